"""Contact history: the data of a world's contacts that Newton's collision pipeline and solver keep from one step for the next.

Newton keeps the contacts of all worlds in one list sorted by shape, so that those of a world are consecutive. Saving and loading copies
this segment to another list and renumbers the indices of shapes, bodies and contacts in it. In a saved list, worlds count from 0.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# Sort key behind the last contact or pair of bodies: Newton's sentinel.
LAST = wp.constant(wp.int64(0x7FFFFFFFFFFFFFFF))
# Threads that copy a world's contacts.
LANES = wp.constant(64)


@wp.struct
class ContactHistory:
    """History of a list of contacts, and of the friction patches, whose pairs of bodies are sorted apart, at other indices."""

    key: wp.array[wp.int64]
    """(contact): sort key of the matcher: two shapes, and which of their contacts."""
    midpoint: wp.array[wp.vec3]
    """(contact): point halfway between the two surfaces [m]."""
    normal: wp.array[wp.vec3]
    """(contact): contact normal."""
    dense_slot: wp.array[int]
    """(contact): index of the first joint-space constraint row; -1: none."""
    free_slot: wp.array[int]
    """(contact): index of the first row among those of free bodies; -1: none."""
    propagation_slot: wp.array[int]
    """(contact): index of the first row among those of graph-colored contacts; -1: none."""
    solved_normal: wp.array[wp.vec3]
    """(contact): contact normal at the last solve."""
    pair: wp.array[wp.int64]
    """(pair): two bodies, 1 + index each, or behind all bodies 1 + index of a static shape; ascending."""
    pair_contact: wp.array[int]
    """(pair): index of the contact."""
    patch_normal: wp.array[wp.vec3]
    """(contact): normal in the frame of the first body, if `valid`."""
    displacement: wp.array[wp.vec3]
    """(contact): displacement of the friction spring [m]."""
    friction: wp.array[wp.vec2]
    """(contact): coefficients of friction of the two shapes."""
    body_a: wp.array[int]
    """(contact): index of the first body; -1: static."""
    body_b: wp.array[int]
    """(contact): index of the second body; -1: static."""
    shape_a: wp.array[int]
    """(contact): index of the first shape."""
    shape_b: wp.array[int]
    """(contact): index of the second shape."""
    owner: wp.array[int]
    """(contact): index of the contact that represents its friction patch; -1: none."""
    anchor_a: wp.array[wp.vec3]
    """(contact): friction anchor in the first body's frame [m]."""
    anchor_b: wp.array[wp.vec3]
    """(contact): friction anchor in the second body's frame [m]."""
    surface_a: wp.array[wp.vec3]
    """(contact): contact point on the first surface, in the frame of its body [m]."""
    surface_b: wp.array[wp.vec3]
    """(contact): contact point on the second surface, in the frame of its body [m]."""
    valid: wp.array[int]
    """(contact): 1 if the contact is an anchor of its patch."""
    tangent_impulse: wp.array[wp.vec3]
    """(contact): tangential impulse [N·s]."""


@wp.struct
class ContactNumbers:
    """How a list numbers shapes, bodies and contacts: those of each world, 0 where all worlds count from 0; all bodies; bits of a matcher's
    key.
    """

    shapes: int
    bodies: int
    all_bodies: int
    contacts: int
    """1: contacts are numbered through all worlds; 0: from 0 in each."""
    shape_bits: int
    """Bits of a shape in a key ..."""
    contact_bits: int
    """... and those of the contact within its pair of shapes, the low ones."""


@wp.func
def renumber(value: int, shift: int) -> int:
    """Number of a shape, body or contact after a shift; a negative one stays: there is none."""
    if value < 0:
        return value
    return value + shift


@wp.func
def renumber_key(key: wp.int64, source: ContactNumbers, target: ContactNumbers, shift: int) -> wp.int64:
    """Sort key of the matcher with its two shapes shifted."""
    one = wp.int64(1)
    bits = wp.int64(source.shape_bits)
    low = wp.int64(source.contact_bits)
    mask = (one << bits) - one
    first = ((key >> (low + bits)) & mask) + wp.int64(shift)
    second = ((key >> low) & mask) + wp.int64(shift)
    contact = key & ((one << low) - one)
    low = wp.int64(target.contact_bits)
    return (first << (low + wp.int64(target.shape_bits))) | (second << low) | contact


@wp.func
def renumber_end(end: int, source: ContactNumbers, target: ContactNumbers, shapes: int, bodies: int) -> int:
    """One end of a pair: a body, or a static shape behind all bodies, shifted."""
    if end <= source.all_bodies:
        return end + bodies
    return end - source.all_bodies + target.all_bodies + shapes


@wp.func
def renumber_pair(pair: wp.int64, source: ContactNumbers, target: ContactNumbers, shapes: int, bodies: int) -> wp.int64:
    """Pair of bodies with both ends shifted."""
    half = wp.int64(32)
    first = renumber_end(int(pair >> half), source, target, shapes, bodies)
    second = renumber_end(int(pair & wp.int64(0xFFFFFFFF)), source, target, shapes, bodies)
    return (wp.int64(first) << half) | wp.int64(second)


@wp.func
def copy_anchor(source: ContactHistory, one: int, target_out: ContactHistory, other: int):
    """Copy the anchor of a contact; where there is none, zeros in place of what nobody reads."""
    none = wp.vec3(0.0, 0.0, 0.0)
    is_anchor = source.valid[one] != 0
    target_out.patch_normal[other] = wp.where(is_anchor, source.patch_normal[one], none)
    target_out.displacement[other] = wp.where(is_anchor, source.displacement[one], none)
    target_out.anchor_a[other] = wp.where(is_anchor, source.anchor_a[one], none)
    target_out.anchor_b[other] = wp.where(is_anchor, source.anchor_b[one], none)
    target_out.surface_a[other] = wp.where(is_anchor, source.surface_a[one], none)
    target_out.surface_b[other] = wp.where(is_anchor, source.surface_b[one], none)
    target_out.tangent_impulse[other] = wp.where(is_anchor, source.tangent_impulse[one], none)


@wp.kernel
def find_contacts_kernel(
    # Scene:
    numbers: ContactNumbers,
    # In:
    key: wp.array[wp.int64],  # (contact)
    contact_count: wp.array[int],  # (one)
    # Out:
    start_out: wp.array[int],  # (world + 1)
):
    """Find the first contact of each world by binary search; the last entry is their number. Launched over world + 1."""
    world = wp.tid()
    shape = wp.int64(world) * wp.int64(numbers.shapes)
    first = shape << wp.int64(numbers.contact_bits + numbers.shape_bits)
    low = int(0)
    high = wp.min(contact_count[0], key.shape[0])
    if world + 1 == start_out.shape[0]:
        low = high
    while low < high:
        middle = (low + high) // 2
        if key[middle] < first:
            low = middle + 1
        else:
            high = middle
    start_out[world] = low


@wp.kernel
def count_saved_kernel(
    # Scene:
    capacity: int,
    # In:
    world: wp.array[int],  # (row)
    live_start: wp.array[int],  # (world + 1)
    # Out:
    start_out: wp.array[int],  # (row)
    count_out: wp.array[int],  # (row)
):
    """Count the contacts of the worlds that are saved in rows, -1: none, and place each row's, `capacity` apart. Launched over row."""
    row = wp.tid()
    start_out[row] = row * capacity
    if world[row] >= 0:
        count_out[row] = live_start[world[row] + 1] - live_start[world[row]]


@wp.kernel
def place_contacts_kernel(
    # Scene:
    saved_capacity: int,
    live_capacity: int,
    contacts_lost: int,
    # In:
    row: wp.array[int],  # (world)
    saved_count: wp.array[int],  # (row)
    live_start: wp.array[int],  # (world + 1)
    # Out:
    kept_out: wp.array[int],  # (world)
    target_start_out: wp.array[int],  # (world + 1)
    target_count_out: wp.array[int],  # (world)
    lost_inout: wp.array[int],  # (world)
):
    """Place the contacts of all worlds in a new list: those of a saved `row`, or with -1 the world's own, which `kept` then names.

    Worlds whose contacts exceed a capacity, of the saved list or of the new one, lose some: `lost` receives the flag `contacts_lost`. A
    single thread (dim 1) adds up the numbers (prefix sum).
    """
    total = int(0)
    for world in range(row.shape[0]):
        count = live_start[world + 1] - live_start[world]
        kept_out[world] = world
        fits = bool(True)
        if row[world] >= 0:
            kept_out[world] = -1
            count = wp.min(saved_count[row[world]], saved_capacity)
            fits = count == saved_count[row[world]]
        if total + count > live_capacity:
            count = live_capacity - total
            fits = False
        if not fits:
            lost_inout[world] = lost_inout[world] | contacts_lost
        target_start_out[world] = total
        target_count_out[world] = count
        total += count
    target_start_out[row.shape[0]] = total


@wp.kernel
def copy_contacts_kernel(
    # Scene:
    source_numbers: ContactNumbers,
    target_numbers: ContactNumbers,
    capacity: int,
    # In:
    place: wp.array[int],  # (target world)
    source_start: wp.array[int],  # (world)
    target_start: wp.array[int],  # (target world)
    count: wp.array[int],  # (target world)
    source: ContactHistory,
    # Out:
    target_out: ContactHistory,
):
    """Copy the contacts of worlds from one list to another; `place` names each one's world in the source, -1: it is left out.

    Of each world, `capacity` contacts are copied at most. Launched over target world, lane.
    """
    world, lane = wp.tid()
    origin = place[world]
    if origin < 0:
        return
    first = source_start[origin]
    start = target_start[world]
    shapes = world * target_numbers.shapes - origin * source_numbers.shapes
    bodies = world * target_numbers.bodies - origin * source_numbers.bodies
    contacts = start * target_numbers.contacts - first * source_numbers.contacts
    for contact in range(lane, wp.min(count[world], capacity), int(LANES)):
        one = first + contact
        other = start + contact
        target_out.midpoint[other] = source.midpoint[one]
        target_out.normal[other] = source.normal[one]
        target_out.dense_slot[other] = source.dense_slot[one]
        target_out.free_slot[other] = source.free_slot[one]
        target_out.propagation_slot[other] = source.propagation_slot[one]
        target_out.solved_normal[other] = source.solved_normal[one]
        target_out.friction[other] = source.friction[one]
        target_out.valid[other] = source.valid[one]
        copy_anchor(source, one, target_out, other)
        target_out.key[other] = renumber_key(source.key[one], source_numbers, target_numbers, shapes)
        target_out.pair[other] = renumber_pair(source.pair[one], source_numbers, target_numbers, shapes, bodies)
        target_out.pair_contact[other] = renumber(source.pair_contact[one], contacts)
        target_out.owner[other] = renumber(source.owner[one], contacts)
        target_out.body_a[other] = renumber(source.body_a[one], bodies)
        target_out.body_b[other] = renumber(source.body_b[one], bodies)
        target_out.shape_a[other] = renumber(source.shape_a[one], shapes)
        target_out.shape_b[other] = renumber(source.shape_b[one], shapes)


@wp.kernel
def end_contacts_kernel(
    # In:
    start: wp.array[int],  # (world + 1)
    # Out:
    pair_out: wp.array[wp.int64],  # (pair)
    valid_out: wp.array[int],  # (contact)
    claim_out: wp.array[wp.int64],  # (contact)
    count_out: wp.array[int],  # (one)
):
    """End Newton's list of contacts: its length, no pairs and no anchors behind it, and no contact that is claimed by a later one.

    Launched over contact.
    """
    contact = wp.tid()
    total = start[start.shape[0] - 1]
    claim_out[contact] = LAST
    if contact == 0:
        count_out[0] = total
    if contact >= total:
        pair_out[contact] = LAST
        valid_out[contact] = 0
