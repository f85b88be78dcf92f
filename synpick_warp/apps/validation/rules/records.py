"""Rules about scene_camera.json, scene_gt.json and scene_gt_info.json; the last by the definitions of the toolkit's calc_gt_info.py."""

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
from msgspec import UNSET

from synpick_warp.apps.validation.registry import Deviation, Findings, Level, rule
from synpick_warp.apps.validation.scene_files import Info, TruthSchema
from synpick_warp.apps.validation.subjects import SceneSubject

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R Rᵀ - 1 and of det R - 1; published matrices have six digits."""
NEAR = 20.0
"""Largest distance that is taken for metres [mm]: no camera of a data set is this close to an object, and few are 20 m away."""
MAX_DEPTH_SCALE = 100.0
"""Largest depth_scale [mm]; BOP's sets have 0.1 to 1."""
FRACTION_TOLERANCE = 1e-3
"""Largest error of visib_fract; files are often rounded."""
EMPTY, SKIPPED = [-1, -1, -1, -1], [-1.0, -1.0, -1.0]
"""Box of an instance without visible pixels, and translation that the toolkit takes for 'fully occluded, skip'."""
_KEY = re.compile(r"-?[0-9]+")


@rule(SceneSubject, "json-schema", "write the file again in BOP's format: lists of numbers, matrices row by row")
def check_schema(scene: SceneSubject) -> Findings:
    """scene_camera.json, scene_gt.json and scene_gt_info.json are JSON objects by image, with BOP's keys and types."""
    for name in ("camera", "gt", "gt_info"):
        yield from scene.record(name).faults


@rule(SceneSubject, "json-keys", "write the key without leading zeros or other characters")
def check_keys(scene: SceneSubject) -> Findings:
    """Images are plain decimal integers as keys ("0", "17"), without leading zeros."""
    for name in ("camera", "gt", "gt_info"):
        for key in scene.record(name).keys:
            shown = key if len(key) <= 40 else f"{key[:39]}…"
            yield scene.record(name).file, f'key "{shown}"' + (" has leading zeros or a sign" if _KEY.fullmatch(key) else " is no index")


@rule(SceneSubject, "same-images", "add the missing entry: an empty list for an image without instances")
def check_same_images(scene: SceneSubject) -> Findings:
    """scene_camera.json, scene_gt.json and scene_gt_info.json have the same images."""
    camera = scene.record("camera")
    for name in ("gt", "gt_info"):
        record = scene.record(name)
        if record.present and camera.present:
            for image in sorted(camera.raw.keys() - record.raw.keys()):
                yield record.file, f"no entry of image {image}, which {camera.file} has"
            for image in sorted(record.raw.keys() - camera.raw.keys()):
                yield camera.file, f"no entry of image {image}, which {record.file} has"


@rule(
    SceneSubject,
    "rotation",
    "write a proper rotation, row by row; a determinant of -1 is a mirrored axis, other matrices are scaled or cut short",
)
def check_rotations(scene: SceneSubject) -> Findings:
    """Rotations (cam_R_m2c, cam_R_w2c) are orthonormal with determinant +1."""
    found = [(file, f"{place}: cam_R_w2c", entry.cam_R_w2c) for file, place, entry in _cameras(scene) if entry.cam_R_w2c is not UNSET]
    found += [(file, f"{place}: cam_R_m2c", item.cam_R_m2c) for file, place, _, _, item in _truths(scene)]
    if not found:
        return
    rotations = np.reshape(np.array([matrix for *_, matrix in found], np.float64), (-1, 3, 3))
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(rotations)
    for row in np.flatnonzero((off > ROTATION_TOLERANCE) | (np.abs(determinant - 1.0) > ROTATION_TOLERANCE)).tolist():
        file, place, _ = found[row]
        yield file, f"{place} is no rotation: its determinant is {determinant[row]:.4g}, R Rᵀ differs from 1 by up to {off[row]:.2g}"


@rule(SceneSubject, "camera-model", "keep one of the two; cam_K is fx s cx 0 fy cy 0 0 1 in pixels")
def check_camera_model(scene: SceneSubject) -> Findings:
    """An image has either cam_K, with focal lengths above 0 and 0 0 1 as its last row, or cam_model; never both."""
    for file, place, entry in _cameras(scene):
        has_matrix, has_model = entry.cam_K is not UNSET, entry.cam_model is not UNSET
        if has_matrix == has_model:
            yield file, f"{place} has {'both cam_K and cam_model' if has_model else 'neither cam_K nor cam_model'}"
        if not isinstance(entry.cam_K, list):
            continue
        k = entry.cam_K
        if not (k[0] > 0.0 and k[4] > 0.0):
            yield file, f"{place}: focal lengths {k[0]:g} and {k[4]:g} px in cam_K"
        elif k[3] or k[6] or k[7] or k[8] != 1.0:
            hint = "; it looks column by column" if k[6] and k[7] and not k[2] and not k[5] else ""
            yield file, f"{place}: cam_K is no intrinsic matrix{hint}"


@rule(SceneSubject, "depth-scale", "add depth_scale: the toolkit's calc_gt_info.py, calc_gt_masks.py and VSD read it")
def check_depth_scale(scene: SceneSubject) -> Findings:
    """scene_camera.json has a depth_scale above 0 for every image with depth: millimetres per count."""
    for file, place, entry in _cameras(scene) if "depth" in scene.files.kinds else ():
        if entry.depth_scale is UNSET:
            yield file, f"{place} has no depth_scale"
        elif not 0.0 < entry.depth_scale <= MAX_DEPTH_SCALE:
            yield file, f"{place}: depth_scale is {entry.depth_scale:g}; expected: above 0, up to {MAX_DEPTH_SCALE:g}"


@rule(SceneSubject, "skip-translation", "write the pose, also of hidden instances, or leave the instance out")
def check_skip_translation(scene: SceneSubject) -> Findings:
    """No instance has the translation -1, -1, -1, which the toolkit takes for 'fully occluded, skip'."""
    for file, place, _, _, item in _truths(scene):
        if item.cam_t_m2c == SKIPPED:
            yield file, f"{place}: cam_t_m2c is -1, -1, -1"


@rule(SceneSubject, "translation-units", "multiply cam_t_m2c by 1000 if it is in metres")
def check_units(scene: SceneSubject) -> Findings:
    """Translations of instances are in millimetres."""
    for file, place, _, _, item in _truths(scene):
        length = float(np.linalg.norm(item.cam_t_m2c))
        if length < NEAR and item.cam_t_m2c != SKIPPED:
            yield file, f"{place}: {length:.3g} mm from the camera; it looks like metres"


@rule(SceneSubject, "camera-units", "multiply cam_t_w2c by 1000 if it is in metres", level=Level.WARNING)
def check_camera_units(scene: SceneSubject) -> Findings:
    """Camera positions (cam_t_w2c) are in millimetres."""
    lengths = [float(np.linalg.norm(entry.cam_t_w2c)) for entry in scene.cameras.values() if isinstance(entry.cam_t_w2c, list)]
    if lengths and 0.0 < max(lengths) < NEAR:
        yield scene.record("camera").file, f"the world's origin is at most {max(lengths):.3g} mm from the camera; it looks like metres"


@rule(SceneSubject, "extrinsics", "add the missing one, or remove the other")
def check_extrinsics(scene: SceneSubject) -> Findings:
    """cam_R_w2c and cam_t_w2c come together."""
    for file, place, entry in _cameras(scene):
        if (entry.cam_R_w2c is UNSET) != (entry.cam_t_w2c is UNSET):
            yield file, f"{place} has only one of cam_R_w2c and cam_t_w2c"


@rule(SceneSubject, "behind-camera", "convert poses of an OpenGL camera by diag(1, -1, -1)")
def check_in_front(scene: SceneSubject) -> Findings:
    """Instances with visible pixels are in front of the camera (z above 0; OpenCV's axes: x right, y down, z forward)."""
    for file, place, image, index, item in _truths(scene):
        infos = scene.infos.get(image, [])
        seen = index >= len(infos) or infos[index].px_count_visib > 0
        if item.cam_t_m2c[2] <= 0.0 and seen and item.cam_t_m2c != SKIPPED:
            yield file, f"{place}: z is {item.cam_t_m2c[2]:g} mm, behind the camera"


@rule(SceneSubject, "instance-ids", "write the identity of each object over the scene; BOP's ground-truth index is only a list position")
def check_instance_ids(scene: SceneSubject) -> Findings:
    """instance_id, where it exists, is unique in an image and stays with one object."""
    record, known = scene.record("gt"), {}
    for image, entries in scene.truths.items():
        present = [(item.instance_id, item.obj_id) for item in entries if item.instance_id is not UNSET]
        ids = [instance for instance, _ in present]
        for instance in sorted({instance for instance in ids if ids.count(instance) > 1}):
            yield record.where(image), f"image {image}: instance_id {instance} occurs {ids.count(instance)} times"
        for instance, obj_id in present:
            if known.setdefault(instance, obj_id) != obj_id:
                yield record.where(image), f"image {image}: instance_id {instance} has obj_id {obj_id}, before {known[instance]}"


@rule(SceneSubject, "object-model", "add the model, or correct obj_id")
def check_object_models(scene: SceneSubject) -> Findings:
    """Every obj_id of scene_gt.json has a model obj_NNNNNN.ply in models (T-LESS: models_cad)."""
    models, reported = scene.layout.model_files, set()
    for file, place, _, _, item in _truths(scene) if models else ():
        if item.obj_id not in models and item.obj_id not in reported:
            reported.add(item.obj_id)
            yield file, f"{place}: there is no model of obj_id {item.obj_id}"


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


def _cameras(scene: SceneSubject) -> Iterator[tuple[str, str, Any]]:
    """Yield (file, place for messages, entry) of each image in scene_camera.json."""
    record = scene.record("camera")
    yield from ((record.where(image), f"image {image}", entry) for image, entry in scene.cameras.items())


def _truths(scene: SceneSubject) -> Iterator[tuple[str, str, int, int, TruthSchema]]:
    """Yield (file, place for messages, image, index, entry) of each instance in scene_gt.json."""
    record = scene.record("gt")
    for image, entries in scene.truths.items():
        yield from ((record.where(image), f"image {image}, instance {index}", image, index, item) for index, item in enumerate(entries))


def _infos(scene: SceneSubject) -> Iterator[tuple[str, str, int, Info]]:
    """Yield (file, place for messages, obj_id, entry) of each instance in scene_gt_info.json; obj_id 0: unknown."""
    record = scene.record("gt_info")
    for image, infos in scene.infos.items():
        truths = scene.truths.get(image, [])
        for index, info in enumerate(infos):
            obj_id = truths[index].obj_id if index < len(truths) else 0
            yield record.where(image), f"image {image}, instance {index}", obj_id, info
