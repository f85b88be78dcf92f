"""Contacts: matching, in which one without a partner takes the nearest one left; manifolds; friction; and the order of patches."""

import re

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.configs.schema import Config, Physics
from synpick_warp.kernels.newton_patches import contact_matching as kernels
from synpick_warp.kernels.newton_patches.friction import solve_friction
from synpick_warp.kernels.newton_patches.friction_patches import sort_contacts_kernel
from synpick_warp.kernels.newton_patches.hull_support import find_farthest
from synpick_warp.newton_patches.narrow_phase import BLOCK, MAX_DISTANCE, _narrow_kernels, sort_pairs
from synpick_warp.scenes.collision.hulls import hull_planes
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece
from synpick_warp.stages.sim import physics
from tests.harness.probe import probe

PAIR_BITS = 3
"""Low bits of the keys of the tables below."""
NEAR, FAR = 1e-3, 2 * MAX_DISTANCE
SLIP = 5e-6
"""Motion of a box in a substep [m]."""
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
LAST = [(1, 0.0, UP), (1, 0.0, UP), (1, FAR, UP), (2, 0.0, UP), (2, NEAR, DOWN)]
"""Contacts of the last substep: pair of shapes, place along an axis [m], normal."""


def complete(device, contacts: list[tuple[int, float, tuple]], match: list[int]) -> list[int]:
    """Matches of contacts as of LAST after the kernel, which begins with `match`."""

    def keys(rows):
        return wp.array([(pair << PAIR_BITS) + index % 8 for index, (pair, _, _) in enumerate(rows)], dtype=wp.int64, device=device)

    def vectors(values):
        return wp.array(np.array(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device)

    def places(rows):
        return [(place, 0.0, 0.0) for _, place, _ in rows]

    history = kernels.ContactHistory()
    history.count, history.key = wp.array([len(LAST)], dtype=int, device=device), keys(LAST)
    history.position, history.normal = vectors(places(LAST)), vectors([normal for _, _, normal in LAST])
    history.pair_bits = wp.int64((1 << PAIR_BITS) - 1)
    shapes, body_q = wp.zeros(len(contacts), dtype=int, device=device), wp.zeros(1, dtype=wp.transform, device=device)
    points = vectors(places(contacts))
    matches = wp.array(match, dtype=int, device=device)
    inputs = [wp.array([-1], dtype=int, device=device), MAX_DISTANCE, 0.995, history, body_q]
    inputs += [wp.array([len(contacts)], dtype=int, device=device), keys(contacts), shapes, shapes, points, points]
    inputs.append(vectors([normal for _, _, normal in contacts]))
    wp.launch(kernels.complete_matching_kernel, dim=len(contacts) + 2, inputs=inputs, outputs=[matches], device=device)
    return matches.numpy().tolist()


@pytest.mark.parametrize(("count", "bits"), [(0, 1), (1, 1), (33, 3), (700, 40), (1000, 4)])
def test_contacts_sorted_by_ranks_are_in_the_order_of_a_stable_sort(device, count, bits):
    """Random keys with duplicates, followed by unused slots; known: the orders of NumPy's stable sort and of Warp's radix sort."""
    capacity = 1000
    random = np.full(2 * capacity, int(UNUSED))
    random[:count] = np.random.default_rng(count).integers(0, 1 << bits, count)
    order = np.argsort(random[:count], kind="stable")
    for is_ranked in (True, False):
        keys = wp.array(random, dtype=wp.int64, device=device)
        indices = wp.array(np.r_[:capacity, :capacity], dtype=int, device=device)
        keys.is_ranked = is_ranked
        sort_pairs(keys, indices, capacity, end_bit=63)
        np.testing.assert_array_equal(keys.numpy()[:capacity], np.sort(random[:capacity]))
        np.testing.assert_array_equal(indices.numpy()[:count], order)


farthest = probe(find_farthest)


@pytest.mark.parametrize("first", [0, 1])
@pytest.mark.parametrize("count", [1, 3, 4, 5, 7, 8, 11, 12, 64, 67])
def test_the_support_of_a_hull_is_its_first_farthest_vertex(device, count, first):
    """Points of a grid, many of which are equally far in a direction along an axis; known: NumPy's first maximum. Points behind another one
    in memory are not aligned for wide loads."""
    random = np.random.default_rng(count)
    points = random.integers(-2, 3, (first + count, 3)).astype(np.float32)
    vertices = wp.array(points, dtype=wp.vec3, device=device)[first:]
    mesh = wp.Mesh(vertices, wp.zeros(3, dtype=int, device=device))
    directions = np.concatenate((np.eye(3), -np.eye(3), random.integers(-2, 3, (20, 3)))).astype(np.float32)
    packed = np.tile(np.array([mesh.id >> shift & 0x3FFFFF for shift in (0, 22, 44)], np.float32), (len(directions), 1))
    np.testing.assert_array_equal(farthest(packed, directions, device=device), points[first:][np.argmax(directions @ points[first:].T, 1)])


def test_few_pairs_of_shapes_are_tested_by_a_thread_of_each_warp():
    """Kernels of GJK, its refinement and manifolds, whose source code is Newton's but for the first pair of a thread."""
    threads, warps, found = 4096, 4096 // BLOCK, 0
    for kernel, _ in _narrow_kernels(True):
        for first in re.findall(r"(?:first = |range\()(tid % [^,\n]*)", kernel.adj.source):
            pairs = eval(first, {"tid": np.arange(threads), "total_num_threads": threads})
            np.testing.assert_array_equal(np.sort(pairs), np.arange(threads))
            np.testing.assert_array_equal(np.argsort(pairs)[:warps] // BLOCK, np.arange(warps))
            found += 1
    assert found == 3


@pytest.mark.parametrize(
    ("contacts", "match", "expected"),
    [
        ([(1, 0.0, UP), (1, 0.0, UP)], [0, -2], [0, 1]),
        ([(1, 0.0, UP), (1, 0.0, UP)], [-2, 0], [1, 0]),
        ([(1, 0.0, UP), (1, 0.0, UP), (1, 0.0, UP)], [0, -2, -2], [0, 1, -2]),
        ([(1, FAR - NEAR, UP)], [-2], [2]),
        ([(1, FAR + MAX_DISTANCE + NEAR, UP)], [-2], [-2]),
        ([(2, NEAR, UP), (2, NEAR, DOWN)], [-2, -2], [3, 4]),
        ([(2, 0.0, UP), (2, NEAR, UP)], [3, -2], [3, -2]),
        ([(0, 0.0, UP), (3, 0.0, UP)], [-2, -2], [-2, -2]),
        ([(1, 0.0, UP), (1, 0.0, UP)], [-1, -1], [-1, -1]),
    ],
    ids=["second", "first", "none left", "nearest", "too far", "normals", "none aligned", "other pairs", "new pairs"],
)
def test_a_contact_without_a_partner_gets_the_nearest_one_left(contacts, match, expected, device):
    assert complete(device, contacts, match) == expected


def collider(device, add, settings: Physics) -> tuple[newton.State, newton.CollisionPipeline]:
    """A model of the shapes that `add` gives to a builder, with its state and collision pipeline."""
    builder = newton.ModelBuilder()
    add(builder, builder.ShapeConfig(gap=Config().physics.gap))
    model = builder.finalize(device)
    state = model.state()
    newton.eval_fk(model, model.joint_q, model.joint_qd, state)
    return state, physics.make_pipeline(settings, model)


@pytest.mark.parametrize("matches_all", [False, True])
def test_an_edge_on_a_face_keeps_its_impulses(matches_all, device):
    """Newton writes the end of an edge twice, and leaves one of the two without a partner as soon as it moves by micrometres."""
    turn = Rotation.from_euler("yx", (1.0, 30.0), degrees=True)
    corners = np.stack(np.meshgrid(*[(-0.5, 0.5)] * 3), axis=-1).reshape(-1, 3) * (0.08, 0.06, 0.03)
    lowest = float(turn.apply(corners)[:, 2].min())

    def add(builder, shape) -> None:
        body = builder.add_body(xform=wp.transform(wp.vec3(0.0, 0.0, -lowest), wp.quat(*turn.as_quat().tolist())))
        mesh = newton.Mesh.create_box(0.04, 0.03, 0.015, compute_inertia=False)
        builder.add_shape_convex_hull(body, mesh=mesh, cfg=shape)
        builder.add_shape_box(-1, xform=wp.transform(wp.vec3(0.0, 0.0, -0.1), wp.quat_identity()), hx=0.2, hy=0.2, hz=0.1, cfg=shape)

    state, pipeline = collider(device, add, Physics(match_all=matches_all))
    contacts = pipeline.contacts()
    for slip in (0.0, SLIP):
        pose = state.body_q.numpy()
        pose[0, 0] += slip
        state.body_q.assign(pose)
        pipeline.collide(state, contacts)
    count = int(contacts.rigid_contact_count.numpy()[0])
    match = contacts.rigid_contact_match_index.numpy()[:count]
    assert count == 3
    assert sorted(match) == ([0, 1, 2] if matches_all else [-2, *sorted(match[match >= 0])])


# ---- manifolds: how one scanned box lies on another ----

LOWER, UPPER = (0.3, 0.3, 0.05), (0.1, 0.15, 0.05)
"""Extents of the boxes [m]."""
ROUGHNESS = 2e-4
"""Largest error of a point of a scan in each coordinate [m]."""


def scan_box(size: tuple[float, float, float], rng: np.random.Generator) -> ConvexPiece:
    """Collision shape of noisy points on the sides of a box about the origin."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), axis=-1).reshape(-1, 3)
    points = grid[np.abs(grid).max(axis=1) == 0.5] * size
    return simplify_hull(points + rng.uniform(-ROUGHNESS, ROUGHNESS, points.shape), 64)


def lay_side(piece: ConvexPiece, side: float) -> wp.transform:
    """Pose in which the side of a piece that faces up (side 1) or down (-1) lies in the plane z = 0."""
    planes = hull_planes(piece)
    plane = planes[(side * planes[:, 2]).argmax()]
    turn = Rotation.align_vectors([[0.0, 0.0, side]], plane[None, :3])[0]
    return wp.transform(wp.vec3(0.0, 0.0, -side * float(plane[3])), wp.quat(*turn.as_quat().tolist()))


@pytest.mark.parametrize("seed", range(8))
def test_a_scanned_box_lies_on_another_on_the_corners_of_its_side(device, seed):
    """Were the sides not planar, a single contact would jump from vertex to vertex as the upper box rocks."""
    rng = np.random.default_rng(seed)
    lower, upper = scan_box(LOWER, rng), scan_box(UPPER, rng)

    def add(builder, shape) -> None:
        for piece, side, body in ((lower, 1.0, -1), (upper, -1.0, builder.add_body(xform=lay_side(upper, -1.0)))):
            mesh = newton.Mesh(piece.vertices, piece.faces.reshape(-1), compute_inertia=False)
            builder.add_shape_convex_hull(body, xform=lay_side(piece, side) if body < 0 else None, mesh=mesh, cfg=shape)

    state, pipeline = collider(device, add, Config().physics)
    contacts = pipeline.contacts()
    pipeline.collide(state, contacts)
    count = int(contacts.rigid_contact_count.numpy()[0])
    assert 3 <= count <= 4
    corners = 0.5 * (contacts.rigid_contact_point0.numpy()[:count] + contacts.rigid_contact_point1.numpy()[:count])
    assert (np.ptp(corners[:, :2], axis=0) > 0.9 * np.array(UPPER[:2])).all()


# ---- friction rows: Newton's method on the secular equation against a bisection of it in double precision ----


@wp.func
def solve_rows(scale: float, values: wp.vec2, axis: wp.vec2, residual: wp.vec2, old: wp.vec2, radius: float, relaxation: float):
    return solve_friction(scale, values[0], values[1], axis, residual, old, radius, relaxation)


probe_rows = probe(solve_rows)


def solve(matrices, residual, old, radius, device, relaxation: float = 1.0) -> np.ndarray:
    """Solve the friction rows of a batch of contacts; returns impulses (contact, 2).

    Takes Delassus matrices (contact, 2, 2), residuals and old impulses (contact, 2), and radii of the disks (contact).
    """
    values, vectors = np.linalg.eigh(matrices)
    scale = np.maximum(np.maximum(matrices[:, 0, 0], matrices[:, 1, 1]), 1e-20)
    return probe_rows(scale, values[:, ::-1] / scale[:, None], vectors[:, :, 1], residual, old, radius, relaxation, device=device)


def bisect(matrices: np.ndarray, residual: np.ndarray, old: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Minimizers (contact, 2) of ½ xᵀA x - bᵀx within disks, with b = A old - residual, by bisection in double precision."""

    def solved(shift: np.ndarray) -> np.ndarray:
        return np.linalg.solve(matrices + shift[:, None, None] * np.eye(2), b[..., None])[..., 0]

    b = (matrices @ old[..., None])[..., 0] - residual
    low, high = np.zeros(len(radius)), np.linalg.norm(b, axis=1) / radius
    for _ in range(200):
        middle = (low + high) / 2.0
        outside = np.linalg.norm(solved(middle), axis=1) > radius
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    free = solved(np.zeros(len(radius)))
    return np.where(np.linalg.norm(free, axis=1, keepdims=True) <= radius[:, None], free, solved(high))


def random_contacts(count: int, condition: float, seed: int = 1):
    """Matrices of largest eigenvalues of 0.5 to 50 /kg and ratios up to `condition`, residuals of scales 1e-5 to 1 m/s, old impulses
    within the disks."""
    random = np.random.default_rng(seed)
    angle = random.uniform(0.0, np.pi, count)
    vectors = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], -1).reshape(-1, 2, 2)
    largest = np.exp(random.uniform(np.log(0.5), np.log(50.0), count))
    values = np.stack([largest, largest / np.exp(random.uniform(0.0, np.log(condition), count))], -1)
    matrices = np.einsum("nij,nj,nkj->nik", vectors, values, vectors)
    radius = np.exp(random.uniform(np.log(1e-5), np.log(1e-2), count))
    old = random.normal(size=(count, 2))
    old *= (radius * random.random(count) / np.linalg.norm(old, axis=1))[:, None]
    residual = random.normal(size=(count, 2)) * np.exp(random.uniform(np.log(1e-5), 0.0, count))[:, None]
    return matrices, residual, old, radius


@pytest.mark.parametrize("condition", [1.0, 5.0, 1000.0])
def test_impulses_are_those_of_a_bisection(device, condition):
    contacts = random_contacts(3000, condition)
    found = solve(*contacts, device)
    expected = bisect(*contacts)
    error = np.linalg.norm(found - expected, axis=1) / contacts[3]
    slides = np.linalg.norm(expected, axis=1) > 0.999 * contacts[3]
    assert 0.2 < slides.mean() < 0.95
    assert np.quantile(error, 0.99) < 5e-6
    assert error.max() < 5e-5


def test_an_impulse_in_equilibrium_stays(device):
    """Solved again with the residual of its own solution, an impulse changes by the tolerance at most."""
    matrices, residual, old, radius = random_contacts(2000, 20.0, seed=2)
    first = solve(matrices, residual, old, radius, device).astype(float)
    after = residual + np.einsum("nij,nj->ni", matrices, first - old)
    second = solve(matrices, after, first, radius, device)
    assert (np.linalg.norm(second - first, axis=1) / radius).max() < 2e-5


def test_without_load_there_is_no_friction(device):
    matrices, residual, old, _ = random_contacts(50, 5.0)
    assert (solve(matrices, residual, old, np.zeros(50), device) == 0.0).all()
    assert (solve(matrices, residual, old, np.full(50, -1.0), device) == 0.0).all()


def test_an_old_impulse_may_be_far_outside_the_disk(device):
    """As after the load of a contact fell to a thousandth."""
    matrices, residual, old, radius = random_contacts(2000, 20.0, seed=3)
    old *= 1000.0
    found = solve(matrices, residual, old, radius, device)
    expected = bisect(matrices, residual, old, radius)
    assert (np.linalg.norm(found - expected, axis=1) / radius).max() < 1e-3


def test_sliding_impulses_satisfy_the_optimality_conditions(device):
    """A x - b = -α x with α >= 0, as Karush, Kuhn and Tucker say."""
    matrices, residual, old, radius = random_contacts(2000, 20.0, seed=4)
    found = solve(matrices, residual, old, radius, device).astype(float)
    slides = np.linalg.norm(found, axis=1) > 0.99999 * radius
    velocity = (residual + np.einsum("nij,nj->ni", matrices, found - old))[slides]
    x = found[slides] / radius[slides, None]
    size = np.linalg.norm(residual, axis=1) + np.linalg.norm(matrices, axis=(1, 2)) * radius
    across = velocity[:, 0] * x[:, 1] - velocity[:, 1] * x[:, 0]
    assert (np.abs(across) / size[slides]).max() < 1e-4
    assert ((velocity * x).sum(1) / size[slides]).max() < 1e-5


def test_over_relaxation_is_clipped_to_the_disk(device):
    contacts = random_contacts(2000, 5.0, seed=5)
    exact, relaxed = solve(*contacts, device).astype(float), solve(*contacts, device, 1.5)
    expected = contacts[2] + 1.5 * (exact - contacts[2])
    expected *= np.minimum(1.0, contacts[3] / np.linalg.norm(expected, axis=1))[:, None]
    assert (np.linalg.norm(relaxed - expected, axis=1) / contacts[3]).max() < 1e-4


STICKS = (np.diag((2.0, 4.0)), (0.02, 0.04), (0.001, 0.002), 1.0)
SLIDES = (3.0 * np.eye(2), (0.6, -0.8), (0.0, 0.0), 0.01)
ONE_ROW, NONE = np.diag((1.0, 0.0)), np.zeros((2, 2))


@pytest.mark.parametrize(
    ("contact", "relaxation", "expected", "tolerance"),
    [
        (STICKS, 1.0, (0.001 - 0.01, 0.002 - 0.01), 1e-6),
        (STICKS, 0.5, (0.001 - 0.005, 0.002 - 0.005), 1e-6),
        (SLIDES, 1.0, (-0.006, 0.008), 1e-5),
        ((ONE_ROW, (0.0, 0.0), (0.5, 0.25), 1.0), 1.0, (0.5, 0.25), 1e-6),
        ((ONE_ROW, (0.0, 0.0), (0.5, 2.0), 1.0), 1.0, (0.5, np.sqrt(0.75)), 1e-5),
        ((NONE, (0.3, 0.4), (0.1, 0.1), 1.0), 1.0, (0.0, 0.0), 0.0),
    ],
    ids=["sticks", "half", "slides", "no response", "no response beyond the disk", "no body moves"],
)
def test_known_impulses(device, contact, relaxation, expected, tolerance):
    """Analytic: a contact that sticks has no velocity left; with equal eigenvalues the impulse opposes the residual; a row without
    response keeps its impulse within the disk."""
    np.testing.assert_allclose(solve(*(np.array([part]) for part in contact), device, relaxation), [expected], rtol=tolerance)


def test_a_residual_without_response_pushes_to_the_edge_of_the_disk(device):
    (found,) = solve(ONE_ROW[None], np.array([[0.0, 1.0]]), np.array([[0.6, 0.0]]), np.ones(1), device)
    assert np.linalg.norm(found) == pytest.approx(1.0, rel=1e-5)
    assert found[1] < 0.0


@given(st.lists(st.floats(-1.0, 1.0, width=32), min_size=4, max_size=4), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_impulses_stay_finite_within_the_circle(numbers, largest, ratio, radius):
    """Also for matrices whose eigenvalues are zero, as of a body that cannot move in a direction."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    matrix = turn @ np.diag((largest, largest * ratio)) @ turn.T
    found = solve(matrix[None], np.array([numbers[:2]]), np.array([numbers[2:]]), np.array([radius]), "cpu")
    assert np.isfinite(found).all()
    assert np.linalg.norm(found) <= radius * (1.0 + 1e-5)


# ---- friction patches: their order is that of Newton's sort ----

WORLDS, BODIES, CAPACITY = 5, 7, 512
UNUSED = 0x7FFFFFFFFFFFFFFF


@pytest.mark.parametrize("count", [0, 1, 300, CAPACITY])
def test_contacts_are_sorted_as_by_a_stable_sort(device, count):
    """Keys of random pairs of bodies, grouped by worlds, one of which has none; the rest of the array is unused."""
    random = np.random.default_rng(count)
    world = np.sort(random.choice([0, 1, 3, 4], count))
    first = world * BODIES + random.integers(0, BODIES, count) + 1
    keys = np.full(2 * CAPACITY, UNUSED)
    keys[:count] = (first << 32) | (first + random.integers(1, 60, count))
    found = wp.array(keys, dtype=wp.int64, device=device)
    order = wp.array(np.arange(2 * CAPACITY), dtype=wp.int32, device=device)
    block = 64 if device.is_cuda else 1
    wp.launch_tiled(sort_contacts_kernel, dim=[WORLDS], inputs=[BODIES, found, order], block_dim=block, device=device)
    expected = np.argsort(keys[:CAPACITY], kind="stable")
    np.testing.assert_array_equal(order.numpy()[:CAPACITY], expected)
    np.testing.assert_array_equal(found.numpy()[:CAPACITY], keys[expected])
