"""Test kernels for lamp shadows: packed bytes, slab tests and boxes of moving bodies."""

import warp as wp

from synpick_warp.kernels.render.lighting.moving_bodies import world_box
from synpick_warp.kernels.render.lighting.shadow_filter import lamp_fractions, steepness_levels
from synpick_warp.kernels.render.lighting.shadow_upsampling import TapVector, blend_bytes
from synpick_warp.kernels.render.lighting.shadows import byte_of, meets_box, spread_bits
from synpick_warp.kernels.render.visibility.gbuffer import Meshes

wp.set_module_options({"enable_backward": False})


@wp.kernel
def spread_kernel(
    # Out:
    bytes_out: wp.array2d[int],  # (bits, lamp)
):
    """Bytes of all sets of bits."""
    bits, lamp = wp.tid()
    bytes_out[bits, lamp] = byte_of(spread_bits(bits), lamp)


@wp.kernel
def blend_kernel(
    # In:
    taps: wp.array2d[wp.uint64],  # (sample, tap)
    weights: wp.array[wp.vec4],  # (sample)
    # Out:
    blended_out: wp.array[wp.uint64],  # (sample)
):
    """Weighted means of packed bytes."""
    i = wp.tid()
    blended_out[i] = blend_bytes(TapVector(taps[i, 0], taps[i, 1], taps[i, 2], taps[i, 3]), weights[i])


@wp.kernel
def steepness_kernel(
    # In:
    share: float,
    supported: bool,
    # Out:
    level_out: wp.array2d[int],  # (lowest, highest)
):
    """Steepness by the extremes of a visible fraction."""
    lowest, highest = wp.tid()
    level_out[lowest, highest] = steepness_levels(lowest, highest, share, supported)


@wp.kernel
def slab_kernel(
    # In:
    origin: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    lower: wp.vec3,
    upper: wp.vec3,
    # Out:
    meets_out: wp.array[int],  # (ray)
):
    """Whether rays meet a box."""
    i = wp.tid()
    inverse = wp.vec3(1.0 / direction[i][0], 1.0 / direction[i][1], 1.0 / direction[i][2])
    meets_out[i] = int(meets_box(origin[i], inverse, lower, upper))


@wp.kernel
def world_box_kernel(
    # Scene:
    meshes: Meshes,
    # In:
    pose: wp.array[wp.transformf],  # (pose) [m]
    # Out:
    lower_out: wp.array[wp.vec3],  # (pose)
    upper_out: wp.array[wp.vec3],  # (pose)
):
    """Boxes of mesh 0 at poses."""
    i = wp.tid()
    lower, upper = world_box(meshes, 0, pose[i])
    lower_out[i] = lower
    upper_out[i] = upper


@wp.kernel
def fractions_kernel(
    # In:
    even: wp.array[wp.uint64],  # (sample)
    odd: wp.array[wp.uint64],  # (sample)
    weight: int,
    lamps: int,
    rays: int,
    # Out:
    fractions_out: wp.array[wp.uint64],  # (sample)
):
    """Visible fractions of lamps."""
    i = wp.tid()
    fractions_out[i] = lamp_fractions(even[i], odd[i], weight, lamps, rays)
