"""Records of attempts from scripted ticks: each attempt once, with what was seen before it and what came of it."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Measure, Mode, Outcome, Task
from synpick_warp.configs.dataset.splits import may_pick
from synpick_warp.factory.attempts import AttemptLog, EpisodeRecord
from tests.worlds.scripted_worlds import CONFIG, OBJECT_IDS, RAYS, ROOM, Ticks, World, bits, new_world, play, report, run
from tests.worlds.small_worlds import settings


def every_outcome(world: World) -> Ticks:
    """Five attempts; one object is picked with the target, another alone, one is lost on the way, one is left."""
    world.settle(5, 0, Mode.PICK, [2, 0, 1, 1])
    yield
    world.first_frame()
    world.look(1)
    yield
    yield from world.attempt(
        0, [0.0, 9.0, 8.0], outcome=Outcome.TARGET_PICKED, hits=RAYS, engaged=bits(0, 1), attached=bits(1), catalog_index=[2, -1, 1, 1]
    )
    world.look(0)
    yield
    yield from world.attempt(1, [0.0, 3.0], outcome=Outcome.DROPPED, hits=RAYS - 2, engaged=bits(0), attached=0)
    world.look(0)
    yield
    yield from world.attempt(
        2, [0.0, 2.0, 1.0, 1.0], outcome=Outcome.OTHER_PICKED, hits=1, engaged=bits(0, 2), attached=bits(2), catalog_index=[2, -1, -1, 1]
    )
    world.look(3)
    yield
    # Instance 3 falls beside the tote in the meantime.
    world.catalog_index[0, 3] = -1
    yield from world.attempt(3, [0.0, 0.0], outcome=Outcome.NOTHING_CAUGHT, hits=0, engaged=0, attached=0)
    world.look(-1)
    yield
    # The columns still tell of the attempt before.
    world.now(hits=RAYS, engaged=bits(0))
    world.nothing_seen(4)
    world.over(Ending.GAVE_UP)
    yield


def redrawn(world: World) -> Ticks:
    """An arrangement that fails in the middle of its second attempt; then one of the same episode that moves on; then another episode."""
    world.settle(6, 0, Mode.PICK, [0, 1, -1, -1])
    yield
    world.first_frame()
    world.look(0)
    yield
    yield from world.attempt(0, [0.0, 6.0], outcome=Outcome.TARGET_PICKED, hits=RAYS, engaged=1, attached=1, catalog_index=[-1, 1, -1, -1])
    world.look(1)
    yield
    world.frame(task=Task.APPROACH, attempt=1)
    world.over(Ending.SOLVER_OVERFLOW)
    yield
    world.settle(6, 1, Mode.PICK, [1, 1, 1, -1])
    yield
    world.first_frame()
    world.look(2)
    yield
    yield from world.attempt(0, [0.0, 4.0], outcome=Outcome.DROPPED, hits=RAYS, engaged=bits(2), attached=0)
    world.over(Ending.GAVE_UP)
    yield
    world.settle(9, 19, Mode.TARGET, [0, -1, -1, -1])
    world.over(Ending.UNSETTLED)
    yield


def stir(world: World) -> Ticks:
    """A world that moves; an object is thrown out."""
    world.settle(8, 0, Mode.MOVE, [0, 1, 2, 0])
    yield
    world.first_frame()
    yield
    for entry in ([0, 1, 2, 0], [0, -1, 2, 0], [0, -1, 2, 0]):
        world.frame(catalog_index=entry, load=0.0)
        yield
    world.frame()
    world.over(Ending.FINISHED)
    yield


@pytest.fixture(scope="module")
def mixed(device) -> dict[tuple[int, int], EpisodeRecord]:
    scripts = (every_outcome, redrawn, stir)
    return run(*((world, make(world)) for world, make in ((new_world(device), make) for make in scripts)))


def by_number(found: dict[tuple[int, int], EpisodeRecord]) -> dict[int, EpisodeRecord]:
    """The last record of every episode."""
    return {episode: record for (_, episode), record in found.items()}


def test_every_attempt_has_its_outcome_once(mixed):
    attempts = by_number(mixed)[5].attempts
    assert [(one.attempt, one.outcome) for one in attempts] == list(
        enumerate(
            (
                Outcome.TARGET_PICKED,
                Outcome.DROPPED,
                Outcome.OTHER_PICKED,
                Outcome.NOTHING_CAUGHT,
                Outcome.NOTHING_SEEN,
            )
        )
    )
    # An attempt begins in the frame in which the one before ended.
    assert [one.frame for one in attempts] == [0, 6, 11, 18, 23]
    assert [one.end_frame for one in attempts] == [6, 11, 18, 23, 24]
    assert [one.peak_force for one in attempts] == [(0.0, 9.0, 8.0), (0.0, 3.0), (0.0, 2.0, 1.0, 1.0), (0.0, 0.0), ()]
    assert {(one.episode, one.mode, one.rays) for one in attempts} == {(5, "pick", RAYS)}


def test_caught_and_picked_are_the_attempts_own(mixed):
    attempts = by_number(mixed)[5].attempts
    assert [one.engaged for one in attempts] == [(0, 1), (0,), (0, 2), (), ()]
    assert [one.picked for one in attempts] == [(1,), (), (2,), (), ()]
    assert [one.hits for one in attempts] == [RAYS, RAYS - 2, 1, 0, 0]
    assert [one.good_seal for one in attempts] == [True, False, False, False, False]
    assert [(one.target, one.object_id) for one in attempts] == [(1, 3), (0, 21), (0, 21), (3, 8), (None, None)]


def test_with_a_vacuum_an_attempt_has_the_break_force_of_what_it_engaged(device, mixed):
    world, suction = new_world(device), settings(suction__vacuum=60.0).suction
    world.measures[0, Measure.BREAK_FORCE] = 12.5
    attempts = by_number(play({world: every_outcome(world)}, AttemptLog(suction, CONFIG.perception.resolution, OBJECT_IDS)))[5].attempts
    assert [json.loads(one.line()).get("break_force") for one in attempts] == [12.5] * 3 + [None] * 2
    assert {one.rays for one in attempts} == {48 + 256}
    assert "break_force" not in by_number(mixed)[5].attempts[0].line()


def test_an_attempt_keeps_what_its_own_look_saw(mixed):
    """Each look of the script adds 1 to all numbers; in the tick in which an attempt ends they are already those of the next."""
    attempts = by_number(mixed)[5].attempts
    assert [one.point for one in attempts] == [(number,) * 3 for number in (1.0, 2.0, 3.0, 4.0)] + [None]
    assert [one.tilt for one in attempts] == [1.0, 2.0, 3.0, 4.0, None]
    assert [one.observation.instances[0].visible_fraction for one in attempts] == [1.0, 2.0, 3.0, 4.0, 5.0]
    present = [[seen.instance for seen in one.observation.instances] for one in attempts]
    assert present == [[0, 1, 2, 3], [0, 2, 3], [0, 2, 3], [0, 3], [0]]
    assert attempts[0].observation.instances[0].object_id == 21


def test_a_look_that_found_nothing_has_no_grasp(mixed):
    record = json.loads(by_number(mixed)[5].attempts[-1].line())
    assert all(record[key] is None for key in ("target", "object_id", "point", "normal", "yaw", "tilt"))
    assert (record["hits"], record["good_seal"], record["engaged"], record["picked"], record["peak_force"]) == (0, False, [], [], [])


def test_objects_are_accounted_for(mixed):
    found = by_number(mixed)
    counts = {number: (one.mode, one.objects, len(one.attempts), one.picked, one.lost, one.left) for number, one in found.items()}
    assert counts == {
        5: ("pick", 4, 5, 2, 1, 1),
        6: ("pick", 3, 1, 0, 0, 3),
        8: ("move", 4, 0, 0, 1, 3),
        9: ("target", 0, 0, 0, 0, 0),
    }


def test_an_arrangement_that_is_drawn_again_leaves_no_attempt(mixed):
    first, second = (record for (_, episode), record in mixed.items() if episode == 6)
    assert first == EpisodeRecord("pick")
    (attempt,) = second.attempts
    assert (attempt.attempt, attempt.frame, attempt.target, attempt.outcome) == (0, 0, 2, Outcome.DROPPED)


def one_attempt(world: World, **found: object) -> Ticks:
    world.settle(0, 0, Mode.PICK, [0, 1, 2, 0] + [-1] * (world.room - ROOM))
    world.first_frame()
    world.look(0)
    yield
    yield from world.attempt(0, [0.0], **found)
    world.over(Ending.GAVE_UP)
    yield


@pytest.mark.parametrize(("room", "last"), [(32, 31), (33, 32), (251, 250)])
def test_the_last_instance_is_a_bit_like_the_others(device, room, last):
    world = World(CONFIG, device, room)
    script = one_attempt(world, outcome=Outcome.OTHER_PICKED, hits=1, engaged=bits(*{0, 31, last}), attached=bits(last))
    (record,) = run((world, script)).values()
    assert (record.attempts[0].engaged, record.attempts[0].picked) == (tuple(sorted({0, 31, last})), (last,))


@pytest.mark.parametrize(
    ("cups", "sealed", "good", "listed"),
    [(1, 1, True, None), (1, 0, False, None), (4, 0b1011, False, (0, 1, 3)), (4, 15, True, (0, 1, 2, 3))],
)
def test_a_good_seal_is_one_of_all_cups(device, cups, sealed, good, listed):
    world = new_world(device)
    log = AttemptLog(CONFIG.suction, CONFIG.perception.resolution, OBJECT_IDS, cups=cups)
    (record,) = play({world: one_attempt(world, outcome=Outcome.DROPPED, hits=3, sealed=sealed, attached=0)}, log).values()
    attempt = record.attempts[0]
    assert (attempt.good_seal, attempt.sealed, attempt.rays) == (good, listed, cups * RAYS)
    assert json.loads(attempt.line()).get("sealed") == (None if listed is None else list(listed))


def test_missing_reports_are_noticed(device):
    world, log = new_world(device), AttemptLog(CONFIG.suction, CONFIG.perception.resolution, OBJECT_IDS)
    world.settle(3, 0, Mode.PICK, [0, 1, 2, 0])
    world.first_frame()
    world.look(0)
    log.update(report([world]))
    world.frame(task=Task.LOOK, attempt=1, outcome=Outcome.DROPPED)
    with pytest.raises(ValueError, match="attempt 1 of episode 3 ends"):
        log.update(report([world]))


FAILED = (Outcome.DROPPED, Outcome.NOTHING_CAUGHT, Outcome.NOTHING_SEEN)
TRY = st.tuples(st.sampled_from(FAILED), st.lists(st.integers(0, 40).map(float), min_size=1, max_size=4))


@given(st.lists(st.tuples(st.integers(0, 3), st.lists(TRY, min_size=1, max_size=4)), min_size=1, max_size=3))
def test_worlds_do_not_disturb_each_other(device, plans):
    """Any attempts, in worlds that begin at different times."""
    expected = {}

    def script(world: World, episode: int, delay: int, tries: list[tuple[Outcome, list[float]]]) -> Ticks:
        for _ in range(1 + delay):
            world.settle(episode, 0, Mode.PICK, [0, 1, -1, -1])
            yield
        world.first_frame()
        frame, known = 0, []
        for number, (outcome, loads) in enumerate(tries):
            seen = outcome is not Outcome.NOTHING_SEEN
            world.look(0 if seen else -1)
            yield
            if seen:
                yield from world.attempt(number, loads, outcome=outcome, attached=0)
            else:
                world.nothing_seen(number)
            last = frame + (3 + len(loads) if seen else 1)
            known.append((number, outcome, frame, last, tuple(loads) if seen else ()))
            frame = last
        expected[episode] = known
        world.over(Ending.GAVE_UP)
        yield

    made = [new_world(device) for _ in plans]
    found = run(*((world, script(world, episode, *plan)) for episode, (world, plan) in enumerate(zip(made, plans, strict=True))))
    records = {
        episode: [(a.attempt, a.outcome, a.frame, a.end_frame, a.peak_force) for a in one.attempts] for (_, episode), one in found.items()
    }
    assert records == expected


@pytest.mark.parametrize(
    ("mode", "mix", "expected"),
    [
        ("pick", [0, 0, 1], True),
        ("target", [0, 0, 1], True),
        ("move", [1, 1, 1], False),
        ("mixed", [0, 0, 1], False),
        ("mixed", [0, 2, 1], True),
        ("cycle", [0, 0, 1], True),
    ],
)
def test_which_bakes_may_pick(mode, mix, expected):
    config = settings(bake__mode=mode, bake__mix=mix)
    assert may_pick(config.bake, config.splits) is expected
