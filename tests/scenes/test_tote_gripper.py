"""Tote and gripper, measured with rays: visual meshes and collision shapes agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import Gripper, Tote
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.bins import guide_walls
from synpick_warp.scenes.grippers.mechanism import finger_collider, finger_fixture
from synpick_warp.scenes.modelling import at_height, cap, join, loft, make_mesh, rounded_rectangle, strips
from synpick_warp.scenes.tote import CORNER_RADIUS, FLOOR_DEPTH, MIN_WALL, rim_height, tote_colliders, tote_fixture
from tests.twins.rays import edges_match, first_hit

TOTE = Tote()
GRIPPER = Gripper()
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
TOP = rim_height(TOTE)


def seen(origin, direction, tote=TOTE):
    mesh = tote_fixture(tote).mesh
    return first_hit(mesh.vertices, mesh.faces, origin, direction)


def felt(pieces, origin, direction):
    return min(first_hit(piece.vertices, piece.faces, origin, direction) for piece in pieces)


def inside(piece, points, margin=1e-6):
    """Which points (N, 3) lie inside a convex piece."""
    corners = piece.vertices[piece.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return ((points[:, None] - corners[None, :, 0]) * normal).sum(axis=2).max(axis=1) < -margin


def convex(piece):
    corners = piece.vertices[piece.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    height = ((piece.vertices[None].astype(np.float64) - corners[:, :1]) * normal[:, None]).sum(axis=2)
    return edges_match(piece.faces) and signed_volume(piece.vertices, piece.faces) > 0 and height.max() < 1e-6


@pytest.mark.parametrize("fixture", [tote_fixture(TOTE), finger_fixture(GRIPPER)], ids=("tote", "finger"))
def test_fixtures_are_closed_and_face_outward(fixture):
    mesh = fixture.mesh
    assert edges_match(merge_positions(mesh.vertices, mesh.faces)[1])
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3
    assert fixture.material.texture is None


def test_the_floor_is_at_zero_and_one_wall_thick():
    assert seen((0.01, 0.02, 1.0), DOWN) == pytest.approx(1.0, abs=1e-6)
    assert seen((0.01, 0.02, -1.0), UP) == pytest.approx(1.0 - TOTE.wall, abs=1e-6)


@pytest.mark.parametrize("axis", [0, 1])
def test_opening_and_floor_have_their_sizes(axis):
    across = tuple(float(axis == k) for k in range(3))
    for height in (1e-4, 0.5 * TOP, TOP - 1e-4):
        share = height / TOP
        size = TOTE.floor_size[axis] + share * (TOTE.rim_size[axis] - TOTE.floor_size[axis])
        # A little off the middle, so that no ray runs along an edge.
        start = (0.003 * (1 - axis), 0.003 * axis, height) if axis else (0.0, 0.003, height)
        assert seen(start, across) + seen(start, tuple(-k for k in across)) == pytest.approx(size, abs=2e-6)


def test_walls_are_as_thick_as_set():
    # Half-way up, and between two ribs; the draft makes the level path through a wall a little longer than its thickness.
    height, rim = 0.03, TOTE.rim_size[0] / 2
    within = seen((0.0, 0.003, height), (1.0, 0.0, 0.0))
    outside = seen((1.0, 0.003, height), (-1.0, 0.0, 0.0))
    slope = (rim - TOTE.floor_size[0] / 2) / TOP
    assert 1.0 - outside - within == pytest.approx(TOTE.wall, abs=TOTE.wall * slope)


def test_the_flange_reaches_the_outer_size_at_the_rim():
    vertices = tote_fixture(TOTE).mesh.vertices
    assert np.allclose(np.ptp(vertices, axis=0), TOTE.outer_size, atol=2e-6)
    assert vertices[:, 2].max() == pytest.approx(TOP, abs=1e-6)
    for x in (TOTE.rim_size[0] / 2 + 0.002, TOTE.outer_size[0] / 2 - 0.002):
        assert seen((x, 0.05, 1.0), DOWN) == pytest.approx(1.0 - TOP, abs=1e-6)


def test_the_inside_of_the_tote_is_empty():
    vertices = tote_fixture(TOTE).mesh.vertices
    share = np.clip(vertices[:, 2] / TOP, 0, 1)
    for axis in (0, 1):
        half = (TOTE.floor_size[axis] + share * (TOTE.rim_size[axis] - TOTE.floor_size[axis])) / 2
        other = (TOTE.floor_size[1 - axis] + share * (TOTE.rim_size[1 - axis] - TOTE.floor_size[1 - axis])) / 2
        free = (np.abs(vertices[:, axis]) < half - 1e-5) & (np.abs(vertices[:, 1 - axis]) < other - 1e-5) & (vertices[:, 2] > 1e-6)
        corner = (np.abs(vertices[:, axis]) > half - 0.03) & (np.abs(vertices[:, 1 - axis]) > other - 0.03)
        assert not (free & ~corner).any()


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), DOWN])
@pytest.mark.parametrize("height", [0.001, 0.07, 0.15, TOP - 0.001])
def test_collision_shapes_coincide_with_the_visual_mesh(direction, height):
    origin = (0.011, 0.017, height)
    assert felt(tote_colliders(TOTE), origin, direction) == pytest.approx(seen(origin, direction), abs=2e-6)


def test_collision_shapes_are_convex_and_thick():
    floor, *walls = tote_colliders(TOTE)
    for piece in (floor, *walls, *guide_walls(BinSizes.of_tote(TOTE), 2.0)):
        assert convex(piece)
    assert floor.vertices[:, 2].min() == pytest.approx(-FLOOR_DEPTH)
    assert floor.vertices[:, 2].max() == 0
    assert len(walls) == 8
    for wall in walls:
        assert wall.vertices[:, 2].max() == pytest.approx(TOP)
    reach = np.abs(np.concatenate([wall.vertices for wall in walls])).max(axis=0)[:2]
    assert reach == pytest.approx(np.maximum(np.array(TOTE.outer_size[:2]) / 2, np.array(TOTE.rim_size) / 2 + MIN_WALL))


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(1e-4, 1.0))
def test_collision_shapes_leave_the_inside_free_and_fill_the_walls(x, y, share):
    half = [(low + share * (high - low)) / 2 for low, high in zip(TOTE.floor_size, TOTE.rim_size, strict=True)]
    within = np.array([[2 * x * (half[0] - 1e-4), 2 * y * (half[1] - 1e-4), share * TOP]])
    radius = CORNER_RADIUS + share * min(high - low for low, high in zip(TOTE.floor_size, TOTE.rim_size, strict=True)) / 2
    # A plane at 45° touches the corner's round: it cuts (2 - √2) r off both sides.
    beyond = (2 - 2**0.5) * radius - sum(half[axis] - abs(within[0, axis]) for axis in (0, 1))
    if abs(beyond) > 1e-5:
        assert any(inside(piece, within).any() for piece in tote_colliders(TOTE)) == (beyond > 0)
    wall = np.array([[half[0] + 0.005, 2 * y * half[1], 0.99 * share * TOP], [2 * x * half[0], -half[1] - 0.005, 0.99 * share * TOP]])
    assert np.any([inside(piece, wall) for piece in tote_colliders(TOTE)], axis=0).all()


def test_guide_walls_stand_on_the_rim_flush_with_the_opening():
    walls = guide_walls(BinSizes.of_tote(TOTE), 2.0)
    assert len(walls) == 4
    everything = np.concatenate([wall.vertices for wall in walls])
    assert everything[:, 2].min() == pytest.approx(TOP)
    assert everything[:, 2].max() == pytest.approx(TOP + 2.0)
    for axis, size in enumerate(TOTE.rim_size):
        for sign in (1.0, -1.0):
            direction = tuple(sign * float(axis == k) for k in range(3))
            assert felt(walls, (0.013, 0.017, 1.0), direction) == pytest.approx(size / 2 - sign * (0.013, 0.017)[axis], abs=1e-6)
    # No gap between neighbours.
    assert any(inside(wall, np.array([[TOTE.rim_size[0] / 2 + 0.05, TOTE.rim_size[1] / 2 + 0.05, 1.0]])).all() for wall in walls)


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"rim_size": (0.61, 0.352)}, "tote.rim_size"),
        ({"floor_size": (0.55, 0.319)}, "tote.floor_size"),
        ({"floor_size": (0.513, 0.03)}, "tote.floor_size"),
        ({"outer_size": (0.615, 0.373, 0.01)}, "tote.outer_size"),
    ],
)
def test_invalid_totes_are_refused(change, field):
    for build in (tote_fixture, tote_colliders):
        with pytest.raises(ConfigError, match=field):
            build(replace(TOTE, **change))


def test_a_narrow_flange_leaves_a_closed_tote():
    tote = replace(TOTE, outer_size=(0.560, 0.366, 0.2))
    mesh = tote_fixture(tote).mesh
    assert edges_match(merge_positions(mesh.vertices, mesh.faces)[1])
    assert np.allclose(np.ptp(mesh.vertices, axis=0), tote.outer_size, atol=2e-6)


def test_the_finger_is_a_cone_above_the_tilt_axis():
    vertices = finger_fixture(GRIPPER).mesh.vertices
    assert vertices[:, 2].min() == 0
    assert vertices[:, 2].max() == pytest.approx(GRIPPER.finger_length)
    assert np.ptp(vertices[:, 0]) == pytest.approx(GRIPPER.finger_width)
    low = vertices[vertices[:, 2] < 0.02]
    assert np.ptp(low[:, 0]) == pytest.approx(0.03, abs=1e-3)


def test_the_fingers_collision_shape_is_as_long_as_it_is():
    finger = finger_collider(GRIPPER)
    assert convex(finger)
    assert finger.vertices[:, 2].max() == pytest.approx(GRIPPER.finger_length)
    assert finger.vertices[:, 2].min() == 0


def areas(patch):
    """Signed areas (n) of a flat patch's triangles, seen from above."""
    a, b, c = np.moveaxis(np.asarray(patch.corners, dtype=np.float64)[..., :2], 1, 0)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@given(width=st.floats(0.1, 1.0), depth=st.floats(0.1, 1.0), share=st.floats(0.1, 0.9), segments=st.integers(2, 8), below=st.booleans())
def test_strips_cover_the_same_area_as_a_fan(width, depth, share, segments, below):
    # The rectangle without what its round corners lack.
    radius = share * min(width, depth) / 2
    ring = at_height(rounded_rectangle(width, depth, radius, segments), 0.3)
    strip, fan = (areas(close(ring, below=below)) for close in (strips, cap))
    sign = -1.0 if below else 1.0
    assert (sign * strip > 0.0).all()
    np.testing.assert_allclose(strip.sum(), fan.sum(), rtol=1e-9)
    round_corner = segments * np.sin(np.pi / 2 / segments) / 2 * radius**2
    np.testing.assert_allclose(sign * strip.sum(), width * depth - 4 * (radius**2 - round_corner), rtol=1e-9)


@pytest.mark.parametrize("segments", [2, 3, 6])
def test_a_solid_with_strips_at_its_ends_is_closed(segments):
    ring = rounded_rectangle(0.6, 0.4, 0.05, segments)
    rings = np.stack([at_height(ring, 0.0), at_height(ring, 0.2)])
    mesh = make_mesh(join(strips(rings[0], below=True), loft(rings), strips(rings[1])), centered=False)
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    assert edges_match(faces)
    area = 0.6 * 0.4 - 4 * 0.05**2 * (1 - segments * np.sin(np.pi / 2 / segments) / 2)
    assert signed_volume(vertices, faces) == pytest.approx(0.2 * area, rel=1e-5)
