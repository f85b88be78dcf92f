"""Rules about scene_camera.json and scene_gt.json: schema, indices, rotations, intrinsics, units."""

from __future__ import annotations

import re

import numpy as np
from msgspec import UNSET

from synpick_warp.apps.validation.registry import Findings, Level, rule
from synpick_warp.apps.validation.subjects import SceneSubject

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R Rᵀ - 1 and of det R - 1; published matrices have six digits."""
NEAR = 20.0
"""Largest distance that is taken for metres [mm]: no camera of a data set is this close to an object, and few are 20 m away."""
MAX_DEPTH_SCALE = 100.0
"""Largest depth_scale [mm]; BOP's sets have 0.1 to 1."""
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
    camera, truth = scene.record("camera"), scene.record("gt")
    places, matrices = [], []
    for image, entry in scene.cameras.items():
        if entry.cam_R_w2c is not UNSET:
            places.append((camera.where(image), f"image {image}: cam_R_w2c"))
            matrices.append(entry.cam_R_w2c)
    for image, entries in scene.truths.items():
        for index, item in enumerate(entries):
            places.append((truth.where(image), f"image {image}, instance {index}: cam_R_m2c"))
            matrices.append(item.cam_R_m2c)
    if not matrices:
        return
    rotations = np.reshape(np.array(matrices, np.float64), (-1, 3, 3))
    off = np.abs(rotations @ rotations.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    determinant = np.linalg.det(rotations)
    for row in np.flatnonzero((off > ROTATION_TOLERANCE) | (np.abs(determinant - 1.0) > ROTATION_TOLERANCE)).tolist():
        file, place = places[row]
        yield file, f"{place} is no rotation: its determinant is {determinant[row]:.4g}, R Rᵀ differs from 1 by up to {off[row]:.2g}"


@rule(SceneSubject, "camera-model", "keep one of the two; cam_K is fx s cx 0 fy cy 0 0 1 in pixels")
def check_camera_model(scene: SceneSubject) -> Findings:
    """An image has either cam_K, with focal lengths above 0 and 0 0 1 as its last row, or cam_model; never both."""
    record = scene.record("camera")
    for image, entry in scene.cameras.items():
        has_matrix, has_model = entry.cam_K is not UNSET, entry.cam_model is not UNSET
        if has_matrix == has_model:
            yield record.where(image), f"image {image} has {'both cam_K and cam_model' if has_model else 'neither cam_K nor cam_model'}"
        if not isinstance(entry.cam_K, list):
            continue
        k = entry.cam_K
        if not (k[0] > 0.0 and k[4] > 0.0):
            yield record.where(image), f"image {image}: focal lengths {k[0]:g} and {k[4]:g} px in cam_K"
        elif k[3] or k[6] or k[7] or k[8] != 1.0:
            hint = "; it looks column by column" if k[6] and k[7] and not k[2] and not k[5] else ""
            yield record.where(image), f"image {image}: cam_K is no intrinsic matrix{hint}"


@rule(SceneSubject, "depth-scale", "add depth_scale: the toolkit's calc_gt_info.py, calc_gt_masks.py and VSD read it")
def check_depth_scale(scene: SceneSubject) -> Findings:
    """scene_camera.json has a depth_scale above 0 for every image with depth: millimetres per count."""
    record = scene.record("camera")
    for image, entry in scene.cameras.items() if "depth" in scene.files.kinds else ():
        if entry.depth_scale is UNSET:
            yield record.where(image), f"image {image} has no depth_scale"
        elif not 0.0 < entry.depth_scale <= MAX_DEPTH_SCALE:
            yield record.where(image), f"image {image}: depth_scale is {entry.depth_scale:g}; expected: above 0, up to {MAX_DEPTH_SCALE:g}"


@rule(SceneSubject, "skip-translation", "write the pose, also of hidden instances, or leave the instance out")
def check_skip_translation(scene: SceneSubject) -> Findings:
    """No instance has the translation -1, -1, -1, which the toolkit takes for 'fully occluded, skip'."""
    record = scene.record("gt")
    for image, entries in scene.truths.items():
        for index, item in enumerate(entries):
            if item.cam_t_m2c == [-1.0, -1.0, -1.0]:
                yield record.where(image), f"image {image}, instance {index}: cam_t_m2c is -1, -1, -1"


@rule(SceneSubject, "translation-units", "multiply cam_t_m2c by 1000 if it is in metres")
def check_units(scene: SceneSubject) -> Findings:
    """Translations of instances are in millimetres."""
    record = scene.record("gt")
    for image, entries in scene.truths.items():
        for index, item in enumerate(entries):
            length = float(np.linalg.norm(item.cam_t_m2c))
            if length < NEAR and item.cam_t_m2c != [-1.0, -1.0, -1.0]:
                yield record.where(image), f"image {image}, instance {index}: {length:.3g} mm from the camera; it looks like metres"


@rule(SceneSubject, "camera-units", "multiply cam_t_w2c by 1000 if it is in metres", level=Level.WARNING)
def check_camera_units(scene: SceneSubject) -> Findings:
    """Camera positions (cam_t_w2c) are in millimetres."""
    lengths = [float(np.linalg.norm(entry.cam_t_w2c)) for entry in scene.cameras.values() if isinstance(entry.cam_t_w2c, list)]
    if lengths and 0.0 < max(lengths) < NEAR:
        yield scene.record("camera").file, f"the world's origin is at most {max(lengths):.3g} mm from the camera; it looks like metres"


@rule(SceneSubject, "extrinsics", "add the missing one, or remove the other")
def check_extrinsics(scene: SceneSubject) -> Findings:
    """cam_R_w2c and cam_t_w2c come together."""
    record = scene.record("camera")
    for image, entry in scene.cameras.items():
        if (entry.cam_R_w2c is UNSET) != (entry.cam_t_w2c is UNSET):
            yield record.where(image), f"image {image} has only one of cam_R_w2c and cam_t_w2c"


@rule(SceneSubject, "behind-camera", "convert poses of an OpenGL camera by diag(1, -1, -1)")
def check_in_front(scene: SceneSubject) -> Findings:
    """Instances with visible pixels are in front of the camera (z above 0; OpenCV's axes: x right, y down, z forward)."""
    record = scene.record("gt")
    for image, entries in scene.truths.items():
        infos = scene.infos.get(image, [])
        for index, item in enumerate(entries):
            seen = index >= len(infos) or infos[index].px_count_visib > 0
            if item.cam_t_m2c[2] <= 0.0 and seen and item.cam_t_m2c != [-1.0, -1.0, -1.0]:
                yield record.where(image), f"image {image}, instance {index}: z is {item.cam_t_m2c[2]:g} mm, behind the camera"


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
    for image, entries in scene.truths.items() if models else ():
        for index, item in enumerate(entries):
            if item.obj_id not in models and item.obj_id not in reported:
                reported.add(item.obj_id)
                yield scene.record("gt").where(image), f"image {image}, instance {index}: there is no model of obj_id {item.obj_id}"
