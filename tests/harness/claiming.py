"""Requests of real claiming workers, counted by an S3 server of this process, beside those that tools.reports.store predicts.

A bake of a quarter of the episodes by one worker tells what a set needs once; the others are predicted from there.

    python -m tests.harness.claiming --workers 1,2,4,8 --episodes 64 --json FILE
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import urllib.request
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

from synpick_warp.system.hardware.device import pick_device
from tests.cloud.conftest import Server, tiny
from tools.figures import finish_report
from tools.options import Row, make_parser, positive_count
from tools.reports.store.model import Limits, Machine, Simulation

LEASE = 60
"""Lease of the workers [s]: no heartbeat is due in a chunk, which takes a second."""
FILES = 24
"""Files of an episode of these settings."""
KINDS = {"PUT": "write", "POST": "write", "GET": "read", "HEAD": "read"}
"""Request method -> kind in the model."""
BOOT, SECONDS, LATENCY = 5.0, 0.3, 0.004
"""Start of a worker, an episode, a request on this machine, about [s]: they decide how often workers collide."""


def count_requests(workers: int, episodes: int) -> tuple[Counter[str], float]:
    """Let workers bake a set into a server; returns requests by kind, and the time [s]."""
    server, counts, bucket = Server(), Counter[str](), f"b{uuid4().hex[:12]}"

    def count(method: str, path: str) -> None:
        key = path.partition("/sets/one/")[2]
        claimed = key.startswith(".store/claims/") and method == "PUT" and "indices" not in key
        counts["list" if method == "GET" and not key else "claim" if claimed else KINDS.get(method, "delete")] += 1

    urllib.request.urlopen(urllib.request.Request(f"{server.address}/{bucket}", method="PUT")).close()
    server.fault = count
    given = {"ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret", "REGION": "us-east-1", "ENDPOINT_URL": server.address}
    environment = os.environ | {f"AWS_{name}": value for name, value in given.items()}
    command = [sys.executable, "-m", "tests.cloud.claiming_worker", f"s3://{bucket}/sets/one", str(episodes), str(LEASE)]
    started = time.perf_counter()
    running = [subprocess.Popen(command, env=environment, cwd=Path(__file__).parents[2]) for _ in range(workers)]
    codes = [each.wait() for each in running]
    server.close()
    if any(codes):
        raise RuntimeError(f"workers ended with {codes}")
    return counts, time.perf_counter() - started


def predict_requests(workers: int, episodes: int) -> Counter[str]:
    """Requests by the model, without those that a set needs once."""
    machine = Machine(start=0.0, rate=1.0 / SECONDS, views=1.0, view_bytes=1e4, files=FILES, boot=BOOT, worlds=tiny().bake.worlds or 1)
    return Simulation(workers, episodes, machine, Limits(latency=LATENCY), chunk=max(1, episodes // 32)).run().requests


def compare(workers: list[int], episodes: int) -> Iterator[Row]:
    """Rows of requests, by kind: counted and predicted."""
    few = episodes // 4
    counted, expected = count_requests(1, few)[0], predict_requests(1, few)
    once = {kind: counted[kind] - expected[kind] for kind in ("write", "read", "list", "claim")}
    yield from (Row(f"once: {kind}", count, part="a set") for kind, count in once.items())
    for number in workers:
        counted, seconds = count_requests(number, episodes)
        expected = predict_requests(number, episodes)
        part = f"{number} workers"
        for kind, count in once.items():
            yield Row(f"{kind}: counted", counted[kind], part=part)
            yield Row(f"{kind}: predicted", expected[kind] + count, part=part)
        yield Row("start to exit", seconds, "s", part=part)


if __name__ == "__main__":
    numbers = {"type": lambda text: [positive_count(each) for each in text.split(",")], "default": [1, 2, 4, 8]}
    count = {"type": positive_count, "default": 64, "help": "episodes of the set (default: 64)"}
    options = make_parser(
        __doc__, "json", own={"workers": numbers | {"help": "numbers of workers (default: 1,2,4,8)"}, "episodes": count}
    ).parse_args()
    rows = list(compare(options.workers, options.episodes))
    sys.exit(finish_report("tests.harness.claiming", options.json, pick_device("cpu"), "requests", "claiming workers", rows))
