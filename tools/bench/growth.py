"""Scaling benchmark: physics time of a tick and rendering time of a view against worlds, objects, resolution, paths and cameras.

One factor varies at a time, and the others stay as set. Physics is that of piles DROP_TICKS ticks after the drop, without gripper; the
pictures show these piles.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import warp as wp

from synpick_warp.configs.schema import Cameras, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.stages.buffers import Snapshot, ViewBuffers, allocate
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.view_ring import view_sizes
from synpick_warp.system.hardware.device import pick_device
from tools.bench.instances import DROP_TICKS, measure_instances
from tools.bench.physics import BURST, FOREVER, seconds_per_call
from tools.options import Row

FACTORS = {"worlds": (0.125, 0.25, 0.5), "objects": (0.25, 0.5), "resolution": (1 / 3, 2 / 3), "paths": (1, 2, 4), "cameras": (1 / 3, 2.0)}
"""Values of each factor: paths per coarse pixel, and multiples of the settings' own worlds, volume of the objects, image width and height,
cameras."""


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
        fixtures, cameras = make_fixtures(make_bins(config.cell.bins), config.gripper), make_cameras(config.rig)
        return build_render_scene(config.render, -config.tote.wall, self.catalog, fixtures, cameras, self.lights, self.device)

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
        cameras, objects = len(config.rig), config.arrangement.max_objects
        sizes = view_sizes(config.render, config.rig, worlds, objects, device)
        count = min(sizes["view"], worlds * cameras)
        renderer = make_renderer(config, scene, objects, sizes["view"], worlds * cameras)
        images, views = allocate(ViewBuffers, sizes, device), first_views(count, cameras, objects, device)
        return seconds_per_call(lambda: renderer.render(pile.snapshot, views, images), device, self.min_seconds, BURST) / count


def vary(config: Config, factor: str, value: float) -> tuple[str, Config]:
    """The settings with one factor changed, and its new value in words; `value` is a multiple of the old one, or the number of paths.

    More cameras than there are are these again, turned by 180° about the vertical.
    """
    if factor == "worlds":
        worlds = max(1, round(value * config.bake.worlds))
        config = with_enough_worlds(config.with_values({"bake.worlds": worlds}), pick_device(config.bake.device))
        return str(config.bake.worlds), config
    if factor == "objects":
        volume = value * config.arrangement.volume
        return f"{1e3 * volume:.3g} l", config.with_values({"arrangement.volume": volume})
    if factor == "resolution":
        width, height = (max(1, round(value * size)) for size in config.cameras.resolution)
        return f"{width}x{height}", config.with_values({"cameras.resolution": (width, height)})
    if factor == "paths":
        return str(int(value)), config.with_values({"render.coarse_paths": int(value)})
    cameras = config.cameras
    count = max(1, round(value * len(cameras.positions)))
    return str(count), replace(config, cameras=replace(cameras, **{name: _turn(cameras, name, count) for name in ("positions", "ups")}))


def _turn(cameras: Cameras, name: str, count: int) -> tuple[tuple[float, float, float], ...]:
    vectors = getattr(cameras, name)
    repeats = math.ceil(count / len(vectors))
    return tuple(((-1) ** turn * x, (-1) ** turn * y, z) for turn in range(repeats) for x, y, z in vectors)[:count]


def measure_growth(config: Config, min_seconds: float, instances: Sequence[int] = ()) -> Iterator[Row]:
    """Measure the settings themselves, then each factor's values, or physics alone of `instances` like parts; a measurement is repeated for
    at least `min_seconds` [s]."""
    if instances:
        yield from measure_instances(config, instances, min_seconds)
        return
    started = time.perf_counter()
    own = Variant(config, load_catalog(config), load_lights(config.bake.lights), pick_device(config.bake.device), min_seconds)
    scene = own.build_scene()
    pile = own.drop(scene)
    yield from _rows("as set", own.steps, pile, own.time_view(scene, pile))
    for factor, values in FACTORS.items():
        for value, changed in dict(vary(config, factor, each) for each in values).items():
            varied = replace(own, config=changed)
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
