"""Summaries of episodes and advice against endings that a setting causes."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import pytest

from synpick_warp.codes import Ending
from synpick_warp.configs.schema import Config
from synpick_warp.factory.episodes import remedy

CONFIG = Config()
SECTIONS = (CONFIG.physics, CONFIG.perception, CONFIG.arrangement, CONFIG.settle)
CURED = {Ending.UNSETTLED, Ending.ARRANGEMENT_OVERFLOW, Ending.SOLVER_OVERFLOW, Ending.PERCEPTION_OVERFLOW}


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
    assert len(named) == {Ending.SOLVER_OVERFLOW: 4, Ending.UNSETTLED: 2}.get(ending, int(bool(text)))


def test_a_solver_overflow_names_every_capacity_of_the_solver():
    capacities = {name for name in setting_values(Config()) if name.endswith("_per_world")}
    assert all(name in remedy(Ending.SOLVER_OVERFLOW, *SECTIONS) for name in capacities)
    assert len(capacities) == 4
