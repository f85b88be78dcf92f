"""Contacts between a gripper head and the objects that it holds, which seals replace."""

import warp as wp

from synpick_warp.kernels.sim.cup_rays import CUP
from synpick_warp.kernels.state import Contacts, Seals, Worlds
from synpick_warp.kernels.structs import LayoutData

wp.set_module_options({"enable_backward": False})

# Gap that disables a contact [m]: ten times CONTACT_GAP of stages.sim.physics, beyond which the solver skips contacts.
APART = wp.constant(1.0)


@wp.func
def is_attached(layout: LayoutData, world: int, body: int, body_slot: wp.array2d[int], attached: wp.array2d[int]) -> bool:
    """True if a seal holds the body, which must not be the gripper's."""
    result = bool(False)
    slot = body - world * layout.bodies - layout.gripper_bodies
    for instance in range(layout.instances):
        if attached[world, instance] != 0 and body_slot[world, instance] == slot:
            result = True
    return result


@wp.kernel
def ignore_attached_contacts_kernel(layout: LayoutData, contacts_inout: Contacts, state: Worlds, seals: Seals):
    """Disable contacts between a gripper head and its attached objects, which would fight the seal: set their margin to -APART.

    The solver makes no constraint rows for contacts that far apart. The collision pipeline writes all margins anew each time, after it has
    stored what it matches the next step's contacts with. Disabling the shapes instead would put all such contacts of all worlds into one
    pair of bodies, and the solver's time grows with the square of a pair's contacts. Launched over contact.
    """
    contact = wp.tid()
    if contact >= contacts_inout.count[0] or contacts_inout.shape0[contact] < 0 or contacts_inout.shape1[contact] < 0:
        return
    a = contacts_inout.shape_body[contacts_inout.shape0[contact]]
    b = contacts_inout.shape_body[contacts_inout.shape1[contact]]
    if a < 0 or b < 0:
        return
    cup = a
    other = b
    if b % layout.bodies == CUP:
        cup = b
        other = a
    if cup % layout.bodies != CUP:
        return
    if is_attached(layout, cup // layout.bodies, other, state.body_slot, seals.attached):
        contacts_inout.margin0[contact] = -APART
