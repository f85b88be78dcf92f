"""The gripper's corners, setpoint and force, in NumPy, from the laws in kernels.sim.gripper's docstrings."""

from __future__ import annotations

import numpy as np

from synpick_warp.codes import Stream
from tests.twins import rng


def corner_order(seed: int, episode: int, arrangement: int, rounds: int) -> list[int]:
    """A Fisher-Yates shuffle of the four corners for each round."""
    key = rng.stream_key(seed, episode, arrangement, Stream.CORNERS)
    order: list[int] = []
    for visit in range(4 * rounds):
        if visit % 4 == 0:
            order += [0, 1, 2, 3]
        other = visit + int(rng.uniform_index(key, visit, 4 - visit % 4))
        order[visit], order[other] = order[other], order[visit]
    return order


def corner_place(code: int, corner: np.ndarray) -> np.ndarray:
    """Bit 0 of the code is the sign of x, bit 1 that of y."""
    return corner * np.where([code & 1, code & 2, 0], -1.0, 1.0)


def force(offset, velocity, stiffness: float, damping: float, limit: float, mass: float, step: float) -> np.ndarray:
    """k (g - x') - d v' with v' = v + h F / m and x' = x + h v', solved for F by a linear system; its length is at most the limit."""
    # Unknowns F and v': F + (k h + d) v' = k (g - x), v' - h F / m = v.
    matrix = np.array([[1.0, stiffness * step + damping], [-step / mass, 1.0]])
    free = np.linalg.solve(matrix, np.stack([stiffness * np.asarray(offset, float), np.asarray(velocity, float)]))[0]
    size = np.linalg.norm(free)
    return free * min(1.0, limit / size) if size > 0 else free


def step_response(time: np.ndarray, stiffness: float, damping: float, mass: float) -> np.ndarray:
    """Position of m x'' = k (1 - x) - d x' from rest at 0: the analytic solution, any damping."""
    roots = np.roots([mass, damping, stiffness]).astype(complex)
    if np.isclose(roots[0], roots[1]):
        return (1 - (1 - roots[0] * time) * np.exp(roots[0] * time)).real
    # x = 1 + a exp(r0 t) + b exp(r1 t) with x(0) = 0, x'(0) = 0.
    a, b = roots[1] / (roots[0] - roots[1]), -roots[0] / (roots[0] - roots[1])
    return (1 + a * np.exp(roots[0] * time) + b * np.exp(roots[1] * time)).real


def stepped_response(steps: int, stiffness: float, damping: float, mass: float, step: float, substeps: int) -> np.ndarray:
    """The same, as it is simulated: the force is held for a step, in which speed, then position, take `substeps` Euler steps."""
    position = velocity = 0.0
    positions = []
    for _ in range(steps):
        acceleration = force([1.0 - position], [velocity], stiffness, damping, np.inf, mass, step)[0] / mass
        for _ in range(substeps):
            velocity += step / substeps * acceleration
            position += step / substeps * velocity
        positions.append(position)
    return np.array(positions)
