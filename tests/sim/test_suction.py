"""Suction rays: plates, edges, reach, concave objects, neighbours; bodies stay at their poses. Vacuum of a cup on plates, rings, gratings,
pins, balls and blocks: the force that it holds follows from geometry, and so does what is lifted."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from trimesh.creation import annulus, box, cylinder, icosphere

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.render.scene import build_meshes
from synpick_warp.stages.sim.behavior import SuctionHold
from tests.twins import suction as twin
from tests.twins.raycast import rotation_of
from tests.worlds.hanging import Hanging
from tests.worlds.kernel_worlds import KernelWorlds, filled
from tests.worlds.small_worlds import ANGLE, catalog, solid

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


# ---- forces of a vacuum ----

PARTS = Path(__file__).parents[1] / "cases/parts/suction_default_porous"
PRESSURE = 60e3
CUPS = (0.005, 0.022, 0.042, 0.06)
"""Diameters [m]."""
ORIFICE = 0.62 * math.sqrt(2 * PRESSURE / 1.2) / (40e-3 / 60)
"""Flow of a leak of 1 m² relative to that of the ejector."""


def lying(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    return mesh.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, (1, 0, 0)))


def grating(bar: float, gap: float) -> trimesh.Trimesh:
    return trimesh.util.concatenate([box((bar, 0.2, 0.004)).apply_translation((index * (bar + gap), 0, 0)) for index in range(-9, 10)])


def full(cup: float) -> float:
    """Force of a tight cup [N]."""
    return PRESSURE * math.pi * cup**2 / 4


def held(cup: float, area: float) -> float:
    """Force of a cup with a hole of an area below its mouth [N]."""
    s = 2.0 / (ORIFICE * area + math.sqrt((ORIFICE * area) ** 2 + 4.0))
    return PRESSURE * s**2 * (math.pi * cup**2 / 4 - area)


def press(device, meshes, cup: float, places=((0.0, 0.0),), turn=UPRIGHT, cups=((0.0, 0.0),), valve: int = 0, **settings) -> Cups:
    """One world per offset [m] of the first object from the cup's axis; the highest point of each object is at the lip. Rays hit meshes;
    nothing collides, so that boxes are the shapes."""
    config = load_config("smoke", {"suction.vacuum": PRESSURE / 1e3, "gripper.cup_width": cup} | settings)
    objects = Catalog(tuple(solid(mesh, (simplify_hull(mesh.bounding_box.vertices, 8),)) for mesh in meshes))
    result = Cups(device, len(places), cups=cups, objects=objects, config=config, reach=0.03)
    result.scene.cups.common_valve = valve
    for world, place in enumerate(places):
        for index, mesh in enumerate(meshes):
            result.lay(world, index, index, np.add(PLACE, (*place, -mesh.bounds[1, 2])), turn)
    result.cast()
    return result


def forces(*arguments, **given) -> list[float]:
    return press(*arguments, **given)["break_force"][:, 0].tolist()


def test_a_tight_cup_holds_vacuum_times_area_and_the_settings_say_so(device):
    """On a block, on the bottom of a pocket, and on a surface to which it tilts by 4 degrees; at 15 degrees it does not lie on it."""
    pocket = trimesh.util.concatenate([annulus(0.3 * CUPS[1], 0.05, 0.06), cylinder(0.05, 0.004).apply_translation((0, 0, -0.03))])
    for cup in CUPS:
        assert forces(device, [box((0.1, 0.1, 0.03))], cup) == pytest.approx([full(cup)], rel=1e-5)
    config = load_config("smoke", {"suction.vacuum": 60, "gripper.cup_width": 0.022})
    assert config.suction.good_force == pytest.approx(full(0.022))
    assert config.suction.radius == 0.011
    assert forces(device, [pocket], 0.022) == pytest.approx([full(0.022)], rel=1e-5)
    for degrees, rel in ((4.0, 0.99), (15.0, 0.0)):
        half = math.radians(degrees) / 2
        (force,) = forces(device, [box((0.1, 0.1, 0.004))], 0.022, turn=(math.sin(half), 0.0, 0.0, math.cos(half)))
        assert rel <= force / full(0.022) <= rel + 0.02


@pytest.mark.parametrize("cup", CUPS)
def test_a_hole_leaks_by_its_area_and_one_of_a_tenth_of_the_cup_is_always_seen(device, cup):
    plate = annulus(cup / 10, 3 * cup, 0.004, sections=96)
    assert forces(device, [plate], cup)[0] == pytest.approx(held(cup, math.pi * cup**2 / 100), rel=0.25)
    tenth, numbers = annulus(cup / 20, 3 * cup, 0.004, sections=96), np.random.default_rng(5)
    way, angle = 0.44 * cup * np.sqrt(numbers.uniform(size=60)), numbers.uniform(0, math.tau, 60)
    places = np.column_stack([way * np.cos(angle), way * np.sin(angle)])
    assert max(forces(device, [tenth], cup, places)) < held(cup, math.pi * cup**2 / 1200)


@pytest.mark.parametrize(
    ("cup", "mesh", "share"),
    [
        (0.022, icosphere(5, 0.030), 1.0),
        (0.022, icosphere(5, 0.020), 0.0),
        (0.042, icosphere(5, 0.056), 1.0),
        (0.042, icosphere(5, 0.030), 0.0),
        (0.006, lying(cylinder(0.009, 0.05, sections=96)), 1.0),
        (0.022, lying(cylinder(0.030, 0.1, sections=192)), 1.0),
        (0.022, lying(cylinder(0.015, 0.1, sections=96)), 0.0),
        (0.022, grating(0.004, 0.003), 0.0),
        (0.042, grating(0.004, 0.003), 0.0),
        (0.042, annulus(0.018, 0.05, 0.006), 0.0),
        (0.042, cylinder(0.006, 0.06), 0.0),
        (0.042, trimesh.util.concatenate([box((0.1, 0.1, 0.004)), grating(0.02, 0.003).apply_translation((0.0115, 0, 0.004))]), 0.0),
    ],
    ids=["ball", "small ball", "ball 42", "small ball 42", "pin", "pipe", "rod", "grating", "grating 42", "ring", "thin pin", "groove"],
)
def test_a_cup_seals_on_what_its_bellows_follow_and_nowhere_else(device, cup, mesh, share):
    """A ball or pipe of radius r with r - sqrt(r² - R²) of up to a tenth of the cup; nothing thinner than it, no hole, no gap of 3 mm: one
    of 4 mm depth, with 24 mm² below the lip, leaves 3 % of the vacuum."""
    (force,) = forces(device, [mesh], cup)
    assert share - 0.01 <= force / full(cup) <= share + 0.04


@pytest.mark.parametrize("radius", [0.012, 0.030])
@pytest.mark.parametrize("width", [0.9, 0.99, 1.01, 1.05, 1.2])
def test_a_ball_about_as_wide_as_the_cup_is_not_held(device, radius, width):
    """Air enters through a truncated cone between lip and ball, of which the lip has sunk by a tenth of the cup below the pole."""
    lip = width * radius
    centre = radius - 0.2 * lip
    far = math.hypot(lip, centre)
    closed = held(2 * lip, math.pi * (far - radius) * (lip + radius * lip / far))
    (force,) = forces(device, [icosphere(5, radius)], 2 * lip)
    assert 0.2 <= force / closed <= 3.0


def test_beside_an_edge_and_across_two_boxes_air_enters(device):
    """Two boxes that touch each cover a half, or one a twentieth more: one is engaged, and neither is held."""
    cup, side = 0.022, 0.1
    places = [(0.0, side / 2 - edge * cup / 2) for edge in (1.1, 0.9, 0.5)]
    tight, over, half = forces(device, [box((side, side, 0.03))], cup, places)
    assert tight == pytest.approx(full(cup), rel=1e-4)
    beyond = (cup / 2) ** 2 * (math.acos(0.9) - 0.9 * math.sqrt(1 - 0.9**2))
    assert over == pytest.approx(held(cup, beyond), rel=0.35)
    assert 0.01 * full(cup) > half > 0.0
    boxes = [box((side, side, 0.03)).apply_translation((sign * side / 2, 0, 0)) for sign in (-1, 1)]
    pressed = press(device, boxes, cup, [(0.0, 0.0), (0.001, 0.0)])
    assert (np.count_nonzero(pressed.attached(), axis=1) == 1).all()
    assert (pressed["break_force"] < 0.01 * full(cup)).all()


@pytest.mark.parametrize(("valve", "good"), [(0, 0b01), (1, 0)])
def test_an_open_cup_takes_the_vacuum_of_a_common_valve(device, valve, good):
    pressed = press(device, [box((0.05, 0.05, 0.01))], 0.022, cups=((0.0, 0.0), (0.06, 0.0)), valve=valve)
    assert pressed["hits"].tolist() == [[304, good]]
    assert pressed.attached() == [[1, 0, 0, 0]]
    config = load_config("smoke", {"suction.vacuum": PRESSURE / 1e3, "gripper.cup_width": 0.022})
    assert pressed["break_force"][0].tolist() == pytest.approx([full(0.022) if good else config.suction.poor_force, 0.0], rel=1e-4)


class Lift(Hanging):
    """Worlds in which one cup is pressed on the highest point of an object and lifts it: 4 m/s² for 0.1 s, then 0.4 m/s."""

    def __init__(self, device, meshes, mass: float, cup: float) -> None:
        shapes = [solid(mesh) for mesh in meshes]
        super().__init__(device, [[mass]] * len(meshes), shapes=shapes, suction__vacuum=PRESSURE / 1e3, gripper__cup_width=cup)
        self.start(np.array([[[0.0, 0.0, -mesh.bounds[1, 2]]] for mesh in meshes]))
        self.seals.attached.zero_()
        self.state.phase.fill_(int(Phase.ACT))
        self.attempts.task.fill_(int(Task.PRESS))
        self.attempts.steps.fill_(10_000)
        self.suction.engage(self.scene, self.state, self.attempts, self.seals, self.physics)
        self.limits = self.seals.break_force.numpy()[:, 0].copy()

    def lift(self) -> list[bool]:
        """Whether each object hangs on the cup in the end."""
        for _ in range(50):
            self.speed[2] += 0.008
            self.run(1)
        self.run(50)
        return self.seals.attached.numpy()[:, 0].astype(bool).tolist()


def test_what_is_porous_or_thin_stays_where_vacuum_does_not_hold_it(device):
    """The parts of a user: by the forces of the paper, a cup of 42 mm picked them all."""
    parts = {path.stem: trimesh.load(path).apply_scale(1e-3) for path in sorted(PARTS.glob("*.stl"))}
    assert list(parts) == ["ball", "grid", "pin", "ring"]
    mass = 0.02
    lift = Lift(device, [*parts.values(), box((0.06, 0.06, 0.02))], mass, 0.042)
    assert lift.limits[:4].max() < 0.1 * mass * 9.81
    assert lift.limits[4] == pytest.approx(full(0.042), rel=1e-5)
    assert lift.lift() == [False, False, False, False, True]
