"""How attempts begin, go on and end, on worlds without physics."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Mode, Outcome, Phase, Removal, Task
from synpick_warp.kernels.perception import worklist
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.state import Attempts, Worlds
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.perception.perceive import WORKLIST
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
    """Worlds of three single objects in three slots, all in the tote, acting in mode PICK; fingers cannot turn, they have no model."""
    result = KernelWorlds(device, worlds, 3, radius=np.full(3, 0.1), pick=PICK | pick, move={"tcp_offset": TIP, "step": STEP})
    result.begin(Phase.ACT)
    result.put(mode=Mode.PICK, catalog_index=[0, 1, 2], body_slot=[0, 1, 2], point=POINT, normal=NORMAL)
    result.put(body_q=[0.0, 0.0, 0.1, 0.0, 0.0, 0.0, 1.0])
    result.physics.set_yaw = lambda yaw: None
    return result


def test_who_begins_to_pick_looks(device):
    worlds = made(device, worlds=4)
    worlds.put(phase=[Phase.ACT, Phase.ACT, Phase.ACT, Phase.SETTLE], mode=[Mode.PICK, Mode.TARGET, Mode.MOVE, Mode.PICK])
    cleared = ("failures", "removed", "yaw", "overflow")
    worlds.put(**dict.fromkeys(cleared, 2))
    worlds.run(gripper.begin_picking)
    assert worlds["task"].tolist() == [Task.LOOK, Task.LOOK, Task.NONE, Task.NONE]
    assert worlds["attempt"].tolist() == [-1] * 4
    assert not any(worlds[name].any() for name in cleared)


def test_nothing_hangs_where_nobody_acts(device):
    worlds = made(device, worlds=2)
    worlds.put(phase=[Phase.ACT, Phase.SETTLE], attached=1)
    worlds.run(gripper.clear_seals)
    assert worlds["attached"].tolist() == [[1, 1, 1], [0, 0, 0]]


def test_who_acts_already_keeps_its_task(device):
    worlds = made(device)
    worlds.put(frame=7, task=Task.LIFT, outcome=Outcome.DROPPED, attached=1)
    worlds.run(gripper.begin_picking)
    assert worlds.row("task", "outcome", "attached") == [Task.LIFT, Outcome.NONE, [1, 1, 1]]


def test_an_attempt_begins_above_the_grasp(device):
    worlds = made(device, worlds=2)
    worlds.run(gripper.begin_picking)
    worlds.put(target=[1, -1], tilt=0.3)
    worlds.run(gripper.begin_attempts)
    assert worlds["task"].tolist() == [Task.APPROACH, Task.LOOK]
    assert worlds["attempt"].tolist() == [0, 0]
    axis = np.add(POINT, np.multiply(TIP, NORMAL)) + np.array([0.0, 0.0, PICK["appear_height"]])
    joints = worlds["joint_q"].reshape(2, -1)
    np.testing.assert_allclose(joints[0, :4], [*axis, 0.3], rtol=1e-6)
    np.testing.assert_allclose(worlds["joint_target_q"].reshape(2, -1)[:, 3], [0.3, 0.0], rtol=1e-6)
    np.testing.assert_allclose(worlds["setpoint"][0], axis, rtol=1e-6)


def test_the_setpoint_goes_down_slowly_at_the_end_and_up_again(device):
    worlds = made(device)
    worlds.run(gripper.begin_picking)
    worlds.put(target=1)
    worlds.run(gripper.begin_attempts)
    axis = np.add(POINT, np.multiply(TIP, NORMAL))
    before = axis + np.multiply(PICK["near"], NORMAL)
    seen = []
    for _ in range(1200):
        worlds.run(gripper.drive_gripper)
        seen.append((worlds["task"][0], worlds["setpoint"][0].copy()))
    counts = Counter(task for task, _ in seen)
    way = np.linalg.norm(axis + np.array([0.0, 0.0, PICK["appear_height"]]) - before)
    # The step in which the setpoint arrives already belongs to the next task.
    assert counts[Task.APPROACH] == int(np.ceil(way / (PICK["speed"] * STEP))) - 1
    assert abs(counts[Task.DESCEND] - PICK["near"] / (PICK["near_speed"] * STEP)) < 1.5
    assert counts.keys() == {Task.APPROACH, Task.DESCEND, Task.PRESS}
    places = np.array([setpoint for task, setpoint in seen if task == Task.DESCEND])
    np.testing.assert_allclose(places[0], before, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(np.diff(places, axis=0), axis=1), PICK["near_speed"] * STEP, atol=1e-6)
    np.testing.assert_allclose(seen[-1][1], axis, atol=1e-6)
    assert worlds["steps"][0] == counts[Task.PRESS] - 1
    worlds.run(gripper.advance_tasks)
    assert worlds["task"][0] == Task.LIFT
    heights = []
    for _ in range(round(PICK["lift_height"] / (PICK["lift_speed"] * STEP)) + 3):
        worlds.run(gripper.drive_gripper)
        heights.append(worlds["setpoint"][0, 2])
    np.testing.assert_allclose(heights[9], axis[2] + 10 * PICK["lift_speed"] * STEP, atol=1e-5)
    np.testing.assert_allclose(worlds["setpoint"][0], axis + np.array([0.0, 0.0, PICK["lift_height"]]), atol=1e-6)
    assert worlds["outcome"][0] == Outcome.NONE
    worlds.run(gripper.advance_tasks)
    assert worlds["outcome"][0] == Outcome.NOTHING_CAUGHT


def test_the_cup_rests_before_it_sucks(device):
    worlds = made(device)
    worlds.put(task=Task.PRESS, steps=PICK["press_steps"] - 1)
    worlds.run(gripper.advance_tasks)
    assert worlds["task"][0] == Task.PRESS


LIFTED = np.add(POINT, np.multiply(TIP, NORMAL)).astype(np.float32) + np.array([0.0, 0.0, PICK["lift_height"]], np.float32)


def lifted(device, target: int, engaged: int, attached: tuple[int, ...], mode: int = Mode.PICK, **pick) -> KernelWorlds:
    worlds = made(device, **pick)
    worlds.put(mode=mode, task=Task.LIFT, target=target, engaged_words=[engaged], attached=attached, setpoint=LIFTED)
    worlds.run(gripper.drive_gripper)
    return worlds


@pytest.mark.parametrize(
    ("target", "engaged", "attached", "outcome", "failures"),
    [
        (1, 0b010, (0, 1, 0), Outcome.TARGET_PICKED, 0),
        (1, 0b011, (1, 1, 0), Outcome.TARGET_PICKED, 0),
        (1, 0b101, (1, 0, 1), Outcome.OTHER_PICKED, 0),
        (1, 0b010, (0, 0, 0), Outcome.DROPPED, 1),
        (1, 0b000, (0, 0, 0), Outcome.NOTHING_CAUGHT, 1),
    ],
)
def test_what_hangs_after_the_lift_leaves_the_scene(device, target, engaged, attached, outcome, failures):
    worlds = lifted(device, target, engaged, attached)
    worlds.run(gripper.advance_tasks)
    bits = [sum(bit << i for i, bit in enumerate(attached))]
    assert worlds.row("outcome", "failures", "task", "attached_words") == [outcome, failures, Task.LOOK, bits]
    assert worlds.row("removed", "attached") == [[Removal.PICKED * bit for bit in attached], [0, 0, 0]]
    assert worlds.row("catalog_index") == [[-1 if bit else i for i, bit in enumerate(attached)]]
    np.testing.assert_allclose(worlds["joint_q"][:4], [3.0, 0.0, 1.0, 0.0])


IN_PICK, IN_TARGET = 1 << Mode.PICK, 1 << Mode.TARGET


@pytest.mark.parametrize(
    ("mode", "forgive", "failures"),
    [(Mode.TARGET, IN_TARGET, 0), (Mode.TARGET, IN_PICK, 2), (Mode.PICK, IN_TARGET, 2), (Mode.PICK, IN_PICK | IN_TARGET, 0)],
)
def test_a_success_may_be_forgiving(device, mode, forgive, failures):
    worlds = lifted(device, 1, 2, (0, 1, 0), mode=mode, forgive=forgive)
    worlds.put(failures=2)
    worlds.run(gripper.advance_tasks)
    assert worlds["failures"][0] == failures


def test_failed_attempts_are_counted_by_target_if_it_is_asked(device):
    """Attempts at 1, 1, 2, of which the second succeeds with another object; then a new episode."""
    for tries_another, expected in ((False, [[0, 0, 0]] * 4), (True, [[0, 1025, 0], [0, 1, 0], [0, 1, 1025], [0, 0, 0]])):
        worlds = made(device)
        worlds.scene = replace(worlds.scene, tries_another=tries_another)
        counts = []
        for frame, target, attached in ((3, 1, (0, 0, 0)), (4, 1, (1, 0, 0)), (5, 2, (0, 0, 0)), (0, 2, (0, 0, 0))):
            task = Task.LIFT if frame else Task.LOOK
            worlds.put(frame=frame, task=task, target=target, outcome=Outcome.NONE, attached=attached, setpoint=LIFTED)
            worlds.run(gripper.advance_tasks)
            counts += worlds.row("target_failures")
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
    worlds.run(gripper.begin_picking)
    worlds.put(target=1)
    worlds.run(gripper.begin_attempts, law)
    worlds.run(gripper.drive_gripper, law)
    np.testing.assert_allclose(worlds["setpoint"][0], np.add(POINT, (0.0, 0.0, 0.01)), atol=1e-6)
    worlds.put(task=Task.PRESS)
    worlds.run(gripper.advance_tasks, law)
    assert worlds.row("outcome", "task") == [Outcome.NOTHING_CAUGHT, Task.PRESS]


def test_a_look_that_finds_nothing_is_a_failure_a_tick_later(device):
    worlds = made(device)
    worlds.run(gripper.begin_picking)
    worlds.run(gripper.advance_tasks)
    assert worlds["outcome"][0] == Outcome.NONE
    worlds.run(gripper.begin_attempts)
    for _ in range(33):
        worlds.run(gripper.drive_gripper)
    worlds.run(gripper.advance_tasks)
    assert worlds.row("outcome", "failures", "attempt") == [Outcome.NOTHING_SEEN, 1, 0]


@pytest.mark.parametrize(
    ("place", "displacement", "lost"),
    [
        ((0.0, 0.0, -0.11), 1.0, True),
        ((0.0, 0.0, -0.09), 1.0, False),
        ((0.3, 0.0, 0.05), 1e-5, True),
        ((0.3, 0.0, 0.05), 1e-2, False),
        ((0.3, 0.0, 0.6), 1e-5, False),
        ((0.1, 0.0, 0.05), 1e-5, False),
    ],
)
def test_what_left_the_tote_is_lost_when_it_lies_or_is_deep(device, place, displacement, lost):
    worlds = made(device)
    worlds.put(attached=1, displacement=[1.0, displacement, 1.0])
    worlds.place(0, 1, [*place, 0.0, 0.0, 0.0, 1.0])
    worlds.run(gripper.remove_lost)
    expected = [[0, -1 if lost else 1, 2], [0, Removal.LOST * lost, 0], [1, 1 - lost, 1]]
    assert worlds.row("catalog_index", "removed", "attached") == expected


def test_what_has_left_is_parked_apart_and_weightless_no_more(device):
    worlds = made(device, worlds=2)
    worlds.put(removed=[[0, 0, 0], [1, 0, 2]], joint_f=5.0, joint_qd=5.0)
    worlds.run(gripper.park_removed)
    poses = worlds.coordinates()
    assert not poses[0].any()
    assert not poses[1, 1].any()
    assert (poses[1, [0, 2], 2] < -50.0).all()
    assert abs(poses[1, 0, 0] - poses[1, 2, 0]) > 1.0
    assert (worlds.forces()[1] == [[0.0], [5.0], [0.0]]).all()


@pytest.mark.parametrize(
    ("state", "ending"),
    [
        ({"task": Task.LOOK, "failures": 2}, Ending.RUNNING),
        ({"task": Task.LOOK, "failures": 3}, Ending.GAVE_UP),
        ({"task": Task.LOOK, "catalog_index": -1}, Ending.EMPTIED),
        ({"task": Task.LOOK, "failures": 3, "catalog_index": -1}, Ending.EMPTIED),
        ({"task": Task.LIFT, "failures": 3, "catalog_index": -1}, Ending.RUNNING),
        ({"task": Task.LIFT, "overflow": 1}, Ending.PERCEPTION_OVERFLOW),
    ],
    ids=["failures", "gave up", "emptied", "emptied at last", "lifting", "a contour without room"],
)
def test_when_picking_ends(device, state, ending):
    worlds = made(device)
    worlds.put(**state)
    worlds.run(arrange.judge_episodes)
    assert worlds.row("ending", "phase") == [ending, Phase.ACT if ending == Ending.RUNNING else Phase.OVER]


@pytest.mark.parametrize("link", [0, 1])
def test_a_gripper_that_is_nowhere_ends_the_episode(device, link):
    worlds = made(device)
    body_q = worlds["body_q"]
    body_q[link, 0] = np.nan
    worlds.put(body_q=body_q)
    worlds.run(arrange.judge_episodes)
    assert worlds["ending"][0] == Ending.NOT_FINITE


@given(looking=st.lists(st.booleans(), min_size=1, max_size=12), views=st.integers(1, 5))
@settings(deadline=None, max_examples=25)
def test_everybody_who_looks_is_looked_at_once(looking, views, device):
    worlds = len(looking)
    state = filled(Worlds(), {"phase": wp.full(worlds, Phase.ACT, dtype=int, device=device)})
    tasks = [Task.LOOK if looks else Task.PRESS for looks in looking]
    attempts = filled(Attempts(), {"task": wp.array(tasks, dtype=int, device=device)})
    listed, batch = allocate_struct(WORKLIST, {"world": worlds, "one": 1}, device), filled(Views(), {"world": wp.zeros(views, int, device)})
    wp.launch(worklist.list_worlds_kernel, dim=1, inputs=[worlds, state, attempts], outputs=[listed], device=device)
    seen: list[int] = []
    batches = 0
    while listed.remaining.numpy()[0]:
        wp.launch(worklist.take_batch_kernel, dim=views, inputs=[listed], outputs=[batch], device=device)
        seen += [number for number in batch.world.numpy().tolist() if number >= 0]
        wp.launch(worklist.advance_batch_kernel, dim=1, inputs=[views], outputs=[listed], device=device)
        batches += 1
    assert seen == [number for number, looks in enumerate(looking) if looks]
    assert batches == -(-len(seen) // views)
