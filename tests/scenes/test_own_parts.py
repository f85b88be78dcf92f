"""Own parts: mass by density and volume, concavity by the depth of the hull, loose pieces."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Bake, Config, ObjectRow, Objects
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.collision.depth import is_concave, relative_depth
from synpick_warp.scenes.types import CatalogEntry
from tests.worlds.bin_meshes import bracket
from tests.worlds.model_files import REAL_HULLS, exported, put

CASES = Path(__file__).resolve().parents[1] / "cases" / "parts"
STEEL = 7850.0


def load(folder: Path, mesh: trimesh.Trimesh, config: Config) -> tuple[CatalogEntry, list[str]]:
    """An object of a folder that has it alone, and what is told."""
    put(folder / "models" / "part.ply", exported(mesh))
    lines: list[str] = []
    given = Config(Bake(models=str(folder / "models")), objects=config.objects, object_rows=config.object_rows)
    (entry,) = load_catalog(given, folder / "cache", lines.append).entries
    return entry, lines


def box(*sides: float, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    return trimesh.creation.box(sides).apply_translation(at)


def shells(*radii: float) -> trimesh.Trimesh:
    """A hollow ball; a negative radius is that of an inner side."""
    balls = [trimesh.creation.icosphere(4, abs(radius)) for radius in radii]
    for ball in balls[1:]:
        ball.invert()
    return trimesh.util.concatenate(balls)


def without_a_face(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    return mesh


# ---- mass ----


@pytest.mark.parametrize(
    ("make", "volume", "told"),
    [
        (lambda: bracket(60.0).apply_scale(1e-3), 23.49e-6, False),
        (lambda: shells(0.03, 0.025), shells(0.03).volume - shells(0.025).volume, False),
        (lambda: without_a_face(box(0.04, 0.03, 0.02)), 24e-6, True),
        # Two bodies in one place would weigh twice as much.
        (lambda: trimesh.util.concatenate([box(0.04, 0.03, 0.02), box(0.04, 0.03, 0.02)]), 24e-6, True),
    ],
    ids=["bracket", "hollow", "open", "twice"],
)
def test_a_density_that_is_known_is_that_of_the_material(tmp_path, make, volume, told):
    """A steel bracket of 184 g weighed 17.7 g."""
    config = load_config("smoke", {"objects.density": STEEL, "objects.concave_ratio": 0.0})
    entry, lines = load(tmp_path, make(), config)
    assert entry.mass == pytest.approx(STEEL * volume, rel=1e-4)
    said = f"mass of part: {entry.mass:.3g} kg, 7850 kg/m³ of their collision shapes, where meshes are open, is a guess; close the meshes, "
    assert [line.startswith(said) for line in lines if line.startswith("mass")] == [True] * told


def test_a_density_that_is_not_known_is_told_as_a_guess(tmp_path):
    (part, lines), hull = load(tmp_path, bracket(60.0).apply_scale(1e-3), load_config("smoke")), 44.145e-6
    assert part.mass == pytest.approx(400.0 * hull)
    advice = "is a guess; set objects.density to the material's, or mass in [[object_rows]]"
    assert lines[-1] == f"mass of part: 0.0177 kg, 400 kg/m³ of their convex hulls, {advice}"
    put(tmp_path / "models" / "small.ply", exported(box(0.02, 0.02, 0.02)))
    load_catalog(Config(Bake(models=str(tmp_path / "models"))), tmp_path / "cache", lines.append)
    assert lines[-1].startswith("mass of part, small: 0.0032 to 0.0177 kg, ")


def test_a_density_that_is_set_is_over_meshes_unless_hulls_are_asked_for():
    assert [
        load_config("synpick", given).objects.mass_volume
        for given in ({}, {"objects.density": 400.0}, {"objects.density": 400.0, "objects.mass_volume": "hull"})
    ] == ["hull", "mesh", "hull"]


@pytest.mark.parametrize("concave", [None, False])
def test_a_row_leaves_what_it_does_not_name_to_the_rules(tmp_path, concave):
    """It gave 0.1 kg, and the hull of a bracket."""
    row = ObjectRow(name="part", concave=concave)
    config = Config(objects=Objects(density=STEEL, mass_volume="mesh"), object_rows=(row,))
    entry, lines = load(tmp_path, bracket(60.0).apply_scale(1e-3), config)
    assert entry.mass == pytest.approx(STEEL * 23.49e-6)
    assert (len(entry.pieces) > 1) == (concave is None), lines


# ---- concavity ----


def revolved(*profile: tuple[float, float]) -> trimesh.Trimesh:
    return trimesh.creation.revolve(np.array(profile), sections=48)


def net() -> trimesh.Trimesh:
    """Wires of 2 mm, 20 mm apart."""
    wires = [box(*sides, at=at) for at, sides in ((((0, y, 0)), (0.1, 0.002, 0.002)) for y in np.arange(-0.04, 0.05, 0.02))]
    return trimesh.util.concatenate([*wires, *(wire.copy().apply_transform(np.diag([1.0, 1, 1, 1])[[1, 0, 2, 3]]) for wire in wires)])


ARC = np.linspace(0.0, np.pi / 2.0, 20)
SHAPES: dict[str, tuple[Callable[[], trimesh.Trimesh], float, bool]] = {
    "box": (lambda: box(0.1, 0.08, 0.06), 0.0, False),
    "plate": (lambda: box(0.2, 0.2, 0.001), 0.0, False),
    "hollow ball": (lambda: shells(0.05, 0.045), 0.0, False),
    "hollow box": (lambda: trimesh.util.concatenate([box(0.1, 0.08, 0.06), box(0.09, 0.07, 0.05).apply_scale(-1.0)]), 0.0, False),
    "tube": (lambda: trimesh.creation.annulus(0.04, 0.05, 0.1, sections=64), 0.8, True),
    "washer": (lambda: trimesh.creation.annulus(0.004, 0.01, 0.002, sections=64), 4.0, True),
    "bowl": (lambda: revolved((0, 0), (0.06, 0.0), (0.06, 0.05), (0.058, 0.05), (0.058, 0.002), (0, 0.002)), 2 * 0.048 / 0.05, True),
    "open dome": (lambda: revolved(*0.05 * np.stack([np.cos(ARC), np.sin(ARC)], axis=1)), 2.0, True),
    "bottle": (lambda: revolved((0, 0), (0.03, 0), (0.03, 0.1), (0.012, 0.13), (0.012, 0.16), (0, 0.16)), 0.28, False),
    "net": (net, 9.0, True),
    "plate with holes": (lambda: trimesh.load_mesh(CASES / "suction_default_porous" / "grid.stl"), 1.5, True),
}


@pytest.mark.parametrize("name", SHAPES)
def test_concavity_is_the_depth_of_the_hull_and_no_matter_of_volume(name):
    make, depth, concave = SHAPES[name]
    mesh = make()
    hull = mesh.convex_hull.volume
    assert is_concave(mesh.vertices, mesh.faces, hull, 0.6) == concave
    if mesh.volume < 0.99 * hull:
        assert relative_depth(mesh.vertices, mesh.faces) == pytest.approx(depth, rel=0.06, abs=0.02)


def test_concave_real_objects_are_those_of_the_table_and_some_that_it_takes_for_hulls(real_models):
    """The table of the paper has hulls for a banana, scissors, a marker with a clip and two clamps."""
    found = set()
    for obj_id in REAL_HULLS:
        mesh, _ = read_mesh(real_models / f"obj_{obj_id:06d}.ply", 1e-3)
        if is_concave(mesh.vertices, mesh.faces, REAL_HULLS[obj_id] * 1e-3, Objects.concave_ratio):
            found.add(obj_id)
    assert found == {13, 14, 15} | {10, 17, 18, 19, 20}


# ---- loose pieces ----


@pytest.mark.parametrize(("size", "at", "told"), [(0.001, 0.2, True), (0.001, 0.04, False), (0.02, 0.2, False)])
def test_a_loose_speck_that_lengthens_a_part_is_told(tmp_path, size, at, told):
    mesh = trimesh.util.concatenate([box(0.06, 0.04, 0.02), box(size, size, size, at=(at, 0.0, 0.0))])
    entry, lines = load(tmp_path, mesh, load_config("smoke", {"objects.center": True}))
    said = [line.partition(": ")[2] for line in lines if "loose pieces" in line]
    length = 1e3 * entry.diameter
    what = f"loose pieces, 12 of its 24 triangles, lengthen it from 74.83 to {length:.4g} mm; delete them from the file unless "
    assert [line.startswith(what) for line in said] == [True] * told
