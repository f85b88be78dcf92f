"""Unoccluded environment lighting without any ray: SH irradiance for the diffuse lobe, a prefiltered map for the specular one.

It is the denominator of the ratio estimator in `paths.coarse`.
"""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import MIN_COSINE, AnyBrdf, Brdf, SplitRadiance, coat_albedo, specular_albedo
from synpick_warp.kernels.render.lighting.environment import SH_CONSTANT, Lights, prefiltered_radiance, rotate_z, sh_irradiance
from synpick_warp.kernels.render.lighting.finish import FinishedBrdf

wp.set_module_options({"enable_backward": False})

MIN_UNOCCLUDED = wp.constant(0.05)
"""Unoccluded light is at least this fraction of the map's mean, so that visibility ratios stay bounded."""
MIN_EXPOSED = wp.constant(1.0e-3)
"""And, times the map's exposure, at least this, so that half precision holds it and its ratios where a map is black but for its lamps."""
BRUSH_TAPS = wp.constant(8)
"""Number of samples of the prefiltered environment map along the wide axis of an anisotropic lobe. With one, highlights are not stretched
(metal balls: FLIP against the reference 0.103, with eight 0.096)."""


@wp.func
def max_channels(a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """Component-wise maximum of two colours."""
    return wp.vec3(wp.max(a[0], b[0]), wp.max(a[1], b[1]), wp.max(a[2], b[2]))


@wp.func
def unoccluded_light(lights: Lights, light: int, yaw: float, brdf: AnyBrdf) -> SplitRadiance:
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
    return finish_light(lights, light, yaw, brdf, radiance, floor / wp.PI)


@wp.func
def finish_light(lights: Lights, light: int, yaw: float, brdf: Brdf, radiance: SplitRadiance, least: wp.vec3) -> SplitRadiance:
    """Unoccluded light of a surface without coat and anisotropy: `radiance` itself. `least` is not used."""
    return radiance


@wp.func
def finish_light(  # noqa: F811
    lights: Lights, light: int, yaw: float, brdf: FinishedBrdf, radiance: SplitRadiance, least: wp.vec3
) -> SplitRadiance:
    """Unoccluded light of a surface with coat or anisotropy; `radiance` is that without, `least` a lower bound of specular radiance.

    An anisotropic lobe is a sum of isotropic ones (as Kautz and McCool, 2000) about microfacets that tilt along the tangent: quantiles of
    the GGX slopes, weighted by their projected area, each as wide as their spacing.
    """
    result = radiance
    if brdf.widths[0] > brdf.widths[1]:
        width = brdf.widths[0] / float(BRUSH_TAPS)
        roughness = wp.sqrt(wp.sqrt(brdf.widths[1] * brdf.widths[1] + width * width))
        total, weight = wp.vec3(0.0, 0.0, 0.0), float(0.0)
        for tap in range(BRUSH_TAPS):
            sine = float(2 * tap + 1) / float(BRUSH_TAPS) - 1.0
            facet = wp.normalize(brdf.normal + brdf.widths[0] * sine / wp.sqrt(1.0 - sine * sine) * brdf.tangent)
            cosine = wp.dot(facet, brdf.outgoing)
            mirrored = 2.0 * cosine * facet - brdf.outgoing
            if cosine > 0.0 and wp.dot(mirrored, brdf.normal) > 0.0:
                weight += cosine
                total += cosine * prefiltered_radiance(lights, light, rotate_z(mirrored, -yaw), roughness)
        result.specular = wp.cw_mul(specular_albedo(brdf), max_channels(total / wp.max(weight, MIN_COSINE), least))
    if brdf.clearcoat > 0.0:
        coat = unoccluded_light(lights, light, yaw, brdf.coat)
        result.diffuse = brdf.passing * radiance.diffuse
        result.specular = brdf.passing * result.specular + brdf.clearcoat * coat.specular
    return result


@wp.func
def visibility_ratio(light: wp.vec3, unoccluded: wp.vec3) -> wp.vec3:
    """Ratio of light to unoccluded light, by channel; 1 where the unoccluded light is 0."""
    result = wp.vec3(1.0, 1.0, 1.0)
    for i in range(3):
        if unoccluded[i] > 0.0:
            result[i] = light[i] / unoccluded[i]
    return result
