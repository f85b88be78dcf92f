"""What all parts of the benchmark share: the run with its options, repeated timing, timers of methods."""

from __future__ import annotations

import contextlib
import statistics
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from unittest import mock

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.system.hardware.device import pick_device

FOREVER = 1 << 30
"""Tick count that no measurement reaches."""
MIN_REPEATS = 3
"""Repetitions of a measurement, at least."""
BURST = 2
"""Ticks, or render passes, between two synchronisations: as in a bake, the device does not wait for the host."""
LIVE_FRACTION = 0.9
"""Steady-state threshold: fraction of the worlds that must deliver frames in a tick. Before, worlds settle, and physics has a larger
part."""
SPARE_EPISODES = 16
"""Episodes planned for each world of a steady state, so that none runs out of them in the measurement."""


@dataclass(eq=False)
class Bench:
    """Run of the benchmark: its settings and options, and what its parts have measured so far."""

    config: Config
    seconds: float
    """Time for which a measurement is repeated, at least [s]."""
    devices: tuple[str, ...] = ()
    """Devices of the part steady; empty: that of the settings."""
    after: int = 0
    """Ticks simulated before the part pictures."""
    instances: tuple[int, ...] = ()
    """Numbers of like parts that the part growth measures, instead of its factors."""
    values: dict[str, float] = field(default_factory=dict)
    """Value of each row so far, by name."""

    @property
    def device(self) -> wp.Device:
        """Device of the settings."""
        return pick_device(self.config.bake.device)

    def seconds_per_call(self, function: Callable[[], object], share: float = 1.0, calls: int | None = None) -> float:
        """Median time of a call [s], in bursts (None: of BURST) repeated for that share of `seconds`; see `seconds_per_call`."""
        return seconds_per_call(function, self.device, share * self.seconds, calls or BURST)


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
