"""Rules about colour, greyscale and depth images, and about masks: that they decode, sizes, types, and agreement with annotations."""

from collections.abc import Iterable, Iterator

import cv2
import numpy as np

from synpick_warp.apps.validation.registry import Deviation, Findings, Level, rule
from synpick_warp.apps.validation.rules.records import EMPTY, box_sides
from synpick_warp.apps.validation.scene_files import Info, StoredMask
from synpick_warp.apps.validation.subjects import ViewSubject

MIN_KNOWN_DEPTH = 0.05
"""Smallest fraction of pixels with depth that raises no warning; the poorest sensors of BOP's sets have half."""


@rule(ViewSubject, "image-decodes", "restore the file: it is damaged, empty or of another format")
def check_decodes(view: ViewSubject) -> Findings:
    """Every image is a PNG, JPEG or TIFF file that decodes."""
    _ = view.colour, view.depth, view.masks
    yield from dict.fromkeys(view.faults)


@rule(ViewSubject, "image-size", "write them at the resolution of the camera")
def check_sizes(view: ViewSubject) -> Findings:
    """Colour, depth and masks of an image have the same width and height."""
    if view.size is None:
        return
    sizes = [(mask.file, mask.size) for masks in view.masks.values() for mask in masks if mask is not None]
    if view.depth_file is not None:
        sizes.append((view.depth_file.file, view.depth_file.size))
    for file, size in sizes:
        if size != view.size:
            yield file, f"{size[0]} x {size[1]} px; the image has {view.size[0]} x {view.size[1]}"


@rule(ViewSubject, "colour-type", "convert the image; put greyscale images into gray")
def check_colour(view: ViewSubject) -> Findings:
    """rgb has three channels of 8 bits, gray one of 8 or 16 bits."""
    if view.colour is None:
        return
    file, image, _ = view.colour
    if view.scene.colour == "rgb":
        if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
            return
    elif image.dtype in (np.uint8, np.uint16) and (image.ndim == 2 or (image[..., :1] == image[..., :3]).all()):
        return
    yield file, f"{(*image.shape[2:], 1)[0]} channels of type {image.dtype}"


@rule(ViewSubject, "depth-type", "write uint16 counts, clamped to 65535; 0 is no measurement")
def check_depth_type(view: ViewSubject) -> Findings:
    """Depth is a PNG (or TIFF) file of one channel with 16 bits."""
    if view.depth_file is None:
        return
    file, image, kind = view.depth_file
    if image.ndim != 2 or image.dtype != np.uint16:
        bits = f"{kind[0]} bits {kind[1]}" if kind else f"type {image.dtype}"
        yield file, f"{(*image.shape[2:], 1)[0]} channels, {bits}"


@rule(ViewSubject, "depth-known", "check the writer, and depth_scale: counts above 65535 do not fit", level=Level.WARNING)
def check_depth_known(view: ViewSubject) -> Findings:
    """A depth image has measurements."""
    if view.depth is not None and view.depth_file is not None:
        known = np.count_nonzero(view.depth) / view.depth.size
        if known < MIN_KNOWN_DEPTH:
            yield view.depth_file.file, f"only {known:.1%} of the pixels have depth"


COUNT_SLACK, COUNT_FRACTION = 2, 1e-3
"""Largest difference of a count from the mask's: pixels, or a fraction of them (the acceptance bound of reference renderers)."""


def _all_masks(view: ViewSubject, kind: str) -> Iterator[tuple[int, StoredMask]]:
    """Yield (index, mask) of the masks that exist and have the view's size."""
    for index, mask in enumerate(view.masks.get(kind, ())):
        if mask is not None and mask.size == view.size:
            yield index, mask


def _pairs(view: ViewSubject, kind: str) -> Iterator[tuple[int, StoredMask, Info]]:
    """Yield (index, mask, info) of each instance whose mask of this kind could be read; nothing without infos."""
    for index, mask in _all_masks(view, kind) if view.infos else ():
        yield index, mask, view.infos[index]


def _file(view: ViewSubject) -> str:
    """File that holds the infos of the view, for messages."""
    return view.scene.record("gt_info").where(view.image)


@rule(ViewSubject, "mask-type", "write uint8 masks of one channel, 255 where the instance is")
def check_type(view: ViewSubject) -> Findings:
    """Masks are 8-bit greyscale images of 0 and 255 alone."""
    for masks in view.masks.values():
        for mask in masks:
            if mask is not None and mask.kind not in (None, (8, "greyscale")):
                yield mask.file, f"{mask.kind[0]} bits {mask.kind[1]}" if mask.kind else "another type"
            elif mask is not None and not mask.binary:
                yield mask.file, "values besides 0 and 255"


@rule(ViewSubject, "mask-inside-mask", "cut mask_visib from mask; check that both have the same index", unit="px")
def check_inside(view: ViewSubject) -> Findings:
    """mask_visib is a part of mask."""
    amodal = dict(_all_masks(view, "mask"))
    for index, visible in _all_masks(view, "mask_visib"):
        if index in amodal and visible.box is not None:
            outside = visible.crop & ~amodal[index].window(*visible.box)
            count = int(np.count_nonzero(outside))
            text = f"{count} of {visible.count} visible pixels are outside of the silhouette in mask"
            value = _farthest(visible, amodal[index]) if count else 0.0
            yield Deviation(visible.file, text, view.truths[index].obj_id, value, count > 0)


def _farthest(visible: StoredMask, amodal: StoredMask) -> float:
    """Directed Hausdorff distance of a visible mask to an amodal one [px]: of the pixel that is farthest from it."""
    width, height = visible.size
    if amodal.box is None:
        return float(np.hypot(width, height))
    beside = (~amodal.window(0, 0, width, height)).astype(np.uint8)
    away = cv2.distanceTransform(beside, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return float(away[visible.window(0, 0, width, height)].max())


@rule(ViewSubject, "mask-overlap", "give each pixel to the nearest instance")
def check_overlap(view: ViewSubject) -> Findings:
    """Visible masks of an image do not overlap. Checked where masks are exact: the toolkit's, made from depth with a tolerance, do."""
    if not view.scene.layout.ours or view.size is None:
        return
    taken = np.zeros((view.size[1], view.size[0]), bool)
    for _, mask in _all_masks(view, "mask_visib"):
        if mask.box is not None:
            left, top, width, height = mask.box
            part = taken[top : top + height, left : left + width]
            shared = np.count_nonzero(part & mask.crop)
            if shared:
                yield mask.file, f"{shared} pixels belong to another instance as well"
            part |= mask.crop


@rule(ViewSubject, "visible-count", "count the mask's pixels")
def check_visible_count(view: ViewSubject) -> Findings:
    """px_count_visib is the number of pixels of mask_visib."""
    for index, mask, info in _pairs(view, "mask_visib"):
        if _differ(info.px_count_visib, mask.count):
            stated = f"px_count_visib is {info.px_count_visib}"
            yield _file(view), f"image {view.image}, instance {index}: {stated}, {mask.file} has {mask.count}"


@rule(ViewSubject, "valid-count", "count the pixels of mask whose depth is not 0")
def check_valid_count(view: ViewSubject) -> Findings:
    """px_count_valid is the number of pixels of mask that have depth."""
    depth = view.depth
    if depth is None or depth.shape[::-1] != view.size:
        return
    for index, mask, info in _pairs(view, "mask"):
        count = 0
        if mask.box is not None:
            left, top, width, height = mask.box
            count = int(np.count_nonzero(mask.crop & (depth[top : top + height, left : left + width] > 0)))
        if _differ(info.px_count_valid, count):
            stated = f"px_count_valid is {info.px_count_valid}"
            yield _file(view), f"image {view.image}, instance {index}: {stated}; in {mask.file} {count} have depth"


@rule(ViewSubject, "amodal-count", "count the silhouette in the image and up to one image size beyond each border")
def check_amodal_count(view: ViewSubject) -> Findings:
    """px_count_all is the number of pixels of mask, or more if the silhouette touches the image's border."""
    for index, mask, info in _pairs(view, "mask"):
        inside = not _touched_sides(mask)
        if (inside and _differ(info.px_count_all, mask.count)) or info.px_count_all + COUNT_SLACK < mask.count * (1.0 - COUNT_FRACTION):
            yield _file(view), f"image {view.image}, instance {index}: px_count_all is {info.px_count_all}, {mask.file} has {mask.count}"


@rule(ViewSubject, "visible-box", "compute the box from the mask; COCO's boxes have + 1, these do not", unit="px")
def check_visible_box(view: ViewSubject) -> Findings:
    """bbox_visib is the tight box of mask_visib: x_min, y_min, x_max - x_min, y_max - y_min, without + 1."""
    for index, mask, info in _pairs(view, "mask_visib"):
        if mask.box is not None and info.bbox_visib != EMPTY:
            text = f"image {view.image}, instance {index}: bbox_visib is {_describe(info.bbox_visib, mask.box)}"
            value = _farthest_side(info.bbox_visib, mask.box, range(4))
            yield Deviation(_file(view), text, view.truths[index].obj_id, value, value > 0)


@rule(ViewSubject, "amodal-box", "compute the box from the whole silhouette; COCO's boxes have + 1, these do not", unit="px")
def check_amodal_box(view: ViewSubject) -> Findings:
    """bbox_obj is the tight box of the whole silhouette, without + 1; beyond the image where the silhouette is."""
    for index, mask, info in _pairs(view, "mask"):
        if mask.box is None or info.bbox_obj == EMPTY:
            continue
        box, wrong = info.bbox_obj, wrong_sides(info.bbox_obj, mask)
        cut = f"bbox_obj {box}, cut at the border, is not the box of {mask.file}"
        text = f"image {view.image}, instance {index}: {cut if _touched_sides(mask) else f'bbox_obj is {_describe(box, mask.box)}'}"
        yield Deviation(_file(view), text, view.truths[index].obj_id, _farthest_side(box, mask.box, wrong), bool(wrong))


def _farthest_side(box: list[int], seen: tuple[int, int, int, int], sides: Iterable[int]) -> float:
    """Largest distance of a box in BOP's convention from that of a mask at some sides, as in `box_sides` [px]; 0 at none."""
    stated, found = box_sides(box), box_sides(bop_box(seen))
    return float(max((abs(stated[side] - found[side]) for side in sides), default=0))


def wrong_sides(box: list[int], mask: StoredMask) -> list[int]:
    """Sides, as in `box_sides`, on which the amodal box of a silhouette contradicts its mask (its part inside the image, not empty).

    A silhouette that ends inside the image must agree on all sides. Of one that is cut, only the side opposite to the border is known, and
    only if its box stays within the image on the others: around a corner of the image it may reach farther than inside.
    """
    if mask.box is None:
        return []
    stated, seen, touched = box_sides(box), box_sides(bop_box(mask.box)), _touched_sides(mask)
    image = box_sides([0, 0, mask.size[0] - 1, mask.size[1] - 1])
    beyond = {side for side in range(4) if touched and stated[side] > image[side]}
    known = [side for side in range(4) if touched | beyond <= {(side + 2) % 4}]
    return [side for side in range(4) if stated[side] < seen[side] or (side in known and stated[side] != seen[side])]


def bop_box(box: tuple[int, int, int, int]) -> list[int]:
    """Box in BOP's convention from one with pixel counts as sizes."""
    return [box[0], box[1], box[2] - 1, box[3] - 1]


def _touched_sides(mask: StoredMask) -> set[int]:
    """Borders of the image that a silhouette reaches, as in `box_sides`; all, if it is empty and may lie outside."""
    if mask.box is None:
        return {0, 1, 2, 3}
    left, top, width, height = mask.box
    reached = left == 0, top == 0, left + width == mask.size[0], top + height == mask.size[1]
    return {side for side, reaches in enumerate(reached) if reaches}


def _differ(count: int, expected: int) -> bool:
    """Whether a count is off by more than the slack (COUNT_SLACK pixels or COUNT_FRACTION)."""
    return abs(count - expected) > max(COUNT_SLACK, COUNT_FRACTION * expected)


def _describe(stated: list[int], box: tuple[int, int, int, int]) -> str:
    """Stated and expected box as text, with a hint if width and height are too large by 1."""
    hint = "; width and height have + 1" if stated == list(box) else ""
    return f"{stated}, the mask's is {bop_box(box)}{hint}"
