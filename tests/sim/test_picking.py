"""Whole episodes of picking: from the first look to the empty tote."""

from __future__ import annotations

import itertools
from collections import defaultdict

import numpy as np
import pytest

from synpick_warp.codes import Ending, Outcome, Phase, Task
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import TickReport
from tests.worlds.sights import CALM, SHORT, picking
from tests.worlds.small_worlds import BOX, CUBE, catalog, report, settings

COARSE = {"physics__step": 4e-3, "physics__steps_per_tick": 16, "physics__substeps": 1, "physics__iterations": 8}
LONGEST = 300
GRAVITY = 9.81


def run(simulation: Simulation) -> list[TickReport]:
    """Until no episode is left."""
    reports = []
    for _ in range(LONGEST):
        simulation.tick()
        reports.append(report(simulation.record))
        if (reports[-1].column("phase") == Phase.IDLE).all():
            return reports
    raise AssertionError("the worlds did not come to an end")


def column(reports: list[TickReport], name: str, world: int = 0) -> np.ndarray:
    return np.array([row.column(name)[world] for row in reports])


@pytest.fixture(scope="module")
def emptied(device):
    """One world from two objects to none, at the paper's step, and what it was made of."""
    objects = catalog(BOX, CUBE)
    config = settings(arrangement__max_objects=2, **SHORT | CALM)
    simulation = picking(config, objects, device)
    return run(simulation), objects


def test_a_pick_episode_runs_to_its_end(emptied):
    reports, objects = emptied
    outcomes = column(reports, "outcome")
    assert [Outcome(code) for code in outcomes[outcomes > 0]] == [Outcome.TARGET_PICKED] * len(objects)
    last = np.flatnonzero(column(reports, "phase") == Phase.OVER)
    assert len(last) == 1
    assert Ending(column(reports, "ending")[last[0]]) is Ending.EMPTIED
    assert column(reports, "live")[last[0]] == 1, "the picture of the empty tote belongs to the episode"
    live = column(reports, "live") == 1
    assert column(reports, "frame")[live].tolist() == list(range(live.sum()))


def test_what_was_picked_is_gone_from_the_next_picture(emptied):
    reports, objects = emptied
    live = [row for row in reports if row.column("live")[0]]
    present = [(row.catalog_index[0] >= 0).sum() for row in live]
    ended = [row.column("outcome")[0] != 0 for row in live]
    assert present[0] == len(objects)
    assert np.diff(present).tolist() == [-int(end) for end in ended[1:]]
    for row, end in zip(live, ended, strict=True):
        if end:
            assert row.attached[0, 0] == 1 << row.column("target")[0]


def test_tasks_come_in_order(emptied):
    reports, objects = emptied
    tasks = column(reports, "task")[column(reports, "live") == 1]
    changes = tasks[np.insert(np.diff(tasks) != 0, 0, True)].tolist()
    once = [Task.LOOK, Task.APPROACH, Task.DESCEND, Task.PRESS, Task.LIFT]
    assert changes == once * len(objects) + [Task.LOOK]


def test_the_seal_bears_the_weight_at_the_end_of_the_lift(emptied):
    reports, objects = emptied
    for row, following in itertools.pairwise(reports):
        if following.column("outcome")[0]:
            target = following.column("target")[0]
            weight = objects.entries[row.catalog_index[0][target]].mass * GRAVITY
            assert row.measure("peak_force")[0] == pytest.approx(weight, rel=0.03)
            assert row.column("hits")[0] == 10


def test_the_first_two_frames_show_the_same_pile(emptied):
    """Looking takes no time, and the gripper that appears touches nothing."""
    live = [row for row in emptied[0] if row.column("live")[0]]
    np.testing.assert_allclose(live[0].pose[0, :, :3], live[1].pose[0, :, :3], atol=2e-3)


def test_there_must_be_something_to_look_at(device):
    with pytest.raises(ValueError, match="render_scene"):
        Simulation(settings(**SHORT), catalog(), 1, device)


def track(device, worlds: int, episodes: int = 3) -> dict[tuple[int, int], list[bytes]]:
    """Results of every tick by (episode, arrangement), in mixed modes and a number of worlds."""
    changed = SHORT | COARSE | {"bake__mode": "mixed", "pick__retry": "another", "perception__grasp_point": "flat"}
    changed |= {"perception__resolution": [160, 90]}
    config = settings(bake__worlds=worlds, bake__episodes=episodes, arrangement__max_objects=2, pick__failures=1, **changed)
    simulation = picking(config, catalog(), device)
    ticks = defaultdict(list)
    for row in run(simulation):
        for world in range(worlds):
            address = (int(row.column("episode")[world]), int(row.column("arrangement")[world]))
            full = row.catalog_index[world] >= 0
            parts = (row.status[world], row.measures[world], row.catalog_index[world], row.pose[world][full])
            ticks[address].append(b"".join(np.ascontiguousarray(part).tobytes() for part in parts))
    return {address: rows for address, rows in ticks.items() if address[0] >= 0}


def test_an_episode_of_any_mode_is_the_same_in_any_world(device):
    alone, together = track(device, 1), track(device, 3)
    assert {episode for episode, _ in alone} == {0, 1, 2}
    assert alone == together
