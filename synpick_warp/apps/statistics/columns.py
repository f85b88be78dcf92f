"""Tables of a data set, as blocks of columns: of an episode its row, attempts, looks and bin; of a scene its instances, frames, depth; and
grouped sums over them, in integers, so that those of parts add up to those of the whole in any order.

Values are columns of bins where they are counted by bin, and integers where they are summed. A table is never whole in memory: what grows
with the data set are the keys of the sums, of which there are as many as groups, objects, and bins of values.
"""

import math
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Annotated, Any, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.dataset.annotations import ADVICE, Index, Length, camera_schema
from synpick_warp.dataset.bop.arrays import SceneArrays
from synpick_warp.dataset.reading import Episode
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

    def merge(self, other: "Counts") -> None:
        """Add the sums of another part, in any order. Raises DatasetError if there are more than MAX_OBJECTS objects."""
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


VISIBILITY_BINS = 20
"""Bins of the visible fraction, of equal width from 0 to 1; the last one includes 1."""
VISIBILITY_UNIT = 10**9
"""Visible fractions are summed as integers in units of 1 / VISIBILITY_UNIT, so that sums do not depend on their order."""
FORCE_BIN = 2.0
"""Width of a bin of seal forces [N]."""
FORCE_BINS = 30
"""Number of bins; the last one includes all larger forces, beyond the 40 N at which a good seal breaks."""
FORCE_UNIT = 10**6
"""Forces are summed as integers in units of 1 / FORCE_UNIT N."""
TIME_BIN = 2.0
"""Width of a bin of time [s]."""
_ROUNDING = 1e-9
"""Frames at the begin of a bin belong to it, also if their time is rounded down."""
BANDS, SECTORS = 12, 24
"""Steps of z from -1 to 1, and of longitude from -180° to 180°: cells of Lambert's cylindrical projection, whose areas on the sphere of
directions are equal (Archimedes' hat-box theorem)."""
DIRECTION_BINS = BANDS * SECTORS
MIN_VISIBILITY = 0.1
"""Visible fraction from which a view of an object counts, as in BOP's target lists."""
DEPTH_BIN = 5.0
"""Width of a bin of depth [mm]."""
_LEVELS = 2**16
"""Number of values of a 16-bit depth image."""
YAW_BINS = 12
"""Bins of the yaw of an environment map, of equal width over a full turn, from 0."""
EXPOSURE_BIN = 0.1
"""Width of a bin of the exposure compensation [EV]."""
LOOK_DIGITS = 2
"""Significant digits of drawn looks: quantiles are within 5 %, and the number of distinct values stays small."""
_EPISODE, _DISTRACTORS, _INSTANCE = "episode", "distractors", "instance"
_CHANNELS = ("red", "green", "blue")
BIN_STEPS = {"x": 0.01, "y": 0.01, "yaw": math.radians(5.0)}
"""Widths of the intervals in which the places of bins are counted [m, rad]."""
REST_WINDOW = 0.2
"""Length of a window of the step log [s]."""
REST_DRIFT = 1.5e-3
"""Mean speed of an object at rest, at most [m/s]: 0.1 mm in a tick of 1/15 s, as `settle.rest_threshold`."""
REST_AMPLITUDE = 5e-3
"""Velocity amplitude about the mean, in both halves of a window, above which an object vibrates [m/s]: 30 µm at 50 Hz are 9 mm/s."""
_REST_ARRAYS = ("velocity", "attached", "gripper_contact_load")
"""Arrays of the step log that are read."""

MAX_NAME = 256
"""Longest name of a mode, an ending, an outcome, a split or a light map."""
Name = Annotated[str, Meta(max_length=MAX_NAME)]
Force = Annotated[float, Meta(ge=0.0, le=1e9)]
LookFacts = dict[Name, Length | list[Length] | Name]
"""Parameters of a body that an episode has drawn."""
Looks = dict[Name, Length | LookFacts | list[LookFacts]]
"""An episode's looks, as its row has them."""


class BinFacts(msgspec.Struct):
    """Bin of an episode: name, position [m] and yaw [rad] in the world."""

    name: Name
    position: tuple[Length, Length, Length]
    yaw: Length


class EpisodeFacts(msgspec.Struct):
    """Schema of an episode's manifest row; other keys are passed over."""

    mode: Name
    frames: Index
    ending: Name
    objects: Index = 0
    picked: Index = 0
    lost: Annotated[int, Meta(ge=-(2**31), lt=2**31)] = 0
    looks: Looks = {}
    """Empty: they are not randomized."""
    bin: BinFacts | None = None


class AttemptFacts(msgspec.Struct):
    """Schema of an attempt to pick in the manifest."""

    outcome: Name
    good_seal: bool = False
    engaged: Annotated[list[Index], Meta(max_length=255)] = []
    """Instances that suction engaged."""
    peak_force: Annotated[list[Force], Meta(max_length=100_000)] = []
    """Largest force on any seal in each tick of the lift [N]."""
    break_force: Force | None = None
    """Least break force of its seals [N]; None: that of the settings."""


class Light(msgspec.Struct, gc=False):
    """An episode's environment map, its yaw [rad] and exposure compensation [EV]."""

    map: Name
    yaw: Length
    exposure: Length


CAMERA = camera_schema(light=Light)
"""Entry of a view in scene_camera.json with its light, which only data sets of this program have."""


def episode_blocks(group: Group, row: EpisodeFacts, attempts: Sequence[AttemptFacts], suction: Suction | None) -> Iterator[Block]:
    """Tables of an episode; `suction` has the break forces of its attempts, and may be None without any."""
    counted = {"episodes": 1, "frames": row.frames, "objects": row.objects, "picked": row.picked, "lost": row.lost}
    yield "episodes", {"group": group, "ending": row.ending, "attempts": len(attempts), **counted}
    outcomes = {"outcome": [attempt.outcome for attempt in attempts], "good_seals": [int(attempt.good_seal) for attempt in attempts]}
    yield "attempts", {"group": group, **outcomes}
    if suction is not None:
        engaged = [attempt for attempt in attempts if attempt.engaged]
        forces = [max(attempt.peak_force, default=0.0) for attempt in engaged]
        load = [_load(attempt, force, suction) for attempt, force in zip(engaged, forces, strict=True)]
        force_bin = [min(int(force / FORCE_BIN), FORCE_BINS - 1) for force in forces]
        summed = {"seals": 1, "force": [round(force * FORCE_UNIT) for force in forces]}
        yield "seals", {"group": group, "force_bin": force_bin, "load": load, **summed}
    drawn = [(part, parameter, _rounded(value)) for part, parameter, value in _drawn(row.looks)]
    yield "looks", {name: [each[column] for each in drawn] for column, name in enumerate(("part", "parameter", "value"))}
    if row.bin is not None:
        yield "bins", {"bin": row.bin.name}
        place = zip(BIN_STEPS.items(), (*row.bin.position[:2], row.bin.yaw), strict=True)
        yield "bin_places", {"bin": row.bin.name, "axis": list(BIN_STEPS), "step": [math.floor(value / step) for (_, step), value in place]}


def _load(attempt: AttemptFacts, force: float, suction: Suction) -> int:
    """Largest seal force of an attempt relative to its break force [%], rounded up, at most 100."""
    limit = suction.good_force if attempt.good_seal else suction.poor_force
    limit = limit if attempt.break_force is None else attempt.break_force
    return math.ceil(100.0 * force / limit) if force < limit else 100


def _drawn(looks: Looks) -> Iterator[tuple[str, str, float]]:
    """Part, parameter and value of all that an episode has drawn; parameters of several bodies are those of one part."""
    for name, value in looks.items():
        if not isinstance(value, (dict, list)):
            yield _EPISODE, name, value
            continue
        if name == _DISTRACTORS and isinstance(value, list):
            yield _EPISODE, _DISTRACTORS, len(value)
        part = name.removesuffix("s") if isinstance(value, list) else name
        for body in value if isinstance(value, list) else (value,):
            for parameter, one in body.items():
                if isinstance(one, list):
                    yield from ((part, f"{parameter}.{channel}", each) for channel, each in zip(_CHANNELS, one, strict=False))
                elif not isinstance(one, str) and parameter != _INSTANCE:
                    yield part, parameter, one


def _rounded(value: float) -> float:
    """A value in LOOK_DIGITS significant digits."""
    return round(float(value), LOOK_DIGITS - 1 - math.floor(math.log10(abs(value))) if value else 0)


def scene_blocks(group: Group, scene: SceneArrays, place: object) -> Iterator[Block]:
    """Tables of a scene's instances; raises DatasetError, with the `place`, if a pose has no direction to the camera."""
    known = scene.visibility[~np.isnan(scene.visibility)]
    summed = {"known": len(known), "visibility": int(np.rint(known * VISIBILITY_UNIT).astype(np.int64).sum())}
    yield "scenes", {"group": group, "views": len(scene.images), "invisible": int((known == 0.0).sum()), **summed}
    yield "instances", {"group": group, "object_id": scene.object_id}
    bins = np.minimum((known * VISIBILITY_BINS).astype(np.int64), VISIBILITY_BINS - 1)
    yield "known_instances", {"group": group, "visibility_bin": bins}
    # The camera is at the origin: R d = -t.
    direction = -np.einsum("nji,nj->ni", scene.rotation, scene.translation)
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    if not (length > 0.0).all():
        raise DatasetError(f"{place}: an instance is at the camera, or its cam_R_m2c is no rotation; {ADVICE}")
    # Instances of which it is not known count as seen.
    seen = ~(scene.visibility < MIN_VISIBILITY)
    yield "seen_instances", {"object_id": scene.object_id[seen], "direction_bin": direction_bins((direction / length)[seen])}


def direction_bins(direction: np.ndarray) -> np.ndarray:
    """Bin of each unit vector (N, 3), as (N,) int64."""
    x, y, z = direction.T
    band = np.clip(((z + 1.0) * (BANDS / 2.0)).astype(np.int64), 0, BANDS - 1)
    turn = (np.arctan2(y, x) / (2.0 * np.pi) + 0.5) * SECTORS
    return band * SECTORS + np.clip(turn.astype(np.int64), 0, SECTORS - 1)


def frame_blocks(group: Group, scene: SceneArrays, period: float) -> Iterator[Block]:
    """Table of a scene's frames with their numbers of objects; `period` is the time from frame to frame [s]."""
    time = (scene.images * (period / TIME_BIN) + _ROUNDING).astype(np.int64)
    yield "frames", {"group": group, "time_bin": time, "objects": scene.counts, "frames": 1}


def light_blocks(light: Light) -> Iterator[Block]:
    """Table of an episode's light."""
    yaw = math.floor(light.yaw / math.tau * YAW_BINS) % YAW_BINS
    yield "lights", {"map": light.map, "yaw_bin": yaw, "exposure_bin": math.floor(light.exposure / EXPOSURE_BIN)}


def depth_blocks(image: np.ndarray, scale: float) -> Iterator[Block]:
    """Tables of a depth image (H, W) uint16 with `scale` mm per count, and of its depths; 0 is no measurement."""
    levels = np.bincount(image.ravel(), minlength=_LEVELS)
    yield "depth_views", {"views": 1, "pixels": image.size, "missing": int(levels[0])}
    present = np.flatnonzero(levels[1:]) + 1
    yield "depths", {"depth_bin": (present * (scale / DEPTH_BIN)).astype(np.int64), "pixels": levels[present]}


def rest_blocks(episode: Episode, step: float) -> Iterator[Block]:
    """Table of the windows of an episode's step log in which the gripper touches nothing; `step` is the time from row to row [s]."""
    length = round(REST_WINDOW / step)
    if length < 2 or any(name not in episode.steps for name in _REST_ARRAYS):
        return
    velocity, attached, load = (episode.steps[name] for name in _REST_ARRAYS)
    for first in range(0, velocity.shape[0] - length + 1, length):
        rows = slice(first, first + length)
        if not np.any(load[rows]) and not np.any(attached[rows]):
            at_rest, vibrates = judge_window(np.asarray(velocity[rows]))
            yield "windows", {"at_rest": int(at_rest), "vibrating": int(at_rest and vibrates)}


def judge_window(velocity: np.ndarray) -> tuple[bool, bool]:
    """Whether all objects are at rest on average, and whether one vibrates in both halves of a window: a limit cycle. Velocities (step,
    instance, axis) [m/s] are NaN where an instance is not in the scene."""
    there = velocity[:, np.isfinite(velocity).all(axis=(0, 2))]
    mean = there.mean(axis=0, keepdims=True)
    amplitude = np.linalg.norm(there - mean, axis=2)
    halves = np.array_split(amplitude, 2)
    vibrates = (np.minimum(*(half.max(axis=0) for half in halves)) > REST_AMPLITUDE).any()
    return bool((np.linalg.norm(mean, axis=2) <= REST_DRIFT).all()), bool(vibrates)
