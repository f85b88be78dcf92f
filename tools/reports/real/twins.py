"""Paired renderings (twins) of annotated photographs: the objects rendered at their poses, in front of the photograph itself.

Photograph and twin differ in the objects' appearance alone: materials, light, the camera's tone. A network is scored on both (the paired
gap); `synpick-warp gap` compares the pixels of each object, in BOP data sets.
"""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

import synpick_warp
from synpick_warp.apps.evaluation.twins import UNIT, Shot, render_twins
from synpick_warp.configs.files.load import parse_assignment
from synpick_warp.errors import ConfigError
from synpick_warp.online.render import SceneRenderer
from synpick_warp.scenes.types import Camera
from tools.reports.real.frames import RealFrame


def render_frames(frames: Sequence[RealFrame], options: argparse.Namespace) -> list[RealFrame]:
    """Twins of frames, and their labels, by a command line's `models`, `lights`, `device` and `set`. Raises SynpickError: one of these
    cannot be used."""
    if not options.models:
        raise ConfigError("twins need --models, the folder of the photographs' BOP models")
    given = dict(parse_assignment(text) for text in options.set) | {"bake.lights": options.lights, "bake.device": options.device}
    settings = synpick_warp.load_config(None, given | {"render.table": False})
    if not (shots := [_make_shot(frame, Path(options.models)) for frame in frames if frame.object_ids]):
        return list(frames)
    meshes = sorted({path for shot in shots for path, _ in shot.objects})
    twins = render_twins(shots, SceneRenderer(meshes, [shots[0].camera], (), UNIT, options.device, settings))
    labels = (np.array([0, *frame.object_ids], np.uint8) for frame in frames if frame.object_ids)
    made = (replace(twin.shot.source, color=twin.color, label=label[twin.instance]) for twin, label in zip(twins, labels, strict=True))
    return [next(made) if frame.object_ids else frame for frame in frames]


def _make_shot(frame: RealFrame, models: Path) -> Shot:
    """Frame of one object or more, to render. `models`: folder of BOP models."""
    view = np.linalg.inv(np.vstack([frame.world_to_camera, [0.0, 0.0, 0.0, 1.0]]))
    poses = np.tile(np.eye(4), (len(frame.object_ids), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frame.rotations, UNIT * frame.translations
    objects = [(models / f"obj_{index:06d}.ply", view @ pose) for index, pose in zip(frame.object_ids, poses, strict=True)]
    return Shot(frame, frame.color, objects, Camera.at(matrix=frame.intrinsics, resolution=frame.label.shape[::-1], pose=view))
