"""Fake CUDA device for tests: executes the operations of its streams one by one, in a random order that CUDA's stream rules allow."""

from __future__ import annotations

import contextlib
import random
from collections import deque
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

Operation = tuple[Callable[[], bool], Callable[[], None]]
"""Whether it may begin, and what it does."""
SPEEDS = (1, 5, 20)
"""Relative rates of streams: a slow one may be far behind a fast one."""


class ModelDevice:
    """Device with streams; `stream` is the current one, and `wp` stands for Warp's functions on it."""

    is_cuda = True

    def __init__(self, chance: random.Random) -> None:
        self.chance = chance
        self.streams: list[ModelStream] = []
        self.stream = ModelStream(self)
        self.wp = SimpleNamespace(
            get_device=lambda _: self,
            Stream=lambda device, priority=0: ModelStream(device),
            Event=ModelEvent,
            ScopedStream=scoped_stream,
            copy=self._copy,
            synchronize_event=lambda event: self._run_until(lambda: event.is_complete),
            synchronize_stream=lambda stream: self._run_until(lambda: not stream.queue),
        )

    def run(self, count: int) -> bool:
        """Do up to `count` operations; returns False if there are fewer that may begin."""
        for _ in range(count):
            ready = [stream for stream in self.streams if stream.queue and stream.queue[0][0]()]
            if not ready:
                return False
            (stream,) = self.chance.choices(ready, [stream.speed for stream in ready])
            stream.queue.popleft()[1]()
        return True

    def _run_until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            assert self.run(1), "a deadlock"

    def _copy(self, target: ModelArray, source: ModelArray, stream: ModelStream | None = None) -> None:
        (stream or self.stream).enqueue(lambda: setattr(target, "value", source.value))


class ModelStream:
    """CUDA stream: a queue of operations."""

    def __init__(self, device: ModelDevice) -> None:
        self.device, self.speed = device, device.chance.choice(SPEEDS)
        self.queue: deque[Operation] = deque()
        device.streams.append(self)

    def enqueue(self, operation: Callable[[], None]) -> None:
        """Enqueue a kernel or a copy."""
        self.queue.append((lambda: True, operation))

    def record_event(self, event: ModelEvent) -> ModelEvent:
        event.recorded += 1
        number = event.recorded
        self.enqueue(lambda: setattr(event, "done", max(event.done, number)))
        return event

    def wait_event(self, event: ModelEvent) -> None:
        """Wait for the latest record of an event before this call, as CUDA does; for none if there is none."""
        number = event.recorded
        self.queue.append((lambda: event.done >= number, lambda: None))

    def wait_stream(self, other: ModelStream) -> None:
        self.wait_event(other.record_event(ModelEvent(self.device)))


class ModelEvent:
    """CUDA event: how often it was recorded by the host, and how many of these records a stream has done."""

    def __init__(self, device: ModelDevice) -> None:
        self.device = device
        self.recorded = self.done = 0

    @property
    def is_complete(self) -> bool:
        return self.done >= self.recorded


class ModelArray:
    """Array of the device or of pinned memory, with one value."""

    def __init__(self, device: ModelDevice, value: Any = None) -> None:
        self.device, self.value = device, value

    def numpy(self) -> Any:
        return self.value


@contextlib.contextmanager
def scoped_stream(stream: ModelStream, sync_enter: bool = True) -> Iterator[None]:
    """As `wp.ScopedStream`."""
    device, saved = stream.device, stream.device.stream
    if sync_enter:
        stream.wait_stream(saved)
    device.stream = stream
    try:
        yield
    finally:
        device.stream = saved
