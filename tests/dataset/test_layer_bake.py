"""Layers from settings to files: what a small bake leaves agrees with its own depth, masks and poses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.configs.schema import LAYERS
from synpick_warp.dataset.commit.manifest import episode_entry, read_checksums
from synpick_warp.dataset.view import read_layer
from synpick_warp.dataset.view_files import SceneFolder
from tests.builders import PICKING, STIRRING, bake_boxes, once
from tests.harness.exporter_contract import digests

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


class View:
    """An image and its ground truth; lengths in metres."""

    def __init__(self, scene: Path, frame: int) -> None:
        self.scene, self.frame = scene, frame
        self.camera = json.loads((scene / "scene_camera.json").read_text())[str(frame)]
        self.truth = json.loads((scene / "scene_gt.json").read_text())[str(frame)]
        image = cv2.imread(str(scene / "depth" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
        self.depth = image * self.camera["depth_scale"] * 1e-3
        self.matrix = np.reshape(self.camera["cam_K"], (3, 3))
        self.centers = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
        rays = np.concatenate((self.centers, np.ones((HEIGHT, WIDTH, 1))), axis=-1) @ np.linalg.inv(self.matrix).T
        self.points = rays * self.depth[..., None]

    def mask(self, index: int) -> np.ndarray:
        return cv2.imread(str(self.scene / "mask_visib" / f"{self.frame:06d}_{index:06d}.png"), cv2.IMREAD_UNCHANGED) > 0

    def pose(self, instance: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Model to camera."""
        for record in self.truth:
            if record["instance_id"] == instance:
                return np.reshape(record["cam_R_m2c"], (3, 3)), 1e-3 * np.array(record["cam_t_m2c"])
        return None

    def layer(self, name: str) -> np.ndarray:
        return read_layer(SceneFolder(self.scene), name, self.frame)


def views(split: Path) -> list[View]:
    scenes = sorted(split.iterdir())
    return [View(scene, frame) for scene in scenes for frame in range(len(json.loads((scene / "scene_gt.json").read_text())))]


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
    flow, scene_flow = view.layer("flow"), view.layer("scene_flow")
    most = 0.0
    for index, record in enumerate(view.truth):
        seen = view.mask(index)
        then, now = before.pose(record["instance_id"]), view.pose(record["instance_id"])
        assert then is not None
        assert now is not None
        own = (view.points[seen] - now[1]) @ now[0]
        was = own @ then[0].T + then[1]
        # Half a step of the file, and what half a count of depth can turn and scale.
        np.testing.assert_allclose(scene_flow[seen], was - view.points[seen], atol=1e-5 + 0.5 * DEPTH_STEP)
        image = was @ view.matrix.T
        expected = image[:, :2] / image[:, 2:] - view.centers[seen]
        np.testing.assert_allclose(flow[seen], expected, atol=1 / 128 + 0.005)
        most = max(most, float(np.abs(expected).max(initial=0.0)))
    return most


def unknown(view: View) -> np.ndarray:
    """Where there is a surface whose motion is unknown; both layers must agree."""
    found = np.isnan(view.layer("flow")[..., 0])
    np.testing.assert_array_equal(found, np.isnan(view.layer("scene_flow")[..., 0]))
    return found & (view.depth > 0)


def test_motion_is_that_of_the_poses(split):
    most = []
    for view in views(split):
        if view.frame == 0:
            assert np.isnan(view.layer("flow")).all()
            assert np.isnan(view.layer("scene_flow")).all()
            continue
        most.append(check_motion(view, View(view.scene, view.frame - 1)))
        assert not unknown(view).any()
        rest = ~np.any([view.mask(index) for index in range(len(view.truth))], axis=0)
        # Table and tote stand.
        assert (view.layer("flow")[rest] == 0.0).all(axis=-1).mean() > 0.5
    assert sum(value > 0.1 for value in most) >= 10
    assert max(most) > 5.0


def test_a_gripper_that_was_out_of_the_picture_has_no_motion(tmp_path):
    split = baked(tmp_path / "set", TINY | PICKING | {"bake.episodes": 1})
    chosen = {json.loads(line)["frame"] for line in (split.parent / "attempts.jsonl").read_text().splitlines()}
    appeared = 0
    for view in views(split):
        if view.frame == 0:
            continue
        check_motion(view, View(view.scene, view.frame - 1))
        # Worlds choose without gripper; it comes in the next image.
        if view.frame - 1 in chosen:
            appeared += unknown(view).any()
            assert not unknown(view)[np.any([view.mask(index) for index in range(len(view.truth))], axis=0)].any()
        else:
            assert not unknown(view).any()
    assert appeared


def test_classes_and_places_are_those_of_the_masks(split):
    infos = json.loads((split.parent / "models" / "models_info.json").read_text())
    for view in views(split)[::3]:
        classes, nocs = view.layer("classes"), view.layer("nocs")
        rest = np.ones((HEIGHT, WIDTH), bool)
        for index, record in enumerate(view.truth):
            seen = view.mask(index)
            rest &= ~seen
            assert (classes[seen] == record["obj_id"]).all()
            info = infos[str(record["obj_id"])]
            size = 1e-3 * np.array([info[f"size_{axis}"] for axis in "xyz"])
            middle = 1e-3 * np.array([info[f"min_{axis}"] for axis in "xyz"]) + size / 2
            rotation, translation = view.pose(record["instance_id"])
            own = (view.points[seen] - translation) @ rotation
            np.testing.assert_allclose(middle + np.linalg.norm(size) * (nocs[seen] - 0.5), own, atol=DEPTH_STEP)
        assert not classes[rest].any()
        assert not nocs[rest].any()


def test_normals_and_albedo_cover_what_there_is(split):
    for view in views(split)[::5]:
        normals, albedo = view.layer("normals"), view.layer("albedo")
        there = view.depth > 0
        np.testing.assert_allclose(np.linalg.norm(normals[there], axis=-1), 1.0, atol=1e-4)
        assert (np.einsum("ij,ij->i", normals[there], view.points[there]) < 0.0).mean() > 0.99
        assert not normals[~there].any()
        for index in range(len(view.truth)):
            # The boxes' material: 0.6, 0.5, 0.4.
            assert np.abs(albedo[view.mask(index)].astype(int) - (153, 128, 102)).max(initial=0) <= 1


def test_worlds_writers_and_batches_change_no_layer(split, tmp_path):
    other = baked(tmp_path / "other", TINY | {"bake.worlds": 2, "bake.writers": 2, "render.views_per_batch": 3})
    assert digests(other) == digests(split)


def test_layers_have_checksums(split):
    names = {name for episode in range(TINY["bake.episodes"]) for name in read_checksums(split.parent, episode_entry(episode))}
    assert names == {f"{split.name}/{name}" for name in digests(split)}
    assert {Path(name).parts[2] for name in names} >= set(LAYERS)


def test_layers_change_nothing_else(split, tmp_path):
    few = digests(baked(tmp_path / "few", TINY | {"render.layers": ["flow"]}))
    whole = digests(split)
    assert few == {name: digest for name, digest in whole.items() if Path(name).parts[1] not in set(LAYERS) - {"flow"}}
