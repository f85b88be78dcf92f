"""Stores by their contract: objects, order, conditions; requests that fail for a while, and for good."""

from __future__ import annotations

import itertools
import threading
from http.server import ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace
from uuid import uuid4

import pytest

from synpick_warp.cloud import run
from synpick_warp.errors import StoreError
from synpick_warp.system.inputs.urls import as_url
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores import base, object_store
from synpick_warp.system.stores.file_system import FileSystemStore
from synpick_warp.system.stores.opening import Probe, open_store, probe
from tests.builders import mistake
from tests.cloud.conftest import tiny
from tests.cloud.mortal import stored
from tests.harness import scripted_bake


@pytest.fixture(params=["memory", "file", "s3", "fsspec"])
def store(request: pytest.FixtureRequest, tmp_path: Path):
    if request.param == "fsspec":
        pytest.importorskip("fsspec")
        return FileSystemStore(f"memory://{uuid4().hex}/p")
    pytest.importorskip("obstore")
    return open_store(
        {"file": f"file://{tmp_path}/set"}.get(request.param) or request.getfixturevalue({"s3": "prefix"}.get(request.param, "memory"))
    )


def test_a_store_keeps_and_lists_objects(store, tmp_path):
    keys = [f"{folder}/{number:03d}.json" for folder in ("a", "a-b", "m") for number in range(3)]
    for key in reversed(keys):
        store.put(key, key.encode())
    (tmp_path / "large").write_bytes(bytes(range(256)) * 50_000)
    store.put_file("z", tmp_path / "large")
    assert [key for key, _ in store.list("")] == [*sorted(keys), "z"]
    assert list(store.list("a")) == [(key, 10) for key in keys[:3]]
    assert [key for key, _ in store.list("m", "m/000.json")] == keys[7:]
    assert list(store.list("none")) == []
    assert b"".join(store.blocks("z")) == (tmp_path / "large").read_bytes()
    assert store.get("m/001.json") == b"m/001.json"
    assert store.stat("z").size == 12_800_000
    store.delete("z")
    store.delete("z")
    assert store.stat("z") is None
    with pytest.raises(FileNotFoundError):
        store.get("z")


def test_the_probe_tells_conditional_writes(store):
    found = probe(store)
    assert found == Probe(found.offset, store.conditional)
    assert abs(found.offset) < 60
    assert list(store.list("")) == []
    if not store.conditional:
        return
    tag = store.create("claim", b"one")
    assert store.create("claim", b"two") is None
    assert store.get_tagged("claim") == (b"one", tag)
    newer = store.replace("claim", b"three", tag)
    assert newer not in (None, tag)
    assert store.replace("claim", b"four", tag) is None
    assert store.get("claim") == b"three"
    assert store.get_tagged("none") is None


def test_a_second_server_without_compare_and_swap_is_told_and_takes_shares(tmp_path, monkeypatch, local):
    """It creates if absent and ignores If-Match."""
    bucket = pytest.importorskip("localbucket")
    monkeypatch.setattr(bucket.S3Handler, "data_root", tmp_path, raising=False)
    monkeypatch.setattr(bucket.S3Handler, "disable_nagle_algorithm", True)
    (tmp_path / "bucket").mkdir()
    server = ThreadingHTTPServer(("127.0.0.1", 0), bucket.S3Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    given = {"ACCESS_KEY_ID": "key", "SECRET_ACCESS_KEY": "secret", "REGION": "us-east-1"}
    for name, value in (given | {"ENDPOINT_URL": f"http://127.0.0.1:{server.server_port}"}).items():
        monkeypatch.setenv(f"AWS_{name}", value)
    url = "s3://bucket/set"
    store = open_store(url)
    assert (store.create(".store/k", b"one") is None, store.create(".store/k", b"two")) == (False, None)
    assert store.replace(".store/k", b"three", ' "another"') is not None
    said = mistake("bake", "--config", "smoke", "--out", url, "--claim", "--device", "cpu")
    assert "has no conditional writes, which --claim needs" in said
    for share in range(2):
        run.bake_into_store(tiny(), url, SilentProgress(), shard=(share, 2), bake=scripted_bake.bake_episodes)
    assert stored(url) == local
    server.shutdown()
    server.server_close()


def test_of_many_that_create_one_wins(memory):
    store, won = open_store(memory), []
    threads = [threading.Thread(target=lambda me=me: won.append(store.create("claim", b"%d" % me))) for me in range(16)]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert sum(tag is not None for tag in won) == 1


@pytest.mark.parametrize("fault", ["500 InternalError", "503 SlowDown", "lost"])
def test_requests_are_repeated_while_the_store_fails(server, prefix, fault):
    count = itertools.count()
    server.fault = lambda method, path: fault if next(count) < 2 else None
    store = open_store(prefix)
    store.put("key", b"data")
    assert store.get("key") == b"data"
    assert next(count) > 3


def test_a_store_that_does_not_answer_in_time_is_asked_again(server, prefix, monkeypatch):
    monkeypatch.setattr(object_store, "TIMEOUT", 1)
    gate, count = threading.Event(), itertools.count()
    server.fault = lambda method, path: gate.wait(1.5) and None if next(count) == 0 else None
    store = open_store(prefix)
    store.put("key", b"data")
    gate.set()
    assert store.get("key") == b"data"


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (NotImplementedError(), "cannot do that"),
        (FileNotFoundError("no such share"), "no such share"),
        (RuntimeError("gone"), "6 attempts"),
    ],
)
def test_errors_of_any_library_become_store_errors(monkeypatch, error, said):
    pytest.importorskip("fsspec")
    monkeypatch.setattr("synpick_warp.system.stores.base.FIRST_PAUSE", 0.0)
    store = FileSystemStore(f"memory://{uuid4().hex}/p")

    def fail(*_):
        raise error

    monkeypatch.setattr(store._files, "pipe_file", fail)
    with pytest.raises(StoreError, match=said):
        store.put("key", b"data")


def test_a_transient_error_that_mentions_credentials_is_repeated(memory, monkeypatch):
    monkeypatch.setattr("synpick_warp.system.stores.base.FIRST_PAUSE", 0.0)
    store, faults = open_store(memory), ["status code: 503: token credentials", "error sending request for url (s3/credentials/a)"]
    real = store._obs.put

    def put(*arguments, **given):
        if faults:
            raise store._errors.GenericError(faults.pop())
        return real(*arguments, **given)

    monkeypatch.setattr(store, "_obs", SimpleNamespace(put=put))
    store.put("key", b"data")
    assert faults == []


@pytest.mark.parametrize("failures", [2, base.TRIES])
def test_a_listing_that_fails_is_repeated_or_an_error_and_never_short(memory, monkeypatch, failures):
    monkeypatch.setattr(base, "FIRST_PAUSE", 0.0)
    store = open_store(memory)
    real = store._obs.list
    keys = [f"many/{number:04d}" for number in range(1_001)]
    for key in keys:
        store.put(key, b"")
    pages = iter([0, *[1] * failures])  # The first page is read, and the second fails.

    def listing(*arguments, **given):
        """A stream of obstore, which after its error has ended."""
        if next(pages, 0):
            raise store._errors.GenericError("Server returned non-2xx status code: 500")
        yield from real(*arguments, **given)

    monkeypatch.setattr(store, "_obs", SimpleNamespace(list=listing))
    if failures < base.TRIES:
        assert [key for key, _ in store.list("many")] == keys
    else:
        with pytest.raises(StoreError, match="6 attempts failed"):
            list(store.list("many"))


def test_an_object_that_is_replaced_while_it_is_read_is_told(memory, monkeypatch):
    monkeypatch.setattr(object_store, "BLOCK_BYTES", 2)
    store = open_store(memory)
    store.put("key", b"old!")
    blocks = store.blocks("key")
    assert next(blocks) == b"ol"
    store.put("key", b"new!")
    with pytest.raises(StoreError, match="key was replaced while it was read"):
        next(blocks)


def test_a_generation_is_compared_where_the_store_tells_one(memory, monkeypatch):
    """Google Cloud Storage compares it, in place of the ETag."""
    store, modes = open_store(memory), []
    monkeypatch.setattr(store, "_obs", SimpleNamespace(put=lambda *_, mode, **__: modes.append(mode) or {"e_tag": '"b"', "version": "2"}))
    assert store.replace("key", b"data", '1 "a"') == '2 "b"'
    assert modes == [{"e_tag": '"a"', "version": "1"}]


@pytest.mark.parametrize(
    ("fault", "said"), [("403 AccessDenied", "credentials may not do that"), ("403 InvalidAccessKeyId", "does not accept the credentials")]
)
def test_what_fails_for_good_ends_in_one_line(server, prefix, fault, said):
    server.fault = lambda method, path: fault
    with pytest.raises(StoreError, match=said):
        open_store(prefix).put("key", b"data")


@pytest.mark.parametrize(
    ("place", "url"),
    [
        (Path("s3://bucket/a/b/"), "s3://bucket/a/b"),
        ("gs://bucket/a", "gs://bucket/a"),
        (Path("file:///data/x"), "file:///data/x"),
        (Path("s3://"), "s3://"),
        (Path("S3://Bucket/a"), "s3://Bucket/a"),
        ("folder/x", None),
        (Path("/a:b/c"), None),
        (None, None),
    ],
)
def test_urls_are_told_from_folders(place, url):
    assert as_url(place) == url
