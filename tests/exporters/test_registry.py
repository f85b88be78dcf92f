"""Registry of formats, the composite of all exporters of a bake, and the description of the data format, which names all that the writers
produce; memory and open files of the writers (leak test). Tables of simulated picks: every value, unit and code as a Parquet reader finds
them."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

import synpick_warp.exporters
from synpick_warp.codes import Effect, Outcome, names
from synpick_warp.configs.dataset.export import ExportSettings
from synpick_warp.configs.schema import FORMATS, Config
from synpick_warp.dataset.records import Attempt, InstanceObservation
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.picks import FOLDER, STATES_FOLDER, PicksExporter
from synpick_warp.exporters.registry import Exporters, Needs, load_exporter_classes
from synpick_warp.exporters.trajectory.arrays import CONSTANT_GROUPS, EPISODE_GROUPS
from synpick_warp.factory.episodes import EpisodeOutcome
from synpick_warp.testing.box_views import config
from synpick_warp.testing.exporters import ExporterContract, export
from synpick_warp.testing.picks import EACH, REPEATS, pick_batch
from synpick_warp.views.frames import EpisodeEnd
from synpick_warp.views.layers import LAYER_TABLE
from synpick_warp.views.picks import COLUMNS, ORDER, STATES, PickBatch, make_rows


class Fake:
    """Exporter that records its calls and keeps `on_committed` callbacks pending."""

    def __init__(self, _: ExportContext | None) -> None:
        self.calls: list[str] = []
        self.pending: list = []

    def write_views(self, batch: str) -> None:
        self.calls.append(batch)

    write_ticks = write_views

    def end_episode(self, end: EpisodeEnd, on_committed) -> None:
        self.pending.append(on_committed)


def test_every_format_has_one_class_in_a_fixed_order():
    assert tuple(FORMAT_TABLE) == FORMATS
    classes = load_exporter_classes(("zarr", "bop", "zarr"))
    assert [one.__name__ for one in classes] == ["BopExporter", "TrajectoryExporter"]
    assert load_exporter_classes(FORMATS) == load_exporter_classes(FORMATS[::-1])


def test_episode_is_committed_when_the_last_exporter_has_committed_it():
    both = Exporters((Fake, Fake), None)  # type: ignore[arg-type]
    first, second = both._all
    both.write_views("views")
    both.write_ticks("tick")
    assert first.calls == second.calls == ["views", "tick"]
    committed = []
    for episode in (4, 5):
        both.end_episode(EpisodeEnd(episode, 0, 1, 1), lambda episode=episode: committed.append(episode))
    second.pending[1]()
    first.pending[0]()
    assert committed == []
    first.pending[1]()
    assert committed == [5]
    second.pending[0]()
    assert committed == [5, 4]


NEEDS = {
    ("bop",): ("views", "depth_files"),
    ("coco",): ("views",),
    ("lerobot",): ("physics", "views", "images"),
    ("usd",): (),
    ("zarr", "usd"): ("physics",),
    ("zarr", "shards"): ("physics", "views", "depth_files"),
}


@pytest.mark.parametrize("formats", NEEDS)
def test_needs_are_those_of_all_formats(formats):
    config = Config().with_values({"bake.formats": formats, "cameras.resolution": (64, 48)})
    needs = Needs.of(config)
    assert tuple(name for name in ("physics", "views", "images", "depth_files") if getattr(needs, name)) == NEEDS[formats]
    assert needs.slot_bytes == max(one.slot_bytes(ExportSettings.of(config)) for one in needs.classes)
    assert (needs.slot_bytes == 0) == (formats == ("usd",))


TICKS = 100
"""A short soak; `python -m tests.harness.soak` runs 10,000. One writer, so that it has run every type of task by half time."""


@pytest.mark.slow(minutes=1)
def test_memory_and_open_files_stay_constant():
    command = [sys.executable, "-m", "tests.harness.soak", "--ticks", str(TICKS), "--writers", "1"]
    process = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    samples = json.loads(process.stdout)
    late = slice(len(samples["memory"]) // 2, None)
    assert len(set(samples["files"][late])) == 1
    assert max(samples["memory"][late]) < 1.02 * min(samples["memory"][late])


README = Path(synpick_warp.exporters.__file__).with_name("README.md")


def described(section: str = "") -> set[str]:
    """Names in code style in a section, or in the whole text."""
    text = README.read_text(encoding="utf-8")
    part = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0] if section else text
    assert part
    return set(re.findall(r"`([\w.]+)`", part))


def test_all_that_writers_produce_is_described():
    assert set(FORMAT_TABLE) <= described()
    for package in ("bop/", "usd/", "trajectory/", "writing/"):
        assert f"`{package}`" in README.read_text(encoding="utf-8")
    assert set(LAYER_TABLE) <= described("Layers")
    keys = {*Attempt.__struct_fields__, *InstanceObservation.__struct_fields__}
    keys |= {*EpisodeOutcome._fields, "sentence", "checksum", *names(Outcome)} - {"none"}
    assert keys <= described("Episode and attempt lists")
    assert {"light", "effects", "instance_id", *names(Effect)} <= described("BOP scenes")
    groups = CONSTANT_GROUPS | EPISODE_GROUPS
    arrays = {name for group in groups.values() for name in group.arrays}
    assert arrays | set(groups) <= described("Zarr trajectories")
    assert {column.name for column in (*COLUMNS, *STATES)} <= described("Picks")


class TestPicksContract(ExporterContract):
    exporter_class, row = PicksExporter, FORMAT_TABLE["picks"]


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
