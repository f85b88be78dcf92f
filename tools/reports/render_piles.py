"""Image quality of settled piles: PSNR and bias of the denoised image against the path-traced reference, and flicker between frames."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.errors import SynpickError
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import load_lights
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from tools.options import Row
from tools.reports.render_checks import Shot, Studio, bounded_row, make_studio

MIN_PSNR = 32.0
"""Bound of the mean PSNR of denoised images against references [dB]."""
MAX_BIAS = 1.0
"""Bound of the bias of the denoised image's mean radiance [%]."""
BIAS_SAMPLES = 8
"""Seeds over which a denoised image's mean radiance is averaged: one seed deviates by half a percent."""
MAX_FLICKER = 1.0
"""Bound of the mean difference of two successive frames of a static scene [grey levels]."""
CREEP = 1e-4
"""Displacement of objects between two almost equal frames [m]."""
MAX_TICKS = 400
"""Ticks within which all piles must come to rest: 27 s."""


@dataclass(frozen=True, eq=False)
class Pair:
    """Denoised image and reference of one pile under one light map, mean radiance over seeds, and a second reference (None: none)."""

    light: str
    denoised: Shot
    reference: Shot
    mean: float
    """Mean radiance of the denoised image over `BIAS_SAMPLES` seeds."""
    second: Shot | None = None
    """Independent reference of the same view; with it, `quality` is free of the references' noise."""

    @property
    def quality(self) -> float:
        """PSNR of the denoised image against the reference [dB].

        With a second reference the squared error is estimated by the product of the two differences, whose expectation has no noise.
        """
        second = self.second or self.reference
        first, other = (shot.color.astype(np.float64) - self.denoised.color for shot in (self.reference, second))
        return peak_ratio(float((first * other).mean()))

    @property
    def bias(self) -> float:
        """Relative bias of the denoised image's mean radiance [%]."""
        references = [self.reference, *([self.second] if self.second else [])]
        return 100.0 * (self.mean / float(np.mean([shot.radiance.mean() for shot in references])) - 1.0)


def compare_piles(
    config: Config, every_light: bool, noise: bool, device: Any, report: Callable[[str], None]
) -> tuple[list[Row], list[Pair]]:
    """Render settled piles by camera 0 in both modes and compare them; returns rows and image pairs.

    Args:
        config: All settings; one pile a world, each under the next light map.
        every_light: Reuse piles until every light map has been rendered.
        noise: Render a second reference with another seed, to measure the reference's noise.
        device: Where to render.
        report: Receives messages about objects.
    """
    catalog = load_catalog(config, report=report)
    lights = load_lights(config.bake.lights)
    snapshot = settle_piles(Simulation(with_enough_worlds(config, device), catalog, len(lights), device), config.bake.worlds)
    cameras = make_cameras(config.rig)[:1]
    values: list[dict[str, object]] = [{"render.mode": FAST}, {"render.mode": REFERENCE}]
    if noise:
        values.append({"render.mode": REFERENCE, "bake.seed": config.bake.seed + 1})
    denoised, reference, *second = (make_studio(config.with_values(each), catalog, cameras, lights, device) for each in values)
    piles = config.bake.worlds
    rows, pairs, static, displaced = [], [], [], []
    for index in range(max(piles, len(lights)) if every_light else piles):
        world, light = index % piles, index % len(lights)
        snapshot.light.fill_(light)
        shots = denoised.render(snapshot, world, 0), reference.render(snapshot, world, 0)
        pair = Pair(lights[light].name, *shots, mean_radiance(denoised, snapshot, world))
        pairs.append(pair)
        name = f"scene {world}, {pair.light}"
        noises = [psnr(pair.reference.color, studio.render(snapshot, world, 0).color) for studio in second]
        rows += [
            Row(f"{name}: denoised against reference", pair.quality, "dB"),
            *(Row(f"{name}: reference against itself", value, "dB") for value in noises),
            Row(f"{name}: bias of mean radiance", pair.bias, "%"),
        ]
        if index < piles:
            for differences, displacement in ((static, 0.0), (displaced, CREEP)):
                frame = denoised.render(next_frame(snapshot, displacement), world, 0)
                differences.append(mean_difference(pair.denoised, frame))
    return rows + _summarize(math.prod(config.cameras.resolution) * config.render.samples, pairs, static, displaced), pairs


def mean_radiance(studio: Studio, snapshot: Snapshot, world: int) -> float:
    """Mean radiance of a world by camera 0 over `BIAS_SAMPLES` seeds; the episode index seeds the renderer."""
    # numpy() of an array on the CPU shares its memory, so it is copied.
    episode = snapshot.episode.numpy().copy()
    means = []
    for offset in range(BIAS_SAMPLES):
        snapshot.episode.assign(episode + offset)
        means.append(float(studio.render(snapshot, world, 0).radiance.mean()))
    snapshot.episode.assign(episode)
    return float(np.mean(means))


def _summarize(paths: int, pairs: list[Pair], static: list[float], displaced: list[float]) -> list[Row]:
    """Rows over all pairs, whose references have `paths` paths, and over the frame differences `static` and `displaced` [grey levels]."""
    seconds = float(np.median([pair.reference.seconds for pair in pairs]))
    return [
        *summarize_pairs(pairs, MIN_PSNR),
        bounded_row("bias of mean radiance, largest", max((pair.bias for pair in pairs), key=abs), "%", MAX_BIAS),
        bounded_row("denoised: frames of a static scene, mean difference", float(np.mean(static)), "grey", MAX_FLICKER),
        Row(f"denoised: the same, objects displaced by {1e3 * CREEP:g} mm", float(np.mean(displaced)), "grey"),
        Row("reference: time per image", seconds, "s"),
        Row("reference: paths", 1e-6 * paths / seconds, "million/s"),
    ]


def summarize_pairs(pairs: list[Pair], bound: float) -> list[Row]:
    """Rows of the quality of all pairs, whose mean PSNR must reach `bound` [dB], and of their mean bias."""
    mean = float(np.mean([pair.quality for pair in pairs]))
    return [
        Row("denoised against reference, mean", mean, "dB", f">= {bound:g}", mean >= bound),
        Row("denoised against reference, min", min(pair.quality for pair in pairs), "dB"),
        bounded_row("bias of mean radiance, mean", float(np.mean([pair.bias for pair in pairs])), "%", MAX_BIAS),
    ]


def next_frame(snapshot: Snapshot, displacement: float) -> Snapshot:
    """Snapshot of the next frame: a copy with objects displaced along +x by `displacement` [m], and the given one as last frame."""
    arrays = {item.name: getattr(snapshot, item.name).numpy().copy() for item in fields(Snapshot)}
    for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible"):
        arrays[f"last_{name}"] = arrays[name].copy()
    arrays["follows"][:] = 1
    arrays["frame"] += 1
    arrays["pose"][..., 0] += displacement
    sources = {name: getattr(snapshot, name) for name in arrays}
    return Snapshot(**{name: wp.array(array, dtype=sources[name].dtype, device=sources[name].device) for name, array in arrays.items()})


def mean_difference(a: Shot, b: Shot) -> float:
    """Mean absolute difference of two images [grey levels]."""
    return float(np.abs(a.color.astype(np.int16) - b.color).mean())


def settle_piles(simulation: Simulation, count: int) -> Snapshot:
    """Simulate `count` piles until rest, one a world; returns each in the tick in which it begins to act. World w has light map w % their
    number.

    Raises:
        SynpickError: A pile does not come to rest.
    """
    record = simulation.record
    piles: dict[int, dict[str, np.ndarray]] = {}
    for _ in range(MAX_TICKS):
        simulation.tick()
        host = {item.name: getattr(record.snapshot, item.name).numpy() for item in fields(Snapshot)}
        for world in np.flatnonzero(simulation.state.phase.numpy() == Phase.ACT):
            piles.setdefault(int(world), {name: array[world].copy() for name, array in host.items()})
        if len(piles) == count:
            break
    else:
        raise SynpickError(f"only {len(piles)} of {count} piles came to rest within {MAX_TICKS} ticks; choose another seed")
    for item in fields(Snapshot):
        rows = getattr(record.snapshot, item.name).numpy().copy()
        for world, pile in piles.items():
            rows[world] = pile[item.name]
        getattr(record.snapshot, item.name).assign(rows)
    record.snapshot.light.assign(np.arange(simulation.layout.worlds, dtype=np.int32) % simulation.scene.drop.lights)
    return record.snapshot


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio (PSNR) of two 8-bit images [dB]."""
    return peak_ratio(float(((a.astype(np.float64) - b) ** 2).mean()))


def peak_ratio(error: float) -> float:
    """PSNR of a mean squared error of 8-bit images [dB]."""
    return 10.0 * float(np.log10(255.0**2 / max(error, 1e-9)))
