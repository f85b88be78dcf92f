"""Bakes that are killed, stopped or fail, and go on: what is there in the end is what an undisturbed bake makes."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import synpick_warp
from synpick_warp.cli.main import EXIT_MISTAKE
from synpick_warp.configs.files.load import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import writing
from synpick_warp.dataset.commit.manifest import committed_episodes
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.factory import pipeline
from synpick_warp.testing.exporters import digests
from tests.builders import mistake, run
from tests.harness import scripted_bake
from tests.harness.bake_server import TINY, BakeServer
from tests.harness.processes import kill_at, wait_for

KILLS = int(os.environ.get("SYNPICK_KILLS", 2))
"""Number of kills at random numbers of files, of the bake and of its writer in turn; a long run has 200."""
EPISODES = TINY["bake.episodes"]
FILES_OF_THE_MANIFEST = 2 + 2 * (EPISODES + 2)
"""Files without a checksum: settings, manifest, and two for each entry."""


@pytest.fixture(scope="module")
def server() -> Iterator[BakeServer]:
    """The server of quick bakes, which loads all kernels once."""
    with BakeServer() as server:
        yield server


@pytest.fixture(scope="module")
def whole(server, tmp_path_factory) -> Path:
    """An undisturbed bake."""
    out = tmp_path_factory.mktemp("whole") / "set"
    assert server.bake(out, warm=True) == 0
    return out


@pytest.fixture(scope="module")
def expected(whole) -> dict[str, str]:
    return digests(whole)


@pytest.mark.slow
def test_killed_at_any_number_of_files_and_resumed_the_files_are_those_of_an_undisturbed_bake(server, expected, tmp_path):
    """A smoke test of what simulations of crash points assume. These bakes find other values in allocated memory than the undisturbed one:
    none may reach the files."""
    numbers, out = random.Random(0), tmp_path / "set"
    for kill in range(KILLS):
        kill_at(server.start(out, allocated=0x7F), out, numbers.randint(0, len(expected)), writer=kill % 2 == 1)
        code = server.wait()
        assert code in (0, -signal.SIGKILL, EXIT_MISTAKE)
        if code == 0:  # It had ended before.
            assert digests(out) == expected
            shutil.rmtree(out)
    assert server.bake(out, allocated=0x7F) == 0
    assert digests(out) == expected


SMALL = {"bake.formats": ["bop"], "bop.split": "test"}


def scripted_config(**given: Any) -> Config:
    values = {"bake.mode": "move", "bop.split": "train", "bop.color_format": "png"} | given
    return scripted_bake.settings(EPISODES, tuple(TINY["bake.formats"])).with_values(values)


@pytest.fixture
def scripted(tmp_path, monkeypatch) -> Callable[..., str]:
    """Function that runs the command `bake` without simulation, for seconds less, and returns what it reports as an error."""
    monkeypatch.setattr(pipeline, "_fill", scripted_bake.fill)

    def bake(out: Path, *arguments: str, splits: str = "", **given: Any) -> str:
        (tmp_path / "scripted.toml").write_text(config_to_toml(scripted_config(**given)) + splits)
        ran = run("bake", "--config", tmp_path / "scripted.toml", "--out", out, *arguments)
        assert (ran.code == 0) == ("error: " not in ran.err), ran.err
        return ran.err.partition("error: ")[2]

    return bake


SPLITS = "\n[splits.train]\nepisodes = 3\n[splits.test]\nepisodes = 1\n"


@pytest.mark.slow
def test_splits_fill_one_folder_in_any_order(scripted, tmp_path):
    """Split by split and shard by shard or all at once: the same files; and the episodes are those of the same indices without splits."""
    once, parts = tmp_path / "once", tmp_path / "parts"
    assert scripted(once, splits=SPLITS) == ""
    assert scripted(tmp_path / "without") == ""
    for arguments in (["--split", "test"], ["--split=train", "--shard=0/2"], ["--split", "train,test"]):
        assert scripted(parts, *arguments, splits=SPLITS) == ""
        assert verify(parts).finished
    files, expected = digests(once), digests(tmp_path / "without")
    assert digests(parts) == files
    moved = {name.replace("test_web/", "train_web/").replace("test/", "train/"): digest for name, digest in files.items()}
    images = [name for name in expected if name.endswith((".png", ".tar")) or name.startswith("train/")]
    assert images
    for name in images:
        # COCO files name their split.
        assert name in moved
        assert moved[name] == expected[name] or name.endswith("scene_gt_coco.json")
    data = synpick_warp.open(once)
    cameras = data.camera_count
    assert {name: list(part) for name, part in data.splits.items()} == {"train": [0, 1, 2], "test": [3]}
    assert [episode.row["split"] for episode in data.values()] == [episode.attributes["split"] for episode in data.values()]
    assert sorted(path.name for path in (once / "test").iterdir()) == [f"{3 * cameras + camera:06d}" for camera in range(cameras)]
    assert data.split("test")[3].view(0).rgb.shape == data[0].view(0).rgb.shape
    assert 0 not in data.split("test")
    for name, scenes in (("train", range(3 * cameras)), ("test", range(3 * cameras, 4 * cameras))):
        for kind in ("bop19", "bop24"):
            targets = json.loads((once / f"{name}_targets_{kind}.json").read_text())
            assert {target["scene_id"] for target in targets} == set(scenes)
        assert {int(key[:6]) for key in json.loads((once / f"{name}_web" / "key_to_shard.json").read_text())} == set(scenes)


def test_a_data_set_of_splits_grows_at_its_end_only(scripted, tmp_path):
    out, few, more = tmp_path / "set", *(SPLITS.replace("= 3", f"= {count}") + "first = 3\n" for count in (2, 3))
    given = {"bake.episodes": 3, "bake.formats": ["zarr"]}
    assert scripted(out, splits=few, **given) == ""
    assert committed_episodes(out) == [0, 1, 3]
    assert scripted(out, splits=more, **given | {"bake.episodes": 4}) == ""
    assert committed_episodes(out) == [0, 1, 2, 3]
    assert scripted(out, splits=few, **given).startswith("splits.train.episodes is 2, but")


def test_a_bake_of_other_settings_is_refused_and_says_which(scripted, copied):
    before = digests(copied)
    line = scripted(copied, **SMALL | {"physics.friction": 0.4, "bake.seed": 3, "bake.worlds": 1})
    assert line.startswith(f"{copied} was started with other settings: ")
    assert "bake.seed is 3, there 0; physics.friction is 0.4, there 0.5; " in line
    assert "worlds" not in line
    assert "bake.episodes is 2, but" in scripted(copied, **SMALL | {"bake.episodes": 2})
    assert digests(copied) == before


SENSORS = {
    "bop.layout": "multisensor",
    "bop.keypoints": 4,
    "bop.masks": True,
    "bop.coco": True,
    "bake.formats": ["bop"],
    "bake.episodes": 2,
}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("splits", "given", "options"),
    [
        (SPLITS, {"bake.formats": ["bop"]}, (["--split", "train"], ["--split", "test"])),
        ("", SENSORS, (["--shard", "0/2"], ["--shard", "1/2"])),
    ],
    ids=["splits", "sensors"],
)
def test_parts_of_splits_and_of_several_sensors_are_merged(scripted, tmp_path, splits, given, options):
    parts = [tmp_path / "first", tmp_path / "second"]
    for part, arguments in zip([*parts, tmp_path / "once"], [*options, []], strict=True):
        assert scripted(part, *arguments, splits=splits, **given) == ""
    assert merge(parts, tmp_path / "merged").missing == []
    assert digests(tmp_path / "merged") == digests(tmp_path / "once")


@pytest.mark.slow
def test_stopped_once_it_finishes_what_is_whole_and_twice_it_ends_at_once(server, expected, tmp_path):
    out, log = tmp_path / "set", tmp_path / "log"
    process = server.start(out, log=str(log), settings={"bake.worlds": 1})
    wait_for(lambda: len(committed_episodes(out)) >= 1)
    os.kill(process, signal.SIGTERM)
    assert server.wait() == 128 + signal.SIGTERM
    assert "stopping after this tick" in log.read_text()
    there = committed_episodes(out)
    assert 1 <= len(there) < EPISODES
    assert f"interrupted: {len(there)} of {EPISODES} episodes are complete" in log.read_text()
    assert (verify(out).problem, verify(out).finished) == ("", False)
    assert not (out / PARTIAL).exists()
    log.unlink()
    process = server.start(out, log=str(log))
    wait_for(lambda: any((out / PARTIAL).rglob("*.png")))
    os.kill(process, signal.SIGINT)
    wait_for(lambda: "stopping" in log.read_text())
    os.kill(process, signal.SIGINT)
    assert server.wait() == 130
    assert server.bake(out) == 0
    assert digests(out) == expected


@pytest.mark.slow
def test_the_folder_is_removed(scripted, tmp_path, monkeypatch):
    """After the first of four episodes."""
    out, moved, write = tmp_path / "set", tmp_path / "moved", scripted_bake._write_episode

    def write_elsewhere(*arguments: Any) -> Any:
        monkeypatch.setattr(scripted_bake, "_write_episode", write)
        row = write(*arguments)
        out.rename(moved)
        return row

    monkeypatch.setattr(scripted_bake, "_write_episode", write_elsewhere)
    assert scripted(out).startswith(f"{out} was removed while the bake wrote to it")
    assert not out.exists()
    assert committed_episodes(moved) == [0]
    assert (scripted(moved), scripted(tmp_path / "whole")) == ("", "")
    assert digests(moved) == digests(tmp_path / "whole")


# ---- verify ----


@pytest.fixture
def copied(tmp_path) -> Path:
    """A finished bake without simulation."""
    scripted_bake.bake(tmp_path / "set", scripted_config(**SMALL))
    return tmp_path / "set"


def test_an_undisturbed_data_set_is_as_it_was_written(copied):
    assert verify(copied) == ("", EPISODES, len(digests(copied)) - FILES_OF_THE_MANIFEST, True)
    listed = subprocess.run(["sha256sum", "--check", "--quiet", *copied.glob("manifest/*.sha256")], cwd=copied, capture_output=True)
    assert listed.returncode == 0


def test_what_is_wrong_or_missing_is_named(copied):
    targets, picture = copied / "test_targets_bop19.json", copied / "test/000003/depth/000001.png"
    model, settings, manifest = copied / "models/models_info.json", copied / "config.toml", copied / "manifest.json"
    for change, said in (
        (lambda: targets.write_bytes(targets.read_bytes()[:-1]), f"{targets} has changed since it was written: its checksum differs"),
        (picture.unlink, f"{picture} is missing"),
        (lambda: model.write_bytes(model.read_bytes() + b" "), f"{model} has changed since it was written: its checksum differs"),
        (lambda: exchange(settings, "seed = 0", "seed = 1"), f"{settings} does not match the manifest: bake.seed is 1, there 0"),
    ):
        change()
        code, out, _ = run("verify", copied)
        assert (code, out.strip()) == (1, said)
    exchange(manifest, '"friction": 0.5', '"friction": 0.6')
    assert "do not match their checksum" in mistake("verify", copied)


def exchange(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def test_a_folder_is_one_bakes_at_a_time(copied, monkeypatch):
    monkeypatch.setattr(writing, "LOCK_TIMEOUT", 0.2)
    handle = writing.lock_folder(copied)
    with pytest.raises(OutputError, match="another bake writes to"):
        writing.lock_folder(copied)
    os.close(handle)
    os.close(writing.lock_folder(copied))
