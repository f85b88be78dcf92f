"""Hyper-parameter search on synthetic views: trials train on one pool of views, each for --seconds, and are ranked by held-out mIoU.

A trial names the hyper-parameters that it changes, as `dice=1,batch=48`; `base` changes none. Photographs are scored too, into the
trial's JSON only: they are not printed, and nothing is chosen by them. Trials with results in --out are not repeated.

    python -m tools.reports.real.tuning --real REAL --models YCB --lights HDRI --passes 1000 --seconds 90 --out OUT base dice=1
"""

from __future__ import annotations

import argparse
import sys
import time
from dataclasses import fields, replace
from pathlib import Path

from synpick_warp.errors import ConfigError, SynpickError
from tools.options import fail, finite_seconds, number_in, positive_count, write_json
from tools.reports.real.__main__ import MODELS, RANGES, Outcome, make_options, measure, open_bench, recipe_of, source_of
from tools.reports.real.networks import NETWORKS
from tools.reports.real.training import Recipe, train
from tools.reports.real.views import Pool

SLACK = 15.0
"""Time that a trial takes beside its training, for scores and files [s]."""


SHARED = ("views", "capacity", "seconds", "depth", "compile")
"""Hyper-parameters that all trials share, by the options of these names."""


def changed(recipe: Recipe, text: str) -> Recipe:
    """Recipe with the changes that a trial names.

    Raises:
        ConfigError: There is no such hyper-parameter, trials share it, or its value has another type or is out of range.
    """
    types = {one.name: type(getattr(recipe, one.name)) for one in fields(recipe) if one.name not in SHARED}
    changes: dict[str, object] = {}
    for part in [] if text == "base" else text.split(","):
        name, _, value = part.partition("=")
        try:
            changes[name] = types[name](value)
            if name == "network" and value not in NETWORKS:
                raise ValueError
            if types[name] is not str:
                (positive_count if types[name] is int else RANGES.get(name, number_in(0.0)))(value)
        except (KeyError, ValueError, argparse.ArgumentTypeError):
            raise ConfigError(f"a trial has {part}; allowed: NAME=VALUE of {', '.join(types)}") from None
    return replace(recipe, **changes)


def entry(text: str, outcome: Outcome) -> dict[str, object]:
    """Results of a trial."""
    trained, synthetic, real = outcome.trained, outcome.synthetic, outcome.real
    scored = {"mean_iou": synthetic.mean_iou, "found": synthetic.found, "background": synthetic.background, "iou": synthetic.iou}
    spent = {"views": trained.views, "samples": trained.samples, "seconds": trained.seconds, "losses": trained.losses}
    return {"trial": text, "synthetic": scored, **spent, "photographs": {"mean_iou": real.mean_iou, "found": real.found}}


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    parser = make_options(__doc__)
    parser.add_argument("--out", type=Path, required=True, help="existing folder to write to")
    parser.add_argument("--deadline", type=finite_seconds, default=500.0, help="seconds after which no trial ends (default: 500)")
    parser.add_argument("--prefix", default="", help="first part of the names of files, of what all trials share")
    parser.add_argument("trials", nargs="+", metavar="TRIAL", help="base, or NAME=VALUE joined by commas")
    options, started = parser.parse_args(arguments), time.perf_counter()
    try:
        if not options.out.is_dir():
            raise ConfigError(f"--out is {options.out}; name a folder that exists")
        recipes = {text: changed(recipe_of(options), text) for text in options.trials}
        paths = {text: options.out / f"{options.prefix}{text}.json" for text in recipes}
        waiting = [text for text in recipes if not paths[text].exists()]
        if not waiting:
            return 0
        seed = options.first_seed
        with open_bench(options) as bench:
            source, pool = source_of(options, seed, bench.device), Pool(options.views, seed)
            pool.fill(source.batches(options.views), options.views, options.seconds)
            print(f"{pool.seen} views after {time.perf_counter() - started:.0f} s (stream {pool.seconds:.1f})", flush=True)
            for text in waiting:
                if time.perf_counter() - started + options.seconds + SLACK > options.deadline:
                    print(f"left out: {text}")
                    continue
                trained, _ = train(source, replace(recipes[text], views=pool.seen), 1 + MODELS, bench.target, seed, pool)
                outcome = measure(trained, options.depth, bench)
                write_json(paths[text], entry(text, outcome))
                print(f"{options.prefix}{text}: {trained.samples} samples, loss {trained.losses[-1]:.3f}, ", end="")
                print(f"synthetic mIoU {outcome.synthetic.mean_iou:.3f}, found {100 * outcome.synthetic.found:.0f} %", flush=True)
    except SynpickError as error:
        return fail("reports.real.tuning", error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
