"""Props, what stands around the bin or hangs on the gripper: mesh and material of a file or embedded, pose, collision shapes.

Meshes are read in an isolated process, which imports this module; so it does not import Newton, which would take seconds."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.configs.cell.bins import EMBEDDED, BinSizes, PropRow
from synpick_warp.configs.cell.cameras import GRIPPER, in_opencv_axes
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
