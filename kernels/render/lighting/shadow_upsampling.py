"""Joint bilateral upsampling (Kopf et al., 2007) of lamp shadows, all lamps at once: eight bytes in a word (SIMD within a register)."""

import warp as wp

from synpick_warp.kernels.render.lighting.coarse_grid import (
    MIN_WEIGHT,
    PLANE_TOLERANCE,
    CoarseGrid,
    flat_index,
    middle_pixel,
    window_coordinate,
)
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance
from synpick_warp.kernels.render.lighting.shadows import LampShadows, shadow_depth, shadow_fractions, shadow_segment
from synpick_warp.kernels.render.lighting.upsampling import RING
from synpick_warp.kernels.render.visibility.camera import clamp_index
from synpick_warp.kernels.render.visibility.records import read_record

wp.set_module_options({"enable_backward": False, "fast_math": True})

EVEN_BYTES = wp.constant(wp.uint64(0x00FF00FF00FF00FF))
"""Bytes 0, 2, 4, 6, each with room for a sum in 16 bits."""
WEIGHT_SUM = wp.constant(256)
"""Sum of the fixed-point weights; weighted sums of 8-bit values fit into 16 bits."""
HALF_WEIGHTS = wp.constant(wp.uint64(0x0080008000800080))
"""Rounding term: half of WEIGHT_SUM in each 16 bits."""
TapVector = wp.types.vector(length=4, dtype=wp.uint64)
"""Visible fractions of the lamps at the four nearest coarse pixels."""


@wp.func
def blend_bytes(taps: TapVector, weights: wp.vec4) -> wp.uint64:
    """Weighted mean of each byte over four packed values, rounded; the weights are positive, and need no normalization."""
    scale = float(WEIGHT_SUM) / (weights[0] + weights[1] + weights[2] + weights[3])
    even = HALF_WEIGHTS
    odd = HALF_WEIGHTS
    before = int(0)
    cumulative = float(0.0)
    # Cumulative sums are rounded, so that the fixed-point weights are not negative and have the exact sum.
    for i in range(4):
        cumulative += weights[i]
        end = wp.where(i == 3, WEIGHT_SUM, int(scale * cumulative + 0.5))
        weight = wp.uint64(end - before)
        before = end
        even += weight * (taps[i] & EVEN_BYTES)
        odd += weight * ((taps[i] >> wp.uint64(8)) & EVEN_BYTES)
    # Division by WEIGHT_SUM leaves the upper byte of each 16 bits.
    return ((even >> wp.uint64(8)) & EVEN_BYTES) | (odd & ~EVEN_BYTES)


@wp.func
def on_plane(record: wp.vec4, coarse: CoarseGrid, row: int, column: int, plane: Plane, r: int, c: int) -> bool:
    """Whether the coarse pixel (r, c), packed, shows the surface of the pixel (row, column), whose tangent plane is `plane`."""
    pixel = middle_pixel(coarse, r, c)
    distance = plane_distance(plane, pixel[0] - row, pixel[1] - column, shadow_depth(record))
    return shadow_segment(record) == plane.segment and distance <= PLANE_TOLERANCE * float(coarse.size) * plane.width


@wp.func
def sum_ring(
    shadows: LampShadows, coarse: CoarseGrid, view: int, row: int, column: int, plane: Plane, top: int, left: int
) -> tuple[wp.uint64, wp.uint64, int]:
    """Sum the fractions over the 4 x 4 coarse pixels around (top, left) that show the surface of the pixel (row, column).

    Returns the sums of the even bytes, those of the odd bytes, in 16 bits each, and the number of coarse pixels.
    """
    even = wp.uint64(0)
    odd = wp.uint64(0)
    total = int(0)
    # Not unrolled: few pixels come here.
    ring = int(RING)
    for i in range(-ring, 2 + ring):
        r = clamp_index(top + i, coarse.grid.height)
        for j in range(-ring, 2 + ring):
            c = clamp_index(left + j, coarse.grid.width)
            record = read_record(shadows.record, flat_index(coarse.grid, view, r, c))
            if on_plane(record, coarse, row, column, plane, r, c):
                packed = shadow_fractions(record)
                even += packed & EVEN_BYTES
                odd += (packed >> wp.uint64(8)) & EVEN_BYTES
                total += 1
    return even, odd, total


@wp.func
def divide_sums(even: wp.uint64, odd: wp.uint64, total: int) -> wp.uint64:
    """Divide sums of bytes by their number, rounded, and pack the quotients."""
    result = wp.uint64(0)
    for part in range(4):
        shift = wp.uint64(16 * part)
        lower = (int((even >> shift) & wp.uint64(0xFFFF)) + total // 2) // total
        upper = (int((odd >> shift) & wp.uint64(0xFFFF)) + total // 2) // total
        result |= wp.uint64((upper << 8) | lower) << shift
    return result


@wp.func
def upsample_shadows(shadows: LampShadows, coarse: CoarseGrid, view: int, row: int, column: int, plane: Plane) -> wp.uint64:
    """Visible fraction of each lamp at a pixel, as in `shadows.pack_shadows`, from the four nearest coarse pixels on its surface.

    If all four are on other surfaces, the ring around them is searched too, as for visibility ratios: light of another surface would
    show as bright pixels along the edge. If none there is on it either, the four are interpolated. `plane` is the pixel's tangent plane.
    """
    y = window_coordinate(coarse, row)
    x = window_coordinate(coarse, column)
    top = int(wp.floor(y))
    left = int(wp.floor(x))
    weights = wp.vec4()
    taps = TapVector()
    found = bool(False)
    for i in range(2):
        r = clamp_index(top + i, coarse.grid.height)
        vertical = 1.0 - wp.abs(y - float(top + i))
        for j in range(2):
            c = clamp_index(left + j, coarse.grid.width)
            weight = vertical * (1.0 - wp.abs(x - float(left + j))) + MIN_WEIGHT
            record = read_record(shadows.record, flat_index(coarse.grid, view, r, c))
            if on_plane(record, coarse, row, column, plane, r, c):
                found = True
            else:
                # Also against the MIN_WEIGHT of a tap on the surface.
                weight *= MIN_WEIGHT * MIN_WEIGHT
            weights[2 * i + j] = weight
            taps[2 * i + j] = shadow_fractions(record)
    if not found:
        even, odd, total = sum_ring(shadows, coarse, view, row, column, plane, top, left)
        if total > 0:
            return divide_sums(even, odd, total)
    return blend_bytes(taps, weights)
