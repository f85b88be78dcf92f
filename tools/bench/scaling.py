"""Benchmarks that vary one setting: scaling with the number of worlds, objects, pixels or equal workpieces; perception of heaps of many
instances; physics with and without our replacements of Newton's components.

For scaling, physics is timed from DROP_TICKS ticks after the objects are dropped, without gripper; rendering is timed on these piles.
"""

import contextlib
import math
import resource
import time
from collections.abc import Generator, Iterator
from dataclasses import dataclass, replace
from typing import Any
from unittest import mock

import newton
import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.configs.episodes.objects import Counts
from synpick_warp.configs.schema import LAYERED, Cameras, Config
from synpick_warp.factory.assembly import fit_to_catalog, make_renderer
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.build import build_model, find_drawn
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog, EnvironmentMap
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers
from synpick_warp.stages.constants import make_scene_data
from synpick_warp.stages.perception.perceive import Perception
from synpick_warp.stages.render.scene import RenderScene, build_render_scene
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation, allocate_worlds
from synpick_warp.stages.sim.worlds import world_sizes
from synpick_warp.stages.view_ring import view_sizes
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.bench.run import FOREVER, Bench
from tools.bench.worlds import measure_perception
from tools.options import MeasuredRow

FACTORS = {"worlds": (0.125, 0.25, 0.5), "objects": (0.25, 0.5), "resolution": (1 / 3, 2 / 3), "paths": (1, 2, 4), "cameras": (1 / 3, 2.0)}
"""Values of each factor: paths per coarse pixel, and multiples of the settings' own worlds, volume of the objects, image width and height,
cameras."""
DROP_TICKS, REST_TICKS = 24, 36
"""Ticks from the drop to the first measurement (1.6 s: nearly all objects have landed), and from its end to the second (2.4 s: objects
should be at rest, which is not checked)."""
PART = "bracket"
"""Workpiece whose piles are measured if the settings have no counts."""
INSTANCES = (10, 32, 64, 128, 251)
"""Numbers of instances of a heap; the last is the largest that segmentation ids have room for."""
HEAP_WORLDS = 64
"""Most worlds of a heap."""
SMALL, DENSITY, MAX_HEIGHT = 4, 0.5, 0.4
"""Heap: it takes the smallest 1 / SMALL of the catalog's objects, so that many are visible. DENSITY is their volume over that of the box in
which they are placed; the box is at most MAX_HEIGHT high [m], and then denser."""
WARM_UP_TICKS, TICKS = 8, 80
"""Ticks before a measurement of replacements, in which kernels are loaded and graphs captured; and ticks measured, 5 s of an episode."""
NEWTONS_OWN = {
    "the fused solver": ("choose_solver", lambda device: newton.solvers.SolverSteel),
    "the separating broad phase": ("replace_broad_phase", lambda pipeline: None),
    "the launch sizes of the narrow phase": ("resize_blocks", lambda pipeline: None),
}
"""Replacement -> function of `stages.sim.physics` that installs it, and one to put in its place, which keeps Newton's own component."""


# ---- growth ----


@dataclass(frozen=True, eq=False)
class Variant:
    """One configuration to measure: settings of a run of the benchmark, catalog and lights."""

    bench: Bench
    catalog: Catalog
    lights: tuple[EnvironmentMap, ...] = ()

    @property
    def config(self) -> Config:
        """Settings."""
        return self.bench.config

    @property
    def steps(self) -> int:
        """Physics steps in a tick, over all worlds."""
        return self.config.physics.steps_per_tick * self.config.bake.worlds

    def build_scene(self) -> RenderScene:
        """Renderer's scene."""
        config = self.config
        fixtures, cameras = make_fixtures(make_bins(config.cell.bins), config.gripper), make_cameras(config.rig)
        return build_render_scene(config.render, -config.tote.wall, self.catalog, fixtures, cameras, self.lights, self.bench.device)

    def make_simulation(self, scene: RenderScene | None) -> Simulation:
        """Simulation whose piles never count as settled, so that episodes do not go on to their next phase."""
        lights, worlds = max(1, len(self.lights)), range(self.config.bake.worlds)
        simulation = Simulation(self.config, self.catalog, lights, self.bench.device, scene, worlds)
        simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
        return simulation

    def time_ticks(self, simulation: Simulation, lead: int) -> float:
        """Time of a tick's physics [s], after `lead` ticks."""
        for _ in range(lead):
            simulation.tick()
        return self.bench.seconds_per_call(simulation.tick)

    def time_view(self, scene: RenderScene, snapshot: Snapshot) -> float:
        """Time of a view [s], in full batches."""
        config, device, worlds = self.config, self.bench.device, self.config.bake.worlds
        cameras, objects = len(config.rig), config.arrangement.max_objects
        sizes = view_sizes(config.render, config.rig, worlds, objects, device)
        count = min(sizes["view"], worlds * cameras)
        renderer = make_renderer(config, scene, objects, sizes["view"], worlds * cameras)
        images, views = allocate(ViewBuffers, sizes, device), first_views(count, cameras, objects, device)
        return self.bench.seconds_per_call(lambda: renderer.render(snapshot, views, images)) / count


def vary(config: Config, factor: str, value: float) -> tuple[str, Config]:
    """Settings with one factor changed, and its new value in words; `value` is a multiple of the old one, or the number of paths.

    If there are to be more cameras, those of the settings are repeated, every other round turned by 180° about the vertical.
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
    """The cameras' vectors `name`, repeated up to `count`, every other round turned by 180° about z."""
    vectors = getattr(cameras, name)
    repeats = math.ceil(count / len(vectors))
    return tuple(((-1) ** turn * x, (-1) ** turn * y, z) for turn in range(repeats) for x, y, z in vectors)[:count]


def measure_growth(bench: Bench) -> Iterator[MeasuredRow]:
    """Measure the settings themselves, then each factor's values; or, with `bench.instances`, physics alone of equal workpieces."""
    started = time.perf_counter()
    yield from _measure_instances(bench) if bench.instances else _measure_factors(bench)
    yield MeasuredRow("all measurements", time.perf_counter() - started, "s")


def _measure_factors(bench: Bench) -> Iterator[MeasuredRow]:
    """Rows of the settings themselves, and of each value of each factor."""
    own = Variant(bench, load_catalog(bench.config), load_lights(bench.config.bake.lights))
    scene = own.build_scene()
    piles = yield from _measure_point("as set", own, scene)
    for factor, values in FACTORS.items():
        for value, changed in dict(vary(bench.config, factor, each) for each in values).items():
            varied = replace(own, bench=replace(bench, config=changed))
            shown = varied.build_scene() if factor in ("resolution", "cameras") else scene
            yield from _measure_point(f"{factor} {value}", varied, shown, None if factor in ("worlds", "objects") else piles)


def _measure_point(
    name: str, variant: Variant, scene: RenderScene, piles: Snapshot | None = None
) -> Generator[MeasuredRow, None, Snapshot]:
    """Rows of one measured setting: time of a view of `piles`, which it returns; None: drop them first, with rows of physics."""
    if piles is None:
        simulation = variant.make_simulation(scene)
        seconds = variant.time_ticks(simulation, DROP_TICKS)
        dropped: Snapshot = simulation.record.snapshot
        piles = dropped
        yield MeasuredRow(f"{name}: objects a tote", float((dropped.catalog_index.numpy() >= 0).sum(axis=1).mean()))
        yield MeasuredRow(f"{name}: physics of a tick", 1e3 * seconds, "ms")
        yield MeasuredRow(f"{name}: world-steps", variant.steps / seconds, "1/s")
    yield MeasuredRow(f"{name}: a view", 1e3 * variant.time_view(scene, piles), "ms")
    return piles


# ---- growth by instances ----


def number_settings(counts: Counts, number: int) -> dict[str, Any]:
    """Settings by which `number` copies of one workpiece are dropped, in layers: of the one with the largest number in `counts`."""
    part = max(counts or ((PART, 1, 1),), key=lambda row: row[2])[0]
    fill = {"arrangement.counts": ((part, number, number),), "arrangement.max_objects": number, "arrangement.drop": LAYERED}
    return {"bake.mode": "move"} | fill | ({} if counts else {"objects.embedded": ("industrial",)})


def _measure_instances(bench: Bench) -> Iterator[MeasuredRow]:
    """Time of a tick, contacts and memory of piles of equal workpieces in one bin, DROP_TICKS after the drop and REST_TICKS later. Raises
    ConfigError: a number does not fit into the bin, or into the device's memory."""
    config, device = bench.config, bench.device
    varied = [config.with_values(number_settings(config.arrangement.counts, number)) for number in bench.instances]
    catalog, bins = load_catalog(max(varied, key=lambda each: each.arrangement.max_objects)), make_bins(config.cell.bins)
    for fitted in [fit_to_catalog(each, catalog, bins, device, SilentProgress()) for each in varied]:
        yield from _measure_equal_parts(Variant(replace(bench, config=fitted), catalog))


def _measure_equal_parts(variant: Variant) -> Iterator[MeasuredRow]:
    """Rows of landing and of resting workpieces, of contacts, of overlapping bounding boxes (broad phase) and of memory."""
    config, device = variant.config, variant.bench.device
    worlds, before = config.bake.worlds, _memory_in_use(device)
    simulation, name = variant.make_simulation(None), f"{config.arrangement.max_objects} instances"
    for state, ticks in (("landing", DROP_TICKS), ("at rest", REST_TICKS)):
        seconds = variant.time_ticks(simulation, ticks)
        yield MeasuredRow(f"{name}, {state}: physics of a tick", 1e3 * seconds, "ms")
        yield MeasuredRow(f"{name}, {state}: world-steps", variant.steps / seconds, "1/s")
        yield MeasuredRow(f"{name}, {state}: part-steps", variant.steps * config.arrangement.max_objects / seconds, "1/s")
    own = simulation.physics
    for what, array in (("contacts", own.contacts.rigid_contact_count), ("overlaps", own.overlap_count)):
        yield MeasuredRow(f"{name}: {what} a world", int(array.numpy()[0]) / worlds)
    overflow = own.solver.constraint_overflow.numpy()[:-1]  # The last entry is that of bodies outside of all worlds.
    yield MeasuredRow(f"{name}: worlds without overflow", 100.0 * float(np.mean(~overflow)), "%")
    yield MeasuredRow(f"{name}: memory of the physics", (_memory_in_use(device) - before) / GIB, "GiB")
    pieces = max(len(variant.catalog.bodies[index].pieces) for index in find_drawn(config.arrangement, variant.catalog))
    terms = [term for term in plan_memory(config, device, 0, pieces) if term.name.startswith(("Newton", "the state", "separating"))]
    yield MeasuredRow(f"{name}: memory planned for it, at least", sum(term.size for term in terms) / GIB, "GiB")


def _memory_in_use(device: wp.Device) -> int:
    """Memory in use of Warp's pool on a GPU; on the CPU the peak resident set of the process [bytes]."""
    if device.is_cuda:
        wp.synchronize_device(device)
        return int(wp.get_mempool_used_mem_current(device))
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


# ---- heaps ----


def measure_heaps(bench: Bench) -> Iterator[MeasuredRow]:
    """Measure perception of heaps of INSTANCES: objects in random poses, which may overlap. Edges of the clutter graph: one object above
    another. Nothing is simulated, so that any number is quick."""
    worlds = min(bench.config.bake.worlds, HEAP_WORLDS)
    config = replace(bench.config, bake=replace(bench.config.bake, worlds=1, mode="pick"))
    own, device = Variant(replace(bench, config=config), load_catalog(config), load_lights(config.bake.lights)), bench.device
    render_scene = own.build_scene()
    scene = make_scene_data(config, own.catalog, build_model(config, own.catalog, device), len(own.lights), device)
    for count in INSTANCES:
        sizes = world_sizes(worlds, count, config.move.rounds, 1, 1)
        state, attempts, _, _, record = allocate_worlds(sizes, device)
        parts = (render_scene, scene, state, attempts, record.observation, record.plan)
        perception = Perception(config.perception, config.rig, config.bake.seed, *parts)
        entry, pose = heap(own.catalog, config.tote.floor_size, config.bake.seed, worlds, count)
        state.catalog_index.assign(entry)
        record.snapshot.catalog_index.assign(entry)
        record.snapshot.pose.assign(pose)
        record.snapshot.fixture_pose.fill_(wp.transform_identity())
        for row in measure_perception(perception, record.snapshot, device, bench.seconds):
            yield replace(row, name=f"{count} instances: {row.name}")
        seen = perception.images.views.world.numpy()
        visible, above = (getattr(record.observation, name).numpy()[seen] for name in ("visible", "above"))
        yield MeasuredRow(f"{count} instances: visible", float((visible > 0).sum() / len(seen)))
        yield MeasuredRow(f"{count} instances: edges of the clutter graph", float(np.bitwise_count(above).sum() / len(seen)))


def heap(catalog: Catalog, floor: tuple[float, ...], seed: int, worlds: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Catalog indices of small objects, repeated (world, instance) int32, and their random poses above a floor [m] (world, instance, 7)."""
    numbers = np.random.default_rng(seed)
    volume = np.array([entry.volume for entry in catalog.entries])
    room = np.array(floor)
    small = np.argsort(volume, stable=True)[: max(1, len(volume) // SMALL)]
    entry = numbers.permuted(np.resize(small, (worlds, count)), axis=1).astype(np.int32)
    height = np.minimum(volume[entry].sum(axis=1) / (DENSITY * room.prod()), MAX_HEIGHT)
    pose = np.empty((worlds, count, 7), np.float32)
    pose[..., :2] = 0.4 * room * numbers.uniform(-1, 1, (worlds, count, 2))
    pose[..., 2] = height[:, None] * numbers.uniform(0, 1, (worlds, count))
    turn = numbers.normal(size=(worlds, count, 4))
    pose[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return entry, pose


# ---- replacements of Newton's components ----


def measure_patches(bench: Bench) -> Iterator[MeasuredRow]:
    """Ablation study: rates of physics in mode move with all replacements (`newton_patches`), without each, without any, and with all again
    to show the noise.

    The same piles fall, come to rest and are stirred in every run, since all variants find the same contacts.
    """
    config = bench.config.with_values({"bake.mode": "move", "bake.episodes": bench.config.bake.worlds})
    catalog, every = load_catalog(config), tuple(NEWTONS_OWN)
    without = {f"without {name}": (name,) for name in every}
    for name, left_out in {"all": (), **without, "Newton's own parts alone": every, "all, once more": ()}.items():
        with contextlib.ExitStack() as stack:
            for function, own in map(NEWTONS_OWN.__getitem__, left_out):
                stack.enter_context(mock.patch.object(physics, function, own))
            seconds = _time_stirring(Simulation(config, catalog, 1, bench.device))
        yield MeasuredRow(f"{name}: world-steps", TICKS * config.physics.steps_per_tick * config.bake.worlds / seconds, "1/s")


def _time_stirring(simulation: Simulation) -> float:
    """Time of TICKS ticks in which the gripper stirs [s], after the warm-up."""
    for _ in range(WARM_UP_TICKS):
        simulation.tick()
    wp.synchronize_device(simulation.device)
    started = time.perf_counter()
    for _ in range(TICKS):
        simulation.tick()
    wp.synchronize_device(simulation.device)
    return time.perf_counter() - started
