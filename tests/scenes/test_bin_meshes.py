"""Bins from meshes: what is measured, that collision shapes fill the solid and nothing free, and what is refused."""

import dataclasses
import hashlib

import numpy as np
import pytest
import trimesh

from synpick_warp.apps.viz.cell import lay_out
from synpick_warp.configs.cell.bins import AXES, BinRow, BinSizes, MeasuredBin
from synpick_warp.configs.files.load import config_to_toml, load_config, override_config
from synpick_warp.dataset.commit.manifest import make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.assets.appearance import NO_MATERIAL
from synpick_warp.scenes.bin_meshes import reading
from synpick_warp.scenes.bin_meshes.colliders import MAX_PIECES
from synpick_warp.scenes.bin_meshes.inside import LIMIT_CELLS, _flood
from synpick_warp.scenes.bin_meshes.reading import BinModel, measure_bins, read_bin
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.collision.simplification import hull_piece
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Finish, TriangleMesh
from tests.harness.pieces import filled
from tests.worlds import bin_meshes as meshes
from tests.worlds.bin_meshes import block, frustum, heights, sloped_bin, stepped_bin

TURN, JOIN = trimesh.transformations.rotation_matrix, trimesh.util.concatenate
AROUND_Z = (0, 0, 1)
FLOOR, HEIGHT = (0.412, 0.262), 0.176
"""Of a `frustum` [m]."""
SLOPED, UNEQUAL = (12,) * 4, (5, 20, 10, 0)
"""Drafts of its walls [°]."""
MIN_LIFT = 5e-3
"""What lies higher is too long for the floor [m]."""
PROFILE = [(x + 0.05, z) for x, z in ((-0.03, 0), (0.03, 0), (-3e-3, 0.1), (3e-3, 0.1))]
DIVIDER = trimesh.convex.convex_hull(np.array([(x, end * (0.131 + z * np.tan(np.radians(12))), z) for end in (-1, 1) for x, z in PROFILE]))
"""A wedge across a `frustum`: from x = 0.02 to 0.08 on the floor, 0.1 m high [m]."""
DIVIDED = JOIN([frustum(), DIVIDER])


def model(tmp_path, mesh, name: str = "own.stl", **settings) -> BinModel:
    """Bin of a mesh."""
    mesh.export(tmp_path / name)
    return read_bin(BinRow(name="own", file=str(tmp_path / name), **settings))


def read_sizes(tmp_path, mesh, name: str = "own.stl", **settings) -> tuple[BinModel, BinSizes]:
    """Bin of a mesh, and its sizes."""
    found = model(tmp_path, mesh, name, **settings)
    return found, BinSizes.of_row(BinRow(name="own", file=str(tmp_path / name), measured=found.measured))


def opening_of(drafts) -> list[float]:
    """Sides of the opening of a `frustum`."""
    return list(np.array(FLOOR) + HEIGHT * np.tan(np.radians(drafts)).reshape(2, 2).sum(axis=1))


def test_a_checksum_tells_materials_apart():
    """Bins as they were before files had light and coats keep theirs."""
    solid = trimesh.creation.box((1.0, 1.0, 1.0))
    mesh = TriangleMesh(solid.vertices, solid.faces, solid.vertex_normals, np.zeros((len(solid.vertices), 2)))
    materials = [dataclasses.replace(NO_MATERIAL, **each) for each in ({}, {"finish": Finish(0.5)}, {"emission": (1.0, 0.0, 0.0)})]
    assert len({reading._checksum(mesh, each) for each in materials}) == 3
    state = hashlib.sha256(repr((NO_MATERIAL.color, None, None)).encode())
    for array in (mesh.vertices, mesh.faces, mesh.normals, mesh.uv):
        state.update(np.ascontiguousarray(array).tobytes())
    assert reading._checksum(mesh, NO_MATERIAL) == state.hexdigest()


def test_a_sloped_floor_and_a_divider_are_measured_and_have_shapes(tmp_path):
    """Both faces of the divider, its top and the walls are where the mesh has them, within 0.1 mm."""
    found = model(tmp_path, sloped_bin(rise=0.04, divider=0.1))
    measured, pieces = found.measured, found.pieces
    np.testing.assert_allclose(measured.box, (-0.204, -0.154, -0.004, 0.204, 0.154, 0.2), atol=1e-5)
    np.testing.assert_allclose(measured.opening, (0.4, 0.3), atol=3e-3)
    assert measured.height == pytest.approx(0.2, abs=1e-5)
    left, right = measured.compartments
    np.testing.assert_allclose(left, (-0.0765, 0.0, 0.247, 0.3, 0.1, 0.0, 0.02), atol=3e-3)
    np.testing.assert_allclose(right, (0.1265, 0.0, 0.147, 0.3, 0.1, 0.0, 0.02), atol=3e-3)
    sides = [((x, 0.06), (side, 0)) for x, side in ((0.047, 1), (0.053, -1), (-0.2, -1), (0.2, 1))]
    for (x, z), (out, up) in [*sides, ((0.05, 0.1), (0, -1))]:
        face = np.array([(x, y, z) for y in np.linspace(-0.14, 0.14, 15)])
        into = 1e-4 * np.array([out, 0, up])
        assert filled(pieces, face + into).all(), (x, z)
        assert not filled(pieces, face - into).any(), (x, z)


@pytest.mark.parametrize(
    "mesh",
    [
        sloped_bin().apply_transform(TURN(0.5, AROUND_Z)),
        meshes.round_bin(),
        meshes.round_bin(sections=100),
        meshes.low_front(),
        stepped_bin(),
        meshes.tote(),
    ],
    ids=["turned", "round", "fine", "front", "step", "tote"],
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


@pytest.mark.parametrize(
    ("name", "unit", "scale", "up", "axis", "angle"),
    [
        ("a.stl", "mm", 1000.0, "z", AROUND_Z, 0),
        ("a.ply", "cm", 100.0, "-z", (1, 0, 0), np.pi),
        ("a.obj", "in", 1 / 0.0254, "y", (1, 0, 0), -np.pi / 2),
        ("a.glb", "mm", 1000.0, "x", (0, 1, 0), np.pi / 2),
        ("b.stl", "in", 1 / 0.0254, "-y", (1, 0, 0), np.pi / 2),
    ],
)
def test_any_format_unit_and_axis_gives_the_same_bin(tmp_path, name, unit, scale, up, axis, angle):
    mesh = DIVIDED.copy().apply_scale(scale).apply_transform(TURN(angle, axis))
    found, sizes = read_sizes(tmp_path, mesh, name, unit=unit, up=up)
    assert (found.measured.height, len(found.measured.compartments)) == (pytest.approx(HEIGHT, abs=1e-4), 2)
    np.testing.assert_allclose(np.sort([sizes.floor, sizes.opening]), np.sort([FLOOR, opening_of(SLOPED)]), atol=5e-4)


def test_a_place_as_modelled_is_the_meshs(tmp_path):
    mesh = sloped_bin().apply_translation((0.3, -0.2, 0.5))
    here, there = (model(tmp_path, mesh, place=place).measured for place in ("floor", "file"))
    assert dataclasses.replace(there, origin=(0.0, 0.0, 0.0)) == here
    np.testing.assert_allclose(there.origin, (0.3, -0.2, 0.5), atol=1e-4)


@pytest.mark.parametrize("flip", [False, True])
def test_a_sheet_without_thickness_gets_thick_shapes(tmp_path, flip):
    mesh = meshes.sheet_bin()
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
        (meshes.wall_of_floor(), {}, "has no inside"),
        (meshes.bowl(), {}, r"need \d+ convex collision shapes; allowed: 64; simplify the mesh"),
    ],
)
def test_what_is_no_bin_is_refused_in_one_line(tmp_path, mesh, settings, message):
    with pytest.raises(ConfigError, match=rf"\Abin own: .*{message}.*\Z"):
        model(tmp_path, mesh, **settings)


def test_shapes_that_differ_from_the_mesh_are_refused(tmp_path, monkeypatch):
    """The comparison sees a missing floor, and a piece in the way."""
    whole = reading.make_colliders
    block_in_the_way = hull_piece(block((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1)).vertices)
    for wrong in (lambda *mesh: whole(*mesh)[1:], lambda *mesh: (*whole(*mesh), block_in_the_way)):
        monkeypatch.setattr(reading, "make_colliders", wrong)
        sloped_bin().export(tmp_path / "own.stl")
        with pytest.raises(reading.CatalogError, match=r"collision shapes and mesh differ by more than 3 mm over \d+% of the opening"):
            reading._model(BinRow(name="own", file=str(tmp_path / "own.stl")))


# ---- rows of the settings ----

ROWS = 'preset = "smoke"\n[bins]\nkind = "own"\n[[bin]]\nname = "kanban"\nfile = "bins/kanban.stl"\n'


def read(tmp_path, text=ROWS, mesh=None):
    """Load settings whose bin is a mesh in a folder beside them. `mesh` is written by the first call only."""
    (tmp_path / "bins").mkdir(exist_ok=True)
    if not (tmp_path / "bins" / "kanban.stl").exists():
        (mesh or sloped_bin()).export(tmp_path / "bins" / "kanban.stl")
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
    assert load_config(str(tmp_path / "own.toml")) == config
    moved = measured(dataclasses.replace(config, bin=(dataclasses.replace(config.bin[0], file=str(tmp_path / "moved.stl")),)))
    assert make_manifest(moved) == make_manifest(config)
    sloped_bin(rise=0.03).export(tmp_path / "moved.stl")
    assert make_manifest(measured(moved)) != make_manifest(config)
    with pytest.raises(ConfigError, match="is not the mesh that was measured"):
        make_bins(moved.cell.bins)
    with pytest.raises(ConfigError, match=r"bin kanban: .* cannot be read \(No such file"):
        make_bins(config.cell.bins)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (ROWS + "wall = 0.01", r"bin\[0\].wall is 0.01 .*; allowed: none beside bin.file"),
        (ROWS + "compartments = [2, 1]", r"bin\[0\].compartments is .*; allowed: none beside bin.file"),
        (ROWS + 'unit = "ft"', r'bin\[0\].unit is "ft" .*; allowed: m, cm, mm, in'),
        (ROWS + 'up = "w"', rf'bin\[0\].up is "w" .*; allowed: {", ".join(AXES)}'),
        (ROWS + 'place = "here"', r'bin\[0\].place is "here" .*; allowed: floor, file'),
        (ROWS.replace("file = ", "unit = 'mm' #"), r'bin\[0\].unit is "mm" .*; allowed: none without bin.file'),
    ],
)
def test_a_wrong_row_is_refused(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        read(tmp_path, text)


CLOSE = "place = 'file'\n[pick]\nfloor = -0.6\n[cameras]\npositions = [[0, 0, -0.55]]\nups = [[0, 1, 0]]"


def test_rules_of_other_settings_hold_for_what_is_measured(tmp_path):
    for lines, message in (
        ("[pick]\nlift_height = 0.19", r"pick.lift_height is 0.19 .*; allowed: at least the inner height of the bin, 0.2"),
        ("place = 'file'", r"pick.floor is -0.1 .*; allowed: at most the floor of the bin, -0.5: what is below it is removed"),
        (CLOSE, r"cameras.positions .* z > -0.5,"),
    ):
        config = read(tmp_path, ROWS + lines, sloped_bin().apply_translation((0.0, 0.0, -0.5)))
        with pytest.raises(ConfigError, match=message):
            measured(config)


def test_a_tool_that_does_not_come_down_between_leaning_walls_is_refused(tmp_path):
    funnel = frustum(floor=(0.06, 0.06), drafts=(30,) * 4)
    tool = '[gripper]\nkind = "suction_array"\ncups = [[-0.04, 0.0], [0.04, 0.0]]\n'
    for text in (ROWS + '[bake]\nmode = "move"\n', ROWS + tool + '[bake]\nmode = "pick"\n'):
        measured(read(tmp_path, text, funnel))
    # 2 (0.04 + 0.021) = 0.06 + 2 h tan(30°)
    with pytest.raises(ConfigError, match=r"move.height is 0.02 .*; allowed: at least 0.0537, .*0.122 m wide, fits between the walls"):
        measured(read(tmp_path, ROWS + tool + '[bake]\nmode = "move"\n', funnel))


# ---- floors and openings of bins whose walls lean, that are turned in their files, or have holes ----


@pytest.mark.parametrize(
    ("drafts", "more"),
    [
        *((drafts, {}) for drafts in ((1,) * 4, UNEQUAL, (15, 15, 0, 0))),
        *((UNEQUAL, more) for more in ({"radius": 0.03}, {"wall": 0.0}, {"wall": 0.03})),
        ((45,) * 4, {"wall": 0.03}),
    ],
)
def test_floor_and_opening_are_those_of_a_frustum(tmp_path, drafts, more):
    found, sizes = read_sizes(tmp_path, frustum(drafts=drafts, **more))
    np.testing.assert_allclose(sizes.floor, FLOOR, atol=5e-4)
    np.testing.assert_allclose(sizes.opening, opening_of(drafts), atol=1e-3)
    shift = HEIGHT * (np.tan(np.radians(drafts)).reshape(2, 2) @ (0.5, -0.5))
    (floor,), (mouth,) = sizes.floors, sizes.openings
    np.testing.assert_allclose(floor[:2], shift, atol=1e-3)
    np.testing.assert_allclose((*floor[4:], *mouth[:2], sizes.height), (0, 0, 0, 0, 0, HEIGHT), atol=1e-3)
    least = np.array(FLOOR) - 2 * more.get("radius", 0.0)
    assert (np.array(floor[2:4]) > least - 1e-4).all()
    assert (np.array(floor[2:4]) < np.array(FLOOR) + 1e-4).all()
    shown = " x ".join(f"{1e3 * side:.4g}" for side in found.measured.floor or ())
    assert f"; floor {shown} mm, opening " in found.notes[0]


def test_upright_walls_need_no_other_keys(tmp_path):
    """So that settings of data sets stay as they were."""
    measured = model(tmp_path, frustum(drafts=(0,) * 4)).measured
    assert isinstance(measured, MeasuredBin)
    assert (measured.yaw, measured.floor, measured.openings) == (None, None, None)


@pytest.mark.parametrize(("angle", "yaw", "flip"), [(3, 3, False), (30, 30, True), (90, None, False), (100, -80, True)])
def test_a_turned_bin_has_its_own_sides(tmp_path, angle, yaw, flip):
    """Its frame lies along them; in the world it is where the mesh is."""
    mesh = frustum(drafts=UNEQUAL).apply_transform(TURN(np.radians(angle), AROUND_Z)).apply_translation((0.3, -0.2, 0.5))
    if flip:
        mesh.invert()
    found, sizes = read_sizes(tmp_path, mesh, place="file")
    assert found.measured.yaw == pytest.approx(yaw, abs=1e-3) if yaw else found.measured.yaw is None
    sides = np.array([sizes.floor, sizes.opening])
    np.testing.assert_allclose(sides if yaw else sides[:, ::-1], [FLOOR, opening_of(UNEQUAL)], atol=5e-4)
    there = np.array([sizes.to_world(point) for point in found.mesh.vertices.astype(float)])
    assert np.linalg.norm(there[:, None] - mesh.vertices, axis=2).min(axis=1).max() < 1e-5
    np.testing.assert_allclose(sizes.to_frame(sizes.to_world((0.1, 0.2, 0.3))), (0.1, 0.2, 0.3), atol=1e-12)
    assert np.ptp(sizes.corners, axis=0)[2] == pytest.approx(0.18)


@pytest.mark.parametrize(
    ("wall", "hole", "said"), [(0.004, 0.01, None), (0.004, 0.2, 200), (0.0, 0.01, None), (0.0, 0.03, 30), (0.03, 0.03, 30)]
)
def test_a_hole_is_named_and_the_floor_stays_where_it_is(tmp_path, hole, wall, said):
    found, sizes = read_sizes(tmp_path, frustum(hole=hole, wall=wall))
    np.testing.assert_allclose((*sizes.floor, sizes.base, sizes.height), (*FLOOR, -wall, HEIGHT), atol=5e-4)
    np.testing.assert_allclose(sizes.floors[0][2:], (*FLOOR, 0, 0, 0), atol=5e-4)
    lines = [line for line in found.notes if "hole" in line]
    assert bool(lines) == bool(said)
    if said:
        assert "parts that fall through will lie on the table" in lines[0]
        assert float(lines[0].split("of up to ")[1].split(" x ")[0]) == pytest.approx(said, abs=3.0)


def test_without_a_floor_parts_lie_on_the_table(tmp_path):
    for mesh in (JOIN(meshes.walls(0.39, 0.29, 0.12, 0.005)), frustum(floor=(0.1, 0.1), drafts=(40,) * 4, hole=0.098)):
        found, sizes = read_sizes(tmp_path, mesh)
        assert found.notes[1] == "bin own: it has no floor: parts will lie on the table"
        assert sizes.base == pytest.approx(0.0, abs=1e-6)


COMPARTMENTS = [(-0.093, 0, 0.226, 0.262), (0.143, 0, 0.126, 0.262)]
"""Of DIVIDED: middle and sides."""


@pytest.mark.parametrize(
    ("mesh", "rooms"),
    [
        (frustum(radius=0.05, drafts=(40,) * 4), 1),
        (frustum(floor=(0.1, 0.1), radius=0.05, drafts=(40,) * 4), 1),
        (frustum().apply_transform(TURN(0.5, AROUND_Z)), 1),
        (JOIN([stepped_bin(), block((-0.2, -0.15, -0.002), (-0.1, 0.15, 0.06))]), 1),
        (meshes.low_front(), 1),
        (meshes.tote(), 1),
        (DIVIDED, 2),
    ],
    ids=["rounded", "funnel", "turned", "steps", "drains", "tote", "divider"],
)
def test_waypoints_and_objects_keep_to_the_floor(tmp_path, mesh, rooms):
    """Waypoints are as high above the mesh as is set; laid out objects touch it, and nothing of them is below."""
    found, sizes = read_sizes(tmp_path, mesh)
    assert len(sizes.floors) == rooms
    if rooms > 1:
        np.testing.assert_allclose(sizes.floor, FLOOR, atol=5e-4)
        np.testing.assert_allclose([one[:4] for one in sizes.floors], COMPARTMENTS, atol=5e-4)
    corners = np.array(sizes.waypoints(0.75, 0.02)).reshape(-1, 3)
    np.testing.assert_allclose(corners[:, 2] - heights(found.mesh, corners[:, :2]), 0.02, atol=1e-3)
    objects = procedural_objects()
    laid = lay_out(objects, sizes)
    assert laid.indices
    for index, place in zip(laid.indices, laid.positions, strict=True):
        points = objects[index].mesh.vertices.astype(float) + place
        gap = (points[:, 2] - heights(found.mesh, points[:, :2])).min()
        assert gap > -2e-3
        assert gap < 2e-3 or points[:, 2].min() > MIN_LIFT


def test_what_is_longer_than_the_floor_lies_between_the_walls(tmp_path):
    _, sizes = read_sizes(tmp_path, frustum(floor=(0.06, 0.06), drafts=(30,) * 4))
    bar = max(procedural_objects(), key=lambda raw: float(np.ptp(raw.mesh.vertices[:, 0])))
    (place,) = lay_out([bar], sizes).positions
    points = bar.mesh.vertices.astype(float) + place
    room = 0.03 + points[:, 2:].min() * np.tan(np.radians(30))
    assert np.abs(points[:, :2]).max() == pytest.approx(room - 0.01, abs=1e-3)


@pytest.mark.parametrize(("draft", "angle"), [(0, 0), (30, 25)])
def test_a_basket_collides_as_a_closed_box_on_request(tmp_path, draft, angle):
    mesh = meshes.basket(draft, sections=4).apply_transform(TURN(np.radians(angle), AROUND_Z))
    found, sizes = read_sizes(tmp_path, mesh, collision="box")
    assert found.notes[1] == "bin own: it collides as a closed box; nothing falls through its holes"
    rise = np.tan(np.radians(draft)) * 0.15
    np.testing.assert_allclose(sizes.floor, (0.396, 0.296), atol=0.015)
    np.testing.assert_allclose(sizes.opening, (0.4 + 2 * rise, 0.3 + 2 * rise), atol=5e-3)
    assert len(found.pieces) == 5
    assert len(found.mesh.faces) > 1000
    if draft == 0:
        with pytest.raises(ConfigError, match=r'or set collision = "box", which closes its holes'):
            read_sizes(tmp_path, meshes.basket(gap=0.06, sections=4))


@pytest.mark.parametrize("mesh", [frustum(drafts=UNEQUAL), DIVIDED], ids=["unequal", "divider"])
def test_a_closed_box_is_as_the_mesh(tmp_path, mesh):
    """The collision shapes of a closed box fill what those of the mesh fill, along vertical rays."""
    found, sizes = read_sizes(tmp_path, mesh, collision="box")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (3000, 2)) * (np.array(sizes.opening) - 0.01)
    top = np.max([heights(trimesh.Trimesh(piece.vertices, piece.faces), points) for piece in found.pieces], axis=0)
    assert np.quantile(np.abs(top - heights(found.mesh, points)), 0.98) < 3e-3


def test_a_pool_fills_to_the_lowest_notch_of_its_rim():
    height = np.zeros((9, 8))
    height[2:7, 2:7], height[3:6, 3:6], height[4, 6] = 3.0, 1.0, 2.0
    np.testing.assert_array_equal(_flood(height), np.where(height == 1.0, 2.0, height))
