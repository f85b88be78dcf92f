"""Parallel convex decomposition: one subprocess per object, since CoACD keeps global state that threads would share.

The processes are interpreters of their own: not forked, because CUDA does not survive a fork, and not `multiprocessing`'s spawned
ones, because those import the main script again, which fails for scripts without `if __name__ == "__main__":`.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.collision.decomposition import ShapeRecipe, decompose
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from synpick_warp.system.cores import count_cores

_WORKER = "from synpick_warp.scenes.collision.parallel import main; main()"
"""Program of a process: imported, not run as `__main__`, so that pickled results name the modules' own classes."""

Job = tuple[str, TriangleMesh, ShapeRecipe]
"""Name of the object, mesh, recipe."""


def decompose_all(jobs: Sequence[Job]) -> Iterator[tuple[ConvexPiece, ...]]:
    """Decompose concave objects in one process per job, as many at a time as there are usable cores; a single job in this process.

    Yields:
        The pieces of each job, in order, each as soon as it and all before it are done.

    Raises:
        CatalogError: A mesh has no volume, or a process died.
    """
    if len(jobs) <= 1:
        yield from (decompose(mesh, recipe) for _, mesh, recipe in jobs)
        return
    workers = _Workers()
    with ThreadPoolExecutor(min(len(jobs), count_cores())) as threads:
        try:
            yield from threads.map(workers.run, jobs)
        finally:
            # After an error, or Ctrl-C, nobody waits for the other objects.
            workers.stop()


class _Workers:
    """The running processes, to be killed together."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = False

    def run(self, job: Job) -> tuple[ConvexPiece, ...]:
        """Decompose in a new process, and wait for it."""
        name, mesh, recipe = job
        with self._lock:
            if self._stopped:
                return ()
            process = _start()
            self._running.add(process)
        output, errors = process.communicate(pickle.dumps((mesh, recipe)))
        with self._lock:
            self._running.discard(process)
        if process.returncode:
            raise CatalogError(f"{name}: the process that decomposes it {_describe_death(process.returncode, errors)}")
        result = pickle.loads(output)
        if isinstance(result, BaseException):
            raise result
        return result

    def stop(self) -> None:
        """Kill the running processes, and start no others."""
        with self._lock:
            self._stopped = True
            for process in self._running:
                process.kill()


def _start() -> subprocess.Popen[bytes]:
    paths = os.pathsep.join(path or os.getcwd() for path in sys.path)
    return subprocess.Popen(
        (sys.executable, "-P", "-c", _WORKER),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": paths},
        process_group=0,  # A terminal's Ctrl-C goes to the caller alone, which then stops all processes.
    )


def _describe_death(code: int, errors: bytes) -> str:
    """The end of a process with this exit status, or killed by signal -code, in words."""
    if code == -signal.SIGKILL:
        return "was killed, probably for lack of memory; free some and run again, or set concave = false for it"
    last = errors.decode(errors="replace").strip().splitlines()[-1:]
    ending = f"was ended by signal {-code}" if code < 0 else f"ended with status {code}"
    return ": ".join([ending, *last]) + "; repair the mesh, or set concave = false"


def main() -> None:
    """Entry point of a process: a pickled mesh and recipe from standard input; pieces, or the exception, to standard output."""
    output = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # Whatever native code prints must not get into the result.
    mesh, recipe = pickle.load(sys.stdin.buffer)
    result: tuple[ConvexPiece, ...] | Exception
    try:
        result = decompose(mesh, recipe)
    except Exception as error:  # raised again in the calling process
        result = error
    with output:
        pickle.dump(result, output)
