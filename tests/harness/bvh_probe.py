"""Test kernels of ray queries: those of the wide BVH, and Warp's own, their reference."""

import warp as wp

from synpick_warp.kernels.render.visibility.wide_bvh import WideBvh, query_any_hit, query_closest_hit

wp.set_module_options({"enable_backward": False})


@wp.kernel
def query_wide_bvh_kernel(
    # Scene:
    bvh: WideBvh,
    # In:
    mesh: int,
    start: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    reach: float,
    # Out:
    hit_out: wp.array[wp.vec3],  # (ray)
    face_out: wp.array[int],  # (ray)
    blocked_out: wp.array[int],  # (ray)
):
    """Query the wide BVH of a mesh: (t, u, v) and triangle of the closest hit, -1 for none, and whether there is any."""
    ray = wp.tid()
    hit = query_closest_hit(bvh, bvh.root[mesh], start[ray], direction[ray], reach)
    hit_out[ray] = wp.vec3(hit[0], hit[1], hit[2])
    face_out[ray] = wp.cast(hit[3], int)
    blocked_out[ray] = int(query_any_hit(bvh, bvh.root[mesh], start[ray], direction[ray], reach))


@wp.kernel
def query_mesh_kernel(
    # Scene:
    mesh: wp.uint64,
    # In:
    start: wp.array[wp.vec3],  # (ray)
    direction: wp.array[wp.vec3],  # (ray)
    reach: float,
    # Out:
    hit_out: wp.array[wp.vec3],  # (ray)
    face_out: wp.array[int],  # (ray)
    blocked_out: wp.array[int],  # (ray)
):
    """The same by Warp's queries of a mesh."""
    ray = wp.tid()
    hit_out[ray] = wp.vec3(-1.0, 0.0, 0.0)
    face_out[ray] = -1
    query = wp.mesh_query_ray(mesh, start[ray], direction[ray], reach)
    if query.result:
        hit_out[ray] = wp.vec3(query.t, query.u, query.v)
        face_out[ray] = query.face
    blocked_out[ray] = int(wp.mesh_query_ray_anyhit(mesh, start[ray], direction[ray], reach))
