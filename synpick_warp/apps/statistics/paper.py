"""Comparison with the data set of the SynPick paper, whose numbers are in paper.toml."""

from __future__ import annotations

import functools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import msgspec

from synpick_warp.apps.statistics.figures import Comparison, GroupStatistics, Numbers
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.toml import read_toml

_NAME = re.compile(r"[0-9]{3}_(.+)")
"""Name of an object in the YCB set; the paper's plot leaves the number out."""
_Count = Annotated[int, msgspec.Meta(ge=1)]


class PaperGroup(msgspec.Struct, frozen=True):
    """Row of the paper's table, of a split and mode."""

    split: str
    mode: str
    sequences: _Count
    views: _Count
    visibility: float
    """Mean visible fraction."""
    objects: dict[str, int]
    """Annotated instances by name of the object."""

    @property
    def instances(self) -> int:
        """Annotated instances of all objects."""
        return sum(self.objects.values())


class Paper(msgspec.Struct, frozen=True):
    """Statistics that the paper publishes of its data set."""

    cameras: int
    total_views: int
    total_visibility: float
    groups: list[PaperGroup]

    def group(self, split: str, mode: str) -> PaperGroup | None:
        """Row of a split and mode in the paper's table; None: it has none."""
        return next((each for each in self.groups if (each.split, each.mode) == (split, mode)), None)


@functools.cache
def read_paper() -> Paper:
    """Read the paper's numbers from paper.toml."""
    return msgspec.convert(read_toml(Path(__file__).with_name("paper.toml"), DatasetError), Paper)


def compare(groups: Sequence[GroupStatistics], kinds: Mapping[str, str], names: Mapping[int, str], cameras: int) -> tuple[Comparison, ...]:
    """Compare every group that the paper has, too, with the paper's numbers; one comparison each.

    Args:
        groups: The groups.
        kinds: Split -> train, val or test.
        names: Names of objects by obj_id.
        cameras: Number of cameras.
    """
    paper, rows = read_paper(), []
    for group in groups:
        ours, sequences = group.annotations, group.episodes.episodes
        theirs = paper.group(kinds.get(group.split, group.split), group.mode)
        if theirs is None or not ours.views:
            continue
        other = paper.group("test" if theirs.split == "train" else "train", theirs.mode)
        distance = total_variation(theirs.objects, other.objects) if other else 0.0
        mine = Numbers(sequences, ours.views, ours.views / (sequences * cameras), ours.visibility, ours.instances_per_view)
        pair = mine, _numbers(theirs, paper.cameras)
        rows.append(Comparison(group.split, group.mode, *pair, object_distance(ours.objects, names, theirs.objects), distance))
    return tuple(rows)


def _numbers(group: PaperGroup, cameras: int) -> Numbers:
    """Numbers of a row of the paper, to stand beside ours; frames are those of a sequence."""
    frames = group.views / (group.sequences * cameras)
    return Numbers(group.sequences, group.views, frames, group.visibility, group.instances / group.views)


def object_distance(ours: Mapping[int, int], names: Mapping[int, str], theirs: Mapping[str, int]) -> float | None:
    """Total variation distance of instances by obj_id to instances by the paper's names; None: an object has none of these names."""
    counts: dict[str, int] = {}
    for object_id, count in ours.items():
        match = _NAME.fullmatch(names.get(object_id, ""))
        name = match[1] if match else ""
        if name not in theirs:
            return None
        counts[name] = counts.get(name, 0) + count
    return total_variation(counts, theirs) if counts else None


def total_variation(first: Mapping[str, int], second: Mapping[str, int]) -> float:
    """Total variation distance ½ Σ |p - q| of two distributions, given as counts."""
    totals = sum(first.values()), sum(second.values())
    return 0.5 * sum(abs(first.get(key, 0) / totals[0] - second.get(key, 0) / totals[1]) for key in {**first, **second})
