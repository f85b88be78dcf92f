"""Point clouds: a file a view, in the polygon file format (PLY; Turk 1994), with colour, object and instance of each point, and a list of
the clouds of a scene; their exporter.

Runs in writer processes, too, so it imports neither Warp nor Newton.
"""

import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synpick_warp.configs.calibration.lens import LensMap, pixel_rays, read_lens
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.errors import ConfigError, DatasetError, OutputError
from synpick_warp.exporters.base import EncodedView, SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.bop.view import MILLIMETERS, ViewSettings
from synpick_warp.exporters.writing.files import Buffer, open_folder, output_errors, sync_folder, write_synced
from synpick_warp.exporters.writing.notes import note_files, write_notes
from synpick_warp.system.linear_algebra import is_rotation

FOLDER = Path("points")
"""Folder in the data set."""
POINT = np.dtype(
    [*((name, "<f4") for name in "xyz"), *((name, "u1") for name in ("red", "green", "blue")), ("object_id", "<i4"), ("instance_id", "<i4")]
)
"""A point: position [m], sRGB colour (black without a colour image), obj_id (0: no instance), and the id of the instance's track (-1: none,
or unknown, as in some sets of others)."""
_TYPES = {"<f4": "float", "|u1": "uchar", "<i4": "int"}
_BAND = 64
"""Rows of pixels whose points are made at a time."""


def cloud_list(scene: int) -> Path:
    """Path, in the data set, of the text file that lists a scene's clouds."""
    return FOLDER / f"{scene:06d}.txt"


def write_view(view: EncodedView, scene: Path, settings: ViewSettings) -> None:
    """Write a view's cloud to the staging folder of its scene. Raises DatasetError: its camera has no intrinsics, depth scale or rotation,
    or an image is not of the camera's size."""
    name, camera = f"image {view.frame} of scene {view.scene}", view.camera
    lens, shift, rotation = _read_camera(camera, settings.resolution, name)
    depth = _check_size(view.depth_image(), settings.resolution, f"depth of {name}")
    color = _check_size(_decode(view.color[1]), settings.resolution, f"colour of {name}") if settings.color else None
    properties = "".join(f"property {_TYPES[POINT[field].str]} {field}\n" for field in POINT.names or ())
    count, frame = np.count_nonzero(depth), "camera" if shift is None else "world"
    header = (
        f"ply\nformat binary_little_endian 1.0\ncomment {frame} frame, metres\nelement vertex {count}\n{properties}end_header\n".encode()
    )
    content = bytearray(len(header) + count * POINT.itemsize)
    content[: len(header)] = header
    points = np.frombuffer(content, POINT, offset=len(header))
    rays = pixel_rays(np.reshape(np.array(camera["cam_K"], float), (3, 3)), lens, settings.resolution)
    instances, rows = _label_pixels(view, depth.shape), 0
    poses = [(0, -1), *((pose["obj_id"], pose.get("instance_id", -1)) for pose in view.gt)]
    ids = np.array(poses, np.int32).T
    # In bands of rows: temporary arrays are small beside the file.
    for first in range(0, len(depth), _BAND):
        band = slice(first, first + _BAND)
        seen = depth[band] > 0
        part = points[rows : rows + np.count_nonzero(seen)]
        rows += len(part)
        z = depth[band][seen] * (camera["depth_scale"] / MILLIMETERS)
        place = [rays[0][band][seen] * z, rays[1][band][seen] * z, z]
        if shift is not None:
            # Sums have a fixed order, not BLAS's, so that bytes do not depend on the kind of processor.
            x, y, z = (values - offset / MILLIMETERS for values, offset in zip(place, shift, strict=True))
            place = [a * x + b * y + c * z for a, b, c in rotation.T.tolist()]
        for axis, values in zip("xyz", place, strict=True):
            part[axis] = values
        if color is not None:
            part["blue"], part["green"], part["red"] = color[band][seen].T
        part["object_id"], part["instance_id"] = ids[:, instances[band][seen]]
    with open_folder(scene) as folder:
        folder.write(f"{view.frame:06d}.ply", memoryview(content))


def _read_camera(camera: Mapping[str, Any], size: tuple[int, int], name: str) -> tuple[LensMap | None, list[float] | None, np.ndarray]:
    """Lens of a camera's entry (None: a pinhole), and translation [mm] (None: its pose is unknown) and rotation (3, 3), world to camera."""
    if missing := {"cam_K", "depth_scale"} - camera.keys():
        raise DatasetError(f"the camera of {name} has no {min(missing)}, of which points are made")
    if not (camera["cam_K"][0] > 0.0 and camera["cam_K"][4] > 0.0):
        raise DatasetError(f"the camera of {name} has a cam_K without focal lengths above 0")
    try:
        lens = read_lens(camera, size)
    except ConfigError as error:
        raise DatasetError(f"the camera of {name} has a {error}") from None
    if "cam_R_w2c" not in camera or "cam_t_w2c" not in camera:
        return lens, None, np.eye(3)
    rotation = np.reshape(np.array(camera["cam_R_w2c"], float), (3, 3))
    if not is_rotation(rotation):
        raise DatasetError(f"the camera of {name} has a cam_R_w2c that is no rotation")
    return lens, camera["cam_t_w2c"], rotation


def _decode(file: Buffer) -> np.ndarray | None:
    """Decode a colour image, blue first (H, W, 3) uint8, as it lies in the file; None: it cannot be decoded."""
    return cv2.imdecode(np.frombuffer(file, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)


def _check_size(image: np.ndarray | None, size: tuple[int, int], name: str) -> np.ndarray:
    """The image, if it is one of this width and height; raises DatasetError otherwise."""
    if image is None or image.shape[1::-1] != size:
        raise DatasetError(f"the {name} cannot be decoded, or is not of its camera's size, {size[0]} x {size[1]}")
    return image


def _label_pixels(view: EncodedView, shape: tuple[int, ...]) -> np.ndarray:
    """Label image (H, W) int16: 1 plus the index of the visible instance, 0: none."""
    labels = np.zeros(shape, np.int16)
    for index, mask in enumerate(view.masks(), 1):
        runs = mask.visible
        lengths = runs.past - runs.first
        rows = np.arange(lengths.sum()) + np.repeat(runs.past - np.cumsum(lengths), lengths)
        labels[rows, np.repeat(runs.column, lengths)] = index
    return labels


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


class PointsExporter(SceneExporter):
    """`Exporter` of point clouds. A scene is a folder of clouds in the frame of the world, and a list of them."""

    staging = "points"

    write_view = staticmethod(write_view)

    @staticmethod
    def folder_name(split: str) -> str:
        return str(FOLDER / split)

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles(note_files(layout), (), (*(FOLDER / split for split in layout.folders), FOLDER))

    def write_constants(self) -> list[Path]:
        context = self._context
        with output_errors(self._out):
            for folder in reversed(self.shared_files(context.layout).folders):
                (self._out / folder).mkdir(exist_ok=True)
            return write_notes(self._out, context.settings, context.names, self._cameras)

    def places(self, episode: int) -> list[Path]:
        folder, scenes = self._folder(self.scene_ids(episode)[0]).relative_to(self._out), self.scene_ids(episode)
        return [*map(cloud_list, scenes), *(folder / f"{scene:06d}" for scene in scenes)]

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._context.layout.folder(scenes[0][1] // len(self._cameras))
        return commit_scenes, (scenes, self._out, split, images)
