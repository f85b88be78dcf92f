"""Clear coat and anisotropic specular lobe over the BRDF of `brdf`, as in KHR_materials_clearcoat and KHR_materials_anisotropy of glTF.

The lobe has GGX widths α_t and α_b along tangent and bitangent (Heitz, 2014). At one azimuth it is an isotropic lobe of another width. Its
multiple scattering is that of the mean width: at strength 0.7 and roughness 0.3, white metal reflects 0.85 to 1.03 of even light.

The coat is a dielectric without diffuse lobe. With c its factor, E_c its directional albedo (Schlick's F if it is smooth), T = 1 - c E_c:

    f = c f_coat + min(T(μ_i), T(μ_o)) f_specular + T(μ_i) T(μ_o) / T̄ f_diffuse

In even light the base is dimmed by T(μ_o) = 1 - c F, as in glTF, whose example leaves out the light's direction and is not reciprocal.
"""

import warp as wp

from synpick_warp.kernels.render.lighting import brdf as plain
from synpick_warp.kernels.render.lighting.brdf import AlbedoTables, Brdf, BrdfValue, brdf_pdf, evaluate_brdf, evaluate_disc, sample_brdf
from synpick_warp.kernels.render.visibility.variants import variant_of

wp.set_module_options({"enable_backward": False})

COAT_OVERLAP = wp.constant(0.013)
"""T̄ is the mean of T over light that enters a smooth base: variance of F over the mean of 1 - F, weighted by cosine, for F₀ = 0.04."""

FinishedBrdf = variant_of(
    Brdf, "FinishedBrdf", widths=wp.vec2, coat=Brdf, clearcoat=float, passing=float, mean_passing=float, coat_probability=float
)
"""BRDF whose frame and `widths` are those of an anisotropic lobe (`alpha` is its width towards the viewer), under a `coat` of the factor
`clearcoat`. `passing` is T(μ_o), `mean_passing` T̄, `coat_probability` that of sampling the coat."""


@wp.func
def finish_brdf(
    brdf: FinishedBrdf, tables: AlbedoTables, widths: wp.vec2, coat_normal: wp.vec3, tangent: wp.vec4, finish: wp.vec4
) -> FinishedBrdf:
    """Add coat and anisotropy to what `make_brdf` has set, for the mean of `widths`. `tangent`: as of `Surface`, zero if they are equal.
    `finish`: as of `RandomizedSurfaces`."""
    result = brdf
    if widths[0] > widths[1]:
        along = wp.vec3(tangent[0], tangent[1], tangent[2])
        along = wp.normalize(along - wp.dot(along, brdf.normal) * brdf.normal)
        across = tangent[3] * wp.cross(brdf.normal, along)
        result.tangent = wp.cos(finish[3]) * along + wp.sin(finish[3]) * across
        result.bitangent = wp.cross(brdf.normal, result.tangent)
    result.widths = widths
    result.alpha = width_toward(widths, plain.to_local(result, brdf.outgoing))
    result.passing = 1.0
    result.mean_passing = 1.0
    if finish[0] > 0.0:
        coat = plain.make_brdf(Brdf(), tables, wp.vec3(0.0, 0.0, 0.0), 0.0, finish[1], coat_normal, brdf.outgoing)
        coat.specular_probability = 1.0
        result.coat = coat
        result.clearcoat = finish[0]
        reflected = finish[0] * plain.coat_albedo(coat, coat.albedo)
        result.passing = 1.0 - reflected
        result.mean_passing = 1.0 - finish[0] * (plain.coat_albedo(coat, coat.mean_albedo) - COAT_OVERLAP)
        below = plain.mean_channel(plain.specular_albedo(brdf) + (1.0 - plain.coat_albedo(brdf, brdf.albedo)) * brdf.diffuse)
        share = reflected / (reflected + result.passing * below)
        result.coat_probability = wp.clamp(share, plain.MIN_LOBE_PROBABILITY, 1.0 - plain.MIN_LOBE_PROBABILITY)
    return result


@wp.func
def width_toward(widths: wp.vec2, direction: wp.vec3) -> float:
    """GGX width of the isotropic lobe that shadows and masks alike at the azimuth of a direction in the shading frame."""
    across = direction[0] * direction[0] + direction[1] * direction[1]
    if across <= 0.0:
        return widths[0]
    return wp.length(wp.vec2(widths[0] * direction[0], widths[1] * direction[1])) / wp.sqrt(across)


@wp.func
def facet_distribution(brdf: FinishedBrdf, angles: plain.Angles, incoming: wp.vec3, slopes: float) -> float:
    """D at the half vector of a light direction, or its mean over a disc of slopes. This is an ellipse in units of the widths, for which a
    disc of the same area stands."""
    area = brdf.widths[0] * brdf.widths[1]
    width = area / width_toward(wp.vec2(brdf.widths[1], brdf.widths[0]), plain.to_local(brdf, incoming + brdf.outgoing))
    distribution = plain.ggx_distribution(angles.half_way, angles.squared_sine, width)
    if slopes > 0.0:
        distribution = plain.ggx_disc_distribution(angles.half_way, angles.squared_sine, width, slopes * width / wp.sqrt(area))
    return width * width / area * distribution


@wp.func
def evaluate_layers(tables: AlbedoTables, brdf: FinishedBrdf, view: plain.ViewFactors, incoming: wp.vec3, radius: float) -> BrdfValue:
    """Evaluate coat and base times cosine for light from `incoming`, or a disc light of this tangent of its radius about it."""
    result = BrdfValue()
    angles = plain.measure_angles(brdf, incoming)
    if angles.incoming > 0.0 and angles.outgoing > 0.0:
        lit = brdf
        lit.alpha = width_toward(brdf.widths, plain.to_local(brdf, incoming))
        distribution = facet_distribution(brdf, angles, incoming, plain.disc_slopes(angles, radius))
        result = plain.evaluate_lobes(tables, lit, view, angles, distribution)
    if brdf.clearcoat > 0.0:
        albedo = plain.directional_albedo(tables, brdf.coat.roughness, wp.dot(incoming, brdf.coat.normal))
        passing = 1.0 - brdf.clearcoat * plain.coat_albedo(brdf.coat, albedo)
        reflected = wp.vec3(0.0, 0.0, 0.0)
        if radius > 0.0:
            reflected = evaluate_disc(tables, brdf.coat, plain.view_factors(brdf.coat), incoming, radius)
        else:
            reflected = evaluate_brdf(tables, brdf.coat, incoming).specular
        result.specular = wp.min(passing, brdf.passing) * result.specular + brdf.clearcoat * reflected
        result.diffuse = passing * brdf.passing / brdf.mean_passing * result.diffuse
    return result


@wp.func
def evaluate_brdf(tables: AlbedoTables, brdf: FinishedBrdf, incoming: wp.vec3) -> BrdfValue:  # noqa: F811
    """Evaluate the BRDF times cosine for light from `incoming`; zero below the surface."""
    return evaluate_layers(tables, brdf, plain.view_factors(brdf), incoming, 0.0)


@wp.func
def evaluate_disc(  # noqa: F811
    tables: AlbedoTables, brdf: FinishedBrdf, view: plain.ViewFactors, center: wp.vec3, radius: float
) -> wp.vec3:
    """Evaluate the BRDF times cosine, averaged over a disc light (a lamp) about `center`."""
    value = evaluate_layers(tables, brdf, view, center, radius)
    return value.specular + value.diffuse * brdf.diffuse


@wp.func
def brdf_pdf(brdf: FinishedBrdf, incoming: wp.vec3) -> float:  # noqa: F811
    """Probability density over solid angle with which `sample_brdf` returns a direction [1/sr]."""
    angles = plain.measure_angles(brdf, incoming)
    pdf = float(0.0)
    if angles.incoming > 0.0:
        facing = wp.max(angles.outgoing, plain.MIN_COSINE) * (1.0 + plain.smith_term(angles.outgoing, brdf.alpha))
        pdf = wp.lerp(angles.incoming / wp.PI, facet_distribution(brdf, angles, incoming, 0.0) / (2.0 * facing), brdf.specular_probability)
    if brdf.clearcoat > 0.0:
        pdf = wp.lerp(pdf, brdf_pdf(brdf.coat, incoming), brdf.coat_probability)
    return pdf


@wp.func
def sample_brdf(brdf: FinishedBrdf, choice: float, u: wp.vec2) -> wp.vec3:  # noqa: F811
    """Sample an incoming direction: from the coat if `choice` < coat_probability, else from the base, whose facets are those of a lobe of
    width 1, stretched."""
    if choice < brdf.coat_probability:
        return sample_brdf(brdf.coat, 0.0, u)
    radius, angle = wp.sqrt(u[0]), wp.TAU * u[1]
    i = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(wp.max(1.0 - u[0], 0.0)))
    if choice < wp.lerp(brdf.coat_probability, 1.0, brdf.specular_probability):
        scale = wp.vec3(brdf.widths[0], brdf.widths[1], 1.0)
        o = plain.to_local(brdf, brdf.outgoing)
        facet = wp.normalize(wp.cw_mul(scale, plain.sample_ggx_vndf(wp.normalize(wp.cw_mul(scale, o)), 1.0, u)))
        i = 2.0 * wp.dot(o, facet) * facet - o
    return wp.normalize(i[0] * brdf.tangent + i[1] * brdf.bitangent + i[2] * brdf.normal)
