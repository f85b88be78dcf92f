"""Records of attempts from scripted ticks, each once, with what was seen before it and what came of it; codes and rows of episodes."""

import json
from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from synpick_warp.apps.viz.explain_record import read_attempts
from synpick_warp.codes import Ending, Measure, Mode, Outcome, Phase, Task
from synpick_warp.configs.dataset import may_pick
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import Row, check_content
from synpick_warp.factory.attempts import AttemptLog, EpisodeRecord
from synpick_warp.factory.episodes import EpisodeOutcome, encode_line, remedy
from synpick_warp.views.frames import bin_record
from tests.worlds.scripted_worlds import CONFIG, OBJECT_IDS, RAYS, ROOM, Ticks, World, bits, new_world, play, report, run
from tests.worlds.small_worlds import settings


def every_outcome(world: World) -> Ticks:
    """Five attempts; one object is picked with the target, another alone, one is lost on the way, one is left."""
    yield from world.begin(5, 0, Mode.PICK, [2, 0, 1, 1], 1)
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
    yield from world.begin(6, 0, Mode.PICK, [0, 1, -1, -1], 0)
    yield from world.attempt(0, [0.0, 6.0], outcome=Outcome.TARGET_PICKED, hits=RAYS, engaged=1, attached=1, catalog_index=[-1, 1, -1, -1])
    world.look(1)
    yield
    world.frame(task=Task.APPROACH, attempt=1)
    world.over(Ending.SOLVER_OVERFLOW)
    yield
    yield from world.begin(6, 1, Mode.PICK, [1, 1, 1, -1], 2)
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


def test_every_attempt_is_there_once_with_what_it_caught_and_picked(mixed):
    """An attempt begins in the frame in which the one before ended."""
    assert [
        (one.outcome, one.frame, one.end_frame, one.peak_force, one.engaged, one.picked, one.hits, one.good_seal, one.target, one.object_id)
        for one in by_number(mixed)[5].attempts
    ] == [
        ("target_picked", 0, 6, [0.0, 9.0, 8.0], [0, 1], [1], RAYS, True, 1, 3),
        ("dropped", 6, 11, [0.0, 3.0], [0], [], RAYS - 2, False, 0, 21),
        ("other_picked", 11, 18, [0.0, 2.0, 1.0, 1.0], [0, 2], [2], 1, False, 0, 21),
        ("nothing_caught", 18, 23, [0.0, 0.0], [], [], 0, False, 3, 8),
        ("nothing_seen", 23, 24, [], [], [], 0, False, None, None),
    ]
    found = [(one.episode, one.attempt, one.mode, one.rays) for one in by_number(mixed)[5].attempts]
    assert found == [(5, number, "pick", RAYS) for number in range(5)]


def test_with_a_vacuum_an_attempt_has_the_break_force_of_what_it_engaged(device, mixed):
    world, suction = new_world(device), settings(suction__vacuum=60.0).suction
    world.measures[0, Measure.BREAK_FORCE] = 12.5
    attempts = by_number(play({world: every_outcome(world)}, AttemptLog(suction, CONFIG.perception.resolution, OBJECT_IDS)))[5].attempts
    assert [json.loads(encode_line(one)).get("break_force") for one in attempts] == [12.5] * 3 + [None] * 2
    assert {one.rays for one in attempts} == {48 + 256}
    assert "break_force" not in encode_line(by_number(mixed)[5].attempts[0])


def test_an_attempt_keeps_what_its_own_look_saw(mixed):
    """Each look of the script adds 1 to all numbers; in the tick in which an attempt ends they are already those of the next."""
    attempts = by_number(mixed)[5].attempts
    assert [one.point for one in attempts] == [[number] * 3 for number in (1.0, 2.0, 3.0, 4.0)] + [None]
    assert [one.tilt for one in attempts] == [1.0, 2.0, 3.0, 4.0, None]
    assert [one.observation.instances[0].visible_fraction for one in attempts] == [1.0, 2.0, 3.0, 4.0, 5.0]
    present = [[seen.instance for seen in one.observation.instances] for one in attempts]
    assert present == [[0, 1, 2, 3], [0, 2, 3], [0, 2, 3], [0, 3], [0]]
    assert attempts[0].observation.instances[0].object_id == 21


def test_a_look_that_found_nothing_has_no_grasp(mixed):
    record = json.loads(encode_line(by_number(mixed)[5].attempts[-1]))
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
    assert (attempt.attempt, attempt.frame, attempt.target, attempt.outcome) == (0, 0, 2, "dropped")


def one_attempt(world: World, **found: object) -> Ticks:
    yield from world.begin(0, 0, Mode.PICK, [0, 1, 2, 0] + [-1] * (world.room - ROOM), 0)
    yield from world.attempt(0, [0.0], **found)
    world.over(Ending.GAVE_UP)
    yield


@pytest.mark.parametrize(("room", "last"), [(32, 31), (33, 32), (251, 250)])
def test_the_last_instance_is_a_bit_like_the_others(device, room, last):
    world = World(CONFIG, device, room)
    script = one_attempt(world, outcome=Outcome.OTHER_PICKED, hits=1, engaged=bits(*{0, 31, last}), attached=bits(last))
    (record,) = run((world, script)).values()
    assert (record.attempts[0].engaged, record.attempts[0].picked) == (sorted({0, 31, last}), [last])


@pytest.mark.parametrize(
    ("cups", "sealed", "good", "listed"),
    [(1, 1, True, None), (1, 0, False, None), (4, 0b1011, False, [0, 1, 3]), (4, 15, True, [0, 1, 2, 3])],
)
def test_a_good_seal_is_one_of_all_cups(device, cups, sealed, good, listed):
    world = new_world(device)
    log = AttemptLog(CONFIG.suction, CONFIG.perception.resolution, OBJECT_IDS, cups=cups)
    (record,) = play({world: one_attempt(world, outcome=Outcome.DROPPED, hits=3, sealed=sealed, attached=0)}, log).values()
    attempt = record.attempts[0]
    assert (attempt.good_seal, attempt.sealed, attempt.rays) == (good, listed, cups * RAYS)
    assert json.loads(encode_line(attempt)).get("sealed") == listed


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
            known.append((number, outcome.name.lower(), frame, last, loads if seen else []))
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


# ---- a record, field by field ----


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
    assert list(found) == [(9, 7)]
    return found[9, 7]


OBSERVATION = {
    "resolution": [64, 48],
    "instances": [
        {
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
        },
        {
            "instance": 3,
            "object_id": 3,
            "visible": 0,
            "visible_fraction": 0.0,
            "pole": [-1.0, -1.0],
            "centroid": [-1.0, -1.0],
            "midpoint": [-1.0, -1.0],
            "distances": [0.0, 0.0, 0.0],
            "grasp_pixel": [-1, -1],
            "depth": 0.0,
            "above": [],
            "ancestors": [],
        },
    ],
    "votes": [[1, 3, 12.3], [3, 1, 0.1]],
}
LINE = {
    "episode": 7,
    "attempt": 0,
    "mode": "target",
    "frame": 0,
    "end_frame": 7,
    "outcome": "target_picked",
    "sentence": Outcome.TARGET_PICKED.sentence,
    "target": 1,
    "object_id": 21,
    "point": [0.1, -0.2, 0.034568],
    "normal": [0.0, 0.6, 0.8],
    "yaw": -1.23457,
    "tilt": 0.0,
    "rays": RAYS,
    "hits": RAYS - 1,
    "good_seal": True,
    "engaged": [1, 3],
    "picked": [1, 3],
    "peak_force": [0.0, 5.0, 5.0, 3.5],
    "observation": OBSERVATION,
}


def test_a_line_says_all_that_was_seen_and_done(picked):
    """Two ticks of settling, the look, three on the way and three of lifting come before; keys are in the order of the format."""
    assert (picked.mode, picked.objects, picked.picked, picked.lost, picked.left) == ("target", 2, 2, 0, 0)
    (attempt,) = picked.attempts
    assert encode_line(attempt) == json.dumps(LINE) + "\n"


@pytest.mark.parametrize(
    ("name", "place"), [(None, "in the tote"), ("tote", "in the tote"), ("pallet", "on the pallet"), ("kanban", "in the bin")]
)
def test_a_line_names_the_bin_of_its_episode(picked, name, place):
    unseen = replace(picked.attempts[0], sentence=Outcome.NOTHING_SEEN.sentence)
    record = None if name is None else {"name": name, "position": [0.0, 0.0, 0.0], "yaw": 0.0}
    assert json.loads(encode_line(unseen, record))["sentence"] == f"no object {place} is visible"


def test_explain_reads_what_is_written(picked, tmp_path):
    (attempt,) = picked.attempts
    (tmp_path / "attempts.jsonl").write_text(encode_line(attempt))
    (read,) = read_attempts(tmp_path, 7, None)
    for name in ("attempt", "sentence", "mode", "frame", "end_frame", "target", "tilt", "rays", "hits", "good_seal", "engaged", "picked"):
        assert getattr(read, name) == getattr(attempt, name), name
    assert (read.peak_force, read.observation.resolution) == (attempt.peak_force, (64, 48))
    assert [one.instance for one in read.seen] == [1], "3 was not visible"
    assert list(read.seen[0].distances) == attempt.observation.instances[0].distances
    assert read.votes == {(1, 3): 12.3, (3, 1): 0.1}


def test_what_is_not_finite_does_not_become_json(device):
    world = new_world(device)
    world.plan.tilt[0] = np.nan
    (record,) = run((world, one_attempt(world, outcome=Outcome.DROPPED))).values()
    with pytest.raises(ValueError, match="JSON"):
        encode_line(record.attempts[0])


# ---- episodes ----


DEFAULTS = Config()
OVERFLOWS = (Ending.SOLVER_OVERFLOW, Ending.CONTACT_OVERFLOW, Ending.PAIR_OVERFLOW)
CURED = {Ending.UNSETTLED, Ending.ARRANGEMENT_OVERFLOW, Ending.PERCEPTION_OVERFLOW, *OVERFLOWS}


def setting_values(config: Config) -> dict[str, object]:
    """Value of every setting by its key, section.name."""
    sections = {item.name: getattr(config, item.name) for item in fields(config) if is_dataclass(getattr(config, item.name))}
    return {f"{name}.{item.name}": getattr(section, item.name) for name, section in sections.items() for item in fields(section)}


@pytest.mark.parametrize("ending", Ending)
def test_a_remedy_names_settings_with_their_values(ending):
    text = remedy(ending, DEFAULTS)
    assert bool(text) == (ending in CURED)
    values = setting_values(DEFAULTS)
    named = [word for word in text.split() if "." in word and "(" not in word]
    assert all(f"{name} ({values[name]:g})" in text for name in named)
    assert len(named) == {Ending.SOLVER_OVERFLOW: 2, Ending.UNSETTLED: 2}.get(ending, int(bool(text)))


def test_each_capacity_of_physics_is_named_after_one_overflow():
    capacities = [name for name in setting_values(Config()) if name.endswith("_per_world")]
    assert [sum(f"{name} (" in remedy(ending, DEFAULTS) for ending in OVERFLOWS) for name in capacities] == [1] * 4


@pytest.mark.parametrize(
    ("name", "place"), [("", "in the tote"), ("tote", "in the tote"), ("table", "on the table"), ("kanban", "in the bin")]
)
def test_rows_of_episodes_have_their_bin_unless_it_is_a_tote_in_its_place(name, place):
    record = bin_record(name, np.array([0.1, -0.2, 0.0, 0.0, 0.0, -0.5, np.sqrt(0.75)], np.float32)) if name else None
    assert record is None or record == {"name": name, "position": [0.1, -0.2, 0.0], "yaw": pytest.approx(-np.pi / 3, abs=1e-6)}
    row = EpisodeOutcome(3, 1, Ending.EMPTIED, 10, 0.6, "pick", 3, 3, 3, 0, 0, "val", bin=record)
    line = row.as_json()
    assert ("bin" in line) == bool(name)
    assert line["sentence"] == f"no object is left {place}"
    assert EpisodeOutcome.from_json(line) == row
    assert check_content(json.loads(json.dumps(line)), Row, "a line").split == "val"


@pytest.mark.parametrize("kind", [Ending, Outcome])
def test_every_code_has_a_sentence_of_its_own(kind):
    sentences = [code.sentence for code in kind]
    assert len(set(sentences)) == len(sentences)
    for sentence in sentences:
        assert sentence[0].islower()
        assert sentence[-1].isalnum()
        assert "\n" not in sentence


def test_what_codes_stand_for():
    delivering = [ending for ending in Ending if ending.delivers]
    assert delivering == [Ending.FINISHED, Ending.EMPTIED, Ending.GAVE_UP]
    # `delivers` of kernels.sim.endings relies on their being consecutive.
    assert delivering == list(range(delivering[0], delivering[-1] + 1))
    assert [outcome for outcome in Outcome if outcome.succeeded] == [Outcome.TARGET_PICKED, Outcome.OTHER_PICKED]
    # In a new array nothing has ended.
    assert (Ending(0), Outcome(0), Task(0), Phase(0)) == (Ending.RUNNING, Outcome.NONE, Task.NONE, Phase.EMPTY)
