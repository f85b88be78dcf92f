"""Heads of all kinds of gripper: closed meshes, cups where they are said to be, collision shapes that end where the picture does."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.configs.cell.gripper import GRIPPERS
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.grippers.registry import HEADS, check_reach, make_head
from synpick_warp.stages.sim.hold import HOLDS
from tests.scenes.test_tote_gripper import UP, convex, felt
from tests.twins.rays import edges_match, first_hit
from tests.worlds.small_worlds import catalog

EXAMPLES = [
    {},
    {"kind": "suction_array", "cups": [[0.0, 0.0]]},
    {"kind": "suction_array", "cups": [[-0.05, 0.0], [0.0, 0.0], [0.05, 0.0]]},
    {"kind": "suction_array", "cups": [[0.04, 0.03], [-0.04, 0.03], [-0.04, -0.03]], "cup_width": 0.03, "cup_length": 0.08},
]
"""Settings of grippers. To add a kind, add a row."""


def test_every_kind_has_a_head_a_hold_and_an_example():
    assert set(GRIPPERS) == set(HEADS) == set(HOLDS) == {"suction1", *(row["kind"] for row in EXAMPLES[1:])}


@pytest.mark.parametrize("row", EXAMPLES)
def test_settings_survive_writing_and_reading(row, tmp_path):
    config = load_config("smoke", {f"gripper.{name}": value for name, value in row.items()})
    (tmp_path / "written.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "written.toml"), {}) == config


@pytest.mark.parametrize("row", EXAMPLES)
def test_a_head_ends_in_the_lips_of_its_cups(row):
    gripper = load_config("smoke", {f"gripper.{name}": value for name, value in row.items()}).gripper
    head = make_head(gripper)
    mesh, radius, lip = head.fixture.mesh, gripper.cup_width / 2, -gripper.cup_length
    assert edges_match(merge_positions(mesh.vertices, mesh.faces)[1])
    assert signed_volume(mesh.vertices, mesh.faces) > 0
    assert np.abs(np.linalg.norm(mesh.normals, axis=1) - 1).max() < 1e-3
    assert all(convex(piece) and len(piece.vertices) <= 32 for piece in head.pieces)
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


ARRAY = {"gripper.kind": "suction_array"}


@pytest.mark.parametrize(
    ("overrides", "expected"),
    [
        ({"gripper.kind": "suction_array"}, r"gripper.cups is \[\] by default; allowed: 1 to 16 places \[x, y\]"),
        ({"gripper.cups": [[0.0, 0.0]]}, r'gripper.cups is .*; allowed: none with gripper.kind "suction1"'),
        (
            {"gripper.valve": "common"},
            r'^gripper.valve is "common" .*; allowed: each with gripper.kind "suction1", which [^\n]*$',
        ),
        (ARRAY | {"gripper.cups": [[0.0, 0.0], [0.03, 0.0]]}, r"gripper.cups is .*; allowed: cups that do not overlap: 0 and 1 are 0.03"),
        (ARRAY | {"gripper.cups": [[0.0, 0.0], [0.3, 0.0]]}, r"gripper.cups is .*; allowed: within 0.155 m of the middle: the tool"),
        (ARRAY | {"gripper.cups": [[0.05 * i - 0.4, 0.0] for i in range(17)]}, r"gripper.cups is .*; allowed: 1 to 16 places"),
    ],
)
def test_tools_that_cannot_be_are_refused(overrides, expected):
    with pytest.raises(ConfigError, match=expected):
        load_config("smoke", overrides)


def test_cups_that_reach_no_object_are_refused():
    """Objects are gripped at the tool centre point: a cup farther from it than any object is long holds nothing."""
    config = load_config("tabletop", ARRAY | {"gripper.cups": [[0.3, 0.0], [0.4, 0.0]]})
    long, short = (catalog([(size, 0.03, 0.02)]) for size in (0.29, 0.28))
    check_reach(config.gripper, config.suction, long)
    with pytest.raises(ConfigError, match=r"^no cup of gripper.cups reaches an object: the nearest is 0.3 m from the tool centre[^\n]*$"):
        check_reach(config.gripper, config.suction, short)
