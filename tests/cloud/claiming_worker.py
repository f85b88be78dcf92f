"""Program of a claiming worker that bakes without simulation: URL, number of episodes, lease [s]. Prints a line when it starts."""

from __future__ import annotations

import sys
from functools import partial

from synpick_warp.cloud import run
from synpick_warp.system.progress import SilentProgress
from tests.cloud.conftest import tiny
from tests.harness import scripted_bake

if __name__ == "__main__":
    job = run.Job(tiny(int(sys.argv[2])), sys.argv[1], bake=partial(scripted_bake.bake_episodes, grows=True), lease=float(sys.argv[3]))
    print("claiming", flush=True)
    run.bake_into_store(job, SilentProgress(), claim=True)
