"""Fuzz tests of hostile data sets: any record, checksum list, scene or shard ends in one line, and nothing leaves the set."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from synpick_warp.dataset.commit.manifest import episode_entry, read_entry
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import DatasetError, SynpickError
from synpick_warp.exporters.bop.shards.tar_files import list_keys
from synpick_warp.exporters.bop.shared import targets
from synpick_warp.exporters.writing.checksums import parse_checksums
from tests.harness.fuzz import fuzz_examples
from tests.harness.hostile import LEAVES, WHOLE, hostile_contents, places, replaced
from tests.harness.scripted_bake import ATTEMPT, bake, make_victim, small_settings, snapshot

pytestmark = pytest.mark.usefixtures("inline")
CONFIG = small_settings()
SECONDS = 5.0
"""Longest time of a command on a hostile data set."""
RECORDS = (
    "manifest.json",
    *(f"manifest/{name}.{kind}" for name in ("constants", "000000", "000001", "joined") for kind in ("json", "sha256")),
)


def check_line(error: Exception, case: str = "", advice: str = "") -> None:
    """An error is one line, with this advice."""
    assert str(error).isprintable(), case
    assert advice in str(error), case


@examples(max_examples=fuzz_examples(200), deadline=None)
@given(
    st.lists(
        st.tuples(
            st.sampled_from(["0" * 64] * 8 + ["A" * 64, "0"]),
            st.sampled_from(["  "] * 8 + [" ", "  *", "\t"]),
            st.one_of(
                st.text(max_size=12), st.lists(st.sampled_from(["..", ".", "a", "", "out", "manifest", "ü"]), max_size=5).map("/".join)
            ),
        ).map("".join),
        max_size=4,
    ),
    st.sampled_from(["\n"] * 8 + ["\r\n", "", "\x0b"]),
)
def test_a_checksum_list_is_refused_or_its_names_are_inside(tmp_path_factory, lines, separator):
    folder = tmp_path_factory.getbasetemp() / "names"
    folder.mkdir(exist_ok=True)
    if not (folder / "out").is_symlink():
        (folder / "out").symlink_to("..")
    try:
        known = parse_checksums(separator.join(lines).encode("utf-8", "surrogatepass"), folder, Path("LIST"), "ADVICE")
    except DatasetError as error:
        check_line(error)
    else:
        assert all((folder / name).resolve().is_relative_to(folder.resolve()) and (folder / name).resolve() != folder for name in known)


@examples(max_examples=fuzz_examples(100), deadline=None)
@given(st.data())
def test_damaged_scenes_are_one_line_or_targets(ready, tmp_path_factory, data):
    scene = tmp_path_factory.mktemp("scene") / "000000"
    scene.mkdir()
    places = str(scene.parent / targets.BOP19), str(scene.parent / targets.BOP24)
    for place in places:
        Path(place).mkdir()
    for name in ("scene_gt.json", "scene_gt_info.json"):
        shutil.copy(ready / "train" / "000000" / name, scene)
    path = scene / data.draw(st.sampled_from(["scene_gt.json", "scene_gt_info.json"]))
    path.write_bytes(draw_hostile(data, path.read_bytes()))
    try:
        targets.write_scene_targets(scene, places, 0.1)
    except DatasetError as error:
        check_line(error)


@examples(max_examples=fuzz_examples(100), deadline=None)
@given(st.data())
def test_damaged_shards_are_one_line_or_keys(ready, tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("shard")
    content = bytearray((ready / "train_web" / "shard-000000.tar").read_bytes()[:20_000])
    for _ in range(data.draw(st.integers(0, 8))):
        content[512 * data.draw(st.integers(0, 2)) + data.draw(st.integers(0, 511))] = data.draw(st.integers(0, 255))
    shard = folder / "shard-000000.tar"
    shard.write_bytes(content[: data.draw(st.integers(0, len(content)))])
    (folder / "keys").mkdir()
    try:
        list_keys(shard, folder / "keys")
    except DatasetError as error:
        check_line(error)


def draw_hostile(data: st.DataObject, content: bytes) -> bytes:
    """A hostile replacement of a JSON file, or of a checksum list."""
    if data.draw(st.booleans()) or not content.startswith(b"{"):
        whole = [*WHOLE.values(), content[: data.draw(st.integers(0, len(content)))]]
        return data.draw(st.sampled_from(whole))
    document = json.loads(content)
    place = data.draw(st.sampled_from(list(places(document))))
    return json.dumps(replaced(document, place, data.draw(st.sampled_from([*LEAVES, float("nan")])))).encode()


def fix_digests(data_set: Path) -> None:
    """Let entries fit their lists again, and the manifest its settings, where they are readable: somebody edits with care."""
    path = data_set / "manifest.json"
    try:
        content = json.loads(path.read_bytes())
        settings_ = json.dumps(content["settings"], sort_keys=True).encode()
        path.write_text(json.dumps(content | {"settings_checksum": hashlib.sha256(settings_).hexdigest()}))
    except (ValueError, KeyError, TypeError, RecursionError, OSError):
        pass
    for entry in (data_set / "manifest").glob("*.json"):
        try:
            content = json.loads(entry.read_bytes())
            digest = hashlib.sha256(entry.with_suffix(".sha256").read_bytes()).hexdigest()
            entry.write_text(json.dumps(content | {"checksum": digest}))
        except (ValueError, TypeError, RecursionError, OSError):
            pass


@examples(max_examples=fuzz_examples(50), deadline=None, suppress_health_check=list(HealthCheck))
@given(st.data())
@pytest.mark.slow
def test_resume_verify_and_merge_of_hostile_sets_end_in_one_line_and_stay_inside(ready, tmp_path_factory, data):
    root = tmp_path_factory.mktemp("hostile")
    victim = make_victim(root)
    data_set = root / "set"
    shutil.copytree(ready, data_set)
    for name in data.draw(st.lists(st.sampled_from(RECORDS), min_size=1, max_size=2, unique=True)):
        path = data_set / name
        kind = data.draw(st.sampled_from(["replace", "replace", "remove", "link", "names"]))
        if kind == "replace":
            path.write_bytes(draw_hostile(data, path.read_bytes()))
        elif kind == "names" and name.endswith(".sha256"):
            names = ["../victim", "../victim/thesis.txt", "/etc/hostname", "train/../../victim", "train", "train/000000", "out/victim", "."]
            line = f"{64 * '0'}  {data.draw(st.sampled_from(names))}\n"
            path.write_text(line + (path.read_text() if data.draw(st.booleans()) else ""))
        else:
            path.unlink()
            if kind == "link":
                path.symlink_to(victim / "thesis.txt")
    if data.draw(st.booleans()):
        (data_set / "out").symlink_to("..")
    if data.draw(st.booleans()):
        fix_digests(data_set)
    before, outside = snapshot(victim), sorted(os.listdir(root))
    commands = [
        lambda: verify(data_set),
        lambda: merge([data_set], root / "merged"),
        lambda: bake(data_set, CONFIG),
        lambda: verify(data_set),
    ]
    for command in commands:
        started = time.monotonic()
        try:
            command()
        except SynpickError as error:
            check_line(error)
        assert time.monotonic() - started < 10 * SECONDS
    assert snapshot(victim) == before
    assert sorted(set(os.listdir(root)) - {"merged"}) == outside
    shutil.rmtree(root)


@pytest.fixture(scope="module")
def entry(ready) -> bytes:
    return (ready / f"{episode_entry(0)}.json").read_bytes()


def test_every_hostile_copy_of_a_record_is_refused_in_one_line_or_valid(entry, tmp_path):
    (tmp_path / "manifest").mkdir()
    path = tmp_path / f"{episode_entry(0)}.json"
    refusals = 0
    for description, content in hostile_contents(entry):
        path.write_bytes(content)
        try:
            check_entry(tmp_path)
        except DatasetError as error:
            refusals += 1
            check_line(error, f"{description}: ", "; remove manifest/000000.json and manifest/000000.sha256, and resume")
    assert refusals > 500


@examples(max_examples=fuzz_examples(200), deadline=None)
@given(st.data())
def test_attempts_of_any_content_are_refused_in_one_line_or_valid(entry, tmp_path_factory, data):
    folder = tmp_path_factory.getbasetemp() / "attempts"
    (folder / "manifest").mkdir(parents=True, exist_ok=True)
    attempt = ATTEMPT | {"episode": 0}
    json_values = st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
        lambda children: st.lists(children, max_size=3) | st.dictionaries(st.text(max_size=5), children, max_size=3),
        max_leaves=6,
    )
    for _ in range(data.draw(st.integers(1, 3))):
        place = data.draw(st.sampled_from(list(places(attempt))))
        value = data.draw(st.sampled_from(LEAVES) | json_values)
        try:
            attempt = replaced(attempt, place, value)
        except (KeyError, IndexError, TypeError):
            continue  # An earlier value took the place away.
    content = json.loads(entry) | {"attempts": [attempt]}
    (folder / f"{episode_entry(0)}.json").write_text(json.dumps(content))
    try:
        check_entry(folder)
    except DatasetError as error:
        check_line(error)


def check_entry(folder: Path) -> None:
    """Read an entry as a resumed bake does."""
    from synpick_warp.factory.episodes import BakeSummary

    content = read_entry(folder, episode_entry(0))
    assert content is not None
    BakeSummary().take_record(content)
    for row in ({**content["row"], "checksum": content["checksum"]}, *content["attempts"]):
        assert json.loads(json.dumps(row, allow_nan=False)) == row


@pytest.mark.parametrize("last", ["/etc/passwd", "/x", "a/..", "..", "link", "a/link"])
def test_a_name_is_checked_after_others_of_its_folder_too(tmp_path, last):
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to("..")
    (tmp_path / "a" / "link").symlink_to("../..")
    lines = "".join(f"{'0' * 64}  {name}\n" for name in ("first", "a/first", last))
    with pytest.raises(DatasetError, match="line 3"):
        parse_checksums(lines.encode(), tmp_path, Path("LIST"), "ADVICE")
