"""Benchmark of simulation and perception: ticks while piles fall, rest, are stirred or picked; perception by stage."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from unittest import mock

import newton
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.factory.assembly import Factory
from synpick_warp.stages.sim.physics import may_capture
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader
from tools.options import Row, of_part

FOREVER = 1 << 30
"""Tick count that no measurement reaches."""
FALL_TICKS, SETTLE_TICKS = 4, 60
"""Ticks from the drop until the first objects land, and from there until piles are at rest (4 s at 15 Hz)."""
START_HEIGHT, STIR_TICKS = 0.2, 30
"""Start height of the gripper in mode move, just above the pile [m]; ticks from there until it is inside the pile (2 s at 15 Hz)."""
LEAD_TICKS, PICK_TICKS = 25, 60
"""Ticks from the first perception to the middle of the first attempt, and ticks measured from there: an attempt takes 55."""
MIN_REPEATS = 3
"""Repetitions of a measurement, at least."""
BURST = 2
"""Ticks, or render passes, between two synchronisations: as in a bake, the device does not wait for the host."""


def seconds_per_call(function: Callable[[], object], device: wp.Device, min_seconds: float, calls: int = 1) -> float:
    """Median time of a call [s], device work included, after one warm-up call.

    Bursts of `calls` calls are timed, each with a synchronisation at its end: at least `MIN_REPEATS` of them, for at least `min_seconds`.
    """
    function()
    times: list[float] = []
    while len(times) < MIN_REPEATS or sum(times) < min_seconds:
        wp.synchronize_device(device)
        started = time.perf_counter()
        for _ in range(calls):
            function()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - started)
    return statistics.median(times) / calls


class Stopwatch:
    """Device timer of methods by CUDA events, without synchronisation; by the host's clock on the CPU."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.events: dict[str, list[tuple[wp.Event, wp.Event]]] = defaultdict(list)
        self.spent: dict[str, float] = defaultdict(float)

    def time_method(self, owner: object, method: str, name: str) -> contextlib.AbstractContextManager[object]:
        """Context manager that adds the time spent in `owner.method` to the timer `name`."""
        function = getattr(owner, method)

        def timed(*arguments: object, **options: object) -> object:
            with self._time(name):
                return function(*arguments, **options)

        return mock.patch.object(owner, method, timed)

    def time_generator(self, owner: object, method: str, name: str) -> contextlib.AbstractContextManager[object]:
        """Context manager that times a generator method, from its first to its last part, with what its consumer does between."""
        function = getattr(owner, method)

        def timed(*arguments: object, **options: object) -> Iterator[object]:
            with self._time(name):
                yield from function(*arguments, **options)

        return mock.patch.object(owner, method, timed)

    @contextlib.contextmanager
    def _time(self, name: str) -> Iterator[None]:
        """Add the time of the block to what `name` has spent: on a GPU by events, on a CPU by the clock."""
        if not self.device.is_cuda:
            started = time.perf_counter()
            yield
            self.spent[name] += time.perf_counter() - started
            return
        pair = (wp.Event(self.device, enable_timing=True), wp.Event(self.device, enable_timing=True))
        self.device.stream.record_event(pair[0])
        yield
        self.device.stream.record_event(pair[1])
        self.events[name].append(pair)

    def seconds(self, name: str) -> float:
        """Total time of the timer `name` [s]; waits for the device."""
        wp.synchronize_device(self.device)
        return self.spent[name] + 1e-3 * sum(wp.get_event_elapsed_time(*pair) for pair in self.events[name])


def measure_simulation(factory: Factory, min_seconds: float, parts: tuple[str, ...]) -> Iterator[Row]:
    """Benchmark of all phases of an episode: drop and settle all worlds, let them act, and measure `parts` on the way.

    The state at the end is that of worlds in the middle of acting, as the benchmarks of rendering and writing need it.

    Args:
        factory: Worlds, before their first tick.
        min_seconds: Time for which a measurement is repeated, at least [s].
        parts: Parts to measure: "physics": ticks; "perception": perception.
    """
    simulation = factory.simulation
    tick = simulation.tick
    settle = simulation.scene.settle
    rest_ticks, settle.rest_ticks, settle.max_ticks = settle.rest_ticks, FOREVER, FOREVER
    simulation.scene.move.start_height = START_HEIGHT
    started = time.perf_counter()
    for _ in range(FALL_TICKS):
        tick()
    wp.synchronize_device(simulation.device)
    yield Row(f"load kernels, record the steps, first {FALL_TICKS} ticks", time.perf_counter() - started, "s", part="setup")
    physics_measured = "physics" in parts
    if physics_measured:
        yield from _measure_ticks(simulation, tick, min_seconds, "falling and landing")
    for _ in range(SETTLE_TICKS):
        tick()
    # Guide walls are removed as in a bake; then the phase SETTLE goes on, so that piles stay at rest.
    for count in (1, FOREVER):
        settle.rest_ticks = count
        tick()
    pile_seconds = 0.0
    if physics_measured:
        yield from _measure_ticks(simulation, tick, min_seconds, "at rest")
        yield from _measure_tick_parts(simulation, tick, min_seconds)
        pile_seconds = _measure_pile_steps(simulation, min_seconds)
        yield from _tick_rates(simulation, pile_seconds, "at rest, without gripper and seals, steps alone")
    settle.rest_ticks = rest_ticks
    if simulation.perception is None:
        for _ in range(STIR_TICKS + 2 * rest_ticks):
            tick()
        if physics_measured:
            yield from _measure_ticks(simulation, tick, min_seconds, "being stirred")
    else:
        for _ in range(LEAD_TICKS + 2 * rest_ticks):
            tick()
        if {"physics", "perception"} & set(parts):
            yield from (row for row in of_part("physics", _measure_picking(simulation, pile_seconds)) if row.part in parts)
    if physics_measured:
        acting = float((simulation.state.phase.numpy() == Phase.ACT).mean())
        yield Row("worlds that act", 100.0 * acting, "%")
        contacts = int(simulation.physics.contacts.rigid_contact_count.numpy()[0])
        yield Row("contacts per world", contacts / simulation.layout.worlds, "")


def _measure_ticks(simulation: Simulation, tick: Callable[[], None], min_seconds: float, state: str) -> Iterator[Row]:
    """Measure whole ticks in a state of the worlds; yields rows of time and rates."""
    yield from _tick_rates(simulation, seconds_per_call(tick, simulation.device, min_seconds, BURST), state)


def _tick_rates(simulation: Simulation, seconds: float, state: str) -> Iterator[Row]:
    """Rows of time and rates of ticks that take `seconds` each."""
    physics = simulation.config.physics
    yield Row(f"{state}: world-steps", physics.steps_per_tick * simulation.layout.worlds / seconds, "1/s")
    yield Row(f"{state}: a step of all worlds", 1e3 * seconds / physics.steps_per_tick, "ms")


def _measure_tick_parts(simulation: Simulation, tick: Callable[[], None], min_seconds: float) -> Iterator[Row]:
    """Breakdown of a tick: physics steps, everything else, launch overhead, collision detection."""
    physics, device = simulation.physics, simulation.device
    watch, calls = Stopwatch(device), 0
    with watch.time_generator(physics, "tick_parts", "steps"):
        while calls < MIN_REPEATS or watch.seconds("steps") < min_seconds:
            tick()
            calls += 1
    started = time.perf_counter()
    tick()
    host = time.perf_counter() - started
    with mock.patch.object(physics, "tick_parts", side_effect=lambda *_: iter(())):
        outside = seconds_per_call(tick, device, min_seconds / 4, BURST)
    collide = _capture_graph(lambda: physics.pipeline.collide(physics.state, physics.contacts), device)
    yield Row("a tick: physics steps", 1e3 * watch.seconds("steps") / calls, "ms")
    yield Row("a tick: everything but physics steps", 1e3 * outside, "ms")
    yield Row("a tick: host time to launch it", 1e3 * host, "ms")
    yield Row("a collision detection of all worlds", 1e3 * seconds_per_call(collide, device, min_seconds / 4, BURST), "ms")


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


def _measure_pile_steps(simulation: Simulation, min_seconds: float) -> float:
    """Time of a tick's physics steps [s] with the pile alone: no setpoints, no seals; the gripper keeps its last force."""

    def keep_forces(state: newton.State) -> None:
        """Leave the forces of the last step."""

    # Captured graphs contain the kernels of their hooks: steps without the gripper's need graphs of their own, and so do those after them.
    physics = simulation.physics
    physics.clear_graphs()
    physics.tick(keep_forces)
    seconds = seconds_per_call(lambda: physics.tick(keep_forces), simulation.device, min_seconds, BURST)
    physics.clear_graphs()
    return seconds


def _measure_picking(simulation: Simulation, pile_seconds: float) -> Iterator[Row]:
    """Benchmark of ticks in which worlds pick, and of their perception.

    Args:
        simulation: Worlds in the middle of an attempt.
        pile_seconds: Time of a tick's steps with the pile alone, for comparison [s]; 0: not measured.
    """
    device, perception, worlds = simulation.device, simulation.perception, simulation.layout.worlds
    reader, watch = TickReader(simulation.record), Stopwatch(device)
    perceptions, attached, acting = 0, 0, 0
    wp.synchronize_device(device)
    started = time.perf_counter()
    with watch.time_generator(simulation.physics, "tick_parts", "steps"), watch.time_method(perception, "perceive", "perception"):
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
    steps, perceive = (watch.seconds(name) / PICK_TICKS for name in ("steps", "perception"))
    yield from _tick_rates(simulation, tick, "picking")
    yield from _tick_rates(simulation, steps, "picking, steps alone")
    if pile_seconds:
        yield Row("picking, steps alone: rate relative to steps without gripper and seals", 100.0 * pile_seconds / steps, "%")
    for name, count in (("act", acting), ("have an object attached", attached)):
        yield Row(f"picking: worlds that {name}", 100.0 * count / (PICK_TICKS * worlds), "%")
    yield Row("worlds perceived a tick", perceptions / PICK_TICKS, part="perception")
    yield Row("perception and planning, a tick", 1e3 * perceive, "ms", part="perception")
    yield Row("perception and planning: fraction of the simulation's time", 100.0 * perceive / tick, "%", part="perception")
