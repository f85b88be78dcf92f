"""Reader of simulated picks: tables of grasp trials and states as record arrays. Loads NumPy and pyarrow when a table is read.

picks = synpick_warp.open("DATA")[0].picks
picks[picks.share == Share.UNIFORM].success.mean()
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, cast

from synpick_warp.codes import Ending, Share, names
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import check_regular_file

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    import numpy as np

    from synpick_warp.dataset.reading import Episode
    from synpick_warp.dataset.view import View
    from synpick_warp.views.picks import PickColumn

MAX_ROWS = 2**22
"""Maximum number of rows of a table that the reader accepts: 1 GB of trials."""
_MAX_FILE = 2**31
"""Largest file of a table [bytes]."""
_UNIT = 1e-3
"""Largest deviation of a direction's length from 1."""
_MEASURED = ("peak_force", "margin", "farthest")
"""Columns of trials that need not be finite where a pose became infinite."""


class _Fault(NamedTuple):
    """What is wrong in a table: column, mask of the rows (row) bool, and what is allowed."""

    column: str
    wrong: np.ndarray
    allowed: str


class PickTables:
    """Base of `Episode`: its tables of picks, as attributes; both are read and checked on the first access."""

    index: int
    folder: Path

    @property
    def picks(self) -> np.recarray:
        """Grasp trials, a record array with the columns of `views.picks.COLUMNS`, sorted by state, candidate and repeat. Raises
        DatasetError if the data set has no picks, a table is damaged or has a value that is not allowed, or pyarrow is not installed."""
        return self._pick_tables[0]

    @property
    def pick_states(self) -> np.recarray:
        """States from which trials start, a record array with the columns of `views.picks.STATES`. Errors: see `picks`."""
        return self._pick_tables[1]

    def state_views(self) -> Iterator[tuple[np.void, View]]:
        """Iterate over the states with the views from which their candidates were drawn, without those whose camera has no picture in their
        frame. Errors: see `picks`."""
        episode = cast("Episode", self)
        for state in self.pick_states:
            if (frame := int(state["frame"])) in episode.frames(camera := int(state["camera"])):
                yield state, episode.view(frame, camera)

    @cached_property
    def _pick_tables(self) -> tuple[np.recarray, np.recarray]:
        """Both tables, checked against their schemas and each other."""
        try:
            from synpick_warp.exporters.picks import FOLDER, pick_files
            from synpick_warp.views.picks import COLUMNS, STATES
        except ImportError as error:
            raise DatasetError(f"picks cannot be read: {error}; install it by pip install 'synpick-warp[picks]'") from None
        if not (self.folder / FOLDER).is_dir():
            raise DatasetError(
                f"{self.folder} has no picks; bake it with --formats picks, which can be combined with others, as in bop,picks"
            )
        episode = cast("Episode", self)
        places = [self.folder / name for name in pick_files(self.index)]
        trials, states = (_read(place, columns) for place, columns in zip(places, (COLUMNS, STATES), strict=True))
        for name, count, of in (("frame", len(episode), "episode"), ("camera", len(episode.cameras), "data set")):
            _refuse(places[1], states, iter([_Fault(name, states[name] >= count, f"0 to {count - 1}, the {name}s of the {of}")]))
        _refuse(places[0], trials, _check_trials(trials, states))
        _refuse(places[1], states, _check_counts(states, trials))
        return trials, states


def _read(path: Path, columns: Sequence[PickColumn]) -> np.recarray:
    import pyarrow as pa
    import pyarrow.parquet as pq

    from synpick_warp.exporters.picks import check_schema, from_table
    from synpick_warp.views.picks import are_sorted

    check_regular_file(path, _MAX_FILE, DatasetError)
    try:
        with pq.ParquetFile(path) as file:
            if not 0 <= file.metadata.num_rows <= MAX_ROWS:
                raise DatasetError(f"{path} has {file.metadata.num_rows:,} rows; at most {MAX_ROWS:,} are read")
            kind = check_schema(file.schema_arrow, columns)
            rows = from_table(file.read(), columns, kind)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DatasetError(f"{path} cannot be read: {' '.join(str(error).split())}; {ADVICE}") from None
    _refuse(path, rows, _check_columns(columns, rows))
    _refuse(path, rows, iter([_Fault("state", ~are_sorted(rows), "rows sorted by state, candidate and repeat, none twice")]))
    return rows


def _refuse(path: Path, rows: np.recarray, faults: Iterator[_Fault]) -> None:
    """Raise DatasetError about the first row of the first fault."""
    for column, wrong, allowed in faults:
        if wrong.any():
            row = int(wrong.argmax())
            raise DatasetError(f"{path}, column {column}, row {row} is {rows[column][row].tolist()}; allowed: {allowed}; {ADVICE}")


def _check_columns(columns: Sequence[PickColumn], rows: np.recarray) -> Iterator[_Fault]:
    """Yield a fault per column: values that its domain does not have."""
    import numpy as np

    kind = rows.dtype
    ended = rows["ending"] == Ending.NOT_FINITE if "ending" in (kind.names or ()) else np.zeros(len(rows), bool)
    for column in columns:
        values = rows[column.name].reshape(len(rows), kind[column.name].itemsize // kind[column.name].base.itemsize)
        right = (column.low <= values) & (values <= column.high) & np.isfinite(values)
        allowed = f"{column.low:g} to {column.high:g}" if np.isfinite(column.low) else "finite numbers"
        if column.codes:
            right, allowed = (
                np.isin(values, list(column.codes)),
                ", ".join(f"{code} {name}" for code, name in enumerate(names(column.codes))),
            )
        elif column.is_direction:
            right, allowed = np.abs(np.linalg.norm(values.astype(np.float64), axis=1, keepdims=True) - 1.0) <= _UNIT, "a unit vector"
        elif column.undefined:
            right |= np.isnan(values)
        yield _Fault(column.name, ~(right.all(axis=1) | (ended & (column.name in _MEASURED))), allowed)


def _check_counts(states: np.recarray, trials: np.recarray) -> Iterator[_Fault]:
    """Yield a fault of the first state that has another number of candidates than the table of trials."""
    import numpy as np

    tried = np.unique(trials[["state", "candidate"]])["state"]
    counts = np.searchsorted(tried, states["state"], "right") - np.searchsorted(tried, states["state"])
    for row in np.flatnonzero(counts != states["candidates"])[:1]:
        yield _Fault("candidates", np.arange(len(states)) == row, f"{counts[row]}, which have trials")


def _check_trials(trials: np.recarray, states: np.recarray) -> Iterator[_Fault]:
    """Yield faults of trials: what does not fit the states from which they start."""
    import numpy as np

    row = np.minimum(np.searchsorted(states["state"], trials["state"]), max(len(states) - 1, 0))
    yield _Fault(
        "state", states["state"][row] != trials["state"] if len(states) else np.ones(len(trials), bool), "a row of the table of states"
    )
    if not len(states):
        return
    start, instances = states[row], states["visible"].shape[1]
    yield _Fault("frame", trials["frame"] != start["frame"], "the frame of its state")
    for name, bound in (("candidate", "candidates"), ("column", "width"), ("row", "height")):
        yield _Fault(name, trials[name] >= start[bound], f"less than {bound} of its state")
    for name in ("instance", "picked"):
        yield _Fault(name, trials[name] >= instances, f"-1 to {instances - 1}, the instances of `visible`")
    yield _Fault("weight", (trials["share"] != Share.OWN) & (trials["weight"] == 0.0), "above 0, but for own grasps")
