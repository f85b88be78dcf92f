"""Parts of the guard on a GPU: digests of the same episodes in different numbers of worlds, and the rate of pictures."""

from __future__ import annotations

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import warp as wp

from tools.compare.guard_steps import mixed_episodes

if TYPE_CHECKING:
    from tools.compare.guard import Side

WORLDS = (8, 512)
"""World counts in which the same episodes are baked."""
ROUNDS = 2
"""Measurements of each checkout, in turns."""
PICTURE_WORLDS = 128
"""Worlds of these: four measurements take less than ten minutes."""
TOLERANCE = 0.01
"""How much slower pictures may become; they may become faster."""
LEFT_OUT = ("config.toml", "manifest.json")
"""Files that differ with the number of worlds, or with the program's version."""

Result = tuple[str, str, str]
"""(name, verdict, detail) of one comparison."""


def compare_worlds(old: Side, new: Side, options: argparse.Namespace) -> Iterator[Result]:
    """Bake the same episodes in each number of worlds, and on two GPUs if there are two; all digests of both checkouts are one."""
    runs = [(options.device, worlds) for worlds in WORLDS]
    if wp.get_cuda_device_count() > 1:
        runs.append(("cuda:0,cuda:1", WORLDS[0]))
    expected = ""
    for device, worlds in runs:
        for name, side in (("old", old), ("new", new)):
            title, out = f"{name}, {worlds} worlds on {device}", f"worlds-{device.replace(':', '')}-{worlds}"
            command = ("-m", "synpick_warp", *mixed_episodes(device, worlds, out, options.models, options.lights))
            if failure := _run(side, command):
                yield title, "failed", failure
                continue
            digest = digest_folder(side.folder / out)
            expected = expected or digest
            yield title, "equal" if digest == expected else "different", digest


def digest_folder(folder: Path) -> str:
    """Digest of the names and contents of all files but `LEFT_OUT`, 16 digits."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in LEFT_OUT):
        digest.update(f"{path.relative_to(folder)}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def compare_pictures(old: Side, new: Side, options: argparse.Namespace) -> Iterator[Result]:
    """Measure the renderer's rate of both checkouts in turns, and compare the medians of all rows in views/s."""
    rates: dict[str, dict[str, list[float]]] = {"old": {}, "new": {}}
    fixed = ["--device", options.device, "--parts", "pictures", "--worlds", str(PICTURE_WORLDS)]
    fixed += [argument for name in ("models", "lights") if (folder := getattr(options, name)) for argument in (f"--{name}", folder)]
    for turn in range(ROUNDS):
        for name, side in (("old", old), ("new", new)):
            file = f"pictures-{turn}.json"
            command = ("-m", "tools.bench", *fixed, "--json", file)
            if failure := _run(side, command):
                yield f"{name}, turn {turn}", "failed", failure
                return
            for row in json.loads((side.folder / file).read_text())["rows"]:
                if row["unit"] == "1/s" and "median" in row["name"]:
                    rates[name].setdefault(row["name"], []).append(row["value"])
    if not rates["old"] or rates["old"].keys() != rates["new"].keys():
        yield "rows", "failed", f"{', '.join(rates['old']) or 'none'} and {', '.join(rates['new']) or 'none'}"
    for row in rates["old"].keys() & rates["new"].keys():
        before, after = (statistics.median(rates[name][row]) for name in ("old", "new"))
        change = after / before - 1.0
        yield row, "equal" if change > -TOLERANCE else "different", f"{before:.1f} and {after:.1f} views/s, {100 * change:+.2f} %"


def _run(side: Side, arguments: tuple[str, ...]) -> str:
    """Run a Python command with the source tree of `side` in its result folder; returns the error message, empty on success."""
    command = [sys.executable, *arguments]
    done = subprocess.run(command, cwd=side.folder, env=side.environment(), capture_output=True, text=True, check=False)
    return f"exit code {done.returncode}: {(done.stderr.strip() or 'no message').splitlines()[-1]}" if done.returncode else ""
