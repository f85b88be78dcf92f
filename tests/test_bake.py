"""Bakes from settings to files: the same bytes every time, truth that fits the images, grasp trials, what is left when something fails."""

import json
import re
import tomllib
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pyarrow.parquet as parquet
import pytest

from synpick_warp.apps.validation.registry import Level
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.cli import main as commands
from synpick_warp.codes import Ending, Outcome
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import OutputError
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.factory import picks, pipeline
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages import ticks, timing
from synpick_warp.stages.ticks import TickLoop
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing.exporters import digests
from tests.builders import PICKED, STIRRING, assignments, bake_boxes, boxes, failing_after, once
from tests.worlds.cells import check_same
from tests.worlds.small_worlds import BRIEF, QUICK, catalog, settings

EPISODES, CAMERAS = 3, 3
WIDTH, HEIGHT = 64, 36
TINY = STIRRING | {
    "bake.worlds": 2,
    "bake.episodes": EPISODES,
    "cameras.resolution": [WIDTH, HEIGHT],
    "render.views_per_batch": CAMERAS,
}


@pytest.fixture(scope="module", autouse=True)
def all_boxes():
    """All bakes here are of boxes."""
    with boxes():
        yield


class Baked:
    """A finished bake; `made`: its folder and summary, if it is not to be baked here."""

    def __init__(self, out: Path, given: Mapping[str, object] = TINY, made: BakeSummary | None = None) -> None:
        self.out, self.config = out, settings(**given)
        self.summary = made or run_bake(self.config, out, SilentProgress())
        self.split = out / self.config.bop.split

    def files(self, folder: str = ".") -> dict[str, str]:
        return digests(self.out / folder)

    def scenes(self) -> list[Path]:
        return sorted(self.split.iterdir())


def truth(scene: Path, name: str) -> dict[int, object]:
    return {int(number): record for number, record in json.loads((scene / f"{name}.json").read_text()).items()}


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Baked:
    folder, summary = once(tmp_path_factory, "stirred", lambda out: Baked(out).summary)
    return Baked(folder, made=summary)


# ---- the same bytes ----


def test_the_same_settings_give_the_same_bytes_with_a_profile_too(baked, tmp_path):
    with timing.record() as recorder:
        again = Baked(tmp_path / "again")
    assert again.files() == baked.files()
    assert len(again.files()) > 100
    calls = {path[-1]: stage.calls for path, stage in recorder.times.items()}
    assert calls["end episode"] >= EPISODES
    # A tick is enqueued in parts; on a GPU some are simulated ahead.
    assert calls["simulate"] > calls["arrange"] >= calls["wait for tick"]
    # One batch has the views of a world's frame.
    assert calls["render"] == calls["wait for images"] == calls["hand over views"] == again.summary.views // CAMERAS
    assert recorder.times["simulate",].host < recorder.wall


@pytest.mark.parametrize(
    ("worlds", "lead", "writers", "batch"), [(1, 0, 1, CAMERAS), pytest.param(2, 5, 1, CAMERAS, marks=pytest.mark.slow), (4, 5, 2, 4)]
)
def test_neither_worlds_nor_the_lead_of_physics_nor_writers_change_a_file(baked, tmp_path, monkeypatch, worlds, lead, writers, batch):
    """Two worlds are fewer than the episodes, so physics leads only once a world is idle; with four it leads from the start."""
    leads, may_begin = set(), TickLoop._may_begin
    monkeypatch.setattr(ticks, "queue_lead", lambda *_: lead)
    monkeypatch.setattr(TickLoop, "_may_begin", lambda loop: leads.add(loop._enqueued - loop._taken) or may_begin(loop))
    other = Baked(tmp_path / "other", TINY | {"bake.worlds": worlds, "bake.writers": writers, "render.views_per_batch": batch})
    assert max(leads) == lead or other.config.bake.device != "cpu"  # A GPU may not get so far ahead.
    check_same(other.out, baked.out)


def test_another_seed_gives_other_scenes(baked, tmp_path):
    other = Baked(tmp_path / "other", TINY | {"bake.seed": 1, "bake.episodes": 1, "bake.worlds": 1})
    for scene in other.scenes():
        assert (scene / "scene_gt.json").read_bytes() != (baked.split / scene.name / "scene_gt.json").read_bytes()


# ---- what is there ----


def test_every_episode_has_a_scene_for_each_camera_and_every_frame_its_files(baked):
    assert [scene.name for scene in baked.scenes()] == [f"{number:06d}" for number in range(CAMERAS * EPISODES)]
    for number, scene in enumerate(baked.scenes()):
        frames = baked.summary.episodes[number // CAMERAS].frames
        assert sorted(truth(scene, "scene_gt")) == sorted(truth(scene, "scene_camera")) == list(range(frames))
        for kind in ("rgb", "depth"):
            pictures = sorted((scene / kind).iterdir())
            assert [path.name for path in pictures] == [f"{frame:06d}.png" for frame in range(frames)]
            assert cv2.imread(str(pictures[-1]), cv2.IMREAD_UNCHANGED).shape[:2] == (HEIGHT, WIDTH)
    assert baked.summary.views == CAMERAS * sum(row.frames for row in baked.summary.episodes)
    assert [path.name for path in baked.out.iterdir() if path.name.startswith(".")] == []


def test_the_list_of_episodes_is_right(baked):
    rows = [json.loads(line) for line in (baked.out / "episodes.jsonl").read_text().splitlines()]
    assert [row["episode"] for row in rows] == list(range(EPISODES))
    assert [row["ending"] for row in rows] == ["finished"] * EPISODES
    assert {row["sentence"] for row in rows} == {Ending.FINISHED.sentence}
    tick = baked.config.physics.step * baked.config.physics.steps_per_tick
    for row, known in zip(rows, baked.summary.episodes, strict=True):
        assert (row["arrangement"], row["frames"]) == (known.arrangement, known.frames)
        assert row["seconds"] == pytest.approx((row["frames"] - 1) * tick, abs=1e-6)
        assert (row["mode"], row["attempts"], row["picked"]) == ("move", 0, 0)
        assert row["objects"] == row["left"] + row["lost"] > 0
    assert not (baked.out / "attempts.jsonl").exists()


def test_the_settings_are_kept_and_can_be_used_again(baked):
    path = baked.out / "config.toml"
    assert load_config(str(path), {}) == baked.config
    assert tomllib.loads(path.read_text())["bake"]["seed"] == baked.config.bake.seed


# ---- truth and images ----


def test_all_cameras_tell_the_same_poses_in_the_world(baked):
    """World poses from each camera's own numbers agree within 1e-3 mm."""
    for first in range(0, CAMERAS * EPISODES, CAMERAS):
        places = []
        for scene in baked.scenes()[first : first + CAMERAS]:
            cameras = truth(scene, "scene_camera")
            for view, records in truth(scene, "scene_gt").items():
                turn = np.array(cameras[view]["cam_R_w2c"]).reshape(3, 3)
                shift = np.array(cameras[view]["cam_t_w2c"])
                places.append([turn.T @ (np.array(record["cam_t_m2c"]) - shift) for record in records])
        views = np.array(places).reshape(CAMERAS, -1, len(places[0]), 3)
        assert np.abs(views - views[0]).max() < 1e-3
        # Inside the tote.
        half = 500 * np.array(baked.config.tote.rim_size)
        assert (np.abs(views[..., :2]) < half).all()
        assert (views[..., 2] > -1).all()


def test_counts_boxes_masks_depth_and_objects_agree(baked):
    """By the rules that find each fault of tests/validation/faults.py."""
    summary = Summary()
    found = validate(baked.out, ValidationOptions(threads=1), summary)
    assert [each for each in found if each.level is Level.ERROR] == []
    assert summary.views == baked.summary.views


# ---- picking ----


@pytest.fixture(scope="module")
def picked(picked_set, tmp_path_factory) -> Baked:
    return Baked(picked_set, PICKED, once(tmp_path_factory, "picked", lambda out: bake_boxes(out, PICKED))[1])


def records(baked: Baked, name: str) -> list[dict]:
    return [json.loads(line) for line in (baked.out / f"{name}.jsonl").read_text().splitlines()]


def test_attempts_are_listed_by_episode_and_number(picked):
    attempts, episodes = records(picked, "attempts"), records(picked, "episodes")
    expected = [(row["episode"], number) for row in episodes for number in range(row["attempts"])]
    assert [(row["episode"], row["attempt"]) for row in attempts] == expected
    assert {row["mode"] for row in episodes} == {"pick"}
    assert {row["ending"] for row in episodes} <= {"emptied", "gave_up"}
    for row in episodes:
        own = [attempt for attempt in attempts if attempt["episode"] == row["episode"]]
        assert row["picked"] == sum(len(attempt["picked"]) for attempt in own)
        assert row["picked"] + row["lost"] + row["left"] == row["objects"] > 0
        assert [attempt["frame"] for attempt in own] == [0, *(attempt["end_frame"] for attempt in own[:-1])]
        assert own[-1]["end_frame"] == row["frames"] - 1
    assert sum(row["picked"] for row in episodes) > 0
    assert picked.summary.outcomes == Counter(Outcome[row["outcome"].upper()] for row in attempts)


def test_what_was_picked_is_in_the_truth_until_then(picked):
    for attempt in records(picked, "attempts"):
        scene = truth(picked.scenes()[CAMERAS * attempt["episode"]], "scene_gt")
        there = [{row["instance_id"]: row["obj_id"] for row in scene[attempt[name]]} for name in ("frame", "end_frame")]
        assert there[0] == {seen["instance"]: seen["object_id"] for seen in attempt["observation"]["instances"]}
        assert set(there[0]) - set(there[1]) >= set(attempt["picked"])
        if attempt["target"] is not None:
            assert there[0][attempt["target"]] == attempt["object_id"]


def test_attempts_are_the_same_in_any_number_of_worlds(picked, tmp_path):
    other = Baked(tmp_path / "other", PICKED | {"bake.worlds": 1, "perception.views": 1})
    check_same(other.out, picked.out)


FOUR_CUPS = PICKED | {
    "gripper.kind": "suction_array",
    "gripper.cups": [[0.03, 0.02], [-0.03, 0.02], [-0.03, -0.02], [0.03, -0.02]],
    "gripper.cup_width": 0.03,
    "arrangement.volume": 4e-3,
    "bake.formats": ["bop", "zarr"],
    "cameras.resolution": [32, 18],
    "render.mode": "unoccluded",
    "render.layers": [],
}


def large_boxes() -> Catalog:
    return catalog(((0.2, 0.16, 0.05),))


@pytest.fixture(scope="module")
def four_cups(tmp_path_factory) -> Baked:
    with boxes(large_boxes):
        return Baked(tmp_path_factory.mktemp("cups") / "1", FOUR_CUPS | {"bake.worlds": 1})


def test_four_cups_pick_the_same_in_any_number_of_worlds(four_cups, tmp_path):
    with boxes(large_boxes):
        other = Baked(tmp_path / "other", FOUR_CUPS | {"bake.worlds": 2})
    check_same(other.out, four_cups.out)
    assert max(len(attempt["sealed"]) for attempt in records(four_cups, "attempts")) > 1


@pytest.mark.slow
def test_a_bake_that_grows_lists_the_attempts_of_both(picked, tmp_path):
    """The first episode's attempts come from its record: by the second bake nobody remembers them."""
    Baked(tmp_path / "set", PICKED | {"bake.episodes": 1, "bake.worlds": 1})
    grown = Baked(tmp_path / "set", PICKED)
    assert (grown.summary.resumed, grown.summary.episodes) == (1, picked.summary.episodes)
    assert grown.summary.outcomes == picked.summary.outcomes
    assert grown.files() == picked.files()


# ---- when something fails ----


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_an_error_leaves_whole_scenes_only(tmp_path, monkeypatch, baked, share):
    """Writing fails in a middle batch, or in the last one."""
    left = [int(share * (baked.summary.views // CAMERAS - 1))]
    write = BopExporter.write_views

    def failing(self, batch):
        if left[0] == 0:
            raise OutputError("no more")
        left[0] -= 1
        write(self, batch)

    monkeypatch.setattr(BopExporter, "write_views", failing)
    out = tmp_path / "set"
    with pytest.raises(OutputError, match="no more"):
        Baked(out)
    split = out / baked.config.bop.split
    for scene in sorted(split.iterdir()) if split.exists() else []:
        whole = {path.relative_to(scene) for path in scene.rglob("*")}
        assert whole == {path.relative_to(baked.split / scene.name) for path in (baked.split / scene.name).rglob("*")}
    names = {path.name for path in out.iterdir()} if out.exists() else set()
    assert not {name for name in names if name.startswith(".")}
    assert "episodes.jsonl" not in names


COMMAND = ["--config", "smoke", *assignments(QUICK | TINY)]


def test_episodes_that_are_given_up(tmp_path, capsys):
    """One arrangement without time to settle: no scenes, exit code 1, and the reason in the list of episodes."""
    out = tmp_path / "set"
    given = assignments({"settle.max_time": 0.1, "settle.tries": 1, "bake.episodes": 2})
    assert commands.main(["bake", "--out", str(out), *COMMAND, *given]) == commands.options.EXIT_INCOMPLETE
    capsys.readouterr()
    rows = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert [(row["episode"], row["ending"], row["frames"], row["seconds"]) for row in rows] == [(n, "unsettled", 0, 0.0) for n in range(2)]
    assert {row["sentence"] for row in rows} == {Ending.UNSETTLED.sentence}
    assert list(out.rglob("scene_gt.json")) == []


def test_drawn_again_and_counted(tmp_path):
    """Two arrangements without time to settle: one is noted, the second given up."""
    noted = []

    class Notes(SilentProgress):
        def note(self, text: str) -> None:
            noted.append(text)

    given = TINY | {"settle.max_time": 0.1, "settle.tries": 2, "bake.episodes": 1, "bake.worlds": 1}
    summary = run_bake(settings(**given), tmp_path / "set", Notes())
    assert (summary.resampled, summary.resampled_by_ending) == (1, {Ending.UNSETTLED: 1})
    assert [(row.episode, row.arrangement, row.ending) for row in summary.episodes] == [(0, 1, Ending.UNSETTLED)]
    advice = "raise settle.max_time (0.1) or settle.max_redrops (8)"
    assert noted == [f"episode 0, arrangement 1: {Ending.UNSETTLED.sentence}; {advice}"]
    assert summary.remedies == {Ending.UNSETTLED: advice}


def test_a_full_disk_is_one_line_and_exit_code_2(small_disk, capsys, monkeypatch):
    monkeypatch.setattr(pipeline, "check_disk", lambda *_: None)
    out = small_disk(200) / "set"
    assert commands.main(["bake", "--out", str(out), *COMMAND]) == commands.EXIT_MISTAKE
    assert re.match("synpick-warp: error: cannot write .*No space left on device", capsys.readouterr().err.splitlines()[-1])
    assert list(out.rglob(".*")) == []


def test_a_worker_that_fails_ends_the_bake_with_one_line(tmp_path, capsys, monkeypatch):
    """As with a full disk, where no small file system can be had: a file stands where a folder must be made."""
    begin = BopExporter.write_views

    def blocked(self, batch):
        split = out / "train"
        if split.is_dir() and not any(split.iterdir()):
            split.rmdir()
            split.write_text("")
        begin(self, batch)

    out = tmp_path / "set"
    monkeypatch.setattr(BopExporter, "write_views", blocked)
    assert commands.main(["bake", "--out", str(out), *COMMAND]) == commands.EXIT_MISTAKE
    assert capsys.readouterr().err.splitlines()[-1].startswith("synpick-warp: error: cannot write ")


# ---- grasp trials ----


GIVEN = {key.replace("__", "."): value for key, value in BRIEF.items()} | {
    "bake.mode": "pick",
    "bake.worlds": 2,
    "bake.episodes": 2,
    "bake.formats": ["bop", "picks"],
    "arrangement.max_objects": 2,
    "cameras.resolution": [32, 18],
    "picks.states": 2,
    "picks.candidates": 4,
    "picks.repeats": 2,
    "picks.near": 0.02,
    "picks.hold": 0.1,
    "picks.lift_height": 0.05,
}


@pytest.fixture(scope="module")
def tried(tmp_path_factory):
    folder = tmp_path_factory.mktemp("picks") / "set"
    bake_boxes(folder, GIVEN)
    return folder


def files(folder) -> dict[str, str]:
    """Digests of what episodes have, but for the tables beside their scenes."""
    found = {name: digest for name, digest in digests(folder).items() if name.startswith(("train", "picks"))}
    return {name: digest for name, digest in found.items() if not name.endswith("scene_picks.json")}


def test_tables_have_every_trial_and_the_own_grasp_succeeds_as_in_its_episode(tried):
    for episode in range(GIVEN["bake.episodes"]):
        table = parquet.read_table(tried / f"picks/{episode:06d}.parquet").to_pydict()
        states = parquet.read_table(tried / f"picks/states/{episode:06d}.parquet").to_pydict()
        assert states["state"] == [0, 1]
        assert states["candidates"] == [4, 4]
        assert list(zip(table["state"], table["candidate"], table["repeat"], strict=True)) == [
            (state, candidate, repeat) for state in range(2) for candidate in range(4) for repeat in range(2)
        ]
        own = [index for index, candidate in enumerate(table["candidate"]) if candidate == 0]
        assert all(table["outcome"][index] == Outcome.TARGET_PICKED and table["intended"][index] for index in own)
        assert all(1 <= held <= 10 for held in table["hits"])
        assert all((margin > 0) == bool(success) for margin, success in zip(table["margin"], table["success"], strict=True))


@pytest.mark.slow
def test_tables_do_not_depend_on_worlds_nor_on_a_failure(tried, tmp_path, monkeypatch):
    """Each state is tried by itself, in other numbers of worlds, by a bake that fails in between and is resumed."""
    monkeypatch.setattr(picks, "BATCH_ROUNDS", 0)
    other = GIVEN | {"bake.worlds": 1, "picks.worlds": 3}
    with failing_after(1):
        bake_boxes(tmp_path / "set", other)
    assert len(list(tmp_path.glob("set/picks/*.parquet"))) == 1
    bake_boxes(tmp_path / "set", other)
    assert files(tmp_path / "set") == files(tried)


def test_the_ordinary_data_set_is_the_same_without_trials(tried, tmp_path):
    bake_boxes(tmp_path / "set", GIVEN | {"bake.formats": ["bop"]})
    ordinary = {name: digest for name, digest in files(tried).items() if not name.startswith("picks")}
    assert len(ordinary) > 50
    assert files(tmp_path / "set") == ordinary
