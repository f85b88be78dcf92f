"""Bodies of tools from meshes, read in an isolated process, which imports this module: without Newton, as that takes seconds."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import read_cell_mesh, read_measured
from synpick_warp.scenes.types import TriangleMesh

BODY_SIDES, LIKELY_SIDES = (0.01, 2.0), (0.03, 1.0)
"""Least and largest longest side of a body, and of most bodies [m]."""
RIM = 8
"""Points of a cup's rim at which the room is measured."""
ROOM, ROOM_TOLERANCE = 0.44, 1e-5
"""Height above the lips that cups need for their bellows, in cup lengths; by what a body may be lower [m], as its precision is single."""


@dataclass(frozen=True, eq=False)
class ToolBody:
    """Mesh of a tool's body in the frame of the head, height of its lower side above each cup's lip [m], SHA-256 of the mesh."""

    mesh: TriangleMesh
    undersides: tuple[float, ...]
    checksum: str


def measure_tool(gripper: Gripper) -> dict[str, Gripper]:
    """Section, for `override_config`, of a gripper with the checksum of its mesh; none if it has it. Raises ConfigError: the mesh cannot be
    used as a tool's body."""
    checksum = read_body(gripper).checksum if gripper.mesh else ""
    return {} if checksum == gripper.mesh_checksum else {"gripper": replace(gripper, mesh_checksum=checksum)}


def read_body(gripper: Gripper) -> ToolBody:
    """Read the mesh of a gripper, or return it as it was read before in this process. Raises ConfigError: it cannot be used as a tool's
    body."""
    return read_measured(_body, replace(gripper, mesh_checksum=""), gripper.mesh, "gripper.mesh")


def _body(gripper: Gripper) -> ToolBody:
    """Read and check the mesh of a gripper. Runs in an isolated process."""
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
    """Height of a body's lower side above the lip of a cup [m], which must have room for its bellows and something to hold it."""
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
    """Lowest height (n) at which vertical lines through points (n, 2) meet triangles (F, 3, 3) [m]; infinity: they meet none."""
    a, b, c = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    area = b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0]
    a, b, c, area = (array[np.abs(area) > 1e-12] for array in (a, b, c, area))
    x, y = np.moveaxis(points[:, None] - a[:, :2], 2, 0)
    u, v = (x * c[:, 1] - y * c[:, 0]) / area, (y * b[:, 0] - x * b[:, 1]) / area
    over = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
    return np.where(over, a[:, 2] + u * b[:, 2] + v * c[:, 2], np.inf).min(axis=1, initial=np.inf)
