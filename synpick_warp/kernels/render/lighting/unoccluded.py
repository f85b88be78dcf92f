"""Unoccluded environment lighting without any ray: SH irradiance for the diffuse lobe, a prefiltered map for the specular one.

It is the denominator of the ratio estimator in `paths.coarse`.
"""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import Brdf, SplitRadiance, coat_albedo, specular_albedo
from synpick_warp.kernels.render.lighting.environment import SH_CONSTANT, Lights, prefiltered_radiance, rotate_z, sh_irradiance

wp.set_module_options({"enable_backward": False})

MIN_UNOCCLUDED = wp.constant(0.05)
"""Unoccluded light is at least this fraction of the map's mean, so that visibility ratios stay bounded."""
MIN_EXPOSED = wp.constant(1.0e-3)
"""And, times the map's exposure, at least this, so that half precision holds it and its ratios where a map is black but for its lamps."""


@wp.func
def max_channels(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Component-wise maximum of two colours."""
    return wp.vec3(wp.max(a[0], b[0]), wp.max(a[1], b[1]), wp.max(a[2], b[2]))


@wp.func
def unoccluded_light(lights: Lights, light: int, yaw: float, brdf: Brdf) -> SplitRadiance:
    """Radiance reflected from an unoccluded environment map without its lamps; nothing is indirect. Diffuse by spherical harmonics,
    specular by the split-sum approximation (Karis, 2013). `light` is the index of the map, rotated by `yaw` [rad] about +z."""
    radiance = SplitRadiance()
    floor = max_channels(
        MIN_UNOCCLUDED * lights.irradiance[light, 0] * SH_CONSTANT, MIN_EXPOSED / lights.exposure[light] * wp.vec3(1.0, 1.0, 1.0)
    )
    irradiance = max_channels(sh_irradiance(lights, light, rotate_z(brdf.normal, -yaw)), floor)
    radiance.diffuse = ((1.0 - coat_albedo(brdf, brdf.albedo)) / wp.PI) * irradiance
    mirrored = 2.0 * wp.dot(brdf.normal, brdf.outgoing) * brdf.normal - brdf.outgoing
    prefiltered = max_channels(prefiltered_radiance(lights, light, rotate_z(mirrored, -yaw), brdf.roughness), floor / wp.PI)
    radiance.specular = wp.cw_mul(specular_albedo(brdf), prefiltered)
    return radiance


@wp.func
def visibility_ratio(light: wp.vec3, unoccluded: wp.vec3) -> wp.vec3:
    """Ratio of light to unoccluded light, by channel; 1 where the unoccluded light is 0."""
    result = wp.vec3(1.0, 1.0, 1.0)
    for i in range(3):
        if unoccluded[i] > 0.0:
            result[i] = light[i] / unoccluded[i]
    return result
