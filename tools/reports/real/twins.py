"""Paired renderings (twins) of annotated photographs: the objects rendered at their poses, in front of the photograph itself.

Photograph and twin differ in the objects' appearance alone: materials, light, the camera's tone. `tools.reports.real` scores a network on
both (the paired gap); without a network, the pixels of each object are compared.

    python -m tools.reports.real.twins --real REAL --models YCB --lights HDRI --pictures OUT
"""

import argparse
import itertools
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
from rich.console import Console

import synpick_warp
from synpick_warp.configs.files.load import parse_assignment
from synpick_warp.errors import ConfigError, SynpickError
from synpick_warp.scenes.types import Camera
from tools.figures import describe_run, write_run
from tools.options import MeasuredRow, existing_folder, fail, make_parser, print_rows
from tools.reports.real.frames import RealFrame, read_frames

UNIT = 1e-3
"""Unit of BOP models [m]."""
LEVELS = 255.0


def render_twins(frames: Sequence[RealFrame], options: argparse.Namespace) -> list[RealFrame]:
    """Twins of frames by a command line's `models`, `lights`, `device` and `set`. Raises SynpickError: one of these cannot be used."""
    if not options.models:
        raise ConfigError("twins need --models, the folder of the photographs' BOP models")
    settings = dict(parse_assignment(text) for text in options.set) | {"bake.lights": options.lights, "render.table": False}
    return [render_twin(frame, Path(options.models), options.device, settings) for frame in frames]


def render_twin(frame: RealFrame, models: Path, device: str, settings: Mapping[str, object]) -> RealFrame:
    """The frame with its objects rendered, and their labels; all else is the photograph. `models`: folder of BOP models. `device` and
    `settings`: as of `synpick_warp.render`. Raises SynpickError: a model or a setting cannot be used."""
    if not frame.object_ids:
        return frame
    view = np.linalg.inv(np.vstack([frame.world_to_camera, [0.0, 0.0, 0.0, 1.0]]))
    poses = np.tile(np.eye(4), (len(frame.object_ids), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = frame.rotations, UNIT * frame.translations
    objects = [(models / f"obj_{index:06d}.ply", view @ pose) for index, pose in zip(frame.object_ids, poses, strict=True)]
    camera = Camera.at(matrix=frame.intrinsics, resolution=frame.label.shape[::-1], pose=view)
    views = synpick_warp.render(objects, [camera], unit=UNIT, device=device, settings=settings)
    label = np.array([0, *frame.object_ids], np.uint8)[views["instance"][0]]
    return replace(frame, color=np.where(label[..., None] > 0, views["color"][0], frame.color), label=label)


def compare_objects(frames: Sequence[RealFrame], twins: Sequence[RealFrame]) -> list[MeasuredRow]:
    """Appearance of each object in photographs and twins, over the pixels that show it in both, as means over the frames."""
    found: dict[int, list[tuple[float, ...]]] = {}
    for frame, twin in zip(frames, twins, strict=True):
        for index in set(frame.object_ids):
            real, rendered = frame.label == index, twin.label == index
            if not (both := real & rendered).any():
                continue
            pairs = zip(*(_tone(one.color[both]) for one in (frame, twin)), strict=True)
            found.setdefault(index, []).append((*itertools.chain(*pairs), both.sum() / (real | rendered).sum()))
    names = [f"{name}, {where}" for name in ("brightness", "contrast", "saturation") for where in ("photograph", "twin")] + ["masks: IoU"]
    means = {index: np.mean(values, axis=0) for index, values in sorted(found.items())}
    return [
        MeasuredRow(f"obj_id {index}: {name}", round(float(value), 3), part="object")
        for index, values in means.items()
        for name, value in zip(names, values, strict=True)
    ]


def _tone(pixels: np.ndarray) -> tuple[float, float, float]:
    """Mean and standard deviation of the grey values of sRGB pixels (N, 3) uint8, and their mean saturation (of HSV), in 0..1."""
    values = pixels / LEVELS
    high, grey = values.max(axis=1), values.mean(axis=1)
    return float(grey.mean()), float(grey.std()), float(np.mean((high - values.min(axis=1)) / np.maximum(high, 1.0 / LEVELS)))


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    own = {"pictures": {"type": existing_folder, "metavar": "DIR", "help": "write each photograph beside its twin to this folder"}}
    parser = make_parser(__doc__, "device", "models", "lights", "set", "json", own=own)
    parser.add_argument("--real", type=Path, required=True, help="frames: SSSS_FFFFFF-{color,depth,label}.png and -poses.json")
    options = parser.parse_args(arguments)
    try:
        frames = read_frames(options.real)
        twins = render_twins(frames, options)
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
