"""Registry of formats, the composite of all exporters of a bake, and the description of the data format, which names all that the writers
produce; memory and open files of the writers (leak test); tables of simulated picks as a Parquet reader finds them. LeRobot data sets
by the real pool: tables by pyarrow against the simulation, videos by PyAV, whose bytes depend neither on freed memory nor on the CPU."""

import base64
import dataclasses
import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

import synpick_warp.exporters
from synpick_warp.codes import Effect, Outcome, Task, names
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import FORMATS, Config, Split
from synpick_warp.dataset.annotations import Attempt, InstanceObservation
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.base import ExportContext, list_folders
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.lerobot import layout, video
from synpick_warp.exporters.lerobot.episode import describe_tasks
from synpick_warp.exporters.lerobot.exporter import LerobotExporter
from synpick_warp.exporters.picks import FOLDER, STATES_FOLDER, PicksExporter
from synpick_warp.exporters.registry import Exporters, Needs, load_exporter_classes
from synpick_warp.exporters.trajectory.arrays import CONSTANT_GROUPS, EPISODE_GROUPS
from synpick_warp.factory.episodes import EpisodeOutcome
from synpick_warp.testing import box_views
from synpick_warp.testing.box_views import EACH, REPEATS, config, pick_batch
from synpick_warp.testing.exporters import ExporterContract, export, exporting, feed, finish
from synpick_warp.views.frames import EpisodeEnd
from synpick_warp.views.layers import LAYER_TABLE
from synpick_warp.views.picks import COLUMNS, ORDER, STATES, PickBatch, make_rows
from tests.harness.hostile import replaced
from tests.worlds import trajectories


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


TICKS = 30
"""A short soak; `python -m tests.harness.soak` runs 10,000. One writer, so that it has run every type of task by half time."""
GROWTH = 1.004
"""Largest growth of memory in the second half; measured: 1.0003."""


@pytest.mark.slow
def test_memory_and_open_files_stay_constant():
    command = [sys.executable, "-m", "tests.harness.soak", "--ticks", str(TICKS), "--writers", "1"]
    process = subprocess.run(command, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True)
    samples = json.loads(process.stdout)
    late = slice(len(samples["memory"]) // 2, None)
    assert len(set(samples["files"][late])) == 1
    assert max(samples["memory"][late]) < GROWTH * min(samples["memory"][late])


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


# ---- LeRobot ----

EPISODES = (0, 2)
FRAMES = 11
"""More than a group of pictures."""
LENSES = box_views.cameras()


class TestLerobotContract(ExporterContract):
    exporter_class, row = LerobotExporter, FORMAT_TABLE["lerobot"]


def write(out: Path, settings: Config, episodes: tuple[int, ...] = EPISODES) -> Path:
    """Write a data set with physics, views and attempts."""
    with exporting(LerobotExporter, out, settings) as exporter:
        exporter.write_constants()
        for tick in trajectories.ticks(episodes, FRAMES):
            exporter.write_ticks(tick)
        for batch in box_views.batches(4, episodes, FRAMES, LENSES):
            exporter.write_views(batch)
        for end in trajectories.ends(episodes, FRAMES):
            exporter.end_episode(end, lambda: None)
        finish(exporter)
    return out


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("lerobot") / "set", trajectories.config()) / "lerobot"


@pytest.fixture(scope="module")
def data(dataset) -> dict[str, np.ndarray]:
    table = pq.read_table(dataset / "data" / "chunk-000" / "file-000.parquet").to_pydict()
    return {name: np.array(values) for name, values in table.items()}


@pytest.fixture(scope="module")
def episodes(dataset) -> list[dict]:
    return pq.read_table(dataset / "meta" / "episodes" / "chunk-000" / "file-000.parquet").to_pylist()


def test_frames_hold_states_and_commands_of_the_simulation(data):
    for place, episode in enumerate(EPISODES):
        ticks = list(trajectories.ticks((episode,), FRAMES))
        mine = data["episode_index"] == place
        for frame, tick in enumerate(ticks):
            following = ticks[min(frame + 1, FRAMES - 1)]
            suction = [float(one.tick["task"][0] == Task.LIFT) for one in (tick, following)]
            state = [*tick.fixture_pose[0, 2], suction[0], float(tick.tick["attached"][0].any())]
            np.testing.assert_array_equal(data["observation.state"][mine][frame], np.array(state, np.float32))
            np.testing.assert_array_equal(
                data["action"][mine][frame], np.array([*following.steps["setpoint"][0, -1], suction[1]], np.float32)
            )
    assert data["index"].tolist() == list(range(2 * FRAMES))
    assert data["frame_index"].tolist() == 2 * list(range(FRAMES))
    period = trajectories.config().physics.step * trajectories.STEP_COUNT
    np.testing.assert_array_equal(data["timestamp"].astype(np.float32), np.tile(np.arange(FRAMES) * period, 2).astype(np.float32))


def test_frames_without_setpoint_are_commanded_to_stay_and_missing_views_are_an_error(tmp_path):
    with exporting(LerobotExporter, tmp_path, trajectories.config()) as exporter:
        feed(exporter, (0,), 2)
        finish(exporter)
        table = pq.read_table(tmp_path / layout.DATA).to_pydict()
        assert table["action"][0][:3] == table["observation.state"][1][:3]
    with exporting(LerobotExporter, tmp_path, trajectories.config()) as exporter:
        for tick in trajectories.ticks((1,), 2):
            exporter.write_ticks(tick)
        exporter.write_views(next(box_views.batches(2, (1,), 2, LENSES)))
        with pytest.raises(ValueError, match="views of 2 groups of pictures are missing"):
            exporter.end_episode(trajectories.ends((1,), 2)[0], lambda: None)


def test_attempts_become_tasks_rewards_and_outcomes(data, dataset):
    first = slice(0, FRAMES)
    sentences = pq.read_table(dataset / "meta" / "tasks.parquet").to_pydict()["task"]
    spoken = [sentences[index] for index in data["task_index"][first]]
    # The first attempt, frames 1 to 4, aims at a box 7 and picks; the second, frame 6, sees nothing.
    assert spoken == 5 * ["pick the box 7 out of the tote"] + 6 * ["pick all objects out of the tote"]
    assert data["attempt.index"][first].tolist() == [-1, 0, 0, 0, 0, -1, 1, -1, -1, -1, -1]
    assert data["attempt.outcome"][2] == Outcome.TARGET_PICKED
    assert data["next.reward"][first].tolist() == [0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0]
    assert data["next.success"][first].sum() == 1
    assert np.flatnonzero(data["next.done"]).tolist() == [FRAMES - 1, 2 * FRAMES - 1]


OBJECTS = {1: "001_first", 2: "second"}
FIRST, SECOND, WHOLE = (f"pick {what} out of the tote" for what in ("the first", "the second", "all objects"))
STIR = "stir the objects in the tote"


@pytest.mark.parametrize(
    ("mode", "attempts", "sentences"),
    [
        # (obj_id of the target, first frame, frame in which it had ended). The last attempt ends in the episode's last frame.
        ("pick", [(1, 0, 3), (2, 3, 6)], 3 * [FIRST] + 4 * [SECOND]),
        ("pick", [(1, 0, 6)], 7 * [FIRST]),
        ("pick", [(1, 1, 3), (None, 3, 4)], 3 * [FIRST] + 4 * [WHOLE]),
        ("pick", [(None, 0, 1), (2, 1, 6)], [WHOLE] + 6 * [SECOND]),
        ("pick", [], 7 * [WHOLE]),
        ("move", [], 7 * [STIR]),
    ],
)
def test_the_last_frame_keeps_the_sentence_of_the_last_attempt(mode, attempts, sentences):
    rows = [{"object_id": target, "frame": first, "end_frame": last} for target, first, last in attempts]
    found, tasks = describe_tasks(mode, 7, rows, OBJECTS)
    assert [found[task] for task in tasks] == sentences
    assert len(found) == len(set(sentences))


def test_videos_show_the_views_at_exact_times(dataset, episodes):
    rate = layout.video_rate(trajectories.config().physics)
    for place, episode in enumerate(EPISODES):
        row = episodes[place]
        assert (row["episode_index"], row["source/episode"], row["length"]) == (place, episode, FRAMES)
        assert (row["dataset_from_index"], row["dataset_to_index"]) == (place * FRAMES, (place + 1) * FRAMES)
        assert (row["source/mode"], row["source/ending"], row["source/attempts"], row["source/picked"]) == ("pick", "emptied", 2, 2)
        for camera in range(3):
            key = f"observation.images.camera_{camera}"
            assert (row[f"videos/{key}/chunk_index"], row[f"videos/{key}/file_index"]) == (0, episode)
            truth = [one.color[0] for one in box_views.batches(1, (episode,), FRAMES, LENSES) if int(one.camera[0]) == camera]
            with av.open(str(dataset / "videos" / key / "chunk-000" / f"file-{episode:03d}.mp4")) as container:
                stream = container.streams.video[0]
                assert (stream.codec_context.name, stream.average_rate) == ("h264", rate)
                shown = list(container.decode(stream))
            assert [frame.pts * frame.time_base for frame in shown] == [frame / rate for frame in range(FRAMES)]
            assert [frame.key_frame for frame in shown] == [index % video.GROUP == 0 for index in range(FRAMES)]
            for frame, color in zip(shown, truth, strict=True):
                assert np.abs(frame.to_ndarray(format="rgb24").astype(int) - color).mean() < 6


def test_info_describes_every_column_and_video(dataset, data, episodes):
    info = json.loads((dataset / "meta" / "info.json").read_text())
    assert (info["codebase_version"], info["total_episodes"], info["total_frames"]) == ("v3.0", 2, 2 * FRAMES)
    videos = {name for name, feature in info["features"].items() if feature["dtype"] == "video"}
    assert videos == {f"observation.images.camera_{camera}" for camera in range(3)}
    assert set(info["features"]) - videos == set(data)
    for name in set(data):
        assert info["features"][name]["shape"] == list(data[name].shape[1:] or (1,))
    assert Fraction(info["fps"]).limit_denominator(1000) == 1 / Fraction(trajectories.config().physics.step * 4).limit_denominator(1000)
    assert (dataset / info["data_path"].format(chunk_index=0, file_index=0)).is_file()
    assert all(feature["info"]["video.codec"] == "h264" for name, feature in info["features"].items() if name in videos)


def test_splits_are_ranges_of_episodes(tmp_path, dataset, episodes):
    assert json.loads((dataset / "meta" / "info.json").read_text())["splits"] == {"train": "0:2"}
    assert [row["source/split"] for row in episodes] == ["train", "train"]
    assert "  - split: train\n    path: data/" in (dataset / "README.md").read_text()
    splits = (Split("train", 2, 0, "pick", "train_pbr"), Split("test", 3, 2, "pick", "test_pbr"), Split("val", 1, 1500, "pick", "val_pbr"))
    settings = dataclasses.replace(trajectories.config(), splits=splits)
    shutil.copytree(dataset, out := tmp_path / "set" / "lerobot")
    (out.parent / ".partial").mkdir()
    LerobotExporter.finalize(out.parent, ExportSettings.of(settings), None, range(10))  # type: ignore[arg-type]
    assert json.loads((out / "meta" / "info.json").read_text())["splits"] == {"train": "0:1", "test": "1:2"}
    assert [row["source/split"] for row in pq.read_table(out.parent / layout.EPISODES).to_pylist()] == ["train", "test"]
    assert "  data_files: data/*/*.parquet\n" in (out / "README.md").read_text()
    assert "in `meta/info.json`): train, test.\n" in (out / "README.md").read_text()
    chunk = layout.video_path("camera_0", 1500).parent
    (out.parent / chunk).mkdir()
    assert chunk in list_folders(out.parent, LerobotExporter.shared_files(DataLayout.of(settings)).folders)
    assert str(layout.PARTS) == FORMAT_TABLE["lerobot"].part.folder


def test_statistics_are_those_of_all_frames(dataset, data, episodes):
    stats = json.loads((dataset / "meta" / "stats.json").read_text())
    for name, values in data.items():
        numbers = values.reshape(2 * FRAMES, -1).astype(float)
        expected = {"min": numbers.min(0), "max": numbers.max(0), "mean": numbers.mean(0), "std": numbers.std(0), "count": [2 * FRAMES]}
        for key, value in expected.items():
            np.testing.assert_allclose(stats[name][key], value, rtol=1e-6, atol=1e-9, err_msg=f"{name} {key}")
    halves = data["observation.state"].reshape(2, FRAMES, -1)
    np.testing.assert_allclose(stats["observation.state"]["q90"], np.quantile(halves.astype(float), 0.9, axis=1).mean(axis=0), rtol=1e-6)
    color = np.concatenate(
        [one.color[0, ::4, ::4].reshape(-1, 3) for one in box_views.batches(1, EPISODES, FRAMES, LENSES) if one.camera[0] == 1]
    )
    seen = stats["observation.images.camera_1"]
    for key, value in {"min": color.min(0), "max": color.max(0), "mean": color.mean(0), "std": color.std(0)}.items():
        np.testing.assert_allclose(np.ravel(seen[key]), value / 255, rtol=1e-6)
    median = np.quantile(color, 0.5, axis=0, method="inverted_cdf")
    np.testing.assert_allclose(np.ravel(seen["q50"]), median / 255)
    assert np.shape(seen["q50"]) == (3, 1, 1)
    assert episodes[1]["stats/index/min"] == [FRAMES]


def with_rows(content: dict, state: float | None) -> bytes:
    """A part in which the first number of the state is another; without one, the last row is short."""
    rows = np.frombuffer(base64.b64decode(content["rows"]), layout.ROW).copy()
    if state is None:
        return json.dumps(content | {"rows": content["rows"][:-8]}).encode()
    rows["state"][0, 0] = state
    return json.dumps(content | {"rows": base64.b64encode(rows.tobytes()).decode()}).encode()


FAULTS: dict[str, Callable[[dict], bytes]] = {
    "text": lambda content: b"{",
    "rows": lambda content: with_rows(content, None),
    "inf": lambda content: with_rows(content, np.inf),
    "nan": lambda content: with_rows(content, np.nan),
    "cameras": lambda content: json.dumps(content | {"levels": content["levels"][:1]}).encode(),
    "levels": lambda content: json.dumps(replaced(content, ("levels", 0, 1), [0] * 256)).encode(),
    "huge levels": lambda content: json.dumps(content | {"levels": [[[2**61] * 256] * 3] * len(content["levels"])}).encode(),
}


@pytest.mark.parametrize("fault", [*FAULTS, "link"])
def test_damaged_parts_are_one_error(tmp_path, fault):
    out = write(tmp_path / "set", trajectories.config(), (0,))
    part = out / layout.part_path(0)
    if fault == "link":
        part.rename(tmp_path / "elsewhere")
        part.symlink_to(tmp_path / "elsewhere")
    else:
        part.write_bytes(FAULTS[fault](json.loads(part.read_text())))
    (out / ".partial").mkdir()
    with pytest.raises(DatasetError, match=r"000000\.json"):
        LerobotExporter.finalize(out, ExportSettings.of(trajectories.config()), None, (0,))  # type: ignore[arg-type]


def test_missing_packages_are_one_line_that_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "av", None)
    for name in [name for name in sys.modules if name.startswith("synpick_warp.exporters.lerobot")]:
        monkeypatch.delitem(sys.modules, name)
    with pytest.raises(ConfigError, match=r"bake\.formats names lerobot, .*av.*; install it by pip install 'synpick-warp\[lerobot\]'"):
        load_exporter_classes(("lerobot",))


def test_odd_image_sizes_are_refused_at_the_start_and_chunks_hold_a_thousand_videos():
    with pytest.raises(ConfigError, match=r"cameras\.resolution .* even width and height with the format lerobot"):
        load_config("smoke", {"bake.formats": ["lerobot"], "cameras.resolution": [161, 90]})
    assert str(layout.video_path("camera_1", 2345)).endswith("camera_1/chunk-002/file-345.mp4")
    assert len(layout.video_folders(("camera_0", "camera_1"))) == 2 + 2 + 1


CHUNK = 100_000
"""Allocation size [bytes], below glibc's mmap threshold of 128 KiB: larger blocks are newly mapped, zero-filled pages."""


def moving_noise(width: int, height: int) -> list[np.ndarray]:
    """Synthetic video: YUV planes of a group of pictures, from a crop window that moves across a blurred noise image."""
    noise = np.random.default_rng(0).integers(0, 256, (height + 40, width + 40, 3), dtype=np.uint8)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX)
    windows = [picture[2 * step : 2 * step + height, 3 * step : 3 * step + width] for step in range(video.GROUP)]
    return [video.split_planes(np.ascontiguousarray(window)) for window in windows]


def encode(planes: list[np.ndarray], path: Path) -> bytes:
    video.write_group(planes, np.zeros((3, video.LEVELS), np.int64), Fraction(15), path)
    return path.read_bytes()


def fill_free_memory(value: int) -> bytes:
    """Fill 10 MB of the heap with a byte value and free it, except the last chunk, which prevents the heap from shrinking."""
    chunks = [bytes([value]) * CHUNK for _ in range(100)]
    return chunks.pop()


@pytest.mark.parametrize(("width", "height"), [(96, 72), (224, 224), (320, 240), (480, 270)])
def test_bytes_depend_neither_on_freed_memory_nor_on_the_instruction_set(tmp_path, monkeypatch, width, height):
    """Regression test: at these sizes x264's macroblock tree with AVX-512 reads out of bounds, unless `cpu-independent` is set."""
    planes = moving_noise(width, height)
    found = set()
    for value in (0, 255, 128):
        last_chunk = fill_free_memory(value)
        found.add(encode(planes, tmp_path / "group"))
        del last_chunk
    monkeypatch.setitem(video._OPTIONS, "x264-params", video._OPTIONS["x264-params"] + ":asm=0")
    assert found == {encode(planes, tmp_path / "group")}
