"""The object catalog: BOP folders, other meshes, mass properties, and errors."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.distance import cdist

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Arrangement, Bake, Config, ObjectRow, Objects, Tote
from synpick_warp.errors import CatalogError
from synpick_warp.scenes import catalog as catalogs
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.collision import hulls
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import CatalogEntry
from tests.worlds.model_files import REAL_HULLS, exported, glb, heard, load_models, put

REAL_CONCAVE = {13, 14, 15}


def config_for(folder: Path, rows: tuple[ObjectRow, ...] = (), **objects) -> Config:
    return Config(bake=Bake(models=str(folder)), objects=Objects(**objects), object_rows=rows)


def write_box(file: Path, extents=(0.1, 0.1, 0.1), offset=(0.0, 0.0, 0.0)) -> Path:
    """In metres, or in millimetres for names of BOP models."""
    box = trimesh.creation.box(np.array(extents) * (1000 if file.name.startswith("obj_") else 1))
    box.apply_translation(offset)
    return put(file, exported(box, file.suffix[1:]))


def write_info(folder: Path, content) -> None:
    (folder / "models_info.json").write_text(content if isinstance(content, str) else json.dumps(content))


def load(config: Config, cache: Path) -> tuple[CatalogEntry, ...]:
    return load_catalog(config, cache / "cache").entries


def assert_physical(entry: CatalogEntry) -> None:
    low, middle, high = np.linalg.eigvalsh(entry.inertia)
    assert low > 0.0
    assert low + middle >= high
    assert np.array_equal(entry.inertia, entry.inertia.T)
    assert entry.mass > 0.0
    assert entry.volume > 0.0
    assert entry.diameter / 2 <= entry.radius * (1 + 1e-6)


def test_a_bop_folder_in_millimetres(tmp_path):
    write_box(tmp_path / "obj_000007.ply", (0.1, 0.2, 0.3))
    write_box(tmp_path / "obj_000002.ply", (0.1, 0.1, 0.1))
    turn = [-1, 0, 0, 10, 0, -1, 0, 20, 0, 0, 1, 30, 0, 0, 0, 1]
    write_info(
        tmp_path,
        {
            "2": {"diameter": 173.2, "symmetries_continuous": [{"axis": [0, 0, 2], "offset": [0, 5, 0]}]},
            "7": {"symmetries_discrete": [np.eye(4).ravel().tolist(), turn]},
            "9": {"diameter": -1},
        },
    )
    two, seven = load(config_for(tmp_path), tmp_path)
    assert (two.obj_id, seven.obj_id) == (2, 7)
    assert two.name == "obj_000002"
    assert two.source == tmp_path / "obj_000002.ply"
    assert seven.volume == pytest.approx(6e-3)
    assert seven.mass == pytest.approx(400.0 * 6e-3)
    assert seven.diameter == pytest.approx(np.sqrt(0.14))
    assert seven.radius == pytest.approx(np.sqrt(0.14) / 2)
    assert np.allclose(np.diag(seven.inertia), 2.4 / 12 * np.array((0.13, 0.10, 0.05)))
    assert seven.center_of_mass == pytest.approx((0.0, 0.0, 0.0), abs=1e-9)
    assert seven.symmetries_discrete == ((-1, 0, 0, 0.01, 0, -1, 0, 0.02, 0, 0, 1, 0.03, 0, 0, 0, 1),)
    assert two.symmetries_continuous == (((0.0, 0.0, 1.0), (0.0, 0.005, 0.0)),)
    assert (two.material.metallic, two.material.roughness) == (0.1, 0.5)
    assert_physical(two)


def test_a_row_applies_if_id_and_diameter_agree(tmp_path):
    for obj_id in (1, 2, 3):
        write_box(tmp_path / f"obj_{obj_id:06d}.ply")
    size = 0.1 * np.sqrt(3)
    rows = (
        ObjectRow(id=1, name="near", diameter=1.09 * size, mass=0.3, metallic=0.9, roughness=0.2),
        ObjectRow(id=2, name="far", diameter=1.2 * size, mass=0.4),
        ObjectRow(id=3, name="any size", mass=0.5),
    )
    one, two, three = load(config_for(tmp_path, rows), tmp_path)
    assert (one.name, one.mass, one.material.metallic, one.material.roughness) == ("near", 0.3, 0.9, 0.2)
    assert (two.name, two.mass) == ("obj_000002", pytest.approx(0.4))
    assert (three.name, three.mass) == ("any size", 0.5)


def test_meshes_that_are_not_bop_models_are_in_metres(tmp_path):
    write_box(tmp_path / "b.ply", (0.1, 0.2, 0.3))
    write_box(tmp_path / "a.obj")
    put(tmp_path / "c.glb", glb(trimesh.creation.icosphere(2, 0.04)))
    (tmp_path / "notes.txt").write_text("no model")
    (tmp_path / ".hidden.ply").write_text("no model")
    # These ids are only positions: rows are matched by name, not by id.
    rows = (ObjectRow(id=1, name="other", diameter=0.1732, mass=9.0), ObjectRow(id=9, name="b", mass=0.7))
    a, b, c = load(config_for(tmp_path, rows), tmp_path)
    assert [(e.obj_id, e.name, e.source) for e in (a, b, c)] == [(1, "a", None), (2, "b", None), (3, "c", None)]
    assert (a.mass, b.mass) == (pytest.approx(0.4), 0.7)
    assert b.volume == pytest.approx(6e-3)
    assert c.diameter == pytest.approx(0.08, rel=1e-3)


def test_other_meshes_beside_bop_models_are_reported_as_ignored(tmp_path):
    write_box(tmp_path / "obj_000001.ply")
    write_box(tmp_path / "spare.obj")
    catalog, lines = load_models(tmp_path, tmp_path)
    assert len(catalog) == 1
    assert any("1 meshes" in line and "ignored" in line for line in lines)


def fails(config: Config, cache: Path, *words: str) -> None:
    """Objects that cannot be used are errors; without `strict` they are left out (`test_folder_cases.py`)."""
    with pytest.raises(CatalogError) as caught:
        load_catalog(replace(config, objects=replace(config.objects, strict=True)), cache / "cache")
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def test_missing_and_empty_folders(tmp_path):
    fails(config_for(tmp_path / "gone"), tmp_path, "gone", "no such folder")
    (tmp_path / "file").write_text("")
    fails(config_for(tmp_path / "file"), tmp_path, "no such folder")
    fails(config_for(tmp_path), tmp_path, "contains no models")


def test_duplicate_objects(tmp_path):
    write_box(tmp_path / "obj_000001.ply")
    write_box(tmp_path / "obj_01.ply")
    fails(config_for(tmp_path), tmp_path, "both object 1")
    own = tmp_path / "own"
    own.mkdir()
    write_box(own / "a.ply")
    write_box(own / "a.obj")
    fails(config_for(own), tmp_path, "a.obj and a.ply have the same name; the first is used, keep one of them")


@pytest.mark.parametrize(
    ("extents", "offset", "words"),
    [
        ((100, 100, 100), (0, 0, 0), ("too large for the tote", "173.2 m", "millimetres")),
        ((1e-4, 1e-4, 1e-4), (0, 0, 0), ("0.0001732 m", "millimetres")),
        ((0.1, 0.1, 0), (0, 0, 0), ("one plane",)),
        ((0.1, 0.1, 0.1), (1, 0, 0), ("origin",)),
    ],
)
def test_wrong_sizes_and_origins(tmp_path, extents, offset, words):
    write_box(tmp_path / "thing.ply", extents, offset)
    fails(config_for(tmp_path), tmp_path, "thing", *words)


@pytest.mark.parametrize(
    ("unit", "center", "size", "said"),
    [
        ("auto", False, (0.084, 0.04, 0.012), []),
        ("m", False, (0.084, 0.04, 0.012), ["84 x 40 x 12 mm, unit m"]),
        ("cm", False, (8.4, 4, 1.2), ["84 x 40 x 12 mm, unit cm"]),
        ("in", False, (4, 2, 1), ["101.6 x 50.8 x 25.4 mm, unit in"]),
        ("mm", True, (84, 40, 12), ["84 x 40 x 12 mm, unit mm; centred: moved by -0.042, -0.02, -0.006 m"]),
        ("auto", True, (0.084, 0.04, 0.012), ["84 x 40 x 12 mm, unit m; centred: moved by -0.042, -0.02, -0.006 m"]),
        ("cm", False, (0.3, 0.3, 0.2), ["3 x 3 x 2 mm, unit cm", 'size 4.69 mm: did you mean objects.unit = "m"?']),
    ],
)
@pytest.mark.parametrize("name", ["bracket.stl", "bracket.glb", "obj_000003.ply"])
def test_units_and_centring_are_told(tmp_path, name, unit, center, size, said):
    """Of BOP models, whose poses refer to their origin, only a unit that was asked for."""
    file, is_bop = tmp_path / name, name.startswith("obj_")
    if is_bop and (center or unit == "auto"):
        pytest.skip("BOP models are in millimetres, and stay where they are")
    box = trimesh.creation.box(size)
    box.apply_translation(np.array(size) / 2)
    put(file, exported(box, file.suffix[1:]))
    catalog, lines = load_models(tmp_path, tmp_path, unit=unit, center=center)
    (entry,) = catalog.entries
    scale = {"auto": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}[unit]
    assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx(scale * np.array(size), rel=1e-5)
    assert np.allclose(entry.mesh.vertices.max(axis=0), np.array(size) * scale * (0.5 if center else 1.0))
    assert [line.partition(": ")[2] for line in lines] == said
    assert entry.source is None


@pytest.mark.parametrize(
    ("unit", "side", "advice"),
    [
        ("auto", 42.0, 'median size 72.7 m: did you mean objects.unit = "mm"?'),
        ("m", 2.5, 'median size 4.33 m: did you mean objects.unit = "cm"?'),
        ("mm", 0.06, 'median size 0.104 mm: did you mean objects.unit = "m"?'),
        ("mm", 0.8, 'median size 1.39 mm: did you mean objects.unit = "cm"?'),
    ],
)
def test_an_implausible_unit_is_told_with_a_likely_one(tmp_path, unit, side, advice):
    for name in ("a", "b", "c"):
        put(tmp_path / f"{name}.stl", exported(trimesh.creation.box((side, side, side)), "stl"))
    fails(config_for(tmp_path, unit=unit), tmp_path, advice.removeprefix("median "))
    with pytest.raises(CatalogError) as caught:
        load(config_for(tmp_path, unit=unit), tmp_path)
    assert str(caught.value).endswith(f"; {advice}")
    # One that fits does not hide it.
    put(tmp_path / "d.stl", exported(trimesh.creation.box(np.full(3, 0.05 / {"auto": 1, "m": 1, "mm": 1e-3}[unit])), "stl"))
    _, lines = load_models(tmp_path, tmp_path, unit=unit)
    assert lines[-1] == f"models folder {tmp_path}: {advice}"


@pytest.mark.parametrize("mass", [0.0, -1.0, 1e-9, 1e5, np.inf, np.nan])
def test_masses_out_of_range(tmp_path, mass):
    write_box(tmp_path / "thing.ply")
    said = f"mass {mass:g} kg in its row of the object table; allowed: 1e-07 to 10000 kg"
    fails(config_for(tmp_path, (ObjectRow(name="thing", mass=mass),)), tmp_path, "thing", said)


def test_a_density_that_gives_no_useful_mass(tmp_path):
    write_box(tmp_path / "thing.ply")
    fails(config_for(tmp_path, density=1e-12), tmp_path, "thing", "mass 1e-15 kg by objects.density")


def turned_box(file: Path, extents: tuple[float, float, float], seed: int | None) -> Path:
    """A box in a random orientation, which must not matter."""
    box = trimesh.creation.box(np.array(extents))
    if seed is not None:
        box.apply_transform(trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).uniform(size=3)))
    return put(file, exported(box))


@pytest.mark.parametrize("seed", [None, 1, 2])
@pytest.mark.parametrize(
    ("extents", "said"),
    [
        ((0.4, 0.41, 0.42), "0.4 x 0.41 x 0.42 m, diameter 0.7103 m, "),
        ((0.36, 0.37, 0.38), "0.36 x 0.37 x 0.38 m, diameter 0.641 m, "),
        ((0.02, 0.55, 0.3), ""),
        ((0.02, 0.57, 0.56), "0.02 x 0.56 x 0.57 m, "),
        ((0.7, 0.03, 0.03), "0.03 x 0.03 x 0.7 m, diameter 0.7013 m, but "),
        ((0.6, 0.03, 0.03), ""),
        ((0.54, 0.34, 0.1), ""),
        ((0.3, 0.3, 0.3), ""),
    ],
)
def test_objects_that_do_not_fit_into_the_tote(tmp_path, extents, said, seed):
    """By their minimum bounding box, in any orientation. Objects that fit come to rest in simulations."""
    write_box(tmp_path / "a.ply")
    turned_box(tmp_path / "thing.ply", extents, seed)
    if said:
        tote = "but the tote's opening is 0.352 x 0.545 m, and its inner diagonal 0.678 m; "
        fails(config_for(tmp_path), tmp_path, f"thing: too large for the tote: {said}", tote, "millimetres")
    else:
        assert len(load(config_for(tmp_path), tmp_path)) == 2


def test_a_small_tote_takes_small_objects(tmp_path):
    write_box(tmp_path / "thing.ply", (0.2, 0.2, 0.2))
    small = Tote(outer_size=(0.3, 0.2, 0.1), floor_size=(0.2, 0.1), rim_size=(0.25, 0.15))
    fails(replace(config_for(tmp_path), tote=small), tmp_path, "thing", "opening is 0.15 x 0.25 m")


def test_objects_larger_than_the_volume_budget_are_reported(tmp_path):
    write_box(tmp_path / "large.ply", (0.2, 0.2, 0.2))
    write_box(tmp_path / "small.ply")
    catalog, lines = load_models(tmp_path, tmp_path)
    assert len(catalog) == 2
    assert lines == ["never drawn, since larger than arrangement.volume, 0.007 m³: large (0.008 m³)"]
    roomy = replace(config_for(tmp_path), arrangement=Arrangement(volume=0.0081))
    lines.clear()
    load_catalog(roomy, tmp_path / "cache", heard(lines))
    assert not lines


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("{", ("is damaged", "repair it")),
        ("[]", ("expected object, got array",)),
        ({}, ("no entry for object 1",)),
        ({"-1": {}, "1_0": {}, "obj_000001": {}, "²": {}}, ("no entry for object 1",)),
        ({"1": {}, "01": {}}, ("the keys '1' and '01' are both object 1; keep one of them",)),
        ('{"1": {}, "1": {"diameter": 5}}', ("the keys '1' and '1' are both object 1",)),
        ({"1": 5}, ("no entry for object 1",)),
        ({"1": {"diameter": "big"}}, ("diameter", "diameter above 0")),
        ({"1": {"diameter": 0}}, ("> 0.0", "diameter above 0")),
        ('{"1": {"diameter": NaN}}', ("malformed",)),
        ({"1": {"diameter": 0.1732}}, ("173.2 mm", "0.1732")),
        ({"1": {"symmetries_discrete": 3}}, ("symmetries_discrete", "array")),
        ({"1": {"symmetries_discrete": [[1, 2, 3]]}}, ("symmetries_discrete[0]", "16 numbers")),
        ({"1": {"symmetries_discrete": [[2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}}, ("rigid",)),
        ({"1": {"symmetries_discrete": [[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]}}, ("rigid",)),
        ({"1": {"symmetries_continuous": [7]}}, ("axis and offset",)),
        ({"1": {"symmetries_continuous": [{"offset": [0, 0, 0]}]}}, ("axis", "3 numbers")),
        ({"1": {"symmetries_continuous": [{"axis": [0, 0, 0], "offset": [0, 0, 0]}]}}, ("zero",)),
        ('{"1": {"symmetries_continuous": [{"axis": [0, 0, Infinity], "offset": [0, 0, 0]}]}}', ("malformed",)),
    ],
)
def test_an_invalid_models_info(tmp_path, content, words):
    write_box(tmp_path / "obj_000001.ply")
    write_info(tmp_path, content)
    fails(config_for(tmp_path), tmp_path, "models_info.json", *words)


def test_without_a_models_info_there_are_no_symmetries(tmp_path):
    write_box(tmp_path / "obj_000001.ply")
    (entry,) = load(config_for(tmp_path), tmp_path)
    assert entry.symmetries_discrete == ()
    assert entry.symmetries_continuous == ()
    assert entry.diameter == pytest.approx(0.1 * np.sqrt(3))


@given(st.integers(0, 2**32 - 1), st.integers(4, 60))
def test_the_diameter_is_the_largest_distance(seed, count):
    points = np.random.default_rng(seed).normal(size=(count, 3)).astype(np.float32)
    distances = np.linalg.norm(points[:, None].astype(np.float64) - points[None], axis=-1)
    assert hull_size(points).diameter == pytest.approx(distances.max(), rel=1e-12)


@pytest.mark.parametrize("scale", [(1.0, 1.0, 1.0), (3.0, 1.0, 1.0), (1.0, 1.0, 0.1), (1.0, 1.02, 1.01)])
def test_of_many_hull_vertices_not_all_are_compared(monkeypatch, scale):
    points = trimesh.creation.icosphere(4).vertices * scale
    diameter = hull_size(points).diameter
    monkeypatch.setattr(hulls, "_MOST_COMPARED", 100)
    monkeypatch.setattr(hulls, "cdist", lambda some, others: cdist(some, others) if len(some) < 2000 else pytest.fail("all"))
    assert hull_size(points).diameter == pytest.approx(diameter, rel=1e-3)


def test_embedded_objects_need_no_folder_and_no_table(tmp_path, monkeypatch):
    # Hulls only: decompositions of the embedded objects take longer than all other tests here.
    raws = [replace(raw, concave=False) for raw in procedural_objects()]
    monkeypatch.setattr(catalogs, "procedural_objects", lambda sets: raws)
    rows = tuple(ObjectRow(id=raw.obj_id, name="table", mass=99.0) for raw in raws)
    entries = load(Config(object_rows=rows), tmp_path)
    assert [entry.obj_id for entry in entries] == sorted(raw.obj_id for raw in raws)
    for entry in entries:
        assert entry.mass < 2.0
        assert entry.source is None
        assert_physical(entry)


@pytest.mark.slow
def test_the_real_objects(real_models, tmp_path):
    """They agree with their models_info.json, too: nothing is said."""
    # Rows from the preset, but no decompositions: they take minutes. `test_collision` decomposes a small bowl.
    config = load_config("synpick", {})
    rows = tuple(replace(row, concave=False) for row in config.object_rows)
    config = replace(config, bake=replace(config.bake, models=str(real_models)), object_rows=rows)
    lines: list[str] = []
    entries = load_catalog(config, tmp_path / "cache", heard(lines)).entries
    assert not lines
    assert [entry.obj_id for entry in entries] == list(range(1, 22))
    for entry, row in zip(entries, rows, strict=True):
        assert (entry.name, entry.mass) == (row.name, row.mass)
        litres = entry.volume * 1e3
        assert litres <= REAL_HULLS[entry.obj_id] * 1.02
        assert litres >= REAL_HULLS[entry.obj_id] * 0.94
        assert len(entry.pieces) == 1
        assert len(entry.pieces[0].vertices) <= 64
        assert_physical(entry)
    assert {entry.obj_id for entry in entries if entry.symmetries_discrete} == {1, 16, 19, 20, 21}
    assert {entry.obj_id for entry in entries if entry.symmetries_continuous} == {13, 18}
    assert {row.id for row in load_config("synpick", {}).object_rows if row.concave} == REAL_CONCAVE
