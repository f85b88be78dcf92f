"""Path tracer: paths from the camera that scatter at surfaces until they leave the scene for the environment map.

A pixel's radiance is the mean over N paths of Σ_k T_k (w_l f_l L_l / p_l + w_s f_s L_s / p_s). At surface k, one direction l is sampled by
the map's radiance (next-event estimation) and one, s, by the BRDF. f: BRDF times cosine in that direction; L: the map's radiance there, 0
if another surface is hit; p: density of the sampling. T_k, the throughput, is the product of f_s / p_s of the surfaces before. w: weights
of multiple importance sampling by the power heuristic (Veach, 1997), w_l = p_l² / (p_l² + q²), q the BRDF's density for l. Surfaces that
emit light are not sampled: paths that come upon them add T_k times their emission.

`trace_paths_kernel` is the path-traced reference; `coarse` uses the same functions with a few paths per pixel of a smaller image.
"""

from typing import Any

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.lighting.brdf import Brdf, BrdfValue, SplitRadiance, brdf_pdf, evaluate_brdf, sample_brdf
from synpick_warp.kernels.render.lighting.environment import Lights, environment_radiance, rotate_z
from synpick_warp.kernels.render.lighting.finish import FinishedBrdf
from synpick_warp.kernels.render.lighting.materials import brdf_of, interpolate_surface, make_table_surface, map_table, material_at, wear_at
from synpick_warp.kernels.render.lighting.sampling import (
    EnvironmentCdf,
    EnvironmentSample,
    environment_pdf,
    sample_environment,
    scrambled_point,
)
from synpick_warp.kernels.render.lighting.surfaces import AnySurfaces, FinishedSurfaces, RandomizedSurfaces, Surfaces, add_emission
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET, hit_table, is_blocked, trace_camera_ray, trace_ray
from synpick_warp.kernels.render.visibility.camera import camera_ray, hit_position, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import FAR, AnyShot, Hit, Meshes, ShadedImage, Table, body_of
from synpick_warp.kernels.render.visibility.variants import VARIANTS, kernel_of_views, variant_of
from synpick_warp.kernels.rng import mix, stream_key

wp.set_module_options({"enable_backward": False})

COMBINED = wp.constant(0)
LIGHT_SAMPLING = wp.constant(1)
BRDF_SAMPLING = wp.constant(2)
"""Sampling strategies of light: both combined by MIS, or one alone, which has the same mean and more noise and serves as a check."""
MAX_SURVIVAL = wp.constant(0.95)
"""Russian roulette: largest survival probability, so that every path ends."""
BELOW_ONE = wp.constant(0.99999994)
"""The largest float32 below 1."""
DIMENSIONS_PER_BOUNCE = wp.constant(3)
"""Two-dimensional sample points that a bounce consumes: light direction, BRDF direction, (lobe choice, Russian roulette)."""
TERMINATED = wp.constant(-1)
"""Value of `Path.bounce` when the path has ended."""
FOOTPRINT_GROWTH = wp.constant(0.1)
"""Growth of a path's footprint per metre [m/m] after a bounce at roughness 1, so that later textures are read from coarse mip levels."""


@wp.struct
class PathScene:
    """Geometry, materials and environment maps that paths interact with. Constant."""

    meshes: Meshes
    table: Table
    surfaces: Surfaces
    lights: Lights
    cdf: EnvironmentCdf
    """Rows are those of `Lights.radiance`."""


RandomizedScene = variant_of(PathScene, "RandomizedScene", surfaces=RandomizedSurfaces)
"""Scene with domain randomization: materials are sampled for each episode."""
FinishedScene = variant_of(PathScene, "FinishedScene", surfaces=FinishedSurfaces)
"""The same, with clear coats and anisotropy."""
AnyScene = Any
"""`PathScene`, `RandomizedScene` or `FinishedScene`: functions are compiled for each; see `variants`."""
VARIANTS["scene"] = PathScene, RandomizedScene, FinishedScene


@wp.struct
class PathRules:
    """Numbers of paths and bounces, Russian roulette, sampling strategy, roughness and firefly limits, and the seed of the path tracer."""

    samples: int
    """Paths per pixel, or per coarse pixel."""
    first_samples: int
    """Paths per coarse pixel in the first frame of an episode, if light is accumulated over frames (`LightHistory`); at least `samples`."""
    bounces: int
    """Largest number of surfaces at which a path scatters."""
    roulette: int
    """First bounce, counted from 0, with Russian roulette: dim paths end early, survivors are weighted up."""
    strategy: int
    """COMBINED, LIGHT_SAMPLING or BRDF_SAMPLING."""
    min_roughness: float
    """Path regularization: smallest roughness of surfaces after the first. Caustics through two mirrors are rare, bright and noisy."""
    firefly_clamp: float
    """Upper limit of a path's light in `coarse`, in units of what the surface would reflect of the map without occluders (`clamp_path`)."""
    seed: wp.uint64


@wp.struct
class PathContext:
    """Constants of all paths of one pixel: its view, its light, its stream of random numbers."""

    view: int
    first_light: int
    """Environment map for the first surface, row of `Lights.radiance`; `coarse` takes the one without lamps, whose light is added apart."""
    light: int
    """Environment map for all other surfaces: row of `Lights.radiance`."""
    yaw: float
    """Rotation of the map about +z [rad]."""
    key: wp.uint64
    """Key of the scrambled Sobol' points."""
    shift: wp.vec2
    """Cranley-Patterson rotation: sample points of dimension d are shifted by d · shift, modulo 1."""


@wp.struct
class Throughput:
    """Path throughput: product of BRDF, cosine and 1 / pdf, split by the lobe of the first surface.

    The diffuse part excludes the diffuse colour of that surface.
    """

    diffuse: wp.vec3
    specular: wp.vec3


@wp.struct
class Vertex:
    """Path vertex: origin of the next rays, geometric normal and BRDF of a surface that a path hit."""

    origin: wp.vec3
    """Origin of rays that leave the surface, in the world [m]."""
    face_normal: wp.vec3
    """Geometric normal, in the world, on the side of the incoming ray."""
    brdf: Brdf
    emission: wp.vec3
    """As in `SurfaceMaterial`."""


FinishedVertex = variant_of(Vertex, "FinishedVertex", brdf=FinishedBrdf)
"""The same of `FinishedScene`; functions are compiled for each type of `vertex`."""


@wp.func
def new_vertex(surfaces: AnySurfaces) -> Vertex:
    """Empty vertex of a scene."""
    return Vertex()


@wp.func
def new_vertex(surfaces: FinishedSurfaces) -> FinishedVertex:  # noqa: F811
    """Empty vertex of a scene."""
    return FinishedVertex()


@wp.struct
class Path:
    """State of a path between two bounces: radiance so far, throughput, and the last hit."""

    radiance: SplitRadiance
    throughput: Throughput
    hit: Hit
    """Last hit, at which the path scatters next; not set before the first bounce."""
    position: wp.vec3
    """Position of the last hit, in the world [m]."""
    direction: wp.vec3
    """Unit direction of the ray to the last hit."""
    bounce: int
    """Bounces so far, or TERMINATED."""
    width: float
    """Width of the path's footprint at the last vertex [m]."""


@wp.func
def make_vertex(
    scene: AnyScene,
    shot: AnyShot,
    view: int,
    hit: Hit,
    position: wp.vec3,
    outgoing: wp.vec3,
    width: float,
    min_roughness: float,
    is_mean: bool,
):
    """Build the path vertex at a hit. `outgoing`: direction back along the ray. `width`: footprint across the ray [m]. `is_mean`: use the
    surface's mean wear instead of its noise pattern, which costs more than tracing the ray; set after the first bounce."""
    bodies = shot.bodies
    surface = make_table_surface(scene.meshes, scene.surfaces, bodies, view, outgoing)
    at = position
    if hit.segment != Segment.TABLE:
        body = body_of(hit.segment, shot.views.instances)
        surface = interpolate_surface(scene.meshes, scene.surfaces, bodies, view, body, hit.triangle, hit.barycentric, outgoing, width)
    else:
        # Exactly on the table: far away, float32 rounding moves a hit off its plane by more than RAY_OFFSET.
        at = wp.vec3(position[0], position[1], scene.table.height)
        surface = map_table(scene.surfaces, surface, at, outgoing, width)
    vertex = new_vertex(scene.surfaces)
    vertex.origin = at + RAY_OFFSET * surface.face_normal
    vertex.face_normal = surface.face_normal
    material = material_at(scene.surfaces, surface, wear_at(scene.surfaces, surface, is_mean))
    vertex.emission = material.emission
    roughness = wp.max(material.roughness, min_roughness)
    vertex.brdf = brdf_of(scene.surfaces, surface, material, roughness, outgoing, min_roughness)
    return vertex


@wp.func
def mis_weight(strategy: int, own: int, own_pdf: float, other_pdf: float) -> float:
    """MIS weight of a direction sampled by strategy `own`: the power heuristic, or 1 and 0 if `strategy` uses one of them alone."""
    if strategy == COMBINED:
        ratio = other_pdf / own_pdf
        return 1.0 / (1.0 + ratio * ratio)
    if strategy == own:
        return 1.0
    return 0.0


@wp.func
def extend_throughput(throughput: Throughput, value: BrdfValue, color: wp.vec3, bounce: int) -> Throughput:
    """Multiply the throughput by BRDF · cosine (`value`) of one more surface, of diffuse colour `color`. Only the first splits lobes."""
    result = Throughput()
    if bounce == 0:
        result.diffuse = wp.vec3(value.diffuse, value.diffuse, value.diffuse)
        result.specular = value.specular
    else:
        both = value.specular + value.diffuse * color
        result.diffuse = wp.cw_mul(throughput.diffuse, both)
        result.specular = wp.cw_mul(throughput.specular, both)
    return result


@wp.func
def add_light(total: SplitRadiance, throughput: Throughput, radiance: wp.vec3, bounce: int) -> SplitRadiance:
    """Add light that arrives after `bounce` + 1 surfaces. Light of the diffuse lobe after the first bounce is `indirect`."""
    result = total
    result.specular += wp.cw_mul(throughput.specular, radiance)
    if bounce == 0:
        result.diffuse += wp.cw_mul(throughput.diffuse, radiance)
    else:
        result.indirect += wp.cw_mul(throughput.diffuse, radiance)
    return result


@wp.func
def meet_emission(surfaces: Surfaces, path: Path, emission: wp.vec3, exposure: float) -> SplitRadiance:
    """Radiance of a path at a surface of a scene without emissive materials: unchanged."""
    return path.radiance


@wp.func
def meet_emission(surfaces: AnySurfaces, path: Path, emission: wp.vec3, exposure: float) -> SplitRadiance:  # noqa: F811
    """Radiance of a path with what the last surface emits, as light from other surfaces. What the camera sees is added apart."""
    if path.bounce == 0 or wp.max(emission) == 0.0:
        return path.radiance
    return add_light(path.radiance, path.throughput, emission / exposure, path.bounce)


@wp.func
def sample_point(context: PathContext, index: int, dimension: int) -> wp.vec2:
    """Sample point in [0, 1)² of path `index`, pair `dimension` of its random numbers: scrambled Sobol' with Cranley-Patterson rotation."""
    point = scrambled_point(context.key, index, dimension)
    x = point[0] + context.shift[0] * float(dimension)
    y = point[1] + context.shift[1] * float(dimension)
    return wp.vec2(wp.min(x - wp.floor(x), BELOW_ONE), wp.min(y - wp.floor(y), BELOW_ONE))


@wp.func
def sample_direct_light(
    scene: AnyScene, shot: AnyShot, rules: PathRules, context: PathContext, light: int, vertex: Any, u: wp.vec2
) -> EnvironmentSample:
    """Next-event estimation: sample a direction of the map and test it by a shadow ray.

    The result's direction is in the world, its radiance is the map's over the pdf and times the MIS weight; 0: blocked. Light from behind
    the triangle counts as blocked, whatever the interpolated normal says.
    """
    sample = sample_environment(scene.cdf, light, u)
    result = EnvironmentSample()
    result.direction = rotate_z(sample.direction, context.yaw)
    if sample.pdf <= 0.0 or wp.dot(result.direction, vertex.face_normal) <= 0.0:
        return result
    weight = mis_weight(rules.strategy, LIGHT_SAMPLING, sample.pdf, brdf_pdf(vertex.brdf, result.direction)) / sample.pdf
    if weight <= 0.0 or wp.dot(result.direction, vertex.brdf.normal) <= 0.0:
        return result
    if is_blocked(scene.meshes, scene.table, shot.bodies, context.view, -1, vertex.origin, result.direction, FAR):
        return result
    result.radiance = weight * environment_radiance(scene.lights, light, sample.direction)
    return result


@wp.func
def escaped_radiance(scene: AnyScene, rules: PathRules, context: PathContext, light: int, direction: wp.vec3, pdf: float) -> wp.vec3:
    """Radiance of the map for a path that left the scene, times its MIS weight; `pdf` is the BRDF's for `direction`."""
    local = rotate_z(direction, -context.yaw)
    radiance = environment_radiance(scene.lights, light, local)
    return mis_weight(rules.strategy, BRDF_SAMPLING, pdf, environment_pdf(scene.cdf, light, local)) * radiance


@wp.func
def pixel_context(shot: AnyShot, rules: PathRules, view: int, row: int, column: int) -> PathContext:
    """Path constants of a pixel of the reference renderer: one environment map, lamps included, for all bounces."""
    snapshot, views = shot.snapshot, shot.views
    world = views.world[view]
    context = PathContext()
    context.view = view
    context.first_light = snapshot.light[world]
    context.light = snapshot.light[world]
    context.yaw = snapshot.light_yaw[world]
    pixel = (views.camera[view] * shot.grid.height + row) * shot.grid.width + column
    context.key = mix(stream_key(rules.seed, snapshot.episode[world], 0, Stream.PATHS) ^ wp.uint64(pixel))
    return context


@wp.func
def init_path(width: float) -> Path:
    """Start a path at the surface that the camera sees; `width` is its footprint's there [m]."""
    path = Path()
    path.width = width
    return path


@wp.func
def next_vertex(scene: AnyScene, shot: AnyShot, rules: PathRules, context: PathContext, path: Path):
    """Build the vertex at the last hit of a path that goes on."""
    return make_vertex(scene, shot, context.view, path.hit, path.position, -path.direction, path.width, rules.min_roughness, True)


@wp.func
def extend_path(
    scene: AnyScene, shot: AnyShot, rules: PathRules, context: PathContext, index: int, first_diffuse: wp.vec3, path: Path, vertex: Any
) -> Path:
    """Scatter path `index` once at its last `vertex`: add the direct light there, then move the path to the next hit or terminate it.
    `first_diffuse` is the diffuse colour of the path's first surface, which multiplies all its diffuse light in the end."""
    bounce = path.bounce
    light = context.light
    if bounce == 0:
        light = context.first_light
    result = path
    result.radiance = meet_emission(scene.surfaces, path, vertex.emission, scene.lights.exposure[context.light])
    result.bounce = TERMINATED
    dimension = 1 + DIMENSIONS_PER_BOUNCE * bounce
    direct = sample_direct_light(scene, shot, rules, context, light, vertex, sample_point(context, index, dimension))
    if wp.max(direct.radiance) > 0.0:
        value = evaluate_brdf(scene.surfaces.albedo, vertex.brdf, direct.direction)
        throughput = extend_throughput(path.throughput, value, vertex.brdf.diffuse, bounce)
        result.radiance = add_light(result.radiance, throughput, direct.radiance, bounce)

    choice = sample_point(context, index, dimension + 2)
    direction = sample_brdf(vertex.brdf, choice[0], sample_point(context, index, dimension + 1))
    pdf = brdf_pdf(vertex.brdf, direction)
    if pdf <= 0.0 or wp.dot(direction, vertex.face_normal) <= 0.0:
        return result
    value = evaluate_brdf(scene.surfaces.albedo, vertex.brdf, direction)
    throughput = extend_throughput(path.throughput, value, vertex.brdf.diffuse, bounce)
    scale = 1.0 / pdf
    if bounce >= rules.roulette:
        survival = wp.min(scale * wp.max(wp.cw_mul(first_diffuse, throughput.diffuse) + throughput.specular), MAX_SURVIVAL)
        if choice[1] >= survival:
            return result
        scale = scale / survival
    throughput.diffuse = throughput.diffuse * scale
    throughput.specular = throughput.specular * scale
    hit = trace_ray(scene.meshes, scene.table, shot.bodies, context.view, shot.views.instances, vertex.origin, direction)
    if hit.segment == Segment.NOTHING:
        radiance = escaped_radiance(scene, rules, context, light, direction, pdf)
        result.radiance = add_light(result.radiance, throughput, radiance, bounce)
        return result
    if bounce + 1 == rules.bounces:
        return result
    result.throughput = throughput
    result.width = path.width + FOOTPRINT_GROWTH * vertex.brdf.roughness * hit.depth
    result.hit = hit
    result.position = vertex.origin + hit.depth * direction
    result.direction = direction
    result.bounce = bounce + 1
    return result


@kernel_of_views
def trace_paths_kernel(scene: AnyScene, shot: AnyShot, rules: PathRules, first: int, image_out: ShadedImage):
    """Path-traced reference: mean radiance of N paths per pixel, with stratified start points in the pixel (box filter).

    Random numbers are addressed by (seed, episode; camera and pixel; path, dimension): a still scene gives the same image again. Launched
    over view, pixel (tile order, from flat index `first` on).
    """
    grid, views = shot.grid, shot.views
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    context = pixel_context(shot, rules, view, row, column)
    footprint = 1.0 / (views.cameras.intrinsics[view][0] * wp.sqrt(float(rules.samples)))
    total = wp.vec3(0.0, 0.0, 0.0)
    for index in range(rules.samples):
        offset = scrambled_point(context.key, index, 0) - wp.vec2(0.5, 0.5)
        ray = camera_ray(views.cameras, view, row, column, offset)
        hit = trace_camera_ray(scene.meshes, shot.bodies, view, tile_of(grid, row, column), ray, views.instances)
        hit = hit_table(scene.table, views.cameras, view, ray, hit)
        direction = wp.normalize(views.cameras.to_world[view] * ray)
        if hit.segment == Segment.NOTHING:
            total += environment_radiance(scene.lights, context.light, rotate_z(direction, -context.yaw))
        else:
            start = hit_position(views.cameras, view, ray, hit.depth)
            width = footprint * hit.depth
            vertex = make_vertex(scene, shot, view, hit, start, -direction, width, 0.0, False)
            total = add_emission(scene.surfaces, total, vertex.emission, scene.lights.exposure[context.light])
            diffuse = vertex.brdf.diffuse
            path = init_path(width)
            while path.bounce != TERMINATED:
                if path.bounce > 0:
                    vertex = next_vertex(scene, shot, rules, context, path)
                path = extend_path(scene, shot, rules, context, index, diffuse, path, vertex)
            total += wp.cw_mul(diffuse, path.radiance.diffuse + path.radiance.indirect) + path.radiance.specular
    image_out.radiance[view, row, column] = total / float(rules.samples)
