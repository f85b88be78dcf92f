"""Amodal masks: one bit per pixel of each instance's bounding box, in words of MASK_ROWS rows of a column, from a pool of words per view.

A box takes as many words as it needs, wherever the boxes before it end (prefix sum), so work, copies and memory grow with covered area,
not with the number of instances; `stages.view_ring` forms batches whose masks fit. Words lie along the rows of the image, as its pixels
do: neighbouring columns are neighbouring words.
"""

import warp as wp

from synpick_warp.codes import MASK_ROWS
from synpick_warp.kernels.render.visibility.camera import ImageGrid
from synpick_warp.kernels.render.visibility.damage import Damage, has_moved
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
class KeptMasks:
    """Amodal masks of the previous frame of each world and camera, in the layout of the pool of `InstanceMasks`."""

    first: wp.array2d[int]
    """(kept, instance): index in `words` of the first word of the instance's mask."""
    words: wp.array2d[wp.uint32]
    """(kept, word): words of the masks."""
    length: wp.array[int]
    """(kept): words of all masks; 0, or more than there is room for: none are kept."""


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
def drawn_mask(masks: InstanceMasks, view: int, body: int, kept: bool) -> Mask:
    """Mask of a body that is drawn anew; without columns if it is `kept`."""
    if kept:
        return Mask()
    return read_mask(masks, view, body)


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


@wp.func
def is_kept(damage: Damage, kept: KeptMasks, view: int, body: int) -> bool:
    """Whether a body is at rest and the masks of the previous frame are kept: its mask has the same box and the same words."""
    if has_moved(damage, view, body):
        return False
    length = kept.length[damage.kept_row[view]]
    return length > 0 and length <= kept.words.shape[1]


@wp.kernel
def restore_masks_kernel(damage: Damage, kept: KeptMasks, threads: int, masks_inout: InstanceMasks):
    """Copy the masks of instances at rest from the previous frame, and clear all others. Launched over view, instance, thread: `threads`
    threads stride over an instance's words, whose number the host does not know."""
    view, instance, thread = wp.tid()
    rests = is_kept(damage, kept, view, instance)
    mask = read_mask(masks_inout, view, instance)
    for i in range(thread, count_words(mask), threads):
        word = wp.uint32(0)
        if rests:
            row = damage.kept_row[view]
            word = kept.words[row, kept.first[row, instance] + i]
        masks_inout.words[view, mask.first + i] = word


@wp.kernel
def keep_masks_kernel(damage: Damage, masks: InstanceMasks, threads: int, kept_inout: KeptMasks):
    """Store the masks of this frame for the next one. Launched over view, thread: `threads` threads stride over a view's words."""
    view, thread = wp.tid()
    row, length = damage.kept_row[view], masks.length[view]
    kept_inout.length[row] = wp.where(length <= masks.words.shape[1], length, 0)
    for instance in range(thread, masks.first.shape[1], threads):
        kept_inout.first[row, instance] = masks.first[view, instance]
    for word in range(thread, wp.min(length, kept_inout.words.shape[1]), threads):
        kept_inout.words[row, word] = masks.words[view, word]
