"""How attempts begin, go on and end, on worlds without physics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Removal, Task
from synpick_warp.kernels.perception import worklist
from synpick_warp.kernels.state import Attempts, Worlds
from synpick_warp.stages.sim import arrange, gripper
from tests.worlds.kernel_worlds import KernelWorlds, filled

STEP, TIP = 2e-3, 0.05
PICK = {
    "stiffness": 2500.0,
    "damping": 200.0,
    "force": 200.0,
    "appear_height": 1.0,
    "speed": 1.0,
    "near": 0.05,
    "near_speed": 0.1,
    "press_steps": 50,
    "lift_height": 1.0,
    "lift_speed": 0.5,
    "failures": 3,
    "floor": -0.1,
    "tilt_limit": np.pi / 2,
    "forgive": 0,
    "random_after_failure": 0,
}
POINT = (0.1, -0.05, 0.04)
NORMAL = (0.6, 0.0, 0.8)


def made(device, worlds: int = 1, **pick) -> KernelWorlds:
    """Worlds of three single objects in three slots, all in the scene, acting in mode PICK."""
    result = KernelWorlds(device, worlds, 3, radius=np.full(3, 0.1), pick=PICK | pick, move={"tcp_offset": TIP, "step": STEP})
    result.begin(Phase.ACT)
    result.set(result.state.mode, Mode.PICK)
    result.set(result.state.catalog_index, [0, 1, 2])
    result.set(result.state.body_slot, [0, 1, 2])
    result.set(result.plan.point, POINT)
    result.set(result.plan.normal, NORMAL)
    return result


def begin(worlds: KernelWorlds) -> None:
    gripper.begin_picking(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.plan, worlds.physics)


def end(worlds: KernelWorlds) -> None:
    gripper.advance_tasks(worlds.scene, worlds.state, worlds.attempts, worlds.seals, worlds.plan, worlds.physics)


def step(worlds: KernelWorlds, count: int = 1) -> None:
    for _ in range(count):
        gripper.drive_gripper(worlds.scene, worlds.state, worlds.attempts, worlds.plan, worlds.physics, worlds.physics.state)


def begin_attempt(worlds: KernelWorlds) -> None:
    """With fingers that cannot turn: they have no model."""
    worlds.physics.set_yaw = lambda yaw: None
    gripper.begin_attempts(worlds.scene, worlds.state, worlds.attempts, worlds.plan, worlds.physics)


def test_who_begins_to_pick_looks(device):
    worlds = made(device, worlds=4)
    worlds.set(worlds.state.phase, [Phase.ACT, Phase.ACT, Phase.ACT, Phase.SETTLE])
    worlds.set(worlds.state.mode, [Mode.PICK, Mode.TARGET, Mode.MOVE, Mode.PICK])
    for array in (worlds.attempts.failures, worlds.attempts.removed, worlds.plan.yaw, worlds.observation.overflow):
        worlds.set(array, 2)
    begin(worlds)
    assert worlds.attempts.task.numpy().tolist() == [Task.LOOK, Task.LOOK, Task.NONE, Task.NONE]
    assert worlds.attempts.attempt.numpy().tolist() == [-1] * 4
    for array in (worlds.attempts.failures, worlds.attempts.removed, worlds.plan.yaw, worlds.observation.overflow):
        assert not array.numpy().any()


def test_nothing_hangs_where_nobody_acts(device):
    worlds = made(device, worlds=2)
    worlds.set(worlds.state.phase, [Phase.ACT, Phase.SETTLE])
    worlds.set(worlds.seals.attached, 1)
    gripper.clear_seals(worlds.state, worlds.seals)
    assert worlds.seals.attached.numpy().tolist() == [[1, 1, 1], [0, 0, 0]]


def test_who_acts_already_keeps_its_task(device):
    worlds = made(device)
    worlds.set(worlds.state.frame, 7)
    worlds.set(worlds.attempts.task, Task.LIFT)
    worlds.set(worlds.attempts.outcome, Outcome.DROPPED)
    worlds.set(worlds.seals.attached, 1)
    begin(worlds)
    assert worlds.attempts.task.numpy()[0] == Task.LIFT
    assert worlds.attempts.outcome.numpy()[0] == Outcome.NONE
    assert worlds.seals.attached.numpy().all()


def test_an_attempt_begins_above_the_grasp(device):
    worlds = made(device, worlds=2)
    begin(worlds)
    worlds.set(worlds.plan.target, [1, -1])
    worlds.set(worlds.plan.tilt, 0.3)
    begin_attempt(worlds)
    assert worlds.attempts.task.numpy().tolist() == [Task.APPROACH, Task.LOOK]
    assert worlds.attempts.attempt.numpy().tolist() == [0, 0]
    axis = np.add(POINT, np.multiply(TIP, NORMAL)) + np.array([0.0, 0.0, PICK["appear_height"]])
    joints = worlds.physics.state.joint_q.numpy().reshape(2, -1)
    np.testing.assert_allclose(joints[0, :4], [*axis, 0.3], rtol=1e-6)
    np.testing.assert_allclose(worlds.physics.control.joint_target_q.numpy().reshape(2, -1)[:, 3], [0.3, 0.0], rtol=1e-6)
    np.testing.assert_allclose(worlds.state.setpoint.numpy()[0], axis, rtol=1e-6)


def test_the_setpoint_goes_down_slowly_at_the_end_and_up_again(device):
    worlds = made(device)
    begin(worlds)
    worlds.set(worlds.plan.target, 1)
    begin_attempt(worlds)
    axis = np.add(POINT, np.multiply(TIP, NORMAL))
    before = axis + np.multiply(PICK["near"], NORMAL)
    seen: list[tuple[int, np.ndarray]] = []
    for _ in range(1200):
        step(worlds)
        seen.append((int(worlds.attempts.task.numpy()[0]), worlds.state.setpoint.numpy()[0].copy()))
    order = [task for task, _ in seen]
    counts = {task: order.count(task) for task in set(order)}
    way = np.linalg.norm(axis + np.array([0.0, 0.0, PICK["appear_height"]]) - before)
    # The step in which the setpoint arrives already belongs to the next task.
    assert counts[Task.APPROACH] == int(np.ceil(way / (PICK["speed"] * STEP))) - 1
    assert abs(counts[Task.DESCEND] - PICK["near"] / (PICK["near_speed"] * STEP)) < 1.5
    assert set(order) == {Task.APPROACH, Task.DESCEND, Task.PRESS}
    places = np.array([setpoint for task, setpoint in seen if task == Task.DESCEND])
    np.testing.assert_allclose(places[0], before, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), PICK["near_speed"] * STEP, atol=1e-6)
    np.testing.assert_allclose(seen[-1][1], axis, atol=1e-6)
    assert worlds.attempts.steps.numpy()[0] == counts[Task.PRESS] - 1
    end(worlds)
    assert worlds.attempts.task.numpy()[0] == Task.LIFT
    heights = []
    for _ in range(round(PICK["lift_height"] / (PICK["lift_speed"] * STEP)) + 3):
        step(worlds)
        heights.append(worlds.state.setpoint.numpy()[0, 2])
    np.testing.assert_allclose(heights[9], axis[2] + 10 * PICK["lift_speed"] * STEP, atol=1e-5)
    np.testing.assert_allclose(worlds.state.setpoint.numpy()[0], axis + np.array([0.0, 0.0, PICK["lift_height"]]), atol=1e-6)
    assert worlds.attempts.outcome.numpy()[0] == Outcome.NONE
    end(worlds)
    assert worlds.attempts.outcome.numpy()[0] == Outcome.NOTHING_CAUGHT


def test_the_cup_rests_before_it_sucks(device):
    worlds = made(device)
    worlds.set(worlds.attempts.task, Task.PRESS)
    worlds.set(worlds.attempts.steps, PICK["press_steps"] - 1)
    end(worlds)
    assert worlds.attempts.task.numpy()[0] == Task.PRESS


LIFTED = np.add(POINT, np.multiply(TIP, NORMAL)).astype(np.float32) + np.array([0.0, 0.0, PICK["lift_height"]], np.float32)
JUDGED = [
    (1, 0b010, (0, 1, 0), Outcome.TARGET_PICKED, 0),
    (1, 0b011, (1, 1, 0), Outcome.TARGET_PICKED, 0),
    (1, 0b101, (1, 0, 1), Outcome.OTHER_PICKED, 0),
    (1, 0b010, (0, 0, 0), Outcome.DROPPED, 1),
    (1, 0b000, (0, 0, 0), Outcome.NOTHING_CAUGHT, 1),
]


def lifted(device, target: int, engaged: int, attached: tuple[int, ...], mode: int = Mode.PICK, **pick) -> KernelWorlds:
    worlds = made(device, **pick)
    worlds.set(worlds.state.mode, mode)
    worlds.set(worlds.attempts.task, Task.LIFT)
    worlds.set(worlds.plan.target, target)
    worlds.set(worlds.attempts.engaged_words, [engaged])
    worlds.set(worlds.seals.attached, attached)
    worlds.set(worlds.state.setpoint, LIFTED)
    step(worlds)
    return worlds


@pytest.mark.parametrize(("target", "engaged", "attached", "outcome", "failures"), JUDGED)
def test_what_hangs_after_the_lift_leaves_the_scene(device, target, engaged, attached, outcome, failures):
    worlds = lifted(device, target, engaged, attached)
    end(worlds)
    assert worlds.attempts.outcome.numpy()[0] == outcome
    assert worlds.attempts.failures.numpy()[0] == failures
    assert worlds.attempts.task.numpy()[0] == Task.LOOK
    assert worlds.attempts.attached_words.numpy()[0, 0] == sum(bit << i for i, bit in enumerate(attached))
    assert worlds.attempts.removed.numpy()[0].tolist() == [Removal.PICKED * bit for bit in attached]
    assert worlds.state.catalog_index.numpy()[0].tolist() == [-1 if bit else i for i, bit in enumerate(attached)]
    assert not worlds.seals.attached.numpy().any()
    np.testing.assert_allclose(worlds.physics.state.joint_q.numpy()[:4], [3.0, 0.0, 1.0, 0.0])


IN_PICK, IN_TARGET = 1 << Mode.PICK, 1 << Mode.TARGET


@pytest.mark.parametrize(
    ("mode", "forgive", "failures"),
    [(Mode.TARGET, IN_TARGET, 0), (Mode.TARGET, IN_PICK, 2), (Mode.PICK, IN_TARGET, 2), (Mode.PICK, IN_PICK | IN_TARGET, 0)],
)
def test_a_success_may_be_forgiving(device, mode, forgive, failures):
    worlds = lifted(device, 1, 2, (0, 1, 0), mode=mode, forgive=forgive)
    worlds.set(worlds.attempts.failures, 2)
    end(worlds)
    assert worlds.attempts.failures.numpy()[0] == failures


def test_failed_attempts_are_counted_by_target_if_it_is_asked(device):
    """Attempts at 1, 1, 2, of which the second succeeds with another object; then a new episode."""
    for tries_another, expected in ((False, [[0, 0, 0]] * 4), (True, [[0, 1025, 0], [0, 1, 0], [0, 1, 1025], [0, 0, 0]])):
        worlds = made(device)
        worlds.scene = replace(worlds.scene, tries_another=tries_another)
        counts = []
        for frame, target, attached in ((3, 1, (0, 0, 0)), (4, 1, (1, 0, 0)), (5, 2, (0, 0, 0)), (0, 2, (0, 0, 0))):
            worlds.set(worlds.state.frame, frame)
            worlds.set(worlds.attempts.task, Task.LIFT if frame else Task.LOOK)
            worlds.set(worlds.plan.target, target)
            worlds.set(worlds.attempts.outcome, Outcome.NONE)
            worlds.set(worlds.seals.attached, attached)
            worlds.set(worlds.state.setpoint, LIFTED)
            end(worlds)
            counts.append(worlds.attempts.target_failures.numpy()[0].tolist())
        assert counts == expected


class Hovering(gripper.TwoSpeedLaw):
    """A law of another gripper: it begins at the grasp, and judges nothing."""

    def begin(self, scene, state, attempts, plan, physics):
        state.setpoint.assign(plan.point)

    def advance(self, scene, state, attempts, plan):
        state.setpoint.assign(state.setpoint.numpy() + np.array([0.0, 0.0, 0.01]))

    def end_tick(self, scene, state, attempts, plan):
        attempts.outcome.fill_(int(Outcome.NOTHING_CAUGHT))


def test_the_law_of_a_gripper_replaces_the_setpoints(device):
    worlds, law = made(device), Hovering()
    state = (worlds.scene, worlds.state, worlds.attempts)
    begin(worlds)
    worlds.set(worlds.plan.target, 1)
    worlds.physics.set_yaw = lambda yaw: None
    gripper.begin_attempts(*state, worlds.plan, worlds.physics, law)
    gripper.drive_gripper(*state, worlds.plan, worlds.physics, worlds.physics.state, law)
    np.testing.assert_allclose(worlds.state.setpoint.numpy()[0], np.add(POINT, (0.0, 0.0, 0.01)), atol=1e-6)
    worlds.set(worlds.attempts.task, Task.PRESS)
    gripper.advance_tasks(*state, worlds.seals, worlds.plan, worlds.physics, law)
    assert (worlds.attempts.outcome.numpy()[0], worlds.attempts.task.numpy()[0]) == (Outcome.NOTHING_CAUGHT, Task.PRESS)


def test_a_look_that_finds_nothing_is_a_failure_a_tick_later(device):
    worlds = made(device)
    begin(worlds)
    end(worlds)
    assert worlds.attempts.outcome.numpy()[0] == Outcome.NONE
    begin_attempt(worlds)
    step(worlds, 33)
    end(worlds)
    assert worlds.attempts.outcome.numpy()[0] == Outcome.NOTHING_SEEN
    assert worlds.attempts.failures.numpy()[0] == 1
    assert worlds.attempts.attempt.numpy()[0] == 0


PLACES = [
    ((0.0, 0.0, -0.11), 1.0, True),
    ((0.0, 0.0, -0.09), 1.0, False),
    ((0.3, 0.0, 0.05), 1e-5, True),
    ((0.3, 0.0, 0.05), 1e-2, False),
    ((0.3, 0.0, 0.6), 1e-5, False),
    ((0.1, 0.0, 0.05), 1e-5, False),
]


@pytest.mark.parametrize(("place", "displacement", "lost"), PLACES)
def test_what_left_the_tote_is_lost_when_it_lies_or_is_deep(device, place, displacement, lost):
    worlds = made(device)
    worlds.set(worlds.seals.attached, 1)
    worlds.set(worlds.state.displacement, [1.0, displacement, 1.0])
    for instance in range(3):
        worlds.place(0, instance, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    worlds.place(0, 1, [*place, 0.0, 0.0, 0.0, 1.0])
    gripper.remove_lost(worlds.scene, worlds.state, worlds.attempts, worlds.seals, worlds.physics)
    assert worlds.state.catalog_index.numpy()[0].tolist() == [0, -1 if lost else 1, 2]
    assert worlds.attempts.removed.numpy()[0].tolist() == [0, Removal.LOST * lost, 0]
    assert worlds.seals.attached.numpy()[0].tolist() == [1, 1 - lost, 1]


def test_what_has_left_is_parked_apart_and_weightless_no_more(device):
    worlds = made(device, worlds=2)
    worlds.set(worlds.attempts.removed, [[0, 0, 0], [1, 0, 2]])
    worlds.set(worlds.physics.control.joint_f, 5.0)
    worlds.set(worlds.physics.state.joint_qd, 5.0)
    gripper.park_removed(worlds.scene, worlds.state, worlds.attempts, worlds.physics)
    poses = worlds.coordinates()
    assert not poses[0].any()
    assert not poses[1, 1].any()
    assert (poses[1, [0, 2], 2] < -50.0).all()
    assert abs(poses[1, 0, 0] - poses[1, 2, 0]) > 1.0
    assert (worlds.forces()[1] == [[0.0], [5.0], [0.0]]).all()


@pytest.mark.parametrize(
    ("task", "catalog_index", "failures", "ending"),
    [
        (Task.LOOK, [0, 1, 2], 2, Ending.RUNNING),
        (Task.LOOK, [0, 1, 2], 3, Ending.GAVE_UP),
        (Task.LOOK, [-1, -1, -1], 0, Ending.EMPTIED),
        (Task.LOOK, [-1, -1, -1], 3, Ending.EMPTIED),
        (Task.LIFT, [-1, -1, -1], 3, Ending.RUNNING),
    ],
)
def test_when_picking_ends(device, task, catalog_index, failures, ending):
    worlds = made(device)
    for instance in range(3):
        worlds.place(0, instance, [0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    worlds.set(worlds.attempts.task, task)
    worlds.set(worlds.attempts.failures, failures)
    worlds.set(worlds.state.catalog_index, catalog_index)
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert worlds.state.ending.numpy()[0] == ending
    assert worlds.state.phase.numpy()[0] == (Phase.ACT if ending == Ending.RUNNING else Phase.OVER)


def test_a_contour_without_room_ends_the_episode(device):
    worlds = made(device)
    worlds.set(worlds.attempts.task, Task.LIFT)
    worlds.set(worlds.observation.overflow, 1)
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert worlds.state.ending.numpy()[0] == Ending.PERCEPTION_OVERFLOW


@pytest.mark.parametrize("link", [0, 1])
def test_a_gripper_that_is_nowhere_ends_the_episode(device, link):
    worlds = made(device)
    body_q = worlds.physics.state.body_q.numpy()
    body_q[link, 0] = np.nan
    worlds.physics.state.body_q.assign(body_q)
    arrange.judge_episodes(worlds.scene, worlds.state, worlds.attempts, worlds.observation, worlds.physics)
    assert worlds.state.ending.numpy()[0] == Ending.NOT_FINITE


@given(looking=st.lists(st.booleans(), min_size=1, max_size=12), views=st.integers(1, 5))
@settings(deadline=None, max_examples=25)
def test_everybody_who_looks_is_looked_at_once(looking, views, device):
    worlds = len(looking)
    state = filled(Worlds(), {"phase": wp.full(worlds, Phase.ACT, dtype=int, device=device)})
    tasks = [Task.LOOK if looks else Task.PRESS for looks in looking]
    attempts = filled(Attempts(), {"task": wp.array(tasks, dtype=int, device=device)})
    listed, world = wp.zeros(worlds, dtype=int, device=device), wp.zeros(views, dtype=int, device=device)
    count, first, left = (wp.zeros(1, dtype=int, device=device) for _ in range(3))
    wp.launch(worklist.list_worlds_kernel, dim=1, inputs=[worlds, state, attempts], outputs=[listed, count, first, left], device=device)
    seen: list[int] = []
    batches = 0
    while left.numpy()[0]:
        wp.launch(worklist.take_batch_kernel, dim=views, inputs=[listed, count, first], outputs=[world], device=device)
        seen += [number for number in world.numpy().tolist() if number >= 0]
        wp.launch(worklist.advance_batch_kernel, dim=1, inputs=[views, count], outputs=[first, left], device=device)
        batches += 1
    assert seen == [number for number, looks in enumerate(looking) if looks]
    assert batches == -(-len(seen) // views)
