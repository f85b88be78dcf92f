"""Meshes of bins: read in an isolated process, turned and placed, measured, and given collision shapes."""

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.configs.cell.bins import AXES, BOX, FILE, BinRow, MeasuredBin
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import NO_MATERIAL, FileMaterial
from synpick_warp.scenes.assets.meshes import read_cell_mesh, read_measured
from synpick_warp.scenes.bin_meshes import compartments
from synpick_warp.scenes.bin_meshes.colliders import make_box, make_colliders
from synpick_warp.scenes.bin_meshes.inside import MIN_DEPTH, BinSurface, HeightField, find_inside, make_limits
from synpick_warp.scenes.types import BLACK, PLAIN, ConvexPiece, Material, TriangleMesh
from synpick_warp.system.linear_algebra import matmul

SIDES = (0.02, 10.0)
"""Least and largest side of a bin [m], as of those that are given by sizes."""
LIKELY_SIDES = (0.1, 2.0)
"""Of most bins [m]."""
COARSE = 64
"""Cells of the height field where only its direction is in question."""
DIGITS = 6
"""Decimals of measured lengths [m]."""
MAX_LISTED = 6
"""Most compartments whose floors a line names."""
RAY_STEP = 5e-3
"""Distance of the rays by which collision shapes are compared with the mesh [m]."""
AGREEMENT, MAX_DIFFERENT = 3e-3, 0.01
"""Largest difference of the heights where both agree [m], and largest fraction of the rays with more."""


@dataclass(frozen=True, eq=False)
class BinModel:
    """Mesh, material and collision shapes of a bin in its frame, its inside, and remarks on it."""

    mesh: TriangleMesh
    material: FileMaterial
    pieces: tuple[ConvexPiece, ...]
    limits: HeightField
    measured: MeasuredBin
    notes: tuple[str, ...]
    """Lines on what was read."""


def measure_bins(rows: tuple[BinRow, ...]) -> dict[str, tuple[BinRow, ...]]:
    """Setting, for `override_config`, of [[bin]] tables with what their meshes measure; none if they have it. Raises ConfigError: a mesh
    cannot be used as a bin."""
    found = tuple(replace(row, measured=read_bin(row).measured) if row.file else row for row in rows)
    return {} if found == rows else {"bin": found}


def read_bin(row: BinRow) -> BinModel:
    """Read the mesh of a bin, or return it as it was read before in this process. Raises ConfigError: it cannot be used as a bin."""
    return read_measured(_model, replace(row, measured=None, weight=1.0), row.file or "", f"bin {row.name}")


def _model(row: BinRow) -> BinModel:
    """Read and measure the mesh of a bin. Runs in an isolated process."""
    path, lines = Path(row.file or ""), []
    unit, up = row.unit or "m", row.up or "z"
    mesh, material, _ = read_cell_mesh(str(path), unit, SIDES, LIKELY_SIDES, "unit", lines.append)
    mesh = _rotate(mesh, lambda vectors: matmul(vectors, _rotation(up).astype(np.float32).T))
    yaw = compartments.find_turn(mesh.vertices[mesh.faces].astype(np.float64))
    mesh = _rotate(mesh, lambda vectors: compartments.turned(vectors.astype(np.float64), -yaw).astype(np.float32)) if yaw else mesh
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    surface = find_inside(corners)
    places = compartments.find_compartments(surface) if surface else []
    if surface is None or not places:
        raise CatalogError(f"{path} has no inside {_explain(corners, up)}")
    low, high = compartments.find_opening(surface, places)
    origin = np.array([*((low + high) / 2.0), surface.floor])
    holes, leans = compartments.find_holes(surface), any(one.leans for one in places)
    pieces = _make_pieces(row, mesh, corners, surface, places, holes)
    measured = MeasuredBin(
        box=_rounded(np.concatenate([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))]) - np.tile(origin, 2)),
        opening=_rounded(high - low),
        height=round(surface.rim - float(origin[2]), DIGITS),
        origin=_rounded(compartments.turned(origin[None], yaw)[0]) if row.place == FILE else (0.0, 0.0, 0.0),
        yaw=yaw or None,
        compartments=tuple(_rounded((*_shifted(one.floor, origin), *_moved(one.plane, origin))) for one in places),
        openings=tuple(_rounded(_shifted(one.opening, origin)) for one in places) if leans else None,
        floor=_rounded(np.ptp(compartments.enclose([one.span for one in places]), axis=0)) if leans else None,
        checksum="",
    )
    mesh = replace(mesh, vertices=(mesh.vertices - origin).astype(np.float32))
    measured = replace(measured, checksum=_checksum(mesh, material))
    pieces = tuple(ConvexPiece((piece.vertices - origin).astype(np.float32), piece.faces) for piece in pieces)
    lines += [_describe(measured, places, unit, len(pieces)), *_describe_holes(surface, holes, row)]
    limits = make_limits(surface, origin)
    return BinModel(mesh, material, pieces, limits, measured, tuple(f"bin {row.name}: {line}" for line in lines))


def _make_pieces(
    row: BinRow, mesh: TriangleMesh, corners: np.ndarray, surface: BinSurface, places: list[compartments.Compartment], holes: np.ndarray
) -> tuple[ConvexPiece, ...]:
    """Collision shapes of a bin: those of its mesh, which must agree with it, or a closed box. Raises CatalogError: the mesh needs too
    many, or they differ from it."""
    if row.collision == BOX:
        return make_box(surface, places, compartments.find_opening(surface, places))
    advice = f', or set collision = "{BOX}", which closes its holes' if len(holes) else ""
    try:
        pieces = make_colliders(mesh.vertices, mesh.faces, surface)
    except CatalogError as error:
        raise CatalogError(f"{row.file}: {error}{advice}") from error
    share = _disagreement(corners, pieces, surface)
    if share > MAX_DIFFERENT:
        raise CatalogError(
            f"{row.file}: collision shapes and mesh differ by more than {1e3 * AGREEMENT:g} mm over {share:.0%} of the opening; "
            f"close the gaps of the mesh, or simplify it{advice}"
        )
    return pieces


def _rotate(mesh: TriangleMesh, rotate: Callable[[np.ndarray], np.ndarray]) -> TriangleMesh:
    """Mesh whose vertices and normals are rotated."""
    return replace(mesh, vertices=rotate(mesh.vertices), normals=rotate(mesh.normals))


def _rotation(up: str) -> np.ndarray:
    """Rotation of an axis to z: about x for y, about y for x."""
    axis, sign = "xyz".index(up[-1]), -1.0 if up.startswith("-") else 1.0
    rows = {
        2: [(1, 0, 0), (0, sign, 0), (0, 0, sign)],
        1: [(1, 0, 0), (0, 0, -sign), (0, sign, 0)],
        0: [(0, 0, -sign), (0, 1, 0), (sign, 0, 0)],
    }
    return np.array(rows[axis], float)


def _explain(corners: np.ndarray, up: str) -> str:
    """Why a mesh has no inside: the direction in which it would have the largest one, if any."""
    sizes = {}
    back = _rotation(up).T
    for other in AXES:
        surface = find_inside(matmul(corners, matmul(_rotation(other), back).T), COARSE)
        if other != up and surface is not None and compartments.find_compartments(surface):
            sizes[other] = float((surface.rim - surface.height[surface.inside]).sum()) * surface.cell**2
    least = f"{1e3 * MIN_DEPTH:g} mm deep and {1e3 * compartments.MIN_SIDE:g} mm wide"
    rule = f"as seen from above, with up = {up}: it is closed, flat, or not {least}"
    best = max(sizes, key=lambda name: sizes[name], default="")
    return f'{rule}; did you mean up = "{best}"?' if best else f"{rule}; a bin needs an open top"


def _shifted(rectangle: compartments.Rectangle, origin: np.ndarray) -> tuple[float, ...]:
    """Rectangle in the frame at `origin`."""
    x, y, *sides = rectangle
    return x - origin[0], y - origin[1], *sides


def _moved(plane: tuple[float, float, float], origin: np.ndarray) -> tuple[float, float, float]:
    """Plane z = a x + b y + c in the frame at `origin`."""
    a, b, c = plane
    return a, b, float(a * origin[0] + b * origin[1] + c - origin[2])


def _rounded(values: np.ndarray | tuple[float, ...]) -> tuple:
    """Values to DIGITS decimals."""
    return tuple(round(float(value), DIGITS) + 0.0 for value in values)


def _checksum(mesh: TriangleMesh, material: FileMaterial) -> str:
    """SHA-256 of a mesh in the bin's frame and of its material."""
    added = [value for value, none in ((material.light, BLACK), (material.finish, PLAIN)) if value != none]
    state = hashlib.sha256(repr((material.color, material.metallic, material.roughness, *added)).encode())
    for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.uv, material.texture):
        state.update(b"" if array is None else np.ascontiguousarray(array).tobytes())
    return state.hexdigest()


def _describe(measured: MeasuredBin, places: list[compartments.Compartment], unit: str, pieces: int) -> str:
    """Line on what was measured."""
    box, count = np.array(measured.box), len(places)
    rooms = "floor " if count == 1 else f"{count} compartments with floors of "
    rooms += ", ".join(_millimetres(one.span[2:]) for one in places[:MAX_LISTED]) + (" and more" if count > MAX_LISTED else "")
    turn = f", turned by {measured.yaw:.4g}°" if measured.yaw else ""
    inner = f"{rooms} mm, opening {_millimetres(measured.opening)} mm, depth {_millimetres((measured.height,))} mm"
    return f"{_millimetres(box[3:] - box[:3])} mm, unit {unit}{turn}; {inner}, {pieces} collision shapes"


def _describe_holes(surface: BinSurface, holes: np.ndarray, row: BinRow) -> list[str]:
    """Line on a missing floor, or on holes that parts fall through, if there are any."""
    if row.collision == BOX:
        return ["it collides as a closed box; nothing falls through its holes"] if len(holes) else []
    if not surface.has_floor:
        return ["it has no floor: parts will lie on the table"]
    if not len(holes):
        return []
    largest, count = _millimetres(np.round(max(holes.tolist(), key=min), 3)), "a hole" if len(holes) == 1 else f"{len(holes)} holes"
    return [f'it has {count} of up to {largest} mm: parts that fall through will lie on the table, unless collision = "{BOX}"']


def _millimetres(sides: Iterable[float]) -> str:
    """Lengths [m] as text, such as "412 x 262" for millimetres."""
    return " x ".join(f"{1e3 * side:.4g}" for side in sides)


def _disagreement(corners: np.ndarray, pieces: tuple[ConvexPiece, ...], surface: BinSurface) -> float:
    """Fraction of vertical rays into the inside for which collision shapes and mesh differ.

    A ray that meets the collision shapes at a height between those of the mesh at it and its neighbours agrees: it may be beside a step.
    """
    low, high = (surface.centers(end) for end in (np.argwhere(surface.inside).min(axis=0), np.argwhere(surface.inside).max(axis=0)))
    axes = [np.arange(low[axis], high[axis] + RAY_STEP, RAY_STEP) for axis in (0, 1)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    mesh, shapes = (np.full(points.shape[:2], -np.inf) for _ in range(2))
    for triangle in corners:
        _raise_to_triangle(mesh, points, triangle)
    for piece in pieces:
        _raise_to_piece(shapes, points, piece)
    least, most = (np.stack([np.roll(mesh, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)]) for _ in range(2))
    agrees = (shapes >= least.min(axis=0) - AGREEMENT) & (shapes <= most.max(axis=0) + AGREEMENT)
    counted = surface.inside[surface.index(points)] & np.isfinite(mesh)
    return float((counted & ~agrees).sum()) / max(1, int(counted.sum()))


def _block(points: np.ndarray, corners: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of a grid of points that a set of corners may cover."""
    low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
    x, y = points[:, 0, 0], points[0, :, 1]
    return (
        slice(int(np.searchsorted(x, low[0])), int(np.searchsorted(x, high[0], "right"))),
        slice(int(np.searchsorted(y, low[1])), int(np.searchsorted(y, high[1], "right"))),
    )


def _raise_to_triangle(heights: np.ndarray, points: np.ndarray, triangle: np.ndarray) -> None:
    """Raise heights to those of a triangle where it lies over the points."""
    (ax, ay, az), b, c = triangle[0], triangle[1] - triangle[0], triangle[2] - triangle[0]
    area = b[0] * c[1] - b[1] * c[0]
    block = _block(points, triangle)
    if abs(area) < 1e-12 or heights[block].size == 0:
        return
    x, y = points[block][..., 0] - ax, points[block][..., 1] - ay
    u, v = (x * c[1] - y * c[0]) / area, (y * b[0] - x * b[1]) / area
    over = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1.0 + 1e-9)
    heights[block] = np.where(over, np.maximum(heights[block], az + u * b[2] + v * c[2]), heights[block])


def _raise_to_piece(heights: np.ndarray, points: np.ndarray, piece: ConvexPiece) -> None:
    """Raise heights to the upper side of a convex piece where it lies over the points."""
    vertices = piece.vertices.astype(np.float64)
    block = _block(points, vertices)
    if heights[block].size == 0:
        return
    planes = ConvexHull(vertices).equations
    reach = matmul(points[block], planes[:, :2].T) + planes[:, 3]
    up, down, upright = planes[:, 2] > 1e-6, planes[:, 2] < -1e-6, np.abs(planes[:, 2]) <= 1e-6
    top = (-reach[..., up] / planes[up, 2]).min(axis=-1)
    bottom = (-reach[..., down] / planes[down, 2]).max(axis=-1)
    over = (reach[..., upright] <= 1e-9).all(axis=-1) & (bottom <= top)
    heights[block] = np.where(over, np.maximum(heights[block], top), heights[block])


def bin_material(model: BinModel, row: BinRow) -> Material:
    """Material of a bin: that of its file; what this does not state is the row's."""
    material = model.material.complete(row.metallic, row.roughness)
    return replace(material, color=row.color) if material.texture is None and material.color == NO_MATERIAL.color else material
