"""Start of a bake into an object store: in this process, by a claiming worker on each of several devices, or by those of a Ray cluster.

Apart from `run`, which the workers import.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from synpick_warp.cloud.crew import Crew
from synpick_warp.cloud.device_workers import bake_with_devices
from synpick_warp.cloud.ray_engine import bake_with_ray
from synpick_warp.cloud.run import Job, bake_into_store
from synpick_warp.errors import ConfigError
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.system.progress import Progress


def start_bake(
    job: Job,
    progress: Progress,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] = (),
    *,
    claim: bool = False,
    crew: Crew | None = None,
) -> BakeSummary:
    """Bake a data set into an object store; arguments as of `run.bake_into_store`.

    Args:
        job: What to bake; `splits` take the place of its own.
        crew: Options of a bake on Ray; or receives number and time of claiming workers on these devices; None: neither.

    Raises:
        ConfigError: Claims share out the episodes, and so does `shard`; a cluster's devices are its own.
        SynpickError: As `run.bake_into_store`.
    """
    job = replace(job, splits=tuple(splits))
    engine = crew is not None and crew.engine != ""
    if (claim or engine) and shard != (0, 1):
        raise ConfigError("workers that claim share out the episodes among them; drop the shard")
    if crew is not None and engine:
        if devices:
            raise ConfigError("an engine places one worker a GPU or core of its cluster; drop the devices")
        return bake_with_ray(job, crew, progress)
    if claim and devices:
        return bake_with_devices(job, devices, progress, crew)
    return bake_into_store(job.config, job.url, progress, shard, splits, devices, claim=claim)
