"""The cup's rays and seals in NumPy, from the laws in the kernels' docstrings: triangle by triangle, and by whole matrices; and the
gripper's corners, setpoint and force, from those of kernels.sim.gripper."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np

from synpick_warp.codes import Stream
from synpick_warp.scenes.types import CatalogEntry, ConvexPiece
from tests.twins import rng
from tests.twins.raycast import first_hit, rotation_of


def ray_starts(cup: np.ndarray, rays: int, radius: float, tcp_offset: float) -> tuple[np.ndarray, np.ndarray]:
    """Starts (ray, 3) and common direction (3) in the world, for the cup's pose (7)."""
    angle = 2 * np.pi * np.arange(rays) / rays
    local = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(rays, -tcp_offset)], axis=1)
    turn = rotation_of(cup[3:])
    return local @ turn.T + cup[:3], -turn[:, 2]


def is_inside(piece: ConvexPiece, point: np.ndarray) -> bool:
    """Whether a point lies behind all triangles."""
    corners = piece.vertices[piece.faces].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return bool((((point - corners[:, 0]) * normal).sum(axis=1) <= 0.0).all())


def distance(entry: CatalogEntry, pose: np.ndarray, start: np.ndarray, direction: np.ndarray) -> float:
    """From a ray's start to the object's collision shape at a pose (7) [m]: 0 inside, infinite if the ray passes it."""
    turn = rotation_of(pose[3:])
    local, local_direction = (start - pose[:3]) @ turn, direction @ turn
    if any(is_inside(piece, local) for piece in entry.pieces):
        return 0.0
    return min(first_hit(piece.vertices, piece.faces, tuple(local), tuple(local_direction)) for piece in entry.pieces)


def engage(
    entries: Sequence[CatalogEntry | None], poses: np.ndarray, starts: np.ndarray, direction: np.ndarray, reach: float
) -> tuple[int, int]:
    """Rays that hit, and objects hit as bits; entry i at pose i, None: not there."""
    hits, engaged = 0, 0
    for start in starts:
        along = [np.inf if entry is None else distance(entry, pose, start, direction) for entry, pose in zip(entries, poses, strict=True)]
        nearest = int(np.argmin(along))
        if along[nearest] <= reach:
            hits += 1
            engaged |= 1 << nearest
    return hits, engaged


@dataclass(frozen=True)
class Body:
    """Pose (7), linear velocity of the centre of mass and angular velocity (6), mass properties in the body's frame."""

    pose: np.ndarray
    velocity: np.ndarray
    mass: float
    inertia: np.ndarray
    center: np.ndarray

    def moment_arm(self, point: np.ndarray) -> np.ndarray:
        """From the centre of mass to a point of the world."""
        return point - self.pose[:3] - rotation_of(self.pose[3:]) @ self.center

    def motion(self, point: np.ndarray) -> np.ndarray:
        """(6, 6): from linear and angular velocity to those of the frame at a point."""
        return np.block([[np.eye(3), -_cross(self.moment_arm(point))], [np.zeros((3, 3)), np.eye(3)]])


def seal_wrenches(
    cup: Body, body: Body, object_in_tcp: np.ndarray, law: SimpleNamespace, objects: int, places: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Of each of an object's seals, by cups at `places` (cup, 2): generalized forces on the object (6) and on x, y, z and tilt of the
    gripper (4), and its seal force [N]; `objects` hang on the gripper.

    By whole 6 x 6 systems at the tool's TCP: w = K (e + h u') + D u' with u' = u - h W w, W = J M⁻¹ Jᵀ of both sides, and sums over the
    cups of their stiffness and damping.
    """
    turn, rotation = rotation_of(cup.pose[3:]), rotation_of(body.pose[3:])
    axis, wrist_axis = turn[:, 2], turn[:, 1]
    tcp = cup.pose[:3] - law.tcp_offset * axis
    grip = rotation @ rotation_of(object_in_tcp[3:]).T
    origin = body.pose[:3] - grip @ object_in_tcp[:3]
    stiffness, swing = law.twist_stiffness * np.outer(axis, axis), turn.T @ grip
    torque = -law.twist_stiffness * 2 * np.arctan2(swing[1, 0] - swing[0, 1], 1 + np.trace(swing)) * axis
    beyond = np.arccos(np.clip(swing[2, 2], -1, 1)) - law.swing_limit
    if beyond > 0:
        normal = np.cross(axis, grip[:, 2])
        normal /= np.linalg.norm(normal)
        torque -= law.swing_stiffness * beyond * normal
        stiffness = stiffness + law.swing_stiffness * np.outer(normal, normal)
    zero, one, h = np.zeros((3, 3)), np.eye(3), law.step
    gain = h * np.block([[law.stiffness * one, zero], [zero, stiffness]])
    gain += np.block([[law.damping * one, zero], [zero, law.twist_damping * one]])
    object_inverse = np.block([[one / body.mass, zero], [zero, rotation @ np.linalg.inv(body.inertia) @ rotation.T]])
    gripper_inverse = np.diag(1 / np.array([law.finger_mass + law.cup_mass] * 3 + [law.tilt_inertia]))

    def slide(point: np.ndarray) -> np.ndarray:
        """(6, 4): from the speeds of x, y, z and tilt to those of the frame at a point."""
        result = np.zeros((6, 4))
        result[:3, :3], result[:3, 3], result[3:, 3] = one, np.cross(wrist_axis, point - cup.pose[:3]), wrist_axis
        return result

    inverse_mass = body.motion(tcp) @ object_inverse @ body.motion(tcp).T + objects * slide(tcp) @ gripper_inverse @ slide(tcp).T
    relative = cup.motion(tcp) @ cup.velocity - body.motion(tcp) @ body.velocity
    arms = [turn @ (x, y, 0.0) for x, y in places]
    springs = [
        np.concatenate([law.stiffness * (tcp + r - origin - grip @ (x, y, 0.0)), torque]) for r, (x, y) in zip(arms, places, strict=True)
    ]
    shifts = [np.block([[one, -_cross(r)], [zero, one]]) for r in arms]
    whole_spring = sum(shift.T @ spring for shift, spring in zip(shifts, springs, strict=True))
    whole_gain = sum(shift.T @ gain @ shift for shift in shifts)
    whole = np.linalg.solve(np.eye(6) + h * whole_gain @ inverse_mass, whole_spring + whole_gain @ relative)
    after = relative - h * inverse_mass @ whole
    result = []
    for r, spring, shift in zip(arms, springs, shifts, strict=True):
        wrench = spring + gain @ shift @ after
        borne = wrench[:3] - min(wrench[:3] @ axis, 0.0) * axis
        result.append((body.motion(tcp + r).T @ wrench, -slide(tcp + r).T @ wrench, float(np.linalg.norm(borne))))
    return result


def _cross(v: np.ndarray) -> np.ndarray:
    """Matrix of v x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


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
    """Implicit spring-damper force F = k (g - x') - d v' with v' = v + h F / m and x' = x + h v': the solution of a linear system, with its
    norm clamped to the limit."""
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
