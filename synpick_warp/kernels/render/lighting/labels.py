"""Decals of procedural content: printed labels with a bar code, a matrix code and lines of text, projected onto one side of a body.

A label is a rectangle that is projected along the normal of one of the body's larger triangles, so that it needs no texture coordinates and
bends over a tin.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.gbuffer import Meshes

wp.set_module_options({"enable_backward": False})

CANDIDATES = wp.constant(24)
"""Triangles of which the largest that fits gets the label."""
LABEL_RATIO = wp.constant(0.6)
"""Height of a label relative to its width."""
MAX_TURN = wp.constant(0.15)
"""Largest angle to the body's axes at which a label is stuck on [rad]."""
MIN_FACING = wp.constant(0.4)
"""Smallest cosine between the normals of surface and label: what is seen edge-on has none."""
FLATNESS = wp.constant(1.0e-3)
"""Depth relative to the body's radius below which a side counts as an outer one: a flat sheet has its middle in it."""
PAPER, INK = wp.constant(0.82), wp.constant(0.03)
"""Reflectance of paper and of ink."""
LABEL_ROUGHNESS = wp.constant(0.45)
"""Perceptual roughness of coated paper."""
BAR_CELLS, MATRIX_CELLS, LETTERS, LINES = wp.constant(60.0), wp.constant(18.0), wp.constant(16.0), wp.constant(5.0)
"""Modules of the bar code, of a side of the matrix code, letters of a line and lines of text; proportions of a shipping label."""
MEAN_INK = wp.constant(0.45)
"""Fraction of ink in a code or a line that a pixel cannot resolve."""


@wp.struct
class Label:
    """Frame of a label in the body's: its middle [m], the direction of its lines divided by half its width, that across by half its
    height [1/m], and its normal; zero: none."""

    middle: wp.vec3
    along: wp.vec3
    across: wp.vec3
    normal: wp.vec3


@wp.func
def place_label(meshes: Meshes, mesh: int, seed: int, width: float, is_bin: bool) -> Label:
    """Draw the place of a label of this width [m] on a mesh: on one of its larger outer sides, or on a wall of a bin, inside or outside."""
    result = Label()
    first = meshes.first_triangle[mesh]
    count = meshes.first_triangle[mesh + 1] - first
    state = wp.rand_init(seed)
    largest = float(0.0)
    for _candidate in range(CANDIDATES):
        triangle = first + wp.min(int(wp.randf(state) * float(count)), count - 1)
        a = meshes.corner[3 * triangle]
        b = meshes.corner[3 * triangle + 1]
        c = meshes.corner[3 * triangle + 2]
        middle = (a + b + c) / 3.0
        normal = meshes.face_normal[triangle]
        area = wp.length(wp.cross(b - a, c - a))
        is_fit = wp.dot(normal, middle - meshes.center[mesh]) > -FLATNESS * meshes.radius[mesh]
        if is_bin:
            is_fit = wp.abs(normal[2]) < 0.5
        if is_fit and area > largest:
            largest = area
            result.middle = middle
            result.normal = normal
    # Lines run horizontally on a wall, along x or y elsewhere.
    axis = wp.vec3(0.0, 0.0, 1.0)
    if wp.abs(result.normal[2]) > 0.7:
        axis = wp.vec3(0.0, 1.0, 0.0)
    level = wp.normalize(wp.cross(axis, result.normal))
    turn = MAX_TURN * (2.0 * wp.randf(state) - 1.0)
    along = wp.cos(turn) * level + wp.sin(turn) * wp.cross(result.normal, level)
    result.along = along * (2.0 / width)
    result.across = wp.cross(result.normal, along) * (2.0 / (LABEL_RATIO * width))
    return result


@wp.func
def find_place(label: Label, point: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """Coordinates on a label, each -1 to 1, of a point of the body's surface with this unit normal towards the viewer; beyond, it shows
    no label."""
    offset = point - label.middle
    # A sheet's other side and its edges face away; on a tin the label ends where it is as deep as high.
    if wp.dot(normal, label.normal) < MIN_FACING or wp.abs(wp.dot(offset, label.normal)) * wp.length(label.across) > 1.0:
        return wp.vec2(2.0, 2.0)
    return wp.vec2(wp.dot(offset, label.along), wp.dot(offset, label.across))


@wp.func
def print_cell(seed: int, x: float, y: float) -> float:
    """Ink, 0 or 1, of the cell of a code."""
    state = wp.rand_init(seed + int(wp.floor(x)) + 64 * int(wp.floor(y)))
    return wp.where(wp.randf(state) < 0.5, 1.0, 0.0)


@wp.func
def label_reflectance(seed: int, at: wp.vec2, footprint: float) -> float:
    """Reflectance of a label at coordinates -1 to 1, for a pixel of this width in them; codes fade to grey when it is as wide as a cell."""
    x, y = 0.5 + 0.5 * at[0], 0.5 - 0.5 * at[1]
    if x < 0.06 or x > 0.94 or y < 0.08 or y > 0.92:
        return PAPER
    ink, cell = float(0.0), float(1.0)
    if y > 0.62:
        ink = print_cell(seed, BAR_CELLS * x, 0.0)
        cell = 2.0 / BAR_CELLS
    elif x < 0.38:
        # A square: as wide as high.
        ink = print_cell(seed, MATRIX_CELLS * (x - 0.06) / 0.3, 1.0 + MATRIX_CELLS * (y - 0.08) / 0.5)
        cell = 0.6 / MATRIX_CELLS
        if x > 0.36 or y > 0.58:
            ink = 0.0
    elif x > 0.42:
        line = LINES * (y - 0.08) / 0.5
        cell = 0.5 / LINES
        # Words end at random, lines have gaps between them.
        if line < LINES and line - wp.floor(line) < 0.55:
            ink = print_cell(seed, LETTERS * x, 32.0 + line)
    clear = wp.clamp(2.0 - 2.0 * footprint / cell, 0.0, 1.0)
    return wp.lerp(PAPER, INK, wp.lerp(MEAN_INK * wp.where(cell < 1.0, 1.0, 0.0), ink, clear))
