"""Render the same piles on two devices and tell how far every output differs, in both modes of rendering.

Piles settle once, on the first device; then objects creep, so that there is motion to see. Exits with 1 if a difference is larger
than its tolerance, with 2 if nothing can be compared.

    python -m tools.checks.compare_pictures --devices cpu,cuda:0 --models DIR --lights DIR --scenes 3 --size 160x90
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

from synpick_warp.arrays import allocate
from synpick_warp.configs.schema import FAST, LAYERS, REFERENCE, Config
from synpick_warp.device import pick_device
from synpick_warp.errors import SynpickError
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views
from tools.options import configure, fail, make_parser, write_json
from tools.reports.render_checks import with_mode
from tools.reports.render_piles import following, settled

CREEP = 1e-3
"""How far objects moved since the frame before [m]."""


@dataclass(frozen=True)
class Tolerance:
    """How far an output may differ."""

    apart: float | None
    """Largest difference that is no difference [the output's unit]; None: names, which are equal or not."""
    share: float
    """Most pixels, or numbers, that may differ by more [%]: rays that graze an edge pass it on one side or the other."""
    unit: str = ""


TOLERANCES = {
    "instance": Tolerance(None, 0.05),
    "amodal": Tolerance(None, 0.1),
    "classes": Tolerance(None, 0.05),
    "depth": Tolerance(1.0, 0.05, "counts"),
    "pixels": Tolerance(4.0, 1.0, "px"),
    "boxes": Tolerance(1.0, 1.0, "px"),
    "effects": Tolerance(1e-5, 0.0),
    "normals": Tolerance(2e-3, 0.1),
    "albedo": Tolerance(2.0, 0.1, "grey"),
    "nocs": Tolerance(1e-3, 0.1),
    "flow": Tolerance(0.02, 0.1, "px"),
    "scene_flow": Tolerance(2e-5, 0.1, "m"),
    "depth_sensor": Tolerance(1.0, 0.5, "counts"),
}
"""Of everything but colour, which is the same in both modes."""
NUMBERS = ("pixels", "boxes", "effects")
"""Outputs that are no images."""
COLORS = {FAST: Tolerance(2.0, 1.0, "grey"), REFERENCE: Tolerance(4.0, 2.0, "grey")}
"""Of colour, by mode: where rounding turns a path's choice, its pixel changes, in the fast picture a little and with its neighbours."""


@dataclass(frozen=True)
class Difference:
    """How one output differs between two devices."""

    mode: str
    output: str
    differing: float
    """Pixels, or numbers, that differ at all [%]."""
    mean: float
    """Mean absolute difference [unit]; of names, the share that differ."""
    largest: float
    """Largest difference [unit]; of names 1 if any differ."""
    beyond: float
    """Share that differ by more than the tolerance [%]."""
    tolerance: Tolerance

    @property
    def holds(self) -> bool:
        return self.beyond <= self.tolerance.share


def compare(mode: str, output: str, a: np.ndarray, b: np.ndarray) -> Difference:
    """Compare one output of two devices.

    Args:
        mode: Of rendering.
        output: Name of the output.
        a: (B, H, W[, C]) of images, where a pixel differs if any of its channels does; any shape of counts and boxes.
        b: The same of the other device. Two values that are not numbers are equal.
    """
    tolerance = COLORS[mode] if output == "color" else TOLERANCES[output]
    if tolerance.apart is None:
        apart = (a != b).astype(np.float64)
    else:
        wide, other = a.astype(np.float64), b.astype(np.float64)
        apart = np.abs(wide - other)
        apart[np.isnan(wide) & np.isnan(other)] = 0.0
        apart[np.isnan(wide) != np.isnan(other)] = np.inf
    if output not in NUMBERS:
        apart = apart.reshape(*apart.shape[:3], -1).max(axis=-1)
    finite = apart[np.isfinite(apart)]
    return Difference(
        mode,
        output,
        100.0 * float((apart > 0.0).mean()),
        float(finite.mean()) if finite.size else 0.0,
        float(apart.max()),
        100.0 * float((apart > (tolerance.apart or 0.0)).mean()),
        tolerance,
    )


def main(arguments: list[str] | None = None) -> int:
    """Render, compare, print, and return the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    try:
        names = options.devices.split(",")
        if len(names) != 2:
            raise SynpickError(f"--devices is {options.devices}; it takes two devices, such as cpu,cuda:0")
        devices = [pick_device(name) for name in names]
        config = _config(options, names[0])
        differences = compare_devices(config, devices, console)
    except SynpickError as error:
        return fail("compare_pictures", error)
    _print(console, differences, f"{names[0]} and {names[1]}, {options.scenes} piles, {options.size}, {options.samples} paths")
    rows = [dataclasses.asdict(row) | {"holds": row.holds} for row in differences]
    write_json(options.json, {"devices": names, "size": options.size, "rows": rows})
    return 0 if all(row.holds for row in differences) else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = make_parser(__doc__, "models", "lights", "seed", "set", "json")
    parser.add_argument("--devices", default="cpu,cuda:0", help="two devices with a comma between them (default: cpu,cuda:0)")
    parser.add_argument("--scenes", type=int, default=3, help="piles to render, by all cameras (default: 3)")
    parser.add_argument("--size", default="160x90", help="width and height of the pictures (default: 160x90)")
    parser.add_argument("--samples", type=int, default=8, help="paths per pixel of the reference (default: 8)")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace, device: str) -> Config:
    fixed = {
        "bake.mode": "move",
        "bake.episodes": options.scenes,
        "bake.worlds": options.scenes,
        "bake.device": device,
        "render.samples": options.samples,
        "render.layers": list(LAYERS),
        "cameras.resolution": [int(part) if part.isdecimal() else part for part in options.size.split("x")],
    }
    return configure(options, fixed)


def compare_devices(config: Config, devices: list[Any], console: Console) -> list[Difference]:
    """All differences, first those of the fast mode.

    Raises:
        SynpickError: Models or lights cannot be used, or a pile does not come to rest.
    """
    catalog = load_catalog(config, report=console.print)
    lights = load_lights(config.bake.lights)
    snapshot = following(settled(config, catalog, len(lights), devices[0]), CREEP)
    cameras = make_cameras(config.cameras)
    fixtures = make_fixtures(config.tote, config.gripper)
    differences = []
    for mode in (FAST, REFERENCE):
        kind = with_mode(config, mode)
        outputs = [
            render_views(kind, build_render_scene(kind, catalog, fixtures, cameras, lights, device), carried(snapshot, device))
            for device in devices
        ]
        differences += [compare(mode, name, outputs[0][name], outputs[1][name]) for name in outputs[0]]
    return differences


def carried(snapshot: Snapshot, device: Any) -> Snapshot:
    """The same snapshot on another device."""
    arrays = {item.name: getattr(snapshot, item.name) for item in fields(Snapshot)}
    return Snapshot(**{name: wp.array(array.numpy(), dtype=array.dtype, device=device) for name, array in arrays.items()})


def render_views(config: Config, scene: Any, snapshot: Snapshot) -> dict[str, np.ndarray]:
    """All outputs of all worlds seen by all cameras, by name."""
    worlds, cameras, device = config.bake.worlds, scene.camera_count, scene.device
    sizes = {"view": worlds * cameras, "row": scene.height, "column": scene.width, "instance": config.arrangement.max_objects}
    sizes |= {"count": 3, "box": 2, "side": 4}
    renderer = Renderer(config, scene, config.arrangement.max_objects, worlds * cameras)
    out, layers = allocate(ViewBuffers, sizes, device), allocate(LayerBuffers, sizes, device, LAYERS)
    view = np.arange(worlds * cameras, dtype=np.int32)
    world, camera = (wp.array(values, dtype=wp.int32, device=device) for values in (view // cameras, view % cameras))
    renderer.render(snapshot, make_views(world, camera, len(view), renderer.instances), out, layers)
    images = {item.name: getattr(out, item.name).numpy() for item in fields(ViewBuffers)}
    return images | {name: getattr(layers, name).numpy() for name in LAYERS}


def _print(console: Console, differences: list[Difference], title: str) -> None:
    table = Table("mode", "output", "differ %", "mean", "largest", "unit", "tolerance", "beyond %", "most %", title=title)
    table.add_column("", min_width=len("VIOLATED"), no_wrap=True)
    for row in differences:
        tolerance = row.tolerance
        same = "equal" if tolerance.apart is None else f"{tolerance.apart:g}"
        numbers = (f"{row.differing:.4f}", f"{row.mean:.3g}", f"{row.largest:.3g}", tolerance.unit, same, f"{row.beyond:.4f}")
        table.add_row(row.mode, row.output, *numbers, f"{tolerance.share:g}", "holds" if row.holds else "VIOLATED")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
