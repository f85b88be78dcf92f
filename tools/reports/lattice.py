"""Image quality report of the denoised renderer: PSNR, FLIP and periodic artefacts, per light map and image size, against references.

The denoiser computes light and shadows on a coarse grid of pixels. Errors of upsampling then repeat with the grid's period, as a lattice
that PSNR hardly shows. For each map and size, one frame of an episode is rendered as in a bake, with its light history, and path-traced
twice. The report prints:

- PSNR, corrected for the references' noise (`Pair.quality`);
- mean FLIP (Andersson et al., "FLIP: A Difference Evaluator for Alternating Images", 2020; package flip-evaluator) against the mean of
  both references, and half of the FLIP between the two, an upper bound of what their noise contributes;
- the lattice (`measure_lattice`): spectral amplitude at the grid's frequencies relative to neighbouring frequencies, in image windows
  without objects, for the denoised frame and for the reference.

`--crops DIR` writes the region with the largest FLIP of each frame beside the reference, unscaled. Exit code 1: a bound is violated.

    python -m tools.reports.lattice --models DIR --lights DIR --mode move --seed 4 --set move.rounds=1 --set move.speed=2 --crops DIR
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from synpick_warp.apps.viz.preview import write_picture
from synpick_warp.codes import Segment
from synpick_warp.configs.schema import FAST, Config, Render
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import Stages, build_stages, make_renderer
from synpick_warp.factory.sizes import fit_to_device
from synpick_warp.kernels.render.lighting.history import NEVER
from synpick_warp.kernels.render.lighting.shadows import STRATA_PERIOD
from synpick_warp.kernels.tuning import LANE_STRIDE
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import FIXTURES, Snapshot
from synpick_warp.stages.render.sampling_rates import coarse_size, shadow_size
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.figures import finish_report
from tools.options import Row, configure, fail, image_resolution, make_parser, positive_count
from tools.reports.reference_store import ReferenceStore, existing_folder
from tools.reports.render_checks import Shot, Studio, first_camera
from tools.reports.render_piles import Pair

MAX_FLIP = 0.05
"""Bound of the mean FLIP under every map."""
MAX_LATTICE = 1.5
"""Bound of the lattice's amplitude relative to neighbouring frequencies."""
WINDOW = 32
"""Least width of a window [px]; a window has at least four periods."""
VISIBLE = 1.0
"""Least amplitude of a visible lattice [grey levels]."""
STRONG = 3.0
"""Least ratio of the amplitudes at a grid frequency and at its neighbours, for a window to count as one with a lattice."""
FLOOR = 0.1
"""Amplitude that is added to the neighbours' [grey levels]: the amplitude that rounding to 8 bits causes at one frequency."""
NOISE_RATIO = float(np.exp(np.euler_gamma))
"""Arithmetic over geometric mean of the power spectrum of white noise. Neighbours are averaged geometrically, so that a few strong edge
frequencies do not dominate, and multiplied by this ratio."""
CROP = 320
"""Width of a crop [px]."""
MAX_SAMPLES = 4096
"""Most paths per pixel of both references together: with these, at 320x180, their noise is far below the denoiser's error."""
LUMINANCE = np.array([0.299, 0.587, 0.114])
"""Weights of sRGB values in luma (Rec. 601)."""
SIZES = "320x180,960x540,1920x1080"


def _sizes(text: str) -> tuple[tuple[int, int], ...]:
    """Type of an option: resolutions joined by commas."""
    sizes = [image_resolution(part) for part in text.split(",")]
    if not all(len(size) == 2 and all(isinstance(extent, int) for extent in size) for size in sizes):
        raise argparse.ArgumentTypeError(f"{text} are no sizes; allowed: such as 320x180,1920x1080")
    return tuple((int(width), int(height)) for width, height in sizes)


def _pixel(text: str) -> tuple[int, int]:
    """Type of an option: a pixel."""
    parts = text.split(",")
    if len(parts) != 2 or not all(part.isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text} is no pixel; allowed: COLUMN,ROW")
    return int(parts[0]), int(parts[1])


OWN = {
    "mode": {"default": "move", "help": "bake.mode (default: move)"},
    "sizes": {"type": _sizes, "default": _sizes(SIZES), "help": f"WIDTHxHEIGHT of the pictures, comma-separated (default: {SIZES})"},
    "frame": {"type": int, "default": 8, "help": "frame to compare (default: 8)"},
    "light": {"default": "", "help": "part of the name of the maps to compare (default: all)"},
    "paths": {"type": positive_count, "default": 1 << 29, "help": "paths of a picture's two references together (default: 536870912)"},
    "cache": {"type": existing_folder, "help": "folder in which references are kept for further runs"},
    "crops": {"type": existing_folder, "help": "folder for crops at 1:1, the denoised picture beside the reference"},
    "at": {"type": _pixel, "help": "COLUMN,ROW in the middle of all crops (default: where FLIP is largest)"},
}
"""Options of this report; see `tools.options.OPTIONS`."""


@dataclass(frozen=True)
class Lattice:
    """Strength of periodic artefacts in an image: amplitude relative to neighbouring frequencies (1: none), share of windows [%], largest
    amplitude [grey levels].
    """

    ratio: float
    """RMS amplitude at the strongest grid frequency over all windows, relative to neighbouring frequencies; 1: no lattice."""
    share: float
    """Share of windows with an amplitude of at least VISIBLE and STRONG times that of neighbouring frequencies [%]."""
    amplitude: float
    """Largest amplitude of any window at any grid frequency [grey levels]."""
    windows: int
    """Number of windows."""


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_parser(__doc__, "models", "lights", "device", "seed", "set", "json", own=OWN).parse_args(arguments)
    console = Console(highlight=False)
    started = time.perf_counter()
    rows: list[Row] = []
    try:
        fixed = {"bake.mode": options.mode, "bake.episodes": 1, "bake.worlds": 1}
        configs = [configure(options, fixed | {"cameras.resolution": list(size)}) for size in options.sizes]
        configs = [each.with_values(first_camera(each.cameras)) for each in configs]
        config = configs[0]
        device = pick_device(config.bake.device)
        fast = fit_to_device(config.with_values({"render.mode": FAST}), device, 1)
        stages = build_stages(fast, device, SilentProgress(), range(1))
        snapshots = simulate_frames(stages.simulation, options.frame)
        for size, sized in zip(options.sizes, configs, strict=True):
            for pair, periods in compare_maps(sized, stages, snapshots, options):
                rows += describe(pair, size, periods)
                values = ", ".join(f"{row.name.partition(': ')[2]} {row.value:.3f}" for row in rows[-8:])
                console.print(f"{time.perf_counter() - started:5.0f} s  {size[0]}x{size[1]} {pair.light}: {values}")
                if options.crops:
                    write_crops(pair, options.crops, f"{size[0]}x{size[1]}_{pair.light}", options.at)
    except SynpickError as error:
        return fail("reports.lattice", error)
    title = f"{config.bake.mode}, frame {options.frame}, {time.perf_counter() - started:.0f} s"
    return finish_report("tools.reports.lattice", options.json, device, "denoised frames", title, rows)


def simulate_frames(simulation: Simulation, last: int) -> list[dict[str, np.ndarray]]:
    """Simulate one episode; returns the snapshots of the frames up to `last` on the host.

    Raises:
        SynpickError: The episode ends earlier.
    """
    snapshots: list[dict[str, np.ndarray]] = []
    while len(snapshots) <= last:
        simulation.tick()
        report = read_tick(simulation.record)
        if report.column("live")[0] and report.column("frame")[0] == len(snapshots):
            snapshot = simulation.record.snapshot
            snapshots.append({item.name: getattr(snapshot, item.name).numpy()[:1].copy() for item in fields(Snapshot)})
        elif snapshots:
            raise SynpickError(f"the episode has only {len(snapshots)} frames; name an earlier one than --frame {last}")
    return snapshots


def compare_maps(
    config: Config, stages: Stages, snapshots: list[dict[str, np.ndarray]], options: argparse.Namespace
) -> Iterator[tuple[Pair, tuple[int, ...]]]:
    """Render the last snapshot at the size of `config` under every map whose name contains `options.light`.

    Args:
        config: All settings.
        stages: Objects and maps.
        snapshots: Frames of an episode, from the first one on, which fill the light histories.
        options: The command line: `light`, `paths` and `cache` are read.

    Yields the denoised frame beside two references, and the periods of the lattice [px].
    """
    device, room = stages.groups[0].renderer.scene.device, config.arrangement.max_objects
    fixtures, cameras = make_fixtures(make_bins(config.cell.bins), config.gripper), make_cameras(config.rig)
    scene = build_render_scene(config.render, -config.tote.wall, stages.catalog, fixtures, cameras, stages.lights, device)
    width, height = config.cameras.resolution
    samples = min(MAX_SAMPLES, max(2, 1 << int(math.log2(options.paths / (width * height)))))
    store = ReferenceStore(options.cache, config.with_values({"render.samples": samples}), scene)
    denoised = Studio(make_renderer(config.with_values({"render.mode": FAST}), scene, room, 1, 1))
    sizes = {"world": 1, "instance": room, "fixture": len(FIXTURES)}
    state = allocate(Snapshot, sizes, device)
    for index, map_ in enumerate(stages.lights):
        if options.light not in map_.name:
            continue
        history: Any = denoised.renderer.shading
        history.history.frame.fill_(int(NEVER))
        shots: list[Shot] = []
        for content in snapshots:
            for name, values in content.items():
                getattr(state, name).assign(values)
            state.light.fill_(index)
            shots.append(denoised.render(state, 0, 0))
        first, second = store.get(state, 0)
        yield Pair(map_.name, shots[-1], first, float(shots[-1].radiance.mean()), second), lattice_periods(config.render, width)


def lattice_periods(render: Render, width: int) -> tuple[int, ...]:
    """Periods of the denoiser's grids [px]: of the order in which coarse pixels are shaded, and of the shadow samples' strata."""
    size = coarse_size(render, width, 1)
    return tuple(sorted({size * int(LANE_STRIDE), shadow_size(size) * int(STRATA_PERIOD)}))


def describe(pair: Pair, size: tuple[int, int], periods: tuple[int, ...]) -> list[Row]:
    """Rows on the artefacts in a frame under one map."""
    second = pair.second or pair.reference
    mean = 0.5 * (pair.reference.color.astype(np.float32) + second.color)
    flip = mean_flip(mean, pair.denoised.color)
    noise = 0.5 * mean_flip(pair.reference.color, second.color)
    lattice, other = (measure_lattice(image, pair.denoised.instance, periods) for image in (pair.denoised.color, mean))
    name = f"{size[0]}x{size[1]}, {pair.light}"
    return [
        Row(f"{name}: PSNR", pair.quality, "dB"),
        Row(f"{name}: FLIP", flip, "", f"< {MAX_FLIP:g}", flip < MAX_FLIP),
        Row(f"{name}: FLIP by the reference's noise", noise),
        Row(f"{name}: lattice", lattice.ratio, "", f"< {MAX_LATTICE:g}", lattice.ratio < MAX_LATTICE),
        Row(f"{name}: lattice of the reference", other.ratio),
        Row(f"{name}: windows with a lattice", lattice.share, "%"),
        Row(f"{name}: windows with a lattice in the reference", other.share, "%"),
        Row(f"{name}: largest amplitude of the lattice", lattice.amplitude, "grey"),
    ]


def mean_flip(reference: np.ndarray, image: np.ndarray) -> float:
    """Mean FLIP of two images (H, W, 3) with grey levels from 0 to 255, at its default of 67 pixels per degree."""
    return float(flip_map(reference, image).mean())


def flip_map(reference: np.ndarray, image: np.ndarray) -> np.ndarray:
    """FLIP of each pixel (H, W), from 0 to 1.

    Raises:
        SynpickError: The package is missing.
    """
    try:
        import flip_evaluator  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise SynpickError("this report needs the package flip-evaluator; pip install flip-evaluator") from error
    first, second = (np.ascontiguousarray(each, dtype=np.float32) / 255.0 for each in (reference, image))
    return flip_evaluator.evaluate(first, second, "LDR", applyMagma=False, computeMeanError=False)[0].reshape(image.shape[:2])


def measure_lattice(image: np.ndarray, instance: np.ndarray, periods: tuple[int, ...]) -> Lattice:
    """Measure periodic artefacts: power spectra of image windows at the frequencies (i / P, j / P), relative to neighbouring frequencies.

    Windows are several periods P wide, overlap by half (Welch's method), and are tapered by a Hann window; only windows within one surface
    count. Neighbours of a frequency lie two or three bins away, for a frequency on an axis along that axis, since straight edges have most
    of their power there. The ratio over all windows weights each window by the inverse of its neighbours' power; otherwise the few
    windows with strong edges would decide it.

    Args:
        image: Grey levels (H, W, 3).
        instance: Segmentation ids (H, W); windows that show more than the tote or the table alone are left out.
        periods: Periods P [px]; the result is that of the one with the strongest lattice.
    """
    return max((_measure_period(image, instance, period) for period in periods), key=lambda lattice: lattice.ratio)


def _measure_period(image: np.ndarray, instance: np.ndarray, period: int) -> Lattice:
    """Measure the artefacts of one period; see `measure_lattice`."""
    lattice, near = _window_spectra(image, instance, period)
    if not len(lattice):
        return Lattice(0.0, 0.0, 0.0, 0)
    near = near + FLOOR**2
    strong = (lattice > VISIBLE**2) & (lattice > STRONG**2 * near)
    weight = 1.0 / near.mean(axis=1, keepdims=True)
    ratio = float(np.sqrt(((weight * lattice).sum(axis=0) / (weight * near).sum(axis=0)).max()))
    return Lattice(ratio, 100.0 * float(strong.any(axis=1).mean()), float(np.sqrt(lattice.max())), len(lattice))


def _window_spectra(image: np.ndarray, instance: np.ndarray, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared amplitudes (window, frequency) [grey levels²]: at the grid's frequencies, and the mean of their neighbours."""
    periods = max(4, round(WINDOW / period))
    size, half = period * periods, period // 2
    taper = np.outer(*2 * [np.hanning(size + 1)[:size]])
    at = [(i, j) for i in range(half + 1) for j in range(-half, half + 1) if (i or j > 0) and -period < 2 * j]
    near = [_neighbours(i * periods, j * periods, size, periods) for i, j in at]
    rows, columns = (periods * np.array(each) % size for each in zip(*at, strict=True))
    luma = image @ LUMINANCE
    found: list[tuple[np.ndarray, list[float]]] = []
    for top in range(0, luma.shape[0] - size + 1, size // 2):
        for left in range(0, luma.shape[1] - size + 1, size // 2):
            ids = instance[top : top + size, left : left + size]
            if ids[0, 0] in (Segment.TABLE, Segment.TOTE) and (ids == ids[0, 0]).all():
                window = luma[top : top + size, left : left + size]
                # A sinusoid of amplitude a has the spectrum a / 2 times the window's sum at either of its two frequencies.
                flat = taper * (window - (taper * window).sum() / taper.sum())
                power = np.abs(np.fft.fft2(flat) * (2.0 / taper.sum())) ** 2
                found.append((power[rows, columns], [NOISE_RATIO * float(np.exp(np.log(power[each] + 1e-12).mean())) for each in near]))
    first, second = zip(*found, strict=True) if found else ((), ())
    return np.array(first), np.array(second)


def _neighbours(row: int, column: int, size: int, periods: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns of the spectral bins that a bin (row, column) is compared with; none lies beside a bin of the grid's frequencies."""
    steps = [(i, j) for i in range(-3, 4) for j in range(-3, 4) if max(abs(i), abs(j)) >= 2]
    if row == 0 or column == 0:
        steps = [(i, j) for i, j in steps if (i == 0 if row == 0 else j == 0)]
    bins = [(row + i, column + j) for i, j in steps]
    bins = [(r, c) for r, c in bins if min(r % periods, -r % periods) + min(c % periods, -c % periods) >= 2]
    bins = [(r, c) for r, c in bins if row == 0 or column == 0 or (abs(r % size) >= 2 and abs(c % size) >= 2)]
    return np.array([r % size for r, _ in bins]), np.array([c % size for _, c in bins])


def write_crops(pair: Pair, folder: Path, name: str, at: tuple[int, int] | None) -> None:
    """Write a crop of the denoised frame beside the reference: the region with the largest FLIP, or around pixel `at` (column, row)."""
    second = pair.second or pair.reference
    mean = 0.5 * (pair.reference.color.astype(np.float32) + second.color)
    height, width = mean.shape[:2]
    down, across = min(CROP, height), min(CROP, width)
    if at is None:
        sums = np.pad(flip_map(mean, pair.denoised.color).cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        boxes = sums[down:, across:] - sums[:-down, across:] - sums[down:, :-across] + sums[:-down, :-across]
        top, left = (int(index) for index in np.unravel_index(boxes.argmax(), boxes.shape))
    else:
        top, left = (
            max(0, min(middle - size // 2, limit - size))
            for middle, size, limit in zip(at[::-1], (down, across), (height, width), strict=True)
        )
    parts = [each[top : top + down, left : left + across] for each in (pair.denoised.color, np.rint(mean).astype(np.uint8))]
    write_picture(folder / f"{name}_{left}_{top}.png", np.concatenate(parts, axis=1)[..., ::-1])


if __name__ == "__main__":
    sys.exit(main())
