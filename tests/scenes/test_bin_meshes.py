"""Bins from meshes: what is measured, that collision shapes fill the solid and nothing free, and what is refused."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from synpick_warp.apps.viz.cell.rendering import lay_out
from synpick_warp.configs.cell.bins import AXES, BinRow, MeasuredBin
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.files.load import load_config, override_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes import reading
from synpick_warp.scenes.bin_meshes.colliders import MAX_PIECES
from synpick_warp.scenes.bin_meshes.inside import LIMIT_CELLS
from synpick_warp.scenes.bin_meshes.reading import BinModel, measure_bins, read_bin
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.collision.simplification import hull_piece
from synpick_warp.scenes.embedded.objects import procedural_objects
from tests.worlds.bin_meshes import (
    basket,
    block,
    bowl,
    frustum,
    heights,
    low_front,
    round_bin,
    sheet_bin,
    sloped_bin,
    stepped_bin,
    tote,
    wall_of_floor,
    walls,
)

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


# ---- floors and openings of bins whose walls lean, that are turned in their files, or have holes ----


FLOOR, HEIGHT = (0.412, 0.262), 0.176
MIN_LIFT = 5e-3
"""What lies higher is too long for the floor [m]."""
DIVIDER = trimesh.convex.convex_hull(
    np.array(
        [
            (x + 0.05, end * (0.131 + z * np.tan(np.radians(12))), z)
            for end in (-1, 1)
            for x, z in ((-0.03, 0), (0.03, 0), (-3e-3, 0.1), (3e-3, 0.1))
        ]
    )
)
"""A wedge across a `frustum`: from x = 0.02 to 0.08 on the floor, 0.1 m high [m]."""
DIVIDED = trimesh.util.concatenate([frustum(), DIVIDER])


def read_sizes(tmp_path, mesh, **settings) -> tuple[BinModel, BinSizes]:
    """Bin of a mesh, and its sizes."""
    mesh.export(tmp_path / "own.stl")
    row = BinRow(name="own", file=str(tmp_path / "own.stl"), **settings)
    model = read_bin(row)
    return model, BinSizes.of_row(BinRow(name="own", file=row.file, measured=model.measured))


def opening_of(drafts) -> list[float]:
    """Sides of the opening of a `frustum`."""
    return list(np.array(FLOOR) + HEIGHT * np.tan(np.radians(drafts)).reshape(2, 2).sum(axis=1))


@pytest.mark.parametrize("more", [{}, {"radius": 0.03}, {"wall": 0.0}, {"wall": 0.03}], ids=["sharp", "rounded", "sheet", "thick"])
@pytest.mark.parametrize("drafts", [(1,) * 4, (5, 20, 10, 0), (15, 15, 0, 0), (30,) * 4, (45,) * 4], ids=str)
def test_floor_and_opening_are_those_of_a_frustum(tmp_path, drafts, more):
    model, sizes = read_sizes(tmp_path, frustum(drafts=drafts, **more))
    np.testing.assert_allclose(sizes.floor, FLOOR, atol=5e-4)
    np.testing.assert_allclose(sizes.opening, opening_of(drafts), atol=1e-3)
    shift = HEIGHT * (np.tan(np.radians(drafts)).reshape(2, 2) @ (0.5, -0.5))
    (floor,), (mouth,) = sizes.floors, sizes.openings
    np.testing.assert_allclose(floor[:2], shift, atol=1e-3)
    np.testing.assert_allclose((*floor[4:], *mouth[:2], sizes.height), (0, 0, 0, 0, 0, HEIGHT), atol=1e-3)
    least = np.array(FLOOR) - 2 * more.get("radius", 0.0)
    assert (np.array(floor[2:4]) > least - 1e-4).all()
    assert (np.array(floor[2:4]) < np.array(FLOOR) + 1e-4).all()
    shown = " x ".join(f"{1e3 * side:.4g}" for side in model.measured.floor or ())
    assert f"; floor {shown} mm, opening " in model.notes[0]


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize(("angle", "found"), [(3, 3), (30, 30), (60, 60), (90, None), (100, -80), (200, 20)])
def test_a_turned_bin_has_its_own_sides(tmp_path, angle, found, flip):
    """Its frame lies along them; in the world it is where the mesh is."""
    mesh = frustum(drafts=(5, 20, 10, 0)).apply_transform(TURN(np.radians(angle), (0, 0, 1))).apply_translation((0.3, -0.2, 0.5))
    if flip:
        mesh.invert()
    model, sizes = read_sizes(tmp_path, mesh, place="file")
    assert model.measured.yaw == pytest.approx(found, abs=1e-3) if found else model.measured.yaw is None
    expected = [FLOOR, opening_of((5, 20, 10, 0))]
    sides = np.array([sizes.floor, sizes.opening])
    np.testing.assert_allclose(sides if found else sides[:, ::-1], expected, atol=5e-4)
    there = np.array([sizes.to_world(point) for point in model.mesh.vertices.astype(float)])
    apart = np.linalg.norm(there[:, None] - mesh.vertices, axis=2).min(axis=1)
    assert apart.max() < 1e-5
    np.testing.assert_allclose(sizes.to_frame(sizes.to_world((0.1, 0.2, 0.3))), (0.1, 0.2, 0.3), atol=1e-12)
    assert np.ptp(sizes.corners, axis=0)[2] == pytest.approx(0.18)


@pytest.mark.parametrize(("unit", "scale"), [("mm", 1000.0), ("cm", 100.0), ("in", 1 / 0.0254)])
def test_units_and_axes_do_not_matter(tmp_path, unit, scale):
    mesh = frustum().apply_transform(TURN(np.pi / 2, (1, 0, 0))).apply_scale(scale)
    _, sizes = read_sizes(tmp_path, mesh, unit=unit, up="-y")
    np.testing.assert_allclose([sizes.floor, sizes.opening], [FLOOR, opening_of((12,) * 4)], atol=5e-4)


@pytest.mark.parametrize("wall", [0.0, 0.004, 0.03])
@pytest.mark.parametrize(("hole", "said"), [(0.005, None), (0.01, None), (0.03, 30), (0.1, 100), (0.2, 200)])
def test_a_hole_is_named_and_the_floor_stays_where_it_is(tmp_path, hole, wall, said):
    model, sizes = read_sizes(tmp_path, frustum(hole=hole, wall=wall))
    np.testing.assert_allclose((*sizes.floor, sizes.base, sizes.height), (*FLOOR, -wall, HEIGHT), atol=5e-4)
    np.testing.assert_allclose(sizes.floors[0][2:], (*FLOOR, 0, 0, 0), atol=5e-4)
    found = [line for line in model.notes if "hole" in line]
    assert bool(found) == bool(said)
    if said:
        assert "parts that fall through will lie on the table" in found[0]
        assert float(found[0].split("of up to ")[1].split(" x ")[0]) == pytest.approx(said, abs=3.0)


def test_without_a_floor_parts_lie_on_the_table(tmp_path):
    for mesh in (trimesh.util.concatenate(walls(0.39, 0.29, 0.12, 0.005)), frustum(floor=(0.1, 0.1), drafts=(40,) * 4, hole=0.098)):
        model, sizes = read_sizes(tmp_path, mesh)
        assert model.notes[1] == "bin own: it has no floor: parts will lie on the table"
        assert sizes.base == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize(
    ("mesh", "rooms"),
    [
        (frustum(), 1),
        (frustum(radius=0.05, drafts=(40,) * 4), 1),
        (frustum(floor=(0.1, 0.1), radius=0.05, drafts=(40,) * 4), 1),
        (frustum().apply_transform(TURN(0.5, (0, 0, 1))), 1),
        (stepped_bin(), 1),
        (trimesh.util.concatenate([stepped_bin(), block((-0.2, -0.15, -0.002), (-0.1, 0.15, 0.06))]), 1),
        (low_front(), 1),
        (tote(), 1),
        (DIVIDED, 2),
    ],
    ids=["frustum", "rounded", "funnel", "turned", "step", "steps", "drains", "tote", "divider"],
)
def test_waypoints_and_objects_keep_to_the_floor(tmp_path, mesh, rooms):
    """Waypoints are as high above the mesh as is set; laid out objects touch it, and nothing of them is below."""
    model, sizes = read_sizes(tmp_path, mesh)
    assert len(sizes.floors) == rooms
    corners = np.array(sizes.waypoints(0.75, 0.02)).reshape(-1, 3)
    np.testing.assert_allclose(corners[:, 2] - heights(model.mesh, corners[:, :2]), 0.02, atol=1e-3)
    objects = procedural_objects()
    laid = lay_out(objects, sizes)
    assert laid.indices
    for index, place in zip(laid.indices, laid.positions, strict=True):
        points = objects[index].mesh.vertices.astype(float) + place
        gap = (points[:, 2] - heights(model.mesh, points[:, :2])).min()
        assert gap > -2e-3
        assert gap < 2e-3 or points[:, 2].min() > MIN_LIFT


def test_what_is_longer_than_the_floor_lies_between_the_walls(tmp_path):
    _, sizes = read_sizes(tmp_path, frustum(floor=(0.06, 0.06), drafts=(30,) * 4))
    bar = max(procedural_objects(), key=lambda raw: float(np.ptp(raw.mesh.vertices[:, 0])))
    (place,) = lay_out([bar], sizes).positions
    points = bar.mesh.vertices.astype(float) + place
    room = 0.03 + points[:, 2:].min() * np.tan(np.radians(30))
    assert np.abs(points[:, :2]).max() == pytest.approx(room - 0.01, abs=1e-3)


@pytest.mark.parametrize(("draft", "angle"), [(0, 0), (15, 0), (30, 25)])
def test_a_basket_collides_as_a_closed_box_on_request(tmp_path, draft, angle):
    mesh = basket(draft).apply_transform(TURN(np.radians(angle), (0, 0, 1)))
    model, sizes = read_sizes(tmp_path, mesh, collision="box")
    assert model.notes[1] == "bin own: it collides as a closed box; nothing falls through its holes"
    rise = np.tan(np.radians(draft)) * 0.15
    np.testing.assert_allclose(sizes.floor, (0.396, 0.296), atol=0.015)
    np.testing.assert_allclose(sizes.opening, (0.4 + 2 * rise, 0.3 + 2 * rise), atol=5e-3)
    assert len(model.pieces) == 5
    assert len(model.mesh.faces) > 1000
    with pytest.raises(ConfigError, match=r'or set collision = "box", which closes its holes'):
        read_sizes(tmp_path, basket(draft, gap=0.06, sections=6))


@pytest.mark.parametrize("mesh", [frustum(drafts=(5, 20, 10, 0)), DIVIDED], ids=["unequal", "divider"])
def test_a_closed_box_is_as_the_mesh(tmp_path, mesh):
    """The collision shapes of a closed box fill what those of the mesh fill, along vertical rays."""
    model, sizes = read_sizes(tmp_path, mesh, collision="box")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (3000, 2)) * (np.array(sizes.opening) - 0.01)
    solids = [trimesh.Trimesh(piece.vertices, piece.faces) for piece in model.pieces]
    top = np.max([heights(solid, points) for solid in solids], axis=0)
    apart = np.abs(top - heights(model.mesh, points))
    assert np.quantile(apart, 0.98) < 3e-3


def test_a_tool_that_does_not_come_down_between_leaning_walls_is_refused(tmp_path):
    frustum(floor=(0.06, 0.06), drafts=(30,) * 4).export(tmp_path / "own.stl")
    rows = f'preset = "smoke"\n[bake]\nmode = "move"\n[bins]\nkind = "own"\n[[bin]]\nname = "own"\nfile = "{tmp_path / "own.stl"}"\n'
    tool = '[gripper]\nkind = "suction_array"\ncups = [[-0.04, 0.0], [0.04, 0.0]]\n'
    for text, fails in ((rows, False), (rows + tool, True), ((rows + tool).replace('"move"', '"pick"'), False)):
        (tmp_path / "own.toml").write_text(text)
        config = load_config(str(tmp_path / "own.toml"))
        if fails:
            # 2 (0.04 + 0.021) = 0.06 + 2 h tan(30°)
            with pytest.raises(
                ConfigError, match=r"move.height is 0.02 .*; allowed: at least 0.0537, .*0.122 m wide, fits between the walls"
            ):
                override_config(config, measure_bins(config.bin))
        else:
            override_config(config, measure_bins(config.bin))


def test_upright_walls_need_no_other_keys(tmp_path):
    """So that settings of data sets stay as they were."""
    model, _ = read_sizes(tmp_path, frustum(drafts=(0,) * 4))
    assert isinstance(model.measured, MeasuredBin)
    assert (model.measured.yaw, model.measured.floor, model.measured.openings) == (None, None, None)


def test_compartments_between_leaning_dividers(tmp_path):
    _, sizes = read_sizes(tmp_path, DIVIDED)
    np.testing.assert_allclose(sizes.floor, FLOOR, atol=5e-4)
    np.testing.assert_allclose([one[:4] for one in sizes.floors], [(-0.093, 0, 0.226, 0.262), (0.143, 0, 0.126, 0.262)], atol=5e-4)
