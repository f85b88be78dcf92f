"""Look-at cameras: projections with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.cell.rig import Rig
from synpick_warp.configs.schema import Cameras
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.cameras import make_cameras

ONE = Cameras(positions=((0.0, 0.0, 2.0),), ups=((0.0, 1.0, 0.0),))


def project(camera, point):
    x = camera.matrix @ (camera.rotation @ np.array(point) + camera.translation)
    return x[:2] / x[2]


def test_the_papers_cameras_have_the_papers_matrix():
    cameras = make_cameras(Rig.of(Cameras()))
    assert len(cameras) == 3
    for camera in cameras:
        assert (camera.width, camera.height) == (1920, 1080)
        assert np.allclose(camera.matrix, [[5444.43, 0, 960], [0, 5444.43, 540], [0, 0, 1]], atol=5e-3)
        assert camera.rotation @ camera.rotation.T == pytest.approx(np.eye(3))
        assert np.linalg.det(camera.rotation) == pytest.approx(1)


def test_the_first_camera_looks_straight_down_with_y_up():
    (camera,) = make_cameras(Rig.of(ONE))
    assert np.allclose(camera.rotation, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    assert np.allclose(camera.translation, [0, 0, 2])
    assert project(camera, (0, 0, 0.16)) == pytest.approx((960, 540))
    # 0.1 m to the right and to the top, 2 m away.
    assert project(camera, (0.1, 0, 0)) == pytest.approx((960 + 272.2213, 540), abs=1e-3)
    assert project(camera, (0, 0.1, 0)) == pytest.approx((960, 540 - 272.2213), abs=1e-3)


def test_the_other_two_cameras_look_at_the_target_with_the_centre_line_up():
    _, far, near = make_cameras(Rig.of(Cameras()))
    for camera, side in ((far, 1.0), (near, -1.0)):
        assert np.allclose(-camera.rotation.T @ camera.translation, (0, side * 0.573, 2.0))
        assert project(camera, (0, 0, 0.16)) == pytest.approx((960, 540))
        # The image's upper edge points across the centre line, away from where the camera stands.
        assert project(camera, (0, -side * 0.1, 0.16))[1] < 540
        assert project(camera, (side * 0.1, 0, 0.16))[0] < 960


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(1, 170))
def test_up_vectors_point_up_and_the_target_is_in_the_image_centre(position, target, up, fov):
    forward = np.subtract(target, position)
    if np.linalg.norm(np.cross(forward, up)) < 1e-3 * np.linalg.norm(forward) or np.linalg.norm(forward) < 1e-2:
        return
    (camera,) = make_cameras(Rig.of(Cameras(positions=(position,), target=target, ups=(up,), fov=fov)))
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    assert project(camera, target) == pytest.approx((960, 540), abs=1e-3)
    higher = (np.array(target) + 1e-3 * np.array(up)).tolist()
    assert project(camera, higher)[1] < 540 + 1e-9
    # Half the field of view lies between the middle and the right edge.
    assert np.degrees(np.arctan(960 / camera.matrix[0, 0])) == pytest.approx(fov / 2)


def test_resolution_scales_the_intrinsics():
    (camera,) = make_cameras(Rig.of(replace(ONE, resolution=(640, 360))))
    assert np.allclose(camera.matrix, [[1814.81, 0, 320], [0, 1814.81, 180], [0, 0, 1]], atol=5e-3)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ups": ((0.0, 0.0, 1.0),)}, "parallel"),
        ({"ups": ((0.0, 0.0, 0.0),)}, "zero"),
        ({"ups": ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0))}, "1 entries and cameras.ups 2"),
        ({"positions": (), "ups": ()}, "empty"),
        ({"target": (0.0, 0.0, 2.0)}, "is at its look-at point"),
        ({"target": (0.0, float("nan"), 0.0)}, "not finite"),
    ],
)
def test_invalid_cameras_are_refused(change, words):
    with pytest.raises(ConfigError, match=words) as caught:
        make_cameras(Rig.of(replace(ONE, **change)))
    assert "\n" not in str(caught.value)
