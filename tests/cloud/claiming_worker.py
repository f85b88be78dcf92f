"""Program of three claiming workers that bake without simulation: URL, episodes, lease [s], a file in whose absence one dies. Prints their
exit codes."""

import contextlib
import multiprocessing
import os
import signal
import sys
from functools import partial
from pathlib import Path

from synpick_warp.cloud import run
from synpick_warp.system.progress import SilentProgress
from tests.harness import scripted_bake
from tests.harness.scripted_bake import tiny


def bake_or_die(marker: Path, *given):
    """Kill this worker when its first chunk is in the store and not yet marked as done, unless another has died."""
    dies = not marker.exists()
    summary = scripted_bake.bake_episodes(*given, grows=not dies)
    if dies:
        with contextlib.suppress(FileExistsError):
            marker.touch(exist_ok=False)
            os.kill(os.getpid(), signal.SIGKILL)
    return summary


if __name__ == "__main__":
    url, episodes, lease, marker = sys.argv[1:]
    job = run.Job(tiny(int(episodes)), url, bake=partial(bake_or_die, Path(marker)), lease=float(lease))
    start = partial(multiprocessing.get_context("fork").Process, target=run.bake_into_store, args=(job, SilentProgress()))
    workers = [start(kwargs={"claim": True}) for _ in range(3)]
    for each in workers:
        each.start()
    for each in workers:
        each.join()
    print(sorted(each.exitcode for each in workers))
