"""Reader of annotated frames of a real RGB-D camera (YCB-Video's, by way of `oprb/ycbvideo`), and their BOP data set, for measuring only.

    python -m tools.reports.real_frames FRAMES MODELS OUT

writes OUT as a BOP data set of one split, `test`: a scene for each sequence, depth in 0.1 mm, `mask_visib` from the class masks (each class
is there once), `mask` rendered from pose and model, poses in the frames of the models. `cam_K` has 0.5 px added to the principal point:
pixel centres are at + 0.5 in data sets of this project, at whole numbers in those frames.
"""

import argparse
import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from synpick_warp.apps.validation.comparison import ObjectRenderer
from synpick_warp.dataset.bop.foreign import measure_info
from synpick_warp.dataset.bop.layout import Layout
from synpick_warp.errors import DatasetError, OutputError, SynpickError
from synpick_warp.exporters.writing.files import output_errors
from synpick_warp.system.inputs.files import decode_json
from synpick_warp.system.inputs.image_files import decode_image
from tools.options import fail

SPLIT = "test"
"""Split of the data set: BOP's name of measured images."""
DEPTH_SCALE = 0.1
"""Depth of one count in the frames [mm]."""
CENTER = 0.5
"""Centre of the first pixel in our coordinates, where the frames have 0 [px]."""
_MILLIMETRES = 1e3
"""In a metre."""


@dataclass(frozen=True, eq=False)
class RealFrame:
    """Annotated frame: images (H, W), intrinsics (3, 3) [px], and poses of N objects in the frames of the models [mm]."""

    sequence: int
    image: int
    color: np.ndarray
    """RGB (H, W, 3) uint8."""
    depth: np.ndarray
    """Planar depth (H, W) uint16 [0.1 mm]; 0: not measured."""
    label: np.ndarray
    """obj_id of each pixel (H, W) uint8; 0: none of the objects."""
    intrinsics: np.ndarray
    """Camera matrix (3, 3) [px]; the centre of pixel (row, column) is (column + 0.5, row + 0.5)."""
    world_to_camera: np.ndarray
    """Matrix (3, 4): rotation, and translation [m]."""
    object_ids: tuple[int, ...]
    rotations: np.ndarray
    """Object to camera (N, 3, 3)."""
    translations: np.ndarray
    """Object to camera (N, 3) [mm]: of the bounding box's centre."""

    @property
    def name(self) -> str:
        """Name of the frame's files."""
        return f"{self.sequence:04d}_{self.image:06d}"

    def mask(self, index: int) -> np.ndarray:
        """Visible mask of an object (H, W) bool."""
        return self.label == self.object_ids[index]


def read_frames(folder: Path) -> list[RealFrame]:
    """Read all annotated frames of a folder, by name. Raises DatasetError: there are none, or a file is missing or damaged."""
    names = sorted(path.name.removesuffix("-poses.json") for path in folder.glob("*-poses.json"))
    if not names:
        raise DatasetError(f"{folder} has no frames (SSSS_FFFFFF-poses.json)")
    return [_read_frame(folder, name) for name in names]


def _read_frame(folder: Path, name: str) -> RealFrame:
    path = folder / f"{name}-poses.json"
    content = decode_json(_read(path), dict[str, Any], path, DatasetError)
    try:
        objects, matrix = content["objects"], np.array(content["K"], np.float64)
        matrix[:2, 2] += CENTER
        rotations = np.array([entry["R_model_to_camera"] for entry in objects]).reshape(-1, 3, 3)
        return RealFrame(
            sequence=int(content["sequence"]),
            image=int(content["frame"]),
            color=cv2.cvtColor(_image(folder / f"{name}-color.png"), cv2.COLOR_BGR2RGB),
            depth=_image(folder / f"{name}-depth.png"),
            label=_image(folder / f"{name}-label.png"),
            intrinsics=matrix,
            world_to_camera=np.array(content["world_to_camera"]),
            object_ids=tuple(int(entry["obj_id"]) for entry in objects),
            rotations=rotations,
            translations=_MILLIMETRES * np.array([entry["t_bop_m"] for entry in objects]).reshape(-1, 3),
        )
    except (KeyError, TypeError, ValueError) as fault:
        raise DatasetError(f"{path} is no record of poses: {fault}") from None


def _read(path: Path) -> bytes:
    """Content of a file; DatasetError without it."""
    try:
        return path.read_bytes()
    except OSError as fault:
        raise DatasetError(f"{path} cannot be read: {fault.strerror}") from None


def _image(path: Path) -> np.ndarray:
    return decode_image(_read(path), path, DatasetError)


def write_data_set(folder: Path, models: Path, out: Path) -> Path:
    """Write the frames of a folder as a BOP data set, with the BOP models of their objects [mm]; returns its folder `out`. Raises
    DatasetError: a frame or a model is missing or damaged; OutputError: `out` exists, or cannot be written."""
    frames = read_frames(folder)
    if out.exists():
        raise OutputError(f"{out} exists; name a new folder")
    with output_errors(out):
        _copy_models(models, sorted({index for frame in frames for index in frame.object_ids}), out)
        width, height = frames[0].depth.shape[::-1]
        fx, fy, cx, cy = frames[0].intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
        camera = {"width": width, "height": height, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "depth_scale": DEPTH_SCALE}
        _write_json(out / "camera.json", camera)
        for sequence, group in groupby(frames, lambda frame: frame.sequence):
            _write_scene(folder, list(group), out / SPLIT / f"{sequence:06d}")
        targets = [
            {"scene_id": frame.sequence, "im_id": frame.image, "obj_id": index, "inst_count": 1}
            for frame in frames
            for index in sorted(frame.object_ids)
        ]
        _write_json(out / "test_targets_bop19.json", targets)
    return out


def _write_json(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1) + "\n")


def _copy_models(models: Path, object_ids: Sequence[int], out: Path) -> None:
    """Copy the models of objects, with textures, as `models` and `models_eval`, and their part of models_info.json."""
    path = models / "models_info.json"
    infos = decode_json(_read(path), dict[str, Any], path, DatasetError)
    if missing := [index for index in object_ids if str(index) not in infos]:
        raise DatasetError(f"{path} lacks obj_id {missing[0]}, which the frames show")
    for name in ("models", "models_eval"):
        _write_json(out / name / "models_info.json", {str(index): infos[str(index)] for index in object_ids})
        for index in object_ids:
            for source in sorted(models.glob(f"obj_{index:06d}.*")):
                shutil.copyfile(source, out / name / source.name)


def _write_scene(folder: Path, frames: Sequence[RealFrame], scene: Path) -> None:
    """Write images, both kinds of masks, and annotations of a sequence; an object's `instance_id` is its place in the first frame."""
    for kind in ("rgb", "depth", "mask", "mask_visib"):
        (scene / kind).mkdir(parents=True)
    instances = {index: instance for instance, index in enumerate(frames[0].object_ids)}
    cameras, truth, infos = {}, {}, {}
    for frame in frames:
        for part, kind in (("color", "rgb"), ("depth", "depth")):
            shutil.copyfile(folder / f"{frame.name}-{part}.png", scene / kind / f"{frame.image:06d}.png")
        cameras[frame.image] = {
            "cam_K": frame.intrinsics.ravel().tolist(),
            "depth_scale": DEPTH_SCALE,
            "cam_R_w2c": frame.world_to_camera[:, :3].ravel().tolist(),
            "cam_t_w2c": (_MILLIMETRES * frame.world_to_camera[:, 3]).tolist(),
        }
        truth[frame.image] = [
            {
                "cam_R_m2c": rotation.ravel().tolist(),
                "cam_t_m2c": translation.tolist(),
                "obj_id": index,
                "instance_id": instances.setdefault(index, len(instances)),
            }
            for index, rotation, translation in zip(frame.object_ids, frame.rotations, frame.translations, strict=True)
        ]
    _write_json(scene / "scene_camera.json", cameras)
    _write_json(scene / "scene_gt.json", truth)
    renderer = ObjectRenderer(Layout(scene.parents[1]))
    for frame in frames:
        count = range(len(frame.object_ids))
        visible, amodal = [frame.mask(index) for index in count], [_render_silhouette(renderer, frame, index) for index in count]
        for kind, masks in (("mask", amodal), ("mask_visib", visible)):
            for index, mask in enumerate(masks):
                cv2.imwrite(str(scene / kind / f"{frame.image:06d}_{index:06d}.png"), np.uint8(255) * mask.astype(np.uint8))
        infos[frame.image] = [
            entry | {"px_count_valid": int(np.count_nonzero(mask & (frame.depth > 0)))}
            for entry, mask in zip(measure_info(visible, amodal), amodal, strict=True)
        ]
    _write_json(scene / "scene_gt_info.json", infos)


def _render_silhouette(renderer: ObjectRenderer, frame: RealFrame, index: int) -> np.ndarray:
    """Silhouette (H, W) bool of one object at its annotated pose."""
    silhouette = np.zeros(frame.depth.shape, bool)
    size = (silhouette.shape[1], silhouette.shape[0])
    patch = renderer.render(frame.object_ids[index], frame.rotations[index], frame.translations[index], frame.intrinsics, size)
    rows, columns = patch.depth.shape
    silhouette[patch.top : patch.top + rows, patch.left : patch.left + columns] = np.isfinite(patch.depth)
    return silhouette


def main() -> int:
    """Write the data set."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("frames", type=Path, help="folder of SSSS_FFFFFF-{color,depth,label}.png and -poses.json")
    parser.add_argument("models", type=Path, help="folder of BOP models")
    parser.add_argument("out", type=Path, help="folder to write, which does not exist")
    options = parser.parse_args()
    try:
        print(f"data set: {write_data_set(options.frames, options.models, options.out)}")
    except SynpickError as error:
        return fail("reports.real_frames", error)
    return 0


if __name__ == "__main__":
    sys.exit(main())
