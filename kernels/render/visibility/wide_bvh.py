"""Wide BVH (BVH4): ray queries against meshes by hierarchies with four children per node and quantized boxes, after the eight-wide ones of
Ylitalo, Karras and Laine (2017).

A node is 64 bytes, so that a ray tests four boxes per memory access, and the chain of accesses that depend on each other is half as long
as in a binary BVH. A leaf is one triangle; its corners are stored in the order of the leaves. Hits are those of testing every triangle with
Warp's watertight test (Woop, Benthin and Wald, 2013), to the last bit. `wp.mesh_query_ray` loses a few of them, since its box test allows
for no rounding. Of triangles hit at the same distance, as along a shared edge, either may be returned. `stages.render.wide_bvh` builds the
trees.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

WIDTH = wp.constant(4)
"""Children of a node."""
NODE_RECORDS = wp.constant(4)
"""Records of 16 bytes of a node."""
LEAF = wp.constant(0x80000000)
"""Bit of a child reference that marks a leaf. Its other bits are the index of the triangle in `WideBvh.triangle`, or else that
of the child's node."""
STACK_SIZE = wp.constant(64)
"""Size of the traversal stack: the most children that a query can postpone."""


@wp.struct
class WideBvh:
    """Wide BVHs of all meshes, each in its mesh's frame. Constant."""

    node: wp.array[wp.vec4ui]
    """(NODE_RECORDS x node): record 0: a corner (x, y, z) of the node's box as float32 [m]; per axis the exponent e, 8 bits, of the
    quantization step 2^(e - 127) m. Record 1: lower x, lower y, lower z, upper x of the children's boxes [steps from the corner], 8 bits
    per child. Record 2: upper y, upper z; references to children 0 and 1. Record 3: to children 2 and 3; unused. An absent child has
    an inverted box, from 255 to 0, and refers to the mesh's first triangle."""
    triangle: wp.array[wp.vec4]
    """(3 x triangle): a corner [m]; in the fourth number of the first corner the triangle's index within its mesh, as bits."""
    root: wp.array[int]
    """(mesh): index of the root node."""


_TRAVERSAL = """
    typedef unsigned int Word;
    struct alignas(16) Words { Word x, y, z, w; };
    struct alignas(16) Floats { float x, y, z, w; };
    union Bits { float real; Word word; };
    constexpr Word LEAF = 0x80000000u, NO_HIT = 0xFFFFFFFFu;
    constexpr int STACK_SIZE = 64;
    const Words* const nodes = reinterpret_cast<const Words*>(bvh.node.data);
    const Floats* const corners = reinterpret_cast<const Floats*>(bvh.triangle.data);
    auto as_float = [](Word word) { Bits bits; bits.word = word; return bits.real; };
    auto as_word = [](float real) { Bits bits; bits.real = real; return bits.word; };
    auto byte = [](Word word, int i) { return (float)((word >> (8 * i)) & 255u); };
#ifdef __CUDA_ARCH__
    auto smaller = [](float a, float b) { return fminf(a, b); };
    auto larger = [](float a, float b) { return fmaxf(a, b); };
#else
    auto smaller = [](float a, float b) { return a < b ? a : b; };
    auto larger = [](float a, float b) { return a < b ? b : a; };
#endif
    // Smaller components are replaced: their reciprocals would be infinite, and zero times infinity is no number.
    auto reciprocal = [](float d) { return 1.0f / (d > -1.0e-20f && d < 1.0e-20f ? (d < 0.0f ? -1.0e-20f : 1.0e-20f) : d); };
    const float rx = reciprocal(direction[0]), ry = reciprocal(direction[1]), rz = reciprocal(direction[2]);
    // Slab test of a node's boxes: the distance at which the ray enters each, with the child's number in its last two bits, or NO_HIT.
    // The far end is enlarged by some 8 ulp (Ize, 2013) against rounding far from the boxes, as the builder's MARGIN is near them.
    auto test_boxes = [&](const Words& a, const Words& b, const Words& c, float reach, Word (&entry)[4]) {
        const float sx = as_float((a.w & 255u) << 23) * rx, ox = (as_float(a.x) - start[0]) * rx;
        const float sy = as_float((a.w >> 8 & 255u) << 23) * ry, oy = (as_float(a.y) - start[1]) * ry;
        const float sz = as_float((a.w >> 16 & 255u) << 23) * rz, oz = (as_float(a.z) - start[2]) * rz;
        const Word near_x = rx < 0.0f ? b.w : b.x, far_x = rx < 0.0f ? b.x : b.w;
        const Word near_y = ry < 0.0f ? c.x : b.y, far_y = ry < 0.0f ? b.y : c.x;
        const Word near_z = rz < 0.0f ? c.y : b.z, far_z = rz < 0.0f ? b.z : c.y;
    #pragma unroll
        for (int i = 0; i < 4; ++i) {
            const float near_xy = larger(byte(near_x, i) * sx + ox, byte(near_y, i) * sy + oy);
            const float far_xy = smaller(byte(far_x, i) * sx + ox, byte(far_y, i) * sy + oy);
            const float enter = larger(near_xy, larger(byte(near_z, i) * sz + oz, 0.0f));
            const float leave = smaller(far_xy, smaller(byte(far_z, i) * sz + oz, reach));
            entry[i] = enter <= 1.000001f * leave ? (as_word(enter) & ~3u) | i : NO_HIT;
        }
    };
    float t, u, v;
    auto test_triangle = [&](Word leaf, float reach) {
        const Floats* const corner = corners + 3 * (leaf & ~LEAF);
        const Floats a = corner[0], b = corner[1], c = corner[2];
        const wp::vec3 p(a.x, a.y, a.z), q(b.x, b.y, b.z), r(c.x, c.y, c.z);
        float sign;
        wp::vec3 normal;
        return wp::intersect_ray_tri_woop(start, direction, p, q, r, t, u, v, sign, &normal) && t < reach && t >= 0.0f;
    };
    Word stack[STACK_SIZE];
    int size = 0;
    Word current = root;
"""
"""C++ that both queries begin with: reciprocal direction, tests of boxes and triangles, stack; parameters as in `query_closest_hit`."""


@wp.func_native(
    _TRAVERSAL
    + """
    Word entry[4];
    auto order = [&](int i, int j) {
        const Word low = entry[i] < entry[j] ? entry[i] : entry[j], high = entry[i] < entry[j] ? entry[j] : entry[i];
        entry[i] = low;
        entry[j] = high;
    };
    float best = reach, best_u = 0.0f, best_v = 0.0f;
    Word face = NO_HIT;
    while (true) {
        if (current & LEAF) {
            if (test_triangle(current, best))
                best = t, best_u = u, best_v = v, face = as_word(corners[3 * (current & ~LEAF)].w);
        } else {
            const Words* const node = nodes + 4 * current;
            const Words a = node[0], b = node[1], c = node[2], d = node[3];
            test_boxes(a, b, c, best, entry);
            // A sorting network of five comparisons: nearest first.
            order(0, 1), order(2, 3), order(0, 2), order(1, 3), order(1, 2);
            auto child = [&](Word number) { return number & 2u ? (number & 1u ? d.y : d.x) : (number & 1u ? c.w : c.z); };
    #pragma unroll
            for (int i = 3; i > 0; --i)
                if (entry[i] != NO_HIT)
                    stack[size++] = child(entry[i]);
            if (entry[0] != NO_HIT) {
                current = child(entry[0]);
                continue;
            }
        }
        if (size == 0)
            return wp::vec4(face == NO_HIT ? -1.0f : best, best_u, best_v, as_float(face));
        current = stack[--size];
    }
"""
)
def query_closest_hit(bvh: WideBvh, root: int, start: wp.vec3, direction: wp.vec3, reach: float) -> wp.vec4:
    """Closest hit of a ray with the mesh of a root node: (t, u, v, triangle's index within the mesh as bits); t < 0: none.

    u and v are the barycentric weights of the first and second corner. Hits have 0 <= t < `reach`, both in units of |direction|.
    """
    ...


@wp.func_native(
    _TRAVERSAL
    + """
    Word entry[4];
    while (true) {
        if (current & LEAF) {
            if (test_triangle(current, reach))
                return true;
        } else {
            const Words* const node = nodes + 4 * current;
            const Words a = node[0], b = node[1], c = node[2], d = node[3];
            test_boxes(a, b, c, reach, entry);
            if (entry[0] != NO_HIT)
                stack[size++] = c.z;
            if (entry[1] != NO_HIT)
                stack[size++] = c.w;
            if (entry[2] != NO_HIT)
                stack[size++] = d.x;
            if (entry[3] != NO_HIT)
                stack[size++] = d.y;
        }
        if (size == 0)
            return false;
        current = stack[--size];
    }
"""
)
def query_any_hit(bvh: WideBvh, root: int, start: wp.vec3, direction: wp.vec3, reach: float) -> bool:
    """Any-hit query (occlusion): True if a ray hits the mesh of a root node. Parameters as in `query_closest_hit`."""
    ...


@wp.func_native("""
    const wp::BVH bvh = wp::mesh_get(mesh).bvh;
    if (node >= bvh.num_nodes)
        return;
    const wp::BVHPackedNodeHalf low = bvh.node_lowers[node], high = bvh.node_uppers[node];
    lower_out.data[node] = wp::vec3(low.x, low.y, low.z);
    upper_out.data[node] = wp::vec3(high.x, high.y, high.z);
    children_out.data[node] = low.b ? wp::vec_t<2, int>(-1 - (int)low.i, -1 - (int)high.i) : wp::vec_t<2, int>(low.i, high.i);
    if (low.b)
        for (unsigned int i = low.i; i < high.i; ++i)
            triangle_out.data[i] = bvh.primitive_indices[i];
    if (node == 0)
        root_out.data[0] = *bvh.root;
""")
def read_binary_node(
    mesh: wp.uint64,
    node: int,
    lower_out: wp.array[wp.vec3],
    upper_out: wp.array[wp.vec3],
    children_out: wp.array[wp.vec2i],
    triangle_out: wp.array[int],
    root_out: wp.array[int],
):
    """Copy a node of the binary BVH of a `wp.Mesh`, for which Warp has no public function. Arrays as in `read_binary_bvh_kernel`."""
    ...


@wp.kernel
def read_binary_bvh_kernel(
    # In:
    mesh: wp.uint64,
    # Out:
    lower_out: wp.array[wp.vec3],  # (node) [m]
    upper_out: wp.array[wp.vec3],  # (node) [m]
    children_out: wp.array[wp.vec2i],  # (node)
    triangle_out: wp.array[int],  # (triangle)
    root_out: wp.array[int],  # (1)
):
    """Copy the binary BVH of a `wp.Mesh`: boxes and children of its nodes, triangles in the order of its leaves, index of its root.

    A leaf of the triangles [begin, end) of this order has children (-1 - begin, -1 - end). Rows past the last node are not written.
    """
    read_binary_node(mesh, wp.tid(), lower_out, upper_out, children_out, triangle_out, root_out)
