"""What all parts of the benchmark share: the run with its options, and repeated timing, of calls and of scopes in them."""

import contextlib
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from unittest import mock

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.stages import timing
from synpick_warp.system.hardware.device import pick_device

FOREVER = 1 << 30
"""Tick count that no measurement reaches."""
MIN_REPEATS = 3
"""Repetitions of a measurement, at least."""
BURST = 2
"""Ticks, or render passes, between two synchronisations: as in a bake, the device does not wait for the host."""
LIVE_FRACTION = 0.9
"""Steady-state threshold: fraction of worlds that must deliver frames. Before, worlds settle, and physics has a larger part."""
SPARE_EPISODES = 16
"""Episodes planned for each world of a steady state, so that none runs out of them in the measurement."""


@dataclass(eq=False)
class Bench:
    """Run of the benchmark: its settings and options."""

    config: Config
    seconds: float
    """Time for which a measurement is repeated, at least [s]."""
    devices: tuple[str, ...] = ()
    """Devices of the part steady; empty: that of the settings."""
    after: int = 0
    """Ticks simulated before the part pictures."""
    instances: tuple[int, ...] = ()
    """Numbers of like parts that the part growth measures, instead of its factors."""

    @property
    def device(self) -> wp.Device:
        """Device of the settings."""
        return pick_device(self.config.bake.device)

    def seconds_per_call(self, function: Callable[[], object], share: float = 1.0, calls: int | None = None) -> float:
        """Median time of a call [s], device work included, after one warm-up call.

        Bursts of `calls` calls (None: BURST) are timed, each with a synchronisation at its end: at least `MIN_REPEATS` of them, for that
        share of `seconds` or longer.
        """
        function()
        calls, times = calls or BURST, list[float]()
        while len(times) < MIN_REPEATS or sum(times) < share * self.seconds:
            wp.synchronize_device(self.device)
            started = time.perf_counter()
            for _ in range(calls):
                function()
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - started)
        return statistics.median(times) / calls


def time_scopes(function: Callable[[], object], device: wp.Device, min_seconds: float) -> dict[str, float]:
    """Mean time [s] that a call of `function` spends in each timing scope, by its path: names of outer scopes and its own, joined by ': '.

    Calls in bursts, after one warm-up call, at least MIN_REPEATS of them, for at least `min_seconds`.
    """
    function()
    wp.synchronize_device(device)
    with timing.record() as recorder:
        started, calls = time.perf_counter(), 0
        while calls < MIN_REPEATS or time.perf_counter() - started < min_seconds:
            for _ in range(BURST):
                function()
            calls += BURST
            wp.synchronize_device(device)
    return {name: seconds / calls for name, seconds in scope_seconds(recorder, device).items()}


def scope_seconds(recorder: timing.Recorder, device: wp.Device) -> dict[str, float]:
    """Total time of each recorded scope [s], by its path: on a GPU that of the device, on a CPU that of the host."""
    return {": ".join(path): stage.device if device.is_cuda else stage.host for path, stage in recorder.times.items()}


@contextlib.contextmanager
def scope_around(owner: object, method: str, name: str, device: wp.Device) -> Iterator[None]:
    """Context manager in which calls of `owner.method` are in the timing scope `name`."""
    function = getattr(owner, method)

    def scoped(*arguments: object, **options: object) -> object:
        with timing.scope(name, device):
            return function(*arguments, **options)

    with mock.patch.object(owner, method, scoped):
        yield
