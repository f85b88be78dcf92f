"""Benchmarks that share one simulation: physics, perception, rendering and encoders. Also benchmarks of physics alone: scaling with the
number of identical workpieces without a gripper, timed from DROP_TICKS ticks after the drop, and the gain of our replacements of Newton's
components."""

import contextlib
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any
from unittest import mock

import newton
import numpy as np
import warp as wp

from synpick_warp.cli.commands.doctor import GIB
from synpick_warp.codes import Phase, Status, Task
from synpick_warp.configs.episodes.objects import Counts
from synpick_warp.configs.schema import LAYERED
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.factory.assembly import Factory, build_factory, fit_to_catalog
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.build import find_drawn
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages import encoding, timing
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, ViewBuffers
from synpick_warp.stages.perception.perceive import Perception
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim import physics
from synpick_warp.stages.sim.physics import may_capture
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader, TickReport, read_tick
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.system.progress import SilentProgress
from tools.bench import run
from tools.bench.online import measure_stream
from tools.bench.run import FOREVER, Bench
from tools.options import MeasuredRow, of_part

FALL_TICKS, SETTLE_TICKS = 4, 60
"""Ticks from the drop until the first objects land, and from there until piles are at rest (4 s at 15 Hz)."""
START_HEIGHT, STIR_TICKS = 0.2, 30
"""Start height of the gripper in mode move, just above the pile [m]; ticks from there until it is inside the pile (2 s at 15 Hz)."""
LEAD_TICKS, PICK_TICKS = 25, 60
"""Ticks from the first perception to the middle of the first attempt, and ticks measured from there: an attempt takes 55."""
STREAM_BATCHES = 12
"""Number of batches that are rendered and copied back to back."""
STEPS, PERCEPTION = "physics", "perceive"
"""Timing scopes of a tick."""
CPU_VIEWS = 6
"""Number of views that are encoded on the CPU."""


def measure_worlds(bench: Bench, parts: tuple[str, ...]) -> Iterator[MeasuredRow]:
    """Measure the parts physics, perception, render, encode and stream of these, in this order."""
    started = time.perf_counter()
    factory = build_factory(bench.config, SilentProgress())
    simulation, device = factory.simulation, factory.simulation.device
    wp.synchronize_device(device)
    yield MeasuredRow("load and build", time.perf_counter() - started, "s", part="setup")
    yield from of_part("physics", _measure_simulation(bench, simulation, parts))
    if simulation.perception is not None and "perception" in parts:
        yield from of_part("perception", measure_perception(simulation.perception, simulation.record.snapshot, device, bench.seconds))
    if "render" in parts:
        yield from of_part("render", _measure_rendering(bench, factory))
    if "encode" in parts:
        yield from of_part("encode", _measure_encoding(bench, factory))
    if "stream" in parts:
        yield from of_part("stream", measure_stream(bench, factory, _mark_live(simulation, simulation.layout.worlds)))
    yield _memory_in_use(device)


def _memory_in_use(device: wp.Device) -> MeasuredRow:
    """Row of the device memory in use by all processes; on the CPU, of the process's peak memory."""
    if device.is_cuda:
        return MeasuredRow("device memory in use by all processes", (device.total_memory - device.free_memory) / GIB, "GiB", part="setup")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return MeasuredRow("peak memory of the process", peak / 1024**2, "GiB", part="setup")


def _mark_live(simulation: Simulation, worlds: int) -> TickReport:
    """Report of the last tick, marked as a frame of the first `worlds` worlds alone."""
    report = read_tick(simulation.record)
    report.status[:, Status.LIVE] = np.arange(simulation.layout.worlds) < worlds
    return report


# ---- physics ----


def _measure_simulation(bench: Bench, simulation: Simulation, parts: tuple[str, ...]) -> Iterator[MeasuredRow]:
    """Benchmark of all phases of an episode: drop, settle, let act; measures `parts` (physics, perception) on the way.

    The state at the end is that of worlds in the middle of acting, as the benchmark of rendering needs it.
    """
    tick, settle, measured = simulation.tick, simulation.scene.settle, "physics" in parts
    rest_ticks, settle.rest_ticks, settle.max_ticks = settle.rest_ticks, FOREVER, FOREVER
    simulation.scene.move.start_height = START_HEIGHT
    started = time.perf_counter()
    _simulate(simulation, FALL_TICKS)
    wp.synchronize_device(simulation.device)
    yield MeasuredRow(f"load kernels, record the steps, first {FALL_TICKS} ticks", time.perf_counter() - started, "s", part="setup")
    if measured:
        yield from _tick_rates(simulation, bench.seconds_per_call(tick), "falling and landing")
    _simulate(simulation, SETTLE_TICKS)
    # Guide walls are removed as in a bake; then the phase SETTLE goes on, so that piles stay at rest.
    for count in (1, FOREVER):
        settle.rest_ticks = count
        tick()
    pile_seconds = 0.0
    if measured:
        yield from _tick_rates(simulation, bench.seconds_per_call(tick), "at rest")
        yield from _measure_tick_parts(bench, simulation)
        pile_seconds = _measure_pile_steps(bench, simulation)
        yield from _tick_rates(simulation, pile_seconds, "at rest, without gripper and seals, steps alone")
    settle.rest_ticks = rest_ticks
    if simulation.perception is None:
        _simulate(simulation, STIR_TICKS + 2 * rest_ticks)
        if measured:
            yield from _tick_rates(simulation, bench.seconds_per_call(tick), "being stirred")
    else:
        _simulate(simulation, LEAD_TICKS + 2 * rest_ticks)
        if {"physics", "perception"} & set(parts):
            yield from (row for row in of_part("physics", _measure_picking(simulation, pile_seconds)) if row.part in parts)
    if measured:
        acting = float((simulation.state.phase.numpy() == Phase.ACT).mean())
        yield MeasuredRow("worlds that act", 100.0 * acting, "%")
        contacts = int(simulation.physics.contacts.rigid_contact_count.numpy()[0])
        yield MeasuredRow("contacts per world", contacts / simulation.layout.worlds, "")


def _simulate(simulation: Simulation, ticks: int) -> None:
    for _ in range(ticks):
        simulation.tick()


def _tick_rates(simulation: Simulation, seconds: float, state: str) -> Iterator[MeasuredRow]:
    """Rows of time and rates of ticks that take `seconds` each in a state of the worlds."""
    steps = simulation.config.physics.steps_per_tick
    yield MeasuredRow(f"{state}: world-steps", steps * simulation.layout.worlds / seconds, "1/s")
    yield MeasuredRow(f"{state}: a step of all worlds", 1e3 * seconds / steps, "ms")


def _measure_tick_parts(bench: Bench, simulation: Simulation) -> Iterator[MeasuredRow]:
    """Breakdown of a tick: physics steps, everything else, launch overhead, collision detection."""
    physics, tick = simulation.physics, simulation.tick
    steps = run.time_scopes(tick, simulation.device, bench.seconds)[STEPS]
    started = time.perf_counter()
    tick()
    host = time.perf_counter() - started
    with mock.patch.object(physics, "tick_parts", side_effect=lambda *_: iter(())):
        outside = bench.seconds_per_call(tick, 0.25)
    collide = _capture_graph(lambda: physics.pipeline.collide(physics.state, physics.contacts), simulation.device)
    yield MeasuredRow("a tick: physics steps", 1e3 * steps, "ms")
    yield MeasuredRow("a tick: everything but physics steps", 1e3 * outside, "ms")
    yield MeasuredRow("a tick: host time to launch it", 1e3 * host, "ms")
    yield MeasuredRow("a collision detection of all worlds", 1e3 * bench.seconds_per_call(collide, 0.25), "ms")


def _capture_graph(function: Callable[[], object], device: wp.Device) -> Callable[[], object]:
    """Capture the function's launches as a graph, to leave launch overhead out, where a bake captures them, too."""
    function()
    if not may_capture(device):
        return function
    with wp.ScopedCapture(device=device) as capture:
        function()
    graph = capture.graph
    assert graph is not None  # Set at the end of the capture.
    return lambda: wp.capture_launch(graph)


def _measure_pile_steps(bench: Bench, simulation: Simulation) -> float:
    """Time of a tick's physics steps [s] with the pile alone: no setpoints, no seals; the gripper keeps its last force."""

    def keep_forces(state: newton.State) -> None:
        """Leave the forces of the last step."""

    # Captured graphs contain the kernels of their hooks: steps without the gripper's need graphs of their own, and so do those after them.
    physics = simulation.physics
    physics.clear_graphs()
    physics.tick(keep_forces)
    seconds = bench.seconds_per_call(lambda: physics.tick(keep_forces))
    physics.clear_graphs()
    return seconds


def _measure_picking(simulation: Simulation, pile_seconds: float) -> Iterator[MeasuredRow]:
    """Benchmark of ticks in which worlds pick, and of their perception.

    `pile_seconds`: time of a tick's steps with the pile alone, for comparison [s]; 0: not measured.
    """
    device, worlds, reader = simulation.device, simulation.layout.worlds, TickReader(simulation.record)
    perceptions, attached, acting = 0, 0, 0
    wp.synchronize_device(device)
    with timing.record() as recorder:
        started = time.perf_counter()
        for _ in range(PICK_TICKS):
            simulation.tick()
            reader.start()
            report = reader.wait()
            act = report.column("phase") == Phase.ACT
            acting += int(act.sum())
            attached += int((act & report.attached.any(axis=1)).sum())
            perceptions += int((act & (report.column("task") == Task.LOOK)).sum())
        wp.synchronize_device(device)
        tick = (time.perf_counter() - started) / PICK_TICKS
    steps, perceive = (run.scope_seconds(recorder, device)[name] / PICK_TICKS for name in (STEPS, PERCEPTION))
    yield from _tick_rates(simulation, tick, "picking")
    yield from _tick_rates(simulation, steps, "picking, steps alone")
    if pile_seconds:
        yield MeasuredRow("picking, steps alone: rate relative to steps without gripper and seals", 100.0 * pile_seconds / steps, "%")
    for name, count in (("act", acting), ("have an object attached", attached)):
        yield MeasuredRow(f"picking: worlds that {name}", 100.0 * count / (PICK_TICKS * worlds), "%")
    yield MeasuredRow("worlds perceived a tick", perceptions / PICK_TICKS, part="perception")
    yield MeasuredRow("perception and planning, a tick", 1e3 * perceive, "ms", part="perception")
    yield MeasuredRow("perception and planning: fraction of the simulation's time", 100.0 * perceive / tick, "%", part="perception")


# ---- perception ----


def measure_perception(perception: Perception, snapshot: Snapshot, device: wp.Device, min_seconds: float) -> Iterator[MeasuredRow]:
    """Measure perception and planning by stage, in full batches of worlds that all look, for at least `min_seconds` [s]."""
    perception.state.phase.fill_(Phase.ACT)
    perception.attempts.task.fill_(Task.LOOK)
    stages = (
        (perception.images, "render", "ray tracing"),
        (perception.segmenter, "find_grasp_points", "components, distance transform, contours, suction points"),
        (perception.planner, "plan", "occlusion votes, clutter graph, target, grasp"),
    )
    names, graph = [name for _, _, name in stages], "of these, clutter graph"

    def perceive_batch() -> None:
        perception.list_worlds()
        perception.perceive_batch(snapshot)

    with contextlib.ExitStack() as patches:
        for stage in (*stages, (perception.planner, "order_clutter", graph)):
            patches.enter_context(run.scope_around(*stage, device))
        seconds = run.time_scopes(perceive_batch, device, min_seconds)
    views = perception.images.views.count
    yield MeasuredRow("views in a batch", views, "")
    for name, path in (*zip(names, names, strict=True), (graph, f"{names[-1]}: {graph}")):
        yield MeasuredRow(f"a view: {name}", 1e3 * seconds[path] / views, "ms")
    yield MeasuredRow("a view", 1e3 * sum(map(seconds.__getitem__, names)) / views, "ms")


# ---- rendering and encoders ----


def _measure_rendering(bench: Bench, factory: Factory) -> Iterator[MeasuredRow]:
    """Benchmark of rendering: each stage of a view, a whole batch, copies to the host, and batches with copies overlapped."""
    simulation, stream, ring = factory.simulation, factory.stream, factory.stream.rings[0]
    device, cameras = simulation.device, len(factory.cameras)
    count = min(ring.batch, simulation.layout.worlds * cameras)
    yield MeasuredRow("views in a batch", count, "")
    views = first_views(count, cameras, ring.renderer.instances, device)

    def render() -> None:
        ring.renderer.render(simulation.record.snapshot, views, ring.slots[0].images)

    spent = {name: seconds / count for name, seconds in run.time_scopes(render, device, bench.seconds).items()}
    spent["all"] = bench.seconds_per_call(render, 0.25) / count
    for name, seconds in spent.items():
        yield MeasuredRow(f"a view: {name}", 1e3 * seconds, "ms")
    yield MeasuredRow("views, ground truth alone", 1.0 / (spent["set up views"] + spent["rasterize"] + spent["annotate"]), "1/s")
    yield MeasuredRow("views, all stages", 1.0 / spent["all"], "1/s")
    if device.is_cuda:
        size = sum(array.capacity for array in ring.copies[0].source)

        def copy() -> None:
            ring.copies[0].start(stream.streams.copy)
            ring.copies[0].wait()

        seconds = bench.seconds_per_call(copy, 0.25, 1)
        yield MeasuredRow("copy to the host", 1e-9 * size / seconds, "GB/s")
        yield MeasuredRow("views copied to the host", ring.batch / seconds, "1/s")
    worlds = min(simulation.layout.worlds, -(-STREAM_BATCHES * ring.batch // cameras))
    report = _mark_live(simulation, worlds)
    seconds = bench.seconds_per_call(lambda: [len(batch) for batch in stream.render(simulation.record.snapshot, report)], 1.0, 1)
    yield MeasuredRow("views, all stages and copies", worlds * cameras / seconds, "1/s")


def _measure_encoding(bench: Bench, factory: Factory) -> Iterator[MeasuredRow]:
    """Benchmark of the image encoders: colour as JPEG and depth as PNG, on the device, and on a core of the CPU for comparison."""
    ring, simulation, quality = factory.stream.rings[0], factory.simulation, factory.config.bop.jpeg_quality
    device, images = simulation.device, ring.slots[0].images
    count = min(ring.batch, simulation.layout.worlds * len(factory.cameras))
    ring.renderer.render(simulation.record.snapshot, first_views(count, len(factory.cameras), ring.renderer.instances, device), images)
    colors, depths = (array[: min(count, CPU_VIEWS)].numpy() for array in (images.color, images.depth))
    jpeg, jpeg_out = _jpeg_encoder(images, quality, count, device)
    depth, depth_out = _depth_encoder(images, count, device)
    runs = (
        (f"JPEG, quality {quality}", jpeg, jpeg_out.jpeg_size, jpeg_out.jpeg, lambda view: encode_jpeg(colors[view], quality)),
        ("depth PNG", depth, depth_out.depth_idat_size, depth_out.depth_idat, lambda view: encode_png(depths[view])),
    )
    for name, encode, sizes, data, encode_on_cpu in runs:
        yield MeasuredRow(f"a view: {name}", 1e3 * bench.seconds_per_call(encode) / count, "ms")
        bytes_ = sizes.numpy()[:count]
        yield MeasuredRow(f"{name}: size", 1e-6 * float(bytes_.mean()), "MB")
        yield MeasuredRow(f"{name}: largest size, of its capacity", 100.0 * float(bytes_.max()) / data.shape[1], "%")
        yield MeasuredRow(f"{name}: CPU time of a view by the CPU's encoder", 1e3 * _cpu_seconds(encode_on_cpu, len(depths)), "ms")


def _jpeg_encoder(images: ViewBuffers, quality: int, count: int, device: wp.Device) -> tuple[Callable[[], None], encoding.JpegBuffers]:
    views, height, width = images.depth.shape
    sizes = encoding.jpeg_sizes(views, width, height)
    encoder, out = (
        encoding.JpegEncoder(allocate(encoding.JpegScratch, sizes, device), width, height),
        allocate(encoding.JpegBuffers, sizes, device),
    )
    qualities = wp.full(views, quality, dtype=wp.int32, device=device)
    return lambda: encoder.encode(images.color, qualities, count, out), out


def _depth_encoder(images: ViewBuffers, count: int, device: wp.Device) -> tuple[Callable[[], None], encoding.DepthBuffers]:
    views, height, width = images.depth.shape
    encoder = encoding.DepthEncoder(encoding.allocate_depth_scratch(views, width, height, device), width, height)
    out = allocate(encoding.DepthBuffers, encoding.depth_sizes(views, width, height), device)
    return lambda: encoder.encode(images.depth, count, out), out


def _cpu_seconds(encode: Callable[[int], object], views: int) -> float:
    """Median CPU time of a view [s], after one warm-up."""
    encode(0)
    times = []
    for view in range(views):
        started = time.process_time()
        encode(view)
        times.append(time.process_time() - started)
    return float(np.median(times))


DROP_TICKS, REST_TICKS = 24, 36
"""Ticks from the drop to the first measurement (1.6 s: nearly all objects have landed), and from its end to the second (2.4 s: objects
should be at rest, which is not checked)."""
PART = "bracket"
"""Workpiece whose piles are measured if the settings have no counts."""
INSTANCES = (10, 32, 64, 128, 251)
"""Default numbers of instances; the last is the largest that segmentation ids have room for."""
WARM_UP_TICKS, TICKS = 8, 80
"""Ticks before a measurement of replacements, in which kernels are loaded and graphs captured; and ticks measured, 5 s of an episode."""
NEWTONS_OWN = {
    "the fused solver": ("choose_solver", lambda device: newton.solvers.SolverSteel),
    "the separating broad phase": ("replace_broad_phase", lambda pipeline: None),
    "the launch sizes of the narrow phase": ("resize_blocks", lambda pipeline: None),
}
"""Replacement -> function of `stages.sim.physics` that installs it, and one to put in its place, which keeps Newton's own component."""


# ---- growth ----


def number_settings(counts: Counts, number: int) -> dict[str, Any]:
    """Settings by which `number` copies of one workpiece are dropped, in layers: of the one with the largest number in `counts`."""
    part = max(counts or ((PART, 1, 1),), key=lambda row: row[2])[0]
    fill = {"arrangement.counts": ((part, number, number),), "arrangement.max_objects": number, "arrangement.drop": LAYERED}
    return {"bake.mode": "move"} | fill | ({} if counts else {"objects.embedded": ("industrial",)})


def measure_growth(bench: Bench) -> Iterator[MeasuredRow]:
    """Time of a tick, contacts and memory of piles of equal workpieces in one bin, DROP_TICKS after the drop and REST_TICKS later. Raises
    ConfigError: a number does not fit into the bin, or into the device's memory."""
    config, device = bench.config, bench.device
    varied = [config.with_values(number_settings(config.arrangement.counts, number)) for number in bench.instances or INSTANCES]
    catalog, bins = load_catalog(max(varied, key=lambda each: each.arrangement.max_objects)), make_bins(config.cell.bins)
    for fitted in [fit_to_catalog(each, catalog, bins, device, SilentProgress()) for each in varied]:
        yield from _measure_equal_parts(replace(bench, config=fitted), catalog)


def _measure_equal_parts(bench: Bench, catalog: Catalog) -> Iterator[MeasuredRow]:
    """Rows of landing and of resting workpieces, of contacts, of overlapping bounding boxes (broad phase) and of memory."""
    config, device = bench.config, bench.device
    worlds, before = config.bake.worlds, _pool_in_use(device)
    simulation, name = Simulation(config, catalog, 1, device, None, range(worlds)), f"{config.arrangement.max_objects} instances"
    simulation.scene.settle.rest_ticks = simulation.scene.settle.max_ticks = FOREVER
    steps = config.physics.steps_per_tick * worlds
    for state, ticks in (("landing", DROP_TICKS), ("at rest", REST_TICKS)):
        for _ in range(ticks):
            simulation.tick()
        seconds = bench.seconds_per_call(simulation.tick)
        yield MeasuredRow(f"{name}, {state}: physics of a tick", 1e3 * seconds, "ms")
        yield MeasuredRow(f"{name}, {state}: world-steps", steps / seconds, "1/s")
        yield MeasuredRow(f"{name}, {state}: part-steps", steps * config.arrangement.max_objects / seconds, "1/s")
    own = simulation.physics
    for what, array in (("contacts", own.contacts.rigid_contact_count), ("overlaps", own.overlap_count)):
        yield MeasuredRow(f"{name}: {what} a world", int(array.numpy()[0]) / worlds)
    overflow = own.solver.constraint_overflow.numpy()[:-1]  # The last entry is that of bodies outside of all worlds.
    yield MeasuredRow(f"{name}: worlds without overflow", 100.0 * float(np.mean(~overflow)), "%")
    yield MeasuredRow(f"{name}: memory of the physics", (_pool_in_use(device) - before) / GIB, "GiB")
    pieces = max(len(catalog.bodies[index].pieces) for index in find_drawn(config.arrangement, catalog))
    terms = [term for term in plan_memory(config, device, 0, pieces) if term.name.startswith(("Newton", "the state", "separating"))]
    yield MeasuredRow(f"{name}: memory planned for it, at least", sum(term.size for term in terms) / GIB, "GiB")


def _pool_in_use(device: wp.Device) -> int:
    """Memory in use of Warp's pool on a GPU; on the CPU the peak resident set of the process [bytes]."""
    if device.is_cuda:
        wp.synchronize_device(device)
        return int(wp.get_mempool_used_mem_current(device))
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


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
