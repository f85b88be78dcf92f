"""What tools/reports/render.py measures of settled piles: the fast picture beside the reference, and successive frames."""

from __future__ import annotations

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
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from tools.options import Row
from tools.reports.render_checks import Shot, Studio, bounded, with_mode

LEAST_PSNR = 32.0
"""Fast against reference, mean over scenes [dB]."""
MOST_BIAS = 1.0
"""Of the fast picture's mean radiance [%]."""
BIAS_DRAWS = 8
"""Of random numbers, over which a fast picture's mean radiance is averaged: one draw is off by half a percent."""
MOST_FLICKER = 1.0
"""Mean difference of two successive frames of a still scene [grey levels]."""
CREEP = 1e-4
"""How far objects move between two frames in which hardly anything happens [m]."""
MOST_TICKS = 400
"""Ticks within which all piles must rest; 27 s."""


@dataclass(frozen=True, eq=False)
class Pair:
    """One pile under one light map in both modes."""

    light: str
    fast: Shot
    reference: Shot
    mean: float
    """Of the fast picture's radiance, over several draws of its random numbers."""

    @property
    def quality(self) -> float:
        """Peak signal to noise of the fast picture against the reference [dB]."""
        return psnr(self.fast.color, self.reference.color)

    @property
    def bias(self) -> float:
        """Of the fast picture's mean radiance [%]."""
        return 100.0 * (self.mean / float(self.reference.radiance.mean()) - 1.0)


def compare_piles(
    config: Config, every_light: bool, noise: bool, device: Any, report: Callable[[str], None]
) -> tuple[list[Row], list[Pair]]:
    """The fast picture of settled piles against the reference, camera 0.

    Args:
        config: All settings; one pile a world, seen under the next light map.
        every_light: Go on with the first piles until all maps have been seen.
        noise: Render a second reference that differs in its random numbers alone.
        device: Where to render.
        report: Takes lines about objects.
    """
    catalog = load_catalog(config, report=report)
    lights = load_lights(config.bake.lights)
    snapshot = settled(config, catalog, len(lights), device)
    cameras = make_cameras(config.cameras)[:1]
    kinds = [with_mode(config, FAST), with_mode(config, REFERENCE)]
    if noise:
        kinds.append(with_mode(config, REFERENCE, seed=config.bake.seed + 1))
    fast, reference, *other = (Studio(kind, catalog, cameras, lights, device) for kind in kinds)
    piles = config.bake.worlds
    rows, pairs, still, moved = [], [], [], []
    for number in range(max(piles, len(lights)) if every_light else piles):
        world, light = number % piles, number % len(lights)
        snapshot.light.fill_(light)
        shots = fast.shoot(snapshot, world, 0), reference.shoot(snapshot, world, 0)
        pair = Pair(lights[light].name, *shots, mean_radiance(fast, snapshot, world))
        pairs.append(pair)
        name = f"scene {world}, {pair.light}"
        noises = [psnr(pair.reference.color, studio.shoot(snapshot, world, 0).color) for studio in other]
        rows += [
            Row(f"{name}: fast against reference", pair.quality, "dB"),
            *(Row(f"{name}: reference against itself", value, "dB") for value in noises),
            Row(f"{name}: bias of mean radiance", pair.bias, "%"),
        ]
        if number < piles:
            for found, shift in ((still, 0.0), (moved, CREEP)):
                found.append(difference(pair.fast, fast.shoot(following(snapshot, shift), world, 0)))
    return rows + _summary(config, pairs, still, moved), pairs


def mean_radiance(studio: Studio, snapshot: Snapshot, world: int) -> float:
    """Of a world's pictures by camera 0, whose random numbers follow from the episode's number."""
    # The host's view of an array of the CPU is the array.
    episode = snapshot.episode.numpy().copy()
    means = []
    for draw in range(BIAS_DRAWS):
        snapshot.episode.assign(episode + draw)
        means.append(float(studio.shoot(snapshot, world, 0).radiance.mean()))
    snapshot.episode.assign(episode)
    return float(np.mean(means))


def _summary(config: Config, pairs: list[Pair], still: list[float], moved: list[float]) -> list[Row]:
    """Means over all pairs, and differences of frames over all piles [grey levels]."""
    width, height = config.cameras.resolution
    seconds = float(np.median([pair.reference.seconds for pair in pairs]))
    mean = float(np.mean([pair.quality for pair in pairs]))
    return [
        Row("fast against reference, mean", mean, "dB", f">= {LEAST_PSNR:g}", mean >= LEAST_PSNR),
        Row("fast against reference, least", min(pair.quality for pair in pairs), "dB"),
        bounded("bias of mean radiance, mean", float(np.mean([pair.bias for pair in pairs])), "%", MOST_BIAS),
        bounded("bias of mean radiance, largest", max((pair.bias for pair in pairs), key=abs), "%", MOST_BIAS),
        bounded("fast: frames of a still scene, mean difference", float(np.mean(still)), "grey", MOST_FLICKER),
        Row(f"fast: the same, objects moved by {1e3 * CREEP:g} mm", float(np.mean(moved)), "grey"),
        Row("reference: a picture", seconds, "s"),
        Row("reference: paths", 1e-6 * width * height * config.render.samples / seconds, "million/s"),
    ]


def following(snapshot: Snapshot, shift: float) -> Snapshot:
    """The frame after a snapshot: time went on, and objects moved by `shift` [m] along +x; nothing else did."""
    arrays = {item.name: getattr(snapshot, item.name).numpy().copy() for item in fields(Snapshot)}
    for name in ("entry", "pose", "fixture_pose", "fixture_visible"):
        arrays[f"last_{name}"] = arrays[name].copy()
    arrays["follows"][:] = 1
    arrays["frame"] += 1
    arrays["pose"][..., 0] += shift
    kinds = {name: getattr(snapshot, name) for name in arrays}
    return Snapshot(**{name: wp.array(array, dtype=kinds[name].dtype, device=kinds[name].device) for name, array in arrays.items()})


def difference(a: Shot, b: Shot) -> float:
    """Mean absolute difference of two pictures [grey levels]."""
    return float(np.abs(a.color.astype(np.int16) - b.color).mean())


def settled(config: Config, catalog: Catalog, lights: int, device: Any) -> Snapshot:
    """Piles at rest, one a world, in the tick in which each begins to act; world w has light map w, w + lights, ...

    Raises:
        SynpickError: One does not come to rest.
    """
    wanted = config.bake.worlds
    config = with_enough_worlds(config, device)
    simulation = Simulation(config, catalog, lights, device)
    record = simulation.records[0]
    piles: dict[int, dict[str, np.ndarray]] = {}
    for _ in range(MOST_TICKS):
        simulation.tick(record)
        host = {item.name: getattr(record.snapshot, item.name).numpy() for item in fields(Snapshot)}
        for world in np.flatnonzero(simulation.state.phase.numpy() == Phase.ACT):
            piles.setdefault(int(world), {name: array[world].copy() for name, array in host.items()})
        if len(piles) == wanted:
            break
    else:
        raise SynpickError(f"only {len(piles)} of {wanted} piles came to rest within {MOST_TICKS} ticks; give another seed")
    for item in fields(Snapshot):
        rows = getattr(record.snapshot, item.name).numpy().copy()
        for world, pile in piles.items():
            rows[world] = pile[item.name]
        getattr(record.snapshot, item.name).assign(rows)
    record.snapshot.light.assign(np.arange(config.bake.worlds, dtype=np.int32) % lights)
    return record.snapshot


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise of two 8-bit pictures [dB]."""
    error = float(((a.astype(np.float64) - b) ** 2).mean())
    return 10.0 * float(np.log10(255.0**2 / max(error, 1e-9)))
