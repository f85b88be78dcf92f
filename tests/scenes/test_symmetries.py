"""Symmetries of objects: detected on bodies whose groups are known, declared in the object table, and written as BOP has them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from synpick_warp.apps.evaluation.errors import read_models
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import ObjectRow
from synpick_warp.errors import CatalogError
from synpick_warp.exporters.bop.shared import write_models
from synpick_warp.scenes import catalog
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import read_models_info
from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.symmetries.detection import close_group, find_element, find_symmetries
from synpick_warp.scenes.symmetries.surface import SampledSurface
from tests.builders import refusal
from tests.worlds.model_files import exported, load_models, put

MAKE = trimesh.creation


def joined(*parts: Any) -> Any:
    """Bodies as one mesh."""
    return trimesh.util.concatenate(list(parts))


def gear(teeth: int) -> Any:
    """Disc with teeth and a hub on one side, so that it cannot be turned over."""
    angle = np.linspace(0.0, 2.0 * np.pi, 8 * teeth, endpoint=False)
    radius = 0.04 + 0.006 * (np.arange(8 * teeth) % 8 < 4)
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle)])
    body = trimesh.Trimesh(*extrude(ring, 0.01), process=False)
    return joined(body, MAKE.cylinder(0.015, 0.02, sections=64).apply_translation((0, 0, 0.015)))


def extrude(ring: np.ndarray, height: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a star-shaped prism, with its end faces in fans."""
    count, at = len(ring), np.arange(len(ring))
    after = (at + 1) % count
    low, high = np.column_stack([ring, np.zeros(count)]), np.column_stack([ring, np.full(count, height)])
    vertices = np.concatenate([low, high, [(0, 0, 0), (0, 0, height)]])
    sides = [(at, after, at + count), (after, after + count, at + count)]
    ends = [(after, at, np.full(count, 2 * count)), (at + count, after + count, np.full(count, 2 * count + 1))]
    return vertices, np.concatenate([np.column_stack(each) for each in (*sides, *ends)])


def bracket() -> Any:
    """Two unequal arms and a pin: no symmetry."""
    arms = [MAKE.box((0.1, 0.03, 0.02)), MAKE.box((0.03, 0.06, 0.02)).apply_translation((0.035, 0.045, 0.0))]
    return joined(*arms, MAKE.cylinder(0.005, 0.02, sections=32).apply_translation((-0.03, 0.0, 0.02)))


TETRAHEDRON = [(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]
SLOW = ("cube", "cone", "can", "ring", "ball")
"""Bodies of the largest groups, or of the most triangles."""
BODIES = {
    "box": (MAKE.box((0.1, 0.06, 0.02)), 3, 0),
    "square box": (MAKE.box((0.1, 0.1, 0.04)), 7, 0),
    "cube": (MAKE.box((0.1, 0.1, 0.1)), 23, 0),
    "nut": (MAKE.cylinder(0.03, 0.02, sections=6), 11, 0),
    "tetrahedron": (trimesh.Trimesh(0.04 * np.array(TETRAHEDRON), [(0, 1, 2), (0, 3, 1), (0, 2, 3), (1, 3, 2)]), 11, 0),
    "gear of 17": (gear(17), 16, 0),
    "can": (MAKE.cylinder(0.03, 0.1, sections=64), 1, 1),
    "cone": (MAKE.cone(0.03, 0.08, sections=64), 0, 1),
    "ring": (MAKE.torus(0.04, 0.01), 1, 1),
    "ball": (MAKE.icosphere(4, 0.05), 0, 3),
    "bracket": (bracket(), 0, 0),
}
"""Body -> mesh, number of discrete symmetries without the identity, number of continuous axes."""
TOLERANCE = 0.01


def diameter(mesh: trimesh.Trimesh) -> float:
    corners = mesh.convex_hull.vertices
    return float(np.linalg.norm(corners[:, None] - corners[None], axis=2).max())


def counts(mesh: trimesh.Trimesh, *shares: float) -> list[int]:
    """Numbers of discrete symmetries that are found with tolerances by share of the diameter."""
    size = diameter(mesh)
    return [len(find_symmetries(mesh.vertices, mesh.faces, size, share * size).discrete) for share in shares]


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow) if name in SLOW else name for name in BODIES])
def test_the_groups_of_known_bodies_in_any_orientation(name):
    mesh, discrete, continuous = BODIES[name]
    size = diameter(mesh)
    placed = mesh.copy()
    pose = trimesh.transformations.random_rotation_matrix(np.random.default_rng(3).random(3))
    pose[:3, 3] = 0.01, -0.02, 0.03
    placed.apply_transform(pose)
    # All folds of a ball's axes take a third of the time within the tolerance of the default settings.
    found = find_symmetries(placed.vertices, placed.faces, size, (0.03 if name == "ball" else TOLERANCE) * size)
    assert (len(found.discrete), len(found.continuous)) == (discrete, continuous)
    # Distances are measured to a sample of the surface: of exact symmetries up to its gaps.
    assert max([*found.deviations, *(turn.deviation for turn in found.continuous)], default=0.0) < 0.7 * TOLERANCE * size
    moves = [*found.discrete, *(turn.matrix(1.0) for turn in found.continuous)]
    for move in moves:
        assert np.abs(move[:3, :3] @ move[:3, :3].T - np.eye(3)).max() < 1e-12
        off = KDTree(placed.vertices).query(placed.vertices @ move[:3, :3].T + move[:3, 3])[0].max()
        assert off < (0.01 if not continuous else 0.06) * size  # By vertices; of round bodies up to their distance.
    if discrete and not continuous:
        group = np.concatenate([np.eye(3)[None], found.discrete[:, :3, :3]])
        products = np.einsum("aij,bjk->abik", group, group).reshape(-1, 3, 3)
        assert all(np.abs(group[find_element(group, product)] - product).max() < 1e-9 for product in products)


REAL = dict.fromkeys((4, 10, 11, 12, 14, 15, 17, 19, 20), (0, 0))  # Dents of 4, 19 and 20 are 3.5, 3.8 and 3.3 % deep.
REAL |= dict.fromkeys((13, 18), (0, 1))
REAL |= dict.fromkeys((2, 3, 7, 8), (3, 0))  # Boxes.
REAL |= dict.fromkeys((5, 9, 21), (1, 0))
REAL |= {1: (1, 1), 6: (1, 1), 16: (7, 0)}  # Cans are round, and most the same upside down.
"""obj_id of YCB-Video -> numbers of discrete and continuous symmetries of its scan, within 3 % of the diameter."""
QUICK = (2, 13, 19, 20)


@pytest.mark.parametrize("obj_id", [row if row in QUICK else pytest.param(row, marks=pytest.mark.slow) for row in REAL])
def test_the_groups_of_scanned_objects(real_models, obj_id):
    mesh, *_ = read_mesh(real_models / f"obj_{obj_id:06d}.ply", 1e-3)
    found = find_symmetries(mesh.vertices, mesh.faces, size := hull_size(mesh.vertices).diameter, 0.03 * size)
    assert (len(found.discrete), len(found.continuous)) == REAL[obj_id]
    assert max([*found.deviations, *(turn.deviation for turn in found.continuous)], default=0.0) <= 0.03 * size


def test_a_feature_above_the_tolerance_breaks_a_symmetry():
    """A pin of 3 mm on a box of 118 mm, at 2 % and at 3 %."""
    mesh = joined(MAKE.box((0.1, 0.06, 0.02)), MAKE.cylinder(0.002, 0.006, sections=16).apply_translation((0.04, 0.02, 0.01)))
    assert counts(mesh, 0.02, 0.03) == [0, 3]
    missed = find_symmetries(mesh.vertices, mesh.faces, diameter(mesh), 0.02 * diameter(mesh)).missed
    assert missed is not None
    assert missed.deviation == pytest.approx(0.003, rel=0.1)


def test_a_single_vertex_above_the_tolerance_breaks_a_symmetry():
    """Of some thousands, pulled out of a side by 3.5 diameters in a hundred: subsamples miss it."""
    mesh = MAKE.box((0.1, 0.06, 0.02)).subdivide_to_size(0.002)
    size = diameter(mesh)
    inside = np.abs(mesh.vertices - (0.03, 0.015, 0.01)).sum(axis=1).argmin()
    mesh.vertices[inside, 2] += 0.035 * size
    surface, half_turn = SampledSurface(mesh.vertices, mesh.faces), np.diag([-1.0, -1.0, 1.0, 1.0])
    assert surface.rough_deviation(half_turn, np.inf) < 0.03 * size
    assert surface.deviation(half_turn) == pytest.approx(0.035 * size, rel=0.02)
    assert counts(mesh, 0.03, 0.04) == [0, 3]


def test_a_group_is_closed_and_exact_from_axes_that_are_a_degree_off():
    turns = ((np.pi / 2, np.array((0.01, 0.0, 1.0))), (np.pi, np.array((1.0, 0.015, 0.01))))
    rotations = np.array([Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix() for angle, axis in turns])
    group = close_group(rotations, 15.0)
    assert group is not None
    assert len(group) == 8
    table = np.einsum("aij,bjk->abik", group, group).reshape(-1, 3, 3)
    assert max(np.abs(group - product).max(axis=(1, 2)).min() for product in table) < 1e-9


# ---- declared in the object table ----

HALF = (-1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def load(tmp_path: Path, mesh: trimesh.Trimesh, name: str = "part.stl", row: ObjectRow | None = None, **objects):
    put(tmp_path / "parts" / name, exported(mesh, name.rpartition(".")[2]))
    return load_models(tmp_path / "parts", tmp_path, *([row] if row else []), **objects)


@pytest.mark.parametrize(
    ("discrete", "continuous", "expected"),
    [
        (((0, 0, 1, 2),), (), (1, 0)),
        (((0, 0, 2, 2), (1, 0, 0, 2, 0.05, 0.03, 0.01)), (), (3, 0)),
        (((*HALF[:3], 0.1, *HALF[4:7], 0.06, *HALF[8:]),), (), (1, 0)),
    ],
)
@pytest.mark.parametrize("center", [True, False])
def test_declared_symmetries_move_with_the_mesh(tmp_path, center, discrete, continuous, expected):
    """A box from the origin to 100 x 60 x 20 mm: offsets and matrices are in the frame of its file."""
    mesh = MAKE.box((0.1, 0.06, 0.02)).apply_translation((0.05, 0.03, 0.01))
    row = ObjectRow(name="part", symmetries_discrete=discrete, symmetries_continuous=continuous)
    catalog, lines = load(tmp_path, mesh, row=row, center=center)
    (entry,) = catalog.entries
    assert not [line for line in lines if "moves its surface" in line]
    assert (len(entry.symmetries_discrete), len(entry.symmetries_continuous)) == expected
    corners = entry.mesh.vertices.astype(np.float64)
    for values in entry.symmetries_discrete:
        matrix = np.reshape(values, (4, 4))
        moved = corners @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.linalg.norm(moved[:, None] - corners[None], axis=2).min(axis=1).max() < 1e-6


def test_a_declared_symmetry_that_does_not_hold_is_named(tmp_path):
    mesh = MAKE.box((0.1, 0.06, 0.02))
    row = ObjectRow(name="part", symmetries_discrete=((0, 0, 1, 4),))
    _, (line,) = load(tmp_path, mesh, row=row)
    assert "part.stl: its row of the object table gives symmetries_discrete[0], which moves its surface by 19.4 mm" in line
    with pytest.raises(CatalogError, match="moves its surface"):
        load(tmp_path, mesh, row=row, strict=True)
    many = ObjectRow(name="part", symmetries_discrete=((0, 0, 1, 71), (1, 0, 0, 71)))
    said = "generate more than 144; a symmetry about an axis by any angle belongs into symmetries_continuous"
    with pytest.raises(CatalogError, match=said):
        load(tmp_path, mesh, row=many)
    # One that holds comes before those that are detected.
    row = ObjectRow(name="part", symmetries_discrete=((0, 0, 1, 2),))
    catalog, lines = load(tmp_path, MAKE.cylinder(0.03, 0.1, sections=64), row=row, symmetries="detect")
    assert not lines
    assert catalog.entries[0].symmetries_continuous == ()
    assert len(catalog.entries[0].symmetries_discrete) == 1


TABLE = "[[object_rows]]\nid = 1\ndiameter = 0.0\nname = 'part'\n"


@pytest.mark.parametrize(
    "text",
    [
        "symmetries_discrete = [{ axis = [0, 0, 1], fold = 2 }]",
        "symmetries_discrete = [{ axis = [0, 0, 1], fold = 3, offset = [0.1, 0, 0] }]",
        "symmetries_discrete = [{ matrix = [[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]] }]",
        "symmetries_discrete = [[[-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]",
        "symmetries_discrete = [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], [0, 0, 1, 2]]",
        "symmetries_continuous = [{ axis = [0, 0, 1] }, { axis = [1, 0, 0], offset = [0, 0, 0.1] }]",
    ],
)
def test_forms_of_declarations_are_written_and_read_back(tmp_path, text):
    config = load_config(str(put(tmp_path / "a.toml", TABLE + text)))
    (row,) = config.object_rows
    assert row.symmetries_discrete or row.symmetries_continuous
    assert load_config(str(put(tmp_path / "b.toml", config_to_toml(config)))) == config


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("symmetries_discrete = [{ axis = [0, 0, 0], fold = 2 }]", "an axis that is not zero"),
        ("symmetries_discrete = [{ axis = [0, 0, 1], fold = 1 }]", "a fold from 2 to 72"),
        ("symmetries_discrete = [{ axis = [0, 0, 1], fold = 2.5 }]", "a fold from 2 to 72"),
        ("symmetries_discrete = [{ axis = [0, 0, 1], folds = 2 }]", "fold = 2"),
        ("symmetries_discrete = [{ axis = [0, 1], fold = 2 }]", "axis = [0, 0, 1]"),
        ("symmetries_discrete = [[-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]", "a rigid 4 x 4 matrix"),
        ("symmetries_discrete = [[2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]]", "a rigid 4 x 4 matrix"),
        ("symmetries_discrete = [[nan, 0, 0, 2]]", "an axis that is not zero"),
        ("symmetries_discrete = { axis = [0, 0, 1], fold = 2 }", "a list of symmetries"),
        ("symmetries_continuous = [{ axis = [0, 0, 1], fold = 2 }]", "offset = [0, 0, 0]"),
        ("symmetries_continuous = ['z']", "an axis that is not zero"),
    ],
)
def test_a_wrong_declaration_is_one_line(tmp_path, text, said):
    message = refusal(load_config, put(tmp_path / "a.toml", TABLE + text))
    assert message.startswith("object_rows[0].symmetries_")
    assert said in message


# ---- what comes of them ----


@pytest.mark.parametrize(
    ("name", "mesh", "said", "discrete", "poses"),
    [
        ("part.stl", MAKE.box((0.1, 0.06, 0.02)), "symmetries detected: 2-fold about (", 3, 4),
        ("obj_000001.ply", MAKE.cylinder(30.0, 100.0, sections=64), "continuous about (0, 0, 1), 2-fold about (1, 0, 0)", 1, 2 * 315),
    ],
)
def test_detected_symmetries_reach_models_info_and_evaluation(tmp_path, name, mesh, said, discrete, poses):
    """Of a box in metres, and of a can as a BOP model, whose own entry has none."""
    is_bop = name.startswith("obj_")
    if is_bop:
        put(tmp_path / "parts" / "models_info.json", json.dumps({"1": {"diameter": 116.6, "extra": 1}}))
    catalog, (line,) = load(tmp_path, mesh, name, symmetries="detect")
    assert said in line
    assert "; they move its surface by up to " in line
    (tmp_path / "set").mkdir()
    write_models(catalog, tmp_path / "set" / "models")
    info = read_models_info(tmp_path / "set" / "models" / "models_info.json", [1])[1]
    assert info.symmetries_continuous == ((((0.0, 0.0, 1.0), (0.0, 0.0, 0.0)),) if is_bop else ())
    assert len(info.symmetries_discrete) == discrete
    assert ("extra" in (tmp_path / "set" / "models" / "models_info.json").read_text()) == is_bop
    model = read_models(tmp_path / "set", [1])[1]
    assert model.symmetric
    assert len(model.symmetries) == poses


def test_symmetries_are_found_once_for_a_mesh_and_a_tolerance(tmp_path, monkeypatch):
    """What is read has the bits of what was found; a damaged file is no error, and neither is a folder that cannot be written."""
    found, block, disc = [], MAKE.box((0.03, 0.04, 0.05)), MAKE.cylinder(0.02, 0.01, sections=12)
    monkeypatch.setattr(catalog, "find_symmetries", lambda *given: found.append(find_symmetries(*given)) or found[-1])
    folder = tmp_path / "new"
    given = [(body.vertices, body.faces, 0.1, tolerance) for body, tolerance in ((block, 0.003), (disc, 0.003), (block, 0.002))]

    def bits(found):
        turns = [*found.continuous, *([found.missed] if found.missed else [])]
        numbers = [(*turn.axis.tolist(), *turn.point.tolist(), turn.fold, turn.deviation) for turn in turns]
        return found.discrete.tobytes(), found.deviations.tobytes(), found.discrete.shape, len(found.continuous), numbers

    first, second = ([bits(catalog.cached_symmetries(*each, folder)) for each in given] for _ in range(2))
    assert first == second == [bits(each) for each in found]
    assert len(list(folder.iterdir())) == 3
    assert all([found[0].discrete.size, found[1].continuous, found[1].missed])
    for file in folder.iterdir():
        file.write_bytes(file.read_bytes()[:-60])
    assert bits(catalog.cached_symmetries(*given[0], folder)) == first[0]
    assert bits(catalog.cached_symmetries(*given[0], Path("/dev/null/none"))) == first[0]
    assert len(found) == 5
