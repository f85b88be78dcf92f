"""Worker process of a GPU, which executes command lines of `tools.reports.real` sequentially and prepares their shared inputs once."""

from __future__ import annotations

import multiprocessing
import os
from contextlib import ExitStack
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("spawn")
"""A process that uses CUDA cannot be forked."""


class Worker:
    """Handle of a worker process. It is started by the first run, and restarted by a run after one that failed.

    Held-out views, kernels and photographs are prepared once in a process. It exits after a failure, since its CUDA context may be corrupt.
    """

    def __init__(self, shared: list[str]) -> None:
        """`shared`: arguments of all runs, which also determine the held-out views."""
        self.shared = shared
        self._process: BaseProcess | None = None
        self._connection: Any = None

    @property
    def ready(self) -> bool:
        """Whether the process is running."""
        return self._process is not None and self._process.is_alive()

    def run(self, arguments: list[str], log: Path, seconds: float) -> bool:
        """Execute a run, with its output in the file `log`. Returns False if it failed, or was killed after `seconds`."""
        if not self.ready:
            self._connection, other = _CONTEXT.Pipe()
            # No daemon: it may start processes of its own, as CoACD's.
            self._process = _CONTEXT.Process(target=_serve, args=(other, self.shared))
            self._process.start()
            other.close()
        try:
            self._connection.send((arguments, log))
            if self._connection.poll(max(seconds, 0.0)):
                return bool(self._connection.recv())
        except (EOFError, OSError):
            pass
        self.stop()
        return False

    def stop(self) -> None:
        """Kill the process."""
        if self._process is not None:
            self._process.kill()
            self._process.join()


def _serve(connection: Any, shared: list[str]) -> None:
    """Main loop of the process, until the parent exits. An error ends it, with a traceback in the log."""
    with ExitStack() as stack:
        bench = None
        while True:
            try:
                arguments, log = connection.recv()
            except EOFError:
                return
            with open(log, "wb") as file:
                os.dup2(file.fileno(), 1)
                os.dup2(file.fileno(), 2)
            from tools.reports.real.__main__ import carry_out, make_options, open_bench, torch

            options = make_options().parse_args([*shared, *arguments])
            bench = bench or stack.enter_context(open_bench(make_options().parse_args(shared)))
            carry_out(options, bench)
            print(end="", flush=True)
            torch.cuda.empty_cache()  # The renderer's memory is not PyTorch's.
            connection.send(True)
