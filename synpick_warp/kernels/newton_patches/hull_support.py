"""Support mapping of a convex hull: the vertex farthest in a direction, by a scan of all vertices with wide loads.

Newton scans them with three loads of 4 bytes for each vertex. The threads of a warp test different pairs of shapes, so a load touches as
many cache lines as there are threads, and the loads are what GJK, MPR and manifolds wait for. Here six loads of 16 bytes bring eight
vertices, and the eight dot products are compared as a tree. The vertex is the same: products are summed in the same order, and of vertices
at the same distance the first counts.
"""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func_native("""
    // The mesh's address in three numbers of 22 bits, as Newton packs it.
    const uint64_t id = uint64_t(packed[0]) | uint64_t(packed[1]) << 22 | uint64_t(packed[2]) << 44;
    const wp::Mesh mesh = wp::mesh_get(id);
    const wp::vec3* vertices = mesh.points.data;
    const int count = mesh.points.shape[0];
    int farthest = 0, vertex = 0;
    float distance = -1.0e10f;
#if defined(__CUDA_ARCH__)
    const auto project = [&](float x, float y, float z) {
        return __fmaf_rn(z, direction[2], __fmaf_rn(x, direction[0], __fmul_rn(y, direction[1])));
    };
    const float4* words = reinterpret_cast<const float4*>(vertices);
    if (reinterpret_cast<uint64_t>(vertices) % sizeof(float4) == 0) {
#pragma unroll 1
        for (int first = 0; first + 4 <= count; first += 8, words += 6) {
            // Of the last four, if they are alone, a second copy.
            const float4* more = first + 8 <= count ? words + 3 : words;
            const float4 a = __ldg(words), b = __ldg(words + 1), c = __ldg(words + 2);
            const float4 d = __ldg(more), e = __ldg(more + 1), f = __ldg(more + 2);
            const float p[8] = {project(a.x, a.y, a.z), project(a.w, b.x, b.y), project(b.z, b.w, c.x), project(c.y, c.z, c.w),
                                project(d.x, d.y, d.z), project(d.w, e.x, e.y), project(e.z, e.w, f.x), project(f.y, f.z, f.w)};
            const float most = fmaxf(fmaxf(fmaxf(p[0], p[1]), fmaxf(p[2], p[3])), fmaxf(fmaxf(p[4], p[5]), fmaxf(p[6], p[7])));
            if (most > distance) {
                distance = most;
                farthest = first + 7;
#pragma unroll
                for (int k = 6; k >= 0; --k) if (p[k] == most) farthest = first + k;
            }
        }
        vertex = count & ~3;
    }
#endif
    for (; vertex < count; ++vertex) {
        const float candidate = wp::dot(vertices[vertex], direction);
        if (candidate > distance) {
            distance = candidate;
            farthest = vertex;
        }
    }
    return vertices[farthest];
""")
def find_farthest(packed: wp.vec3, direction: wp.vec3) -> wp.vec3:
    """Vertex of a mesh farthest in `direction`; packed: the mesh's address, as Newton packs it."""
    ...


@wp.func
def map_support(geom: Any, direction: wp.vec3) -> wp.vec3:
    """Support point of a convex mesh in its frame; geom: Newton's `GenericShapeData` of a shape of the type `CONVEX_MESH`."""
    return wp.cw_mul(find_farthest(geom.auxiliary, wp.cw_mul(direction, geom.scale)), geom.scale)
