"""Run boundaries of the label images: where values change down the columns, from which writers build RLE and PNG masks.

The lists take about a hundredth of the images' bytes, so copying them to the host and to writer processes is cheap.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

INSTANCE = wp.constant(0)
AMODAL = wp.constant(1)
"""Index of the instance and the amodal image: the dimension `image` of counts and lists."""


@wp.func
def read_label(
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    amodal_image: wp.array3d[wp.uint32],  # (view, row, column)
    view: int,
    image: int,
    row: int,
    column: int,
) -> wp.uint32:
    """Pixel value of the instance or the amodal image; 0 in the rows above and below the image."""
    if row < 0 or row >= instance_image.shape[1]:
        return wp.uint32(0)
    if image == INSTANCE:
        return wp.uint32(instance_image[view, row, column])
    return amodal_image[view, row, column]


@wp.kernel
def count_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    amodal_image: wp.array3d[wp.uint32],  # (view, row, column)
    # Out:
    column_count_out: wp.array3d[int],  # (view, image, column)
):
    """Count run boundaries per column: rows, from the first to the one below the image, whose value differs from the row above.

    First pass of a stream compaction; `column_count_out` receives each column's count, `list_boundaries_kernel` sums them to offsets.
    Launched over view, image, column.
    """
    view, image, column = wp.tid()
    count = int(0)
    above = wp.uint32(0)
    for row in range(instance_image.shape[1] + 1):
        below = read_label(instance_image, amodal_image, view, image, row, column)
        if below != above:
            count += 1
        above = below
    column_count_out[view, image, column] = count


@wp.kernel
def list_boundaries_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    amodal_image: wp.array3d[wp.uint32],  # (view, row, column)
    column_count: wp.array3d[int],  # (view, image, column)
    # Out:
    boundary_count_out: wp.array2d[int],  # (view, image)
    boundaries_out: wp.array4d[wp.uint32],  # (view, image, field, boundary)
):
    """Write the run boundaries of an image as a list sorted by column, then row: second pass of a stream compaction.

    `boundaries_out` receives three fields per boundary: position = column · (rows + 1) + row of the pixel below, the value above and the
    value below. `boundary_count_out` receives the number of boundaries, including those beyond the list's capacity, which are not written.
    Launched over view, image, column.
    """
    view, image, column = wp.tid()
    rows = instance_image.shape[1]
    index = int(0)
    for before in range(column):
        index += column_count[view, image, before]
    above = wp.uint32(0)
    for row in range(rows + 1):
        below = read_label(instance_image, amodal_image, view, image, row, column)
        if below != above:
            if index < boundaries_out.shape[3]:
                boundaries_out[view, image, 0, index] = wp.uint32(column * (rows + 1) + row)
                boundaries_out[view, image, 1, index] = above
                boundaries_out[view, image, 2, index] = below
            index += 1
        above = below
    if column == column_count.shape[2] - 1:
        boundary_count_out[view, image] = index
