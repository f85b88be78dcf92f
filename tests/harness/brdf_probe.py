"""Probes of the BRDF, with the normal +z."""

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting import brdf
from synpick_warp.kernels.render.lighting.brdf import AlbedoTables, Brdf, make_brdf
from synpick_warp.kernels.render.lighting.finish import FinishedBrdf, finish_brdf
from tests.harness.probe import probe

UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))


@wp.func
def evaluate_pair(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, incoming: wp.vec3):
    """BRDF times cosine, and the pdf of sampling `incoming`."""
    surface = make_brdf(Brdf(), tables, base, metallic, roughness, UP, outgoing)
    value = brdf.evaluate_brdf(tables, surface, incoming)
    return value.specular + value.diffuse * surface.diffuse, brdf.brdf_pdf(surface, incoming)


@wp.func
def evaluate_disc(
    tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, center: wp.vec3, radius: float
):
    """Mean of BRDF times cosine over a disc light about `center`."""
    surface = make_brdf(Brdf(), tables, base, metallic, roughness, UP, outgoing)
    return brdf.evaluate_disc(tables, surface, brdf.view_factors(surface), center, radius)


@wp.func
def sample_direction(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, outgoing: wp.vec3, u: wp.vec3):
    """Direction sampled by three uniform numbers."""
    return brdf.sample_brdf(make_brdf(Brdf(), tables, base, metallic, roughness, UP, outgoing), u[0], wp.vec2(u[1], u[2]))


@wp.func
def finished(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, finish: wp.vec4, outgoing: wp.vec3) -> FinishedBrdf:
    """BRDF with a finish; u grows along x."""
    alpha = wp.clamp(roughness * roughness, brdf.MIN_ALPHA, 1.0)
    widths = wp.vec2(wp.lerp(alpha, 1.0, finish[2] * finish[2]), alpha)
    made = make_brdf(FinishedBrdf(), tables, base, metallic, wp.sqrt(0.5 * (widths[0] + widths[1])), UP, outgoing)
    return finish_brdf(made, tables, widths, UP, wp.vec4(1.0, 0.0, 0.0, 1.0), finish)


@wp.func
def evaluate_finished(
    tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, finish: wp.vec4, outgoing: wp.vec3, incoming: wp.vec3
):
    """`evaluate_pair` with a finish."""
    surface = finished(tables, base, metallic, roughness, finish, outgoing)
    value = brdf.evaluate_brdf(tables, surface, incoming)
    return value.specular + value.diffuse * surface.diffuse, brdf.brdf_pdf(surface, incoming)


@wp.func
def evaluate_finished_disc(
    tables: AlbedoTables,
    base: wp.vec3,
    metallic: float,
    roughness: float,
    finish: wp.vec4,
    outgoing: wp.vec3,
    center: wp.vec3,
    radius: float,
):
    """`evaluate_disc` with a finish."""
    surface = finished(tables, base, metallic, roughness, finish, outgoing)
    return brdf.evaluate_disc(tables, surface, brdf.view_factors(surface), center, radius)


@wp.func
def sample_finished(tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, finish: wp.vec4, outgoing: wp.vec3, u: wp.vec3):
    """`sample_direction` with a finish."""
    return brdf.sample_brdf(finished(tables, base, metallic, roughness, finish, outgoing), u[0], wp.vec2(u[1], u[2]))


_pairs, _discs, _samples = (
    {3: probe(plain), 4: probe(made)}
    for plain, made in ((evaluate_pair, evaluate_finished), (evaluate_disc, evaluate_finished_disc), (sample_direction, sample_finished))
)
"""By the number of a material's values."""


def toward(cosine, azimuth=0.0):
    """Unit vectors (..., 3) float32 with the given cosines to +z and azimuths [rad]."""
    sine = np.sqrt(1.0 - np.square(cosine))
    return np.stack(np.broadcast_arrays(sine * np.cos(azimuth), sine * np.sin(azimuth), cosine), axis=-1).astype(np.float32)


def evaluate(tables, material, outgoing, incoming):
    """BRDF times cosine (N, 3) and pdf (N) for pairs of directions; a material is base colour, metallic and roughness, and may
    have a finish."""
    value, pdf = _pairs[len(material)](tables, *material, outgoing, np.atleast_2d(incoming), device=tables.directional.device)
    return value.astype(np.float64), pdf.astype(np.float64)


def evaluate_discs(tables, material, outgoing, centers, tangent):
    """Mean of BRDF times cosine (N, 3) over disc lights about directions (N, 3)."""
    return _discs[len(material)](tables, *material, outgoing, centers, tangent, device=tables.directional.device).astype(np.float64)


def sample(tables, material, outgoing, count):
    """Sampled directions (count, 3)."""
    numbers = np.random.default_rng(3).random((count, 3), dtype=np.float32)
    return _samples[len(material)](tables, *material, outgoing, numbers, device=tables.directional.device).astype(np.float64)
