"""Manifest of a data set: settings that must match on resume, messages about differences, and completeness of entries."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator
from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.codes import Ending
from synpick_warp.configs.episodes.randomize import FIXED, Distribution
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import load_config, sections
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Config
from synpick_warp.dataset.commit import manifest
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.writing import commit_episode, digest_inputs
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.checksums import list_files, write_manifest_entry
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import CatalogEntry, ConvexPiece, EnvironmentMap, Material, Sun, TriangleMesh
from synpick_warp.views.frames import EpisodeEnd
from tests.harness import scripted_bake
from tests.harness.entries import episode_content
from tests.worlds.small_worlds import catalog, settings

CONFIG = settings()
MANIFEST = manifest.make_manifest(CONFIG)


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


@pytest.mark.parametrize("key", list(keys()))
def test_every_setting_binds_but_the_free_ones(key):
    said = manifest.describe_differences(manifest.make_manifest(changed(key)), MANIFEST)
    assert said.startswith(f"{key} is ") if key not in manifest.FREE_SETTINGS else said == ""


def test_free_settings_exist():
    assert set(manifest.FREE_SETTINGS) <= set(keys())


def test_the_order_of_formats_is_of_no_account():
    one, two = (manifest.make_manifest(settings(bake__formats=given)) for given in (["zarr", "bop"], ["bop", "zarr", "bop"]))
    assert one == two


def test_a_table_of_objects_binds(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text('preset = "smoke"\n[[object_rows]]\nid = 1\ndiameter = 0.1\n')
    assert manifest.make_manifest(load_config(str(path), {})) != manifest.make_manifest(load_config("smoke", {}))


def test_versions_bind():
    versions = MANIFEST["versions"]
    assert all(versions.values())
    later = MANIFEST | {"versions": versions | {"newton": "1.9.0"}}
    assert manifest.describe_differences(later, MANIFEST) == f'versions.newton is "1.9.0", there "{versions["newton"]}"'


def test_a_manifest_comes_back(tmp_path):
    (tmp_path / manifest.MANIFEST_FILE).write_bytes(manifest.encode_manifest(MANIFEST))
    assert manifest.read_manifest(tmp_path) == MANIFEST
    assert MANIFEST["seed"] == 0


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
def test_manifests_that_are_none(tmp_path, text, said):
    (tmp_path / manifest.MANIFEST_FILE).write_text(text)
    with pytest.raises(DatasetError, match=said):
        manifest.read_manifest(tmp_path)


def test_inputs_are_known_by_their_content():
    known = digest_inputs(catalog(), skies())
    assert known == digest_inputs(catalog(), skies())
    entry = catalog().entries[1]
    heavier = dataclasses.replace(catalog(), entries=(*catalog().entries[:1], dataclasses.replace(entry, mass=9.0), *catalog().entries[2:]))
    assert digest_inputs(heavier, skies())["objects"] != known["objects"]
    brighter = (dataclasses.replace(skies()[0], radiance=skies()[0].radiance * np.float32(2)), *skies()[1:])
    digests = digest_inputs(catalog(), brighter)
    assert (digests["objects"], digests["lights"] != known["lights"]) == (known["objects"], True)


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


def test_merge_and_resume_name_the_objects_that_differ(tmp_path, monkeypatch):
    config, parts = scripted_bake.small_settings(), [tmp_path / "a", tmp_path / "b"]
    for number, part in enumerate(parts):
        digests = {"objects": 64 * f"{number}", f"{manifest.OBJECT}7: box 7": 64 * f"{number}"}
        monkeypatch.setattr(scripted_bake, "INPUTS", scripted_bake.INPUTS | digests | {f"{manifest.OBJECT}3: box 3": 64 * "3"})
        scripted_bake.bake(part, config, shard=(number, 2))
    with pytest.raises(DatasetError, match=rf"{parts[1]} was made with other objects \(7: box 7\) than {parts[0]}; only parts"):
        merge(parts, tmp_path / "set")
    assert not (tmp_path / "set").exists()
    with pytest.raises(ConfigError, match=rf"{parts[0]} was started with other objects \(7: box 7\); "):
        scripted_bake.bake(parts[0], config)


def test_field_names_that_every_manifest_depends_on():
    """Digests hash them, but for fields with hash=False: renaming one would make every data set refuse to be resumed."""
    names = {
        kind.__name__: [item.name for item in dataclasses.fields(kind) if item.hash is not False]
        for kind in (CatalogEntry, ConvexPiece, EnvironmentMap)
    }
    assert names == {
        "CatalogEntry": [
            "obj_id",
            "name",
            "mesh",
            "material",
            "pieces",
            "volume",
            "radius",
            "mass",
            "center_of_mass",
            "inertia",
            "diameter",
            "symmetries_discrete",
            "symmetries_continuous",
            "source",
        ],
        "ConvexPiece": ["vertices", "faces"],
        "EnvironmentMap": ["name", "radiance", "sun"],
    }
    assert [item.name for item in dataclasses.fields(Material)] == ["color", "texture", "metallic", "roughness"]
    assert [item.name for item in dataclasses.fields(TriangleMesh)] == ["vertices", "faces", "normals", "uv"]
    assert [item.name for item in dataclasses.fields(Sun)] == ["direction", "irradiance"]


def test_a_record_has_every_file_once_and_is_whole_while_they_are_there(tmp_path):
    (tmp_path / "a" / "deep").mkdir(parents=True)
    (tmp_path / "manifest").mkdir()
    for name in ("a/deep/two", "a/one", "three"):
        (tmp_path / name).write_text(name)
    place = manifest.episode_entry(7)
    given = [manifest.Path("three"), manifest.Path("a"), manifest.Path("a/one")]
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
    exporters = SimpleNamespace(files=lambda _: [manifest.Path(name) for name in names])
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
    write_manifest_entry(tmp_path, place, [manifest.Path("file")], {})
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
