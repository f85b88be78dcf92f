"""Rays: queries of the wide BVH against a test of every triangle, and the empty interior of the tote, which they skip."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.configs.schema import Tote
from synpick_warp.errors import CatalogError
from synpick_warp.kernels.render.visibility.bvh_rays import stays_in_interior
from synpick_warp.kernels.render.visibility.gbuffer import FAR
from synpick_warp.kernels.render.visibility.gbuffer import Interior as DeviceInterior
from synpick_warp.kernels.render.visibility.wide_bvh import LEAF, WIDTH
from synpick_warp.scenes.bins import tote_fixture
from synpick_warp.scenes.types import Interior, TriangleMesh
from synpick_warp.stages.render import wide_bvh
from synpick_warp.stages.render.wide_bvh import ABSENT, MAX_COORDINATE, build_levels, build_wide_bvh, needed_stack
from synpick_warp.system.hardware.device import pick_device
from tests.harness.bvh_probe import hit_every_triangle, query_warp, query_wide, visits_of
from tests.harness.environment import default_device
from tests.harness.probe import probe
from tests.twins.raycast import first_hit
from tests.worlds.shapes import UPRIGHT, ball, box, camera, entry
from tests.worlds.toy_scene import ANNOTATIONS, ToyScene, assert_same, render

RAYS = 4096


def soup(count: int, seed: int, size: float = 0.3) -> TriangleMesh:
    """Random triangles, of which every tenth is degenerate: two coincident or three collinear corners."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.0, 1.0, (count, 1, 3)) + rng.uniform(-size, size, (count, 3, 3))
    corners[5::20, 1] = corners[5::20, 0]
    corners[15::20, 1:, 1:] = corners[15::20, :1, 1:]
    return loose(corners)


def loose(corners: np.ndarray) -> TriangleMesh:
    """A mesh of loose triangles (F, 3, 3) [m]; its normals and texture coordinates don't matter here."""
    zeros = np.zeros((3 * len(corners), 3), np.float32)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return TriangleMesh(corners.reshape(-1, 3).astype(np.float32), faces, zeros, zeros[:, :2])


def staircase(levels: int) -> TriangleMesh:
    """Triangles each half as large and half as far from the origin as the one before: a split by area cuts off one at a time."""
    scale = 0.5 ** np.arange(levels)[:, None, None]
    corners = np.array([[1.0, 0.0, 0.0], [1.2, 0.0, 0.0], [1.0, 0.2, 0.1]]) * scale
    return loose(corners)


def rays_at(mesh: TriangleMesh, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Start points and directions (RAYS, 3) float32 of rays from outside and inside a mesh's box; a quarter has zero components."""
    rng = np.random.default_rng(seed)
    lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, half = (lower + upper) / 2, (upper - lower) / 2 + 1e-3
    start = middle + half * rng.normal(size=(RAYS, 3)) * rng.choice([0.3, 2.0, 20.0], (RAYS, 1))
    direction = middle + half * rng.uniform(-1.0, 1.0, (RAYS, 3)) - start
    direction[::8, rng.integers(3)] = 0.0
    direction[4::8, :2] = 0.0
    start[::16] = mesh.vertices[rng.integers(len(mesh.vertices), size=len(start[::16]))]
    return start.astype(np.float32), (direction / np.linalg.norm(direction, axis=1, keepdims=True).clip(1e-9)).astype(np.float32)


def run_queries(meshes: list[TriangleMesh], row: int, rays: tuple[np.ndarray, np.ndarray], reach: float, device: wp.Device, own: bool):
    """Hits (ray, 3) of (t, u, v), triangles (ray) and blocked rays (ray), by the wide BVH (`own`) or by Warp's."""
    if own:
        return query_wide(build_wide_bvh(meshes, device), row, *rays, reach, device=device)
    points = wp.array(meshes[row].vertices, dtype=wp.vec3, device=device)
    mesh = wp.Mesh(points, wp.array(meshes[row].faces.reshape(-1), dtype=wp.int32, device=device))
    return query_warp(mesh.id, *rays, reach, device=device)


def check_queries(meshes: list[TriangleMesh], row: int, seed: int, reach: float) -> int:
    """Compare both queries of a mesh; returns the number of hits."""
    device = pick_device(default_device())
    rays = rays_at(meshes[row], seed)
    hit, face, blocked = run_queries(meshes, row, rays, reach, device, own=True)
    expected_hit, expected_face, expected_blocked = run_queries(meshes, row, rays, reach, device, own=False)
    assert np.array_equal(hit[:, 0], expected_hit[:, 0])
    same = face == expected_face
    assert np.array_equal(hit[same], expected_hit[same])
    # Of triangles hit at the same distance, which share an edge or a corner, either is right.
    start, direction = (values[face >= 0].astype(np.float64) for values in rays)
    t, u, v = hit[face >= 0].astype(np.float64).T[..., None]
    corners = meshes[row].vertices[meshes[row].faces[face[face >= 0]]].astype(np.float64)
    point = u * corners[:, 0] + v * corners[:, 1] + (1.0 - u - v) * corners[:, 2]
    assert (np.abs(start + t * direction - point) < 1e-5 * (1.0 + t)).all()
    assert np.array_equal(blocked, expected_blocked)
    assert np.array_equal(blocked, hit[:, 0] >= 0.0)
    return len(point)


@pytest.mark.parametrize("reach", [0.5, 1e30])
@pytest.mark.parametrize("mesh", [ball(0.1, 3), box(0.2, 0.1, 0.05), soup(1, 0), soup(3, 1), soup(600, 2), staircase(60)])
def test_hits_are_those_of_warps_queries(mesh: TriangleMesh, reach: float):
    assert check_queries([soup(7, 5), mesh, ball(0.3, 1)], 1, seed=3, reach=reach) > 0


@settings(max_examples=20, deadline=None)
@given(count=st.integers(1, 300), seed=st.integers(0, 1000), size=st.sampled_from([1e-4, 0.05, 1.0]))
def test_hits_of_random_triangles_are_those_of_warps_queries(count: int, seed: int, size: float):
    check_queries([soup(count, seed, size)], 0, seed, 1e30)


def test_rays_from_afar_hit_a_small_mesh():
    """Rounding in the slab test grows with the distance. 20 m off Warp's query misses one of the triangles that rays are aimed at."""
    mesh = soup(200, 4, 0.01)
    small = TriangleMesh(mesh.vertices * np.float32(0.05), mesh.faces, mesh.normals, mesh.uv)
    rng = np.random.default_rng(0)
    away = rng.normal(size=(RAYS, 3))
    start = 20.0 * away / np.linalg.norm(away, axis=1, keepdims=True)
    target = small.vertices[small.faces].mean(axis=1)[rng.integers(200, size=RAYS)]
    direction = (target - start) / np.linalg.norm(target - start, axis=1, keepdims=True)
    rays = start.astype(np.float32), direction.astype(np.float32)
    device = pick_device(default_device())
    own, warps = (run_queries([small], 0, rays, 1e30, device, own) for own in (True, False))
    found = warps[1] >= 0
    assert found.sum() > 0.9 * RAYS
    assert np.array_equal(own[0][found, 0], warps[0][found, 0])
    assert (own[1] >= 0).sum() >= found.sum()


@pytest.mark.parametrize("mesh", [ball(0.1, 3), soup(1, 0), soup(500, 2), staircase(60)])
def test_boxes_contain_their_triangles(mesh: TriangleMesh):
    bvh = build_wide_bvh([soup(9, 1), mesh], wp.get_device("cpu"))
    words, triangles = bvh.node.numpy().reshape(-1, 16), bvh.triangle.numpy().reshape(-1, 3, 4)
    faces = triangles[:, 0, 3].copy().view(np.uint32)
    seen: list[int] = []

    def visit(node: int) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of a node's triangles, after a check that each child's box contains its own."""
        record = words[node]
        origin = record[:3].view(np.float32).astype(np.float64)
        step = 2.0 ** ((record[3] >> np.array([0, 8, 16]) & 255).astype(float) - 127.0)
        boxes = record[4:10].copy().view(np.uint8).reshape(6, int(WIDTH)).T
        bounds = []
        for child, quantized in zip(record[10:14], boxes, strict=True):
            if quantized[0] == MAX_COORDINATE and quantized[3] == 0:
                continue
            if child & int(LEAF):
                row = int(child) - int(LEAF)
                seen.append(int(faces[row]))
                assert np.array_equal(triangles[row, :, :3], mesh.vertices[mesh.faces[faces[row]]])
                low, high = triangles[row, :, :3].min(axis=0), triangles[row, :, :3].max(axis=0)
            else:
                low, high = visit(int(child))
            assert (origin + quantized[:3] * step <= low).all()
            assert (origin + quantized[3:] * step >= high).all()
            bounds.append((low, high))
        return np.min([low for low, _ in bounds], axis=0), np.max([high for _, high in bounds], axis=0)

    visit(int(bvh.root.numpy()[1]))
    assert sorted(seen) == list(range(len(mesh.faces)))


def test_nodes_of_a_regular_mesh_are_filled():
    _, levels = build_levels(ball(0.1, 4))
    child = np.concatenate([level.child for level in levels])
    assert (child != ABSENT).sum(axis=1).mean() > 2.8


def stack_of(mesh: TriangleMesh) -> int:
    """Worst-case stack of a mesh's wide BVH, by recursion over its records: all children but one wait while a query is below that one."""
    words = build_wide_bvh([mesh], wp.get_device("cpu")).node.numpy().reshape(-1, 16)

    def needed(node: int) -> int:
        inner = [int(child) for child in words[node, 10:14] if not child & int(LEAF)]
        return int(WIDTH) + max((needed(child) - 1 for child in inner), default=0)

    return needed(0)


@pytest.mark.parametrize("mesh", [soup(1, 0), soup(300, 2), ball(0.1, 3), staircase(60)])
def test_the_needed_stack_is_that_of_a_recursion(mesh: TriangleMesh):
    assert needed_stack(build_levels(mesh)[1]) == stack_of(mesh)


def test_a_tree_too_deep_for_the_stack_is_balanced(monkeypatch: pytest.MonkeyPatch):
    mesh = staircase(60)
    assert needed_stack(build_levels(mesh)[1]) > 50
    monkeypatch.setattr(wide_bvh, "STACK_SIZE", 20)
    assert needed_stack(build_levels(mesh)[1]) <= 20
    monkeypatch.setattr(wide_bvh, "STACK_SIZE", 4)
    with pytest.raises(CatalogError, match="60 triangles has a BVH too deep for a stack of 4"):
        build_levels(mesh)


@pytest.mark.parametrize(
    ("extent", "tiny"),
    [*((0.1, tiny) for tiny in (0.0, 1e-45, 1e-39, 1e-37, 1e-30, 1e-20, -1e-45, -1e-39, -1e-30)), (100.0, 0.0), (100.0, 1e-39)],
)
def test_rays_almost_along_an_axis_hit(tiny: float, extent: float):
    mesh = soup(300, 1)
    scaled = TriangleMesh(mesh.vertices * np.float32(extent), mesh.faces, mesh.normals, mesh.uv)
    start, _ = rays_at(scaled, 0)
    start[:, 2] = 3.0 * extent
    direction = np.tile(np.array([tiny, -tiny, -1.0], np.float32), (RAYS, 1))
    check_against_every_triangle(scaled, start, direction)


@pytest.mark.parametrize(("half", "away", "slope"), [(1.0, 0.2, 1e-3), (0.3, 200.0, 3.0), (0.3, 0.5, 0.0)])
def test_no_hit_is_lost_by_rounding_in_boxes(half: float, away: float, slope: float):
    """A flat grid, whose boxes have no thickness: nearby the builder's MARGIN counts, far away the enlarged far end of the slab test."""
    line = np.linspace(-half, half, 17)
    x, y = np.meshgrid(line, line)
    grid = np.stack([x, y, np.zeros_like(x)], axis=-1)
    a, b, c, d = grid[:-1, :-1], grid[:-1, 1:], grid[1:, 1:], grid[1:, :-1]
    mesh = loose(np.concatenate([np.stack([a, b, c], axis=2), np.stack([a, c, d], axis=2)]).reshape(-1, 3, 3))
    rng = np.random.default_rng(0)
    target = np.concatenate([rng.uniform(-half, half, (RAYS, 2)), np.zeros((RAYS, 1))], axis=1)
    target[::2, 0] = rng.choice(line, RAYS // 2)
    direction = np.concatenate([slope * rng.normal(size=(RAYS, 2)), -np.ones((RAYS, 1))], axis=1)
    start = target - away * direction
    check_against_every_triangle(mesh, start.astype(np.float32), direction.astype(np.float32))


def check_against_every_triangle(mesh: TriangleMesh, start: np.ndarray, direction: np.ndarray):
    """Distances of hits equal the smallest of all triangles' own, by the test that leaves use; the any-hit query agrees."""
    device = pick_device(default_device())
    hit, _, blocked = run_queries([mesh], 0, (start, direction), 1e30, device, own=True)
    corners = wp.array(mesh.vertices[mesh.faces].reshape(-1, 3), dtype=wp.vec3, device=device)
    nearest = hit_every_triangle(corners, start, direction, device=device)
    assert (hit[:, 0] >= 0.0).sum() > 0.1 * len(start)
    np.testing.assert_array_equal(hit[:, 0], nearest)
    np.testing.assert_array_equal(blocked, nearest >= 0.0)


def test_a_box_of_just_more_than_the_largest_coordinate_is_quantized():
    """Its extent is a few float64 steps above 255 steps, where the logarithm is rounded down."""
    low, high, middle = np.float32([2.0376503e-06, 0.9960917, 1.0321041])
    mesh = loose(np.array([[[low, -middle, 0.5], [high, middle, 0.5], [low, middle, 0.5]]]))
    rng = np.random.default_rng(0)
    start = np.concatenate([rng.uniform(0.0, 1.0, (RAYS, 2)), np.ones((RAYS, 1))], axis=1).astype(np.float32)
    check_against_every_triangle(mesh, start, np.tile(np.float32([0.0, 0.0, -1.0]), (RAYS, 1)))


def test_queries_visit_few_nodes():
    """Nearest first, and none beyond a hit: most rays at a ball of 1,280 triangles visit about as many nodes as its tree has levels."""
    mesh, device = ball(0.1, 3), pick_device(default_device())
    bvh = build_wide_bvh([mesh], device)
    visits = visits_of(bvh, int(bvh.root.numpy()[0]), *rays_at(mesh, 0), 1e30, device=device)[:, 3]
    assert 5.0 < visits.mean() < 9.6


# ---- empty interior of the tote ----


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
