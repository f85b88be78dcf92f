"""Scoped profiler: host and device time of named stages, as a table and as a Chrome trace. Costs one comparison per scope when off.

    with timing.record() as recorder:
        with timing.scope("render", device):
            ...
    recorder.write_trace(Path("profile.json"))      # opens in https://ui.perfetto.dev or chrome://tracing

Host time is wall time between entering and leaving a scope; on a GPU, which works asynchronously, it is the time to enqueue. Device time is
measured by CUDA events on the current stream, without synchronization inside the scope. Scopes nest.
"""

import contextlib
import json
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import warp as wp

MAX_SPANS = 200_000
"""Maximum number of spans in a trace (about 20 MB); the table counts all."""
MAX_PENDING = 2048
"""Maximum number of device scopes whose events are not read yet; the oldest are then waited for."""
MICROSECONDS = 1e6
"""In a second."""
HOST, DEVICE = 0, 1
"""Tracks of a trace."""

Name = tuple[str, ...]
"""Names of a scope and of those around it, outermost first."""


@dataclass
class StageTime:
    """Accumulated number of calls and host and device time [s] (0: not measured) of all scopes of one name."""

    calls: int = 0
    host: float = 0.0
    device: float = 0.0


class Span(NamedTuple):
    """Scope in a trace: name, track, start since the recorder started, and duration [s]."""

    name: str
    track: int
    start: float
    duration: float


class Recorder:
    """Collects scopes: `times` by name, and spans for a trace. For one thread."""

    def __init__(self) -> None:
        self.times: dict[Name, StageTime] = {}
        self.wall = 0.0
        """Time from start to `finish` [s]."""
        self._started = time.perf_counter()
        self._spans: list[Span] = []
        self._stack: list[str] = []
        self._pending: deque[tuple[Name, wp.Event, wp.Event]] = deque()
        self._base: tuple[wp.Event, float] | None = None

    @contextlib.contextmanager
    def scope(self, name: str, device: wp.Device | None = None) -> Iterator[None]:
        """Measure a block of code; see the module's `scope`."""
        self._stack.append(name)
        path = tuple(self._stack)
        stage = self.times.setdefault(path, StageTime())
        begin = self._start_event(device)
        start = time.perf_counter()
        try:
            yield
        finally:
            duration = time.perf_counter() - start
            stage.calls += 1
            stage.host += duration
            self._add_span(Span(name, HOST, start - self._started, duration))
            if begin is not None and device is not None:
                self._pending.append((path, begin, device.stream.record_event(wp.Event(device, enable_timing=True))))
                if len(self._pending) > MAX_PENDING:
                    self._read_events(MAX_PENDING // 2)
            self._stack.pop()

    def _start_event(self, device: wp.Device | None) -> wp.Event | None:
        """Record an event on the device's current stream; None on the CPU, and during graph capture, which has no times."""
        if device is None or not device.is_cuda or device.is_capturing:
            return None
        if self._base is None:
            wp.synchronize_device(device)
            self._base = device.stream.record_event(wp.Event(device, enable_timing=True)), time.perf_counter() - self._started
        return device.stream.record_event(wp.Event(device, enable_timing=True))

    def _read_events(self, keep: int) -> None:
        """Wait for the oldest device scopes and add their times, until `keep` are pending."""
        while len(self._pending) > keep and self._base is not None:
            path, begin, end = self._pending.popleft()
            base, offset = self._base
            duration = 1e-3 * wp.get_event_elapsed_time(begin, end)
            self.times[path].device += duration
            self._add_span(Span(path[-1], DEVICE, offset + 1e-3 * wp.get_event_elapsed_time(base, begin), duration))

    def _add_span(self, span: Span) -> None:
        """Append a span, up to MAX_SPANS."""
        if len(self._spans) < MAX_SPANS:
            self._spans.append(span)

    def finish(self) -> None:
        """Read all device times, and take the wall time."""
        self._read_events(0)
        self.wall = time.perf_counter() - self._started

    def write_trace(self, path: Path) -> None:
        """Write spans as Chrome trace events (JSON), host and device as two tracks; raises OSError if the file cannot be written."""
        events = [
            {"name": "thread_name", "ph": "M", "pid": 0, "tid": track, "args": {"name": ("host", "device")[track]}}
            for track in (HOST, DEVICE)
        ]
        events += [
            {"name": one.name, "ph": "X", "pid": 0, "tid": one.track, "ts": MICROSECONDS * one.start, "dur": MICROSECONDS * one.duration}
            for one in self._spans
        ]
        path.write_text(json.dumps({"traceEvents": events, "displayTimeUnit": "ms"}) + "\n", encoding="ascii")


class _NullScope:
    """Context manager that does nothing; one instance serves all."""

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        return None


_NULL_SCOPE = _NullScope()
_recorder: Recorder | None = None


def scope(name: str, device: wp.Device | None = None) -> contextlib.AbstractContextManager[None]:
    """Measure a block of code by the name of its stage, if a recorder is active; with a device, device time, too."""
    return _NULL_SCOPE if _recorder is None else _recorder.scope(name, device)


@contextlib.contextmanager
def record() -> Iterator[Recorder]:
    """Context manager: record all scopes in this block; blocks do not nest. Raises RuntimeError if a recorder is active already."""
    global _recorder
    if _recorder is not None:
        raise RuntimeError("a profile is already being recorded")
    recorder = _recorder = Recorder()
    try:
        yield recorder
    finally:
        _recorder = None
        recorder.finish()
