"""Reader of simulated picks: tables of grasp trials and states as record arrays. Loads NumPy and pyarrow when a table is read.

picks = synpick_warp.open("DATA")[0].picks
picks[picks.share == Share.UNIFORM].success.mean()
"""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import check_regular_file

if TYPE_CHECKING:
    import numpy as np

MAX_ROWS = 2**22
"""Maximum number of rows of a table that the reader accepts: 1 GB of trials."""
_MAX_FILE = 2**31
"""Largest file of a table [bytes]."""


class PickTables:
    """Tables of picks of an episode, as its attributes; read on access."""

    index: int
    folder: Path
    """Folder of the data set."""

    @cached_property
    def picks(self) -> np.recarray:
        """Grasp trials, a record array with the columns of `views.picks.COLUMNS`, sorted by state, candidate and repeat.

        Raises:
            DatasetError: The data set has no picks, its table is damaged, or pyarrow is not installed.
        """
        return _read(self.folder, self.index, states=False)

    @cached_property
    def pick_states(self) -> np.recarray:
        """States from which trials start, a record array with the columns of `views.picks.STATES`. Errors: see `picks`."""
        return _read(self.folder, self.index, states=True)


def _read(folder: Path, episode: int, *, states: bool) -> np.recarray:
    """Read one of an episode's tables, and check it against its schema."""
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq

        from synpick_warp.exporters.picks import FOLDER, from_table, pick_files, read_type
        from synpick_warp.views.picks import COLUMNS, STATES, are_sorted
    except ImportError as error:
        raise DatasetError(f"picks cannot be read: {error}; install it by pip install 'synpick-warp[picks]'") from None
    path = folder / pick_files(episode)[int(states)]
    if not (folder / FOLDER).is_dir():
        raise DatasetError(f"{folder} has no picks; bake it with --formats picks, which can be combined with others, as in bop,picks")
    check_regular_file(path, _MAX_FILE, DatasetError)
    columns = STATES if states else COLUMNS
    try:
        with pq.ParquetFile(path) as file:
            if not 0 <= file.metadata.num_rows <= MAX_ROWS:
                raise DatasetError(f"{path} has {file.metadata.num_rows:,} rows; at most {MAX_ROWS:,} are read")
            kind = read_type(file.schema_arrow, columns)
            if kind is None:
                raise DatasetError(f"{path} does not have the columns of picks; {ADVICE}")
            rows = from_table(file.read(), columns, kind)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DatasetError(f"{path} cannot be read: {' '.join(str(error).split())}; {ADVICE}") from None
    if not are_sorted(rows):
        raise DatasetError(f"{path} is not sorted, or has a row twice; {ADVICE}")
    return rows
