"""Bakes into a store: the files of a local bake, whatever fails or dies meanwhile, and one line for what cannot be used."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from pathlib import Path

import pytest

from synpick_warp.cloud import run
from synpick_warp.cloud.ledger import FINISHED, Ledger
from synpick_warp.configs.schema import FORMATS, Split
from synpick_warp.dataset.commit.manifest import INPUTS, OBJECT, encode_manifest, make_manifest
from synpick_warp.errors import ConfigError, DatasetError, OutputError, StoreError
from synpick_warp.exporters.writing.files import LINES
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores.store import Probe, open_store
from tests.builders import mistake
from tests.cloud.conftest import files, stored
from tests.harness import scripted_bake
from tests.harness.scripted_bake import tiny

QUIET = SilentProgress()


def bake(url: str, config=None, **given):
    return run.bake_into_store(run.Job(config or tiny(), url, bake=scripted_bake.bake_episodes), QUIET, **given)


def test_the_set_equals_a_local_one_of_every_format(memory, tmp_path, monkeypatch):
    """Nothing is written but into the store and a temporary folder, which is gone."""
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    for name in ("home", "temporary", "here"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path / "here")
    config = tiny(2, FORMATS)
    assert bake(memory, config).total == 2
    assert [list(folder.iterdir()) for folder in tmp_path.iterdir()] == [[], [], []]
    scripted_bake.bake(tmp_path / "local", config)
    assert stored(memory) == files(tmp_path / "local")
    assert bake(memory, config).total == 0


def test_fewer_episodes_than_are_there_leave_nothing_to_do(memory, local):
    bake(memory)
    assert bake(memory, tiny(2)).total == 0
    assert stored(memory) == local


def test_files_that_arrive_incomplete_are_sent_again(server, prefix, local):
    draw = random.Random("truncated")
    server.fault = lambda _, path: "truncated" if draw.random() < 0.05 and "/sets/one/train" in path else None
    bake(prefix)
    server.fault = lambda method, path: None
    assert stored(prefix) == local


def test_two_plans_of_as_many_episodes_are_told_apart(memory, tmp_path):
    """Their numbers of episodes are equal; neither finishes the other."""

    def split(train: int, val: int):
        return replace(tiny(), splits=(Split("train", train, 0), Split("val", val, 5)))

    bake(memory, split(2, 1))
    assert bake(memory, split(1, 2)).total == 1
    rows = stored(memory)["episodes.jsonl"].decode().splitlines()
    assert [json.loads(row)["episode"] for row in rows] == [0, 5, 6]


def test_done_marks_are_listed_block_by_block(memory, monkeypatch):
    """A resume holds one block. Empty marks, of an interrupted write, do not count; numbers of seven digits sort apart."""
    store = open_store(memory)
    ledger = Ledger(store, tiny(1_002_000), Probe(0.0, True))
    for episode in (*range(998_990, 999_990), *range(1_000_010, 1_001_000)):
        store.put(f"manifest/{episode:06d}.json", b"{}" if episode % 10 else b"")
    listed, wanted = [], range(998_990, 1_001_010)
    monkeypatch.setattr(Ledger, "done", lambda self, block, done=Ledger.done: listed.append(block) or done(self, block))
    there = {episode for episode in wanted if episode % 10 and (episode < 999_990 or 1_000_010 <= episode < 1_001_000)}
    left = list(ledger.remaining([wanted[::2], wanted[1::2]]))
    assert [episode for each in left for episode in each] == sorted(set(wanted) - there)
    assert listed == [998, 999, 1000, 1001]
    assert [each[0] // 1000 for each in left] == listed


def test_another_set_other_settings_or_objects_are_refused(memory, monkeypatch):
    store = open_store(memory)
    for name in ("thesis.txt", "-draft.txt"):  # The second sorts before the control objects.
        store.put(name, b"ten years")
        with pytest.raises(OutputError, match=rf"not empty: it has {name}"):
            bake(memory)
        store.delete(name)
    bake(memory, shard=(0, 2))
    before = stored(memory)
    with pytest.raises(ConfigError, match=r"started with other settings: bake\.seed is 8"):
        bake(memory, tiny().with_values({"bake.seed": 8}))
    monkeypatch.setattr(scripted_bake, "INPUTS", {"objects": 64 * "2", "lights": 64 * "1"})
    with pytest.raises(ConfigError, match=r"s3://memory-.* was started with other objects"):
        bake(memory)
    assert stored(memory) == before


@pytest.mark.parametrize("known", [{}, {f"{OBJECT}5: bowl": 64 * "5", f"{OBJECT}6: cup": 64 * "6"}])
def test_a_manifest_that_another_worker_wrote_meanwhile_is_compared(memory, known):
    """Also by a store without conditional writes. A manifest with one digest of all objects is compared as far as it goes."""
    ours = make_manifest(tiny()) | {INPUTS: scripted_bake.INPUTS | {f"{OBJECT}5: bowl": 64 * "7", f"{OBJECT}6: cup": 64 * "6"}}
    store = open_store(memory)
    ledger = Ledger(store, tiny(), Probe(0.0, False))
    objects = {"objects": 64 * "1"} if known else {}
    store.put("manifest.json", encode_manifest(ours | {INPUTS: scripted_bake.INPUTS | known | objects}))
    if known:
        with pytest.raises(ConfigError, match=r"by another worker with other settings, objects or lights: objects \(5: bowl\);"):
            ledger.put_manifest(encode_manifest(ours))
    else:
        ledger.put_manifest(encode_manifest(ours))


def test_settings_that_another_worker_wrote_meanwhile_are_compared(memory):
    store = open_store(memory)
    ledger = Ledger(store, tiny(), Probe(0.0, False))
    theirs = encode_manifest(make_manifest(tiny().with_values({"bake.seed": 8})))
    store.put("manifest.json", theirs)
    with pytest.raises(ConfigError, match=r"by another worker.*bake\.seed is 0, there 8"):
        ledger.put_manifest(encode_manifest(make_manifest(tiny())))
    assert store.get("manifest.json", 1 << 30) == theirs


def test_a_damaged_or_deleted_index_file_is_named(memory, monkeypatch):
    monkeypatch.setattr(run, "AHEAD", 2)
    bake(memory)
    store, key = open_store(memory), ".store/index/000002.tar.gz"
    store.delete(FINISHED)
    for data in (store.get(key, 1 << 30)[:-20], b"none"):
        store.put(key, data)
        with pytest.raises(DatasetError, match=rf"{key} is damaged: .*; delete it and its episode's done mark"):
            bake(memory)
    store.delete(key)
    with pytest.raises(StoreError, match=rf"is missing: .*{key}.*; restore it, or delete the done mark"):
        bake(memory)


@pytest.mark.parametrize("record", [b"", b"000000-000002", b"000000-00000x", b"\xff"])
def test_a_record_that_does_not_cover_the_plan_finishes_nothing(memory, local, record):
    bake(memory)
    store = open_store(memory)
    store.put(FINISHED, record)
    store.put("manifest/joined.json", b"damaged")
    bake(memory)
    assert stored(memory) == local


def test_a_prefix_in_another_set_is_refused(prefix):
    bake(prefix, tiny(1))
    with pytest.raises(OutputError, match=r"in the data set s3://.*/sets/one"):
        bake(f"{prefix}/more")


def _unset(server, monkeypatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")


def _fail(fault: str, *methods: str):
    def prepare(server, monkeypatch) -> None:
        server.fault = lambda method, path: fault if method in methods else None

    return prepare


@pytest.mark.parametrize(
    ("prepare", "url", "said"),
    [
        (_unset, None, "there are no credentials for s3://"),
        (_fail("", ""), "s3://no-such-bucket/set", "there is no such bucket"),
        (_fail("403 AccessDenied", "PUT", "POST"), None, "the credentials may not do that"),
        (_fail("403 RequestTimeTooSkewed", "PUT"), None, "the clock of this machine differs"),
        (_fail("late clock", "HEAD"), None, "the clock of this machine differs"),
        (_fail("", ""), "s3://", "names no bucket"),
        (_fail("", ""), "nowhere://a/b", "nowhere"),
        (_fail("", ""), "file:///proc/none", "/proc/none"),
    ],
    ids=["credentials", "bucket", "read-only", "skew refused", "skew measured", "no bucket", "scheme", "folder"],
)
def test_what_cannot_be_used_is_one_line_before_anything_is_simulated(server, prefix, monkeypatch, prepare, url, said):
    prepare(server, monkeypatch)
    message = mistake("bake", "--config", "smoke", "--out", url or prefix, "--device", "cpu")
    assert said in message
    server.fault = lambda method, path: None
    if prepare is not _unset:
        assert stored(prefix) == {}


def test_the_local_file_is_checked_before_it_is_sent(memory, monkeypatch):
    honest = Path.read_bytes
    monkeypatch.setattr(Path, "read_bytes", lambda path: honest(path) + b"x" * (path.suffix == ".tar"))
    with pytest.raises((OutputError, StoreError), match="has changed since it was written"):
        bake(memory)
    assert not any(key.startswith("manifest/0") for key in stored(memory))


def test_a_folder_of_index_lines_is_never_taken_for_a_local_bake(tmp_path):
    (tmp_path / LINES).mkdir()
    with pytest.raises(OutputError, match="is where the lines of indices are joined; move it away"):
        scripted_bake.bake(tmp_path, tiny(1))
