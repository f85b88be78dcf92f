"""Grouped sums over the tables of a data set, in integers, so that those of parts add up to those of the whole in any order.

A table comes in blocks of columns (`columns.py`), one an episode or a scene, and is never whole in memory: what grows with the data set are
the keys of the sums, of which there are as many as groups, objects, and bins of values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, NamedTuple

import numpy as np

from synpick_warp.errors import DatasetError

MAX_OBJECTS = 65_536
"""Maximum number of distinct objects; more are a sign of corrupt annotations."""
Block = tuple[str, Mapping[str, Any]]
"""Rows of a table: its name, and its columns by name, each an array, a list, or a value that stands in all rows."""


class Group(NamedTuple):
    """Split and mode whose episodes are counted together."""

    split: str
    mode: str


class Aggregate(NamedTuple):
    """Grouped sum, SELECT by, SUM(values) FROM table GROUP BY by, whose keys have the name of the value behind those of `by`."""

    table: str
    by: tuple[str, ...]
    """Columns that make the key; the group is the first, if it is among them."""
    values: tuple[str, ...] = ()
    """Columns that are summed; none: rows are counted."""


AGGREGATES = {
    "episodes": Aggregate("episodes", ("group",), ("episodes", "frames", "objects", "picked", "lost", "attempts")),
    "endings": Aggregate("episodes", ("group", "ending")),
    "outcomes": Aggregate("attempts", ("group", "outcome")),
    "good_seals": Aggregate("attempts", ("group",), ("good_seals",)),
    "seals": Aggregate("seals", ("group",), ("seals", "force")),
    "forces": Aggregate("seals", ("group", "force_bin")),
    "loads": Aggregate("seals", ("group", "load")),
    "views": Aggregate("scenes", ("group",), ("views", "known", "visibility", "invisible")),
    "objects": Aggregate("instances", ("group", "object_id")),
    "visibility": Aggregate("known_instances", ("group", "visibility_bin")),
    "directions": Aggregate("seen_instances", ("object_id", "direction_bin")),
    "timeline": Aggregate("frames", ("group", "time_bin"), ("frames", "objects")),
    "depth_views": Aggregate("depth_views", (), ("views", "pixels", "missing")),
    "depths": Aggregate("depths", ("depth_bin",), ("pixels",)),
    "light_maps": Aggregate("lights", ("map",)),
    "light_yaws": Aggregate("lights", ("yaw_bin",)),
    "exposures": Aggregate("lights", ("exposure_bin",)),
    "looks": Aggregate("looks", ("part", "parameter", "value")),
    "bins": Aggregate("bins", ("bin",)),
    "bin_places": Aggregate("bin_places", ("bin", "axis", "step")),
    "windows": Aggregate("windows", (), ("at_rest", "vibrating")),
}
"""All that is counted, by name."""


@dataclass
class Counts:
    """Sums of all `AGGREGATES` over some episodes and scenes."""

    sums: dict[str, Counter[tuple[Any, ...]]] = field(default_factory=lambda: {name: Counter() for name in AGGREGATES})

    def add(self, blocks: Iterable[Block]) -> None:
        """Add rows of tables to all aggregates over them."""
        for table, columns in blocks:
            rows = _align(columns)
            for name, (source, by, values) in AGGREGATES.items():
                if source != table:
                    continue
                keys = [rows[column] for column in by]
                if not values:
                    self.sums[name].update(zip(*keys, strict=True))
                for value in values:
                    for key, amount in zip(zip(*keys, repeat(value)), rows[value]):  # noqa: B905, repeat has no end
                        self.sums[name][key] += amount

    def merge(self, other: Counts) -> None:
        """Add the sums of another part. The order of merges does not change the result.

        Raises:
            DatasetError: There are more than MAX_OBJECTS objects.
        """
        for name, sums in self.sums.items():
            sums.update(other.sums[name])
        if len(self.sums["objects"]) > MAX_OBJECTS:
            raise DatasetError(f"the annotations have more than {MAX_OBJECTS:,} different obj_id; scene_gt.json is damaged")

    def groups(self) -> set[Group]:
        """All groups that have episodes."""
        return {group for group, _ in self.sums["episodes"]}

    def of(self, name: str, groups: Collection[Group] | None = None) -> Counter[Any]:
        """Sums of an aggregate by key; with `groups`, over these, by the rest of the key. A key of one column is its value."""
        found: Counter[Any] = Counter()
        for key, amount in self.sums[name].items():
            if groups is None or key[0] in groups:
                rest = key if groups is None else key[1:]
                found[rest[0] if len(rest) == 1 else rest] += amount
        return found


def _align(columns: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Columns as lists of one length; a block of values only is one row."""
    lists = {name: column.tolist() for name, column in columns.items() if isinstance(column, np.ndarray)}
    lists |= {name: column for name, column in columns.items() if isinstance(column, list)}
    length = len(next(iter(lists.values()), [None]))
    return {name: lists[name] if name in lists else [column] * length for name, column in columns.items()}
