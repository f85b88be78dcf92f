"""Parts of what trains without files: the online stream beside the bare renderer, and steps of the environment."""

import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import make_choice
from synpick_warp.factory.assembly import Factory, Stages
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.online.stream import Producer, Selection, ViewStream
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.online.batches import BatchRing, ViewBatch
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views, pair_views
from synpick_warp.stages.stream import TickReport
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.progress import SilentProgress
from tools.bench.run import Bench
from tools.options import MeasuredRow

ROUNDS = 5
"""Alternations between the two loops of a comparison."""
TWISTS = 4
"""Worlds that twist for each that picks: 2,048 by default, as peers publish."""
PILES = 128
"""Different piles of all cases but the first, so that their resets are short."""
SHORT = {"pick.appear_height": 0.1, "pick.lift_height": 0.2}
"""Settings of attempts that begin near the object and end soon, as trials do."""
CASES: tuple[tuple[str, int, dict[str, Any], dict[str, Any]], ...] = (
    ("attempts, state alone", 1, {"action": "point", "obs": ("state",), "piles": None}, {}),
    ("attempts, depth 160x90", 1, {"action": "pixel", "obs": ("depth",)}, {}),
    ("short attempts, depth 160x90", 1, {"action": "pixel", "obs": ("depth",)}, SHORT),
    ("ticks, state alone", TWISTS, {"action": "twist", "obs": ("state",)}, {}),
    ("ticks, depth 64x64", TWISTS, {"action": "twist", "obs": ("depth",), "resolution": (64, 64)}, {}),
    ("ticks, colour and depth 64x64", TWISTS, {"action": "twist", "obs": ("rgb", "depth"), "resolution": (64, 64)}, {}),
)
"""Environments: name, worlds relative to those of the benchmark, what differs from DEFAULTS, and settings."""
DEFAULTS: dict[str, Any] = {
    "task": "pick",
    "resolution": (160, 90),
    "autoreset": "disabled",
    "backend": "warp",
    "seed": 0,
    "max_steps": 10**6,
    "piles": PILES,
    "course": "attempt",
}
SPREAD, HEIGHT = 0.15, 0.05
"""Half width of the square of points that are tried, and their height [m]; most of them end on an object."""


# ---- stream ----


class _StillProducer(Producer):
    """Producer without simulation: renders one tick repeatedly."""

    def __init__(self, still: TickReport, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        self.still = still

    def batches(self) -> Iterator[ViewBatch]:
        """Yield batches of the same, kept tick without end."""
        while True:
            yield from self.render(self.still, self.stages.simulation.record.snapshot)


class _UnloggedProducer(Producer):
    """Producer without the log of episodes: attempts may have begun before the benchmark."""

    def _end_episodes(self, report: TickReport) -> None:
        """Do nothing: no episode is logged."""
        return


def measure_stream(bench: Bench, factory: Factory, report: TickReport) -> Iterator[MeasuredRow]:
    """Benchmark of the online generator against the bare renderer, and against the bare loop of simulation and rendering.

    `factory`: worlds in the middle of acting, and renderer; `report`: that of the last tick, with the rendered worlds marked as live.
    """
    ring = BatchRing(factory.groups[0], factory.config.render.layers, factory.config.bop.depth_scale)
    parts = (factory, (ring,), Selection().resolve(len(factory.cameras)), BakeSummary(), SilentProgress())
    yield MeasuredRow("views in a batch", ring.views, "")
    still, ticks = ViewStream(_StillProducer(report, *parts)), ViewStream(_UnloggedProducer(*parts))
    consume = _consumer(bench.device)
    bare = (views for _ in itertools.count() for views in _render_all(factory, ring, factory.simulation.record.snapshot, report))
    yield from _compare(bench, {"renderer alone": bare, "stream of one tick": map(consume, still)})
    yield from _compare(bench, {"simulation and renderer alone": _tick_loop(factory, ring), "stream of ticks": map(consume, ticks)})


def _compare(bench: Bench, sources: dict[str, Iterator[int]]) -> Iterator[MeasuredRow]:
    """Rows of the views per second of two sources, which take turns, and of the second's rate in percent of the first's.

    `sources`: name -> iterator over the numbers of views that it makes, of which a step is short beside `bench.seconds`.
    """
    totals = {name: np.zeros(2) for name in sources}
    for _ in range(ROUNDS):
        for name, source in sources.items():
            totals[name] += _count(source, bench.device, bench.seconds / ROUNDS)
    rates = {name: views / seconds for name, (views, seconds) in totals.items()}
    if not all(rates.values()):
        return  # All episodes have ended.
    for name, rate in rates.items():
        yield MeasuredRow(f"{name}, views", rate, "1/s")
    (alone, own), (name, rate) = rates.items()
    yield MeasuredRow(f"{name}: of {alone}", 100.0 * rate / own, "%")


def _count(source: Iterator[int], device: wp.Device, min_seconds: float) -> tuple[float, float]:
    """Views made in at least `min_seconds` after one warm-up batch, and the elapsed time with synchronization of the device [s].

    The count ends early if the source does.
    """
    next(source, None)
    wp.synchronize_device(device)
    started, views = time.perf_counter(), 0
    for count in source:
        views += count
        if time.perf_counter() - started >= min_seconds:
            break
    wp.synchronize_device(device)
    return views, time.perf_counter() - started


def _consumer(device: wp.Device) -> Callable[[ViewBatch], int]:
    """Make a consumer that imports colour and ids through DLPack on a CUDA stream of its own, and returns a batch's number of views."""
    stream = wp.Stream(device) if device.is_cuda else None

    def consume(batch: ViewBatch) -> int:
        with wp.ScopedStream(stream, sync_enter=False):
            wp.from_dlpack(batch.color)
            wp.from_dlpack(batch.instance)
        return len(batch)

    return consume


def _tick_loop(stages: Stages, ring: BatchRing) -> Iterator[int]:
    """Simulate and render, tick by tick as a bake does, into one buffer; yields the number of views of each batch."""
    with TickLoop(stages.simulation) as ticks:
        while True:
            report, snapshot = ticks.advance()
            if (report.column("phase") == Phase.IDLE).all():
                return
            for views in _render_all(stages, ring, snapshot, report):
                ticks.enqueue()
                yield views


def _render_all(stages: Stages, ring: BatchRing, snapshot: Snapshot, report: TickReport) -> Iterator[int]:
    """Render the views of a tick in batches into one slot of the ring; yields the number of views of each."""
    slot, renderer = ring.slots[0], stages.groups[0].renderer
    for views in batch_views(report, len(stages.cameras), ring.views, renderer):
        renderer.render(snapshot, views, slot.images, slot.layers)
        yield views.count


def batch_views(report: TickReport, cameras: int, size: int, renderer: Renderer) -> Iterator[Any]:
    """Split the views of a tick into batches of at most `size`; yields a struct `Views` for each."""
    pairs = pair_views(np.flatnonzero(report.column("live")), np.arange(cameras))
    for first in range(0, len(pairs[0]), size):
        rows = [wp.array(values[first : first + size], dtype=wp.int32, device=renderer.scene.device) for values in pairs]
        yield make_views(rows[0], rows[1], len(rows[0]), renderer.instances)


# ---- environment ----


def measure_environment(bench: Bench, make: Callable[..., PickingEnvironment] = make_picking) -> Iterator[MeasuredRow]:
    """Attempts per second of whole picks, and ticks per second of twists, with and without pictures.

    As many worlds as --worlds says pick, four times as many twist. Rates are of steps alone: resets, which simulate piles to rest, are a
    row of their own.
    """
    for name, factor, given, settings in CASES:
        count = factor * bench.config.bake.worlds
        environment = make(make_choice(**{**DEFAULTS, **given, "num_envs": count}), source=bench.config, settings=settings)
        started = time.perf_counter()
        environment.reset(seed=0)
        settled = time.perf_counter() - started
        random = np.random.default_rng(0)
        environment.step(_sample(environment, random))
        steps, started = 0, time.perf_counter()
        while not steps or time.perf_counter() - started < bench.seconds:
            environment.step(_sample(environment, random))
            steps += 1
        seconds = time.perf_counter() - started
        yield MeasuredRow(f"{name}, {count} worlds", steps * count / seconds, "1/s")
        yield MeasuredRow(f"{name}: a reset of all", settled, "s")
        if "piles" not in given:
            started = time.perf_counter()
            environment.reset(seed=0)
            yield MeasuredRow(f"{name}: a reset of all to kept piles", time.perf_counter() - started, "s")
        del environment


def _sample(environment: PickingEnvironment, random: np.random.Generator) -> np.ndarray:
    """Random actions: pixels of the middle of the image, points above the floor, or twists."""
    choice, count = environment.choice, environment.count
    if choice.action == "pixel":
        size = np.array(choice.resolution)
        return random.integers(size // 4, 3 * size // 4, (count, 2))
    if choice.action == "point":
        across = random.uniform(-SPREAD, SPREAD, (count, 2))
        return np.concatenate([across, np.full((count, 1), HEIGHT), np.tile([0.0, 0.0, 1.0], (count, 1))], axis=1)
    return random.uniform(-1.0, 1.0, (count, 6))
