"""Structs of constants, filled from settings and derived values."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from synpick_warp.kernels.structs import ModeData
from synpick_warp.stages.constants import fill


def test_derived_values_come_before_sections_and_earlier_sections_before_later():
    first, second = SimpleNamespace(first=0, pick_share=0.25, cycle=0), SimpleNamespace(pick_share=0.5, pick_or_target_share=0.75)
    result = fill(ModeData, first, second)
    assert (float(result.pick_share), float(result.pick_or_target_share)) == (0.25, 0.75)
    assert float(fill(ModeData, first, second, pick_share=1.0).pick_share) == 1.0


def test_missing_and_unknown_members_are_errors():
    with pytest.raises(AttributeError, match=r"no value for ModeData\.pick_or_target_share"):
        fill(ModeData, first=0, pick_share=0.5, cycle=0)
    with pytest.raises(TypeError, match="wrong_name"):
        fill(ModeData, first=0, pick_share=0.5, pick_or_target_share=0.5, cycle=0, wrong_name=1)
