"""Samples per second of a training loop from a store beside the local disk, and CPU time of an upload.

    python -m tests.harness.store_reading DATA --json FILE
    AWS_ENDPOINT_URL=http://127.0.0.1:9000 python -m tests.harness.store_reading DATA --bucket s3://BUCKET    # another server

DATA has the formats bop and shards. Without --bucket, moto's server is started in a process of its own.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Iterable, Iterator
from itertools import islice
from pathlib import Path
from uuid import uuid4

import webdataset

import synpick_warp
from synpick_warp.cloud.delivery import Delivery, send_file
from synpick_warp.cloud.ledger import Ledger
from synpick_warp.cloud.reading import list_shards, stream_shards
from synpick_warp.dataset.commit.manifest import INDICES, read_checksums
from synpick_warp.dataset.pytorch import Views
from synpick_warp.dataset.reading import open_data_set
from synpick_warp.dataset.webdataset import decode_view
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.stores.opening import open_store, probe
from tools.figures import finish_report
from tools.options import Row, make_parser

FIELDS = ("rgb", "depth", "boxes", "object_ids")
SHARD_BYTES = 100_000_000
"""Size of the large file [B]."""
SAMPLES = 60
"""Views of a measurement."""


def measure_upload(data: Path, url: str) -> Iterator[Row]:
    """Upload a copy of a data set as a bake does, all but the simulation."""
    store = open_store(url)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(shutil.copytree(data, Path(name) / "set"))
        files = [path for path in folder.rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files)
        ledger = Ledger(store, open_data_set(data).config, probe(store))
        views = len(Views(data))
        wall, cpu = time.perf_counter(), time.process_time()
        with Delivery(ledger, folder) as delivery:
            delivery.finish()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    for name in read_checksums(data, INDICES):
        store.put_file(name, data / name)
    for suffix in (".sha256", ".json"):
        store.put_file(f"{INDICES}{suffix}", data / f"{INDICES}{suffix}")
    yield Row("files", len(files), part="upload of all formats")
    yield Row("size of a view", 1e-3 * size / views, "kB", part="upload of all formats")
    yield Row("CPU time of a view", 1e3 * cpu / views, "ms", part="upload of all formats")
    yield Row("CPU time of a file", 1e3 * cpu / len(files), "ms", part="upload of all formats")
    yield Row("rate", 1e-6 * size / wall, "MB/s", part="upload of all formats")


def measure_shard(url: str) -> Iterator[Row]:
    """Upload one large file: a pass for its checksum, and one in parts."""
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / "shard.tar"
        path.write_bytes(random.Random(0).randbytes(SHARD_BYTES))
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        wall, cpu = time.perf_counter(), time.process_time()
        send_file(open_store(url), path, path.name, digest)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    yield Row("CPU time of 100 MB", cpu, "s", part="upload of a shard")
    yield Row("CPU time of a view of 0.43 MB", 1e3 * cpu * 0.43e6 / SHARD_BYTES, "ms", part="upload of a shard")
    yield Row("rate", 1e-6 * SHARD_BYTES / wall, "MB/s", part="upload of a shard")


def rate(samples: Iterable[object]) -> float:
    """Samples per second, of the first SAMPLES."""
    started = time.perf_counter()
    count = sum(1 for _ in islice(samples, SAMPLES))
    return count / (time.perf_counter() - started)


def shuffled(views: Views) -> Iterator[object]:
    """Views in random order, SAMPLES of them."""
    order = random.Random(0).choices(range(len(views)), k=SAMPLES)
    return (views[index] for index in order)


def measure_reading(data: Path, url: str) -> Iterator[Row]:
    """Read the set by webdataset's line, and by our dataset: in random order, first with an empty cache, then from it."""
    stream_shards()
    shards = {"local disk": sorted(str(path) for path in data.glob("*_web/*.tar")), "store": list_shards(url)}
    for part, places in shards.items():
        opened = webdataset.WebDataset(places, shardshuffle=False).decode(decode_view)
        yield Row("webdataset", rate(opened), "1/s", part=part)
    for part, place in {"local disk": data, "store": url}.items():
        views = Views(synpick_warp.open(place), fields=FIELDS)
        yield Row("Views, first epoch", rate(shuffled(views)), "1/s", part=part)
        yield Row("Views, later epochs", rate(shuffled(views)), "1/s", part=part)


def start_moto() -> subprocess.Popen[bytes]:
    """Start moto's server with a bucket, and set the variables by which clients find it."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        port = found.getsockname()[1]
    server = subprocess.Popen([sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)], stderr=subprocess.DEVNULL)
    given = {"ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret", "REGION": "us-east-1", "ENDPOINT_URL": f"http://127.0.0.1:{port}"}
    os.environ.update({f"AWS_{name}": value for name, value in given.items()})
    for _ in range(100):
        try:
            urllib.request.urlopen(urllib.request.Request(f"http://127.0.0.1:{port}/bucket", method="PUT")).close()
            return server
        except OSError:
            time.sleep(0.2)
    raise RuntimeError("moto's server did not start")


def main() -> int:
    """Run the command line; returns the exit code."""
    own = {"bucket": {"default": "", "help": "s3://BUCKET of a running server"}}
    parser = make_parser(__doc__, "json", own=own)
    parser.add_argument("data", type=Path)
    options = parser.parse_args()
    server = None if options.bucket else start_moto()
    try:
        url = f"{options.bucket or 's3://bucket'}/{uuid4().hex[:8]}/set"
        rows = [*measure_upload(options.data, url), *measure_shard(f"{url}-shard"), *measure_reading(options.data, url)]
    finally:
        if server is not None:
            server.kill()
    return finish_report("tests.harness.store_reading", options.json, pick_device("cpu"), "", "reading from a store", rows)


if __name__ == "__main__":
    sys.exit(main())
