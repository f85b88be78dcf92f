"""Exporter of simulated picks: two Parquet tables per episode, of grasp trials and of the states from which they start."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from synpick_warp.codes import Ending, names
from synpick_warp.configs.dataset import DataLayout
from synpick_warp.exporters.base import EpisodeExporter, SharedFiles, StagedEpisode
from synpick_warp.exporters.writing.files import output_errors, sync_file, sync_folder
from synpick_warp.exporters.writing.pool import WriteTask
from synpick_warp.views.frames import EpisodeEnd
from synpick_warp.views.picks import COLUMNS, STATES, PickBatch, PickColumn, make_rows, row_type, sort_rows

FOLDER = Path("picks")
"""Folder in the data set, with the tables of trials."""
STATES_FOLDER = FOLDER / "states"
"""Folder of the tables of states."""
_Tables = list[tuple[np.ndarray, np.ndarray]]
"""For each batch, rows of trials and rows of states."""


class PicksExporter(EpisodeExporter[_Tables]):
    """`Exporter` of picks. Episode k becomes picks/k.parquet and picks/states/k.parquet, empty tables if it has no trials."""

    staging = FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles((), (), (STATES_FOLDER, FOLDER))

    def write_constants(self) -> list[Path]:
        for folder in (FOLDER, STATES_FOLDER):
            with output_errors(place := self._context.out / folder):
                place.mkdir(exist_ok=True)
        return []

    def write_picks(self, batch: PickBatch) -> None:
        content = self._staged(batch.episode, lambda _: []).content
        content.append((make_rows(COLUMNS, batch.trials), make_rows(STATES, batch.states)))

    def end_episode(self, end: EpisodeEnd, on_committed: Callable[[], None]) -> None:
        """An episode without trials is written, too."""
        if Ending(end.ending).delivers:
            self._staged(end.episode, lambda _: [])
        super().end_episode(end, on_committed)

    def places(self, episode: int) -> tuple[Path, Path]:
        return pick_files(episode)

    def _commit(self, episode: StagedEpisode[_Tables], end: EpisodeEnd) -> WriteTask:
        out, places = self._context.out, pick_files(end.episode)
        return WriteTask(write_tables, (), (episode.folder, episode.content, out, places), out / places[0])


def pick_files(episode: int) -> tuple[Path, Path]:
    """Paths of an episode's tables of trials and of states, relative to the data set."""
    name = f"{episode:06d}.parquet"
    return FOLDER / name, STATES_FOLDER / name


def write_tables(folder: Path, batches: _Tables, out: Path, places: tuple[Path, Path]) -> None:
    """Task: write an episode's tables, sorted, and rename them to their places in the data set: the table of trials last."""
    for place, columns, index in (places[1], STATES, 1), (places[0], COLUMNS, 0):
        parts = [batch[index] for batch in batches] or [np.empty(0, row_type(columns))]
        rows = sort_rows(np.concatenate(parts))
        pq.write_table(make_table(columns, rows), folder / place.name, compression="zstd")
        sync_file(folder / place.name)
        (folder / place.name).rename(out / place)
        sync_folder((out / place).parent)


def make_table(columns: Sequence[PickColumn], rows: np.ndarray) -> pa.Table:
    """Convert rows to an Arrow table; field metadata hold units, meanings and names of codes."""
    arrays = []
    for column in columns:
        values = np.ascontiguousarray(rows[column.name])
        flat = pa.array(values.ravel())
        arrays.append(pa.FixedSizeListArray.from_arrays(flat, values.shape[1]) if values.ndim > 1 else flat)
    return pa.table(arrays, schema=table_schema(columns, rows.dtype))


def table_schema(columns: Sequence[PickColumn], kind: np.dtype) -> pa.Schema:
    """Arrow schema of a table with rows of structured dtype `kind`."""
    fields = []
    for column in columns:
        scalar, shape = kind[column.name].subdtype or (kind[column.name], ())
        arrow = pa.from_numpy_dtype(scalar)
        codes = {"codes": ",".join(names(column.codes))} if column.codes else {}
        notes = {"unit": column.unit, "meaning": column.meaning} | codes
        fields.append(pa.field(column.name, pa.list_(arrow, shape[0]) if shape else arrow, nullable=False, metadata=notes))
    return pa.schema(fields)


def check_schema(schema: pa.Schema, columns: Sequence[PickColumn]) -> np.dtype:
    """Structured dtype of a stored table's rows; raises ValueError unless it has each of `columns` once, with its type."""
    sizes = [item.type.list_size for item in schema if item.name == "visible" and pa.types.is_fixed_size_list(item.type)]
    kind = row_type(columns, *sizes[:1])
    known = table_schema(columns, kind)
    for name in [*known.names, *schema.names]:
        if (count := schema.names.count(name)) != known.names.count(name):
            raise ValueError(f"it has {count} columns {name}; allowed: {known.names.count(name)}")
        if (found := schema.field(name).type) != (wanted := known.field(name).type):
            raise ValueError(f"column {name} has the type {found}; allowed: {wanted}")
    return kind


def from_table(table: pa.Table, columns: Sequence[PickColumn], kind: np.dtype) -> np.recarray:
    """Rows of an Arrow table; the inverse of `make_table`. Raises ValueError if a value is missing."""
    rows = np.empty(table.num_rows, kind).view(np.recarray)
    for column in columns:
        values = table[column.name].combine_chunks()
        flat = values.flatten() if pa.types.is_fixed_size_list(values.type) else values
        for part, size in ((values, 1), (flat, len(flat) // max(len(values), 1))):
            if part.null_count:
                raise ValueError(f"column {column.name}, row {part.is_null().index(True).as_py() // size} has no value")
        rows[column.name] = flat.to_numpy(zero_copy_only=False).reshape(rows[column.name].shape)
    return rows
