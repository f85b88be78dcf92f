"""Procedural decals: printed labels with a bar code, a matrix code and lines of text, in planar projection onto one side of a body.

They need no texture coordinates, and bend over a tin. Coordinates on a label run from -1 to 1 across its width and its height.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.gbuffer import Meshes

wp.set_module_options({"enable_backward": False})

ATTEMPTS = wp.constant(4)
"""Places that are tried, until ENOUGH of the middle of a label and its corners lie on the body; else the best of them is taken. Eight took
43 us a view of 21 bodies with labels (H200)."""
ENOUGH = wp.constant(4)
"""Number of these five points."""
MIDDLE_PART = wp.constant(0.7)
"""Part of a side, about its middle, on which the middles of labels lie."""
LABEL_RATIO = wp.constant(0.6)
"""Height of a label relative to its width."""
MAX_TURN = wp.constant(0.15)
"""Largest angle between a label's lines and the horizontal of the body's frame, or on its top and bottom the x axis [rad]."""
MIN_FACING = wp.constant(0.4)
"""Smallest cosine between the normals of surface and label for the surface to show it."""
PAPER, INK = wp.constant(0.82), wp.constant(0.03)
"""Reflectance of paper and of ink."""
LABEL_ROUGHNESS = wp.constant(0.45)
"""Perceptual roughness of coated paper."""
BAR_CELLS, MATRIX_CELLS, LETTERS, LINES = wp.constant(60.0), wp.constant(18.0), wp.constant(16.0), wp.constant(5.0)
"""Cells of the bar code, and of a side of the matrix code; letters of a line, and lines of text. Proportions are a shipping label's."""
CODE_MEAN, TEXT_MEAN = wp.constant(0.5), wp.constant(0.28)
"""Mean ink of a code and of text, which wide pixels see."""


@wp.struct
class Label:
    """Frame of a label in the body's: its middle [m], the direction of its lines divided by half its width, that across by half its
    height [1/m], and its normal; a normal of zero: there is no label."""

    middle: wp.vec3
    along: wp.vec3
    across: wp.vec3
    normal: wp.vec3


@wp.func
def frame_of(middle: wp.vec3, normal: wp.vec3, turn: float, width: float) -> Label:
    """Frame of a label of this width [m], whose lines run horizontally in the body's frame, but for an angle [rad]."""
    result = Label()
    axis = wp.vec3(0.0, 0.0, 1.0)
    if wp.abs(normal[2]) > 0.7:
        axis = wp.vec3(0.0, 1.0, 0.0)
    level = wp.normalize(wp.cross(axis, normal))
    along = wp.cos(turn) * level + wp.sin(turn) * wp.cross(normal, level)
    result.middle = middle
    result.normal = normal
    result.along = along * (2.0 / width)
    result.across = wp.cross(normal, along) * (2.0 / (LABEL_RATIO * width))
    return result


@wp.func
def count_spots(meshes: Meshes, mesh: int, label: Label) -> int:
    """Support of a label: how many of its middle and four corners have the mesh within half the label's height along the normal."""
    depth = 1.0 / wp.length(label.across)
    count = int(1)
    for corner in range(4):
        x = float(2 * (corner & 1) - 1) / wp.length_sq(label.along)
        y = float((corner & 2) - 1) / wp.length_sq(label.across)
        start = label.middle + x * label.along + y * label.across + depth * label.normal
        if wp.mesh_query_ray(meshes.id[mesh], start, -label.normal, 2.0 * depth).result:
            count += 1
    return count


@wp.func
def place_label(meshes: Meshes, mesh: int, seed: int, width: float, is_bin: bool) -> Label:
    """Sample the place of a label of this width [m]: where a ray meets a mesh from one of the six sides of its bounding box, or a wall of a
    bin from outside or inside. A zero label where no ray meets anything."""
    best = Label()
    most = int(0)
    state = wp.rand_init(seed)
    middle = 0.5 * (meshes.lower[mesh] + meshes.upper[mesh])
    half = 0.5 * (meshes.upper[mesh] - meshes.lower[mesh])
    reach = wp.length(half)
    attempt = int(0)
    while attempt < ATTEMPTS and most < ENOUGH:
        attempt += 1
        axis = wp.min(int(wp.randf(state) * wp.where(is_bin, 2.0, 3.0)), 2)
        side = wp.where(wp.randf(state) < 0.5, -1.0, 1.0)
        place = wp.vec3(wp.randf(state, -1.0, 1.0), wp.randf(state, -1.0, 1.0), wp.randf(state, -1.0, 1.0))
        start = middle + MIDDLE_PART * wp.cw_mul(half, place)
        direction = wp.vec3(0.0, 0.0, 0.0)
        direction[axis] = -side
        start[axis] = middle[axis] + side * (half[axis] + reach)
        if wp.randf(state) < 0.5 and is_bin:
            start[axis] = middle[axis]
        turn = wp.randf(state, -MAX_TURN, MAX_TURN)
        query = wp.mesh_query_ray(meshes.id[mesh], start, direction, 4.0 * reach)
        if query.result:
            normal = wp.normalize(query.normal)
            if wp.dot(normal, direction) > 0.0:
                normal = -normal
            label = frame_of(start + query.t * direction, normal, turn, width)
            count = count_spots(meshes, mesh, label)
            if count > most:
                most = count
                best = label
    return best


@wp.func
def label_coordinates(label: Label, point: wp.vec3, normal: wp.vec3) -> wp.vec2:
    """Coordinates on a label of a point of the body's surface, with its unit normal towards the viewer; beyond -1 to 1 it has no label."""
    offset = point - label.middle
    # A sheet's other side and its edges face away; on a tin the label ends at a depth of half its height.
    if wp.dot(normal, label.normal) < MIN_FACING or wp.abs(wp.dot(offset, label.normal)) * wp.length(label.across) > 1.0:
        return wp.vec2(2.0, 2.0)
    return wp.vec2(wp.dot(offset, label.along), wp.dot(offset, label.across))


@wp.func
def cell_ink(seed: int, x: float, y: float) -> float:
    """Random ink, 0 or 1, of the cell of a code that holds (x, y)."""
    state = wp.rand_init(seed + int(wp.floor(x)) + 64 * int(wp.floor(y)))
    return wp.where(wp.randf(state) < 0.5, 1.0, 0.0)


@wp.func
def label_reflectance(seed: int, at: wp.vec2, footprint: float) -> float:
    """Reflectance of a label at coordinates in half widths, for a pixel of this width; codes fade to grey in pixels as wide as their
    cells."""
    x, y = 0.5 + 0.5 * at[0], 0.5 - 0.5 * at[1]
    if x < 0.06 or x > 0.94 or y < 0.08 or y > 0.92:
        return PAPER
    ink, mean, cell = float(0.0), float(0.0), float(1.0)
    if y > 0.62:
        ink = cell_ink(seed, BAR_CELLS * x, 0.0)
        mean, cell = CODE_MEAN, 2.0 / BAR_CELLS
    elif x < 0.36 and y < 0.58:
        # A square on the label.
        ink = cell_ink(seed, MATRIX_CELLS * (x - 0.06) / 0.3, 1.0 + MATRIX_CELLS * (y - 0.08) / 0.5)
        mean, cell = CODE_MEAN, 0.6 / MATRIX_CELLS
    elif x > 0.42 and y < 0.58:
        # Letters are dark or missing; lines have gaps between them.
        line = LINES * (y - 0.08) / 0.5
        mean, cell = TEXT_MEAN, 0.5 / LINES
        if line - wp.floor(line) < 0.55:
            ink = cell_ink(seed, LETTERS * x, 32.0 + line)
    return wp.lerp(PAPER, INK, wp.lerp(mean, ink, wp.clamp(2.0 - 2.0 * footprint / cell, 0.0, 1.0)))
