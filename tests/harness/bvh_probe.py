"""Probes of ray queries: the wide BVH, its references (Warp's mesh queries, a test of every triangle), and a count of node visits."""

import warp as wp

from synpick_warp.kernels.perception.exact_hits import intersect_triangle
from synpick_warp.kernels.render.visibility.gbuffer import FAR
from synpick_warp.kernels.render.visibility.wide_bvh import WideBvh, query_any_hit, query_closest_hit
from tests.harness.probe import probe


@wp.func
def query_bvh(bvh: WideBvh, row: int, start: wp.vec3, direction: wp.vec3, reach: float):
    """Closest hit (t, u, v), its triangle, and whether the any-hit query finds one, of mesh `row`."""
    hit = query_closest_hit(bvh, bvh.root[row], start, direction, reach)
    blocked = query_any_hit(bvh, bvh.root[row], start, direction, reach)
    return wp.vec3(hit[0], hit[1], hit[2]), wp.cast(hit[3], int), blocked


@wp.func
def query_mesh(mesh: wp.uint64, start: wp.vec3, direction: wp.vec3, reach: float):
    """The same of one of Warp's meshes."""
    hit = wp.vec3(-1.0, 0.0, 0.0)
    face = -1
    query = wp.mesh_query_ray(mesh, start, direction, reach)
    if query.result:
        hit = wp.vec3(query.t, query.u, query.v)
        face = query.face
    return hit, face, wp.mesh_query_ray_anyhit(mesh, start, direction, reach)


@wp.func
def hit_triangles(corner: wp.array[wp.vec3], start: wp.vec3, direction: wp.vec3):
    """Distance of a ray's closest hit by a test of every triangle; -1: none."""
    nearest = float(FAR)
    for triangle in range(corner.shape[0] // 3):
        first = 3 * triangle
        hit = intersect_triangle(start, direction, corner[first], corner[first + 1], corner[first + 2])
        if hit[0] >= 0.0 and hit[0] < nearest:
            nearest = hit[0]
    return wp.where(nearest < FAR, nearest, -1.0)


@wp.func_native(
    query_closest_hit.native_snippet.replace("test_boxes(a, b, c, best, entry);", "test_boxes(a, b, c, best, entry), ++visits;")
    .replace("Word stack[STACK_SIZE];", "Word stack[STACK_SIZE]; int visits = 0;")
    .replace("best_u, best_v, as_float(face)", "best_u, best_v, (float)visits")
)
def count_visits(bvh: WideBvh, root: int, start: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4:
    """The closest-hit query with the number of nodes it visited instead of the triangle."""


query_wide, query_warp, hit_every_triangle, visits_of = probe(query_bvh), probe(query_mesh), probe(hit_triangles), probe(count_visits)
