"""Regression test for refactorings: runs the same commands in two checkouts, and compares files, printed text and generated kernels.

Each command runs in a process of its own, in folders of the same content, and a line is printed for everything compared: equal, different
with the first difference, or failed. Exits with 0 if all is equal, with 1 if something differs or has failed, with 2 if nothing can be
compared.

    python -m tools.compare guard OLD NEW                              # on the CPU: sets, commands, kernels
    python -m tools.compare guard OLD NEW --device cuda:0 --models DIR --lights DIR     # on a GPU: worlds, pictures

- sets: six small data sets, every byte.
- commands: verify, validate, stats, convert, estimate, eval, explain, preview, report: files and printed text, without paths and times.
- kernels: generated CUDA source of every kernel without its names; of Newton's, those that call our functions.
- worlds: a digest of eight episodes in mode mixed, in 8 and in 512 worlds and, if there are two, on two GPUs.
- pictures: the rendering rate, measured alternately; NEW may be slower by 1 %.

With `--work DIR` results are kept, by the content of the checkout: the next run repeats only what it lacks. Neither checkout needs git.
"""

import argparse
import hashlib
import inspect
import json
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import newton
import numpy as np
import warp as wp

from synpick_warp.errors import DatasetError
from tools.compare import kernel_sources, runs
from tools.options import fail, make_names_parser, make_parser, write_json

LAYERS = ["normals", "albedo", "nocs", "classes", "flow", "scene_flow", "depth_sensor"]
SMALL: dict[str, object] = {
    "bake.device": "cpu",
    "bake.worlds": 2,
    "bake.episodes": 2,
    "bake.writers": 1,
    "cameras.resolution": [128, 72],
    "move.speed": 2.0,
    "settle.rest_ticks": 2,
}
"""Settings of all sets, on top of the preset `smoke`: two worlds whose episodes end after a few dozen frames."""
PICKING: dict[str, object] = {
    "bake.mode": "cycle",
    "pick.speed": 4.0,
    "pick.near_speed": 0.5,
    "pick.lift_height": 0.2,
    "pick.lift_speed": 2.0,
    "pick.appear_height": 0.2,
    "pick.failures": 1,
    "perception.resolution": [320, 180],
    "arrangement.volume": 2e-3,
}
"""Settings of short episodes of picking."""
TINY: dict[str, object] = {"cameras.resolution": [64, 36], "move.speed": 4.0, "arrangement.volume": 1e-3}
"""Settings of a few small pictures."""
EFFECTS: dict[str, object] = {
    "effects.exposure_jitter": 0.5,
    "effects.white_balance_jitter": 0.1,
    "effects.vignette": [0.0, 0.3],
    "effects.chromatic_aberration": [0.0, 0.002],
    "effects.blur": [0.0, 1.0],
    "effects.shot_noise": [0.0, 0.01],
    "effects.read_noise": [0.0, 0.01],
    "effects.jpeg_quality": [60, 95],
}
"""Settings: all camera effects."""
JPEG: dict[str, object] = {"bop.color_format": "jpg", "bop.split": "train_pbr"}
SETS: dict[str, dict[str, object]] = {
    "smoke": {},
    "picks": {**PICKING, "bake.formats": ["bop", "zarr"], "bop.keypoints": 4},
    "all": {**JPEG, "bake.formats": ["bop", "shards", "usd", "zarr", "lerobot", "coco", "yolo", "points"], "render.layers": LAYERS},
    "sensors": {**TINY, **JPEG, **EFFECTS, "bake.formats": ["bop", "zarr"], "bop.layout": "multisensor"},
    "reference": {**TINY, "render.mode": "reference", "render.samples": 4, "bake.models": "smoke/models", "arrangement.fill": "within"},
    "unoccluded": {**PICKING, **TINY, "bake.formats": ["shards", "zarr"], "render.mode": "unoccluded", "bake.seed": 7},
}
"""Data set -> settings of its bake, on top of `SMALL`."""
SPLITS_FILE = "splits.toml"
"""File of settings that the guard writes before the bakes: `SPLITS`."""
SPLITS = 'preset = "smoke"\n[splits.train]\nepisodes = 1\n[splits.test]\nepisodes = 1\nmode = "pick"\n'
SPLIT_SET = "unoccluded"
"""Data set that is baked with this file."""
CONVERSIONS = {"picks": "shards,usd,lerobot,coco,yolo", "smoke": "shards,coco", "unoccluded": "bop,usd,lerobot,coco"}
"""Data set -> formats that it is converted to."""
RECORDED = ("bake all", "bake reference", "bake unoccluded", "estimate refine")
"""Steps whose loaded kernels are compared."""


@dataclass(frozen=True)
class Step:
    """A command that is run with each checkout, in the folder of its results."""

    name: str
    """Unique name, under which its text is kept and reported."""
    arguments: tuple[str, ...]
    """Arguments of `python -m synpick_warp`; none: only the kernels of all modules are listed."""
    output: str = ""
    """File or folder that it writes, relative to the folder."""

    @property
    def kernels(self) -> str:
        """File of the kernels that it loads; empty: they are not compared."""
        return f"{self.name.replace(' ', '-')}.kernels.json" if self.name in RECORDED or not self.arguments else ""


def cpu_steps(parts: tuple[str, ...]) -> Iterator[Step]:
    """Yield the steps on the CPU that the given parts need, in order."""
    if "kernels" in parts:
        yield Step("modules", ())
    for name, settings in SETS.items() if {"sets", "commands"} & set(parts) else ():
        preset = SPLITS_FILE if name == SPLIT_SET else "smoke"
        yield Step(f"bake {name}", ("bake", "--config", preset, *_assignments({**SMALL, **settings}), "--out", name), name)
    if "commands" in parts:
        for name in SETS:
            yield Step(f"verify {name}", ("verify", name))
            yield Step(f"validate {name}", ("validate", name, "--threads", "1"))
            yield Step(f"stats {name}", ("stats", name, "--json", "--threads", "1"))
        for name, formats in CONVERSIONS.items():
            out = f"{name}-converted"
            yield Step(f"convert {name}", ("convert", name, "--to", formats, "--out", out, "--processes", "1"), out)
            yield Step(f"verify {out}", ("verify", out))
        yield from _readers()


def _readers() -> Iterator[Step]:
    """Yield the steps that print, draw or evaluate a data set, or estimate poses from it."""
    yield Step("stats tables", ("stats", "picks", "--threads", "1", "--paper"))
    yield Step(
        "estimate single",
        ("estimate", "--data", "picks", "--method", "single", "--every", "16", "--out", "single.csv"),
        "single.csv",
    )
    sensor = ("--method", "refine", "--every", "8", "--depth", "sensor")
    yield Step("estimate refine", ("estimate", "--data", "all", *sensor, "--out", "refine.csv"), "refine.csv")
    yield Step("eval json", ("eval", "--data", "picks", "--results", "single.csv", "--format", "json", "--targets", "single-targets.json"))
    yield Step("eval text", ("eval", "--data", "all", "--results", "refine.csv", "--filter", "ema", "--plots", "plots"), "plots")
    yield Step("explain", ("explain", "picks", "--out", "explained.png"), "explained.png")
    yield Step("preview", ("preview", "all", "--out", "sheet.png"), "sheet.png")
    yield Step("report", ("report", "picks", "--out", "report.html"), "report.html")


def mixed_episodes(device: str, worlds: int, out: str, models: str, lights: str) -> tuple[str, ...]:
    """Arguments of a bake of eight short episodes in mode `mixed` (each draws its task) with all layers, on GPUs (joined by commas)."""
    settings = {
        "bake.mode": "mixed",
        "bake.episodes": 8,
        "bake.worlds": worlds,
        "bake.formats": ["bop", "shards", "usd", "zarr", "coco", "yolo"],
        "bake.models": models,
        "bake.lights": lights,
        "cameras.resolution": [320, 180],
        "render.layers": LAYERS,
        "move.rounds": 1,
        "move.speed": 0.6,
        "pick.failures": 1,
        "target.forgive": False,
        "arrangement.volume": 1e-3,
    }
    return ("bake", *_assignments(settings), "--devices" if "," in device else "--device", device, "--out", out)


def _assignments(settings: dict[str, object]) -> tuple[str, ...]:
    """Command-line options (--set NAME=VALUE) for settings."""
    return tuple(part for name, value in settings.items() for part in ("--set", f"{name}={json.dumps(value)}"))


CPU_PARTS = ("sets", "commands", "kernels")
GPU_PARTS = ("worlds", "pictures")
MAX_NAMED = 8
"""Most changed kernels that are shown with their first difference."""
PACKAGE_FOLDERS = ("synpick_warp", "kernels", "scenes", "configs")
"""Folders of a checkout on which results depend."""
WORLDS = (8, 512)
"""World counts in which the same episodes are baked."""
ROUNDS = 2
"""Measurements of each checkout, alternately."""
PICTURE_WORLDS = 128
"""Worlds of these: four measurements take less than ten minutes."""
TOLERANCE = 0.01
"""Fraction by which the rendering rate may fall; it may rise by any."""
LEFT_OUT = ("config.toml", "manifest.json")
"""Files that differ with the number of worlds, or with the program's version."""
_PROGRESS = re.compile(r"^(?: +\d+:\d\d  .*|\w+ [\d,]+/[\d,]+)\n", re.MULTILINE)
"""Progress lines, whose number depends on how long a command runs."""
_TIMES = re.compile(
    r"(?<= poses in )[^\n]*|\b\d+:\d\d(?::\d\d)?\b|\b[\d.,]+(?= (?:views/s|s\b))|(?<=\"seconds_per_image\": )[\d.e-]+"
    r"|(?<=peak memory )[\d,]+(?= MiB)"
)
"""Durations, rates and memory."""
_LAST_COLUMN = re.compile(rb",[^,\n]*$", re.MULTILINE)
"""The time of a pose estimate."""
_VERSION = re.compile(r'^__version__ = "([^"]+)"', re.MULTILINE)


class ComparisonResult(NamedTuple):
    """Result of one comparison, printed as a line."""

    part: str
    name: str
    verdict: str
    """equal, different or failed."""
    detail: str = ""

    def __str__(self) -> str:
        return f"{self.verdict:10} {self.part}: {self.name}{': ' if self.detail else ''}{self.detail}"


@dataclass(frozen=True)
class Side:
    """One of the two compared versions: its source tree, and the folder to which its commands write."""

    checkout: Path
    folder: Path

    @property
    def version(self) -> str:
        """Version of the package in this checkout."""
        files = [path for name in ("_version", "__init__") if (path := self.checkout / "synpick_warp" / f"{name}.py").exists()]
        match = _VERSION.search("".join(path.read_text() for path in files))
        return match[1] if match else "unknown"

    def call(self, arguments: Sequence[str]) -> subprocess.CompletedProcess[str]:
        """Run a Python command in the folder, with this checkout first on PYTHONPATH and a plain terminal of fixed width."""
        places = [str(self.checkout), *filter(None, [os.environ.get("PYTHONPATH")])]
        fixed = {"PYTHONPATH": os.pathsep.join(places), "COLUMNS": "160", "TERM": "dumb", "NO_COLOR": "1", "PYTHONUTF8": "1"}
        command = [sys.executable, *arguments]
        return subprocess.run(command, cwd=self.folder, env=os.environ | fixed, capture_output=True, text=True, check=False)

    def run(self, step: Step) -> None:
        """Run a step and save exit code, stdout and stderr. Skipped if that file exists: written last, it marks a finished step."""
        text = self.text_file(step)
        if text.exists():
            return
        script = [str(Path(kernel_sources.__file__).resolve()), step.kernels] if step.kernels else ["-m", "synpick_warp"]
        done = self.call([*script, *step.arguments])
        text.parent.mkdir(exist_ok=True)
        part = text.with_suffix(".part")
        part.write_text(f"exit code {done.returncode}\n{done.stdout}{done.stderr}")
        part.rename(text)

    def text_file(self, step: Step) -> Path:
        """File that keeps the text a step printed."""
        return self.folder / "text" / f"{step.name.replace(' ', '-')}.txt"

    def text(self, step: Step) -> str:
        """Text that a step printed, without paths, times and version."""
        text = _PROGRESS.sub("", self.text_file(step).read_text())
        for path, name in ((self.folder, "<folder>"), (self.checkout, "<checkout>"), (self.version, "<version>")):
            text = text.replace(str(path), name)
        return _TIMES.sub("TIME", text)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = _parse(arguments)
    checkouts = [folder.resolve() for folder in (options.old, options.new)]
    for folder in checkouts:
        if not (folder / "synpick_warp" / "__init__.py").is_file():
            return fail("compare guard", f"{folder} is no checkout: it has no synpick_warp/__init__.py")
    with tempfile.TemporaryDirectory(prefix="guard-") as temporary:
        work = (options.work or Path(temporary)).resolve()
        sides = [Side(checkout, work / name) for checkout, name in zip(checkouts, _folder_names(checkouts), strict=True)]
        for side in sides:
            side.folder.mkdir(parents=True, exist_ok=True)
            (side.folder / SPLITS_FILE).write_text(SPLITS)
        results = []
        for result in compare(sides[0], sides[1], options):
            print(result, flush=True)
            results.append(result)
    write_json(options.json, [result._asdict() for result in results])
    different = [result for result in results if result.verdict != "equal"]
    print(f"{len(results) - len(different)} of {len(results)} equal: {sides[0].checkout} and {sides[1].checkout}")
    return int(bool(different))


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "lights", "json")
    parser.add_argument("old", type=Path, metavar="OLD", help="folder of a checkout")
    parser.add_argument("new", type=Path, metavar="NEW", help="folder of another")
    parser.add_argument(
        "--parts",
        type=make_names_parser(CPU_PARTS + GPU_PARTS, "part"),
        help=f"any of {','.join(CPU_PARTS + GPU_PARTS)} (default: by --device)",
    )
    parser.add_argument("--device", default="cpu", help="cpu, or cuda:N for the parts worlds and pictures (default: cpu)")
    parser.add_argument("--work", type=Path, help="folder in which results are kept for the next run (default: a temporary one)")
    parser.add_argument("--jobs", type=int, choices=(1, 2), default=2, help="checkouts that run at a time (default: 2)")
    options = parser.parse_args(arguments)
    for name in ("models", "lights"):
        setattr(options, name, str(Path(folder).resolve()) if (folder := getattr(options, name)) else "")
    options.parts = options.parts or (CPU_PARTS if options.device == "cpu" else GPU_PARTS)
    return options


def _folder_names(checkouts: list[Path]) -> list[str]:
    """Folder names of both checkouts' results: a digest of everything that these depend on; for equal ones the second ends in -again."""
    names = []
    for checkout in checkouts:
        digest = hashlib.sha256(repr((wp.__version__, newton.__version__, np.__version__, sys.version)).encode())
        for module in (sys.modules[__name__], kernel_sources):
            digest.update(inspect.getsource(module).encode())
        for path in sorted(path for folder in PACKAGE_FOLDERS for path in (checkout / folder).rglob("*")):
            if path.is_file() and path.suffix not in (".pyc", ".md"):
                digest.update(f"{path.relative_to(checkout)}\0".encode() + path.read_bytes())
        names.append(digest.hexdigest()[:16])
    return names if names[0] != names[1] else [names[0], f"{names[1]}-again"]


def compare(old: Side, new: Side, options: argparse.Namespace) -> Iterator[ComparisonResult]:
    """Run and compare all parts that the options name; yields the results."""
    if set(options.parts) & set(CPU_PARTS):
        steps = list(cpu_steps(options.parts))
        with ThreadPoolExecutor(options.jobs) as pool:
            for step in steps:
                started = time.perf_counter()
                list(pool.map(lambda side, step=step: side.run(step), (old, new)))
                print(f"           {step.name}: {time.perf_counter() - started:.1f} s", file=sys.stderr, flush=True)
                yield from _compare_step(old, new, step, options.parts)
    if "worlds" in options.parts:
        yield from compare_worlds(old, new, options)
    if "pictures" in options.parts:
        yield from compare_pictures(old, new, options)


def _compare_step(old: Side, new: Side, step: Step, parts: tuple[str, ...]) -> Iterator[ComparisonResult]:
    """Compare what both checkouts wrote and printed in a step; yields the results."""
    baked = step.arguments[:1] == ("bake",)
    part = "sets" if baked else "commands" if step.arguments else "kernels"
    texts = [side.text(step) for side in (old, new)]
    for side, text in zip(("old", "new"), texts, strict=True):
        if not text.startswith("exit code 0\n"):
            yield ComparisonResult(part, step.name, "failed", f"{side}: {text.splitlines()[0]}: {text.splitlines()[-1]}")
            return
    if step.output and (part in parts):
        yield _compare_output(part, old, new, step.output)
    if "commands" in parts and step.arguments:
        difference = kernel_sources.first_difference([texts[0]], [texts[1]])
        yield ComparisonResult("commands", f"text of {step.name}", "different" if difference else "equal", difference)
    if "kernels" in parts and step.kernels:
        yield _compare_kernels(step.name, old.folder / step.kernels, new.folder / step.kernels)


def _compare_output(part: str, old_side: Side, new_side: Side, name: str) -> ComparisonResult:
    """Compare a file or folder that a step has written, without the column of times of a .csv file and the version in an .html page."""
    old, new = old_side.folder / name, new_side.folder / name
    if old.suffix:
        contents = [path.read_bytes() for path in (old, new)]
        if old.suffix == ".csv":
            contents = [_LAST_COLUMN.sub(b"", content) for content in contents]
        if old.suffix == ".html":
            contents = [content.replace(side.version.encode(), b"") for content, side in zip(contents, (old_side, new_side), strict=True)]
        verdict = "equal" if contents[0] == contents[1] else "different"
        return ComparisonResult(part, name, verdict, " and ".join(f"{len(content):,}" for content in contents) + " bytes")
    try:
        layers, difference = runs.compare(old, new)
    except DatasetError as error:
        return ComparisonResult(part, name, "failed", str(error))
    files, differing = (sum(getattr(layer, name) for layer in layers.values()) for name in ("files", "differing"))
    return ComparisonResult(
        part,
        old.name,
        "different" if difference else "equal",
        f"{differing} of {files:,} files; {difference}" if difference else f"{files:,} files",
    )


def _compare_kernels(name: str, old_file: Path, new_file: Path) -> ComparisonResult:
    """Compare the kernels of both checkouts by key; a key that one of them lacks is looked for by its source (renamed)."""
    old, new = (json.loads(path.read_text()) for path in (old_file, new_file))
    changed = [key for key in sorted(old.keys() & new.keys()) if old[key] != new[key]]
    added = {key: new[key] for key in sorted(new.keys() - old.keys())}
    renamed, missing = {}, []
    for key in sorted(old.keys() - new.keys()):
        partner = next((other for other, source in added.items() if source == old[key]), None)
        if partner is None:
            missing.append(key)
        else:
            renamed[key] = partner
            del added[partner]
    details = [f"{len(changed)} of {len(old)} kernels" if changed else f"{len(old)} kernels"]
    details += [f"{key}: {kernel_sources.first_difference(old[key], new[key])}" for key in changed[:MAX_NAMED]]
    details += [f"only old: {key}" for key in missing] + [f"only new: {key}" for key in added]
    details += [f"{key} is now {partner}" for key, partner in renamed.items()]
    return ComparisonResult("kernels", name, "different" if changed or missing or added else "equal", "; ".join(details))


def compare_worlds(old: Side, new: Side, options: argparse.Namespace) -> Iterator[ComparisonResult]:
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
                yield ComparisonResult("worlds", title, "failed", failure)
                continue
            digest = digest_folder(side.folder / out)
            expected = expected or digest
            yield ComparisonResult("worlds", title, "equal" if digest == expected else "different", digest)


def digest_folder(folder: Path) -> str:
    """Digest of the names and contents of all files but `LEFT_OUT`, 16 digits."""
    digest = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file() and path.name not in LEFT_OUT):
        digest.update(f"{path.relative_to(folder)}\0".encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()[:16]


def compare_pictures(old: Side, new: Side, options: argparse.Namespace) -> Iterator[ComparisonResult]:
    """Measure the renderer's rate of both checkouts alternately, and compare the medians of all rows in views/s."""
    rates: dict[str, dict[str, list[float]]] = {"old": {}, "new": {}}
    fixed = ["--device", options.device, "--parts", "pictures", "--worlds", str(PICTURE_WORLDS)]
    fixed += [argument for name in ("models", "lights") if (folder := getattr(options, name)) for argument in (f"--{name}", folder)]
    for turn in range(ROUNDS):
        for name, side in (("old", old), ("new", new)):
            file = f"pictures-{turn}.json"
            command = ("-m", "tools.bench", *fixed, "--json", file)
            if failure := _run(side, command):
                yield ComparisonResult("pictures", f"{name}, turn {turn}", "failed", failure)
                return
            for row in json.loads((side.folder / file).read_text())["rows"]:
                if row["unit"] == "1/s" and "median" in row["name"]:
                    rates[name].setdefault(row["name"], []).append(row["value"])
    if not rates["old"] or rates["old"].keys() != rates["new"].keys():
        yield ComparisonResult("pictures", "rows", "failed", f"{', '.join(rates['old']) or 'none'} and {', '.join(rates['new']) or 'none'}")
    for row in rates["old"].keys() & rates["new"].keys():
        before, after = (statistics.median(rates[name][row]) for name in ("old", "new"))
        change = after / before - 1.0
        verdict = "equal" if change > -TOLERANCE else "different"
        yield ComparisonResult("pictures", row, verdict, f"{before:.1f} and {after:.1f} views/s, {100 * change:+.2f} %")


def _run(side: Side, arguments: tuple[str, ...]) -> str:
    """Run a Python command of `side`; returns the error message, empty on success."""
    done = side.call(arguments)
    return f"exit code {done.returncode}: {(done.stderr.strip() or 'no message').splitlines()[-1]}" if done.returncode else ""


if __name__ == "__main__":
    sys.exit(main())
