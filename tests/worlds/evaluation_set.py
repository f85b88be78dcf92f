"""Small data set for evaluations, written without a bake: two episodes, objects with known symmetries on straight paths; and synthetic
estimates around analytic trajectories: rest, constant velocity, constant rotation rate; with noise, outliers and gaps."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.truth import PoseTable
from synpick_warp.configs.files.load import config_to_toml, load_config
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


FRAME = 1 / 15
"""Time from frame to frame [s]."""


@dataclass(frozen=True)
class Motion:
    """An instance that moves at constant velocity and rotation rate."""

    scene: int = 1
    object_id: int = 17
    start: tuple[float, float, float] = (0.0, 0.0, 1.9)
    """[m]"""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """[m/s]"""
    spin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector a second, in the camera frame [rad/s]."""
    first: tuple[float, float, float] = (0.3, -0.2, 0.5)
    """Rotation vector in image 0 [rad]."""
    images: int = 100
    instance: int = 0


def true_poses(*motions: Motion) -> PoseTable:
    """Poses of all images, sorted by scene, image and object."""
    parts = []
    for motion in motions:
        image = np.arange(motion.images)
        time = (image * FRAME)[:, None]
        rotation = Rotation.from_rotvec(time * motion.spin) * Rotation.from_rotvec(motion.first)
        full = np.full(motion.images, motion.scene), image, np.full(motion.images, motion.object_id)
        rest = np.ones(motion.images), np.full(motion.images, -1.0), np.full(motion.images, motion.instance)
        parts.append(PoseTable(*full, rotation.as_matrix(), motion.start + time * motion.velocity, *rest))
    return join_tables(*parts)


def join_tables(*tables: PoseTable) -> PoseTable:
    """Rows of several tables, sorted by scene, image and object."""
    names = PoseTable.__dataclass_fields__
    table = PoseTable(*(np.concatenate([getattr(one, name) for one in tables]) for name in names))
    return table.select(np.lexsort((table.object_id, table.image, table.scene)))


def estimates(
    truth: PoseTable,
    seed: int = 0,
    *,
    noise: float = 0.0,
    angle: float = 0.0,
    outliers: float = 0.0,
    jump: float = 0.2,
    missing: float = 0.0,
    known: bool = False,
) -> PoseTable:
    """Estimates of true poses.

    Args:
        truth: True poses.
        seed: Of the random numbers.
        noise: Standard deviation of each coordinate [m].
        angle: Standard deviation of each component of the rotation vector [rad].
        outliers: Fraction of estimates that are `jump` away and turned at random.
        jump: Distance of outliers [m].
        missing: Fraction of rows that are left out.
        known: Whether estimates know their instances.
    """
    rng = np.random.default_rng(seed)
    count = len(truth)
    far = rng.random(count) < outliers
    way = rng.normal(size=(count, 3))
    translation = truth.translation + noise * rng.normal(size=(count, 3))
    translation = translation + far[:, None] * jump * way / np.linalg.norm(way, axis=1, keepdims=True)
    rotation = Rotation.from_rotvec(angle * rng.normal(size=(count, 3))).as_matrix() @ truth.rotation
    rotation = np.where(far[:, None, None], Rotation.random(count, rng=rng).as_matrix(), rotation)
    instance = truth.instance if known else np.full(count, -1)
    table = PoseTable(truth.scene, truth.image, truth.object_id, rotation, translation, rng.random(count), truth.seconds, instance)
    return table.select(rng.random(count) >= missing)


@st.composite
def noisy_tables(draw: st.DrawFn) -> PoseTable:
    """Estimates of up to 5 instances, which may share scene and object, with noise, outliers and gaps."""
    motions = [
        Motion(
            scene=draw(st.integers(0, 2)),
            object_id=draw(st.integers(1, 2)),
            start=tuple(draw(st.floats(-0.3, 0.3)) for _ in range(3)),
            velocity=tuple(draw(st.floats(-0.5, 0.5)) for _ in range(3)),
            spin=tuple(draw(st.floats(-2.0, 2.0)) for _ in range(3)),
            images=draw(st.integers(1, 12)),
            instance=instance,
        )
        for instance in range(draw(st.integers(1, 5)))
    ]
    seed, known = draw(st.integers(0, 2**31)), draw(st.booleans())
    return estimates(true_poses(*motions), seed, noise=0.02, angle=0.3, outliers=0.1, missing=0.2, known=known)
