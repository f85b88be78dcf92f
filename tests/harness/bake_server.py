"""Fork server for quick bakes of boxes in separate processes, which tests may kill: it loads everything once and forks for every bake.

The server reads one line of JSON per bake, prints the process id, and after its end the exit code (minus the signal's number).
"""

from __future__ import annotations

import contextlib
import ctypes
import gc
import json
import os
import subprocess
import sys
from pathlib import Path

from tests.harness.processes import module_command
from tests.worlds.small_worlds import QUICK, QUICK_PICKS, catalog

TINY = {
    "bake.device": "cpu",  # A forked process cannot use its parent's CUDA context.
    "bake.worlds": 2,
    "bake.episodes": 4,
    "bake.writers": 1,
    "bake.formats": ["bop", "shards", "usd", "zarr"],
    "cameras.resolution": [48, 27],
    "render.bounces": 1,
    "render.coarse_paths": 1,
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
"""Overrides on top of QUICK: an episode takes less than a second."""
TINY_PICKS = QUICK_PICKS | {
    "bake.mode": "pick",
    "bake.formats": ["bop", "picks"],
    "pick.failures": 1,
    "perception.resolution": [160, 90],
    "picks.states": 1,
    "picks.candidates": 3,
    "picks.lift_height": 0.05,
    "picks.hold": 0.0,
    "picks.worlds": 2,
}
"""Overrides on top of TINY: short attempts, and few trials from a state."""
_PERTURB = -6
"""M_PERTURB of glibc's malloc.h."""


class BakeServer:
    """Client of the fork server, as a context manager."""

    def __init__(self) -> None:
        self._running = False

    def __enter__(self) -> BakeServer:
        command, pipe, environment = module_command("tests.harness.bake_server"), subprocess.PIPE, os.environ | {"OMP_NUM_THREADS": "1"}
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, cwd=Path(__file__).parents[2], env=environment)
        return self

    def __exit__(self, *_: object) -> None:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        self._process.stdout.close()
        self._process.wait(300)

    def start(self, out: Path, **options: object) -> int:
        """Start a bake; returns its process id. Options: config, settings, arguments, log, and allocated, a byte."""
        if self._running:
            self.wait()  # A test failed before it waited for its bake.
        self._send({"out": str(out), **options})
        self._running = True
        return int(self._receive())

    def wait(self) -> int:
        """Wait for the bake; returns its exit code."""
        self._running = False
        return int(self._receive())

    def bake(self, out: Path, **options: object) -> int:
        """Run a bake; returns its exit code."""
        self.start(out, **options)
        return self.wait()

    def _send(self, request: dict[str, object]) -> None:
        assert self._process.stdin
        self._process.stdin.write(json.dumps(request) + "\n")
        self._process.stdin.flush()

    def _receive(self) -> str:
        assert self._process.stdout
        return self._process.stdout.readline()


def arguments(request: dict) -> list[str]:
    """Command-line arguments of a request."""
    overrides = QUICK | TINY | request.get("settings", {})
    settings = [part for key, value in overrides.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    return ["bake", "--out", request["out"], "--config", request.get("config", "smoke"), *settings, *request.get("arguments", [])]


def _serve() -> None:
    from synpick_warp.cli import main as commands
    from synpick_warp.exporters.writing import pool
    from synpick_warp.factory import assembly, devices
    from tests.harness.made_once import made_once

    once = made_once()
    once.__enter__()  # Forks inherit what a bake in this process has made.
    pool.NICENESS = 0  # Writers of lower priority stall their bakes while other tests saturate all cores.
    assembly.load_catalog = devices.load_catalog = lambda config, report: catalog()
    answer = os.dup(1)
    os.dup2(2, 1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
    gc.freeze()  # Collections of forks pass over modules.
    gc.enable()
    warm = False
    for line in sys.stdin:
        request = json.loads(line)
        if not warm and request.get("warm"):
            # In this process, so that later children inherit all loaded kernels.
            os.write(answer, f"0\n{commands.main(arguments(request))}\n".encode())
            warm = True
            continue
        child = os.fork()
        if child == 0:
            if "allocated" in request:
                _fill_allocations(request["allocated"])
            with open(request.get("log", os.devnull), "a") as log:
                os.dup2(log.fileno(), 2)
            os._exit(commands.main(arguments(request)))
        os.write(answer, f"{child}\n".encode())
        _, status = os.waitpid(child, 0)
        os.write(answer, f"{os.waitstatus_to_exitcode(status)}\n".encode())


def _fill_allocations(value: int) -> None:
    """Make glibc initialize allocated memory with a byte (M_PERTURB), in this process and in the writers; other C libraries ignore it.

    Exception: in this process, blocks of up to 1 kB that come from glibc's thread cache (tcache) keep their contents. The writers run
    without that cache. `value`: the byte; not 255, whose complement, 0, would turn M_PERTURB off."""
    perturb = value ^ 0xFF
    os.environ["GLIBC_TUNABLES"] = "glibc.malloc.tcache_count=0"
    os.environ["MALLOC_PERTURB_"] = str(perturb)
    with contextlib.suppress(AttributeError):
        ctypes.CDLL(None).mallopt(_PERTURB, perturb)


if __name__ == "__main__":
    _serve()
