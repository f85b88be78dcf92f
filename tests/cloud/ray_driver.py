"""Program that bakes without simulation on a Ray cluster of its own: URL, episodes, workers, a file in whose absence a worker dies."""

import functools
import sys
from pathlib import Path

from rich.console import Console

from synpick_warp.cli.display import make_progress
from synpick_warp.cloud.run import Crew, Job
from synpick_warp.cloud.workers import bake_with_ray
from tests.cloud.claiming_worker import bake_or_die
from tests.harness.scripted_bake import tiny

if __name__ == "__main__":
    url, episodes, workers, marker = sys.argv[1:]
    crew = Crew(price=3600.0)
    config = tiny(int(episodes)).with_values({"bake.device": "cpu"})
    with make_progress(Console(), crew) as progress:
        job = Job(config, url, bake=functools.partial(bake_or_die, Path(marker)), lease=3.0)
        summary = bake_with_ray(job, "ray", int(workers), progress, crew)
    print(f"{len(summary.episodes)} of {summary.total} episodes by {crew}")
