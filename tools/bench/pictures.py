"""Render-only benchmark: views per second of all stages of the renderer over successive ticks, with light histories as in a bake.

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
from collections.abc import Iterator
from dataclasses import fields
from typing import Any, NamedTuple

import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.factory.assembly import Factory, build_factory, make_renderer
from synpick_warp.kernels.render.lighting.history import MAX_PERIOD_BITS
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.denoised import LIGHT_HISTORY, DenoisedRenderer
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.stream import FrameStream, TickReport, read_tick
from synpick_warp.system.progress import SilentProgress
from tools.bench.online import batch_views
from tools.bench.run import LIVE_FRACTION, SPARE_EPISODES, Bench
from tools.options import MeasuredRow

HISTORY_TICKS = 24
"""Ticks rendered before the measurement. Where nothing moves, a coarse pixel traces its 2nd path in the next frame, 2 more in every second
frame and 4 more in every fourth: it has accumulated 8 after 1 + 2 * 2 + 4 * 4 = 21 frames, and then traces one in every 8th. Its longest
update period it reaches after 16 more."""
KEPT_TICKS = 1 << int(MAX_PERIOD_BITS)
"""Ticks of a pass: the longest update period, in which each coarse pixel traces at least one path."""
ROUNDS = 5
"""Passes of each renderer; the renderers alternate, so that changes of the device's clock affect both."""


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
