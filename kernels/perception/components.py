"""Connected components of the pixels of each instance, their sizes, and the largest of each instance.

Images are flat here: pixel = row * width + column. A thread works on a strip of a row, so that runs of equal pixels are joined and
counted in registers and few atomics are left. All atomics are on integers: the order of threads does not show in the result.
"""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Views

wp.set_module_options({"enable_backward": False})

STRIP = wp.constant(32)
"""Pixels of a strip."""
NO_COMPONENT = wp.constant(-1)
LAST_PIXEL = wp.constant(wp.int64(0x7FFFFFFF))
"""Larger than the index of any pixel; also the mask of the bits that `pack_key` keeps it in."""
PIXEL_BITS = wp.constant(wp.int64(31))


@wp.func
def strip_of(index: int, height: int, strips: int) -> tuple[int, int, int]:
    """(view, row, strip) of a flat index."""
    line = index // strips
    view = line // height
    return view, line - view * height, index - line * strips


@wp.func
def pack_key(value: wp.int64, pixel: int) -> wp.int64:
    """A key whose maximum belongs to the largest value and, of equal ones, to the least pixel; positive for values above 0."""
    return (value << PIXEL_BITS) | (LAST_PIXEL - wp.int64(pixel))


@wp.func
def unpack_pixel(key: wp.int64) -> int:
    """The pixel of a key of `pack_key`."""
    return int(LAST_PIXEL - (key & LAST_PIXEL))


@wp.func
def instance_segment(segment: wp.array2d[wp.uint8], view: int, pixel: int, instances: int) -> int:
    """1 + instance where the pixel shows one, else 0."""
    found = int(segment[view, pixel])
    if found > instances:
        return 0
    return found


@wp.kernel
def label_strips_kernel(
    # In:
    views: Views,
    segment: wp.array2d[wp.uint8],
    width: int,
    height: int,
    strips: int,
    first: int,
    # Out:
    component_out: wp.array2d[int],
    area_out: wp.array2d[int],
):
    """Name each pixel by the first one of its run of equal codes within its strip; sizes to 0. One thread a strip."""
    view, row, strip = strip_of(wp.tid() + first, height, strips)
    if views.world[view] < 0:
        return
    column = strip * STRIP
    pixel = row * width + column
    start = int(0)
    before = int(0)
    for i in range(wp.min(STRIP, width - column)):
        here = instance_segment(segment, view, pixel + i, views.instances)
        if here != before:
            start = pixel + i
        before = here
        name = int(NO_COMPONENT)
        if here > 0:
            name = start
        component_out[view, pixel + i] = name
        area_out[view, pixel + i] = 0


@wp.func
def root_of(component: wp.array2d[int], view: int, pixel: int) -> int:
    """Follow the names until one names itself."""
    root = pixel
    above = component[view, root]
    while above != root:
        root = above
        above = component[view, root]
    return root


@wp.func
def unite(component: wp.array2d[int], view: int, a: int, b: int):
    """Join the trees of two pixels; the larger root gets the smaller one's name, so that the least pixel of all stays the root.

    If another thread has hung the larger root elsewhere meanwhile, the tree where it was hung is joined as well.
    """
    low = root_of(component, view, a)
    high = root_of(component, view, b)
    while low != high:
        if low > high:
            lower = high
            high = low
            low = lower
        old = wp.atomic_min(component, view, high, low)
        if old == high:
            high = low
        else:
            low = root_of(component, view, low)
            high = root_of(component, view, old)


@wp.kernel
def merge_strips_kernel(
    # In:
    views: Views,
    segment: wp.array2d[wp.uint8],
    width: int,
    # Out:
    component_inout: wp.array2d[int],
):
    """Join runs of equal codes with the strip to the left and with the row above, 8 neighbours, once for every pair of runs."""
    view, row, strip = wp.tid()
    if views.world[view] < 0:
        return
    begin = strip * STRIP
    left = int(0)
    above_left = int(0)
    above = int(0)
    if begin > 0:
        left = instance_segment(segment, view, row * width + begin - 1, views.instances)
        if row > 0:
            above_left = instance_segment(segment, view, (row - 1) * width + begin - 1, views.instances)
    if row > 0:
        above = instance_segment(segment, view, (row - 1) * width + begin, views.instances)
    for column in range(begin, wp.min(begin + STRIP, width)):
        pixel = row * width + column
        here = instance_segment(segment, view, pixel, views.instances)
        above_right = int(0)
        if row > 0 and column + 1 < width:
            above_right = instance_segment(segment, view, pixel - width + 1, views.instances)
        if here > 0:
            if column == begin and left == here:
                unite(component_inout, view, pixel - 1, pixel)
            # What the left pixel sees above itself is its own to join.
            if above == here:
                if left != here or above_left != here:
                    unite(component_inout, view, pixel - width, pixel)
            else:
                if above_left == here and left != here:
                    unite(component_inout, view, pixel - width - 1, pixel)
                if above_right == here:
                    unite(component_inout, view, pixel - width + 1, pixel)
        left = here
        above_left = above
        above = above_right


@wp.kernel
def measure_components_kernel(
    # In:
    views: Views,
    width: int,
    # Out:
    component_inout: wp.array2d[int],
    area_out: wp.array2d[int],
):
    """Name each pixel by the root of its component, and count pixels there: area[root] = sum over its runs of their lengths."""
    view, row, strip = wp.tid()
    if views.world[view] < 0:
        return
    begin = row * width + strip * STRIP
    run = int(NO_COMPONENT)
    root = int(NO_COMPONENT)
    count = int(0)
    for pixel in range(begin, wp.min(begin + STRIP, (row + 1) * width)):
        name = component_inout[view, pixel]
        # All pixels of a run but its first have the first one's name, as `label_strips_kernel` gave it.
        if name != run:
            if count > 0:
                wp.atomic_add(area_out, view, root, count)
            count = 0
            run = int(NO_COMPONENT)
            if name >= 0:
                run = pixel
                root = root_of(component_inout, view, name)
        if run >= 0:
            component_inout[view, pixel] = root
            count += 1
    if count > 0:
        wp.atomic_add(area_out, view, root, count)


@wp.kernel
def find_largest_kernel(
    # In:
    views: Views,
    segment: wp.array2d[wp.uint8],
    area: wp.array2d[int],
    # Out:
    largest_key_out: wp.array2d[wp.int64],
):
    """Key of each instance's largest component: the maximum of `pack_key(area, root)` over its roots. The keys begin as 0."""
    view, pixel = wp.tid()
    if views.world[view] < 0:
        return
    size = area[view, pixel]
    if size > 0:
        wp.atomic_max(largest_key_out, view, int(segment[view, pixel]) - 1, pack_key(wp.int64(size), pixel))


@wp.kernel
def unpack_largest_kernel(
    # In:
    views: Views,
    largest_key: wp.array2d[wp.int64],
    # Out:
    largest_out: wp.array2d[int],
):
    """Root of each instance's largest component; -1: the instance is not visible."""
    view, instance = wp.tid()
    largest_out[view, instance] = NO_COMPONENT
    if views.world[view] >= 0 and largest_key[view, instance] > wp.int64(0):
        largest_out[view, instance] = unpack_pixel(largest_key[view, instance])
