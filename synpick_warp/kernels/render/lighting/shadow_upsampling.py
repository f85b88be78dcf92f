"""Lamp shadows of a pixel: joint bilateral upsampling (Kopf et al., 2007) from the shadow grid, and a filter of rays at steep edges.

All lamps at once: eight bytes in a word (SIMD within a register).
"""

import warp as wp

from synpick_warp.kernels.render.lighting.coarse_grid import (
    MIN_WEIGHT,
    PLANE_TOLERANCE,
    CoarseGrid,
    coarse_coordinate,
    flat_index,
    middle_pixel,
)
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance
from synpick_warp.kernels.render.lighting.shadow_filter import (
    EVEN_BYTES,
    STEEPNESS_BITS,
    STEEPNESS_LEVELS,
    LampShadows,
    same_surface,
    shadow_depth,
    shadow_fractions,
    shadow_normal,
    shadow_segment,
    shadow_steepness,
)
from synpick_warp.kernels.render.lighting.shadows import byte_of
from synpick_warp.kernels.render.visibility.camera import clamp_index
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer
from synpick_warp.kernels.render.visibility.records import read_record

wp.set_module_options({"enable_backward": False, "fast_math": True})

WEIGHT_SUM = wp.constant(256)
"""Sum of the fixed-point weights; weighted sums of 8-bit values fit into 16 bits."""
HALF_WEIGHTS = wp.constant(wp.uint64(0x0080008000800080))
"""Rounding term: half of WEIGHT_SUM in each 16 bits."""
LOW_NIBBLES = wp.constant(wp.uint32(0x0F0F0F0F))
"""Mask of nibbles 0, 2, 4, 6. A weighted sum of such nibbles fits into 8 bits: weights add up to 64 where values are at most 2, to 16 where
they are at most 5."""
NIBBLE_ONES = wp.constant(wp.uint32(0x11111111))
"""1 in each nibble."""
TapVector = wp.types.vector(length=4, dtype=wp.uint64)
"""Visible fractions of the lamps at the four nearest pixels of the shadow grid."""
LevelVector = wp.types.vector(length=4, dtype=wp.uint32)
"""Steepness of the lamps' shadows at the four nearest pixels of the shadow grid."""


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


@wp.struct
class ShadowTaps:
    """Fractions, weights and steepness at the four pixels of the shadow grid around a pixel, for bilinear interpolation."""

    fractions: TapVector
    """Visible fractions of the lamps."""
    weights: wp.vec4
    """Bilinear weights, tiny for pixels on other surfaces, above 0."""
    steepness: LevelVector
    """Steepness of the lamps' shadows; 0 on other surfaces."""
    found: bool
    """Whether any of the four shows the surface of the pixel."""


@wp.func
def find_shadow_taps(shadows: LampShadows, coarse: CoarseGrid, view: int, row: int, column: int, plane: Plane) -> ShadowTaps:
    """Look up the pixels of the shadow grid around the pixel (row, column), whose tangent plane is `plane`."""
    y = coarse_coordinate(coarse, row)
    x = coarse_coordinate(coarse, column)
    top = int(wp.floor(y))
    left = int(wp.floor(x))
    result = ShadowTaps()
    result.found = False
    for i in range(2):
        r = clamp_index(top + i, coarse.grid.height)
        vertical = 1.0 - wp.abs(y - float(top + i))
        for j in range(2):
            c = clamp_index(left + j, coarse.grid.width)
            weight = vertical * (1.0 - wp.abs(x - float(left + j))) + MIN_WEIGHT
            record = read_record(shadows.record, flat_index(coarse.grid, view, r, c))
            pixel = middle_pixel(coarse, r, c)
            steepness = shadow_steepness(record)
            down = pixel[0] - row
            right = pixel[1] - column
            if same_surface(coarse, plane, down, right, shadow_depth(record), shadow_segment(record), shadow_normal(record)):
                result.found = True
            else:
                # Also against the MIN_WEIGHT of a tap on the surface.
                weight *= MIN_WEIGHT * MIN_WEIGHT
                steepness = wp.uint32(0)
            result.weights[2 * i + j] = weight
            result.fractions[2 * i + j] = shadow_fractions(record)
            result.steepness[2 * i + j] = steepness
    return result


@wp.func
def all_steepness(taps: ShadowTaps) -> wp.uint32:
    """Bitwise union of the taps' steepness, STEEPNESS_BITS for each lamp: above 0 where the shadow is steep at any tap. All bits are set if
    no tap shows the pixel's surface."""
    steepness = taps.steepness[0] | taps.steepness[1] | taps.steepness[2] | taps.steepness[3]
    return wp.where(taps.found, steepness, ~wp.uint32(0))


@wp.func
def lamp_steepness(taps: ShadowTaps, lamp: int) -> float:
    """Interpolated steepness of a lamp's shadow, from 0 to 1."""
    if not taps.found:
        return 1.0
    total = float(0.0)
    weight = float(0.0)
    for tap in range(4):
        level = (taps.steepness[tap] >> wp.uint32(STEEPNESS_BITS * lamp)) & wp.uint32(STEEPNESS_LEVELS)
        total += taps.weights[tap] * float(level)
        weight += taps.weights[tap]
    return total / (weight * float(STEEPNESS_LEVELS))


@wp.func
def edge_reach(rays: int) -> int:
    """Largest offset of the edge filter's taps [px]: with one ray to a lamp from a pixel 5 x 5 pixels have all parts of the lamp, with
    four 3 x 3, counting half at the border."""
    return wp.where(rays == 1, 2, 1)


@wp.struct
class EdgeSums:
    """Weighted sums of unblocked rays in `LampShadows.edge` over a window, and of the weights, 8 bits for each lamp: even and odd lamps."""

    even: wp.uint32
    odd: wp.uint32
    even_weight: wp.uint32
    odd_weight: wp.uint32
    """Weights of the pixels that traced rays to the lamp."""


@wp.func
def sum_edges(shadows: LampShadows, coarse: CoarseGrid, gbuffer: GBuffer, view: int, row: int, column: int, plane: Plane) -> EdgeSums:
    """Sum traced visibility over the pixels around (row, column) on its surface, whose tangent plane is `plane`."""
    result = EdgeSums()
    reach = edge_reach(coarse.rays)
    tolerance = PLANE_TOLERANCE * float(reach) * plane.width
    for r in range(wp.max(row - reach, 0), wp.min(row + reach + 1, coarse.image.height)):
        for c in range(wp.max(column - reach, 0), wp.min(column + reach + 1, coarse.image.width)):
            word = shadows.edge[view, r, c]
            if word != wp.uint32(0):
                down = r - row
                right = c - column
                if (
                    gbuffer.segment[view, r, c] == plane.segment
                    and plane_distance(plane, down, right, gbuffer.depth[view, r, c]) <= tolerance
                ):
                    # Those at the border count half: so each part of a lamp has the same weight.
                    weight = wp.uint32(wp.where(wp.abs(down) == reach, 1, 2) * wp.where(wp.abs(right) == reach, 1, 2))
                    traced = (word | (word >> wp.uint32(1)) | (word >> wp.uint32(2))) & NIBBLE_ONES
                    result.even += weight * (word & LOW_NIBBLES)
                    result.odd += weight * ((word >> wp.uint32(4)) & LOW_NIBBLES)
                    result.even_weight += weight * (traced & LOW_NIBBLES)
                    result.odd_weight += weight * ((traced >> wp.uint32(4)) & LOW_NIBBLES)
    return result


@wp.func
def edge_fraction(sums: EdgeSums, lamp: int, rays: int, fallback: float) -> float:
    """Visible fraction of a lamp [1/255]: weighted number of unblocked shadow rays divided by that of all; `rays` is the number per pixel.
    `fallback` where no pixel in the window traced a ray to the lamp."""
    shift = wp.uint32(8 * (lamp >> 1))
    values = int((wp.where(lamp & 1 == 0, sums.even, sums.odd) >> shift) & wp.uint32(0xFF))
    weight = int((wp.where(lamp & 1 == 0, sums.even_weight, sums.odd_weight) >> shift) & wp.uint32(0xFF))
    if weight == 0:
        return fallback
    return 255.0 * float(values - weight) / float(rays * weight)


@wp.func
def filter_edge(
    shadows: LampShadows, coarse: CoarseGrid, gbuffer: GBuffer, lamps: int, view: int, row: int, column: int, plane: Plane
) -> wp.uint64:
    """Visible fractions of the lamps at a pixel that traced rays, byte k that of lamp k in 1/255.

    Blends, by steepness, from the fractions interpolated on the shadow grid to the mean over the rays of the pixels around, on the surface
    whose tangent plane is `plane`. Where no pixel of the shadow grid around is on this surface, the rays alone count.
    """
    taps = find_shadow_taps(shadows, coarse, view, row, column, plane)
    wide = blend_bytes(taps.fractions, taps.weights)
    sums = sum_edges(shadows, coarse, gbuffer, view, row, column, plane)
    result = wp.uint64(0)
    for lamp in range(lamps):
        value = float(byte_of(wide, lamp))
        value += lamp_steepness(taps, lamp) * (edge_fraction(sums, lamp, coarse.rays, value) - value)
        result |= wp.uint64(int(value + 0.5)) << wp.uint64(8 * lamp)
    return result


@wp.func
def pack_fractions(fractions: wp.uint64) -> wp.vec3:
    """Store the bits of the lamps' visible fractions as those of two floats."""
    return wp.vec3(wp.cast(wp.uint32(fractions), wp.float32), wp.cast(wp.uint32(fractions >> wp.uint64(32)), wp.float32), 0.0)


@wp.func
def unpack_fractions(packed: wp.vec3) -> wp.uint64:
    """Packed visible fractions of the lamps, as one 64-bit word, from the vector of `pack_fractions`."""
    return (wp.uint64(wp.cast(packed[1], wp.uint32)) << wp.uint64(32)) | wp.uint64(wp.cast(packed[0], wp.uint32))


@wp.func
def upsample_shadows(
    shadows: LampShadows, edges: wp.array3d[wp.vec3], coarse: CoarseGrid, view: int, row: int, column: int, plane: Plane
) -> wp.uint64:
    """Visible fractions of the lamps at a pixel, byte k that of lamp k in 1/255: from its rays and its neighbours' where it traced some,
    which `edges` holds, packed by `pack_fractions`, else interpolated between the four nearest pixels of the shadow grid on its surface,
    whose tangent plane is `plane`."""
    if shadows.edge[view, row, column] != wp.uint32(0):
        return unpack_fractions(edges[view, row, column])
    taps = find_shadow_taps(shadows, coarse, view, row, column, plane)
    return blend_bytes(taps.fractions, taps.weights)
