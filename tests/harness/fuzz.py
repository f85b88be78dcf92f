"""Fuzz tests: number of examples, short in the suite, longer by SYNPICK_FUZZ_EXAMPLES; what does not count as an input's time."""

from __future__ import annotations

import os

from synpick_warp.system.processes import isolation


def fuzz_examples(default: int) -> int:
    """Examples of a fuzz test: `default`, or the environment variable SYNPICK_FUZZ_EXAMPLES."""
    return int(os.environ.get("SYNPICK_FUZZ_EXAMPLES", default))


def start_isolation() -> None:
    """Start the server of isolated processes, if it does not run: its start does not count as time that an input takes."""
    worker = isolation._server._worker
    if worker is None or worker.process.poll() is not None:
        list(isolation.run_isolated(abs, [(1,)], isolation.Limits(60.0, 2**30)))
