"""Small data set for evaluations, written without a bake: two episodes, objects with known symmetries on straight paths."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import encode_manifest, make_manifest

FRAMES = 4
CAMERAS = 3
MODES = ("move", "pick")
"""Mode of each episode."""
PERIOD = 0.1
"""Time from frame to frame [s]."""
BRICK, BOX, PRISM = 1, 2, 3
"""Objects: an L without symmetries; a box that looks the same after half a turn about z; a prism of SIDES sides about z."""
SIDES = 24
OBJECTS = (BRICK, BOX, PRISM, BRICK)
"""obj_id of each instance; two are of one object."""
VISIBILITY = (1.0, 0.6, 0.05, 0.3)
"""Visible fraction of each instance."""
SPEED = (0.0, 0.02, 0.0, 0.3)
"""Speed of each instance along x [m/s]."""


def shapes() -> dict[int, trimesh.Trimesh]:
    """Mesh of each object [mm]."""
    corner = trimesh.creation.box((90, 30, 30))
    corner.apply_translation((0, 0, 10))
    brick = trimesh.util.concatenate([corner, trimesh.creation.box((30, 60, 20))])
    return {BRICK: brick, BOX: trimesh.creation.box((80, 60, 40)), PRISM: trimesh.creation.cylinder(33, 100, sections=SIDES)}


def infos() -> dict[str, dict[str, object]]:
    """models_info.json."""
    entries: dict[str, dict[str, object]] = {}
    for object_id, mesh in shapes().items():
        low, size = mesh.bounds[0], np.ptp(mesh.bounds, axis=0)
        entries[str(object_id)] = {"diameter": float(np.linalg.norm(size))}
        entries[str(object_id)] |= {f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)}
        entries[str(object_id)] |= {f"size_{axis}": float(value) for axis, value in zip("xyz", size, strict=True)}
    entries[str(BOX)]["symmetries_discrete"] = [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]
    entries[str(PRISM)]["symmetries_continuous"] = [{"axis": [0, 0, 1], "offset": [0, 0, 0]}]
    return entries


def write_evaluation_set(folder: Path) -> Path:
    """Write the data set; returns its folder."""
    (folder / "models").mkdir(parents=True)
    for object_id, mesh in shapes().items():
        mesh.export(folder / "models" / f"obj_{object_id:06d}.ply")
    (folder / "models" / "models_info.json").write_text(json.dumps(infos()))
    overrides: dict[str, object] = {"physics.step": PERIOD / 10, "physics.steps_per_tick": 10, "physics.substeps": 10}
    overrides |= {"bake.episodes": len(MODES), "bop.split": "train_pbr", "bop.color_format": "jpg"}
    config = load_config("smoke", overrides)
    assert len(config.cameras.positions) == CAMERAS
    (folder / "config.toml").write_text(config_to_toml(config))
    (folder / "manifest").mkdir()
    (folder / "manifest.json").write_bytes(encode_manifest(make_manifest(config)))
    random = np.random.default_rng(7)
    for episode, mode in enumerate(MODES):
        row = {"episode": episode, "mode": mode, "frames": FRAMES, "ending": "finished"}
        (folder / "manifest" / f"{episode:06d}.json").write_text(json.dumps({"row": row}))
        for camera in range(CAMERAS):
            _write_scene(folder / config.bop.split / f"{CAMERAS * episode + camera:06d}", random)
    return folder


def _write_scene(folder: Path, random: np.random.Generator) -> None:
    folder.mkdir(parents=True)
    rotations = Rotation.random(len(OBJECTS), rng=random).as_matrix()
    places = random.uniform((-200, -200, 1800), (200, 200, 2000), (len(OBJECTS), 3))
    records: dict[str, dict[int, object]] = {"camera": {}, "gt": {}, "gt_info": {}}
    for frame in range(FRAMES):
        records["camera"][frame] = {"cam_K": [500.0, 0.0, 48.0, 0.0, 500.0, 27.0, 0.0, 0.0, 1.0], "depth_scale": 0.1}
        records["gt"][frame] = [
            {
                "obj_id": object_id,
                "cam_R_m2c": rotations[index].reshape(-1).tolist(),
                "cam_t_m2c": (places[index] + (1e3 * SPEED[index] * PERIOD * frame, 0, 0)).tolist(),
                "instance_id": index,
            }
            for index, object_id in enumerate(OBJECTS)
        ]
        records["gt_info"][frame] = [
            {
                "bbox_obj": [0, 0, 9, 9],
                "bbox_visib": [0, 0, 9, 9],
                "px_count_all": 100,
                "px_count_valid": 100,
                "px_count_visib": round(100 * fraction),
                "visib_fract": fraction,
            }
            for fraction in VISIBILITY
        ]
    for name, record in records.items():
        (folder / f"scene_{name}.json").write_text(json.dumps(record))


def moved(poses: PoseTable, offset: tuple[float, float, float] = (0.0, 0.0, 0.0), turn: np.ndarray | None = None) -> PoseTable:
    """Poses moved in the camera's axes [m] and turned in the object's axes."""
    rotation = poses.rotation if turn is None else poses.rotation @ turn
    return PoseTable(**(vars(poses) | {"rotation": rotation, "translation": poses.translation + offset}))
