"""Cameras on the device: tables of a scene's cameras, and of the views of a batch whose matrices and poses are their own."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.configs.calibration.lens import FISHEYE, LensMap, with_matrix
from synpick_warp.kernels.render.visibility.camera import CameraTable, LensCameras, compute_rays_kernel
from synpick_warp.kernels.render.visibility.lens import BEND, FIRST, FISHEYE_MODEL, MODEL, NUMBERS, RADIUS, STRETCH, Lenses
from synpick_warp.scenes.cameras import CAMERA_KEYS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate_struct, struct_arrays

VIEW_CAMERAS, LENS_CAMERAS = (
    struct_arrays(struct, "view", units={"intrinsics": "px", "center": "m"}) for struct in (CameraTable, LensCameras)
)
LENSES = struct_arrays(Lenses, "view", ray=("view", "row", "column"), number=("view", "number"))


def build_cameras(cameras: Sequence[Camera], device: wp.Device) -> Any:
    """Build the struct `CameraTable` of cameras of one image size."""
    result, lenses = CameraTable(), [camera.lens for camera in cameras if camera.lens is not None]
    rows = np.cumsum([camera.lens is not None for camera in cameras]) - 1
    values = camera_arrays(*(np.array([getattr(camera, key) for camera in cameras]) for key in CAMERA_KEYS))
    values["lens"] = np.where([camera.lens is not None for camera in cameras], rows, -1).astype(np.int32)
    for name, value in values.items():
        setattr(result, name, wp.array(value, dtype=CameraTable.vars[name].type.dtype, device=device))
    if lenses:
        result.lenses.ray = wp.array(np.stack([lens.rays() for lens in lenses]), dtype=wp.vec2, device=device)
        result.lenses.number = wp.array(np.stack([lens_numbers(lens) for lens in lenses]), dtype=wp.float32, device=device)
    return result


def camera_arrays(matrix: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> dict[str, np.ndarray]:
    """`CameraTable` without lenses for matrices (n, 3, 3) [px], world-to-camera rotations (n, 3, 3) and translations (n, 3) [m]."""
    return {
        "intrinsics": matrix[:, [0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32),
        "rotation": rotation,
        "center": -np.einsum("kji,kj->ki", rotation, translation),
        "to_world": rotation.transpose(0, 2, 1).astype(np.float32),
    }


def lens_numbers(lens: LensMap | None) -> np.ndarray:
    """Row of `Lenses.number`; zeros for a pinhole."""
    result = np.zeros(int(NUMBERS), np.float32)
    if lens is not None:
        result[int(MODEL)] = float(FISHEYE_MODEL) * (lens.lens.model == FISHEYE)
        result[int(FIRST) : int(FIRST) + len(lens.lens.coefficients)] = lens.lens.coefficients
        result[[int(RADIUS), int(BEND), int(STRETCH)]] = lens.radius, lens.bend, lens.stretch
    return result


def allocate_view_cameras(views: int, device: wp.Device, cameras: Any = None) -> Any:
    """Allocate the cameras of views: the struct `CameraTable`, or `LensCameras` with the lenses of a scene's `cameras` if it has some."""
    if cameras is None or cameras.lenses.ray is None:
        return allocate_struct(VIEW_CAMERAS, {"view": views}, device)
    made = allocate_struct(LENS_CAMERAS, {"view": views}, device)
    made.lenses = cameras.lenses
    return made


def allocate_lenses(sizes: dict[str, int], device: wp.Device) -> Any:
    """Allocate a lens of its own for each view of a batch, whose extents are those of `view_sizes`."""
    return allocate_struct(LENSES, sizes | {"number": int(NUMBERS)}, device)


def place_cameras(
    made: Any, cameras: Any, slot: np.ndarray, placed: Mapping[str, np.ndarray], lenses: Sequence[LensMap | None] = ()
) -> None:
    """Set the cameras of the first views of a batch on the host. `made`: as of `allocate_view_cameras`; written. `cameras`: the scene's.
    `slot`: row of each view's camera in these (view) int32. `placed`: matrix, rotation and translation of each view, as fields of
    `FrameBatch`. `lenses`: lens of each of the scene's cameras (None: a pinhole), if views have lenses of their own, by `allocate_lenses`:
    the same lens before a sensor with the view's matrix. The rays of its pixels are computed from those of the scene."""
    values = camera_arrays(*(placed[key] for key in CAMERA_KEYS))
    if cameras.lenses.ray is not None:
        values["lens"] = cameras.lens.numpy()[slot]
    drawn = [with_matrix(lenses[row], matrix) for row, matrix in zip(slot, placed["matrix"], strict=True)] if lenses else []
    if drawn:
        values["lens"] = np.where([lens is not None for lens in drawn], np.arange(len(slot)), -1).astype(np.int32)
        made.lenses.number[: len(slot)].assign(np.stack([lens_numbers(lens) for lens in drawn]))
    for name, value in values.items():
        getattr(made, name)[: len(slot)].assign(value)
    if drawn:
        inputs = [cameras, wp.array(slot, dtype=wp.int32, device=made.lens.device), made]
        dim = (len(slot), *made.lenses.ray.shape[1:])
        wp.launch(compute_rays_kernel, dim=dim, inputs=inputs, outputs=[made.lenses.ray], device=made.lens.device)
