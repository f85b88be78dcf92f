"""Small rendered scenes for pose estimators: objects on known paths, and a fixed data set of two cluttered scenes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.stages.pose.batch import InstanceTable, ObjectModel, RgbdBatch
from tests.worlds.pose_views import embedded, pose_of, rendered, table_of


@dataclass(frozen=True, eq=False)
class Scene:
    """Rendered frames of objects with known poses."""

    objects: tuple[ObjectModel, ...]
    frames: tuple[RgbdBatch, ...]
    """Views of each frame."""
    table: InstanceTable
    pose: np.ndarray
    """True poses (frame, instance, 7) float32."""


def select(batch: RgbdBatch, views: slice | list[int]) -> RgbdBatch:
    """Subset of the views of a batch."""
    return RgbdBatch(**{name: array[views] for name, array in vars(batch).items()})


def without(batch: RgbdBatch, slot: int) -> RgbdBatch:
    """Copy of a batch in which the mask of one slot is removed."""
    return RgbdBatch(**(vars(batch) | {"label": np.where(batch.label == slot + 1, 0, batch.label).astype(np.uint8)}))


def card(x: float) -> np.ndarray:
    """Pose of the flat carton (obj_id 7), the occluder that passes in front of the mug at a depth of 0.4 m."""
    return pose_of((x, 0.075, 0.4), Rotation.from_euler("xz", [5.0, 90.0], degrees=True))


MOVING = 10
"""Frames of `moving_scene`."""
TIN, MUG, DRILL = 0, 1, 2
"""Its instances."""


def moving_scene(device: wp.Device) -> Scene:
    """One view: a soup tin that turns about its axis, which depth cannot see; a mug that a card passes; a drill that flies and tumbles.

    From frame to frame the tin turns by 5°, and the drill moves by 6 mm and turns by 4°.
    """
    objects = embedded(4, 14, 15, 7)
    upright = Rotation.from_euler("x", 105.0, degrees=True)
    poses = np.empty((MOVING, 3, 7), np.float32)
    placed = []
    for frame in range(MOVING):
        turn = Rotation.from_euler("z", 5.0 * frame, degrees=True)
        poses[frame, TIN] = pose_of((-0.12, -0.03, 0.4), upright * turn)
        poses[frame, MUG] = pose_of((0.0, 0.06, 0.6), Rotation.from_euler("xyz", [115.0, 20.0, 30.0], degrees=True))
        tumble = Rotation.from_rotvec(np.deg2rad(4.0 * frame) * np.array([0.0, 0.6, 0.8]))
        way = np.array([0.005, -0.003, 0.0015]) * (frame - MOVING / 2)
        poses[frame, DRILL] = pose_of(tuple(np.array([0.16, -0.01, 0.62]) + way), tumble * Rotation.from_euler("x", 25.0, degrees=True))
        placed.append([(model, poses[frame, model]) for model in range(3)] + [(3, card(-0.16 + 0.02 * frame))])
    batch = rendered(objects, placed, device)
    frames = tuple(select(batch, [frame]) for frame in range(MOVING))
    return Scene(objects, frames, table_of((0, 0, 0), (0, 1, 1), (0, 2, 2)), poses)


SET_SCENES, SET_FRAMES = 2, 8
SET_IDS = (2, 4, 8, 10, 12, 14, 15, 17)
"""Objects of the fixed data set: cartons, tin, banana, bottle, mug, drill, scissors."""
SET_INSTANCES = 6
"""Instances of each of its scenes; two further objects are clutter without masks of their own."""


def fixed_set(device: wp.Device, frames: int = SET_FRAMES) -> Scene:
    """Two scenes of eight objects in two layers, each moving steadily; the poses follow from fixed seeds, whatever the number of frames."""
    objects = embedded(*SET_IDS)
    count = SET_INSTANCES + 2
    poses = np.empty((frames, SET_SCENES, count, 7), np.float32)
    models = np.empty((SET_SCENES, count), np.int32)
    for scene in range(SET_SCENES):
        random = np.random.default_rng(40 + scene)
        models[scene] = random.permutation(len(SET_IDS))
        cells = np.array([(x, y) for y in (-0.09, 0.09) for x in (-0.24, -0.08, 0.08, 0.24)])[random.permutation(8)]
        place = np.concatenate([cells + random.uniform(-0.02, 0.02, (8, 2)), random.uniform(0.62, 0.82, (8, 1))], axis=1)
        rotation = Rotation.random(count, rng=random)
        speed, spin = random.normal(0.0, 0.003, (count, 3)), random.normal(0.0, np.deg2rad(2.0), (count, 3))
        for frame in range(frames):
            poses[frame, scene, :, :3] = place + frame * speed
            poses[frame, scene, :, 3:] = (Rotation.from_rotvec(frame * spin) * rotation).as_quat()
    placed = [
        [(int(models[scene, slot]), poses[frame, scene, slot]) for slot in range(count)]
        for frame in range(frames)
        for scene in range(SET_SCENES)
    ]
    batch = rendered(objects, placed, device)
    views = tuple(select(batch, slice(SET_SCENES * frame, SET_SCENES * (frame + 1))) for frame in range(frames))
    rows = [(scene, slot, int(models[scene, slot])) for scene in range(SET_SCENES) for slot in range(SET_INSTANCES)]
    true = poses[:, :, :SET_INSTANCES].reshape(frames, -1, 7)
    return Scene(objects, views, table_of(*rows), true)
