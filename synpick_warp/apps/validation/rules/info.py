"""Rules about scene_gt_info.json, by the definitions of the toolkit's calc_gt_info.py."""

from __future__ import annotations

from collections.abc import Iterator

from synpick_warp.apps.validation.registry import Deviation, Findings, rule
from synpick_warp.apps.validation.schemas import Info
from synpick_warp.apps.validation.subjects import SceneSubject

FRACTION_TOLERANCE = 1e-3
"""Largest error of visib_fract; files are often rounded."""
EMPTY = [-1, -1, -1, -1]


@rule(SceneSubject, "list-lengths", "make scene_gt_info.json again from scene_gt.json (calc_gt_info.py)")
def check_lengths(scene: SceneSubject) -> Findings:
    """scene_gt_info.json has as many entries for an image as scene_gt.json, in the same order."""
    record = scene.record("gt_info")
    for image, infos in scene.infos.items():
        truths = scene.truths.get(image)
        if truths is not None and len(truths) != len(infos):
            yield record.where(image), f"image {image} has {len(infos)} infos, but {len(truths)} instances"


@rule(SceneSubject, "visible-fraction", "compute it from the two counts", unit="px")
def check_fraction(scene: SceneSubject) -> Findings:
    """visib_fract is px_count_visib / px_count_all, or 0 if px_count_all is 0."""
    for file, place, obj_id, info in _infos(scene):
        expected = info.px_count_visib / info.px_count_all if info.px_count_all else 0.0
        text = f"{place}: visib_fract is {info.visib_fract:.4g}, but the counts give {expected:.4g}"
        if abs(info.visib_fract - min(expected, 1.0)) > FRACTION_TOLERANCE and abs(info.visib_fract - expected) > FRACTION_TOLERANCE:
            yield file, text
        else:
            # Clipped at 1: the visible mask has more pixels than the silhouette.
            error = abs(info.visib_fract - expected)
            yield Deviation(file, text, obj_id, error * info.px_count_all / _outline(info), error > FRACTION_TOLERANCE)


@rule(SceneSubject, "count-order", "count px_count_all over the whole silhouette, up to one image size beyond each border", unit="px")
def check_order(scene: SceneSubject) -> Findings:
    """px_count_visib and px_count_valid are at most px_count_all, which includes the silhouette beyond the image."""
    for file, place, obj_id, info in _infos(scene):
        excess = max(0, info.px_count_visib - info.px_count_all)
        text = f"{place}: px_count_visib is {info.px_count_visib}, more than px_count_all, {info.px_count_all}"
        yield Deviation(file, text, obj_id, excess / _outline(info), excess > 0)
        if info.px_count_valid > info.px_count_all:
            yield file, f"{place}: px_count_valid is {info.px_count_valid}, more than px_count_all, {info.px_count_all}"


@rule(SceneSubject, "hidden-boxes", "write four times -1 for instances of which no pixel is visible, and boxes for all others")
def check_hidden_boxes(scene: SceneSubject) -> Findings:
    """bbox_obj and bbox_visib are -1, -1, -1, -1 if px_count_visib is 0, and only then."""
    for file, place, _, info in _infos(scene):
        for name in ("bbox_obj", "bbox_visib"):
            box = getattr(info, name)
            if (box == EMPTY) != (info.px_count_visib == 0):
                yield file, f"{place}: {name} is {box}, px_count_visib is {info.px_count_visib}"
            elif box != EMPTY and min(box[2:]) < 0:
                yield file, f"{place}: {name} is {box}; its size is negative"


@rule(SceneSubject, "box-inside-box", "compute both from the masks: x_min, y_min, x_max - x_min, y_max - y_min", unit="px")
def check_nested_boxes(scene: SceneSubject) -> Findings:
    """bbox_visib lies inside bbox_obj."""
    for file, place, obj_id, info in _infos(scene):
        outer, inner = info.bbox_obj, info.bbox_visib
        if EMPTY in (outer, inner):
            continue
        beyond = [side - limit for side, limit in zip(box_sides(inner), box_sides(outer), strict=True)]
        text = f"{place}: bbox_visib {inner} reaches out of bbox_obj {outer}"
        yield Deviation(file, text, obj_id, max(0, *beyond), max(beyond) > 0)


def box_sides(box: list[int]) -> tuple[int, int, int, int]:
    """Extents of a box to the left, top, right and bottom, each the larger the farther the box reaches: -x, -y, x + width, y + height."""
    return -box[0], -box[1], box[0] + box[2], box[1] + box[3]


def _outline(info: Info) -> int:
    """Length of the outline of an instance [px], by which differences of counts are divided: that of its box."""
    return 2 * (max(info.bbox_obj[2], 0) + max(info.bbox_obj[3], 0) + 2)


def _infos(scene: SceneSubject) -> Iterator[tuple[str, str, int, Info]]:
    """Yield (file, place for messages, obj_id, entry) of each instance in scene_gt_info.json; obj_id 0: unknown."""
    record = scene.record("gt_info")
    for image, infos in scene.infos.items():
        truths = scene.truths.get(image, [])
        for index, info in enumerate(infos):
            obj_id = truths[index].obj_id if index < len(truths) else 0
            yield record.where(image), f"image {image}, instance {index}", obj_id, info
