"""Settings of the cameras: the section [cameras] for identical cameras that look at one point, and [[camera]] tables for any others."""

from dataclasses import dataclass
from typing import Annotated, ClassVar

from synpick_warp.configs.calibration.files import MAX_NUMBER, MODELS
from synpick_warp.configs.episodes.randomize import Distribution
from synpick_warp.configs.fields import setting
from synpick_warp.views.layers import LAYER_TABLE

Vector = tuple[float, float, float]
WORLD, GRIPPER = "world", "gripper"
"""What cameras are fixed to."""
OPENCV, OPENGL = "opencv", "opengl"
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""


COLOR, DEPTH, MASKS = "color", "depth", "masks"
MODALITIES = (COLOR, DEPTH, MASKS, *LAYER_TABLE)
"""Image modalities that a camera may export."""


@dataclass(frozen=True)
class Cameras:
    """Pinhole cameras above the tote: square pixels, principal point in the middle of the image."""

    resolution: Annotated[tuple[int, int], "[1, 8192] px"] = setting((1920, 1080), "Image width and height.")
    fov: Annotated[float, "[1, 170] °"] = setting(20.0, "Horizontal field of view.")
    positions: Annotated[tuple[tuple[float, float, float], ...], "[-100, 100] m"] = setting(
        ((0.0, 0.0, 2.0), (0.0, 0.573, 2.0), (0.0, -0.573, 2.0)), "Position of each camera in the tote's frame (released)."
    )
    target: Annotated[tuple[float, float, float], "[-100, 100] m"] = setting((0.0, 0.0, 0.16), "Look-at point of all cameras (released).")
    ups: Annotated[tuple[tuple[float, float, float], ...], "[-1e3, 1e3]"] = setting(
        ((0.0, 1.0, 0.0), (0.0, -1.0, 0.0), (0.0, 1.0, 0.0)), "Up vector of each camera."
    )


@dataclass(frozen=True)
class Pose:
    """Pose of a camera in the tote's frame, in one of three forms."""

    matrix: Annotated[tuple[tuple[float, float, float, float], ...] | None, "[-100, 100] m"] = setting(
        None, "Camera-to-world transform, 4 x 4."
    )
    position: Annotated[tuple[float, float, float] | None, "[-100, 100] m"] = setting(
        None, "Optical centre; with quaternion, or with look_at and up."
    )
    quaternion: Annotated[tuple[float, float, float, float] | None, "[-1.1, 1.1]"] = setting(None, "Camera-to-world rotation: x, y, z, w.")
    look_at: Annotated[tuple[float, float, float] | None, "[-100, 100] m"] = setting(None, "Point that the optical axis meets.")
    up: Annotated[tuple[float, float, float] | None, "[-1e3, 1e3]"] = setting(None, "Direction that is up in the image.")
    axes: str | None = setting(
        None,
        "Axes in matrix or quaternion: opencv (x right, y down, z forward; the default) or opengl (x right, y up, z backward; also "
        "Blender, nerfstudio, USD).",
        choices=(OPENCV, OPENGL),
    )


_NONE = Distribution()


@dataclass(frozen=True)
class Jitter:
    """Random differences of a camera from its table, which each episode draws anew; perception keeps to the table.

    Components are independent. Normal distributions are cut at three standard deviations. Not in the paper.
    """

    position: Annotated[Distribution, "[-10, 10] m"] = setting(_NONE, "Offset of the position along each axis.")
    rotation: Annotated[Distribution, "[-90, 90] °"] = setting(_NONE, "Components of a rotation vector in the camera's axes.")
    focal_length: Annotated[Distribution, "[-0.9, 9]"] = setting(_NONE, "Relative change of fx and fy, such as 0.01 for 1 % more.")
    center: Annotated[Distribution, "[-8192, 8192] px"] = setting(_NONE, "Offset of cx and of cy.")


@dataclass(frozen=True)
class CameraRow:
    """A camera. The tables replace [cameras]. Pixel centres are at +0.5: add 0.5 to cx and cy of OpenCV and ROS."""

    REQUIRED: ClassVar = ("pose",)
    name: str = setting("", "Name of lower-case letters, digits and underscores; empty: camera_0 and so on.")
    resolution: Annotated[tuple[int, int] | None, "[1, 8192] px"] = setting(None, "Image width and height; not given: cameras.resolution.")
    fov: Annotated[float | None, "[1, 170] °"] = setting(None, "Horizontal field of view: square pixels, principal point in the middle.")
    matrix: Annotated[
        tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]] | None,
        f"[{-MAX_NUMBER}, {MAX_NUMBER}] px",
    ] = setting(None, "Camera matrix with fx, fy, cx and cy, instead of fov.")
    distortion: Annotated[tuple[float, ...] | None, f"[{-MAX_NUMBER}, {MAX_NUMBER}]"] = setting(
        None, "Lens distortion by OpenCV's coefficients, k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4]]]; of a fisheye k1 k2 k3 k4."
    )
    model: str | None = setting(None, "Distortion model, pinhole unless it is given.", choices=MODELS)
    file: str | None = setting(
        None,
        "Calibration file of OpenCV, ROS, Kalibr, BOP, COLMAP, nerfstudio, Open3D, RealSense, Zivid, or cam_K.txt, instead of matrix, "
        "distortion, resolution.",
        path=True,
    )
    scale: Annotated[float | None, "(0, 1]"] = setting(
        None, "Factor on image size and camera matrix, such as 0.25 for a quarter; not given: 1."
    )
    sensor: str | None = setting(None, "Depth sensor whose resolution and matrix the camera has, [as listed](#sensor-presets).")
    pixel_center: Annotated[float | None, "px"] = setting(
        None, "Centre of the first pixel in the given matrix or file, 0 or 0.5; not given: 0.5, of a file its format's."
    )
    pose: Pose = setting(Pose(), "Pose in the tote's frame: {matrix}, {position, quaternion} or {position, look_at, up}.")
    fixed_to: str | None = setting(
        None,
        "What carries the camera: the world (default), or the gripper (eye-in-hand; the pose is in the frame of its shaft, whose origin "
        "is on the wrist axis, z up).",
        choices=(WORLD, GRIPPER),
    )
    modalities: tuple[str, ...] | None = setting(
        None, "Images in its files, of layers those in render.layers; not given: all.", choices=MODALITIES
    )
    every: Annotated[int | None, "[1, 1000] frames"] = setting(None, "Frames from one picture to the next, from frame 0; not given: 1.")
    jitter: Jitter | None = setting(
        None, "What each episode draws of the camera anew: {position, rotation, focal_length, center}, each a distribution."
    )
