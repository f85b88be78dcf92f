"""Packed constraint rows: the numbers of a row side by side, for the sweep of the solver's iterations over contacts."""

import warp as wp

wp.set_module_options({"enable_backward": False})

RECORD = wp.constant(12)
"""Length of a contact's record [words]. Word 0 is the contact's first row, and word 9 its number of rows.

A friction patch is a group of contacts of two bodies; one of them has the friction rows, bounded by the sum of the normal impulses of all.
Its record lists the normal rows of the others, the members."""
BODY_A, BODY_B = 1, 2
"""Words with the index of a body in the world's list of bodies; -1: a static body."""
MEMBER_COUNT = 3
"""Word with the number of members that follow it."""
PATCH_MEMBERS = 4
"""Maximum number of members in a record."""
NEXT_MEMBER = 8
"""Word with the first member that is not in the record; -1: there is none."""
MEMBER_LIST = 11
"""Word with the list of the members that are not in the record: their number << 20 | offset in the world's lists; -1: it was full."""
KIND = wp.constant(10)
"""Word with the kind: `WITH_FRICTION`, `NORMAL_ONLY`, or 0 for any other rows."""
WITH_FRICTION = wp.constant(1)
"""Kind of a contact with a normal row and two friction rows."""
NORMAL_ONLY = wp.constant(2)
"""Kind of a contact with a normal row, whose friction is solved by another contact of its patch."""
ROW = wp.constant(32)
"""Words of a packed row, a cache line: Jacobians J_a and J_b, responses M⁻¹J_aᵀ and M⁻¹J_bᵀ of 6 each, effective mass 1 / (J M⁻¹Jᵀ) and
friction coefficient."""
MASS, MU = wp.constant(24), wp.constant(25)
"""Words of a packed row with the effective mass and the friction coefficient."""
WARP = wp.constant(32)
"""Threads of a warp, one for each word of a row."""
THREADS = wp.constant(512)
"""Threads that pack the rows of a world."""


@wp.kernel(enable_backward=False)
def pack_rows_kernel(
    # Scene:
    offsets: int,
    # State:
    color_offsets: wp.array[int],  # (world * offsets)
    records: wp.array[int],  # (world * contacts * RECORD)
    # In:
    jacobian_a: wp.array3d[float],  # (world, row, 6)
    jacobian_b: wp.array3d[float],  # (world, row, 6)
    response_a: wp.array3d[float],  # (world, row, 6), M⁻¹Jᵀ
    response_b: wp.array3d[float],  # (world, row, 6)
    mass: wp.array2d[float],  # (world, row), effective mass 1 / (J M⁻¹Jᵀ) [kg]
    mu: wp.array2d[float],  # (world, row), friction coefficient
    # Out:
    rows_out: wp.array3d[float],  # (world, row, ROW)
):
    """Pack the rows of contacts, a warp for each contact; only the normal row where there is no friction."""
    world, thread = wp.tid()
    warp = thread // WARP
    word = thread - warp * WARP
    count = color_offsets[world * offsets + offsets - 1]
    for contact in range(warp, count, THREADS // WARP):
        record = (world * mass.shape[1] + contact) * RECORD
        rows = 1
        if records[record + KIND] == WITH_FRICTION:
            rows = 3
        for which in range(rows):
            row = records[record] + which
            value = float(0.0)
            if word < 6:
                value = jacobian_a[world, row, word]
            elif word < 12:
                value = jacobian_b[world, row, word - 6]
            elif word < 18:
                value = response_a[world, row, word - 12]
            elif word < 24:
                value = response_b[world, row, word - 18]
            elif word == MASS:
                value = mass[world, row]
            elif word == MU:
                value = mu[world, row]
            rows_out[world, row, word] = value
