"""G-buffer: depth, segmentation ids, amodal masks, pixel counts and boxes; known sizes, float64 and a NumPy twin; up to 251 instances."""

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import MAX_INSTANCES, Segment
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED, Config
from synpick_warp.kernels.render.visibility import gbuffer
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.types import Fixture
from synpick_warp.stages import buffers
from synpick_warp.views.frames import most_words
from tests.harness.trace_probe import trace_gbuffer
from tests.twins.layers import annotated
from tests.twins.raycast import cast_scene
from tests.worlds.shapes import FLAT, GREY, UPRIGHT, ball, box, camera, entry, random_pile, random_pose, random_rotation, sheet
from tests.worlds.toy_scene import ToyScene, assert_same, one, render, render_gbuffer, several, views_of, with_render

NARROW = camera(160, 90, 453.7, (0.0, 0.0, 2.0))
"""The default camera at a twelfth of its resolution."""


def test_the_fixtures_segments_follow_each_other():
    assert [Segment.TOTE + i for i in range(gbuffer.FIXTURES)] == [Segment.TOTE, Segment.FINGER, Segment.CUP]
    assert len(buffers.FIXTURES) == gbuffer.FIXTURES


def test_a_world_without_instances_shows_none(device):
    toy = one(sheet(0.2, 0.2), (0.0, 0.0, 0.0, *UPRIGHT), NARROW)
    toy.placed = [[], toy.placed[0]]
    picture = render(toy, device, colors=False)
    assert not picture.amodal[0].any()
    assert not picture.instance[0].any()
    assert picture.amodal[1].any()


def test_fixtures_and_table_are_visible_without_amodal_bits(device):
    fixtures = (Fixture(box(0.3, 0.1, 0.1), GREY), Fixture(box(0.02, 0.02, 0.2), GREY), Fixture(box(0.02, 0.02, 0.02), GREY))
    toy = one(sheet(0.1, 0.1), (0.0, 0.0, 0.07, *UPRIGHT), NARROW, fixtures=fixtures, table=True)
    toy.fixture_poses = ((0.0, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.2, *UPRIGHT), (0.1, 0.0, 0.2, *UPRIGHT))
    toy.fixtures_visible = (1, 1, 0)
    picture = render(toy, device, colors=False)
    instance, depth = picture.instance[0], picture.depth[0]
    assert set(np.unique(instance)) == {1, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    assert set(np.unique(picture.amodal[0])) == {0, 1}
    assert instance[45, 80] == Segment.FINGER
    assert picture.amodal[0][45, 80] == 1
    assert depth[45, 80] == 17000
    assert (depth[instance == Segment.TOTE].min(), depth[instance == 1].min()) == (19500, 19300)
    assert depth[0, 0] == round((2.0 + toy.config.tote.wall) * 1e4)


def test_worlds_and_cameras_do_not_mix(device):
    views = (NARROW, camera(160, 90, 453.7, (0.1, 0.0, 1.0)))
    poses = [(0.0, 0.0, 0.0, *UPRIGHT), (0.02, 0.03, 0.2, *UPRIGHT)]
    together = render(ToyScene([entry(box(0.1, 0.05, 0.02))], [[(0, pose)] for pose in poses], views), device)
    for world, pose in enumerate(poses):
        for number, view in enumerate(views):
            alone = render(one(box(0.1, 0.05, 0.02), pose, view), device)
            for name in ("color", "depth", "instance", "amodal", "pixels", "boxes"):
                np.testing.assert_array_equal(getattr(together, name)[2 * world + number], getattr(alone, name)[0])


@pytest.mark.parametrize("seed", range(4))
def test_the_gbuffer_agrees_with_a_float64_reference(device, seed):
    rng = np.random.default_rng(seed)
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 3), box(0.2, 0.004, 0.1), ball(0.1, 1)]
    poses, turn = [random_pose(rng, (-0.15, -0.1, 0.0), (0.15, 0.1, 0.2)) for _ in meshes], random_rotation(rng)
    # A camera that looks at the pile from anywhere.
    check_against_reference(meshes, poses, camera(160, 90, 453.7, tuple(turn.T @ (0.0, 0.0, -2.0)), turn), device)


@pytest.mark.parametrize("numbers", [(3, 13, 15), (11, 14, 17)])
def test_real_objects_agree_with_a_float64_reference(device, real_models, numbers):
    rng = np.random.default_rng(numbers[0])
    meshes = [read_mesh(real_models / f"obj_{number:06d}.ply", 1e-3)[0] for number in numbers]
    check_against_reference(meshes, [random_pose(rng, (-0.1, -0.05, 0.0), (0.1, 0.05, 0.2)) for _ in meshes], NARROW, device)


def check_against_reference(meshes, poses, view, device):
    picture = render(several(meshes, poses, view), device, colors=False)
    depth, instance, masks = cast_scene(meshes, poses, view)
    # At most 0.05 % of a mask's pixels may differ; at this size that is one pixel on an edge at most.
    for reference, mask in zip(masks, picture.masks[0], strict=False):
        differing = (reference != mask).sum()
        assert differing <= max(1, 5e-4 * reference.sum())
    same = picture.instance[0] == instance
    assert (~same).sum() <= 1
    seen = same & (instance > 0)
    # A ray within rounding of a silhouette may meet the surface behind it; everywhere else float32 must not show.
    error = np.abs(picture.exact_depth[0] - depth)[seen]
    assert np.quantile(error, 0.999) < 2e-6
    assert (error > 1e-4).sum() <= 1
    assert np.quantile(np.abs(picture.depth[0] * 1e-4 - depth)[seen], 0.999) < 0.5e-4 + 2e-6


def test_a_fine_mesh_has_no_holes(device):
    # 20,480 triangles over 12,000 pixels: rays pass close to edges and corners everywhere.
    picture = render(
        one(ball(0.1, 5), (0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.927), camera(160, 90, 700.0, (0.0, 0.0, 1.0))), device, colors=False
    )
    rows, columns = np.mgrid[:90, :160]
    assert picture.amodal[0][np.hypot(rows - 44.5, columns - 79.5) < 65.0].all()


# ---- pixel counts and boxes ----


WIDE = camera(96, 54, 272.2, (0.0, 0.0, 2.0))
SHEET = one(sheet(0.1, 0.1), FLAT, WIDE)
"""0.1 m at 2 m and f = 272.2 px: 13.61 px, about column 48 and row 27, holds 14 columns and rows."""


def check_view(toy: ToyScene, device) -> tuple[list, list]:
    """Compare a toy scene's counts and boxes with those of the NumPy twin, and return them."""
    picture, pixels, boxes = annotated(toy, device)
    np.testing.assert_array_equal(picture.pixels[0], pixels)
    np.testing.assert_array_equal(picture.boxes[0], boxes)
    return pixels.tolist(), boxes.tolist()


def test_a_sheet_of_known_size_and_absent_instances(device):
    pixels, boxes = check_view(SHEET, device)
    assert pixels == [[196, 196, 196], *[[0, 0, 0]] * 3]
    assert boxes == [[[41, 20, 54, 33]] * 2, *[[[0, 0, -1, -1]] * 2] * 3]


def test_occluded_pixels_count_as_amodal_but_not_as_visible(device):
    above = [(1, (0.0, 0.0, 0.1, *UPRIGHT))]
    pixels, boxes = check_view(replace(SHEET, entries=[*SHEET.entries, entry(sheet(0.2, 0.2))], placed=[SHEET.placed[0] + above]), device)
    assert pixels[0] == [196, 196, 0]
    assert boxes[0] == [[41, 20, 54, 33], [0, 0, -1, -1]]
    assert pixels[1][2] == pixels[1][0]


@pytest.mark.parametrize("place", [(0.34, 0.0), (-0.35, 0.2), (0.0, -0.2), (0.45, 0.0), (0.9, 0.5), (1.3, 0.0)])
def test_instances_that_leave_the_image_count_beyond_its_border(device, place):
    """Half inside, across a corner, just outside, far outside at the end of the canvas."""
    toy = ToyScene([entry(ball(0.1, 3))], [[(0, (*place, 0.1, *UPRIGHT)), (0, (*place, -0.3, *UPRIGHT))]], (WIDE,))
    pixels, boxes = check_view(toy, device)
    if place == (0.34, 0.0):
        assert 0 < pixels[0][1] < pixels[0][0]
        assert boxes[0][0][2] > 95
        assert boxes[0][1][2] == 95


def test_instances_that_reach_behind_the_camera_count_up_to_the_canvas(device):
    pixels, _ = check_view(one(box(0.02, 0.1, 4.0), (0.1, 0.0, 1.0, *UPRIGHT), WIDE), device)
    assert pixels[0][0] > pixels[0][1]


def test_depth_above_sixteen_bits_is_0_and_not_valid(device):
    pixels, _ = check_view(replace(SHEET, config=Config().with_values({"bop.depth_scale": 0.03})), device)
    assert pixels[0] == [196, 0, 196]


@pytest.mark.parametrize("seed", range(3))
def test_random_piles_match_the_twin(device, seed):
    entries = [entry(box(0.2, 0.1, 0.05)), entry(ball(0.08, 2))]
    placed = random_pile(np.random.default_rng(seed), 2, 7, (-0.45, -0.3, -0.1), (0.45, 0.3, 0.4))
    check_view(ToyScene(entries, [placed], (WIDE,), instances=32, table=True, fixtures_visible=(1, 1, 0)), device)


# ---- many instances ----


NEAR = camera(160, 90, 160.0, (0.0, 0.0, 1.0))
MESHES = (box(0.06, 0.04, 0.03), ball(0.02, 1), box(0.1, 0.015, 0.015))


def pile(count: int, seed: int = 0, **more) -> ToyScene:
    """Small objects above each other, some beyond the border of the image."""
    placed = random_pile(np.random.default_rng(seed), len(MESHES), count, (-0.55, -0.3, -0.15), (0.55, 0.3, 0.15))
    return ToyScene([entry(mesh) for mesh in MESHES], [placed], (NEAR,), **{"instances": MAX_INSTANCES} | more)


@pytest.fixture(scope="module", params=[200, MAX_INSTANCES])
def dense(request):
    return pile(request.param)


def test_masks_agree_with_float64_rays_and_counts_with_masks(device, dense):
    picture, pixels, boxes = annotated(dense, device)
    meshes, poses = [MESHES[index] for index, _ in dense.placed[0]], [pose for _, pose in dense.placed[0]]
    depth, instance, masks = cast_scene(meshes, poses, NEAR)
    seen = masks.any(axis=(1, 2))
    assert seen.sum() > 0.8 * len(meshes)
    for reference, mask in zip(masks, picture.masks[0], strict=False):
        assert (reference != mask).sum() <= 1
    assert (masks != picture.masks[0, : len(masks)]).sum() <= 5
    assert not picture.masks[0, len(masks) :].any()
    assert (picture.instance[0] != instance).sum() <= 5
    assert np.unique(picture.instance).size > 100
    same = (picture.instance[0] == instance) & (instance > 0)
    assert np.quantile(np.abs(picture.exact_depth[0] - depth)[same], 0.999) < 2e-6
    np.testing.assert_array_equal(picture.pixels[0], pixels)
    np.testing.assert_array_equal(picture.boxes[0], boxes)
    assert (boxes[:, 0, 2] >= NEAR.width).any()


def test_words_do_not_grow_with_the_number_of_instances(device, dense):
    """Each mask takes what its box covers, in order, and the capacity is that of masks as large as the image."""
    out, _ = render_gbuffer(dense, device)
    first, box_, length = out.mask_first.numpy()[0], out.mask_box.numpy()[0], int(out.mask_length.numpy()[0])
    sides = np.maximum(box_[:, 2:] - box_[:, :2] + 1, 0)
    words = sides[:, 0] * -(-sides[:, 1] // 32)
    np.testing.assert_array_equal(first, np.cumsum(words) - words)
    assert length == words.sum() < 0.1 * out.mask_words.shape[1]
    assert out.mask_words.shape[1] == MAX_INSTANCES * most_words(NEAR.width, NEAR.height)
    assert not out.mask_words.numpy()[0, length:].any()
    assert (box_[:, :2] >= 0).all()
    assert (box_[:, 2:] < (NEAR.width, NEAR.height)).all()


def test_masks_as_large_as_the_image_fit_the_pool(device):
    """Objects around the camera, whose boxes are the whole image: as many words as there are."""
    around = ToyScene([entry(ball(0.4, 2))], [[(0, (0.01 * index, 0.0, 1.0, *UPRIGHT)) for index in range(3)]], (NEAR,), instances=3)
    out, _ = render_gbuffer(around, device)
    assert out.mask_length.numpy()[0] == out.mask_words.shape[1] == 3 * most_words(NEAR.width, NEAR.height)
    assert render(around, device, colors=False).masks.all()


def test_rays_meet_the_bodies_of_all_words(device, dense):
    toy = replace(dense, fixtures_visible=(0, 1, 1), fixture_poses=tuple((0.1 * index, 0.1, 0.2, *UPRIGHT) for index in range(3)))
    _, renderer = render_gbuffer(toy, device)
    names = ("segment", "triangle", "barycentric", "depth")
    raster = {name: getattr(renderer.gbuffer, name).numpy().copy() for name in names}
    assert renderer.bodies.body_mask.shape[2] == 4
    trace_gbuffer(renderer.scene, renderer.bodies, views_of(toy, device, renderer.cameras), renderer.gbuffer, 1)
    same = raster["segment"] == renderer.gbuffer.segment.numpy()
    assert (~same).sum() <= 3
    np.testing.assert_allclose(renderer.gbuffer.depth.numpy()[same], raster["depth"][same], rtol=1e-5)


@pytest.mark.parametrize("mode", [FAST, REFERENCE, UNOCCLUDED])
def test_pictures_do_not_depend_on_the_room_for_instances(device, mode):
    config = with_render(mode, samples=2) if mode == REFERENCE else with_render(mode)
    few, many = (render(pile(14, 3, instances=room, config=config, fixtures_visible=(0, 1, 0)), device) for room in (14, MAX_INSTANCES))
    assert_same(few, many, "color", "depth", "instance", "exact_depth", "radiance", "resolve")
    for name in ("masks", "pixels", "boxes"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:, :14])


@pytest.mark.parametrize("count", [60, 61, 62])
def test_bodies_about_the_end_of_a_word_are_anti_aliased_alike(device, count):
    """With fixtures 63, 64 and 65 bodies, all in the image: one word with a free bit, and two."""
    fixtures = {"fixtures_visible": (1, 1, 1), "fixture_poses": tuple((0.2 * index, 0.1, -0.3, *UPRIGHT) for index in range(3))}
    exact, wide = (render(pile(count, 4, instances=room, config=with_render(UNOCCLUDED), **fixtures), device) for room in (count, 200))
    assert_same(exact, wide, "color", "instance", "resolve")


def test_coverage_rays_meet_the_bodies_of_later_words(device):
    """Objects beside the image, nearer to the camera, take the first ranks; those in the image are in the last word."""
    seen = pile(20, 5, config=with_render(UNOCCLUDED))
    beside = [(1, (50.0, 0.01 * index, 0.5, *UPRIGHT)) for index in range(220)]
    crowded = replace(seen, placed=[seen.placed[0] + beside])
    alone, among = render(seen, device), render(crowded, device)
    assert_same(among, alone, "instance", "resolve")
    assert (alone.resolve != 0).sum() > 100
