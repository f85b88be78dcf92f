"""Layers: known normals, colours, places, classes and motions; motion against poses in float64."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import LAYERS
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import Fixture, Material
from tests.twins.layers import Before, draw, moved, pixels, points, pose_in
from tests.twins.raycast import rotation_of
from tests.worlds.toy_scene import GREY, UPRIGHT, ToyScene, ball, box, camera, entry, flat_shaded, sheet

VIEW = camera(160, 90, 453.7, (0.0, 0.0, 2.0))
TILTED = (0.03, -0.02, 0.1, 0.3, -0.1, 0.2, 0.8)
FIXTURES = (Fixture(box(0.5, 0.3, 0.02), GREY), Fixture(box(0.02, 0.02, 0.1), GREY), Fixture(box(0.04, 0.04, 0.01), GREY))


def one(mesh, pose=TILTED, view=VIEW, **more) -> ToyScene:
    return ToyScene([entry(mesh)], [[(0, pose)]], (view,), **more)


def crowded(**more) -> ToyScene:
    """A box in a tote beside finger and cup, on a table."""
    poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.1, 0.0, 0.2, *UPRIGHT), (0.1, 0.0, 0.12, *UPRIGHT))
    return one(box(0.1, 0.05, 0.04), fixtures=FIXTURES, fixture_poses=poses, fixtures_visible=(1, 1, 1), table=True, **more)


def random_pose(rng: np.random.Generator) -> tuple[float, ...]:
    q = rng.normal(size=4)
    return (*rng.uniform(-0.1, 0.1, 3), *(q / np.linalg.norm(q)))


# ---- which there are ----


def test_only_what_is_asked_for_is_drawn(device):
    for name in LAYERS:
        assert set(draw(crowded(), device, names=(name,)).layers) == {name}


# ---- normals ----


def test_normals_of_a_ball_point_from_its_centre(device):
    drawn = draw(one(ball(0.1, 5), (0.02, 0.01, 0.3, 0.1, 0.5, 0.2, 0.8)), device)
    seen = drawn.segment[0] == 1
    center = VIEW.rotation @ (0.02, 0.01, 0.3) + VIEW.translation
    expected = (points(drawn.depth[0], VIEW) - center)[seen]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    normals = drawn["normals"][0]
    # Within a triangle the interpolated normal is the ball's but for the square of the triangle's angle, 2 degrees.
    assert np.abs(normals[seen] - expected).max() < 2e-3
    np.testing.assert_allclose(np.linalg.norm(normals[seen], axis=1), 1.0, atol=1e-6)
    assert not normals[~seen].any()
    assert (drawn.segment[0] == Segment.NOTHING).any()


@pytest.mark.parametrize("flip", [False, True])
def test_normals_of_a_sheet_face_the_camera_from_either_side(device, flip):
    pose = np.array([0.0, 0.0, 0.1, 0.3, -0.2, 0.1, 0.9])
    if flip:
        # Turned over about its own x axis: q (1, 0, 0, 0).
        x, y, z, w = pose[3:]
        pose[3:] = (w, z, -y, -x)
    drawn = draw(one(sheet(0.2, 0.2), tuple(pose)), device)
    normal = VIEW.rotation @ rotation_of(pose[3:])[:, 2] * (-1.0 if flip else 1.0)
    assert normal[2] < 0.0
    np.testing.assert_allclose(
        drawn["normals"][0][drawn.segment[0] == 1], np.broadcast_to(normal, ((drawn.segment == 1).sum(), 3)), atol=1e-6
    )


def test_the_table_faces_a_camera_above_it(device):
    drawn = draw(crowded(), device)
    table = drawn.segment[0] == Segment.TABLE
    assert table.any()
    np.testing.assert_array_equal(drawn["normals"][0][table], np.broadcast_to(np.array([0, 0, -1], np.float32), (table.sum(), 3)))


# ---- base colour ----


def test_albedo_is_the_base_colour_whatever_the_light(device):
    toy = crowded()
    toy.entries = [entry(box(0.1, 0.05, 0.04), Material((0.2, 0.4, 1.0), None, 1.0, 0.3))]
    toy.config = replace(toy.config, render=replace(toy.config.render, table_color=(0.1, 0.0, 1.0)))
    drawn = draw(toy, device)
    for code, color in ((1, (51, 102, 255)), (Segment.TABLE, (26, 0, 255)), (Segment.TOTE, (178, 178, 178))):
        found = drawn["albedo"][0][drawn.segment[0] == code].astype(int)
        assert len(found)
        # 0.7 and 0.1 lie half-way between two bytes.
        assert np.abs(found - color).max() <= (0 if code == 1 else 1)


def test_albedo_has_the_texture(device):
    texture = np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (90, 91, 92)]], np.uint8).repeat(64, axis=0).repeat(64, axis=1)
    toy = one(sheet(0.2, 0.2), (0.0, 0.0, 0.0, *UPRIGHT))
    toy.entries = [entry(sheet(0.2, 0.2), Material((1.0, 1.0, 1.0), texture, 0.0, 0.5))]
    drawn = draw(toy, device)
    albedo = drawn["albedo"][0]
    # The sheet's u grows along +x, to the right, and v along +y, up: the picture shows the texture as it is stored.
    for row, column in ((35, 70), (35, 90), (55, 70), (55, 90)):
        assert albedo[row, column].tolist() == texture[-(row > 45), -(column > 80)].tolist()
    assert not albedo[0, 0].any()


# ---- places on objects ----


def test_nocs_tells_where_on_the_object_a_pixel_lies(device):
    whole = trimesh.creation.box(extents=(0.2, 0.1, 0.05))
    # Off its origin, as scanned objects are.
    shift = np.array([0.03, -0.2, 0.01])
    mesh = flat_shaded(whole.vertices + shift, whole.faces)
    pose = (0.0, 0.2, 0.1, 0.2, -0.1, 0.1, 0.9)
    drawn = draw(one(mesh, pose), device)
    seen = drawn.segment[0] == 1
    rotation, translation = pose_in(VIEW, pose)
    own = (points(drawn.depth[0], VIEW)[seen] - translation) @ rotation
    diagonal = np.linalg.norm((0.2, 0.1, 0.05))
    found = diagonal * (drawn["nocs"][0][seen].astype(np.float64) - 0.5) + shift
    assert seen.sum() > 500
    assert np.abs(found - own).max() < 1e-6
    assert not drawn["nocs"][0][~seen].any()


def test_nocs_of_known_points(device):
    drawn = draw(one(box(0.2, 0.1, 0.05), (0.0, 0.0, 0.0, *UPRIGHT), camera(161, 91, 453.7, (0.0, 0.0, 2.0))), device)
    diagonal = np.linalg.norm((0.2, 0.1, 0.05))
    np.testing.assert_allclose(drawn["nocs"][0, 45, 80], (0.5, 0.5, 0.5 + 0.025 / diagonal), atol=1e-6)
    rows, columns = np.nonzero(drawn.segment[0] == 1)
    # A pixel is 4.4 mm wide: the corner lies within one.
    corner = drawn["nocs"][0, rows.min(), columns.min()]
    np.testing.assert_allclose(corner, 0.5 + np.array([-0.1, 0.05, 0.025]) / diagonal, atol=0.0044 / diagonal)


def test_nocs_of_fixtures_table_and_background_are_nothing(device):
    drawn = draw(crowded(), device)
    assert drawn["nocs"][drawn.segment == 1].any(axis=-1).all()
    assert not drawn["nocs"][drawn.segment != 1].any()


# ---- classes ----


def test_classes_are_obj_ids(device):
    toy = crowded()
    toy.entries = [replace(entry(box(0.1, 0.05, 0.04)), obj_id=65535), replace(entry(box(0.1, 0.05, 0.04)), obj_id=7)]
    toy.placed = [[(1, (-0.1, 0.0, 0.1, *UPRIGHT)), (0, (0.0, 0.0, 0.1, *UPRIGHT)), (1, (0.0, 0.08, 0.1, *UPRIGHT))]]
    drawn = draw(toy, device)
    expected = np.zeros(256, int)
    expected[1:4] = 7, 65535, 7
    assert set(np.unique(drawn.segment)) >= {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    np.testing.assert_array_equal(drawn["classes"], expected[drawn.segment])


@pytest.mark.parametrize("number", [0, 65536])
def test_an_object_that_has_no_place_among_the_classes_is_refused(device, number):
    toy = crowded()
    toy.entries = [replace(toy.entries[0], obj_id=number)]
    with pytest.raises(CatalogError, match=f"object {number} has no place in the layer classes"):
        draw(toy, device)
    draw(toy, device, names=("nocs",))


# ---- motion ----


def test_motion_of_a_sheet_that_slid(device):
    # Now 10 px to the right and 5 px up of where it was, at depth 1 m and 100 px a metre.
    view = camera(160, 90, 100.0, (0.0, 0.0, 1.0))
    toy = one(sheet(0.4, 0.4), (0.1, 0.05, 0.0, *UPRIGHT), view)
    drawn = draw(toy, device, Before([[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], [1]))
    seen = drawn.segment[0] == 1
    np.testing.assert_allclose(drawn["flow"][0][seen], np.broadcast_to((-10.0, 5.0), (seen.sum(), 2)), atol=1e-5)
    np.testing.assert_allclose(drawn["scene_flow"][0][seen], np.broadcast_to((-0.1, 0.05, 0.0), (seen.sum(), 3)), atol=1e-7)


def test_motion_of_a_sheet_that_came_nearer(device):
    view = camera(160, 90, 100.0, (0.0, 0.0, 1.0))
    toy = one(sheet(0.4, 0.4), (0.0, 0.0, 0.5, *UPRIGHT), view)
    drawn = draw(toy, device, Before([[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], [1]))
    seen = drawn.segment[0] == 1
    np.testing.assert_allclose(drawn["scene_flow"][0][seen], np.broadcast_to((0.0, 0.0, 0.5), (seen.sum(), 3)), atol=1e-7)
    # At twice the distance, everything was half as far from the middle of the picture.
    rows, columns = np.nonzero(seen)
    np.testing.assert_allclose(drawn["flow"][0][seen], np.stack([80 - columns - 0.5, 45 - rows - 0.5], axis=1) / 2, atol=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_motion_agrees_with_poses_in_float64(device, seed):
    rng = np.random.default_rng(seed)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    view = camera(160, 90, 453.7, tuple(turn.T @ (0.0, 0.0, -2.0)), turn)
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 3), box(0.2, 0.004, 0.1)]
    now, then = ([random_pose(rng) for _ in meshes] for _ in range(2))
    fixtures_now, fixtures_then = (tuple(random_pose(rng) for _ in range(3)) for _ in range(2))
    toy = ToyScene(
        [entry(mesh) for mesh in meshes],
        [list(enumerate(now))],
        (view,),
        fixtures=FIXTURES,
        fixture_poses=fixtures_now,
        fixtures_visible=(1, 1, 1),
    )
    drawn = draw(toy, device, Before([list(enumerate(then))], [1], fixtures_then))
    place = points(drawn.depth[0], view)
    centers = np.stack(np.meshgrid(np.arange(160) + 0.5, np.arange(90) + 0.5), axis=-1)
    poses = {1: (now[0], then[0]), 2: (now[1], then[1]), 3: (now[2], then[2])}
    poses |= {Segment.TOTE + i: (fixtures_now[i], fixtures_then[i]) for i in range(3)}
    assert len(np.unique(drawn.segment)) >= 5
    for code, (pose, before) in poses.items():
        seen = drawn.segment[0] == code
        was = moved(place[seen], pose_in(view, pose), pose_in(view, before))
        # The depth from which the kernel starts is itself a float32: 2 m to 2.4e-7.
        np.testing.assert_allclose(drawn["scene_flow"][0][seen], was - place[seen], atol=1e-6)
        np.testing.assert_allclose(drawn["flow"][0][seen], pixels(was, view) - centers[seen], atol=2e-3)


def test_what_stands_still_does_not_move_at_all(device):
    toy = crowded()
    drawn = draw(toy, device, Before(toy.placed, [1]))
    seen = drawn.segment[0] != Segment.NOTHING
    # To far less than float32 could tell of the positions themselves.
    assert np.abs(drawn["scene_flow"][0][seen]).max() < 1e-15
    assert np.abs(drawn["flow"][0][seen]).max() < 1e-12


def known(drawn) -> np.ndarray:
    """Where motion is known; both layers must agree, in all components."""
    flow, scene_flow = np.isfinite(drawn["flow"]), np.isfinite(drawn["scene_flow"])
    assert (flow.all(axis=-1) == flow.any(axis=-1)).all()
    assert (scene_flow.all(axis=-1) == flow.any(axis=-1)).all()
    return flow.all(axis=-1)


def test_nothing_is_known_of_the_first_frame(device):
    toy = crowded()
    assert not known(draw(toy, device)).any()
    assert not known(draw(toy, device, Before(toy.placed, [0]))).any()


def test_what_was_not_there_has_no_motion(device):
    toy = crowded()
    toy.entries = [entry(box(0.1, 0.05, 0.04)), entry(box(0.1, 0.05, 0.04))]
    poses = [(-0.1, 0.0, 0.1, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT), (0.0, 0.08, 0.1, *UPRIGHT)]
    toy.placed = [[(1, poses[0]), (0, poses[1]), (1, poses[2])]]
    # Instance 0 stays, instance 1 was another object, instance 2 was none; finger and cup were out of the picture.
    before = Before([[(1, poses[0]), (1, poses[1]), (-1, poses[2])]], [1], fixtures_visible=(1, 0, 0))
    drawn = draw(toy, device, before)
    assert set(np.unique(drawn.segment)) >= {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    np.testing.assert_array_equal(known(drawn), np.isin(drawn.segment, (1, Segment.TABLE, Segment.TOTE)))


def test_a_point_that_was_behind_the_camera_has_no_place_in_its_image(device):
    toy = one(sheet(0.4, 0.4), (0.0, 0.0, 0.5, *UPRIGHT), camera(160, 90, 100.0, (0.0, 0.0, 1.0)))
    drawn = draw(toy, device, Before([[(0, (0.0, 0.0, 1.5, *UPRIGHT))]], [1]))
    seen = drawn.segment[0] == 1
    assert np.isnan(drawn["flow"][0]).all()
    np.testing.assert_allclose(drawn["scene_flow"][0][seen][:, 2], -1.0, atol=1e-6)


def test_worlds_and_cameras_do_not_mix(device):
    views = (VIEW, camera(160, 90, 453.7, (0.1, 0.0, 1.0)))
    rng = np.random.default_rng(5)
    now, then = ([[(0, random_pose(rng))] for _ in range(3)] for _ in range(2))
    shape = box(0.1, 0.05, 0.02)
    together = draw(ToyScene([entry(shape)], now, views, table=True), device, Before(then, [1, 0, 1]))
    for world, follows in enumerate((1, 0, 1)):
        for number, view in enumerate(views):
            alone = draw(ToyScene([entry(shape)], [now[world]], (view,), table=True), device, Before([then[world]], [follows]))
            # Cameras are told apart by the depth sensor's noise.
            for name in set(LAYERS) - {"depth_sensor"}:
                np.testing.assert_array_equal(together[name][2 * world + number], alone[name][0])
    assert np.isnan(together["flow"][2:4]).all()
