"""Island sleeping: islands of objects at rest fall asleep as a whole, and are not simulated until an awake body touches one of them.

An island is a connected component of the contact graph; fixed shapes (bins, table) are not nodes of it. Islands fall asleep at the end of
a tick and may wake in any substep. A sleeping body keeps its pose at zero velocity, without contacts among sleepers or constraint rows.
"""

import warp as wp

from synpick_warp.codes import Phase
from synpick_warp.kernels.state import Attempts, Contacts, Motion, Seals, Worlds
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Consecutive ticks in which an object must be quiet, that is move at most by the threshold, before it falls asleep.
QUIET_TICKS = wp.constant(3)


@wp.struct
class Sleepers:
    """Per body slot of each world: sleep flag, island, and quiet time."""

    asleep: wp.array2d[int]
    """(world, slot): 1: asleep; 0: awake."""
    island: wp.array2d[int]
    """(world, slot): slot that names the island of a sleeping body: the smallest of its slots."""
    quiet: wp.array2d[int]
    """(world, slot): consecutive ticks in which the body moved by at most `physics.sleep` [ticks]."""


@wp.struct
class Islands:
    """Scratch of the search for islands."""

    parent: wp.array[int]
    """(body): union-find."""
    restless: wp.array[int]
    """(body): 1: root of an island that stays awake; 0 before a search."""
    woken: wp.array2d[int]
    """(world, slot): 1: slot that names an island to be woken."""


@wp.func
def body_of(shape_body: wp.array[int], shape: int) -> int:
    """Body of a shape of a contact; -1: a fixed shape, or none."""
    if shape < 0:
        return -1
    return shape_body[shape]


@wp.func
def is_asleep(layout: LayoutData, asleep: wp.array2d[int], body: int) -> bool:
    """Whether a body is a sleeping object; False for the gripper's bodies and for -1 (fixed shape)."""
    if body < 0:
        return False
    world = body // layout.bodies
    slot = body - world * layout.bodies - layout.gripper_bodies
    return slot >= 0 and asleep[world, wp.max(slot, 0)] != 0


@wp.kernel
def list_awake_pairs_kernel(
    # Scene:
    layout: LayoutData,
    threads: int,
    shape_body: wp.array[int],  # (shape)
    # State:
    sleepers: Sleepers,
    # In:
    overlap: wp.array[wp.vec2i],  # (overlap)
    overlap_count: wp.array[int],  # (one)
    # Out:
    pair_out: wp.array[wp.vec2i],  # (overlap)
    pair_count_inout: wp.array[int],  # (one)
):
    """Stream compaction of the broad phase: list the overlapping pairs with a shape of an awake body, in arbitrary order.

    Grid-stride loop over the pairs: launched over `threads`.
    """
    thread = wp.tid()
    for index in range(thread, wp.min(overlap_count[0], overlap.shape[0]), threads):
        one = shape_body[overlap[index][0]]
        other = shape_body[overlap[index][1]]
        if (one >= 0 and not is_asleep(layout, sleepers.asleep, one)) or (other >= 0 and not is_asleep(layout, sleepers.asleep, other)):
            pair_out[wp.atomic_add(pair_count_inout, 0, 1)] = overlap[index]


@wp.kernel
def wake_touched_kernel(layout: LayoutData, threads: int, contacts: Contacts, sleepers: Sleepers, islands_out: Islands):
    """Mark the sleeping islands in contact with an awake body: `woken` becomes 1 at the slot that names the island (`island`).

    Contact margins cover the motion in a substep, so that islands wake before surfaces meet. Grid-stride loop, launched over `threads`.
    """
    thread = wp.tid()
    for contact in range(thread, wp.min(contacts.count[0], contacts.shape0.shape[0]), threads):
        one = body_of(contacts.shape_body, contacts.shape0[contact])
        other = body_of(contacts.shape_body, contacts.shape1[contact])
        if one >= 0 and other >= 0:
            one_sleeps = is_asleep(layout, sleepers.asleep, one)
            if one_sleeps != is_asleep(layout, sleepers.asleep, other):
                sleeper = wp.where(one_sleeps, one, other)
                world = sleeper // layout.bodies
                slot = sleeper - world * layout.bodies - layout.gripper_bodies
                islands_out.woken[world, sleepers.island[world, slot]] = 1


@wp.kernel
def hold_sleepers_kernel(layout: LayoutData, before: Motion, islands: Islands, sleepers_inout: Sleepers, after_out: Motion):
    """Restore pose and velocity of sleeping bodies after a substep, in which the solver lets them fall; then wake those of woken islands.

    Launched over world, slot.
    """
    world, slot = wp.tid()
    if sleepers_inout.asleep[world, slot] == 0:
        return
    q = world * layout.coords + layout.gripper_dofs + 7 * slot
    qd = world * layout.dofs + layout.gripper_dofs + 6 * slot
    body = world * layout.bodies + layout.gripper_bodies + slot
    for axis in range(7):
        after_out.joint_q[q + axis] = before.joint_q[q + axis]
    for axis in range(6):
        after_out.joint_qd[qd + axis] = before.joint_qd[qd + axis]
    after_out.body_q[body] = before.body_q[body]
    after_out.body_qd[body] = before.body_qd[body]
    if islands.woken[world, sleepers_inout.island[world, slot]] != 0:
        sleepers_inout.asleep[world, slot] = 0
        sleepers_inout.quiet[world, slot] = 0


@wp.func
def find_root(parent: wp.array[int], body: int) -> int:
    """Union-find: root of a body's tree, which names its set; without path compression."""
    root = body
    while parent[root] != root:
        root = parent[root]
    return root


@wp.kernel
def begin_islands_kernel(islands_out: Islands):
    """Union-find: make each body its own root. Launched over body."""
    body = wp.tid()
    islands_out.parent[body] = body


@wp.kernel
def join_islands_kernel(contacts: Contacts, islands_inout: Islands):
    """Lock-free union-find: unite the sets of the two bodies of each contact under the smaller root.

    Parents only decrease (atomic minimum), and a parent that is replaced is united in turn: the root of an island is its smallest body in
    any order of threads. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts.count[0]:
        return
    one = body_of(contacts.shape_body, contacts.shape0[contact])
    other = body_of(contacts.shape_body, contacts.shape1[contact])
    if one < 0 or other < 0:
        return
    one = find_root(islands_inout.parent, one)
    other = find_root(islands_inout.parent, other)
    while one != other:
        high = wp.max(one, other)
        low = wp.min(one, other)
        before = wp.atomic_min(islands_inout.parent, high, low)
        if before == high:
            return
        one = find_root(islands_inout.parent, before)
        other = find_root(islands_inout.parent, low)


@wp.func
def stop(layout: LayoutData, world: int, slot: int, joint_qd_out: wp.array[float], body_qd_out: wp.array[wp.spatial_vector]):
    """Set the velocity of the body in a slot to zero, in joint and body coordinates."""
    for axis in range(6):
        joint_qd_out[world * layout.dofs + layout.gripper_dofs + 6 * slot + axis] = 0.0
    body_qd_out[world * layout.bodies + layout.gripper_bodies + slot] = wp.spatial_vector(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@wp.kernel
def judge_sleep_kernel(
    layout: LayoutData,
    threshold: float,
    state: Worlds,
    attempts: Attempts,
    seals: Seals,
    sleepers_inout: Sleepers,
    islands_inout: Islands,
    motion_out: Motion,
):
    """Put an island to sleep if each of its objects was quiet for QUIET_TICKS ticks and none is attached to a cup or touches the gripper;
    wake it if one of its objects was attached or removed (catalog index -1). Outside of phase ACT all are awake.

    Quiet: moved by at most `threshold` [m] in a tick. `island` becomes the slot of the island's root, `woken` zero. Launched over world.
    """
    world = wp.tid()
    first = world * layout.bodies + layout.gripper_bodies
    if state.phase[world] != Phase.ACT:
        for slot in range(layout.slots):
            sleepers_inout.asleep[world, slot] = 0
            sleepers_inout.quiet[world, slot] = 0
            islands_inout.woken[world, slot] = 0
        return
    for body in range(world * layout.bodies, first):
        islands_inout.restless[find_root(islands_inout.parent, body)] = 1
    for instance in range(layout.instances):
        slot = state.body_slot[world, instance]
        is_gone = attempts.removed[world, instance] != 0
        if is_gone or state.catalog_index[world, instance] >= 0:
            is_taken = is_gone or seals.attached[world, instance] != 0
            quiet = wp.where(not is_taken and state.displacement[world, instance] <= threshold, sleepers_inout.quiet[world, slot] + 1, 0)
            sleepers_inout.quiet[world, slot] = quiet
            if sleepers_inout.asleep[world, slot] == 0 and quiet < QUIET_TICKS:
                islands_inout.restless[find_root(islands_inout.parent, first + slot)] = 1
            if sleepers_inout.asleep[world, slot] != 0 and is_taken:
                islands_inout.woken[world, sleepers_inout.island[world, slot]] = 1
    for instance in range(layout.instances):
        slot = state.body_slot[world, instance]
        if attempts.removed[world, instance] != 0 or state.catalog_index[world, instance] >= 0:
            if sleepers_inout.asleep[world, slot] != 0:
                if islands_inout.woken[world, sleepers_inout.island[world, slot]] != 0:
                    sleepers_inout.asleep[world, slot] = 0
                    sleepers_inout.quiet[world, slot] = 0
            elif islands_inout.restless[find_root(islands_inout.parent, first + slot)] == 0:
                sleepers_inout.asleep[world, slot] = 1
                sleepers_inout.island[world, slot] = find_root(islands_inout.parent, first + slot) - first
                stop(layout, world, slot, motion_out.joint_qd, motion_out.body_qd)
    for slot in range(layout.slots):
        islands_inout.woken[world, slot] = 0
