"""Graceful shutdown: the first SIGINT or SIGTERM requests a stop after the current tick, the second acts as usual.

SIGTERM is the signal by which job schedulers announce the end of a job's time.
"""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from types import FrameType
from typing import Self

from synpick_warp.system.descriptors import STANDARD_ERROR

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPING = b"\nstopping after this tick; committed episodes stay, the same command resumes the bake; once more: stop at once\n"


class StopRequest:
    """Context manager that records the first of SIGNALS; after it the previous handlers are restored.

    In any thread but the main one it does nothing: Python allows signal handlers there alone.
    """

    def __init__(self) -> None:
        self.number = 0
        """Number of the received signal; 0: none."""
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._handle) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _handle(self, number: int, _: FrameType | None) -> None:
        self.number = number
        self._restore()
        # os.write, not print: a signal handler can interrupt buffered output.
        with contextlib.suppress(OSError):
            os.write(STANDARD_ERROR, _STOPPING)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
