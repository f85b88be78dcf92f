"""Parts of what trains without files: the online stream beside the bare renderer, and steps of the environment; and the render-only
benchmark: views per second of all stages of the renderer over successive ticks, with light histories as in a bake.

Light histories (`render.history`) are the temporally accumulated light of coarse pixels. The worlds are simulated until most of them
deliver frames, as for the benchmark part `steady`. Then HISTORY_TICKS ticks are simulated and rendered, so that the histories hold as many
paths as in a bake; then KEPT_TICKS ticks are simulated and kept. Each pass renders the kept ticks in order, in the batches of a bake, and
the device is synchronised at both ends only. Before each pass, outside the measured time, the histories are restored to those before the
first kept tick, so that every pass does the same work, and even its first tick continues histories. Physics, encoders, copies to the host
and writers do not run. The size of a pass is fixed: `--seconds` is ignored.
"""

import itertools
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.environment.make import make_picking
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import make_choice
from synpick_warp.factory.assembly import Factory, Stages, build_factory, make_renderer
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.kernels.render.lighting.history import MAX_PERIOD_BITS
from synpick_warp.online.stream import Producer, Selection, ViewStream
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.online.batches import BatchRing, ViewBatch
from synpick_warp.stages.render.denoised import LIGHT_HISTORY, DenoisedRenderer
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views, pair_views
from synpick_warp.stages.stream import FrameStream, TickReport, read_tick
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.progress import SilentProgress
from tools.bench.run import LIVE_FRACTION, SPARE_EPISODES, Bench
from tools.options import MeasuredRow

HISTORY_TICKS = 24
"""Ticks rendered before the measurement. Where nothing moves, a coarse pixel traces its 2nd path in the next frame, 2 more in every second
frame and 4 more in every fourth: it has accumulated 8 after 1 + 2 * 2 + 4 * 4 = 21 frames, and then traces one in every 8th. Its longest
update period it reaches after 16 more."""
KEPT_TICKS = 1 << int(MAX_PERIOD_BITS)
"""Ticks of a pass: the longest update period, in which each coarse pixel traces at least one path."""
ROUNDS = 5
"""Passes of each renderer or loop of a comparison: they alternate, so that changes of the device's clock affect both."""


_KEPT = ("nearest",), ("first", "words", "length"), ("pixels", "boxes")
"""Arrays of visibility, masks and counts beyond the image that are kept from frame to frame."""


class KeptTick(NamedTuple):
    """Copy of a tick's snapshot and batches of views, which stays valid while the simulation goes on."""

    snapshot: Snapshot
    batches: list[Any]
    """Its views in the batches of a bake, each a struct `Views`."""


def light_history(renderer: Renderer) -> Any:
    """The struct `LightHistory` of a renderer; None: it keeps none."""
    shading = renderer.shading
    return shading.history if isinstance(shading, DenoisedRenderer) and shading.history.max_paths > 0 else None


def _history_arrays(renderer: Renderer) -> dict[str, wp.array]:
    """Arrays of a renderer's light histories and kept images by name; none if it keeps none."""
    history, shading = light_history(renderer), renderer.shading
    if history is None or not isinstance(shading, DenoisedRenderer):
        return {}
    kept = {"ratios": shading.ratios.record, "bodies": shading.flags.bodies, "color": renderer.postprocessor.kept}
    kept["sources"] = shading.kept_sources.word
    if renderer.damage is not renderer.rasterizer.whole:
        owners = renderer.rasterizer.visibility, renderer.rasterizer.kept_masks, renderer.annotator.border
        kept |= {f"{name} {index}": getattr(owner, name) for index, owner in enumerate(owners) for name in _KEPT[index]}
    return {name: getattr(history, name) for name in LIGHT_HISTORY.specs} | {name: array for name, array in kept.items() if array.size}


def measure_pictures(bench: Bench) -> Iterator[MeasuredRow]:
    """Simulate, keep and render ticks: rows of counts, and of the rates with `render.history` as set, and with 0.

    More device memory is needed than for a bake: for a copy of the histories, the kept snapshots, and the scratch arrays of a second
    renderer. `bench.after` ticks are simulated before the histories begin; just after the drop little moves.
    """
    started = time.perf_counter()
    config = bench.config.with_values({"bake.episodes": SPARE_EPISODES * bench.config.bake.worlds})
    factory = build_factory(config, SilentProgress())
    stream, ring = factory.stream, factory.stream.rings[0]
    simulate_until_live(factory)
    for _ in range(bench.after):
        _tick(factory)
    for _ in range(HISTORY_TICKS):
        render_ticks(stream, ring.renderer, [keep_tick(factory)])
    ticks = [keep_tick(factory) for _ in range(KEPT_TICKS)]
    views = sum(batch.count for tick in ticks for batch in tick.batches)
    wp.synchronize_device(stream.device)
    yield MeasuredRow(f"setup: load, drop objects, render {HISTORY_TICKS} ticks", time.perf_counter() - started, "s")
    yield MeasuredRow("ticks in a pass", len(ticks), "")
    yield MeasuredRow("views in a pass", views, "")
    yield MeasuredRow("views in a batch", ring.batch, "")
    if views == 0:
        return  # All episodes have ended.
    renderers = {"all stages": ring.renderer}
    history = light_history(ring.renderer)
    if history is not None:
        paths = history.paths.numpy()[history.frame.numpy() >= 0]  # NEVER, a negative index: no frame yet.
        yield MeasuredRow("paths in a history before a pass, mean", float(paths.mean()), "")
        scene, count = ring.renderer.scene, history.frame.shape[0]
        for setting, value, histories in (("render.reuse", False, count), ("render.history", 0, 0)):
            other = make_renderer(config.with_values({setting: value}), scene, ring.instances, ring.batch, histories=histories)
            renderers[f"all stages, {setting}={str(value).lower()}"] = other
    megapixels = 1e-6 * config.cameras.resolution[0] * config.cameras.resolution[1]
    for name, times in _time_passes(stream, renderers, ticks).items():
        rate = views / statistics.median(times)
        yield MeasuredRow(f"{name}: views, median of {len(times)} passes", rate, "1/s")
        yield MeasuredRow(f"{name}: views, slowest pass", views / max(times), "1/s")
        yield MeasuredRow(f"{name}: views, fastest pass", views / min(times), "1/s")
        yield MeasuredRow(f"{name}: pixels", megapixels * rate, "Mpx/s")
        yield MeasuredRow(f"{name}: a view", 1e3 / rate, "ms")


def simulate_until_live(factory: Factory) -> None:
    """Simulate until LIVE_FRACTION of the worlds deliver frames, or all episodes have ended."""
    while True:
        report = _tick(factory)
        if report.column("live").mean() >= LIVE_FRACTION or (report.column("phase") == Phase.IDLE).all():
            return


def keep_tick(factory: Factory) -> KeptTick:
    """Simulate a tick, and copy what its rendering needs: the simulation overwrites its record."""
    report, snapshot, ring = _tick(factory), factory.simulation.record.snapshot, factory.stream.rings[0]
    copy = Snapshot(**{item.name: wp.clone(getattr(snapshot, item.name)) for item in fields(snapshot)})
    return KeptTick(copy, list(batch_views(report, len(factory.cameras), ring.batch, ring.renderer)))


def _tick(factory: Factory) -> TickReport:
    factory.simulation.tick()
    return read_tick(factory.simulation.record)


def render_ticks(stream: FrameStream, renderer: Renderer, ticks: list[KeptTick]) -> None:
    """Enqueue the rendering of all views of `ticks`, in the order, batches and buffers of a bake; does not wait for the device."""
    slots = itertools.cycle(stream.rings[0].slots)
    for tick in ticks:
        for views in tick.batches:
            slot = next(slots)
            renderer.render(tick.snapshot, views, slot.images, slot.layers)


def _time_passes(stream: FrameStream, renderers: dict[str, Renderer], ticks: list[KeptTick]) -> dict[str, list[float]]:
    """Times of ROUNDS passes of each renderer [s], by its name, after a warm-up pass over the first tick."""
    saved = {name: wp.clone(array) for name, array in _history_arrays(next(iter(renderers.values()))).items()}
    times: dict[str, list[float]] = {name: [] for name in renderers}
    for renderer in renderers.values():
        render_ticks(stream, renderer, ticks[:1])
    for _ in range(ROUNDS):
        for name, renderer in renderers.items():
            for member, array in _history_arrays(renderer).items():
                wp.copy(array, saved[member])
            wp.synchronize_device(stream.device)
            started = time.perf_counter()
            render_ticks(stream, renderer, ticks)
            wp.synchronize_device(stream.device)
            times[name].append(time.perf_counter() - started)
    return times


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
