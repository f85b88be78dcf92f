"""Worker process pool: tasks go to the least busy process, results are futures, and errors are raised in the caller.

The one pool of the package: files are written, images decoded, and data sets verified, validated and counted by it. Processes are fresh
interpreters that carry pickled messages over a socket pair, started by `subprocess`: not forked, because CUDA and threads do not survive a
fork, and not spawned by `multiprocessing`, which would import the main script and with it the whole simulator (and fail in scripts without
`if __name__ == "__main__":`). Nothing of them outlives this one.
"""

import contextlib
import os
import pickle
import selectors
import signal
import socket
import subprocess
import sys
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Self

from synpick_warp.errors import SynpickError
from synpick_warp.system.interpreter import duplicate_above_streams, open_standard_descriptors

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
        """How it died, such as "was ended by SIGKILL", and what can be done about it. `setting`: that of the number of processes."""
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
    """Start a process. Its standard output is the null device, since the inherited one may be full or closed. `program`: python code that
    imports and calls the main function. It is imported, not run as `__main__`, so that pickled messages name the module's own classes.
    `handles`: file handles that it uses; sys.argv[1] is the number of its link's handle, the next arguments are the numbers of these.
    `inherited`: file handles that it keeps open until it exits, such as one that holds a lock. `environment`: environment variables that it
    has besides those of this process. `has_threads`: whether its libraries start as many threads as those of this process.

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


_PROGRAM = "from synpick_warp.system.processes.pool import main; main()"
_SLACK = 2
"""Unanswered tasks that a process may have more than the least busy one and still be chosen by affinity."""
_AHEAD = 8
"""Size of the reorder buffer of an ordered map [results per process]: while it is full, no further task is started."""


@dataclass(frozen=True)
class WorkerProgram:
    """Program of a pool's processes. A task is a picklable callable; it is called with the state of the process that runs it."""

    setup: Callable[[], Any]
    """Picklable; makes the state that the tasks of a process share. If it raises, each task raises its error."""
    noun: str
    """Name of a process in error messages, such as "process that validates"."""
    setting: str = "--threads"
    """Name of the setting that has the number of processes."""
    handles: tuple[int, ...] = ()
    """File handles that the setup uses, by the same numbers."""
    inherited: tuple[int, ...] = ()
    """File handles that the processes keep open until they exit, such as one that holds a lock."""
    environment: Mapping[str, str] = field(default_factory=dict)
    """Environment variables that they have besides those of this process."""


class DeadProcessError(ProcessError):
    """A process of a pool has died."""

    def __init__(self, program: WorkerProgram, worker: WorkerProcess) -> None:
        self.how, self.remedy = worker.describe_end(program.setting)
        self.task: TaskFuture | None = worker.tasks[0] if worker.tasks else None
        """Future of the task that it ran; None: it had none."""
        super().__init__(f"a {program.noun} {self.how}; {self.remedy}")


@dataclass(eq=False, slots=True)
class TaskFuture:
    """Future of a task of a pool: its value or error, once done.

    It belongs to the thread that uses the pool, so it has no lock, unlike `concurrent.futures.Future`, whose lock costs that thread some 10
    us of 50 a task.
    """

    is_done: bool = False
    value: Any = None
    error: Exception | None = None

    def done(self) -> bool:
        """Whether there is a result, or an error."""
        return self.is_done

    def set(self, value: Any, error: Exception | None) -> None:
        """Set the result or the error."""
        self.value, self.error, self.is_done = value, error, True

    def result(self) -> Any:
        """The result of a task that is done; raises its error."""
        if self.error is not None:
            raise self.error
        return self.value


class TaskError(RuntimeError):
    """Unexpected error of a task, a programming error: its type and text in one line, its traceback as a note."""


class WorkerPool:
    """Pool of worker processes. As a context manager it kills them."""

    def __init__(self, program: WorkerProgram, processes: int) -> None:
        """Start processes; 0: tasks run in the calling process, at once. Raises ProcessError: they cannot be started."""
        open_standard_descriptors()
        self._program = program
        self._workers: list[WorkerProcess] = []
        self._links = selectors.DefaultSelector()
        self._runs_here = processes == 0
        self._state = program.setup() if self._runs_here else None
        try:
            for _ in range(processes):
                worker = start_process(_PROGRAM, program.handles, program.inherited, program.environment)
                self._workers.append(worker)
                self._links.register(worker.link, selectors.EVENT_READ, worker)
            for worker in self._workers:
                self._send(worker, pickle.dumps(program.setup))
        except OSError as error:
            self.kill()
            raise ProcessError(f"cannot start a {program.noun}: {error}; set {program.setting} lower") from error
        except BaseException:
            self.kill()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.kill()

    def __len__(self) -> int:
        """Number of processes."""
        return len(self._workers)

    def pids(self) -> tuple[int, ...]:
        """Ids of the worker processes."""
        return tuple(worker.process.pid for worker in self._workers)

    def load(self) -> int:
        """Number of unanswered tasks of the least busy process."""
        return min(map(_load, self._workers), default=0)

    def submit(self, task: Callable[[Any], Any], affinity: int | None = None, *, drain: bool = True) -> TaskFuture:
        """Send a task to the process with the fewest unanswered tasks; returns its future, which later calls of `receive`, `wait` and
        `submit` set. `task`: the task; see `WorkerProgram`. `affinity`: equal numbers choose the same process, unless it has `_SLACK` more
        than another; None: any. `drain`: receive available results first, so that a process that waits for its answer to be read takes the
        task. Needless if the caller bounds the unanswered tasks, and both tasks and results are small. Raises DeadProcessError: a process
        died."""
        future: TaskFuture = TaskFuture()
        if self._runs_here:
            try:
                future.set(task(self._state), None)
            except Exception as error:
                future.set(None, error)
            return future
        message = pickle.dumps(task)
        if drain:
            self.receive(0.0)
        worker = min(self._workers, key=_load)
        if affinity is not None and _load(own := self._workers[affinity % len(self._workers)]) < _load(worker) + _SLACK:
            worker = own
        worker.tasks.append(future)
        self._send(worker, message)
        return future

    def broadcast(self, task: Callable[[Any], Any]) -> list[TaskFuture]:
        """Send a task to every process; returns their futures. Raises DeadProcessError: a process died."""
        if self._runs_here:
            return [self.submit(task)]
        message = pickle.dumps(task)
        futures = []
        for worker in self._workers:
            futures.append(TaskFuture())
            worker.tasks.append(futures[-1])
            self._send(worker, message)
        return futures

    def receive(self, timeout: float | None) -> list[TaskFuture]:
        """Receive available results; a timeout of None blocks until there is one, unless no task is unanswered. Returns the futures that it
        has set. Raises DeadProcessError: a process died."""
        if timeout is None and not any(worker.tasks for worker in self._workers):
            timeout = 0.0
        received = []
        for key, _ in self._links.select(timeout):
            worker: WorkerProcess = key.data
            try:
                value, error = worker.link.recv()
            except (EOFError, OSError) as end:
                raise DeadProcessError(self._program, worker) from end
            received.append(future := worker.tasks.popleft())
            future.set(value, error)
        return received

    def wait(self, future: TaskFuture) -> Any:
        """Block until a task is done; returns its result. Raises SynpickError: what the task raised; so are OSError and MemoryError;
        TaskError: the task raised another error; DeadProcessError: A process died."""
        while not future.done():
            self.receive(None)
        return future.result()

    def map_ordered(self, tasks: Iterable[Callable[[Any], Any]], *, depth: int = 1, ahead: int = _AHEAD) -> Iterator[Any]:
        """Results of tasks, which are taken lazily as processes become idle, in order. `depth`: unanswered tasks per process; `ahead`:
        these and results that wait for an earlier one. Raises the errors of `wait`; other tasks go on."""
        limit = ahead * max(1, len(self))
        pending: deque[TaskFuture] = deque()
        for task in tasks:
            pending.append(self.submit(task))
            while pending and (pending[0].done() or len(pending) >= limit or self.load() >= depth):
                if pending[0].done():
                    yield pending.popleft().result()
                else:
                    self.receive(None)
        while pending:
            yield self.wait(pending.popleft())

    def end(self) -> None:
        """Let idle processes exit. Raises OSError: one has died; subprocess.TimeoutExpired: one did not exit."""
        for worker in self._workers:
            send(worker.link, None)
        for worker in self._workers:
            worker.process.wait(END_TIMEOUT)

    def kill(self) -> None:
        """Kill the processes, also in the middle of a task. Never raises."""
        for worker in self._workers:
            worker.kill()
        self._workers.clear()
        self._links.close()
        self._state = None

    def _send(self, worker: WorkerProcess, message: bytes) -> None:
        """Send a message to a worker; raises DeadProcessError if it has ended."""
        try:
            worker.link.send_bytes(message)
        except OSError as error:
            raise DeadProcessError(self._program, worker) from error


def map_ordered(program: WorkerProgram, tasks: Iterable[Callable[[Any], Any]], processes: int) -> Iterator[Any]:
    """Results of tasks, in order, in a pool of their own, or with one process in the calling one; see `WorkerPool.map_ordered`. Raises
    ProcessError: processes cannot be started, or one died."""
    with WorkerPool(program, processes if processes > 1 else 0) as pool:
        yield from pool.map_ordered(tasks)


def portable_error(error: Exception) -> Exception:
    """Convert an error to one that can be pickled.

    Errors of users, of the operating system, of memory and of imports keep their type; others become a `TaskError` of one line. The
    traceback of all but the first, which are about data, becomes a note: the caller's traceback ends where it waits for the task.
    """
    if isinstance(error, SynpickError | TaskError):
        return error
    if isinstance(error, OSError):
        name = (str(error.filename),) if error.filename else ()
        result = OSError(error.errno or 0, error.strerror or str(error), *name)
    elif isinstance(error, MemoryError):
        result = MemoryError(str(error))
    elif isinstance(error, ImportError):
        result = ImportError(str(error))
    else:
        result = TaskError(f"{type(error).__name__}: {' '.join(str(error).split())}")
    result.add_note("".join(traceback.format_exception(error)))
    return result


def _load(worker: WorkerProcess) -> int:
    return len(worker.tasks)


# ---- in the processes ----


def main() -> None:
    """Main function of a process: run tasks until `None` arrives or the parent exits. SIGINT is ignored; the parent handles it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    link = Connection(int(sys.argv[1]))
    try:
        state, fault = _run(link.recv())
        while (task := link.recv()) is not None:
            link.send((None, fault) if fault else _run(task, state))
    except (EOFError, ConnectionError):
        return  # The parent has ended; nobody is left to receive an answer.


def _run(task: Callable[..., Any], *arguments: Any) -> tuple[Any, Exception | None]:
    """Run a task: (result, None), or (None, error)."""
    try:
        return task(*arguments), None
    except Exception as error:
        return None, portable_error(error)
