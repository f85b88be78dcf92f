"""Packing of contact constraint rows: gathers the Jacobians and responses of a row from separate arrays into one cache line."""

import warp as wp

wp.set_module_options({"enable_backward": False})

RECORD = wp.constant(12)
"""Length of a contact's record [words]. Word 0 holds the index of the contact's first row, and word 9 its number of rows.

A friction patch is a group of contacts of two bodies; one of them has the friction rows, bounded by the sum of the normal impulses of all.
Its record lists the normal rows of the others, the members."""
BODY_A, BODY_B = 1, 2
"""Words that hold the bodies of a contact, as indices into the world's list of bodies; -1: a static body."""
MEMBER_COUNT = 3
"""Word that holds the number of members listed in the words after it."""
PATCH_MEMBERS = 4
"""Maximum number of members in a record."""
NEXT_MEMBER = 8
"""Word that holds the first member that does not fit into the record; -1: all members fit."""
MEMBER_LIST = 11
"""Word that locates the list of the members that do not fit: their number << 20 | offset in the world's lists; -1: the lists were full."""
KIND = wp.constant(10)
"""Word that holds the kind of the contact: `WITH_FRICTION`, `NORMAL_ONLY`, or 0 for anything else."""
WITH_FRICTION = wp.constant(1)
"""Kind of a contact with a normal row and two friction rows."""
NORMAL_ONLY = wp.constant(2)
"""Kind of a contact with a normal row, whose friction is solved by another contact of its patch."""
ROW = wp.constant(32)
"""Length of a packed row [words], one cache line: Jacobians J_a and J_b and responses M⁻¹J_aᵀ and M⁻¹J_bᵀ (6 words each), effective mass
1 / (J M⁻¹Jᵀ), friction coefficient, and padding."""
MASS, MU = wp.constant(24), wp.constant(25)
"""Index of the word of a packed row that holds the effective mass, and of the one that holds the friction coefficient."""
WARP = wp.constant(32)
"""Number of threads of a warp; each copies one word of a row."""
THREADS = wp.constant(1024)
"""Number of threads that pack the rows of a world."""


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
    """Gather the constraint rows of contacts into `rows_out`: the normal row, and the friction rows of `WITH_FRICTION` contacts.

    Launched over world, thread: `THREADS` threads per world, of which a warp packs one contact at a time.
    """
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
