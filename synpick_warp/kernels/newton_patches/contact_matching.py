"""Matching of contacts between substeps: those that Newton's matching leaves without a partner, and so without a warm start, get one.

Newton lets each contact choose the nearest of the last substep's contacts of its two shapes, and if two choose the same one, the farther
one starts without impulse. Its narrow phase writes contacts twice where an edge lies on a face: once as an end of the clipped edge, once
as the deepest point. Both choose the same one, so that up to half of the load of that edge is lost in every substep. Other contacts lose
theirs where a manifold has other corners than before.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

BROKEN = wp.constant(-2)
"""Newton's code of a contact without a partner, of shapes that had contacts in the last substep."""


@wp.struct
class ContactHistory:
    """Contacts of the last substep, sorted by key: their number, keys, and midpoints and normals in the world's frame."""

    count: wp.array[int]
    """(one)"""
    key: wp.array[wp.int64]
    """Shapes of a contact, and in the low bits `pair_bits` its place among theirs (contact)."""
    position: wp.array[wp.vec3]
    """(contact) [m]"""
    normal: wp.array[wp.vec3]
    """(contact)"""
    pair_bits: wp.int64
    """Mask of the low bits of a key."""


@wp.func
def find_pair(keys: wp.array[wp.int64], count: int, pair: wp.int64) -> int:
    """Index of the first of `count` ascending keys that is not below `pair`, by binary search."""
    low = int(0)
    high = count
    while low < high:
        middle = (low + high) // 2
        if keys[middle] < pair:
            low = middle + 1
        else:
            high = middle
    return low


@wp.func
def world_point(body_q: wp.array[wp.transform], body: int, point: wp.vec3) -> wp.vec3:
    """Point of a body in the world's frame [m]; static bodies (-1) have that frame."""
    if body < 0:
        return point
    return wp.transform_point(body_q[body], point)


@wp.func
def is_taken(match: wp.array[int], first: int, end: int, previous: int) -> bool:
    """Whether one of the contacts from `first` to before `end` has the partner `previous`."""
    for contact in range(first, end):
        if match[contact] == previous:
            return True
    return False


@wp.kernel
def complete_matching_kernel(
    # Scene:
    shape_body: wp.array[int],  # (shape)
    max_distance: float,
    min_alignment: float,
    # State:
    history: ContactHistory,
    body_q: wp.array[wp.transform],  # (body) [m]
    # In:
    count: wp.array[int],  # (one)
    key: wp.array[wp.int64],  # (contact)
    shape0: wp.array[int],  # (contact)
    shape1: wp.array[int],  # (contact)
    point0: wp.array[wp.vec3],  # (contact) [m]
    point1: wp.array[wp.vec3],  # (contact) [m]
    normal: wp.array[wp.vec3],  # (contact)
    # Out:
    match_inout: wp.array[int],  # (contact)
):
    """Greedy matching: each BROKEN contact gets the nearest contact of the last substep that no other one of its two shapes has.

    Only one at most `max_distance` [m] away whose normal is within `min_alignment` (a cosine). `match_inout` receives its index. Launched
    over contact; the first contact of two shapes matches all of theirs, in their order.
    """
    first = wp.tid()
    total = wp.min(count[0], key.shape[0])
    if first >= total:
        return
    pair = key[first] & ~history.pair_bits
    if first > 0 and (key[first - 1] & ~history.pair_bits) == pair:
        return
    end = int(first)
    broken = bool(False)
    while end < total and (key[end] & ~history.pair_bits) == pair:
        broken = broken or match_inout[end] == BROKEN
        end += 1
    if not broken:
        return
    previous_count = wp.min(history.count[0], history.key.shape[0])
    start = find_pair(history.key, previous_count, pair)
    for contact in range(first, end):
        if match_inout[contact] == BROKEN:
            one = world_point(body_q, shape_body[shape0[contact]], point0[contact])
            other = world_point(body_q, shape_body[shape1[contact]], point1[contact])
            nearest = float(max_distance)
            best = int(BROKEN)
            previous = int(start)
            while previous < previous_count and (history.key[previous] & ~history.pair_bits) == pair:
                distance = wp.length(0.5 * (one + other) - history.position[previous])
                aligned = wp.dot(normal[contact], history.normal[previous]) >= min_alignment
                if distance < nearest and aligned and not is_taken(match_inout, first, end, previous):
                    nearest = distance
                    best = previous
                previous += 1
            match_inout[contact] = best
