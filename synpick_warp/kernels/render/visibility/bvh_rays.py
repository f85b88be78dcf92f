"""Ray queries against the BVHs of meshes: closest hit and any hit, of camera rays (by tile masks) and of world-space rays.

Camera rays are (x, y, 1) in the camera's axes, so that the ray parameter is planar depth.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.camera import AnyCameras
from synpick_warp.kernels.render.visibility.gbuffer import FAR, MASK_BITS, Hit, Interior, Meshes, Table, ViewBodies, segment_of
from synpick_warp.kernels.render.visibility.ray_bodies import first_ray_record, read_ray_body
from synpick_warp.kernels.render.visibility.records import read_record
from synpick_warp.kernels.render.visibility.wide_bvh import query_any_hit, query_closest_hit

wp.set_module_options({"enable_backward": False})

RAY_OFFSET = wp.constant(2.0e-4)
"""Secondary rays start this far off the surface [m], against self-intersection."""


@wp.func
def is_in_interior(interior: Interior, point: wp.vec3) -> bool:
    """True if a point, which must not be above the top, lies in the tote's empty interior."""
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
    """Conservative early-out: True if the ray's segment up to `reach`, clipped to the tote's height, lies in its empty convex interior.

    Both ends of the clipped segment are tested; convexity does the rest. It spares camera rays that hit an object in the tote, and shadow
    rays to lamps, the tote's BVH; for rays of paths it does not pay.
    """
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
def body_ray_start(bodies: ViewBodies, view: int, body: int, ray: wp.vec3) -> wp.vec3:
    """Point of a camera ray at the body's near depth, in the body's frame [m]."""
    return bodies.start[view, body] + bodies.near[view, body] * (bodies.rotation[view, body] * wp.vec3(ray[0], ray[1], 0.0))


@wp.func
def hits_body(meshes: Meshes, bodies: ViewBodies, view: int, body: int, ray: wp.vec3) -> bool:
    """Any-hit query of a camera ray against one body."""
    root = meshes.bvh.root[bodies.mesh[view, body]]
    return query_any_hit(meshes.bvh, root, body_ray_start(bodies, view, body, ray), bodies.rotation[view, body] * ray, FAR)


@wp.func
def no_hit() -> Hit:
    """Hit of a ray that meets nothing."""
    hit = Hit()
    hit.segment = Segment.NOTHING
    hit.depth = FAR
    return hit


@wp.func
def trace_bodies(
    meshes: Meshes, bodies: ViewBodies, view: int, first: int, body_mask: wp.uint64, ray: wp.vec3, instances: int, nearest: Hit
) -> Hit:
    """Closest hit of a camera ray among the bodies in a word of `ViewBodies.body_mask`, front to back, so that most are skipped; `nearest`
    unless one of them is nearer. `first`: rank of the lowest bit."""
    best = nearest
    left = body_mask
    rank = int(first)
    while left != wp.uint64(0):
        # Each ray goes on to its next body by itself: rays of a warp then traverse BVHs at the same time, even of different bodies.
        while (left & wp.uint64(1)) == wp.uint64(0):
            left = left >> wp.uint64(1)
            rank += 1
        body = bodies.order[view, rank]
        near = bodies.near[view, body]
        if near < best.depth:
            reach = best.depth - near
            start = body_ray_start(bodies, view, body, ray)
            direction = bodies.rotation[view, body] * ray
            if body != instances or not stays_in_interior(meshes.interior, start, direction, reach):
                hit = query_closest_hit(meshes.bvh, meshes.bvh.root[bodies.mesh[view, body]], start, direction, reach)
                if hit[0] >= 0.0:
                    best.depth = near + hit[0]
                    best.triangle = wp.cast(hit[3], int)
                    best.barycentric = wp.vec2(hit[1], hit[2])
                    best.segment = segment_of(body, instances)
        left = left >> wp.uint64(1)
        rank += 1
    return best


@wp.func
def trace_camera_ray(meshes: Meshes, bodies: ViewBodies, view: int, tile: int, ray: wp.vec3, instances: int) -> Hit:
    """Closest hit of a camera ray among the bodies that its tile can show."""
    best = no_hit()
    for word in range(bodies.body_mask.shape[2]):
        best = trace_bodies(meshes, bodies, view, MASK_BITS * word, bodies.body_mask[view, tile, word], ray, instances, best)
    return best


@wp.func
def hit_table(table: Table, cameras: AnyCameras, view: int, ray: wp.vec3, best: Hit) -> Hit:
    """Closer one of a camera ray's hit `best` and its hit on the table."""
    result = best
    if table.visible != 0:
        along = cameras.to_world[view] * ray
        fall = along[2]
        height = float(cameras.center[view][2]) - table.height
        if fall * height < 0.0:
            depth = -height / fall
            if depth < best.depth:
                seen = True
                if table.half[0] < FAR or table.half[1] < FAR:
                    x = float(cameras.center[view][0]) + depth * along[0]
                    y = float(cameras.center[view][1]) + depth * along[1]
                    seen = wp.abs(x) <= table.half[0] and wp.abs(y) <= table.half[1]
                if seen:
                    result.segment = Segment.TABLE
                    result.depth = depth
    return result


@wp.func
def trace_ray(meshes: Meshes, table: Table, bodies: ViewBodies, view: int, instances: int, origin: wp.vec3, direction: wp.vec3) -> Hit:
    """Closest hit of a world-space ray along a unit vector, table included; `depth` is the distance [m]. Bounding spheres are tested before
    BVHs. `is_blocked` is its any-hit counterpart."""
    best = Hit()
    best.segment = Segment.NOTHING
    best.depth = FAR
    height = origin[2] - table.height
    if table.visible != 0 and direction[2] * height < 0.0:
        best.segment = Segment.TABLE
        best.depth = -height / direction[2]
    for rank in range(bodies.present[view]):
        record = first_ray_record(bodies, view, rank)
        sphere = read_record(bodies.ray_record, record)
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
        closest = offset - wp.clamp(wp.dot(offset, direction), 0.0, best.depth) * direction
        if wp.dot(closest, closest) < sphere[3]:
            body = read_ray_body(bodies, record)
            start = body.rotation * (origin - body.position)
            hit = query_closest_hit(meshes.bvh, body.root, start, body.rotation * direction, best.depth)
            if hit[0] >= 0.0:
                best.depth = hit[0]
                best.triangle = wp.cast(hit[3], int)
                best.barycentric = wp.vec2(hit[1], hit[2])
                best.segment = segment_of(body.row, instances)
    return best


@wp.func
def is_blocked(
    meshes: Meshes, table: Table, bodies: ViewBodies, view: int, tote: int, origin: wp.vec3, direction: wp.vec3, reach: float
) -> bool:
    """Any-hit query (shadow ray): True if something lies within `reach` [m] of `origin` along the unit vector `direction`, in the world.
    `tote` is the row of the tote, whose BVH is skipped for rays in its empty interior; -1: without this test."""
    if table.visible != 0 and direction[2] < 0.0:
        if origin[2] + reach * direction[2] < table.height:
            return True
    present = bodies.present[view]
    for turn in range(present):
        # Back to front, so that the tote comes first: low rays hit its walls.
        record = first_ray_record(bodies, view, present - 1 - turn)
        sphere = read_record(bodies.ray_record, record)
        offset = wp.vec3(sphere[0], sphere[1], sphere[2]) - origin
        closest = offset - wp.clamp(wp.dot(offset, direction), 0.0, reach) * direction
        if wp.dot(closest, closest) < sphere[3]:
            body = read_ray_body(bodies, record)
            start = body.rotation * (origin - body.position)
            local = body.rotation * direction
            if body.row != tote or not stays_in_interior(meshes.interior, start, local, reach):
                if query_any_hit(meshes.bvh, body.root, start, local, reach):
                    return True
    return False
