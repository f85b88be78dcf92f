"""Hostile copies of a data set: whatever one of its files says, reading ends with a result or with one line, never with a traceback."""

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
from tests.harness.hostile import LEAVES, WHOLE, fuzz_examples, places, removed, replaced

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
        self.changed = ""  # The file that is replaced.
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
        path, self.changed = self.folder / name, name
        before = path.read_bytes()
        path.unlink()
        try:
            if content is not None:
                path.write_bytes(content)
            yield
        finally:
            self.changed = ""
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


def use_set(sandbox: Sandbox) -> None:
    """Read everything of a data set that `synpick_warp.open` gives; errors are SynpickErrors, or those of a missing key. Arrays are read to
    their ends if the store of one has changed."""
    data, arrays = synpick_warp.open(sandbox.folder), "zarr" in sandbox.changed or not sandbox.changed
    attempted(lambda: (len(data), repr(data), data.config))
    attempted(lambda: (data.attributes, data.objects))
    for name in ("cameras", "models_info"):
        attempted(lambda name=name: getattr(data, name))
    attempted(lambda: list(data.attempts))
    for index in attempted(lambda: list(data)) or []:
        use_episode(data, index, arrays)


def use_episode(data: DataSet, index: int, arrays: bool) -> None:
    """Read everything of an episode."""
    episode = attempted(lambda: data[index])
    if episode is None:
        return
    attempted(lambda: (repr(episode), episode.row, len(episode)))
    attempted(lambda: episode.attributes)
    for group in (episode.ticks, episode.steps, episode.arrangement, episode.attempt_arrays):
        for name in (attempted(lambda group=group: list(group)) or []) if arrays else ():
            attempted(lambda name=name, group=group: group[name][...])
    names = ("rgb", "depth", "masks", "amodal_masks", "layers", "intrinsics", "object_to_world", "object_ids", "instance_ids")
    for camera in (0, 2):
        if (view := attempted(lambda camera=camera: episode.view(0, camera))) is not None:
            for name in (*names, "visibility", "boxes", "visible_boxes"):
                attempted(lambda name=name, view=view: getattr(view, name))
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


def run_command(sandbox: Sandbox, name: str, *options: object, out: str = "", to: str = "--out") -> int:
    """Run a command on the set: exit code 0 or 1, or 2 with one line; with `out`, output is written there if and only if the code is 0."""
    place, started = sandbox.scratch / (out or "none"), time.monotonic()
    code, _, err = run(name, *options, *((to, place) if out else ()))
    assert time.monotonic() - started < HANG, name
    assert code in (0, 1, 2), name
    assert (code == 2) == bool(err), (name, err)
    if code == 2:
        [line] = err.splitlines()
        assert line.startswith("synpick-warp: error: "), line
        assert line.isprintable()
    assert (code == 0) == place.exists() or not out
    shutil.rmtree(place) if place.is_dir() else place.unlink(missing_ok=True)
    assert not list(sandbox.scratch.glob(".*"))
    return code


def draw(sandbox: Sandbox) -> int:
    """Run `preview` and `explain`."""
    codes = run_command(sandbox, "preview", sandbox.folder, "--views", 2, out="sheet.png")
    return codes + run_command(sandbox, "explain", sandbox.folder, "--episode", 0, out="explained.png")


def evaluate(sandbox: Sandbox) -> int:
    """Run `eval` on the set's own poses."""
    options = ("--results", sandbox.results, "--filter", "ema", "--vertices", 20)
    return run_command(sandbox, "eval", "--data", sandbox.folder, *options, out="table.txt")


def estimate(sandbox: Sandbox) -> int:
    options = ("--method", "refine", "--every", 1, "--visib-min", 0, "--threads", 1)
    return run_command(sandbox, "estimate", "--data", sandbox.folder, *options, out="refine.csv")


def count(sandbox: Sandbox) -> int:
    run_command(sandbox, "stats", sandbox.folder)
    return run_command(sandbox, "stats", sandbox.folder, out="tables", to="--csv")


def check_and_merge(sandbox: Sandbox) -> int:
    run_command(sandbox, "merge", sandbox.folder, out="merged")
    return run_command(sandbox, "verify", sandbox.folder)


READERS: dict[str, Callable[[Sandbox], int | None]] = {
    "open": use_set,
    "draw": draw,
    "evaluate": evaluate,
    "estimate": estimate,
    "count": count,
    "check and merge": check_and_merge,
    "config": lambda sandbox: run_command(sandbox, "config", "--config", sandbox.folder / "config.toml"),
}


def test_the_set_itself_is_read_by_every_command(sandbox):
    assert len(sandbox.files) > 60
    data = synpick_warp.open(sandbox.folder)
    assert [len(data[0].attempts), data[0].view(0).layers] == [2, ("classes", "flow")]
    for read in READERS.values():
        assert not read(sandbox)


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
