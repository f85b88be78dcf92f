"""Benchmark against Newton's SensorCamera: both renderers agree on instances, depth and surfaces of the same snapshot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import Segment
from synpick_warp.scenes.types import Catalog, Fixture
from tests.worlds.toy_scene import GREY, UPRIGHT, ToyScene, ball, box, camera, entry, render, sheet, snapshot
from tools.bench import sensor as bench_sensor

OBLIQUE = np.array([[1.0, 0.0, 0.0], [0.0, -0.6, -0.8], [0.0, 0.8, -0.6]])
"""World-to-camera rotation of a camera that looks down and towards +y."""


@pytest.fixture(scope="module")
def views(device):
    """Two worlds of overlapping objects by two cameras: the sensor's scene and images, and ours."""
    rng = np.random.default_rng(0)
    quaternions = rng.normal(size=(2, 3, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    positions = rng.uniform((-0.15, -0.1, 0.05), (0.15, 0.1, 0.2), (2, 3, 3))
    entries = ((0, 1, 1), (1, 0, 0))
    toy = ToyScene(
        [entry(ball(0.08, 3)), entry(box(0.2, 0.1, 0.05))],
        [[(entry_index, (*positions[w, i], *quaternions[w, i])) for i, entry_index in enumerate(entries[w])] for w in range(2)],
        (camera(80, 60, 90.0, (0.0, 0.0, 1.0)), camera(80, 60, 90.0, (0.0, -0.8, 0.7), OBLIQUE)),
        fixtures=(Fixture(box(0.5, 0.4, 0.02), GREY), Fixture(box(0.05, 0.05, 0.4), GREY), Fixture(box(0.1, 0.1, 0.1), GREY)),
        fixture_poses=((0.0, 0.0, 0.0, *UPRIGHT), (0.1, 0.0, 0.4, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT)),
        fixtures_visible=(1, 1, 0),
        table=True,
    )
    config = toy.settings()
    scene = bench_sensor.build_sensor_scene(
        config.render, Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, -config.tote.wall, snapshot(toy, device), 4, device
    )
    scene.prepare(color=False)[0]()
    return scene, *scene.read_hits(4), render(toy, device)


def test_an_independent_renderer_agrees(views):
    scene, index, depth, ours = views
    assert set(np.unique(ours.instance)) == {1, 2, 3, Segment.TABLE, Segment.TOTE, Segment.FINGER}
    same, close, largest = (row.value for row in bench_sensor.compare_hits(scene.segment, index, depth, ours.instance, ours.depth, 0.1))
    # Rounding decides on which side of a silhouette a grazing ray passes.
    assert same >= 99.9
    assert close >= 99.9
    assert largest >= 0.0


def test_differences_are_counted(views):
    scene, index, depth, ours = views
    segment, counts = ours.instance.copy(), ours.depth.copy()
    segment[0, :30] = Segment.CUP
    counts[0, 30:] += 100
    same, close, largest = (row.value for row in bench_sensor.compare_hits(scene.segment, index, depth, segment, counts, 0.1))
    assert same == pytest.approx(87.5, abs=0.2)
    assert close == pytest.approx(75.0, abs=0.2)
    assert largest >= 9.9


def test_textures_with_the_same_border_stay_distinct():
    black = np.zeros((1024, 1024, 3), np.uint8)
    framed = black.copy()
    framed[:, 1:] = 200
    first, second = (bench_sensor.newton_mesh(sheet(1.0, 1.0), replace(GREY, texture=texture)) for texture in (black, framed))
    assert first.texture_hash != second.texture_hash
