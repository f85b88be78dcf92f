"""Where the images that masks are cut from change down their columns: lists that take a hundredth of the images' room."""

import warp as wp

wp.set_module_options({"enable_backward": False})

INSTANCE = wp.constant(0)
AMODAL = wp.constant(1)
"""Which image: a dimension of counts and lists."""


@wp.func
def pixel_value(
    instance_image: wp.array3d[wp.uint8], amodal_image: wp.array3d[wp.uint32], view: int, kind: int, row: int, column: int
) -> wp.uint32:
    """Of one of the two images; 0 above and below."""
    if row < 0 or row >= instance_image.shape[1]:
        return wp.uint32(0)
    if kind == INSTANCE:
        return wp.uint32(instance_image[view, row, column])
    return amodal_image[view, row, column]


@wp.kernel
def count_edges_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],
    amodal_image: wp.array3d[wp.uint32],
    # Out:
    column_count_out: wp.array3d[int],
):
    """Edges of a column: how many of its pixels, and of the rows above and below the image, differ from the one above."""
    view, kind, column = wp.tid()
    count = int(0)
    above = wp.uint32(0)
    for row in range(instance_image.shape[1] + 1):
        below = pixel_value(instance_image, amodal_image, view, kind, row, column)
        if below != above:
            count += 1
        above = below
    column_count_out[view, kind, column] = count


@wp.kernel
def list_edges_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],
    amodal_image: wp.array3d[wp.uint32],
    column_count: wp.array3d[int],
    # Out:
    edge_count_out: wp.array2d[int],
    edges_out: wp.array4d[wp.uint32],
):
    """List a column's edges behind those of all columns before it: place, value above, value below.

    A place is column · (rows + 1) + row of the pixel below, so the list is sorted. What has no room is counted only.
    """
    view, kind, column = wp.tid()
    rows = instance_image.shape[1]
    edge = int(0)
    for before in range(column):
        edge += column_count[view, kind, before]
    above = wp.uint32(0)
    for row in range(rows + 1):
        below = pixel_value(instance_image, amodal_image, view, kind, row, column)
        if below != above:
            if edge < edges_out.shape[3]:
                edges_out[view, kind, 0, edge] = wp.uint32(column * (rows + 1) + row)
                edges_out[view, kind, 1, edge] = above
                edges_out[view, kind, 2, edge] = below
            edge += 1
        above = below
    if column == column_count.shape[2] - 1:
        edge_count_out[view, kind] = edge
