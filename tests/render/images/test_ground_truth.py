"""Ground truth of views on the device: known answers, and a NumPy twin in float64."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from synpick_warp.exporters.bop.view import rotation_matrices
from synpick_warp.kernels.render.images.ground_truth import expand_masks_kernel, gather_cameras_kernel, gather_objects_kernel
from synpick_warp.kernels.render.visibility.camera import CameraTable
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import allocate_view_buffers, masks_of
from synpick_warp.stages.online.batches import TruthBuffers
from tests.harness.aimed_views import aimed_views
from tests.twins.masks import pack_into

WORLDS, ROOM, CAMERAS, VIEWS = 4, 3, 2, 7
WORLD = np.array([3, 3, 0, 1, 2, 2, 1], np.int32)
CAMERA = np.array([0, 1, 1, 0, 0, 1, 1], np.int32)
OBJECT_IDS = np.array([4, 7, 11], np.int32)


def gather(device: wp.Device, rotation: np.ndarray, center: np.ndarray, entry: np.ndarray, pose: np.ndarray) -> dict[str, np.ndarray]:
    """Results of both kernels; intrinsics are 100 and 110 c + 0, 1, 2, 3 for camera c; world w shows frame 2 w of episode 20 + w."""
    cameras = CameraTable()
    intrinsics = np.array([[100, 101, 102, 103], [110, 111, 112, 113]], np.float32)
    cameras.intrinsics = wp.array(intrinsics, dtype=wp.vec4, device=device)
    cameras.rotation = wp.array(rotation, dtype=wp.mat33d, device=device)
    cameras.center = wp.array(center, dtype=wp.vec3d, device=device)
    index = np.arange(WORLDS, dtype=np.int32)
    episode, frame = (wp.array(values, dtype=wp.int32, device=device) for values in (20 + index, 2 * index))
    cameras.to_world = wp.zeros(CAMERAS, dtype=wp.mat33, device=device)
    views = aimed_views(WORLD, CAMERA, ROOM, cameras, device)
    out = allocate(TruthBuffers, {"view": VIEWS, "instance": ROOM}, device)
    outputs = [out.episode, out.camera, out.frame, out.intrinsics, out.world_to_camera]
    wp.launch(gather_cameras_kernel, dim=VIEWS, inputs=[episode, frame, views], outputs=outputs, device=device)
    inputs = [
        wp.array(OBJECT_IDS, dtype=wp.int32, device=device),
        wp.array(entry, dtype=wp.int32, device=device),
        wp.array(pose, dtype=wp.transformf, device=device),
        views,
    ]
    outputs = [out.object_id, out.pose, out.object_to_camera]
    wp.launch(gather_objects_kernel, dim=(VIEWS, ROOM), inputs=inputs, outputs=outputs, device=device)
    return {name: array.numpy() for name, array in vars(out).items()}


def test_a_camera_that_looks_down_from_two_metres(device):
    """Rotation diag(1, -1, -1) at (0.1, 0.2, 2): the origin is at (-0.1, 0.2, 2) in the camera, an object at z = 0.5 1.5 m away."""
    rotation, center = np.tile(np.diag([1.0, -1, -1]), (CAMERAS, 1, 1)), np.tile([0.1, 0.2, 2.0], (CAMERAS, 1))
    entry = np.full((WORLDS, ROOM), -1, np.int32)
    entry[:, 1] = 2
    pose = np.tile(np.array([0.1, 0.2, 0.5, 0, 0, 0, 1], np.float32), (WORLDS, ROOM, 1))
    made = gather(device, rotation, center, entry, pose)
    assert made["episode"].tolist() == (20 + WORLD).tolist()
    assert made["frame"].tolist() == (2 * WORLD).tolist()
    assert made["camera"].tolist() == CAMERA.tolist()
    assert made["intrinsics"][1].tolist() == [[110, 0, 112], [0, 111, 113], [0, 0, 1]]
    expected = np.array([[1, 0, 0, -0.1], [0, -1, 0, 0.2], [0, 0, -1, 2], [0, 0, 0, 1]], np.float32)
    np.testing.assert_allclose(made["world_to_camera"], np.tile(expected, (VIEWS, 1, 1)), atol=1e-7)
    assert made["object_id"].tolist() == [[-1, 11, -1]] * VIEWS
    np.testing.assert_allclose(made["object_to_camera"][:, 1, :3, 3], np.tile([0, 0, 1.5], (VIEWS, 1)), atol=1e-7)
    np.testing.assert_array_equal(made["object_to_camera"][:, 0], np.tile(np.eye(4), (VIEWS, 1, 1)))
    np.testing.assert_array_equal(made["pose"][:, [0, 2]], np.tile([0, 0, 0, 0, 0, 0, 1], (VIEWS, 2, 1)))


@pytest.mark.parametrize("seed", range(3))
def test_poses_equal_their_twin(device, seed):
    rng = np.random.default_rng(seed)
    rotation = rotation_matrices(rng.normal(size=(CAMERAS, 4)))
    center = rng.normal(size=(CAMERAS, 3))
    entry = rng.integers(-1, 3, (WORLDS, ROOM)).astype(np.int32)
    pose = rng.normal(size=(WORLDS, ROOM, 7)).astype(np.float32)
    pose[..., 3:] /= np.linalg.norm(pose[..., 3:], axis=-1, keepdims=True)
    made = gather(device, rotation, center, entry, pose)
    ids, poses = np.append(OBJECT_IDS, -1)[entry[WORLD]], pose[WORLD].astype(np.float64)
    np.testing.assert_array_equal(made["object_id"], ids)
    present = ids >= 0
    np.testing.assert_array_equal(made["pose"][present], pose[WORLD][present])
    to_camera = rotation[CAMERA][:, None]
    model = to_camera @ rotation_matrices(poses[..., 3:].reshape(-1, 4)).reshape(VIEWS, ROOM, 3, 3)
    position = (to_camera @ (poses[..., :3] - center[CAMERA][:, None])[..., None])[..., 0]
    np.testing.assert_allclose(made["object_to_camera"][present][:, :3, :3], model[present], rtol=0, atol=2e-7)
    np.testing.assert_allclose(made["object_to_camera"][present][:, :3, 3], position[present], rtol=2e-7, atol=2e-7)
    np.testing.assert_allclose(
        made["world_to_camera"][:, :3, 3], -np.squeeze(to_camera @ center[CAMERA][:, None, :, None], (1, 3)), atol=5e-7
    )


def test_masks_equal_their_twin(device):
    rng = np.random.default_rng(0)
    ids = rng.choice(np.array([0, 1, 2, 3, 40, 252, 253, 254, 255], np.uint8), (2, 35, 6))
    masks = rng.integers(0, 2, (2, 40, 35, 6)).astype(bool)
    masks[:, ::3, :, rng.integers(1, 5) :] = False
    masks[:, ::7] = False
    images = allocate_view_buffers(2, 6, 35, 40, device)
    images.instance.assign(ids)
    pack_into(images, masks)
    for hidden, expected in ((False, ids[:, None] == 1 + np.arange(40)[:, None, None]), (True, masks)):
        out = wp.zeros(masks.shape, dtype=wp.bool, device=device)
        inputs = [images.instance, masks_of(images), hidden]
        wp.launch(expand_masks_kernel, dim=out.shape, inputs=inputs, outputs=[out], device=device)
        np.testing.assert_array_equal(out.numpy(), expected)
