"""Report on image quality in episodes: PSNR of denoised frames, with light histories as in a bake, against path-traced references.

Light histories (`render.history`) average the light of resting surfaces over the frames of an episode, so single frames do not show the
quality of a bake. Here every frame of camera 0 is denoised, from the first one on, and those of `--frames` are rendered twice more as
references, with half of `--samples` each: the product of the two differences estimates the error without the references' noise. Exits with
1 if a bound is violated, with 2 if nothing can be rendered.

    python -m tools.reports.sequence --models DIR --lights DIR --size 640x360 --frames 0,8,30 --samples 256 --sheet sheet.png

With `--references DIR` references are cached: another run with other settings of the denoiser takes a tenth of the time.
"""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import warp as wp
from rich.console import Console

from synpick_warp.apps.viz.drawing import FONT, put_text, write_picture
from synpick_warp.codes import Phase
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import build_stages, make_renderer
from synpick_warp.factory.memory_plan import check_memory, explain_shortage, plan_memory
from synpick_warp.factory.sizes import fit_to_device
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import RenderScene
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.stream import read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.figures import finish_report
from tools.options import MeasuredRow, configure, existing_folder, fail, make_parser, positive_count, writable_file

MIN_PSNR, MAX_BIAS = 35.0, 1.0
"""Bounds of the mean PSNR over all compared frames [dB], and of the mean bias [%]."""
DENOISER_SETTINGS = ("coarse_pixel", "coarse_paths", "history", "mode")
"""Settings of section `render` that do not affect references."""
CELL_WIDTH, GAP, LINE, GAIN = 640, 6, 30, 5
"""Contact sheet: width of an image, gap between images, height of a line of text [px]; factor that makes differences visible."""


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


class ReferenceStore:
    """Pairs of references with half of the paths each, cached in one file per pair. The key is a hash of settings and of the world's state.

    The key does not cover the code: clear the folder after a change of the reference renderer.
    """

    def __init__(self, folder: Path | None, config: Config, scene: RenderScene) -> None:
        """
        Args:
            folder: Folder of the files; None: no caching.
            config: Settings of the references, including the number of paths.
            scene: Scene of the references.
        """
        self._folder = folder
        half, room = {"render.mode": REFERENCE, "render.samples": max(1, config.render.samples // 2)}, config.arrangement.max_objects
        both = (config.with_values(half | {"bake.seed": config.bake.seed + offset}) for offset in (0, 1))
        self._studios = [Studio(make_renderer(each, scene, room, 1)) for each in both]
        content: dict[str, Any] = dataclasses.asdict(config)
        for name in DENOISER_SETTINGS:
            del content["render"][name]
        self._settings = repr(content).encode()

    def get(self, snapshot: Snapshot, world: int) -> tuple[Shot, Shot]:
        """Return the references of a world, from the cache or else from the renderer."""
        if self._folder is None:
            return self._render(snapshot, world)
        state = hashlib.sha256(self._settings)
        for item in dataclasses.fields(snapshot):
            state.update(getattr(snapshot, item.name).numpy()[world].tobytes())
        path = self._folder / f"{state.hexdigest()}.npz"
        if not path.exists():
            shots = self._render(snapshot, world)
            part = path.with_suffix(".part.npz")
            np.savez(part, **{f"{name}{index}": array for index, shot in enumerate(shots) for name, array in vars(shot).items()})
            part.replace(path)
        with np.load(path) as content:
            first, second = (Shot(content[f"color{index}"], content[f"radiance{index}"]) for index in (0, 1))
        return first, second

    def _render(self, snapshot: Snapshot, world: int) -> tuple[Shot, Shot]:
        first, second = (studio.render(snapshot, world) for studio in self._studios)
        return first, second


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
    "sheet": {"type": writable_file, "help": "contact sheet: denoised, reference, and five times their difference"},
    "references": {"type": existing_folder, "help": "folder in which references are cached between runs"},
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
        for frame, pair in compare_frames(config, options.frames, options.references):
            pairs.append(pair)
            missing.discard(frame)
            name, seconds = f"frame {frame}, {pair.light}", time.perf_counter() - started
            rows.append(MeasuredRow(f"{name}: denoised against reference", pair.quality, "dB"))
            rows.append(MeasuredRow(f"{name}: bias of mean radiance", pair.bias, "%"))
            console.print(f"{seconds:6.0f} s  frame {frame:4}  {pair.light}: {pair.quality:.2f} dB, {pair.bias:+.2f} %")
        if missing:
            raise SynpickError(f"no episode has frame {min(missing)} of --frames; name earlier ones")
        if options.sheet:
            console.print(f"wrote {write_picture(options.sheet, draw_sheet(pairs)[..., ::-1])}")
    except SynpickError as error:
        return fail("reports.sequence", error)
    rows += summarize_pairs(pairs)
    width, height = config.cameras.resolution
    title = f"{config.bake.mode}, {width} x {height}, {config.render.samples} paths per pixel, {time.perf_counter() - started:.0f} s"
    return finish_report("tools.reports.sequence", options.json, device, "frames of episodes", title, rows)


def compare_frames(config: Config, frames: tuple[int, ...], cache: Path | None = None) -> Iterator[tuple[int, Pair]]:
    """Simulate episodes and render camera 0; yields (frame, denoised image and references) for the given frames of each episode.

    Args:
        config: All settings; one episode per world.
        frames: Indices of frames.
        cache: Folder in which references are cached; None: no caching.
    """
    device = pick_device(config.bake.device)
    fitted = fit_to_device(config.with_values({"render.mode": FAST}), device, config.bake.episodes)
    check_memory(plan_memory(fitted, device), device)
    with explain_shortage(fitted):
        stages = build_stages(fitted, device, SilentProgress(), range(config.bake.episodes))
    denoised, store = Studio(stages.groups[0].renderer), ReferenceStore(cache, config, stages.groups[0].renderer.scene)
    simulation, names = stages.simulation, stages.light_table.name
    while True:
        simulation.tick()
        report = read_tick(simulation.record)
        snapshot, shown = simulation.record.snapshot, report.column("frame")
        for world in np.flatnonzero(report.column("live")).tolist():
            if shown[world] <= max(frames):
                shot = denoised.render(snapshot, world)
                if shown[world] in frames:
                    light = str(names[int(snapshot.light.numpy()[world])])
                    yield int(shown[world]), Pair(light, shot, store.get(snapshot, world))
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


def draw_sheet(pairs: list[Pair]) -> np.ndarray:
    """Draw a contact sheet (H, W, 3) uint8 RGB: a labelled row of images for each pair."""
    blocks = []
    for pair in pairs:
        denoised, reference = pair.denoised.color, pair.references[0].color
        images = (denoised, reference, cv2.absdiff(denoised, reference).clip(0, 255 // GAIN) * GAIN)
        row = np.concatenate([np.pad(_scale(image), ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for image in images], axis=1)
        blocks += [_draw_line([f"{pair.light}:  {pair.quality:.1f} dB,  bias {pair.bias:+.1f} %"], row.shape[1]), row]
    return np.concatenate([_draw_line(["denoised", "reference", f"{GAIN} x their difference"], blocks[-1].shape[1]), *blocks])


def _scale(image: np.ndarray) -> np.ndarray:
    """Image shrunk to the cells' width, or enlarged by an integer factor."""
    height, width = image.shape[:2]
    if width > CELL_WIDTH:
        return cv2.resize(image, (CELL_WIDTH, round(height * CELL_WIDTH / width)), interpolation=cv2.INTER_AREA)
    factor = CELL_WIDTH // width
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def _draw_line(texts: list[str], width: int) -> np.ndarray:
    """Draw a line of evenly spaced texts, shrunk to fit their columns."""
    canvas, column = np.full((LINE, width, 3), 255, np.uint8), width // len(texts)
    for index, text in enumerate(texts):
        size = 0.65 * min(1.0, (column - 2 * GAP) / cv2.getTextSize(text, FONT, 0.65, 1)[0][0])
        put_text(canvas, text, (index * column + GAP, LINE - 9), size, (30, 30, 30))
    return canvas


if __name__ == "__main__":
    sys.exit(main())
