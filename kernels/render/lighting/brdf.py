"""How a surface scatters light: metallic-roughness with a GGX lobe, what that lobe scatters several times, and a diffuse lobe below it.

With μ the cosine to the normal, F₀ the reflectance at normal incidence, E(μ) the single-scattering albedo of the lobe for F = 1 and
E_d(μ) that of all gloss of a dielectric, their cosine-weighted means written Ē:

    f = D F G₂ / (4 μ_i μ_o)                                        gloss, single scattering (Walter et al., 2007; Heitz, 2014)
      + F_m (1 - E(μ_i)) (1 - E(μ_o)) / (π (1 - Ē))                 gloss, multiple scattering (Kulla and Conty, 2017)
      + (1 - metallic) base (1 - E_d(μ_i)) (1 - E_d(μ_o)) / (π (1 - Ē_d))     diffuse: what the gloss lets through (Kelemen, 2001)

This is the mixture, by `metallic`, of a metal and a dielectric, as glTF has it. Each part is reciprocal, and a white base colour
reflects all light. F is Schlick's, so that the albedo is linear in F₀: ∫ D F G₂ / (4 μ_o) dω = F₀ a(μ) + b(μ), E = a + b. A table
holds a and b.
"""

import warp as wp

from synpick_warp.kernels.render.lighting.sampling import around, sobol_point

wp.set_module_options({"enable_backward": False})

DIELECTRIC = wp.constant(0.04)
"""Reflectance of plastics and paper at normal incidence."""
MIN_ALPHA = wp.constant(0.01)
"""Smallest squared roughness; smoother surfaces would mirror a lamp as a point that no pixel meets."""
MIN_COSINE = wp.constant(1.0e-4)
"""Cosines, and products of such, are kept off zero by this much before something is divided by them."""
LEAST_FACING = wp.constant(0.01)
"""Interpolated normals are bent until this is their cosine to the side from which they are seen."""
LEAST_RISE = wp.constant(1.0e-7)
"""Facets point up by at least this much, so that their normal has a direction."""
LEAST_LOST = wp.constant(1.0e-6)
"""A mirror scatters nothing twice; what it would is divided by no less than this."""
GLOSS_ROWS = wp.constant(32)
"""Roughness in the table of albedos: i / (GLOSS_ROWS - 1)."""
GLOSS_COLUMNS = wp.constant(32)
"""Roots of cosines in the table: j / (GLOSS_COLUMNS - 1); the albedo changes fastest at grazing angles."""
GLOSS_SAMPLES = wp.constant(4096)
"""Directions that find one entry of the table, to about 1e-4."""
LEAST_SHARE = wp.constant(0.25)
"""No lobe that scatters anything is chosen more seldom than this."""


@wp.struct
class Gloss:
    """Albedo of the single-scattering lobe: F₀ times the first component plus the second."""

    albedo: wp.array2d[wp.vec2]
    """(roughness, root of the cosine)."""
    mean: wp.array[wp.vec2]
    """(roughness): 2 ∫ albedo μ dμ of the table as it is interpolated."""


@wp.struct
class Brdf:
    """A surface at one hit, seen from one direction. Directions are unit vectors in the world that point away from the hit."""

    normal: wp.vec3
    tangent: wp.vec3
    bitangent: wp.vec3
    outgoing: wp.vec3
    roughness: float
    alpha: float
    reflectance: wp.vec3
    """F₀."""
    diffuse: wp.vec3
    """(1 - metallic) times base colour."""
    multiple: wp.vec3
    """F_m: what is left of light that the lobe scatters more than once."""
    coat_multiple: float
    """F_m of a dielectric."""
    albedo: wp.vec2
    """The table's entry for the outgoing direction."""
    mean: wp.vec2
    """The table's mean."""
    gloss_share: float
    """How often a direction is drawn from the GGX lobe; else from the cosine."""


@wp.func
def gloss_albedo(gloss: Gloss, roughness: float, cosine: float) -> wp.vec2:
    """The table at a roughness and a cosine, bilinear in roughness and in the cosine's root."""
    y = wp.clamp(roughness, 0.0, 1.0) * float(GLOSS_ROWS - 1)
    x = wp.sqrt(wp.clamp(cosine, 0.0, 1.0)) * float(GLOSS_COLUMNS - 1)
    row = wp.min(int(y), GLOSS_ROWS - 2)
    column = wp.min(int(x), GLOSS_COLUMNS - 2)
    right = x - float(column)
    return wp.lerp(
        wp.lerp(gloss.albedo[row, column], gloss.albedo[row, column + 1], right),
        wp.lerp(gloss.albedo[row + 1, column], gloss.albedo[row + 1, column + 1], right),
        y - float(row),
    )


@wp.func
def gloss_mean(gloss: Gloss, roughness: float) -> wp.vec2:
    """The table's mean at a roughness."""
    y = wp.clamp(roughness, 0.0, 1.0) * float(GLOSS_ROWS - 1)
    row = wp.min(int(y), GLOSS_ROWS - 2)
    return wp.lerp(gloss.mean[row], gloss.mean[row + 1], y - float(row))


@wp.func
def multiple_share(kept: float, reflectance: float) -> float:
    """F_m for the table's mean albedo `kept`: light meets the facets k > 1 times with chance ∝ (1 - Ē)^(k - 1), and F̄ stays each time.

    Schlick's term averages to F̄ = F₀ + (1 - F₀) / 21. The sum begins at the second time, hence the square (Hill, 2018).
    """
    average = (20.0 * reflectance + 1.0) / 21.0
    return average * average * kept / (1.0 - (1.0 - kept) * average)


@wp.func
def coat_share(brdf: Brdf, albedo: wp.vec2) -> float:
    """E_d: what all gloss of a dielectric reflects where the table says `albedo`."""
    return albedo[0] * DIELECTRIC + albedo[1] + (1.0 - albedo[0] - albedo[1]) * brdf.coat_multiple


@wp.func
def even_gloss(brdf: Brdf) -> wp.vec3:
    """Share of even light from everywhere that the gloss reflects to where it is seen from, however often it scatters it."""
    once = brdf.albedo[0] * brdf.reflectance + wp.vec3(brdf.albedo[1], brdf.albedo[1], brdf.albedo[1])
    return once + (1.0 - brdf.albedo[0] - brdf.albedo[1]) * brdf.multiple


@wp.func
def mean_of(color: wp.vec3) -> float:
    return (color[0] + color[1] + color[2]) / 3.0


@wp.func
def facing(normal: wp.vec3, outgoing: wp.vec3) -> wp.vec3:
    """`normal`, bent towards `outgoing` as far as it takes to see its front: interpolated normals turn away at silhouettes."""
    cosine = wp.dot(normal, outgoing)
    if cosine >= LEAST_FACING:
        return normal
    return wp.normalize(normal + (LEAST_FACING - cosine) * outgoing)


@wp.func
def brdf_at(gloss: Gloss, base: wp.vec3, metallic: float, roughness: float, normal: wp.vec3, outgoing: wp.vec3) -> Brdf:
    """A surface of linear base colour `base`, seen from `outgoing`; `normal` points to the same side."""
    made = Brdf()
    made.normal = facing(normal, outgoing)
    made.tangent = around(made.normal, wp.vec3(1.0, 0.0, 0.0))
    made.bitangent = around(made.normal, wp.vec3(0.0, 1.0, 0.0))
    made.outgoing = outgoing
    made.roughness = roughness
    made.alpha = wp.clamp(roughness * roughness, MIN_ALPHA, 1.0)
    made.reflectance = wp.lerp(wp.vec3(DIELECTRIC, DIELECTRIC, DIELECTRIC), base, metallic)
    made.diffuse = (1.0 - metallic) * base
    made.albedo = gloss_albedo(gloss, roughness, wp.dot(made.normal, outgoing))
    made.mean = gloss_mean(gloss, roughness)
    kept = made.mean[0] + made.mean[1]
    made.coat_multiple = multiple_share(kept, DIELECTRIC)
    metal = wp.vec3(multiple_share(kept, base[0]), multiple_share(kept, base[1]), multiple_share(kept, base[2]))
    made.multiple = wp.lerp(wp.vec3(made.coat_multiple, made.coat_multiple, made.coat_multiple), metal, metallic)
    single = made.albedo[0] * mean_of(made.reflectance) + made.albedo[1]
    rest = (1.0 - made.albedo[0] - made.albedo[1]) * mean_of(made.multiple)
    rest += (1.0 - coat_share(made, made.albedo)) * mean_of(made.diffuse)
    made.gloss_share = 1.0
    if rest > 0.0:
        made.gloss_share = wp.clamp(single / (single + rest), LEAST_SHARE, 1.0 - LEAST_SHARE)
    return made


@wp.func
def to_local(brdf: Brdf, direction: wp.vec3) -> wp.vec3:
    """A direction in the frame whose z is the normal."""
    return wp.vec3(wp.dot(direction, brdf.tangent), wp.dot(direction, brdf.bitangent), wp.dot(direction, brdf.normal))


@wp.func
def smith(cosine: float, alpha: float) -> float:
    """1 + 2 Λ of GGX: masking alone is 2 / (1 + smith), both ways, correlated in height, it is 2 / (smith_i + smith_o)."""
    a2 = alpha * alpha
    c2 = wp.max(cosine * cosine, MIN_COSINE * MIN_COSINE)
    return wp.sqrt(1.0 + a2 * wp.max(1.0 - c2, 0.0) / c2)


@wp.func
def facets(half_way: wp.vec3, alpha: float) -> float:
    """D of GGX: density of microfacets about a local half vector."""
    a2 = alpha * alpha
    spread = (half_way[0] * half_way[0] + half_way[1] * half_way[1]) + a2 * half_way[2] * half_way[2]
    return a2 / (wp.PI * spread * spread)


@wp.func
def facets_towards_disc(half_way: wp.vec3, alpha: float, radius: float) -> float:
    """Mean D of GGX over half vectors whose slopes lie in a disc of this radius about a local one's; `facets` if the radius is 0.

    Over slopes GGX is the even distribution on a sphere in stereographic projection, which turns discs into caps, whose area is known.
    """
    c2 = wp.max(half_way[2] * half_way[2], MIN_COSINE)
    away = (half_way[0] * half_way[0] + half_way[1] * half_way[1]) / (c2 * alpha * alpha)
    wide = radius * radius / (alpha * alpha)
    near = 1.0 + away - wide
    root = wp.sqrt(near * near + 4.0 * wide)
    if near >= 0.0:
        return 2.0 / (wp.PI * alpha * alpha * c2 * c2 * root * (root + near))
    return (root - near) / (2.0 * wp.PI * radius * radius * c2 * c2 * root)


@wp.func
def schlick(cosine: float) -> float:
    """Share by which F rises from F₀ to 1."""
    x = wp.clamp(1.0 - cosine, 0.0, 1.0)
    x2 = x * x
    return x2 * x2 * x


@wp.func
def visible_facet(outgoing: wp.vec3, alpha: float, u: wp.vec2) -> wp.vec3:
    """Local normal of a microfacet that is seen from the local direction `outgoing`, by its visible area (Dupuy and Benyoub, 2023)."""
    seen = wp.normalize(wp.vec3(alpha * outgoing[0], alpha * outgoing[1], outgoing[2]))
    angle = wp.TAU * u[0]
    z = (1.0 - u[1]) * (1.0 + seen[2]) - seen[2]
    radius = wp.sqrt(wp.clamp(1.0 - z * z, 0.0, 1.0))
    h = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), z) + seen
    return wp.normalize(wp.vec3(alpha * h[0], alpha * h[1], wp.max(h[2], LEAST_RISE)))


@wp.struct
class Reflection:
    """f times the cosine to where light comes from, in two parts: diffuse color times `diffuse`, plus `gloss` [1/sr]."""

    diffuse: float
    gloss: wp.vec3


@wp.func
def reflected_parts(gloss: Gloss, brdf: Brdf, i: wp.vec3, o: wp.vec3, half_way: wp.vec3, density: float) -> Reflection:
    """How much of the light from the local direction i a surface reflects to o, with `density` of facets about the half vector."""
    made = Reflection()
    one = wp.vec3(1.0, 1.0, 1.0)
    fresnel = brdf.reflectance + schlick(wp.dot(o, half_way)) * (one - brdf.reflectance)
    masking = 2.0 / (smith(i[2], brdf.alpha) + smith(o[2], brdf.alpha))
    single = density * masking / (4.0 * wp.max(o[2], MIN_COSINE)) * fresnel

    albedo = gloss_albedo(gloss, brdf.roughness, i[2])
    lost = (1.0 - albedo[0] - albedo[1]) * (1.0 - brdf.albedo[0] - brdf.albedo[1]) / wp.max(1.0 - brdf.mean[0] - brdf.mean[1], LEAST_LOST)
    through = (1.0 - coat_share(brdf, albedo)) * (1.0 - coat_share(brdf, brdf.albedo)) / (1.0 - coat_share(brdf, brdf.mean))
    made.gloss = single + (i[2] / wp.PI * lost) * brdf.multiple
    made.diffuse = i[2] / wp.PI * through
    return made


@wp.func
def evaluate_parts(gloss: Gloss, brdf: Brdf, incoming: wp.vec3) -> Reflection:
    """How much of the light from `incoming` a surface reflects; none below the surface."""
    i = to_local(brdf, incoming)
    o = to_local(brdf, brdf.outgoing)
    if i[2] <= 0.0 or o[2] <= 0.0:
        return Reflection()
    half_way = wp.normalize(i + o)
    return reflected_parts(gloss, brdf, i, o, half_way, facets(half_way, brdf.alpha))


@wp.func
def evaluate_disc(gloss: Gloss, brdf: Brdf, middle: wp.vec3, spread: float) -> wp.vec3:
    """Mean over a disc of directions about `middle` of f times the cosine; `spread` is the tangent of its angular radius, and small.

    The half vectors of a disc fill an ellipse, for which a disc of the same area stands: wide lamps seen from cosines below 0.5 in sharp
    gloss shine too bright in the highlight's middle, too dark at its side.
    """
    i = to_local(brdf, middle)
    o = to_local(brdf, brdf.outgoing)
    if i[2] <= 0.0 or o[2] <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    half_way = wp.normalize(i + o)
    # Half vectors turn by half the angle in the plane of both directions, by more across it; slopes change by more than angles do.
    radius = 0.5 * spread / wp.sqrt(wp.max(wp.dot(o, half_way) * half_way[2] * half_way[2] * half_way[2], MIN_COSINE))
    parts = reflected_parts(gloss, brdf, i, o, half_way, facets_towards_disc(half_way, brdf.alpha, radius))
    return parts.gloss + parts.diffuse * brdf.diffuse


@wp.func
def density(brdf: Brdf, incoming: wp.vec3) -> float:
    """Probability per solid angle with which `scatter` gives a direction [1/sr]."""
    i = to_local(brdf, incoming)
    o = to_local(brdf, brdf.outgoing)
    if i[2] <= 0.0:
        return 0.0
    half_way = wp.normalize(i + o)
    visible = facets(half_way, brdf.alpha) / (2.0 * wp.max(o[2], MIN_COSINE) * (1.0 + smith(o[2], brdf.alpha)))
    return brdf.gloss_share * visible + (1.0 - brdf.gloss_share) * i[2] / wp.PI


@wp.func
def scatter(brdf: Brdf, choice: float, u: wp.vec2) -> wp.vec3:
    """A direction from which light may come, drawn from three numbers in [0, 1); below the surface: none."""
    o = to_local(brdf, brdf.outgoing)
    i = wp.vec3(0.0, 0.0, 1.0)
    if choice < brdf.gloss_share:
        facet = visible_facet(o, brdf.alpha, u)
        i = 2.0 * wp.dot(o, facet) * facet - o
    else:
        radius = wp.sqrt(u[0])
        angle = wp.TAU * u[1]
        i = wp.vec3(radius * wp.cos(angle), radius * wp.sin(angle), wp.sqrt(wp.max(1.0 - u[0], 0.0)))
    return wp.normalize(i[0] * brdf.tangent + i[1] * brdf.bitangent + i[2] * brdf.normal)


@wp.kernel
def measure_gloss_kernel(
    # Out:
    albedo_out: wp.array2d[wp.vec2],
):
    """Albedo of the lobe at each roughness and cosine: the mean of (1 - s, s) G₂ / G₁ over visible facets, s Schlick's term."""
    row, column = wp.tid()
    roughness = float(row) / float(GLOSS_ROWS - 1)
    root = float(column) / float(GLOSS_COLUMNS - 1)
    alpha = wp.clamp(roughness * roughness, MIN_ALPHA, 1.0)
    cosine = wp.max(root * root, MIN_COSINE)
    o = wp.vec3(wp.sqrt(wp.max(1.0 - cosine * cosine, 0.0)), 0.0, cosine)
    total = wp.vec2(0.0, 0.0)
    for number in range(GLOSS_SAMPLES):
        facet = visible_facet(o, alpha, sobol_point(number))
        slope = wp.dot(o, facet)
        i = 2.0 * slope * facet - o
        if i[2] > 0.0:
            kept = (1.0 + smith(cosine, alpha)) / (smith(i[2], alpha) + smith(cosine, alpha))
            rise = schlick(slope)
            total += kept * wp.vec2(1.0 - rise, rise)
    albedo_out[row, column] = total / float(GLOSS_SAMPLES)
