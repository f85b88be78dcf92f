"""Zarr store: exporter contract, and its content as read by plain zarr, compared with the batches that were written. Of a bake, recorded
trajectories obey the laws of motion, and bytes depend neither on worlds nor on the lead of physics."""

import json
import runpy
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st

import synpick_warp
from synpick_warp.codes import Outcome
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.trajectory import arrays as tables
from synpick_warp.exporters.trajectory.exporter import TrajectoryExporter, chunk_layout, make_attempt_arrays, spool_bytes
from synpick_warp.stages import ticks as stage_ticks
from synpick_warp.stages.stream import FrameStream
from synpick_warp.testing import box_views
from synpick_warp.testing.exporters import ExporterContract, digests, exporting, finish
from tests.builders import PICKING, bake_boxes, boxes, once
from tests.harness.memory_tables import device_arrays
from tests.worlds import small_worlds, trajectories
from tests.worlds.trajectories import ATTEMPT, STEP_COUNT, UNSEEN, config, ends, ticks, write_set

EPISODES = (0, 4)
FRAMES = 19
INSTANCES = 4
"""1 + the largest instance index in box_views."""


class TestContract(ExporterContract):
    exporter_class, row = TrajectoryExporter, FORMAT_TABLE["zarr"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_set(tmp_path_factory.mktemp("zarr") / "set", config(), EPISODES, FRAMES)


@pytest.fixture(scope="module")
def store(folder) -> zarr.Group:
    return zarr.open_group(folder / tables.STORE, mode="r")


def arrays(group: zarr.Group) -> dict[str, zarr.Array]:
    return {path: member for path, member in group.members(max_depth=None) if isinstance(member, zarr.Array)}


def test_no_dimension_has_the_name_of_an_array(store):
    # xarray takes such an array for the dimension's coordinate, and then neither opens the group nor selects in it.
    dimensions = {name for array in arrays(store).values() for name in array.metadata.dimension_names}
    assert {"tick", "step", "instance", "component", "axis"} <= dimensions
    groups: dict[str, set[str]] = {}
    for path, array in arrays(store).items():
        groups.setdefault(path.rpartition("/")[0], set()).update(array.metadata.dimension_names)
    for group, dims in groups.items():
        assert dims & {path.rpartition("/")[2] for path in arrays(store) if path.rpartition("/")[0] == group} == set(), group
    assert store[f"{tables.EPISODES}/000000/ticks/pose"].attrs["labels"]["component"] == ["x", "y", "z", "qx", "qy", "qz", "qw"]


def written_batches(episode: int) -> list:
    """Tick batches of an episode."""
    return list(ticks((episode,), FRAMES))


@pytest.mark.parametrize("episode", EPISODES)
@pytest.mark.parametrize(("group", "schema"), [("ticks", tables.TICKS), ("steps", tables.STEPS)])
def test_arrays_equal_the_batches(store, episode, group, schema):
    stored, batches = store[f"{tables.EPISODES}/{episode:06d}/{group}"], written_batches(episode)
    assert set(stored.array_keys()) == set(schema.arrays)
    for name, spec in schema.arrays.items():
        if group == "ticks":
            memory = np.concatenate([batch.tick.get(name, getattr(batch, name, None)) for batch in batches])
        elif name == "time":
            continue  # See below.
        else:
            memory = np.concatenate([batch.steps[name][0] for batch in batches])
        memory = memory[tuple(slice(INSTANCES if dim == "instance" else None) for dim in spec.dims)]
        if (group, name) == ("ticks", "pose"):
            memory[stored["object_id"][:] < 0] = np.nan
        np.testing.assert_array_equal(stored[name][:], memory, err_msg=name)


def test_more_episodes_than_a_task_takes_are_written_as_one_by_one(tmp_path, monkeypatch):
    """Of tasks of two rows, with three or four episodes of each number of instances: each has the same frames whether its rows share tasks
    with others, of more and fewer instances, or not."""
    monkeypatch.setattr("synpick_warp.exporters.trajectory.exporter.SPOOL_ROWS", 2)
    episodes = tuple(range(10))

    def written(groups: list[tuple[int, ...]]) -> dict[str, str]:
        out = tmp_path / str(len(groups))
        with exporting(TrajectoryExporter, out, config(), 2 if len(groups) == 1 else 0) as exporter:
            exporter.write_constants()
            for group in groups:
                for batch in ticks(group, 2):
                    for world in np.flatnonzero(batch.episode % 3):
                        batch.object_id[world, batch.episode[world] % 3 :] = -1
                    exporter.write_ticks(batch)
                for end in box_views.ends(group, 2):
                    exporter.end_episode(end, lambda: None)
            finish(exporter)
        return digests(out)

    assert written([episodes]) == written([(episode,) for episode in episodes])


def test_step_times_are_ends_of_steps_and_the_store_is_sharded_and_compressed_by_zstd(store):
    pose = store[f"{tables.EPISODES}/000000/steps/pose"]
    assert (pose.chunks, pose.shards) == ((2 * STEP_COUNT, INSTANCES, 7), (6 * STEP_COUNT, INSTANCES, 7))
    assert [codec.to_dict()["name"] for codec in pose.compressors] == ["zstd"]
    assert pose.metadata.zarr_format == 3
    episode = store[f"{tables.EPISODES}/000004"]
    step, time = store.attrs["step"], episode["steps/time"][:]
    assert len(time) == FRAMES * STEP_COUNT
    np.testing.assert_array_equal(time[STEP_COUNT - 1 :: STEP_COUNT], episode["ticks/time"][:])
    np.testing.assert_allclose(np.diff(time.reshape(FRAMES, STEP_COUNT)), step, rtol=1e-9)


def test_episode_attributes_and_arrangement(store):
    episode = store[f"{tables.EPISODES}/000004"]
    attributes = dict(episode.attrs)
    light = attributes.pop("light")
    assert {name: light[name] for name in ("map", "yaw", "exposure")} == {"map": 0, "yaw": 2.0, "exposure": 0.25}
    assert light["units"] == {"yaw": "rad", "exposure": "EV"}
    known = {"episode": 4, "arrangement": 1, "frames": FRAMES, "ending": "emptied", "sentence": "no object is left in the tote"}
    assert attributes == known | {"seed": 0, "mode": "pick", "picked": 2, "redrops": 4}
    np.testing.assert_array_equal(episode["arrangement/object_id"][:], box_views.OBJECT_IDS[:INSTANCES])
    np.testing.assert_array_equal(episode["arrangement/mass"][:], [0.3, np.nan, 0.3, 0.3])
    drops = written_batches(4)[0].tick["drop_pose"][0, :INSTANCES]
    drops[1] = np.nan
    np.testing.assert_array_equal(episode["arrangement/drop_pose"][:], drops)


def test_attempts_as_columns(store):
    made = make_attempt_arrays([ATTEMPT], 4)
    assert {name: values.dtype.str for name, values in made.items()} == {name: one.dtype for name, one in tables.ATTEMPTS.arrays.items()}
    attempts = store[f"{tables.EPISODES}/000000/attempts"]
    columns = {name: attempts[name][:].tolist() for name in attempts.array_keys()}
    lines = [json.loads(line) for line in bytes(columns.pop("record")).splitlines()]
    assert lines == [ATTEMPT, UNSEEN]
    assert columns["outcome"] == [Outcome.TARGET_PICKED, Outcome.NOTHING_SEEN]
    assert (columns["target"], columns["object_id"], columns["frame"], columns["end_frame"]) == ([2, -1], [7, -1], [1, 6], [5, 7])
    assert (columns["point"][0], columns["normal"][0], columns["yaw"][0], columns["tilt"][0]) == ([0.1, 0.2, 0.3], [0, 0, 1], 0.25, -0.5)
    assert np.isnan(columns["point"][1]).all()
    assert np.isnan(columns["yaw"][1])
    assert columns["engaged"] == [[False, False, True, False], [False] * 4]
    assert columns["picked"] == [[False, False, True, True], [False] * 4]
    np.testing.assert_array_equal(columns["peak_force"], [[0.0, 3.25], [np.nan, np.nan]])


def test_an_episode_without_attempts_or_instances_has_empty_columns(tmp_path):
    with exporting(TrajectoryExporter, tmp_path, config()) as exporter:
        exporter.write_constants()
        (batch,) = ticks((0,), 1)
        batch.object_id.fill(-1)
        exporter.write_ticks(batch)
        exporter.end_episode(box_views.ends((0,), 1)[0], lambda: None)
    episode = zarr.open_group(tmp_path / tables.STORE / tables.EPISODES / "000000", mode="r")
    assert {array.shape[0] for array in arrays(episode["attempts"]).values()} == {0}
    assert set(episode["attempts"].array_keys()) == set(tables.ATTEMPTS.arrays)
    assert (episode["steps/pose"].shape, episode["steps/setpoint"].shape) == ((STEP_COUNT, 0, 7), (STEP_COUNT, 3))


def test_every_array_has_unit_description_and_dimension_names(store):
    """And every group has a description."""
    stored = arrays(store)
    once, each = (sum(len(doc.arrays) for doc in docs.values()) for docs in (tables.CONSTANT_GROUPS, tables.EPISODE_GROUPS))
    assert len(stored) == once + len(EPISODES) * each
    for path, array in stored.items():
        assert array.attrs["units"], path
        assert array.attrs["description"].endswith("."), path
        names = array.metadata.dimension_names
        assert len(names) == len(set(names)) == array.ndim, path
        for dim, labels in array.attrs.get("labels", {}).items():
            assert len(labels) == array.shape[names.index(dim)], path
        if array.dtype.kind in "iu" and (codes := array.attrs.get("codes")) and array.size:
            assert array[:].max() < len(codes), path
    for path, group in store.members(max_depth=None):
        if isinstance(group, zarr.Group) and path.count("/") != 1:
            assert group.attrs["description"].endswith("."), path
            for name in group.attrs.get("coordinates", "").split():
                # As xarray takes them: along a dimension of the group's other arrays.
                assert group[name].metadata.dimension_names == (path.rpartition("/")[2].removesuffix("s"),), path
            assert ("coordinates" in group.attrs) == path.endswith(("/ticks", "/steps")), path


def test_equally_named_dimensions_have_equal_sizes(store):
    """Within an episode, as xarray requires."""
    for episode in EPISODES:
        extents: dict[str, set[int]] = {}
        for array in arrays(store[f"{tables.EPISODES}/{episode:06d}"]).values():
            for name, extent in zip(array.metadata.dimension_names, array.shape, strict=True):
                extents.setdefault(name, set()).add(extent)
        assert {name: len(sizes) for name, sizes in extents.items()} == dict.fromkeys(extents, 1)


def test_without_recorded_steps_there_is_no_group_of_steps(tmp_path):
    write_set(tmp_path, config(steps=False), (0,), 3, steps=False)
    episode = zarr.open_group(tmp_path / tables.STORE / tables.EPISODES / "000000", mode="r")
    assert set(episode.group_keys()) == set(tables.EPISODE_GROUPS) - {"steps"}
    assert spool_bytes(INSTANCES, STEP_COUNT, False) < spool_bytes(INSTANCES, STEP_COUNT, True) / 3


def test_missing_frames_and_an_array_missing_from_the_schema_are_errors(tmp_path):
    with exporting(TrajectoryExporter, tmp_path, config()) as exporter:
        for batch in ticks((0,), 2):
            exporter.write_ticks(batch)
        with pytest.raises(ValueError, match="ended with 3 frames, but 2 came"):
            exporter.end_episode(ends((0,), 3)[0], lambda: None)
        (other,) = ticks((1,), 1)
        other.steps["magic"] = other.steps["setpoint"]
        with pytest.raises(ValueError, match="magic"):
            exporter.write_ticks(other)


@given(ticks=st.integers(0, 5000), chunk=st.integers(1, 64), chunks=st.integers(1, 64), rows=st.integers(1, 40))
@settings(max_examples=200)
def test_shards_hold_whole_chunks_of_whole_ticks_and_no_more_than_needed(ticks, chunk, chunks, rows):
    rows_per_chunk, shard = chunk_layout(trajectories.config(chunk_ticks=chunk, shard_chunks=chunks).trajectory, ticks, rows)
    assert rows_per_chunk == chunk * rows
    assert shard % rows_per_chunk == 0
    assert shard <= chunks * rows_per_chunk
    assert shard - rows_per_chunk < max(1, ticks * rows)


# ---- bakes ----

TOOL = "tools.checks.trajectory"
MIXED = PICKING | {
    "bake.formats": ["zarr"],
    "bake.mode": "mixed",
    "bake.episodes": 3,
    "cameras.resolution": [32, 18],
    "physics.iterations": 8,
}
"""Settings of a mixed bake that takes some seconds and includes an episode of picking."""


@pytest.fixture(scope="module")
def mixed() -> Config:
    return small_worlds.settings(**MIXED)


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    """A finished bake of boxes; beside it the same with another number of worlds, and with physics ahead."""

    def make(folder: Path) -> None:
        with boxes() as patch:
            # No format needs images.
            patch.setattr(FrameStream, "render", lambda *_: pytest.fail("views were rendered"))
            bake_boxes(folder, MIXED)
            patch.setattr(stage_ticks, "queue_lead", lambda *_: 5)
            bake_boxes(folder.with_name("again"), MIXED | {"bake.worlds": 3})

    return once(tmp_path_factory, "mixed", make)[0]


def check(monkeypatch, *arguments: object) -> int:
    monkeypatch.setattr(sys, "argv", [TOOL, *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module(TOOL, run_name="__main__")
    return ended.value.code


def test_the_laws_of_motion_hold_whatever_the_number_of_worlds_and_the_lead_of_physics(out, tmp_path, monkeypatch, capsys):
    assert digests(out / "trajectory.zarr") == digests(out.with_name("again") / "trajectory.zarr")
    assert check(monkeypatch, out) == 0
    assert "VIOLATED" not in capsys.readouterr().out
    assert check(monkeypatch, tmp_path) == 2
    assert "has no trajectories" in capsys.readouterr().err
    assert check(monkeypatch, tmp_path, "--episodes", 0) == 2


@pytest.mark.parametrize(
    ("array", "what"),
    [
        ("steps/velocity", "change of momentum"),
        ("steps/contact_force", "contacts of all objects against their weight"),
        ("steps/pose", "last step against frame"),
        ("steps/setpoint", "gripper: force against its law"),
        ("steps/seal_force", "peak force of a tick"),
        ("ticks/pose", "speed, by displacement over a tick"),
        ("ticks/pose", "poses that are not finite"),
    ],
)
def test_corrupted_arrays_violate_the_laws_of_motion(out, tmp_path, monkeypatch, capsys, array, what):
    picking = next(episode for episode in synpick_warp.open(out).values() if episode.attributes["mode"] != "move")
    shutil.copytree(out, tmp_path / "set")
    one = zarr.open_array(tmp_path / "set" / f"trajectory.zarr/episodes/{picking.number:06d}" / array, mode="r+")
    values = 1.2 * one[:]
    values[1::2] += 0.02 if array.startswith("steps") else 0.5
    if array.startswith("ticks"):
        values[0] = np.nan
    one[:] = values
    assert check(monkeypatch, tmp_path / "set") == 1
    assert any("VIOLATED" in line and what in line for line in capsys.readouterr().out.splitlines())


def test_what_is_opened_is_what_was_baked(out, mixed):
    data = synpick_warp.open(out)
    assert data.config == mixed
    lines = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    for row, episode in zip(lines, data.values(), strict=True):
        known = {name: value for name, value in row.items() if name != "checksum"}
        assert {name: episode.attributes[name] for name in known} == known
    attempts = [json.loads(line) for line in (out / "attempts.jsonl").read_text().splitlines()]
    assert [attempt for episode in data.values() for attempt in episode.attempts] == attempts
    assert any(attempt["outcome"] == "target_picked" for attempt in attempts)
    for row, episode in zip(lines, data.values(), strict=True):
        there = episode.ticks["object_id"][:] >= 0
        assert (there[0].sum(), there[-1].sum()) == (row["objects"], row["left"])
        assert episode.steps["time"].shape == (16 * row["frames"],)
        obj_ids = episode.arrangement["object_id"][:]
        np.testing.assert_allclose(episode.arrangement["mass"][:], [data.objects[obj_id - 1].mass for obj_id in obj_ids])


def test_the_memory_table_counts_recorded_arrays(mixed):
    """One record; none for formats that ask for none."""
    mixed = replace(mixed, bake=replace(mixed.bake, device="cpu"))  # A GPU gets at least eight worlds.
    rows = [row for row in device_arrays(mixed) if row[0] == "StepArrays.pose"]
    assert rows == [("StepArrays.pose", (1, 16, 4), "m", 16 * 4 * 28)]
    without = replace(mixed, bake=replace(mixed.bake, formats=("bop",)))
    assert not any(row[0].startswith("StepArrays") for row in device_arrays(without))
