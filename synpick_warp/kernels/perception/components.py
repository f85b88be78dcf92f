"""Connected-component labeling (8-connectivity) by parallel union-find, with component sizes and the largest component of each instance.

Labels follow Playne and Hawick (2018): every pixel points to a pixel with a smaller index, atomic min unites trees, and the root, the
smallest index of a component, is its label. Images are flat here: pixel = row * width + column. A thread processes a strip of a row, so
that runs of equal ids are joined and counted in registers and few atomics remain. All atomics are on integers: the result does not depend
on the order of threads.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.structs import CatalogData

wp.set_module_options({"enable_backward": False})

STRIP = wp.constant(32)
"""Pixels of a strip."""
NO_COMPONENT = wp.constant(-1)
LAST_PIXEL = wp.constant(wp.int64(0x7FFFFFFF))
"""Upper bound of pixel indices; also the bit mask of the index in a packed key."""
PIXEL_BITS = wp.constant(wp.int64(31))


@wp.struct
class Segments:
    """Images, with pixels in row-major order, and results of segmentation. A patch is the largest component of an instance."""

    segment: wp.array2d[wp.uint8]
    """(view, pixel): segmentation id of the G-buffer."""
    depth: wp.array2d[float]
    """(view, pixel): planar depth of the G-buffer [m]."""
    component: wp.array2d[int]
    """(view, pixel): label of the connected component (8-connectivity, within one instance): the smallest index of its pixels; -1: none."""
    area: wp.array2d[int]
    """(view, pixel): size of a component [px], stored at its root, the pixel whose index is the label; 0 elsewhere."""
    patch: wp.array2d[wp.uint16]
    """(view, pixel): low byte: 1 + instance, 0: no patch; bit 8 + d: the neighbour in direction d belongs to the same patch."""
    gap: wp.array2d[int]
    """(view, pixel): 256 x distance within the column [px] + low byte of `patch`."""
    distance: wp.array2d[float]
    """(view, pixel): distance to the centre of the nearest pixel outside the patch [px]; 0 outside of patches."""
    largest: wp.array2d[int]
    """(view, instance): label of the largest component; -1: the instance is not visible."""
    largest_key: wp.array2d[wp.int64]
    """(view, instance): size and label of the largest component, packed by `pack_key`."""
    pole_key: wp.array2d[wp.int64]
    """(view, instance): squared distance [px²] and pixel of the pole, packed by `pack_key`."""
    square: wp.array2d[wp.int64]
    """(view, instance): sum of squared depths over the patch [2⁻²⁴ m²]."""
    contour: wp.array3d[wp.vec2i]
    """(view, instance, point): outer contour of the patch [px]."""
    contour_length: wp.array2d[int]
    """(view, instance): number of contour points."""


@wp.struct
class Patches:
    """The results of segmentation that planning reads, as images: members of `Segments`."""

    component: wp.array3d[int]
    """(view, row, column)"""
    area: wp.array3d[int]
    """(view, row, column) [px]"""
    distance: wp.array3d[float]
    """(view, row, column) [px]"""
    largest: wp.array2d[int]
    """(view, instance)"""
    contour: wp.array3d[wp.vec2i]
    """(view, instance, point) [px]"""
    contour_length: wp.array2d[int]
    """(view, instance)"""


@wp.func
def split_index(index: int, height: int, strips: int) -> tuple[int, int, int]:
    """(view, row, strip) of a thread's flat index."""
    line = index // strips
    view = line // height
    return view, line - view * height, index - line * strips


@wp.func
def pack_key(value: wp.int64, pixel: int) -> wp.int64:
    """Sort key for an argmax by atomic max: largest value first, then the smallest pixel index. Positive for values above 0."""
    return (value << PIXEL_BITS) | (LAST_PIXEL - wp.int64(pixel))


@wp.func
def unpack_pixel(key: wp.int64) -> int:
    """Row-major pixel index of a key made by `pack_key`."""
    return int(LAST_PIXEL - (key & LAST_PIXEL))


@wp.func
def instance_id(segment: wp.array2d[wp.uint8], view: int, pixel: int, instances: int) -> int:
    """1 + instance, or 0 where the segmentation id is no instance."""
    result = int(segment[view, pixel])
    if result > instances:
        return 0
    return result


@wp.kernel
def label_strips_kernel(segments_inout: Segments, views: Views, width: int, height: int, strips: int, first: int):
    """Initialize union-find: `component_out` receives the first pixel of each pixel's run of equal ids in its strip, or -1 off instances.

    `area_out` is set to 0. Launched over view, row, strip (flat, from index `first` on).
    """
    view, row, strip = split_index(wp.tid() + first, height, strips)
    if views.world[view] < 0:
        return
    column = strip * STRIP
    pixel = row * width + column
    start = int(0)
    before = int(0)
    for i in range(wp.min(STRIP, width - column)):
        here = instance_id(segments_inout.segment, view, pixel + i, views.instances)
        if here != before:
            start = pixel + i
        before = here
        label = int(NO_COMPONENT)
        if here > 0:
            label = start
        segments_inout.component[view, pixel + i] = label
        segments_inout.area[view, pixel + i] = 0


@wp.func
def find_root(component: wp.array2d[int], view: int, pixel: int) -> int:
    """Find of union-find: follow the labels until a pixel is its own label."""
    root = pixel
    parent = component[view, root]
    while parent != root:
        root = parent
        parent = component[view, root]
    return root


@wp.func
def unite(component: wp.array2d[int], view: int, a: int, b: int):
    """Union of union-find: link the larger root of two pixels to the smaller one, so that the smallest pixel index stays the root.

    If another thread has linked the larger root to a third tree in the meantime, that tree is united as well.
    """
    low = find_root(component, view, a)
    high = find_root(component, view, b)
    while low != high:
        if low > high:
            lower = high
            high = low
            low = lower
        old = wp.atomic_min(component, view, high, low)
        if old == high:
            high = low
        else:
            low = find_root(component, view, low)
            high = find_root(component, view, old)


@wp.kernel
def merge_strips_kernel(segments_inout: Segments, views: Views, width: int):
    """Union pass: unite runs of equal ids with the strip to the left and with the row above, diagonals included, once for each pair.

    `component_inout` receives the links between labels. Launched over view, row, strip.
    """
    view, row, strip = wp.tid()
    if views.world[view] < 0:
        return
    begin = strip * STRIP
    left = int(0)
    above_left = int(0)
    above = int(0)
    if begin > 0:
        left = instance_id(segments_inout.segment, view, row * width + begin - 1, views.instances)
        if row > 0:
            above_left = instance_id(segments_inout.segment, view, (row - 1) * width + begin - 1, views.instances)
    if row > 0:
        above = instance_id(segments_inout.segment, view, (row - 1) * width + begin, views.instances)
    for column in range(begin, wp.min(begin + STRIP, width)):
        pixel = row * width + column
        here = instance_id(segments_inout.segment, view, pixel, views.instances)
        above_right = int(0)
        if row > 0 and column + 1 < width:
            above_right = instance_id(segments_inout.segment, view, pixel - width + 1, views.instances)
        if here > 0:
            if column == begin and left == here:
                unite(segments_inout.component, view, pixel - 1, pixel)
            # Skip neighbours above that the left pixel of the same run has already united.
            if above == here:
                if left != here or above_left != here:
                    unite(segments_inout.component, view, pixel - width, pixel)
            else:
                if above_left == here and left != here:
                    unite(segments_inout.component, view, pixel - width - 1, pixel)
                if above_right == here:
                    unite(segments_inout.component, view, pixel - width + 1, pixel)
        left = here
        above_left = above
        above = above_right


@wp.kernel
def measure_components_kernel(segments_inout: Segments, views: Views, width: int):
    """Path compression: replace each label by its root, and add the lengths of its runs to the component's size at the root.

    Writes `component_inout` and `area_out`, with one atomic addition per run. Launched over view, row, strip.
    """
    view, row, strip = wp.tid()
    if views.world[view] < 0:
        return
    begin = row * width + strip * STRIP
    run = int(NO_COMPONENT)
    root = int(NO_COMPONENT)
    count = int(0)
    for pixel in range(begin, wp.min(begin + STRIP, (row + 1) * width)):
        label = segments_inout.component[view, pixel]
        # All pixels of a run but its first still have the first one as label, from `label_strips_kernel`.
        if label != run:
            if count > 0:
                wp.atomic_add(segments_inout.area, view, root, count)
            count = 0
            run = int(NO_COMPONENT)
            if label >= 0:
                run = pixel
                root = find_root(segments_inout.component, view, label)
        if run >= 0:
            segments_inout.component[view, pixel] = root
            count += 1
    if count > 0:
        wp.atomic_add(segments_inout.area, view, root, count)


@wp.kernel
def find_largest_kernel(segments_inout: Segments, views: Views):
    """Argmax of the component size of each instance: max over its roots of pack_key(area, root). Keys must be 0 before. Launched over view,
    pixel."""
    view, pixel = wp.tid()
    if views.world[view] < 0:
        return
    size = segments_inout.area[view, pixel]
    if size > 0:
        wp.atomic_max(segments_inout.largest_key, view, int(segments_inout.segment[view, pixel]) - 1, pack_key(wp.int64(size), pixel))


@wp.kernel
def unpack_largest_kernel(
    # Scene:
    catalog: CatalogData,
    # State:
    catalog_index: wp.array2d[int],  # (world, instance)
    segments_inout: Segments,
    # In:
    views: Views,
):
    """Label of each instance's largest component; -1: not visible, or a distractor, which perception does not know as an object, or the
    view is unused. Launched over view, instance.
    """
    view, instance = wp.tid()
    segments_inout.largest[view, instance] = NO_COMPONENT
    world = views.world[view]
    if world >= 0 and segments_inout.largest_key[view, instance] > wp.int64(0) and catalog_index[world, instance] < catalog.count:
        segments_inout.largest[view, instance] = unpack_pixel(segments_inout.largest_key[view, instance])
