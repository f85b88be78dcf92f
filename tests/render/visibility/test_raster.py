"""Triangle rasterizer, behind pinholes and lenses: its G-buffer equals that of ray tracing, of float64 and of OpenCV, for any triangles."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Segment
from synpick_warp.configs.calibration.lens import FISHEYE, with_matrix
from synpick_warp.configs.schema import UNOCCLUDED
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.types import Camera, Fixture, TriangleMesh
from synpick_warp.stages.render import raster
from synpick_warp.stages.render.cameras import allocate_lenses, allocate_view_cameras, place_cameras
from synpick_warp.system.hardware.device import pick_device
from tests.harness.environment import default_device
from tests.harness.trace_probe import trace_gbuffer
from tests.twins.layers import PreviousFrame, annotated, render_layers
from tests.twins.masks import bits_of, masks_of_buffers
from tests.worlds.shapes import DOWN, FLAT, GREY, UPRIGHT, ball, box, camera, distorted, entry, flat_shaded, random_pose, sheet, surface
from tests.worlds.toy_scene import (
    ANNOTATIONS,
    ToyScene,
    assert_same,
    build_scene,
    one,
    render,
    render_gbuffer,
    several,
    views_of,
    with_render,
)

VIEW = camera(96, 64, 150.0, (0.0, 0.0, 1.0))
NEVER = 1.0e6
"""Depth of a miss in the reference [m]."""


def triangles(corners: np.ndarray) -> TriangleMesh:
    """A mesh of loose triangles (F, 3, 3) [m]."""
    return flat_shaded(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))


def arrays_of(gbuffer: Any) -> dict[str, np.ndarray]:
    return {name: getattr(gbuffer, name).numpy()[0].copy() for name in ("segment", "triangle", "barycentric", "depth")}


def gbuffer_of(toy: ToyScene, device: wp.Device) -> dict[str, np.ndarray]:
    """G-buffer and amodal bits of world 0 seen by camera 0."""
    out, renderer = render_gbuffer(toy, device)
    return arrays_of(renderer.gbuffer) | {"amodal": bits_of(masks_of_buffers(out))[0]}


def gbuffers_of(toy: ToyScene, device: wp.Device) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """G-buffers of world 0 seen by camera 0: rasterized, and by ray tracing."""
    _, renderer = render_gbuffer(toy, device)
    rasterized = arrays_of(renderer.gbuffer)
    trace_gbuffer(renderer.scene, renderer.bodies, views_of(toy, device, renderer.cameras), renderer.gbuffer, 1)
    return rasterized, arrays_of(renderer.gbuffer)


def depth_in_float64(corners: np.ndarray, view=VIEW) -> tuple[np.ndarray, np.ndarray]:
    """Nearest planar depth (H, W) [m] by the Möller-Trumbore test, and each ray's least margin (H, W) of hit or miss."""
    k = view.matrix
    x, y = (np.arange(view.width) + 0.5 - k[0, 2]) / k[0, 0], (np.arange(view.height) + 0.5 - k[1, 2]) / k[1, 1]
    ray = np.stack([*np.broadcast_arrays(x[None, :], y[:, None]), np.ones((view.height, view.width))], axis=-1)
    if view.lens is not None:
        centers = np.stack(np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), -1)
        ray[..., :2] = view.lens.unproject(centers)
    nearest, clear = np.full(ray.shape[:2], NEVER), np.full(ray.shape[:2], np.inf)
    for a, b, c in corners.astype(np.float32).astype(np.float64) @ view.rotation.T + view.translation:
        across = np.cross(ray, c - a)
        determinant = across @ (b - a)
        # A triangle seen edge-on may be hit or missed.
        clear = np.minimum(clear, np.abs(determinant) / (np.linalg.norm(b - a) * np.linalg.norm(c - a) + 1e-30) * 1e3)
        safe = np.where(determinant == 0.0, 1.0, determinant)
        u, v = across @ -a / safe, ray @ np.cross(-a, b - a) / safe
        depth = np.cross(-a, b - a) @ (c - a) / safe
        weights = np.stack([u, v, 1.0 - u - v, depth])
        met = (weights >= 0.0).all(axis=0) & (determinant != 0.0)
        # Distance of the point from an edge [px]; depth is 0 where a ray starts on the triangle.
        clear = np.minimum(clear, np.abs(weights).min(axis=0) * 1e3)
        nearest = np.where(met & (depth < nearest), depth, nearest)
    return nearest, clear


def random_triangles(seed: int, count: int, size: float, spread: float) -> np.ndarray:
    """Loose triangles about the origin (count, 3, 3) [m]."""
    rng = np.random.default_rng(seed)
    return rng.uniform(-spread, spread, (count, 1, 3)) + size * rng.normal(size=(count, 3, 3))


def check_triangles(corners: np.ndarray, device: wp.Device, view: Camera = VIEW, margin: float = 0.1, least: float = 0.4) -> int:
    """Compare the G-buffer of loose triangles with float64 where no ray is within `margin` of a miss, at `least` such; number of hits."""
    found = gbuffer_of(one(triangles(corners), FLAT, view), device)
    depth, clear = depth_in_float64(corners, view)
    sure = clear > margin
    assert sure.mean() > least
    np.testing.assert_array_equal(found["segment"][sure] == 1, depth[sure] < NEVER)
    both = sure & (depth < NEVER)
    np.testing.assert_allclose(found["depth"][both], depth[both], rtol=2e-4)
    assert (found["amodal"][both] == 1).all()
    return int(both.sum())


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 12), size=st.sampled_from([0.003, 0.03, 0.3, 2.0]))
def test_loose_triangles_of_any_size_agree_with_float64(seed, count, size):
    """Two metres are much larger than the camera's distance of one: such triangles pass through its plane, and behind it."""
    check_triangles(random_triangles(seed, count, size, 0.2), pick_device(default_device()), least=0.5)


@pytest.mark.parametrize("depth", [-0.5, 0.0, 1e-3, 2e-3, 5e-3, 0.05])
def test_triangles_that_reach_the_camera_plane_are_complete(device, depth):
    """Triangles with one corner at `depth` [m] and the others spread over the image."""
    rng = np.random.default_rng(7)
    near, far = rng.uniform(-0.02, 0.02, (12, 2)), rng.uniform(-0.25, 0.25, (12, 2, 2))
    corners = np.stack([np.concatenate([n, [1.0 - depth]]) for n in near])[:, None]
    corners = np.concatenate([corners, np.concatenate([far, np.zeros((12, 2, 1))], axis=2)], axis=1)
    assert check_triangles(corners, device, margin=0.02) > 500


@pytest.mark.parametrize("seed", range(3))
def test_ray_tracing_gives_the_same_gbuffer(device, seed):
    rng = np.random.default_rng(seed)
    meshes = [ball(0.1, 4), box(0.2, 0.1, 0.05), ball(0.05, 2), sheet(0.4, 0.3)]
    poses = [random_pose(rng, (-0.2, -0.1, 0.0), (0.2, 0.1, 0.3)) for _ in meshes]
    fixtures = (Fixture(box(0.7, 0.5, 0.02), GREY), Fixture(box(0.05, 0.05, 0.3), GREY), Fixture(ball(0.04, 3), GREY))
    placed = ((0.01, 0.0, 0.0, *UPRIGHT), (0.1, 0.1, 0.4, *UPRIGHT), (0.1, 0.1, 0.2, *UPRIGHT))
    toy = several(meshes, poses, VIEW, fixtures=fixtures, fixture_poses=placed, fixtures_visible=(1, 1, 1), table=True)
    ours, theirs = gbuffers_of(toy, device)
    # On a GPU the two ray tests round differently: rays within rounding of an edge may pass it on either side.
    differs = ours["segment"] != theirs["segment"]
    assert differs.sum() <= (2 if device.is_cuda else 0)
    theirs = {
        name: np.where(differs.reshape(differs.shape + (1,) * (values.ndim - 2)), ours[name], values) for name, values in theirs.items()
    }
    assert set(np.unique(ours["segment"])) >= {1, 2, 4, Segment.TOTE, Segment.FINGER}
    met = (ours["segment"] != Segment.NOTHING) & (ours["segment"] != Segment.TABLE)
    same = met & (ours["triangle"] == theirs["triangle"])
    assert same.sum() > 0.99 * met.sum()
    np.testing.assert_allclose(ours["depth"], theirs["depth"], rtol=3e-6)
    np.testing.assert_allclose(ours["barycentric"][same], theirs["barycentric"][same], atol=2e-4)


def test_shared_edges_are_watertight(device):
    """The edges of a fan of 4 x 4 squares pass through the centres of pixels; each is met, from either side of the sheet."""
    # Pixel centres lie 1 / 150 m apart at a distance of one; corners at every third, each in its own, rounded, coordinates.
    x, y = (np.arange(-13, 14, 3) + 0.5) / 150.0, (np.arange(-10, 11, 3) + 0.5) / 150.0
    faces = []
    for j in range(len(y) - 1):
        for i in range(len(x) - 1):
            a, b, c, d = ((x[i], y[j], 0), (x[i + 1], y[j], 0), (x[i + 1], y[j + 1], 0), (x[i], y[j + 1], 0))
            faces += [(a, b, c), (c, d, a)] if (i + j) % 2 else [(d, a, b), (b, c, d)]
    mesh = triangles(np.array(faces))
    for turn in (UPRIGHT, (1.0, 0.0, 0.0, 0.0)):
        found = gbuffer_of(one(mesh, (0.0, 0.0, 0.0, *turn), VIEW), device)
        rows, columns = np.nonzero(found["segment"] == 1)
        inside = found["segment"][rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
        assert (inside == 1).all()
        assert inside.size >= 24 * 18


def test_the_order_of_triangles_and_bodies_does_not_matter(device):
    corners = random_triangles(3, 300, 0.05, 0.2)
    shuffled = np.random.default_rng(0).permutation(len(corners))
    first, second = (gbuffer_of(one(triangles(c), FLAT, VIEW), device) for c in (corners, corners[shuffled]))
    np.testing.assert_array_equal(first["depth"], second["depth"])
    np.testing.assert_array_equal(first["amodal"], second["amodal"])
    met = first["segment"] == 1
    np.testing.assert_array_equal(first["triangle"][met], shuffled[second["triangle"][met]])


@pytest.mark.parametrize("capacity", [0, 3, raster.BLOCKS])
def test_large_triangles_are_complete_with_any_capacity_for_blocks(device, capacity, monkeypatch):
    toy = one(box(0.3, 0.2, 0.1), (0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.927), camera(192, 128, 300.0, (0.0, 0.0, 1.0)))
    _, expected = gbuffers_of(toy, device)
    monkeypatch.setattr(raster, "BLOCKS", capacity)
    monkeypatch.setattr(raster, "INSTANCE_BLOCKS", 0)
    found = gbuffer_of(toy, device)
    np.testing.assert_array_equal(found["segment"], expected["segment"])
    np.testing.assert_array_equal(found["amodal"], (expected["segment"] == 1).astype(np.uint32))
    assert (found["segment"] == 1).sum() > 20 * 256


def test_the_static_background_equals_the_rasterized_tote(device):
    """The same rotation as another quaternion is not the pose of the background, so the tote is rasterized."""
    fixtures = (Fixture(box(0.5, 0.3, 0.05), GREY), Fixture(box(0.05, 0.05, 0.3), GREY), Fixture(box(0.1, 0.1, 0.1), GREY))
    poses = [(0, (0.05, 0.02, 0.02, 0.1, 0.2, 0.3, 0.927)), (0, (-0.1, 0.0, -0.2, *UPRIGHT))]
    views = (VIEW, camera(96, 64, 120.0, (0.1, 0.0, 0.8)))
    toy = ToyScene([entry(box(0.1, 0.1, 0.1))], [poses], views, fixtures=fixtures, fixtures_visible=(1, 1, 0), table=True)
    other = replace(toy, fixture_poses=((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0), *toy.fixture_poses[1:]))
    pictures = [render(scene, device) for scene in (toy, other)]
    assert_same(*pictures, "color", "exact_depth", "radiance", *ANNOTATIONS)
    assert {1, Segment.TABLE, Segment.TOTE, Segment.FINGER} <= set(np.unique(pictures[0].instance))
    # An object under the tote keeps its amodal bits, and is not visible.
    assert ((pictures[0].amodal & 2) != 0).any()
    assert not (pictures[0].instance == 2).any()


def test_a_moved_or_hidden_tote_does_not_use_the_background(device):
    fixtures = (Fixture(box(0.5, 0.3, 0.05), GREY),) * 3
    toy = ToyScene([entry(box(0.1, 0.1, 0.1))], [[]], (VIEW,), fixtures=fixtures, fixtures_visible=(1, 0, 0))
    home = gbuffer_of(toy, device)["segment"] == Segment.TOTE
    moved = gbuffer_of(replace(toy, fixture_poses=((0.1, 0.0, 0.0, *UPRIGHT),) * 3), device)["segment"] == Segment.TOTE
    gone = gbuffer_of(replace(toy, fixtures_visible=(0, 0, 0)), device)["segment"]
    assert home.sum() > 1000
    np.testing.assert_array_equal(np.roll(home, 15, axis=1)[:, 15:], moved[:, 15:])
    assert not gone.any()


BINS = (
    Fixture(box(0.5, 0.3, 0.05), replace(GREY, color=(0.7, 0.1, 0.1))),
    Fixture(box(0.3, 0.4, 0.1), replace(GREY, color=(0.1, 0.2, 0.7))),
)
GRIP = (Fixture(box(0.05, 0.05, 0.3), GREY), Fixture(box(0.1, 0.1, 0.1), GREY))
IN_A_BIN = several(
    (box(0.1, 0.1, 0.1), ball(0.06, 3)),
    ((0.05, 0.0, 0.1, *UPRIGHT), (-0.08, 0.02, 0.11, *UPRIGHT)),
    VIEW,
    fixture_poses=((0.0, 0.0, 0.0, *UPRIGHT), (0.0, 0.1, 0.3, *UPRIGHT), (0.0, 0.1, 0.15, *UPRIGHT)),
    fixtures_visible=(1, 1, 1),
    table=True,
)


@pytest.mark.parametrize("chosen", range(2))
def test_a_world_shows_its_own_bin(device, chosen):
    """The picture is that of a scene with this bin alone."""
    several = render(replace(IN_A_BIN, fixtures=(*BINS, *GRIP), bin=chosen), device)
    alone = render(replace(IN_A_BIN, fixtures=(BINS[chosen], *GRIP)), device)
    assert {1, 2, Segment.TABLE, Segment.TOTE, Segment.FINGER} <= set(np.unique(alone.instance))
    assert_same(several, alone, "color", *ANNOTATIONS)


def test_a_bin_that_moves_with_camera_and_objects_gives_the_same_picture(device):
    """One is shown before the static background, the other not."""
    offset = np.array([0.125, -0.0625, 0.0])

    def moved(pose):
        return (*(np.array(pose[:3]) + offset).tolist(), *pose[3:])

    toy = replace(IN_A_BIN, fixtures=(BINS[0], *GRIP))
    lens = replace(VIEW, translation=VIEW.translation - VIEW.rotation @ offset)
    placed = [[(which, moved(pose)) for which, pose in toy.placed[0]]]
    other = replace(toy, cameras=(lens,), placed=placed, fixture_poses=tuple(map(moved, toy.fixture_poses)))
    first, second = render(toy, device), render(other, device)
    np.testing.assert_array_equal(first.instance, second.instance)
    np.testing.assert_allclose(first.exact_depth, second.exact_depth, rtol=2e-6)
    assert np.abs(first.color.astype(int) - second.color).max() <= 1


def test_a_mesh_with_more_triangles_than_marks_can_name_is_refused(device, monkeypatch):
    monkeypatch.setattr(raster, "MAX_TRIANGLES", 11)
    with pytest.raises(CatalogError, match="a mesh has 12 triangles; at most 11"):
        gbuffer_of(ToyScene([entry(box(0.1, 0.1, 0.1))], [[]], (VIEW,)), device)


# ---- distorted cameras ----


WIDE = camera(96, 64, 70.0, (0.0, 0.0, 1.0))
VIEWS = {
    "issue": distorted(WIDE, -0.12, 0.08, 0.0005, -0.0003, 0.0),
    "strong": distorted(WIDE, -0.35, 0.12, 0.002, -0.003, 0.0),
    "pincushion": distorted(WIDE, 0.2, 0.05, 0.0, 0.0),
    "rational": distorted(WIDE, 8.5, 3.2, 1e-3, -5e-4, 0.15, 8.8, 4.8, 0.6),
    "prism": distorted(WIDE, -0.2, 0.05, 2e-3, -3e-3, 0.0, 0.01, 0.02, 0.0, 0.01, -2e-3, 5e-3, 1e-3),
    "fisheye": distorted(WIDE, -0.01, 0.02, -0.01, 0.002, model=FISHEYE),
}


def on_views(*values: tuple) -> list[tuple]:
    """The first values on each of VIEWS, the others on the strong one."""
    return [*((name, *values[0]) for name in VIEWS), *(("strong", *other) for other in values[1:])]


TURN = Rotation.from_euler("xyz", [172, 9, 40], degrees=True).as_matrix()
OFF_CENTRE = Camera(96, 64, np.array([[75.0, 0.0, 51.3], [0.0, 69.4, 30.2], [0.0, 0.0, 1.0]]), TURN, -TURN @ (0.02, -0.03, 1.0))
"""A real camera matrix without a lens: fx ≠ fy and cx ≠ W/2."""


def opencv_pixels(view: Camera, points: np.ndarray) -> np.ndarray:
    """Pixel coordinates of world points (n, 3) by OpenCV with the camera's values; its pixel centres are then at + 0.5, as ours."""
    lens = view.lens and view.lens.lens
    project = cv2.fisheye.projectPoints if lens and lens.model == FISHEYE else cv2.projectPoints
    there = (points @ view.rotation.T + view.translation).reshape(-1, 1, 3)
    return project(there, np.zeros(3), np.zeros(3), view.matrix, np.array(lens.coefficients) if lens else None)[0].reshape(-1, 2)


@settings(max_examples=30, deadline=None)
@given(name=st.sampled_from(sorted(VIEWS)), seed=st.integers(0, 2**32 - 1), size=st.sampled_from([0.003, 0.03, 0.3, 2.0]))
def test_the_rasterizer_misses_no_ray(name, seed, size):
    """Triangles all over and beside the image, some through the camera's plane: their footprints bound their bent images."""
    device = pick_device(default_device())
    ours, theirs = gbuffers_of(one(triangles(random_triangles(seed, 30, size, 0.8)), FLAT, VIEWS[name]), device)
    differs = ours["segment"] != theirs["segment"]
    assert differs.sum() <= (2 if device.is_cuda else 0)
    # Both are float32, and depth is interpolated over two metres: of 70 seeds, the worst differs by 5e-5.
    np.testing.assert_allclose(ours["depth"][~differs], theirs["depth"][~differs], rtol=1e-4, atol=2e-6)


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("size", [0.03, 0.3])
def test_depth_and_masks_are_those_of_float64(device, name, size):
    assert check_triangles(random_triangles(5, 40, size, 0.4), device, VIEWS[name]) > 20


@pytest.mark.parametrize(("name", "zoom", "shift"), on_views((0.0, (3.0, -2.0)), (0.05, (-4.5, 0.25)), (-0.02, (0.5, 1.5))))
def test_rays_of_a_drawn_camera_matrix_are_those_of_float64(device, name, zoom, shift):
    """Beside a pinhole, in a batch of three views with a lens of their own."""
    view = VIEWS[name]
    matrix = view.matrix * (1.0 + zoom * np.eye(3))
    matrix[:2, 2], matrix[2, 2] = view.matrix[:2, 2] + shift, 1.0
    lenses = (with_matrix(view.lens, matrix), None, view.lens)
    scene = build_scene(ToyScene([entry(sheet(1.0, 1.0))], [[]], (view, WIDE)), device)
    slot, matrices = np.array([0, 1, 0], np.int32), np.array([matrix, WIDE.matrix, view.matrix])
    cameras = allocate_view_cameras(4, device, scene.cameras)
    cameras.lenses = allocate_lenses({"view": 4, "row": view.height, "column": view.width}, device)
    placed = {"matrix": matrices, "rotation": np.array([DOWN] * 3), "translation": np.zeros((3, 3))}
    place_cameras(cameras, scene.cameras, slot, placed, (view.lens, None))
    assert cameras.lens.numpy()[:3].tolist() == [0, -1, 2]
    for row in (0, 2):
        # A thousandth of a pixel is 1.5e-5 here.
        np.testing.assert_allclose(cameras.lenses.ray.numpy()[row], lenses[row].rays(), rtol=0, atol=5e-7)


@pytest.mark.parametrize("view", [*VIEWS.values(), OFF_CENTRE], ids=[*VIEWS, "off centre"])
def test_edges_lie_where_opencv_projects_them(device, view):
    """A square that fills most of the image: its mask ends within 0.02 px of the projected outline."""
    half = 0.35
    found = gbuffer_of(ToyScene([entry(sheet(2 * half, 2 * half))], [[(0, (0.05, 0.02, 0.0, *UPRIGHT))]], (view,)), device)
    side = np.linspace(-half, half, 400)
    ends = np.full_like(side, half)
    outline = np.concatenate([np.stack(p, 1) for p in ((side, -ends), (ends, side), (-side, ends), (-ends, -side))])
    places = opencv_pixels(view, np.column_stack((outline + np.array((0.05, 0.02)), np.zeros(len(outline))))).astype(np.float32)
    rows, columns = np.indices(found["segment"].shape)
    off = np.array([cv2.pointPolygonTest(places, (c + 0.5, r + 0.5), True) for r, c in zip(rows.flat, columns.flat, strict=True)])
    sure = abs(off) > 0.02
    assert sure.mean() > 0.95
    assert 1000 < (off > 0).sum() < off.size - 500
    np.testing.assert_array_equal((found["segment"].ravel() == 1)[sure], (off > 0)[sure])


@pytest.mark.parametrize(("name", "place"), on_views(((0.68, 0.0),), ((-0.75, 0.45),), ((0.0, -0.62),)))
def test_masks_beyond_the_border_are_those_of_the_continued_lens(device, name, place):
    view = VIEWS[name]
    toy = ToyScene([entry(ball(0.15, 3))], [[(0, (*place, 0.1, *UPRIGHT)), (0, (*place, -0.3, *UPRIGHT))]], (view,))
    picture, pixels, boxes = annotated(toy, device)
    assert pixels[0][0] > 50
    # The inverse is float32 here and float64 there: a ray within 1e-3 px of an outline may pass it on either side.
    assert np.abs(picture.pixels[0] - pixels).max() <= 1
    assert np.abs(picture.boxes[0] - boxes).max() <= 1


@pytest.mark.parametrize(("name", "shift"), on_views((0.03,), (0.0,), (1e-5,)))
def test_flow_is_the_difference_of_opencvs_projections(device, name, shift):
    """Of a sheet that moves across and towards the camera, by nothing, by less than float32 resolves in pixels, and by pixels."""
    view, moved = VIEWS[name], np.array((shift, -shift / 2, shift))
    toy = ToyScene([entry(sheet(0.8, 0.5))], [[(0, (0.05, 0.02, 0.0, *UPRIGHT))]], (view,))
    before = PreviousFrame([[(0, (*(np.array((0.05, 0.02, 0.0)) - moved), *UPRIGHT))]], [1])
    rendered = render_layers(toy, device, before, names=("flow",))
    seen = rendered.segment[0] == 1
    centers = np.stack(np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5), -1)[seen]
    rays = np.column_stack((view.lens.unproject(centers), np.ones(len(centers))))
    points = (rays * rendered.depth[0][seen][:, None] - view.translation) @ view.rotation
    expected = opencv_pixels(view, points - moved) - centers
    np.testing.assert_allclose(rendered["flow"][0][seen], expected, atol=2e-3 if shift > 1e-4 else 1e-5)
    assert seen.sum() > 1000


@pytest.mark.parametrize("name", ["issue", "fisheye"])
def test_the_undistorted_picture_is_that_of_a_pinhole(device, name):
    plain = camera(640, 480, 480.0, (0.0, 0.0, 1.0))
    lens = VIEWS[name].lens.lens
    placed = [[(0, (-0.2, 0.1, 0.0, *UPRIGHT)), (1, (0.25, -0.1, 0.05, 0.1, 0.2, 0.3, 0.927))]]
    toy = ToyScene([entry(ball(0.2, 5)), entry(box(0.3, 0.2, 0.1), surface((0.6, 0.3, 0.2)))], placed, (plain,), table=True)
    toy.config = with_render(UNOCCLUDED)
    expected = render(toy, device).color[0]
    bent = distorted(plain, *lens.coefficients, model=lens.model)
    found = render(replace(toy, cameras=(bent,)), device).color[0]
    maps = bent.lens.undistortion_maps()
    flat = cv2.remap(found, *maps, cv2.INTER_CUBIC)
    inside = (maps[0] > 4) & (maps[1] > 4) & (maps[0] < 635) & (maps[1] < 475)
    error = (flat.astype(float) - expected)[inside]
    assert inside.mean() > 0.6
    assert 10 * np.log10(255**2 / np.mean(error**2)) >= 38.0
    assert np.mean((found.astype(float) - expected)[inside] ** 2) > 4 * np.mean(error**2)
