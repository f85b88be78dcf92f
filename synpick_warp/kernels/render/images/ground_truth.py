"""Per-view ground truth on the device: gather of each view's episode, camera, object ids and poses; a mask image per instance."""

import warp as wp

from synpick_warp.kernels.render.images.layers import position_of, rotation_of
from synpick_warp.kernels.render.visibility.camera import AnyViews
from synpick_warp.kernels.render.visibility.masks import InstanceMasks, has_pixel, read_mask
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.state import Frames, Snapshots

wp.set_module_options({"enable_backward": False})


@wp.func
def camera_matrix(fx_fy_cx_cy: wp.vec4) -> wp.mat33:
    """Camera matrix K of fx, fy, cx, cy [px]."""
    k = fx_fy_cx_cy
    return wp.mat33(k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0)


@wp.func
def rigid_transform(r: wp.mat33d, t: wp.vec3d) -> wp.mat44:
    """Homogeneous matrix of a rotation and a translation [m], rounded to float32."""
    return wp.mat44(
        float(r[0, 0]), float(r[0, 1]), float(r[0, 2]), float(t[0]),
        float(r[1, 0]), float(r[1, 1]), float(r[1, 2]), float(t[1]),
        float(r[2, 0]), float(r[2, 1]), float(r[2, 2]), float(t[2]),
        0.0, 0.0, 0.0, 1.0,
    )  # fmt: skip


@wp.struct
class ViewTruth:
    """Ground truth of a batch of views, beside what the renderer writes."""

    episode: wp.array[int]
    """(view): episode index."""
    camera: wp.array[int]
    """(view): camera index."""
    frame: wp.array[int]
    """(view): frame index within the episode, from 0."""
    object_id: wp.array2d[int]
    """(view, instance): obj_id; -1: the instance is not in the scene; below: a distractor, without label."""
    pose: wp.array2d[wp.transform]
    """(view, instance): object to world: x, y, z, quaternion x, y, z, w [m]."""
    object_to_camera: wp.array2d[wp.mat44]
    """(view, instance): object to camera, OpenCV's axes [m]."""
    intrinsics: wp.array[wp.mat33]
    """(view): camera matrix K; the centre of pixel (row, column) is (column + 0.5, row + 0.5) [px]."""
    world_to_camera: wp.array[wp.mat44]
    """(view): extrinsics [m]."""


@kernel_of_views
def gather_cameras_kernel(snapshot: Frames, views: AnyViews, truth_out: ViewTruth):
    """Gather what belongs to a view as a whole: episode, camera and frame index, camera matrix and extrinsics. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    camera = views.camera[view]
    truth_out.episode[view] = snapshot.episode[world]
    truth_out.camera[view] = camera
    truth_out.frame[view] = snapshot.frame[world]
    truth_out.intrinsics[view] = camera_matrix(views.cameras.intrinsics[view])
    rotation = views.cameras.rotation[view]
    truth_out.world_to_camera[view] = rigid_transform(rotation, -(rotation * views.cameras.center[view]))


@kernel_of_views
def gather_objects_kernel(
    # Scene:
    object_ids: wp.array[int],  # (entry)
    # State:
    snapshot: Snapshots,
    # In:
    views: AnyViews,
    # Out:
    truth_out: ViewTruth,
):
    """Gather obj_id and pose of each instance: object to world as simulated, object to camera computed in float64. Instances that are not
    in the scene get obj_id -1 and the identity. Launched over view, instance."""
    view, instance = wp.tid()
    world = views.world[view]
    entry = snapshot.catalog_index[world, instance]
    if entry < 0:
        truth_out.object_id[view, instance] = -1
        truth_out.pose[view, instance] = wp.transform_identity()
        truth_out.object_to_camera[view, instance] = wp.identity(n=4, dtype=float)
        return
    body = snapshot.pose[world, instance]
    rotation = views.cameras.rotation[view]
    truth_out.object_id[view, instance] = object_ids[entry]
    truth_out.pose[view, instance] = body
    position = rotation * (position_of(body) - views.cameras.center[view])
    truth_out.object_to_camera[view, instance] = rigid_transform(rotation * rotation_of(body), position)


@wp.kernel
def expand_masks_kernel(
    # In:
    instance: wp.array3d[wp.uint8],  # (view, row, column)
    masks: InstanceMasks,
    is_amodal: bool,
    # Out:
    mask_out: wp.array4d[wp.bool],  # (view, instance, row, column)
):
    """Make one binary mask per instance: visible masks from the id image or, if `is_amodal`, amodal masks from their boxes. Launched over
    view, instance, row, column."""
    view, index, row, column = wp.tid()
    if is_amodal:
        mask_out[view, index, row, column] = has_pixel(masks, view, read_mask(masks, view, index), row, column)
    else:
        mask_out[view, index, row, column] = int(instance[view, row, column]) == index + 1
