"""Yaw of a gripper with several cups: the one with which most cups come to lie on the target, seen in the perception image."""

import warp as wp

from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.render.visibility.camera import NEAR_PLANE, ImageGrid, Views, in_image
from synpick_warp.kernels.rng import TAU
from synpick_warp.kernels.state import Plans
from synpick_warp.kernels.structs import CupData, PickData, SuctionData

wp.set_module_options({"enable_backward": False})

# Yaws that are compared: a step of 5°.
YAWS = wp.constant(72)
# Points on a cup's circle of rays that must all show the target.
RIM = wp.constant(8)
# Radius of the circle that must show as much of it as possible beyond, in radii of the circle of rays.
MARGIN = wp.constant(2.0)
# Score of a cup that lies on the target: more than all points of wider circles have.
WHOLE = wp.constant(1024)


@wp.struct
class HeadFrame:
    """Axes of the gripper head in the world, with its wrist's angles."""

    yaw: float
    """Of the shaft [rad]."""
    tilt: float
    """Of the head about the wrist axis [rad]."""
    along: wp.vec3
    """Unit vector +x of the head."""
    across: wp.vec3
    """Unit vector +y: the wrist axis."""
    axis: wp.vec3
    """Unit vector +z, out of the object."""


@wp.func
def head_frame(normal: wp.vec3, yaw: float) -> HeadFrame:
    """Frame of the head at a yaw [rad], tilted so that its axis is as near to a unit normal as it can be."""
    frame = HeadFrame()
    heading = wp.vec3(wp.cos(yaw), wp.sin(yaw), 0.0)
    frame.yaw = yaw
    frame.tilt = wp.atan2(wp.dot(normal, heading), normal[2])
    frame.across = wp.vec3(-heading[1], heading[0], 0.0)
    up = wp.vec3(0.0, 0.0, 1.0)
    frame.axis = wp.sin(frame.tilt) * heading + wp.cos(frame.tilt) * up
    frame.along = wp.cos(frame.tilt) * heading - wp.sin(frame.tilt) * up
    return frame


@wp.func
def shows(views: Views, grid: ImageGrid, patches: Patches, view: int, point: wp.vec3, label: int) -> bool:
    """True if the pixel of a point in the world [m] has this label."""
    offset = wp.vec3d(wp.float64(point[0]), wp.float64(point[1]), wp.float64(point[2])) - views.cameras.center[view]
    seen = wp.vec3(views.cameras.rotation[view] * offset)
    if seen[2] < NEAR_PLANE:
        return False
    intrinsics = views.cameras.intrinsics[view]
    column = int(wp.floor(intrinsics[0] * seen[0] / seen[2] + intrinsics[2]))
    row = int(wp.floor(intrinsics[1] * seen[1] / seen[2] + intrinsics[3]))
    if not in_image(grid, row, column):
        return False
    return patches.component[view, row, column] == label


@wp.func
def score_frame(
    frame: HeadFrame,
    origin: wp.vec3,
    suction: SuctionData,
    cups: CupData,
    views: Views,
    grid: ImageGrid,
    patches: Patches,
    view: int,
    label: int,
) -> int:
    """WHOLE for each cup of which all points of the ring show the target, and 1 for each point that does of the wider rings."""
    score = int(0)
    for cup in range(cups.count):
        center = origin + cups.place[cup][0] * frame.along + cups.place[cup][1] * frame.across
        hits = int(0)
        for index in range(RIM):
            angle = TAU * float(index) / float(RIM)
            spoke = suction.radius * (wp.cos(angle) * frame.along + wp.sin(angle) * frame.across)
            if shows(views, grid, patches, view, center + spoke, label):
                hits += 1
            if shows(views, grid, patches, view, center + MARGIN * spoke, label):
                score += 1
        if hits == RIM:
            score += WHOLE
    return score


@wp.kernel
def align_cups_kernel(
    pick: PickData, suction: SuctionData, cups: CupData, grid: ImageGrid, plan_inout: Plans, views: Views, patches: Patches
):
    """Turn the grasp of each target about its point so that most cups lie on the target's largest component.

    Candidates are the planned yaw, which meets the normal, and YAWS others around the full turn with which the head's axis comes within
    the seals' free swing of it. A cup lies on it if all points of its ring show the target; of equals, the one is taken whose wider rings
    show most of it, then the nearest to the normal, then the first. `normal` becomes the head's axis. Launched over view.
    """
    view = wp.tid()
    world = views.world[view]
    if world < 0 or plan_inout.target[world] < 0:
        return
    label = patches.largest[view, plan_inout.target[world]]
    normal = plan_inout.normal[world]
    best = head_frame(normal, plan_inout.yaw[world])
    most = int(-1)
    least = float(0.0)
    for candidate in range(YAWS + 1):
        yaw = plan_inout.yaw[world]
        if candidate > 0:
            yaw = TAU * float(candidate - 1) / float(YAWS) - wp.PI
        frame = head_frame(normal, yaw)
        # Sine of the angle between axis and normal.
        deviation = wp.abs(wp.dot(frame.across, normal))
        if candidate == 0 or (deviation <= wp.sin(suction.swing_limit) and wp.abs(frame.tilt) <= pick.tilt_limit):
            score = score_frame(frame, plan_inout.point[world], suction, cups, views, grid, patches, view, label)
            if score > most or (score == most and deviation < least):
                most = score
                least = deviation
                best = frame
    plan_inout.normal[world] = best.axis
    plan_inout.yaw[world] = best.yaw
    plan_inout.tilt[world] = best.tilt
