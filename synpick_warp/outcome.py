"""How an episode ended. Codes live in device arrays; their sentences are for people."""

from __future__ import annotations

import enum


class Outcome(enum.IntEnum):
    """Why an episode stopped. `describe` gives the sentence."""

    RUNNING = 0
    FINISHED = 1
    UNSETTLED = 2
    ARRANGEMENT_OVERFLOW = 3
    SOLVER_OVERFLOW = 4
    NOT_FINITE = 5

    @property
    def sentence(self) -> str:
        return _SENTENCES[self]

    @property
    def delivers(self) -> bool:
        """Whether an episode with this outcome becomes part of the data set."""
        return self is Outcome.FINISHED


_SENTENCES = {
    Outcome.RUNNING: "the episode is still running",
    Outcome.FINISHED: "the gripper did all it was to do",
    Outcome.UNSETTLED: "the objects did not come to rest in time, so the arrangement was drawn again",
    Outcome.ARRANGEMENT_OVERFLOW: "more objects of a kind were drawn than a world has room for, so the arrangement was drawn again",
    Outcome.SOLVER_OVERFLOW: "more contacts arose than the solver has room for, so the episode was drawn again",
    Outcome.NOT_FINITE: "a pose became infinite or not a number, so the episode was drawn again",
}
