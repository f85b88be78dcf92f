"""Ray-triangle intersection of rasterized hits in the frame of the body, with the arithmetic of Warp's mesh queries."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.visibility.bvh_rays import body_ray_start
from synpick_warp.kernels.render.visibility.camera import ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, ViewBodies, body_of

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    float t, u, v, sign;
    wp::vec3 normal;
    if (wp::intersect_ray_tri_woop(start, direction, a, b, c, t, u, v, sign, &normal))
        return wp::vec3(t, u, v);
    return wp::vec3(-1.0f, 0.0f, 0.0f);
""")
def intersect_triangle(start: wp.vec3, direction: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Watertight ray/triangle intersection (Woop, Benthin and Wald, 2013) as in `wp.mesh_query_ray`: (t, u, v); t < 0: no hit.

    u and v are the barycentric weights of a and b.
    """
    ...


@wp.kernel
def intersect_hits_kernel(meshes: Meshes, grid: ImageGrid, bodies: ViewBodies, views: Views, first: int, gbuffer_inout: GBuffer):
    """Replace depth and barycentric weights of each pixel's hit by those that a ray query of the body's mesh returns, to the last bit.

    Rasterization and BVH traversal find the same triangles, but round differently, and a grasp plan amplifies the last bit of a depth into
    another motion. Hits of the table, and rays that miss the triangle within rounding, keep their values. Launched over view, pixel (tile
    order, from flat index `first` on).
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or views.world[view] < 0:
        return
    segment = int(gbuffer_inout.segment[view, row, column])
    if segment == Segment.NOTHING or segment == Segment.TABLE:
        return
    body = body_of(segment, views.instances)
    ray = camera_ray(views.cameras, view, row, column, wp.vec2(0.0, 0.0))
    start = body_ray_start(bodies, view, body, ray)
    direction = bodies.rotation[view, body] * ray
    corner = 3 * (meshes.first_triangle[bodies.mesh[view, body]] + gbuffer_inout.triangle[view, row, column])
    hit = intersect_triangle(start, direction, meshes.corner[corner], meshes.corner[corner + 1], meshes.corner[corner + 2])
    if hit[0] >= 0.0:
        gbuffer_inout.depth[view, row, column] = bodies.near[view, body] + hit[0]
        gbuffer_inout.barycentric[view, row, column] = wp.vec2(hit[1], hit[2])
