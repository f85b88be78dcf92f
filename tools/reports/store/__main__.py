"""Report on bakes into an object store by 1 to thousands of claiming workers: rate, waste, requests, cost, time of finalization.

python -m tools.reports.store --workers 1,8,64,512,4096 --episodes 1000000 --json FILE
"""

from __future__ import annotations

import sys
from collections.abc import Iterator

from synpick_warp.system.hardware.device import pick_device
from tools.figures import finish_report
from tools.options import Row, make_parser, number_in, positive_count
from tools.reports.store.model import Limits, Machine, Replication, Simulation, measured_machine

INDICES = 0.0007
"""Time of the indices for an episode of shards, 3 cameras and 504 frames [s] (tools/results/store_indices.json)."""
VARIANTS = ((512, 1, 0), (4096, 64, 128), (10_000, 64, 128))
"""Columns besides: GPUs, partitions of the prefix, episodes of a chunk (0: that of a bake)."""


def describe(part: str, out: Replication, machine: Machine, limits: Limits) -> Iterator[Row]:
    """Rows of a simulated bake."""
    gpus, requests = out.price(machine, limits)
    yield Row("views", out.views / out.seconds, "1/s", part=part)
    yield Row("bake", out.seconds / 3600.0, "h", part=part)
    yield Row("of the GPUs' rate without store", 100.0 * out.views / (out.busy * machine.rate), "%", part=part)
    yield Row("waste", 100.0 * out.wasted / (out.views + out.wasted), "%", part=part)
    yield Row("machines lost", out.losses, part=part)
    for kind in ("write", "read", "list", "claim"):
        yield Row(f"requests: {kind}", 1e-6 * (out.requests[kind] + out.requests["heartbeat"] * (kind == "claim")), "million", part=part)
    yield Row("answers 503", 1e-6 * out.refused, "million", part=part)
    yield Row("cost: GPUs", gpus, "USD", part=part)
    yield Row("cost: requests", requests, "USD", part=part)
    yield Row("finalization", out.finalization / 3600.0, "h", part=part)


def main() -> int:
    """Run the command line; returns the exit code."""
    counts = {"type": lambda text: [positive_count(each) for each in text.split(",")]}
    options = make_parser(
        __doc__,
        "json",
        own={
            "workers": counts | {"default": [1, 8, 64, 512, 4096], "help": "numbers of GPUs (default: 1,8,64,512,4096)"},
            "episodes": {"type": positive_count, "default": 1_000_000, "help": "episodes of the set (default: %(default)s)"},
            "losses": {"type": number_in(0.0), "default": 2.0, "help": "losses of a spot machine a day (default: %(default)s)"},
            "partitions": {"type": positive_count, "default": 64, "help": "partitions of the prefix in the store (default: %(default)s)"},
            "chunk": {"type": positive_count, "default": 0, "help": "episodes of a whole chunk (default: that of a bake)"},
        },
    ).parse_args()
    machine, rows = measured_machine()._replace(losses=options.losses), list[Row]()
    for workers, partitions, chunk in (*((workers, options.partitions, options.chunk) for workers in options.workers), *VARIANTS):
        limits = Limits(partitions=partitions)
        simulation = Simulation(workers, options.episodes, machine, limits, chunk=chunk, finalization=INDICES)
        part = f"{workers:,} GPU{'s' * (workers > 1)}" + ", one partition" * (partitions == 1) + f", chunks of {chunk}" * bool(chunk)
        rows += describe(part, simulation.run(), machine, limits)
    assumed = {"machine": machine._asdict(), "store": Limits(partitions=options.partitions)._asdict()}
    return finish_report("tools.reports.store", options.json, pick_device("cpu"), "", "bakes into a store", rows, assumed=assumed)


if __name__ == "__main__":
    sys.exit(main())
