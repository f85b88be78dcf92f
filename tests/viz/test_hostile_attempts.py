"""Hostile records of attempts: `explain` reads them, or names the line; what is read can be drawn."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.apps.viz.explain import draw_words, load_chart
from synpick_warp.apps.viz.explain_graph import clutter_edges, draw_graph, lay_out
from synpick_warp.apps.viz.explain_record import MAX_ATTEMPTS, SeenAttempt, read_attempts
from synpick_warp.configs.files.load import load_config
from synpick_warp.dataset.records import MAX_OBSERVED
from synpick_warp.errors import DatasetError
from tests.harness.charts import picture_of
from tests.harness.fuzz import fuzz_examples
from tests.harness.hostile import LEAVES, hostile_contents, places, removed, replaced
from tests.worlds.attempt_records import record, seen_object

PILE = [seen_object(2, 7, (50, 38), above=[3], ancestors=[3]), seen_object(3, 7, (20, 30)), seen_object(5, 1, (70, 60))]
RECORD = record(PILE, observation={"resolution": [96, 72], "instances": PILE, "votes": [[2, 3, 12.0], [5, 3, 2.5]]})
CONFIG = load_config("smoke", {})
SECONDS = 5.0
VALUES = (
    st.sampled_from(LEAVES) | st.integers() | st.floats() | st.text(max_size=30) | st.lists(st.integers(0, 5) | st.floats(0, 9), max_size=4)
)


def draw(attempt: SeenAttempt) -> None:
    """Draw all panels that need no image."""
    draw_words(attempt, {7: "tin"}, (CONFIG.target, CONFIG.pick), CONFIG.suction)
    assert picture_of(load_chart(attempt, CONFIG.suction, CONFIG.physics.tick_time, 800, 200), 1.0).shape == (200, 800, 3)
    draw_graph(attempt, CONFIG.perception.min_votes, (500, 640))


def read_and_draw(folder: Path, line: bytes) -> None:
    (folder / "attempts.jsonl").write_bytes(line + b"\n")
    try:
        for attempt in read_attempts(folder, 0, None):
            draw(attempt)
    except DatasetError as error:
        assert str(error).isprintable()  # noqa: PT017


def test_the_record_itself_is_drawn(tmp_path):
    (tmp_path / "attempts.jsonl").write_text(json.dumps(RECORD) + "\n")
    [attempt] = read_attempts(tmp_path, 0, None)
    draw(attempt)
    assert len(clutter_edges(attempt, CONFIG.perception.min_votes)) > 0


@settings(max_examples=fuzz_examples(200), deadline=None)
@given(st.lists(st.tuples(st.integers(0, 10**6), VALUES, st.booleans()), min_size=1, max_size=3))
def test_changed_records_are_drawn_or_named(tmp_path_factory, changes):
    content: Any = RECORD
    for spot, value, gone in changes:
        where = list(places(content))
        place = where[spot % len(where)]
        content = removed(content, place) if gone else replaced(content, place, value)
    read_and_draw(tmp_path_factory.getbasetemp(), json.dumps(content).encode())


@pytest.mark.parametrize("part", range(4))
def test_hostile_lines_are_drawn_or_named(tmp_path, part):
    for number, (_, content) in enumerate(hostile_contents(json.dumps(RECORD).encode())):
        if number % 16 == part:
            read_and_draw(tmp_path, content)


@pytest.mark.parametrize("point", [{"pole": [1e300, 3]}, {"grasp_pixel": [2**31 - 1, 3]}])
def test_a_point_outside_of_the_image_is_named(tmp_path, point):
    one = seen_object(2, 7, (50, 38), **point)
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record([one])))
    with pytest.raises(DatasetError, match="line 1, is damaged: a point of instance 2 is not in the image of 96 x 72"):
        read_attempts(tmp_path, 0, None)


def test_a_graph_of_all_edges_ends(tmp_path):
    """More objects than a world can have are refused where they are read."""
    pile = [seen_object(index, 1, (index % 80, 30), above=list(range(index))) for index in range(MAX_OBSERVED + 1)]
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record(pile)))
    with pytest.raises(DatasetError, match=f"expected array of length <= {MAX_OBSERVED}"):
        read_attempts(tmp_path, 0, None)
    (tmp_path / "attempts.jsonl").write_text(json.dumps(record(pile[:MAX_OBSERVED])))
    [attempt] = read_attempts(tmp_path, 0, None)
    started = time.monotonic()
    with pytest.raises(DatasetError, match="has too many edges to be drawn"):
        lay_out(attempt, clutter_edges(attempt, 1.0), (500, 640))
    assert time.monotonic() - started < SECONDS


def test_a_figure_has_a_limited_number_of_attempts(tmp_path):
    lines = [json.dumps(RECORD | {"attempt": number}) for number in range(MAX_ATTEMPTS + 1)]
    (tmp_path / "attempts.jsonl").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match="has 101 attempts of episode 0; a figure has at most 100: name one by --attempt"):
        read_attempts(tmp_path, 0, None)
    assert len(read_attempts(tmp_path, 0, 100)) == 1


def test_a_list_of_many_episodes_is_shortened(tmp_path):
    lines = [json.dumps({"episode": 2 * number, "attempt": 0}) for number in range(1000)]
    (tmp_path / "attempts.jsonl").write_text("\n".join(lines))
    with pytest.raises(DatasetError, match=r"episodes that have: 0, 2, .*, 38, \.\.\.$"):
        read_attempts(tmp_path, 1, None)
