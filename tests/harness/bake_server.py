"""Bakes of boxes in processes of their own, quickly: a server loads everything once, and forks for every bake. Bakes may be killed.

The server reads a line of JSON a bake, prints the process's number, and when that has ended its exit code (minus the signal's number).
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
from pathlib import Path

from tests.worlds.small_worlds import QUICK, catalog

TINY = {
    "bake.worlds": 2,
    "bake.episodes": 4,
    "bake.writers": 1,
    "bake.formats": ["bop", "shards", "usd", "zarr"],
    "cameras.resolution": [48, 27],
    "render.bounces": 1,
    "render.cell_paths": 1,
    "render.layers": ["flow", "depth_sensor"],
    "effects.blur": [0.0, 1.0],
    "effects.shot_noise": [0.0, 0.1],
    "physics.step": 8e-3,
    "physics.steps_per_tick": 8,
    "physics.substeps": 1,
    "physics.iterations": 6,
    "move.speed": 4.0,
    "settle.max_time": 3.0,
}
"""On top of QUICK: an episode takes less than a second."""
_EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir")
"""What changes a folder, as audit hooks see it."""


class BakeServer:
    """The test's side. Use it as a context manager."""

    def __init__(self) -> None:
        self._running = False

    def __enter__(self) -> BakeServer:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.harness.bake_server"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=Path(__file__).parents[2],
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(30)

    def start(self, out: Path, **options: object) -> int:
        """Begin a bake and return the process's number. Options: settings, arguments, and what `_prepare` knows."""
        if self._running:
            self.wait()  # A test has failed, and its bake has not been waited for.
        self._send({"out": str(out), **options})
        self._running = True
        return int(self._hear())

    def wait(self) -> int:
        """Its exit code."""
        self._running = False
        return int(self._hear())

    def bake(self, out: Path, **options: object) -> int:
        """Both."""
        self.start(out, **options)
        return self.wait()

    def _send(self, request: dict[str, object]) -> None:
        assert self._process.stdin
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()

    def _hear(self) -> str:
        assert self._process.stdout
        return self._process.stdout.readline()


def arguments(request: dict) -> list[str]:
    """Of the command line."""
    given = QUICK | TINY | request.get("settings", {})
    settings = [part for key, value in given.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    return ["bake", "--out", request["out"], "--config", "smoke", *settings, *request.get("arguments", [])]


def _serve() -> None:
    from synpick_warp import pipeline
    from synpick_warp.cli import commands

    pipeline.load_catalog = lambda config, report: catalog()
    answer = os.dup(1)
    os.dup2(2, 1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    warm = False
    for line in sys.stdin:
        request = json.loads(line)
        if not warm and request.get("warm"):
            # In this process, so that those that follow find all kernels loaded.
            os.write(answer, f"0\n{commands.main(arguments(request))}\n".encode())
            warm = True
            continue
        child = os.fork()
        if child == 0:
            _prepare(request)
            with open(request.get("log", os.devnull), "a") as log:
                os.dup2(log.fileno(), 2)
            os._exit(commands.main(arguments(request)))
        os.write(answer, f"{child}\n".encode())
        _, status = os.waitpid(child, 0)
        os.write(answer, f"{os.waitstatus_to_exitcode(status)}\n".encode())


def _prepare(request: dict) -> None:
    """What is to go wrong in a bake."""
    from synpick_warp import pipeline
    from synpick_warp.exporters.writing.pool import WriterPool

    if "alone" in request:
        # Files are written by this process, too.
        def alone(_: int, slot_bytes: int, held: int) -> WriterPool:
            pool = WriterPool(0, slot_bytes, held)
            if "most_bytes" in request:
                resource.setrlimit(resource.RLIMIT_FSIZE, (request["most_bytes"],) * 2)
            return pool

        pipeline.WriterPool = alone
    if "kill_at" in request:
        _kill_at(request["kill_at"], request["out"])
    if "count" in request:
        _count(Path(request["count"]), request["out"])


def _kill_at(number: int, out: str) -> None:
    """Kill this process before the data set's folder is changed for the `number`th time."""
    left = [number]

    def watch(event: str, given: tuple) -> None:
        if _changes(event, given, out):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(watch)


def _count(file: Path, out: str) -> None:
    """Have the number of changes written to a file."""
    number = [0]

    def watch(event: str, given: tuple) -> None:
        if _changes(event, given, out):
            number[0] += 1
            file.write_text(str(number[0]))

    sys.addaudithook(watch)


def _changes(event: str, given: tuple, out: str) -> bool:
    return event in _EVENTS and str(given[0]).startswith(out) and not (event == "open" and given[1] in ("r", "rb", None))


if __name__ == "__main__":
    _serve()
