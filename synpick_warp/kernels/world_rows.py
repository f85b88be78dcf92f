"""Gather and scatter of per-world data: copies the 32-bit words of one world between many arrays and a contiguous record.

The arrays are world-major with a constant stride. A table holds the address of each word in the first world and the stride to the next
world, so that one launch copies from or to all arrays.
"""

import warp as wp

from synpick_warp.codes import Phase

wp.set_module_options({"enable_backward": False})


@wp.struct
class WordTable:
    """Addresses of the words of a record in the first world, and strides between worlds."""

    address: wp.array[wp.uint64]
    """(word): address in the first world [bytes]."""
    stride: wp.array[int]
    """(word): stride between consecutive worlds [bytes]."""


@wp.func
def word_of(table: WordTable, world: int, word: int):
    """View of one word of a world, as an array of one element."""
    offset = wp.uint64(world) * wp.uint64(table.stride[word])
    return wp.array(ptr=table.address[word] + offset, shape=(1,), dtype=wp.uint32)


@wp.kernel
def save_rows_kernel(
    # Scene:
    table: WordTable,
    # In:
    world: wp.array[int],  # (row)
    # Out:
    record_out: wp.array2d[wp.uint32],  # (row, word)
):
    """Gather the words of the world of each row; -1: the row keeps its content. Launched over row, word."""
    row, word = wp.tid()
    if world[row] < 0:
        return
    live = word_of(table, world[row], word)
    record_out[row, word] = live[0]


@wp.kernel
def load_rows_kernel(
    # Scene:
    table: WordTable,
    # In:
    row: wp.array[int],  # (world)
    record: wp.array2d[wp.uint32],  # (row, word)
):
    """Scatter the words of the row of each world to the arrays of the table; -1: the world keeps its own. Launched over world, word."""
    world, word = wp.tid()
    if row[world] < 0:
        return
    live = word_of(table, world, word)
    live[0] = record[row[world], word]


@wp.kernel
def reset_rows_kernel(
    # Scene:
    table: WordTable,
    fresh: wp.array[wp.uint32],  # (word)
    # State:
    phase: wp.array[int],  # (world)
    # In:
    resets: wp.array[int],  # (reset word)
):
    """Write the words `resets` of worlds that start an episode or have none (phase START or IDLE) as before the first tick.

    Launched over world, reset word.
    """
    world, place = wp.tid()
    if phase[world] != Phase.START and phase[world] != Phase.IDLE:
        return
    live = word_of(table, world, resets[place])
    live[0] = fresh[resets[place]]


@wp.kernel
def select_variants_kernel(
    # Scene:
    bodies: int,
    first_word: int,
    # In:
    row: wp.array[int],  # (world)
    record: wp.array2d[wp.uint32],  # (row, word)
    # Out:
    variant_out: wp.array[int],  # (body)
    restarted_out: wp.array[wp.bool],  # (world_and_global)
):
    """Write the body variants of the row of each world, which begin at `first_word` of a record, and which worlds get any.

    `variant` is -1, no change, in other worlds. Launched over world, body.
    """
    world, body = wp.tid()
    variant = int(-1)
    if row[world] >= 0:
        variant = int(record[row[world], first_word + body])
    variant_out[world * bodies + body] = variant
    if body == 0:
        restarted_out[world] = row[world] >= 0


@wp.kernel
def clear_idle_rows_kernel(
    # Scene:
    impulses: int,
    row_type: int,
    row_parent: int,
    # In:
    world: wp.array[int],  # (row)
    # Out:
    record_inout: wp.array2d[wp.uint32],  # (row, word)
):
    """Set type and parent of constraint rows without impulse to -1, none: they start nothing, and may be left from any earlier step.

    `impulses`, `row_type` and `row_parent` are the first words of constraint rows in a record. Launched over row, constraint row.
    """
    row, index = wp.tid()
    if world[row] >= 0 and record_inout[row, impulses + index] == wp.uint32(0):
        record_inout[row, row_type + index] = wp.uint32(-1)
        record_inout[row, row_parent + index] = wp.uint32(-1)
