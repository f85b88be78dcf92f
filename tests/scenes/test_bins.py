"""Bins (tote, pallet, table, custom rows): ray casts show that visual meshes and collision shapes agree; settings. Gripper heads of all
kinds: closed meshes, positions of the cups, extents of the collision shapes equal to those of the visual meshes."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.gripper import GRIPPERS
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.configs.schema import Gripper, Tote
from synpick_warp.dataset.commit.manifest import describe_differences, make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.scenes.bins import CORNER_RADIUS, FLOOR_DEPTH, MIN_WALL, guide_walls, make_bins, rim_height, tote_colliders, tote_fixture
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.grippers import HEADS, check_reach, finger_collider, finger_fixture, make_head
from synpick_warp.scenes.modelling import at_height, cap, join, loft, make_mesh, rounded_rectangle, strips
from synpick_warp.scenes.props import measure_tool
from synpick_warp.stages.sim.behavior import BEHAVIORS
from tests.harness.pieces import assert_closed, felt, filled, is_convex
from tests.twins.raycast import edges_match, first_hit
from tests.worlds.small_worlds import catalog

TOTE = Tote()
MESH = tote_fixture(TOTE).mesh
UP, DOWN = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
TOP = rim_height(TOTE)
GRAIN = 1e-6
"""Depth at which a point is inside a piece [m]."""


def seen(origin, direction):
    """Distance along a ray to the tote's visual mesh [m]."""
    return first_hit(MESH.vertices, MESH.faces, origin, direction)


def inner_sizes(share):
    """Length and width of the tote's inside at a share of its height [m]."""
    return tuple(low + share * (high - low) for low, high in zip(TOTE.floor_size, TOTE.rim_size, strict=True))


# ---- the tote ----


def test_rays_meet_floor_walls_and_flange_where_the_settings_have_them():
    assert_closed(MESH)
    assert tote_fixture(TOTE).material.texture is None
    assert seen((0.01, 0.02, 1.0), DOWN) == pytest.approx(1.0, abs=1e-6)
    assert seen((0.01, 0.02, -1.0), UP) == pytest.approx(1.0 - TOTE.wall, abs=1e-6)
    for axis, height in itertools.product((0, 1), (1e-4, 0.5 * TOP, TOP - 1e-4)):
        across = tuple(float(axis == k) for k in range(3))
        # A little off the middle, so that no ray runs along an edge.
        start = (0.003 * (1 - axis), 0.003 * axis, height) if axis else (0.0, 0.003, height)
        width = seen(start, across) + seen(start, tuple(-k for k in across))
        assert width == pytest.approx(inner_sizes(height / TOP)[axis], abs=2e-6)
    # Half-way up, and between two ribs; the draft makes the level path through a wall a little longer than its thickness.
    within, outside = seen((0.0, 0.003, 0.03), (1.0, 0.0, 0.0)), seen((1.0, 0.003, 0.03), (-1.0, 0.0, 0.0))
    slope = (TOTE.rim_size[0] - TOTE.floor_size[0]) / 2 / TOP
    assert 1.0 - outside - within == pytest.approx(TOTE.wall, abs=TOTE.wall * slope)
    assert np.allclose(np.ptp(MESH.vertices, axis=0), TOTE.outer_size, atol=2e-6)
    assert MESH.vertices[:, 2].max() == pytest.approx(TOP, abs=1e-6)
    for x in (TOTE.rim_size[0] / 2 + 0.002, TOTE.outer_size[0] / 2 - 0.002):
        assert seen((x, 0.05, 1.0), DOWN) == pytest.approx(1.0 - TOP, abs=1e-6)


def test_the_inside_of_the_tote_is_empty():
    half = np.column_stack(inner_sizes(np.clip(MESH.vertices[:, 2] / TOP, 0, 1))) / 2
    across = np.abs(MESH.vertices[:, :2])
    free = (across < half - 1e-5).all(axis=1) & (MESH.vertices[:, 2] > 1e-6)
    corner = (across > half - 0.03).all(axis=1)
    assert not (free & ~corner).any()


@pytest.mark.parametrize("direction", [(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0), DOWN])
@pytest.mark.parametrize("height", [0.001, 0.07, 0.15, TOP - 0.001])
def test_collision_shapes_coincide_with_the_visual_mesh(direction, height):
    origin = (0.011, 0.017, height)
    assert felt(tote_colliders(TOTE), origin, direction) == pytest.approx(seen(origin, direction), abs=2e-6)


def test_collision_shapes_are_convex_and_reach_around_the_tote():
    floor, *walls = tote_colliders(TOTE)
    assert all(is_convex(piece) for piece in (floor, *walls, *guide_walls(BinSizes.of_tote(TOTE), 2.0)))
    assert (floor.vertices[:, 2].min(), floor.vertices[:, 2].max()) == (pytest.approx(-FLOOR_DEPTH), 0)
    assert [wall.vertices[:, 2].max() for wall in walls] == pytest.approx([TOP] * 8)
    reach = np.abs(np.concatenate([wall.vertices for wall in walls])).max(axis=0)[:2]
    assert reach == pytest.approx(np.maximum(np.array(TOTE.outer_size[:2]) / 2, np.array(TOTE.rim_size) / 2 + MIN_WALL))


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(1e-4, 1.0))
def test_collision_shapes_leave_the_inside_free_and_fill_the_walls(x, y, share):
    half = [size / 2 for size in inner_sizes(share)]
    within = np.array([[2 * x * (half[0] - 1e-4), 2 * y * (half[1] - 1e-4), share * TOP]])
    radius = CORNER_RADIUS + share * min(high - low for low, high in zip(TOTE.floor_size, TOTE.rim_size, strict=True)) / 2
    # A plane at 45° touches the corner's round: it cuts (2 - √2) r off both sides.
    beyond = (2 - 2**0.5) * radius - sum(half[axis] - abs(within[0, axis]) for axis in (0, 1))
    if abs(beyond) > 1e-5:
        assert filled(tote_colliders(TOTE), within, GRAIN).any() == (beyond > 0)
    wall = np.array([[half[0] + 0.005, 2 * y * half[1], 0.99 * share * TOP], [2 * x * half[0], -half[1] - 0.005, 0.99 * share * TOP]])
    assert filled(tote_colliders(TOTE), wall, GRAIN).all()


def test_guide_walls_stand_on_the_rim_flush_with_the_opening():
    walls = guide_walls(BinSizes.of_tote(TOTE), 2.0)
    assert len(walls) == 4
    levels = np.concatenate([wall.vertices for wall in walls])[:, 2]
    assert (levels.min(), levels.max()) == pytest.approx((TOP, TOP + 2.0))
    for axis, sign in itertools.product((0, 1), (1.0, -1.0)):
        direction = tuple(sign * float(axis == k) for k in range(3))
        found = felt(walls, (0.013, 0.017, 1.0), direction)
        assert found == pytest.approx(TOTE.rim_size[axis] / 2 - sign * (0.013, 0.017)[axis], abs=1e-6)
    # No gap between neighbours.
    assert filled(walls, np.array([[TOTE.rim_size[0] / 2 + 0.05, TOTE.rim_size[1] / 2 + 0.05, 1.0]]), GRAIN).all()


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"rim_size": (0.61, 0.352)}, "tote.rim_size"),
        ({"floor_size": (0.55, 0.319)}, "tote.floor_size"),
        ({"floor_size": (0.513, 0.03)}, "tote.floor_size"),
        ({"outer_size": (0.615, 0.373, 0.01)}, "tote.outer_size"),
    ],
)
def test_invalid_totes_are_refused(change, field):
    for build in (tote_fixture, tote_colliders):
        with pytest.raises(ConfigError, match=field):
            build(replace(TOTE, **change))


def test_a_narrow_flange_leaves_a_closed_tote():
    tote = replace(TOTE, outer_size=(0.560, 0.366, 0.2))
    mesh = tote_fixture(tote).mesh
    assert_closed(mesh)
    assert np.allclose(np.ptp(mesh.vertices, axis=0), tote.outer_size, atol=2e-6)


def areas(patch):
    """Signed areas (n) of a flat patch's triangles, seen from above."""
    a, b, c = np.moveaxis(np.asarray(patch.corners, dtype=np.float64)[..., :2], 1, 0)
    return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])


@given(width=st.floats(0.1, 1.0), depth=st.floats(0.1, 1.0), share=st.floats(0.1, 0.9), segments=st.integers(2, 8), below=st.booleans())
def test_strips_cover_the_same_area_as_a_fan_and_close_a_solid(width, depth, share, segments, below):
    radius = share * min(width, depth) / 2
    outline = rounded_rectangle(width, depth, radius, segments)
    ring = at_height(outline, 0.3)
    strip, fan = (areas(close(ring, below=below)) for close in (strips, cap))
    sign = -1.0 if below else 1.0
    assert (sign * strip > 0.0).all()
    np.testing.assert_allclose(strip.sum(), fan.sum(), rtol=1e-9)
    # The rectangle without what its round corners lack.
    area = width * depth - 4 * radius**2 * (1 - segments * np.sin(np.pi / 2 / segments) / 2)
    np.testing.assert_allclose(sign * strip.sum(), area, rtol=1e-9)
    rings = np.stack([at_height(outline, 0.0), ring])
    mesh = make_mesh(join(strips(rings[0], below=True), loft(rings), strips(ring)), centered=False)
    vertices, faces = merge_positions(mesh.vertices, mesh.faces)
    assert edges_match(faces)
    assert signed_volume(vertices, faces) == pytest.approx(0.3 * area, rel=1e-5)


# ---- other kinds ----


def made(**settings):
    config = load_config("smoke", {f"bins.{name}": value for name, value in settings.items()})
    return make_bins(config.cell.bins)


def test_a_pallet_is_closed_and_its_box_holds_its_boards():
    (pallet,) = made(kind="pallet", area=[0.3, 0.2], pallet_size=[0.5, 0.4, 0.1])
    assert_closed(pallet.fixture.mesh)
    (box,) = pallet.pieces
    for points in (pallet.fixture.mesh.vertices, box.vertices):
        np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.25, -0.2, -0.1], [0.25, 0.2, 0.0]], atol=1e-6)
    assert pallet.sizes.base == -0.1


def test_a_table_has_no_shapes_and_guides_around_its_area():
    (table,) = made(kind="none", area=[0.3, 0.2])
    assert (table.pieces, table.sizes.is_visible, table.sizes.base) == ((), False, 0.0)
    inner = [np.abs(wall.vertices).min(axis=0) for wall in guide_walls(table.sizes, 2.0)]
    assert sorted({round(float(value), 6) for wall in inner for value in wall} - {0.0}) == [0.1, 0.15, 0.2, 0.25]


ROWS = """preset = "smoke"
[bins]
kind = "own"
[[bin]]
name = "kanban"
rim_size = [0.54, 0.35]
compartments = [2, 3]
[[bin]]
name = "flat"
outer_size = [0.615, 0.373, 0.05]
wall = 0.006
"""


def read(tmp_path, text=ROWS):
    (tmp_path / "own.toml").write_text(text)
    return load_config(str(tmp_path / "own.toml"))


def test_rows_are_bins_and_are_written_back(tmp_path):
    config = read(tmp_path)
    first, second = config.cell.bins
    assert (first.name, second.name, second.height, first.compartments) == ("kanban", "flat", 0.05 - 0.006, (2, 3))
    assert read(tmp_path, config_to_toml(config)) == config
    assert config.cell.recorded == ("kanban", "flat")
    assert "bin" in make_manifest(config)["settings"]


def test_compartments_are_equal_and_dividers_fill_what_is_between_them(tmp_path):
    kanban, flat = make_bins(read(tmp_path).cell.bins)
    assert_closed(kanban.fixture.mesh)
    assert (kanban.fixture.interior, flat.fixture.interior is None) == (None, False)
    assert len(kanban.pieces) == len(flat.pieces) + 3
    assert all(is_convex(piece) for piece in kanban.pieces)
    sizes, dividers = kanban.sizes, kanban.pieces[len(flat.pieces) :]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 2)) * sizes.floor
    apart = np.abs(points[:, None] - np.array(sizes.openings)[:, :2]) - np.array(sizes.cell) / 2
    free = (apart < -1e-4).all(axis=2).any(axis=1)
    between = (apart > 1e-4).any(axis=2).all(axis=1)
    solid = filled(dividers, np.column_stack([points, np.full(len(points), 0.05)]), GRAIN)
    assert not solid[free].any()
    assert solid[between].all()
    assert free.mean() == pytest.approx(6 * np.prod(sizes.cell) / np.prod(sizes.floor), abs=0.02)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('kind = "own"', 'kind = "tote"', r'bins.kind is "tote" .*; allowed: own with \[\[bin\]\] tables'),
        ('name = "flat"', 'name = "kanban"', r'bin\[0\].name is "kanban" .*; allowed: .* other than those of other bins'),
        ('name = "flat"', 'name = "a/b"', r'bin\[1\].name is "a/b" .*; allowed: lower-case letters'),
        ('name = "flat"', 'name = "pallet"', r'bin\[1\].name is "pallet" .*; allowed: .* not tote, table, pallet'),
        ('name = "flat"', "weight = 1.0", r"bin\[1\] has no name .*; a row needs name"),
        ("[2, 3]", "[2, 7]", r"bin\[0\].compartments is .*; allowed: .* 6"),
        ("[2, 3]", "[6, 6]\ndivider_height = 0.3", r"bin\[0\].divider_height is 0.3 .*; allowed: at most the height of the rim, 0.1955 "),
        ("[2, 3]", "[2, 3]\nfloor_size = [0.08, 0.1]", r"bin\[0\].compartments is .*; allowed: compartments of at least 0.03 m"),
        ("wall = 0.006", "wall = 0.06", r"bin\[1\].outer_size is .*; allowed: at least bin\[1\].rim_size and two walls"),
        ("wall = 0.006", "weight = -1.0", r"bin\[1\].weight is -1.0 .*; allowed: "),
        ("wall = 0.006", "colour = [1, 1, 1]", r"there is no key bin\[1\].colour"),
    ],
)
def test_a_wrong_row_is_refused_in_one_line(tmp_path, old, new, message):
    with pytest.raises(ConfigError, match=rf"\A{message}.*\Z"):
        read(tmp_path, ROWS.replace(old, new))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "crate"}, 'bins.kind is "crate" .*; allowed: tote, own, none, pallet'),
        ({"area": [0.0, 0.3]}, "bins.area is .*; allowed: .* above 0"),
        ({"margin": -1.0}, "bins.margin is -1.0 .*; allowed: "),
        ({"kind": "pallet", "area": [0.3, 0.5]}, r"bins.area is .*; allowed: at most the pallet's length and width, \[0.6, 0.4\] \[m\]"),
    ],
)
def test_a_wrong_bin_is_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError, match=rf"\A{message}.*\Z"):
        made(**settings)


def test_objects_that_do_not_fit_into_a_compartment_are_left_out(tmp_path):
    lines: list[str] = []
    catalog = load_catalog(read(tmp_path), report=lines.append)
    assert 0 < len(catalog) < len(load_catalog(load_config("smoke")))
    assert any("too large for the bin: " in line and "opening is 0.0997 x 0.252 m" in line for line in lines)


# ---- grippers ----

ARRAY = {"kind": "suction_array"}
EXAMPLES = [
    {},
    ARRAY | {"cups": [[0.0, 0.0]]},
    ARRAY | {"cups": [[-0.05, 0.0], [0.0, 0.0], [0.05, 0.0]]},
    ARRAY | {"cups": [[0.04, 0.03], [-0.04, 0.03], [-0.04, -0.03]], "cup_width": 0.03, "cup_length": 0.08},
]
"""Settings of grippers. To add a kind, add a row."""
BEAM = ARRAY | {"cups": [[0.0, 0.06], [0.0, -0.06]], "mesh_unit": "mm"}
"""Two cups, 120 mm apart along the wrist axis, under the beam of `beam_file`."""


def options(row: dict[str, object]) -> dict[str, object]:
    """Settings of a gripper by full keys."""
    return {f"gripper.{name}": value for name, value in row.items()}


def beam_file(folder: Path, low: float = -20.0, half: float = 80.0) -> Path:
    """STL file of a beam of 30 mm x 2 `half` from z = `low` to 5 mm, in millimetres."""
    path = folder / "beam.stl"
    trimesh.creation.box(bounds=[[-15.0, -half, low], [15.0, half, 5.0]]).export(path)
    return path


def test_every_kind_has_a_head_a_behavior_and_an_example():
    assert set(GRIPPERS) == set(HEADS) == set(BEHAVIORS) == {"suction1", *(row["kind"] for row in EXAMPLES[1:])}


def test_the_finger_is_a_cone_above_the_tilt_axis_and_its_collision_shape_is_as_long():
    gripper = Gripper()
    fixture, collider = finger_fixture(gripper), finger_collider(gripper)
    assert_closed(fixture.mesh)
    assert fixture.material.texture is None
    assert is_convex(collider)
    for vertices in (fixture.mesh.vertices, collider.vertices):
        assert (vertices[:, 2].min(), vertices[:, 2].max()) == (0, pytest.approx(gripper.finger_length))
    vertices = fixture.mesh.vertices
    assert np.ptp(vertices[:, 0]) == pytest.approx(gripper.finger_width)
    assert np.ptp(vertices[vertices[:, 2] < 0.02, 0]) == pytest.approx(0.03, abs=1e-3)


def test_a_mesh_is_the_body_of_a_tool(tmp_path):
    """Its cups end in it; its checksum is written, so that another mesh under the same name is refused."""
    config = load_settings("smoke", options(BEAM | {"mesh": str(beam_file(tmp_path))}))
    gripper, head = config.gripper, make_head(config.gripper)
    low, high = head.fixture.mesh.vertices.min(axis=0), head.fixture.mesh.vertices.max(axis=0)
    np.testing.assert_allclose([low, high], [(-0.021, -0.081, -0.055), (0.021, 0.081, 0.005)], atol=1.2e-3)
    for x, y in head.cups:
        assert felt(head.pieces, (x + 0.02, y, -1.0), UP) == pytest.approx(0.945, abs=1e-6)
        # From below, beside the middle: the cup's stem, up to the beam.
        assert first_hit(head.fixture.mesh.vertices, head.fixture.mesh.faces, (x, y, -0.04), UP) < 0.021
    assert felt(head.pieces, (0.0, 0.0, -1.0), UP) == pytest.approx(0.98, abs=1e-6)
    assert "mesh" not in make_manifest(config)["settings"]["gripper"]
    assert make_manifest(config)["settings"]["gripper"]["mesh_checksum"] == gripper.mesh_checksum != ""
    beam_file(tmp_path, half=90.0)
    with pytest.raises(ConfigError, match=r"^gripper.mesh: \S*beam.stl is not the mesh that was measured; restore it[^\n]*$"):
        make_head(gripper)
    other = replace(config, **measure_tool(gripper))
    assert describe_differences(make_manifest(other), make_manifest(config)).startswith("gripper.mesh_checksum is ")


@pytest.mark.parametrize(
    ("size", "other", "said"),
    [
        ({}, {"mesh_unit": "m"}, r"beam.stl is 30 x 160 x 25 m, unit m; .*did you mean gripper.mesh_unit = \"mm\"\?"),
        ({"low": -60.0}, {}, r"beam.stl reaches 5 mm below the cups' lips, -0.055 m; they must be its lowest points"),
        ({"low": -50.0}, {}, r"beam.stl has cup 0 at \[0.0, 0.06\] m inside it: 5 mm above its lip; allowed: at least 24.2 mm"),
        ({"half": 50.0}, {}, r"beam.stl has nothing above cup 0 at \[0.0, 0.06\] m, which it must hold"),
        ({}, {"mesh": "none.stl"}, r"none.stl cannot be read \(No such file or directory\)"),
        ({}, {"mesh": "beam.txt"}, r"beam.txt is no mesh; allowed: "),
    ],
)
def test_meshes_that_cannot_hold_the_cups_are_refused(size, other, said, tmp_path):
    path = beam_file(tmp_path, **size)
    (tmp_path / "beam.txt").write_bytes(path.read_bytes())
    given = BEAM | other | {"mesh": str(tmp_path / other.get("mesh", path.name))}
    with pytest.raises(ConfigError, match=r"^gripper.mesh: [^\n]*" + said + r"[^\n]*$"):
        load_settings("smoke", options(given))


@pytest.mark.parametrize("row", EXAMPLES)
def test_a_head_ends_in_the_lips_of_its_cups_and_its_settings_survive_writing(row, tmp_path):
    config = load_config("smoke", options(row))
    (tmp_path / "written.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "written.toml"), {}) == config
    gripper, head = config.gripper, make_head(config.gripper)
    mesh, radius, lip = head.fixture.mesh, gripper.cup_width / 2, -gripper.cup_length
    assert_closed(mesh)
    assert all(is_convex(piece) and len(piece.vertices) <= 32 for piece in head.pieces)
    assert mesh.vertices[:, 2].min() == pytest.approx(lip)
    assert min(head.inertia) > 0
    assert 2 * max(head.inertia) < sum(head.inertia)
    tips = mesh.vertices[mesh.vertices[:, 2] < lip + 1e-6, :2]
    for place in head.cups:
        near = tips[np.linalg.norm(tips - place, axis=1) < 1.2 * radius]
        np.testing.assert_allclose([near.min(axis=0), near.max(axis=0)], [np.array(place) - radius, np.array(place) + radius], atol=1e-5)
        # Hollow: from below, the middle lies deeper than the lip, where picture and collision shape end at the same height.
        x, y = place
        assert first_hit(mesh.vertices, mesh.faces, (x + 1e-4, y + 2e-4, -1.0), UP) > 1.0 + lip + 0.003
        assert felt(head.pieces, (x + 0.9 * radius, y + 1e-3, -1.0), UP) == pytest.approx(1.0 + lip, abs=1e-6)


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({"kind": "suction_array"}, r"gripper.cups is \[\] by default; allowed: 1 to 16 places \[x, y\]"),
        ({"mesh": "a.stl"}, r'gripper.mesh is "a.stl" .*; allowed: none with gripper.kind "suction1"'),
        ({"cups": [[0.0, 0.0]]}, r'gripper.cups is .*; allowed: none with gripper.kind "suction1"'),
        ({"valve": "common"}, r'^gripper.valve is "common" .*; allowed: each with gripper.kind "suction1", which [^\n]*$'),
        (ARRAY | {"cups": [[0.0, 0.0], [0.03, 0.0]]}, r"gripper.cups is .*; allowed: cups that do not overlap: 0 and 1 are 0.03"),
        (ARRAY | {"cups": [[0.0, 0.0], [0.3, 0.0]]}, r"gripper.cups is .*; allowed: within 0.155 m of the middle: the tool"),
        (ARRAY | {"cups": [[0.05 * i - 0.4, 0.0] for i in range(17)]}, r"gripper.cups is .*; allowed: 1 to 16 places"),
    ],
)
def test_tools_that_cannot_be_are_refused(overrides, expected):
    with pytest.raises(ConfigError, match=expected):
        load_config("smoke", options(overrides))


def test_cups_that_reach_no_object_are_refused():
    """Objects are gripped at the tool centre point: a cup farther from it than any object is long holds nothing."""
    config = load_config("tabletop", options(ARRAY | {"cups": [[0.3, 0.0], [0.4, 0.0]]}))
    long, short = (catalog([(size, 0.03, 0.02)]) for size in (0.29, 0.28))
    check_reach(config.gripper, config.suction, long)
    with pytest.raises(ConfigError, match=r"^no cup of gripper.cups reaches an object: the nearest is 0.3 m from the tool centre[^\n]*$"):
        check_reach(config.gripper, config.suction, short)
