"""G-buffer: depth, segmentation ids, amodal bits."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility import gbuffer
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.types import Fixture
from synpick_warp.stages import buffers
from tests.twins.raycast import cast_scene
from tests.worlds.toy_scene import GREY, UPRIGHT, ToyScene, ball, box, camera, entry, one, random_pose, random_rotation, render, sheet

NARROW = camera(160, 90, 453.7, (0.0, 0.0, 2.0))
"""The default camera at a twelfth of its resolution."""


def test_the_fixtures_segments_follow_each_other():
    assert [Segment.TOTE + i for i in range(gbuffer.FIXTURES)] == [Segment.TOTE, Segment.FINGER, Segment.CUP]
    assert len(buffers.FIXTURES) == gbuffer.FIXTURES


def test_a_ball_shows_its_area_and_its_nearest_depth(device):
    picture = render(one(ball(0.1, 5), (0.0, 0.0, 0.3, *UPRIGHT), camera(161, 91, 400.0, (0.0, 0.0, 1.3))), device, colors=False)
    # The silhouette of a sphere of radius r at distance d is a circle of radius f r / sqrt(d² - r²).
    area = np.pi * (400.0 * 0.1) ** 2 / (1.0 - 0.1**2)
    assert abs((picture.instance[0] == 1).sum() / area - 1.0) < 0.01
    assert picture.depth[0, 45, 80] == 9000
    assert picture.amodal[0, 45, 80] == 1
    assert picture.depth[0, 0, 0] == 0
    assert picture.instance[0, 0, 0] == Segment.NOTHING


def test_pixel_centres_have_half_integer_coordinates(device):
    # A sheet whose edges project to columns 70.25 and 80.25 and rows 35.75 and 45.75: it holds the centres of columns 70 to 79 and
    # rows 36 to 45. Were centres at whole numbers, it would hold columns 71 to 80.
    view = camera(160, 90, 100.0, (0.0, 0.0, 1.0))
    x, y = (75.25 - 80.0) / 100.0, -(40.75 - 45.0) / 100.0
    picture = render(one(sheet(0.1, 0.1), (x, y, 0.0, *UPRIGHT), view), device, colors=False)
    rows, columns = np.nonzero(picture.instance[0])
    assert (columns.min(), columns.max(), rows.min(), rows.max()) == (70, 79, 36, 45)
    assert len(rows) == 100
    assert (picture.depth[0][picture.instance[0] == 1] == 10000).all()


def test_occluded_instances_keep_their_amodal_bits(device):
    toy = one(sheet(0.2, 0.2), (0.0, 0.0, 0.0, *UPRIGHT), NARROW)
    toy.placed[0] += [(0, (0.05, 0.0, 0.1, *UPRIGHT)), (0, (0.0, 0.03, -0.1, *UPRIGHT))]
    picture = render(toy, device, colors=False)
    bits, instance = picture.amodal[0], picture.instance[0]
    assert bits[45, 80] == 0b111
    assert instance[45, 80] == 2
    left = 80 - int(0.08 * 453.7 / 2.0)
    assert bits[45, left] == 0b101
    assert instance[45, left] == 1
    assert (bits[instance == 3] == 0b100).all()
    assert ((bits >> (np.maximum(instance, 1) - 1)) & 1)[instance > 0].all()


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
    picture = render(ToyScene([entry(mesh) for mesh in meshes], [list(enumerate(poses))], (view,)), device, colors=False)
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
