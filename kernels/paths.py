"""The reference picture: paths from the camera that scatter at surfaces until they leave the scene for the light map.

A pixel's radiance is the mean over N paths of Σ_k T_k (w_l f L / p_l + w_s L_s), T the product of f cos / p along the path: at each surface
one direction is drawn by the map's radiance and one by the surface's own law, weighted by the power heuristic (Veach, 1997),
w_l = p_l² / (p_l² + p_s²). Nothing in the scene glows but the map.
"""

import warp as wp

from synpick_warp.kernels.brdf import Brdf, brdf_at, density, evaluate, scatter
from synpick_warp.kernels.camera_rays import Cameras, ImageGrid, camera_ray, tile_pixel
from synpick_warp.kernels.draws import PATHS, mix, stream_key
from synpick_warp.kernels.environment import Lights, background_radiance, turned
from synpick_warp.kernels.hits import (
    FAR,
    FIRST_FIXTURE,
    NOTHING,
    TABLE,
    Bodies,
    Hit,
    Meshes,
    Table,
    body_of,
    hit_table,
    is_blocked,
    trace_camera_ray,
)
from synpick_warp.kernels.occlusion import RAY_OFFSET, hit_position
from synpick_warp.kernels.sampling import Chances, light_density, sample_light, scrambled_point
from synpick_warp.kernels.surfaces import Surfaces, base_color, mesh_surface, table_surface

wp.set_module_options({"enable_backward": False})

BOTH = wp.constant(0)
BY_LIGHT = wp.constant(1)
BY_SURFACE = wp.constant(2)
"""How directions to the light are drawn. One way alone has the same mean and more noise: it serves to check the other."""
MOST_LUCK = wp.constant(0.95)
"""Largest chance of a path to go on, so that all end."""
DIMENSIONS = wp.constant(3)
"""Points in the unit square that a scattering takes: light, surface, and (lobe, roulette)."""
SCATTERED_SPREAD = wp.constant(0.1)
"""A path's width grows by this much per metre [m/m] after it met a rough surface, so that textures it meets later are read coarsely."""


@wp.struct
class PathScene:
    """What rays meet. Constant."""

    meshes: Meshes
    table: Table
    surfaces: Surfaces
    lights: Lights
    chances: Chances


@wp.struct
class PathRules:
    """How paths are drawn."""

    samples: int
    """Paths a pixel."""
    bounces: int
    """Most surfaces at which a path scatters."""
    roulette: int
    """From this scattering on, the first being 0, dim paths end early, and those that go on count for them."""
    strategy: int
    """BOTH, BY_LIGHT or BY_SURFACE."""
    seed: wp.uint64
    instances: int


@wp.struct
class Place:
    """Where one pixel's paths are: the world's light, the view's bodies, the stream of random numbers."""

    view: int
    light: int
    turn: float
    key: wp.uint64


@wp.struct
class Vertex:
    """A surface that a path met."""

    origin: wp.vec3
    """Where rays leave it, in the world [m]."""
    face_normal: wp.vec3
    brdf: Brdf


@wp.func
def nearest_hit(scene: PathScene, bodies: Bodies, view: int, instances: int, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """The nearest hit of a ray along a unit vector, all in the world; `depth` is the distance [m]. The companion of `is_blocked`."""
    best = Hit()
    best.code = NOTHING
    best.depth = FAR
    height = origin[2] - scene.table.height
    if scene.table.visible != 0 and direction[2] * height < 0.0:
        best.code = TABLE
        best.depth = -height / direction[2]
    for body in range(instances + 3):
        sphere = bodies.sphere[view, body]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
        closest = offset - wp.clamp(wp.dot(offset, direction), 0.0, best.depth) * direction
        if wp.dot(closest, closest) < sphere[3]:
            turn = bodies.world_turn[view, body]
            query = wp.mesh_query_ray(
                scene.meshes.id[bodies.mesh[view, body]], turn * (origin - bodies.position[view, body]), turn * direction, best.depth
            )
            if query.result:
                best.depth = query.t
                best.triangle = query.face
                best.barycentric = wp.vec2(query.u, query.v)
                best.code = body + 1
                if body >= instances:
                    best.code = FIRST_FIXTURE + body - instances
    return best


@wp.func
def vertex_at(
    scene: PathScene, bodies: Bodies, view: int, instances: int, hit: Hit, position: wp.vec3, outgoing: wp.vec3, width: float
) -> Vertex:
    """The surface at a hit; `width` [m] is the path's there, across it."""
    surface = table_surface(scene.meshes, outgoing)
    at = position
    if hit.code == TABLE:
        # Far away, rounding would lift or sink it by more than the rays' offset.
        at = wp.vec3(position[0], position[1], scene.table.height)
    else:
        body = body_of(hit.code, instances)
        surface = mesh_surface(scene.meshes, scene.surfaces, bodies, view, body, hit.triangle, hit.barycentric, outgoing, width)
    made = Vertex()
    made.origin = at + RAY_OFFSET * surface.face_normal
    made.face_normal = surface.face_normal
    metallic = scene.surfaces.metallic[surface.row]
    roughness = scene.surfaces.roughness[surface.row]
    made.brdf = brdf_at(scene.surfaces.gloss, base_color(scene.surfaces, surface), metallic, roughness, surface.normal, outgoing)
    return made


@wp.func
def heuristic(strategy: int, own: int, density_own: float, density_other: float) -> float:
    """Weight of a direction drawn in the way `own`: the power heuristic, or all or nothing where one way alone is asked for."""
    if strategy == BOTH:
        ratio = density_other / density_own
        return 1.0 / (1.0 + ratio * ratio)
    if strategy == own:
        return 1.0
    return 0.0


@wp.func
def direct_light(scene: PathScene, bodies: Bodies, rules: PathRules, place: Place, vertex: Vertex, u: wp.vec2) -> wp.vec3:
    """What the map sends straight to a surface and on along its path, by one direction drawn from the map, with its weight.

    Light that comes from behind the triangle is none, whatever the interpolated normal says.
    """
    drawn = sample_light(scene.chances, place.light, u)
    direction = turned(drawn.direction, place.turn)
    nothing = wp.vec3(0.0, 0.0, 0.0)
    if drawn.density <= 0.0 or wp.dot(direction, vertex.face_normal) <= 0.0:
        return nothing
    reflected = evaluate(scene.surfaces.gloss, vertex.brdf, direction)
    weight = heuristic(rules.strategy, BY_LIGHT, drawn.density, density(vertex.brdf, direction)) / drawn.density
    if weight * wp.max(reflected) <= 0.0:
        return nothing
    if is_blocked(scene.meshes, scene.table, bodies, place.view, rules.instances, vertex.origin, direction, FAR):
        return nothing
    return weight * wp.cw_mul(reflected, background_radiance(scene.lights, place.light, drawn.direction))


@wp.func
def escaped_light(scene: PathScene, rules: PathRules, place: Place, direction: wp.vec3, bounce: int, drawn_density: float) -> wp.vec3:
    """What the map sends along a path that left the scene, weighted against drawing the same direction from the map."""
    local = turned(direction, -place.turn)
    radiance = background_radiance(scene.lights, place.light, local)
    if bounce == 0:
        return radiance
    return heuristic(rules.strategy, BY_SURFACE, drawn_density, light_density(scene.chances, place.light, local)) * radiance


@wp.func
def path_radiance(
    scene: PathScene, bodies: Bodies, rules: PathRules, place: Place, number: int, first: Hit, start: wp.vec3, ray: wp.vec3, spread: float
) -> wp.vec3:
    """Radiance along one path, whose first hit lies at `start` in the direction `ray` from the camera; `spread` is its width there [m]."""
    total = wp.vec3(0.0, 0.0, 0.0)
    through = wp.vec3(1.0, 1.0, 1.0)
    hit = first
    position = start
    direction = ray
    width = float(spread)
    drawn_density = float(0.0)
    for bounce in range(rules.bounces + 1):
        if hit.code == NOTHING:
            total += wp.cw_mul(through, escaped_light(scene, rules, place, direction, bounce, drawn_density))
            break
        if bounce == rules.bounces:
            break
        vertex = vertex_at(scene, bodies, place.view, rules.instances, hit, position, -direction, width)
        dimension = 1 + DIMENSIONS * bounce
        light = direct_light(scene, bodies, rules, place, vertex, scrambled_point(place.key, number, dimension))
        total += wp.cw_mul(through, light)

        choice = scrambled_point(place.key, number, dimension + 2)
        direction = scatter(vertex.brdf, choice[0], scrambled_point(place.key, number, dimension + 1))
        drawn_density = density(vertex.brdf, direction)
        if drawn_density <= 0.0 or wp.dot(direction, vertex.face_normal) <= 0.0:
            break
        through = wp.cw_mul(through, evaluate(scene.surfaces.gloss, vertex.brdf, direction) / drawn_density)
        luck = wp.min(wp.max(through), MOST_LUCK)
        if bounce >= rules.roulette:
            if choice[1] >= luck:
                break
            through = through / luck
        hit = nearest_hit(scene, bodies, place.view, rules.instances, vertex.origin, direction)
        position = vertex.origin + hit.depth * direction
        width += SCATTERED_SPREAD * vertex.brdf.roughness * hit.depth
    return total


@wp.kernel
def trace_paths_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    episode: wp.array[int],
    light: wp.array[int],
    light_turn: wp.array[float],
    # In:
    bodies: Bodies,
    view_world: wp.array[int],
    view_camera: wp.array[int],
    rules: PathRules,
    first: int,
    # Out:
    radiance_out: wp.array3d[wp.vec3],
):
    """Mean radiance of N paths through each pixel, spread evenly over its square.

    Random numbers have the address (seed, episode; camera and pixel; path, dimension): a still scene gives the same picture again.
    """
    pixel = tile_pixel(grid, wp.tid() + first)
    view = pixel[0]
    row = pixel[1]
    column = pixel[2]
    if row >= grid.height or column >= grid.width:
        return
    camera = view_camera[view]
    world = view_world[view]
    place = Place()
    place.view = view
    place.light = light[world]
    place.turn = light_turn[world]
    address = (camera * grid.height + row) * grid.width + column
    place.key = mix(stream_key(rules.seed, episode[world], 0, PATHS) ^ wp.uint64(address))
    footprint = 1.0 / (cameras.intrinsics[camera][0] * wp.sqrt(float(rules.samples)))
    total = wp.vec3(0.0, 0.0, 0.0)
    for number in range(rules.samples):
        offset = scrambled_point(place.key, number, 0) - wp.vec2(0.5, 0.5)
        ray = camera_ray(cameras.intrinsics[camera], row, column, offset)
        hit = trace_camera_ray(scene.meshes, bodies, view, row, column, ray, rules.instances, False)
        hit = hit_table(scene.table, cameras, camera, ray, hit)
        start = hit_position(cameras, camera, ray, hit.depth)
        direction = wp.normalize(cameras.to_world[camera] * ray)
        total += path_radiance(scene, bodies, rules, place, number, hit, start, direction, footprint * hit.depth)
    radiance_out[view, row, column] = total / float(rules.samples)
