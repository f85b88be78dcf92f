"""Detection of rotational symmetries of a surface: candidate axes, refinement, verification by distance, closure to a group;
or those that an object's row or models_info.json declares.

The surface is symmetric under a rotation if the Hausdorff distance between it and its rotated self is within a tolerance: BOP's
condition (Hodaň et al., BOP Challenge 2020), which takes 0.1 of the diameter, at least 15 mm. Texture does not count.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice, takewhile

import numpy as np

from synpick_warp.configs.episodes.objects import DETECT, ObjectRow, Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import MeshFile
from synpick_warp.scenes.assets.models_info import FileModelInfo, check_against_mesh
from synpick_warp.scenes.symmetries.surface import SampledSurface
from synpick_warp.system.linear_algebra import DECIMALS, dot, eigh, lstsq, matmul, nearest_rotation, norm, rotation, solve

MAX_FOLD = 36
"""Largest fold that is looked for; an axis with all folds up to it is continuous."""
_GRID, _GRID_FOLDS = 600, (2, 3, 4, 5)
"""Directions over the half sphere, 6° apart, and the folds about them: polyhedra have no others; axes of larger folds are principal."""
_MOMENTS = 0.15
"""Relative difference between the covariances of a surface and its rotated self up to which the rotation is a candidate."""
_MARGIN = 0.03
"""Mean distance that a candidate may have beyond the tolerance, in diameters: its axis is up to 4° off."""
_NEIGHBOURHOOD = np.cos(np.radians(9.0)).round(DECIMALS)
_PARALLEL = np.cos(np.radians(5.0)).round(DECIMALS)
_SAME = 15.0
"""Angle up to which two rotations of a group are one [°], or 0.4 of the angle of the largest fold; in the icosahedron's, 44° is least."""
_STEPS, _ROUGH, _FINE = 8, 600, 6_000
"""Iterations of the refinement; points from which all candidates, and those within twice the tolerance, are refined."""


@dataclass(frozen=True)
class Turn:
    """A rotation that maps a surface onto itself: unit axis, a point on it [m], fold (0: any angle), distance of subsamples [m]."""

    axis: np.ndarray
    point: np.ndarray
    fold: int
    deviation: float

    def matrix(self, angle: float | None = None) -> np.ndarray:
        """Rigid transform by an angle [rad]; None: a turn by a fold's angle."""
        return turn_matrix(self.axis, self.point, 2.0 * np.pi / max(self.fold, 2) if angle is None else angle)


@dataclass(frozen=True)
class Symmetries:
    """Symmetries that were found: discrete ones (N, 4, 4) without the identity, closed under composition up to the continuous ones,
    with their distances (N) [m], the largest from all points, others from subsamples, and continuous ones; and the best rotation beyond the
    tolerance, up to twice of it."""

    discrete: np.ndarray
    deviations: np.ndarray
    continuous: tuple[Turn, ...]
    missed: Turn | None


Detector = Callable[[np.ndarray, np.ndarray, float, float], Symmetries]
"""A function as `find_symmetries`."""


def turn_matrix(axis: np.ndarray, point: np.ndarray, angle: float) -> np.ndarray:
    """Rotation by an angle [rad] about an axis through a point, as a 4 x 4 matrix."""
    return _about(rotation(axis, angle), point)


def _axis_angle(matrix: np.ndarray) -> tuple[np.ndarray, float]:
    """Unit axis and angle [rad], 0 to pi, of a rotation matrix (3, 3); of the identity, no axis but zeros."""
    # Of two forms of an axis: its matrix's antisymmetric part vanishes at half turns, a column of the symmetric part at none.
    twice = np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])
    cosine = (np.trace(matrix) - 1.0) / 2.0
    if cosine > 0.0:
        axis = twice
    else:
        symmetric = (matrix + matrix.T) / 2.0 - cosine * np.eye(3)
        column = symmetric[:, int(np.argmax(np.diag(symmetric)))]
        axis = column * (-1.0 if dot(column, twice) < 0.0 else 1.0)
    length = norm(axis)
    return axis / (length or 1.0), round(float(np.arctan2(norm(twice) / 2.0, cosine)), DECIMALS)


def find_axes(matrices: np.ndarray) -> list[Turn]:
    """Axes of discrete symmetries (N, 4, 4), each with its largest fold, without distances; larger folds first."""
    found: list[Turn] = []
    for matrix in matrices:
        axis, angle = _axis_angle(matrix[:3, :3])
        if angle < 1e-3:
            continue
        axis = _upward(axis)
        turn = Turn(axis, lstsq(np.eye(3) - matrix[:3, :3], matrix[:3, 3], 1e-6), max(round(2.0 * np.pi / angle), 2), 0.0)
        beside = next((index for index, other in enumerate(found) if abs(dot(other.axis, axis)) > np.cos(np.radians(2.0))), None)
        if beside is None:
            found.append(turn)
        elif turn.fold > found[beside].fold:
            found[beside] = turn
    return sorted(found, key=lambda turn: -turn.fold)


def _upward(axis: np.ndarray) -> np.ndarray:
    """Flip an axis such that its largest component is positive."""
    return axis * np.sign(axis[np.argmax(np.abs(axis))])


def find_symmetries(vertices: np.ndarray, faces: np.ndarray, diameter: float, tolerance: float) -> Symmetries:
    """Find the rotational symmetries of a mesh, vertices (V, 3) and faces (F, 3), of a diameter [m]. `tolerance`: largest Hausdorff
    distance [m]. Returns a closed group of discrete symmetries. Rotations about a continuous axis are omitted, as the axis stands for them;
    beside it there is at most one half turn, about a perpendicular axis. A ball has three continuous axes, which stand for all rotations.
    """
    surface = SampledSurface(vertices, faces)
    turns, missed = _find_turns(surface, diameter, tolerance)
    continuous = sorted((turn for turn in turns if turn.fold == 0), key=lambda turn: turn.deviation)[:1]
    if continuous:
        first = continuous[0]
        others = [turn for turn in turns if turn.fold == 0 and abs(dot(turn.axis, first.axis)) < _PARALLEL]
        if others:
            return Symmetries(np.zeros((0, 4, 4)), np.zeros(0), _ball(surface, tolerance) or (first,), None)
        flips = sorted((_flip(surface, first, turn) for turn in turns if turn.fold == 2), key=lambda turn: turn.deviation)
        confirmed = (_confirmed(surface, flip, tolerance) for flip in flips if flip.deviation <= tolerance)
        found = [_confirmed(surface, flip, np.inf) for flip in islice((flip for flip in confirmed if flip.deviation <= tolerance), 1)]
        return Symmetries(
            np.array([turn.matrix() for turn in found]).reshape(-1, 4, 4), np.array([turn.deviation for turn in found]), (first,), missed
        )
    return Symmetries(*_close(surface, turns, tolerance), (), missed)


def _find_turns(surface: SampledSurface, diameter: float, tolerance: float) -> tuple[list[Turn], Turn | None]:
    """Rotations within the tolerance, of continuous axes with fold 0; and the nearest one beyond it, up to twice the tolerance."""
    turns: list[Turn] = []
    missed: Turn | None = None
    seen: list[tuple[np.ndarray, int]] = []

    def is_known(axis: np.ndarray, fold: int) -> bool:
        return any(abs(dot(axis, other)) > _PARALLEL and of in (0, fold) for other, of in seen)

    for _, axis, fold in sorted(_candidates(surface, diameter, tolerance), key=lambda candidate: candidate[0]):
        if is_known(axis, fold):
            continue
        axis, point = _refine(surface, axis, surface.center, fold, _ROUGH)
        if is_known(axis, fold):
            continue
        turn = _turn(surface, axis, point, fold, 2.0 * tolerance)
        if turn.deviation <= 2.0 * tolerance:
            limit = turn.deviation + 0.1 * tolerance
            fine = _turn(surface, *_refine(surface, axis, point, fold, _FINE), fold, limit)
            turn = fine if fine.deviation <= limit else turn
        if turn.deviation <= tolerance:
            turn = _confirmed(surface, _snap(surface, turn, tolerance), tolerance)
        seen.append((turn.axis, fold if turn.deviation > tolerance else 0))
        if turn.deviation > tolerance:
            if turn.deviation <= 2.0 * tolerance and (missed is None or turn.deviation < missed.deviation):
                missed = turn
            continue
        turns += _all_folds(surface, turn, tolerance)
        if sum(each.fold == 0 for each in turns) > 1:
            break
    return turns, missed


def _candidates(surface: SampledSurface, diameter: float, tolerance: float) -> list[tuple[float, np.ndarray, int]]:
    """(mean distance, axis, fold) of rotations that nearly keep the covariance, and a coarse sample, in place.

    Axes are the principal ones, those of coordinates and the normals of flat regions, for all folds; and a grid for small folds.
    """
    index = np.arange(_GRID) + 0.5
    height, turn = index / _GRID, np.pi * (1.0 + np.sqrt(5.0)) * index
    grid = np.column_stack([np.sqrt(1.0 - height**2)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1).round(DECIMALS), height])
    features = np.concatenate([eigh(surface.covariance)[1].T, np.eye(3), surface.facets])
    result = []
    polygons = [fold for fold in range(2, MAX_FOLD + 1) if fold not in _GRID_FOLDS]
    for axes, folds, margin in ((features, polygons, 0.4 * _MARGIN), (np.concatenate([features, grid]), _GRID_FOLDS, _MARGIN)):
        for fold in folds:
            rotations = rotation(axes, 2.0 * np.pi / fold)
            changes = matmul(matmul(rotations, surface.covariance), rotations.transpose(0, 2, 1)) - surface.covariance
            kept = norm(changes.reshape(-1, 9)) <= _MOMENTS * norm(surface.covariance.reshape(9))
            if not kept.any():
                continue
            near, offs = axes[kept], surface.mean_distances(rotations[kept])
            # Least of its neighbourhood: the others would be refined to the same axis.
            beside = np.where(np.abs(matmul(near, near.T)) > _NEIGHBOURHOOD, offs[None], np.inf).min(axis=1)
            rows = np.flatnonzero((offs <= beside) & (offs <= tolerance + margin * diameter))
            result += [(float(offs[row]), near[row], fold) for row in rows]
    return result


def _refine(surface: SampledSurface, axis: np.ndarray, point: np.ndarray, fold: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Axis and a point on it, next to the given one, about which a rotation of the fold maps the surface best onto itself: ICP with
    point-to-plane distances (Chen and Medioni, 1992), from `count` points."""
    center, rows = surface.center, slice(None, None, len(surface.points) // count)
    points, own = surface.points[rows], surface.normals[rows]
    matrix = turn_matrix(axis, point, 2.0 * np.pi / fold)
    for _ in range(_STEPS):
        moved = matmul(points, matrix[:3, :3].T) + matrix[:3, 3]
        distance, index = surface.exact.query(moved)
        normals = surface.normals[index]
        weight = (dot(matmul(own, matrix[:3, :3].T), normals) > 0.3) / (1.0 + (distance / (2.0 * np.median(distance) + 1e-12)) ** 2)
        rows_of = np.concatenate([np.cross(moved - center, normals), normals], axis=1)
        gain = matmul(rows_of.T, weight[:, None] * rows_of)
        right = dot(rows_of.T, weight * dot(normals, surface.points[index] - moved))
        step = solve(gain + 1e-6 * np.diag(np.diag(gain)) + 1e-12 * np.trace(gain) * np.eye(6), right)
        angle = norm(step[:3])
        update = turn_matrix(step[:3] / (angle or 1.0), center, angle)
        update[:3, 3] += step[3:]
        matrix = matmul(update, matrix)
        if np.abs(step).max() < 1e-6:
            break
    vector, length = _axis_angle(matrix[:3, :3])
    if length > 0.1:
        axis = vector * (1.0 if dot(vector, axis) > 0.0 else -1.0)
    shift = dot(matrix[:3, :3], center) + matrix[:3, 3] - center
    return axis, center + lstsq(np.eye(3) - matrix[:3, :3], shift - axis * dot(axis, shift), 1e-3)


def _turn(surface: SampledSurface, axis: np.ndarray, point: np.ndarray, fold: int, limit: float = np.inf) -> Turn:
    """Rotation by a fold's angle with a lower bound of its distance, from subsamples."""
    axis = _upward(axis)
    return Turn(axis, point, fold, surface.rough_deviation(turn_matrix(axis, point, 2.0 * np.pi / fold), limit))


def _confirmed(surface: SampledSurface, turn: Turn, limit: float) -> Turn:
    """The rotation, beyond the limit if any point is; without a limit with its distance from all points."""
    return replace(turn, deviation=surface.deviation(turn.matrix(), limit))


def _snap(surface: SampledSurface, turn: Turn, tolerance: float) -> Turn:
    """Snap a rotation to the nearest coordinate axis and to the origin if its distance stays as small: most parts are modelled so."""
    options = [turn.axis]
    near = int(np.argmax(np.abs(turn.axis)))
    if abs(turn.axis[near]) > np.cos(np.radians(3.0)):
        options.insert(0, np.sign(turn.axis[near]) * np.eye(3)[near])
    for axis in options:
        for point in (np.zeros(3), turn.point - axis * dot(axis, turn.point)):
            limit = turn.deviation + 0.05 * tolerance
            found = _turn(surface, axis, point, turn.fold, limit)
            if found.deviation <= limit:
                return found
    return turn


def _all_folds(surface: SampledSurface, turn: Turn, tolerance: float) -> list[Turn]:
    """All folds of an axis within the tolerance; if all are, one rotation of fold 0 with the largest distance."""
    result = [turn]
    for fold in range(2, MAX_FOLD + 1):
        if fold == turn.fold:
            continue
        other = _confirmed(surface, replace(turn, fold=fold), tolerance)
        if other.deviation <= tolerance:
            result.append(other)
    if len(result) < MAX_FOLD - 1:
        return result
    worst = max(result, key=lambda each: each.deviation)
    return [replace(_confirmed(surface, worst, np.inf), fold=0)]


def _flip(surface: SampledSurface, main: Turn, turn: Turn) -> Turn:
    """Half turn about an axis that is made exactly perpendicular to a continuous one; of all of these, the one nearest to x or y."""
    beside = np.eye(3)[int(np.argmin(np.abs(main.axis)))]
    axis = beside - main.axis * dot(main.axis, beside)
    point = main.point + main.axis * dot(main.axis, turn.point - main.point)
    return _turn(surface, axis / norm(axis), point, 2)


def _ball(surface: SampledSurface, tolerance: float) -> tuple[Turn, ...]:
    """Three continuous axes through the centroid, if each is within the tolerance; else nothing."""
    found = [
        each for axis in np.eye(3) for each in _all_folds(surface, _turn(surface, axis, surface.center, 2), tolerance) if each.fold == 0
    ]
    return tuple(found) if len(found) == 3 else ()


def _close(surface: SampledSurface, turns: list[Turn], tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Largest group of discrete symmetries (N, 4, 4) that the rotations generate, best first, with all products within the tolerance;
    without the identity, and their distances (N)."""
    group, offs, used = np.eye(3)[None], np.zeros(1), []
    center = surface.center
    for turn in sorted(turns, key=lambda turn: turn.deviation):
        within = min(_SAME, 0.4 * 360.0 / max(each.fold for each in [*used, turn]))
        if find_element(group, turn.matrix()[:3, :3], within) >= 0:
            continue
        larger = close_group(np.array([each.matrix()[:3, :3] for each in [*used, turn]]), within)
        if larger is None:
            continue
        middle = _common_point([*used, turn], surface.center)
        distances = (surface.deviation(_about(each, middle), tolerance) for each in larger)
        found = np.array([*takewhile(lambda distance: distance <= tolerance, distances)])
        if len(found) == len(larger):
            group, offs, center = larger, found, middle
            used.append(turn)
    matrices, offs = np.array([_about(each, center) for each in group[1:]]).reshape(-1, 4, 4), offs[1:]
    if len(offs):
        worst = int(np.argmax(offs))
        offs[worst] = surface.deviation(matrices[worst])
    return matrices, offs


def _about(turned: np.ndarray, center: np.ndarray) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turned, center - dot(turned, center)
    return matrix


def _common_point(turns: list[Turn], center: np.ndarray) -> np.ndarray:
    """Point closest to all axes (least squares), and along a common direction closest to the centroid."""
    across = [np.eye(3) - np.outer(turn.axis, turn.axis) for turn in turns]
    weak = 1e-9 * np.eye(3)
    point = solve(sum(across) + weak, sum(dot(one, turn.point) for one, turn in zip(across, turns, strict=True)) + dot(weak, center))
    return point if len(turns) > 1 else turns[0].point


MAX_ELEMENTS = 144
"""Largest group: dihedral ones have two elements for each fold; the rotations of the icosahedron are 60."""
_EQUAL = 1.0
"""Angle up to which two declared rotations are the same [°]: their matrices are rounded."""


def find_element(elements: np.ndarray, rotation: np.ndarray, within: float = _EQUAL) -> int:
    """Index of the element (N, 3, 3) that a rotation equals within an angle [°]; -1: none."""
    traces = np.einsum("nij,ij->n", elements, rotation)
    best = int(np.argmax(traces))
    return best if np.sqrt(max(1.0 + traces[best], 0.0)) / 2.0 >= np.cos(np.radians(within / 2.0)).round(DECIMALS) else -1


def close_transforms(matrices: Sequence[np.ndarray]) -> np.ndarray | None:
    """The rigid 4 x 4 matrices as they are, and all products with other rotations; without the identity. None: more than MAX_ELEMENTS."""
    closed = _add_products(np.array([np.eye(4), *matrices]), matrices, _EQUAL)
    return None if closed is None else closed[1:]


def close_group(generators: np.ndarray, within: float) -> np.ndarray | None:
    """All products of rotations (N, 3, 3), with the identity first; None if they are more than MAX_ELEMENTS, or no group.

    Products within an angle [°] of an element count as it, so that axes which were found with errors of a degree still generate a finite
    group; `make_exact` then removes the errors.
    """
    closed = _add_products(np.eye(3)[None], generators, within)
    return None if closed is None else make_exact(closed, within)


def _add_products(elements: np.ndarray, generators: Sequence[np.ndarray] | np.ndarray, within: float) -> np.ndarray | None:
    """Elements, the identity first, and all of their products with generators whose rotations are none of an element's within an angle [°];
    None if they are more than MAX_ELEMENTS."""
    at = 0
    while at < len(elements):
        for generator in generators:
            product = matmul(elements[at], generator)
            if find_element(elements[:, :3, :3], product[:3, :3], within) < 0:
                elements = np.concatenate([elements, product[None]])
                if len(elements) > MAX_ELEMENTS:
                    return None
        at += 1
    return elements


def make_exact(elements: np.ndarray, within: float) -> np.ndarray | None:
    """Exact group closest to rotations (N, 3, 3) that are a group up to an angle [°]; None if there is none.

    Element a becomes the mean over all b of (a b) b⁻¹ (Grove, Karcher and Ruh, 1974), which converges quadratically, and then the
    rotation next to it.
    """
    count = len(elements)
    table = np.array([[find_element(elements, matmul(a, b), within) for b in elements] for a in elements])
    if (table < 0).any() or any(len(set(row)) < count for row in table):
        return None
    for _ in range(8):
        elements = nearest_rotation(np.einsum("abij,bkj->aik", elements[table], elements) / count)
    return elements


def describe_counts(discrete: int, continuous: int) -> str:
    """Text on the numbers of an object's symmetries."""
    return ", ".join(f"{count} {kind}" for count, kind in ((discrete, "discrete"), (continuous, "continuous")) if count) or "none"


_MAX_SHOWN = 4
"""Most axes of discrete symmetries that a line names."""


def add_symmetries(
    info: FileModelInfo, found: MeshFile, diameter: float, row: ObjectRow | None, objects: Objects, origin: str, find: Detector
) -> tuple[FileModelInfo, list[str]]:
    """Add the symmetries of the object's row to its entry, or find them if neither has any and the settings ask for it. `info`: entry of
    models_info.json; without symmetries if there is none. Returns the entry with symmetries, and lines on what was found, or on declared
    ones that do not hold. Raises CatalogError: with `objects.strict`, a declared symmetry does not hold; or they generate too many."""
    if row is not None and (row.symmetries_discrete or row.symmetries_continuous):
        return _declared(info, found, diameter, row, objects.strict, origin)
    if objects.symmetries != DETECT or info.symmetries_discrete or info.symmetries_continuous:
        return info, []
    tolerance = objects.symmetry_tolerance * diameter
    symmetries = find(found.mesh.vertices, found.mesh.faces, diameter, tolerance)
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
    closed = close_transforms(matrices)
    if closed is None:
        advice = "a symmetry about an axis by any angle belongs into symmetries_continuous"
        raise CatalogError(f"{origin}: the discrete symmetries in its row generate more than {MAX_ELEMENTS}; {advice}")
    return _with(info, closed, axes), [line] if said else []


def _matrix(values: Sequence[float], moved: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Rigid 4 x 4 matrix of a declared discrete symmetry, in the frame of the moved mesh."""
    if len(values) != 16:
        return turn_matrix(*_axis(values, values[4:], moved, center), 2.0 * np.pi / values[3])
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
    x, y, z = (_rounded(value) for value in vector)
    return x, y, z


def _rounded(value: float) -> float:
    """Number with nine decimals, without a negative zero."""
    return round(float(value), 9) + 0.0


def describe_symmetries(symmetries: Symmetries, tolerance: float) -> str:
    """Line on detected symmetries with their distances, or on the nearest miss; `tolerance`: that of the detection [m]."""
    parts = [f"continuous about {_shown(turn.axis)}" for turn in symmetries.continuous]
    axes = find_axes(symmetries.discrete)
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


def _named(turn: Turn) -> str:
    return f"{'a half turn' if turn.fold == 2 else f'1/{turn.fold} turn'} about {_shown(turn.axis)}"


def _shown(axis: np.ndarray) -> str:
    return f"({', '.join(f'{value + 0.0:.3g}' for value in axis.round(3))})"
