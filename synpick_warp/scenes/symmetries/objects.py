"""Symmetries of an object: those that its row of the object table or models_info.json declares, or else those that are detected."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from synpick_warp.configs.episodes.objects import DETECT, ObjectRow, Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import MeshFile
from synpick_warp.scenes.assets.models_info import FileModelInfo, check_against_mesh
from synpick_warp.scenes.symmetries import detection
from synpick_warp.scenes.symmetries.surface import SampledSurface
from synpick_warp.system.linear_algebra import dot, norm

_MAX_SHOWN = 4
"""Most axes of discrete symmetries that a line names."""


def add_symmetries(
    info: FileModelInfo, found: MeshFile, diameter: float, row: ObjectRow | None, objects: Objects, origin: str
) -> tuple[FileModelInfo, list[str]]:
    """Add the symmetries of the object's row to its entry, or detect them if neither has any and the settings ask for it. `info`: entry of
    models_info.json; without symmetries if there is none. Returns the entry with symmetries, and lines on what was found, or on what is
    declared and does not hold. Raises CatalogError: with `objects.strict`, a declared symmetry does not hold; or the declared ones generate
    too many."""
    if row is not None and (row.symmetries_discrete or row.symmetries_continuous):
        return _declared(info, found, diameter, row, objects.strict, origin)
    if objects.symmetries != DETECT or info.symmetries_discrete or info.symmetries_continuous:
        return info, []
    tolerance = objects.symmetry_tolerance * diameter
    symmetries = detection.find_symmetries(found.mesh.vertices, found.mesh.faces, diameter, tolerance)
    return _with(info, symmetries.discrete, [(turn.axis, turn.point) for turn in symmetries.continuous]), [
        f"{origin}: {describe_symmetries(symmetries, tolerance)}"
    ]


def _declared(
    info: FileModelInfo, found: MeshFile, diameter: float, row: ObjectRow, strict: bool, origin: str
) -> tuple[FileModelInfo, list[str]]:
    """The entry with the symmetries of a row, moved with the mesh, and closed under composition."""
    center = SampledSurface(found.mesh.vertices, found.mesh.faces).center
    matrices = [_matrix(values, found.moved, center) for values in row.symmetries_discrete]
    axes = [_axis(values, values[3:], found.moved, center) for values in row.symmetries_continuous]
    _, said = check_against_mesh(_with(FileModelInfo(), matrices, axes), found.mesh.vertices, diameter)
    line = f"{origin}: its row of the object table gives {'; '.join(said)}"
    if said and strict:
        raise CatalogError(line)
    closed = detection.close_transforms(matrices)
    if closed is None:
        advice = "a symmetry about an axis by any angle belongs into symmetries_continuous"
        raise CatalogError(f"{origin}: the discrete symmetries in its row generate more than {detection.MAX_ELEMENTS}; {advice}")
    return _with(info, closed, axes), [line] if said else []


def _matrix(values: Sequence[float], moved: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Rigid 4 x 4 matrix of a declared discrete symmetry, in the frame of the moved mesh."""
    if len(values) != 16:
        return detection.turn_matrix(*_axis(values, values[4:], moved, center), 2.0 * np.pi / values[3])
    matrix = np.reshape(values, (4, 4))
    matrix[:3, 3] += moved - dot(matrix[:3, :3], moved)
    return matrix


def _axis(values: Sequence[float], offset: Sequence[float], moved: np.ndarray, center: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit axis, and a point on it in the frame of the moved mesh; without an offset, that of the centroid next to the origin."""
    axis = np.array(values[:3], np.float64)
    axis /= norm(axis)
    return axis, np.array(offset) + moved if len(offset) else center - axis * dot(axis, center)


def _with(info: FileModelInfo, matrices: Sequence[np.ndarray] | np.ndarray, axes: Sequence[tuple[np.ndarray, np.ndarray]]) -> FileModelInfo:
    """The entry with these symmetries, rounded to 1e-9: further digits depend on the machine, and the catalog's digest on all of them."""
    return replace(
        info,
        symmetries_discrete=tuple(tuple(_rounded(value) for value in matrix.reshape(-1)) for matrix in matrices),
        symmetries_continuous=tuple((_triple(axis), _triple(point)) for axis, point in axes),
    )


def _triple(vector: np.ndarray) -> tuple[float, float, float]:
    """Vector as a tuple."""
    x, y, z = (_rounded(value) for value in vector)
    return x, y, z


def _rounded(value: float) -> float:
    """Number with nine decimals, without a negative zero."""
    return round(float(value), 9) + 0.0


def describe_symmetries(symmetries: detection.Symmetries, tolerance: float) -> str:
    """Line on detected symmetries with their distances, or on the nearest miss; `tolerance`: that of the detection [m]."""
    parts = [f"continuous about {_shown(turn.axis)}" for turn in symmetries.continuous]
    axes = detection.find_axes(symmetries.discrete)
    parts += [f"{turn.fold}-fold about {_shown(turn.axis)}" for turn in axes[:_MAX_SHOWN]]
    parts += [f"{len(axes) - _MAX_SHOWN} more axes"] if len(axes) > _MAX_SHOWN else []
    allowed = f"{1e3 * tolerance:.3g} mm allowed"
    if parts:
        off = max([*symmetries.deviations, *(turn.deviation for turn in symmetries.continuous)])
        return f"symmetries detected: {', '.join(parts)}; they move its surface by up to {1e3 * off:.2g} mm, {allowed}"
    missed = (
        "" if symmetries.missed is None else f"; the nearest, {_named(symmetries.missed)}, by {1e3 * symmetries.missed.deviation:.2g} mm"
    )
    return f"no symmetries detected, {allowed}{missed}"


def _named(turn: detection.Turn) -> str:
    """Words for a rotation."""
    return f"{'a half turn' if turn.fold == 2 else f'1/{turn.fold} turn'} about {_shown(turn.axis)}"


def _shown(axis: np.ndarray) -> str:
    """Direction with three digits."""
    return f"({', '.join(f'{value + 0.0:.3g}' for value in axis.round(3))})"
