"""Sheet of object symmetries: each object with its axes, and overlaid on its rotated selves, coloured by the distance between both."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import Image, blank, put_text, stacked, with_text, write_picture
from synpick_warp.scenes.symmetries.detection import Turn, describe_counts, find_axes, turn_matrix
from synpick_warp.scenes.symmetries.surface import SampledSurface
from synpick_warp.scenes.types import RawObject

MAX_OBJECTS = 32
"""Maximum number of objects on a sheet; of more, the first are drawn, with a note."""
_SIDE, _CAPTION, _LINE, _TURNS = 260, 44, 18, 4
"""Size of a panel, heights of its caption and of a line [px], and most rotations shown of an object."""
_VIEW = np.array((0.55, -0.7, 0.45)) / np.linalg.norm((0.55, -0.7, 0.45))
_CHECKED = 7
"""Angles of a continuous symmetry of which the worst is shown."""
_BESIDE = np.repeat((0, 1, 2), 3), np.tile((0, 1, 2), 3)
"""Rows and columns that a point covers [px]."""
_BLUE = 30.0
"""Level of the colour map for a distance of zero; from twice the tolerance on, it is red."""
_AXIS, _ROUND = (170, 60, 20), (30, 30, 200)
"""Colours of discrete and continuous axes; blue first."""


@dataclass(frozen=True)
class _Drawn:
    """Splats: positions [m], normals, colours (N, 3) uint8."""

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray


def write_symmetry_sheet(objects: Sequence[RawObject], tolerance: float, out: Path, report: Callable[[str], None]) -> Path:
    """Draw the symmetries of objects, with distances up to a tolerance [diameters]. Raises OutputError if the picture cannot be written."""
    objects = sorted(objects, key=lambda raw: raw.obj_id)
    if len(objects) > MAX_OBJECTS:
        report(f"the first {MAX_OBJECTS} of {len(objects)} objects are drawn")
    rows = [_row(raw, tolerance * raw.hull.diameter) for raw in objects[:MAX_OBJECTS]]
    return write_picture(out, stacked(rows))


def group_turns(raw: RawObject) -> list[Turn]:
    """Axes of an object's symmetries: continuous ones (fold 0), then those of the discrete ones, without distances."""
    turns = [Turn(np.array(axis), np.array(point), 0, 0.0) for axis, point in raw.symmetries_continuous]
    return turns + find_axes(np.reshape(raw.symmetries_discrete, (-1, 4, 4)))


def _row(raw: RawObject, tolerance: float) -> Image:
    """Panels of an object: itself with its axes, and up to four rotations with their distances."""
    surface, turns = SampledSurface(raw.mesh.vertices, raw.mesh.faces), group_turns(raw)
    scale = 0.4 * _SIDE / (raw.hull.diameter / 2.0)
    itself = _Drawn(surface.points, surface.normals, np.full((len(surface.points), 3), 200, np.uint8))
    first = _splat([itself], surface.center, scale)
    for turn in turns:
        _draw_axis(first, turn, surface.center, scale, raw.hull.diameter)
    said = f"symmetries: {describe_counts(len(raw.symmetries_discrete), len(raw.symmetries_continuous))}"
    panels = [with_text(first, [f"{raw.obj_id} {raw.name}"[:34], said], _CAPTION, _LINE)]
    for turn in turns[:_TURNS]:
        angles = [2.0 * np.pi / turn.fold] if turn.fold else [2.0 * np.pi * (step + 0.5) / _CHECKED for step in range(_CHECKED)]
        matrices = [turn_matrix(turn.axis, turn.point, angle) for angle in angles]
        matrix = max(matrices, key=lambda matrix: surface.rough_deviation(matrix, np.inf))
        panels.append(_overlay(surface, itself, turn, matrix, scale, tolerance, raw.hull.diameter))
    return np.concatenate(panels, axis=1)


def _overlay(
    surface: SampledSurface, itself: _Drawn, turn: Turn, matrix: np.ndarray, scale: float, tolerance: float, diameter: float
) -> Image:
    """An object in grey and its rotated self, coloured by distance, which is drawn where both coincide."""
    moved = surface.points @ matrix[:3, :3].T + matrix[:3, 3]
    level = (_BLUE + (255.0 - _BLUE) * np.minimum(surface.distances(moved) / (2.0 * tolerance), 1.0)).astype(np.uint8)
    colors = cv2.applyColorMap(level[:, None], cv2.COLORMAP_TURBO)[:, 0]
    rotated = _Drawn(moved, surface.normals @ matrix[:3, :3].T, colors)
    image = _splat([itself, rotated], surface.center, scale, lift=0.5 * tolerance)
    _draw_axis(image, turn, surface.center, scale, diameter)
    name = f"1/{turn.fold} turn" if turn.fold else "any angle"
    off = 1e3 * surface.deviation(matrix)
    about = " ".join(f"{value + 0.0:.2f}" for value in turn.axis.round(2))
    return with_text(image, [f"{name} about {about}", f"{off:.2g} mm; red from {2e3 * tolerance:.2g} mm on"], _CAPTION, _LINE)


def _frame() -> np.ndarray:
    """Rows: right, up and towards the viewer, of an orthographic view."""
    right = np.cross((0.0, 0.0, 1.0), _VIEW)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(_VIEW, right), _VIEW])


def _project(points: np.ndarray, center: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (N, 2) and nearness (N) [m] of points."""
    seen = (points - center) @ _frame().T
    return np.column_stack([_SIDE / 2 + scale * seen[:, 0], _SIDE / 2 - scale * seen[:, 1]]), seen[:, 2]


def _splat(bodies: list[_Drawn], center: np.ndarray, scale: float, lift: float = 0.0) -> Image:
    """Draw points with a depth buffer, three pixels wide, shaded by a light at the viewer; later bodies lie `lift` [m] nearer."""
    image = blank(_SIDE + 2, _SIDE + 2)
    pixels, nearness, colors = [], [], []
    for index, body in enumerate(bodies):
        place, near = _project(body.points, center, scale)
        shade = 0.45 + 0.55 * np.abs(body.normals @ _VIEW)
        pixels.append(np.floor(place).astype(np.int64))
        nearness.append(near + index * lift)
        colors.append((shade[:, None] * body.colors).astype(np.uint8))
    column, row = np.concatenate(pixels).clip(0, _SIDE - 1).T
    order, shown = np.argsort(np.concatenate(nearness), kind="stable"), np.concatenate(colors)
    # From far to near: of equal indices the last assignment holds.
    targets = (row[order, None] + _BESIDE[0]).reshape(-1), (column[order, None] + _BESIDE[1]).reshape(-1)
    image[targets] = np.repeat(shown[order], len(_BESIDE[0]), axis=0)
    return image[:_SIDE, :_SIDE]


def _draw_axis(image: Image, turn: Turn, center: np.ndarray, scale: float, diameter: float) -> None:
    middle = turn.point + turn.axis * (turn.axis @ (center - turn.point))
    ends, _ = _project(middle + 0.58 * diameter * np.array([[-1.0], [1.0]]) * turn.axis, center, scale)
    color = _AXIS if turn.fold else _ROUND
    start, end = (tuple(int(value) for value in place.round()) for place in ends)
    cv2.line(image, start, end, color, 1, cv2.LINE_AA)
    put_text(image, str(turn.fold) if turn.fold else "any", (end[0] + 2, end[1]), 0.4, color)
