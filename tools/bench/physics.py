"""What tools.bench measures of the simulation: ticks of falling, resting, stirred and picked piles, and looks."""

from __future__ import annotations

import contextlib
import functools
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from unittest import mock

import newton
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.pipeline import Factory
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReader

FOREVER = 1 << 30
"""More ticks than any measurement takes."""
FALL_TICKS, SETTLE_TICKS = 4, 60
"""From the drop until the first objects land, and from there until piles are at rest: 4 s at 15 Hz."""
START_HEIGHT, STIR_TICKS = 0.2, 30
"""Where the gripper starts when moving, just above the pile [m]; from there until it is in the pile's midst: 2 s at 15 Hz."""
LEAD_TICKS, PICK_TICKS = 25, 60
"""From the first look to the midst of the first attempt, and from there for a little longer than an attempt takes: 55 ticks."""
LEAST_REPEATS = 3
BURST = 2
"""Ticks, or passes of the renderer, between two synchronisations: as in a bake, the device does not wait for the host."""


@dataclass(frozen=True)
class Row:
    """One measured number."""

    part: str
    name: str
    value: float
    unit: str


def seconds_per_call(function: Callable[[], object], device: wp.Device, least: float, calls: int = 1) -> float:
    """Median time of a call [s], the device's work included, of at least `LEAST_REPEATS` bursts of `calls`, after one as warm-up."""
    function()
    times: list[float] = []
    while len(times) < LEAST_REPEATS or sum(times) < least:
        wp.synchronize_device(device)
        started = time.perf_counter()
        for _ in range(calls):
            function()
        wp.synchronize_device(device)
        times.append(time.perf_counter() - started)
    return statistics.median(times) / calls


class Stopwatch:
    """Adds up the device's time in methods, without waiting for it."""

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.marks: dict[str, list[tuple[wp.Event, wp.Event]]] = defaultdict(list)
        self.spent: dict[str, float] = defaultdict(float)

    def around(self, owner: object, method: str, name: str) -> contextlib.AbstractContextManager[object]:
        """While this holds, time in `owner.method` counts for `name`."""
        function = getattr(owner, method)

        def timed(*arguments: object, **options: object) -> object:
            if not self.device.is_cuda:
                started = time.perf_counter()
                result = function(*arguments, **options)
                self.spent[name] += time.perf_counter() - started
                return result
            pair = (wp.Event(self.device, enable_timing=True), wp.Event(self.device, enable_timing=True))
            self.device.stream.record_event(pair[0])
            result = function(*arguments, **options)
            self.device.stream.record_event(pair[1])
            self.marks[name].append(pair)
            return result

        return mock.patch.object(owner, method, timed)

    def seconds(self, name: str) -> float:
        """Their sum [s]; waits for the device."""
        wp.synchronize_device(self.device)
        return self.spent[name] + 1e-3 * sum(wp.get_event_elapsed_time(*pair) for pair in self.marks[name])


def measure_simulation(factory: Factory, least: float, parts: tuple[str, ...]) -> Iterator[Row]:
    """Drop and settle all worlds and let them act; on the way, measure what `parts` name. Piles are left as the gripper finds them.

    Args:
        factory: Worlds, before their first tick.
        least: Least time a measurement is repeated [s].
        parts: "physics": ticks; "sight": looks.
    """
    simulation = factory.simulation
    tick = functools.partial(simulation.tick, simulation.records[0])
    settle = simulation.scene.settle
    rest_ticks, settle.rest_ticks, settle.max_ticks = settle.rest_ticks, FOREVER, FOREVER
    simulation.scene.move.start_height = START_HEIGHT
    started = time.perf_counter()
    for _ in range(FALL_TICKS):
        tick()
    wp.synchronize_device(simulation.device)
    yield Row("setup", f"load kernels, record the steps, first {FALL_TICKS} ticks", time.perf_counter() - started, "s")
    thorough = "physics" in parts
    if thorough:
        yield from _ticks(simulation, tick, least, "falling and landing")
    for _ in range(SETTLE_TICKS):
        tick()
    # Guide walls go away as they do in a bake; then piles are held at rest.
    for count in (1, FOREVER):
        settle.rest_ticks = count
        tick()
    bare = 0.0
    if thorough:
        yield from _ticks(simulation, tick, least, "at rest")
        yield from _within_a_tick(simulation, tick, least)
        bare = _bare_steps(simulation, least)
        yield from _pace(simulation, bare, "at rest, without gripper and seals, steps alone")
    settle.rest_ticks = rest_ticks
    if simulation.perception is None:
        for _ in range(STIR_TICKS + 2 * rest_ticks):
            tick()
        if thorough:
            yield from _ticks(simulation, tick, least, "being stirred")
    else:
        for _ in range(LEAD_TICKS + 2 * rest_ticks):
            tick()
        if {"physics", "sight"} & set(parts):
            yield from (row for row in _picking(simulation, bare) if row.part in parts)
    if thorough:
        acting = float((simulation.state.phase.numpy() == Phase.ACT).mean())
        yield Row("physics", "worlds that act", 100.0 * acting, "%")
        contacts = int(simulation.physics.contacts.rigid_contact_count.numpy()[0])
        yield Row("physics", "contacts a world", contacts / simulation.layout.worlds, "")
    if simulation.perception is not None and "sight" in parts:
        yield from _looks(simulation, least)


def _ticks(simulation: Simulation, tick: Callable[[], None], least: float, state: str) -> Iterator[Row]:
    """How fast whole ticks are."""
    yield from _pace(simulation, seconds_per_call(tick, simulation.device, least, BURST), state)


def _pace(simulation: Simulation, seconds: float, state: str) -> Iterator[Row]:
    """Rates of ticks that take so long."""
    physics = simulation.config.physics
    yield Row("physics", f"{state}: world-steps", physics.steps_per_tick * simulation.layout.worlds / seconds, "1/s")
    yield Row("physics", f"{state}: a step of all worlds", 1e3 * seconds / physics.steps_per_tick, "ms")


def _within_a_tick(simulation: Simulation, tick: Callable[[], None], least: float) -> Iterator[Row]:
    """What a tick's time goes to."""
    physics, device = simulation.physics, simulation.device
    watch, calls = Stopwatch(device), 0
    with watch.around(physics, "tick", "steps"):
        while calls < LEAST_REPEATS or watch.seconds("steps") < least:
            tick()
            calls += 1
    started = time.perf_counter()
    tick()
    host = time.perf_counter() - started
    with mock.patch.object(physics, "tick"):
        outside = seconds_per_call(tick, device, least / 4, BURST)
    collide = _recorded(lambda: physics.pipeline.collide(physics.state, physics.contacts), device)
    yield Row("physics", "a tick: its steps", 1e3 * watch.seconds("steps") / calls, "ms")
    yield Row("physics", "a tick: all but its steps", 1e3 * outside, "ms")
    yield Row("physics", "a tick: the host until all is launched", 1e3 * host, "ms")
    yield Row("physics", "collision, once", 1e3 * seconds_per_call(collide, device, least / 4, BURST), "ms")


def _recorded(function: Callable[[], object], device: wp.Device) -> Callable[[], object]:
    """The same launches as a CUDA graph, so that launching does not count; on the CPU, the function."""
    function()
    if not device.is_cuda:
        return function
    with wp.ScopedCapture(device=device) as capture:
        function()
    graph = capture.graph
    assert graph is not None  # It is there once the capture has ended.
    return lambda: wp.capture_launch(graph)


def _bare_steps(simulation: Simulation, least: float) -> float:
    """Time of a tick's steps [s] with nothing but the pile: no goals, no seals; the gripper is carried by the last force."""

    def leave(state: newton.State) -> None:
        """No forces but those of before."""

    # The recorded steps have the gripper's kernels in them; those without are recorded anew.
    with mock.patch.object(simulation.physics, "_graph", None):
        simulation.physics.tick(leave)
        return seconds_per_call(lambda: simulation.physics.tick(leave), simulation.device, least, BURST)


def _picking(simulation: Simulation, bare: float) -> Iterator[Row]:
    """Ticks in which worlds pick: world-steps beside those of the bare pile (`bare`: time of its tick's steps [s]), and what looks take."""
    device, perception, worlds = simulation.device, simulation.perception, simulation.layout.worlds
    reader, watch = TickReader(simulation.records[0]), Stopwatch(device)
    looks, held, acting = 0, 0, 0
    wp.synchronize_device(device)
    started = time.perf_counter()
    with watch.around(simulation.physics, "tick", "steps"), watch.around(perception, "perceive", "looks"):
        for _ in range(PICK_TICKS):
            simulation.tick(simulation.records[0])
            reader.start()
            report = reader.wait()
            picks = report.column("phase") == Phase.ACT
            acting += int(picks.sum())
            held += int((picks & (report.column("held") != 0)).sum())
            looks += int((picks & (report.column("task") == Task.LOOK)).sum())
    wp.synchronize_device(device)
    whole, steps, look = ((time.perf_counter() - started) / PICK_TICKS, *(watch.seconds(name) / PICK_TICKS for name in ("steps", "looks")))
    yield from _pace(simulation, whole, "picking")
    yield from _pace(simulation, steps, "picking, steps alone")
    if bare:
        yield Row("physics", "picking, steps alone: rate over that without gripper and seals", 100.0 * bare / steps, "%")
    for name, count in (("act", acting), ("have something on the cup", held)):
        yield Row("physics", f"picking: worlds that {name}", 100.0 * count / (PICK_TICKS * worlds), "%")
    yield Row("sight", "looks a tick", looks / PICK_TICKS, "")
    yield Row("sight", "looks and plans, a tick", 1e3 * look, "ms")
    yield Row("sight", "looks and plans: share of the simulation's time", 100.0 * look / whole, "%")


def _looks(simulation: Simulation, least: float) -> Iterator[Row]:
    """Time of a look, by what it consists of, in full batches."""
    perception, snapshot = simulation.perception, simulation.records[0].snapshot
    assert perception is not None  # There are worlds that pick.
    simulation.state.phase.fill_(Phase.ACT)
    simulation.attempts.task.fill_(Task.LOOK)
    parts = (
        (perception.images, "render", "trace"),
        (perception.segmenter, "find_grasp_points", "components, distances, contours, suction points"),
        (perception.planner, "plan", "votes, clutter graph, choice, grasp"),
    )

    def perceive_batch() -> None:
        perception.list_worlds()
        perception.perceive_batch(snapshot)

    seconds_per_call(perceive_batch, simulation.device, 0.0)
    watch, calls = Stopwatch(simulation.device), 0
    with contextlib.ExitStack() as patches:
        for part in parts:
            patches.enter_context(watch.around(*part))
        while calls < LEAST_REPEATS or sum(watch.seconds(name) for _, _, name in parts) < least:
            perceive_batch()
            calls += 1
    views = perception.images.views.count
    yield Row("sight", "views in a batch", views, "")
    for _, _, name in parts:
        yield Row("sight", f"a look: {name}", 1e3 * watch.seconds(name) / (calls * views), "ms")
    yield Row("sight", "a look", 1e3 * sum(watch.seconds(name) for _, _, name in parts) / (calls * views), "ms")
