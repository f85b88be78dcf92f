"""Tool meshes: import, size check and clearance above the suction cups.

Meshes are read in an isolated process, which imports this module; so it does not import Newton, which would take seconds."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import read_cell_mesh, read_measured
from synpick_warp.scenes.types import TriangleMesh

BODY_SIDES, LIKELY_SIDES = (0.01, 2.0), (0.03, 1.0)
"""Allowed range of the longest side of a tool mesh, and its usual range [m]."""
RIM = 8
"""Number of sample points on a cup's rim at which the clearance is measured."""
ROOM, ROOM_TOLERANCE = 0.44, 1e-5
"""Clearance for the bellows between a cup's lip and the mesh, as a fraction of the cup length; tolerance for single precision [m]."""


@dataclass(frozen=True, eq=False)
class ToolBody:
    """Tool mesh in the frame of the gripper head, its height above the lip of each cup [m], and its SHA-256."""

    mesh: TriangleMesh
    undersides: tuple[float, ...]
    checksum: str


def measure_tool(gripper: Gripper) -> dict[str, Gripper]:
    """Gripper settings with the checksum of the mesh, as a section for `override_config`; empty if the checksum is already set. Raises
    ConfigError: the mesh cannot be used as a tool."""
    checksum = read_body(gripper).checksum if gripper.mesh else ""
    return {} if checksum == gripper.mesh_checksum else {"gripper": replace(gripper, mesh_checksum=checksum)}


def read_body(gripper: Gripper) -> ToolBody:
    """Read a gripper's tool mesh, once a process. Raises ConfigError: the mesh cannot be used as a tool."""
    return read_measured(_body, replace(gripper, mesh_checksum=""), gripper.mesh, "gripper.mesh")


def _body(gripper: Gripper) -> ToolBody:
    """Read and check a tool mesh. Runs in an isolated process."""
    path = Path(gripper.mesh)
    mesh = read_cell_mesh(gripper.mesh, gripper.mesh_unit, BODY_SIDES, LIKELY_SIDES, "gripper.mesh_unit").mesh
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    lip = -gripper.cup_length
    lowest = float(corners[..., 2].min())
    if lowest < lip - ROOM_TOLERANCE:
        raise CatalogError(f"{path} reaches {1e3 * (lip - lowest):.3g} mm below the cups' lips, {lip:g} m; they must be its lowest points")
    heights = [_height_over_cup(corners, place, gripper, number) for number, place in enumerate(gripper.cups)]
    state = hashlib.sha256()
    for array in (mesh.vertices, mesh.faces, mesh.normals):
        state.update(np.ascontiguousarray(array).tobytes())
    return ToolBody(replace(mesh, uv=np.zeros_like(mesh.uv)), tuple(heights), state.hexdigest())


def _height_over_cup(corners: np.ndarray, place: tuple[float, float], gripper: Gripper, number: int) -> float:
    """Height of the mesh above the lip of a cup [m]. Raises CatalogError: no mesh above the cup, or no clearance for its bellows."""
    turn = 2.0 * np.pi * np.arange(RIM) / RIM
    rim = np.array(place) + gripper.cup_width / 2 * np.column_stack([np.cos(turn), np.sin(turn)])
    heights = underside(corners, np.concatenate([[place], rim])) + gripper.cup_length
    need = ROOM * gripper.cup_length
    if not np.isfinite(heights[0]):
        raise CatalogError(
            f"{gripper.mesh} has nothing above cup {number} at {list(place)} m, which it must hold; move the cup or the mesh"
        )
    if heights.min() < need - ROOM_TOLERANCE:
        raise CatalogError(
            f"{gripper.mesh} has cup {number} at {list(place)} m inside it: {1e3 * heights.min():.3g} mm above its lip; allowed: at least "
            f"{1e3 * need:.3g} mm, {ROOM:g} of gripper.cup_length"
        )
    return float(heights[0])


def underside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Vertical ray casting: height (n) of the lowest intersection of vertical lines through points (n, 2) with triangles (F, 3, 3) [m];
    infinity: no intersection."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    a, b, c, area = (array[np.abs(area) > 1e-12] for array in (a, b, c, area))
    x, y = np.moveaxis(points[:, None] - a[:, :2], 2, 0)
    u, v = (x * c[:, 1] - y * c[:, 0]) / area, (y * b[:, 0] - x * b[:, 1]) / area
    over = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
    return np.where(over, a[:, 2] + u * b[:, 2] + v * c[:, 2], np.inf).min(axis=1, initial=np.inf)
