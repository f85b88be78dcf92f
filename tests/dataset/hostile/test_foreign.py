"""What does not belong into a data set: planted names and rights, pipes and sockets, what file managers leave, counts without data."""

import contextlib
import dataclasses
import errno
import hashlib
import json
import os
import re
import shutil
import signal
import socket
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.commit.manifest import CONSTANTS, episode_entry
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import DatasetError, OutputError, SynpickError
from synpick_warp.exporters.lerobot.exporter import LerobotExporter
from synpick_warp.exporters.writing import files
from tests.builders import once, run
from tests.harness.scripted_bake import bake, settings, snapshot

HANG = 120
"""Longest time of a command [s]; some 0.1 s are usual."""
HIDDEN = (".git/hooks/post-checkout", ".bashrc", ".envrc", "train_pbr/000000/.git/config", "models/.envrc")
FOREIGN = ("Makefile", "models/Makefile", "usd/assets/run.sh", "README.md")
FOREIGN += ("train_pbr/000099/rgb/000000.jpg", "train_pbr/000000/rgb/run.sh")


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A finished data set of all formats, of two episodes."""
    return once(tmp_path_factory, "whole", lambda out: bake(out, settings()))[0]


@pytest.fixture(scope="module")
def narrow(tmp_path_factory) -> Path:
    """A finished data set that can be converted to most formats."""
    plain = settings(formats=("bop", "zarr"))
    config = dataclasses.replace(plain, bop=dataclasses.replace(plain.bop, keypoints=0))
    return once(tmp_path_factory, "narrow", lambda out: bake(out, config))[0]


@pytest.fixture(autouse=True)
def guarded() -> Iterator[None]:
    """What hangs is ended."""

    def end(*_: object) -> None:
        raise TimeoutError("it hangs")

    before = signal.signal(signal.SIGALRM, end)
    signal.alarm(HANG)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def copied(source: Path, folder: Path) -> Path:
    """A copy of hard links: files are replaced, never written to."""
    return Path(shutil.copytree(source, folder, copy_function=os.link))


def replace(path: Path, data: bytes) -> None:
    path.unlink(missing_ok=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


def add_line(data_set: Path, entry: Path, name: str) -> None:
    """Add a name to a checksum list, with the fitting checksum in its entry."""
    lines = (data_set / f"{entry}.sha256").read_bytes() + f"{hashlib.sha256(b'evil').hexdigest()}  {name}\n".encode()
    content = json.loads((data_set / f"{entry}.json").read_bytes())
    content |= {"checksum": hashlib.sha256(lines).hexdigest(), "files": content["files"] + 1, "bytes": content["bytes"] + 4}
    replace(data_set / f"{entry}.sha256", lines)
    replace(data_set / f"{entry}.json", json.dumps(content).encode())


def told(*arguments: object) -> tuple[int, str]:
    """Exit code and error of a command: 0 or 1, or 2 and one line."""
    code, _, err = run(*arguments)
    assert (code == 2) == (len(err.splitlines()) == 1), err
    return code, err


# ---- names and rights of files that are copied by a list ----


@pytest.mark.parametrize(("name", "entry"), [*((name, CONSTANTS) for name in HIDDEN + FOREIGN), (HIDDEN[3], episode_entry(1))])
def test_a_list_plants_no_file(narrow, tmp_path, entry, name):
    folder, out = copied(narrow, tmp_path / "set"), tmp_path / "out"
    (out / ".git" / "hooks").mkdir(parents=True)
    replace(folder / name, b"evil")
    (folder / name).chmod(0o755)
    add_line(folder, entry, name)
    before = snapshot(tmp_path)
    with pytest.raises(DatasetError, match=f'{entry}.sha256 names "{name}", which none of its formats writes; remove manifest/'):
        merge([folder], out)
    code, error = told("convert", folder, "--to", "shards", "--threads", 1, "--out", out)
    assert (code, "none of its formats writes" in error) == ((2, True) if entry == CONSTANTS else (0, False))
    assert not (out / name).exists() or (out / name).read_bytes() != b"evil"  # Shards have a README.md of their own.
    shutil.rmtree(out)
    (out / ".git" / "hooks").mkdir(parents=True)
    assert snapshot(tmp_path) == before
    assert "none of its formats writes" in verify(folder).problem


def test_merged_files_cannot_be_executed(narrow, tmp_path):
    folder = tmp_path / "set"
    shutil.copytree(narrow, folder)
    for path in folder.rglob("*"):
        if path.is_file():
            path.chmod(0o6755)
    merge([folder], tmp_path / "merged")
    assert verify(tmp_path / "merged").finished
    assert {path.stat().st_mode & 0o7111 for path in (tmp_path / "merged").rglob("*") if path.is_file()} == {0}


@pytest.mark.parametrize("call", ["link", "mkdir"])
def test_a_merge_that_is_interrupted_after_its_first_file_leaves_nothing(narrow, tmp_path, monkeypatch, call):
    made = getattr(os, call)

    def make(*arguments: object, **options: object) -> None:
        made(*arguments, **options)
        raise KeyboardInterrupt

    monkeypatch.setattr(os, call, make)
    (tmp_path / "merged" / ".git").mkdir(parents=True) if call == "link" else None
    with pytest.raises(KeyboardInterrupt):
        merge([narrow], tmp_path / "merged")
    assert [path.name for path in tmp_path.glob("merged/*")] in ([], [".git"])


# ---- pipes, sockets and devices ----


def make_socket(path: Path) -> None:
    with contextlib.chdir(path.parent), socket.socket(socket.AF_UNIX) as made:  # Names of sockets are short.
        made.bind(path.name)


KINDS: dict[str, Callable[[Path], None]] = {"pipe": os.mkfifo, "socket": make_socket, "folder": Path.mkdir}
KINDS["device"] = lambda path: path.symlink_to("/dev/zero")
PLACES = ("manifest", "manifest.json", "manifest/000000.json", "manifest/000000.sha256", "manifest/.000001.json.new", "episodes.jsonl")
PLACES += ("models/models_info.json", "train_pbr/000000", "train_pbr/000000/scene_gt.json", "train_pbr_web/shard-000000.tar")
PLACES += ("trajectory.zarr/episodes/000000/ticks/time/c.0", "usd/000000.usdc", "lerobot/videos/observation.images.camera_0/chunk-000")
"""Names that are opened, written or removed."""
CASES = [(place, "pipe") for place in PLACES]
CASES += [("config.toml", kind) for kind in KINDS] + [(".partial", "folder"), ("coco/parts/000000.jsonl", "device")]


@pytest.mark.parametrize(("place", "kind"), CASES)
def test_what_is_no_file_is_neither_waited_for_nor_read(whole, tmp_path, place, kind):
    """A bake goes on, or says what is wrong in one line; so does every command."""
    folder = copied(whole, tmp_path / "set")
    (folder / "manifest" / "000001.json").unlink()
    path = folder / place
    shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    path.parent.mkdir(exist_ok=True)
    KINDS[kind](path)
    for name, *options in (("verify",), ("stats",), ("merge", "--out", tmp_path / "merged")):
        told(name, folder, *options)
    with contextlib.suppress(SynpickError):
        bake(folder, settings())
        assert verify(folder).finished


@pytest.mark.parametrize("kind", KINDS)
def test_a_staging_folder_that_is_none_is_named(narrow, tmp_path, kind):
    (tmp_path / "empty").mkdir()
    for out in (copied(narrow, tmp_path / "set"), tmp_path / "empty"):
        if kind != "folder" or out.name == "empty":
            (out / "manifest" / "joined.json").unlink(missing_ok=True)
            KINDS[kind](out / ".partial")
            with pytest.raises(OutputError, match=r"\.partial"):
                bake(out, settings(formats=("bop", "zarr")))
            assert os.path.lexists(out / ".partial")


# ---- what file managers and editors leave ----

LITTER = (".DS_Store", "._{}", ".{}.swp", "{}~", "Thumbs.db", "desktop.ini", "{stem} (copy){suffix}", "Copy of {}", "000099{suffix}")


def strew(folder: Path) -> None:
    """Leave litter beside each file, with its content, and beside each folder; and files of an episode that nobody committed."""
    for path in sorted(folder.rglob("*"), reverse=True):
        for pattern in LITTER:
            other = path.with_name(pattern.format(path.name, stem=path.stem, suffix=path.suffix))
            is_entry = path.parent.name == "manifest" and pattern == LITTER[-1]
            if not other.exists() and ".zarr" not in str(path.parent) and not is_entry:
                os.link(path, other) if path.is_file() else other.mkdir()


def test_litter_is_no_data(whole, tmp_path):
    """Merged and resumed sets are as without."""
    folder, clean = copied(whole, tmp_path / "set"), snapshot(whole)
    strew(folder)
    [said] = merge([folder], tmp_path / "merged").left_out
    assert re.fullmatch(rf"left out: {folder}/lerobot/parts/\S+ and \d+ more, of no committed episode", said)
    assert snapshot(tmp_path / "merged") == clean
    for name in ("000001.json", "joined.json"):
        (folder / "manifest" / name).unlink()
    bake(folder, settings())
    assert verify(folder).finished
    known = snapshot(folder)
    assert {name: known[name] for name in clean} == clean


@pytest.mark.parametrize("place", ["coco/parts/000099.jsonl", "coco/parts/000000 (copy).jsonl", "lerobot/parts/000099.json"])
def test_a_part_of_no_committed_episode_is_told(whole, tmp_path, place):
    folder = copied(whole, tmp_path / "set")
    line = f"left out: {folder}/{place}, of no committed episode"
    for there in (False, True):
        code, out, _ = run("merge", folder, "--out", tmp_path / f"merged-{there}")
        assert (code, line in out.splitlines()) == (0, there)
        (folder / place).write_text("[]\n")


READERS: tuple[tuple[object, ...], ...] = (
    ("verify",),
    ("stats",),
    ("validate",),
    ("preview", "--views", 2, "--out", "sheet.png"),
    ("explain", "--episode", 0, "--out", "explained.png"),
    ("merge", "--out", "merged"),
    ("convert", "--to", "shards", "--threads", 1, "--out", "converted"),
)
"""Every command that reads a data set."""


def test_commands_pass_litter_over(narrow, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    strew(folder := copied(narrow, tmp_path / "set"))
    for name, *options in READERS:
        code, error = told(name, folder, *options)
        assert code == 0 or name == "validate", error


def test_litter_in_an_output_folder_is_no_data(tmp_path):
    for name in (".DS_Store", "Thumbs.db", "desktop.ini"):
        (tmp_path / name).write_text("x")
    bake(tmp_path, settings(1, ("coco",)))
    assert verify(tmp_path).finished


# ---- counts ----


def edit(path: Path, change: Callable[[dict], object]) -> None:
    content = json.loads(path.read_bytes())
    change(content)
    replace(path, json.dumps(content).encode())


FORMATS = ("bop", "shards", "zarr", "usd", "lerobot", "coco")


@pytest.mark.parametrize(("formats", "frames"), [*(((name,), 2**31 - 1) for name in FORMATS), (("bop",), 7), (("zarr",), 7)])
def test_frames_are_counted_not_believed(tmp_path, formats, frames):
    folder = tmp_path / "set"
    bake(folder, settings(1, formats))
    edit(folder / "manifest" / "000000.json", lambda content: content["row"].update(frames=frames))
    if frames > 7 or formats in (("bop",), ("coco",)):
        assert "counts" in verify(folder).problem
    for name, *options in (("stats",), ("report", "--out", tmp_path / "r.html"), ("convert", "--to", "lerobot", "--out", tmp_path / "new")):
        code, error = told(name, folder, *options)
        assert code == 2 or frames == 7, error
    assert not (tmp_path / "new").exists()


def test_episodes_in_the_settings_are_not_believed(narrow, tmp_path):
    folder = copied(narrow, tmp_path / "set")
    text = (folder / "config.toml").read_text()
    replace(folder / "config.toml", text.replace("episodes = 2", f"episodes = {2**31 - 1}").encode())
    shared = LerobotExporter.shared_files(dataclasses.replace(DataLayout.of(settings()), episodes=2**31 - 1))
    assert len(shared.folders) < 20
    assert told("convert", folder, "--to", "lerobot", "--threads", 1, "--out", tmp_path / "new") == (0, "")
    assert told("stats", folder)[0] == 0


def test_an_attempt_has_as_many_votes_as_pairs_of_objects(whole, tmp_path):
    folder = copied(whole, tmp_path / "set")
    votes = [[index % 250, 250, 0.5] for index in range(100_000)]
    edit(folder / "manifest" / "000000.json", lambda content: content["attempts"][0]["observation"].update(votes=votes))
    assert "length <= 62750" in verify(folder).problem
    assert told("merge", folder, "--out", tmp_path / "merged")[0] == 2


def test_a_file_with_a_hole_of_terabytes_is_not_read(narrow, tmp_path):
    folder = copied(narrow, tmp_path / "set")
    replace(folder / "models" / "models_info.json", b"{}")
    os.truncate(folder / "models" / "models_info.json", 2**42)
    assert "models_info.json cannot be read: it is larger than all files of its entry" in verify(folder).problem


def test_a_full_disk_leaves_no_probe(tmp_path, monkeypatch):
    def no_space(**_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files.tempfile, "TemporaryFile", no_space)
    with pytest.raises(OutputError, match="No space left on device"):
        files.check_output_folder(tmp_path)
    assert list(tmp_path.iterdir()) == []
