"""Pixel counts and bounding boxes of every instance: BOP's px_count_* and bbox_*, amodal ones beyond the image border as well."""

import warp as wp

from synpick_warp.kernels.render.visibility.bvh_rays import hits_body
from synpick_warp.kernels.render.visibility.camera import ImageGrid, border_ray, in_image
from synpick_warp.kernels.render.visibility.damage import Damage, has_moved
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Meshes, ViewBodies
from synpick_warp.kernels.render.visibility.masks import ROWS, InstanceMasks, count_words, read_mask
from synpick_warp.kernels.render.visibility.variants import kernel_of_views

wp.set_module_options({"enable_backward": False})

ALL = wp.constant(0)
VALID = wp.constant(1)
VISIBLE = wp.constant(2)
"""Index of a count: amodal pixels, those of them that have a depth, and visible pixels."""
AMODAL_BOX = wp.constant(0)
VISIBLE_BOX = wp.constant(1)
"""Index of a box: of the amodal mask and of the visible mask."""
UNSET = wp.constant(2147483647)
"""Sentinel of an empty box: minima are the largest int32 and maxima its negative, so that the first pixel replaces all four."""
HALF = wp.constant(wp.uint64(32))
LOWER_HALF = wp.constant(wp.uint64(0xFFFFFFFF))
"""Shift of the upper, and mask of the lower, of the two 32-bit counters packed in `BorderBoxes.length`."""


@wp.struct
class BoxesCounts:
    """Pixel counts and boxes of every instance."""

    pixels: wp.array3d[int]
    """(view, instance, count)."""
    boxes: wp.array4d[int]
    """(view, instance, box, side)."""


@wp.struct
class BorderCounts:
    """Amodal pixel counts and boxes of every instance beyond the image border, kept from frame to frame."""

    pixels: wp.array2d[int]
    """(kept, instance); `kept` is the view's `Damage.kept_row`."""
    boxes: wp.array4d[int]
    """(kept, instance, one, side)."""


@wp.func
def set_empty(boxes: wp.array4d[int], view: int, instance: int, which: int):
    """Set a stored box to an inverted one, which holds no pixel."""
    boxes[view, instance, which, 0] = UNSET
    boxes[view, instance, which, 1] = UNSET
    boxes[view, instance, which, 2] = -UNSET
    boxes[view, instance, which, 3] = -UNSET


@wp.kernel
def clear_boxes_counts_kernel(counts_out: BoxesCounts):
    """Set pixel counts to 0 and boxes to inverted ones, which hold no pixel. Launched over view, instance."""
    view, instance = wp.tid()
    for i in range(3):
        counts_out.pixels[view, instance, i] = 0
    for i in range(2):
        set_empty(counts_out.boxes, view, instance, i)


@wp.func
def extend_box(box: wp.vec4i, row: int, column: int) -> wp.vec4i:
    """Smallest box that contains `box` and a pixel: x_min, y_min, x_max, y_max, inclusive."""
    return wp.vec4i(wp.min(box[0], column), wp.min(box[1], row), wp.max(box[2], column), wp.max(box[3], row))


@wp.func
def merge_box(
    boxes: wp.array4d[int],  # (view, instance, box, side)
    view: int,
    instance: int,
    which: int,
    box: wp.vec4i,
):
    """Extend a stored box by another, atomically. Integer minima and maxima do not depend on the order of threads."""
    wp.atomic_min(boxes, view, instance, which, 0, box[0])
    wp.atomic_min(boxes, view, instance, which, 1, box[1])
    wp.atomic_max(boxes, view, instance, which, 2, box[2])
    wp.atomic_max(boxes, view, instance, which, 3, box[3])


@wp.kernel
def count_image_pixels_kernel(
    # In:
    instance_image: wp.array3d[wp.uint8],  # (view, row, column)
    depth_image: wp.array3d[wp.uint16],  # (view, row, column)
    masks: InstanceMasks,
    threads: int,
    # Out:
    counts_inout: BoxesCounts,
):
    """Count an instance's pixels inside the image and extend its boxes: reduction in registers, then one atomic operation per thread.

    `pixels` is increased by the three counts, `boxes` is extended by the amodal and the visible pixels. Launched over view,
    instance, thread: `threads` threads stride over the words of an instance's mask.
    """
    view, instance, thread = wp.tid()
    mask = read_mask(masks, view, instance)
    segment = wp.uint8(instance + 1)
    amodal = int(0)
    valid = int(0)
    visible = int(0)
    amodal_box = wp.vec4i(UNSET, UNSET, -UNSET, -UNSET)
    visible_box = wp.vec4i(UNSET, UNSET, -UNSET, -UNSET)
    for i in range(thread, count_words(mask), threads):
        word = masks.words[view, mask.first + i]
        row = mask.top + i // mask.columns * ROWS
        column = mask.left + i % mask.columns
        while word != wp.uint32(0):
            if (word & wp.uint32(1)) != wp.uint32(0):
                amodal += 1
                amodal_box = extend_box(amodal_box, row, column)
                if depth_image[view, row, column] != wp.uint16(0):
                    valid += 1
                if instance_image[view, row, column] == segment:
                    visible += 1
                    visible_box = extend_box(visible_box, row, column)
            word = word >> wp.uint32(1)
            row += 1
    if amodal > 0:
        wp.atomic_add(counts_inout.pixels, view, instance, ALL, amodal)
        wp.atomic_add(counts_inout.pixels, view, instance, VALID, valid)
        merge_box(counts_inout.boxes, view, instance, AMODAL_BOX, amodal_box)
    if visible > 0:
        wp.atomic_add(counts_inout.pixels, view, instance, VISIBLE, visible)
        merge_box(counts_inout.boxes, view, instance, VISIBLE_BOX, visible_box)


@wp.struct
class BorderBoxes:
    """Work list of the projected boxes that reach beyond the image, cut into chunks of pixels that threads share. Scratch."""

    owner: wp.array[int]
    """(listed): view * instances + instance of each box."""
    first_chunk: wp.array[int]
    """(listed): index of the first chunk of each box, the number of chunks of the boxes before; ascending."""
    length: wp.array[wp.uint64]
    """(1): boxes in the upper 32 bits and chunks in the lower, so that one atomic addition reserves both in the same order."""


@wp.func
def is_inside(grid: ImageGrid, box: wp.vec4i) -> bool:
    """True if a projected box is empty or lies within the image."""
    return box[2] < box[0] or (box[0] >= 0 and box[1] >= 0 and box[2] < grid.width and box[3] < grid.height)


@wp.func
def box_pixels(box: wp.vec4i) -> int:
    """Number of pixels of a box with inclusive sides."""
    return (box[2] - box[0] + 1) * (box[3] - box[1] + 1)


@wp.kernel
def list_border_boxes_kernel(
    grid: ImageGrid,
    damage: Damage,
    bodies: ViewBodies,
    instances: int,
    chunk: int,
    boxes_inout: BorderBoxes,
    border_inout: BorderCounts,
):
    """List the instances that moved and whose boxes reach beyond the image, in any order, with `chunk` pixels to a chunk, and clear their
    counts there. `length` starts at 0. Launched over view, instance."""
    view, instance = wp.tid()
    if not has_moved(damage, view, instance):
        return
    row = damage.kept_row[view]
    border_inout.pixels[row, instance] = 0
    set_empty(border_inout.boxes, row, instance, AMODAL_BOX)
    box = bodies.box[view, instance]
    if is_inside(grid, box):
        return
    chunks = (box_pixels(box) + chunk - 1) // chunk
    reserved = wp.atomic_add(boxes_inout.length, 0, (wp.uint64(1) << HALF) + wp.uint64(chunks))
    listed = int(reserved >> HALF)
    boxes_inout.owner[listed] = view * instances + instance
    boxes_inout.first_chunk[listed] = int(reserved & LOWER_HALF)


@wp.func
def find_box(first_chunk: wp.array[int], listed: int, chunk: int) -> int:
    """Index of the listed box that contains chunk number `chunk`: binary search for the last box that starts at it or before."""
    low = int(0)
    high = int(listed)
    while high - low > 1:
        middle = (low + high) // 2
        if first_chunk[middle] <= chunk:
            low = middle
        else:
            high = middle
    return low


@kernel_of_views
def count_border_pixels_kernel(
    meshes: Meshes,
    shot: AnyShot,
    damage: Damage,
    border_boxes: BorderBoxes,
    groups: int,
    threads: int,
    chunk: int,
    border_inout: BorderCounts,
):
    """Count amodal pixels outside the image, up to one image size beyond each border, by a ray per pixel of the listed boxes.

    Groups of `threads` threads stride over the chunks: one object near the camera has more pixels than all others of a batch.
    Counts are added to, and boxes extend, those of `BorderCounts`. Launched over group, thread.
    """
    views, bodies = shot.views, shot.bodies
    group, thread = wp.tid()
    length = border_boxes.length[0]
    for index in range(group, int(length & LOWER_HALF), groups):
        listed = find_box(border_boxes.first_chunk, int(length >> HALF), index)
        view = border_boxes.owner[listed] // views.instances
        instance = border_boxes.owner[listed] % views.instances
        box = bodies.box[view, instance]
        intrinsics = views.cameras.intrinsics[view]
        columns = box[2] - box[0] + 1
        begin = (index - border_boxes.first_chunk[listed]) * chunk
        amodal = int(0)
        amodal_box = wp.vec4i(UNSET, UNSET, -UNSET, -UNSET)
        for i in range(begin + thread, wp.min(begin + chunk, box_pixels(box)), threads):
            row = box[1] + i // columns
            column = box[0] + i % columns
            if not in_image(shot.grid, row, column):
                if hits_body(meshes, bodies, view, instance, border_ray(views.cameras, intrinsics, view, row, column)):
                    amodal += 1
                    amodal_box = extend_box(amodal_box, row, column)
        if amodal > 0:
            wp.atomic_add(border_inout.pixels, damage.kept_row[view], instance, amodal)
            merge_box(border_inout.boxes, damage.kept_row[view], instance, AMODAL_BOX, amodal_box)


@wp.kernel
def finish_boxes_counts_kernel(damage: Damage, border: BorderCounts, counts_inout: BoxesCounts):
    """Add what lies beyond the image to the amodal counts and boxes, and set boxes without pixels to (0, 0, -1, -1). Launched over view,
    instance, box."""
    view, instance, box = wp.tid()
    if box == AMODAL_BOX:
        row = damage.kept_row[view]
        counts_inout.pixels[view, instance, ALL] += border.pixels[row, instance]
        sides = border.boxes
        beyond = wp.vec4i(sides[row, instance, 0, 0], sides[row, instance, 0, 1], sides[row, instance, 0, 2], sides[row, instance, 0, 3])
        merge_box(counts_inout.boxes, view, instance, AMODAL_BOX, beyond)
    if counts_inout.boxes[view, instance, box, 2] < counts_inout.boxes[view, instance, box, 0]:
        counts_inout.boxes[view, instance, box, 0] = 0
        counts_inout.boxes[view, instance, box, 1] = 0
        counts_inout.boxes[view, instance, box, 2] = -1
        counts_inout.boxes[view, instance, box, 3] = -1
