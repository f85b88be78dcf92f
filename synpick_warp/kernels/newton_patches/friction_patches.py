"""Friction patches of contacts: order of the contacts by pairs of bodies, in place of a radix sort of Newton's."""

import warp as wp

from synpick_warp.kernels.newton_patches.broad_phase import synchronize_block
from synpick_warp.kernels.newton_patches.contact_matching import find_pair

wp.set_module_options({"enable_backward": False})

FIRST_BODY = wp.constant(wp.int64(32))
"""Bits of a key below its first body, which counts from 1."""


@wp.kernel(enable_backward=False, module="unique")
def sort_contacts_kernel(
    # Scene:
    bodies: int,  # of a world
    # Out:
    key_inout: wp.array[wp.int64],  # (2 * contact): first body << FIRST_BODY | second body or shape, then scratch
    contact_inout: wp.array[int],  # (2 * contact): index, then scratch
):
    """Sort the contacts of each world by their keys, in place: a stable sort by counting, for each contact, those of its world before it.

    Contacts come world by world, those without a key, the highest number, last. Launched over world, thread: a block of threads per world.
    """
    world, thread = wp.tid()
    capacity = key_inout.shape[0] // 2
    first = find_pair(key_inout, capacity, wp.int64(world * bodies + 1) << FIRST_BODY)
    end = find_pair(key_inout, capacity, wp.int64((world + 1) * bodies + 1) << FIRST_BODY)
    for contact in range(first + thread, end, wp.block_dim()):
        key = key_inout[contact]
        rank = first
        for other in range(first, end):
            before = key_inout[other]
            rank += wp.where(before < key or (before == key and other < contact), 1, 0)
        key_inout[capacity + rank] = key
        contact_inout[capacity + rank] = contact_inout[contact]
    # Keys of a world keep their range, in which the searches of other blocks find its bounds at any time.
    synchronize_block()
    for place in range(first + thread, end, wp.block_dim()):
        key_inout[place] = key_inout[capacity + place]
        contact_inout[place] = contact_inout[capacity + place]
