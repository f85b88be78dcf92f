"""Hostile copies of a data set: whatever one of its files says, reading ends with a result or with one line, never with a traceback."""

from __future__ import annotations

import functools
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

import synpick_warp
from synpick_warp.apps.evaluation.results import write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import SynpickError
from tests.builders import PICKED, bake_boxes, once, run
from tests.harness.fuzz import fuzz_examples
from tests.harness.hostile import LEAVES, WHOLE, places, removed, replaced

TINY = PICKED | {
    "bake.device": "cpu",
    "bake.episodes": 1,
    "bake.worlds": 1,
    "bake.formats": ["bop", "shards", "zarr"],
    "cameras.resolution": [48, 27],
}
HANG = 20.0
"""Longest time that one command may take [s]; some 0.1 s are usual."""
REMOVED = object()
VALUES = (*LEAVES, float("nan"), 2**31, 2**63, -(2**40), 1e300, REMOVED)


class Sandbox:
    """A data set whose files are replaced one at a time."""

    def __init__(self, folder: Path, scratch: Path) -> None:
        self.folder, self.scratch = folder, scratch
        paths = [path for path in sorted(folder.rglob("*")) if path.suffix in (".json", ".jsonl", ".toml", ".sha256")]
        self.files = [str(path.relative_to(folder)) for path in paths]
        self.kinds: dict[str, list[str]] = {}
        """Files by their last name, so that each kind comes as often as the 68 zarr.json."""
        for name in self.files:
            self.kinds.setdefault(name.rpartition("/")[2], []).append(name)
        self.results = scratch / "own_results.csv"
        write_results(self.results, read_truth(synpick_warp.open(folder)).poses)

    @contextmanager
    def replaced(self, name: str, content: bytes | None) -> Iterator[None]:
        """Replace a file, or remove it; afterwards it is as before. A merged set may share the file: it is not written to."""
        path = self.folder / name
        before = path.read_bytes()
        path.unlink()
        try:
            if content is not None:
                path.write_bytes(content)
            yield
        finally:
            path.unlink(missing_ok=True)
            path.write_bytes(before)


@pytest.fixture(scope="module")
def sandbox(tmp_path_factory) -> Sandbox:
    """A finished set of one episode with two attempts, in all formats that are read back, and with few pixels: it is read often."""
    folder = tmp_path_factory.mktemp("hostile")
    baked, _ = once(tmp_path_factory, "hostile", lambda out: bake_boxes(out, TINY))
    return Sandbox(shutil.copytree(baked, folder / "set"), folder)


@functools.lru_cache(maxsize=64)
def spots(data: bytes) -> tuple[tuple[object, ...], ...]:
    return tuple(places(json.loads(data)))


def hostile_content(name: str, data: bytes, number: int) -> bytes | None:
    """One of the hostile replacements of a file's content; None: no file."""
    whole = [None, *WHOLE.values(), *(data[: len(data) * part // 4] for part in (1, 2, 3)), data[:-2]]
    if number % 4 == 0:
        return whole[number // 4 % len(whole)]
    number //= 4
    if name.endswith((".toml", ".sha256")):
        lines = data.splitlines(keepends=True)
        row, value = number % len(lines), VALUES[number // len(lines) % len(LEAVES)]
        head, separator, _ = lines[row].partition(b" = ") if b" = " in lines[row] else lines[row].partition(b"  ")
        lines[row] = head + separator + json.dumps(value).encode() + b"\n"
        return b"".join(lines)
    first, rest = (data, b"") if name.endswith(".json") else data.split(b"\n", 1)
    where = spots(first)
    place, value = where[number % len(where)], VALUES[number // len(where) % len(VALUES)]
    document = json.loads(first)
    changed = removed(document, place) if value is REMOVED else replaced(document, place, value)
    return json.dumps(changed).encode() + b"\n" + rest


def use_set(folder: Path) -> None:
    """Read everything of a data set that `synpick_warp.open` gives; errors are SynpickErrors, or those of a missing key."""
    data = synpick_warp.open(folder)
    parts: list[Callable[[], object]] = [
        lambda: (len(data), repr(data), data.config),
        lambda: (data.attributes, data.objects),
        lambda: data.cameras,
        lambda: data.models_info,
        lambda: list(data.attempts),
    ]
    for part in parts:
        attempted(part)
    for index in attempted(lambda: list(data)) or []:
        use_episode(data, index)


def use_episode(data: DataSet, index: int) -> None:
    """Read everything of an episode."""
    episode = attempted(lambda: data[index])
    if episode is None:
        return
    attempted(lambda: (repr(episode), episode.row, len(episode)))
    attempted(lambda: episode.attributes)
    for group in (episode.ticks, episode.steps, episode.arrangement, episode.attempt_arrays):
        for name in attempted(lambda group=group: list(group)) or []:
            attempted(lambda name=name, group=group: group[name][...])
    for camera in (0, 2):
        view = attempted(lambda camera=camera: episode.view(0, camera))
        names = ("rgb", "depth", "masks", "amodal_masks", "layers", "intrinsics", "object_to_world", "object_ids", "instance_ids")
        for name in (*names, "visibility", "boxes", "visible_boxes") if view is not None else ():
            attempted(lambda name=name, view=view: getattr(view, name))
        if view is not None:
            attempted(lambda view=view: [view.layer(name) for name in view.layers])
            attempted(lambda view=view: view.project(view.object_to_camera[:, :3, 3]))


def attempted(part: Callable[[], object]):
    """Result of a call; None: it failed with a message of one line."""
    try:
        return part()
    except (SynpickError, KeyError, IndexError) as caught:
        error = caught
    allowed = isinstance(error, SynpickError) or "has no episode" in str(error) or "has no frame" in str(error)
    assert allowed, repr(error)
    assert str(error).isprintable()
    return None


def run_command(*arguments: object) -> int:
    """Run a command: exit code 0 or 1, or 2 with one line."""
    started = time.monotonic()
    code, _, err = run(*arguments)
    assert time.monotonic() - started < HANG, arguments
    assert code in (0, 1, 2), arguments
    assert (code == 2) == bool(err), (arguments, err)
    if code == 2:
        [line] = err.splitlines()
        assert line.startswith("synpick-warp: error: "), line
        assert line.isprintable()
    return code


def draw(sandbox: Sandbox) -> None:
    """Run `preview` and `explain`; an image is written if and only if the code is 0."""
    picture = sandbox.scratch / "picture.png"
    for arguments in (("preview", sandbox.folder, "--views", 2), ("explain", sandbox.folder, "--episode", 0)):
        code = run_command(*arguments, "--out", picture)
        assert (code == 0) == picture.exists()
        picture.unlink(missing_ok=True)
    assert not list(sandbox.scratch.glob(".picture*"))


def check_and_merge(sandbox: Sandbox) -> None:
    """Run `verify` and `merge`."""
    run_command("verify", sandbox.folder)
    run_command("merge", sandbox.folder, "--out", sandbox.scratch / "merged")
    shutil.rmtree(sandbox.scratch / "merged", ignore_errors=True)


def show_settings(sandbox: Sandbox) -> None:
    """Run `config` on the set's settings."""
    run_command("config", "--config", sandbox.folder / "config.toml")


def evaluate(sandbox: Sandbox) -> None:
    """Run `eval` on the set's own poses."""
    table = sandbox.scratch / "table.txt"
    code = run_command("eval", "--data", sandbox.folder, "--results", sandbox.results, "--filter", "ema", "--vertices", 20, "--out", table)
    assert (code == 0) == table.exists()
    table.unlink(missing_ok=True)


def estimate(sandbox: Sandbox) -> int:
    """Run `estimate`; returns the exit code."""
    out = sandbox.scratch / "refine.csv"
    options = ("--method", "refine", "--every", 1, "--visib-min", 0, "--threads", 1)
    code = run_command("estimate", "--data", sandbox.folder, *options, "--out", out)
    assert (code == 0) == out.exists()
    out.unlink(missing_ok=True)
    return code


def count(sandbox: Sandbox) -> int:
    """Run `stats`; tables are written if and only if the code is 0."""
    tables = sandbox.scratch / "tables"
    code = run_command("stats", sandbox.folder, "--csv", tables)
    assert (code == 0) == tables.exists()
    shutil.rmtree(tables, ignore_errors=True)
    run_command("stats", sandbox.folder)
    return code


READERS = {
    "open": lambda sandbox: use_set(sandbox.folder),
    "draw": draw,
    "evaluate": evaluate,
    "estimate": estimate,
    "count": count,
    "check and merge": check_and_merge,
    "config": show_settings,
}


def test_the_set_itself_is_read_by_every_command(sandbox):
    assert len(sandbox.files) > 60
    use_set(sandbox.folder)
    data = synpick_warp.open(sandbox.folder)
    assert [len(data[0].attempts), data[0].view(0).layers] == [2, ("classes", "flow")]
    draw(sandbox)
    evaluate(sandbox)
    assert estimate(sandbox) == 0
    assert count(sandbox) == 0
    assert run_command("verify", sandbox.folder) == 0
    show_settings(sandbox)


@pytest.mark.parametrize("reader", READERS)
@settings(
    max_examples=fuzz_examples(20),
    deadline=None,
    phases=(Phase.explicit, Phase.generate),
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.data_too_large],
)
@given(data=st.data())
def test_a_file_with_hostile_content_is_read_or_named_in_one_line(sandbox, reader, data):
    unread = {"config": sandbox.kinds.keys() - {"config.toml"}, "draw": {"zarr.json", "episodes.jsonl"}}.get(reader, set())
    kind = data.draw(st.sampled_from([name for name in sandbox.kinds if name not in unread]))
    name = data.draw(st.sampled_from(sandbox.kinds[kind]))
    number = data.draw(st.integers(0, 200_000))
    with sandbox.replaced(name, hostile_content(name, (sandbox.folder / name).read_bytes(), number)):
        READERS[reader](sandbox)
