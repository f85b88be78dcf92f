"""What a surface reflects of a light map, without its main light, if nothing stands in the way: known without any ray."""

import warp as wp

from synpick_warp.kernels.render.lighting.brdf import Brdf, coat_share, even_gloss
from synpick_warp.kernels.render.lighting.environment import FLAT_HARMONIC, Lights, diffuse_irradiance, reflected_radiance, turned

wp.set_module_options({"enable_backward": False})

LEAST_EVEN = wp.constant(0.05)
"""Unhindered light counts as at least this share of the map's mean, so that ratios stay small."""


@wp.struct
class Light:
    """Light that a surface reflects to the camera: diffuse without its colour, and gloss."""

    diffuse: wp.vec3
    between: wp.vec3
    gloss: wp.vec3


@wp.func
def brighter(value: wp.vec3, least: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.max(value[0], least[0]), wp.max(value[1], least[1]), wp.max(value[2], least[2]))


@wp.func
def even_light(lights: Lights, light: int, turn: float, brdf: Brdf) -> Light:
    """What a surface reflects of a map, without its main light, that nothing hides: diffuse by harmonics, gloss by blurred reflections."""
    made = Light()
    mean = LEAST_EVEN * lights.irradiance[light, 0] * FLAT_HARMONIC
    sky = brighter(diffuse_irradiance(lights, light, turned(brdf.normal, -turn)), mean)
    made.diffuse = ((1.0 - coat_share(brdf, brdf.albedo)) / wp.PI) * sky
    mirrored = 2.0 * wp.dot(brdf.normal, brdf.outgoing) * brdf.normal - brdf.outgoing
    seen = brighter(reflected_radiance(lights, light, turned(mirrored, -turn), brdf.roughness), mean / wp.PI)
    made.gloss = wp.cw_mul(even_gloss(brdf), seen)
    return made


@wp.func
def ratio(light: wp.vec3, even: wp.vec3) -> wp.vec3:
    """Component by component; 1 where there is nothing to compare with."""
    made = wp.vec3(1.0, 1.0, 1.0)
    for i in range(3):
        if even[i] > 0.0:
            made[i] = light[i] / even[i]
    return made
