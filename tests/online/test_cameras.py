"""Streams of [[camera]] tables: two image sizes, drawn and carried cameras. Views are those that a bake writes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

import synpick_warp
from tests.dataset.test_drawn_cameras import CELL
from tests.online.conftest import tiny
from tests.online.test_stream import taken
from tests.worlds.cells import make_camera

CAMERAS = (*CELL, make_camera("small", resolution=[64, 48], fov=40.0))
SIZES = [(96, 72)] * 3 + [(64, 48)]


def test_views_of_two_sizes_are_those_that_a_bake_writes(tmp_path):
    config = replace(tiny(bake__episodes=1, bake__worlds=1, render__layers=["flow"]), camera=CAMERAS)
    synpick_warp.bake(config, tmp_path / "set")
    data, stream = synpick_warp.open(tmp_path / "set"), synpick_warp.stream(config)
    views = taken(stream)
    assert views.keys() == {(0, camera, frame) for camera in range(len(SIZES)) for frame in range(len(data[0]))}
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        assert made["color"].shape == (*SIZES[camera][::-1], 3)
        np.testing.assert_array_equal(made["color"], view.rgb)
        np.testing.assert_array_equal(made["depth"] * np.float32(config.bop.depth_scale / 1000), view.depth)
        np.testing.assert_allclose(made["intrinsics"], view.intrinsics, rtol=1e-6)
        np.testing.assert_allclose(made["world_to_camera"], view.world_to_camera, rtol=0, atol=1e-6)
        present = made["object_id"] >= 0
        np.testing.assert_allclose(made["object_to_camera"][present], view.object_to_camera, rtol=0, atol=1e-6)
        if camera in (0, 2):
            np.testing.assert_allclose(made["host_matrix"], view.intrinsics, rtol=0, atol=1e-12)
            np.testing.assert_allclose(made["host_translation"], view.world_to_camera[:3, 3], rtol=0, atol=1e-12)


def test_a_choice_of_cameras_gives_those_alone():
    config = replace(tiny(bake__episodes=1, bake__worlds=1), camera=CAMERAS)
    views = taken(synpick_warp.stream(config, cameras=[3, 0], stride=2))
    assert {camera for _, camera, _ in views} == {0, 3}
    assert {frame % 2 for *_, frame in views} == {0}
