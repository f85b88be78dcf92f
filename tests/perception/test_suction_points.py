"""Where each instance would be sucked: poles, the choice among three points, visible shares; and the traced image itself."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.types import Catalog, Fixture
from synpick_warp.stages.perception import segment
from synpick_warp.stages.render.scene import build_render_scene
from tests.twins import perception
from tests.twins.perception import Look
from tests.worlds.toy_scene import GREY, UPRIGHT, ToyScene, ball, box, entry, render, snapshot

WIDTH, HEIGHT = 64, 48


@pytest.fixture(scope="module")
def shared(device):
    return Look(device, WIDTH, HEIGHT, instances=2)


@pytest.fixture
def look(shared):
    """One instance weighs 0.1 kg and has an expected area of 0.01 m², unless a test changes that."""
    shared.mass[:], shared.area[:] = 0.1, 0.01
    return shared


def empty() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def chosen(look: Look, instance: int = 0) -> dict[str, np.ndarray]:
    return {name: look.of(name, instance) for name in ("pole", "centroid", "middle", "distances", "suction")}


def blob(seed: int) -> np.ndarray:
    """Codes (H, W) of instance 0: a few random ellipses, less one of another instance."""
    rng = np.random.default_rng(seed)
    image = empty()
    for code in (1, 1, 1, 2):
        middle = rng.integers((8, 8), (WIDTH - 8, HEIGHT - 8))
        cv2.ellipse(image, middle.tolist(), rng.integers(3, 16, 2).tolist(), float(rng.uniform(0, 180)), 0, 360, code, -1)
    return image


# ---- three points and the rule ----


def test_square_is_gripped_in_its_middle(look):
    codes = empty()
    codes[10:31, 20:41] = 1
    look.see(codes)
    found = chosen(look)
    assert found["pole"].tolist() == found["centroid"].tolist() == found["middle"].tolist() == [30.0, 20.0]
    assert found["distances"].tolist() == [11.0, 11.0, 11.0]
    assert found["suction"].tolist() == [30, 20]


def test_the_first_of_equal_poles_counts_and_the_centroid_is_preferred(look):
    """A long bar has a row of poles; the centroid, as far from the contour, is taken."""
    codes = empty()
    codes[10:21, 5:46] = 1
    look.see(codes)
    found = chosen(look)
    assert found["pole"].tolist() == [10.0, 15.0]
    assert found["centroid"].tolist() == [25.0, 15.0]
    assert found["distances"].tolist() == [6.0, 6.0, 6.0]
    assert found["suction"].tolist() == [25, 15]


def test_pole_where_the_centroid_lies_outside(look):
    """Arms of 5 and 9 px about a corner: the centroid of the L and the point half-way to it lie in the open."""
    codes = empty()
    codes[4:44, 4:13], codes[39:44, 4:60] = 1, 1
    look.see(codes)
    found = chosen(look)
    assert codes[tuple(np.rint(found["centroid"][::-1]).astype(int))] == 0
    assert found["distances"][:2].tolist() == [5.0, 0.0]
    assert found["suction"].tolist() == found["pole"].tolist() == [8, 8]


def test_half_way_where_that_is_farther_from_the_contour(look):
    """A large square with a thin tail, which draws the centroid towards itself."""
    codes = empty()
    codes[4:25, 4:25], codes[12:17, 25:63] = 1, 1
    look.see(codes)
    found = chosen(look)
    pole, centroid, middle = found["distances"]
    assert pole == 11.0
    assert found["pole"].tolist() == [14.0, 14.0]
    assert centroid < middle
    assert 0.4 < middle / pole <= 0.8
    assert found["suction"].tolist() == [14, 14]
    look.mass[0] = 0.9
    look.see(codes)
    assert look.of("suction").tolist() == np.rint(found["middle"]).astype(int).tolist() != [14, 14]
    look.mass[0] = 0.8
    look.see(codes)
    assert look.of("suction").tolist() == [14, 14]


def test_a_hole_moves_the_pole_off_the_centroid(look):
    codes = empty()
    codes[4:45, 10:51] = 1
    codes[22:27, 28:33] = 0
    look.see(codes)
    found = chosen(look)
    assert found["centroid"].tolist() == [30.0, 24.0]
    assert found["distances"][1] == 0.0
    assert found["pole"].tolist() != [30.0, 24.0]
    assert look.image("distance")[tuple(found["suction"][::-1])] > 0.8 * found["distances"][0]


def test_what_is_not_visible_has_no_point(look):
    codes = empty()
    codes[4:9, 4:9] = 2
    look.see(codes)
    look.see(empty())
    for instance in range(2):
        assert look.of("suction", instance).tolist() == [-1, -1]
        assert [look.of(name, instance) for name in ("visible", "share", "depth")] == [0, 0.0, 0.0]
        assert len(look.contour(instance)) == 0


def test_a_look_forgets_the_one_before(look):
    large, small = empty(), empty()
    large[4:40, 4:40], small[40:45, 50:57] = 1, 1
    fresh = Look(look.stage.scene.device, WIDTH, HEIGHT, instances=2)
    fresh.see(small)
    look.see(large)
    look.see(small)
    for name in ("visible", "share", "pole", "centroid", "middle", "distances", "suction", "depth"):
        assert look.of(name).tolist() == fresh.of(name).tolist()


@given(seed=st.integers(0, 2**32 - 1), mass=st.sampled_from([0.1, 1.0]))
def test_same_as_twin(seed, mass, shared):
    look, codes = shared, blob(seed)
    look.mass[:] = mass
    look.see(codes)
    named = perception.components(codes, 2)
    mask = named == perception.largest(named, codes, 0)
    expected = perception.suction_point(mask, mass, look.config.sight)
    found = chosen(look)
    assert found["pole"].tolist() == expected["pole"].tolist()
    np.testing.assert_allclose(found["centroid"], expected["centroid"], atol=1e-5)
    # A centroid that falls between two pixels, but for rounding, may be given to either.
    parts = np.concatenate([expected["centroid"], expected["middle"]]) % 1.0
    if (np.abs(parts - 0.5) > 1e-4).all():
        np.testing.assert_allclose(found["distances"], expected["distances"], rtol=1e-6)
        assert found["suction"].tolist() == expected["suction"].tolist()


@given(seed=st.integers(0, 2**32 - 1))
def test_pole_is_within_a_pixel_of_the_exact_distance_transform(seed, shared):
    """No point of the image lies farther inside than the pole, and the pole as far as OpenCV's transform says, to a pixel and better."""
    look, codes = shared, blob(seed)
    look.see(codes)
    named = perception.components(codes, 2)
    mask = (named == perception.largest(named, codes, 0)).astype(np.uint8)
    exact = cv2.distanceTransform(np.pad(mask, 1), cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    best = np.argwhere(exact > exact.max() - 1e-3)[:, ::-1]
    assert np.linalg.norm(best - look.of("pole"), axis=1).min() <= 1.0
    assert look.of("distances")[0] == pytest.approx(exact.max(), abs=1e-3)


# ---- visible shares and depth ----


def test_share_of_a_sheet_is_its_area_over_what_is_expected(look):
    """Half of 0.02 m², seen from 1.5 m."""
    codes = empty()
    codes[8:28, 10:40] = 1
    fx, fy = look.focal
    look.area[0] = 2.0 * (30 * 1.5 / fx) * (20 * 1.5 / fy)
    look.see(codes, depth=1.5)
    assert look.of("share") == pytest.approx(0.5, rel=1e-5)
    assert look.of("depth") == 1.5


def test_share_sums_over_the_largest_component_alone_and_uses_each_depth(look):
    rng = np.random.default_rng(5)
    codes = blob(5)
    codes[0, 0] = 1
    depth = rng.uniform(0.5, 3.0, codes.shape).astype(np.float32)
    look.see(codes, depth=depth)
    named = perception.components(codes, 2)
    inside = named == perception.largest(named, codes, 0)
    fx, fy = look.focal
    assert inside.sum() < (codes == 1).sum()
    assert look.of("share") == pytest.approx((depth[inside].astype(float) ** 2).sum() / (fx * fy) / 0.01, rel=1e-6)
    column, row = look.of("suction")
    assert look.of("depth") == depth[row, column]


# ---- the traced image ----


def toy(resolution: tuple[int, int]) -> ToyScene:
    """Two worlds of a box and a ball in a tote, the gripper in front of them."""
    config = Config()
    config = replace(config, cameras=replace(config.cameras, resolution=resolution))
    tote = Fixture(box(0.5, 0.3, 0.02), GREY)
    placed = [
        [(0, (0.05, 0.02, 0.06, 0.1, 0.2, 0.0, 0.97)), (1, (-0.08, 0.03, 0.05, *UPRIGHT))],
        [(1, (0.0, 0.0, 0.05, *UPRIGHT)), (0, (0.04, 0.0, 0.1, *UPRIGHT)), (0, (-0.1, -0.05, 0.05, *UPRIGHT))],
    ]
    gripper = (Fixture(box(0.1, 0.1, 0.3), GREY), Fixture(box(0.04, 0.04, 0.05), GREY))
    poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.4, *UPRIGHT), (0.0, 0.0, 0.2, *UPRIGHT))
    cameras = make_cameras(config.cameras)[:1]
    return ToyScene(
        [entry(box(0.1, 0.06, 0.04)), entry(ball(0.04, 3))],
        placed,
        cameras,
        fixtures=(tote, *gripper),
        fixture_poses=poses,
        fixtures_visible=(1, 0, 0),
        config=config,
        table=True,
    )


def test_trace_shows_what_the_renderer_shows_without_a_gripper(device):
    resolution = (96, 54)
    scene = toy(resolution)
    expected = render(scene, device)
    assert set(np.unique(expected.instance)) == {1, 2, 3, Segment.TOTE, Segment.TABLE}
    # The gripper stands in the picture, and camera 0 is larger there: neither shows in the look.
    config = replace(
        scene.settings(),
        sight=replace(scene.config.sight, resolution=resolution, views=3),
        bake=replace(scene.config.bake, worlds=4),
        cameras=replace(scene.config.cameras, resolution=(192, 108)),
    )
    cameras = make_cameras(config.cameras)
    shared = build_render_scene(config, Catalog(tuple(scene.entries)), scene.fixtures, cameras, scene.lights, device)
    sight = segment.Sight(config, shared, scene.room)
    sight.look.world.assign([1, -1, 0])
    sight.hit_arrays.code.fill_(77)
    scene.fixtures_visible = (1, 1, 1)
    sight.trace(snapshot(scene, device))
    code, depth = sight.hits.code.numpy(), sight.hits.depth.numpy()
    for view, world in ((0, 1), (2, 0)):
        assert (code[view] == expected.instance[world]).all()
        # The renderer finds its hits triangle by triangle, looks do by trees.
        np.testing.assert_allclose(depth[view], expected.exact_depth[world], rtol=1e-6)
    assert (code[1] == 77).all()
    assert sight.look.camera.numpy().tolist() == [0, -1, 0]


def test_a_look_at_nothing_needs_no_world(device):
    """No view is in use before somebody fills them."""
    look = Look(device, WIDTH, HEIGHT, worlds=2)
    assert look.stage.look.world.numpy().tolist() == [-1, -1]
    look.see(worlds=[])
    assert (look.sighting.suction.numpy() == 0).all()


# ---- batches ----


def test_number_of_views(device):
    config = Config()
    config = replace(config, bake=replace(config.bake, worlds=64))
    cpu, cuda = device, type("Cuda", (), {"is_cuda": True})()
    assert segment.count_views(config, 21, cpu) == segment.CPU_VIEWS
    each = segment.view_bytes(config, 21)
    assert 1920 * 1080 * 30 < each < 1920 * 1080 * 40
    views = segment.count_views(config, 21, cuda)
    assert views * each <= segment.GPU_BYTES < (views + 1) * each
    asked = replace(config, sight=replace(config.sight, views=7))
    assert segment.count_views(asked, 21, cpu) == 7
    few = replace(config, bake=replace(config.bake, worlds=2))
    assert segment.count_views(few, 21, cuda) == 2
    vast = replace(config, sight=replace(config.sight, resolution=(8192, 8192)))
    assert segment.count_views(vast, 21, cpu) == 1
