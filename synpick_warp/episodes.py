"""What became of a bake's episodes: rows of the list, lines of the summary, and how both are read back from records."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from synpick_warp.attempts import EpisodeRecord
from synpick_warp.codes import Ending, Outcome
from synpick_warp.configs.schema import Config
from synpick_warp.frames import EpisodeEnd
from synpick_warp.stages.stream import TickReport

PLACES = 6
"""Decimal places of a time [s]; more would be noise."""


class EpisodeRow(NamedTuple):
    """One line of the summary."""

    episode: int
    redraw: int
    """How often the episode was drawn again before."""
    ending: Ending
    frames: int
    seconds: float
    """Simulated time from the first frame to the last [s]."""
    mode: str
    """What follows is 0 if the episode delivered nothing."""
    objects: int
    """At the first frame."""
    attempts: int
    picked: int
    """Objects."""
    lost: int
    """Objects that left the scene otherwise."""
    left: int
    """Objects at the last frame."""

    def as_json(self) -> dict[str, Any]:
        """As the data set's list of episodes has it."""
        row = {**self._asdict(), "ending": self.ending.name.lower()}
        return {**row, "sentence": self.ending.sentence}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> EpisodeRow:
        """From the data set's list of episodes."""
        values: dict[str, Any] = {name: row[name] for name in cls._fields}
        values["ending"] = Ending[row["ending"].upper()]
        return cls(**values)


@dataclass
class BakeSummary:
    """What a bake made, with what was there before it."""

    total: int = 0
    """Episodes that there are to be."""
    episodes: list[EpisodeRow] = field(default_factory=list)
    views: int = 0
    """Made by this bake."""
    wall_seconds: float = 0.0
    """From the first tick to the last file [s]."""
    redraws: int = 0
    """Arrangements that ended in a way that delivers nothing, and were drawn again."""
    redrawn: dict[Ending, int] = field(default_factory=dict)
    """The same, by ending."""
    remedies: dict[Ending, str] = field(default_factory=dict)
    """Advice against these endings, where a setting cures them; see `remedy`."""
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    """Attempts, by outcome."""
    resumed: int = 0
    """Episodes that were whole before."""
    stopped: int = 0
    """Number of the signal that stopped the bake before its end; 0: none."""

    def take_record(self, record: Mapping[str, Any]) -> None:
        """Count an episode that was whole before."""
        self.episodes.append(EpisodeRow.from_json(record["row"]))
        self.outcomes.update(Outcome[attempt["outcome"].upper()] for attempt in record["attempts"])
        self.resumed += 1

    def take_redraw(self, ending: Ending) -> None:
        """Count an arrangement that delivered nothing and will be drawn again."""
        self.redraws += 1
        self.redrawn[ending] = self.redrawn.get(ending, 0) + 1

    def take_episode(self, row: EpisodeRow, record: EpisodeRecord) -> None:
        """Count an episode that has ended."""
        self.episodes.append(row)
        self.episodes.sort()
        self.outcomes.update(attempt.outcome for attempt in record.attempts)


def episode_row(config: Config, report: TickReport, world: int, record: EpisodeRecord) -> EpisodeRow:
    """The row of the episode that ended in a world."""
    episode, redraw, frame, ending = (int(report.column(name)[world]) for name in ("episode", "redraw", "frame", "ending"))
    tick = config.physics.step * config.physics.steps_per_tick
    return EpisodeRow(
        episode,
        redraw,
        Ending(ending),
        frame + 1,
        round(max(0, frame) * tick, PLACES),
        record.mode,
        record.objects,
        len(record.attempts),
        record.picked,
        record.lost,
        record.left,
    )


def is_redrawn(config: Config, row: EpisodeRow) -> bool:
    """Whether the episode will come again, with another arrangement."""
    return not row.ending.delivers and row.redraw + 1 < config.settle.tries


def remedy(config: Config, ending: Ending) -> str:
    """Advice against an ending that is caused by a setting, with the current values; empty: no setting cures it."""
    physics, sight, settle = config.physics, config.sight, config.settle
    if ending is Ending.SOLVER_OVERFLOW:
        capacities = ("contacts_per_world", "pairs_per_world", "rows_per_world", "gripper_rows_per_world")
        return "raise " + " or ".join(f"physics.{name} ({getattr(physics, name)})" for name in capacities)
    if ending is Ending.SIGHT_OVERFLOW:
        return f"raise sight.contour_points ({sight.contour_points})"
    if ending is Ending.ARRANGEMENT_OVERFLOW:
        return f"lower arrangement.slot_shortfall ({config.arrangement.slot_shortfall:g})"
    if ending is Ending.UNSETTLED:
        return f"raise settle.max_time ({settle.max_time:g}) or settle.max_redrops ({settle.max_redrops})"
    return ""


def episode_end(config: Config, row: EpisodeRow, record: EpisodeRecord) -> EpisodeEnd:
    """What exporters are told of it."""
    if is_redrawn(config, row):
        return EpisodeEnd(row.episode, row.redraw, row.frames, int(row.ending))
    return EpisodeEnd(row.episode, row.redraw, row.frames, int(row.ending), row.as_json(), tuple(one.line() for one in record.attempts))
