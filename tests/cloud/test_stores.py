"""Object stores: reads, ordered listings, size limits, conditional writes, retries, permanent errors, URLs, secrets in messages. Also bakes
on a Ray cluster, and launchers: the worker script with each scheduler's environment variables, and the names in their files."""

from __future__ import annotations

import io
import itertools
import os
import re
import shlex
import signal
import subprocess
import sys
import tempfile
import threading
import time
from http.server import ThreadingHTTPServer
from pathlib import Path
from types import SimpleNamespace

import pytest
import yaml
from rich.console import Console

import synpick_warp
from synpick_warp.cli.display import make_progress
from synpick_warp.cli.main import app
from synpick_warp.cloud import run
from synpick_warp.cloud.run import Crew
from synpick_warp.errors import StoreError, SynpickError
from synpick_warp.system.inputs.urls import parse_place, resolve_word
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores import store as store_module
from synpick_warp.system.stores.store import Probe, open_store, probe
from tests.builders import mistake
from tests.cloud.conftest import files, stored
from tests.harness import scripted_bake
from tests.harness.processes import module_command
from tests.harness.scripted_bake import tiny


@pytest.fixture(params=["memory", "prefix"])
def store(request: pytest.FixtureRequest):
    return open_store(request.getfixturevalue(request.param))


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
    assert b"".join(store.blocks("z", 1 << 24)) == (tmp_path / "large").read_bytes()
    assert store.get("m/001.json", 10) == b"m/001.json"
    assert store.stat("z").size == 12_800_000
    store.delete("z")
    store.delete("z")
    assert store.stat("z") is None
    with pytest.raises(FileNotFoundError):
        store.get("z", 10)


def test_the_probe_tells_conditional_writes(store):
    found = probe(store)
    assert found == Probe(found.offset, True)
    assert abs(found.offset) < 60
    assert list(store.list("")) == []
    tag = store.create("claim", b"one")
    assert store.create("claim", b"two") is None
    assert store.get_tagged("claim") == (b"one", tag)
    newer = store.replace("claim", b"three", tag)
    assert newer not in (None, tag)
    assert store.replace("claim", b"four", tag) is None
    assert store.get("claim", 10) == b"three"
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
        run.bake_into_store(run.Job(tiny(), url, bake=scripted_bake.bake_episodes), SilentProgress(), shard=(share, 2))
    assert stored(url) == local
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("fault", ["500 InternalError", "503 SlowDown", "lost"])
def test_requests_are_repeated_while_the_store_fails(server, prefix, fault):
    count = itertools.count()
    server.fault = lambda method, path: fault if next(count) < 2 else None
    store = open_store(prefix)
    store.put("key", b"data")
    assert store.get("key", 10) == b"data"
    assert next(count) > 3


def test_a_store_that_does_not_answer_in_time_is_asked_again(server, prefix, monkeypatch):
    monkeypatch.setattr(store_module, "TIMEOUT", 1)
    gate, count = threading.Event(), itertools.count()
    server.fault = lambda method, path: gate.wait(1.5) and None if next(count) == 0 else None
    store = open_store(prefix)
    store.put("key", b"data")
    gate.set()
    assert store.get("key", 10) == b"data"


def test_a_transient_error_that_mentions_credentials_is_repeated(memory, monkeypatch):
    monkeypatch.setattr("synpick_warp.system.stores.store.FIRST_PAUSE", 0.0)
    store, faults = open_store(memory), ["status code: 503: token credentials", "error sending request for url (s3/credentials/a)"]
    real = store._obs.put

    def put(*arguments, **given):
        if faults:
            raise store._errors.GenericError(faults.pop())
        return real(*arguments, **given)

    monkeypatch.setattr(store, "_obs", SimpleNamespace(put=put))
    store.put("key", b"data")
    assert faults == []


@pytest.mark.parametrize("failures", [2, store_module.TRIES])
def test_a_listing_that_fails_is_repeated_or_an_error_and_never_short(memory, monkeypatch, failures):
    monkeypatch.setattr(store_module, "FIRST_PAUSE", 0.0)
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
    if failures < store_module.TRIES:
        assert [key for key, _ in store.list("many")] == keys
    else:
        with pytest.raises(StoreError, match="6 attempts failed"):
            list(store.list("many"))


def test_an_object_that_is_replaced_while_it_is_read_is_told(memory, monkeypatch):
    monkeypatch.setattr(store_module, "BLOCK_BYTES", 2)
    store = open_store(memory)
    store.put("key", b"old!")
    blocks = store.blocks("key", 10)
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
    ("place", "found"),
    [
        (Path("s3://bucket/a/b/"), "s3://bucket/a/b"),
        ("gs://bucket/a", "gs://bucket/a"),
        ("AZ://container", "az://container"),
        (Path("S3://Bucket/a"), "s3://Bucket/a"),
        ("folder/x", Path("folder/x")),
        (Path("/a:b/c"), Path("/a:b/c")),
        ("run:3", Path("run:3")),
        ("file:///data/my%20set/", Path("/data/my set")),
        ("FILE://localhost/data", Path("/data")),
        ("file:/data", Path("/data")),
        ("file:////data", Path("/data")),
        ("file:///a%C3%A4", Path("/aä")),
    ],
)
def test_a_place_is_a_folder_or_a_prefix(place, found):
    assert parse_place(place) == found


@pytest.mark.parametrize(
    ("place", "said"),
    [
        *((f"{scheme}://a/b", "allowed: s3://") for scheme in ("memory", "hdfs", "hf", "sftp", "local", "http", "data", "s3a", "abfs")),
        (Path("memory://"), "allowed: s3://"),
        (Path("simplecache::s3://b/x"), "allowed: s3://"),
        ("hf://datasets/a", "bake into a folder for other services"),
        ("s3a://b/x", "did you mean s3?"),
        *((f"{scheme}:bucket", "has not two slashes") for scheme in ("s3", "gs", "az")),
        ("s3:/bucket/x", "has not two slashes"),
        ("s3://", "names no bucket"),
        ("s3:///a", "names no bucket"),
        ("s3://b_/x", "names no bucket"),
        *((f"s3://bucket/{prefix}", "has a part . or ..") for prefix in ("..", "a/./b", "a//b")),
        *((f"s3://bucket/a{letter}b", "has one of") for letter in "@?#%\\\n"),
        ("s3://bucket:9000/a", "names no bucket"),
        *((f"file:{rest}", "is not of this machine") for rest in ("x", "//host/x", "//host", "", "//", "//127.0.0.1/x")),
        *((f"file:///a{part}", "name the folder by its path") for part in ("?b", "#b", "%zz", "%", "%2Fb", "%00", "%ff")),
        (Path("file:///data"), "a URL in a Path"),
        (Path("s3:bucket"), "has not two slashes"),
    ],
)
def test_a_place_of_another_form_is_one_line(place, said):
    with pytest.raises(StoreError, match=re.escape(said)) as error:
        parse_place(place)
    assert "\n" not in str(error.value)


SECRET = "hunter2hunter2"


@pytest.mark.parametrize(
    "place",
    [
        *(f"{scheme}://me:{SECRET}@host/set" for scheme in ("s3", "gs", "az", "file", "hf", "sftp", "https")),
        *(f"{scheme}://bucket/set?sig={SECRET}" for scheme in ("s3", "az", "file", "https")),
        f"s3://me%3A{SECRET}%40host/set",
        f"s3://{SECRET}@bucket",
        f"file:me:{SECRET}@host",
    ],
)
@pytest.mark.parametrize(
    "command", [("stats", "PLACE"), ("verify", "PLACE"), ("bake", "--config", "smoke", "--device", "cpu", "--out=PLACE")]
)
def test_no_message_shows_a_secret_of_a_url(command, place):
    assert SECRET not in mistake(*(each.replace("PLACE", place) for each in command))


@pytest.mark.parametrize("scheme", ["s3", "gs", "az"])
def test_no_message_shows_a_secret_of_the_environment(scheme, server, monkeypatch):
    """An answer and an error that quote them."""
    given = {"AWS_SESSION_TOKEN": f"{SECRET}1", "AZURE_STORAGE_ACCOUNT_NAME": "me", "AZURE_STORAGE_SAS_KEY": f"sv=1&sig={SECRET}2"}
    for name, value in given.items():
        monkeypatch.setenv(name, value)
    store = open_store(f"{scheme}://bucket/set")
    quoted = f"https://me:{SECRET}3@host/a?sig={SECRET}4 {' '.join(given.values())}"
    for error in (store._errors.GenericError(f"bad: {quoted}"), FileNotFoundError(quoted)):
        monkeypatch.setattr(store, "_obs", SimpleNamespace(get=lambda *_, error=error: (_ for _ in ()).throw(error)))
        with pytest.raises((StoreError, FileNotFoundError)) as caught:
            store.get("key", 10)
        assert SECRET not in str(caught.value)


ADDRESSES = ["http://[::1", "http://[x]", "http://h:99999", "http://h st", "http://", "http:///x", "http://h:p", "http://h:0", "h:9"]
ADDRESSES += [" http://h", "http://h\n", "http://ä", "ftp://h", "http://h#f", "http://%zz", f"http://u:{SECRET}@h", f"http://h?{SECRET}"]


@pytest.mark.parametrize("address", ADDRESSES)
@pytest.mark.parametrize("name", ["AWS_ENDPOINT_URL_S3", "AWS_ENDPOINT_URL", "AWS_ENDPOINT", "AZURE_STORAGE_ENDPOINT", "AZURE_ENDPOINT"])
def test_a_malformed_endpoint_is_one_line(name, address, server, monkeypatch, capfd):
    """Of which obstore panics, in a class that is no Exception, and prints a stack."""
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "me")
    monkeypatch.setenv(name, address)
    said = mistake("verify", f"{'s3' if 'AWS' in name else 'az'}://bucket/set")
    assert f"{name} is" in said
    assert SECRET not in said
    assert "panicked" not in capfd.readouterr().err


@pytest.mark.parametrize("value", ["a\nb", "ä", " "])
@pytest.mark.parametrize(
    "name", ["AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_REGION", "AZURE_STORAGE_ACCOUNT_NAME"]
)
def test_a_malformed_variable_is_one_line(name, value, server, monkeypatch):
    monkeypatch.setenv("AZURE_STORAGE_ACCOUNT_NAME", "me")
    monkeypatch.setenv(name, value)
    assert f"{name} has a space" in mistake("verify", f"{'s3' if 'AWS' in name else 'az'}://bucket/set")


def test_a_panic_of_the_library_is_one_line(memory, monkeypatch):
    def panic(*_, **__):
        raise type("PanicException", (BaseException,), {})("in Rust")

    store = open_store(memory)
    monkeypatch.setattr(store, "_obs", SimpleNamespace(get=panic))
    with pytest.raises(StoreError, match=r"obstore failed \(in Rust\)"):
        store.get("key", 10)
    monkeypatch.setattr("obstore.store.GCSStore", panic)
    with pytest.raises(StoreError, match=r"obstore failed \(in Rust\)"):
        open_store("gs://bucket")


def test_an_object_larger_than_its_limit_is_not_read(store):
    store.put("key", bytes(11))
    for read in (lambda: store.get("key", 10), lambda: list(store.blocks("key", 10))):
        with pytest.raises(StoreError, match="key is larger than 10 bytes"):
            read()
    store.put("lease", bytes(store_module.SMALL + 1))
    with pytest.raises(StoreError, match="larger than 1 MiB"):
        store.get_tagged("lease")


def test_words_of_a_command_line_that_are_urls_are_parsed_before_a_path_drops_slashes(tmp_path):
    assert resolve_word(f"--out=file://{tmp_path}") == f"--out={tmp_path}"
    assert resolve_word("--set=a=file:///x") == "--set=a=file:///x"
    assert resolve_word("S3://bucket/x/") == "s3://bucket/x"
    with pytest.raises(StoreError, match="an empty one"):
        resolve_word("--out=s3://bucket/a//b")


def test_a_file_url_is_the_folder_by_the_code_of_folders(tmp_path):
    """The same set; no FIFO is waited for, no link out of the folder followed, and what is refused leaves no folder."""
    os.mkfifo(tmp_path / "manifest.json")
    for command in ("verify", "stats"):
        assert "manifest.json" in mistake(command, f"file://{tmp_path}")
    (tmp_path / "manifest.json").unlink()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "manifest").symlink_to(tmp_path / "elsewhere")
    assert "is not empty" in mistake("bake", "--config", "smoke", "--device", "cpu", "--out", f"file://{tmp_path}/set")
    assert "models folder" in mistake("bake", "--config", "smoke", "--models", "none", "--device", "cpu", "--out", f"file://{tmp_path}/a/b")
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["elsewhere", "manifest", "set"]
    with pytest.raises(SynpickError, match="is not empty"):
        synpick_warp.bake("smoke", f"file://{tmp_path}/set")
    scripted_bake.bake(tmp_path / "my set", tiny(1))
    assert list(synpick_warp.open(f"file://{tmp_path}/my%20set")) == [0]


# ---- launchers ----


S3 = ("bake", "--config", "smoke", "--device", "cpu", "--out", "s3://bucket/set")


@pytest.mark.slow(minutes=1)
def test_a_killed_worker_leaves_the_set_of_one_bake_and_home_untouched(prefix, tmp_path):
    """Two workers; the first that claims a chunk is killed in it, Ray starts it again, and its chunk is dealt again."""
    pytest.importorskip("ray")
    (tmp_path / "home").mkdir()
    with tempfile.TemporaryDirectory(dir="/tmp") as short:  # Paths of sockets have 107 characters.
        places = {"HOME": str(tmp_path / "home"), "TMPDIR": short, "PYTHONPATH": os.pathsep.join(sys.path)}
        command = [*module_command("tests.cloud.ray_driver"), prefix, "6", "2", str(tmp_path / "died")]
        ran = subprocess.run(command, env=os.environ | places, capture_output=True, text=True, timeout=300)
        assert ran.returncode == 0, ran.stdout + ran.stderr
        assert not list(Path(short).glob("ray-*"))
    assert list((tmp_path / "home").iterdir()) == []
    assert (tmp_path / "died").exists()
    assert "worker · cost" in ran.stdout or "workers · cost" in ran.stdout
    assert "A worker died" in ran.stdout  # Ray's own notice.
    scripted_bake.bake(tmp_path / "local", tiny(6).with_values({"bake.device": "cpu"}))
    assert stored(prefix) == files(tmp_path / "local")


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (("--engine", "dask"), "--engine is dask; allowed: ray, or ray://HOST:PORT"),
        (("--engine", "dask", "--out", "DATA"), "--engine is dask; allowed: ray, or ray://HOST:PORT"),
        (("--engine", "ray://127.0.0.1:1"), "ray://127.0.0.1:1 does not answer ("),
        (("--engine", "ray://127.0.0.1:99999"), "ray://127.0.0.1:99999 does not answer ("),
        (("--engine", "ray", "--shard", "0/2"), "drop --devices and --shard"),
        (("--engine", "ray", "--out", "DATA"), "name one by --out"),
        (("--engine", "ray", "--price", "-1"), "--price is -1; allowed: 0.0 to 1000000.0"),
        (("--engine", "ray", "--workers", "-1"), "--workers is -1; allowed: 0 to 100000"),
        (("--workers", "2"), "--workers and --price go with --engine"),
    ],
)
def test_options_that_cannot_be_used(given, said):
    assert said in mistake(*S3[: -2 if "--out" in given else None], *given)


@pytest.mark.parametrize("given", [("--claim",), ("--devices", "cpu,cpu"), ()])
def test_a_price_is_that_of_workers(given):
    assert "--price also goes with --claim --devices" in mistake("bake", "--config", "smoke", "--out", "s3://b/x", "--price", "2", *given)


@pytest.mark.parametrize(("ray", "said"), [(None, "needs Ray >= 2.52: pip"), ("1.13.0", "here is Ray 1.13.0")])
def test_ray_is_missing_or_too_old(ray, said, monkeypatch):
    for name in ("RAY_ADDRESS", "RAY_AUTH_MODE", "RAY_AUTH_TOKEN", "RAY_USAGE_STATS_ENABLED", "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"):
        monkeypatch.setenv(name, "")
    monkeypatch.setitem(sys.modules, "ray", ray and SimpleNamespace(__version__=ray))
    assert said in mistake(*S3, "--engine", "ray")


@pytest.mark.parametrize("terminal", [False, True])
def test_the_display_shows_workers_and_what_they_have_cost(terminal):
    crew, out = Crew(price=2.5, alive=3, seconds=3600.0), io.StringIO()
    with make_progress(Console(file=out, width=200, force_terminal=terminal), crew) as progress:
        progress.update(episodes_done=1, episodes=2, worlds_active=4, views=5, views_per_s=6.0, seconds_left=7.0)
    assert "worlds 4 · views 5 · 6.0 views/s · 0:07 left · 3 workers · cost 2.50" in out.getvalue()
    assert str(Crew(alive=1)) == "1 worker"


# ---- launchers ----

ROOT = Path(__file__).parents[2]
PLACE = ROOT / "synpick_warp/cloud/launchers"
STUBS = {
    "synpick-warp": 'echo "$*" >> said; trap "exit 143" TERM; touch started; [ "$CODE" = wait ] || exit "$CODE"; sleep 60 & wait',
    "scontrol": 'echo "scontrol $*" >> said',
}


def start(folder: Path, code: str, *arguments: str, **variables: str) -> subprocess.Popen:
    """Start the worker script with stubs in place of the programs that it calls; the bake ends with this code, or waits for SIGTERM."""
    for name, text in STUBS.items():
        (folder / name).write_text(f"#!/bin/bash\n{text}\n")
        (folder / name).chmod(0o755)
    kept = {name: os.environ[name] for name in os.environ if not name.startswith("SLURM_")}
    environment = kept | {"PATH": f"{folder}:{os.environ['PATH']}", "CODE": code} | variables
    return subprocess.Popen(["bash", PLACE / "worker.sh", *arguments], env=environment, cwd=folder)


@pytest.mark.parametrize(("code", "ends"), [("0", 0), ("1", 0), ("2", 2), ("143", 143)])
def test_the_worker_ends_as_its_bake_but_for_episodes_that_were_given_up(code, ends, tmp_path):
    assert start(tmp_path, code, "--out", "s3://a b/c").wait(30) == ends
    assert (tmp_path / "said").read_text() == "bake --claim --out s3://a b/c\n"


@pytest.mark.parametrize("variables", [{"SLURM_JOB_ID": "7", "SLURM_ARRAY_TASK_ID": "3"}, {"JOB_COMPLETION_INDEX": "3"}])
def test_a_signal_reaches_the_bake_and_slurm_alone_is_asked_to_start_it_again(variables, tmp_path):
    worker = start(tmp_path, "wait", **variables)
    while not (tmp_path / "started").exists():
        time.sleep(0.01)
    worker.send_signal(signal.SIGTERM)
    assert worker.wait(30) == 143
    assert (tmp_path / "said").read_text() == "bake --claim\n" + ("scontrol requeue 7\n" if "SLURM_JOB_ID" in variables else "")


def commands() -> list[list[str]]:
    """Arguments of synpick-warp in the launchers and their page."""
    pod = yaml.safe_load((PLACE / "kubernetes.yaml").read_text())["spec"]["template"]["spec"]["containers"][0]
    assert pod["command"] == ["worker.sh"]
    task = yaml.safe_load((PLACE / "skypilot.yaml").read_text())
    (sky,) = re.findall(r"worker\.sh (.*)", task["run"])
    sky = sky.replace("$OPTIONS", task["envs"]["OPTIONS"]).replace("$OUT", task["envs"]["OUT"])
    docker = (PLACE / "Dockerfile").read_text()
    (warm,) = re.findall(r'ARG WARM="(.*)"', docker)
    page = (PLACE / "README.md").read_text().replace("\\\n", " ").replace('"$(pwd)"', ".")
    found = [["bake", "--claim", *pod["args"]], ["bake", "--claim", *shlex.split(sky)], ["warmup", *shlex.split(warm)]]
    found += [["bake", "--claim", *shlex.split(line)] for line in re.findall(r"worker\.sh (--.*)", page)]
    return found + [
        shlex.split(line, comments=True) for line in re.findall(r"synpick-warp ((?:bake|warmup) --.*)", page) if "OPTIONS" not in line
    ]


def test_launchers_and_their_page_name_options_that_exist():
    lines = commands()
    assert len(lines) >= 6
    for line in lines:
        app.parse_args(line, exit_on_error=False, print_error=False)


def test_the_image_copies_what_there_is():
    copied = re.findall(r"^COPY (?:--\S+ )?(.*) \S+$", (PLACE / "Dockerfile").read_text(), re.MULTILINE)
    assert all((ROOT / name).exists() for names in copied for name in names.split())
