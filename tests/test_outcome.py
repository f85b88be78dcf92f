"""Outcomes: sentences for people, codes for device arrays."""

from __future__ import annotations

import pytest

from synpick_warp.outcome import Outcome


@pytest.mark.parametrize("outcome", list(Outcome), ids=lambda outcome: outcome.name)
def test_every_outcome_has_a_sentence_of_its_own(outcome):
    assert outcome.sentence[0].islower()
    assert outcome.sentence[-1].isalnum()
    assert "\n" not in outcome.sentence
    assert [other.sentence for other in Outcome].count(outcome.sentence) == 1


def test_only_a_finished_episode_delivers():
    assert [outcome for outcome in Outcome if outcome.delivers] == [Outcome.FINISHED]


def test_codes_stay_as_they_are():
    """They stand in the logs of bakes; a new array's zero means that nothing has ended."""
    assert [(outcome.name, int(outcome)) for outcome in Outcome] == [
        ("RUNNING", 0), ("FINISHED", 1), ("UNSETTLED", 2), ("ARRANGEMENT_OVERFLOW", 3), ("SOLVER_OVERFLOW", 4), ("NOT_FINITE", 5)
    ]
