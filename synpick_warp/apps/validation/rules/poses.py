"""Rules about poses against pixels: a sample of views is rendered again and compared with depth and masks; see `diagnosis`."""

from __future__ import annotations

from synpick_warp.apps.validation.diagnosis import DiagnosedView, Kind
from synpick_warp.apps.validation.registry import Findings, rule


def _declare(name: str, sentence: str, cure: str, *kinds: Kind) -> None:
    """Declare a rule that yields the findings of some kinds: shifted or wrong masks with the mask's file; scale, ray length and depth with
    the depth image; others with scene_gt.json."""

    def check(rendered: DiagnosedView) -> Findings:
        view = rendered.view
        for finding in rendered.findings:
            if finding.kind not in kinds:
                continue
            if finding.kind in (Kind.SHIFT, Kind.SHIFT_VISIBLE, Kind.MASK, Kind.VISIBLE):
                visible = finding.kind in (Kind.VISIBLE, Kind.SHIFT_VISIBLE) or "mask" not in view.masks
                yield view.scene.files.file("mask_visib" if visible else "mask", view.image, finding.index), finding.text
            elif finding.kind in (Kind.SCALE, Kind.RAY, Kind.DEPTH):
                yield view.scene.files.file("depth", view.image), finding.text
            else:
                yield view.scene.record("gt").where(view.image), finding.text

    check.__doc__ = sentence
    rule(DiagnosedView, name, cure)(check)


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
