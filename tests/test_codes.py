"""Outcomes: sentences for people, codes for device arrays."""

from __future__ import annotations

import pytest

from synpick_warp.codes import Ending, Outcome, Phase, Task


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
    # `delivers` of kernels.sim.endings relies on their being consecutive.
    assert delivering == list(range(delivering[0], delivering[-1] + 1))


def test_which_outcomes_succeed():
    assert [outcome for outcome in Outcome if outcome.succeeded] == [Outcome.TARGET_PICKED, Outcome.OTHER_PICKED]


def test_a_new_array_means_that_nothing_has_ended():
    assert (Ending(0), Outcome(0), Task(0), Phase(0)) == (Ending.RUNNING, Outcome.NONE, Task.NONE, Phase.EMPTY)
