"""Camera rig: all cameras of a bake, from [[camera]] tables or from the section [cameras]."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

from synpick_warp.configs.cell.cameras import COLOR, GRIPPER, OPENGL, CameraRow, Cameras, Pose, Vector
from synpick_warp.configs.episodes.randomize import OFF
from synpick_warp.errors import ConfigError
from synpick_warp.views.layers import LAYER_TABLE

if TYPE_CHECKING:
    from synpick_warp.configs.calibration.lens import LensMap

Size = tuple[int, int]
"""Width and height [px]."""


@dataclass(frozen=True)
class Rig:
    """Cameras of a bake, in their order; scenes have their images under these indices."""

    rows: tuple[CameraRow, ...]
    """With name and resolution."""
    is_listed: bool
    """Whether they come from [[camera]] tables."""

    @classmethod
    def of(cls, cameras: Cameras, rows: tuple[CameraRow, ...] = (), rectified: bool = False) -> Rig:
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
            rows = tuple(CameraRow(fov=cameras.fov, pose=Pose(position=at, look_at=cameras.target, up=up)) for at, up in pairs)
        named = (replace(row, name=row.name or f"camera_{index}", pose=in_opencv_axes(row.pose)) for index, row in enumerate(rows))
        sized = (replace(row, resolution=row.resolution or cameras.resolution) for row in named)
        return cls(tuple(scaled(replace(row, distortion=None, model=None) if rectified else row) for row in sized), listed)

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
        """Indices of the cameras that are rendered together: of one image size and `every`, all placed or none, all moving or none, all
        with lenses that are drawn or none, and all with the same colour and layers."""
        states = [(self.is_placed(index), self.moves(index), self.draws_lens(index)) for index in range(len(self))]
        made = [self.chosen(index, (COLOR, *LAYER_TABLE)) for index in range(len(self))]
        kinds = list(zip(self.sizes, self.every, states, made, strict=True))
        return tuple(tuple(index for index, own in enumerate(kinds) if own == kind) for kind in dict.fromkeys(kinds))

    @cached_property
    def every(self) -> tuple[int, ...]:
        """Frames from one picture of each camera to the next."""
        return tuple(row.every or 1 for row in self.rows)

    def writes(self, index: int, modality: str) -> bool:
        """Whether there are files of a camera's images of this kind, one of MODALITIES, if the settings have such at all."""
        chosen = self.rows[index].modalities
        return chosen is None or modality in chosen

    def chosen(self, index: int, modalities: Iterable[str]) -> tuple[str, ...]:
        """Those of MODALITIES that a camera has, by `writes`."""
        return tuple(name for name in modalities if self.writes(index, name))

    def is_placed(self, index: int) -> bool:
        """Whether a camera's matrix and pose are not the same in all views."""
        return self.rows[index].jitter is not None or self.moves(index)

    def draws_lens(self, index: int) -> bool:
        """Whether episodes draw focal length or centre behind a lens that distorts, and with these the rays of its pixels."""
        row = self.rows[index]
        if not row.distortion or row.jitter is None:
            return False
        return (row.jitter.focal_length.kind, row.jitter.center.kind) != (OFF, OFF)

    def bends(self, cameras: Iterable[int]) -> bool:
        """Whether one of some cameras has a lens that distorts."""
        return any(self.rows[index].distortion for index in cameras)

    def moves(self, index: int) -> bool:
        """Whether a camera moves within an episode."""
        return self.rows[index].fixed_to == GRIPPER

    @property
    def largest(self) -> Size:
        """Width and height of the images with most pixels [px]."""
        return max(self.sizes, key=math.prod)

    def index(self, name: str) -> int:
        """Index of a camera by its name; empty: the first that does not move, or the first."""
        return self.names.index(name) if name else next((index for index in range(len(self)) if not self.moves(index)), 0)

    def key(self, index: int, name: str, section: str = "") -> str:
        """Full key of a camera's setting `name` for messages; `section`: its name in [cameras], if that differs."""
        return f"camera[{index}].{name}" if self.is_listed else f"cameras.{section or name}"

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
    """Distortion of a row with a resolution; None: a pinhole. Raises ConfigError: the coefficients are none of a lens that covers the
    image."""
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
