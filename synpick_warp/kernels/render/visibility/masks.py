"""Amodal masks: one bit per pixel of each instance's bounding box, in words of MASK_ROWS rows of a column, from a pool of words per view.

A box takes as many words as it needs, wherever the boxes before it end (prefix sum), so work, copies and memory grow with covered area,
not with the number of instances; `stages.view_ring` forms batches whose masks fit. Words lie along the rows of the image, as its pixels
do: neighbouring columns are neighbouring words.
"""

import warp as wp

from synpick_warp.codes import MASK_ROWS
from synpick_warp.kernels.render.visibility.camera import ImageGrid
from synpick_warp.kernels.render.visibility.gbuffer import ViewBodies

wp.set_module_options({"enable_backward": False})

ROWS = wp.constant(MASK_ROWS)
"""Rows of a word."""


@wp.struct
class InstanceMasks:
    """Amodal masks of each view's instances: their boxes, where their words begin, and the pool of words. Null arrays: no masks."""

    box: wp.array2d[wp.vec4i]
    """(view, instance): the part of the projected box within the image, x_min, y_min, x_max, y_max, inclusive; x_max < x_min: empty."""
    first: wp.array2d[int]
    """(view, instance): index of the mask's first word in the view's pool, the number of words of the instances before."""
    words: wp.array2d[wp.uint32]
    """(view, word): word (band, column) of an instance's box, `first + band * columns + column`; bit i is row `y_min + 32 band + i`."""
    length: wp.array[int]
    """(view): words of all masks; more than the pool has: the last masks are empty."""


@wp.struct
class Mask:
    """Mask of one instance of a view: its first word, and the box in the image [px]; none: no columns."""

    first: int
    left: int
    top: int
    columns: int
    rows: int


@wp.func
def make_mask(box: wp.vec4i, first: int) -> Mask:
    """Mask of a box with inclusive sides."""
    mask = Mask()
    mask.first = first
    mask.left = box[0]
    mask.top = box[1]
    mask.columns = wp.max(box[2] - box[0] + 1, 0)
    mask.rows = wp.max(box[3] - box[1] + 1, 0)
    return mask


@wp.func
def read_mask(masks: InstanceMasks, view: int, body: int) -> Mask:
    """Mask of a body; without columns if it is a fixture, or if there are no masks."""
    if body < masks.first.shape[1]:
        return make_mask(masks.box[view, body], masks.first[view, body])
    return Mask()


@wp.func
def count_words(mask: Mask) -> int:
    """Words of a mask."""
    return mask.columns * ((mask.rows + ROWS - 1) // ROWS)


@wp.func
def add_pixel(masks: InstanceMasks, view: int, mask: Mask, row: int, column: int):
    """Set a pixel's bit in a mask, atomically; nothing outside its box, in which all of the instance's pixels are."""
    down = row - mask.top
    right = column - mask.left
    if down >= 0 and down < mask.rows and right >= 0 and right < mask.columns:
        wp.atomic_or(masks.words, view, mask.first + (down // ROWS) * mask.columns + right, wp.uint32(1) << wp.uint32(down % ROWS))


@wp.func
def has_pixel(masks: InstanceMasks, view: int, mask: Mask, row: int, column: int) -> bool:
    """True if a pixel of the image is in a mask."""
    down = row - mask.top
    right = column - mask.left
    if down < 0 or down >= mask.rows or right < 0 or right >= mask.columns:
        return False
    word = masks.words[view, mask.first + (down // ROWS) * mask.columns + right]
    return ((word >> wp.uint32(down % ROWS)) & wp.uint32(1)) != wp.uint32(0)


@wp.func
def clip_box(grid: ImageGrid, box: wp.vec4i) -> wp.vec4i:
    """Part of a box within the image; (0, 0, -1, -1) if there is none."""
    clipped = wp.vec4i(wp.max(box[0], 0), wp.max(box[1], 0), wp.min(box[2], grid.width - 1), wp.min(box[3], grid.height - 1))
    if clipped[2] < clipped[0] or clipped[3] < clipped[1]:
        return wp.vec4i(0, 0, -1, -1)
    return clipped


@wp.kernel
def lay_out_masks_kernel(grid: ImageGrid, bodies: ViewBodies, masks_out: InstanceMasks):
    """Lay out each view's masks in its pool: boxes, first words and the number of words, by exclusive prefix sums over the instances.

    A mask that does not fit is empty, and `length` then exceeds the pool. Launched over view, instance: each thread sums the words of the
    instances before its own.
    """
    view, instance = wp.tid()
    first = int(0)
    for before in range(instance):
        first += count_words(make_mask(clip_box(grid, bodies.box[view, before]), 0))
    box = clip_box(grid, bodies.box[view, instance])
    past = first + count_words(make_mask(box, 0))
    if past > masks_out.words.shape[1]:
        box = wp.vec4i(0, 0, -1, -1)
    masks_out.box[view, instance] = box
    masks_out.first[view, instance] = first
    if instance == masks_out.first.shape[1] - 1:
        masks_out.length[view] = past


@wp.kernel
def clear_masks_kernel(threads: int, masks_inout: InstanceMasks):
    """Clear the words in use. Launched over view, thread: `threads` threads stride over a view's words, whose number the host does not
    know.
    """
    view, thread = wp.tid()
    for word in range(thread, wp.min(masks_inout.length[view], masks_inout.words.shape[1]), threads):
        masks_inout.words[view, word] = wp.uint32(0)
