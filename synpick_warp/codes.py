"""How episodes and attempts end. Their codes live in device arrays; the enums' values are sentences for people."""

from __future__ import annotations

import enum
from typing import Self

ATTEMPTS_FILE = "attempts.jsonl"
"""Every attempt to pick, in the data set, by episode and number; a bake that only moves has none."""


class _Coded(enum.IntEnum):
    """An enum that is declared by its sentences; as a number, a member is its place in that order."""

    sentence: str

    def __new__(cls, sentence: str) -> Self:
        member = int.__new__(cls, len(cls.__members__))
        member._value_ = len(cls.__members__)
        member.sentence = sentence
        return member


class Ending(_Coded):
    """Why an episode stopped."""

    RUNNING = "the episode is still running"
    FINISHED = "the gripper has been everywhere it was to go"
    EMPTIED = "no object is left in the tote"
    GAVE_UP = "too many attempts have failed"
    UNSETTLED = "the objects did not come to rest in time, so the arrangement was drawn again"
    ARRANGEMENT_OVERFLOW = "more objects of a kind were drawn than a world has room for, so the arrangement was drawn again"
    SOLVER_OVERFLOW = "more contacts arose than the solver has room for, so the episode was drawn again"
    NOT_FINITE = "a pose became infinite or not a number, so the episode was drawn again"
    SIGHT_OVERFLOW = "a contour has more points than there is room for, so the episode was drawn again"

    @property
    def delivers(self) -> bool:
        """Whether an episode with this ending becomes part of the data set."""
        return self in (Ending.FINISHED, Ending.EMPTIED, Ending.GAVE_UP)


class Outcome(_Coded):
    """What came of an attempt to pick."""

    NONE = "no attempt has ended"
    TARGET_PICKED = "the target hung on the cup after the lift"
    OTHER_PICKED = "another object than the target hung on the cup after the lift"
    DROPPED = "every seal broke during the lift"
    NOTHING_CAUGHT = "no ray of the cup hit an object"
    NOTHING_SEEN = "no object in the tote is visible"

    @property
    def succeeded(self) -> bool:
        """Whether something was picked."""
        return self in (Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)
