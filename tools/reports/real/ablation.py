"""Ablation study of domain randomization, amount of data and renderer, on several GPUs within a time limit.

Each row is a run of `tools.reports.real` for each seed. Runs start in order of priority on the next free GPU: the first seed of all rows
before the second. A process of a GPU serves many runs. A run that cannot end by the deadline is skipped and printed as "left out". Times of
runs are estimated from those that have ended. Runs with results in --out are not repeated, and the summary is written after each run.
Without --out, only the schedule is printed. All rows are scored on the same photographs and on the same held-out views, which have the full
randomization.

    python -m tools.reports.real.ablation --real REAL --models YCB --lights HDRI --gpus 4 --deadline 1400 --out OUT
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from tools.figures import describe_run
from tools.options import Row, finite_seconds, make_parser, positive_count, write_json
from tools.reports.real import OBJECT, interval
from tools.reports.real.worker import Worker

START = 60.0
"""Overhead of a process's first run, beside its training [s]: imports, loading of kernels and photographs, held-out views, scoring."""
BETWEEN = 15.0
"""Overhead of a later run [s]: scoring, writing of files."""
FIRST_VIEWS = 20.0
"""Start-up time of a stream [s]: loading of models and lights, construction of 512 worlds, settling of the first piles (some 35 ticks)."""
STREAM_RATE = 650.0
"""Throughput of a stream after its start-up [views/s]: still piles, 8 views each, 640x480, on an H100."""
REFERENCE_RATE = 7.5
"""Throughput of the path tracer [views/s]: 640x480, 64 paths a pixel."""
TRAIN_RATE = 500.0
"""Training throughput of the U-Net of width 48 [samples/s]: 320x240 pixels a sample, bfloat16, on an H100."""
DETECTOR = 120.0
"""Training time of the detector [s]."""
SLACK = 1.15
"""Safety factor on expected times: a run starts only if its expected time times SLACK is left."""
MAX_FAILURES = 3
"""Number of consecutive failures after which a GPU gets no more runs."""
METRICS = {
    "mean_iou": ("mIoU", "", 1.0),
    "found": ("instances with IoU above 0.5", "%", 100.0),
    "background": ("background taken for objects", "%", 100.0),
    "synthetic_mean_iou": ("synthetic mIoU", "", 1.0),
    "ap50": ("AP50", "", 1.0),
}
"""Scores that are collected, by key of a seed's results: label, unit and factor."""
PASSES = 6.0
"""Number of epochs."""
MAIN_PASSES = 16.0
"""Number of epochs of the first row. It is larger than the time limit allows, so that the whole time is used."""
SAMPLES = 48_000
"""Number of training samples of the baseline and of the rows with fewer views."""
TRACED_LIMIT = 480.0
"""Time limit of the row with path-traced views [s]: their stream takes 130 s."""

CAMERAS = ("2", "5")
"""Cameras of the row with few positions, both 0.86 m from the middle of the table."""
VIEWS = 8
"""Views of a pile with all cameras."""

_OFF = "[0.0, 0.0]"
_EFFECTS = ("vignette", "chromatic_aberration", "blur", "shot_noise", "read_noise", "contrast", "saturation")
COMPONENTS: dict[str, tuple[str, ...]] = {
    "places": ("arrangement.drop=layers", "bins.area=[0.8,0.55]"),
    "surfaces": ("randomize.surfaces=0", "randomize.table_color={uniform=[[0.05,0.05,0.05],[0.9,0.9,0.9]]}"),
    "distractors": ("randomize.distractors=off",),
    "effects": ("effects.exposure_jitter=0", "effects.white_balance_jitter=0", *(f"effects.{name}={_OFF}" for name in _EFFECTS)),
    "standing": ("arrangement.upright=0",),
    "lights": ("randomize.lamps=off", "randomize.exposure=off", "effects.exposure_jitter=0"),
    "materials": ("randomize.object_hue=off", "randomize.object_brightness=off", "randomize.object_roughness=off"),
}
"""Components of the randomization: the settings that switch each off."""


@dataclass(frozen=True)
class Run:
    """Row of the ablation, one run for each seed: its own arguments of `tools.reports.real`, and what its time follows from."""

    name: str
    views: int
    arguments: tuple[str, ...] = ()
    seeds: int = 3
    passes: float = PASSES
    rate: float = STREAM_RATE
    limit: float = 280.0
    """Time limit of rendering and training together [s]."""
    detector: float = 0.0
    """Training time of the detector, if there is enough time left [s]; 0: no detector."""

    @property
    def training(self) -> float:
        """Expected time of rendering and training together [s]."""
        return min(self.limit, FIRST_VIEWS + self.views / self.rate + self.views * self.passes / TRAIN_RATE)

    def fit(self, left: float, start: float, slowdown: float = 1.0) -> Run | None:
        """Fit the run into the remaining time, without its detector if there is no time for that.

        Args:
            left: Time until the deadline [s].
            start: Time of the run beside its training [s].
            slowdown: Factor on the expected time of its training.

        Returns:
            The run; None if the time is too short.
        """
        room = left - SLACK * start
        if room < min(self.limit, SLACK * slowdown * self.training):
            return None
        return replace(self, detector=self.detector if room - self.limit > self.detector else 0.0)

    def command(self, seed: int, stem: Path) -> list[str]:
        """Arguments of one seed, beside those that all runs share."""
        own_detector = ["--detector", f"{self.detector:g}"] if self.detector else []
        own = ["--views", str(self.views), "--passes", f"{self.passes:g}", "--seconds", f"{self.limit:g}", "--seeds", "1"]
        files = ["--first-seed", str(seed), "--json", f"{stem}.json", "--name", stem.name, "--pictures", str(stem.parent)]
        return [*own, *files, *own_detector, *self.arguments]


def _settings(*assignments: str) -> tuple[str, ...]:
    """Arguments of settings."""
    return tuple(word for one in assignments for word in ("--set", one))


def plan(views: int, main_views: int) -> Iterator[Run]:
    """Yield all rows in order of priority. The second one, with the full randomization, is the baseline of the ablation."""
    tote = ("--stride", "3", "--worlds", "64", *_settings("bake.mode=mixed", "cameras.resolution=[320,240]"))
    yield Run(f"{main_views:,} views", main_views, passes=MAIN_PASSES, detector=DETECTOR if find_spec("torchvision") else 0.0)
    yield Run(f"{views:,} views", views)
    yield Run("tote, not randomized", views, ("--config", "synpick", *tote))
    yield Run("tote, randomized", views, ("--config", "randomized", *tote))
    for name, settings in COMPONENTS.items():
        yield Run(f"without {name}", views, _settings(*settings))
    for amount in (1000, 3000):
        yield Run(f"{amount:,} views", amount, passes=SAMPLES / amount)
    traced = _settings("render.mode=reference", "render.samples=64")
    yield Run("1,000 views, path-traced", 1000, traced, passes=SAMPLES / 1000, rate=REFERENCE_RATE, limit=TRACED_LIMIT)
    yield Run("without shadows and bounces", views, _settings("render.mode=unoccluded"))
    yield Run("two camera positions", views, ("--cameras", *CAMERAS), rate=STREAM_RATE * len(CAMERAS) / VIEWS)
    yield Run("without augmentation of the tensors", views, ("--scale", "1", "--jitter", "0", "--jpeg", "0"))
    yield Run("colour and depth", views, ("--depth",))


def order(rows: list[Run]) -> list[tuple[Run, int]]:
    """Execution order of the runs: all seeds of the first row, then the other rows by seed."""
    jobs = [(run, seed) for run in rows for seed in range(run.seeds)]
    return sorted(jobs, key=lambda job: -1 if job[0] is rows[0] else job[1])


def print_plan(jobs: list[tuple[Run, int]], gpus: int, deadline: float) -> None:
    """Print the schedule on a number of GPUs: expected start and end of each run."""
    free = [(0.0, START)] * gpus
    for run, seed in jobs:
        begun, start = heapq.heappop(free)
        fits = run.fit(deadline - begun, start)
        ends = begun + start + (fits or run).training + (fits.detector if fits else 0.0)
        heapq.heappush(free, (ends, BETWEEN) if fits else (begun, start))
        print(f"{begun:6.0f} to {ends:6.0f} s  {ends - begun:4.0f} s  seed {seed}  {run.name}{'' if fits else ' (left out)'}")


class Execution:
    """Parallel execution of all runs that fit before the deadline, by a thread and a worker for each GPU."""

    def __init__(self, jobs: list[tuple[Run, int]], options: argparse.Namespace) -> None:
        self.jobs, self.options, self.started = jobs, options, time.monotonic()
        self.waiting = iter([job for job in jobs if not self.stem(*job).with_suffix(".json").exists()])
        self.lock, self.failed = threading.Lock(), 0
        """Number of runs that failed or were stopped at the deadline."""
        self.start = {False: START, True: BETWEEN}
        """Expected time of a run beside its training, in a process that is to be started and in one that runs [s]."""
        self.slowdowns: list[float] = []
        """Time of each ended training, as a multiple of the expected one."""

    def run(self) -> int:
        """Carry out the runs; returns how many failed or were stopped."""
        gpus = [gpu for _ in range(self.options.processes) for gpu in range(self.options.gpus)]
        with ThreadPoolExecutor(len(gpus)) as threads:
            try:
                list(threads.map(self._serve, gpus))
            finally:
                self.waiting = iter(())  # After an interruption, no thread starts another.
        return self.failed

    def stem(self, run: Run, seed: int) -> Path:
        """Path of a run's files without suffix."""
        return self.options.out / stem_of(run, seed)

    @property
    def now(self) -> float:
        """Time since the start [s]."""
        return time.monotonic() - self.started

    def _serve(self, gpu: int) -> None:
        """Carry out runs by a process on a GPU until no remaining run fits, or MAX_FAILURES in a row have failed."""
        options = self.options
        shared = ["--real", options.real, "--models", options.models, "--lights", options.lights, "--device", f"cuda:{gpu}"]
        worker, failures = Worker([*shared, *options.pass_on]), 0
        try:
            while failures < MAX_FAILURES and (job := self._take(worker.ready)):
                run, seed = job
                stem, begun, ready = self.stem(*job), self.now, worker.ready
                done = worker.run(run.command(seed, stem), stem.with_suffix(".log"), options.deadline - begun)
                failures = 0 if done else failures + 1
                self._finish(f"gpu {gpu}  seed {seed}  {run.name}", done)
                training = spent(stem.with_suffix(".json"))
                self.start[ready] = max(self.start[ready], self.now - begun - training - run.detector)
                self.slowdowns += [training / run.training] if done else []
        finally:
            worker.stop()

    def _take(self, ready: bool) -> tuple[Run, int] | None:
        """Take the next run that fits into the remaining time, and shorten it if needed. Runs that do not fit are printed as left out."""
        with self.lock:
            for run, seed in self.waiting:
                left = self.options.deadline - self.now
                slowdown = max(self.slowdowns, default=float(self.options.processes))
                if fits := run.fit(left, self.start[ready], slowdown):
                    return fits, seed
                needed = self.start[ready] + slowdown * run.training
                print(f"left out: seed {seed} of {run.name} needs {needed:.0f} s, {left:.0f} s are left", flush=True)
            return None

    def _finish(self, name: str, done: bool) -> None:
        """Print how a run ended, and write the summary."""
        with self.lock:
            self.failed += not done
            print(f"{self.now:6.0f} s  {name}: {'done' if done else 'failed or stopped'}", flush=True)
            write_json(self.options.out / "real_ablation.json", collect(self.options.out, self.jobs))


def spent(path: Path) -> float:
    """Wall time of a run's training, its stream included, from its results file [s]; infinity if there is no such file."""
    return json.loads(path.read_text())["more"]["seeds"][0]["seconds"] if path.exists() else math.inf


def stem_of(run: Run, seed: int) -> str:
    """Name of a run's files without suffix."""
    words = "".join(letter if letter.isalnum() else "_" for letter in run.name)
    return f"{words}_{seed}"


def collect(folder: Path, jobs: list[tuple[Run, int]]) -> dict[str, Any]:
    """Results as JSON: means over seeds of all rows that have some, with 95 % intervals by Student's t, without those by object; scores
    and times of seeds."""
    rows: list[Row] = []
    times: dict[str, Any] = {}
    for run in dict.fromkeys(run for run, _ in jobs):
        paths = [folder / f"{stem_of(run, seed)}.json" for seed in range(run.seeds)]
        documents = [json.loads(path.read_text()) for path in paths if path.exists()]
        seeds = [document["more"]["seeds"][0] for document in documents]
        if not seeds:
            continue
        for metric, (label, unit, factor) in METRICS.items():
            values = [factor * seed[metric] for seed in seeds if seed.get(metric) is not None]
            if values:
                words = " ".join(word for word in (unit, interval(values)) if word)
                rows.append(Row(f"{run.name}: {label}", round(float(np.mean(values)), 4), words, part=run.name))
        objects = [{row["name"]: row["value"] for row in document["rows"] if row["part"] == OBJECT} for document in documents]
        rows += [Row(name, round(float(np.mean([one[name] for one in objects])), 4), part=run.name) for name in objects[0]]
        times[run.name] = {
            name: [seed[name] for seed in seeds] for name in ("views", "samples", "seconds", "stream_seconds", "limit", *METRICS)
        }
    return describe_run("tools.reports.real.ablation", (), rows, seeds=times)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code: 1 if a run failed."""
    parser = make_parser(__doc__, "models", "lights")
    parser.add_argument("--real", required=True, help="folder of annotated frames")
    parser.add_argument("--gpus", type=positive_count, default=4, help="GPUs of the host (default: 4)")
    parser.add_argument("--deadline", type=finite_seconds, default=1400.0, help="seconds after which nothing runs (default: 1400)")
    parser.add_argument("--views", type=positive_count, default=8000, help="views of the rows of the ablation (default: 8000)")
    parser.add_argument("--main-views", type=positive_count, default=24_000, help="views of the first row (default: 24000)")
    text = "processes of each GPU: one trains while another starts its stream or is scored (default: 1)"
    parser.add_argument("--processes", type=positive_count, default=1, help=text)
    parser.add_argument("--skip", nargs="+", default=[], metavar="NAME", help="rows that are left out")
    parser.add_argument("--out", type=Path, help="existing folder to write to; without it the plan is printed")
    parser.add_argument("pass_on", nargs="*", help="more arguments of tools.reports.real for all runs, after --")
    options = parser.parse_args(arguments)
    rows = list(plan(options.views, options.main_views))
    names = [run.name for run in rows]
    for name in options.skip:
        if name not in names:
            print(f"reports.real.ablation: --skip is {name}; rows: {'; '.join(names)}", file=sys.stderr)
            return 2
    jobs = [(run, seed) for run, seed in order(rows) if run.name not in options.skip]
    if options.out is None:
        print_plan(jobs, options.gpus, options.deadline)
        return 0
    if not options.out.is_dir():
        print(f"reports.real.ablation: --out is {options.out}; name a folder that exists", file=sys.stderr)
        return 2
    return 1 if Execution(jobs, options).run() else 0


if __name__ == "__main__":
    sys.exit(main())
