"""Props, what stands around the bin or hangs on the gripper: mesh and material of a file or embedded, pose, collision shapes; and tool
meshes: import, size check and clearance above the suction cups.

Meshes are read in an isolated process, which imports this module; so it does not import Newton, which would take seconds.
"""

import hashlib
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.configs.cell.bins import EMBEDDED, BinSizes, PropRow
from synpick_warp.configs.cell.cameras import GRIPPER, in_opencv_axes
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.errors import CatalogError, ConfigError, suggest
from synpick_warp.scenes.assets.asset_files import ignore
from synpick_warp.scenes.assets.meshes import SUFFIXES, connected_parts, merge_positions, read_cell_mesh, read_measured
from synpick_warp.scenes.cameras import place
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.embedded.props import make_embedded
from synpick_warp.scenes.types import ConvexPiece, Fixture, Prop, TriangleMesh
from synpick_warp.system.linear_algebra import DECIMALS, matmul, quaternion

SIDES = (1e-3, 100.0)
"""Least and largest longest side of a prop [m]: less is lost in the contact margin, and more is an error of the unit."""
PIECES, PIECE_VERTICES = 64, 32
"""Most connected parts of a prop that collides, as each world has all of them, and most vertices of their hulls, as of the gripper's."""
LEVELS, MOST_FILLED = 8, 0.5
"""Points along each axis of a compartment at which a prop is looked for, and largest part of these that it may fill."""
LEAST_HEIGHT = 0.1
"""Height over a pallet or table that counts as the inside [m]."""
METALLIC, ROUGHNESS = 0.0, 0.5
"""Of a material whose file does not state them: plastic or paint."""


def make_props(rows: Sequence[PropRow], bins: Sequence[BinSizes], report: Callable[[str], None] = ignore) -> tuple[Prop, ...]:
    """Load or generate props. `report` receives remarks. Raises ConfigError if a mesh or a pose is invalid, or a collider fills a bin."""
    return tuple(_make_prop(row, bins, report) for row in rows)


def _make_prop(row: PropRow, bins: Sequence[BinSizes], report: Callable[[str], None]) -> Prop:
    label, given = f"prop {row.name}", (row.mesh, row.scale, row.collide)
    if row.mesh not in EMBEDDED and Path(row.mesh).suffix.lower() not in SUFFIXES:
        hint = suggest(Path(row.mesh).name, EMBEDDED)
        raise ConfigError(f"{label}: {row.mesh} is no mesh; allowed: {', '.join((*SUFFIXES, *EMBEDDED))}{hint}")
    fixture, pieces, lines = _read(given) if row.mesh in EMBEDDED else read_measured(_read, given, row.mesh, label)
    for line in lines:
        report(f"{label}: {line}")
    rotation, position = place(label, in_opencv_axes(row.pose))
    turn = quaternion(rotation.T).round(DECIMALS)
    for sizes in bins if pieces else ():
        if (share := _filled(sizes, [matmul(piece.vertices.astype(np.float64), rotation) + position for piece in pieces])) > MOST_FILLED:
            owner = " ".join(dict.fromkeys((sizes.noun, sizes.name)))
            rule = f"move it, or let it not collide; each connected part collides as its convex hull, of these {len(pieces)}"
            raise ConfigError(f"{label} fills {share:.0%} of the {owner}, where objects are dropped; {rule}")
    return Prop(row.name, fixture, (*position.tolist(), *turn.tolist()), row.follows == GRIPPER, pieces)


@lru_cache(maxsize=len(EMBEDDED))
def _read(given: tuple[str, float, bool]) -> tuple[Fixture, tuple[ConvexPiece, ...], tuple[str, ...]]:
    """Mesh and material of an embedded prop or a file, by name, scale and whether it collides; collision shapes; remarks. Files are read
    in an isolated process."""
    name, scale, collides = given
    lines: list[str] = []
    if name in EMBEDDED:
        mesh, material = make_embedded(name)
    else:
        mesh, found, _ = read_cell_mesh(name, "m", (SIDES[0] / scale, SIDES[1] / scale), (np.inf, 0.0), "", lines.append)
        material = found.complete(METALLIC, ROUGHNESS)
    mesh = replace(mesh, vertices=mesh.vertices * np.float32(scale))
    return Fixture(mesh, material), _hulls(mesh, name) if collides else (), tuple(lines)


def _hulls(mesh: TriangleMesh, name: str) -> tuple[ConvexPiece, ...]:
    """Convex hulls of the connected parts of a mesh. Raises CatalogError: they are too many, or one is flat."""
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    part = connected_parts(faces)[faces[:, 0]]
    groups = [vertices[np.unique(faces[part == index])] for index in np.unique(part)]
    if len(groups) > PIECES:
        raise CatalogError(f"{name} has {len(groups)} parts that are not connected; allowed with collide: {PIECES}; simplify the mesh")
    try:
        return tuple(simplify_hull(points, PIECE_VERTICES) for points in groups)
    except CatalogError as error:
        raise CatalogError(f"{name}: {error}; what collides needs a volume") from error


def _filled(sizes: BinSizes, pieces: Sequence[np.ndarray]) -> float:
    """Part of a bin's inside, from floor to rim in its mean place, that convex hulls of points (V, 3) in the world [m] fill."""
    steps = (np.arange(LEVELS) + 0.5) / LEVELS
    height = sizes.height or LEAST_HEIGHT
    places = [
        sizes.to_world((x + (i - 0.5) * length, y + (j - 0.5) * width, k * height))
        for x, y, length, width in sizes.openings
        for i, j, k in itertools.product(steps.tolist(), repeat=3)
    ]
    inside = np.zeros(len(places), bool)
    for points in pieces:
        planes = ConvexHull(points).equations
        inside |= (matmul(np.array(places), planes[:, :3].T) + planes[:, 3] < 0.0).all(axis=1)
    return float(inside.mean())


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
