"""The record of one attempt and its line of attempts.jsonl, field by field."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.apps.viz.explain_record import read_attempts
from synpick_warp.codes import Ending, Mode, Outcome
from synpick_warp.factory.attempts import AttemptRecord, EpisodeRecord, ObservationRecord, ObservedInstance
from tests.worlds.scripted_worlds import RAYS, ROOM, Ticks, World, bits, new_world, run


def see_a_pair(world: World) -> None:
    """Instances 1 and 3 are in the scene, 3 on top of 1, with numbers that need rounding; 0 and 2 have what an earlier pile left."""
    seen, plan = world.observation, world.plan
    for arrays in (seen, plan):
        for array in vars(arrays).values():
            array[:] = 7
    seen.visible[0, [1, 3]] = 120, 0
    seen.visible_fraction[0, [1, 3]] = 1.0 / 3.0, 0.0
    seen.pole[0, [1, 3]] = (10.0, 20.0), (-1.0, -1.0)
    seen.centroid[0, [1, 3]] = (12.3456789, 21.0), (-1.0, -1.0)
    seen.midpoint[0, [1, 3]] = (11.17283945, 20.5), (-1.0, -1.0)
    seen.distances[0, [1, 3]] = (5.0, 4.4721359, -0.0), (0.0, 0.0, 0.0)
    seen.grasp_pixel[0, [1, 3]] = (11, 21), (-1, -1)
    seen.depth[0, [1, 3]] = 1.98765432, 0.0
    seen.votes[0][np.ix_([1, 3], [1, 3])] = [[0.0, 12.3], [0.1, 0.0]]
    seen.above[0, [1, 3], 0] = bits(3), 0
    seen.ancestors[0, [1, 3], 0] = bits(0, 3), 0
    plan.target[0] = 1
    plan.point[0] = 0.1, -0.2, 0.0345678912
    plan.normal[0] = -3.0e-9, 0.6, 0.8
    plan.yaw[0], plan.tilt[0] = -1.23456789, 0.0


PAIR = ObservationRecord(
    (64, 48),
    (
        ObservedInstance(
            1, 21, 120, 0.333333, (10.0, 20.0), (12.3457, 21.0), (11.1728, 20.5), (5.0, 4.47214, 0.0), (11, 21), 1.98765, (3,), (0, 3)
        ),
        ObservedInstance(3, 3, 0, 0.0, (-1.0, -1.0), (-1.0, -1.0), (-1.0, -1.0), (0.0, 0.0, 0.0), (-1, -1), 0.0, (), ()),
    ),
    ((1, 3, 12.3), (3, 1, 0.1)),
)


def pick_one(world: World) -> Ticks:
    """Settle for two ticks; one attempt on instance 1, which comes away with 3 behind it; the tote is empty."""
    for _ in range(2):
        world.settle(7, 2, Mode.TARGET, [-1, 2, -1, 0])
        yield
    world.first_frame()
    see_a_pair(world)
    yield
    yield from world.attempt(
        0,
        [0.0, 5.00004, 4.99996, 3.5],
        outcome=Outcome.TARGET_PICKED,
        hits=RAYS - 1,
        engaged=bits(1, 3),
        attached=bits(1, 3),
        catalog_index=[-1] * ROOM,
    )
    world.over(Ending.EMPTIED)
    yield


@pytest.fixture(scope="module")
def picked(device) -> EpisodeRecord:
    world = new_world(device)
    found = run((world, pick_one(world)))
    # Two ticks of settling, the look, three on the way and three of lifting come before.
    assert list(found) == [(9, 7)]
    return found[9, 7]


def test_a_record_says_all_that_was_seen_and_done(picked):
    (attempt,) = picked.attempts
    assert attempt == AttemptRecord(
        episode=7,
        attempt=0,
        mode="target",
        frame=0,
        end_frame=7,
        outcome=Outcome.TARGET_PICKED,
        target=1,
        object_id=21,
        point=(0.1, -0.2, 0.034568),
        normal=(0.0, 0.6, 0.8),
        yaw=-1.23457,
        tilt=0.0,
        rays=RAYS,
        hits=RAYS - 1,
        good_seal=True,
        engaged=(1, 3),
        picked=(1, 3),
        peak_force=(0.0, 5.0, 5.0, 3.5),
        observation=PAIR,
    )
    assert (picked.mode, picked.objects, picked.picked, picked.lost, picked.left) == ("target", 2, 2, 0, 0)


def test_a_line_is_json_with_the_keys_of_the_format(picked):
    line = picked.attempts[0].line()
    assert line.endswith("}\n")
    assert line.count("\n") == 1
    record = json.loads(line)
    assert list(record) == [
        "episode",
        "attempt",
        "mode",
        "frame",
        "end_frame",
        "outcome",
        "sentence",
        "target",
        "object_id",
        "point",
        "normal",
        "yaw",
        "tilt",
        "rays",
        "hits",
        "good_seal",
        "engaged",
        "picked",
        "peak_force",
        "observation",
    ]
    assert (record["outcome"], record["sentence"]) == ("target_picked", Outcome.TARGET_PICKED.sentence)
    assert (record["point"], record["engaged"], record["peak_force"]) == ([0.1, -0.2, 0.034568], [1, 3], [0.0, 5.0, 5.0, 3.5])
    assert record["good_seal"] is True
    assert "-0.0," not in line
    sight = record["observation"]
    assert (sight["resolution"], sight["votes"]) == ([64, 48], [[1, 3, 12.3], [3, 1, 0.1]])
    assert sight["instances"][0] == {
        "instance": 1,
        "object_id": 21,
        "visible": 120,
        "visible_fraction": 0.333333,
        "pole": [10.0, 20.0],
        "centroid": [12.3457, 21.0],
        "midpoint": [11.1728, 20.5],
        "distances": [5.0, 4.47214, 0.0],
        "grasp_pixel": [11, 21],
        "depth": 1.98765,
        "above": [3],
        "ancestors": [0, 3],
    }


@pytest.mark.parametrize(
    ("name", "place"), [(None, "in the tote"), ("tote", "in the tote"), ("pallet", "on the pallet"), ("kanban", "in the bin")]
)
def test_a_line_names_the_bin_of_its_episode(picked, name, place):
    unseen = replace(picked.attempts[0], outcome=Outcome.NOTHING_SEEN)
    record = None if name is None else {"name": name, "position": [0.0, 0.0, 0.0], "yaw": 0.0}
    assert json.loads(unseen.line(record))["sentence"] == f"no object {place} is visible"


def test_explain_reads_what_is_written(picked, tmp_path):
    (attempt,) = picked.attempts
    (tmp_path / "attempts.jsonl").write_text(attempt.line())
    (read,) = read_attempts(tmp_path, 7, None)
    for name in ("mode", "frame", "end_frame", "target", "tilt", "rays", "hits", "good_seal"):
        assert getattr(read, name) == getattr(attempt, name), name
    for name in ("engaged", "picked", "peak_force"):
        assert tuple(getattr(read, name)) == getattr(attempt, name), name
    assert (read.attempt, read.sentence, read.observation.resolution) == (0, attempt.outcome.sentence, (64, 48))
    assert [one.instance for one in read.seen] == [1], "3 was not visible"
    assert read.seen[0].distances == attempt.observation.instances[0].distances
    assert read.votes == {(1, 3): 12.3, (3, 1): 0.1}


def test_what_is_not_finite_does_not_become_json(device):
    world = new_world(device)

    def script() -> Ticks:
        world.settle(0, 0, Mode.PICK, [0, 1, 2, 0])
        world.first_frame()
        world.look(0)
        world.plan.tilt[0] = np.nan
        yield
        yield from world.attempt(0, [1.0], outcome=Outcome.DROPPED)
        world.over(Ending.GAVE_UP)
        yield

    (record,) = run((world, script())).values()
    with pytest.raises(ValueError, match="JSON"):
        record.attempts[0].line()
