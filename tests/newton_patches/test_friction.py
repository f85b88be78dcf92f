"""Friction rows of a contact: Newton's method on the secular equation against a bisection of it in double precision."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.kernels.newton_patches.friction import solve_friction
from tests.harness.probe import probe


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


def test_a_contact_that_sticks_has_no_velocity_left(device):
    """Analytic: residual 0 after the impulse; half of it with a relaxation of 0.5."""
    matrices = np.tile(np.diag((2.0, 4.0)), (1, 1, 1))
    residual, old, radius = np.array([[0.02, 0.04]]), np.array([[0.001, 0.002]]), np.array([1.0])
    np.testing.assert_allclose(solve(matrices, residual, old, radius, device), [[0.001 - 0.01, 0.002 - 0.01]], rtol=1e-6)
    np.testing.assert_allclose(solve(matrices, residual, old, radius, device, 0.5), [[0.001 - 0.005, 0.002 - 0.005]], rtol=1e-6)


def test_isotropic_friction_opposes_the_velocity(device):
    """Analytic: with equal eigenvalues and no old impulse, the impulse is -r times the direction of the residual."""
    matrices, residual, radius = np.eye(2)[None] * 3.0, np.array([[0.6, -0.8]]), np.array([0.01])
    np.testing.assert_allclose(solve(matrices, residual, np.zeros((1, 2)), radius, device), [[-0.006, 0.008]], rtol=1e-5)


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


def test_bodies_that_move_in_one_direction_or_none(device):
    """Singular matrices, analytic: a row without response keeps its impulse within the disk, and a residual there pushes to its edge."""
    matrices = np.array([np.diag((1.0, 0.0))] * 3 + [np.zeros((2, 2))])
    residual = np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 1.0], [0.3, 0.4]])
    old = np.array([[0.5, 0.25], [0.5, 2.0], [0.6, 0.0], [0.1, 0.1]])
    found = solve(matrices, residual, old, np.ones(4), device)
    np.testing.assert_allclose(found[0], (0.5, 0.25), rtol=1e-6)
    np.testing.assert_allclose(found[1], (0.5, np.sqrt(0.75)), rtol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(found[1:3], axis=1), 1.0, rtol=1e-5)
    assert found[2][1] < 0.0
    assert (found[3] == 0.0).all()


@given(st.lists(st.floats(-1.0, 1.0, width=32), min_size=4, max_size=4), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0))
def test_impulses_stay_finite_within_the_circle(numbers, largest, ratio, radius):
    """Also for matrices whose eigenvalues are zero, as of a body that cannot move in a direction."""
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    matrix = turn @ np.diag((largest, largest * ratio)) @ turn.T
    found = solve(matrix[None], np.array([numbers[:2]]), np.array([numbers[2:]]), np.array([radius]), "cpu")
    assert np.isfinite(found).all()
    assert np.linalg.norm(found) <= radius * (1.0 + 1e-5)
