"""Suction rays: plates, edges, reach, concave objects, neighbours; bodies stay at their poses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.collision.hulls import hull_planes
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.render.scene import build_meshes
from synpick_warp.stages.sim.suction import SuctionHold
from tests.twins import suction as twin
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import KernelWorlds, filled
from tests.worlds.small_worlds import ANGLE, catalog

PLATE, BAR = ((0.3, 0.3, 0.01),), ((0.2, 0.02, 0.02),)
THICKNESS = 0.01
ENTRIES = catalog(PLATE, BAR, ANGLE)
RAYS, RADIUS, REACH, TIP = 10, 0.01, 0.03, 0.055
PRESS_STEPS = 5
GOOD, POOR = 40.0, 2.0
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
# Position of the TCP.
PLACE = np.array([0.05, -0.03, 0.1])


class Cups(KernelWorlds):
    """Worlds whose cups press for long enough, with room for four objects."""

    def __init__(
        self, device, worlds: int = 1, surface: str = "hull", cups=((0.0, 0.0),), objects: Catalog = ENTRIES, config=None, **suction
    ) -> None:
        given = {"pick": {"press_steps": PRESS_STEPS}, "move": {"tcp_offset": TIP}, "cups": cups}
        compound = np.array([len(entry.pieces) > 1 for entry in objects.entries], int)
        super().__init__(device, worlds, len(compound), 4, compound=compound, **given)
        filled(
            self.scene.suction,
            {
                "rays": RAYS,
                "radius": RADIUS,
                "reach": REACH,
                "tolerated_misses": 0,
                "good_force": GOOD,
                "poor_force": POOR,
                **suction,
            },
        )
        meshes, keep = build_meshes([entry.mesh for entry in objects.entries], len(objects), device)
        config = config or load_config("smoke", {"suction.surface": surface})
        self.suction = SuctionHold(config.suction, objects, SimpleNamespace(meshes=meshes, keep=keep), device)
        self.begin(Phase.ACT)
        self.set(self.state.catalog_index, -1)
        # Slots in an order of their own.
        self.set(self.state.body_slot, [2, 0, 3, 1])
        self.set(self.attempts.task, Task.PRESS)
        self.set(self.attempts.steps, PRESS_STEPS)
        for world in range(worlds):
            self.put_cup(world, PLACE, UPRIGHT)

    def put_cup(self, world: int, tcp, quaternion) -> None:
        """Place a cup by its TCP [m]."""
        body_q = self.physics.state.body_q.numpy()
        origin = np.asarray(tcp) + TIP * rotation_of(np.asarray(quaternion))[:, 2]
        body_q[world * self.bodies + 1] = [*origin, *quaternion]
        self.physics.state.body_q.assign(body_q)

    def put(self, world: int, instance: int, entry: int, place, quaternion=UPRIGHT) -> None:
        """Put an object somewhere."""
        entries = self.state.catalog_index.numpy()
        entries[world, instance] = entry
        self.state.catalog_index.assign(entries)
        self.place(world, instance, [*place, *quaternion])

    def cast(self) -> tuple[list[int], list[int]]:
        """Number of ray hits, and first word of the bit set of engaged instances, per world."""
        self.suction.engage(self.scene, self.state, self.attempts, self.seals, self.physics)
        return self.attempts.hits.numpy()[:, 0].tolist(), self.attempts.engaged_words.numpy()[:, 0].tolist()

    def attached(self) -> list[list[int]]:
        return self.seals.attached.numpy().tolist()


def below(distance: float) -> np.ndarray:
    """Centre of a plate whose upper side is so far below the tcp."""
    return PLACE - [0.0, 0.0, distance + THICKNESS / 2]


# ---- known answers ----


def test_a_plate_is_hit_by_all_rays_and_held_as_it_lies(device):
    cups = Cups(device, worlds=2)
    turned = (0.0, 0.0, np.sin(0.3), np.cos(0.3))
    cups.put(1, 2, 0, below(0.004), turned)
    cups.set(cups.seals.seal_force, 3.0)
    assert cups.cast() == ([0, RAYS], [0, 0b100])
    assert cups.attached() == [[0, 0, 0, 0], [0, 0, 1, 0]]
    np.testing.assert_allclose(cups.seals.object_in_tcp.numpy()[1, 2], [0, 0, -0.004 - THICKNESS / 2, *turned], atol=1e-6)
    assert cups.seals.break_force.numpy().tolist() == [[POOR], [GOOD]]
    assert cups.seals.seal_force.numpy()[1].tolist() == [3.0, 3.0, 0.0, 3.0]


# Abscissas of the ten rays: ±1, ±0.809 and ±0.309 twice each.
@pytest.mark.parametrize(("edge", "count"), [(1.1, 10), (0.9, 9), (0.5, 7), (0.0, 5), (-0.5, 3), (-0.9, 1), (-1.1, 0)])
def test_over_an_edge_those_rays_hit_that_start_above_the_plate(device, edge, count):
    cups = Cups(device)
    cups.put(0, 0, 0, below(0.01) - [0.15 - edge * RADIUS, 0.0, 0.0])
    assert cups.cast() == ([count], [int(count > 0)])
    assert cups.seals.break_force.numpy()[0, 0] == (GOOD if count == RAYS else POOR)


@pytest.mark.parametrize(("tolerated", "break_force"), [(2, POOR), (3, GOOD)])
def test_so_many_misses_are_tolerated(device, tolerated, break_force):
    cups = Cups(device, tolerated_misses=tolerated)
    cups.put(0, 0, 0, below(0.01) - [0.15 - 0.5 * RADIUS, 0.0, 0.0])
    assert cups.cast()[0] == [7]
    assert cups.seals.break_force.numpy()[0, 0] == break_force


@pytest.mark.parametrize(("distance", "count"), [(0.0299, RAYS), (0.0301, 0), (-0.002, RAYS), (-0.0099, RAYS), (-0.0101, 0)])
@pytest.mark.parametrize("quaternion", [UPRIGHT, (0.5, 0.5, 0.5, 0.5), (0.0, -0.6, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0)])
def test_rays_reach_three_centimetres_from_the_tip_and_count_inside(device, distance, count, quaternion):
    """In any direction; a ray that starts inside the plate hits, one that starts behind it does not."""
    cups = Cups(device)
    axis = rotation_of(np.array(quaternion))[:, 2]
    cups.put_cup(0, PLACE, quaternion)
    cups.put(0, 1, 0, PLACE - (distance + THICKNESS / 2) * axis, quaternion)
    assert cups.cast() == ([count], [0b10 * int(count > 0)])


def test_nothing_but_objects_is_hit(device):
    """The tcp 1 cm above the tote's floor: that is not engaged, nor does it hide what lies below it."""
    cups = Cups(device, worlds=2)
    for world in range(2):
        cups.put_cup(world, (0.0, 0.0, 0.01), UPRIGHT)
    cups.put(1, 0, 0, (0.0, 0.0, -0.005 - THICKNESS / 2))
    assert cups.cast() == ([0, RAYS], [0, 1])
    assert cups.attached()[0] == [0, 0, 0, 0]


def test_each_ray_catches_what_is_nearest(device):
    cups = Cups(device, worlds=3)
    # One above the other; side by side; a bar on a plate.
    cups.put(0, 1, 0, below(0.020))
    cups.put(0, 3, 0, below(0.005))
    cups.put(1, 0, 0, below(0.01) - [0.15 + 0.002, 0.0, 0.0])
    cups.put(1, 3, 0, below(0.02) - [-0.15 - 0.002, 0.0, 0.0])
    cups.put(2, 0, 0, below(0.022))
    cups.put(2, 1, 1, PLACE - [0.0, -0.01, 0.012])
    assert cups.cast() == ([RAYS, RAYS, RAYS], [0b1000, 0b1001, 0b11])
    assert cups.attached() == [[0, 0, 0, 1], [1, 0, 0, 1], [1, 1, 0, 0]]
    assert (cups.seals.break_force.numpy() == GOOD).all()


# In the angle's frame: over the bar, the arm, the notch, the arm's edge, and the notch's corner, into whose quarter three rays fall.
@pytest.mark.parametrize(
    ("x", "y", "count"), [(0.03, 0.0, 10), (-0.03, 0.05, 10), (0.02, 0.045, 0), (-0.015, 0.045, 5), (-0.015, 0.016, 7)]
)
def test_the_notch_of_an_angle_is_open(device, x, y, count):
    """The bar is 9 cm x 3 cm about the origin; the arm, 3 cm x 6 cm, stands beside it at x < -1.5 cm."""
    cups = Cups(device)
    cups.put(0, 0, 2, PLACE - [x, y, 0.015 + 0.005])
    assert cups.cast()[0] == [count]


@pytest.mark.parametrize(
    ("phase", "task", "steps"),
    [(Phase.SETTLE, Task.PRESS, 5), (Phase.ACT, Task.DESCEND, 5), (Phase.ACT, Task.LIFT, 9), (Phase.ACT, Task.PRESS, 4)],
)
def test_rays_are_cast_when_the_time_to_press_is_up(device, phase, task, steps):
    cups = Cups(device, worlds=2)
    for world in range(2):
        cups.put(world, 0, 0, below(0.001))
    for array, value, due in (
        (cups.state.phase, phase, Phase.ACT),
        (cups.attempts.task, task, Task.PRESS),
        (cups.attempts.steps, steps, PRESS_STEPS),
    ):
        cups.set(array, [value, due])
    for array in (cups.attempts.hits, cups.attempts.engaged_words, cups.seals.break_force):
        cups.set(array, 7)
    assert cups.cast() == ([7, RAYS], [7, 1])
    assert cups.attached() == [[0, 0, 0, 0], [1, 0, 0, 0]]
    assert cups.seals.break_force.numpy().tolist() == [[7.0], [GOOD]]


def test_meshes_are_hit_from_both_sides(device):
    """Of a bar, as a mesh, a ray that starts inside hits where it leaves; further than it reaches, it hits nothing."""
    for surface, expected in (("hull", [RAYS, RAYS, RAYS]), ("mesh", [RAYS, RAYS, 0])):
        cups = Cups(device, worlds=3, surface=surface)
        cups.put(0, 0, 0, below(0.01))
        cups.put(1, 0, 1, PLACE)
        # Upright, the bar is 20 cm high.
        cups.put(2, 0, 1, PLACE, (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)))
        filled(cups.scene.suction, {"radius": 0.005})
        assert cups.cast()[0] == expected


# ---- any scene ----


@given(seed=st.integers(0, 10_000), rays=st.integers(3, 12))
@settings(max_examples=40)
def test_random_scenes_agree_with_the_twin(seed, rays, device):
    numbers = np.random.default_rng(seed)
    cups = Cups(device, rays=rays, radius=0.02)
    cup = numbers.normal(size=4)
    cup /= np.linalg.norm(cup)
    cups.put_cup(0, PLACE, cup)
    entries, poses = [None] * 4, np.zeros((4, 7))
    for instance in numbers.permutation(4)[: numbers.integers(1, 5)]:
        index, turn = int(numbers.integers(3)), numbers.normal(size=4)
        poses[instance] = [*(PLACE + numbers.normal(scale=0.05, size=3)), *(turn / np.linalg.norm(turn))]
        entries[instance] = ENTRIES.entries[index]
        cups.put(0, instance, index, poses[instance, :3], poses[instance, 3:])
    pose = cups.physics.state.body_q.numpy()[1].astype(np.float64)
    starts, way = twin.ray_starts(pose, rays, 0.02, TIP)
    hits, engaged = twin.engage(entries, poses, starts, way, REACH)
    assert cups.cast() == ([hits], [engaged])
    assert cups.attached() == [[engaged >> instance & 1 for instance in range(4)]]


def test_planes_hold_the_vertices_of_their_piece():
    """A box has six; every vertex lies on at least three and outside of none."""
    for piece in ENTRIES.entries[2].pieces:
        planes = hull_planes(piece)
        assert planes.shape == (6, 4)
        np.testing.assert_allclose(np.linalg.norm(planes[:, :3], axis=1), 1.0)
        height = piece.vertices.astype(np.float64) @ planes[:, :3].T - planes[:, 3]
        assert height.max() < 1e-8
        assert ((np.abs(height) < 1e-8).sum(axis=1) >= 3).all()
