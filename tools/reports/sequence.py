"""Report on image quality in episodes: PSNR of denoised frames, with light histories as in a bake, against path-traced references.

Light histories (`render.history`) average the light of resting surfaces over the frames of an episode, so single frames do not show the
quality of a bake. Here every frame of camera 0 is denoised, from the first one on, and those of `--frames` are rendered twice more as
references, with half of `--samples` each: the product of the two differences estimates the error without the references' noise. Exits with
1 if a bound is violated, with 2 if nothing can be rendered.

    python -m tools.reports.sequence --models DIR --lights DIR --size 640x360 --frames 0,8,30 --samples 256
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import warp as wp
from rich.console import Console

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import build_stages, make_renderer
from synpick_warp.factory.memory_plan import check_memory, explain_shortage, fit_to_device, plan_memory
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.stream import read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.figures import finish_report
from tools.options import MeasuredRow, configure, fail, make_parser, positive_count

MIN_PSNR, MAX_BIAS = 35.0, 1.0
"""Bounds of the mean PSNR over all compared frames [dB], and of the mean bias [%]."""


@dataclass(frozen=True, eq=False)
class Shot:
    """Rendered view."""

    color: np.ndarray
    """Image (H, W, 3) uint8, sRGB."""
    radiance: np.ndarray
    """Linear radiance before exposure (H, W, 3) float32."""


class Studio:
    """Renderer of single views by camera 0, with its buffers."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer, self.device = renderer, renderer.scene.device
        self.out = allocate_view_buffers(1, renderer.scene.width, renderer.scene.height, renderer.instances, self.device)

    def render(self, snapshot: Snapshot, world: int) -> Shot:
        """Render one world."""
        worlds, cameras = (wp.array([index], dtype=wp.int32, device=self.device) for index in (world, 0))
        self.renderer.render(snapshot, make_views(worlds, cameras, 1, self.renderer.instances), self.out)
        return Shot(self.out.color.numpy()[0].copy(), self.renderer.image.radiance.numpy()[0].copy())


@dataclass(frozen=True, eq=False)
class Pair:
    """Denoised image, and two independent references of the same view under one light map."""

    light: str
    denoised: Shot
    references: tuple[Shot, Shot]

    @property
    def quality(self) -> float:
        """PSNR of the denoised image [dB]; the squared error is the product of its differences to the two references, whose expectation
        has no noise."""
        first, second = (shot.color.astype(np.float64) - self.denoised.color for shot in self.references)
        return 10.0 * float(np.log10(255.0**2 / max(float((first * second).mean()), 1e-9)))

    @property
    def bias(self) -> float:
        """Relative bias of the denoised image's mean radiance [%]."""
        expected = float(np.mean([shot.radiance.mean() for shot in self.references]))
        return 100.0 * (float(self.denoised.radiance.mean()) / expected - 1.0)


def _frames(text: str) -> tuple[int, ...]:
    """Type of an option: frame indices joined by commas."""
    parts = text.split(",")
    if not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text} are no frames; allowed: numbers from 0 on, such as 0,8,30")
    return tuple(sorted({int(part) for part in parts}))


OWN = {
    "episodes": {"type": positive_count, "default": 1, "help": "episodes, each in a world of its own (default: 1)"},
    "mode": {"default": "pick", "help": "bake.mode (default: pick)"},
    "frames": {"type": _frames, "default": (0, 8, 30), "help": "frames to compare, comma-separated (default: 0,8,30)"},
    "samples": {"type": positive_count, "default": 256, "help": "paths per pixel of both references together (default: 256)"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    shared = ("models", "lights", "device", "seed", "set", "json", "size")
    options = make_parser(__doc__, *shared, own=OWN, size="480x270").parse_args(arguments)
    console, started = Console(highlight=False), time.perf_counter()
    rows: list[MeasuredRow] = []
    pairs: list[Pair] = []
    missing = set(options.frames)
    try:
        worlds = {"bake.episodes": options.episodes, "bake.worlds": options.episodes}
        config = configure(options, worlds | {"bake.mode": options.mode, "render.samples": options.samples})
        config = config.with_values({"cameras.positions": config.cameras.positions[:1], "cameras.ups": config.cameras.ups[:1]})
        device = pick_device(config.bake.device)
        for frame, pair in compare_frames(config, options.frames):
            pairs.append(pair)
            missing.discard(frame)
            name, seconds = f"frame {frame}, {pair.light}", time.perf_counter() - started
            rows.append(MeasuredRow(f"{name}: denoised against reference", pair.quality, "dB"))
            rows.append(MeasuredRow(f"{name}: bias of mean radiance", pair.bias, "%"))
            console.print(f"{seconds:6.0f} s  frame {frame:4}  {pair.light}: {pair.quality:.2f} dB, {pair.bias:+.2f} %")
        if missing:
            raise SynpickError(f"no episode has frame {min(missing)} of --frames; name earlier ones")
    except SynpickError as error:
        return fail("reports.sequence", error)
    rows += summarize_pairs(pairs)
    width, height = config.cameras.resolution
    title = f"{config.bake.mode}, {width} x {height}, {config.render.samples} paths per pixel, {time.perf_counter() - started:.0f} s"
    return finish_report("tools.reports.sequence", options.json, device, "frames of episodes", title, rows)


def compare_frames(config: Config, frames: tuple[int, ...]) -> Iterator[tuple[int, Pair]]:
    """Simulate episodes, one per world, and render camera 0; yields (frame, denoised image and references) for these frames of each.

    References have half of the paths each, and seeds of their own.
    """
    device = pick_device(config.bake.device)
    fitted = fit_to_device(config.with_values({"render.mode": FAST, "render.reuse": False}), device, config.bake.episodes)
    check_memory(plan_memory(fitted, device), device)
    with explain_shortage(fitted):
        stages = build_stages(fitted, device, SilentProgress(), range(config.bake.episodes))
    denoised, simulation, names = Studio(stages.groups[0].renderer), stages.simulation, stages.light_table.name
    half = config.with_values({"render.mode": REFERENCE, "render.samples": max(1, config.render.samples // 2)})
    first, second = (
        Studio(make_renderer(half.with_values({"bake.seed": seed}), denoised.renderer.scene, config.arrangement.max_objects, 1))
        for seed in (config.bake.seed, config.bake.seed + 1)
    )
    while True:
        simulation.tick()
        report = read_tick(simulation.record)
        snapshot, shown = simulation.record.snapshot, report.column("frame")
        for world in np.flatnonzero(report.column("live")).tolist():
            if shown[world] <= max(frames):
                shot = denoised.render(snapshot, world)
                if shown[world] in frames:
                    light = str(names[int(snapshot.light.numpy()[world])])
                    yield int(shown[world]), Pair(light, shot, (first.render(snapshot, world), second.render(snapshot, world)))
        phase = report.column("phase")
        if ((phase == Phase.IDLE) | ((phase == Phase.ACT) & (shown >= max(frames)))).all():
            return


def summarize_pairs(pairs: list[Pair]) -> list[MeasuredRow]:
    """Rows of the quality of all pairs, and of their mean bias, with bounds."""
    qualities, bias = [pair.quality for pair in pairs], float(np.mean([pair.bias for pair in pairs]))
    mean = float(np.mean(qualities))
    return [
        MeasuredRow("denoised against reference, mean", mean, "dB", f">= {MIN_PSNR:g}", mean >= MIN_PSNR),
        MeasuredRow("denoised against reference, min", min(qualities), "dB"),
        MeasuredRow("bias of mean radiance, mean", bias, "%", f"within {MAX_BIAS:g}", abs(bias) < MAX_BIAS),
    ]


if __name__ == "__main__":
    sys.exit(main())
