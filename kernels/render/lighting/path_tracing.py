"""The reference picture: paths from the camera that scatter at surfaces until they leave the scene for the light map.

A pixel's radiance is the mean over N paths of Σ_k T_k (w_l f L / p_l + w_s L_s), T the product of f cos / p along the path: at each surface
one direction is drawn by the map's radiance and one by the surface's own law, weighted by the power heuristic (Veach, 1997),
w_l = p_l² / (p_l² + p_s²). Nothing in the scene glows but the map.
"""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.lighting.brdf import Brdf, Reflection, brdf_at, density, evaluate_parts, scatter
from synpick_warp.kernels.render.lighting.environment import Lights, background_radiance, turned
from synpick_warp.kernels.render.lighting.materials import Surfaces, base_color, mesh_surface, table_surface
from synpick_warp.kernels.render.lighting.sampling import Chances, LightSample, light_density, sample_light, scrambled_point
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, hit_position, in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import (
    FAR,
    RAY_OFFSET,
    Hit,
    Meshes,
    Table,
    ViewBodies,
    body_of,
    hit_table,
    is_blocked,
    segment_of,
    trace_camera_ray,
)
from synpick_warp.kernels.rng import mix, stream_key

wp.set_module_options({"enable_backward": False})

BOTH = wp.constant(0)
BY_LIGHT = wp.constant(1)
BY_SURFACE = wp.constant(2)
"""How directions to the light are drawn. One way alone has the same mean and more noise: it serves to check the other."""
MOST_LUCK = wp.constant(0.95)
"""Largest chance of a path to go on, so that all end."""
MOST_POINT = wp.constant(0.99999994)
"""The largest float32 below 1."""
DIMENSIONS = wp.constant(3)
"""Points in the unit square that a scattering takes: light, surface, and (lobe, roulette)."""
ENDED = wp.constant(-1)
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
    least_roughness: float
    """Surfaces that a path meets after the first are at least so rough: what shines through two mirrors is rare, bright and noisy."""
    seed: wp.uint64


@wp.struct
class Place:
    """Where one pixel's paths are: the world's light, the view's bodies, the stream of random numbers."""

    view: int
    instances: int
    """Instance capacity of a world."""
    first_light: int
    """Map that lights the surface which the camera sees."""
    light: int
    """Map that lights all others."""
    turn: float
    key: wp.uint64
    shift: wp.vec2
    """Moves all points in the unit square, each dimension its own way; beyond an edge they come in at the other."""


@wp.struct
class Reflected:
    """Radiance that a surface sends to the camera: diffuse colour times `diffuse` + `between`, plus `gloss`."""

    diffuse: wp.vec3
    """From the map."""
    between: wp.vec3
    """From other surfaces."""
    gloss: wp.vec3
    """From both."""


@wp.struct
class Through:
    """What the surfaces of a path leave of light at its end, in the two parts of the first one."""

    diffuse: wp.vec3
    gloss: wp.vec3


@wp.struct
class Vertex:
    """A surface that a path met."""

    origin: wp.vec3
    """Where rays leave it, in the world [m]."""
    face_normal: wp.vec3
    brdf: Brdf


@wp.struct
class Path:
    """A path on its way: what it has found, and the surface at its end, at which it will scatter next."""

    found: Reflected
    through: Through
    vertex: Vertex
    bounce: int
    """Scatterings so far; ENDED: it will not scatter."""
    width: float
    """Of what it stands for, across it [m]."""


@wp.func
def nearest_hit(scene: PathScene, bodies: ViewBodies, view: int, instances: int, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """The nearest hit of a ray along a unit vector, all in the world; `depth` is the distance [m]. The companion of `is_blocked`."""
    best = Hit()
    best.segment = Segment.NOTHING
    best.depth = FAR
    height = origin[2] - scene.table.height
    if scene.table.visible != 0 and direction[2] * height < 0.0:
        best.segment = Segment.TABLE
        best.depth = -height / direction[2]
    for number in range(bodies.present[view]):
        body = bodies.order[view, number]
        sphere = bodies.sphere[view, body]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
        closest = offset - wp.clamp(wp.dot(offset, direction), 0.0, best.depth) * direction
        if wp.dot(closest, closest) < sphere[3]:
            rotation = bodies.world_rotation[view, body]
            start = rotation * (origin - bodies.position[view, body])
            local = rotation * direction
            query = wp.mesh_query_ray(scene.meshes.id[bodies.mesh[view, body]], start, local, best.depth)
            if query.result:
                best.depth = query.t
                best.triangle = query.face
                best.barycentric = wp.vec2(query.u, query.v)
                best.segment = segment_of(body, instances)
    return best


@wp.func
def vertex_at(
    scene: PathScene,
    bodies: ViewBodies,
    view: int,
    instances: int,
    hit: Hit,
    position: wp.vec3,
    outgoing: wp.vec3,
    width: float,
    least_roughness: float,
) -> Vertex:
    """The surface at a hit; `width` [m] is the path's there, across it."""
    surface = table_surface(scene.meshes, outgoing)
    at = position
    if hit.segment == Segment.TABLE:
        # Far away, rounding would lift or sink it by more than the rays' offset.
        at = wp.vec3(position[0], position[1], scene.table.height)
    else:
        body = body_of(hit.segment, instances)
        surface = mesh_surface(scene.meshes, scene.surfaces, bodies, view, body, hit.triangle, hit.barycentric, outgoing, width)
    made = Vertex()
    made.origin = at + RAY_OFFSET * surface.face_normal
    made.face_normal = surface.face_normal
    metallic = scene.surfaces.metallic[surface.row]
    roughness = wp.max(scene.surfaces.roughness[surface.row], least_roughness)
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
def extended(through: Through, parts: Reflection, color: wp.vec3, bounce: int) -> Through:
    """With one more surface, of diffuse colour `color`, at the path's end. The first keeps its parts apart; others add both of theirs."""
    made = Through()
    if bounce == 0:
        made.diffuse = wp.vec3(parts.diffuse, parts.diffuse, parts.diffuse)
        made.gloss = parts.gloss
    else:
        both = parts.gloss + parts.diffuse * color
        made.diffuse = wp.cw_mul(through.diffuse, both)
        made.gloss = wp.cw_mul(through.gloss, both)
    return made


@wp.func
def lit(total: Reflected, through: Through, radiance: wp.vec3, bounce: int) -> Reflected:
    """`total`, and light that arrives at the end of a path of `bounce` + 1 surfaces."""
    made = total
    made.gloss += wp.cw_mul(through.gloss, radiance)
    if bounce == 0:
        made.diffuse += wp.cw_mul(through.diffuse, radiance)
    else:
        made.between += wp.cw_mul(through.diffuse, radiance)
    return made


@wp.func
def path_point(place: Place, number: int, dimension: int) -> wp.vec2:
    """Point `number` of a dimension in [0, 1)², moved by the place's shift."""
    point = scrambled_point(place.key, number, dimension)
    x = point[0] + place.shift[0] * float(dimension)
    y = point[1] + place.shift[1] * float(dimension)
    return wp.vec2(wp.min(x - wp.floor(x), MOST_POINT), wp.min(y - wp.floor(y), MOST_POINT))


@wp.func
def direct_light(
    scene: PathScene, bodies: ViewBodies, rules: PathRules, place: Place, light: int, vertex: Vertex, u: wp.vec2
) -> LightSample:
    """A direction in the world drawn from the map, and in `radiance` what comes from there, over its density and with its weight.

    Light that comes from behind the triangle is none, whatever the interpolated normal says.
    """
    drawn = sample_light(scene.chances, light, u)
    made = LightSample()
    made.direction = turned(drawn.direction, place.turn)
    if drawn.density <= 0.0 or wp.dot(made.direction, vertex.face_normal) <= 0.0:
        return made
    weight = heuristic(rules.strategy, BY_LIGHT, drawn.density, density(vertex.brdf, made.direction)) / drawn.density
    if weight <= 0.0 or wp.dot(made.direction, vertex.brdf.normal) <= 0.0:
        return made
    if is_blocked(scene.meshes, scene.table, bodies, place.view, vertex.origin, made.direction, FAR):
        return made
    made.radiance = weight * background_radiance(scene.lights, light, drawn.direction)
    return made


@wp.func
def escaped_light(scene: PathScene, rules: PathRules, place: Place, light: int, direction: wp.vec3, drawn_density: float) -> wp.vec3:
    """What the map sends along a path that left the scene, weighted against drawing the same direction from the map."""
    local = turned(direction, -place.turn)
    radiance = background_radiance(scene.lights, light, local)
    return heuristic(rules.strategy, BY_SURFACE, drawn_density, light_density(scene.chances, light, local)) * radiance


@wp.func
def begun(first: Vertex, width: float) -> Path:
    """A path from the surface that the camera sees; `width` is its own there [m]."""
    path = Path()
    path.vertex = first
    path.width = width
    return path


@wp.func
def scattered(
    scene: PathScene, bodies: ViewBodies, rules: PathRules, place: Place, number: int, first_diffuse: wp.vec3, path: Path
) -> Path:
    """Path `number` after it has scattered once more: with the light that it found so, at its next surface or ENDED.

    `first_diffuse` is the diffuse colour of its first surface, by which all diffuse light will be multiplied.
    """
    bounce = path.bounce
    light = place.light
    if bounce == 0:
        light = place.first_light
    made = path
    made.bounce = ENDED
    dimension = 1 + DIMENSIONS * bounce
    direct = direct_light(scene, bodies, rules, place, light, path.vertex, path_point(place, number, dimension))
    if wp.max(direct.radiance) > 0.0:
        parts = evaluate_parts(scene.surfaces.gloss, path.vertex.brdf, direct.direction)
        made.found = lit(made.found, extended(path.through, parts, path.vertex.brdf.diffuse, bounce), direct.radiance, bounce)

    choice = path_point(place, number, dimension + 2)
    direction = scatter(path.vertex.brdf, choice[0], path_point(place, number, dimension + 1))
    drawn_density = density(path.vertex.brdf, direction)
    if drawn_density <= 0.0 or wp.dot(direction, path.vertex.face_normal) <= 0.0:
        return made
    parts = evaluate_parts(scene.surfaces.gloss, path.vertex.brdf, direction)
    through = extended(path.through, parts, path.vertex.brdf.diffuse, bounce)
    scale = 1.0 / drawn_density
    if bounce >= rules.roulette:
        luck = wp.min(scale * wp.max(wp.cw_mul(first_diffuse, through.diffuse) + through.gloss), MOST_LUCK)
        if choice[1] >= luck:
            return made
        scale = scale / luck
    through.diffuse = through.diffuse * scale
    through.gloss = through.gloss * scale
    hit = nearest_hit(scene, bodies, place.view, place.instances, path.vertex.origin, direction)
    if hit.segment == Segment.NOTHING:
        made.found = lit(made.found, through, escaped_light(scene, rules, place, light, direction, drawn_density), bounce)
        return made
    if bounce + 1 == rules.bounces:
        return made
    made.through = through
    made.width = path.width + SCATTERED_SPREAD * path.vertex.brdf.roughness * hit.depth
    position = path.vertex.origin + hit.depth * direction
    made.vertex = vertex_at(scene, bodies, place.view, place.instances, hit, position, -direction, made.width, rules.least_roughness)
    made.bounce = bounce + 1
    return made


@wp.kernel
def trace_paths_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    episode: wp.array[int],
    light: wp.array[int],
    light_yaw: wp.array[float],
    # In:
    bodies: ViewBodies,
    views: Views,
    rules: PathRules,
    first: int,
    # Out:
    radiance_out: wp.array3d[wp.vec3],
):
    """Mean radiance of N paths through each pixel, spread evenly over its square.

    Random numbers have the address (seed, episode; camera and pixel; path, dimension): a still scene gives the same picture again.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    world = views.world[view]
    place = Place()
    place.view = view
    place.instances = views.instances
    place.first_light = light[world]
    place.light = light[world]
    place.turn = light_yaw[world]
    address = (camera * grid.height + row) * grid.width + column
    place.key = mix(stream_key(rules.seed, episode[world], 0, Stream.PATHS) ^ wp.uint64(address))
    footprint = 1.0 / (cameras.intrinsics[camera][0] * wp.sqrt(float(rules.samples)))
    total = wp.vec3(0.0, 0.0, 0.0)
    for number in range(rules.samples):
        offset = scrambled_point(place.key, number, 0) - wp.vec2(0.5, 0.5)
        ray = camera_ray(cameras.intrinsics[camera], row, column, offset)
        hit = trace_camera_ray(scene.meshes, bodies, view, tile_of(grid, row, column), ray, views.instances)
        hit = hit_table(scene.table, cameras, camera, ray, hit)
        direction = wp.normalize(cameras.to_world[camera] * ray)
        if hit.segment == Segment.NOTHING:
            total += background_radiance(scene.lights, place.light, turned(direction, -place.turn))
        else:
            start = hit_position(cameras, camera, ray, hit.depth)
            width = footprint * hit.depth
            vertex = vertex_at(scene, bodies, view, views.instances, hit, start, -direction, width, 0.0)
            diffuse = vertex.brdf.diffuse
            path = begun(vertex, width)
            while path.bounce != ENDED:
                path = scattered(scene, bodies, rules, place, number, diffuse, path)
            total += wp.cw_mul(diffuse, path.found.diffuse + path.found.between) + path.found.gloss
    radiance_out[view, row, column] = total / float(rules.samples)
