"""Rules about poses against pixels: a sample of views is rendered again and compared with depth and masks; see `diagnosis`."""

from __future__ import annotations

from collections.abc import Iterator

from synpick_warp.apps.validation.diagnosis import DiagnosedView, Kind
from synpick_warp.apps.validation.registry import rule

_Finding = Iterator[tuple[str, str]]


def _found(rendered: DiagnosedView, *kinds: Kind) -> _Finding:
    """Yield file and text of the findings of some kinds.

    The file is the instance's mask (SHIFT, SHIFT_VISIBLE, MASK, VISIBLE), the depth image (SCALE, RAY, DEPTH), or else scene_gt.json.
    """
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


@rule(
    DiagnosedView,
    "depth-scaled",
    "Depth times depth_scale is the rendered depth: no common factor is left.",
    "divide depth_scale in scene_camera.json, or the counts, by the factor",
)
def check_scale(rendered: DiagnosedView) -> _Finding:
    """Yield views whose depth agrees with the rendering after a change of scale."""
    yield from _found(rendered, Kind.SCALE)


@rule(
    DiagnosedView,
    "depth-planar",
    "Depth is measured along the optical axis, not along the ray of each pixel.",
    "multiply each pixel's depth by the cosine of its ray's angle",
)
def check_planar(rendered: DiagnosedView) -> _Finding:
    """Yield views whose depth is the length of rays instead of planar depth."""
    yield from _found(rendered, Kind.RAY)


@rule(
    DiagnosedView,
    "mask-shifted",
    "Masks lie on the silhouettes of their objects: none is shifted.",
    "move the masks back, or check how the writer crops or flips them",
)
def check_shift(rendered: DiagnosedView) -> _Finding:
    """Yield masks that lie beside the rendered object, although depth says that the pose is right."""
    yield from _found(rendered, Kind.SHIFT, Kind.SHIFT_VISIBLE)


@rule(
    DiagnosedView,
    "instances-swapped",
    "Each instance's mask shows the object of its pose: ground-truth index and mask index are the same.",
    "exchange the masks or the entries in scene_gt.json; the ground-truth index is the position in the list",
)
def check_swapped(rendered: DiagnosedView) -> _Finding:
    """Yield pairs of instances that have each other's masks."""
    yield from _found(rendered, Kind.SWAP)


@rule(
    DiagnosedView,
    "object-shown",
    "obj_id names the object that the mask shows.",
    "correct obj_id in scene_gt.json",
)
def check_object(rendered: DiagnosedView) -> _Finding:
    """Yield masks that another object of the view fits at the same pose."""
    yield from _found(rendered, Kind.OBJECT)


@rule(
    DiagnosedView,
    "pose",
    "The pose puts the object where masks and depth show it.",
    "correct cam_R_m2c and cam_t_m2c (model to camera, mm); check obj_id and the model's origin",
)
def check_pose(rendered: DiagnosedView) -> _Finding:
    """Yield poses whose silhouette does not fit the mask, without depth confirming them, and those whose depth is off as a whole."""
    yield from _found(rendered, Kind.POSE)


@rule(
    DiagnosedView,
    "mask-rendered",
    "mask is the silhouette of the object at its pose.",
    "make the mask again from model and pose (calc_gt_masks.py)",
)
def check_mask(rendered: DiagnosedView) -> _Finding:
    """Yield masks whose shape is not the rendered one although depth confirms the pose, and empty masks of objects in the image."""
    yield from _found(rendered, Kind.MASK)


@rule(
    DiagnosedView,
    "visible-rendered",
    "mask_visib contains all pixels at which depth shows the object.",
    "make mask_visib again from the instance image, or from model, pose and depth",
)
def check_visible(rendered: DiagnosedView) -> _Finding:
    """Yield visible masks that leave out many pixels whose depth is that of the object as rendered."""
    yield from _found(rendered, Kind.VISIBLE)


@rule(
    DiagnosedView,
    "depth-rendered",
    "Depth inside a visible mask is that of the model at its pose: within 1 mm where it is rendered, 15 mm where it is measured.",
    "check the mask of what lies in front, and the depth image",
)
def check_depth(rendered: DiagnosedView) -> _Finding:
    """Yield instances of whose visible mask too large a part has a depth that is not the object's."""
    yield from _found(rendered, Kind.DEPTH)
