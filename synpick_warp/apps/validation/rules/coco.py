"""Rules about scene_gt_coco.json and scene_gt_coco_modal.json, as the toolkit's calc_gt_coco.py writes them."""

from collections.abc import Iterator

import numpy as np
from msgspec import UNSET

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.scene_files import Annotation, StoredMask
from synpick_warp.apps.validation.subjects import CocoFile, SceneSubject, ViewSubject
from synpick_warp.exporters.writing.rle import find_run_boundaries
from synpick_warp.system.inputs.image_files import MAX_SIDE

IGNORED_VISIBILITY = 0.1
"""Visible fraction below which the toolkit sets `ignore`."""
FRACTION_SLACK = 1e-3
"""Distance from that fraction within which either value of `ignore` is right: files are often rounded."""


@rule(SceneSubject, "coco-schema", "make the file again with calc_gt_coco.py")
def check_schema(scene: SceneSubject) -> Findings:
    """scene_gt_coco.json has images, annotations and categories with COCO's keys and types."""
    for coco in scene.cocos:
        if coco.content is None:
            yield coco.file, coco.fault


@rule(SceneSubject, "coco-ids", "number the annotations from 1 on: pycocotools takes 0 for 'no match'")
def check_ids(scene: SceneSubject) -> Findings:
    """Annotation ids are 1, 2, 3, ... in each scene."""
    for coco in scene.cocos:
        ids = [annotation.id for annotation in coco.content.annotations] if coco.content else []
        wrong = next((place for place, number in enumerate(ids) if number != place + 1), None)
        if wrong is not None:
            yield coco.file, f"annotation {wrong} in the list has the id {ids[wrong]}; expected: {wrong + 1}"


@rule(SceneSubject, "coco-images", "list every image once, file_name relative to the scene's folder")
def check_images(scene: SceneSubject) -> Findings:
    """Its images are those of scene_gt.json, with the names of their files."""
    kind = scene.colour
    for coco in scene.cocos:
        listed = {image.id: image for image in coco.content.images} if coco.content else {}
        if coco.content is None or not scene.truths:
            continue
        for image in sorted(set(scene.truths) - set(listed)):
            yield coco.file, f"no image {image}"
        for image in sorted(set(listed) - set(scene.record("gt").raw)):
            yield coco.file, f"image {image} is not in {scene.record('gt').file}"
        for image in sorted(set(scene.truths) & set(listed)) if kind else ():
            path = scene.files.file(kind or "", image).removeprefix(f"{scene.place}/")
            if listed[image].file_name != path:
                yield coco.file, f"image {image}: file_name is {listed[image].file_name[:200]!a}, the file is {path}"


@rule(SceneSubject, "coco-categories", "use obj_id as the id of categories, also where ids have gaps")
def check_categories(scene: SceneSubject) -> Findings:
    """category_id is an obj_id, and categories lists it."""
    for coco in scene.cocos:
        if coco.content is not None:
            known = {category.id for category in coco.content.categories}
            for missing in sorted({annotation.category_id for annotation in coco.content.annotations} - known):
                yield coco.file, f"category_id {missing} is not in categories"
            for missing in sorted({item.obj_id for items in scene.truths.values() for item in items} - known):
                yield coco.file, f"obj_id {missing} of {scene.record('gt').file} is not in categories"


@rule(ViewSubject, "coco-instances", "leave out instances whose mask_visib is empty, and no others")
def check_instances(view: ViewSubject) -> Findings:
    """There is one annotation for each instance with visible pixels, in the order of scene_gt.json, with its obj_id as category."""
    for coco in view.scene.cocos if _has_masks(view) else ():
        given = [annotation.category_id for annotation in coco.by_image.get(view.image, ())]
        expected = [view.truths[index].obj_id for index, _, _ in _visible(view)]
        if given != expected and coco.content is not None:
            yield coco.file, f"image {view.image}: categories {_shorten(given)}; visible instances have obj_id {_shorten(expected)}"


@rule(
    ViewSubject,
    "coco-mask",
    "encode mask_visib column by column, starting with the number of zeros (pass bool, not 0/255, to the toolkit's encoder)",
)
def check_masks(view: ViewSubject) -> Findings:
    """segmentation is the uncompressed column-major run-length encoding of mask_visib; size is height, width; area counts its pixels."""
    for coco, annotation, _, visible, _ in _matched(view):
        place = f"image {view.image}, annotation {annotation.id}"
        runs = annotation.segmentation
        if isinstance(runs.counts, str):
            yield coco.file, f"{place}: counts is compressed; the toolkit writes a list"
        elif runs.size != visible.size[::-1]:
            hint = " (width and height are swapped)" if runs.size == visible.size else ""
            yield coco.file, f"{place}: size is {list(runs.size)}, the mask's is {list(visible.size[::-1])}{hint}"
        elif runs.counts != run_lengths(visible):
            yield coco.file, f"{place}: segmentation {_explain(runs.counts, visible)}"
        elif annotation.area is not UNSET and annotation.area != visible.count:
            yield coco.file, f"{place}: area is {annotation.area:g}, the mask has {visible.count} pixels"


@rule(ViewSubject, "coco-box", "compute the box from the mask with + 1; scene_gt_info.json has none")
def check_boxes(view: ViewSubject) -> Findings:
    """bbox is the tight box of mask, clipped to the image (modal files: of mask_visib), with width x_max - x_min + 1."""
    for coco, annotation, amodal, visible, _ in _matched(view):
        mask = visible if coco.modal else amodal
        if mask is not None and mask.box is not None and annotation.bbox != list(mask.box):
            x, y, width, height = mask.box
            hint = "; + 1 is missing" if annotation.bbox == [x, y, width - 1, height - 1] else ""
            stated = f"bbox is {annotation.bbox}, the mask's is {list(mask.box)}{hint}"
            yield coco.file, f"image {view.image}, annotation {annotation.id}: {stated}"


@rule(ViewSubject, "coco-ignore", "set ignore by visib_fract")
def check_ignore(view: ViewSubject) -> Findings:
    """ignore is true exactly where visib_fract is below 0.1."""
    for coco, annotation, _, _, index in _matched(view):
        fraction = view.infos[index].visib_fract if view.infos else IGNORED_VISIBILITY
        clear = annotation.ignore is not UNSET and abs(fraction - IGNORED_VISIBILITY) > FRACTION_SLACK
        if clear and annotation.ignore != (fraction < IGNORED_VISIBILITY):
            shown = str(annotation.ignore).lower()
            yield coco.file, f"image {view.image}, annotation {annotation.id}: ignore is {shown}, visib_fract {fraction:.4g}"


def run_lengths(mask: StoredMask) -> list[int]:
    """Run lengths of a mask in COCO's order: by columns, false pixels first."""
    runs = find_run_boundaries(mask.crop.view(np.uint8), mask.top, mask.left).runs_of(1)
    return runs.counts(mask.size[1], mask.size[0]).tolist()


def _has_masks(view: ViewSubject) -> bool:
    """Whether the scene has COCO files, and all visible masks of the view could be read."""
    return "mask_visib" in view.masks and None not in view.masks["mask_visib"] and bool(view.scene.cocos)


def _visible(view: ViewSubject) -> Iterator[tuple[int, StoredMask | None, StoredMask]]:
    """(index, amodal mask, visible mask) of the instances that have an annotation."""
    for index, visible in enumerate(view.masks.get("mask_visib", ())):
        if visible is not None and visible.box is not None:
            yield index, view.masks["mask"][index] if "mask" in view.masks else None, visible


def _matched(view: ViewSubject) -> Iterator[tuple[CocoFile, Annotation, StoredMask | None, StoredMask, int]]:
    """(file, annotation, amodal mask, visible mask, index) of annotations that correspond to instances one to one."""
    instances = list(_visible(view)) if _has_masks(view) else []
    for coco in view.scene.cocos if instances else ():
        given = coco.by_image.get(view.image, [])
        if [annotation.category_id for annotation in given] == [view.truths[index].obj_id for index, _, _ in instances]:
            for annotation, (index, amodal, visible) in zip(given, instances, strict=True):
                yield coco, annotation, amodal, visible, index


def _explain(counts: list[int], mask: StoredMask) -> str:
    """Text on how run lengths differ from those of the mask: size, order, inversion, or number of pixels."""
    width, height = mask.size
    if sum(counts) != width * height or max(mask.size) > MAX_SIDE:
        return f"has runs of {sum(counts)} pixels, the image has {width * height}"
    flat = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
    whole = mask.window(0, 0, width, height)
    if np.array_equal(flat.reshape(height, width), whole):
        return "is encoded row by row; COCO's encoding goes column by column"
    given = flat.reshape(width, height).T
    if np.array_equal(given, ~whole):
        return "is inverted: its runs begin with the mask instead of zeros"
    return f"differs from {mask.file} in {np.count_nonzero(given != whole)} pixels"


def _shorten(values: list[int]) -> str:
    """List as text; beyond 12 values their number."""
    return str(values) if len(values) <= 12 else f"[{', '.join(map(str, values[:12]))}, ...] ({len(values)})"
