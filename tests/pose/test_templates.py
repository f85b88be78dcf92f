"""Depth templates of objects, and the search that starts single-frame estimates."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose.templates import EMPTY, TEMPLATE, TEMPLATE_MARGIN
from synpick_warp.stages.pose.models import build_models
from synpick_warp.stages.pose.templates import DISTANCE, SearchSettings, TemplateSearch, render_templates, sphere_directions
from tests.twins.raycast import cast_mesh
from tests.worlds.pose_views import drawn, embedded, model_of, observe, pose_errors, pose_of, table_of
from tests.worlds.toy_scene import box, camera

BRICK = (0.16, 0.10, 0.06)


@pytest.mark.parametrize("count", [24, 96, 300])
def test_directions_are_evenly_spread(count):
    """The nearest of n directions is about √(4π / n) away."""
    views = Rotation.from_quat(sphere_directions(count)).inv().apply((0.0, 0.0, 1.0))
    angle = np.arccos(np.clip(views @ views.T, -1.0, 1.0)) + np.pi * np.eye(count)
    spacing = np.sqrt(4.0 * np.pi / count)
    assert angle.min() > 0.75 * spacing
    assert angle.min(axis=1).max() < 1.3 * spacing
    assert np.abs(views.mean(axis=0)).max() < 0.02


def test_templates_are_depth_images_of_the_object_alone(device):
    models = build_models([model_of(box(*BRICK)), model_of(box(0.05, 0.05, 0.05))], device, samples=64)
    templates = render_templates(models, 6, device)
    depth, size = templates.depth.numpy(), int(TEMPLATE)
    diameter = np.linalg.norm(BRICK)
    assert templates.width.numpy()[0] == pytest.approx(diameter * float(TEMPLATE_MARGIN) / size, rel=1e-5)
    for direction, rotation in enumerate(templates.rotation.numpy()):
        lens = camera(size, size, size * DISTANCE / float(TEMPLATE_MARGIN), (0.0, 0.0, 0.0), np.eye(3))
        expected = cast_mesh(box(*BRICK), np.array([0.0, 0.0, DISTANCE * diameter, *rotation]), lens) - DISTANCE * diameter
        hit = np.isfinite(expected)
        assert np.array_equal(depth[0, direction] < float(EMPTY), hit)
        assert depth[0, direction][hit] == pytest.approx(expected[hit], abs=1e-5)
        assert (depth[0, direction][~hit] == float(EMPTY)).all()
        # The margin leaves a frame.
        assert not hit[[0, -1]].any()


def seen_alone(mesh, pose: np.ndarray, device, occluded: bool = False):
    """Observer of an object before a wall, cast in float64; `occluded`: with a card before its right third."""
    lens = camera(200, 150, 260.0, (0.0, 0.0, 0.0), np.eye(3))
    depth = cast_mesh(mesh, pose, lens)
    label = np.isfinite(depth).astype(np.uint8)
    depth = np.where(label > 0, depth, 1.1)
    if occluded:
        columns = np.flatnonzero(label.any(axis=0))
        cover = np.arange(200)[None] > columns[0] + (columns[-1] - columns[0]) * 2 // 3
        label, depth = np.where(cover, 0, label), np.where(cover, 0.45, depth)
    return observe(drawn(label, depth, 260.0), table_of((0, 0, 0)), device)


@pytest.mark.parametrize("occluded", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("object_id", [14, 15])
def test_an_object_is_found(device, templates, object_id, seed, occluded):
    """One of the poses that are refined lies within 25° and a tenth of the diameter of the truth."""
    models, found = templates(object_id)
    pose = pose_of((0.05, -0.03, 0.8), Rotation.random(rng=np.random.default_rng(seed)))
    observer = seen_alone(embedded(object_id)[0].mesh, pose, device, occluded)
    poses = wp.zeros(24, dtype=wp.transform, device=device)
    TemplateSearch(found, observer, 24, SearchSettings()).search(poses)
    distance, angle = pose_errors(poses.numpy(), np.tile(pose, (24, 1)))
    near = (distance < 0.1 * models.diameters[0]) & (angle < 25.0)
    assert near.any()
    # Hypotheses differ.
    _, apart = pose_errors(poses.numpy()[1:], np.tile(poses.numpy()[0], (23, 1)))
    assert apart.min() > 10.0


@pytest.fixture(scope="module")
def templates(device):
    """Models and templates of an embedded object; each is rendered once."""
    kept = {}

    def make(object_id: int):
        if object_id not in kept:
            models = build_models(embedded(object_id), device, samples=256)
            kept[object_id] = models, render_templates(models, SearchSettings().directions, device)
        return kept[object_id]

    return make


def test_the_object_beside_its_mask_costs(device, templates):
    """Of a bar's two lengths, the mask's end tells: beyond it lies the wall, which a longer object would hide."""
    models = build_models([model_of(box(0.2, 0.05, 0.05))], device, samples=64)
    found = render_templates(models, 96, device)
    pose = pose_of((0.0, 0.0, 0.8), Rotation.from_euler("z", 40.0, degrees=True))
    observer = seen_alone(box(0.2, 0.05, 0.05), pose, device)
    poses = wp.zeros(4, dtype=wp.transform, device=device)
    TemplateSearch(found, observer, 4, SearchSettings()).search(poses)
    axis = Rotation.from_quat(poses.numpy()[0, 3:]).apply((1.0, 0.0, 0.0))
    true = Rotation.from_quat(pose[3:]).apply((1.0, 0.0, 0.0))
    assert np.degrees(np.arccos(min(abs(axis @ true), 1.0))) < 20.0
    assert np.linalg.norm(poses.numpy()[0, :3] - pose[:3]) < 0.02


def test_what_is_not_seen_has_poses_too(device, templates):
    """They are finite, and all the same."""
    _, found = templates(15)
    observer = observe(drawn(np.zeros((40, 50)), np.full((40, 50), 1.0), 60.0), table_of((0, 0, 0)), device)
    poses = wp.zeros(3, dtype=wp.transform, device=device)
    TemplateSearch(found, observer, 3, SearchSettings()).search(poses)
    assert poses.numpy().tolist() == [[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]] * 3
