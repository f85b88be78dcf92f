"""Poses of cameras from which they see a bin, as a start for a cell whose cameras are not measured yet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from synpick_warp.apps.viz.cell.frusta import center, project
from synpick_warp.configs.cell.cameras import WORLD, CameraRow, Cameras, Pose
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.cell.gripper import Gripper
from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.episodes.manipulation import Pick
from synpick_warp.scenes.cameras import make_cameras

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


def is_in_way(place: Sequence[float] | np.ndarray, sizes: BinSizes, gripper: Gripper, pick: Pick) -> bool:
    """Whether a position lies in the gripper's swept volume during picks from a bin, where a camera sees only the shaft."""
    top = sizes.origin[2] + max(pick.appear_height, pick.lift_height) + gripper.cup_length + gripper.finger_length
    aside = np.abs(np.subtract(place[:2], sizes.origin[:2])) - np.divide(sizes.opening, 2.0)
    return place[2] < top and bool((aside < gripper.finger_width / 2.0).all())


def describe_blocked(mode: str, rig: Rig, bins: Sequence[BinSizes], gripper: Gripper, pick: Pick) -> list[str]:
    """Warnings about cameras in the gripper's swept volume in picks from any bin, a line each; none in mode move, which does not pick."""
    named = zip(rig.names, make_cameras(rig), strict=True) if mode != "move" else ()
    fixed = ((name, center(camera)) for name, camera in named if camera.fixed_to == WORLD)
    return [
        f"camera {name} stands over the {bins[0].noun}, in the gripper's way, and sees only its shaft in picks; move it aside or up"
        for name, place in fixed
        if any(is_in_way(place, each, gripper, pick) for each in bins)
    ]


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
