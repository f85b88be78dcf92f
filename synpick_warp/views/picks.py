"""Table schemas of simulated picks: columns of grasp trials and of states, and the batches that a bake hands to exporters.

A state is a checkpoint of an episode at a moment of choice; a grasp candidate is a point on a surface that camera 0 sees in it; a trial
executes a candidate from the state, possibly perturbed. One trial is one row.
"""

import enum
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from synpick_warp.codes import Ending, Outcome, Share

MOVED = 5e-3
"""Displacement above which another object counts as moved [m]; resting piles creep far less."""
REACH = 1e4
"""Largest coordinate of a grasp point [m]; no cell is as large."""
ORDER = ("state", "candidate", "repeat")
"""Columns that identify a trial within its episode, and by which its table is sorted."""


class PickColumn(NamedTuple):
    """Schema of a column: name, type, unit (1: none), meaning, components (1: a scalar), enumeration of its codes, and domain."""

    name: str
    dtype: str
    unit: str
    """1: dimensionless."""
    meaning: str
    size: int = 1
    """Components of a value: 3 is a vector."""
    codes: type[enum.IntEnum] | None = None
    """Enumeration whose values it holds."""
    low: float = -math.inf
    """Least value; infinite ones are not allowed."""
    high: float = math.inf
    """Largest value."""
    undefined: bool = False
    """Whether it may be NaN."""

    @property
    def is_direction(self) -> bool:
        """Whether values are unit vectors."""
        return self.size > 1 and self.unit == "1"

    @property
    def field(self) -> tuple[str, str, tuple[int, ...]]:
        """Field of a structured type."""
        return self.name, self.dtype, (self.size,) * (self.size > 1)


COLUMNS = (
    PickColumn("state", "<i4", "1", "Index of the state within the episode.", low=0),
    PickColumn("frame", "<i4", "1", "Frame of the episode at which the state was saved, and from which the candidate was drawn.", low=0),
    PickColumn("candidate", "<i4", "1", "Index of the candidate within the state.", low=0),
    PickColumn("repeat", "<i4", "1", "Repeat of the candidate; 0: not perturbed.", low=0),
    PickColumn("share", "|u1", "1", "How the candidate was sampled.", codes=Share),
    PickColumn(
        "weight", "<f4", "1", "Inverse probability weight of its pixel in a draw, for unbiased estimates over pixels; 0: own grasp.", low=0
    ),
    PickColumn(
        "column", "<i4", "px", "Pixel in the perception image of camera 0, from the left; its size is in the table of states.", low=0
    ),
    PickColumn("row", "<i4", "px", "Pixel in the perception image, from the top.", low=0),
    PickColumn("instance", "<i4", "1", "Instance that the pixel shows, which the pick intends; -1: none.", low=-1),
    PickColumn("obj_id", "<i4", "1", "Its object id; -1: none.", low=-1),
    PickColumn("point", "<f4", "m", "Grasp point in the world: surface point at the pixel's centre.", 3, low=-REACH, high=REACH),
    PickColumn("normal", "<f4", "1", "Unit surface normal there in the world, out of the object, smoothed as perception does.", 3),
    PickColumn("yaw", "<f4", "rad", "Rotation of the gripper shaft about the vertical."),
    PickColumn("tilt", "<f4", "rad", "Rotation of the cup about the wrist axis."),
    PickColumn("approach", "<f4", "1", "Unit direction in which the cup is pressed on, in the world.", 3),
    PickColumn("seal", "<f4", "1", "Analytic seal score of SuctionNet at the pixel, 0 to 1.", low=0, high=1),
    PickColumn("wrench", "<f4", "1", "Analytic wrench score of SuctionNet at the pixel, 0 to 1.", low=0, high=1),
    PickColumn("offset", "<f4", "m", "Perturbation of the grasp point.", 3, low=-1, high=1),
    PickColumn("rotation", "<f4", "rad", "Perturbation of the cup's orientation, as a rotation vector in the world.", 3, low=-4, high=4),
    PickColumn("friction", "<f4", "1", "Factor on all coefficients of friction.", low=0, high=2),
    PickColumn("outcome", "|u1", "1", "Outcome of the attempt; none: the simulation ended first.", codes=Outcome),
    PickColumn("ending", "|u1", "1", "Why the simulation ended during the trial; running: it did not.", codes=Ending),
    PickColumn("success", "|b1", "1", "Whether any object hung on the cup after lift and hold."),
    PickColumn("intended", "|b1", "1", "Whether the intended instance hung on the cup after lift and hold."),
    PickColumn("hits", "<i4", "1", "Suction rays that hit an object when the suction was switched on.", low=0),
    PickColumn("sealed", "<i4", "1", "Cups with a good seal: bit k, cup k.", low=0),
    PickColumn("picked", "<i4", "1", "First instance on the cup at the end; -1: none.", low=-1),
    PickColumn("peak_force", "<f4", "N", "Largest force of any seal, seals that broke included.", low=0),
    PickColumn(
        "margin",
        "<f4",
        "1",
        "Least margin of a seal: 1 - force / break force; 0 or less: it broke. NaN: there was no seal.",
        high=1,
        undefined=True,
    ),
    PickColumn(
        "time_to_break",
        "<f4",
        "s",
        "Time from suction on until the last seal broke. NaN: it did not, or there was none.",
        low=0,
        undefined=True,
    ),
    PickColumn("held", "<f4", "s", "Time with an object on the cup.", low=0),
    PickColumn("moved", "<i4", "1", f"Collateral: other objects displaced by more than {1e3 * MOVED:.0f} mm.", low=0),
    PickColumn("farthest", "<f4", "m", "Largest displacement of another object.", low=0),
    PickColumn("lost", "<i4", "1", "Objects that left the bin without being picked.", low=0),
    PickColumn("duration", "<f4", "s", "Simulated duration of the trial.", low=0),
)
"""Columns of the table of trials, in the order of files."""
STATES = (
    PickColumn("state", "<i4", "1", "Index of the state within the episode.", low=0),
    PickColumn("frame", "<i4", "1", "Frame of the episode at which it was saved.", low=0),
    PickColumn("camera", "<i4", "1", "Index of the camera from whose perception image the candidates were drawn.", low=0),
    PickColumn("width", "<i4", "px", "Width of its perception image.", low=1),
    PickColumn("height", "<i4", "px", "Height of its perception image.", low=1),
    PickColumn("candidates", "<i4", "1", "Number of candidates.", low=0),
    PickColumn("visible", "|b1", "1", "Whether each instance is visible in the perception image."),
)
"""Columns of the table of states. `visible` has a component for each instance of the episode."""


@dataclass(frozen=True, eq=False)
class PickBatch:
    """Record batch: all trials of one or more states of an episode, in any order. Exporters copy what they keep. Raises ValueError if
    columns are missing, unknown, or of other shapes."""

    episode: int
    trials: Mapping[str, np.ndarray]
    """Columns of COLUMNS by name, each (trial[, 3])."""
    states: Mapping[str, np.ndarray]
    """Columns of STATES by name, each (state); `visible` (state, instance)."""

    def __post_init__(self) -> None:
        make_rows(COLUMNS, self.trials)
        make_rows(STATES, self.states)

    def __len__(self) -> int:
        """Number of trials."""
        return len(self.trials["state"])


def row_type(columns: Sequence[PickColumn], instances: int = 1) -> np.dtype:
    """Structured dtype of a table's row; `visible` has `instances` components."""
    return np.dtype([(column.name, column.dtype, (instances,)) if column.name == "visible" else column.field for column in columns])


def make_rows(columns: Sequence[PickColumn], arrays: Mapping[str, np.ndarray]) -> np.ndarray:
    """Convert columns to the rows of a table: structured array (row) of `row_type`; raises ValueError as `PickBatch`."""
    if wrong := {column.name for column in columns} ^ set(arrays):
        raise ValueError(f"{sorted(wrong)[0]} is missing, or no column of picks")
    visible = np.asarray(arrays.get("visible", np.zeros((0, 1))))
    kind = row_type(columns, visible.shape[1])
    rows = np.empty(len(arrays[columns[0].name]), kind)
    for column in columns:
        values = np.asarray(arrays[column.name])
        if values.shape != rows[column.name].shape:
            raise ValueError(f"{column.name} of {len(rows)} rows has the shape {values.shape}, not {rows[column.name].shape}")
        rows[column.name] = values
    return rows


def sort_rows(rows: np.ndarray) -> np.ndarray:
    """Sort the rows of a table by the key columns ORDER, as in files."""
    return rows[np.lexsort(_keys(rows)[::-1])]


def are_sorted(rows: np.ndarray) -> np.ndarray:
    """Whether each row (row) follows the previous one by ORDER, with unique keys."""
    keys = np.stack(_keys(rows)).astype(np.int64)
    steps = np.diff(keys, axis=1, prepend=keys[:, :1] - 1)
    # The first key that differs decides.
    return np.take_along_axis(steps, (steps != 0).argmax(axis=0)[None], axis=0)[0] > 0


def _keys(rows: np.ndarray) -> list[np.ndarray]:
    """Key columns of a table: those of ORDER that it has."""
    return [rows[name] for name in ORDER if name in (rows.dtype.names or ())]
