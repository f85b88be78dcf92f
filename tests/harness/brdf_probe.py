"""Kernels that ask the surface's law and the samplers for what tests want to know."""

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.brdf import Gloss, brdf_at, density, evaluate_disc, evaluate_parts, scatter
from synpick_warp.kernels.render.lighting.sampling import Chances, light_density, sample_light, scrambled_point

wp.set_module_options({"enable_backward": False})

UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))


@wp.kernel
def evaluate_kernel(
    # In:
    gloss: Gloss,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.array[wp.vec3],
    incoming: wp.array[wp.vec3],
    # Out:
    value_out: wp.array[wp.vec3],
    density_out: wp.array[float],
):
    """f cos and the density of drawing `incoming`, normal +z."""
    i = wp.tid()
    brdf = brdf_at(gloss, base, metallic, roughness, UP, outgoing[i])
    parts = evaluate_parts(gloss, brdf, incoming[i])
    value_out[i] = parts.gloss + parts.diffuse * brdf.diffuse
    density_out[i] = density(brdf, incoming[i])


@wp.kernel
def evaluate_disc_kernel(
    # In:
    gloss: Gloss,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.vec3,
    middle: wp.array[wp.vec3],
    spread: float,
    # Out:
    value_out: wp.array[wp.vec3],
):
    """Mean of f cos over discs about `middle`, normal +z."""
    i = wp.tid()
    value_out[i] = evaluate_disc(gloss, brdf_at(gloss, base, metallic, roughness, UP, outgoing), middle[i], spread)


@wp.kernel
def scatter_kernel(
    # In:
    gloss: Gloss,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.vec3,
    numbers: wp.array[wp.vec3],
    # Out:
    incoming_out: wp.array[wp.vec3],
):
    """Directions drawn from triples of numbers, normal +z."""
    i = wp.tid()
    u = numbers[i]
    incoming_out[i] = scatter(brdf_at(gloss, base, metallic, roughness, UP, outgoing), u[0], wp.vec2(u[1], u[2]))


@wp.kernel
def light_kernel(
    # In:
    chances: Chances,
    numbers: wp.array[wp.vec2],
    # Out:
    direction_out: wp.array[wp.vec3],
    drawn_out: wp.array[float],
    found_out: wp.array[float],
):
    """Directions drawn from map 0, the density that comes with them, and the density that is found for them afterwards."""
    i = wp.tid()
    made = sample_light(chances, 0, numbers[i])
    direction_out[i] = made.direction
    drawn_out[i] = made.density
    found_out[i] = light_density(chances, 0, made.direction)


@wp.kernel
def point_kernel(
    # In:
    key: wp.uint64,
    dimension: int,
    # Out:
    point_out: wp.array[wp.vec2],
):
    """The first points of a dimension."""
    i = wp.tid()
    point_out[i] = scrambled_point(key, i, dimension)


def toward(cosine, azimuth=0.0):
    """Unit vectors (..., 3) float32 with these cosines to +z."""
    sine = np.sqrt(1.0 - np.square(cosine))
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuth), sine * np.sin(azimuth), cosine), axis=-1).astype(np.float32)


def evaluated(gloss, material, outgoing, incoming):
    """f cos (N, 3) and density (N) for pairs of directions."""
    incoming = np.atleast_2d(incoming)
    outgoing = np.broadcast_to(outgoing, incoming.shape)
    arrays = [wp.array(np.ascontiguousarray(a), dtype=wp.vec3, device=gloss.albedo.device) for a in (outgoing, incoming)]
    value = wp.empty(len(incoming), dtype=wp.vec3, device=gloss.albedo.device)
    density = wp.empty(len(incoming), dtype=wp.float32, device=gloss.albedo.device)
    base, metallic, roughness = material
    wp.launch(evaluate_kernel, len(incoming), [gloss, wp.vec3(*base), metallic, roughness, *arrays], [value, density], device=value.device)
    return value.numpy().astype(np.float64), density.numpy().astype(np.float64)
