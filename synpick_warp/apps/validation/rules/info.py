"""Rules about scene_gt_info.json, by the definitions of the toolkit's calc_gt_info.py."""

from __future__ import annotations

from collections.abc import Iterator

from synpick_warp.apps.validation.registry import Findings, rule
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


@rule(SceneSubject, "visible-fraction", "compute it from the two counts")
def check_fraction(scene: SceneSubject) -> Findings:
    """visib_fract is px_count_visib / px_count_all, or 0 if px_count_all is 0."""
    for file, place, info in _infos(scene):
        expected = info.px_count_visib / info.px_count_all if info.px_count_all else 0.0
        if abs(info.visib_fract - expected) > FRACTION_TOLERANCE:
            yield file, f"{place}: visib_fract is {info.visib_fract:.4g}, but the counts give {expected:.4g}"


@rule(SceneSubject, "count-order", "count px_count_all over the whole silhouette, up to one image size beyond each border")
def check_order(scene: SceneSubject) -> Findings:
    """px_count_visib and px_count_valid are at most px_count_all, which includes the silhouette beyond the image."""
    for file, place, info in _infos(scene):
        for name in ("px_count_visib", "px_count_valid"):
            if getattr(info, name) > info.px_count_all:
                yield file, f"{place}: {name} is {getattr(info, name)}, more than px_count_all, {info.px_count_all}"


@rule(SceneSubject, "hidden-boxes", "write four times -1 for instances of which no pixel is visible, and boxes for all others")
def check_hidden_boxes(scene: SceneSubject) -> Findings:
    """bbox_obj and bbox_visib are -1, -1, -1, -1 if px_count_visib is 0, and only then."""
    for file, place, info in _infos(scene):
        for name in ("bbox_obj", "bbox_visib"):
            box = getattr(info, name)
            if (box == EMPTY) != (info.px_count_visib == 0):
                yield file, f"{place}: {name} is {box}, px_count_visib is {info.px_count_visib}"
            elif box != EMPTY and min(box[2:]) < 0:
                yield file, f"{place}: {name} is {box}; its size is negative"


@rule(SceneSubject, "box-inside-box", "compute both from the masks: x_min, y_min, x_max - x_min, y_max - y_min")
def check_nested_boxes(scene: SceneSubject) -> Findings:
    """bbox_visib lies inside bbox_obj."""
    for file, place, info in _infos(scene):
        outer, inner = info.bbox_obj, info.bbox_visib
        if EMPTY in (outer, inner):
            continue
        if any(inner[axis] < outer[axis] or inner[axis] + inner[axis + 2] > outer[axis] + outer[axis + 2] for axis in (0, 1)):
            yield file, f"{place}: bbox_visib {inner} reaches out of bbox_obj {outer}"


def _infos(scene: SceneSubject) -> Iterator[tuple[str, str, Info]]:
    """Yield (file, place for messages, entry) of each instance in scene_gt_info.json."""
    record = scene.record("gt_info")
    for image, infos in scene.infos.items():
        for index, info in enumerate(infos):
            yield record.where(image), f"image {image}, instance {index}", info
