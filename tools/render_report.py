"""Measure the renderer: white furnaces, a plane under a lamp, and the fast picture beside the reference on settled piles.

Piles settle under the physics; each is seen by camera 0 under the next light map. Two references that differ in their random
numbers alone say how much of the difference is the reference's own noise. Exits with 1 if a bound is violated, with 2 if nothing
can be rendered.

    python tools/render_report.py --models DIR --lights DIR --scenes 10 --size 480x270 --samples 1024 --out DIR
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh
import warp as wp
from rich.console import Console
from rich.table import Table

from synpick_warp.arrays import allocate
from synpick_warp.configs.load import load_config, parse_assignment
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.device import pick_device
from synpick_warp.doctor import describe_machine
from synpick_warp.errors import SynpickError
from synpick_warp.kernels import phases
from synpick_warp.preview import write_picture
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.gripper import cup_fixture, finger_fixture
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.shapes import Camera, Catalog, CatalogEntry, LightMap, Material, TriangleMesh
from synpick_warp.scenes.tote import tote_fixture
from synpick_warp.stages.buffers import FIXTURES, Snapshot, ViewBuffers
from synpick_warp.stages.light_tables import map_directions
from synpick_warp.stages.render import Renderer
from synpick_warp.stages.render_scene import build_render_scene
from synpick_warp.stages.simulate import Simulation

MOST_FURNACE_ERROR = 1.0
"""Of a white object in an even room, and of a plane's irradiance [%]."""
LEAST_PSNR = 32.0
"""Fast against reference, mean over scenes [dB]."""
MOST_BIAS = 1.0
"""Of the fast picture's mean radiance [%]."""
ROUGHNESSES = (0.0, 0.1, 0.2, 0.4, 0.6, 0.8, 1.0)
LAMP_RADIUS = np.radians(6.0)
LAMP_ROWS = 256
LAMP_HEIGHTS = (90.0, 60.0, 30.0)
"""Above the plane [°]."""
QUADRATURE = 4
"""Cosines, and azimuths, from which a plane is seen."""
MOST_TICKS = 400
"""Ticks within which all piles must rest; 27 s."""


@dataclass(frozen=True)
class Row:
    """A line of the report; with a bound if the number must keep one."""

    name: str
    value: float
    unit: str
    bound: str = ""
    holds: bool = True


@dataclass(frozen=True, eq=False)
class Shot:
    """One picture."""

    color: np.ndarray
    """(H, W, 3) uint8, sRGB, red first."""
    radiance: np.ndarray
    """(H, W, 3) float32, linear, before exposure."""
    instance: np.ndarray
    """(H, W) uint8."""
    seconds: float


class Studio:
    """A scene and a renderer for one view at a time."""

    def __init__(self, config: Config, catalog: Catalog, cameras: tuple[Camera, ...], lights: tuple[LightMap, ...], device: Any) -> None:
        fixtures = (tote_fixture(config.tote), finger_fixture(config.gripper), cup_fixture(config.gripper))
        scene = build_render_scene(config, catalog, fixtures, cameras, lights, device)
        self.device = device
        self.renderer = Renderer(config, scene, config.arrangement.max_objects, 1)
        sizes = {"view": 1, "row": scene.height, "column": scene.width, "instance": config.arrangement.max_objects}
        self.out = allocate(ViewBuffers, sizes | {"count": 3, "box": 2, "edge": 4}, device)

    def shoot(self, snapshot: Snapshot, world: int, camera: int) -> Shot:
        """Picture of a world by a camera."""
        started = time.perf_counter()
        world_list, camera_list = (wp.array([number], dtype=wp.int32, device=self.device) for number in (world, camera))
        self.renderer.render(snapshot, world_list, camera_list, 1, self.out)
        color = self.out.color.numpy()[0].copy()
        seconds = time.perf_counter() - started
        return Shot(color, self.renderer.picture.radiance.numpy()[0].copy(), self.out.instance.numpy()[0].copy(), seconds)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, and return the exit code."""
    options = _parse(arguments)
    console = Console(highlight=False)
    started = time.perf_counter()
    try:
        config = _config(options)
        device = pick_device(config.bake.device)
        rows = furnaces(config, device) + planes(config, device)
        if options.scenes:
            rows += comparisons(config, options.out, device, console)
    except SynpickError as error:
        print(f"render_report: {error}", file=sys.stderr)
        return 2
    machine = describe_machine(device)
    _print(console, machine, rows, config, time.perf_counter() - started)
    if options.json:
        record = {"machine": dict(machine), "samples": config.render.samples, "bounces": config.render.bounces,
                  "real_objects": bool(options.models), "real_lights": bool(options.lights),
                  "rows": [dataclasses.asdict(row) for row in rows]}  # fmt: skip
        options.json.write_text(json.dumps(record, indent=1) + "\n")
    return 0 if all(row.holds for row in rows) else 1


def _parse(arguments: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--models", default="", help="folder of BOP models (default: the embedded objects)")
    parser.add_argument("--lights", default="", help="folder of light maps (default: the embedded skies)")
    parser.add_argument("--scenes", type=int, default=2, help="piles to compare (default 2; 0: none)")
    parser.add_argument("--size", default="240x135", help="width and height of their pictures (default 240x135)")
    parser.add_argument("--samples", type=int, default=64, help="paths a pixel of the reference (default 64)")
    parser.add_argument("--device", default="auto", help="cpu, cuda:N or auto (default)")
    parser.add_argument("--seed", type=int, default=0, help="of all draws (default 0)")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="any other setting; may be repeated")
    parser.add_argument("--out", type=Path, help="folder for pictures: fast, reference, and five times their difference")
    parser.add_argument("--json", type=Path, help="write the numbers to this file, too")
    return parser.parse_args(arguments)


def _config(options: argparse.Namespace) -> Config:
    overrides: dict[str, object] = dict(parse_assignment(text) for text in options.set)
    overrides |= {
        "bake.mode": "move",
        "bake.models": options.models,
        "bake.lights": options.lights,
        "bake.episodes": max(1, options.scenes),
        "bake.worlds": max(1, options.scenes),
        "bake.device": options.device,
        "bake.seed": options.seed,
        "render.samples": options.samples,
        "cameras.resolution": [int(part) if part.isdecimal() else part for part in options.size.split("x")],
    }
    return load_config(None, overrides)


def _mode(config: Config, mode: str, **bake: object) -> Config:
    return replace(config, render=replace(config.render, mode=mode), bake=replace(config.bake, **bake))  # pyright: ignore[reportArgumentType]


def furnaces(config: Config, device: Any) -> list[Row]:
    """White balls, dielectric and metal, in a room of radiance 1: how far their mean radiance is from 1, by roughness."""
    made = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    vertices = np.asarray(made.vertices, dtype=np.float32)
    flat = np.zeros((len(vertices), 2), np.float32)
    mesh = TriangleMesh(vertices, np.asarray(made.faces, dtype=np.int32), vertices / np.float32(0.1), flat)
    kinds = [(metallic, roughness) for metallic in (0.0, 1.0) for roughness in ROUGHNESSES]
    above = replace(config.cameras, resolution=(64, 64), fov=10.0, positions=((0.0, 0.0, 2.0),), target=(0.0, 0.0, 0.0),
                    ups=((0.0, 1.0, 0.0),))  # fmt: skip
    rows = []
    for mode in (REFERENCE, FAST):
        studio = _bare_studio(_mode(config, mode), mesh, kinds, make_cameras(above), _even(), device)
        snapshot = _one_each(config, len(kinds), device)
        for world, (metallic, roughness) in enumerate(kinds):
            shot = studio.shoot(snapshot, world, 0)
            error = 100.0 * float(shot.radiance[shot.instance == 1].mean() - 1.0)
            name = f"{mode}: furnace, {'metal' if metallic else 'dielectric'}, roughness {roughness:g}"
            rows.append(_bounded(name, error, "%", MOST_FURNACE_ERROR))
    return rows


def planes(config: Config, device: Any) -> list[Row]:
    """A white matt plane under a disc of radiance L and angular radius a, at the angle θ to the normal: E = π L sin² a cos θ.

    White sends back what it gets, though not evenly: the mean of its radiance over all directions, weighted by the cosine, is
    E / π. Cameras stand at the nodes of a quadrature.
    """
    corners = 20.0 * np.array([(-1, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)], np.float32)
    up = np.tile(np.array([0, 0, 1], np.float32), (4, 1))
    mesh = TriangleMesh(corners, np.array([(0, 1, 2), (0, 2, 3)], np.int32), up, np.zeros((4, 2), np.float32))
    nodes, weights = np.polynomial.legendre.leggauss(QUADRATURE)
    cosines = (nodes + 1.0) / 2.0
    azimuths = (np.arange(QUADRATURE) + 0.5) / QUADRATURE * 2.0 * np.pi
    places = [2.0 * np.array([np.sqrt(1 - c * c) * np.cos(a), np.sqrt(1 - c * c) * np.sin(a), c]) for c in cosines for a in azimuths]
    shares = np.repeat(weights * cosines, QUADRATURE) / QUADRATURE
    around = replace(config.cameras, resolution=(32, 32), fov=2.0, positions=tuple(map(tuple, places)), target=(0.0, 0.0, 0.0),
                     ups=((0.0, 0.0, 1.0),) * len(places))  # fmt: skip
    rows = []
    for height in LAMP_HEIGHTS:
        cosine = float(np.sin(np.radians(height)))
        studio = _bare_studio(_mode(config, REFERENCE), mesh, [(0.0, 1.0)], make_cameras(around), _lamp(cosine), device)
        snapshot = _one_each(config, 1, device)
        radiance = [float(studio.shoot(snapshot, 0, camera).radiance.mean()) for camera in range(len(places))]
        error = 100.0 * (float(shares @ radiance) / (np.sin(LAMP_RADIUS) ** 2 * cosine) - 1.0)
        rows.append(_bounded(f"reference: irradiance, lamp {height:g}° high", error, "%", MOST_FURNACE_ERROR))
    return rows


def _even() -> LightMap:
    return LightMap("even", np.ones((16, 32, 3), np.float32))


def _lamp(cosine: float) -> LightMap:
    """A disc of radiance 1, its edge one texel soft, in a black map."""
    directions, _ = map_directions(LAMP_ROWS)
    angle = np.arccos(np.clip(directions @ np.array([np.sqrt(1.0 - cosine**2), 0.0, cosine]), -1.0, 1.0))
    share = np.clip((LAMP_RADIUS - angle) / (np.pi / LAMP_ROWS) + 0.5, 0.0, 1.0)
    return LightMap("lamp", np.repeat(share[..., None], 3, axis=2).astype(np.float32))


def _bare_studio(
    config: Config, mesh: TriangleMesh, kinds: list[tuple[float, float]], cameras: tuple[Camera, ...], light: LightMap, device: Any
) -> Studio:
    """A studio for a white mesh, one catalog entry for each (metallic, roughness), with nothing around and hidden sky not looked for."""
    config = replace(config, render=replace(config.render, table=False, ambient_rays=0))
    white = [Material((1.0, 1.0, 1.0), None, metallic, roughness) for metallic, roughness in kinds]
    # Volume, radius, mass and diameter do not show.
    entries = tuple(
        CatalogEntry(1, "probe", mesh, material, (), 1.0, 1.0, 1.0, np.zeros(3), np.eye(3), 1.0, (), (), None) for material in white
    )
    return Studio(config, Catalog(entries), cameras, (light,), device)


def _one_each(config: Config, worlds: int, device: Any) -> Snapshot:
    """World w holds catalog entry w at the origin, and nothing else."""
    room = config.arrangement.max_objects
    snapshot = allocate(Snapshot, {"world": worlds, "instance": room, "fixture": len(FIXTURES)}, device)
    entry = np.full((worlds, room), -1)
    entry[:, 0] = np.arange(worlds)
    snapshot.entry.assign(entry)
    for poses in (snapshot.pose, snapshot.fixture_pose):
        poses.assign(np.tile(np.array([0, 0, 0, 0, 0, 0, 1], np.float32), (*poses.shape, 1)))
    return snapshot


def comparisons(config: Config, out: Path | None, device: Any, console: Console) -> list[Row]:
    """The fast picture of settled piles against the reference."""
    catalog = load_catalog(config, report=console.print)
    lights = load_lights(config.bake.lights)
    snapshot = settled(config, catalog, len(lights), device)
    cameras = make_cameras(config.cameras)[:1]
    kinds = (_mode(config, FAST), _mode(config, REFERENCE), _mode(config, REFERENCE, seed=config.bake.seed + 1))
    fast, reference, other = (Studio(kind, catalog, cameras, lights, device) for kind in kinds)
    rows, quality, biases = [], [], []
    for world in range(config.bake.worlds):
        light = lights[world % len(lights)].name
        shots = [studio.shoot(snapshot, world, 0) for studio in (fast, reference, other)]
        quality.append(psnr(shots[0].color, shots[1].color))
        biases.append(100.0 * float(shots[0].radiance.mean() / shots[1].radiance.mean() - 1.0))
        rows += [
            Row(f"scene {world}, {light}: fast against reference", quality[-1], "dB"),
            Row(f"scene {world}, {light}: reference against itself", psnr(shots[1].color, shots[2].color), "dB"),
            Row(f"scene {world}, {light}: bias of mean radiance", biases[-1], "%"),
            Row(f"scene {world}, {light}: reference", shots[2].seconds, "s"),
        ]
        if out is not None:
            pair = [shots[0].color, shots[1].color, cv2.absdiff(shots[0].color, shots[1].color).clip(0, 51) * 5]
            write_picture(out / f"scene_{world:02d}_{light}.png", np.concatenate(pair, axis=1)[..., ::-1])
    mean = float(np.mean(quality))
    rows.append(Row("fast against reference, mean", mean, "dB", f">= {LEAST_PSNR:g}", mean >= LEAST_PSNR))
    rows.append(_bounded("bias of mean radiance, mean", float(np.mean(biases)), "%", MOST_BIAS))
    return rows


def settled(config: Config, catalog: Catalog, lights: int, device: Any) -> Snapshot:
    """Piles at rest, one a world, in the tick in which each begins to act; world w has light map w, w + lights, ...

    Raises:
        SynpickError: One does not come to rest.
    """
    simulation = Simulation(config, catalog, lights, device)
    record = simulation.records[0]
    piles: dict[int, dict[str, np.ndarray]] = {}
    for _ in range(MOST_TICKS):
        simulation.tick(record)
        host = {item.name: getattr(record.snapshot, item.name).numpy() for item in fields(Snapshot)}
        for world in np.flatnonzero(simulation.state.phase.numpy() == phases.ACT):
            piles.setdefault(int(world), {name: array[world].copy() for name, array in host.items()})
        if len(piles) == config.bake.worlds:
            break
    else:
        raise SynpickError(f"only {len(piles)} of {config.bake.worlds} piles came to rest within {MOST_TICKS} ticks; give another seed")
    for item in fields(Snapshot):
        getattr(record.snapshot, item.name).assign(np.stack([piles[world][item.name] for world in sorted(piles)]))
    record.snapshot.light.assign(np.arange(config.bake.worlds, dtype=np.int32) % lights)
    return record.snapshot


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal to noise of two 8-bit pictures [dB]."""
    error = float(((a.astype(np.float64) - b) ** 2).mean())
    return 10.0 * float(np.log10(255.0**2 / max(error, 1e-9)))


def _bounded(name: str, value: float, unit: str, most: float) -> Row:
    return Row(name, value, unit, f"within {most:g}", bool(abs(value) < most))


def _print(console: Console, machine: list[tuple[str, str]], rows: list[Row], config: Config, wall: float) -> None:
    head = Table(show_header=False, box=None)
    for name, value in machine:
        head.add_row(name, value)
    console.print(head)
    width, height = config.cameras.resolution
    title = f"{width} x {height}, {config.render.samples} paths a pixel, {config.render.bounces} bounces, {wall:.0f} s"
    table = Table("renderer", "", "unit", "bound", "", title=title)
    table.columns[1].justify = "right"
    for row in rows:
        table.add_row(row.name, f"{row.value:.3f}", row.unit, row.bound, "" if not row.bound else "holds" if row.holds else "VIOLATED")
    console.print(table)


if __name__ == "__main__":
    sys.exit(main())
