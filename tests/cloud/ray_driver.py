"""Program that bakes without simulation on a Ray cluster of its own: URL, episodes, workers, a file in whose absence a worker dies."""

from __future__ import annotations

import functools
import os
import signal
import sys
from pathlib import Path

from rich.console import Console

from synpick_warp.cli.display import make_progress
from synpick_warp.cloud.ray_engine import bake_with_ray
from synpick_warp.cloud.run import Crew, Job
from tests.cloud.conftest import tiny
from tests.harness import scripted_bake


def bake_or_die(marker: str, config, out, progress, *given):
    """Kill this process, and so the worker, in the first chunk of all."""
    if not Path(marker).exists():
        Path(marker).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return scripted_bake.bake_episodes(config, out, progress, *given)


if __name__ == "__main__":
    url, episodes, workers, marker = sys.argv[1:]
    crew = Crew(price=3600.0)
    config = tiny(int(episodes)).with_values({"bake.device": "cpu"})
    from tests.cloud import ray_driver  # Workers import it by this name.

    with make_progress(Console(), crew) as progress:
        job = Job(config, url, bake=functools.partial(ray_driver.bake_or_die, marker), lease=3.0)
        summary = bake_with_ray(job, "ray", int(workers), progress, crew)
    print(f"{len(summary.episodes)} of {summary.total} episodes by {crew}")
