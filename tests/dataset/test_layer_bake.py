"""Layers from settings to files: what a small bake leaves agrees with its own depth, masks and poses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.view import View
from synpick_warp.testing.exporters import digests
from tests.builders import PICKING, STIRRING, bake_boxes, once

WIDTH, HEIGHT = 96, 54
TINY = STIRRING | {
    "bake.episodes": 3,
    "cameras.resolution": [WIDTH, HEIGHT],
    "cameras.positions": [[0, 0, 2], [0, -0.9, 1.8]],
    "cameras.ups": [[0, 1, 0], [0, 1, 0]],
    "bop.coco": False,
    "render.layers": list(LAYERS),
}
DEPTH_STEP = 1e-4
"""A count of the depth images [m]; half of it is their error."""


def baked(out: Path, given: Mapping[str, object] = TINY) -> Path:
    bake_boxes(out, given)
    return out / "train"


@pytest.fixture(scope="module")
def split(tmp_path_factory) -> Path:
    """One world takes all episodes, one after the other."""
    return once(tmp_path_factory, "layers", baked)[0] / "train"


CENTERS = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)


def surface(view: View) -> np.ndarray:
    """Points that the pixels show, in the camera's frame (H, W, 3) [m]."""
    rays = np.concatenate((CENTERS, np.ones((HEIGHT, WIDTH, 1))), axis=-1) @ np.linalg.inv(view.intrinsics).T
    return rays * view.depth[..., None]


def test_every_view_has_every_layer(split):
    scenes = sorted(split.iterdir())
    assert len(scenes) == 6
    for scene in scenes:
        assert {path.name for path in scene.iterdir() if path.is_dir()} == {"rgb", "depth", "mask", "mask_visib", *LAYERS}
        for name in LAYERS:
            assert [path.name for path in sorted((scene / name).iterdir())] == [path.name for path in sorted((scene / "rgb").iterdir())]
    notes = (split.parent / "dataset_info.md").read_text()
    assert all(f"- `{name}/`: " in notes for name in LAYERS)


def check_motion(view: View, before: View) -> float:
    """Points of an instance, carried by its poses of this image and the one before, must be where the layers say.

    Returns the largest flow [px].
    """
    flow, scene_flow, points = view.layer("flow"), view.layer("scene_flow"), surface(view)
    known, most = before.instance_ids.tolist(), 0.0
    for instance, seen, now in zip(view.instance_ids.tolist(), view.masks, view.object_to_camera, strict=True):
        then = before.object_to_camera[known.index(instance)]
        own = (points[seen] - now[:3, 3]) @ now[:3, :3]
        was = own @ then[:3, :3].T + then[:3, 3]
        # Half a step of the file, and what half a count of depth can turn and scale.
        np.testing.assert_allclose(scene_flow[seen], was - points[seen], atol=1e-5 + 0.5 * DEPTH_STEP)
        image = was @ view.intrinsics.T
        expected = image[:, :2] / image[:, 2:] - CENTERS[seen]
        np.testing.assert_allclose(flow[seen], expected, atol=1 / 128 + 0.005)
        most = max(most, float(np.abs(expected).max(initial=0.0)))
    return most


def unknown(view: View) -> np.ndarray:
    """Where there is a surface whose motion is unknown; both layers must agree."""
    found = np.isnan(view.layer("flow")[..., 0])
    np.testing.assert_array_equal(found, np.isnan(view.layer("scene_flow")[..., 0]))
    return found & (view.depth > 0)


def test_motion_is_that_of_the_poses(split):
    data, most = synpick_warp.open(split.parent), []
    for view in data.views():
        if view.frame == 0:
            assert np.isnan(view.layer("flow")).all()
            assert np.isnan(view.layer("scene_flow")).all()
            continue
        most.append(check_motion(view, data[view.episode].view(view.frame - 1, view.camera)))
        assert not unknown(view).any()
        # Table and tote stand.
        assert (view.layer("flow")[~view.masks.any(axis=0)] == 0.0).all(axis=-1).mean() > 0.5
    assert sum(value > 0.1 for value in most) >= 10
    assert max(most) > 5.0


def test_a_gripper_that_was_out_of_the_picture_has_no_motion(tmp_path):
    split = baked(tmp_path / "set", TINY | PICKING | {"bake.episodes": 1})
    chosen = {json.loads(line)["frame"] for line in (split.parent / "attempts.jsonl").read_text().splitlines()}
    data, appeared = synpick_warp.open(split.parent), 0
    for view in data.views():
        if view.frame == 0:
            continue
        check_motion(view, data[view.episode].view(view.frame - 1, view.camera))
        # Worlds choose without gripper; it comes in the next image.
        if view.frame - 1 in chosen:
            appeared += unknown(view).any()
            assert not unknown(view)[view.masks.any(axis=0)].any()
        else:
            assert not unknown(view).any()
    assert appeared


def test_classes_and_places_are_those_of_the_masks(split):
    data = synpick_warp.open(split.parent)
    for view in list(data.views())[::3]:
        classes, nocs, points = view.layer("classes"), view.layer("nocs"), surface(view)
        for object_id, seen, pose in zip(view.object_ids.tolist(), view.masks, view.object_to_camera, strict=True):
            assert (classes[seen] == object_id).all()
            low, size = (1e-3 * np.array([data.models_info[object_id][f"{end}_{axis}"] for axis in "xyz"]) for end in ("min", "size"))
            own = (points[seen] - pose[:3, 3]) @ pose[:3, :3]
            np.testing.assert_allclose(low + size / 2 + np.linalg.norm(size) * (nocs[seen] - 0.5), own, atol=DEPTH_STEP)
        rest = ~view.masks.any(axis=0)
        assert not classes[rest].any()
        assert not nocs[rest].any()


def test_normals_and_albedo_cover_what_there_is(split):
    for view in list(synpick_warp.open(split.parent).views())[::5]:
        normals, albedo, there = view.layer("normals"), view.layer("albedo"), view.depth > 0
        np.testing.assert_allclose(np.linalg.norm(normals[there], axis=-1), 1.0, atol=1e-4)
        assert (np.einsum("ij,ij->i", normals[there], surface(view)[there]) < 0.0).mean() > 0.99
        assert not normals[~there].any()
        # The boxes' material: 0.6, 0.5, 0.4.
        assert np.abs(albedo[view.masks.any(axis=0)].astype(int) - (153, 128, 102)).max(initial=0) <= 1


def test_worlds_writers_and_batches_change_no_layer(split, tmp_path):
    other = baked(tmp_path / "other", TINY | {"bake.worlds": 2, "bake.writers": 2, "render.views_per_batch": 3})
    assert digests(other) == digests(split)


def test_layers_change_nothing_else(split, tmp_path):
    few = digests(baked(tmp_path / "few", TINY | {"render.layers": ["flow"]}))
    whole = digests(split)
    assert few == {name: digest for name, digest in whole.items() if Path(name).parts[1] not in set(LAYERS) - {"flow"}}
