"""Annotation layers: known normals, albedo, NOCS, class ids and flow, flow against poses in float64; analytic suction maps."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import LAYERS
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import Fixture, Material, TriangleMesh
from tests.twins.layers import PreviousFrame, RenderedLayers, pose_in, previous_points, project, render_layers, surface_points
from tests.twins.raycast import rotation_of
from tests.worlds.shapes import GREY, UPRIGHT, ball, box, camera, entry, flat_shaded, random_pose, random_rotation, sheet
from tests.worlds.toy_scene import ToyScene, one, several

VIEW = camera(160, 90, 453.7, (0.0, 0.0, 2.0))
TILTED = (0.03, -0.02, 0.1, 0.3, -0.1, 0.2, 0.8)
FIXTURES = (Fixture(box(0.5, 0.3, 0.02), GREY), Fixture(box(0.02, 0.02, 0.1), GREY), Fixture(box(0.04, 0.04, 0.01), GREY))


def single(mesh, pose=TILTED, view=VIEW, **more) -> ToyScene:
    return one(mesh, pose, view, **more)


def crowded(**more) -> ToyScene:
    """A box in a tote beside the gripper shaft and cup, on a table."""
    poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.1, 0.0, 0.2, *UPRIGHT), (0.1, 0.0, 0.12, *UPRIGHT))
    return single(box(0.1, 0.05, 0.04), fixtures=FIXTURES, fixture_poses=poses, fixtures_visible=(1, 1, 1), table=True, **more)


# ---- choice of layers ----


def test_only_the_named_layers_are_rendered(device):
    for name in LAYERS:
        assert set(render_layers(crowded(), device, names=(name,)).layers) == {name}


# ---- normals ----


def test_normals_of_a_ball_point_away_from_its_centre(device):
    rendered = render_layers(single(ball(0.1, 5), (0.02, 0.01, 0.3, 0.1, 0.5, 0.2, 0.8)), device)
    seen = rendered.segment[0] == 1
    center = VIEW.rotation @ (0.02, 0.01, 0.3) + VIEW.translation
    expected = (surface_points(rendered.depth[0], VIEW) - center)[seen]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    normals = rendered["normals"][0]
    # Within a triangle the interpolated normal is the ball's but for the square of the triangle's angle, 2 degrees.
    assert np.abs(normals[seen] - expected).max() < 2e-3
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=1), 1.0, atol=1e-6)
    assert not normals[~seen].any()
    assert (rendered.segment[0] == Segment.NOTHING).any()


@pytest.mark.parametrize("flip", [False, True])
def test_normals_of_a_sheet_face_the_camera_from_either_side(device, flip):
    pose = np.array([0.0, 0.0, 0.1, 0.3, -0.2, 0.1, 0.9])
    if flip:
        # Flipped about its own x axis: q (1, 0, 0, 0).
        x, y, z, w = pose[3:]
        pose[3:] = (w, z, -y, -x)
    rendered = render_layers(single(sheet(0.2, 0.2), tuple(pose)), device)
    normal = VIEW.rotation @ rotation_of(pose[3:])[:, 2] * (-1.0 if flip else 1.0)
    assert normal[2] < 0.0
    np.testing.assert_allclose(
        rendered["normals"][0][rendered.segment[0] == 1], np.broadcast_to(normal, ((rendered.segment == 1).sum(), 3)), atol=1e-6
    )


def test_normals_of_the_table_face_the_camera(device):
    rendered = render_layers(crowded(), device)
    table = rendered.segment[0] == Segment.TABLE
    assert table.any()
    np.testing.assert_array_equal(rendered["normals"][0][table], np.broadcast_to(np.array([0, 0, -1], np.float32), (table.sum(), 3)))


# ---- albedo ----


def test_albedo_is_the_base_colour_under_any_light(device):
    toy = crowded()
    toy.entries = [entry(box(0.1, 0.05, 0.04), Material((0.2, 0.4, 1.0), None, 1.0, 0.3))]
    toy.config = replace(toy.config, render=replace(toy.config.render, table_color=(0.1, 0.0, 1.0)))
    rendered = render_layers(toy, device)
    for code, color in ((1, (51, 102, 255)), (Segment.TABLE, (26, 0, 255)), (Segment.TOTE, (178, 178, 178))):
        found = rendered["albedo"][0][rendered.segment[0] == code].astype(int)
        assert len(found)
        # 0.7 and 0.1 lie half-way between two bytes.
        assert np.abs(found - color).max() <= (0 if code == 1 else 1)


def test_albedo_shows_the_texture(device):
    texture = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (90, 91, 92)]], np.uint8).repeat(64, axis=0).repeat(64, axis=1)
    toy = single(sheet(0.2, 0.2), (0.0, 0.0, 0.0, *UPRIGHT))
    toy.entries = [entry(sheet(0.2, 0.2), Material((1.0, 1.0, 1.0), texture, 0.0, 0.5))]
    rendered = render_layers(toy, device)
    albedo = rendered["albedo"][0]
    # The sheet's u grows along +x, to the right, and v along +y, up: the image shows the texture as it is stored.
    for row, column in ((35, 70), (35, 90), (55, 70), (55, 90)):
        assert albedo[row, column].tolist() == texture[-(row > 45), -(column > 80)].tolist()
    assert not albedo[0, 0].any()


# ---- NOCS ----


def test_nocs_gives_the_point_in_object_coordinates(device):
    whole = trimesh.creation.box(extents=(0.2, 0.1, 0.05))
    # Off its origin, as scanned objects are.
    shift = np.array([0.03, -0.2, 0.01])
    mesh = flat_shaded(whole.vertices + shift, whole.faces)
    pose = (0.0, 0.2, 0.1, 0.2, -0.1, 0.1, 0.9)
    rendered = render_layers(single(mesh, pose), device)
    seen = rendered.segment[0] == 1
    rotation, translation = pose_in(VIEW, pose)
    own = (surface_points(rendered.depth[0], VIEW)[seen] - translation) @ rotation
    diagonal = np.linalg.norm((0.2, 0.1, 0.05))
    found = diagonal * (rendered["nocs"][0][seen].astype(np.float64) - 0.5) + shift
    assert seen.sum() > 500
    assert np.abs(found - own).max() < 1e-6
    assert not rendered["nocs"][0][~seen].any()


def test_nocs_of_fixtures_table_and_background_is_zero(device):
    rendered = render_layers(crowded(), device)
    assert rendered["nocs"][rendered.segment == 1].any(axis=-1).all()
    assert not rendered["nocs"][rendered.segment != 1].any()


# ---- classes ----


def test_classes_are_obj_ids(device):
    toy = crowded()
    toy.entries = [replace(entry(box(0.1, 0.05, 0.04)), obj_id=65535), replace(entry(box(0.1, 0.05, 0.04)), obj_id=7)]
    toy.placed = [[(1, (-0.1, 0.0, 0.1, *UPRIGHT)), (0, (0.0, 0.0, 0.1, *UPRIGHT)), (1, (0.0, 0.08, 0.1, *UPRIGHT))]]
    rendered = render_layers(toy, device)
    expected = np.zeros(256, int)
    expected[1:4] = 7, 65535, 7
    assert set(np.unique(rendered.segment)) >= {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    np.testing.assert_array_equal(rendered["classes"], expected[rendered.segment])


@pytest.mark.parametrize("number", [0, 65536])
def test_an_obj_id_that_does_not_fit_the_layer_is_an_error(device, number):
    toy = crowded()
    toy.entries = [replace(toy.entries[0], obj_id=number)]
    with pytest.raises(CatalogError, match=f"object {number} has no place in the layer classes"):
        render_layers(toy, device)
    render_layers(toy, device, names=("nocs",))


# ---- optical flow and scene flow ----


@pytest.mark.parametrize("seed", range(3))
def test_flow_agrees_with_poses_in_float64(device, seed):
    rng = np.random.default_rng(seed)
    turn = random_rotation(rng)
    view = camera(160, 90, 453.7, tuple(turn.T @ (0.0, 0.0, -2.0)), turn)
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 3), box(0.2, 0.004, 0.1)]
    now, then = ([random_pose(rng) for _ in meshes] for _ in range(2))
    fixtures_now, fixtures_then = (tuple(random_pose(rng) for _ in range(3)) for _ in range(2))
    toy = several(meshes, now, view, fixtures=FIXTURES, fixture_poses=fixtures_now, fixtures_visible=(1, 1, 1))
    rendered = render_layers(toy, device, PreviousFrame([list(enumerate(then))], [1], fixtures_then))
    point = surface_points(rendered.depth[0], view)
    centers = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5), axis=-1)
    poses = {1: (now[0], then[0]), 2: (now[1], then[1]), 3: (now[2], then[2])}
    poses |= {Segment.TOTE + i: (fixtures_now[i], fixtures_then[i]) for i in range(3)}
    assert len(np.unique(rendered.segment)) >= 5
    for code, (pose, before) in poses.items():
        seen = rendered.segment[0] == code
        was = previous_points(point[seen], pose_in(view, pose), pose_in(view, before))
        # The depth from which the kernel starts is itself a float32: 2 m to 2.4e-7.
        np.testing.assert_allclose(rendered["scene_flow"][0][seen], was - point[seen], atol=1e-6)
        np.testing.assert_allclose(rendered["flow"][0][seen], project(was, view) - centers[seen], atol=2e-3)


def test_flow_of_bodies_at_rest_is_zero(device):
    toy = crowded()
    rendered = render_layers(toy, device, PreviousFrame(toy.placed, [1]))
    seen = rendered.segment[0] != Segment.NOTHING
    # Far below the float32 resolution of the positions.
    assert np.abs(rendered["scene_flow"][0][seen]).max() < 1e-15
    assert np.abs(rendered["flow"][0][seen]).max() < 1e-12


def known(rendered) -> np.ndarray:
    """Mask of project with known flow; both layers must agree, in all components."""
    flow, scene_flow = np.isfinite(rendered["flow"]), np.isfinite(rendered["scene_flow"])
    assert (flow.all(axis=-1) == flow.any(axis=-1)).all()
    assert (scene_flow.all(axis=-1) == flow.any(axis=-1)).all()
    return flow.all(axis=-1)


def test_flow_of_the_first_frame_is_unknown(device):
    toy = crowded()
    assert not known(render_layers(toy, device)).any()
    assert not known(render_layers(toy, device, PreviousFrame(toy.placed, [0]))).any()


def test_flow_of_bodies_absent_in_the_previous_frame_is_unknown(device):
    toy = crowded()
    toy.entries = [entry(box(0.1, 0.05, 0.04)), entry(box(0.1, 0.05, 0.04))]
    poses = [(-0.1, 0.0, 0.1, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT), (0.0, 0.08, 0.1, *UPRIGHT)]
    toy.placed = [[(1, poses[0]), (0, poses[1]), (1, poses[2])]]
    # Instance 0 stays, instance 1 was another object, instance 2 was absent; gripper shaft and cup were out of the scene.
    before = PreviousFrame([[(1, poses[0]), (1, poses[1]), (-1, poses[2])]], [1], fixtures_visible=(1, 0, 0))
    rendered = render_layers(toy, device, before)
    assert set(np.unique(rendered.segment)) >= {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    np.testing.assert_array_equal(known(rendered), np.isin(rendered.segment, (1, Segment.TABLE, Segment.TOTE)))


def test_optical_flow_of_a_point_behind_the_camera_is_unknown(device):
    toy = single(sheet(0.4, 0.4), (0.0, 0.0, 0.5, *UPRIGHT), camera(160, 90, 100.0, (0.0, 0.0, 1.0)))
    rendered = render_layers(toy, device, PreviousFrame([[(0, (0.0, 0.0, 1.5, *UPRIGHT))]], [1]))
    seen = rendered.segment[0] == 1
    assert np.isnan(rendered["flow"][0]).all()
    np.testing.assert_allclose(rendered["scene_flow"][0][seen][:, 2], -1.0, atol=1e-6)


def test_views_of_a_batch_are_independent(device):
    views = (camera(64, 36, 181.5, (0.0, 0.0, 1.0)), camera(64, 36, 181.5, (0.1, 0.0, 1.0)))
    rng = np.random.default_rng(5)
    now, then = ([[(0, random_pose(rng))] for _ in range(3)] for _ in range(2))
    shape = box(0.1, 0.05, 0.02)
    together = render_layers(ToyScene([entry(shape)], now, views, table=True), device, PreviousFrame(then, [1, 0, 1]))
    for world, follows in enumerate((1, 0, 1)):
        for number, view in enumerate(views):
            alone = render_layers(
                ToyScene([entry(shape)], [now[world]], (view,), table=True), device, PreviousFrame([then[world]], [follows])
            )
            # The noise of sensors differs by camera.
            for name in set(LAYERS) - {"depth_sensor", "ir_left", "ir_right", "depth_stereo"}:
                np.testing.assert_array_equal(together[name][2 * world + number], alone[name][0])
    assert np.isnan(together["flow"][2:4]).all()


# ---- suction maps, by the formulas of SuctionNet in NumPy ----


MILLIMETRES = camera(141, 101, 1000.0, (0.0, 0.0, 1.0))
"""A pixel is 1 mm at the height 0."""
RADIUS = 0.01
NAMES = ("suction_seal", "suction_wrench")
TOP = (0.0, 0.0, -0.02, *UPRIGHT)
"""Pose of a box 40 mm high whose upper face is at height 0."""


def scores(device, *bodies, center=(0.0, 0.0, 0.0), **more) -> RenderedLayers:
    """Maps of meshes at poses; the first has its centre of mass at `center`."""
    entries = [entry(mesh) for mesh, _ in bodies]
    entries[0] = replace(entries[0], center_of_mass=np.array(center))
    return render_layers(
        ToyScene(entries, [[(k, pose) for k, (_, pose) in enumerate(bodies)]], (MILLIMETRES,), **more), device, names=NAMES
    )


def points(found: RenderedLayers) -> np.ndarray:
    """Surface point of each pixel in the world [m]."""
    return (surface_points(found.depth[0], MILLIMETRES) - MILLIMETRES.translation) @ MILLIMETRES.rotation


def seal(heights: np.ndarray) -> float:
    """SuctionNet's score of the heights of a lip's 72 points [m]."""
    chord = 2.0 * RADIUS * np.sin(np.pi / 72)
    edges = np.hypot(chord, np.diff(heights, append=heights[0]))
    return float((chord / edges).min() * np.exp(-1e5 * heights.var()))


def cylinder(radius: float, length: float, sections: int) -> TriangleMesh:
    """A smooth cylinder along x."""
    mesh = trimesh.creation.cylinder(radius, length, sections=sections)
    vertices = np.asarray(mesh.vertices)[:, [2, 0, 1]]
    made = flat_shaded(vertices, np.asarray(mesh.faces))
    normals = made.vertices * np.array([0.0, 1.0, 1.0], np.float32)
    return replace(made, normals=(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(np.float32))


def test_a_face_seals_where_the_whole_lip_lies_on_it(device):
    found = scores(device, (box(0.08, 0.06, 0.04), TOP))
    inside = np.abs(points(found)[..., :2]) + RADIUS - (0.04, 0.03)
    face = found.segment[0] == 1
    seals = found["suction_seal"][0]
    np.testing.assert_allclose(seals[face & (inside.max(axis=-1) < -1e-4)], 1.0, atol=1e-4)
    # 72 points leave 0.01 mm between polygon and circle.
    assert not seals[face & (inside.max(axis=-1) > 2e-5)].any()
    assert not seals[~face].any()
    assert not found["suction_wrench"][0][~face].any()


@pytest.mark.parametrize("radius", [0.012, 0.02])
def test_a_cylinder_bends_the_lip(device, radius):
    found = scores(device, (cylinder(radius, 0.1, 720), (0.0, 0.0, -radius, *UPRIGHT)))
    angle = 2.0 * np.pi * (np.arange(72) + 0.5) / 72
    expected = seal(np.sqrt(radius**2 - (RADIUS * np.sin(angle)) ** 2) - radius)
    assert 0.2 < expected < 0.95
    assert found["suction_seal"][0, 50, 70] == pytest.approx(expected, abs=0.02)


def test_a_ball_keeps_the_lip_in_a_plane(device):
    found = scores(device, (ball(0.03, 6), (0.0, 0.0, -0.03, *UPRIGHT)))
    steep = np.linalg.norm(points(found)[..., :2], axis=-1) > 0.025
    assert found["suction_seal"][0][(found.segment[0] == 1) & ~steep].min() > 0.99


def test_a_ball_smaller_than_the_cup_does_not_seal(device):
    found = scores(device, (ball(0.009, 4), (0.0, 0.0, -0.009, *UPRIGHT)))
    assert (found.segment[0] == 1).any()
    assert not found["suction_seal"].any()


def test_a_groove_costs_by_its_depth(device):
    """Two boards with a step of 1 mm under one cup: half of the lip is lower, and two edges cross the step."""
    bounds = [(-0.05, -0.04, -0.02), (0.0, 0.04, 0.0)], [(0.0, -0.04, -0.02), (0.05, 0.04, -0.001)]
    boards = trimesh.util.concatenate([trimesh.creation.box(bounds=corners) for corners in bounds])
    found = scores(device, (flat_shaded(boards.vertices, boards.faces), (-0.0005, 0.0, 0.0, *UPRIGHT)))
    angle = 2.0 * np.pi * (np.arange(72) + 0.5) / 72
    for column in (62, 66, 75):
        x = points(found)[50, column, 0] + 0.0005
        heights = np.where(x + RADIUS * np.cos(angle) < 0.0, 0.0, -0.001)
        assert found["suction_seal"][0, 50, column] == pytest.approx(seal(heights), abs=1e-3)


def test_the_lever_of_the_centre_of_mass_costs(device):
    center = (0.015, 0.0, -0.01)
    found = scores(device, (box(0.12, 0.08, 0.04), TOP), center=center)
    away = np.abs(points(found)[..., :2] - center[:2]).max(axis=-1)
    # The tangents of a cup that looks up are the image's axes: the larger of both torques counts.
    expected = 1.0 - np.minimum(9.8 * away / (15.6 * np.pi * RADIUS), 1.0)
    face = (np.abs(points(found)[..., :2]) < (0.0599, 0.0399)).all(axis=-1)
    np.testing.assert_allclose(found["suction_wrench"][0][face], expected[face], atol=1e-4)
    assert expected[face].min() == 0.0 < expected[face].max()


@pytest.mark.parametrize(("thickness", "sealed"), [(0.009, True), (0.011, False)])
def test_a_neighbour_in_the_cups_way_prevents_a_seal(device, thickness, sealed):
    """A board lies on the face, from x = 15 mm on, and rises above it by less or more than 10 mm."""
    board = box(0.05, 0.06, thickness), (0.04, 0.0, 0.5 * thickness, *UPRIGHT)
    found = scores(device, (box(0.06, 0.06, 0.04), TOP), board)
    x, y = points(found)[..., 0], points(found)[..., 1]
    own = (found.segment[0] == 1) & (np.abs(y) < 0.019)
    assert found["suction_seal"][0][own & (np.abs(x + 0.007) < 0.0115)].min() > 0.99
    assert (found["suction_seal"][0][own & (np.abs(x - 0.010) < 0.0045)] > 0.99).all() == sealed
    assert found["suction_seal"][0][own & (np.abs(x - 0.010) < 0.0045)].any() == sealed


def test_bins_stand_in_the_way_and_grippers_do_not(device):
    walls = (Fixture(box(0.02, 0.3, 0.2), GREY), Fixture(box(0.02, 0.02, 0.1), GREY), Fixture(box(0.02, 0.02, 0.01), GREY))
    poses = ((0.045, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT), (0.0, 0.0, 0.04, *UPRIGHT))
    tilted = (0.0, 0.0, -0.02, 0.0, np.sin(0.4), 0.0, np.cos(0.4))
    made = {"fixtures": walls, "fixture_poses": poses}
    found = scores(device, (box(0.06, 0.06, 0.04), tilted), **made, fixtures_visible=(1, 1, 1))
    free = scores(device, (box(0.06, 0.06, 0.04), tilted), **made, fixtures_visible=(0, 1, 1))
    seen = (found.segment[0] == 1) & (free.segment[0] == 1)
    # The face looks to +x, where the wall is.
    assert (free["suction_seal"][0][seen] > 0.99).sum() > 200
    assert not found["suction_seal"][0][seen & (found["suction_seal"][0] != free["suction_seal"][0])].any()
    assert (found["suction_seal"][0][seen] == 0.0).sum() > (free["suction_seal"][0][seen] == 0.0).sum() + 100
