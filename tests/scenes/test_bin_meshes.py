"""Bins from meshes: what is measured, that collision shapes fill the solid and nothing free, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from synpick_warp.configs.cell.bins import AXES, BinRow
from synpick_warp.configs.files.load import load_config, override_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes import reading
from synpick_warp.scenes.bin_meshes.colliders import MAX_PIECES
from synpick_warp.scenes.bin_meshes.inside import LIMIT_CELLS
from synpick_warp.scenes.bin_meshes.reading import measure_bins, read_bin
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.collision.simplification import hull_piece
from tests.worlds.bin_meshes import block, bowl, heights, low_front, round_bin, sheet_bin, sloped_bin, stepped_bin, tote, wall_of_floor

TURN = trimesh.transformations.rotation_matrix
UPRIGHT = {"z": ((1, 0, 0), 0), "-z": ((1, 0, 0), np.pi), "y": ((1, 0, 0), -np.pi / 2), "x": ((0, 1, 0), np.pi / 2)}
"""Rotation that takes z to each axis."""


def model(tmp_path, mesh, name: str = "own.stl", **settings):
    """Bin of a mesh."""
    mesh.export(tmp_path / name)
    return read_bin(BinRow(name="own", file=str(tmp_path / name), **settings))


def filled(pieces, points: np.ndarray, margin: float = 0.0) -> np.ndarray:
    """Whether points lie in one of some convex pieces, at least `margin` deep."""
    planes = [ConvexHull(piece.vertices.astype(float)).equations for piece in pieces]
    return np.any([(points @ each[:, :3].T + each[:, 3] <= -margin).all(axis=1) for each in planes], axis=0)


def test_a_sloped_floor_and_a_divider_are_measured(tmp_path):
    found = model(tmp_path, sloped_bin(rise=0.04, divider=0.1)).measured
    np.testing.assert_allclose(found.box, (-0.204, -0.154, -0.004, 0.204, 0.154, 0.2), atol=1e-5)
    np.testing.assert_allclose(found.opening, (0.4, 0.3), atol=3e-3)
    assert found.height == pytest.approx(0.2, abs=1e-5)
    left, right = found.compartments
    np.testing.assert_allclose(left, (-0.0765, 0.0, 0.247, 0.3, 0.1, 0.0, 0.02), atol=3e-3)
    np.testing.assert_allclose(right, (0.1265, 0.0, 0.147, 0.3, 0.1, 0.0, 0.02), atol=3e-3)


@pytest.mark.parametrize(
    "mesh",
    [
        sloped_bin(),
        sloped_bin().apply_transform(TURN(0.5, (0, 0, 1))),
        round_bin(),
        round_bin(sections=200),
        low_front(),
        stepped_bin(),
        tote(),
    ],
    ids=["sloped", "turned", "round", "fine", "front", "step", "tote"],
)
def test_shapes_fill_the_solid_behind_the_inside_and_nothing_of_it(tmp_path, mesh):
    """Along vertical rays from above, against the heights of the mesh by all of its triangles."""
    found = model(tmp_path, mesh)
    assert len(found.pieces) <= MAX_PIECES
    box, rng = found.measured.box, np.random.default_rng(0)
    points = rng.uniform(box[:2], box[3:5], (4000, 2))
    points = points[(np.abs(points) < np.array(found.measured.opening) / 2).all(axis=1)]
    cells = tuple((np.floor(points / found.limits.pitch).astype(int) + LIMIT_CELLS // 2).T)
    inside = found.limits.limit[cells] < found.measured.height - 1e-3
    top = heights(found.mesh, points)
    # Beside walls the tolerance of a facet decides; and what is narrower than the gap of contacts is no free space.
    around = np.stack([heights(found.mesh, points + step) for step in np.array([(1, 0), (-1, 0), (0, 1), (0, -1)]) * 4e-3])
    level = inside & (np.ptp(np.concatenate([around, top[None]]), axis=0) < 4e-3)
    assert level.sum() > 1500
    points, top = points[level], top[level]
    for depth in (1e-3, 5e-3, 0.05):
        assert filled(found.pieces, np.column_stack([points, top - depth])).mean() > 0.995
    for rise in (2e-3, 0.02, 0.05):
        assert filled(found.pieces, np.column_stack([points, top + rise])).mean() < 0.005


def test_dividers_and_walls_hold_what_touches_them(tmp_path):
    """Both faces of the divider, its top and the walls are where the mesh has them, within 0.1 mm."""
    pieces = model(tmp_path, sloped_bin(divider=0.1)).pieces
    faces = {(0.047, 1): 0.06, (0.053, -1): 0.06, (-0.2, -1): 0.06, (0.2, 1): 0.06}
    for (x, side), z in faces.items():
        free, solid = (np.array([[x - side * step, y, z] for y in np.linspace(-0.14, 0.14, 15)]) for step in (1e-4, -1e-4))
        assert filled(pieces, solid).all(), (x, side)
        assert not filled(pieces, free).any(), (x, side)
    top = np.array([[0.05, y, 0.1] for y in np.linspace(-0.14, 0.14, 15)])
    assert filled(pieces, top - (0, 0, 1e-4)).all()
    assert not filled(pieces, top - (0, 0, -1e-4)).any()


@pytest.mark.parametrize(("up", "name"), [("z", "a.stl"), ("-z", "a.ply"), ("y", "a.obj"), ("x", "a.glb")])
def test_any_format_unit_and_axis_gives_the_same_bin(tmp_path, up, name):
    mesh = sloped_bin().apply_scale(1000).apply_transform(TURN(UPRIGHT[up][1] or 0.0, UPRIGHT[up][0]))
    found = model(tmp_path, mesh, name, unit="mm", up=up).measured
    assert sorted(found.opening) == pytest.approx([0.3, 0.4], abs=3e-3)
    assert (found.height, len(found.compartments)) == (pytest.approx(0.2, abs=1e-4), 2)


def test_a_place_as_modelled_is_the_meshs(tmp_path):
    mesh = sloped_bin().apply_translation((0.3, -0.2, 0.5))
    here, there = (model(tmp_path, mesh, place=place).measured for place in ("floor", "file"))
    assert dataclasses.replace(there, origin=(0.0, 0.0, 0.0)) == here
    np.testing.assert_allclose(there.origin, (0.3, -0.2, 0.5), atol=1e-4)


@pytest.mark.parametrize("flip", [False, True])
def test_a_sheet_without_thickness_gets_thick_shapes(tmp_path, flip):
    mesh = sheet_bin()
    if flip:
        mesh.invert()
    found = model(tmp_path, mesh)
    assert len(found.pieces) == 5
    assert filled(found.pieces, np.array([[0.0, 0.0, -0.05], [0.21, 0.0, 0.1], [0.0, -0.11, 0.1]])).all()
    assert not filled(found.pieces, np.array([[0.0, 0.0, 0.01], [0.19, 0.0, 0.1], [0.0, -0.09, 0.1]])).any()


@pytest.mark.parametrize(
    ("mesh", "settings", "message"),
    [
        (block((0, 0, 0), (0.4, 0.3, 0.2)), {}, r"has no inside .* closed, flat.*; a bin needs an open top"),
        (block((0, 0, 0), (0.4, 0.3, 0.004)), {}, r"has no inside .*; a bin needs an open top"),
        (sloped_bin(), {"up": "-z"}, r'has no inside .*with up = -z.*; did you mean up = "z"\?'),
        (sloped_bin(), {"up": "x"}, r'did you mean up = "z"\?'),
        (sloped_bin().apply_scale(1000), {}, r'is 408 x 308 x 204 m, unit m; allowed: .* 10 m; did you mean unit = "mm"'),
        (sloped_bin(), {"unit": "mm"}, r'is 0.000408 x .* m, unit mm; allowed: .*; did you mean unit = "m"'),
        (wall_of_floor(), {}, "has no inside"),
        (bowl(), {}, r"need \d+ convex collision shapes; allowed: 64; simplify the mesh"),
    ],
)
def test_what_is_no_bin_is_refused_in_one_line(tmp_path, mesh, settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        model(tmp_path, mesh, **settings)
    assert str(caught.value).startswith("bin own: ")
    assert "\n" not in str(caught.value)


def test_shapes_that_differ_from_the_mesh_are_refused(tmp_path, monkeypatch):
    """The comparison sees a missing floor, and a piece in the way."""
    whole = reading.make_colliders
    block_in_the_way = hull_piece(block((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)).vertices)
    for wrong in (lambda *mesh: whole(*mesh)[1:], lambda *mesh: (*whole(*mesh), block_in_the_way)):
        monkeypatch.setattr(reading, "make_colliders", wrong)
        sloped_bin().export(tmp_path / "own.stl")
        with pytest.raises(reading.CatalogError, match=r"collision shapes and mesh differ by more than 3 mm over \d+% of the opening"):
            reading._model(BinRow(name="own", file=str(tmp_path / "own.stl")))


ROWS = """preset = "smoke"
[bins]
kind = "own"
[[bin]]
name = "kanban"
file = "bins/kanban.stl"
"""


def read(tmp_path, text=ROWS):
    """Settings with a mesh in a folder beside them."""
    (tmp_path / "bins").mkdir(exist_ok=True)
    sloped_bin().export(tmp_path / "bins" / "kanban.stl")
    (tmp_path / "own.toml").write_text(text)
    return load_config(str(tmp_path / "own.toml"))


def measured(config):
    """Settings with what the meshes of bins measure."""
    return override_config(config, measure_bins(config.bin))


def test_a_measured_bin_is_written_read_and_told_apart_by_its_content(tmp_path):
    config = measured(read(tmp_path))
    assert measure_bins(config.bin) == {}
    (sizes,) = config.cell.bins
    assert (sizes.height, sizes.ground, len(sizes.floors)) == (pytest.approx(0.2, abs=1e-4), pytest.approx(-0.004, abs=1e-4), 2)
    (tmp_path / "own.toml").write_text(config_to_toml(config))
    (tmp_path / "bins" / "kanban.stl").rename(tmp_path / "moved.stl")
    again = load_config(str(tmp_path / "own.toml"))
    assert again == config
    moved = measured(dataclasses.replace(config, bin=(dataclasses.replace(config.bin[0], file=str(tmp_path / "moved.stl")),)))
    assert make_manifest(moved) == make_manifest(config)
    sloped_bin(rise=0.03).export(tmp_path / "moved.stl")
    assert make_manifest(measured(moved)) != make_manifest(config)
    with pytest.raises(ConfigError, match="is not the mesh that was measured"):
        make_bins(moved.cell.bins)
    with pytest.raises(ConfigError, match=r"bin kanban: .* cannot be read \(No such file"):
        make_bins(config.cell.bins)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("wall = 0.01", r"bin\[0\].wall is 0.01 .*; allowed: none beside bin.file"),
        ("compartments = [2, 1]", r"bin\[0\].compartments is .*; allowed: none beside bin.file"),
        ('unit = "ft"', r'bin\[0\].unit is "ft" .*; allowed: m, cm, mm, in'),
        ('up = "w"', rf'bin\[0\].up is "w" .*; allowed: {", ".join(AXES)}'),
        ('place = "here"', r'bin\[0\].place is "here" .*; allowed: floor, file'),
    ],
)
def test_a_wrong_row_with_a_mesh_is_refused(tmp_path, line, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, ROWS + line)


def test_what_belongs_to_a_mesh_needs_one(tmp_path):
    with pytest.raises(ConfigError, match=r'bin\[0\].unit is "mm" .*; allowed: none without bin.file'):
        read(tmp_path, ROWS.replace("file = ", "unit = 'mm' #"))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        ("[pick]\nlift_height = 0.19", r"pick.lift_height is 0.19 .*; allowed: at least the inner height of the bin, 0.2"),
        ("place = 'file'", r"pick.floor is -0.1 .*; allowed: at most the floor of the bin, -0.5: what is below it is removed"),
        (
            "place = 'file'\n[pick]\nfloor = -0.6\n[cameras]\npositions = [[0, 0, -0.55]]\nups = [[0, 1, 0]]",
            r"cameras.positions .* z > -0.5,",
        ),
    ],
)
def test_rules_of_other_settings_hold_for_what_is_measured(tmp_path, lines, message):
    config = read(tmp_path, ROWS + lines)
    sloped_bin().apply_translation((0.0, 0.0, -0.5)).export(tmp_path / "bins" / "kanban.stl")
    with pytest.raises(ConfigError, match=message):
        measured(config)
