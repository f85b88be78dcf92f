"""Embedded industrial parts: bolt, nut, bracket, pipe tee, gear, sheet part, box. Lengths in this file are millimetres, as in CAD."""

import itertools
from collections.abc import Sequence

import numpy as np

from synpick_warp.scenes.modelling import BOX_FACES, NO_TEXTURE, Patch, at_height, cap, ellipse, face, join, loft, rounded_box, torus

MILLIMETER = 1e-3
"""[m]"""
SIDES = 48
"""Points per ring: a multiple of 4 and of 6."""
BOLT, PITCH = 12.0, 1.75
"""Thread M12: diameter and pitch (ISO 261)."""
FLATS, HEAD, NUT = 18.0, 7.5, 10.8
"""Width across flats, height of the head (ISO 4014) and of the nut (ISO 4032) for M12."""
_CHAMFER = 0.95 * FLATS / 2
"""Radius at which the chamfer of 30° of a hexagon ends."""
_CIRCLE = ellipse(2.0, 2.0, SIDES)
_HEXAGON = _CIRCLE / np.cos((np.arange(SIDES) * (2 * np.pi / SIDES) + np.pi / 6) % (np.pi / 3) - np.pi / 6)[:, None]

Hole = tuple[int, int, float, float, float, float]
"""Hole of a profile: edge where it begins and edge where it ends, place along the first edge's axis and along the width, radius, and length
between the centres of its round ends, along the width."""


def _ring(shape: np.ndarray, radius: float, z: float) -> np.ndarray:
    """Ring (SIDES, 3) of a unit shape at a height."""
    return at_height(radius * shape, z)


def _hexagon(z: float, rise: float) -> np.ndarray:
    """Ring (SIDES, 3) of the hexagon where a cone of 30°, _CHAMFER wide at height z, cuts it; `rise`: -1 of an upper end, 1 of a lower."""
    ring = FLATS / 2 * _HEXAGON
    return np.column_stack([ring, z + rise * np.tan(np.radians(30.0)) * (np.hypot(*ring.T) - _CHAMFER)])


def _meters(patch: Patch) -> Patch:
    return Patch(MILLIMETER * patch.corners, patch.uv)


def bolt() -> Patch:
    """Hexagon bolt ISO 4014 M12 x 60, with 30 mm of thread as grooves without a lead, which keeps its symmetry."""
    length, thread, depth = 60.0, 30.0, 0.6134 * PITCH
    rings = [_ring(_CIRCLE, BOLT / 2 - depth, 0.0)]
    for z in np.arange(PITCH, thread, PITCH):
        rings += [_ring(_CIRCLE, BOLT / 2, z - PITCH / 2), _ring(_CIRCLE, BOLT / 2 - depth, z)]
    rings += [_ring(_CIRCLE, BOLT / 2, z) for z in (thread, length)]
    rings += [
        _ring(_CIRCLE, _CHAMFER, length),
        _hexagon(length, 0.0),
        _hexagon(length + HEAD, -1.0),
        _ring(_CIRCLE, _CHAMFER, length + HEAD),
    ]
    return _meters(join(cap(rings[0], below=True), loft(np.stack(rings)), cap(rings[-1])))


def nut() -> Patch:
    """Hexagon nut ISO 4032 M12, chamfered on both sides."""
    bore, sink = BOLT / 2 - 0.5 * PITCH, BOLT / 2 + 0.3
    outside = [_ring(_CIRCLE, _CHAMFER, 0.0), _hexagon(0.0, 1.0), _hexagon(NUT, -1.0), _ring(_CIRCLE, _CHAMFER, NUT)]
    inside = [_ring(_CIRCLE, radius, z) for radius, z in ((sink, NUT), (bore, NUT - 1.2), (bore, 1.2), (sink, 0.0))]
    return _meters(torus(np.stack(outside + inside)))


def bracket() -> Patch:
    """Angle bracket of 60 x 50 mm, 40 wide and 5 thick, with a hole of 7 mm and a slot in one leg, and two holes in the other."""
    quarter = np.pi / 2 * np.arange(5) / 4
    bend = [(5.0 - 5.0 * np.cos(angle), 5.0 - 5.0 * np.sin(angle)) for angle in quarter]
    fillet = [(8.0 - 3.0 * np.sin(angle), 8.0 - 3.0 * np.cos(angle)) for angle in quarter]
    profile = [*bend, (60.0, 0.0), (60.0, 5.0), *fillet, (5.0, 50.0), (0.0, 50.0)]
    base, above, inner, outer = 4, 6, 11, 13
    holes = [(base, above, 22.0, 0.0, 3.5, 0.0), (base, above, 46.0, 0.0, 3.5, 10.0)]
    holes += [(outer, inner, 34.0, y, 3.5, 0.0) for y in (-11.0, 11.0)]
    return _meters(_profile(profile, 40.0, holes))


def pipe_tee() -> Patch:
    """Equal pipe tee with a band at each of its three ends: the outsides of two cylinders, and their insides, meet in ellipses."""
    half, band, outer, rim, inner = 38.0, 13.0, 14.0, 17.0, 11.0
    turn = 2 * np.pi * np.arange(SIDES) / SIDES
    levels = [(outer, half - band - 1.5), (rim, half - band), (rim, half - 1.0), (rim - 1.0, half), (inner, half)]

    def run(radius: float, x: float | None) -> np.ndarray:
        """Ring about the x axis at x, or where it meets the branch."""
        y, z = radius * np.cos(turn), radius * np.sin(turn)
        return np.column_stack([np.maximum(z, 0.0) if x is None else np.full(SIDES, x), y, z])

    def branch(radius: float, z: float | None) -> np.ndarray:
        """Ring about the z axis at z, or where it meets the run."""
        x, y = radius * np.cos(turn), radius * np.sin(turn)
        return np.column_stack([x, y, np.abs(x) if z is None else np.full(SIDES, z)])

    ends = [loft(np.stack([ring(outer, None), *(ring(*level) for level in levels), ring(inner, None)])) for ring in (run, branch)]
    return _meters(join(*ends, ends[0].rotate("z", 180.0)))


def gear() -> Patch:
    """Spur gear of 20 teeth and module 2, 12 mm wide, with a bore of 12 mm; flanks are chords of the involute of 20°."""
    teeth, module, width, bore = 20, 2.0, 12.0, 6.0
    pitch = module * teeth / 2
    root, tip, base = pitch - 1.25 * module, pitch + module, pitch * np.cos(np.radians(20.0))

    def half_width(radius: float) -> float:
        """Half of a tooth's angle at a radius: a quarter of the pitch at the pitch circle, and less outside of it by the involute."""
        bend = [np.sqrt(max((r / base) ** 2 - 1.0, 0.0)) for r in (radius, pitch)]
        involute = [b - np.arctan(b) for b in bend]
        return np.pi / (2 * teeth) - involute[0] + involute[1]

    flank = [root, base, pitch, tip]
    corners = [(-half_width(r), r) for r in flank] + [(half_width(r), r) for r in reversed(flank)]
    places = [(2 * np.pi * tooth / teeth + angle, radius) for tooth in range(teeth) for angle, radius in corners]
    angles, radii = np.array(places).T
    circle = np.column_stack([np.cos(angles), np.sin(angles)])
    outline, hole = radii[:, None] * circle, bore * circle
    return _meters(torus(np.stack([at_height(outline, 0.0), at_height(outline, width), at_height(hole, width), at_height(hole, 0.0)])))


def sheet_part() -> Patch:
    """Sheet of 2 mm, 50 wide, bent to a Z, with a slot in each flange."""
    profile = [(-31.0, -11.0), (1.0, -11.0), (1.0, 9.0), (31.0, 9.0), (31.0, 11.0), (-1.0, 11.0), (-1.0, -9.0), (-31.0, -9.0)]
    return _meters(_profile(profile, 50.0, [(0, 6, -16.0, 0.0, 3.5, 14.0), (4, 2, 16.0, 0.0, 3.5, 14.0)]))


def box() -> Patch:
    """Closed box of 80 x 60 x 40 mm with rounded edges."""
    return rounded_box((0.080, 0.060, 0.040), 0.002, dict.fromkeys(BOX_FACES, NO_TEXTURE))


def _pipe(radius: float, low: float, high: float) -> np.ndarray:
    return np.concatenate([_ring(_CIRCLE, radius, z) for z in (low, high)])


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> np.ndarray:
    return np.array(list(itertools.product(*zip(low, high, strict=True))))


PIECES = {
    "bracket": [_box((5.0, -20.0, 0.0), (60.0, 20.0, 5.0)), _box((0.0, -20.0, 0.0), (5.0, 20.0, 50.0))],  # its legs, without holes
    # Two cylinders as wide as the bands of the tee, without bores.
    "pipe_tee": [_pipe(17.0, -38.0, 38.0)[:, [2, 0, 1]], _pipe(17.0, 10.0, 38.0)],
    # Flanges and web, without slots.
    "sheet_part": [
        _box((-31.0, -25.0, -11.0), (-1.0, 25.0, -9.0)),
        _box((-1.0, -25.0, -11.0), (1.0, 25.0, 11.0)),
        _box((1.0, -25.0, 9.0), (31.0, 25.0, 11.0)),
    ],
}
"""Corners of the convex pieces of parts [mm], in the frame of their drawing: fewer than a decomposition that follows holes would have."""


def _profile(profile: Sequence[tuple[float, float]], width: float, holes: Sequence[Hole]) -> Patch:
    """Extrude a profile along y, with holes through pairs of parallel edges. `profile`: corners (x, z), counter-clockwise with x to the
    right and z up. `width`: extent along y, about 0. `holes`: see `Hole`; the edges are parallel to x or z, and the place is that
    coordinate."""
    corners = np.array(profile)
    ends = [np.column_stack([corners[:, 0], np.full(len(corners), y), corners[:, 1]]) for y in (-width / 2, width / 2)]
    cut: dict[int, list[np.ndarray]] = {edge: [] for edge in range(len(corners))}
    patches = [face(ends[0]), face(ends[1][::-1])]
    for *edges, place, y, radius, length in holes:
        rings = [_slot(corners[edge], corners[(edge + 1) % len(corners)], place, y, radius, length) for edge in edges]
        for edge, ring in zip(edges, rings, strict=True):
            cut[edge].append(ring)
        # Rings turn from an axis to y: seen from the second edge counter-clockwise, if the first one runs along its axis.
        forward = (corners[(edges[0] + 1) % len(corners)] - corners[edges[0]]).sum() > 0.0
        patches.append(loft(np.stack([ring[::-1] if forward else ring for ring in rings])))
    for edge in range(len(corners)):
        after = (edge + 1) % len(corners)
        patches.append(face(np.stack([ends[0][edge], ends[1][edge], ends[1][after], ends[0][after]]), *cut[edge]))
    return join(*patches)


def _slot(start: np.ndarray, end: np.ndarray, place: float, y: float, radius: float, length: float) -> np.ndarray:
    """Ring (n, 3) of a slot on the edge from `start` to `end` (x, z), counter-clockwise from the edge's axis to y."""
    points = SIDES // 2
    turn = 2 * np.pi * (np.arange(points) + 0.5) / points
    along, across = place + radius * np.cos(turn), y + radius * np.sin(turn) + length / 2 * np.sign(np.sin(turn))
    axis = int(np.abs(end - start).argmax())
    ring = np.empty((points, 3))
    ring[:, 1], ring[:, 2 * axis], ring[:, 2 - 2 * axis] = across, along, start[1 - axis]
    return ring
