"""Test kernels that evaluate the BRDF, the environment sampler and the sample points."""

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.brdf import (
    AlbedoTables,
    brdf_pdf,
    evaluate_brdf,
    evaluate_disc,
    make_brdf,
    sample_brdf,
    view_factors,
)
from synpick_warp.kernels.render.lighting.sampling import (
    EnvironmentCdf,
    environment_pdf,
    invert_conditional,
    invert_marginal,
    sample_environment,
    scrambled_point,
)

wp.set_module_options({"enable_backward": False})

UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))


@wp.kernel
def evaluate_kernel(
    # In:
    tables: AlbedoTables,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.array[wp.vec3],  # (sample)
    incoming: wp.array[wp.vec3],  # (sample)
    # Out:
    value_out: wp.array[wp.vec3],  # (sample)
    pdf_out: wp.array[float],  # (sample)
):
    """BRDF times cosine, and the pdf of sampling `incoming`; normal +z."""
    i = wp.tid()
    brdf = make_brdf(tables, base, metallic, roughness, UP, outgoing[i])
    value = evaluate_brdf(tables, brdf, incoming[i])
    value_out[i] = value.specular + value.diffuse * brdf.diffuse
    pdf_out[i] = brdf_pdf(brdf, incoming[i])


@wp.kernel
def evaluate_disc_kernel(
    # In:
    tables: AlbedoTables,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.vec3,
    center: wp.array[wp.vec3],  # (sample)
    radius: float,
    # Out:
    value_out: wp.array[wp.vec3],  # (sample)
):
    """Mean of BRDF times cosine over disc lights about `center`; normal +z."""
    i = wp.tid()
    brdf = make_brdf(tables, base, metallic, roughness, UP, outgoing)
    value_out[i] = evaluate_disc(tables, brdf, view_factors(brdf), center[i], radius)


@wp.kernel
def sample_brdf_kernel(
    # In:
    tables: AlbedoTables,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    outgoing: wp.vec3,
    numbers: wp.array[wp.vec3],  # (sample)
    # Out:
    incoming_out: wp.array[wp.vec3],  # (sample)
):
    """Directions sampled by triples of uniform numbers; normal +z."""
    i = wp.tid()
    u = numbers[i]
    incoming_out[i] = sample_brdf(make_brdf(tables, base, metallic, roughness, UP, outgoing), u[0], wp.vec2(u[1], u[2]))


@wp.kernel
def sample_environment_kernel(
    # In:
    cdf: EnvironmentCdf,
    numbers: wp.array[wp.vec2],  # (sample)
    # Out:
    direction_out: wp.array[wp.vec3],  # (sample)
    sampled_pdf_out: wp.array[float],  # (sample)
    evaluated_pdf_out: wp.array[float],  # (sample)
):
    """Directions sampled from map 0, the pdf that the sampler returns with them, and the pdf evaluated for them afterwards."""
    i = wp.tid()
    sample = sample_environment(cdf, 0, numbers[i])
    direction_out[i] = sample.direction
    sampled_pdf_out[i] = sample.pdf
    evaluated_pdf_out[i] = environment_pdf(cdf, 0, sample.direction)


@wp.kernel
def invert_cdf_kernel(
    # In:
    cdf: EnvironmentCdf,
    row: int,
    numbers: wp.array[float],  # (sample)
    # Out:
    row_out: wp.array[int],  # (sample)
    column_out: wp.array[int],  # (sample)
):
    """Rows by the marginal CDF of map 0, and columns by the conditional CDF of one of its rows."""
    i = wp.tid()
    row_out[i] = invert_marginal(cdf, 0, numbers[i])
    column_out[i] = invert_conditional(cdf, 0, row, numbers[i])


@wp.kernel
def sample_point_kernel(
    # In:
    key: wp.uint64,
    dimension: int,
    # Out:
    point_out: wp.array[wp.vec2],  # (sample)
):
    """The first scrambled Sobol' points of a dimension."""
    i = wp.tid()
    point_out[i] = scrambled_point(key, i, dimension)


def toward(cosine, azimuth=0.0):
    """Unit vectors (..., 3) float32 with the given cosines to +z and azimuths [rad]."""
    sine = np.sqrt(1.0 - np.square(cosine))
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuth), sine * np.sin(azimuth), cosine), axis=-1).astype(np.float32)


def evaluate(tables, material, outgoing, incoming):
    """BRDF times cosine (N, 3) and pdf (N) for pairs of directions."""
    incoming = np.atleast_2d(incoming)
    outgoing = np.broadcast_to(outgoing, incoming.shape)
    arrays = [wp.array(np.ascontiguousarray(a), dtype=wp.vec3, device=tables.directional.device) for a in (outgoing, incoming)]
    value = wp.empty(len(incoming), dtype=wp.vec3, device=tables.directional.device)
    pdf = wp.empty(len(incoming), dtype=wp.float32, device=tables.directional.device)
    base, metallic, roughness = material
    wp.launch(evaluate_kernel, len(incoming), [tables, wp.vec3(*base), metallic, roughness, *arrays], [value, pdf], device=value.device)
    return value.numpy().astype(np.float64), pdf.numpy().astype(np.float64)
