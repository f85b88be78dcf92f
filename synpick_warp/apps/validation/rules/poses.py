"""Rules about poses against pixels: a sample of views is rendered again and compared with depth and masks; see `diagnosis`."""

from __future__ import annotations

from synpick_warp.apps.validation.diagnosis import MEASURED, DiagnosedView, Kind
from synpick_warp.apps.validation.registry import Deviation, Findings, rule

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
