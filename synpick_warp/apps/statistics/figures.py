"""Figures of a data set: what its statistics say, as records of numbers. `stats --json` has their fields."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

Range = tuple[float, float]


@dataclass(frozen=True)
class Annotations:
    """Annotations of a group, as in the paper's table and bar chart."""

    views: int
    instances: int
    """Annotated instances, the invisible ones included."""
    visibility: float | None
    """Mean visible fraction of all instances of which it is known; None: there is none."""
    invisible: int
    """Instances without a visible pixel."""
    histogram: tuple[int, ...]
    """Instances by visible fraction, in VISIBILITY_BINS bins."""
    objects: dict[int, int]
    """Instances by obj_id."""

    @property
    def instances_per_view(self) -> float | None:
        """Mean number of instances in a view; None: no view."""
        return self.instances / self.views if self.views else None


@dataclass(frozen=True)
class EpisodeFigures:
    """Episodes of a group, and their attempts to pick."""

    episodes: int
    frames: int
    """Output frames of simulated time; each is a view of every camera."""
    endings: dict[str, int]
    objects: int
    """Objects at the first frame, over all episodes."""
    picked: int
    lost: int
    """Objects that left the scene otherwise."""
    attempts: int
    outcomes: dict[str, int]
    good_seals: int
    seals: int
    """Attempts in which suction engaged an object."""
    force: float | None
    """Mean over these of the largest seal force [N]; None: there is none."""
    force_histogram: tuple[int, ...]
    """The same, by force: FORCE_BINS bins of FORCE_BIN N."""
    largest_load: int | None = None
    """Largest of these forces relative to the seal's break force [%], rounded up, and 100 from there on; None: there is none."""


class TimePoint(NamedTuple):
    """Bin of simulated time, TIME_BIN wide."""

    time: float
    """Start of the bin since the first frame [s]."""
    frames: int
    """Frames of the bin, over all episodes that last so long."""
    objects: float
    """Mean number of objects in the scene, in these frames."""


@dataclass(frozen=True)
class GroupStatistics:
    """Statistics of the episodes of a split and a mode."""

    split: str
    """Name of the split; empty: all."""
    mode: str
    """pick, target, move or still; empty: all."""
    episodes: EpisodeFigures
    annotations: Annotations
    objects_over_time: tuple[TimePoint, ...]


@dataclass(frozen=True)
class Coverage:
    """Pose coverage of an object: directions from which cameras see it, in its frame."""

    views: int
    """Instances of which at least MIN_VISIBILITY is visible."""
    occupied: float
    """Fraction of the bins with at least one of them."""
    evenness: float
    """Entropy of the bins relative to that of an even distribution: 1, if all bins have as many; 0, if one bin has all."""
    bins: tuple[int, ...]
    """Views by bin, BANDS x SECTORS, from z = -1 and longitude -180° on, longitude first."""


@dataclass(frozen=True)
class ObjectStatistics:
    """Statistics of one object."""

    object_id: int
    name: str
    """Empty: it is not known."""
    instances: int
    """Annotated instances."""
    coverage: Coverage


@dataclass(frozen=True)
class Depth:
    """Planar depth of the pixels of the sampled views."""

    views: int
    pixels: int
    missing: float
    """Fraction of the pixels without measurement."""
    quantiles: dict[float, float]
    """Quantile, one of DEPTH_QUANTILES -> depth, exact to DEPTH_BIN [mm]; empty: nothing was measured."""


@dataclass(frozen=True)
class LightFigures:
    """Environment light of the episodes."""

    episodes: int
    maps: dict[str, int]
    yaw: tuple[int, ...]
    """Episodes by yaw, in YAW_BINS bins."""
    exposure: dict[float, int]
    """Episodes by exposure compensation: begin of the bin [EV] -> episodes; bins are EXPOSURE_BIN wide."""


@dataclass(frozen=True)
class Numbers:
    """Numbers that are compared with the paper's."""

    sequences: int
    views: int
    views_per_sequence: float
    """Views of one camera in a sequence: its frames."""
    visibility: float | None
    """Mean visible fraction; None here and below: not known."""
    instances_per_view: float | None


@dataclass(frozen=True)
class Comparison:
    """Group of the data set beside that of the paper."""

    split: str
    mode: str
    ours: Numbers
    paper: Numbers
    distance: float | None
    """Total variation distance of the distributions of instances over objects, from 0 to 1; None: the objects have other names."""
    paper_distance: float
    """The same between train and test of the paper in this mode: how far its own two draws are apart."""


@dataclass(frozen=True)
class LookStatistics:
    """Randomized looks: values that episodes have drawn of a parameter of a part."""

    part: str
    """episode, bin, table, background, object or distractor."""
    parameter: str
    """As in `episodes.jsonl`; a channel of a colour behind a dot."""
    draws: int
    quantiles: tuple[float, ...]
    """LOOK_QUANTILES of the values."""


@dataclass(frozen=True)
class BinUse:
    """Episodes of a bin, and the intervals of BIN_STEPS that its places span."""

    episodes: int
    x: Range
    """[m]"""
    y: Range
    """[m]"""
    yaw: Range
    """[rad]"""


@dataclass(frozen=True)
class Rest:
    """Windows of piles at rest, and those in which an object vibrates without decay."""

    windows: int
    vibrating: int


@dataclass(frozen=True)
class Statistics:
    """Statistics of a data set."""

    cameras: int
    groups: tuple[GroupStatistics, ...]
    """By split in the order of the settings, then by mode."""
    total: GroupStatistics
    objects: tuple[ObjectStatistics, ...]
    """By obj_id: the objects that are annotated, and those of the models folder that never are."""
    depth: Depth | None
    """None: no depth image was read."""
    lights: LightFigures | None
    """None: no scene names its light."""
    paper: tuple[Comparison, ...]
    """Groups that the paper has, too."""
    missing: tuple[str, ...]
    """What the data set does not have, a sentence each."""
    looks: tuple[LookStatistics, ...] = ()
    """By part and parameter; none: looks are not randomized."""
    bins: Mapping[str, BinUse] = field(default_factory=dict)
    """By name, the most frequent first; empty: no episode names its bin, since the tote is always in its place."""
    rest: Rest | None = None
    """None: no steps of piles at rest were recorded."""

    @property
    def has_paper_objects(self) -> bool:
        """Whether the objects are those of the paper, with which a comparison makes sense."""
        return any(row.distance is not None for row in self.paper)
