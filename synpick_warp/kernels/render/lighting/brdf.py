"""Metallic-roughness BRDF: a GGX specular lobe with energy-compensated multiple scattering over a diffuse lobe; evaluation and sampling.

With μ the cosine to the normal, F₀ the reflectance at normal incidence, E(μ) the directional albedo of the single-scattering lobe for
F = 1 and E_d(μ) the directional albedo of all specular reflection of a dielectric, their cosine-weighted means written Ē:

    f = D F G₂ / (4 μ_i μ_o)                                        specular, single scattering (Walter et al., 2007; Heitz, 2014)
      + F_m (1 - E(μ_i)) (1 - E(μ_o)) / (π (1 - Ē))                 specular, multiple scattering (Kulla and Conty, 2017)
      + (1 - metallic) base (1 - E_d(μ_i)) (1 - E_d(μ_o)) / (π (1 - Ē_d))     diffuse: what the specular lobe transmits (Kelemen, 2001)

This blends a metal and a dielectric by `metallic`, as glTF does. Each term is reciprocal, and a white base colour reflects all light
(white furnace test). F is Schlick's approximation, so the albedo is linear in F₀: ∫ D F G₂ / (4 μ_o) dω = F₀ a(μ) + b(μ), E = a + b.
`AlbedoTables` holds a and b.
"""

from typing import Any

import warp as wp

from synpick_warp.kernels.render.lighting.sampling import rotate_to_axis, sobol_point

wp.set_module_options({"enable_backward": False})

DIELECTRIC_F0 = wp.constant(0.04)
"""F₀ of plastics and paper: reflectance at normal incidence."""
MIN_ALPHA = wp.constant(0.01)
"""Smallest GGX width alpha = roughness²; smoother surfaces would reflect a lamp into a point that no pixel samples."""
MIN_COSINE = wp.constant(1.0e-4)
"""Divisors that are cosines or products of cosines are at least this."""
MIN_FACING = wp.constant(0.01)
"""Interpolated normals are bent towards the viewer until their cosine to the view direction is this."""
MIN_FACET_Z = wp.constant(1.0e-7)
"""Smallest z of a sampled microfacet normal before it is normalized."""
MIN_LOST_ALBEDO = wp.constant(1.0e-6)
"""Smallest divisor 1 - Ē: a mirror scatters nothing more than once."""
ALBEDO_ROWS = wp.constant(32)
"""Rows of the albedo table: roughness i / (ALBEDO_ROWS - 1)."""
ALBEDO_COLUMNS = wp.constant(32)
"""Columns of the albedo table: √cosine j / (ALBEDO_COLUMNS - 1), because the albedo changes fastest at grazing angles."""
ALBEDO_SAMPLES = wp.constant(4096)
"""Directions per entry of the albedo table: its error is about 1e-4."""
PIXEL_VARIANCE = wp.constant(1.0 / 12.0)
"""Variance of a uniformly distributed position in a pixel, along one axis [px²]."""
MAX_WIDENING = wp.constant(0.18)
"""Specular anti-aliasing: largest increase of the squared GGX width alpha² (Tokuyoshi and Kaplanyan, 2019)."""
MIN_LOBE_PROBABILITY = wp.constant(0.25)
"""Smallest probability of sampling a lobe that is not black."""


@wp.struct
class AlbedoTables:
    """Precomputed directional albedo of the single-scattering GGX lobe: F₀ times the first component (a) plus the second (b)."""

    directional: wp.array2d[wp.vec2]
    """(roughness, √cosine)."""
    mean: wp.array[wp.vec2]
    """(roughness): cosine-weighted mean, 2 ∫ albedo μ dμ of the table as it is interpolated."""


@wp.struct
class Brdf:
    """The BRDF at one hit for one view direction. Directions are unit vectors in the world that point away from the hit."""

    normal: wp.vec3
    tangent: wp.vec3
    bitangent: wp.vec3
    outgoing: wp.vec3
    roughness: float
    alpha: float
    """GGX width: roughness², at least MIN_ALPHA."""
    f0: wp.vec3
    """F₀: reflectance at normal incidence."""
    diffuse: wp.vec3
    """Diffuse colour: (1 - metallic) times base colour."""
    multi_scatter: wp.vec3
    """F_m: fraction of light that survives being scattered more than once."""
    coat_multi_scatter: float
    """F_m of a dielectric."""
    albedo: wp.vec2
    """Entry of the directional albedo table for the view direction."""
    mean_albedo: wp.vec2
    """Entry of the mean albedo table."""
    specular_probability: float
    """Probability of sampling the GGX lobe; else the cosine lobe is sampled."""


AnyBrdf = Any
"""`Brdf`, or `FinishedBrdf` of `finish`: functions are compiled for each."""


@wp.func
def directional_albedo(tables: AlbedoTables, roughness: float, cosine: float) -> wp.vec2:
    """Directional albedo at a roughness and a cosine, bilinear in roughness and √cosine."""
    y = wp.clamp(roughness, 0.0, 1.0) * float(ALBEDO_ROWS - 1)
    x = wp.sqrt(wp.clamp(cosine, 0.0, 1.0)) * float(ALBEDO_COLUMNS - 1)
    # Unsigned until they are cut, so that the compiler knows that they are not negative.
    row = int(wp.min(wp.uint32(y), wp.uint32(ALBEDO_ROWS - 2)))
    column = int(wp.min(wp.uint32(x), wp.uint32(ALBEDO_COLUMNS - 2)))
    right = x - float(column)
    return wp.lerp(
        wp.lerp(tables.directional[row, column], tables.directional[row, column + 1], right),
        wp.lerp(tables.directional[row + 1, column], tables.directional[row + 1, column + 1], right),
        y - float(row),
    )


@wp.func
def mean_albedo_at(tables: AlbedoTables, roughness: float) -> wp.vec2:
    """Cosine-weighted mean of the directional albedo at a roughness, interpolated from the table."""
    y = wp.clamp(roughness, 0.0, 1.0) * float(ALBEDO_ROWS - 1)
    row = int(wp.min(wp.uint32(y), wp.uint32(ALBEDO_ROWS - 2)))
    return wp.lerp(tables.mean[row], tables.mean[row + 1], y - float(row))


@wp.func
def multi_scatter_fresnel(mean_albedo: float, reflectance: float) -> float:
    """F_m, the Fresnel factor of multiple scattering, for F₀ = `reflectance` and Ē = `mean_albedo`.

    Light hits k > 1 facets with probability ∝ (1 - Ē)^(k - 1) and keeps the fraction F̄ each time. Schlick's approximation has the mean
    F̄ = F₀ + (1 - F₀) / 21. The series begins at the second hit, hence the square (Hill, 2018).
    """
    average = (20.0 * reflectance + 1.0) / 21.0
    return average * average * mean_albedo / (1.0 - (1.0 - mean_albedo) * average)


@wp.func
def coat_albedo(brdf: AnyBrdf, albedo: wp.vec2) -> float:
    """E_d: albedo of all specular reflection of a dielectric (the coat over the diffuse lobe), for the table's entry `albedo`."""
    return albedo[0] * DIELECTRIC_F0 + albedo[1] + (1.0 - albedo[0] - albedo[1]) * brdf.coat_multi_scatter


@wp.func
def specular_albedo(brdf: AnyBrdf) -> wp.vec3:
    """Directional albedo of all specular reflection, single and multiple scattering: its response to uniform light."""
    single = brdf.albedo[0] * brdf.f0 + wp.vec3(brdf.albedo[1], brdf.albedo[1], brdf.albedo[1])
    return single + (1.0 - brdf.albedo[0] - brdf.albedo[1]) * brdf.multi_scatter


@wp.func
def mean_channel(color: wp.vec3) -> float:
    """Mean of the three channels."""
    return (color[0] + color[1] + color[2]) / 3.0


@wp.func
def bend_normal(normal: wp.vec3, outgoing: wp.vec3) -> wp.vec3:
    """`normal`, bent until it faces the viewer: interpolated normals point away at silhouettes. `outgoing` is the view direction."""
    cosine = wp.dot(normal, outgoing)
    if cosine >= MIN_FACING:
        return normal
    return wp.normalize(normal + (MIN_FACING - cosine) * outgoing)


@wp.func
def widen_roughness(roughness: float, normal_spread: float) -> float:
    """Specular anti-aliasing: widen the GGX lobe by the variance of the normals in a pixel's footprint (Kaplanyan et al., 2016)."""
    alpha = roughness * roughness
    return wp.sqrt(wp.sqrt(wp.min(alpha * alpha + wp.min(PIXEL_VARIANCE * normal_spread * normal_spread, MAX_WIDENING), 1.0)))


@wp.func
def make_brdf(new: AnyBrdf, tables: AlbedoTables, base: wp.vec3, metallic: float, roughness: float, normal: wp.vec3, outgoing: wp.vec3):
    """Build the BRDF of a surface with linear base colour `base` for the view direction `outgoing`; `normal` points to the same side.
    `new`: the struct whose members are set."""
    brdf = new
    brdf.normal = bend_normal(normal, outgoing)
    brdf.tangent = rotate_to_axis(brdf.normal, wp.vec3(1.0, 0.0, 0.0))
    brdf.bitangent = rotate_to_axis(brdf.normal, wp.vec3(0.0, 1.0, 0.0))
    brdf.outgoing = outgoing
    brdf.roughness = roughness
    brdf.alpha = wp.clamp(roughness * roughness, MIN_ALPHA, 1.0)
    brdf.f0 = wp.lerp(wp.vec3(DIELECTRIC_F0, DIELECTRIC_F0, DIELECTRIC_F0), base, metallic)
    brdf.diffuse = (1.0 - metallic) * base
    brdf.albedo = directional_albedo(tables, roughness, wp.dot(brdf.normal, outgoing))
    brdf.mean_albedo = mean_albedo_at(tables, roughness)
    mean = brdf.mean_albedo[0] + brdf.mean_albedo[1]
    brdf.coat_multi_scatter = multi_scatter_fresnel(mean, DIELECTRIC_F0)
    metal = wp.vec3(multi_scatter_fresnel(mean, base[0]), multi_scatter_fresnel(mean, base[1]), multi_scatter_fresnel(mean, base[2]))
    brdf.multi_scatter = wp.lerp(wp.vec3(brdf.coat_multi_scatter, brdf.coat_multi_scatter, brdf.coat_multi_scatter), metal, metallic)
    single = brdf.albedo[0] * mean_channel(brdf.f0) + brdf.albedo[1]
    # The cosine lobe also samples multiple scattering.
    rest = (1.0 - brdf.albedo[0] - brdf.albedo[1]) * mean_channel(brdf.multi_scatter)
    rest += (1.0 - coat_albedo(brdf, brdf.albedo)) * mean_channel(brdf.diffuse)
    brdf.specular_probability = 1.0
    if rest > 0.0:
        brdf.specular_probability = wp.clamp(single / (single + rest), MIN_LOBE_PROBABILITY, 1.0 - MIN_LOBE_PROBABILITY)
    return brdf


@wp.func
def to_local(brdf: AnyBrdf, direction: wp.vec3) -> wp.vec3:
    """Transform a world direction into the shading frame, whose z is the normal."""
    return wp.vec3(wp.dot(direction, brdf.tangent), wp.dot(direction, brdf.bitangent), wp.dot(direction, brdf.normal))


@wp.func
def smith_term(cosine: float, alpha: float) -> float:
    """1 + 2 Λ of Smith's masking function for GGX, s: G₁ = 2 / (1 + s); height-correlated G₂ = 2 / (s_i + s_o)."""
    a2 = alpha * alpha
    c2 = wp.max(cosine * cosine, MIN_COSINE * MIN_COSINE)
    return wp.sqrt(1.0 + a2 * wp.max(1.0 - c2, 0.0) / c2)


@wp.func
def ggx_distribution(cosine: float, squared_sine: float, alpha: float) -> float:
    """GGX normal distribution D at a half vector, by its angle to the normal."""
    a2 = alpha * alpha
    denominator = squared_sine + a2 * cosine * cosine
    return a2 / (wp.PI * denominator * denominator)


@wp.func
def ggx_disc_distribution(cosine: float, squared_sine: float, alpha: float, radius: float) -> float:
    """Mean of D over a disc of half-vector slopes with this radius about that of a half vector; `ggx_distribution` if the radius is 0.

    In slope space GGX is the stereographic projection of the uniform distribution on a sphere: discs map to spherical caps, whose area
    has a closed form.
    """
    c2 = wp.max(cosine * cosine, MIN_COSINE)
    away = squared_sine / (c2 * alpha * alpha)
    wide = radius * radius / (alpha * alpha)
    near = 1.0 + away - wide
    root = wp.sqrt(near * near + 4.0 * wide)
    if near >= 0.0:
        return 2.0 / (wp.PI * alpha * alpha * c2 * c2 * root * (root + near))
    return (root - near) / (2.0 * wp.PI * radius * radius * c2 * c2 * root)


@wp.func
def schlick_weight(cosine: float) -> float:
    """(1 - cosine)⁵: Schlick's Fresnel reflectance is F = F₀ + (1 - F₀) of this."""
    x = wp.clamp(1.0 - cosine, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


@wp.func
def sample_ggx_vndf(outgoing: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Sample a microfacet normal from the GGX distribution of visible normals (VNDF), by spherical caps (Dupuy and Benyoub, 2023).
    Directions are in the shading frame; `u` is uniform in [0, 1)²."""
    warped = wp.normalize(wp.vec3(alpha * outgoing[0], alpha * outgoing[1], outgoing[2]))
    angle = wp.TAU * u[0]
    z = (1.0 - u[1]) * (1.0 + warped[2]) - warped[2]
    radius = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    h = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), z) + warped
    return wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], wp.max(h[2], MIN_FACET_Z)))


@wp.struct
class BrdfValue:
    """BRDF times the cosine of the incoming direction [1/sr], by lobe: diffuse colour times `diffuse`, plus `specular`."""

    diffuse: float
    specular: wp.vec3


@wp.struct
class SplitRadiance:
    """Radiance that a surface reflects to the camera: its diffuse colour times `diffuse` + `indirect`, plus `specular`."""

    diffuse: wp.vec3
    """Diffuse reflection of light that arrives straight from the environment map, without the surface's colour."""
    indirect: wp.vec3
    """Diffuse reflection of light that arrives from other surfaces, without the surface's colour."""
    specular: wp.vec3
    """Specular reflection of both."""


@wp.struct
class Angles:
    """Angles of a light direction, the view direction and their half vector. The BRDF is isotropic, so it needs no tangents."""

    incoming: float
    """Cosine of the light direction to the normal."""
    outgoing: float
    """Cosine of the view direction to the normal."""
    half_way: float
    """Cosine of the half vector to the normal."""
    squared_sine: float
    """Squared sine of that angle; 1 - cosine² would lose the digits that a sharp lobe needs."""
    difference: float
    """Cosine of the half vector to the view direction."""


@wp.func
def measure_angles(brdf: AnyBrdf, incoming: wp.vec3) -> Angles:
    """Cosines between light direction `incoming`, view direction, half vector and normal."""
    angles = Angles()
    angles.incoming = wp.dot(incoming, brdf.normal)
    angles.outgoing = wp.dot(brdf.outgoing, brdf.normal)
    half_way = wp.normalize(incoming + brdf.outgoing)
    angles.half_way = wp.dot(half_way, brdf.normal)
    across = half_way - angles.half_way * brdf.normal
    angles.squared_sine = wp.dot(across, across)
    angles.difference = wp.dot(brdf.outgoing, half_way)
    return angles


@wp.struct
class ViewFactors:
    """Factors of the BRDF that depend on the view direction alone: several lights share them."""

    smith: float
    """`smith_term` of the view direction."""
    multi_scatter: float
    """(1 - E(μ_o)) / (π (1 - Ē))."""
    diffuse: float
    """(1 - E_d(μ_o)) / (π (1 - Ē_d))."""


@wp.func
def view_factors(brdf: AnyBrdf) -> ViewFactors:
    """Factors of the BRDF that several lights share: masking, multiple scattering and diffuse term of its view direction."""
    factors = ViewFactors()
    factors.smith = smith_term(wp.dot(brdf.outgoing, brdf.normal), brdf.alpha)
    lost = wp.max(1.0 - brdf.mean_albedo[0] - brdf.mean_albedo[1], MIN_LOST_ALBEDO)
    factors.multi_scatter = (1.0 - brdf.albedo[0] - brdf.albedo[1]) / (wp.PI * lost)
    factors.diffuse = (1.0 - coat_albedo(brdf, brdf.albedo)) / (wp.PI * (1.0 - coat_albedo(brdf, brdf.mean_albedo)))
    return factors


@wp.func
def evaluate_lobes(tables: AlbedoTables, brdf: AnyBrdf, view: ViewFactors, angles: Angles, distribution: float) -> BrdfValue:
    """Both lobes for light and view directions at these `angles`; `distribution` is D at the half vector."""
    value = BrdfValue()
    one = wp.vec3(1.0, 1.0, 1.0)
    fresnel = brdf.f0 + schlick_weight(angles.difference) * (one - brdf.f0)
    smith = smith_term(angles.incoming, brdf.alpha) + view.smith
    albedo = directional_albedo(tables, brdf.roughness, angles.incoming)
    multi_scatter = angles.incoming * (1.0 - albedo[0] - albedo[1]) * view.multi_scatter
    value.specular = distribution / (2.0 * smith * wp.max(angles.outgoing, MIN_COSINE)) * fresnel + multi_scatter * brdf.multi_scatter
    value.diffuse = angles.incoming * (1.0 - coat_albedo(brdf, albedo)) * view.diffuse
    return value


@wp.func
def evaluate_brdf(tables: AlbedoTables, brdf: Brdf, incoming: wp.vec3) -> BrdfValue:
    """Evaluate the BRDF times cosine for light from `incoming`; zero below the surface."""
    angles = measure_angles(brdf, incoming)
    if angles.incoming <= 0.0 or angles.outgoing <= 0.0:
        return BrdfValue()
    return evaluate_lobes(tables, brdf, view_factors(brdf), angles, ggx_distribution(angles.half_way, angles.squared_sine, brdf.alpha))


@wp.func
def disc_slopes(angles: Angles, radius: float) -> float:
    """Radius of the disc of half-vector slopes of a disc light: a half vector rotates by half the angle in the plane of both directions, by
    more across it; slopes change by more than angles do."""
    cube = angles.half_way * angles.half_way * angles.half_way
    return 0.5 * radius / wp.sqrt(wp.max(angles.difference * cube, MIN_COSINE))


@wp.func
def evaluate_disc(tables: AlbedoTables, brdf: Brdf, view: ViewFactors, center: wp.vec3, radius: float) -> wp.vec3:
    """Evaluate the BRDF times cosine, averaged over a disc light (a lamp) about `center`.

    `view` is that of `view_factors`; `radius` is the tangent of the light's angular radius, and small. The half vectors of a disc light
    fill an ellipse in slope space, approximated by a disc of the same area: in sharp highlights of wide lamps at cosines below 0.5 the
    middle is too bright and the sides are too dark.
    """
    angles = measure_angles(brdf, center)
    if angles.incoming <= 0.0 or angles.outgoing <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    distribution = ggx_disc_distribution(angles.half_way, angles.squared_sine, brdf.alpha, disc_slopes(angles, radius))
    value = evaluate_lobes(tables, brdf, view, angles, distribution)
    return value.specular + value.diffuse * brdf.diffuse


@wp.func
def brdf_pdf(brdf: Brdf, incoming: wp.vec3) -> float:
    """Probability density over solid angle with which `sample_brdf` returns a direction [1/sr]."""
    angles = measure_angles(brdf, incoming)
    if angles.incoming <= 0.0:
        return 0.0
    facing = wp.max(angles.outgoing, MIN_COSINE) * (1.0 + smith_term(angles.outgoing, brdf.alpha))
    visible = ggx_distribution(angles.half_way, angles.squared_sine, brdf.alpha) / (2.0 * facing)
    return brdf.specular_probability * visible + (1.0 - brdf.specular_probability) * angles.incoming / wp.PI


@wp.func
def sample_brdf(brdf: Brdf, choice: float, u: wp.vec2) -> wp.vec3:
    """Sample an incoming direction: from the GGX lobe if `choice` < specular_probability, else cosine-weighted. `choice` and `u` are
    uniform in [0, 1). A direction below the surface carries no light."""
    o = to_local(brdf, brdf.outgoing)
    i = wp.vec3(0.0, 0.0, 1.0)
    if choice < brdf.specular_probability:
        facet = sample_ggx_vndf(o, brdf.alpha, u)
        i = 2.0 * wp.dot(o, facet) * facet - o
    else:
        radius = wp.sqrt(u[0])
        angle = wp.TAU * u[1]
        i = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(wp.max(1.0 - u[0], 0.0)))
    return wp.normalize(i[0] * brdf.tangent + i[1] * brdf.bitangent + i[2] * brdf.normal)


@wp.kernel
def measure_albedo_kernel(
    # Out:
    albedo_out: wp.array2d[wp.vec2],  # (roughness, cosine)
):
    """Measure the directional albedo table: the mean of (1 - s, s) G₂ / G₁ over sampled visible normals, s Schlick's weight. Launched over
    row (roughness), column (√cosine)."""
    row, column = wp.tid()
    roughness = float(row) / float(ALBEDO_ROWS - 1)
    root = float(column) / float(ALBEDO_COLUMNS - 1)
    alpha = wp.clamp(roughness * roughness, MIN_ALPHA, 1.0)
    cosine = wp.max(root * root, MIN_COSINE)
    o = wp.vec3(wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0)), 0.0, cosine)
    total = wp.vec2(0.0, 0.0)
    for index in range(ALBEDO_SAMPLES):
        facet = sample_ggx_vndf(o, alpha, sobol_point(index))
        cosine_facet = wp.dot(o, facet)
        i = 2.0 * cosine_facet * facet - o
        if i[2] > 0.0:
            unmasked = (1.0 + smith_term(cosine, alpha)) / (smith_term(i[2], alpha) + smith_term(cosine, alpha))
            weight = schlick_weight(cosine_facet)
            total += unmasked * wp.vec2(1.0 - weight, weight)
    albedo_out[row, column] = total / float(ALBEDO_SAMPLES)
