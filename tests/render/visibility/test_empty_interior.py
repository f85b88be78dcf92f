"""Empty interior of the tote: no triangle reaches into it, the early-out of rays is conservative, and images do not depend on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp

from synpick_warp.configs.schema import Tote
from synpick_warp.kernels.render.visibility.bvh_rays import stays_in_interior
from synpick_warp.kernels.render.visibility.gbuffer import FAR
from synpick_warp.kernels.render.visibility.gbuffer import Interior as DeviceInterior
from synpick_warp.scenes.tote import tote_fixture
from synpick_warp.scenes.types import Interior
from tests.harness.probe import probe
from tests.twins.rays import first_hit
from tests.worlds.toy_scene import ANNOTATIONS, UPRIGHT, ToyScene, assert_same, box, camera, entry, render

TOTE = Tote()
FIXTURE = tote_fixture(TOTE)
INTERIOR = FIXTURE.interior
assert INTERIOR is not None
OTHER = replace(TOTE, floor_size=(0.3, 0.2), rim_size=(0.42, 0.26), outer_size=(0.5, 0.34, 0.2))


def inside(interior: Interior, points: np.ndarray) -> np.ndarray:
    """True for points (..., 3) in an interior."""
    x, y, z = np.abs(points[..., 0]), np.abs(points[..., 1]), points[..., 2]
    wide = [half + growth * z for half, growth in zip(interior.half, interior.growth, strict=True)]
    return (z >= interior.floor) & (z <= interior.top) & (x <= wide[0]) & (y <= wide[1]) & (x + y <= wide[2])


def corners(interior: Interior) -> np.ndarray:
    """Corners (16, 3) of an interior."""
    points = []
    for z in (interior.floor, interior.top):
        x, y, both = (half + growth * z for half, growth in zip(interior.half, interior.growth, strict=True))
        points += [(sx * a, sy * b, z) for a, b in ((x, both - x), (both - y, y)) for sx in (1, -1) for sy in (1, -1)]
    return np.array(points)


early_out = probe(stays_in_interior)


def stays(interior: Interior, start: np.ndarray, direction: np.ndarray, reach: np.ndarray, device) -> np.ndarray:
    given = DeviceInterior()
    given.half, given.growth, given.floor, given.top = wp.vec3(*interior.half), wp.vec3(*interior.growth), interior.floor, interior.top
    return early_out(given, start, direction, reach, device=device)


@pytest.mark.parametrize("tote", [TOTE, OTHER, replace(TOTE, floor_size=TOTE.rim_size)])
def test_no_part_of_the_tote_lies_in_its_interior(tote):
    fixture = tote_fixture(tote)
    interior = fixture.interior
    assert interior is not None
    shell = trimesh.Trimesh(fixture.mesh.vertices, fixture.mesh.faces, process=False)
    points = np.concatenate([shell.vertices, trimesh.sample.sample_surface(shell, 20_000, seed=1)[0]])
    assert not inside(interior, points).any()
    assert interior.top > shell.vertices[:, 2].max()


def test_the_interior_fills_nearly_the_whole_tote():
    volume = trimesh.convex.convex_hull(corners(INTERIOR)).volume
    floor, rim = (np.prod(size) for size in (TOTE.floor_size, TOTE.rim_size))
    whole = (floor + rim + np.sqrt(floor * rim)) / 3 * INTERIOR.top
    assert 0.98 * whole < volume < whole


@pytest.mark.parametrize("tote", [TOTE, OTHER])
def test_the_early_out_is_conservative(device, tote):
    fixture = tote_fixture(tote)
    rng = np.random.default_rng(3)
    size = np.array((*tote.outer_size[:2], 2.0 * tote.outer_size[2]))
    start = rng.uniform(-0.6, 0.6, (1000, 3)) * size + (0.0, 0.0, 0.4 * size[2])
    direction = rng.normal(size=(1000, 3))
    reach = np.where(rng.random(1000) < 0.5, float(FAR), rng.uniform(0.0, 0.6, 1000))
    skipped = stays(fixture.interior, start, direction, reach, device)
    unit = direction / np.linalg.norm(direction, axis=1)[:, None]
    distance = first_hit(fixture.mesh.vertices, fixture.mesh.faces, start, unit)
    hit = distance < reach * np.linalg.norm(direction, axis=1)
    assert not (skipped & hit).any()
    # It applies to many rays: those that start in the tote and go up, or end in it.
    assert skipped.sum() > 0.2 * (~hit).sum()


def within(points: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Random points (count, 3) strictly inside the convex hull of `points`."""
    weights = rng.dirichlet(np.ones(len(points)), count)
    return 0.999 * weights @ points + 0.001 * points.mean(axis=0)


def test_segments_within_the_interior_or_through_its_opening_are_skipped(device):
    rng = np.random.default_rng(5)
    hull = corners(INTERIOR)
    start, end, out = (within(points, 500, rng) for points in (hull, hull, hull[hull[:, 2] == INTERIOR.top]))
    below = start * (1.0, 1.0, 0.0) - (0.0, 0.0, 0.1)
    ones = np.ones(500)
    assert stays(INTERIOR, start, end - start, ones, device).all()
    assert stays(INTERIOR, start, out - start, float(FAR) * ones, device).all()
    assert stays(INTERIOR, out + (out - start), start - out, 1.5 * ones, device).all()
    assert not stays(INTERIOR, start, below - start, ones, device).any()


@pytest.mark.parametrize("turn", [0.0, 0.4])
def test_images_do_not_depend_on_the_interior(device, turn):
    """A rotated and translated tote with boxes inside, outside and through its wall."""
    boxes = [entry(box(0.1, 0.06, 0.08)), entry(box(0.05, 0.2, 0.05))]
    placed = [
        (0, (0.05, 0.02, 0.05, *UPRIGHT)),
        (1, (-0.1, -0.05, 0.03, *UPRIGHT)),
        (0, (0.31, 0.0, 0.1, *UPRIGHT)),
        (1, (0.5, 0.3, 0.0, *UPRIGHT)),
    ]
    pose = (0.02, -0.01, 0.0, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
    views = (camera(96, 72, 80.0, (0.0, 0.0, 1.2)),)
    grip = (boxes[0].mesh, boxes[1].mesh)
    scenes = []
    for fixture in (FIXTURE, replace(FIXTURE, interior=None)):
        fixtures = (fixture, *(replace(FIXTURE, mesh=mesh, interior=None) for mesh in grip))
        toy = ToyScene(boxes, [placed], views, fixtures=fixtures, fixture_poses=(pose,) * 3, fixtures_visible=(1, 0, 0), table=True)
        scenes.append(render(toy, device))
    assert_same(*scenes, "color", "exact_depth", "radiance", "resolve", *ANNOTATIONS)
    assert {1, 2, 3, 253} <= set(np.unique(scenes[0].instance))
