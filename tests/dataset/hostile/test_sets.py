"""Hostile data sets: edited, damaged or made by somebody else; resume, verify and merge neither read, write nor remove outside of them."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from synpick_warp.configs.dataset.splits import DataLayout
from synpick_warp.dataset.commit.manifest import episode_entry, read_checksums
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import DatasetError, OutputError, SynpickError
from synpick_warp.exporters.registry import load_exporter_classes, shared_files
from synpick_warp.exporters.writing.checksums import checksum, parse_checksums
from synpick_warp.exporters.writing.files import check_output_folder
from tests.harness.scripted_bake import bake, make_victim, small_settings, snapshot

pytestmark = pytest.mark.usefixtures("inline")
CONFIG = small_settings()
SECONDS = 5.0
"""Longest time of a command on a hostile data set."""


@pytest.fixture(scope="module")
def parts(tmp_path_factory) -> list[Path]:
    folder = tmp_path_factory.mktemp("parts")
    for part in range(2):
        bake(folder / str(part), CONFIG, (part, 2))
    return [folder / "0", folder / "1"]


@pytest.fixture
def copied(ready, tmp_path) -> Path:
    """A copy of the finished data set, with a sibling that nothing may touch."""
    make_victim(tmp_path)
    return Path(shutil.copytree(ready, tmp_path / "set"))


def relist(data_set: Path, entry: str, lines: str) -> None:
    """Replace a checksum list, with the fitting checksum in its entry."""
    path = data_set / "manifest" / f"{entry}.json"
    content = json.loads(path.read_bytes()) | {"checksum": hashlib.sha256(lines.encode()).hexdigest()}
    path.with_suffix(".sha256").write_text(lines)
    path.write_text(json.dumps(content) + "\n")


def refused(command: Callable[[], object], said: str = "") -> None:
    """The command ends at once with an error of one line."""
    started = time.monotonic()
    with pytest.raises(SynpickError, match=said) as caught:
        command()
    assert time.monotonic() - started < SECONDS
    assert str(caught.value).isprintable()


# ---- removal ----


def test_an_edited_list_of_indices_removes_nothing_outside_of_the_set(copied, ready):
    before = snapshot(copied.parent / "victim")
    for suffix in (".json", ".sha256"):
        (copied / "manifest" / f"000001{suffix}").unlink()
    relist(copied, "joined", f"{64 * '0'}  ../victim\n")
    bake(copied, CONFIG)
    assert snapshot(copied.parent / "victim") == before
    assert snapshot(copied) == snapshot(ready)


@pytest.mark.parametrize("name", ["notes.txt", "../victim/thesis.txt", "config.toml", "train/000000", "/etc/hostname"])
def test_an_edited_list_of_constants_removes_nothing_that_the_program_did_not_write(tmp_path, name):
    victim = make_victim(tmp_path)
    out = tmp_path / "set"
    bake(out, CONFIG, stop_after=1)
    (out / "notes.txt").write_text("mine")
    for suffix in (".json", ".sha256"):
        (out / "manifest" / f"000000{suffix}").unlink()
    relist(out, "constants", f"{64 * '0'}  {name}\n")
    before = snapshot(victim)
    bake(out, CONFIG, stop_after=0)
    assert (out / "notes.txt").read_text() == "mine"
    assert snapshot(victim) == before


@pytest.mark.parametrize("name", ["train", "manifest", "train_web", "models", ".partial", "train/000000"])
def test_a_link_where_a_bake_writes_is_refused(copied, name):
    victim = copied.parent / "victim"
    (copied / "manifest" / "000001.json").unlink()
    shutil.rmtree(copied / name, ignore_errors=True)
    (copied / name).symlink_to(victim)
    before = snapshot(victim)
    refused(lambda: bake(copied, CONFIG), "link")
    assert snapshot(victim) == before


def test_a_link_in_place_of_a_new_file_is_not_followed(copied):
    (copied / "manifest" / "joined.json").unlink()
    for name in (".config.toml.new", "manifest/.joined.json.new"):
        (copied / name).symlink_to(copied.parent / "victim" / "thesis.txt")
    bake(copied, CONFIG)
    assert (copied.parent / "victim" / "thesis.txt").read_text() == "ten years"


def test_hidden_files_in_the_output_folder_are_never_touched(tmp_path):
    (tmp_path / ".git" / "empty").mkdir(parents=True)
    (tmp_path / ".git" / "HEAD").write_text("ref")
    before = snapshot(tmp_path)
    bake(tmp_path, CONFIG, stop_after=0)
    assert snapshot(tmp_path) == before


def test_a_staging_folder_without_a_manifest_is_refused(tmp_path):
    (tmp_path / ".partial").mkdir()
    (tmp_path / ".partial" / "mine").write_text("mine")
    refused(lambda: bake(tmp_path, CONFIG), r"is not empty: it has a folder \.partial of another program")
    assert (tmp_path / ".partial" / "mine").read_text() == "mine"
    with pytest.raises(OutputError, match="not empty"):
        check_output_folder(tmp_path)


def test_files_and_empty_folders_of_the_user_in_a_data_set_stay(tmp_path):
    out = tmp_path / "set"
    bake(out, CONFIG, stop_after=1)
    (out / "mine" / "empty").mkdir(parents=True)
    (out / "train" / "notes").mkdir()
    for suffix in (".json", ".sha256"):
        (out / "manifest" / f"000000{suffix}").unlink()
    bake(out, CONFIG, stop_after=0)
    assert (out / "mine" / "empty").is_dir()
    assert (out / "train" / "notes").is_dir()
    bake(out, CONFIG)
    assert verify(out).finished
    assert (out / "mine" / "empty").is_dir()


def test_a_bake_without_an_episode_removes_all_that_it_wrote(tmp_path):
    bake(tmp_path / "new" / "set", CONFIG, stop_after=0)
    assert not (tmp_path / "new").exists()


def test_the_names_that_formats_declare_are_those_that_they_write(ready):
    shared = shared_files(load_exporter_classes(CONFIG.bake.formats), DataLayout.of(CONFIG))
    for name in (*shared.constants, *shared.indices, *shared.folders):
        assert (ready / name).exists()
    listed = set(read_checksums(ready, Path("manifest/joined")))
    assert listed == {*map(str, shared.indices), "episodes.jsonl", "attempts.jsonl"}
    roots = [str(name) for name in shared.constants]
    assert all(
        any(name == root or name.startswith(f"{root}/") for root in roots) for name in read_checksums(ready, Path("manifest/constants"))
    )


# ---- records ----


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("row", 3, r"expected object, got int - at \$\.row; remove manifest/000001\.json and manifest/000001\.sha256, and resume"),
        ("ending", "exploded", 'the ending is "exploded", allowed: finished, '),
        ("frames", float("nan"), "is damaged"),
        ("frames", 10**30, r"at \$\.row\.frames"),
        ("episode", 7, "is of another episode"),
        ("attempts", None, "attempts"),
    ],
)
def test_an_edited_record_is_one_line_with_advice(copied, key, value, said):
    path = copied / f"{episode_entry(1)}.json"
    content = json.loads(path.read_bytes())
    (content if key == "row" else content["row"])[key] = value
    path.write_text(json.dumps(content))
    refused(lambda: bake(copied, CONFIG), said)
    refused(lambda: merge([copied], copied.parent / "merged"), said)
    assert not (copied.parent / "merged").exists()
    assert "damaged" in verify(copied).problem


def test_the_advice_about_a_truncated_record_works(copied, ready):
    path = copied / f"{episode_entry(1)}.json"
    path.write_bytes(path.read_bytes()[:40])
    refused(lambda: bake(copied, CONFIG), r"remove manifest/000001\.json and manifest/000001\.sha256, and resume the bake")
    path.unlink()
    path.with_suffix(".sha256").unlink()
    bake(copied, CONFIG)
    assert snapshot(copied) == snapshot(ready)


@pytest.mark.parametrize("seed", [1, "x", None, 0.5, True])
def test_a_changed_seed_in_the_manifest_is_refused(copied, seed):
    path = copied / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_bytes()) | {"seed": seed}, indent=2) + "\n")
    for command in (lambda: verify(copied), lambda: bake(copied, CONFIG), lambda: merge([copied], copied.parent / "merged")):
        refused(command, "seed")


def test_a_planned_number_of_episodes_that_is_absurd_does_not_hang(copied, ready):
    path = copied / "config.toml"
    path.write_text(path.read_text().replace("episodes = 2", "episodes = 1000000000000"))
    refused(lambda: merge([copied], copied.parent / "merged"), "episodes")
    (copied / "manifest" / "000001.json").unlink()
    bake(copied, CONFIG)
    assert snapshot(copied) == snapshot(ready)


# ---- checksum lists ----


@pytest.mark.parametrize("line", ["x", f"{64 * '0'} *train", f"{64 * 'g'}  a", f"{63 * '0'}  a", f"{64 * '0'}  ", f"{64 * '0'}  a\n", "\n"])
def test_lines_that_are_no_digest_and_name(tmp_path, line):
    with pytest.raises(DatasetError, match=r"LIST, line \d, is damaged: it is not a SHA-256 and a name; ADVICE"):
        parse_checksums(f"{64 * '1'}  b\n{line}\n".encode(), tmp_path, Path("LIST"), "ADVICE")


@pytest.mark.parametrize(
    "name",
    [
        "../x",
        "/x",
        "a/../../x",
        "out/x",
        "a/..",
        ".",
        "a//b",
        "a/./b",
        "b",
        "manifest.json",
        "manifest/000000.json",
        ".partial/x",
        "a\x1bb",
    ],
)
def test_names_that_no_list_has(tmp_path, name):
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "out").symlink_to(tmp_path)
    with pytest.raises(DatasetError, match="LIST, line 2,"):
        parse_checksums(f"{64 * '1'}  b\n{64 * '0'}  {name}\n".encode(), tmp_path / "in", Path("LIST"), "ADVICE")


def test_files_that_are_links_have_no_checksum(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to("file")
    assert checksum(tmp_path / "file") == hashlib.sha256(b"x").hexdigest()
    with pytest.raises(OSError, match="it is a symbolic link"):
        checksum(tmp_path / "link")
    with pytest.raises(OSError, match="it is not a regular file"):
        checksum(tmp_path)


# ---- merge ----


def test_links_in_a_part_are_refused(parts, tmp_path):
    part = Path(shutil.copytree(parts[0], tmp_path / "part"))
    picture = next((part / "train").rglob("*.jpg"), None) or next((part / "train").rglob("*.png"))
    content = picture.read_bytes()
    (tmp_path / "outside").write_bytes(content)
    picture.unlink()
    picture.symlink_to(tmp_path / "outside")
    refused(lambda: merge([part, parts[1]], tmp_path / "merged"), "symbolic link")
    assert not (tmp_path / "merged").exists()
    assert "symbolic link" in verify(part).problem


def test_two_lists_that_name_the_same_file_are_refused_and_no_part_is_written_to(parts, tmp_path):
    """The second would be copied over the hard link of the first."""
    copies = [Path(shutil.copytree(part, tmp_path / part.name)) for part in parts]
    relist(copies[1], "000001", (copies[0] / "manifest" / "000000.sha256").read_text())
    before = [snapshot(part) for part in copies]
    refused(lambda: merge(copies, tmp_path / "merged"), "which none of its formats writes")
    assert [snapshot(part) for part in copies] == before


def test_the_same_part_twice_is_one_line_at_once(parts, tmp_path):
    (tmp_path / "link").symlink_to(parts[0])
    for again in (parts[0], parts[0] / ".." / "0", tmp_path / "link"):
        refused(lambda again=again: merge([parts[0], again], tmp_path / "merged"), "are the same folder")
    for out in (parts[0], parts[0] / "merged", tmp_path / "link" / "merged", parts[0].parent):
        refused(lambda out=out: merge(parts, out), "which is, holds or lies in the part")
    assert not (tmp_path / "merged").exists()
    refused(lambda: merge([tmp_path / "none"], tmp_path / "merged"), r"has no manifest\.json")


def test_a_full_disk_names_the_file_that_could_not_be_written(parts, tmp_path, monkeypatch):
    def no_links(*_: object, **__: object) -> None:
        raise OSError(errno.EXDEV, "Invalid cross-device link")

    def no_space(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    (tmp_path / "out").mkdir()
    (tmp_path / "out" / ".git").mkdir()
    monkeypatch.setattr(os, "link", no_links)
    with monkeypatch.context() as patch:
        patch.setattr(os, "fchmod", no_space)
        refused(lambda: merge(parts, tmp_path / "out"), f"cannot write {tmp_path / 'out'}/.*: No space left on device")
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".git"]
    merged = merge(parts, tmp_path / "out")
    assert (merged.episodes, merged.missing) == (2, [])
    assert verify(tmp_path / "out").finished


def test_merged_parts_are_what_one_bake_writes(parts, ready, tmp_path):
    merge(parts, tmp_path / "merged")
    assert snapshot(tmp_path / "merged") == snapshot(ready)


# ---- lists over scenes ----


def test_foreign_names_among_scenes_and_shards_are_no_scenes(copied, ready):
    (copied / "manifest" / "joined.json").unlink()
    for folder, name in (("train", "notes"), ("train_web", "shard-x.tar")):
        (copied / folder / name).mkdir()
    bake(copied, CONFIG)
    for name in ("test_targets_bop19.json", "train_web/key_to_shard.json"):
        assert (copied / name).read_bytes() == (ready / name).read_bytes()
