"""Comparison of rendered outputs between two devices: every image and layer of the same piles, in both rendering modes.

Piles settle once, on the first device; then objects are displaced by `CREEP`, so that flow is not zero. Exits with 1 if a difference
exceeds its tolerance, with 2 if nothing can be compared.

    python -m tools.compare pictures --devices cpu,cuda:0 --models DIR --lights DIR --scenes 3 --size 160x90
"""

import dataclasses
import sys
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp
from rich.console import Console
from rich.table import Table

from synpick_warp.codes import Phase
from synpick_warp.configs.schema import FAST, LAYERS, REFERENCE, UNOCCLUDED, Config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.bins import make_bins, make_fixtures
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import load_lights
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import first_views
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.views.frames import paint_masks
from tools.options import configure, fail, make_parser, write_json

OWN = {
    "devices": {"default": "cpu,cuda:0", "help": "two devices, comma-separated (default: cpu,cuda:0)"},
    "scenes": {"type": int, "default": 3, "help": "piles to render by all cameras (default: 3)"},
    "samples": {"type": int, "default": 8, "help": "paths per pixel of the reference (default: 8)"},
}
"""Options of this report; see `tools.options.OPTIONS`."""
CREEP = 1e-3
"""Displacement of objects since the frame before [m]."""
MAX_TICKS = 400
"""Ticks within which all piles must come to rest: 27 s."""


@dataclass(frozen=True)
class PictureTolerance:
    """Tolerance of one output: a difference per pixel, and the fraction of pixels that may exceed it."""

    difference: float | None
    """Largest difference that counts as equal [the output's unit]; None: labels, which are equal or not."""
    max_beyond: float
    """Pixels, or values, that may differ by more, at most [%]: rounding decides on which side of a silhouette a grazing ray passes."""
    unit: str = ""


PACKED = ("mask_words", "mask_first", "mask_box", "mask_length")
"""Outputs that are compared as the masks that they are."""
TOLERANCES = {
    "instance": PictureTolerance(None, 0.05),
    "masks": PictureTolerance(None, 0.1),
    "classes": PictureTolerance(None, 0.05),
    "depth": PictureTolerance(1.0, 0.05, "counts"),
    "pixels": PictureTolerance(4.0, 1.0, "px"),
    "boxes": PictureTolerance(1.0, 1.0, "px"),
    "effects": PictureTolerance(1e-5, 0.0),
    "normals": PictureTolerance(2e-3, 0.1),
    "albedo": PictureTolerance(2.0, 0.1, "grey"),
    "nocs": PictureTolerance(1e-3, 0.1),
    "flow": PictureTolerance(0.02, 0.1, "px"),
    "scene_flow": PictureTolerance(2e-5, 0.1, "m"),
    "depth_sensor": PictureTolerance(1.0, 0.5, "counts"),
    "ir_left": PictureTolerance(1.0, 0.1, "grey"),
    "ir_right": PictureTolerance(1.0, 0.1, "grey"),
    "depth_stereo": PictureTolerance(1.0, 5.0, "counts"),
    "suction_seal": PictureTolerance(1e-2, 0.5),
    "suction_wrench": PictureTolerance(1e-4, 0.1),
}
"""Tolerances of all outputs but color, which are the same in all modes."""
TABLES = ("pixels", "boxes", "effects")
"""Outputs that are not images."""
COLORS = {
    FAST: PictureTolerance(2.0, 1.0, "grey"),
    UNOCCLUDED: PictureTolerance(2.0, 1.0, "grey"),
    REFERENCE: PictureTolerance(4.0, 2.0, "grey"),
}
"""Tolerances of color, by mode. Where rounding changes a sampled path, its pixel changes; denoising spreads that over neighbours."""


@dataclass(frozen=True)
class PictureDifference:
    """Difference of one output between two devices."""

    mode: str
    output: str
    differing: float
    """Pixels, or values, that differ at all [%]."""
    mean: float
    """Mean absolute difference [unit]; of labels, the fraction that differ."""
    largest: float
    """Largest difference [unit]; of labels 1 if any differ."""
    beyond: float
    """Pixels, or values, that differ by more than the tolerance [%]."""
    tolerance: PictureTolerance

    @property
    def holds(self) -> bool:
        """Whether the difference is within its tolerance."""
        return self.beyond <= self.tolerance.max_beyond


def compare(mode: str, output: str, a: np.ndarray, b: np.ndarray) -> PictureDifference:
    """Compare one output of two devices: images (view, row, column[, channel]), where a pixel differs if any of its channels does, or
    counts or boxes of any shape. NaN equals NaN."""
    tolerance = COLORS[mode] if output == "color" else TOLERANCES[output]
    if tolerance.difference is None:
        difference = (a != b).astype(np.float64)
    else:
        first, second = a.astype(np.float64), b.astype(np.float64)
        difference = np.abs(first - second)
        difference[np.isnan(first) & np.isnan(second)] = 0.0
        difference[np.isnan(first) != np.isnan(second)] = np.inf
    if output not in TABLES:
        difference = difference.reshape(*difference.shape[:3], -1).max(axis=-1)
    finite = difference[np.isfinite(difference)]
    return PictureDifference(
        mode,
        output,
        100.0 * float((difference > 0.0).mean()),
        float(finite.mean()) if finite.size else 0.0,
        float(difference.max()),
        100.0 * float((difference > (tolerance.difference or 0.0)).mean()),
        tolerance,
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    options = make_parser(__doc__, "models", "lights", "seed", "set", "json", "size", own=OWN, size="160x90").parse_args(arguments)
    console = Console(highlight=False)
    try:
        names = options.devices.split(",")
        if len(names) != 2:
            raise SynpickError(f"--devices is {options.devices}; it takes two devices, such as cpu,cuda:0")
        devices = [pick_device(name) for name in names]
        fixed = dict.fromkeys(("bake.episodes", "bake.worlds"), options.scenes) | {"render.layers": list(LAYERS)}
        fixed |= {"bake.mode": "move", "bake.device": names[0], "render.samples": options.samples}
        config = configure(options, fixed)
        differences = compare_devices(config, devices, console)
    except SynpickError as error:
        return fail("compare pictures", error)
    size = "{}x{}".format(*config.cameras.resolution)
    _print(console, differences, f"{names[0]} and {names[1]}, {options.scenes} piles, {size}, {options.samples} paths")
    rows = [dataclasses.asdict(row) | {"holds": row.holds} for row in differences]
    write_json(options.json, {"devices": names, "size": size, "rows": rows})
    return 0 if all(row.holds for row in differences) else 1


def compare_devices(config: Config, devices: list[Any], console: Console) -> list[PictureDifference]:
    """Render settled piles on both devices and compare all outputs; first those of the denoised mode. Raises SynpickError: models or lights
    cannot be used, or a pile does not come to rest."""
    catalog = load_catalog(config, report=console.print)
    lights = load_lights(config.bake.lights)
    simulation = Simulation(with_enough_worlds(config, devices[0]), catalog, len(lights), devices[0])
    snapshot = next_frame(settle_piles(simulation, config.bake.worlds), CREEP)
    cameras = make_cameras(config.rig)
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    differences = []
    for mode in COLORS:
        mode_config, objects = config.with_values({"render.mode": mode}), config.arrangement.max_objects
        outputs = []
        for device in devices:
            scene = build_render_scene(mode_config.render, -mode_config.tote.wall, catalog, fixtures, cameras, lights, device)
            renderer = make_renderer(mode_config, scene, objects, config.bake.worlds * len(cameras))
            outputs.append(render_views(renderer, copy_snapshot(snapshot, device)))
        differences += [compare(mode, name, outputs[0][name], outputs[1][name]) for name in outputs[0]]
    return differences


def settle_piles(simulation: Simulation, count: int) -> Snapshot:
    """Simulate `count` piles until rest, one a world; returns each in the tick in which it begins to act. World w has light map w % their
    number. Raises SynpickError: a pile does not come to rest."""
    arrays = {item.name: getattr(simulation.record.snapshot, item.name) for item in fields(Snapshot)}
    piles: dict[int, dict[str, np.ndarray]] = {}
    for _ in range(MAX_TICKS):
        simulation.tick()
        for world in np.flatnonzero(simulation.state.phase.numpy() == Phase.ACT).tolist():
            if world not in piles:
                piles[world] = {name: array.numpy()[world].copy() for name, array in arrays.items()}
        if len(piles) == count:
            break
    else:
        raise SynpickError(f"only {len(piles)} of {count} piles came to rest within {MAX_TICKS} ticks; choose another seed")
    for name, array in arrays.items():
        rows = array.numpy().copy()
        for world, pile in piles.items():
            rows[world] = pile[name]
        array.assign(rows)
    arrays["light"].assign(np.arange(simulation.layout.worlds, dtype=np.int32) % simulation.scene.drop.lights)
    return simulation.record.snapshot


def next_frame(snapshot: Snapshot, displacement: float) -> Snapshot:
    """Snapshot of the next frame: a copy with objects displaced along +x by `displacement` [m], and the given one as last frame."""
    sources = {item.name: getattr(snapshot, item.name) for item in fields(Snapshot)}
    arrays = {name: array.numpy().copy() for name, array in sources.items()}
    for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible"):
        arrays[f"last_{name}"] = arrays[name].copy()
    arrays["follows"][:] = 1
    arrays["frame"] += 1
    arrays["pose"][..., 0] += displacement
    return Snapshot(**{name: wp.array(array, dtype=sources[name].dtype, device=sources[name].device) for name, array in arrays.items()})


def copy_snapshot(snapshot: Snapshot, device: Any) -> Snapshot:
    """Copy a snapshot to another device."""
    arrays = {item.name: getattr(snapshot, item.name) for item in fields(Snapshot)}
    return Snapshot(**{name: wp.array(array.numpy(), dtype=array.dtype, device=device) for name, array in arrays.items()})


def render_views(renderer: Renderer, snapshot: Snapshot) -> dict[str, np.ndarray]:
    """Render all worlds by all cameras, whose views are a full batch; returns all images and layers by name."""
    scene, device = renderer.scene, renderer.scene.device
    sizes = view_buffer_sizes(renderer.views, scene.width, scene.height, renderer.instances)
    out, layers = allocate(ViewBuffers, sizes, device), allocate(LayerBuffers, sizes, device, LAYERS)
    renderer.render(snapshot, first_views(renderer.views, scene.camera_count, renderer.instances, device), out, layers)
    images = {item.name: getattr(out, item.name).numpy() for item in fields(ViewBuffers)}
    packed = [images.pop(name) for name in PACKED]
    words, first, box = packed[:3]
    masks = [paint_masks(words[view], first[view], box[view], scene.width, scene.height) for view in range(len(words))]
    images["masks"] = np.moveaxis(np.array(masks), 1, -1)
    return images | {name: getattr(layers, name).numpy() for name in LAYERS}


def _print(console: Console, differences: list[PictureDifference], title: str) -> None:
    table = Table("mode", "output", "differ %", "mean", "largest", "unit", "tolerance", "beyond %", "max %", title=title)
    table.add_column("", min_width=len("VIOLATED"), no_wrap=True)
    for row in differences:
        tolerance = row.tolerance
        same = "equal" if tolerance.difference is None else f"{tolerance.difference:g}"
        numbers = (f"{row.differing:.4f}", f"{row.mean:.3g}", f"{row.largest:.3g}", tolerance.unit, same, f"{row.beyond:.4f}")
        table.add_row(row.mode, row.output, *numbers, f"{tolerance.max_beyond:g}", "holds" if row.holds else "VIOLATED")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
