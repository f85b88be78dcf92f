"""What rays hit, by the trees of meshes: nearest hits of camera rays, and occlusion queries."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, in_image, tile_of, tile_pixel

wp.set_module_options({"enable_backward": False})

RAY_REGISTERS = 64
"""Most registers of a thread that casts rays: with more, too few threads are in flight to hide how long a tree's nodes take to come."""
FIXTURES = wp.constant(3)
"""Tote, finger and cup, in this order, come after a world's instances, and their meshes after the catalog's."""
FAR = wp.constant(1.0e30)
"""Stands for no hit yet [m]."""
RAY_OFFSET = wp.constant(2.0e-4)
"""Secondary rays start this far off the surface [m], so that they do not hit it again."""
MAX_COUNTS = wp.constant(65535.0)
"""Largest depth that fits into 16 bits."""


@wp.struct
class Interior:
    """A convex room in the tote's own frame that none of its triangles reaches into, open at the top: see `scenes.types.Interior`."""

    half: wp.vec3
    """Negative: there is none."""
    growth: wp.vec3
    floor: float
    top: float


@wp.struct
class Meshes:
    """Constant, one row a mesh: the catalog's entries, then tote, finger, cup."""

    id: wp.array[wp.uint64]
    lower: wp.array[wp.vec3]
    upper: wp.array[wp.vec3]
    """Bounds in the mesh's own frame [m]."""
    center: wp.array[wp.vec3]
    radius: wp.array[float]
    """Bounding sphere in the mesh's own frame [m]."""
    first_triangle: wp.array[int]
    """Number of the mesh's first triangle among all; one row more than there are meshes."""
    corner: wp.array[wp.vec3]
    """Three corners of each triangle, in the mesh's own frame [m]."""
    entries: int
    """Catalog entries; the mesh of fixture f is entries + f."""
    interior: Interior
    """The tote's."""


@wp.struct
class Table:
    """A horizontal plane under the tote."""

    visible: int
    height: float
    """z in the world [m]."""


@wp.struct
class ViewBodies:
    """Scratch, one row a view and body: the world's instances, then tote, finger, cup."""

    mesh: wp.array2d[int]
    """Row of `Meshes`; -1: not there."""
    rotation: wp.array2d[wp.mat33]
    """Camera's axes to the body's."""
    start: wp.array2d[wp.vec3]
    """Where the optical axis passes depth `near`, in the body's frame [m]: rays start close to the body, so that float32 suffices."""
    near: wp.array2d[float]
    """No point of the body is nearer than this planar depth [m]."""
    box: wp.array2d[wp.vec4i]
    """Pixels that the body can cover: x_min, y_min, x_max, y_max, inclusive, up to one image size beyond the border."""
    world_rotation: wp.array2d[wp.mat33]
    """World's axes to the body's."""
    position: wp.array2d[wp.vec3]
    """Origin of the body in the world [m]."""
    sphere: wp.array2d[wp.vec4]
    """Bounding sphere in the world: centre [m], squared radius [m²]; a negative square: not there."""
    order: wp.array2d[int]
    """The bodies that are there, by `near`, the tote last: rays that meet the nearest first seldom have to look at the rest."""
    present: wp.array[int]
    """How many these are, one a view."""
    uses_background: wp.array[int]
    """1: the view's tote stands at the world's origin, as in the backdrop that was rendered before."""
    body_mask: wp.array2d[wp.uint64]
    """Of a view's tile: bit k is set if rays of its pixels may meet body order[k]."""


@wp.struct
class GBuffer:
    """Scratch, one a view and pixel: what shading and later layers read."""

    segment: wp.array3d[wp.uint8]
    """0 nothing, 1 + instance_id, or the code of the table or a fixture."""
    triangle: wp.array3d[int]
    barycentric: wp.array3d[wp.vec2]
    """Weights of the triangle's first and second vertex."""
    depth: wp.array3d[float]
    """Planar depth [m]."""


@wp.struct
class Hit:
    """The nearest hit of one ray."""

    segment: int
    triangle: int
    barycentric: wp.vec2
    depth: float


@wp.func
def is_in_interior(interior: Interior, point: wp.vec3) -> bool:
    """Whether a point at most as high as the top lies in a hollow."""
    x = wp.abs(point[0])
    y = wp.abs(point[1])
    z = point[2]
    return (
        z >= interior.floor
        and x <= interior.half[0] + z * interior.growth[0]
        and y <= interior.half[1] + z * interior.growth[1]
        and x + y <= interior.half[2] + z * interior.growth[2]
    )


@wp.func
def stays_in_interior(interior: Interior, start: wp.vec3, direction: wp.vec3, reach: float) -> bool:
    """Whether it is plain that a ray meets no triangle of the tote before `reach`: what of it is no higher than the tote begins and ends in
    the hollow, which is convex. Camera rays that meet an object in the tote are spared its tree thus; for rays of paths it does not pay."""
    begin = float(0.0)
    end = float(reach)
    if direction[2] > 0.0:
        end = wp.min(reach, (interior.top - start[2]) / direction[2])
    elif start[2] > interior.top:
        begin = FAR
        if direction[2] < 0.0:
            begin = (interior.top - start[2]) / direction[2]
    if begin >= end:
        return interior.half[0] > 0.0
    return is_in_interior(interior, start + begin * direction) and is_in_interior(interior, start + end * direction)


@wp.func
def body_of(segment: int, instances: int) -> int:
    """Row of `ViewBodies` for a hit's code, which is neither nothing nor the table."""
    if segment >= Segment.TOTE:
        return instances + segment - Segment.TOTE
    return segment - 1


@wp.func
def segment_of(body: int, instances: int) -> int:
    """A hit's code for a row of `ViewBodies`."""
    if body >= instances:
        return Segment.TOTE + body - instances
    return body + 1


@wp.func
def body_ray_start(bodies: ViewBodies, view: int, body: int, ray: wp.vec3) -> wp.vec3:
    """Where a camera ray passes the body's near depth, in the body's frame [m]."""
    return bodies.start[view, body] + bodies.near[view, body] * (bodies.rotation[view, body] * wp.vec3(ray[0], ray[1], 0.0))


@wp.func
def hits_body(meshes: Meshes, bodies: ViewBodies, view: int, body: int, ray: wp.vec3) -> bool:
    """Whether a camera ray hits a body at all."""
    return wp.mesh_query_ray_anyhit(
        meshes.id[bodies.mesh[view, body]], body_ray_start(bodies, view, body, ray), bodies.rotation[view, body] * ray, FAR
    )


@wp.func
def trace_bodies(
    meshes: Meshes,
    bodies: ViewBodies,
    view: int,
    body_mask: wp.uint64,
    ray: wp.vec3,
    instances: int,
) -> Hit:
    """Nearest hit among these bodies, as in `ViewBodies.body_mask`."""
    best = Hit()
    best.segment = Segment.NOTHING
    best.depth = FAR
    left = body_mask
    number = int(0)
    while left != wp.uint64(0):
        if (left & wp.uint64(1)) != wp.uint64(0):
            body = bodies.order[view, number]
            near = bodies.near[view, body]
            if near < best.depth:
                reach = best.depth - near
                start = body_ray_start(bodies, view, body, ray)
                direction = bodies.rotation[view, body] * ray
                if body != instances or not stays_in_interior(meshes.interior, start, direction, reach):
                    query = wp.mesh_query_ray(meshes.id[bodies.mesh[view, body]], start, direction, reach)
                    if query.result:
                        best.depth = near + query.t
                        best.triangle = query.face
                        best.barycentric = wp.vec2(query.u, query.v)
                        best.segment = segment_of(body, instances)
        left = left >> wp.uint64(1)
        number += 1
    return best


@wp.func
def trace_camera_ray(meshes: Meshes, bodies: ViewBodies, view: int, tile: int, ray: wp.vec3, instances: int) -> Hit:
    """Nearest hit among the tile's candidates; see `trace_bodies`."""
    return trace_bodies(meshes, bodies, view, bodies.body_mask[view, tile], ray, instances)


@wp.func
def hit_table(table: Table, cameras: Cameras, camera: int, ray: wp.vec3, best: Hit) -> Hit:
    """The hit given, or the table's if that is nearer."""
    result = best
    if table.visible != 0:
        fall = (cameras.to_world[camera] * ray)[2]
        height = float(cameras.center[camera][2]) - table.height
        if fall * height < 0.0:
            depth = -height / fall
            if depth < best.depth:
                result.segment = Segment.TABLE
                result.depth = depth
    return result


@wp.func
def store_hit(gbuffer: GBuffer, view: int, row: int, column: int, hit: Hit):
    gbuffer.segment[view, row, column] = wp.uint8(hit.segment)
    gbuffer.triangle[view, row, column] = hit.triangle
    gbuffer.barycentric[view, row, column] = hit.barycentric
    gbuffer.depth[view, row, column] = hit.depth


@wp.func
def read_hit(gbuffer: GBuffer, view: int, row: int, column: int) -> Hit:
    """The hit of a pixel."""
    hit = Hit()
    hit.segment = int(gbuffer.segment[view, row, column])
    hit.triangle = gbuffer.triangle[view, row, column]
    hit.barycentric = gbuffer.barycentric[view, row, column]
    hit.depth = gbuffer.depth[view, row, column]
    return hit


@wp.func
def triangle_normal(meshes: Meshes, mesh: int, triangle: int) -> wp.vec3:
    """Unit normal of a mesh's triangle, in the mesh's own frame."""
    first = 3 * (meshes.first_triangle[mesh] + triangle)
    corner = meshes.corner[first]
    return wp.normalize(wp.cross(meshes.corner[first + 1] - corner, meshes.corner[first + 2] - corner))


@wp.func
def face_normal(meshes: Meshes, bodies: ViewBodies, view: int, hit: Hit, instances: int) -> wp.vec3:
    """Unit normal, in the world, of the triangle or table that a ray hit; either side."""
    if hit.segment == Segment.TABLE:
        return wp.vec3(0.0, 0.0, 1.0)
    body = body_of(hit.segment, instances)
    return wp.transpose(bodies.world_rotation[view, body]) * triangle_normal(meshes, bodies.mesh[view, body], hit.triangle)


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def trace_sample_kernel(
    # Scene:
    meshes: Meshes,
    table: Table,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    views: Views,
    offset: wp.vec2,
    first: int,
    # Out:
    gbuffer_out: GBuffer,
):
    """Cast one ray through each pixel, `offset` [px] off its centre: a colour sample, nearest hit only. No camera (-1): no rays."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    camera = views.camera[view]
    if camera < 0:
        return
    ray = camera_ray(cameras.intrinsics[camera], row, column, offset)
    hit = trace_camera_ray(meshes, bodies, view, tile_of(grid, row, column), ray, views.instances)
    store_hit(gbuffer_out, view, row, column, hit_table(table, cameras, camera, ray, hit))


@wp.func
def is_blocked(
    meshes: Meshes,
    table: Table,
    bodies: ViewBodies,
    view: int,
    origin: wp.vec3,
    direction: wp.vec3,
    reach: float,
) -> bool:
    """Whether anything lies within `reach` [m] of `origin` along the unit vector `direction`, all in the world."""
    if table.visible != 0 and direction[2] < 0.0:
        if origin[2] + reach * direction[2] < table.height:
            return True
    present = bodies.present[view]
    for number in range(present):
        # The tote, which is last, first: low rays meet its walls.
        body = bodies.order[view, present - 1 - number]
        sphere = bodies.sphere[view, body]
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
        closest = offset - wp.clamp(wp.dot(offset, direction), 0.0, reach) * direction
        if wp.dot(closest, closest) < sphere[3]:
            rotation = bodies.world_rotation[view, body]
            start = rotation * (origin - bodies.position[view, body])
            local = rotation * direction
            if wp.mesh_query_ray_anyhit(meshes.id[bodies.mesh[view, body]], start, local, reach):
                return True
    return False
