"""Interrupts: a KeyboardInterrupt that no library swallows, SIGTERM as an exception, and graceful shutdown of a bake, on the first signal.

SIGTERM is the signal by which job schedulers announce the end of a job's time.
"""

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Self

from synpick_warp.system.interpreter import STANDARD_ERROR

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_STOPPING = b"\nstopping after this tick; committed episodes stay, the same command resumes the bake; once more: stop at once\n"


RETRY = 0.05
"""Time after which an interrupt that waits, or that was swallowed, is raised again [s]."""
_IMPORT_SYSTEM = "<frozen importlib._bootstrap"
"""How the file names of the import system's frames begin."""


class KeptInterrupt:
    """Context manager in which SIGINT raises KeyboardInterrupt, as always, but neither within an import nor only once.

    Libraries import others by `try: ... except BaseException`, as trimesh does, and take an interrupt there for a missing package. So it
    waits until the import has ended; a second SIGINT does not wait. One that is swallowed elsewhere is raised again, until it
    arrives here. `finally` blocks and handlers that it passes on its way are not disturbed. It uses SIGALRM and ITIMER_REAL.

    Where SIGINT is ignored or handled otherwise, and in any thread but the main one, it does nothing.
    """

    def __init__(self) -> None:
        self._count = 0
        self._raised: KeyboardInterrupt | None = None
        self._caller: FrameType | None = None
        self._before: object = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            self._caller = sys._getframe(1)
            signal.signal(signal.SIGINT, self._handle)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._caller is None:
            return
        if self._before is not None:
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(signal.SIGALRM, self._before)  # type: ignore[arg-type]
        signal.signal(signal.SIGINT, signal.default_int_handler)
        self._caller = None
        # What a command returns or raises after an interrupt that it has swallowed means nothing.
        if self._count and (kind is None or not issubclass(kind, KeyboardInterrupt)):
            raise KeyboardInterrupt from None

    def _handle(self, _: int, frame: FrameType | None) -> None:
        """Handler of SIGINT: count it, raise, and start the timer that raises again until it is taken."""
        self._count += 1
        if self._is_leaving(frame):
            return
        if self._before is None:
            self._before = signal.signal(signal.SIGALRM, lambda _, frame: self._raise(frame))
        signal.setitimer(signal.ITIMER_REAL, RETRY, RETRY)
        self._raise(frame)

    def _raise(self, frame: FrameType | None) -> None:
        """Raise the interrupt, unless an import runs, or it is on its way or about to be raised by `__exit__`."""
        if self._is_on_its_way() or self._is_leaving(frame) or (self._count == 1 and self._is_importing(frame)):
            return
        self._raised = KeyboardInterrupt()
        raise self._raised

    @staticmethod
    def _is_leaving(frame: FrameType | None) -> bool:
        """Whether the interrupted code is `__exit__`, which an interrupt must not break off: the timer would go on for ever."""
        while frame is not None and frame.f_code is not KeptInterrupt.__exit__.__code__:
            frame = frame.f_back
        return frame is not None

    def _is_importing(self, frame: FrameType | None) -> bool:
        """Whether the interrupted code is within an import, which must not be broken off."""
        while frame is not None and frame is not self._caller:
            if frame.f_code.co_filename.startswith(_IMPORT_SYSTEM):
                return True
            frame = frame.f_back
        return False

    def _is_on_its_way(self) -> bool:
        """Whether a handler or a `finally` block of the raised interrupt is running, so that it must not be raised again."""
        error = sys.exception()
        while error is not None and error is not self._raised:
            error = error.__context__
        return error is not None


@contextlib.contextmanager
def raising_sigterm() -> Iterator[None]:
    """Context manager that turns SIGTERM into SystemExit with exit code 143, as shells report it, so that clean-up code runs.

    Where SIGTERM is ignored or handled otherwise, and in any thread but the main one, it does nothing.
    """
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, _: FrameType | None) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


class StopRequest:
    """Graceful shutdown: context manager that records the first of SIGNALS, as `number`; after it the previous handlers are restored.

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
        """Handler of the first signal: keep its number, say so, and restore the handlers, so that a second one ends the process."""
        self.number = number
        self._restore()
        # os.write, not print: a signal handler can interrupt buffered output.
        with contextlib.suppress(OSError):
            os.write(STANDARD_ERROR, _STOPPING)

    def _restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)  # type: ignore[arg-type]
        self._before = {}
