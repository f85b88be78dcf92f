"""Ctrl-C and the signal by which clusters announce that a job's time is over: the first is a request, the second is not."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
from types import FrameType
from typing import Self

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPING = b"\nstopping after this tick; whole episodes stay, the same command goes on; once more: stop at once\n"
_STANDARD_ERROR = 2


class StopRequest:
    """While it is entered, the first of SIGNALS is only noted; from then on they do what they did before.

    Outside of the main thread, where signals do not arrive, it notes nothing.
    """

    def __init__(self) -> None:
        self.number = 0
        """Of the signal that was noted; 0: none."""
        self._before: dict[signal.Signals, object] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = {number: signal.signal(number, self._note) for number in SIGNALS}
        return self

    def __exit__(self, *_: object) -> None:
        self._restore()

    def _note(self, number: int, _: FrameType | None) -> None:
        self.number = number
        self._restore()
        # Not through a console: a handler may run within its own calls.
        with contextlib.suppress(OSError):
            os.write(_STANDARD_ERROR, _STOPPING)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
