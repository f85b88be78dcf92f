"""Light of coarse pixels: what paths find, firefly clamps, and the packed records from which the denoiser forms visibility ratios."""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import AnyBrdf, SplitRadiance, specular_albedo
from synpick_warp.kernels.render.lighting.color import MAX_HALF, MIN_RADIANCE, luminance, pack_half3
from synpick_warp.kernels.render.lighting.environment import Lights
from synpick_warp.kernels.render.visibility.records import write_record, write_uint64

wp.set_module_options({"enable_backward": False, "fast_math": True})

INDIRECT_CLAMP = wp.constant(4.0)
"""Firefly clamp of indirect light: at most this many times the radiance of a white surface that faces all lamps, on top of the clamp
for unoccluded light. Few paths find surfaces that lamps light, so each of them has a large weight."""


@wp.struct
class CoarseLight:
    """Reflected light of the coarse pixels, traced and unoccluded; diffuse light is demodulated (without the surface's colour). Scratch.

    All arrays are (view, cell_row, cell_column). Light is pre-exposed: radiance multiplied by the map's exposure, so that typical values
    are about 1.
    """

    diffuse: wp.array3d[wp.vec4]
    """Diffuse reflection of the environment map without its lamps, occluded and unoccluded; packed by `pack_light`."""
    specular: wp.array3d[wp.vec4]
    """Specular reflection, likewise; the occluded value includes light from other surfaces."""
    indirect: wp.array3d[wp.uint64]
    """Indirect diffuse light: diffuse reflection of light from other surfaces, packed by `pack_half3`. It varies slowly in the image, but
    few paths carry much of it."""


@wp.func
def clamp_light(light: wp.vec3, limit: float) -> wp.vec3:
    """Firefly clamp: `light`, scaled down where its largest channel exceeds `limit`; its hue stays."""
    return light * wp.min(1.0, limit / wp.max(wp.max(light), MIN_RADIANCE))


@wp.func
def clamp_path(
    radiance: SplitRadiance, unoccluded: SplitRadiance, lamplit: wp.vec3, specular_limit: float, firefly_clamp: float
) -> SplitRadiance:
    """Firefly clamp: a path counts with at most `firefly_clamp` times the unoccluded light. The limit of indirect light is higher by
    `lamplit` (see `lamplit_radiance`), since the unoccluded light excludes the lamps. `specular_limit` is that of `limit_specular`."""
    result = SplitRadiance()
    result.diffuse = clamp_light(radiance.diffuse, wp.max(firefly_clamp * unoccluded.diffuse))
    result.indirect = clamp_light(radiance.indirect, wp.max(firefly_clamp * unoccluded.diffuse + lamplit))
    result.specular = clamp_light(radiance.specular, specular_limit)
    return result


@wp.func
def lamplit_radiance(lights: Lights, light: int) -> wp.vec3:
    """INDIRECT_CLAMP times the radiance of a white surface that faces all lamps."""
    return (INDIRECT_CLAMP / wp.PI) * lights.total_lamp_irradiance[light]


@wp.func
def limit_specular(brdf: AnyBrdf, unoccluded: SplitRadiance, lamplit: wp.vec3, firefly_clamp: float) -> float:
    """Firefly clamp of the specular light of a surface: limit of its largest channel. Parameters: see `clamp_path`."""
    return wp.max(firefly_clamp * unoccluded.specular + wp.cw_mul(specular_albedo(brdf), lamplit))


@wp.func
def pack_half2(a: float, b: float) -> float:
    """Pack two non-negative values in half precision, clamped to its range, into the bits of a float that takes no part in arithmetic."""
    return wp.cast(wp.vec2h(wp.float16(wp.min(a, MAX_HALF)), wp.float16(wp.min(b, MAX_HALF))), wp.float32)


@wp.func
def unpack_half2(packed: float) -> wp.vec2:
    """Two values in half precision, packed by `pack_half2`, as float32."""
    halves = wp.cast(packed, wp.vec2h)
    return wp.vec2(float(halves[0]), float(halves[1]))


@wp.func
def pack_light(light: wp.vec3, unoccluded: wp.vec3, statistic: float) -> wp.vec4:
    """Pack occluded and unoccluded light in half precision, and a `statistic` of the luminance of their visibility ratio. For single coarse
    pixels the statistic is the ratio itself, for blocks the variance of the mean ratio."""
    return wp.vec4(pack_half2(light[0], light[1]), pack_half2(light[2], unoccluded[0]), pack_half2(unoccluded[1], unoccluded[2]), statistic)


@wp.func
def luminance_ratio(light: wp.vec3, unoccluded: wp.vec3) -> float:
    """Luminance of the visibility ratio. Unoccluded light is 0 only if the whole map is black."""
    return luminance(light) / wp.max(luminance(unoccluded), MIN_RADIANCE)


@wp.func
def store_light(out: CoarseLight, index: int, light: SplitRadiance, unoccluded: SplitRadiance):
    """Write a coarse pixel by its `flat_index`; `light` and `unoccluded` are pre-exposed, see `CoarseLight`."""
    diffuse = luminance_ratio(light.diffuse, unoccluded.diffuse)
    specular = luminance_ratio(light.specular, unoccluded.specular)
    write_record(out.diffuse, index, pack_light(light.diffuse, unoccluded.diffuse, diffuse))
    write_record(out.specular, index, pack_light(light.specular, unoccluded.specular, specular))
    write_uint64(out.indirect, index, pack_half3(light.indirect))
