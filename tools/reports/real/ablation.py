"""Ablation study of domain randomization, amount of data and renderer, on several GPUs within a time limit.

Each run is a process of `tools.reports.real` with one seed. Runs start in order of priority on the next free GPU, the first seed of all
rows before the second. A run that cannot end by the deadline is skipped and printed as "left out". The rows with the most views are
shortened instead, down to a minimum time; the results then name the time. The start-up time of runs is estimated from those that have
ended. Runs with results in --out are not repeated, and the summary is written after each run. Without --out, only the schedule is
printed. Synthetic scores are measured on held-out views of each row's own settings, so rows are comparable by their scores on photographs
only.

    python -m tools.reports.real.ablation --real REAL --models YCB --lights HDRI --gpus 4 --deadline 1400 --out OUT
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from tools.figures import describe_run
from tools.options import Row, finite_seconds, make_parser, positive_count, write_json
from tools.reports.real import OBJECT, interval

START = 60.0
"""Time of a run beside its training [s]: imports, cached kernels, models and lights, held-out views, scores. 50 to 55 on an H200 host."""
STREAM_RATE = 230.0
"""Views/s of still piles at 320x240 with 512 worlds, the first piles counted: 8 views a pile, some 35 ticks to settle. On an H200."""
REFERENCE_RATE = 30.0
"""Views/s of mode reference at 320x240 and 64 paths."""
TRAIN_RATE = 600.0
"""Samples/s of the U-Net of width 48 at 320x240 in bfloat16 on an H200: 0.17 TFLOP a sample."""
DETECTOR = 60.0
"""Training of the detector [s]."""
SLACK = 1.15
"""Safety factor on expected times: a run starts only if so much time is left."""
METRICS = {
    "mean_iou": ("mIoU", "", 1.0),
    "found": ("instances with IoU above 0.5", "%", 100.0),
    "background": ("background taken for objects", "%", 100.0),
    "averaged_mean_iou": ("mIoU, averaged over sizes", "", 1.0),
    "averaged_found": ("instances with IoU above 0.5, averaged over sizes", "%", 100.0),
    "synthetic_mean_iou": ("synthetic mIoU", "", 1.0),
    "ap50": ("AP50", "", 1.0),
}
"""Scores that are collected, by key of a seed's results: label, unit and factor."""
PASSES = 6.0
"""Number of epochs."""
MAIN_PASSES = 16.0
"""Number of epochs of the first row. It is larger than the time limit allows, so that the whole time is used."""
CHOICE = ("--network", "residual", "--width", "64", "--batch", "32", "--depth")
"""Network of the row with the most views."""
MIN_LIMIT = 150.0
"""Shortest time limit of the first row [s]."""
MIN_STEP_VIEWS = 48_000
"""Number of training samples of runs with few views, equal to that of the others."""

CAMERAS = ("2", "5")
"""Cameras of the row with few positions, both 0.86 m from the middle of the table."""
VIEWS = 8
"""Views of a pile with all cameras."""

_OFF = "[0.0, 0.0]"
_EFFECTS = ("vignette", "chromatic_aberration", "blur", "shot_noise", "read_noise", "contrast", "saturation")
HOLES = ("depth_sensor.shadows=false", "depth_sensor.edge_width=0", "depth_sensor.grazing_angle=89")
"""Settings without what makes holes in depth."""
LEVERS: dict[str, tuple[str, ...]] = {
    "places": ("arrangement.drop=layers", "bins.area=[0.8,0.55]"),
    "surfaces": ("randomize.surfaces=0", "randomize.table_color={uniform=[[0.05,0.05,0.05],[0.9,0.9,0.9]]}"),
    "distractors": ("randomize.distractors=off",),
    "effects": ("effects.exposure_jitter=0", "effects.white_balance_jitter=0", *(f"effects.{name}={_OFF}" for name in _EFFECTS)),
    "contrast": (f"effects.contrast={_OFF}", f"effects.saturation={_OFF}"),
    "standing": ("arrangement.upright=0",),
    "lights": ("randomize.lamps=off", "randomize.exposure=off", "effects.exposure_jitter=0"),
    "materials": ("randomize.object_hue=off", "randomize.object_brightness=off", "randomize.object_roughness=off"),
    "edge of the table": ("render.table_size=[0,0]",),
}
"""Settings that switch a part of the randomization off, by its name."""


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
    least: float = math.inf
    """Shortest time limit, used if less time is left [s]; infinite: the limit is fixed."""
    detector: float = 0.0
    """Training time of the detector, if there is enough time left [s]; 0: no detector."""

    @property
    def training(self) -> float:
        """Expected time of rendering and training together [s]."""
        return min(self.limit, self.views / self.rate + self.views * self.passes / TRAIN_RATE)

    def fit(self, left: float, start: float) -> Run | None:
        """Fit the run into the remaining time: shortened limit, and detector only if there is time for it.

        Args:
            left: Time until the deadline [s].
            start: Start-up and scoring time of a run [s].

        Returns:
            The run; None if the time is too short.
        """
        room = left - SLACK * start
        if room < min(self.limit, SLACK * self.training, self.least):
            return None
        limit = min(self.limit, room)
        return replace(self, limit=limit, detector=self.detector if room - limit > self.detector else 0.0)

    def command(self, options: argparse.Namespace, seed: int, gpu: int, stem: str) -> list[str]:
        """Command line of one seed."""
        own_detector = ["--detector", f"{self.detector:g}"] if self.detector else []
        shared = ["--real", options.real, "--models", options.models, "--lights", options.lights, "--device", f"cuda:{gpu}"]
        own = ["--views", str(self.views), "--passes", f"{self.passes:g}", "--seconds", f"{self.limit:g}", "--seeds", "1"]
        files = ["--first-seed", str(seed), "--json", f"{stem}.json", "--name", Path(stem).name, "--pictures", str(Path(stem).parent)]
        return [sys.executable, "-m", "tools.reports.real", *shared, *own, *files, *own_detector, *options.pass_on, *self.arguments]


def _settings(*assignments: str) -> tuple[str, ...]:
    """Arguments of settings."""
    return tuple(word for one in assignments for word in ("--set", one))


def plan(views: int, main_views: int) -> Iterator[Run]:
    """All rows in the order of priority."""
    detector = DETECTOR if find_spec("torchvision") else 0.0
    tote = ("--stride", "3", "--worlds", "64", *_settings("bake.mode=mixed", "cameras.resolution=[320,240]"))
    yield Run("all levers", main_views, passes=MAIN_PASSES, least=MIN_LIMIT, detector=detector)
    yield Run("tote, not randomized", views, ("--config", "synpick", *tote))
    yield Run("tote, randomized", views, ("--config", "randomized", *tote))
    yield Run("all levers, ablation's number of views", views)
    for name, settings in LEVERS.items():
        yield Run(f"without {name}", views, _settings(*settings))
    yield Run("without augmentation of the tensors", views, ("--scale", "1", "--jitter", "0", "--jpeg", "0"))
    yield Run("without photometric augmentation", views, ("--jitter", "0", "--jpeg", "0"))
    yield Run("without JPEG", views, ("--jpeg", "0"))
    yield Run("colour and depth", views, ("--depth",))
    yield Run("colour and depth without holes", views, ("--depth", *_settings(*HOLES)))
    yield Run("two camera positions", views, ("--cameras", *CAMERAS), rate=STREAM_RATE * len(CAMERAS) / VIEWS)
    for amount in (1000, 3000):
        yield Run(f"{amount:,} views", amount, passes=MIN_STEP_VIEWS / amount)
    yield Run("up to 200,000 views", 200_000, ("--capacity", "40000", *CHOICE), passes=2.0, limit=400.0, least=300.0)
    yield Run("2,000 views, fast", 2000, seeds=2, passes=MIN_STEP_VIEWS / 2000)
    traced = _settings("render.mode=reference", "render.samples=64")
    yield Run("2,000 views, path-traced", 2000, (*traced, "--held-out", "16"), 2, MIN_STEP_VIEWS / 2000, REFERENCE_RATE)
    yield Run("without shadows and bounces", views, _settings("render.mode=unoccluded"))


def order(rows: list[Run], preferred: str = "") -> list[tuple[Run, int]]:
    """Runs in the order in which they start: the first row with all seeds, the others by seed; rows whose name begins so before all."""
    first = [(run, seed) for run in rows[:1] for seed in range(run.seeds)]
    rest = [(run, seed) for seed in range(3) for run in rows[1:] if seed < run.seeds]
    return sorted(first + rest, key=lambda job: not (preferred and job[0].name.startswith(preferred)))


def print_plan(jobs: list[tuple[Run, int]], gpus: int, deadline: float) -> None:
    """Print when each run would start and end on as many GPUs."""
    free = [0.0] * gpus
    for run, seed in jobs:
        start = heapq.heappop(free)
        fits = run.fit(deadline - start, START)
        ends = start + START + (fits or run).training + (fits.detector if fits else 0.0)
        heapq.heappush(free, ends if fits else start)
        print(f"{start:6.0f} to {ends:6.0f} s  {ends - start:4.0f} s  seed {seed}  {run.name}{'' if fits else ' (left out)'}")


def execute(jobs: list[tuple[Run, int]], options: argparse.Namespace) -> int:
    """Run all that fits before the deadline, one process a GPU; returns the number of runs that failed or were stopped at the deadline."""
    waiting = [(run, seed) for run, seed in jobs if not (options.out / f"{stem_of(run, seed)}.json").exists()]
    running = dict[int, tuple[subprocess.Popen[bytes], Run, int, Any]]()
    try:
        return _execute(waiting, running, jobs, options)
    finally:
        for process, *_ in running.values():
            process.kill()


def _execute(
    waiting: list[tuple[Run, int]],
    running: dict[int, tuple[subprocess.Popen[bytes], Run, int, Any]],
    jobs: list[tuple[Run, int]],
    options: argparse.Namespace,
) -> int:
    """Loop of `execute` over the runs that wait and, by GPU, those that run."""
    started, failed, start = time.monotonic(), 0, START
    begun = dict[int, float]()
    while waiting or running:
        left = options.deadline - (time.monotonic() - started)
        for gpu, (process, run, seed, log) in list(running.items()):
            if left < 0:
                process.kill()
            if process.poll() is not None:
                log.close()
                failed += process.returncode != 0
                start = max(start, time.monotonic() - begun[gpu] - spent(options.out / f"{stem_of(run, seed)}.json") - run.detector)
                print(
                    f"{time.monotonic() - started:6.0f} s  gpu {gpu}  seed {seed}  {run.name}: exit code {process.returncode}", flush=True
                )
                del running[gpu]
                write_json(options.out / "real_ablation.json", collect(options.out, jobs))
        for gpu in sorted(set(range(options.gpus)) - running.keys()):
            if not waiting:
                break
            run, seed = waiting.pop(0)
            fits = run.fit(left, start)
            if fits is None:
                print(f"left out: seed {seed} of {run.name} needs {start + run.training:.0f} s, {left:.0f} s are left", flush=True)
                continue
            run, begun[gpu] = fits, time.monotonic()
            stem = str(options.out / stem_of(run, seed))
            log = open(f"{stem}.log", "wb")  # noqa: SIM115
            process = subprocess.Popen(run.command(options, seed, gpu, stem), stdout=log, stderr=subprocess.STDOUT)
            running[gpu] = (process, run, seed, log)
        time.sleep(0.5)
    return failed


def spent(path: Path) -> float:
    """Time of a training with its stream, by its results [s]; infinite without."""
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
        limit = min(seed["limit"] for seed in seeds)
        shorter = f"shortest time limit {limit:.0f} s" if limit < min(run.limit - 1.0, SLACK * run.training) else ""
        for metric, (label, unit, factor) in METRICS.items():
            values = [factor * seed[metric] for seed in seeds if seed.get(metric) is not None]
            if values:
                words = " ".join(word for word in (unit, interval(values), shorter) if word)
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
    parser.add_argument("--first", default="", metavar="NAME", help="rows whose name begins so start before all others")
    parser.add_argument("--out", type=Path, help="existing folder to write to; without it the plan is printed")
    parser.add_argument("pass_on", nargs="*", help="more arguments of tools.reports.real for all runs, after --")
    options = parser.parse_args(arguments)
    jobs = order(list(plan(options.views, options.main_views)), options.first)
    if options.out is None:
        print_plan(jobs, options.gpus, options.deadline)
    elif not options.out.is_dir():
        print(f"reports.real.ablation: --out is {options.out}; name a folder that exists", file=sys.stderr)
        return 2
    else:
        return 1 if execute(jobs, options) else 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
