"""Wide BVH (BVH4): ray queries against meshes, with four children per node and quantized bounding boxes.

The layout follows the eight-wide BVH of Ylitalo, Karras and Laine (2017). A node takes 64 bytes. A ray tests four boxes per node, so its
chain of dependent memory accesses is half as long as in a binary BVH. Each leaf is one triangle; triangles are stored in leaf order.

The hits are exactly those of testing every triangle with Warp's watertight ray/triangle test (Woop, Benthin and Wald, 2013).
`wp.mesh_query_ray` misses a few of them, because its slab test does not account for rounding. If several triangles are hit at the same
distance, as along a shared edge, any of them may be returned.

`stages.render.wide_bvh` builds the trees.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

WIDTH = wp.constant(4)
"""Children per node."""
NODE_RECORDS = wp.constant(4)
"""Number of 16-byte records per node."""
LEAF = wp.constant(0x80000000)
"""Flag of a child reference that marks a leaf. The other bits index the triangle in `WideBvh.triangle`, or the child node."""
STACK_SIZE = wp.constant(64)
"""Capacity of the traversal stack, in child references."""
NO_HIT = wp.constant(0xFFFFFFFF)
"""Sort key of a box that the ray misses, and triangle index of a query without a hit."""
MIN_COMPONENT = wp.constant(1.0e-20)
"""Smallest absolute component of a ray's direction in the slab test. Smaller ones have an infinite reciprocal, which times zero is NaN."""
FAR_SCALE = wp.constant(1.000001)
"""Scale of the distance at which a ray leaves a box, some 8 ulp above 1: rounding never loses a box that the ray touches (Ize, 2013)."""


@wp.struct
class WideBvh:
    """Quantized nodes, triangles and roots of the wide BVHs of all meshes, each in the frame of its mesh. Constant."""

    node: wp.array[wp.vec4ui]
    """(NODE_RECORDS x node): record 0: origin of the quantization grid (x, y, z) as float32 [m], and per axis the 8-bit exponent e of its
    step, 2^(e - 127) m. Record 1: lower x, y, z and upper x of the children's boxes, 8 bits per child [steps]. Record 2: upper y, upper z;
    references to children 0 and 1. Record 3: references to children 2 and 3; two unused words. An absent child has an inverted box, from
    255 to 0, and refers to the mesh's first triangle."""
    triangle: wp.array[wp.vec4]
    """(3 x triangle): corner position [m]. The fourth component of the first corner is the triangle's index within its mesh, as bits."""
    root: wp.array[int]
    """(mesh): index of the root node."""


_CONSTANTS = f"""
    typedef unsigned int Word;
    constexpr Word LEAF = {int(LEAF)}u, NO_HIT = {int(NO_HIT)}u, RECORDS = {int(NODE_RECORDS)}u;
    constexpr int WIDTH = {int(WIDTH)}, STACK_SIZE = {int(STACK_SIZE)};
    constexpr float MIN_COMPONENT = {float(MIN_COMPONENT)}f, FAR_SCALE = {float(FAR_SCALE)}f;
"""
"""The constants above, in C++."""
_TRAVERSAL = (
    _CONSTANTS
    + """
    struct alignas(16) Words { Word x, y, z, w; };
    struct alignas(16) Floats { float x, y, z, w; };
    union Bits { float real; Word word; };
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
    auto reciprocal = [](float d) {
        return 1.0f / (d > -MIN_COMPONENT && d < MIN_COMPONENT ? (d < 0.0f ? -MIN_COMPONENT : MIN_COMPONENT) : d);
    };
    const float rx = reciprocal(direction[0]), ry = reciprocal(direction[1]), rz = reciprocal(direction[2]);
    // Slab test of a node's boxes. A child's sort key is its entry distance with the child's number in the two lowest bits, or NO_HIT.
    auto test_boxes = [&](const Words& a, const Words& b, const Words& c, float reach, Word (&entry)[WIDTH]) {
        const float sx = as_float((a.w & 255u) << 23) * rx, ox = (as_float(a.x) - start[0]) * rx;
        const float sy = as_float((a.w >> 8 & 255u) << 23) * ry, oy = (as_float(a.y) - start[1]) * ry;
        const float sz = as_float((a.w >> 16 & 255u) << 23) * rz, oz = (as_float(a.z) - start[2]) * rz;
        const Word near_x = rx < 0.0f ? b.w : b.x, far_x = rx < 0.0f ? b.x : b.w;
        const Word near_y = ry < 0.0f ? c.x : b.y, far_y = ry < 0.0f ? b.y : c.x;
        const Word near_z = rz < 0.0f ? c.y : b.z, far_z = rz < 0.0f ? b.z : c.y;
    #pragma unroll
        for (int i = 0; i < WIDTH; ++i) {
            const float near_xy = larger(byte(near_x, i) * sx + ox, byte(near_y, i) * sy + oy);
            const float far_xy = smaller(byte(far_x, i) * sx + ox, byte(far_y, i) * sy + oy);
            const float enter = larger(near_xy, larger(byte(near_z, i) * sz + oz, 0.0f));
            const float leave = smaller(far_xy, smaller(byte(far_z, i) * sz + oz, reach));
            entry[i] = enter <= FAR_SCALE * leave ? (as_word(enter) & ~3u) | i : NO_HIT;
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
)
"""Start of both queries, in C++: slab test, triangle test and traversal stack. Parameters are those of `query_closest_hit`."""


@wp.func_native(
    _TRAVERSAL
    + """
    Word entry[WIDTH];
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
            const Words* const node = nodes + RECORDS * current;
            const Words a = node[0], b = node[1], c = node[2], d = node[3];
            test_boxes(a, b, c, best, entry);
            // Sorting network: nearest child first.
            order(0, 1), order(2, 3), order(0, 2), order(1, 3), order(1, 2);
            auto child = [&](Word number) { return number & 2u ? (number & 1u ? d.y : d.x) : (number & 1u ? c.w : c.z); };
    #pragma unroll
            for (int i = WIDTH - 1; i > 0; --i)
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
    """Closest-hit query of a ray against one mesh, given by its root node. Returns (t, u, v, i): distance in units of |direction|, 0 <= t <
    `reach`, or -1 if there is no hit; barycentric weights of the first and second corner; triangle index within the mesh, as bits."""
    ...


@wp.func_native(
    _TRAVERSAL
    + """
    Word entry[WIDTH];
    while (true) {
        if (current & LEAF) {
            if (test_triangle(current, reach))
                return true;
        } else {
            const Words* const node = nodes + RECORDS * current;
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
    """Any-hit query of a shadow ray against one mesh: True if it is hit. Parameters are those of `query_closest_hit`."""
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
    """Copy one node of the binary BVH of a `wp.Mesh`, which Warp's Python API does not expose. See `read_binary_bvh_kernel`."""
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
    """Copy the binary BVH of a `wp.Mesh`: bounding boxes and child indices of its nodes, triangle indices in leaf order, root index.

    A leaf stores its range [begin, end) of `triangle_out` as children (-1 - begin, -1 - end). Rows past the last node are not written.
    Launched over node of the binary BVH.
    """
    read_binary_node(mesh, wp.tid(), lower_out, upper_out, children_out, triangle_out, root_out)
