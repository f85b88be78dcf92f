"""Process isolation: calls of native libraries on data of users, each in a process of its own with limits of time and memory.

A call that crashes, hangs or takes too much memory ends its own process, and the caller gets a `Failure`. The processes are forked from a
server: a fresh interpreter that has imported the functions' modules, and that neither CUDA nor threads of this process have touched. So a
call costs milliseconds, and starts from the same state each time, whatever libraries keep between calls. Each has a supervisor, which
kills it when the caller ends or closes the link (Ctrl-C). Limits are of processor time, which a busy machine does not shorten.
"""

import atexit
import contextlib
import importlib
import math
import mmap
import os
import pickle
import resource
import select
import signal
import socket
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, BinaryIO

from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.cores import SETUP, count_cores
from synpick_warp.system.inputs.files import describe_bytes
from synpick_warp.system.processes.pool import ProcessError, WorkerProcess, send, start_process

MODULES = ("synpick_warp.scenes.catalog", "synpick_warp.scenes.lights")
"""What the server imports before it forks; functions of other modules work too, but import theirs in each call."""
IDLE_TIME = 30.0
"""A server without requests for this long exits [s]; the next call starts another one."""
_WALL = 60.0
"""Wall time of a call, relative to its limit of processor time: for one that sleeps, and beyond any load."""
_GRACE = 5
"""How much later than its supervisor's the alarm of a process itself ends it [s], should the supervisor have died."""
MAX_PIXELS = 2**25
"""Most pixels of an image that OpenCV decodes: 8192 x 4096, which take 1.2 GB as 32-bit floats in an environment map."""
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive", "OPENCV_IO_MAX_IMAGE_PIXELS": str(MAX_PIXELS)}
"""Calls are the parallelism, and their matrices small. CoACD keeps its OpenMP threads, as often there is a single slow object;
waiting ones take no processor time."""
_BLOCK = 1 << 20
_MAX_SHOWN = 200


@dataclass(frozen=True)
class Limits:
    """Limits of an isolated call: processor time [s], and address space beyond the interpreter's [bytes]."""

    seconds: float
    """Processor time of all threads [s]; a call that waits is stopped after _WALL times as long."""
    memory: int


@dataclass(frozen=True)
class Failure:
    """Why an isolated call has no result."""

    reason: str
    """Reason, as the rest of a sentence whose subject the caller adds, such as "crashed (SIGSEGV)"."""
    by_machine: bool = False
    """Whether time or memory of this machine was the reason, so that the same call may succeed elsewhere."""


_STOPPED = Failure("was stopped")


class _Server:
    """The server process, shared by all threads: started by the first call, and again after it has exited."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._worker: WorkerProcess | None = None

    def start(self, failed: WorkerProcess | None = None) -> WorkerProcess:
        """The running server; starts one if none runs, or if the running one is `failed`. The caller must hold the lock. Raises OSError."""
        if self._worker is None or self._worker is failed or self._worker.process.poll() is not None:
            self.stop()
            program = f"from synpick_warp.system.processes.isolation import main; main({MODULES!r}, {IDLE_TIME!r})"
            self._worker = start_process(program, environment=_ENVIRONMENT, has_threads=True)
        return self._worker

    def open_link(self, result: int, failed: WorkerProcess | None) -> tuple[socket.socket, WorkerProcess]:
        """Ask the server for a process in the current folder that writes its result into the file with handle `result`. `failed`: server of
        this call's first attempt, which exited without an answer; None at the first attempt. It is replaced once, by whichever of its calls
        asks first. Returns the socket connected to the supervisor of the new process, and the server that was asked."""
        ours, theirs = socket.socketpair()
        with theirs, self._lock:
            worker = self.start(failed)
            with socket.socket(fileno=os.dup(worker.link.fileno())) as control, contextlib.suppress(OSError):
                place = os.open(".", os.O_PATH)
                try:
                    socket.send_fds(control, [b"r"], [theirs.fileno(), result, place])
                finally:
                    os.close(place)
            return ours, worker

    def stop(self) -> None:
        """End the server; running calls go on to their end."""
        if self._worker is not None:
            self._worker.kill()
            self._worker = None


_server = _Server()
atexit.register(_server.stop)


def start_server() -> None:
    """Start the server before the first call, so that its imports (2 s) overlap with the caller's. The first call reports errors."""
    with _server._lock, contextlib.suppress(OSError):
        _server.start()


def run_isolated(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], limits: Limits) -> Iterator[Any]:
    """Call a function with each tuple of arguments, in a process each, as many at a time as there are usable cores. `function`: function at
    the top of a module: it is pickled by name, and the process imports it. `calls`: arguments of each call; they are pickled.

    Yields, for each call, in order and as soon as it and all before it have ended: its result, the `SynpickError` that it raised, or a
    `Failure`. Raises ProcessError: no process can be started."""
    if not calls:
        return
    links = _Links()
    threads = ThreadPoolExecutor(min(len(calls), count_cores()), thread_name_prefix=SETUP)
    try:
        yield from threads.map(lambda arguments: links.call(pickle.dumps((function, arguments)), limits), calls)
    finally:
        # After an error, or Ctrl-C, nobody waits for the other calls. Nor for the threads, which end by themselves: of a generator that was
        # left before its end this runs in the garbage collector, in any thread, which may hold the lock that joining a thread takes.
        links.close()
        threads.shutdown(wait=False)


class _Links:
    """The links of the running calls, to be closed together."""

    def __init__(self) -> None:
        self._lock = threading.RLock()  # The garbage collector may close links in the thread that opens one.
        self._open: set[socket.socket] = set()
        self._closed = False

    def call(self, request: bytes, limits: Limits) -> Any:
        """Run a call in an isolated process within its limits; returns its result, or a `Failure` (too slow, too much memory, a crash)."""
        with _open_scratch() as result:
            server = None
            for _ in range(2):
                try:
                    link, server = _server.open_link(result.fileno(), failed=server)
                except OSError as error:
                    advice = "end other processes, or raise the limits"
                    raise ProcessError(f"no process can be started to read a file: {error.strerror}; {advice}") from error
                with link, Connection(os.dup(link.fileno())) as connection:
                    with self._lock:
                        if self._closed:
                            return _STOPPED
                        self._open.add(link)
                    try:
                        # An idle server may exit at this moment: then the link closes without a word.
                        if _receive(connection) is not None:
                            with contextlib.suppress(OSError):
                                send(connection, (limits.seconds, limits.memory, request))
                            return _outcome(_receive(connection), result, limits)
                        if self._closed:
                            return _STOPPED
                    finally:
                        with self._lock:
                            self._open.discard(link)
        raise ProcessError("the process that reads files could not be started; see its message above, if any, and please report it")

    def close(self) -> None:
        """Close all links, by which their processes are killed, and open no others."""
        with self._lock:
            self._closed = True
            for link in self._open:
                with contextlib.suppress(OSError):
                    link.shutdown(socket.SHUT_RDWR)


def _receive(link: Connection) -> Any:
    """Receive a message; None: the other end has closed the link."""
    with contextlib.suppress(EOFError, OSError):
        return link.recv()
    return None


def _open_scratch() -> BinaryIO:
    """An empty file in memory, or where there is none, on disk: results of hundreds of megabytes pass through sockets slowly."""
    if hasattr(os, "memfd_create"):
        return os.fdopen(os.memfd_create("synpick"), "w+b")
    return tempfile.TemporaryFile()


def _outcome(end: tuple[int, bool] | None, stream: BinaryIO, limits: Limits) -> Any:
    """Result of a call, unpickled from `stream`, or a `Failure`, by how its process ended. `end`: exit status, as of subprocess, and
    whether the time was over; None: the link was closed. `stream`: the file into which the process wrote its result."""
    if end is None:
        return _STOPPED
    code, timed_out = end
    if timed_out or code in (-signal.SIGALRM, -signal.SIGPROF):
        return Failure(f"took longer than {limits.seconds:g} s of processor time and was stopped", by_machine=True)
    if code == -signal.SIGKILL:
        return Failure("was killed, probably for lack of memory", by_machine=True)
    if code < 0:
        return Failure(f"crashed ({signal.Signals(-code).name})")
    if code > 0:
        return Failure(f"ended with status {code}")
    with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        result = pickle.loads(data)
    if isinstance(result, MemoryError):
        return Failure(f"needs more than {describe_bytes(limits.memory)} of memory", by_machine=True)
    return result


# ---- in the server and its children ----


def main(modules: Sequence[str], idle: float) -> None:
    """Entry point of the server: fork a supervisor for each link that arrives, until the caller's end, or `idle` [s] without any."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # The kernel reaps supervisors.
    warnings.simplefilter("ignore")  # Python 3.12 warns of a fork beside the threads of BLAS, which handles forks.
    for module in modules:
        importlib.import_module(module)
    control = socket.socket(fileno=int(sys.argv[1]))
    while select.select([control], [], [], idle)[0]:
        message, handles, _, _ = socket.recv_fds(control, 1, 3)
        if not message:
            return
        if os.fork() == 0:
            control.close()
            _exit_after(_supervise, Connection(handles[0]), *handles[1:])
        for handle in handles:
            os.close(handle)


def _exit_after(function: Callable[..., int], *arguments: Any) -> None:
    """Exit with the function's status, whatever it raises: a forked process must not go on as its parent would."""
    code = 1
    try:
        code = function(*arguments)
    finally:
        os._exit(code)


def _supervise(link: Connection, result: int, place: int) -> int:
    """Supervise a request: run it in a forked child, in the caller's working directory (descriptor `place`), and send its `_outcome`. The
    child is killed on timeout, or when the caller closes the connection."""
    os.fchdir(place)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    send(link, "started")
    if (message := _receive(link)) is None:
        return 0
    seconds, memory, request = message
    alive, held = os.pipe()  # The child alone holds the other end: it closes as the child ends.
    child = os.fork()
    if child == 0:
        os.close(alive)
        _exit_after(_work, result, request, seconds, memory)
    os.close(held)
    ready = select.select([alive, link], [], [], _WALL * seconds)[0]
    if alive not in ready:
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    with contextlib.suppress(OSError):
        send(link, (os.waitstatus_to_exitcode(status), not ready))
    return 0


def _work(result_file: int, request: bytes, seconds: float, memory: int) -> int:
    """Run a request within its limits and write the pickled result; what native code prints is discarded."""
    os.setpgid(0, 0)
    null = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(null, stream)
    signal.setitimer(signal.ITIMER_PROF, seconds)  # SIGPROF ends the process.
    signal.alarm(math.ceil(_WALL * seconds) + _GRACE)
    _limit_memory(memory)
    try:
        function, arguments = pickle.loads(request)
        result = function(*arguments)
    except (SynpickError, MemoryError) as error:
        result = error
    except Exception as error:  # native libraries raise nearly anything
        text = " ".join(str(error).split())
        text = text if text.isprintable() else ascii(text)[1:-1]
        result = Failure(f"failed ({': '.join(filter(None, (type(error).__name__, text[:_MAX_SHOWN])))})")
    _lift_memory_limit()
    with os.fdopen(result_file, "wb", buffering=_BLOCK) as stream:
        pickle.dump(result, stream, protocol=5)
    return 0


def _limit_memory(memory: int) -> None:
    """Limit the address space to `memory` [bytes] more, without core dumps; the kernel ends this process first if memory runs out."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    with contextlib.suppress(OSError):
        Path("/proc/self/oom_score_adj").write_text("1000")
    with contextlib.suppress(OSError, ValueError):
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        soft, hard = resource.getrlimit(resource.RLIMIT_AS)
        wanted = pages * resource.getpagesize() + memory
        known = [limit for limit in (soft, hard) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min([wanted, *known]), hard))


def _lift_memory_limit() -> None:
    """Lift the soft limit again, so that a result that was computed can be written."""
    with contextlib.suppress(OSError, ValueError):
        hard = resource.getrlimit(resource.RLIMIT_AS)[1]
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
