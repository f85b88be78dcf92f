"""Runs of masks, by which writers build RLE and PNG masks: run boundaries of the segmentation ids, and those of each amodal mask.

A run boundary is where a value changes down a column; its position is column · (rows + 1) + row of the pixel below. Lists are sorted by
position, as RLE is, and take about a hundredth of the images' bytes, so copying them to the host and to writer processes is cheap.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.masks import ROWS, InstanceMasks, Mask, read_mask

wp.set_module_options({"enable_backward": False})

BELOW_SHIFT = wp.constant(wp.uint32(8))
"""Position of the id below a boundary in its word; the id above it is the lowest byte."""


@wp.func
def read_id(instance_image: wp.array3d[wp.uint8], view: int, row: int, column: int) -> wp.uint32:
    """Segmentation id of a pixel; 0 in the rows above and below the image."""
    if row < 0 or row >= instance_image.shape[1]:
        return wp.uint32(0)
    return wp.uint32(instance_image[view, row, column])


@wp.kernel
def count_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    # Out:
    column_count_out: wp.array2d[int],  # (view, column)
):
    """Count run boundaries per column: rows, from the first to the one below the image, whose id differs from the row above.

    First pass of a stream compaction; `column_count_out` receives each column's count, `list_boundaries_kernel` sums them to offsets.
    Launched over view, column.
    """
    view, column = wp.tid()
    count = int(0)
    above = wp.uint32(0)
    for row in range(instance_image.shape[1] + 1):
        below = read_id(instance_image, view, row, column)
        if below != above:
            count += 1
        above = below
    column_count_out[view, column] = count


@wp.kernel
def list_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    column_count: wp.array2d[int],  # (view, column)
    # Out:
    boundary_count_out: wp.array[int],  # (view)
    boundaries_out: wp.array3d[wp.uint32],  # (view, field, boundary)
):
    """Write the run boundaries of the segmentation ids as a list sorted by column, then row: second pass of a stream compaction.

    `boundaries_out` receives two fields per boundary: its position, and the ids above and below. `boundary_count_out` receives the number
    of boundaries, including those beyond the list's capacity, which are not written. Launched over view, column.
    """
    view, column = wp.tid()
    rows = instance_image.shape[1]
    index = int(0)
    for before in range(column):
        index += column_count[view, before]
    above = wp.uint32(0)
    for row in range(rows + 1):
        below = read_id(instance_image, view, row, column)
        if below != above:
            if index < boundaries_out.shape[2]:
                boundaries_out[view, 0, index] = wp.uint32(column * (rows + 1) + row)
                boundaries_out[view, 1, index] = above | (below << BELOW_SHIFT)
            index += 1
        above = below
    if column == column_count.shape[1] - 1:
        boundary_count_out[view] = index


@wp.struct
class MaskColumn:
    """State of a walk down a column of a mask: the changes in its current word, and the last bit of that word."""

    changes: wp.uint32
    """Bit i: row i of the word differs from the row above."""
    last: wp.uint32
    """1: the last row of the word is in the mask."""


@wp.func
def next_changes(masks: InstanceMasks, view: int, mask: Mask, band: int, column: int, last: wp.uint32) -> MaskColumn:
    """Changes in the word (band, column) of a mask; `last`: the last bit of the word above. Past the last band: the end of its last run."""
    word = wp.uint32(0)
    if band * ROWS < mask.rows:
        word = masks.words[view, mask.first + band * mask.columns + column]
    result = MaskColumn()
    result.changes = word ^ ((word << wp.uint32(1)) | last)
    result.last = word >> wp.uint32(ROWS - 1)
    return result


@wp.func
def lane_columns(mask: Mask, lanes: int) -> int:
    """Columns of a mask that a lane walks down."""
    return (mask.columns + lanes - 1) // lanes


@wp.kernel
def count_runs_kernel(
    # In:
    masks: InstanceMasks,
    # Out:
    lane_count_out: wp.array3d[int],  # (view, instance, lane)
    run_count_inout: wp.array2d[int],  # (view, instance)
):
    """Count the run boundaries of each amodal mask: first pass of a stream compaction, in which a lane has consecutive columns of a mask.

    `run_count_inout` is increased by the sums over the lanes. Launched over view, instance, lane.
    """
    view, instance, lane = wp.tid()
    mask = read_mask(masks, view, instance)
    share = lane_columns(mask, lane_count_out.shape[2])
    count = int(0)
    for column in range(lane * share, wp.min((lane + 1) * share, mask.columns)):
        last = wp.uint32(0)
        for band in range(mask.rows // ROWS + 1):
            walk = next_changes(masks, view, mask, band, column, last)
            count += wp.bit_count(walk.changes)
            last = walk.last
    lane_count_out[view, instance, lane] = count
    wp.atomic_add(run_count_inout, view, instance, count)


@wp.kernel
def list_runs_kernel(
    # In:
    masks: InstanceMasks,
    rows: int,
    lane_count: wp.array3d[int],  # (view, instance, lane)
    run_count: wp.array2d[int],  # (view, instance)
    # Out:
    runs_out: wp.array2d[wp.uint32],  # (view, boundary)
):
    """Write the positions of the run boundaries of a view's amodal masks, mask by mask: second pass of a stream compaction.

    They alternate between a run's first pixel and the pixel below its last; what exceeds the capacity is not written. `rows`: of the image.
    Launched over view, instance, lane.
    """
    view, instance, lane = wp.tid()
    mask = read_mask(masks, view, instance)
    index = int(0)
    for before in range(instance):
        index += run_count[view, before]
    for before in range(lane):
        index += lane_count[view, instance, before]
    share = lane_columns(mask, lane_count.shape[2])
    for column in range(lane * share, wp.min((lane + 1) * share, mask.columns)):
        last = wp.uint32(0)
        for band in range(mask.rows // ROWS + 1):
            walk = next_changes(masks, view, mask, band, column, last)
            position = (mask.left + column) * (rows + 1) + mask.top + band * ROWS
            while walk.changes != wp.uint32(0):
                others = walk.changes & (walk.changes - wp.uint32(1))
                if index < runs_out.shape[1]:
                    # The bits below the lowest one that is set.
                    runs_out[view, index] = wp.uint32(position + wp.bit_count((walk.changes ^ others) - wp.uint32(1)))
                index += 1
                walk.changes = others
            last = walk.last
