"""Episodes and attempts: endings, outcomes, counts of objects, seal forces."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from synpick_warp.apps.statistics.counting import Counts, Group
from synpick_warp.apps.statistics.records import AttemptFacts, EpisodeFacts
from synpick_warp.configs.cell.gripper import Suction

FORCE_BIN = 2.0
"""Width of a bin of seal forces [N]."""
FORCE_BINS = 30
"""Number of bins; the last one includes all larger forces, beyond the 40 N at which a good seal breaks."""
NEAR = 50
"""Load from which a seal is near its limit [% of its break force]."""
_UNIT = 10**6
"""Forces are summed as integers in units of 1 / _UNIT N, so that sums do not depend on their order."""


@dataclass(frozen=True)
class Episodes:
    """Aggregate statistics of a group's episodes and of their picking attempts."""

    episodes: int
    frames: int
    """Output frames of simulated time; each is a view of every camera."""
    endings: dict[str, int]
    """Episodes by ending."""
    objects: int
    """Objects at the first frame, over all episodes."""
    picked: int
    lost: int
    """Objects that left the scene otherwise."""
    attempts: int
    outcomes: dict[str, int]
    """Attempts by outcome."""
    good_seals: int
    """Attempts with a good seal."""
    seals: int
    """Attempts in which suction engaged an object."""
    force: float | None
    """Mean over these of the largest seal force [N]; None: there is none."""
    force_histogram: tuple[int, ...]
    """The same, by force: FORCE_BINS bins of FORCE_BIN N."""
    largest_load: int | None = None
    """Largest of these forces relative to the seal's break force [%], rounded up, and 100 from there on; None: there is none."""


@dataclass
class EpisodeCounts(Counts):
    """Accumulator of `Episodes`: counts by group (split, mode) of episodes, endings, outcomes and bins of the largest seal force."""

    totals: Counter[tuple[Group, str]] = field(default_factory=Counter)
    """Sums by name of the field."""
    endings: Counter[tuple[Group, str]] = field(default_factory=Counter)
    outcomes: Counter[tuple[Group, str]] = field(default_factory=Counter)
    bins: Counter[tuple[Group, int]] = field(default_factory=Counter)
    """Attempts by bin of the largest seal force."""
    loads: Counter[tuple[Group, int]] = field(default_factory=Counter)
    """Attempts by largest seal force relative to its break force [%]."""

    def add_episode(self, group: Group, row: EpisodeFacts, attempts: Sequence[AttemptFacts], suction: Suction | None) -> None:
        """Count an episode, its ending, objects and attempts, for its group; `suction` has the break forces of attempts."""
        counted = {"episodes": 1, "frames": row.frames, "objects": row.objects, "picked": row.picked, "lost": row.lost}
        for name, count in {**counted, "attempts": len(attempts)}.items():
            self.totals[group, name] += count
        self.endings[group, row.ending] += 1
        for attempt in attempts:
            self.outcomes[group, attempt.outcome] += 1
            self.totals[group, "good_seals"] += attempt.good_seal
            if attempt.engaged:
                force = max(attempt.peak_force, default=0.0)
                self.totals[group, "seals"] += 1
                self.totals[group, "force"] += round(force * _UNIT)
                self.bins[group, min(int(force / FORCE_BIN), FORCE_BINS - 1)] += 1
                if suction is not None:
                    limit = suction.good_force if attempt.good_seal else suction.poor_force
                    limit = limit if attempt.break_force is None else attempt.break_force
                    self.loads[group, math.ceil(100.0 * force / limit) if force < limit else 100] += 1

    def groups(self) -> list[Group]:
        """All groups that have episodes, sorted."""
        return sorted({group for group, name in self.totals if name == "episodes"})

    def result(self, groups: Iterable[Group]) -> Episodes:
        """Statistics of the episodes of these groups together."""
        groups = tuple(groups)

        def total(name: str) -> int:
            return sum(self.totals[group, name] for group in groups)

        def by_name(counts: Counter[tuple[Group, str]]) -> dict[str, int]:
            found: Counter[str] = Counter()
            for (group, name), count in counts.items():
                if group in groups:
                    found[name] += count
            return dict(sorted(found.items(), key=lambda item: (-item[1], item[0])))

        seals = total("seals")
        return Episodes(
            episodes=total("episodes"),
            frames=total("frames"),
            endings=by_name(self.endings),
            objects=total("objects"),
            picked=total("picked"),
            lost=total("lost"),
            attempts=total("attempts"),
            outcomes=by_name(self.outcomes),
            good_seals=total("good_seals"),
            seals=seals,
            force=total("force") / (_UNIT * seals) if seals else None,
            force_histogram=tuple(sum(self.bins[group, index] for group in groups) for index in range(FORCE_BINS)),
            largest_load=max((load for group, load in self.loads if group in groups), default=None),
        )
