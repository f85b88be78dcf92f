"""Files of the format points: a cloud of each view, in the polygon file format (Turk 1994), and a list of the clouds of a scene.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from synpick_warp.configs.calibration.lens import pixel_rays, read_lens
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.base import EncodedView
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.writing.files import open_folder, sync_folder, write_synced

FOLDER = Path("points")
"""Folder in the data set."""
POINT = np.dtype(
    [*((name, "<f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue")), ("object_id", "<i4"), ("instance_id", "<i4")]
)
"""A point: position [m], sRGB colour, obj_id (0: no instance), and the id of the instance's track (-1: none)."""
_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
_WORLD = {"cam_R_w2c", "cam_t_w2c"}
"""Keys of a camera whose pose in the world is known."""
_MILLIMETERS = 1000.0
"""In a metre: annotations are in millimetres."""


def cloud_list(scene: int) -> Path:
    """List of a scene's clouds."""
    return FOLDER / f"{scene:06d}.txt"


def write_view(view: EncodedView, scene: Path, settings: ViewSettings) -> None:
    """Write a view's cloud to the staging folder of its scene."""
    points = make_points(view, settings)
    properties = "".join(f"property {_TYPES[POINT[name].str]} {name}\n" for name in POINT.names or ())
    frame = "world" if view.camera.keys() >= _WORLD else "camera"
    header = f"ply\nformat binary_little_endian 1.0\ncomment {frame} frame, metres\nelement vertex {len(points)}\n{properties}end_header\n"
    with open_folder(scene) as folder:
        folder.write(f"{view.frame:06d}.ply", header.encode() + points.tobytes())


def make_points(view: EncodedView, settings: ViewSettings) -> np.ndarray:
    """Points (N) `POINT` of the pixels with a surface, row by row; black if the view has no colour image, and in the camera's frame if the
    camera has no pose. Raises DatasetError: it has no intrinsics or depth scale, or the colour image cannot be decoded.

    Sums have a fixed order, not BLAS's, so that bytes do not depend on the kind of processor.
    """
    camera, size = view.camera, settings.resolution
    if missing := {"cam_K", "depth_scale"} - camera.keys():
        raise DatasetError(f"the camera of image {view.frame} in scene {view.scene} has no {min(missing)}, of which points are made")
    depth = view.depth_image()
    seen = depth > 0
    points = np.zeros(np.count_nonzero(seen), POINT)
    rays = pixel_rays(tuple(map(float, camera["cam_K"])), read_lens(camera, size), size)[seen].astype(float)
    z = depth[seen] * (camera["depth_scale"] / _MILLIMETERS)
    shift, rotation = (camera["cam_t_w2c"], camera["cam_R_w2c"]) if camera.keys() >= _WORLD else ((0.0,) * 3, np.eye(3))
    x, y, z = (part - offset / _MILLIMETERS for part, offset in zip((rays[:, 0] * z, rays[:, 1] * z, z), shift, strict=True))
    for axis, (a, b, c) in zip("xyz", np.reshape(rotation, (3, 3)).T.tolist(), strict=True):
        points[axis] = a * x + b * y + c * z
    if settings.color:
        image = cv2.imdecode(np.frombuffer(view.color[1], np.uint8), cv2.IMREAD_COLOR)
        if image is None or image.shape[:2] != depth.shape:
            raise DatasetError(f"the colour image {view.frame} of scene {view.scene} cannot be decoded, or has not the depth image's size")
        points["blue"], points["green"], points["red"] = image[seen].T
    objects, instances = np.zeros(depth.shape, np.int32), np.full(depth.shape, -1, np.int32)
    for index, (pose, mask) in enumerate(zip(view.gt, view.masks(), strict=True)):
        runs = mask.visible
        lengths = runs.past - runs.first
        rows = np.arange(lengths.sum()) + np.repeat(runs.past - np.cumsum(lengths), lengths)
        place = rows, np.repeat(runs.column, lengths)
        objects[place], instances[place] = pose["obj_id"], pose.get("instance_id", index)
    points["object_id"], points["instance_id"] = objects[seen], instances[seen]
    return points


def commit_scenes(scenes: tuple[tuple[Path, int], ...], out: Path, split: str, frames: Sequence[Sequence[int]]) -> None:
    """Task: complete an episode's scenes, (staging folder, scene_id): list their clouds, and rename all to their places in a split; raises
    OutputError if not all `frames` (im_id) of a scene have arrived."""
    for (scene, scene_id), own in zip(scenes, frames, strict=True):
        names = sorted(os.listdir(scene))
        if [f"{frame:06d}.ply" for frame in own] != names:
            raise OutputError(f"{scene} has {len(names)} of {len(own)} frames; this is an error of synpick-warp, please report it")
        listed = scene.parent / f"{scene.name}.txt"
        write_synced(listed, "".join(f"./{split}/{scene_id:06d}/{name}\n" for name in names).encode())
        listed.rename(out / cloud_list(scene_id))
        sync_folder(scene)
        scene.rename(out / FOLDER / split / f"{scene_id:06d}")
    for folder in (FOLDER, FOLDER / split):
        sync_folder(out / folder)
