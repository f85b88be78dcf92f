"""Exact states: branches continue as their episodes do, nothing is forgotten, and what does not fit is refused."""

import re
from collections import Counter
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Ending, Phase, Task
from synpick_warp.errors import StateError
from synpick_warp.kernels.newton_patches.contact_history import ContactHistory
from synpick_warp.newton_patches import history
from synpick_warp.stages.sim import states
from synpick_warp.stages.sim.simulate import Simulation
from tests.harness.world_states import Rows, check_arrays, check_branches, differing, find_arrays, watch
from tests.worlds.small_worlds import BOX, CALM, CUBE, brief, catalog

WORLDS, TICKS = 4, 3
RESTLESS = {"settle__stuck_depth": 1e-7, "settle__stuck_time": 0.05}
"""Objects that touch anything are dropped again."""


@dataclass
class Scene:
    """A simulation at a moment that can be set again, and how its worlds go on."""

    simulation: Simulation
    before: states.State
    queue: np.ndarray
    own: list[Rows]

    @classmethod
    def of(cls, simulation: Simulation) -> "Scene":
        every, queue = range(simulation.layout.worlds), simulation.state.next_episode.numpy().copy()
        scene = cls(simulation, simulation.get_state(every), queue, watch(simulation, every, TICKS))
        scene.reset()
        return scene

    def reset(self) -> None:
        """To the moment."""
        self.simulation.set_state(self.before, range(self.simulation.layout.worlds))
        self.simulation.state.next_episode.assign(self.queue)

    def differences(self, world: int, into: int) -> list[str]:
        """Names of what differs as a branch goes on."""
        later = watch(self.simulation, range(self.simulation.layout.worlds), TICKS)
        return [name for expected, found in zip(self.own, later, strict=True) for name in differing(expected, found, world, into)]


# ---- branch and continuation ----


def test_a_branch_continues_as_its_episode_does(device):
    """To the bit, in other worlds and among fewer of them, beside worlds that do other things, from the drop to the next look."""
    changed = CALM | {"bake__mode": "cycle"}
    result = check_branches(brief(device, WORLDS, **changed), brief(device, 2, **changed), states=28, moments=7, ticks=TICKS, apart=5)
    assert result.differences == []
    assert result.compared > 100
    seen = " ".join(result.moments)
    for moment in ("pick: settling", "move: moving", "pick: approach", "pick: press", "target: descend", "target: lift"):
        assert moment in seen


def test_a_branch_of_objects_that_are_dropped_again_continues_so(device):
    result = check_branches(brief(device, 2, **RESTLESS), brief(device, 2, **RESTLESS), states=2, moments=1, ticks=TICKS, apart=7)
    assert result.differences == []
    assert any("dropped again" in moment for moment in result.moments)


@pytest.fixture(scope="module")
def moment(device):
    """World 0 presses, 1 descends, 2 has moved, 3 picks, and 4 is idle."""
    simulation = brief(device, WORLDS + 1, bake__mode="cycle", bake__episodes=WORLDS)
    while simulation.attempts.task.numpy()[0] != Task.PRESS:
        simulation.tick()
    assert (simulation.attempts.task.numpy()[[1, 3]] >= Task.APPROACH).all()
    assert simulation.state.phase.numpy()[WORLDS] == Phase.IDLE
    return Scene.of(simulation)


@pytest.fixture
def scene(moment):
    """The same moment for each test."""
    yield moment
    moment.reset()


@pytest.fixture
def acting(scene):
    return scene.simulation


def test_an_idle_world_continues_as_a_branch(scene):
    scene.simulation.branch(0, [WORLDS])
    assert scene.differences(0, WORLDS) == []


def test_a_branch_in_several_worlds_is_the_same_in_each(acting):
    acting.branch(1, [0, 2, 3, 4])
    for rows in watch(acting, range(WORLDS + 1), TICKS):
        assert [list(differing(rows, rows, 1, world)) for world in (0, 2, 3, 4)] == [[]] * 4


# ---- nothing is forgotten ----


def test_arrays_outside_the_state_have_no_influence(device):
    kinds = Counter()
    assert list(check_arrays(brief(device, 3), 24, kinds)) == []
    assert kinds["overwritten"] > 100
    assert kinds["state"] > 100


def test_nothing_of_a_poisoned_world_reaches_its_next_arrangement(scene, device):
    """All of its numbers are NaN: its episode ends, the next arrangement is that of a fresh world to the bit, and no other differs."""
    simulation, states = scene.simulation, scene.simulation.states
    state = states.get([0])
    words = state.words.numpy().copy()
    for part in states.fields.values():
        if part.dtype.kind == "f":
            words[:, part.first : part.first + part.words] = np.float32(np.nan).view(np.uint32)
    state.words.assign(words)
    for array in (getattr(state.contacts.history, str(name)) for name in ContactHistory.vars):
        if array.dtype in (wp.vec3, wp.vec2):
            array.fill_(np.nan)
    states.set(state, [0])
    others = range(1, WORLDS + 1)
    (ended,) = watch(simulation, range(WORLDS + 1), 1)
    assert Ending(ended["worlds.ending"][0]) is Ending.NOT_FINITE
    assert [list(differing(scene.own[0], ended, world)) for world in others] == [[]] * WORLDS
    fresh = brief(device, WORLDS + 1, bake__mode="cycle", bake__episodes=WORLDS)
    fresh.state.arrangement_id.assign([(0, 1)] + [(-1, 0)] * (fresh.layout.worlds - 1))
    fresh.state.phase.assign([int(Phase.START)] + [int(Phase.IDLE)] * (fresh.layout.worlds - 1))
    later, expected = watch(simulation, range(WORLDS + 1), TICKS), watch(fresh, [0], TICKS)
    assert [list(differing(*pair, 0)) for pair in zip(expected, later, strict=True)] == [[]] * TICKS
    for before, after in zip(scene.own[1:], later, strict=False):
        assert [list(differing(before, after, world)) for world in others] == [[]] * WORLDS


@pytest.mark.parametrize(
    ("world", "forgotten"),
    [(0, "physics.joint_qd"), (0, "physics.mf_impulses"), (1, "worlds.setpoint"), (1, "plan.point"), (0, "attempts.task")],
)
def test_a_state_that_forgets_an_array_is_found_out(scene, world, forgotten):
    """The checks can fail: without one of its arrays, a branch in an idle world differs."""
    states = scene.simulation.states
    part = states.fields[forgotten.replace("mf_", "propagation_") if scene.simulation.device.is_cuda else forgotten]
    state = states.get([world])
    words = state.words.numpy().copy()
    words[:, part.first : part.first + part.words] = 0
    state.words.assign(words)
    states.set(state, [WORLDS])
    assert scene.differences(world, WORLDS) != []


@pytest.mark.parametrize("forgotten", ["key", "midpoint", "solved_normal", "row", "pair", "displacement", "valid"])
def test_a_forgotten_contact_is_found_out(scene, forgotten):
    state = scene.simulation.get_state([0])
    name = {"row": "propagation_slot" if scene.simulation.device.is_cuda else "free_slot"}.get(forgotten, forgotten)
    getattr(state.contacts.history, name).zero_()
    scene.simulation.set_state(state, [WORLDS])
    assert scene.differences(0, WORLDS) != []


# ---- on the host ----


def test_a_state_survives_a_file(scene, device, tmp_path):
    """In another simulation of other worlds, too."""
    known = scene.simulation.states
    np.savez(tmp_path / "state.npz", **known.to_host(known.get([0, 3])))
    other = brief(device, 3)
    other.tick()
    with np.load(tmp_path / "state.npz") as file:
        other.set_state(other.states.from_host(dict(file)), [2, 1])
    for expected, found in zip(scene.own, watch(other, range(3), TICKS), strict=True):
        assert list(differing(expected, found, 0, 2)) == []
        assert list(differing(expected, found, 3, 1)) == []


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"version": np.array(0)}, "the state has version 0, but this release reads version 1"),
        ({"version": None}, "the state has version unknown"),
        ({"catalog": np.array("0123456789")}, "the state is of another catalog of objects"),
        ({"cell": np.array("0123456789")}, "the state is of another cell or gripper \\(01234567, not "),
        ({"cell": None}, "the state is of another cell or gripper \\(unknown, not "),
        ({"plan.point": None}, "the state lacks plan.point"),
        ({"plan.yaw": np.array([0.0, np.nan], np.float32)}, "plan.yaw of the state has a value that is not finite, in row 1"),
        ({"contacts.count": np.array([3, -1], np.int32)}, "contacts.count of the state is -1; allowed: 0 or more"),
    ],
)
def test_a_state_that_does_not_fit_is_refused(acting, changes, message):
    arrays = acting.states.to_host(acting.get_state([0, 1])) | changes
    with pytest.raises(StateError, match=message):
        acting.states.from_host({name: array for name, array in arrays.items() if array is not None})


def test_each_array_of_a_state_has_its_shape_and_type(acting):
    """Empty, of one row less, of another shape, type or kind: the message names the array, whichever it is."""
    arrays = acting.states.to_host(acting.get_state([0, 1]))
    for name in arrays.keys() - {"version", *states.ORIGINS}:
        like = arrays[name]
        for wrong in (like[:0], like[:1], like[..., None], like[0].ravel()[0], like.astype(complex), like.astype(object), None):
            with pytest.raises(StateError, match=f"^{re.escape(name)} of the state is .*; allowed: {like.dtype} "):
                acting.states.from_host(arrays | {name: wrong})


def test_a_state_of_another_cell_is_refused(acting, device):
    """Of a lower tote, whose arrays have the same shapes."""
    low = brief(device, 1, tote__outer_size=[0.615, 0.373, 0.19])
    low.tick()
    with pytest.raises(StateError, match=r"the state is of another cell or gripper \(.{8}, not .{8}\)"):
        acting.set_state(low.get_state([0]), [0])


def test_catalogs_are_told_apart():
    assert states.checksum(catalog()) == states.checksum(catalog())
    assert len({states.checksum(one) for one in (catalog(), catalog(BOX), catalog(CUBE, BOX))}) == 3


# ---- what is asked for must be there ----


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda one: one.get_state([9]), "there is no world 9; the simulation has worlds 0 to"),
        (lambda one: one.branch(-1, [0]), "there is no world -1"),
        (lambda one: one.branch(0, [1, 1]), "a world is named twice"),
        (lambda one: one.set_state(one.get_state([0, 1]), [0, 1, 2]), "2 rows cannot be loaded into 3 worlds"),
        (lambda one: one.set_state(one.get_state([0, 1]), [0], [2]), "there is no row 2; the state has rows 0 to 1"),
        (lambda one: one.states.allocate(10**12), "states of 1,000,000,000,000 worlds take"),
    ],
)
def test_wrong_worlds_and_rows_are_refused(acting, ask, message):
    with pytest.raises(StateError, match=message):
        ask(acting)


def test_there_is_no_state_before_and_within_a_tick(device):
    simulation = brief(device, 1)
    with pytest.raises(StateError, match="between two ticks alone"):
        simulation.get_state([0])
    parts = simulation.tick_parts()
    for _ in parts:
        with pytest.raises(StateError, match="between two ticks alone"):
            simulation.get_state([0])
    assert len(simulation.get_state([0])) == 1


def test_another_version_of_newton_has_no_states(device, monkeypatch):
    simulation = brief(device, 1, bake__mode="move")
    simulation.tick()
    monkeypatch.setattr(history, "KNOWN_NEWTON", "1.7.0")
    with pytest.raises(StateError, match=r"states need Newton 1.7.0; what .*, which is installed, keeps of a step is unknown"):
        simulation.get_state([0])


def test_a_world_with_more_contacts_than_a_state_has_room_for_ends_as_a_branch(device):
    """And no other world."""
    simulation = brief(device, WORLDS, bake__episodes=1, physics__contacts_per_world=16)
    while simulation.physics.contacts.rigid_contact_count.numpy()[0] <= 16:
        simulation.tick()
    simulation.branch(0, [2])
    simulation.tick()
    phase, ending = simulation.state.phase.numpy(), simulation.state.ending.numpy()
    assert Phase(phase[2]) is Phase.OVER
    assert Ending(ending[2]) is Ending.CONTACT_OVERFLOW
    assert ending[0] == Ending.RUNNING


def test_every_array_of_the_state_is_found(acting):
    found = list(find_arrays(acting).values())
    assert len(found) > 500
    pointers = {array.ptr for array in found}
    assert [array.shape for array in acting.states.arrays() if array.ptr not in pointers] == []
