"""Broad phase of collision detection: pairs of shapes whose bounding boxes overlap and that no cached axis separates.

Newton's broad phase tests all pairs of a world's collision shapes, most of which are empty slots for objects, and its narrow phase runs
MPR and GJK on two and a half times as many pairs as have contacts. Here empty shapes are left out first, and separating axes, cached
between substeps, reject most pairs without contacts.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Safety margin beyond the distance at which contacts are generated, before a pair is rejected [m]: covers rounding at meters.
SEPARATION_MARGIN = wp.constant(1.0e-5)
# Inflation of shapes in Newton's MPR [m]: shapes closer than this may be reported as overlapping.
MPR_INFLATION = wp.constant(2.0e-4)
# Step of an axis along the subgradient of the separation. In real piles 64 of 134 pairs per world are left with 0.15, 52.5 of which have
# contacts; 66 with 0.3, 65 with 0.08, and 109 by reflections alone.
AXIS_STEP = wp.constant(0.15)
# Steps per unit of each octahedral coordinate, -1 to 1, of a packed direction.
DIRECTION_STEPS = wp.constant(32767.0)
# Height above which shapes touch nothing [m]: static ones are put there to be out of the way.
UNREACHED = wp.constant(1500.0)


@wp.struct
class ShapeData:
    """Collision shapes of all worlds: shapes per world, Newton's codes of boxes and hulls; by shape its type, hull mesh and contact gap
    [m]; by pair of shapes in a world, whether they may collide.
    """

    count: int
    box: int
    hull: int
    kind: wp.array[int]
    """Type of shape; pairs with other types than boxes and hulls are never rejected."""
    mesh: wp.array[wp.uint64]
    gap: wp.array[float]
    """Contact gap: two shapes have contacts up to the sum of their gaps and margins [m]."""
    collides: wp.array2d[wp.uint8]
    """1: the pair may collide, for a lower and a higher index of shapes in a world."""


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
#endif
""")
def synchronize_block():
    """Block-wide barrier, after which each thread sees what the others have written to memory."""
    ...


@wp.func
def boxes_overlap(lower: wp.array[wp.vec3], upper: wp.array[wp.vec3], a: int, b: int) -> bool:
    """Whether two axis-aligned bounding boxes overlap or touch."""
    return (
        lower[a][0] <= upper[b][0]
        and lower[a][1] <= upper[b][1]
        and lower[a][2] <= upper[b][2]
        and lower[b][0] <= upper[a][0]
        and lower[b][1] <= upper[a][1]
        and lower[b][2] <= upper[a][2]
    )


@wp.func
def append_pair(pair: wp.vec2i, pair_inout: wp.array[wp.vec2i], count_inout: wp.array[int]):
    """Append a pair to a list, by an atomic counter; the counter keeps growing beyond the capacity of the list."""
    index = wp.atomic_add(count_inout, 0, 1)
    if index < pair_inout.shape[0]:
        pair_inout[index] = pair


@wp.kernel
def list_overlaps_kernel(
    # Scene:
    shapes: ShapeData,
    # In:
    lower: wp.array[wp.vec3],  # (shape) [m]
    upper: wp.array[wp.vec3],  # (shape) [m]
    # Out:
    occupied_out: wp.array2d[int],  # (world, shape of a world)
    occupied_count_inout: wp.array[int],  # (world)
    pair_out: wp.array[wp.vec2i],  # (overlap)
    pair_count_inout: wp.array[int],  # (1)
):
    """All-pairs broad phase: list the pairs of shapes of each world whose bounding boxes, enlarged by gaps and margins, overlap.

    `pair_out` receives the pairs in arbitrary order, `pair_count_inout` is increased by their number, which may exceed the capacity. Shapes
    that are neither empty nor UNREACHED are first compacted to `occupied_out`. Launched over world, lane: one block of threads per world.
    """
    world, lane = wp.tid()
    first = world * shapes.count
    if lane == 0:
        occupied_count_inout[world] = 0
    synchronize_block()
    for shape in range(lane, shapes.count, wp.block_dim()):
        if lower[first + shape][0] <= upper[first + shape][0] and lower[first + shape][2] < UNREACHED:
            occupied_out[world, wp.atomic_add(occupied_count_inout, world, 1)] = shape
    synchronize_block()
    occupied = occupied_count_inout[world]
    for index in range(lane, occupied * occupied, wp.block_dim()):
        row = index // occupied
        column = index - row * occupied
        if row < column:
            one = occupied_out[world, row]
            other = occupied_out[world, column]
            a = wp.min(one, other)
            b = wp.max(one, other)
            if shapes.collides[a, b] != wp.uint8(0) and boxes_overlap(lower, upper, first + a, first + b):
                append_pair(wp.vec2i(first + a, first + b), pair_out, pair_count_inout)


@wp.kernel
def list_occupied_kernel(
    # Scene:
    shapes: ShapeData,
    # In:
    lower: wp.array[wp.vec3],  # (shape) [m]
    upper: wp.array[wp.vec3],  # (shape) [m]
    # Out:
    occupied_out: wp.array2d[int],  # (world, shape of a world)
    occupied_count_inout: wp.array[int],  # (world), zero before the launch
):
    """Stream compaction of each world's shapes that are neither empty nor UNREACHED, in arbitrary order. Launched over world, shape of a
    world."""
    world, shape = wp.tid()
    index = world * shapes.count + shape
    if lower[index][0] <= upper[index][0] and lower[index][2] < UNREACHED:
        occupied_out[world, wp.atomic_add(occupied_count_inout, world, 1)] = shape


@wp.kernel
def list_overlaps_of_shapes_kernel(
    # Scene:
    shapes: ShapeData,
    # In:
    lower: wp.array[wp.vec3],  # (shape) [m]
    upper: wp.array[wp.vec3],  # (shape) [m]
    occupied: wp.array2d[int],  # (world, shape of a world)
    occupied_count: wp.array[int],  # (world)
    # Out:
    pair_out: wp.array[wp.vec2i],  # (overlap)
    pair_count_inout: wp.array[int],  # (1)
):
    """All-pairs broad phase of worlds of many shapes: as `list_overlaps_kernel`, with a thread a shape instead of a block a world.

    Launched over world, place in the world's list of occupied shapes; a thread tests its shape against those behind it in the list.
    """
    world, row = wp.tid()
    count = occupied_count[world]
    if row >= count:
        return
    first = world * shapes.count
    one = occupied[world, row]
    low = lower[first + one]
    high = upper[first + one]
    for column in range(row + 1, count):
        other = occupied[world, column]
        other_low = lower[first + other]
        other_high = upper[first + other]
        below = low[0] <= other_high[0] and low[1] <= other_high[1] and low[2] <= other_high[2]
        if below and other_low[0] <= high[0] and other_low[1] <= high[1] and other_low[2] <= high[2]:
            a = wp.min(one, other)
            b = wp.max(one, other)
            if shapes.collides[a, b] != wp.uint8(0):
                append_pair(wp.vec2i(first + a, first + b), pair_out, pair_count_inout)


@wp.func
def find_support(shapes: ShapeData, shape: int, geometry: wp.vec4, direction: wp.vec3) -> wp.vec3:
    """Support mapping of a box or convex hull: its point farthest in a direction, both in the shape's frame [m]."""
    scale = wp.vec3(geometry[0], geometry[1], geometry[2])
    if shapes.kind[shape] == shapes.box:
        return wp.vec3(
            wp.where(direction[0] < 0.0, -scale[0], scale[0]),
            wp.where(direction[1] < 0.0, -scale[1], scale[1]),
            wp.where(direction[2] < 0.0, -scale[2], scale[2]),
        )
    mesh = wp.mesh_get(shapes.mesh[shape])
    scaled = wp.cw_mul(direction, scale)
    best = int(0)
    farthest = float(-1.0e30)
    for vertex in range(mesh.points.shape[0]):
        distance = wp.dot(mesh.points[vertex], scaled)
        if distance > farthest:
            farthest = distance
            best = vertex
    return wp.cw_mul(mesh.points[best], scale)


@wp.func
def pack_direction(direction: wp.vec3) -> wp.uint32:
    """Octahedral encoding of a unit vector in 2 x 16 bits (Cigolle et al. 2014), never 0."""
    flat = direction / (wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2]))
    x = flat[0]
    y = flat[1]
    if flat[2] < 0.0:
        x = (1.0 - wp.abs(flat[1])) * wp.where(flat[0] < 0.0, -1.0, 1.0)
        y = (1.0 - wp.abs(flat[0])) * wp.where(flat[1] < 0.0, -1.0, 1.0)
    u = wp.uint32(int(wp.round(x * DIRECTION_STEPS)) + int(DIRECTION_STEPS) + 1)
    v = wp.uint32(int(wp.round(y * DIRECTION_STEPS)) + int(DIRECTION_STEPS) + 1)
    return (u << wp.uint32(16)) | v


@wp.func
def unpack_direction(packed: wp.uint32) -> wp.vec3:
    """Unpack a unit vector from its octahedral 2 x 16 bits. Inverse of `pack_direction`."""
    x = float(int(packed >> wp.uint32(16)) - int(DIRECTION_STEPS) - 1) / DIRECTION_STEPS
    y = float(int(packed & wp.uint32(0xFFFF)) - int(DIRECTION_STEPS) - 1) / DIRECTION_STEPS
    z = 1.0 - wp.abs(x) - wp.abs(y)
    if z < 0.0:
        folded = (1.0 - wp.abs(y)) * wp.where(x < 0.0, -1.0, 1.0)
        y = (1.0 - wp.abs(x)) * wp.where(y < 0.0, -1.0, 1.0)
        x = folded
    return wp.normalize(wp.vec3(x, y, z))


@wp.func
def improve_axis(axis: wp.vec3, between: wp.vec3) -> wp.vec3:
    """Next candidate for a separating axis, after one that does not separate two shapes, or not far enough.

    If their projections overlap, the axis is reflected in the plane perpendicular to the difference of the support points (Chung and Wang
    1996): repeated over substeps, this finds a separating axis if there is one. If they are separated by too little, it takes a small step
    along that difference, a subgradient of the separation. Without a difference it stays.

    Args:
        axis: The axis, a unit vector.
        between: From the support point of the first shape to that of the second one [m].
    """
    if wp.length_sq(between) == 0.0:
        return axis
    along = wp.normalize(between)
    if wp.dot(along, axis) < 0.0:
        return wp.normalize(axis - 2.0 * wp.dot(along, axis) * along)
    return wp.normalize(axis + AXIS_STEP * along)


@wp.kernel
def reject_separated_kernel(
    # Scene:
    shapes: ShapeData,
    threads: int,
    # State:
    axis_inout: wp.array2d[wp.uint32],  # (world, pair of shapes)
    # In:
    pose: wp.array[wp.transform],  # (shape) shape to world [m]
    geometry: wp.array[wp.vec4],  # (shape) [m]: scale of a hull or half extents of a box, and margin
    lower: wp.array[wp.vec3],  # (shape) [m]
    upper: wp.array[wp.vec3],  # (shape) [m]
    overlap: wp.array[wp.vec2i],  # (overlap)
    overlap_count: wp.array[int],  # (1)
    # Out:
    pair_out: wp.array[wp.vec2i],  # (pair)
    pair_count_inout: wp.array[int],  # (1)
):
    """Separating-axis test with temporal coherence: keep the overlaps whose cached axis does not separate their shapes.

    `pair_out` receives the candidate pairs in arbitrary order, `pair_count_inout` is increased by their number. Shapes are separated if
    they are farther apart along the axis than their gaps and margins. The axis of a pair is a unit vector in the frame of its first shape,
    kept from substep to substep: it still separates shapes that have moved little. A new pair starts with the axis between the centers of
    the bounding boxes; an axis that does not separate is improved for the next substep. Whatever the axis, only pairs that can have no
    contact are rejected. Launched over a fixed number of threads, which stride over the overlaps.
    """
    thread = wp.tid()
    for index in range(thread, wp.min(overlap_count[0], overlap.shape[0]), threads):
        a = overlap[index][0]
        b = overlap[index][1]
        world = a // shapes.count
        row = a - world * shapes.count
        slot = row * (2 * shapes.count - row - 1) // 2 + b - a - 1
        separated = bool(False)
        convex_a = shapes.kind[a] == shapes.hull or shapes.kind[a] == shapes.box
        if convex_a and (shapes.kind[b] == shapes.hull or shapes.kind[b] == shapes.box):
            packed = axis_inout[world, slot]
            axis = unpack_direction(packed)
            to_a = wp.transform_inverse(pose[a])
            if packed == wp.uint32(0):
                between = wp.transform_vector(to_a, lower[b] + upper[b] - lower[a] - upper[a])
                axis = wp.where(wp.length_sq(between) > 0.0, wp.normalize(between), wp.vec3(0.0, 0.0, 1.0))
            to_b = wp.transform_multiply(wp.transform_inverse(pose[b]), pose[a])
            point_a = find_support(shapes, a, geometry[a], axis)
            point_b = find_support(shapes, b, geometry[b], -wp.transform_vector(to_b, axis))
            between = wp.transform_point(wp.transform_inverse(to_b), point_b) - point_a
            reach = shapes.gap[a] + shapes.gap[b] + geometry[a][3] + geometry[b][3]
            separated = wp.dot(between, axis) > wp.max(reach, MPR_INFLATION) + SEPARATION_MARGIN
            if not separated:
                axis = improve_axis(axis, between)
            if not separated or packed == wp.uint32(0):
                axis_inout[world, slot] = pack_direction(axis)
        if not separated:
            append_pair(overlap[index], pair_out, pair_count_inout)
