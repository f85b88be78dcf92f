"""Hostile data sets: edited, damaged or made by somebody else; resume, verify and merge neither read, write nor remove outside of them. By
known faults, and by fuzz: any record, checksum list, scene or shard ends in one line."""

import errno
import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given
from hypothesis import settings as examples
from hypothesis import strategies as st

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.commit.manifest import episode_entry, read_checksums, read_entry
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.errors import OutputError, SynpickError
from synpick_warp.exporters.bop import shared
from synpick_warp.exporters.bop.shards import list_keys
from synpick_warp.exporters.registry import load_exporter_classes, shared_files
from synpick_warp.exporters.writing.files import check_output_folder
from synpick_warp.factory.episodes import BakeSummary
from tests.harness.hostile import LEAVES, WHOLE, fuzz_examples, hostile_contents, places, replaced
from tests.harness.scripted_bake import ATTEMPT, bake, make_victim, small_settings, snapshot

CONFIG = small_settings()
SECONDS = 5.0
"""Longest time of a command on a hostile data set."""
COMMANDS: dict[str, Callable[[Path, Path], object]] = {
    "verify": lambda data_set, _: verify(data_set),
    "merge": lambda data_set, out: merge([data_set], out),
    "bake": lambda data_set, _: bake(data_set, CONFIG),
}
RECORDS = (
    "manifest.json",
    *(f"manifest/{name}.{kind}" for name in ("constants", "000000", "000001", "joined") for kind in ("json", "sha256")),
)


@pytest.fixture(scope="module")
def ready(tmp_path_factory) -> Path:
    """A finished data set."""
    bake(out := tmp_path_factory.mktemp("ready") / "set", CONFIG)
    return out


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


def uncommit(data_set: Path, episode: int) -> None:
    """Remove an episode's entry and list, so that a resumed bake makes it again."""
    for suffix in (".json", ".sha256"):
        (data_set / f"{episode_entry(episode)}{suffix}").unlink()


def refused(command: Callable[[], object], said: str = "") -> None:
    """The command ends at once with an error of one line."""
    started = time.monotonic()
    with pytest.raises(SynpickError, match=said) as caught:
        command()
    assert time.monotonic() - started < SECONDS
    assert str(caught.value).isprintable()


@contextmanager
def fine_or_one_line(case: str = "", advice: str = "") -> Iterator[list[Exception]]:
    """What is within succeeds, or ends with an error of one line that has this advice; collects the error."""
    errors: list[Exception] = []
    try:
        yield errors
    except SynpickError as error:
        errors.append(error)
        assert str(error).isprintable(), case  # noqa: PT017
        assert advice in str(error), case  # noqa: PT017


# ---- removal ----


def test_an_edited_list_of_indices_removes_nothing_outside_of_the_set(copied, ready):
    before = snapshot(copied.parent / "victim")
    uncommit(copied, 1)
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
    uncommit(out, 0)
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


def test_a_bake_without_an_episode_removes_what_it_wrote_and_no_hidden_file(tmp_path):
    (tmp_path / ".git" / "empty").mkdir(parents=True)
    (tmp_path / ".git" / "HEAD").write_text("ref")
    before = snapshot(tmp_path)
    for out in (tmp_path, tmp_path / "new" / "set"):
        bake(out, CONFIG, stop_after=0)
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
    uncommit(out, 0)
    bake(out, CONFIG, stop_after=0)
    assert (out / "mine" / "empty").is_dir()
    assert (out / "train" / "notes").is_dir()
    bake(out, CONFIG)
    assert verify(out).finished
    assert (out / "mine" / "empty").is_dir()


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
    uncommit(copied, 1)
    bake(copied, CONFIG)
    assert snapshot(copied) == snapshot(ready)


@pytest.mark.parametrize("seed", [1, "x", None, 0.5, True])
def test_a_changed_seed_in_the_manifest_is_refused(copied, seed):
    path = copied / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_bytes()) | {"seed": seed}, indent=2) + "\n")
    for command in COMMANDS.values():
        refused(lambda command=command: command(copied, copied.parent / "merged"), "seed")


def test_a_planned_number_of_episodes_that_is_absurd_does_not_hang(copied, ready):
    path = copied / "config.toml"
    path.write_text(path.read_text().replace("episodes = 2", "episodes = 1000000000000"))
    refused(lambda: merge([copied], copied.parent / "merged"), "episodes")
    (copied / "manifest" / "000001.json").unlink()
    bake(copied, CONFIG)
    assert snapshot(copied) == snapshot(ready)


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


# ---- fuzz ----


@examples(max_examples=fuzz_examples(100), deadline=None)
@given(st.data())
def test_damaged_scenes_are_one_line_or_targets(ready, tmp_path_factory, data):
    scene = tmp_path_factory.mktemp("scene") / "000000"
    scene.mkdir()
    places = str(scene.parent / shared.BOP19), str(scene.parent / shared.BOP24)
    for place in places:
        Path(place).mkdir()
    for name in ("scene_gt.json", "scene_gt_info.json"):
        shutil.copy(ready / "train" / "000000" / name, scene)
    path = scene / data.draw(st.sampled_from(["scene_gt.json", "scene_gt_info.json"]))
    path.write_bytes(draw_hostile(data, path.read_bytes()))
    with fine_or_one_line():
        shared.write_scene_targets(scene, places, 0.1)


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
    with fine_or_one_line():
        list_keys(shard, folder / "keys")


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
    unreadable = suppress(ValueError, KeyError, TypeError, RecursionError, OSError)
    path = data_set / "manifest.json"
    with unreadable:
        content = json.loads(path.read_bytes())
        settings_ = json.dumps(content["settings"], sort_keys=True).encode()
        path.write_text(json.dumps(content | {"settings_checksum": hashlib.sha256(settings_).hexdigest()}))
    for entry in (data_set / "manifest").glob("*.json"):
        with unreadable:
            content = json.loads(entry.read_bytes())
            digest = hashlib.sha256(entry.with_suffix(".sha256").read_bytes()).hexdigest()
            entry.write_text(json.dumps(content | {"checksum": digest}))


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
    for command in ("verify", "merge", "bake", "verify"):
        started = time.monotonic()
        with fine_or_one_line():
            COMMANDS[command](data_set, root / "merged")
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
    refusals: list[Exception] = []
    for description, content in hostile_contents(entry):
        path.write_bytes(content)
        with fine_or_one_line(description, "; remove manifest/000000.json and manifest/000000.sha256, and resume") as errors:
            check_entry(tmp_path)
        refusals += errors
    assert len(refusals) > 500


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
    with fine_or_one_line():
        check_entry(folder)


def check_entry(folder: Path) -> None:
    """Read an entry as a resumed bake does."""
    content = read_entry(folder, episode_entry(0))
    assert content is not None
    BakeSummary().take_record(content)
    for row in ({**content["row"], "checksum": content["checksum"]}, *content["attempts"]):
        assert json.loads(json.dumps(row, allow_nan=False)) == row
