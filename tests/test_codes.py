"""Outcomes: sentences for people, codes for device arrays."""

from __future__ import annotations

import pytest

from synpick_warp.codes import Ending, Outcome
from synpick_warp.kernels import phases


@pytest.mark.parametrize("kind", [Ending, Outcome])
def test_every_code_has_a_sentence_of_its_own(kind):
    sentences = [code.sentence for code in kind]
    assert len(set(sentences)) == len(sentences)
    for sentence in sentences:
        assert sentence[0].islower()
        assert sentence[-1].isalnum()
        assert "\n" not in sentence


def test_which_endings_deliver():
    delivering = [ending for ending in Ending if ending.delivers]
    assert delivering == [Ending.FINISHED, Ending.EMPTIED, Ending.GAVE_UP]
    # kernels.phases.delivers relies on their standing side by side.
    assert delivering == list(range(delivering[0], delivering[-1] + 1))


def test_which_outcomes_succeed():
    assert [outcome for outcome in Outcome if outcome.succeeded] == [Outcome.TARGET_PICKED, Outcome.OTHER_PICKED]


@pytest.mark.parametrize("kind", [Ending, Outcome])
def test_codes_are_the_same_on_both_sides(kind):
    prefix = f"{kind.__name__.upper()}_"
    device = {name.removeprefix(prefix): value for name, value in vars(phases).items() if name.startswith(prefix)}
    assert {code.name: int(code) for code in kind} == device
    assert kind(0).name in ("RUNNING", "NONE"), "a new array's zero means that nothing has ended"
