"""Suction rays: plates, edges, reach, concave objects, neighbours; bodies stay at their poses."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.files.load import load_config
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
        forces = {"good_force": GOOD, "poor_force": POOR}
        filled(self.scene.suction, {"rays": RAYS, "radius": RADIUS, "reach": REACH, "tolerated_misses": 0, **forces, **suction})
        meshes, keep = build_meshes([entry.mesh for entry in objects.entries], len(objects), device)
        config = config or load_config("smoke", {"suction.surface": surface})
        self.suction = SuctionHold(config.suction, objects, SimpleNamespace(meshes=meshes, keep=keep), device)
        self.begin(Phase.ACT)
        # Slots in an order of their own.
        self.put(catalog_index=-1, body_slot=[2, 0, 3, 1], task=Task.PRESS, steps=PRESS_STEPS)
        for world in range(worlds):
            self.put_cup(world, PLACE, UPRIGHT)

    def put_cup(self, world: int, tcp, quaternion) -> None:
        """Place a cup by its TCP [m]."""
        body_q = self["body_q"]
        origin = np.asarray(tcp) + TIP * rotation_of(np.asarray(quaternion))[:, 2]
        body_q[world * self.bodies + 1] = [*origin, *quaternion]
        self.put(body_q=body_q)

    def lay(self, world: int, instance: int, entry: int, place, quaternion=UPRIGHT) -> None:
        """Put an object somewhere."""
        entries = self["catalog_index"]
        entries[world, instance] = entry
        self.put(catalog_index=entries)
        self.place(world, instance, [*place, *quaternion])

    def cast(self) -> tuple[list[int], list[int]]:
        """Number of ray hits, and first word of the bit set of engaged instances, per world."""
        self.run(self.suction.engage)
        return self["hits"][:, 0].tolist(), self["engaged_words"][:, 0].tolist()

    def attached(self) -> list[list[int]]:
        return self["attached"].tolist()


def below(distance: float) -> np.ndarray:
    """Centre of a plate whose upper side is so far below the tcp."""
    return PLACE - [0.0, 0.0, distance + THICKNESS / 2]


# ---- known answers ----


def test_a_plate_is_hit_by_all_rays_and_held_as_it_lies(device):
    cups = Cups(device, worlds=2)
    turned = (0.0, 0.0, np.sin(0.3), np.cos(0.3))
    cups.lay(1, 2, 0, below(0.004), turned)
    cups.put(seal_force=3.0)
    assert cups.cast() == ([0, RAYS], [0, 0b100])
    assert cups.attached() == [[0, 0, 0, 0], [0, 0, 1, 0]]
    np.testing.assert_allclose(cups["object_in_tcp"][1, 2], [0, 0, -0.004 - THICKNESS / 2, *turned], atol=1e-6)
    assert cups["break_force"].tolist() == [[POOR], [GOOD]]
    assert cups["seal_force"][1].tolist() == [3.0, 3.0, 0.0, 3.0]


# Abscissas of the ten rays: ±1, ±0.809 and ±0.309 twice each.
@pytest.mark.parametrize(("edge", "count"), [(1.1, 10), (0.9, 9), (0.5, 7), (0.0, 5), (-0.5, 3), (-0.9, 1), (-1.1, 0)])
@pytest.mark.parametrize("tolerated", [0, 2, 3])
def test_over_an_edge_those_rays_hit_that_start_above_the_plate(device, edge, count, tolerated):
    cups = Cups(device, tolerated_misses=tolerated)
    cups.lay(0, 0, 0, below(0.01) - [0.15 - edge * RADIUS, 0.0, 0.0])
    assert cups.cast() == ([count], [int(count > 0)])
    assert cups["break_force"][0, 0] == (GOOD if RAYS - count <= tolerated else POOR)


@pytest.mark.parametrize(("distance", "count"), [(0.0299, RAYS), (0.0301, 0), (-0.002, RAYS), (-0.0099, RAYS), (-0.0101, 0)])
@pytest.mark.parametrize("quaternion", [UPRIGHT, (0.5, 0.5, 0.5, 0.5), (0.0, -0.6, 0.0, 0.8), (1.0, 0.0, 0.0, 0.0)])
def test_rays_reach_three_centimetres_from_the_tip_and_count_inside(device, distance, count, quaternion):
    """In any direction; a ray that starts inside the plate hits, one that starts behind it does not."""
    cups = Cups(device)
    axis = rotation_of(np.array(quaternion))[:, 2]
    cups.put_cup(0, PLACE, quaternion)
    cups.lay(0, 1, 0, PLACE - (distance + THICKNESS / 2) * axis, quaternion)
    assert cups.cast() == ([count], [0b10 * int(count > 0)])


def test_nothing_but_objects_is_hit(device):
    """The tcp 1 cm above the tote's floor: that is not engaged, nor does it hide what lies below it."""
    cups = Cups(device, worlds=2)
    for world in range(2):
        cups.put_cup(world, (0.0, 0.0, 0.01), UPRIGHT)
    cups.lay(1, 0, 0, (0.0, 0.0, -0.005 - THICKNESS / 2))
    assert cups.cast() == ([0, RAYS], [0, 1])
    assert cups.attached()[0] == [0, 0, 0, 0]


def test_each_ray_catches_what_is_nearest(device):
    cups = Cups(device, worlds=3)
    # One above the other; side by side; a bar on a plate.
    cups.lay(0, 1, 0, below(0.020))
    cups.lay(0, 3, 0, below(0.005))
    cups.lay(1, 0, 0, below(0.01) - [0.15 + 0.002, 0.0, 0.0])
    cups.lay(1, 3, 0, below(0.02) - [-0.15 - 0.002, 0.0, 0.0])
    cups.lay(2, 0, 0, below(0.022))
    cups.lay(2, 1, 1, PLACE - [0.0, -0.01, 0.012])
    assert cups.cast() == ([RAYS, RAYS, RAYS], [0b1000, 0b1001, 0b11])
    assert cups.attached() == [[0, 0, 0, 1], [1, 0, 0, 1], [1, 1, 0, 0]]
    assert (cups["break_force"] == GOOD).all()


# In the angle's frame: over the bar, the arm, the notch, the arm's edge, and the notch's corner, into whose quarter three rays fall.
@pytest.mark.parametrize(
    ("x", "y", "count"), [(0.03, 0.0, 10), (-0.03, 0.05, 10), (0.02, 0.045, 0), (-0.015, 0.045, 5), (-0.015, 0.016, 7)]
)
def test_the_notch_of_an_angle_is_open(device, x, y, count):
    """The bar is 9 cm x 3 cm about the origin; the arm, 3 cm x 6 cm, stands beside it at x < -1.5 cm."""
    cups = Cups(device)
    cups.lay(0, 0, 2, PLACE - [x, y, 0.015 + 0.005])
    assert cups.cast()[0] == [count]


@pytest.mark.parametrize(
    ("phase", "task", "steps"),
    [(Phase.SETTLE, Task.PRESS, 5), (Phase.ACT, Task.DESCEND, 5), (Phase.ACT, Task.LIFT, 9), (Phase.ACT, Task.PRESS, 4)],
)
def test_rays_are_cast_when_the_time_to_press_is_up(device, phase, task, steps):
    cups = Cups(device, worlds=2)
    for world in range(2):
        cups.lay(world, 0, 0, below(0.001))
    cups.put(phase=[phase, Phase.ACT], task=[task, Task.PRESS], steps=[steps, PRESS_STEPS], hits=7, engaged_words=7, break_force=7)
    assert cups.cast() == ([7, RAYS], [7, 1])
    assert cups.attached() == [[0, 0, 0, 0], [1, 0, 0, 0]]
    assert cups["break_force"].tolist() == [[7.0], [GOOD]]


def test_meshes_are_hit_from_both_sides(device):
    """Of a bar, as a mesh, a ray that starts inside hits where it leaves; further than it reaches, it hits nothing."""
    for surface, expected in (("hull", [RAYS, RAYS, RAYS]), ("mesh", [RAYS, RAYS, 0])):
        cups = Cups(device, worlds=3, surface=surface)
        cups.lay(0, 0, 0, below(0.01))
        cups.lay(1, 0, 1, PLACE)
        # Upright, the bar is 20 cm high.
        cups.lay(2, 0, 1, PLACE, (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)))
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
        cups.lay(0, instance, index, poses[instance, :3], poses[instance, 3:])
    pose = cups["body_q"][1].astype(np.float64)
    starts, way = twin.ray_starts(pose, rays, 0.02, TIP)
    hits, engaged = twin.engage(entries, poses, starts, way, REACH)
    assert cups.cast() == ([hits], [engaged])
    assert cups.attached() == [[engaged >> instance & 1 for instance in range(4)]]


# ---- several cups ----

ARM = 0.04
SQUARE = [[ARM, ARM], [-ARM, ARM], [-ARM, -ARM], [ARM, -ARM]]


@pytest.mark.parametrize(("valve", "sealed"), [(0, 0b0110), (1, 0)])
def test_one_leaking_cup_spoils_a_common_valve_alone(device, valve, sealed):
    """The plate ends half a ring's radius beyond the middle of cups 0 and 3; seven of their ten rays hit."""
    cups = Cups(device, cups=SQUARE)
    cups.scene.cups.common_valve = valve
    cups.lay(0, 2, 0, below(0.01) - [0.15 - ARM - 0.005, 0.0, 0.0])
    assert cups.cast() == ([2 * RAYS + 14], [0b100])
    assert cups["hits"][0, 1] == sealed
    assert cups.attached() == [[0, 0, 0b1111, 0]]
    assert cups["break_force"][0].tolist() == [GOOD if sealed >> cup & 1 else POOR for cup in range(4)]


def test_each_cup_holds_what_is_under_it(device):
    """One plate under cups 1 and 2, another under 0 and 3; the tool turned by a quarter lies across both."""
    cups = Cups(device, worlds=2, cups=SQUARE)
    for world in range(2):
        cups.lay(world, 0, 0, below(0.01) - [0.15 + 0.002, 0.0, 0.0])
        cups.lay(world, 3, 0, below(0.01) - [-0.15 - 0.002, 0.0, 0.0])
    half = np.sqrt(0.5)
    cups.put_cup(1, PLACE, (0.0, 0.0, half, half))
    assert cups.cast() == ([4 * RAYS] * 2, [0b1001] * 2)
    assert cups.attached() == [[0b0110, 0, 0, 0b1001], [0b0011, 0, 0, 0b1100]]
