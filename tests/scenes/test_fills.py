"""Fills by `arrangement.counts`: what a table of parts may be, which objects it means, what does not fit, and the slots it takes."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.configs.files.load import load_config, parse_assignment
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Arrangement
from synpick_warp.errors import ConfigError
from synpick_warp.scenes import build
from synpick_warp.scenes.fills import check_fill, count_entries, drop_height
from tests.worlds.small_worlds import BOX, CUBE, PLATE, catalog

OBJECTS = catalog(BOX, CUBE, PLATE)
NAMES = [entry.name for entry in OBJECTS.entries]


def load(counts, **settings):
    return load_config("smoke", {"arrangement.counts": counts} | settings)


@pytest.mark.parametrize(
    ("counts", "rows"),
    [
        ({"bracket": 12}, (("bracket", 12, 12),)),
        ({"bolt": [4, 8], "nut": 8}, (("bolt", 4, 8), ("nut", 8, 8))),
        ([["a part", 0, 3], ["b", 1, 1]], (("a part", 0, 3), ("b", 1, 1))),
        ({}, ()),
    ],
)
def test_tables_and_lists_are_read_and_written(tmp_path, counts, rows):
    config = load(counts)
    assert config.arrangement.counts == rows
    (tmp_path / "same.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "same.toml")).arrangement.counts == rows


def test_the_command_line_takes_a_table():
    assert load_config("smoke", dict([parse_assignment("arrangement.counts={bracket=12}")])).arrangement.counts == (("bracket", 12, 12),)


@pytest.mark.parametrize(
    ("counts", "settings", "rule"),
    [
        (12, {}, "a table of parts"),
        ("bracket", {}, "a table of parts"),
        ({"bracket": "12"}, {}, "a table of parts"),
        ({"bracket": 1.5}, {}, "a table of parts"),
        ({"bracket": True}, {}, "a table of parts"),
        ({"bracket": [1, 2, 3]}, {}, "a table of parts"),
        ({"": 3}, {}, "a table of parts"),
        ({"bracket": 0}, {}, "numbers of at least 1"),
        ({"bracket": -1}, {}, "numbers of at least 1"),
        ({"bracket": [4, 2]}, {}, "numbers of at least 1"),
        ({"bracket": 2**31}, {}, "numbers of at least 1"),
        ([["bolt", 1, 1], ["bolt", 2, 2]], {}, "each part once"),
        ({"bracket": 25}, {}, "at most arrangement.max_objects, 24, together, which are 25"),
        ({"bolt": 12, "nut": [1, 13]}, {}, "which are 25"),
        ({"bolt": 20}, {"randomize.distractors": 6}, "24, less 6 distractors, together, which are 20"),
        ({"bolt": [0, 2], "nut": [0, 2]}, {}, "at least one part that each episode has"),
    ],
)
def test_what_no_fill_is_takes_one_line(counts, settings, rule):
    with pytest.raises(ConfigError, match=rule) as error:
        load(counts, **settings)
    assert "arrangement.counts" in str(error.value)
    assert "\n" not in str(error.value)


def test_parts_are_found_by_name_and_by_obj_id():
    first, _, last = OBJECTS.entries
    counts = ((last.name, 1, 4), (str(first.obj_id), 2, 2))
    np.testing.assert_array_equal(count_entries(counts, OBJECTS), [(2, 2), (0, 0), (1, 4)])
    assert not count_entries((), OBJECTS).any()


@pytest.mark.parametrize(
    ("counts", "line"),
    [
        (((f"{NAMES[1]}s", 1, 1),), f"which no object has.*{NAMES[0]}.*did you mean {NAMES[1]}"),
        (((NAMES[0], 1, 1), (str(OBJECTS.entries[0].obj_id), 1, 1)), "which is set already"),
    ],
)
def test_unknown_parts_are_named(counts, line):
    with pytest.raises(ConfigError, match=line):
        count_entries(counts, OBJECTS)


def test_more_than_the_bin_holds_is_refused():
    bins = load_config("smoke").cell.bins
    inside = bins[0].height * (np.prod(bins[0].floor) + np.prod(bins[0].opening)) / 2.0
    room = int(0.74 * inside / OBJECTS.entries[1].volume)
    few, many = (Arrangement(counts=((NAMES[1], 1, most),), drop="layers") for most in (room, room + 1))
    check_fill(few, 100.0, OBJECTS, bins)
    with pytest.raises(ConfigError, match="the tote has room for"):
        check_fill(many, 100.0, OBJECTS, bins)
    check_fill(many, 100.0, OBJECTS, load_config("tabletop").cell.bins)


def test_stacks_above_the_guide_walls_are_refused():
    """Known: cubes of 50 mm have spheres of 86.6 mm: in a column each takes 96.6 mm, over 545 x 352 mm a layer has 5 x 3 of them."""
    bins = load_config("smoke").cell.bins
    most, radius = np.array([0, 31, 0]), np.array([entry.radius for entry in OBJECTS.entries])
    column, layers = (Arrangement(counts=((NAMES[1], 31, 31),), drop=drop) for drop in ("column", "layers"))
    assert drop_height(most, radius, column, bins[0]) == pytest.approx(31 * 0.0966, rel=1e-3)
    assert drop_height(most, radius, layers, bins[0]) == pytest.approx(3 * 0.0966, rel=1e-3)
    check_fill(column, 3.0, OBJECTS, bins)
    check_fill(layers, 0.3, OBJECTS, bins)
    for arrangement, height, hint in ((column, 2.9, 'arrangement.drop = "layers"'), (layers, 0.28, "raise physics.guide_height")):
        with pytest.raises(ConfigError, match=hint):
            check_fill(arrangement, height, OBJECTS, bins)


def test_slots_are_those_of_the_largest_numbers():
    config = load(((NAMES[0], 3, 7), (NAMES[2], 1, 2)))
    assert build.count_slots(config.arrangement, [False], OBJECTS) == (9, 0)
    assert not build.must_repeat(config.arrangement, OBJECTS)
