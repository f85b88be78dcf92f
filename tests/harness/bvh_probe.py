"""Test kernels of ray queries: the wide BVH, its references (Warp's mesh queries, a test of every triangle), and a count of node visits."""

import warp as wp

from synpick_warp.kernels.perception.exact_hits import intersect_triangle
from synpick_warp.kernels.render.visibility.gbuffer import FAR
from synpick_warp.kernels.render.visibility.wide_bvh import WideBvh, query_any_hit, query_closest_hit

wp.set_module_options({"enable_backward": False})


@wp.kernel
def query_kernel(
    # Scene:
    bvh: WideBvh,
    mesh: wp.uint64,
    # In:
    row: int,
    own: int,
    start: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    reach: float,
    # Out:
    hit_out: wp.array[wp.vec3],  # (ray)
    face_out: wp.array[int],  # (ray)
    blocked_out: wp.array[int],  # (ray)
):
    """Closest-hit query (t, u, v; triangle, -1 if none) and any-hit query: of mesh `row` of `bvh` if `own` is 1, else of `mesh` by Warp."""
    ray = wp.tid()
    if own == 1:
        hit = query_closest_hit(bvh, bvh.root[row], start[ray], direction[ray], reach)
        hit_out[ray] = wp.vec3(hit[0], hit[1], hit[2])
        face_out[ray] = wp.cast(hit[3], int)
        blocked_out[ray] = int(query_any_hit(bvh, bvh.root[row], start[ray], direction[ray], reach))
        return
    hit_out[ray] = wp.vec3(-1.0, 0.0, 0.0)
    face_out[ray] = -1
    query = wp.mesh_query_ray(mesh, start[ray], direction[ray], reach)
    if query.result:
        hit_out[ray] = wp.vec3(query.t, query.u, query.v)
        face_out[ray] = query.face
    blocked_out[ray] = int(wp.mesh_query_ray_anyhit(mesh, start[ray], direction[ray], reach))


@wp.kernel
def hit_every_triangle_kernel(
    # Scene:
    corner: wp.array[wp.vec3],  # (3 x triangle) [m]
    # In:
    start: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    # Out:
    nearest_out: wp.array[float],  # (ray)
):
    """Distance of each ray's closest hit by a test of every triangle; -1: none."""
    ray = wp.tid()
    nearest = float(FAR)
    for triangle in range(corner.shape[0] // 3):
        first = 3 * triangle
        hit = intersect_triangle(start[ray], direction[ray], corner[first], corner[first + 1], corner[first + 2])
        if hit[0] >= 0.0 and hit[0] < nearest:
            nearest = hit[0]
    nearest_out[ray] = wp.where(nearest < FAR, nearest, -1.0)


@wp.func_native(
    query_closest_hit.native_snippet.replace("test_boxes(a, b, c, best, entry);", "test_boxes(a, b, c, best, entry), ++visits;")
    .replace("Word stack[STACK_SIZE];", "Word stack[STACK_SIZE]; int visits = 0;")
    .replace("best_u, best_v, as_float(face)", "best_u, best_v, (float)visits")
)
def count_visits(bvh: WideBvh, root: int, start: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4:
    """The closest-hit query with the number of nodes it visited instead of the triangle."""


@wp.kernel
def count_visits_kernel(
    # Scene:
    bvh: WideBvh,
    # In:
    start: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    # Out:
    visits_out: wp.array[int],  # (ray)
):
    """Nodes that a closest-hit query of the first mesh visits."""
    ray = wp.tid()
    hit = count_visits(bvh, bvh.root[0], start[ray], direction[ray], 1.0e30)
    visits_out[ray] = int(hit[3])
