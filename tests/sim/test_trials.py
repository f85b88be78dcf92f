"""Grasp trials: the planned grasp has the outcome of its attempt, labels do not depend on worlds, and invalid grasps are refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import Outcome
from synpick_warp.configs.episodes.manipulation import Picks
from synpick_warp.errors import StateError
from synpick_warp.stages.perception.candidates import CandidateSampler
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.sim.trials import Trials, check_grasps, find_choices, own_grasps, trial_values
from tests.worlds.hanging import Hanging
from tests.worlds.sights import brief, picking
from tests.worlds.small_worlds import report

ABOVE = 0.25
"""Height of a grasp in the air above the pile [m]."""


def worlds(device, count: int) -> Simulation:
    return brief(device, count, bake__mode="pick", arrangement__max_objects=2)


WHOLE = Picks(near=0.0, hold=0.0)
"""Trials with approach and lift of an attempt."""


def ticked(simulation: Simulation) -> Simulation:
    simulation.tick()
    return simulation


class Choice:
    """A world at a moment of choice: its state, planned grasp, and the outcome of the attempt."""

    def __init__(self, simulation: Simulation) -> None:
        while not len(find_choices(simulation)):
            simulation.tick()
        (self.world,) = find_choices(simulation)[:1]
        self.state, self.grasps = simulation.get_state([self.world]), own_grasps(simulation, [self.world])
        self.peak, self.ticks, row = 0.0, 0, None
        while row is None or not row.column("outcome")[self.world]:
            simulation.tick()
            row, self.ticks = report(simulation.record), self.ticks + 1
            self.peak = max(self.peak, row.measure("peak_force")[self.world])
        self.outcome, self.hits = row.column("outcome")[self.world], row.column("hits")[self.world]

    def repeated(self, count: int, **changed: np.ndarray) -> dict[str, np.ndarray]:
        """The planned grasp `count` times, with some arrays replaced."""
        return {name: np.repeat(values, count, axis=0) for name, values in self.grasps.items()} | changed


@pytest.fixture(scope="module")
def choice(device):
    return Choice(worlds(device, 3))


@pytest.fixture(scope="module")
def labels(choice, device):
    """Labels of seven trials, by number of worlds: the planned grasp, but in the air in trials 1 and 4, and turned in trial 2."""
    grasps = choice.repeated(7)
    grasps["point"][[1, 4], 2] += ABOVE
    grasps["yaw"][2] += 0.5
    found = {}
    for count in (3, 2):
        trials = Trials(ticked(worlds(device, count)), WHOLE)
        found[count] = trials.run(choice.state, trials.upload(grasps, 1))
    return found


def test_the_own_grasp_has_the_outcome_of_the_own_attempt(choice, labels):
    own = {name: values[0] for name, values in labels[3].items()}
    assert Outcome(choice.outcome) is Outcome.TARGET_PICKED
    assert own["outcome"] == choice.outcome
    assert own["hits"][0] == choice.hits
    assert own["picked"] == choice.grasps["target"][0]
    assert own["peak_force"] == np.float32(choice.peak)
    assert own["load"] == pytest.approx(choice.peak / 40.0, rel=1e-5)
    assert own["ticks"] == choice.ticks
    assert 0 < own["held"] < own["ticks"] * 16


def test_the_same_trial_has_the_same_labels(labels):
    for name, values in labels[3].items():
        assert len({values[trial].tobytes() for trial in (0, 3, 5, 6)}) == 1, name
        assert values[1].tobytes() == values[4].tobytes(), name


def test_labels_do_not_depend_on_the_number_of_worlds(labels):
    for name, values in labels[3].items():
        np.testing.assert_array_equal(values, labels[2][name], err_msg=name)


def test_repeats_are_perturbed_alike_in_any_world(choice, device):
    """With start near the grasp and a short lift: repeat 0 is not perturbed, and is held for lift plus hold."""
    settings = Picks(near=0.02, lift_height=0.05, hold=0.1, repeats=3, angle=5.0)
    grasps, found = choice.repeated(2, candidate=np.arange(2)), {}
    for count in (3, 2):
        ordinary = worlds(device, count)
        config = ordinary.config.with_values(trial_values(settings, ordinary.layout.worlds))
        simulation = ticked(picking(config, ordinary.catalog, device, episodes=[]))
        trials = Trials(simulation, settings)
        found[count] = trials.run(choice.state, trials.upload(grasps, 1))
    mu = simulation.physics.model.shape_material_mu.numpy().reshape(simulation.layout.worlds, -1)
    assert all(len(set(row)) == 1 for row in mu)
    labels = found[3]
    for name, values in labels.items():
        np.testing.assert_array_equal(values, found[2][name], err_msg=name)
        assert values[0].tobytes() == values[3].tobytes(), name
    for name, centre, width in (("offset", 0.0, 1e-3), ("rotation", 0.0, np.radians(5.0)), ("friction", 1.0, 0.2)):
        drawn = labels[name][[1, 2, 4, 5]]
        assert len(np.unique(drawn)) == drawn.size
        assert (labels[name][::3] == centre).all()
        assert (np.abs(drawn - centre) <= width).all()
        assert np.ptp(drawn) > 0.2 * width
    assert Outcome(labels["outcome"][0]) is Outcome.TARGET_PICKED
    assert labels["held"][0] * 4e-3 == pytest.approx(0.05 / 0.6 + 0.1, abs=16 * 4e-3)


FOUR_CUPS = {
    "gripper__kind": "suction_array",
    "gripper__cups": [[0.012, 0.012], [-0.012, 0.012], [-0.012, -0.012], [0.012, -0.012]],
    "gripper__cup_width": 0.02,
    "suction__radius": 0.008,
}


def test_four_cups_are_tried_alike_in_any_world_and_others_are_measured_later(device):
    """Candidates, perturbed, with and without `picks.settle`, which changes only what is measured of the other object: it is in the air."""
    first = brief(device, 2, bake__mode="pick", arrangement__max_objects=2, **FOUR_CUPS)
    while not len(find_choices(first)):
        first.tick()
    (world,) = find_choices(first)[:1].tolist()
    arrays = first.states.to_host(first.get_state([world]))
    other = 1 - own_grasps(first, [world])["target"][0]
    upward = first.scene.layout.gripper_dofs + 6 * arrays["worlds.body_slot"][0, other] + 2
    arrays["physics.joint_qd"][0, upward] = 3.0
    state = first.states.from_host(arrays)
    settings, found = Picks(near=0.02, lift_height=0.05, hold=0.0, repeats=2, candidates=4), {}
    for count, settle in ((3, 0.0), (2, 0.0), (2, 0.3)):
        config = first.config.with_values(trial_values(settings, max(count, MIN_GPU_WORLDS) if first.device.is_cuda else count))
        simulation = ticked(picking(config, first.catalog, device, episodes=[]))
        grasps, candidates, _ = CandidateSampler(simulation, settings).sample(state, [0])
        found[count, settle] = Trials(simulation, replace(settings, settle=settle)).run(state, grasps)
        found[count, settle] |= {name: getattr(candidates, name).numpy() for name in ("pixel", "weight", "seal")}
    labels, later = found[2, 0.0], found[2, 0.3]
    for name, values in labels.items():
        np.testing.assert_array_equal(values, found[3, 0.0][name], err_msg=name)
        if name not in ("moved", "farthest", "lost"):
            np.testing.assert_array_equal(values, later[name], err_msg=name)
    assert labels["farthest"][0] > 0.3 > 0.1 > later["farthest"][0]
    assert Outcome(labels["outcome"][0]) is Outcome.TARGET_PICKED
    assert labels["hits"][:, 0].max() > 10
    assert bin(labels["hits"][0, 1]).count("1") >= 3


def test_the_load_of_a_cup_that_holds_two_objects_is_that_of_one_seal(device):
    """Not of the sum: each seal has the break force."""
    hanging, cube = Hanging(device, [[0.5, 1.0]], [[(0.05, 0.05, 0.05)] * 2]), 0.025
    hanging.start(np.array([[[-cube, 0.0, -cube], [cube, 0.0, -cube]]]))
    forces = hanging.run(100)
    assert hanging.seals.peak.numpy()[0, 1] == np.float32(forces.max()) / np.float32(40.0)
    assert forces[-1].sum() > 1.2 * forces.max()


def test_a_grasp_in_the_air_catches_nothing(labels):
    assert Outcome(labels[3]["outcome"][1]) is Outcome.NOTHING_CAUGHT
    assert labels[3]["hits"][1].tolist() == [0, 0]
    assert (labels[3]["picked"][1], labels[3]["held"][1], labels[3]["moved"][1], labels[3]["lost"][1]) == (-1, 0, 0, 0)
    assert labels[3]["peak_force"][1] == 0.0
    assert labels[3]["farthest"][1] < 5e-3


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"yaw": None}, "grasps lack yaw"),
        ({"point": np.zeros((2, 2))}, r"point of 2 grasps has the shape \(2, 2\), not \(2, 3\)"),
        ({"tilt": np.array([0.0, np.nan])}, "tilt of grasp 1 is not finite"),
        ({"row": np.array([0, 3])}, "row is 3; allowed: 0 to 0"),
        ({"target": np.array([-2, 0])}, "target is -2; allowed: -1 to 1"),
    ],
)
def test_bad_grasps_are_refused(choice, changes, message):
    grasps = {name: values for name, values in (choice.repeated(2) | changes).items() if values is not None}
    with pytest.raises(StateError, match=message):
        check_grasps(grasps, 1, 2)
