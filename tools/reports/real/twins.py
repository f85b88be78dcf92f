"""Paired renderings (twins) of annotated photographs: the objects rendered at their poses, in front of the photograph itself.

Photograph and twin differ in the objects' appearance alone: materials, light, the camera's tone. `tools.reports.real` scores a network on
both (the paired gap); without a network, the pixels of each object are compared.

    python -m tools.reports.real.twins --real REAL --models YCB --lights HDRI --pictures OUT
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

import synpick_warp
from synpick_warp.apps.evaluation.likeness import Appearance, find_features, measure_appearance
from synpick_warp.apps.evaluation.twins import UNIT, Shot, Twin, inner_pixels, render_twins
from synpick_warp.configs.files.load import parse_assignment
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.online.render import SceneRenderer
from synpick_warp.scenes.types import Camera
from tools.figures import describe_run, write_run
from tools.options import MeasuredRow, existing_folder, fail, make_parser, print_rows
from tools.reports.real.frames import RealFrame, read_frames


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
    return [_with_twin(frame, next(twins)) if frame.object_ids else frame for frame in frames]


def _with_twin(frame: RealFrame, twin: Twin) -> RealFrame:
    return replace(frame, color=twin.color, label=np.array([0, *frame.object_ids], np.uint8)[twin.instance])


def _make_shot(frame: RealFrame, models: Path) -> Shot:
    """Frame of one object or more, to render. `models`: folder of BOP models."""
    view = np.linalg.inv(np.vstack([frame.world_to_camera, [0.0, 0.0, 0.0, 1.0]]))
    poses = np.tile(np.eye(4), (len(frame.object_ids), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frame.rotations, UNIT * frame.translations
    objects = [(models / f"obj_{index:06d}.ply", view @ pose) for index, pose in zip(frame.object_ids, poses, strict=True)]
    return Shot(frame, frame.color, objects, Camera.at(matrix=frame.intrinsics, resolution=frame.label.shape[::-1], pose=view))


def compare_objects(frames: Sequence[RealFrame], twins: Sequence[RealFrame]) -> list[MeasuredRow]:
    """Appearance of each object in photographs and twins, over the pixels that show it in both, as means over the frames."""
    found: dict[int, list[np.ndarray]] = {}
    for frame, twin in zip(frames, twins, strict=True):
        features = [find_features(one.color) for one in (frame, twin)]
        for index in set(frame.object_ids):
            real, rendered = frame.label == index, twin.label == index
            if (both := real & rendered & inner_pixels(twin.label)).any():
                pair = np.transpose([measure_appearance(each[both]) for each in features])
                found.setdefault(index, []).append(np.append(pair, (real & rendered).sum() / (real | rendered).sum()))
    names = [f"{name}, {where}" for name in Appearance._fields for where in ("photograph", "twin")] + ["masks: IoU"]
    return [
        MeasuredRow(f"obj_id {index}: {name}", round(float(value), 3), part="object")
        for index, values in sorted(found.items())
        for name, value in zip(names, np.mean(values, axis=0), strict=True)
    ]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    own = {"pictures": {"type": existing_folder, "metavar": "DIR", "help": "write each photograph beside its twin to this folder"}}
    parser = make_parser(__doc__, "device", "models", "lights", "set", "json", own=own)
    parser.add_argument("--real", type=Path, required=True, help="frames: SSSS_FFFFFF-{color,depth,label}.png and -poses.json")
    options = parser.parse_args(arguments)
    try:
        frames = read_frames(options.real)
        twins = render_frames(frames, options)
    except SynpickError as error:
        return fail("reports.real.twins", error)
    for frame, twin in zip(frames, twins, strict=True):
        if options.pictures is not None:
            cv2.imwrite(str(options.pictures / f"{frame.name}.png"), np.hstack([frame.color, twin.color])[..., ::-1])
    rows = compare_objects(frames, twins)
    write_run(options.json, describe_run("tools.reports.real.twins", (), rows))
    print_rows(Console(), "", "photographs and twins", rows)
    return 0


if __name__ == "__main__":
    sys.exit(main())
