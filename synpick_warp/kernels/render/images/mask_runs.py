"""Runs of masks, by which writers build RLE and PNG masks: run boundaries of the segmentation ids, and those of each amodal mask.

A run boundary is where a value changes down a column; its position is column · (rows + 1) + row of the pixel below. Lists are sorted by
position, as RLE is, and take about a hundredth of the images' bytes, so copying them to the host and to writer processes is cheap.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.masks import ROWS, InstanceMasks, Mask, read_mask

wp.set_module_options({"enable_backward": False})

BELOW_SHIFT = wp.constant(wp.uint32(8))
"""Position of the id below a boundary in its word; the id above it is the lowest byte."""


@wp.struct
class Boundaries:
    """Run boundaries of the segmentation ids and amodal masks of a batch of views, and their counts. A count may exceed the capacity of its
    list; the list is then truncated. See `FrameBatch`.
    """

    boundary_count: wp.array[int]
    """(view): run boundaries of the ids, including those beyond the capacity of `boundaries`."""
    boundaries: wp.array3d[wp.uint32]
    """(view, field, boundary): position, and values above and below, of each run boundary of the ids."""
    run_count: wp.array2d[int]
    """(view, instance): run boundaries of each amodal mask, including those beyond the capacity of `runs`."""
    runs: wp.array2d[wp.uint32]
    """(view, run): positions of the run boundaries of the amodal masks, mask by mask."""


@wp.struct
class BoundaryCounts:
    """Number of run boundaries in each column of the ids, each band of a column, and each lane of a mask. Scratch of both passes."""

    column_count: wp.array2d[int]
    """(view, column)."""
    band_count: wp.array3d[int]
    """(view, band, column): a band is a range of rows."""
    lane_count: wp.array3d[int]
    """(view, instance, lane)."""


@wp.func
def read_id(instance_image: wp.array3d[wp.uint8], view: int, row: int, column: int) -> wp.uint32:
    """Segmentation id of a pixel; 0 in the rows above and below the image."""
    if row < 0 or row >= instance_image.shape[1]:
        return wp.uint32(0)
    return wp.uint32(instance_image[view, row, column])


@wp.func
def band_rows(rows: int, bands: int) -> int:
    """Height of a band [rows], if the rows of an image, and one row more below it, are divided into `bands` bands."""
    return rows // bands + 1


@wp.kernel
def count_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    # Out:
    counts_inout: BoundaryCounts,
):
    """Count run boundaries per column and band: rows, from the first to the one below the image, whose id differs from the row above.

    First pass of a stream compaction, whose counts `list_boundaries_kernel` sums to offsets. `column_count`, which must be 0, is increased.
    Launched over view, band, column.
    """
    view, band, column = wp.tid()
    rows = instance_image.shape[1]
    share = band_rows(rows, counts_inout.band_count.shape[1])
    count = int(0)
    above = read_id(instance_image, view, band * share - 1, column)
    for row in range(band * share, wp.min((band + 1) * share, rows + 1)):
        below = read_id(instance_image, view, row, column)
        if below != above:
            count += 1
        above = below
    counts_inout.band_count[view, band, column] = count
    wp.atomic_add(counts_inout.column_count, view, column, count)


@wp.kernel
def list_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    counts: BoundaryCounts,
    # Out:
    runs_out: Boundaries,
):
    """Write the run boundaries of the segmentation ids as a list sorted by column, then row: second pass of a stream compaction. Launched
    over view, band, column."""
    view, band, column = wp.tid()
    rows, bands = instance_image.shape[1], counts.band_count.shape[1]
    index = int(0)
    for before in range(column):
        index += counts.column_count[view, before]
    for before in range(band):
        index += counts.band_count[view, before, column]
    share = band_rows(rows, bands)
    above = read_id(instance_image, view, band * share - 1, column)
    for row in range(band * share, wp.min((band + 1) * share, rows + 1)):
        below = read_id(instance_image, view, row, column)
        if below != above:
            if index < runs_out.boundaries.shape[2]:
                runs_out.boundaries[view, 0, index] = wp.uint32(column * (rows + 1) + row)
                runs_out.boundaries[view, 1, index] = above | (below << BELOW_SHIFT)
            index += 1
        above = below
    if column == counts.column_count.shape[1] - 1 and band == bands - 1:
        runs_out.boundary_count[view] = index


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
def count_runs_kernel(masks: InstanceMasks, counts_out: BoundaryCounts, runs_inout: Boundaries):
    """Count the run boundaries of each amodal mask: first pass of a stream compaction, in which a lane has consecutive columns of a mask.
    `run_count` is increased by the sums over the lanes. Launched over view, instance, lane."""
    view, instance, lane = wp.tid()
    mask = read_mask(masks, view, instance)
    share = lane_columns(mask, counts_out.lane_count.shape[2])
    count = int(0)
    for column in range(lane * share, wp.min((lane + 1) * share, mask.columns)):
        last = wp.uint32(0)
        for band in range(mask.rows // ROWS + 1):
            walk = next_changes(masks, view, mask, band, column, last)
            count += wp.bit_count(walk.changes)
            last = walk.last
    counts_out.lane_count[view, instance, lane] = count
    wp.atomic_add(runs_inout.run_count, view, instance, count)


@wp.kernel
def list_runs_kernel(masks: InstanceMasks, rows: int, counts: BoundaryCounts, runs_inout: Boundaries):
    """Write the positions of the run boundaries of a view's amodal masks, mask by mask: second pass of a stream compaction.

    They alternate between a run's first pixel and the pixel below its last; what exceeds the capacity is not written. `rows`: of the image.
    Launched over view, instance, lane.
    """
    view, instance, lane = wp.tid()
    mask = read_mask(masks, view, instance)
    index = int(0)
    for before in range(instance):
        index += runs_inout.run_count[view, before]
    for before in range(lane):
        index += counts.lane_count[view, instance, before]
    share = lane_columns(mask, counts.lane_count.shape[2])
    for column in range(lane * share, wp.min((lane + 1) * share, mask.columns)):
        last = wp.uint32(0)
        for band in range(mask.rows // ROWS + 1):
            walk = next_changes(masks, view, mask, band, column, last)
            position = (mask.left + column) * (rows + 1) + mask.top + band * ROWS
            while walk.changes != wp.uint32(0):
                others = walk.changes & (walk.changes - wp.uint32(1))
                if index < runs_inout.runs.shape[1]:
                    # The bits below the lowest one that is set.
                    runs_inout.runs[view, index] = wp.uint32(position + wp.bit_count((walk.changes ^ others) - wp.uint32(1)))
                index += 1
                walk.changes = others
            last = walk.last
