"""Diagnosis of a re-rendered view, and rules about poses against pixels, of a sample of views.

Three things must agree: the pose (by its rendered silhouette and depth), the masks and the depth image. Where two of them agree, the
third is named, with how much it is off.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from enum import StrEnum
from functools import cached_property

import numpy as np

from synpick_warp.apps.validation.comparison import ComparedView, Instance, best_shift, fit_masks, moved
from synpick_warp.apps.validation.registry import Deviation, Findings, rule

SCALE_SPREAD = 0.003
"""Largest spread of the instances' ratios of depth to the model, for depth as a whole to be scaled."""
RAY_GAIN = 0.25
"""Depth is taken for the ray's length if that leaves less than this fraction of the error."""
AGREEING = 0.8
"""Minimum fraction of a pose's visible pixels whose image depth has the rendered depth, for the pose to be accepted."""
AGREEING_BESIDE = 0.5
"""Minimum fraction, as AGREEING, of visible pixels outside the mask. It is lower, because depth there may also show the background."""
MIN_BESIDE = 10
"""Smallest number of pixels beside the mask that decide [px]."""
BEYOND = 0.2
"""Maximum fraction of a visible mask's pixels whose depth error exceeds the tolerance."""
SWAPPED = 0.85
"""Intersection over union from which a mask is that of another instance."""
MAX_OTHERS = 8
"""Most other objects that are tried at a pose."""
LEFT_OUT = 0.05
"""Largest fraction of the pixels that depth shows to be visible that mask_visib may leave out."""


class Kind(StrEnum):
    """Error class of a finding: the image or annotation that is inconsistent with the others."""

    SCALE = "depth scale"
    RAY = "ray length"
    SHIFT = "shifted mask"
    SHIFT_VISIBLE = "shifted visible mask"
    SWAP = "swapped instances"
    OBJECT = "object"
    POSE = "pose"
    MASK = "mask"
    DEPTH = "depth"
    VISIBLE = "visible mask"


MEASURED = (Kind.SHIFT, Kind.POSE, Kind.MASK, Kind.VISIBLE, Kind.DEPTH)
"""Kinds for which a deviation is measured, of each instance."""


@dataclass(frozen=True)
class Finding:
    """Contradiction between a rendered view and its files."""

    kind: Kind
    index: int | None
    """Ground-truth index; None: the whole image."""
    text: str
    """What is wrong."""
    other: int | None = None
    """Ground-truth index of the second instance of a swap."""

    def explains(self, index: int, unit: str) -> bool:
        """Whether it explains the deviation of an instance: it concerns the instance, or the depth of the whole image (unit mm)."""
        return index in (self.index, self.other) or (self.index is None and unit == "mm")


class DiagnosedView(ComparedView):
    """A re-rendered view with what was found in it: the subject of the rules about poses."""

    @cached_property
    def findings(self) -> list[Finding]:
        """All contradictions between rendering and files; found once for all rules."""
        return diagnose(self)

    @cached_property
    def deviations(self) -> dict[Kind, list[tuple[int, float]]]:
        """Deviations by kind: (ground-truth index, deviation) of each compared instance; poses and depth in mm, masks and shifts in px."""
        found: dict[Kind, list[tuple[int, float]]] = {kind: [] for kind in MEASURED}
        for item in self.instances:
            for kind, value in _measure(item, self.tolerance):
                found[kind].append((item.index, value))
        return found


def diagnose(rendered: ComparedView) -> list[Finding]:
    """Find all contradictions between the rendering of a view and its files."""
    instances = rendered.instances
    fits = {item.index: _outline_fits(item, rendered) for item in instances}
    findings, ratio = _check_depth(rendered, [item for item in instances if fits[item.index]])
    if findings and ratio is None:
        return findings
    if ratio is not None:
        for item in instances:
            item.depth = None if item.depth is None else item.depth / np.float32(ratio)
        # Which pixels are occluded depends on depth.
        fits = {item.index: _outline_fits(item, rendered) for item in instances}
    bad = [item for item in instances if not fits[item.index]]
    done: set[int] = set()
    for item in bad:
        if item.index not in done:
            # An instance whose mask fits this silhouette and whose silhouette fits this mask.
            others = (other for other in bad if other.index not in done and other is not item)
            other = next((other for other in others if min(_overlap(item, other), _overlap(other, item)) > SWAPPED), None)
            if other is not None:
                done |= {item.index, other.index}
                text = f"image {rendered.view.image}: instances {item.index} and {other.index} look swapped"
                findings.append(Finding(Kind.SWAP, item.index, text, other.index))
    findings += [_explain(item, rendered) for item in bad if item.index not in done]
    for item in instances:
        if fits[item.index]:
            findings += _check_instance(item, rendered)
    return findings


def _reference(item: Instance, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Mask, and the rendering that it must equal: amodal masks and silhouettes, else visible masks and visible parts."""
    if item.mask is not None:
        return item.mask, item.silhouette
    assert item.visible is not None
    return item.visible, item.visible_part(tolerance)


def _outline_fits(item: Instance, rendered: ComparedView) -> bool:
    """Whether mask and silhouette agree. Without amodal masks it is enough that visible pixels lie in the silhouette."""
    mask, silhouette = _reference(item, rendered.tolerance)
    within = None if rendered.given is None else rendered.given.px
    if item.mask is not None:
        return fit_masks(mask, silhouette, exact=rendered.view.scene.layout.ours, within=within).good
    return fit_masks(mask & item.silhouette, mask, within=within).good and (
        item.depth is None or fit_masks(mask, silhouette).iou > 1.0 - AGREEING
    )


def _check_depth(rendered: ComparedView, instances: list[Instance]) -> tuple[list[Finding], float | None]:
    """Depth as a whole: scaled, or ray lengths. Returns the finding, and the scale if it is one."""
    view, tolerance = rendered.view, rendered.tolerance
    parts = [item for item in instances if np.count_nonzero(item.seen) >= 20]
    if not parts or rendered.matrix is None:
        return [], None
    pairs = [(item.depth[item.seen], item.rendered[item.seen]) for item in parts if item.depth is not None]
    ratios = np.array([np.median(depth / model) for depth, model in pairs])
    planar = np.concatenate([np.abs(depth - model) for depth, model in pairs])
    lengths = [_ray(item, rendered.matrix)[item.seen] for item in parts]
    rays = np.concatenate([np.abs(depth - model * length) for (depth, model), length in zip(pairs, lengths, strict=True)])
    error = float(np.percentile(planar, 75))
    if error > tolerance and float(np.percentile(rays, 75)) < min(tolerance, RAY_GAIN * error):
        return [Finding(Kind.RAY, None, f"image {view.image}: depth is the length of the ray, not planar depth")], None
    ratio = float(np.median(ratios))
    distance = float(np.median(np.concatenate([item.rendered[item.seen] for item in parts])))
    scaled = abs(ratio - 1.0) * distance > tolerance and float(np.abs(ratios - ratio).max()) < SCALE_SPREAD
    if scaled and (len(parts) > 1 or abs(ratio - 1.0) > SCALE_SPREAD):
        return [Finding(Kind.SCALE, None, f"image {view.image}: depth is {ratio:.4g} times the rendered depth")], ratio
    return [], None


def _ray(item: Instance, matrix: np.ndarray) -> np.ndarray:
    """Ratio of ray length to planar depth at the pixels of an instance's window (h, w)."""
    height, width = item.rendered.shape
    x = (item.left + np.arange(width) + 0.5 - matrix[0, 2]) / matrix[0, 0]
    y = (item.top + np.arange(height) + 0.5 - matrix[1, 2]) / matrix[1, 1]
    return np.sqrt(1.0 + x[None] ** 2 + y[:, None] ** 2).astype(np.float32)


def _overlap(item: Instance, other: Instance) -> float:
    """Intersection over union of one instance's mask and another's silhouette; without amodal masks, the part of the visible one in it."""
    mask = item.visible if item.mask is None else item.mask
    assert mask is not None
    left, top = min(item.left, other.left), min(item.top, other.top)
    right = max(item.left + mask.shape[1], other.left + other.rendered.shape[1])
    bottom = max(item.top + mask.shape[0], other.top + other.rendered.shape[0])
    one, two = np.zeros((bottom - top, right - left), bool), np.zeros((bottom - top, right - left), bool)
    one[item.top - top :, item.left - left :][: mask.shape[0], : mask.shape[1]] = mask
    two[other.top - top :, other.left - left :][: other.rendered.shape[0], : other.rendered.shape[1]] = other.silhouette
    shared = np.count_nonzero(one & two)
    return shared / max(1, np.count_nonzero(one if item.mask is None else one | two))


def _explain(item: Instance, rendered: ComparedView) -> Finding:
    """Classify a mismatch of mask and silhouette: shifted mask, other object, wrong pose or wrong mask."""
    tolerance, place = rendered.tolerance, f"image {rendered.view.image}, instance {item.index}"
    mask, silhouette = _reference(item, tolerance)
    fit = fit_masks(mask, silhouette)
    if not silhouette.any() and mask.any():
        text = "the object is outside of the image or hidden at this pose, its mask is not empty"
        return Finding(Kind.POSE, item.index, f"{place}: {text}")
    if not mask.any():
        text = f"the mask is empty, but {np.count_nonzero(silhouette)} px of the object are in the image"
        return Finding(Kind.MASK, item.index, f"{place}: {text}")
    shift = _find_shift(mask, silhouette)
    if _pose_agrees(item, mask, tolerance):
        if shift is not None:
            return Finding(Kind.SHIFT, item.index, f"{place}: the mask is shifted by ({shift[0]}, {shift[1]}) px")
        return Finding(Kind.MASK, item.index, f"{place}: the mask differs from the silhouette in {fit.differing} px (IoU {fit.iou:.2f})")
    if shift is None and (other := _find_object(item, mask, rendered)) is not None:
        return Finding(Kind.OBJECT, item.index, f"{place}: the mask shows object {other} at this pose, obj_id is {item.obj_id}")
    return Finding(Kind.POSE, item.index, f"{place}: {_describe_offset(item, rendered, shift, fit.iou)}")


def _find_shift(mask: np.ndarray, silhouette: np.ndarray) -> tuple[int, int] | None:
    """Columns and rows by which a mask is shifted; None: a shift does not explain how it differs."""
    right, down = best_shift(mask, silhouette)
    if not (right or down):
        return None
    before, after = fit_masks(mask, silhouette).iou, fit_masks(moved(mask, -right, -down), silhouette).iou
    return (right, down) if after > max(0.9, before) else None


def _find_object(item: Instance, mask: np.ndarray, rendered: ComparedView) -> int | None:
    """obj_id of another object of the view whose silhouette at this pose fits the mask; None: there is none."""
    if item.mask is None:
        return None
    others = dict.fromkeys(truth.obj_id for truth in rendered.view.truths if truth.obj_id != item.obj_id)
    return next((other for other in list(others)[:MAX_OTHERS] if fit_masks(mask, rendered.render_other(item, other)).good), None)


def _pose_agrees(item: Instance, mask: np.ndarray, tolerance: float) -> bool:
    """Depth consistency test of a pose: whether enough pixels of the depth image have the rendered depth within `tolerance` [mm].

    Tested are the visible pixels outside the mask if there are MIN_BESIDE (AGREEING_BESIDE of them must agree), else all (AGREEING). A
    median error beyond the tolerance with little spread contradicts the pose.
    """
    part = item.visible_part(tolerance)
    if item.depth is None:
        return False
    part &= item.depth > 0.0
    errors = (item.depth - item.rendered)[item.seen]
    if errors.size >= 20 and abs(float(np.median(errors))) > tolerance > _spread(errors):
        # The object is there, and as a whole nearer or farther.
        return False
    agreeing = part & (np.abs(item.depth - item.rendered) <= tolerance)
    beside = np.count_nonzero(part & ~mask)
    if beside >= MIN_BESIDE:
        return bool(np.count_nonzero(agreeing & ~mask) >= AGREEING_BESIDE * beside)
    count = np.count_nonzero(part)
    return bool(count > 0 and np.count_nonzero(agreeing) >= AGREEING * count)


def _describe_offset(item: Instance, rendered: ComparedView, shift: tuple[int, int] | None, iou: float) -> str:
    """Size of a pose error: sideways from the shift of the mask, along the ray from depth in it."""
    assert rendered.matrix is not None
    distance = float(item.translation[2])
    away, spread = 0.0, 0.0
    if item.depth is not None and item.visible is not None:
        there = item.silhouette if shift is None else moved(item.silhouette, *shift)
        known = there & item.visible & (item.depth > 0.0)
        model = item.rendered if shift is None else moved(item.rendered, *shift, np.inf)
        errors = (item.depth - model)[known & np.isfinite(model)]
        away = float(np.median(errors)) if errors.size else 0.0
        spread = _spread(errors) if errors.size else 0.0
    if shift is None and abs(away) > rendered.tolerance > spread:
        return f"the pose is off by about {abs(away):.2g} mm along the optical axis"
    if shift is None:
        return f"the pose does not fit the image: IoU of mask and silhouette {iou:.2f}, depth differs by a median of {away:+.3g} mm"
    x, y = shift[0] * distance / rendered.matrix[0, 0], shift[1] * distance / rendered.matrix[1, 1]
    return f"the pose is off by about {np.sqrt(x * x + y * y + away * away):.2g} mm (x {x:+.1f}, y {y:+.1f}, z {away:+.1f} mm)"


def _spread(errors: np.ndarray) -> float:
    """Robust spread: upper quartile of the distances from the median."""
    return float(np.percentile(np.abs(errors - np.median(errors)), 75))


def _check_instance(item: Instance, rendered: ComparedView) -> list[Finding]:
    """Depth inside the visible mask, and pixels that the mask leaves out, of an instance whose outline fits."""
    if item.depth is None or item.visible is None:
        return []
    tolerance, place = rendered.tolerance, f"image {rendered.view.image}, instance {item.index}"
    if item.mask is not None and rendered.view.scene.exact and rendered.given is None:
        expected = item.visible_part(tolerance)
        shift = _find_shift(item.visible, expected) if not fit_masks(item.visible, expected).good else None
        if shift is not None and _pose_agrees(item, item.visible, tolerance):
            return [Finding(Kind.SHIFT_VISIBLE, item.index, f"{place}: mask_visib is shifted by ({shift[0]}, {shift[1]}) px")]
    errors = (item.depth - item.rendered)[item.seen]
    if errors.size >= 20:
        median, beyond = float(np.median(errors)), float(np.mean(np.abs(errors) > tolerance))
        if abs(median) > tolerance:
            return [Finding(Kind.POSE, item.index, f"{place}: the pose is off by about {abs(median):.2g} mm along the optical axis")]
        if beyond > BEYOND:
            return [Finding(Kind.DEPTH, item.index, f"{place}: depth differs from the model by more than {tolerance:g} mm in {beyond:.0%}")]
    part = item.visible_part(tolerance) & (item.depth > 0.0) & (np.abs(item.depth - item.rendered) <= tolerance)
    missing = int(np.count_nonzero(part & ~item.visible))
    if rendered.given is None and missing > max(20, LEFT_OUT * np.count_nonzero(part)):
        return [Finding(Kind.VISIBLE, item.index, f"{place}: mask_visib leaves out {missing} px at which depth shows the object")]
    return []


def _measure(item: Instance, tolerance: float) -> Iterator[tuple[Kind, float]]:
    """Measure the deviations of an instance: mean distance between the outlines of each mask and its rendering [px]; shift of the visible
    mask [px]; of the depth error inside the visible mask the median and the quantile 1 - BEYOND, both without sign [mm]."""
    if item.mask is not None:
        yield Kind.MASK, fit_masks(item.mask, item.silhouette).distance
    if item.visible is not None:
        expected = item.visible_part(tolerance)
        yield Kind.VISIBLE, fit_masks(item.visible, expected).distance
        yield Kind.SHIFT, float(np.hypot(*(_find_shift(item.visible, expected) or (0, 0)))) if item.visible.any() else 0.0
    errors = item.rendered[:0] if item.depth is None else (item.depth - item.rendered)[item.seen]
    if errors.size >= 20:
        yield Kind.POSE, abs(float(np.median(errors)))
        yield Kind.DEPTH, float(np.quantile(np.abs(errors), 1.0 - BEYOND))


_UNITS = {kind: "mm" if kind in (Kind.POSE, Kind.DEPTH) else "px" for kind in MEASURED}
"""Unit of the deviations of each kind that has them."""
_DEVIATIONS = {
    Kind.SHIFT: "the visible mask is shifted by",
    Kind.POSE: "the median of depth is off the model by",
    Kind.MASK: "the outline of the mask is off the silhouette by",
    Kind.VISIBLE: "the outline of the visible mask is off its rendering by",
    Kind.DEPTH: "a fifth of the depth pixels are off the model by more than",
}
"""Sentence about the deviation of each kind, before its value."""


def _declare(name: str, sentence: str, cure: str, *kinds: Kind) -> None:
    """Declare a rule that yields the findings of some kinds, and with a tolerance the deviations of the first kind."""
    unit = _UNITS.get(kinds[0], "")

    def check(rendered: DiagnosedView) -> Findings:
        findings = [finding for finding in rendered.findings if finding.kind in kinds]
        for finding in findings:
            yield _file(rendered, finding.kind, finding.index), finding.text
        for index, value in rendered.deviations[kinds[0]] if unit and rendered.given is not None else ():
            text = f"image {rendered.view.image}, instance {index}: {_DEVIATIONS[kinds[0]]} {value:.3g} {unit}"
            coarse = unit == "mm" and value <= rendered.tolerance
            explained = coarse or any(finding.explains(index, unit) for finding in rendered.findings)
            file = _file(rendered, Kind.SHIFT_VISIBLE if kinds[0] is Kind.SHIFT else kinds[0], index)
            yield Deviation(file, text, rendered.view.truths[index].obj_id, value, explained=explained)

    check.__doc__ = sentence
    rule(DiagnosedView, name, cure, unit=unit)(check)


def _file(rendered: DiagnosedView, kind: Kind, index: int | None) -> str:
    """File of a finding: of shifted or wrong masks the mask; of scale, ray length and depth the depth image; of others scene_gt.json."""
    view = rendered.view
    if kind in (Kind.SHIFT, Kind.SHIFT_VISIBLE, Kind.MASK, Kind.VISIBLE):
        visible = kind in (Kind.VISIBLE, Kind.SHIFT_VISIBLE) or "mask" not in view.masks
        return view.scene.files.file("mask_visib" if visible else "mask", view.image, index)
    if kind in (Kind.SCALE, Kind.RAY, Kind.DEPTH):
        return view.scene.files.file("depth", view.image)
    return view.scene.record("gt").where(view.image)


_declare(
    "depth-scaled",
    "Depth times depth_scale is the rendered depth: no common factor is left.",
    "divide depth_scale in scene_camera.json, or the counts, by the factor",
    Kind.SCALE,
)
_declare(
    "depth-planar",
    "Depth is measured along the optical axis, not along the ray of each pixel.",
    "multiply each pixel's depth by the cosine of its ray's angle",
    Kind.RAY,
)
_declare(
    "mask-shifted",
    "Masks lie on the silhouettes of their objects: none is shifted.",
    "move the masks back, or check how the writer crops or flips them",
    Kind.SHIFT,
    Kind.SHIFT_VISIBLE,
)
_declare(
    "instances-swapped",
    "Each instance's mask shows the object of its pose: ground-truth index and mask index are the same.",
    "exchange the masks or the entries in scene_gt.json; the ground-truth index is the position in the list",
    Kind.SWAP,
)
_declare("object-shown", "obj_id names the object that the mask shows.", "correct obj_id in scene_gt.json", Kind.OBJECT)
_declare(
    "pose",
    "The pose puts the object where masks and depth show it.",
    "correct cam_R_m2c and cam_t_m2c (model to camera, mm); check obj_id and the model's origin",
    Kind.POSE,
)
_declare(
    "mask-rendered",
    "mask is the silhouette of the object at its pose.",
    "make the mask again from model and pose (calc_gt_masks.py)",
    Kind.MASK,
)
_declare(
    "visible-rendered",
    "mask_visib contains all pixels at which depth shows the object.",
    "make mask_visib again from the instance image, or from model, pose and depth",
    Kind.VISIBLE,
)
_declare(
    "depth-rendered",
    "Depth inside a visible mask is that of the model at its pose: within 1 mm where it is rendered, 15 mm where it is measured.",
    "check the mask of what lies in front, and the depth image",
    Kind.DEPTH,
)
