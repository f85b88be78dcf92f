"""Summaries of episodes and advice against endings that a setting causes."""

from __future__ import annotations

import json
from dataclasses import fields, is_dataclass

import numpy as np
import pytest

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import check_content
from synpick_warp.dataset.records import Row
from synpick_warp.factory.episodes import EpisodeOutcome, remedy
from synpick_warp.views.bins import bin_record

CONFIG = Config()
SECTIONS = (CONFIG.physics, CONFIG.perception, CONFIG.arrangement, CONFIG.settle)
OVERFLOWS = (Ending.SOLVER_OVERFLOW, Ending.CONTACT_OVERFLOW, Ending.PAIR_OVERFLOW)
CURED = {Ending.UNSETTLED, Ending.ARRANGEMENT_OVERFLOW, Ending.PERCEPTION_OVERFLOW, *OVERFLOWS}


def setting_values(config: Config) -> dict[str, object]:
    """Value of every setting by its key, section.name."""
    sections = {item.name: getattr(config, item.name) for item in fields(config) if is_dataclass(getattr(config, item.name))}
    return {f"{name}.{item.name}": getattr(section, item.name) for name, section in sections.items() for item in fields(section)}


@pytest.mark.parametrize("ending", Ending)
def test_a_remedy_names_settings_with_their_values(ending):
    text = remedy(ending, *SECTIONS)
    assert bool(text) == (ending in CURED)
    values = setting_values(Config())
    named = [word for word in text.split() if "." in word and "(" not in word]
    assert all(f"{name} ({values[name]:g})" in text for name in named)
    assert len(named) == {Ending.SOLVER_OVERFLOW: 2, Ending.UNSETTLED: 2}.get(ending, int(bool(text)))


def test_each_capacity_of_physics_is_named_after_one_overflow():
    capacities = [name for name in setting_values(Config()) if name.endswith("_per_world")]
    assert [sum(f"{name} (" in remedy(ending, *SECTIONS) for ending in OVERFLOWS) for name in capacities] == [1] * 4


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
