"""Sets in a store read where they lie: the same as on disk, a bounded cache, damage that is named, streams for webdataset."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import pickle
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.cli.main import main
from synpick_warp.cloud import reading
from synpick_warp.dataset.pytorch import Views
from synpick_warp.errors import DatasetError, StoreError, SynpickError
from synpick_warp.system.stores.store import open_store
from tests.builders import mistake, run
from tests.cloud.conftest import files

FORK = multiprocessing.get_context("fork")


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Temporary and current folder of the test."""
    for name in ("temporary", "here"):
        (tmp_path / name).mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path


@pytest.fixture
def sets(memory: str, picked_set: Path) -> tuple[str, Path]:
    """The same set in a store and on disk."""
    store = open_store(f"{memory}/set")
    for name, data in files(picked_set).items():
        store.put(name, data)
    return store.url, picked_set


def test_views_are_those_on_disk_and_the_cache_is_bounded(sets, place):
    url, folder = sets
    local, stored = synpick_warp.open(folder), reading.open_store_set(url, limit=1)
    assert list(stored) == list(local)
    assert list(stored.splits) == list(local.splits)
    for index, episode in local.items():
        there = stored[index]
        assert there.row == episode.row
        for frame in (0, len(episode) - 1):
            np.testing.assert_array_equal(there.view(frame, 1).rgb, episode.view(frame, 1).rgb)
            np.testing.assert_array_equal(there.view(frame, 1).depth, episode.view(frame, 1).depth)
        assert len(list((stored.folder / "manifest").glob("0*.json"))) == 1
    with pytest.raises(KeyError):
        stored[99]
    assert synpick_warp.open(url).planned == local.planned


def test_a_training_set_knows_its_length_without_its_episodes(sets, place, monkeypatch):
    url, folder = sets
    fetched = []
    monkeypatch.setattr(
        reading.StoreCache, "fetch", lambda self, index, real=reading.StoreCache.fetch: fetched.append(index) or real(self, index)
    )
    views, local = Views(synpick_warp.open(url)), Views(folder)
    assert len(views) == len(local)
    assert set(fetched) <= {views.episodes[0]}  # Whose cameras count for all.
    np.testing.assert_array_equal(views[-1]["rgb"], local[-1]["rgb"])
    assert set(fetched) <= {views.episodes[0], views.episodes[-1]}
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(views))[0]["rgb"], local[0]["rgb"])


def test_forked_workers_are_told_and_open_the_set_again_by_its_url(sets, place):
    opened, told = synpick_warp.open(sets[0]), FORK.SimpleQueue()

    def work():
        with pytest.raises(StoreError, match="start workers by spawn or forkserver"):
            opened[1]
        told.put("told")

    worker = FORK.Process(target=work, daemon=True)
    worker.start()
    worker.join(30)
    worker.kill()
    assert worker.exitcode == 0
    assert told.get() == "told"
    assert list(opened.folder.glob("manifest.json"))
    assert list(pickle.loads(pickle.dumps(opened))) == list(opened)


@pytest.mark.parametrize(
    "command",
    [("verify",), ("stats", "--json", "--threads", "1"), ("validate", "--fast", "--threads", "1", "--json")],
    ids=lambda each: each[0],
)
def test_commands_say_what_they_say_of_a_folder(sets, place, command):
    url, folder = sets
    name, *options = command
    here, there = run(name, folder, *options), run(name, url, *options)
    assert (there.code, there.out) == (here.code, here.out)
    assert list((place / "temporary").iterdir()) == list((place / "here").iterdir()) == []


def test_outputs_of_commands_are_in_the_current_folder(sets, place):
    url, folder = sets
    assert run("convert", url, "--to", "coco", "--threads", "1").code == 0
    assert run("convert", folder, "--to", "coco", "--threads", "1", "--out", place / "local").code == 0
    assert files(place / "here" / "set-coco") == files(place / "local")
    (place / "a.csv").write_text("scene_id,im_id,obj_id,score,R,t,time\n0,0,1,1.0,1 0 0 0 1 0 0 0 1,0 0 2000,0.1\n")
    assert f"# BOP scores by the BOP toolkit need a copy of {url}" in run("eval", url, "--results", place / "a.csv").out
    assert list((place / "temporary").iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("convert", "SET", "--to", "coco", "--out", "S3://b/x"), "--out is s3://b/x; only bake writes into object stores"),
        (("preview", "SET", "--out", "s3://b/x.png"), "--out is s3://b/x.png; only bake writes into object stores"),
        (("merge", "SET", "--out", "s3://b/x"), "--out is s3://b/x; only bake writes into object stores"),
        (("merge", "s3://b/one", "--out", "x"), "s3://b/one is in an object store, where all of --shard fill one prefix"),
        (("new-cell", "s3://b/x"), "DIR is s3://b/x; only bake writes into object stores"),
    ],
    ids=lambda each: each[0] if isinstance(each, tuple) else "",
)
def test_outputs_are_in_no_store_and_no_folder_is_named_like_one(picked_set, place, arguments, said):
    ran = run(*(picked_set if each == "SET" else each for each in arguments))
    assert (ran.code, ran.out) == (2, "")
    assert said in ran.err
    assert list((place / "here").iterdir()) == []


@pytest.mark.parametrize("command", ["stats", "verify"])
def test_a_command_that_is_to_end_deletes_its_copy(sets, place, monkeypatch, command):
    monkeypatch.setattr(reading.Copier, "fetch_records", lambda self: signal.raise_signal(signal.SIGTERM))
    with pytest.raises(SystemExit, match="143"):
        main([command, sets[0]])
    assert list((place / "temporary").iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_bucket_that_is_not_there_is_told(prefix, place):
    assert "no-bucket/a/manifest.json: there is no such bucket" in mistake("stats", "s3://no-bucket/a")


def test_damage_is_named_by_its_address(sets, place, monkeypatch):
    url, folder = sets
    store = open_store(url)
    name = next(name for name, _ in store.list("") if name.endswith(".tar"))
    data = store.get(name, 1 << 30)
    store.put(name, data[:-1] + b"x")
    ran = run("verify", url)
    assert (ran.code, ran.out) == (1, f"{url}/{name} has changed since it was written: its checksum differs\n")
    store.put(name, bytes(1 << 26))
    ran = run("verify", url)
    assert (ran.code, ran.out.startswith(f"{url}/{name} is larger than")) == (1, True)
    store.put(name, data[:-1] + b"x")
    with pytest.raises(DatasetError, match="checksum differs"):
        synpick_warp.open(url)[0]
    store.delete(name)
    assert f"{url}/{name} is missing" in run("verify", url).out
    with pytest.raises(DatasetError, match="is missing"):
        synpick_warp.open(url)[0]
    store.put(name, data)
    last = list(synpick_warp.open(folder))[-1]
    for end in ("json", "sha256"):
        store.delete(f"manifest/{last:06d}.{end}")
    ran = run("verify", url)
    assert (ran.code, ran.out) == (1, f"{url}/manifest/{last:06d}.json is missing\n")
    monkeypatch.setattr(reading, "FREE_PART", 0.0)
    assert "may be copied" in mistake("stats", url)
    assert "has no manifest.json" in mistake("stats", f"{url}/none")
    assert list((place / "temporary").iterdir()) == []


@pytest.mark.parametrize("data", [b"[", b'{"episode": 1}', b'{"episode": -1, "frames": 2}', b"[" * 100_000, b"\xff", b"[]"])
def test_a_damaged_list_of_episodes_is_named(sets, place, data):
    open_store(sets[0]).put("episodes.jsonl", data)
    lines = hashlib.sha256(data).hexdigest() + "  episodes.jsonl\n"
    entry = {"files": 1, "bytes": len(data), "checksum": hashlib.sha256(lines.encode()).hexdigest(), "episodes": []}
    for end, content in (("sha256", lines), ("json", json.dumps(entry))):
        open_store(sets[0]).put(f"manifest/joined.{end}", content.encode())
    with pytest.raises(DatasetError, match=r"s3://memory-.*/episodes.jsonl, line 1, is damaged"):
        list(synpick_warp.open(sets[0]))


@pytest.mark.parametrize("data", [None, b"", b"seed = 1", b"[bake]\nseed = 12345"])
def test_settings_that_are_not_those_of_the_manifest_are_named(sets, place, data):
    store = open_store(sets[0])
    store.delete("config.toml") if data is None else store.put("config.toml", data)
    with pytest.raises(SynpickError, match=r"s3://memory-.*/config.toml"):
        synpick_warp.open(sets[0])


@pytest.mark.parametrize("name", ["manifest.json", "config.toml", "manifest/000000.json", "manifest/constants.sha256"])
def test_a_record_beyond_its_limit_is_not_copied(sets, place, monkeypatch, name):
    for limit in ("MAX_JSON", "MAX_TOML"):
        monkeypatch.setattr(reading, limit, 1 << 19)
    monkeypatch.setattr(reading.Copier.fetch, "__defaults__", (None, 1 << 19))
    open_store(sets[0]).put(name, bytes((1 << 19) + 1))
    for command in ("stats", "verify") if name == "manifest.json" else ("stats",):
        assert f"{name} is larger than 512 KiB" in mistake(command, sets[0])
    assert list((place / "temporary").iterdir()) == []


def test_a_url_whose_last_part_leads_out_of_the_temporary_folder_is_refused(memory, place):
    assert "has a part . or .." in mistake("stats", f"{memory}/..")
    with pytest.raises(StoreError, match=r"has a part \. or \.\."):
        synpick_warp.open(f"{memory}/..")
    assert list((place / "temporary").iterdir()) == []


@pytest.mark.filterwarnings("ignore::ResourceWarning")
def test_webdataset_streams_shards(prefix, picked_set, place):
    webdataset = pytest.importorskip("webdataset")
    url, folder = prefix, picked_set
    for path in folder.glob("*_web/*.tar"):
        open_store(url).put(str(path.relative_to(folder)), path.read_bytes())
    reading.stream_shards()
    shards = reading.list_shards(url)
    assert [each.removeprefix(f"{url}/") for each in shards] == sorted(str(path.relative_to(folder)) for path in folder.glob("*_web/*.tar"))
    keys = {sample["__key__"] for sample in webdataset.WebDataset(shards, shardshuffle=False).decode(synpick_warp.webdataset.decode_view)}
    local = {sample["__key__"] for sample in webdataset.WebDataset([str(path) for path in folder.glob("*_web/*.tar")], shardshuffle=False)}
    assert keys == local
    assert list((place / "temporary").iterdir()) == []
