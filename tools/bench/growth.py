"""Scaling benchmark: physics time of a tick and rendering time of a view against worlds, objects, resolution, paths and cameras.

One factor varies at a time, and the others stay as set. Physics is that of piles DROP_TICKS ticks after the drop, without gripper; the
pictures show these piles.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from synpick_warp.configs.schema import Arrangement, Bake, Cameras, Config, Render
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.stages.buffers import Snapshot, ViewBuffers, allocate
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import view_sizes
from synpick_warp.system.device import pick_device
from tools.bench.physics import BURST, FOREVER, seconds_per_call
from tools.options import Row

DROP_TICKS = 24
"""Ticks from the drop to the measurement: 1.6 s, in which nearly all objects land."""
FRACTIONS = {"worlds": (0.125, 0.25, 0.5), "objects": (0.25, 0.5), "resolution": (1 / 3, 2 / 3), "cameras": (1 / 3, 2.0)}
"""Values of each factor, as multiples of the settings' own: worlds, volume of the objects, image width and height, cameras."""
PATHS = (1, 2, 4)
"""Paths per coarse pixel."""
Variation = tuple[str, dict[str, object]]
"""Value of a factor as a text, and the settings that differ."""


@dataclass(frozen=True)
class Pile:
    """Worlds after the drop."""

    snapshot: Snapshot
    objects: float
    """Mean objects of a world."""
    seconds: float
    """Physics of a tick [s]."""


@dataclass(frozen=True, eq=False)
class Variant:
    """Measurements of worlds with some settings."""

    config: Config
    catalog: Catalog
    lights: tuple[EnvironmentMap, ...]
    device: wp.Device
    min_seconds: float

    @property
    def steps(self) -> int:
        """Steps of all worlds in a tick."""
        return self.config.physics.steps_per_tick * self.config.bake.worlds

    def build_scene(self) -> RenderScene:
        """Renderer's scene."""
        config = self.config
        fixtures, cameras = make_fixtures(config.tote, config.gripper), make_cameras(config.cameras)
        return build_render_scene(config.render, config.tote, self.catalog, fixtures, cameras, self.lights, self.device)

    def drop(self, scene: RenderScene) -> Pile:
        """Drop piles and time ticks of their physics."""
        worlds = range(self.config.bake.worlds)
        simulation = Simulation(self.config, self.catalog, len(self.lights), self.device, scene, worlds)
        simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
        tick = simulation.tick
        for _ in range(DROP_TICKS):
            tick()
        seconds = seconds_per_call(tick, self.device, self.min_seconds, BURST)
        snapshot = simulation.record.snapshot
        return Pile(snapshot, float((snapshot.catalog_index.numpy() >= 0).sum(axis=1).mean()), seconds)

    def time_view(self, scene: RenderScene, pile: Pile) -> float:
        """Time of a view [s], in full batches."""
        config, device, worlds = self.config, self.device, self.config.bake.worlds
        cameras, objects = len(config.cameras.positions), config.arrangement.max_objects
        sizes = view_sizes(config.render, config.cameras, worlds, objects, device)
        count = min(sizes["view"], worlds * cameras)
        renderer = make_renderer(config, scene, objects, sizes["view"], worlds * cameras)
        images, views = allocate(ViewBuffers, sizes, device), first_views(count, cameras, objects, device)
        return seconds_per_call(lambda: renderer.render(pile.snapshot, views, images), device, self.min_seconds, BURST) / count


def vary_worlds(bake: Bake, factor: float) -> Variation:
    """Other number of worlds."""
    least = MIN_GPU_WORLDS if pick_device(bake.device).is_cuda else 1
    worlds = max(least, round(factor * bake.worlds))
    return str(worlds), {"bake.worlds": worlds}


def vary_objects(arrangement: Arrangement, factor: float) -> Variation:
    """Other volume of the objects."""
    volume = factor * arrangement.volume
    return f"{1e3 * volume:.3g} l", {"arrangement.volume": volume}


def vary_resolution(cameras: Cameras, factor: float) -> Variation:
    """Other image size of the same shape."""
    width, height = (max(1, round(factor * size)) for size in cameras.resolution)
    return f"{width}x{height}", {"cameras.resolution": (width, height)}


def vary_paths(_: Render, paths: float) -> Variation:
    """Other number of paths per coarse pixel."""
    return str(int(paths)), {"render.coarse_paths": int(paths)}


def vary_cameras(cameras: Cameras, factor: float) -> Variation:
    """Other number of cameras: the first ones, or all, and then these turned by 180° about the vertical."""
    count = max(1, round(factor * len(cameras.positions)))
    return str(count), {f"cameras.{name}": _turn(cameras, name, count) for name in ("positions", "ups")}


def _turn(cameras: Cameras, name: str, count: int) -> tuple[tuple[float, float, float], ...]:
    vectors = getattr(cameras, name)
    repeats = math.ceil(count / len(vectors))
    return tuple(((-1) ** turn * x, (-1) ** turn * y, z) for turn in range(repeats) for x, y, z in vectors)[:count]


VARIATIONS: dict[str, tuple[str, Callable[[Any, float], Variation]]] = {
    "worlds": ("bake", vary_worlds),
    "objects": ("arrangement", vary_objects),
    "resolution": ("cameras", vary_resolution),
    "paths": ("render", vary_paths),
    "cameras": ("cameras", vary_cameras),
}
"""Section of the settings that a factor changes, and its variation."""


def measure_growth(config: Config, min_seconds: float) -> Iterator[Row]:
    """Measure the settings themselves, then each factor's values; a measurement is repeated for at least `min_seconds` [s]."""
    started = time.perf_counter()
    own = Variant(config, load_catalog(config), load_lights(config.bake.lights), pick_device(config.bake.device), min_seconds)
    scene = own.build_scene()
    pile = own.drop(scene)
    yield from _rows("as set", own.steps, pile, own.time_view(scene, pile))
    for factor, (section, vary) in VARIATIONS.items():
        for value, values in dict(vary(getattr(config, section), multiple) for multiple in FRACTIONS.get(factor, PATHS)).items():
            varied = replace(own, config=config.with_values(values))
            other = varied.build_scene() if factor in ("resolution", "cameras") else scene
            dropped = varied.drop(scene) if factor in ("worlds", "objects") else None
            view = varied.time_view(other, dropped or pile)
            yield from _rows(f"{factor} {value}", varied.steps, dropped, view)
    yield Row("all measurements", time.perf_counter() - started, "s")


def _rows(name: str, steps: int, pile: Pile | None, view: float) -> Iterator[Row]:
    """Rows of a point: of piles that were dropped for it, and of a view that takes `view` [s]."""
    if pile is not None:
        yield Row(f"{name}: objects a tote", pile.objects)
        yield Row(f"{name}: physics of a tick", 1e3 * pile.seconds, "ms")
        yield Row(f"{name}: world-steps", steps / pile.seconds, "1/s")
    yield Row(f"{name}: a view", 1e3 * view, "ms")
