"""Worker processes: fresh interpreters, each connected by a socket pair that carries pickled messages and their answers in order.

Started by `subprocess`: not forked, because CUDA and threads do not survive a fork, and not spawned by `multiprocessing`, which would
import the main script again, and with it the whole simulator (and fail for scripts without `if __name__ == "__main__":`).
"""

import contextlib
import os
import pickle
import signal
import socket
import subprocess
import sys
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any

from synpick_warp.errors import SynpickError
from synpick_warp.system.interpreter import duplicate_above_streams

END_TIMEOUT = 120.0
"""How long an idle process may take to exit [s], also on a machine that is busy with others."""
_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "OPENCV_FOR_THREADS_NUM": "1",
    "PXR_WORK_THREAD_LIMIT": "1",  # Not by `Work.SetConcurrencyLimit`: after its second call, a thread of USD's TBB polls on for good.
    "TF_ENV_SETTING_ALERTS_ENABLED": "0",  # Or USD reports the limit at length.
}
"""The processes are the parallelism: libraries start no threads within them."""


class ProcessError(SynpickError):
    """Worker processes cannot be started, or one has died."""


@dataclass(eq=False)
class WorkerProcess:
    """Handle of a running worker process: process, connection, and the requests that it has not answered, oldest first."""

    process: subprocess.Popen[bytes]
    link: Connection
    tasks: deque[Any] = field(default_factory=deque)
    """Pending requests, oldest first: one record per message without an answer."""

    def kill(self) -> None:
        """Kill the process and wait for its exit."""
        self.process.kill()
        self.process.wait()
        self.link.close()

    def describe_end(self, setting: str) -> tuple[str, str]:
        """How the process died, such as "was ended by SIGKILL", and what can be done about it. `setting`: that of the number of
        processes."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(END_TIMEOUT)
        code = self.process.returncode
        # The kernel's out-of-memory killer sends SIGKILL; any other end has left its reason on the standard error stream.
        remedy = "see its message above, if any, and please report it"
        if code == -signal.SIGKILL:
            remedy = f"if memory ran out, set {setting} to a smaller number"
        return f"was ended by {signal.Signals(-code).name}" if code and code < 0 else f"ended with exit code {code}", remedy


def start_process(
    program: str,
    handles: Sequence[int] = (),
    inherited: Sequence[int] = (),
    environment: Mapping[str, str] = {},
    *,
    has_threads: bool = False,
) -> WorkerProcess:
    """Start a process. Its standard output is the null device, since the inherited one may be full or closed.

    Args:
        program: Python code that imports and calls the main function. It is imported, not run as `__main__`, so that pickled messages
            name the module's own classes.
        handles: File handles that it uses; sys.argv[1] is the number of its link's handle, the next arguments are the
            numbers of these.
        inherited: File handles that it keeps open until it exits, such as one that holds a lock.
        environment: Environment variables that it has besides those of this process.
        has_threads: Whether its libraries start as many threads as those of this process.

    Raises OSError: processes, memory or descriptors are used up."""
    ours, theirs = socket.socketpair()
    with ours, theirs, contextlib.ExitStack() as copies:
        # A lock that was taken while a standard stream was closed has that stream's number.
        passed = tuple(map(duplicate_above_streams, inherited))
        for handle in passed:
            copies.callback(os.close, handle)
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
        process = subprocess.Popen(
            (sys.executable, "-P", "-c", program, str(theirs.fileno()), *map(str, handles)),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=None if sys.__stderr__ is not None else subprocess.DEVNULL,
            env={**os.environ, **({} if has_threads else _ENVIRONMENT), **environment, "PYTHONPATH": paths},
            pass_fds=(theirs.fileno(), *handles, *passed),
            process_group=0,  # Ctrl-C in a terminal reaches the parent alone, even before the process ignores it.
        )
        return WorkerProcess(process, Connection(ours.detach()))


def send(link: Connection, message: Any) -> None:
    """Send a message as bytes: `Connection.send` keeps a view of a BytesIO, on which CPython 3.12.1 crashes in a garbage collection if
    the send fails and the error is part of a reference cycle."""
    link.send_bytes(pickle.dumps(message))
