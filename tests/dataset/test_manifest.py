"""Manifest of a data set: settings that must match on resume, messages about differences, completeness of entries, checksum lists, and
their verification."""

import dataclasses
import hashlib
import json
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as examples
from hypothesis import strategies as st

from synpick_warp.codes import Ending
from synpick_warp.configs.episodes.randomize import FIXED, Distribution
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import config_to_toml, load_config, sections
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest, verify
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.writing import commit_episode, digest_inputs
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.files import PARTIAL, checksum, list_files, parse_checksums, write_manifest_entry
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import CatalogEntry, ConvexPiece, EnvironmentMap, Finish, Material, Sun, TriangleMesh
from synpick_warp.system.processes import pool
from synpick_warp.system.processes.pool import ProcessError
from synpick_warp.views.frames import EpisodeEnd
from tests.builders import mistake
from tests.harness import scripted_bake
from tests.harness.hostile import fuzz_examples
from tests.worlds.box_sets import episode_content
from tests.worlds.small_worlds import catalog, settings

CONFIG = settings()
MANIFEST = manifest.make_manifest(CONFIG)
HASHED = (CatalogEntry, ConvexPiece, EnvironmentMap, Material, TriangleMesh, Sun)


def changed(key: str) -> Config:
    """Settings that differ from CONFIG in one value."""
    section, name = key.split(".")
    part = getattr(CONFIG, section)
    return dataclasses.replace(CONFIG, **{section: dataclasses.replace(part, **{name: other(getattr(part, name))})})


def other(value: object) -> object:
    if value is None:
        return 1.0
    if isinstance(value, bool):
        return not value
    if isinstance(value, Distribution):
        return type(value)(FIXED, ((0.75,) * value.components,), (1.0,))
    if isinstance(value, tuple):
        return (other(value[0]), *value[1:]) if value else ("x",)
    return f"{value}x" if isinstance(value, str) else value + 1  # type: ignore[operator]


def keys() -> Iterator[str]:
    for section, kind in sections().items():
        yield from (f"{section}.{name}" for name in settings_of(kind))


def test_every_setting_binds_but_the_free_ones():
    for key in {*keys(), *manifest.FREE_SETTINGS}:
        said = manifest.describe_differences(manifest.make_manifest(changed(key)), MANIFEST)
        assert said.startswith(f"{key} is ") if key not in manifest.FREE_SETTINGS else said == "", key


def test_tables_of_objects_and_versions_bind_and_the_order_of_formats_is_of_no_account(tmp_path):
    one, two = (manifest.make_manifest(settings(bake__formats=given)) for given in (["zarr", "bop"], ["bop", "zarr", "bop"]))
    assert one == two
    path = tmp_path / "my.toml"
    path.write_text('preset = "smoke"\n[[object_rows]]\nid = 1\ndiameter = 0.1\n')
    assert manifest.make_manifest(load_config(str(path), {})) != manifest.make_manifest(load_config("smoke", {}))
    versions = MANIFEST["versions"]
    assert all(versions.values())
    later = MANIFEST | {"versions": versions | {"newton": "1.9.0"}}
    assert manifest.describe_differences(later, MANIFEST) == f'versions.newton is "1.9.0", there "{versions["newton"]}"'


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "is damaged"),
        ("[]", "is damaged: expected object, got array; restore the file, or bake again into another folder"),
        ('{"format": 9}', "has the format 9; this version reads 1"),
        ('{"format": 1, "settings": {}, "settings_checksum": "0", "seed": 0, "versions": {}}', "changed by hand"),
        ('{"format": 1, "settings": {}, "settings_checksum": "0", "seed": "x", "versions": {}}', r"expected int, got str - at \$\.seed"),
        ('{"format": 1, "settings": {"bake": NaN}}', "is damaged"),
    ],
)
def test_a_manifest_comes_back_and_others_are_refused(tmp_path, text, said):
    (tmp_path / manifest.MANIFEST_FILE).write_bytes(manifest.encode_manifest(MANIFEST))
    assert manifest.read_manifest(tmp_path) == MANIFEST
    (tmp_path / manifest.MANIFEST_FILE).write_text(text)
    with pytest.raises(DatasetError, match=said):
        manifest.read_manifest(tmp_path)


def test_inputs_are_known_by_their_content():
    known = digest_inputs(catalog(), skies())
    assert known == digest_inputs(catalog(), skies())
    first, entry, *others = catalog().entries
    heavier = digest_inputs(dataclasses.replace(catalog(), entries=(first, dataclasses.replace(entry, mass=9.0), *others)), skies())
    sky, *rest = skies()
    brighter = digest_inputs(catalog(), (dataclasses.replace(sky, radiance=sky.radiance * np.float32(2)), *rest))
    changes = [(digests["objects"] != known["objects"], digests["lights"] != known["lights"]) for digests in (heavier, brighter)]
    assert changes == [(True, False), (False, True)]
    materials = [dataclasses.replace(entry.material, emission=(1.0, 0.5, 0.0), glow=glow) for glow in (None, np.zeros((2, 2, 3), np.uint8))]
    materials.append(dataclasses.replace(entry.material, finish=Finish(clearcoat=0.5)))
    lit = [dataclasses.replace(catalog(), entries=(first, dataclasses.replace(entry, material=each), *others)) for each in materials]
    shining, textured, coated = (digest_inputs(each, skies()) for each in lit)
    assert [manifest.describe_inputs(known, shining), manifest.describe_inputs(shining, textured)] == ["emission (2: boxes_2)"] * 2
    assert manifest.describe_inputs(known, coated) == "finish (2: boxes_2)"


def test_inputs_that_differ_are_named_with_their_objects():
    """Those of older manifests, which have one digest of all objects, by their kind."""
    known = digest_inputs(catalog(), skies())
    first, *others = catalog().entries
    hull = dataclasses.replace(first, pieces=(dataclasses.replace(first.pieces[0], vertices=first.pieces[0].vertices + np.float32(1e-6)),))
    other = digest_inputs(dataclasses.replace(catalog(), entries=(hull, *others[1:])), skies()[:1])
    assert manifest.describe_inputs(known, other) == "objects and lights (1: boxes_1, 2: boxes_2)"
    older = {name: digest for name, digest in known.items() if not name.startswith(manifest.OBJECT)}
    assert set(older) == {"objects", "lights"}
    assert manifest.describe_inputs(other, older) == manifest.describe_inputs(older, other) == "objects and lights"
    assert manifest.describe_inputs(older, known) == manifest.describe_inputs(known, known) == ""


def test_merge_and_resume_name_the_objects_and_settings_that_differ(tmp_path, monkeypatch):
    config, parts = scripted_bake.small_settings(), [tmp_path / "a", tmp_path / "b"]
    for number, part in enumerate(parts):
        digests = {"objects": 64 * f"{number}", f"{manifest.OBJECT}7: box 7": 64 * f"{number}"}
        monkeypatch.setattr(scripted_bake, "INPUTS", scripted_bake.INPUTS | digests | {f"{manifest.OBJECT}3: box 3": 64 * "3"})
        scripted_bake.bake(part, config, shard=(number, 2))
    with pytest.raises(DatasetError, match=rf"{parts[1]} was made with other objects \(7: box 7\) than {parts[0]}; only parts"):
        merge(parts, tmp_path / "set")
    scripted_bake.bake(other := tmp_path / "other", config.with_values({"bake.seed": 1}), shard=(0, 2))
    with pytest.raises(DatasetError, match=r"was made with other settings than .*: bake.seed is 1, there 0"):
        merge([parts[1], other], tmp_path / "set")
    assert not (tmp_path / "set").exists()
    with pytest.raises(ConfigError, match=rf"{parts[0]} was started with other objects \(7: box 7\); "):
        scripted_bake.bake(parts[0], config)


def test_field_names_that_every_manifest_depends_on():
    """Digests hash them, but for fields with hash=False: renaming one would make every data set refuse to be resumed."""
    names = {kind.__name__: " ".join(item.name for item in dataclasses.fields(kind) if item.hash is not False) for kind in HASHED}
    assert names == {
        "CatalogEntry": "obj_id name mesh material pieces volume radius mass center_of_mass inertia diameter"
        " symmetries_discrete symmetries_continuous source",
        "ConvexPiece": "vertices faces",
        "EnvironmentMap": "name radiance sun",
        "Material": "color texture metallic roughness",
        "TriangleMesh": "vertices faces normals uv",
        "Sun": "direction irradiance",
    }


def test_a_record_has_every_file_once_and_is_whole_while_they_are_there(tmp_path):
    (tmp_path / "a" / "deep").mkdir(parents=True)
    (tmp_path / "manifest").mkdir()
    for name in ("a/deep/two", "a/one", "three"):
        (tmp_path / name).write_text(name)
    place = manifest.episode_entry(7)
    given = [Path("three"), Path("a"), Path("a/one")]
    assert list_files(tmp_path, given) == ["a/deep/two", "a/one", "three"]
    assert not manifest.is_complete(tmp_path, place)
    write_manifest_entry(tmp_path, place, given, episode_content(7, frames=3))
    record = manifest.read_entry(tmp_path, place)
    assert record is not None
    assert (record["row"]["frames"], record["files"], record["bytes"]) == (3, 3, 20)
    assert list(manifest.read_checksums(tmp_path, place)) == ["a/deep/two", "a/one", "three"]
    assert manifest.committed_episodes(tmp_path) == [7]
    assert manifest.is_complete(tmp_path, place)
    (tmp_path / "a/one").write_text("longer")
    assert not manifest.is_complete(tmp_path, place)
    (tmp_path / "a/one").unlink()
    assert not manifest.is_complete(tmp_path, place)


@pytest.mark.parametrize("names", [[], ["a"], ["b", "a", "a/one"]])
@pytest.mark.parametrize("writers", [0, 2])
def test_an_episode_is_committed_whatever_files_it_has(tmp_path, names, writers):
    """Each file or folder has its own writer task. An episode that was given up has no files; a file named twice is listed once."""
    for folder in ("a", "manifest", PARTIAL):
        (tmp_path / folder).mkdir()
    for name in ("a/two", "a/one", "b"):
        (tmp_path / name).write_text(name)
    exporters = SimpleNamespace(files=lambda _: [Path(name) for name in names])
    content = episode_content(7)
    with WriterPool(writers, 1) as pool:
        commit_episode(tmp_path, exporters, pool, EpisodeEnd(7, 0, 3, Ending.FINISHED, content["row"]))  # type: ignore[arg-type]
        pool.wait()
    files = {name: name for name in ("a/one", "a/two", "b") if name in names or ("a" in names and name.startswith("a/"))}
    known = manifest.read_checksums(tmp_path, manifest.episode_entry(7))
    assert known == {name: hashlib.sha256(text.encode()).hexdigest() for name, text in files.items()}
    record = manifest.read_entry(tmp_path, manifest.episode_entry(7))
    assert record is not None
    assert (record["files"], record["bytes"]) == (len(files), sum(map(len, files)))
    assert list((tmp_path / PARTIAL).iterdir()) == []


def test_a_list_that_does_not_fit_its_record(tmp_path):
    (tmp_path / "manifest").mkdir()
    (tmp_path / "file").write_text("x")
    place = manifest.CONSTANTS
    write_manifest_entry(tmp_path, place, [Path("file")], {})
    path = tmp_path / "manifest" / "constants.sha256"
    path.write_text(path.read_text().replace("file", "elif"))
    with pytest.raises(DatasetError, match="does not match"):
        manifest.read_checksums(tmp_path, place)
    assert json.loads((tmp_path / "manifest" / "constants.json").read_text())["files"] == 1


def test_data_sets_from_before_a_setting_are_read_with_what_held_then(tmp_path):
    """Their manifest and config.toml lack arrangement.fill, whose value then was `within`, not the default."""
    config = settings(arrangement__fill="within")
    content = manifest.make_manifest(config)
    assert "fill" not in content["settings"]["arrangement"]
    lines = config_to_toml(config).splitlines()
    (tmp_path / "config.toml").write_text("\n".join(line for line in lines if not line.startswith("fill")) + "\n")
    assert manifest.read_settings(tmp_path, content).arrangement.fill == "within"
    assert MANIFEST["settings"]["arrangement"]["fill"] == "exceed"


# ---- checksum lists ----


@pytest.mark.parametrize("line", ["x", f"{64 * '0'} *train", f"{64 * 'g'}  a", f"{63 * '0'}  a", f"{64 * '0'}  ", f"{64 * '0'}  a\n", "\n"])
def test_lines_that_are_no_digest_and_name(tmp_path, line):
    with pytest.raises(DatasetError, match=r"LIST, line \d, is damaged: it is not a SHA-256 and a name; ADVICE"):
        parse_checksums(f"{64 * '1'}  b\n{line}\n".encode(), tmp_path, Path("LIST"), "ADVICE")


ODD_NAMES = ("../x", "/x", "a/../../x", "out/x", "a/..", ".", "a//b", "a/./b", "b", "manifest.json", "manifest/000000.json", ".partial/x")
ODD_NAMES += ("a\x1bb", "/etc/passwd", "..", "out", "a/link")


@pytest.mark.parametrize("before", [("b",), ("b", "a/first")])
@pytest.mark.parametrize("name", ODD_NAMES)
def test_names_that_no_list_has(tmp_path, name, before):
    """Whether others of their folder come before them or not."""
    folder = tmp_path / "in"
    (folder / "a").mkdir(parents=True)
    (folder / "out").symlink_to(tmp_path)
    (folder / "a" / "link").symlink_to("../..")
    lines = "".join(f"{64 * '0'}  {each}\n" for each in (*before, name))
    with pytest.raises(DatasetError, match=f"LIST, line {len(before) + 1},"):
        parse_checksums(lines.encode(), folder, Path("LIST"), "ADVICE")


def test_files_that_are_links_have_no_checksum(tmp_path):
    (tmp_path / "file").write_text("x")
    (tmp_path / "link").symlink_to("file")
    assert checksum(tmp_path / "file") == hashlib.sha256(b"x").hexdigest()
    with pytest.raises(OSError, match="it is a symbolic link"):
        checksum(tmp_path / "link")
    with pytest.raises(OSError, match="it is not a regular file"):
        checksum(tmp_path)


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
        assert str(error).isprintable()  # noqa: PT017
    else:
        assert all((folder / name).resolve().is_relative_to(folder.resolve()) and (folder / name).resolve() != folder for name in known)


# ---- verification, whose verdict is the same with any number of processes ----

EPISODES, FILES = 4, 7
TOTAL = 1 + EPISODES * FILES
"""Number of files, including the one that all episodes share."""
THREADS = [1, 3]


@pytest.fixture
def out(tmp_path, monkeypatch) -> Path:
    """Data set of EPISODES episodes with FILES files each; the minimum work per process is lowered, so that `verify` uses all `threads`."""
    monkeypatch.setattr(verify, "_FILES_PER_PROCESS", 1)
    (tmp_path / manifest.MANIFEST_FILE).write_bytes(manifest.encode_manifest(manifest.make_manifest(CONFIG)))
    (tmp_path / manifest.CONFIG_FILE).write_text(config_to_toml(CONFIG))
    (tmp_path / "manifest").mkdir()
    write_files(tmp_path, manifest.CONSTANTS, ["models/obj_000001.ply"], {})
    for episode in range(EPISODES):
        write_files(
            tmp_path, manifest.episode_entry(episode), [name(episode, each) for each in range(FILES)], episode_content(episode, FILES)
        )
    return tmp_path


def name(episode: int, file: int) -> str:
    return f"train/{len(CONFIG.cameras.positions) * episode:06d}/rgb/{file:06d}.jpg"


def write_files(out: Path, entry: Path, names: list[str], content: dict) -> None:
    for each in names:
        (out / each).parent.mkdir(parents=True, exist_ok=True)
        (out / each).write_text(each)
    write_manifest_entry(out, entry, [Path(each) for each in names], content)


@pytest.mark.parametrize("threads", THREADS)
def test_all_files_are_counted(out, threads):
    seen = []
    verdict = verify.verify(out, threads, lambda *progress: seen.append(progress))
    assert verdict == ("", EPISODES, TOTAL, False)
    assert {(unit, total) for unit, _, total in seen} == {("files", TOTAL)}
    done = [done for _, done, _ in seen]
    assert done == sorted(done)
    assert set(done) >= {1 + episode * FILES for episode in range(1 + EPISODES)}


@pytest.mark.parametrize("threads", THREADS)
def test_of_several_damaged_files_or_links_the_first_is_named(out, threads):
    (out / name(3, 0)).unlink()
    (out / name(1, 6)).write_text("other")
    (out / name(2, 1)).unlink()
    verdict = verify.verify(out, threads)
    assert verdict.problem == f"{out / name(1, 6)} has changed since it was written: its checksum differs"
    assert verdict.files == 1 + 2 * FILES
    (out / name(0, 1)).rename(out / name(0, 1).replace(".jpg", ".moved"))
    (out / name(0, 1)).symlink_to(out / name(0, 1).replace(".jpg", ".moved"))
    assert "symbolic link" in verify.verify(out, threads).problem


@pytest.mark.parametrize("threads", THREADS)
@pytest.mark.parametrize("damage", ["list", "no list", "entry"])
def test_a_damaged_list_is_said_after_the_files_before_it(out, threads, damage):
    path = out / f"manifest/000002.{'json' if damage == 'entry' else 'sha256'}"
    if damage == "no list":
        path.unlink()
    else:
        path.write_text("")
    (out / name(3, 0)).unlink()
    verdict = verify.verify(out, threads)
    assert str(path) in verdict.problem
    assert verdict.files == 1 + 2 * FILES
    (out / name(1, 2)).unlink()
    assert verify.verify(out, threads).problem == f"{out / name(1, 2)} is missing"


def test_few_small_files_are_read_by_the_calling_process(out, monkeypatch):
    monkeypatch.undo()
    monkeypatch.setattr(pool, "start_process", None)
    assert verify.verify(out, 8).files == TOTAL


def test_another_data_set_in_the_same_folder_has_settings_of_its_own(tmp_path):
    for formats in (("bop",), ("usd",)):
        scripted_bake.bake(tmp_path / "set", scripted_bake.settings(1, formats))
        assert verify.verify(tmp_path / "set").problem == ""
        shutil.rmtree(tmp_path / "set")


@pytest.mark.parametrize("moment", ["before the data set", "with a task"])
def test_a_process_that_dies_is_one_line(out, monkeypatch, capfd, moment):
    tell = pool.WorkerPool._send

    def tell_and_kill(self, worker, message):
        if (not worker.tasks) == (moment == "before the data set"):
            os.kill(worker.process.pid, signal.SIGKILL)
            worker.process.wait()
        tell(self, worker, message)

    monkeypatch.setattr(pool.WorkerPool, "_send", tell_and_kill)
    with pytest.raises(ProcessError, match="a process that verifies was ended by SIGKILL; if memory ran out, set --threads"):
        verify.verify(out, 2)
    assert "was ended by SIGKILL" in mistake("verify", out, "--threads", 2)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("threads", ["-1", "1025", "x"])
def test_other_numbers_of_processes_are_refused(out, threads):
    assert "--threads is" in mistake("verify", out, "--threads", threads)
