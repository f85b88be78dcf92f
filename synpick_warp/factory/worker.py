"""Main program of a device's process: receives its share of a bake, reports progress, and ends when the bake does, however that ends."""

import contextlib
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable, Sequence
from importlib import import_module
from multiprocessing.connection import Connection
from types import FrameType
from typing import TYPE_CHECKING, Any

from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.cores import LINK
from synpick_warp.system.interpreter import collection_paused
from synpick_warp.system.processes.pool import send
from synpick_warp.system.progress import SilentProgress

if TYPE_CHECKING:
    from synpick_warp.factory.episodes import BakeSummary

_MAX_FAULT = 200
"""Longest description of an unexpected error [characters]; the standard error stream has its traceback."""


class BakeLink(SilentProgress):
    """Link to the bake's main process: observer (`Progress`) that forwards all reports, and stop request (as `StopRequest`).

    A thread listens: a number is the signal for which to stop after the current tick; when the link closes, writers and process end.
    """

    def __init__(self, link: Connection) -> None:
        self.number = 0
        """Number of the signal; 0: none."""
        self.writers: Sequence[int] = ()
        """Process ids of the writers, once they run."""
        self.on_stop: Callable[[], None] | None = None
        """Called by the thread after a stop request, for a worker that waits; None: the bake polls `number`."""
        self._link = link

    def listen(self) -> None:
        """Start the thread, and take SIGTERM, which a job scheduler may send to every process, as a request to stop."""
        signal.signal(signal.SIGTERM, self._stop)
        threading.Thread(target=self._listen, name=LINK, daemon=True).start()

    def stage(self, text: str) -> None:
        self.report("stage", text)

    def update(self, **counts: Any) -> None:
        self.report("update", counts)

    def note(self, text: str) -> None:
        self.report("note", text)

    def report(self, kind: str, content: object) -> None:
        """Send a message (kind, content) to the main process; see `devices.DeviceProcesses`."""
        with contextlib.suppress(OSError):  # The main process is gone: the thread ends this one.
            send(self._link, (kind, content))

    def _listen(self) -> None:
        """Receive stop requests (thread); if the main process ends, kill the writers and exit."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                self.number = self._link.recv()
                if self.on_stop is not None:
                    self.on_stop()
        for pid in self.writers:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        os._exit(1)

    def _stop(self, number: int, _: FrameType | None) -> None:
        """Signal handler: keep the signal's number, so that the bake stops."""
        self.number = number


def main(module: str, function: str) -> None:
    """Serve one share from the socket with handle argv[1]: the function generates its episodes from the share (`devices.DeviceShare`, or
    what `cloud.workers` sends), the other handles, which are for the writers to keep open, and the link."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with collection_paused(freezes=True):
        generate: Callable[[Any, Sequence[int], BakeLink], BakeSummary] = getattr(import_module(module), function)
    connection, *handles = map(int, sys.argv[1:])
    link = Connection(connection)
    try:
        share = link.recv()
    except (EOFError, OSError):
        return  # The bake has ended before it began.
    bake = BakeLink(link)
    bake.listen()
    try:
        bake.report("summary", generate(share, handles, bake))
    except SynpickError as error:
        bake.report("error", error)
    except Exception as error:
        traceback.print_exc()
        bake.report("fault", f"{type(error).__name__}: {' '.join(str(error).split())}"[:_MAX_FAULT])
