"""tools/bench/sensor.py: Newton's camera sensor sees what this renderer sees, from a model built of the same snapshot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import Segment
from synpick_warp.scenes.types import Catalog, Fixture
from tests.worlds.toy_scene import GREY, UPRIGHT, ToyScene, ball, box, camera, entry, render, sheet, snapshot
from tools.bench import sensor as bench_sensor

OBLIQUE = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.8, -0.6]])
"""World to camera for a camera that looks down and towards +y."""


@pytest.fixture(scope="module")
def views(device):
    """Two worlds of things that overlap, by two cameras: the sensor's scene and images, and ours."""
    rng = np.random.default_rng(0)
    turns = rng.normal(size=(2, 3, 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    places = rng.uniform((-0.15, -0.1, 0.05), (0.15, 0.1, 0.2), (2, 3, 3))
    kinds = ((0, 1, 1), (1, 0, 0))
    toy = ToyScene(
        [entry(ball(0.08, 3)), entry(box(0.2, 0.1, 0.05))],
        [[(kind, (*places[w, i], *turns[w, i])) for i, kind in enumerate(kinds[w])] for w in range(2)],
        (camera(80, 60, 90.0, (0.0, 0.0, 1.0)), camera(80, 60, 90.0, (0.0, -0.8, 0.7), OBLIQUE)),
        fixtures=(Fixture(box(0.5, 0.4, 0.02), GREY), Fixture(box(0.05, 0.05, 0.4), GREY), Fixture(box(0.1, 0.1, 0.1), GREY)),
        fixture_poses=((0.0, 0.0, 0.0, *UPRIGHT), (0.1, 0.0, 0.4, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT)),
        fixtures_visible=(1, 1, 0),
        table=True,
    )
    config = toy.settings()
    scene = bench_sensor.build_sensor_scene(
        config, Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, -config.tote.wall, snapshot(toy, device), 4, device
    )
    images = scene.outputs(shape_index_image="shape_index", forward_depth_image="depth_forward")
    scene.render(bench_sensor.SensorCamera.RenderConfig(), images)
    return scene, *(image.numpy() for image in images.values()), render(toy, device)


def test_an_independent_renderer_hits_the_same(views):
    scene, index, depth, ours = views
    assert set(np.unique(ours.instance)) == {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    same, close, most = (row.value for row in bench_sensor.agreement(scene, index, depth, ours.instance, ours.depth, 0.1))
    # Rays that graze an edge may fall to either side of it.
    assert same >= 99.9
    assert close >= 99.9
    assert most >= 0.0


def test_what_differs_is_counted(views):
    scene, index, depth, ours = views
    code, counts = ours.instance.copy(), ours.depth.copy()
    code[0, :30] = Segment.CUP
    counts[0, 30:] += 100
    same, close, most = (row.value for row in bench_sensor.agreement(scene, index, depth, code, counts, 0.1))
    assert same == pytest.approx(87.5, abs=0.2)
    assert close == pytest.approx(75.0, abs=0.2)
    assert most >= 9.9


def test_surfaces_are_compared_in_the_camera():
    cameras = (camera(2, 1, 1.0, (0.0, 0.0, 1.0)),)
    normal = np.array([[[(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]]], np.float32)
    albedo = np.array([[[0xFF030201, 0xFF030201]]], np.uint32)
    layers = {
        "normals": np.array([[[(0.0, 0.0, -1.0), (0.0, 0.0, -1.0)]]], np.float32),
        "albedo": np.array([[[(1, 2, 3), (3, 4, 5)]]], np.uint8),
    }
    straight, apart = (row.value for row in bench_sensor.surface_agreement(cameras, normal, albedo, layers))
    assert (straight, apart) == (50.0, 1.0)


def test_textures_with_the_same_border_stay_apart():
    black = np.zeros((1024, 1024, 3), np.uint8)
    framed = black.copy()
    framed[:, 1:] = 200
    first, second = (bench_sensor._newton_mesh(sheet(1.0, 1.0), replace(GREY, texture=texture)) for texture in (black, framed))
    assert first.texture_hash != second.texture_hash
