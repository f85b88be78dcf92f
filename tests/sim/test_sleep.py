"""Island sleeping: objects at rest fall asleep; touched ones wake and move as if never asleep; checkpoints are exact."""

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Outcome, Phase, Removal
from synpick_warp.errors import SynpickError
from synpick_warp.kernels.sim import sleep as kernels
from synpick_warp.kernels.state import Contacts
from synpick_warp.stages.launch import launch
from synpick_warp.stages.sim import sleep
from synpick_warp.stages.sim.simulate import Simulation
from tests.harness.world_states import Rows, check_arrays, check_branches
from tests.worlds.kernel_worlds import filled
from tests.worlds.small_worlds import CALM, brief, report

SLEEP = {"physics__sleep": 2e-4}
CREEP = 5e-4
"""Upper bound of the creep of awake objects at rest during a test [m]."""
ATTEMPT = 40
"""Maximum duration of an attempt [ticks]."""
NEVER = -(10**6)
"""Quiet time so low that no body falls asleep during a test [ticks]."""
BOX, CUBE, ANGLE = range(3)
"""Catalog indices."""
STACK = {BOX: (-0.08, 0.04, 0.02), CUBE: (-0.08, 0.04, 0.065)}
"""Positions of the box and the cube on top of it, by catalog index [m]."""


def set_rows(simulation: Simulation, worlds: list[int], **changed: object) -> None:
    """Overwrite arrays of the states of worlds; names have __ for the dot."""
    arrays = dict(simulation.states.to_host(simulation.get_state(worlds)))
    for name, value in changed.items():
        arrays[name.replace("__", ".")] = np.broadcast_to(np.asarray(value), arrays[name.replace("__", ".")].shape).astype(
            arrays[name.replace("__", ".")].dtype
        )
    simulation.set_state(simulation.states.from_host(arrays), worlds)


def row(simulation: Simulation, world: int) -> Rows:
    return {name: array[0] for name, array in simulation.states.to_host(simulation.get_state([world])).items() if array.ndim}


def asleep(simulation: Simulation) -> np.ndarray:
    """Sleep flags of the objects (world, instance) bool."""
    state = simulation.state
    flags = np.take_along_axis(simulation.sleep.state.asleep.numpy(), np.maximum(state.body_slot.numpy(), 0), axis=1)
    return (flags != 0) & (state.catalog_index.numpy() >= 0)


def positions(simulation: Simulation) -> np.ndarray:
    """Positions of the objects (world, instance, 3) [m]."""
    layout, slot = simulation.layout, simulation.state.body_slot.numpy()
    bodies = simulation.physics.state.body_q.numpy().reshape(layout.worlds, layout.bodies_per_world, 7)
    return np.take_along_axis(bodies[..., :3], 2 + np.maximum(slot, 0)[..., None], axis=1)


def instance_of(simulation: Simulation, entry: int) -> int:
    """The only instance of an object in world 0."""
    (found,) = np.flatnonzero(simulation.state.catalog_index.numpy()[0] == entry)
    return int(found)


def moved_to(simulation: Simulation, places: dict[int, tuple[float, float, float]]) -> np.ndarray:
    """Joint coordinates of world 0 with objects upright at other positions, by catalog index [m]."""
    coords, layout = row(simulation, 0)["physics.joint_q"].copy(), simulation.scene.layout
    for entry, place in places.items():
        first = layout.gripper_dofs + 7 * simulation.state.body_slot.numpy()[0, instance_of(simulation, entry)]
        coords[first : first + 7] = [*place, 0.0, 0.0, 0.0, 1.0]
    return coords


@pytest.fixture(scope="module")
def stack(device):
    """Simulation whose world 0 has a cube asleep on a box, beside an L, while the gripper waits; and its checkpoint."""
    simulation = brief(device, 3, bake__mode="pick", pick__failures=1000, **SLEEP | CALM)
    while simulation.state.phase.numpy()[0] != Phase.ACT:
        simulation.tick(perceives=False)
    set_rows(simulation, [0], physics__joint_q=moved_to(simulation, STACK), physics__joint_qd=0.0, sleep__asleep=0, sleep__quiet=0)
    simulation.physics.refresh_poses()
    for _ in range(12):
        simulation.tick(perceives=False)
    assert asleep(simulation)[0].sum() == 3
    return simulation, simulation.get_state([0])


@pytest.fixture
def twins(stack):
    """Worlds 0 and 1 continue from the checkpoint: world 0 asleep, world 1 awake for the whole test."""
    simulation, state = stack
    simulation.set_state(state, [0, 1])
    set_rows(simulation, [1], sleep__asleep=0, sleep__quiet=NEVER)
    assert asleep(simulation)[:2].sum(axis=1).tolist() == [3, 0]
    return simulation


def apart(simulation: Simulation) -> float:
    """Largest distance between the positions of an object in the twins [m]."""
    there, left = positions(simulation), simulation.state.catalog_index.numpy()[:2] >= 0
    assert (left[0] == left[1]).all()
    return float(np.linalg.norm(there[0] - there[1], axis=1)[left[0]].max())


def test_sleeping_objects_do_not_move_and_have_no_contacts(twins):
    before = positions(twins)
    twins.tick(perceives=False)
    after = positions(twins)
    assert (after[0] == before[0]).all()
    assert 0 < np.abs(after[1] - before[1]).max() < CREEP
    contacts = twins.physics.contacts
    shapes = contacts.rigid_contact_shape0.numpy()[: contacts.rigid_contact_count.numpy()[0]]
    assert set(shapes // twins.layout.shapes_per_world) >= {1}
    assert (shapes >= twins.layout.shapes_per_world).all()


def test_a_stack_is_an_island(twins):
    names = row(twins, 0)["sleep.island"][twins.state.body_slot.numpy()[0]]
    box, cube, angle = (names[instance_of(twins, entry)] for entry in (BOX, CUBE, ANGLE))
    assert box == cube != angle


def test_a_pick_from_a_sleeping_pile_ends_as_from_an_awake_one(twins):
    """The picked object is awake, and all others rest where they do in the awake twin."""
    cube = instance_of(twins, CUBE)
    seen, peak = dict[int, tuple[int, Outcome]](), np.zeros(2)
    for tick in range(ATTEMPT):
        twins.tick()
        now = report(twins.record)
        peak = np.maximum(peak, now.measure("peak_force")[:2])
        for world in (0, 1):
            if tick and now.column("outcome")[world]:  # Before the first look, attempts without a plan fail.
                seen.setdefault(world, (tick, Outcome(now.column("outcome")[world])))
        if len(seen) == 2:
            break
    assert asleep(twins)[0].tolist() == [instance != cube for instance in range(3)]
    assert seen[0] == seen[1]
    assert seen[0][1] is Outcome.TARGET_PICKED
    assert peak[0] == pytest.approx(peak[1], rel=0.1)
    assert apart(twins) < CREEP


def test_an_object_that_falls_on_a_sleeping_pile_wakes_it(twins):
    """The L falls on the cube: both twins come to rest alike, and the sleeper sleeps again."""
    coords = moved_to(twins, {ANGLE: (-0.07, 0.04, 0.17)})
    flags = twins.sleep.state.asleep.numpy()[0]
    flags[twins.state.body_slot.numpy()[0, instance_of(twins, ANGLE)]] = 0
    set_rows(twins, [0], physics__joint_q=coords, sleep__asleep=flags)
    set_rows(twins, [1], physics__joint_q=coords)
    twins.physics.refresh_poses()
    slept = []
    for _ in range(25):
        twins.tick(perceives=False)
        slept.append(asleep(twins)[0].tolist())
    assert sum(slept[0]) == 2  # It is in the air.
    assert [False] * 3 in slept
    assert slept[-1] == [True] * 3
    assert apart(twins) < 0.01


def test_an_object_that_loses_its_support_wakes(twins):
    """The box below the cube leaves the scene: the cube falls as in the awake twin, and what lies apart sleeps on."""
    box, cube, angle = (instance_of(twins, entry) for entry in (BOX, CUBE, ANGLE))
    removed = row(twins, 0)["attempts.removed"].copy()
    index = row(twins, 0)["worlds.catalog_index"].copy()
    removed[box], index[box] = Removal.LOST, -1
    set_rows(twins, [0, 1], attempts__removed=removed, worlds__catalog_index=index)
    twins.tick(perceives=False)
    assert asleep(twins)[0].tolist() == [entry == angle for entry in range(3)]
    for _ in range(15):
        twins.tick(perceives=False)
    assert positions(twins)[0, cube, 2] == pytest.approx(0.025, abs=1e-3)
    assert apart(twins) < CREEP


def test_the_end_of_an_episode_clears_marks_of_islands(twins):
    """Else an island would wake when a state is loaded into the world."""
    set_rows(twins, [0], worlds__phase=Phase.OVER)
    twins.sleep._islands.woken.fill_(1)
    twins.sleep.judge(twins.state, twins.attempts, twins.seals, SLEEP["physics__sleep"])
    assert not twins.sleep._islands.woken.numpy().any()


# ---- states ----


def test_a_branch_continues_as_its_episode_does(device):
    changed = {"bake__mode": "cycle", **SLEEP}
    result = check_branches(brief(device, 4, **changed), brief(device, 2, **changed), states=8, moments=2, ticks=3, apart=18)
    assert result.differences == []
    assert result.compared > 20


def test_arrays_outside_the_state_have_no_influence(device):
    simulation = brief(device, 3, **SLEEP)
    for _ in range(20):
        simulation.tick()
    assert list(check_arrays(simulation, 12, {})) == []
    assert asleep(simulation).any()


# ---- kernels ----


def joined(device, bodies: int, pairs: list[tuple[int, int]]) -> list[int]:
    """Union-find roots (body) of bodies with one shape each, after contacts `pairs`."""
    islands = filled(kernels.Islands(), {"parent": wp.array(np.arange(bodies), dtype=int, device=device)})
    values = {f"shape{side}": [pair[side] for pair in pairs] for side in (0, 1)} | {"count": [len(pairs)], "shape_body": range(bodies)}
    contacts = filled(Contacts(), {name: wp.array(list(value), dtype=int, device=device) for name, value in values.items()})
    launch(kernels.join_islands_kernel, len(pairs), contacts=contacts, islands=islands)
    roots = islands.parent.numpy()
    while (roots[roots] != roots).any():
        roots = roots[roots]
    return roots.tolist()


@pytest.mark.parametrize("flipped", [False, True])
def test_islands_are_the_components_of_the_contact_graph(device, flipped):
    pairs = [(5, 6), (4, 5), (0, -1), (2, 1), (6, 3), (-1, 7)]
    pairs = [(b, a) for a, b in reversed(pairs)] if flipped else pairs
    assert joined(device, 8, pairs) == [0, 1, 1, 3, 3, 3, 3, 7]


def test_random_islands_are_those_of_union_find(device):
    rng = np.random.default_rng(3)
    for count in (20, 60, 200):
        pairs = [tuple(map(int, pair)) for pair in rng.integers(0, 100, (count, 2))]
        expected = np.arange(100)
        for _ in range(100):
            for a, b in pairs:
                expected[[a, b]] = expected[[a, b]].min()
        assert joined(device, 100, pairs) == expected.tolist()


def test_another_version_of_newton_cannot_sleep(device, monkeypatch):
    monkeypatch.setattr(sleep, "SeparatingBroadPhase", Phase)
    with pytest.raises(SynpickError, match=r"physics.sleep needs another version of Newton than .*; set it to 0"):
        brief(device, 1, **SLEEP)
