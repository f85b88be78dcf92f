"""Sweep over mesh files of others: which load, which load with a warning, which are refused and why; and a contact sheet of what loads.

Each file is read in a process of its own with a time limit, since readers of damaged files may crash or hang.

    python -m tools.checks.meshes FOLDER... --sheet sheet.png --objects 40
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import warp as wp
from rich.console import Console

from synpick_warp.apps.viz.preview import put_text, write_picture
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import SynpickError
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.meshes import SUFFIXES, MeshOptions, read_mesh
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.fixtures import make_fixtures
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog, CatalogEntry, Material, TriangleMesh
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.render.view_setup import make_views

LOADS, WARNS, REFUSES, FAILS = "loads", "warns", "refuses", "fails"
"""Outcomes; the last is a fault of the program: a traceback, a crash or a time-out."""
CELL, LINE, COLUMNS = 240, 16, 8
"""Side of a picture and height of its label [px], pictures a row."""
SIZE, TILT = 0.15, (-0.28, 0.12, 0.35, 0.88)
"""Diameter of a drawn object [m], and its orientation (x, y, z, w), which shows three sides of a box."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of reading a mesh file: its kind, the message, and the mesh (None: refused, or not kept)."""

    file: Path
    kind: str
    text: str
    found: tuple[TriangleMesh, Material] | None = None


def read(file: Path) -> Outcome:
    """Read a mesh file as the catalog does, in metres and centred; returns whether it loads, warns, is refused or fails."""
    said: list[str] = []
    try:
        mesh, given = read_mesh(file, 1.0, MeshOptions(center=True), said.append)
    except SynpickError as error:
        return Outcome(file, REFUSES, str(error))
    except Exception as error:
        return Outcome(file, FAILS, repr(error))
    said = [line for line in said if ": centred: moved by" not in line or ";" in line]
    material = Material(given.color, given.texture, 0.1 if given.metallic is None else given.metallic, given.roughness or 0.5)
    return Outcome(file, WARNS if said else LOADS, " ".join(said), (mesh, material))


def _send(file: Path, pipe: Any, keep: bool) -> None:
    """Read a mesh file in a process, and send the outcome through a pipe; `keep`: with the mesh."""
    outcome = read(file)
    pipe.send(outcome if keep else Outcome(outcome.file, outcome.kind, outcome.text))


def read_apart(file: Path, seconds: float, *, keep: bool) -> Outcome:
    """Read a file in a child process; `keep`: with its mesh."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_send, args=(file, sender, keep))
    child.start()
    sender.close()
    try:
        return receiver.recv() if receiver.poll(seconds) else Outcome(file, FAILS, f"not read within {seconds:g} s")
    except EOFError:
        return Outcome(file, FAILS, f"its reader ended with code {child.exitcode}")
    finally:
        child.kill()
        child.join()


def draw(outcomes: list[Outcome], device: str) -> np.ndarray:
    """Draw objects in front of a camera, each alone, scaled to one size (H, W, 3) uint8 RGB."""
    fixed = {"cameras.resolution": [CELL, CELL], "cameras.positions": [[0.0, 0.0, 0.9]], "cameras.ups": [[0.0, 1.0, 0.0]]}
    config = load_config(None, fixed)
    entries = [_entry(number, *found) for number, outcome in enumerate(outcomes) if (found := outcome.found) is not None]
    cameras, count = make_cameras(config.rig), len(entries)
    fixtures = make_fixtures(make_bins(config.cell.bins), config.gripper)
    scene = build_render_scene(
        config.render, -config.tote.wall, Catalog(tuple(entries)), fixtures, cameras, load_lights("")[:1], wp.get_device(device)
    )
    world = allocate(Snapshot, {"world": count, "instance": 1, "fixture": len(fixtures)}, scene.device)
    world.catalog_index.assign(np.arange(count)[:, None])
    world.pose.assign(np.broadcast_to(np.array([0.0, 0.0, 0.3, *TILT], np.float32), (count, 1, 7)))
    world.fixture_visible.zero_()
    renderer = make_renderer(config, scene, 1, count)
    out = allocate_view_buffers(count, CELL, CELL, 1, scene.device)
    indices = wp.array(np.arange(count), dtype=wp.int32, device=scene.device)
    renderer.render(world, make_views(indices, wp.zeros_like(indices), count, 1), out)
    cells = [_label(picture, outcome.file) for picture, outcome in zip(out.color.numpy(), outcomes, strict=True)]
    cells += [np.zeros_like(cells[0])] * (-len(cells) % COLUMNS)
    return np.concatenate([np.concatenate(cells[first : first + COLUMNS], axis=1) for first in range(0, len(cells), COLUMNS)])


def _label(picture: np.ndarray, file: Path) -> np.ndarray:
    """Picture below a line with the file's name."""
    canvas = np.concatenate([np.full((LINE, CELL, 3), 255, np.uint8), picture[..., :3]])
    put_text(canvas, f"{file.parent.name}/{file.name}"[-34:], (2, LINE - 4), 0.38, (30, 30, 30))
    return canvas


def _entry(number: int, mesh: TriangleMesh, material: Material) -> CatalogEntry:
    """A catalog entry for rendering: of the size of all others, and without physics."""
    scale = np.float32(SIZE / max(2.0 * np.linalg.norm(mesh.vertices, axis=1).max(), 1e-9))
    scaled = TriangleMesh(mesh.vertices * scale, mesh.faces, mesh.normals, mesh.uv)
    no_point = np.zeros(3)
    return CatalogEntry(number + 1, "", scaled, material, (), 1e-3, SIZE, 1.0, no_point, np.eye(3), SIZE, (), (), None)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; returns 1 if a file made the program fail."""
    parser = argparse.ArgumentParser(prog="python -m tools.checks.meshes", description="Reads mesh files and tells what became of each.")
    parser.add_argument("folders", nargs="+", type=Path, help="folders, searched with all below them")
    parser.add_argument("--seconds", type=float, default=60.0, help="time limit a file (default: 60)")
    parser.add_argument("--sheet", type=Path, help="write a contact sheet")
    parser.add_argument("--objects", type=int, default=40, help="objects on it, evenly spread over what loads (default: 40)")
    parser.add_argument("--device", default="cpu", help="Warp device that draws (default: cpu)")
    options = parser.parse_args(arguments)
    console = Console(soft_wrap=True, highlight=False)
    files = sorted(file for folder in options.folders for file in folder.rglob("*") if file.suffix.lower() in SUFFIXES)
    outcomes = []
    for file in files:
        outcomes.append(read_apart(file, options.seconds, keep=False))
        console.print(f"{outcomes[-1].kind:8} {file}  {outcomes[-1].text.replace(f'{file}: ', '')}", markup=False)
    counts = Counter((outcome.file.suffix.lower(), outcome.kind) for outcome in outcomes)
    for suffix in SUFFIXES:
        console.print(suffix, ", ".join(f"{counts[suffix, kind]} {kind}" for kind in (LOADS, WARNS, REFUSES, FAILS)))
    good = [outcome.file for outcome in outcomes if outcome.kind in (LOADS, WARNS)]
    if options.sheet is not None and good:
        chosen = [good[index] for index in np.unique(np.linspace(0, len(good) - 1, options.objects).round().astype(int))]
        drawn = [outcome for file in chosen if (outcome := read_apart(file, options.seconds, keep=True)).found is not None]
        write_picture(options.sheet, cv2.cvtColor(draw(drawn, options.device), cv2.COLOR_RGB2BGR))
    return 1 if any(outcome.kind == FAILS for outcome in outcomes) else 0


if __name__ == "__main__":
    sys.exit(main())
