"""Commands that `tools.compare guard`, the regression test of two checkouts, runs: bakes of six small data sets on the CPU, the commands
that read them, and the bake of its GPU part."""

import json
from collections.abc import Iterator
from dataclasses import dataclass

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
