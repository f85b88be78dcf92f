"""Tables of simulated picks: the exporter contract, and every value, unit and code as a Parquet reader finds them."""

from __future__ import annotations

import numpy as np
import pyarrow.parquet as pq
import pytest

from synpick_warp.codes import Outcome, names
from synpick_warp.exporters.picks import FOLDER, STATES_FOLDER, PicksExporter
from synpick_warp.views.picks import COLUMNS, ORDER, STATES, PickBatch, make_rows
from tests.harness.exporter_contract import ExporterContract, export
from tests.worlds.box_views import config
from tests.worlds.pick_tables import EACH, REPEATS, pick_batch


class TestPicksContract(ExporterContract):
    exporter_class = PicksExporter


def test_tables_hold_the_trials_in_order_with_units(tmp_path):
    out = export(PicksExporter, tmp_path / "set", config(), (2,))
    batch = pick_batch(2)
    for folder, columns, given in (FOLDER, COLUMNS, batch.trials), (STATES_FOLDER, STATES, batch.states):
        table, rows = pq.read_table(out / folder / "000002.parquet"), make_rows(columns, given)
        keys = [rows[name] for name in reversed(ORDER) if name in given]
        rows = rows[np.lexsort(keys)]
        assert table.column_names == [column.name for column in columns]
        for column in columns:
            np.testing.assert_array_equal(np.array(table[column.name].to_pylist()).astype(rows[column.name].dtype), rows[column.name])
            assert table.schema.field(column.name).metadata[b"unit"].decode() == column.unit
    assert table.schema.field("visible").type.list_size == 5
    trials = pq.read_table(out / FOLDER / "000002.parquet")
    assert trials.num_rows == len(batch) == 2 * 3 * EACH * REPEATS
    assert trials.schema.field("outcome").metadata[b"codes"].decode() == ",".join(names(Outcome))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.pop("seal"), "seal is missing, or no column of picks"),
        (lambda table: table.update(color=np.zeros(3)), "color is missing, or no column of picks"),
        (lambda table: table.update(point=table["point"][:, :2]), r"point of 48 rows has the shape \(48, 2\), not \(48, 3\)"),
    ],
)
def test_batches_of_other_columns_are_refused(change, message):
    batch = pick_batch(0)
    trials = dict(batch.trials)
    change(trials)
    with pytest.raises(ValueError, match=message):
        PickBatch(0, trials, batch.states)
