"""Heads of all kinds of gripper: closed meshes, cups where they are said to be, collision shapes that end where the picture does."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from synpick_warp.configs.cell.gripper import GRIPPERS
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Gripper
from synpick_warp.dataset.commit.manifest import describe_differences, make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.scenes.grippers import HEADS, check_reach, finger_collider, finger_fixture, make_head, measure_tool
from synpick_warp.stages.sim.behavior import BEHAVIORS
from tests.harness.pieces import assert_closed, felt, is_convex
from tests.twins.raycast import first_hit
from tests.worlds.small_worlds import catalog

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


UP = (0.0, 0.0, 1.0)


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
