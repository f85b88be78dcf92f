"""Probes of the BRDF, with the normal +z."""

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting import brdf
from synpick_warp.kernels.render.lighting.brdf import AlbedoTables, make_brdf
from tests.harness.probe import probe

UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))


@wp.func
def evaluate_pair(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, incoming: wp.vec3):
    """BRDF times cosine, and the pdf of sampling `incoming`."""
    surface = make_brdf(tables, base, metallic, roughness, UP, outgoing)
    value = brdf.evaluate_brdf(tables, surface, incoming)
    return value.specular + value.diffuse * surface.diffuse, brdf.brdf_pdf(surface, incoming)


@wp.func
def evaluate_disc(
    tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, center: wp.vec3, radius: float
):
    """Mean of BRDF times cosine over a disc light about `center`."""
    surface = make_brdf(tables, base, metallic, roughness, UP, outgoing)
    return brdf.evaluate_disc(tables, surface, brdf.view_factors(surface), center, radius)


@wp.func
def sample_direction(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, u: wp.vec3):
    """Direction sampled by three uniform numbers."""
    return brdf.sample_brdf(make_brdf(tables, base, metallic, roughness, UP, outgoing), u[0], wp.vec2(u[1], u[2]))


_pairs, _discs, _samples = probe(evaluate_pair), probe(evaluate_disc), probe(sample_direction)


def toward(cosine, azimuth=0.0):
    """Unit vectors (..., 3) float32 with the given cosines to +z and azimuths [rad]."""
    sine = np.sqrt(1.0 - np.square(cosine))
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuth), sine * np.sin(azimuth), cosine), axis=-1).astype(np.float32)


def evaluate(tables, material, outgoing, incoming):
    """BRDF times cosine (N, 3) and pdf (N) for pairs of directions; a material is base colour, metallic and roughness."""
    value, pdf = _pairs(tables, *material, outgoing, np.atleast_2d(incoming), device=tables.directional.device)
    return value.astype(np.float64), pdf.astype(np.float64)


def evaluate_discs(tables, material, outgoing, centers, tangent):
    """Mean of BRDF times cosine (N, 3) over disc lights about directions (N, 3)."""
    return _discs(tables, *material, outgoing, centers, tangent, device=tables.directional.device).astype(np.float64)


def sample(tables, material, outgoing, count):
    """Sampled directions (count, 3)."""
    numbers = np.random.default_rng(3).random((count, 3), dtype=np.float32)
    return _samples(tables, *material, outgoing, numbers, device=tables.directional.device).astype(np.float64)
