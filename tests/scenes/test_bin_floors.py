"""Floors and openings of bins whose walls lean, that are turned in their files, or have holes; and what follows from them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from synpick_warp.apps.viz.cell.rendering import lay_out
from synpick_warp.configs.cell.bins import BinRow, MeasuredBin
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.files.load import load_config, override_config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes.reading import BinModel, measure_bins, read_bin
from synpick_warp.scenes.embedded.objects import procedural_objects
from tests.worlds.bin_meshes import basket, block, frustum, heights, low_front, stepped_bin, tote, walls

TURN = trimesh.transformations.rotation_matrix
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


def read(tmp_path, mesh, **settings) -> tuple[BinModel, BinSizes]:
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
    model, sizes = read(tmp_path, frustum(drafts=drafts, **more))
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
    model, sizes = read(tmp_path, mesh, place="file")
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
    _, sizes = read(tmp_path, mesh, unit=unit, up="-y")
    np.testing.assert_allclose([sizes.floor, sizes.opening], [FLOOR, opening_of((12,) * 4)], atol=5e-4)


@pytest.mark.parametrize("wall", [0.0, 0.004, 0.03])
@pytest.mark.parametrize(("hole", "said"), [(0.005, None), (0.01, None), (0.03, 30), (0.1, 100), (0.2, 200)])
def test_a_hole_is_named_and_the_floor_stays_where_it_is(tmp_path, hole, wall, said):
    model, sizes = read(tmp_path, frustum(hole=hole, wall=wall))
    np.testing.assert_allclose((*sizes.floor, sizes.base, sizes.height), (*FLOOR, -wall, HEIGHT), atol=5e-4)
    np.testing.assert_allclose(sizes.floors[0][2:], (*FLOOR, 0, 0, 0), atol=5e-4)
    found = [line for line in model.notes if "hole" in line]
    assert bool(found) == bool(said)
    if said:
        assert "parts that fall through will lie on the table" in found[0]
        assert float(found[0].split("of up to ")[1].split(" x ")[0]) == pytest.approx(said, abs=3.0)


def test_without_a_floor_parts_lie_on_the_table(tmp_path):
    for mesh in (trimesh.util.concatenate(walls(0.39, 0.29, 0.12, 0.005)), frustum(floor=(0.1, 0.1), drafts=(40,) * 4, hole=0.098)):
        model, sizes = read(tmp_path, mesh)
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
    model, sizes = read(tmp_path, mesh)
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
    _, sizes = read(tmp_path, frustum(floor=(0.06, 0.06), drafts=(30,) * 4))
    bar = max(procedural_objects(), key=lambda raw: float(np.ptp(raw.mesh.vertices[:, 0])))
    (place,) = lay_out([bar], sizes).positions
    points = bar.mesh.vertices.astype(float) + place
    room = 0.03 + points[:, 2:].min() * np.tan(np.radians(30))
    assert np.abs(points[:, :2]).max() == pytest.approx(room - 0.01, abs=1e-3)


@pytest.mark.parametrize(("draft", "angle"), [(0, 0), (15, 0), (30, 25)])
def test_a_basket_collides_as_a_closed_box_on_request(tmp_path, draft, angle):
    mesh = basket(draft).apply_transform(TURN(np.radians(angle), (0, 0, 1)))
    model, sizes = read(tmp_path, mesh, collision="box")
    assert model.notes[1] == "bin own: it collides as a closed box; nothing falls through its holes"
    rise = np.tan(np.radians(draft)) * 0.15
    np.testing.assert_allclose(sizes.floor, (0.396, 0.296), atol=0.015)
    np.testing.assert_allclose(sizes.opening, (0.4 + 2 * rise, 0.3 + 2 * rise), atol=5e-3)
    assert len(model.pieces) == 5
    assert len(model.mesh.faces) > 1000
    with pytest.raises(ConfigError, match=r'or set collision = "box", which closes its holes'):
        read(tmp_path, basket(draft, gap=0.06, sections=6))


@pytest.mark.parametrize("mesh", [frustum(drafts=(5, 20, 10, 0)), DIVIDED], ids=["unequal", "divider"])
def test_a_closed_box_is_as_the_mesh(tmp_path, mesh):
    """The collision shapes of a closed box fill what those of the mesh fill, along vertical rays."""
    model, sizes = read(tmp_path, mesh, collision="box")
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
    model, _ = read(tmp_path, frustum(drafts=(0,) * 4))
    assert isinstance(model.measured, MeasuredBin)
    assert (model.measured.yaw, model.measured.floor, model.measured.openings) == (None, None, None)


def test_compartments_between_leaning_dividers(tmp_path):
    _, sizes = read(tmp_path, DIVIDED)
    np.testing.assert_allclose(sizes.floor, FLOOR, atol=5e-4)
    np.testing.assert_allclose([one[:4] for one in sizes.floors], [(-0.093, 0, 0.226, 0.262), (0.143, 0, 0.126, 0.262)], atol=5e-4)
