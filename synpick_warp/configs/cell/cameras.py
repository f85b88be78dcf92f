"""Settings of the cameras: the section [cameras] for identical cameras that look at one point, [[camera]] tables for others,
camera effects on colour images, a depth camera, and the rig of all of them. Of the sensor models, none is in the paper."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, ClassVar

from synpick_warp.codes import Effect, names
from synpick_warp.configs.calibration.files import MAX_NUMBER, MODELS
from synpick_warp.configs.calibration.tables import SENSORS
from synpick_warp.configs.episodes.randomize import OFF, Distribution
from synpick_warp.configs.fields import Fraction, setting
from synpick_warp.errors import ConfigError
from synpick_warp.views.layers import LAYER_TABLE

if TYPE_CHECKING:
    from synpick_warp.configs.calibration.lens import LensMap


Vector = tuple[float, float, float]
WORLD, GRIPPER = "world", "gripper"
"""What cameras are fixed to."""
OPENCV, OPENGL = "opencv", "opengl"
"""Axes of a camera: x right, y down, z forward; or x right, y up, z backward."""


COLOR, DEPTH, MASKS = "color", "depth", "masks"
MODALITIES = (COLOR, DEPTH, MASKS, *LAYER_TABLE)
"""Image modalities that a camera may export."""
DECIMALS = 12
"""Decimal places of sines and cosines, whose last bits depend on the processor's C library; see `system.linear_algebra`."""


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
    exposure_time: Annotated[float, "[0, 10] s"] = setting(
        0.0,
        "Exposure of each row of colour images: motion blur. All other images, poses and boxes are of the middle row's mid-exposure.",
    )
    readout_time: Annotated[float, "[0, 10] s"] = setting(0.0, "Delay from the first row's exposure to the last one's: rolling shutter.")


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
    scale: Annotated[float | None, "(0, 1]"] = setting(None, "Factor on image size and camera matrix, such as 0.25; not given: 1.")
    sensor: str | None = setting(None, "Depth sensor whose resolution and matrix the camera has, as in depth_sensor.preset.")
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
    exposure_time: Annotated[float, "[0, 10] s"] = setting(0.0, "As cameras.exposure_time.")
    readout_time: Annotated[float, "[0, 10] s"] = setting(0.0, "As cameras.readout_time.")
    every: Annotated[int | None, "[1, 1000] frames"] = setting(None, "Frames from one picture to the next, from frame 0; not given: 1.")
    jitter: Jitter | None = setting(
        None, "What each episode draws of the camera anew: {position, rotation, focal_length, center}, each a distribution."
    )


@dataclass(frozen=True)
class Still:
    """Mode still: views of a pile at rest, each from a random place on a dome over it, which every episode draws anew. Not in the paper."""

    views: Annotated[int, "[0, 64]"] = setting(
        6, "Views of a pile, each a camera with intrinsics, lens, modalities and jitter of the first one; 0: the cameras stay as they are."
    )
    target: Annotated[Vector, "[-100, 100] m"] = setting((0.0, 0.0, 0.05), "Look-at point of all views, in the tote's frame.")
    target_spread: Annotated[float, "[0, 10] m"] = setting(0.05, "Half width of the look-at point's random offset along each axis.")
    distance: Annotated[tuple[float, float], "(0, 100] m"] = setting(
        (1.6, 2.2), "Minimum and maximum distance to the look-at point, uniform between."
    )
    elevation: Annotated[tuple[float, float], "[0, 90] °"] = setting(
        (30.0, 90.0), "Minimum and maximum elevation, uniform by area of the dome; the azimuth is free."
    )
    roll: Annotated[float, "[0, 180] °"] = setting(
        45.0, "Half width of the random rotation about the optical axis (BlenderProc's script of BOP's train_pbr)."
    )

    def pose(self, samples: Sequence[float]) -> Pose:
        """Pose by seven samples in [0, 1]: of distance, elevation, azimuth, roll and look-at point."""
        distance, height, azimuth, roll, *offset = samples
        (_, low), (_, high) = map(_direction, self.elevation)
        (x, y), (c, s) = _direction(360.0 * azimuth), _direction(self.roll * (2.0 * roll - 1.0))
        up = low + (high - low) * height
        out = math.sqrt(1.0 - up * up)
        target = [middle + self.target_spread * (2.0 * part - 1.0) for middle, part in zip(self.target, offset, strict=True)]
        away = self.distance[0] + (self.distance[1] - self.distance[0]) * distance
        at = [middle + away * part for middle, part in zip(target, (out * x, out * y, up), strict=True)]
        vectors = {"position": at, "look_at": target, "up": (-c * up * x - s * y, -c * up * y + s * x, c * out)}
        return replace(Pose(), **{name: tuple(vector) for name, vector in vectors.items()})


@dataclass(frozen=True)
class Effects:
    """Camera effects on colour images, all off by default. Each view draws its parameters uniformly from these ranges (minimum, maximum; 0,
    0: off), and they are recorded. Not in the paper.
    """

    exposure_jitter: Annotated[float, "[0, 5] EV"] = setting(0.0, "Half width of each view's random exposure offset.")
    white_balance_jitter: Annotated[float, "[0, 2] EV"] = setting(
        0.0, "Half width of random gains of red and of blue; 500 K more at 5,500 K are 0.12 EV more blue, 0.06 EV less red."
    )
    vignette: Annotated[tuple[float, float], "[0, 1]"] = setting(
        (0.0, 0.0), "Fraction of light lost in the image corners, with cos⁴ falloff towards the centre."
    )
    chromatic_aberration: Annotated[tuple[float, float], "[-16, 16] px"] = setting(
        (0.0, 0.0), "Lateral chromatic aberration in the corners: red is displaced outward and blue inward; negative: the reverse."
    )
    blur: Annotated[tuple[float, float], "[0, 16] px"] = setting((0.0, 0.0), "Standard deviation of a Gaussian blur, as by defocus.")
    shot_noise: Annotated[tuple[float, float], "[0, 1]"] = setting(
        (0.0, 0.0), "Standard deviation of shot noise at full scale, relative to it: 1/√N of a full well of N electrons."
    )
    read_noise: Annotated[tuple[float, float], "[0, 1]"] = setting((0.0, 0.0), "Standard deviation of read noise, relative to full scale.")
    jpeg_quality: Annotated[tuple[int, int], "[0, 100]"] = setting((0, 0), "JPEG quality; 0, 0: bop.jpeg_quality.")
    contrast: Annotated[tuple[float, float], "[-0.9, 4]"] = setting(
        (0.0, 0.0), "Relative change of the contrast of sRGB values about their middle."
    )
    saturation: Annotated[tuple[float, float], "[-1, 4]"] = setting(
        (0.0, 0.0), "Relative change of the difference of sRGB values to their luma; -1: grey."
    )


def _direction(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle [°]."""
    turn = math.radians(angle)
    return round(math.cos(turn), DECIMALS), round(math.sin(turn), DECIMALS)


def effect_ranges(effects: Effects) -> dict[str, tuple[float, float]]:
    """Minimum and maximum of each parameter of the camera effects, in the order of `Effect`; 0, 0: off."""
    spreads = {"exposure": effects.exposure_jitter, "red": effects.white_balance_jitter, "blue": effects.white_balance_jitter}
    return {name: (-spreads[name], spreads[name]) if name in spreads else getattr(effects, name) for name in names(Effect)}


@dataclass(frozen=True)
class DepthSensor:
    """Depth camera model: structured light for the layer depth_sensor, active stereo for ir_left, ir_right and depth_stereo. Of the
    settings up to registration, stereo uses baseline, disparity_step, max_disparity and distances. Axial noise is sigma_z = noise +
    noise_growth (z - noise_distance)² + noise_angle / √z · (θ / (π/2 - θ))² (Nguyen et al., 3DIMPVT 2012), with z in m and θ the angle of
    incidence."""

    preset: str = setting(
        "", "Sensor of [configs/calibration/sensors.toml](calibration/sensors.toml): sets what is not set here.", choices=("", *SENSORS)
    )
    baseline: Annotated[float, "(0, 1] m"] = setting(
        0.075, "Distance from the camera to the projector at its right (Khoshelham and Elberink, 2012), or to the right camera."
    )
    disparity_step: Annotated[float, "(0, 16] px"] = setting(
        0.125, "Disparity quantization: depth steps of z² / (f · baseline) times this (Khoshelham and Elberink, 2012)."
    )
    disparity_noise: Annotated[float, "[0, 16] px"] = setting(
        0.0, "Standard deviation of disparity: depth noise of z² / (f · baseline) times this."
    )
    max_disparity: Annotated[float, "[0, 1e4] px"] = setting(
        0.0, "Largest disparity that is searched: the least depth is f · baseline / max_disparity; 0: no limit."
    )
    distances: Annotated[tuple[float, float], "(0, 100] m"] = setting((0.4, 5.0), "Minimum and maximum depth that is measured.")
    noise: Annotated[float, "[0, 1] m"] = setting(0.0012, "Axial noise at noise_distance, as standard deviation.")
    noise_growth: Annotated[float, "[0, 1] 1/m"] = setting(0.0019, "Quadratic growth of axial noise with depth.")
    noise_distance: Annotated[float, "[0, 100] m"] = setting(0.4, "Depth of minimum axial noise.")
    noise_angle: Annotated[float, "[0, 1] m^1.5"] = setting(1e-4, "Growth of axial noise with the angle of incidence.")
    lateral_noise: Annotated[float, "[0, 16] px"] = setting(
        0.5, "Standard deviation of the pixel offset at which depth is sampled: ragged edges (Handa et al., 2014)."
    )
    noise_width: Annotated[int, "[1, 64] px"] = setting(
        1, "Distance of lattice points between which noise is interpolated, so that neighbours' noise correlates; 1: each pixel its own."
    )
    grazing_angle: Annotated[float, "[10, 89] °"] = setting(80.0, "Angle of incidence above which there is no depth.")
    edge_width: Annotated[int, "[0, 16] px"] = setting(1, "Distance to a disparity edge below which there is no depth.")
    edge_step: Annotated[float, "(0, 1e3] px"] = setting(1.0, "Disparity difference that makes an edge.")
    shadows: bool = setting(True, "No depth where the projector is occluded, or the infrared camera that registration names.")
    clear_reach: Annotated[float, "[0, 1e3] m"] = setting(
        0.1,
        "Distance behind a transparent surface at which 1/e of what is there is still measured, else holes (layer "
        "depth_sensor; fitted to frames of ClearGrasp's D435); 0: as if they were opaque.",
    )
    multipath: Fraction = setting(
        0.0,
        "Fraction of the light over a mirrored surface that is not rejected: depth bias (Freedman et al., 2014), or holes (depth_sensor).",
    )
    registration: Fraction = setting(
        0.0,
        "Place on the baseline of the camera to whose image depth is registered: 0 the infrared camera, 1 the projector; in between, "
        "shadows at both sides of objects.",
    )
    projector: Fraction = setting(0.5, "Place of a stereo camera's dot projector on its baseline: 0 left, 1 right camera.")
    dot_spacing: Annotated[float, "[2, 64] px"] = setting(
        4.0, "Width of a cell of the projected pattern, which has one dot at a random place."
    )
    dot_brightness: Annotated[float, "[0, 1e3]"] = setting(
        2.0, "Brightness of projected dots on a white surface at 1 m, relative to full scale; 0: no pattern."
    )
    ambient: Annotated[float, "[0, 10]"] = setting(
        0.25, "Brightness of infrared images by ambient light, relative to that of colour images."
    )
    infrared_noise: Fraction = setting(0.005, "Standard deviation of noise in infrared images, relative to full scale.")


Size = tuple[int, int]
"""Width and height [px]."""


@dataclass(frozen=True)
class Rig:
    """Cameras of a bake, in their order; scenes have their images under these indices."""

    rows: tuple[CameraRow, ...]
    """With name and resolution."""
    is_listed: bool
    """Whether they come from [[camera]] tables."""
    still: Still | None = None
    """Of mode still: how views are drawn; the poses of the rows are amid them."""

    @classmethod
    def of(cls, cameras: Cameras, rows: tuple[CameraRow, ...] = (), rectified: bool = False, still: Still | None = None) -> Rig:
        """Rig of [[camera]] tables, or without any of the section; `rectified`: pinholes of the same matrices, without distortion. Raises
        ConfigError: the section has no position, or another number of up vectors."""
        listed = bool(rows)
        if not listed:
            if not cameras.positions:
                raise ConfigError("cameras.positions is empty; at least one camera is needed")
            if len(cameras.positions) != len(cameras.ups):
                counts = f"{len(cameras.positions)} entries and cameras.ups {len(cameras.ups)}"
                raise ConfigError(f"cameras.positions has {counts}; each camera needs one of both")
            pairs = zip(cameras.positions, cameras.ups, strict=True)
            row = CameraRow(fov=cameras.fov, exposure_time=cameras.exposure_time, readout_time=cameras.readout_time)
            rows = tuple(replace(row, pose=Pose(position=at, look_at=cameras.target, up=up)) for at, up in pairs)
        if still and still.views:
            poses = (still.pose((1.0, 0.5, index / still.views, 0.5, 0.5, 0.5, 0.5)) for index in range(still.views))
            rows = tuple(replace(rows[0], name="", pose=pose) for pose in poses)
        named = (replace(row, name=row.name or f"camera_{index}", pose=in_opencv_axes(row.pose)) for index, row in enumerate(rows))
        sized = (replace(row, resolution=row.resolution or cameras.resolution) for row in named)
        return cls(tuple(scaled(replace(row, distortion=None, model=None) if rectified else row) for row in sized), listed, still)

    def __len__(self) -> int:
        """Number of cameras."""
        return len(self.rows)

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the cameras."""
        return tuple(row.name for row in self.rows)

    @cached_property
    def sensors(self) -> tuple[str, ...]:
        """Names of the cameras as sensors of a scene: theirs, or cam0 and so on."""
        return self.names if self.is_listed else tuple(f"cam{index}" for index in range(len(self)))

    @cached_property
    def sizes(self) -> tuple[Size, ...]:
        """Width and height of each camera's images [px]."""
        return tuple(row.resolution for row in self.rows if row.resolution is not None)

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Indices of the cameras that are rendered together: of one image size, `every` and shutter, all placed or none, all moving or
        none, all with lenses that are drawn or none, and all with the same colour and layers."""
        states = [(self.is_placed(index), self.moves(index), self.draws_lens(index)) for index in range(len(self))]
        made = [self.chosen(index, (COLOR, *LAYER_TABLE)) for index in range(len(self))]
        kinds = list(zip(self.sizes, self.every, states, made, map(self.shutter, range(len(self))), strict=True))
        return tuple(tuple(index for index, own in enumerate(kinds) if own == kind) for kind in dict.fromkeys(kinds))

    @cached_property
    def every(self) -> tuple[int, ...]:
        """Frames from one picture of each camera to the next."""
        return tuple(row.every or 1 for row in self.rows)

    @property
    def dome(self) -> Still | None:
        """Dome on which each episode draws the cameras' poses; None: there is none."""
        return self.still if self.still and self.still.views else None

    def writes(self, index: int, modality: str) -> bool:
        """Whether there are files of a camera's images of this kind, one of MODALITIES, if the settings have such at all."""
        chosen = self.rows[index].modalities
        return chosen is None or modality in chosen

    def chosen(self, index: int, modalities: Iterable[str]) -> tuple[str, ...]:
        """Those of MODALITIES that a camera has, by `writes`."""
        return tuple(name for name in modalities if self.writes(index, name))

    def is_placed(self, index: int) -> bool:
        """Whether a camera's matrix and pose are not the same in all views."""
        return bool(self.dome) or self.rows[index].jitter is not None or self.moves(index)

    def shutter(self, index: int) -> tuple[float, float]:
        """Exposure and readout time of a camera [s]; 0, 0: its pictures are of an instant."""
        return self.rows[index].exposure_time, self.rows[index].readout_time

    def draws_lens(self, index: int) -> bool:
        """Whether a camera has lens distortion and intrinsics that are randomized per episode, so that the rays of its pixels change."""
        row = self.rows[index]
        if not row.distortion or row.jitter is None:
            return False
        return (row.jitter.focal_length.kind, row.jitter.center.kind) != (OFF, OFF)

    def bends(self, cameras: Iterable[int]) -> bool:
        """Whether any of these cameras has lens distortion."""
        return any(self.rows[index].distortion for index in cameras)

    def moves(self, index: int) -> bool:
        """Whether a camera moves within an episode."""
        return self.rows[index].fixed_to == GRIPPER

    @property
    def largest(self) -> Size:
        """Width and height of the largest images [px]."""
        return max(self.sizes, key=math.prod)

    def index(self, name: str) -> int:
        """Index of a camera by its name; empty: the first that does not move, or the first."""
        return self.names.index(name) if name else next((index for index in range(len(self)) if not self.moves(index)), 0)

    def key(self, index: int, name: str, section: str = "") -> str:
        """Full key of a camera's setting `name` for messages; `section`: its name in [cameras], if that differs."""
        return f"camera[{0 if self.dome else index}].{name}" if self.is_listed else f"cameras.{section or name}"

    def label(self, index: int) -> str:
        """Name of a camera for messages, such as "camera 0"."""
        return f"camera {self.rows[index].name if self.is_listed else index}"


def intrinsics(row: CameraRow) -> tuple[float, float, float, float]:
    """Focal lengths and principal point (fx, fy, cx, cy) of a row with a resolution [px]."""
    if row.matrix is not None:
        return row.matrix[0][0], row.matrix[1][1], row.matrix[0][2], row.matrix[1][2]
    width, height = row.resolution or (0, 0)
    focal = width / 2 / math.tan(math.radians(row.fov or 0.0) / 2)
    return focal, focal, width / 2, height / 2


def lens_map(row: CameraRow) -> LensMap | None:
    """Lens distortion of a camera; None for a pinhole. Raises ConfigError if no lens with these coefficients covers the image."""
    if not row.distortion or row.resolution is None:
        return None
    from synpick_warp.configs.calibration.lens import PINHOLE, make_lens_map

    made = make_lens_map(row.model or PINHOLE, row.distortion, intrinsics(row), row.resolution)
    return None if made.lens.is_identity else made


def scaled(row: CameraRow) -> CameraRow:
    """Camera of a row with a resolution whose pictures were scaled by `scale` to whole pixels: the same row without it."""
    if row.scale is None or row.resolution is None:
        return row
    width, height = (max(1, round(row.scale * side)) for side in row.resolution)
    # Pixel centres are at + 0.5, so that coordinates scale about the corner of the image.
    across, down = width / row.resolution[0], height / row.resolution[1]
    matrix = row.matrix and (_times(row.matrix[0], across), _times(row.matrix[1], down), row.matrix[2])
    return replace(row, resolution=(width, height), matrix=matrix, scale=None)


def _times(vector: Vector, factor: float) -> Vector:
    """Vector times a number."""
    return factor * vector[0], factor * vector[1], factor * vector[2]


def turned(pose: Pose) -> Pose:
    """The pose of a camera whose y and z axes are the opposite of those given, in matrix or quaternion; `axes` stays."""
    if pose.matrix is not None:
        rows = [(row[0], 0.0 - row[1], 0.0 - row[2], row[3]) for row in pose.matrix[:3]]
        return replace(pose, matrix=(*rows, *pose.matrix[3:]))
    if pose.quaternion is not None:
        x, y, z, w = pose.quaternion
        return replace(pose, quaternion=(w, z, 0.0 - y, 0.0 - x))
    return pose


def in_opencv_axes(pose: Pose) -> Pose:
    """The same pose with OpenCV's axes."""
    return replace(turned(pose) if pose.axes == OPENGL else pose, axes=None)


def inverted(pose: Pose) -> Pose:
    """The inverse of a pose that is a matrix; others as they are."""
    if pose.matrix is None:
        return pose
    columns, at = tuple(zip(*(row[:3] for row in pose.matrix[:3]), strict=True)), position(pose)
    rows = ((x, y, z, 0.0 - x * at[0] - y * at[1] - z * at[2]) for x, y, z in columns)
    return replace(pose, matrix=(*rows, *pose.matrix[3:]))


def position(pose: Pose) -> Vector:
    """Optical centre [m] of a valid pose."""
    if pose.matrix is not None:
        return pose.matrix[0][3], pose.matrix[1][3], pose.matrix[2][3]
    return pose.position or (0.0, 0.0, 0.0)


def moved(pose: Pose, offset: Vector) -> Pose:
    """A valid pose with its position, and its look-at point, moved by an offset [m]."""
    if pose.matrix is not None:
        rows = [(*row[:3], row[3] + part) for row, part in zip(pose.matrix, offset, strict=False)]
        return replace(pose, matrix=(*rows, pose.matrix[3]))
    points = {name: getattr(pose, name) for name in ("position", "look_at")}
    shifted = {name: tuple(map(sum, zip(point, offset, strict=True))) for name, point in points.items() if point is not None}
    return replace(pose, **shifted)


def viewing_direction(pose: Pose) -> Vector:
    """Viewing direction of a camera pose, along the optical axis, unnormalized; the pose must be valid."""
    if pose.matrix is not None:
        return pose.matrix[0][2], pose.matrix[1][2], pose.matrix[2][2]
    if pose.quaternion is not None:
        x, y, z, w = pose.quaternion
        return 2 * (x * z + w * y), 2 * (y * z - w * x), w * w + z * z - x * x - y * y
    at, target = position(pose), pose.look_at or (0.0, 0.0, 0.0)
    return target[0] - at[0], target[1] - at[1], target[2] - at[2]


def resized(row: CameraRow, size: Size) -> CameraRow:
    """Pinhole camera with the same pose and horizontal field of view, and images of another size: their middle stays in the middle."""
    if row.matrix is None or row.resolution is None:
        return replace(row, resolution=size, distortion=None)
    fx, fy, cx, cy = intrinsics(row)
    width, height = row.resolution
    scale = size[0] / width
    center = (size[0] / 2 + scale * (cx - width / 2), size[1] / 2 + scale * (cy - height / 2))
    matrix = ((scale * fx, 0.0, center[0]), (0.0, scale * fy, center[1]), (0.0, 0.0, 1.0))
    return replace(row, resolution=size, matrix=matrix, distortion=None)
