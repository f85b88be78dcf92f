"""Motion blur and rolling shutter: bodies and cameras at the times of sub-frames, and each row's mean radiance over its exposure."""

import warp as wp

from synpick_warp.kernels.render.images.antialias import resolve_radiance
from synpick_warp.kernels.render.lighting.moving_bodies import same_pose
from synpick_warp.kernels.render.visibility.camera import AnyViews, ImageGrid, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import ShadedImage
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.state import Snapshots

wp.set_module_options({"enable_backward": False})


@wp.struct
class SubFrame:
    """Poses and cameras at the time of a sub-frame, where anything moves, and weights of all sub-frames. Scratch."""

    pose: wp.array2d[wp.transform]
    """(world, instance): object to world [m]."""
    fixture_pose: wp.array2d[wp.transform]
    """(world, fixture): fixture to world [m]."""
    world_moves: wp.array[int]
    """(world): 1: a body that is rendered moved since the previous frame."""
    rotation: wp.array[wp.mat33d]
    """(view): world to camera."""
    center: wp.array[wp.vec3d]
    """(view): optical centre in the world [m]."""
    to_world: wp.array[wp.mat33]
    """(view): camera to world."""
    view_moves: wp.array[int]
    """(view): 1: a body of its world or the camera moved."""
    weight: wp.array2d[float]
    """(sub_frame, row): weight of each sub-frame in a row's exposure."""


@wp.func
def turn_on(now: wp.quatd, then: wp.quatd, frames: float) -> wp.quatd:
    """Rotation a time after `now` [frames] at constant angular velocity, the shorter way from `then`, one frame before it."""
    near = wp.where(wp.dot(now, then) < wp.float64(0.0), -then, then)
    return wp.quat_slerp(now, near, wp.float64(-frames))


@wp.func
def unit_quaternion(pose: wp.transform) -> wp.quatd:
    """Rotation of a pose in float64."""
    q = wp.transform_get_rotation(pose)
    return wp.normalize(wp.quatd(wp.float64(q[0]), wp.float64(q[1]), wp.float64(q[2]), wp.float64(q[3])))


@wp.func
def move_on(sub_frame: SubFrame, world: int, known: bool, now: wp.transform, then: wp.transform, frames: float) -> wp.transform:
    """Pose a time after `now` [frames] at constant velocity from `then`, one frame before it, if that is known [m]; marks the world if it
    moves."""
    if not known or same_pose(now, then):
        return now
    sub_frame.world_moves[world] = 1
    p = wp.transform_get_translation(now)
    q = turn_on(unit_quaternion(now), unit_quaternion(then), frames)
    p += frames * (p - wp.transform_get_translation(then))
    return wp.transform(p, wp.quat(float(q[0]), float(q[1]), float(q[2]), float(q[3])))


@wp.kernel
def move_bodies_kernel(snapshot: Snapshots, frames: float, sub_frame_inout: SubFrame):
    """Poses of bodies a time `frames` after the snapshot [frames]; marks worlds in which one moves. Bodies that were absent in the previous
    frame rest. Launched over world, body."""
    world, body = wp.tid()
    instances = snapshot.pose.shape[1]
    follows = snapshot.follows[world] != 0
    if body < instances:
        entry = snapshot.catalog_index[world, body]
        known = follows and entry >= 0 and entry == snapshot.last_catalog_index[world, body]
        now = snapshot.pose[world, body]
        sub_frame_inout.pose[world, body] = move_on(sub_frame_inout, world, known, now, snapshot.last_pose[world, body], frames)
    else:
        fixture = body - instances
        known = follows and snapshot.fixture_visible[world, fixture] != 0 and snapshot.last_fixture_visible[world, fixture] != 0
        now = snapshot.fixture_pose[world, fixture]
        then = snapshot.last_fixture_pose[world, fixture]
        sub_frame_inout.fixture_pose[world, fixture] = move_on(sub_frame_inout, world, known, now, then, frames)


@kernel_of_views
def move_cameras_kernel(
    # State:
    snapshot: Snapshots,
    # In:
    views: AnyViews,
    last_rotation: wp.array[wp.mat33d],  # (view)
    last_center: wp.array[wp.vec3d],  # (view) [m]
    frames: float,
    # Out:
    sub_frame_inout: SubFrame,
):
    """Cameras of views a time `frames` after the snapshot [frames], by those in the previous frame, as of `move_bodies_kernel`; marks the
    views in which anything moves. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    rotation, center = views.cameras.rotation[view], views.cameras.center[view]
    sub_frame_inout.rotation[view] = rotation
    sub_frame_inout.center[view] = center
    sub_frame_inout.view_moves[view] = sub_frame_inout.world_moves[world]
    if snapshot.follows[world] != 0 and not (rotation == last_rotation[view] and center == last_center[view]):
        q = turn_on(wp.quat_from_matrix(rotation), wp.quat_from_matrix(last_rotation[view]), frames)
        sub_frame_inout.rotation[view] = wp.quat_to_matrix(q)
        sub_frame_inout.center[view] = center + wp.float64(frames) * (center - last_center[view])
        sub_frame_inout.view_moves[view] = 1
    sub_frame_inout.to_world[view] = wp.mat33(wp.transpose(sub_frame_inout.rotation[view]))


@wp.kernel
def expose_kernel(grid: ImageGrid, shown: ShadedImage, sub_frame: SubFrame, index: int, first: int, image_inout: ShadedImage):
    """Add the radiance of sub-frame `index`, `shown`, to the picture of views in which anything moves, with its weight in the row; the
    first one replaces the picture. Launched over view, pixel (tile order, from flat index `first` on)."""
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column) or sub_frame.view_moves[view] == 0:
        return
    value = sub_frame.weight[index, row] * resolve_radiance(shown, view, row, column)
    if index > 0:
        value += image_inout.radiance[view, row, column]
    image_inout.radiance[view, row, column] = value
    image_inout.resolve[view, row, column] = wp.uint32(0)
