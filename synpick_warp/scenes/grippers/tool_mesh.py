"""Body of a tool from a mesh file: read in an isolated process, and compared with the places of its cups."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.episodes.objects import UNITS
from synpick_warp.configs.fields import PATH_RULE
from synpick_warp.errors import CatalogError, ConfigError, SynpickError
from synpick_warp.scenes.assets.meshes import SUFFIXES, MeshOptions, read_mesh
from synpick_warp.scenes.types import TriangleMesh
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

SIDES = (0.01, 2.0)
"""Least and largest longest side of a body [m]."""
MAX_FACES = 200_000
"""Triangles of a body, as of a bin."""
LIMITS = Limits(600.0, 2**33)
"""Limits of reading a mesh."""
ROOM = 0.44
"""Height above the lips that cups need for their bellows, as a fraction of the cup's length."""
RIM = 8
"""Points of a cup's rim at which the room is measured."""
TOLERANCE = 1e-5
"""By which a body may be lower than that [m]: meshes have single precision."""


@dataclass(frozen=True, eq=False)
class ToolBody:
    """Mesh of a tool's body in the frame of the head, height of its lower side above each cup's lip [m], SHA-256 of the mesh."""

    mesh: TriangleMesh
    undersides: tuple[float, ...]
    checksum: str


def measure_tool(gripper: Gripper) -> dict[str, Gripper]:
    """Section, for `override_config`, of a gripper with the checksum of its mesh; none if it has it.

    Raises:
        ConfigError: The mesh cannot be used as a tool's body.
    """
    checksum = read_body(gripper).checksum if gripper.mesh else ""
    return {} if checksum == gripper.mesh_checksum else {"gripper": replace(gripper, mesh_checksum=checksum)}


def read_body(gripper: Gripper) -> ToolBody:
    """Read the mesh of a gripper, or return it as it was read before in this process.

    Raises:
        ConfigError: It cannot be used as a tool's body.
    """
    path = Path(gripper.mesh)
    try:
        stat = path.stat()
    except OSError as error:
        raise ConfigError(f"gripper.mesh: {path} cannot be read ({error.strerror}); {PATH_RULE}") from error
    return _read(replace(gripper, mesh_checksum=""), (stat.st_mtime_ns, stat.st_size))


@lru_cache(maxsize=8)
def _read(gripper: Gripper, stamp: tuple[int, int]) -> ToolBody:
    """Read the mesh of a gripper in an isolated process; `stamp`: time of change and size of the file."""
    (found,) = run_isolated(_body, [(gripper,)], LIMITS)
    if isinstance(found, Failure):
        raise ConfigError(f"gripper.mesh: the process that reads {gripper.mesh} {found.reason}; repair or simplify the mesh")
    if isinstance(found, SynpickError):
        raise ConfigError(f"gripper.mesh: {found}")
    return found


def _body(gripper: Gripper) -> ToolBody:
    """Read and check the mesh of a gripper. Runs in an isolated process."""
    path = Path(gripper.mesh)
    if path.suffix.lower() not in SUFFIXES:
        raise CatalogError(f"{path} is no mesh; allowed: {', '.join(SUFFIXES)}")
    mesh, _ = read_mesh(path, UNITS[gripper.mesh_unit], MeshOptions(substitute=True))
    if len(mesh.faces) > MAX_FACES:
        raise CatalogError(f"{path} has {len(mesh.faces):,} triangles; allowed: {MAX_FACES:,}; decimate the mesh")
    _check_sides(mesh, gripper)
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    lip = -gripper.cup_length
    lowest = float(corners[..., 2].min())
    if lowest < lip - TOLERANCE:
        raise CatalogError(f"{path} reaches {1e3 * (lip - lowest):.3g} mm below the cups' lips, {lip:g} m; they must be its lowest points")
    heights = [_height_over_cup(corners, place, gripper, number) for number, place in enumerate(gripper.cups)]
    state = hashlib.sha256()
    for array in (mesh.vertices, mesh.faces, mesh.normals):
        state.update(np.ascontiguousarray(array).tobytes())
    return ToolBody(replace(mesh, uv=np.zeros_like(mesh.uv)), tuple(heights), state.hexdigest())


def _check_sides(mesh: TriangleMesh, gripper: Gripper) -> None:
    """Refuse a mesh that is too small or too large for a tool, with the unit in which it would not be."""
    sides = np.ptp(mesh.vertices.astype(np.float64), axis=0)
    if SIDES[0] <= sides.max() <= SIDES[1]:
        return
    unit = gripper.mesh_unit
    fitting = [f'"{name}"' for name, size in UNITS.items() if 0.03 <= sides.max() / UNITS[unit] * size <= 1.0]
    advice = f"; did you mean gripper.mesh_unit = {' or '.join(fitting)}?" if fitting else ""
    shown = " x ".join(f"{side:.4g}" for side in sides)
    raise CatalogError(f"{gripper.mesh} is {shown} m, unit {unit}; allowed: a longest side of {SIDES[0]:g} to {SIDES[1]:g} m{advice}")


def _height_over_cup(corners: np.ndarray, place: tuple[float, float], gripper: Gripper, number: int) -> float:
    """Height of a body's lower side above the lip of a cup [m], which must have room for its bellows and something to hold it."""
    turn = 2.0 * np.pi * np.arange(RIM) / RIM
    rim = np.array(place) + gripper.cup_width / 2 * np.column_stack([np.cos(turn), np.sin(turn)])
    heights = underside(corners, np.concatenate([[place], rim])) + gripper.cup_length
    need = ROOM * gripper.cup_length
    if not np.isfinite(heights[0]):
        raise CatalogError(
            f"{gripper.mesh} has nothing above cup {number} at {list(place)} m, which it must hold; move the cup or the mesh"
        )
    if heights.min() < need - TOLERANCE:
        raise CatalogError(
            f"{gripper.mesh} has cup {number} at {list(place)} m inside it: {1e3 * heights.min():.3g} mm above its lip; allowed: at least "
            f"{1e3 * need:.3g} mm, {ROOM:g} of gripper.cup_length"
        )
    return float(heights[0])


def underside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Lowest height (n) at which vertical lines through points (n, 2) meet triangles (F, 3, 3) [m]; infinity: they meet none."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    a, b, c, area = (array[np.abs(area) > 1e-12] for array in (a, b, c, area))
    heights = np.full(len(points), np.inf)
    for number, (x, y) in enumerate(points):
        dx, dy = x - a[:, 0], y - a[:, 1]
        u, v = (dx * c[:, 1] - dy * c[:, 0]) / area, (dy * b[:, 0] - dx * b[:, 1]) / area
        over = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
        heights[number] = (a[:, 2] + u * b[:, 2] + v * c[:, 2])[over].min(initial=np.inf)
    return heights
