"""Poses of cameras from which they see a bin, as a start for a cell whose cameras are not measured yet."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from synpick_warp.apps.viz.cell.frusta import project
from synpick_warp.configs.cell.cameras import CameraRow, Cameras, Pose
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.episodes.manipulation import Pick
from synpick_warp.scenes.cameras import is_in_way, make_cameras

_DIRECTIONS = ((90.0, 90.0), (-90.0, 55.0), (90.0, 55.0), (0.0, 55.0), (180.0, 55.0), (-45.0, 55.0), (135.0, 55.0))
"""Azimuth and elevation from which the cameras look at the bin [°]: the first from above."""
_STEP, _LOWEST = 5.0, 40.0
"""Elevations at which a camera is tried that would stand in the gripper's way, and the lowest [°]."""
_FARTHEST, _MARGIN = 20.0, 0.05
"""Largest distance of a camera [m], and free border of its image around the bin, as a fraction of its sides."""


def pose_for(row: CameraRow, index: int, sizes: BinSizes) -> Pose:
    """Pose from which a camera sees all of a bin, as near as it can: the first from above, the others from the sides, as steep as they can
    without standing in the gripper's way."""
    azimuth, elevation = _DIRECTIONS[index % len(_DIRECTIONS)]
    up = (0.0, 1.0, 0.0) if index % len(_DIRECTIONS) == 0 else (0.0, 0.0, 1.0)
    while True:
        pose = _nearest(row, math.radians(azimuth), math.radians(elevation), up, sizes)
        if elevation <= _LOWEST or not is_in_way(pose.position or (), sizes, Gripper(), Pick()):
            return pose
        elevation -= _STEP


def _nearest(row: CameraRow, azimuth: float, elevation: float, up: tuple[float, float, float], sizes: BinSizes) -> Pose:
    """Pose in a direction [rad] from which a camera sees all of a bin, as near as it can."""
    back = (math.cos(azimuth) * math.cos(elevation), math.sin(azimuth) * math.cos(elevation), math.sin(elevation))
    target = (0.0, 0.0, round(sizes.height / 2.0, 3))

    def pose(distance: float) -> Pose:
        x, y, z = (round(end + distance * step, 3) + 0.0 for end, step in zip(target, back, strict=True))
        return Pose(position=(x, y, z), look_at=target, up=up)

    near, far = 0.6 * math.hypot(*sizes.outer, sizes.height - sizes.base), _FARTHEST
    while far - near > 1e-3:
        middle = (near + far) / 2.0
        (camera,) = make_cameras(Rig.of(Cameras(), (replace(row, pose=pose(middle)),)))
        pixels, depth = project(camera, np.array(sizes.corners))
        border = _MARGIN * np.array((camera.width, camera.height))
        fits = (depth > 0.0).all() and (pixels >= border).all() and (pixels <= (camera.width, camera.height) - border).all()
        near, far = (near, middle) if fits else (middle, far)
    return pose(far)
