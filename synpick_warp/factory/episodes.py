"""What a bake begins with, source of episodes, completed settings and writers; its episode rows, summary and throughput."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import msgspec

from synpick_warp.codes import Ending, Outcome
from synpick_warp.configs.files.load import override_config
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.annotations import Attempt
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH
from synpick_warp.scenes.bin_meshes.loading import measure_meshes
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.device import pick_devices
from synpick_warp.system.hardware.free_memory import free_host_memory
from synpick_warp.system.progress import Progress
from synpick_warp.views.frames import EpisodeEnd, name_bin

if TYPE_CHECKING:
    from synpick_warp.factory.attempts import EpisodeRecord

PLACES = 6
"""Decimal places of a time [s]; more would be noise."""
WRITER_BYTES = 100 << 20
"""Memory reserved for a writer process besides its image slots [bytes]. Measured are 50 MB, with its part of shared libraries, at full HD
with bop and shards; the rest is headroom for formats with larger libraries."""
WRITERS_FRACTION = 0.5
"""Fraction of the free host memory that writer processes may take if their number is chosen."""


class EpisodeSource(list[int]):
    """Work queue of a bake: a list of the episodes that it begins with, sorted, and a source of further ones while worlds are idle."""

    def __init__(self, episodes: Iterable[int], expected: int = 0) -> None:
        super().__init__(episodes)
        self.expected = expected
        """Number of episodes to choose worlds for, if it is larger than that of the first ones, and the settings leave it open."""

    def more(self, wait: bool) -> list[int]:
        """Further episodes, which were never returned before; empty: none at present. `wait`: the bake ends if there are none."""
        del wait
        return []


def measured(config: Config, devices: Sequence[str]) -> Config:
    """Complete the settings by what files of bins and grippers say of themselves, and by the first of several devices."""
    if found := measure_meshes(config.bin, config.gripper):
        config = override_config(config, found)
    return config.with_values({"bake.device": pick_devices(devices)[0]}) if devices else config


def count_writers(writers: int, slot_bytes: int) -> int:
    """Writer processes of a bake: `bake.writers`, or if it is 0, one per usable CPU core, as far as the host's free memory has room for
    them and their slots of `slot_bytes` (see `Needs`)."""
    room = int(WRITERS_FRACTION * free_host_memory()) // (WRITER_BYTES + QUEUE_DEPTH * slot_bytes)
    return writers or max(1, min(count_cores(), room))


class EpisodeOutcome(NamedTuple):
    """Line of episodes.jsonl and of the summary; the fields are the JSON keys. Counts are 0 if the episode is not part of the data set."""

    episode: int
    arrangement: int
    """Index of the arrangement: how often it was resampled before."""
    ending: Ending
    frames: int
    seconds: float
    """Simulated time from the first frame to the last [s]."""
    mode: str
    objects: int
    """Objects at the first frame."""
    attempts: int
    picked: int
    """Objects that left the scene on the cup."""
    lost: int
    """Objects that left the scene otherwise."""
    left: int
    """Objects at the last frame."""
    split: str = ""
    """Name of the episode's split; empty, and no key: the settings have no splits."""
    looks: Mapping[str, Any] | None = None
    """Randomized looks of the episode, as `draw_looks` has them; None, and no key: the settings randomize none."""
    bin: dict[str, Any] | None = None
    """Record of the bin; None, and no key: a tote that is always in its place."""
    cameras: dict[str, Any] | None = None
    """Record of the cameras by name, as `EpisodeCameras.record` has it; None, and no key: all are those of the settings."""

    @property
    def sentence(self) -> str:
        """How the episode ended, of the bin that it has."""
        seen = self.mode == "still" and self.ending.delivers
        return "the pile was seen at rest" if seen else name_bin(self.ending.sentence, self.bin)

    def as_json(self) -> dict[str, Any]:
        """Row as the dictionary of a line of episodes.jsonl."""
        row = {**self._asdict(), "ending": self.ending.name.lower()}
        row = {name: value for name, value in row.items() if name not in _OPTIONAL or value != _OPTIONAL[name]}
        return {**row, "sentence": self.sentence}

    @classmethod
    def from_json(cls, row: Mapping[str, Any]) -> EpisodeOutcome:
        """Row from the dictionary of a line of episodes.jsonl."""
        values: dict[str, Any] = {name: row[name] for name in cls._fields if name not in _OPTIONAL or name in row}
        values["ending"] = Ending[row["ending"].upper()]
        return cls(**values)


_OPTIONAL = EpisodeOutcome._field_defaults
"""Fields that rows lack where they have these values."""


@dataclass
class BakeSummary:
    """Totals of a bake, committed episodes of earlier runs included: episodes, views and time of this run, resampled arrangements,
    outcomes, and the signal that stopped it (0: none)."""

    total: int = 0
    """Episodes of the complete data set."""
    episodes: list[EpisodeOutcome] = field(default_factory=list)
    views: int = 0
    wall_seconds: float = 0.0
    """Time from the first tick to the last file [s]."""
    resampled: int = 0
    """Arrangements that ended without delivery and were resampled."""
    resampled_by_ending: Counter[Ending] = field(default_factory=Counter)
    """These arrangements, by ending."""
    remedies: dict[Ending, str] = field(default_factory=dict)
    """Advice against these endings, where a setting cures them; see `remedy`."""
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    resumed: int = 0
    stopped: int = 0

    def take_record(self, record: Mapping[str, Any]) -> None:
        """Count an episode that an earlier run committed."""
        self.episodes.append(EpisodeOutcome.from_json(record["row"]))
        self.outcomes.update(Outcome[attempt["outcome"].upper()] for attempt in record["attempts"])
        self.resumed += 1

    def take_summary(self, other: BakeSummary) -> None:
        """Add the episodes of another process of this bake; the total stays."""
        self.episodes += other.episodes
        self.episodes.sort()
        self.views += other.views
        self.resampled += other.resampled
        self.resampled_by_ending.update(other.resampled_by_ending)
        self.remedies |= other.remedies
        self.outcomes.update(other.outcomes)
        self.stopped = self.stopped or other.stopped
        self.wall_seconds = max(self.wall_seconds, other.wall_seconds)

    def take_end(self, row: EpisodeOutcome, record: EpisodeRecord, config: Config) -> str:
        """Count an episode that has ended in this run, or an arrangement that will be resampled; returns `remedy` against its ending."""
        if is_resampled(row, config.settle.tries):
            self.resampled += 1
            self.resampled_by_ending[row.ending] += 1
        else:
            self.episodes.append(row)
            self.episodes.sort()
            self.outcomes.update(Outcome[attempt.outcome.upper()] for attempt in record.attempts)
        if advice := remedy(row.ending, config):
            self.remedies[row.ending] = advice
        return advice


def is_resampled(row: EpisodeOutcome, tries: int) -> bool:
    """True if the episode will run again with a resampled arrangement; `tries`: `settle.tries`."""
    return not row.ending.delivers and row.arrangement + 1 < tries


_REMEDIES = {
    Ending.SOLVER_OVERFLOW: ("raise", "physics.rows_per_world", "physics.gripper_rows_per_world"),
    Ending.CONTACT_OVERFLOW: ("raise", "physics.contacts_per_world"),
    Ending.PAIR_OVERFLOW: ("raise", "physics.pairs_per_world"),
    Ending.PERCEPTION_OVERFLOW: ("raise", "perception.contour_points"),
    Ending.ARRANGEMENT_OVERFLOW: ("lower", "arrangement.slot_shortfall"),
    Ending.UNSETTLED: ("raise", "settle.max_time", "settle.max_redrops"),
}
"""What to do after an ending, and with which settings."""


def remedy(ending: Ending, config: Config) -> str:
    """Advice against an ending that is caused by a setting, with the current values; empty: no setting cures it."""
    verb, *keys = _REMEDIES.get(ending, ("",))
    values = {key: config.value(key) for key in keys}
    named = (f"{key} ({value:g})" if isinstance(value, float) else f"{key} ({value})" for key, value in values.items())
    return f"{verb} {' or '.join(named)}" if keys else ""


def encode_line(attempt: Attempt, bin: Mapping[str, Any] | None = None) -> str:
    """Serialize an attempt as one line of JSON with line break; `bin`: record of the episode's bin, if it is not a tote in its place.
    Raises ValueError if a number is not finite."""
    record = msgspec.to_builtins(attempt)
    return json.dumps(record | {"sentence": name_bin(attempt.sentence, bin)}, allow_nan=False) + "\n"


def episode_end(row: EpisodeOutcome, record: EpisodeRecord, tries: int) -> EpisodeEnd:
    """Build the end-of-episode message for exporters; a resampled episode (`is_resampled`) has neither row nor attempts."""
    if is_resampled(row, tries):
        return EpisodeEnd(row.episode, row.arrangement, row.frames, int(row.ending))
    lines = tuple(encode_line(attempt, row.bin) for attempt in record.attempts)
    return EpisodeEnd(row.episode, row.arrangement, row.frames, int(row.ending), row.as_json(), lines)


class ThroughputMeter:
    """Throughput and remaining time, reported to the observer."""

    def __init__(self, cameras: int, expected: float, summary: BakeSummary, progress: Progress) -> None:
        self.summary, self.progress = summary, progress
        self.started: float | None = None
        self.cameras, self.expected = cameras, expected
        """Number of cameras, and mean number of frames of an episode while none has ended."""
        self.counted = 0
        """Episodes of the summary of which `delivered` and `frames` are the sums."""
        self.delivered = self.frames = 0

    def show(self, active: int) -> None:
        """Report after a tick in which `active` worlds were busy. Time counts from the first view, when all kernels are compiled."""
        summary, now = self.summary, time.perf_counter()
        if self.started is None and summary.views:
            self.started = now
        elapsed = now - self.started if self.started is not None else 0.0
        self._count_delivered()
        left = None
        if summary.total > summary.resumed and elapsed > 0.0 and summary.views:
            # Short episodes end first: running ones can already be longer than the mean of the ended ones.
            running = summary.views / self.cameras / max(1, len(summary.episodes) - summary.resumed + active)
            frames = max(self.frames / self.delivered if self.delivered else self.expected, running)
            fraction = summary.views / ((summary.total - summary.resumed) * self.cameras * frames)
            left = (1.0 / fraction - 1.0) * elapsed if fraction < 1.0 else None
        self.progress.update(
            episodes_done=len(summary.episodes),
            episodes=summary.total,
            worlds_active=active,
            views=summary.views,
            views_per_s=summary.views / elapsed if elapsed > 0.0 else 0.0,
            seconds_left=left,
        )

    def _count_delivered(self) -> None:
        """Count the episodes that ended since the last report; the work of a tick is independent of the number of earlier episodes."""
        for row in self.summary.episodes[self.counted :]:
            if row.ending.delivers:
                self.delivered += 1
                self.frames += row.frames
        self.counted = len(self.summary.episodes)
