"""Vacuum of a cup on plates, rings, gratings, pins, balls and blocks: the force that it holds follows from geometry, and so does what is
lifted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from trimesh.creation import annulus, box, cylinder, icosphere

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.types import Catalog
from tests.sim.test_cup_rays import PLACE, Cups
from tests.worlds.hanging import Hanging
from tests.worlds.small_worlds import solid

PARTS = Path(__file__).parents[1] / "cases/parts/suction_default_porous"
PRESSURE = 60e3
CUPS = (0.005, 0.022, 0.042, 0.06)
"""Diameters [m]."""
UP = (0.0, 0.0, 0.0, 1.0)
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


def press(device, meshes, cup: float, places=((0.0, 0.0),), turn=UP, cups=((0.0, 0.0),), valve: int = 0, **settings) -> Cups:
    """One world per offset [m] of the first object from the cup's axis; the highest point of each object is at the lip."""
    config = load_config("smoke", {"suction.vacuum": PRESSURE / 1e3, "gripper.cup_width": cup} | settings)
    result = Cups(device, len(places), cups=cups, objects=Catalog(tuple(map(solid, meshes))), config=config, reach=0.03)
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
    of 4 mm depth, with 24 mm² below the lip, leaves 3 % of the vacuum.
    """
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
