"""Analytic suction maps: known scores of faces, balls, cylinders, edges, levers and obstacles, by SuctionNet's formulas in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from synpick_warp.scenes.types import TriangleMesh
from tests.twins.layers import RenderedLayers, render_layers, surface_points
from tests.worlds.toy_scene import GREY, UPRIGHT, Fixture, ToyScene, ball, box, camera, entry, flat_shaded

VIEW = camera(141, 101, 1000.0, (0.0, 0.0, 1.0))
"""A pixel is 1 mm at the height 0."""
RADIUS = 0.01
NAMES = ("suction_seal", "suction_wrench")
TOP = (0.0, 0.0, -0.02, *UPRIGHT)
"""Pose of a box 40 mm high whose upper face is at height 0."""


def scores(device, *bodies, center=(0.0, 0.0, 0.0), **more) -> RenderedLayers:
    """Maps of meshes at poses; the first has its centre of mass at `center`."""
    entries = [entry(mesh) for mesh, _ in bodies]
    entries[0] = replace(entries[0], center_of_mass=np.array(center))
    return render_layers(ToyScene(entries, [[(k, pose) for k, (_, pose) in enumerate(bodies)]], (VIEW,), **more), device, names=NAMES)


def points(found: RenderedLayers) -> np.ndarray:
    """Surface point of each pixel in the world [m]."""
    return (surface_points(found.depth[0], VIEW) - VIEW.translation) @ VIEW.rotation


def seal(heights: np.ndarray) -> float:
    """SuctionNet's score of the heights of a lip's 72 points [m]."""
    chord = 2.0 * RADIUS * np.sin(np.pi / 72)
    edges = np.hypot(chord, np.diff(heights, append=heights[0]))
    return float((chord / edges).min() * np.exp(-1e5 * heights.var()))


def cylinder(radius: float, length: float, sections: int) -> TriangleMesh:
    """A smooth cylinder along x."""
    mesh = trimesh.creation.cylinder(radius, length, sections=sections)
    vertices = np.asarray(mesh.vertices)[:, [2, 0, 1]]
    made = flat_shaded(vertices, np.asarray(mesh.faces))
    normals = made.vertices * np.array([0.0, 1.0, 1.0], np.float32)
    return replace(made, normals=(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)).astype(np.float32))


def test_a_face_seals_where_the_whole_lip_lies_on_it(device):
    found = scores(device, (box(0.08, 0.06, 0.04), TOP))
    inside = np.abs(points(found)[..., :2]) + RADIUS - (0.04, 0.03)
    face = found.segment[0] == 1
    seals = found["suction_seal"][0]
    np.testing.assert_allclose(seals[face & (inside.max(axis=-1) < -1e-4)], 1.0, atol=1e-4)
    # 72 points leave 0.01 mm between polygon and circle.
    assert not seals[face & (inside.max(axis=-1) > 2e-5)].any()
    assert not seals[~face].any()
    assert not found["suction_wrench"][0][~face].any()


@pytest.mark.parametrize("radius", [0.012, 0.02])
def test_a_cylinder_bends_the_lip(device, radius):
    found = scores(device, (cylinder(radius, 0.1, 720), (0.0, 0.0, -radius, *UPRIGHT)))
    angle = 2.0 * np.pi * (np.arange(72) + 0.5) / 72
    expected = seal(np.sqrt(radius**2 - (RADIUS * np.sin(angle)) ** 2) - radius)
    assert 0.2 < expected < 0.95
    assert found["suction_seal"][0, 50, 70] == pytest.approx(expected, abs=0.02)


def test_a_ball_keeps_the_lip_in_a_plane(device):
    found = scores(device, (ball(0.03, 6), (0.0, 0.0, -0.03, *UPRIGHT)))
    steep = np.linalg.norm(points(found)[..., :2], axis=-1) > 0.025
    assert found["suction_seal"][0][(found.segment[0] == 1) & ~steep].min() > 0.99


def test_a_ball_smaller_than_the_cup_does_not_seal(device):
    found = scores(device, (ball(0.009, 4), (0.0, 0.0, -0.009, *UPRIGHT)))
    assert (found.segment[0] == 1).any()
    assert not found["suction_seal"].any()


def test_a_groove_costs_by_its_depth(device):
    """Two boards with a step of 1 mm under one cup: half of the lip is lower, and two edges cross the step."""
    bounds = [(-0.05, -0.04, -0.02), (0.0, 0.04, 0.0)], [(0.0, -0.04, -0.02), (0.05, 0.04, -0.001)]
    boards = trimesh.util.concatenate([trimesh.creation.box(bounds=corners) for corners in bounds])
    found = scores(device, (flat_shaded(boards.vertices, boards.faces), (-0.0005, 0.0, 0.0, *UPRIGHT)))
    angle = 2.0 * np.pi * (np.arange(72) + 0.5) / 72
    for column in (62, 66, 75):
        x = points(found)[50, column, 0] + 0.0005
        heights = np.where(x + RADIUS * np.cos(angle) < 0.0, 0.0, -0.001)
        assert found["suction_seal"][0, 50, column] == pytest.approx(seal(heights), abs=1e-3)


def test_the_lever_of_the_centre_of_mass_costs(device):
    center = (0.015, 0.0, -0.01)
    found = scores(device, (box(0.12, 0.08, 0.04), TOP), center=center)
    away = np.abs(points(found)[..., :2] - center[:2]).max(axis=-1)
    # The tangents of a cup that looks up are the image's axes: the larger of both torques counts.
    expected = 1.0 - np.minimum(9.8 * away / (15.6 * np.pi * RADIUS), 1.0)
    face = (np.abs(points(found)[..., :2]) < (0.0599, 0.0399)).all(axis=-1)
    np.testing.assert_allclose(found["suction_wrench"][0][face], expected[face], atol=1e-4)
    assert expected[face].min() == 0.0 < expected[face].max()


@pytest.mark.parametrize(("thickness", "sealed"), [(0.009, True), (0.011, False)])
def test_a_neighbour_in_the_cups_way_prevents_a_seal(device, thickness, sealed):
    """A board lies on the face, from x = 15 mm on, and rises above it by less or more than 10 mm."""
    board = box(0.05, 0.06, thickness), (0.04, 0.0, 0.5 * thickness, *UPRIGHT)
    found = scores(device, (box(0.06, 0.06, 0.04), TOP), board)
    x, y = points(found)[..., 0], points(found)[..., 1]
    own = (found.segment[0] == 1) & (np.abs(y) < 0.019)
    assert found["suction_seal"][0][own & (np.abs(x + 0.007) < 0.0115)].min() > 0.99
    assert (found["suction_seal"][0][own & (np.abs(x - 0.010) < 0.0045)] > 0.99).all() == sealed
    assert found["suction_seal"][0][own & (np.abs(x - 0.010) < 0.0045)].any() == sealed


def test_bins_stand_in_the_way_and_grippers_do_not(device):
    walls = (Fixture(box(0.02, 0.3, 0.2), GREY), Fixture(box(0.02, 0.02, 0.1), GREY), Fixture(box(0.02, 0.02, 0.01), GREY))
    poses = ((0.045, 0.0, 0.0, *UPRIGHT), (0.0, 0.0, 0.1, *UPRIGHT), (0.0, 0.0, 0.04, *UPRIGHT))
    tilted = (0.0, 0.0, -0.02, 0.0, np.sin(0.4), 0.0, np.cos(0.4))
    made = {"fixtures": walls, "fixture_poses": poses}
    found = scores(device, (box(0.06, 0.06, 0.04), tilted), **made, fixtures_visible=(1, 1, 1))
    free = scores(device, (box(0.06, 0.06, 0.04), tilted), **made, fixtures_visible=(0, 1, 1))
    seen = (found.segment[0] == 1) & (free.segment[0] == 1)
    # The face looks to +x, where the wall is.
    assert (free["suction_seal"][0][seen] > 0.99).sum() > 200
    assert not found["suction_seal"][0][seen & (found["suction_seal"][0] != free["suction_seal"][0])].any()
    assert (found["suction_seal"][0][seen] == 0.0).sum() > (free["suction_seal"][0][seen] == 0.0).sum() + 100
