"""Bins: what stands under the cameras, and rules of its settings."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.dataset.commit.manifest import make_manifest
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bins import guide_walls, make_bins
from synpick_warp.scenes.catalog import load_catalog
from tests.scenes.test_tote_gripper import convex, inside
from tests.scenes.test_tote_gripper import test_fixtures_are_closed_and_face_outward as check_closed


def made(**settings):
    config = load_config("smoke", {f"bins.{name}": value for name, value in settings.items()})
    return make_bins(config.cell.bins)


def test_a_pallet_is_closed_and_its_box_holds_its_boards():
    (pallet,) = made(kind="pallet", area=[0.3, 0.2], pallet_size=[0.5, 0.4, 0.1])
    check_closed(pallet.fixture)
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
    check_closed(kanban.fixture)
    assert (kanban.fixture.interior, flat.fixture.interior is None) == (None, False)
    assert len(kanban.pieces) == len(flat.pieces) + 3
    assert all(convex(piece) for piece in kanban.pieces)
    sizes, dividers = kanban.sizes, kanban.pieces[len(flat.pieces) :]
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (5000, 2)) * sizes.floor
    apart = np.abs(points[:, None] - np.array(sizes.openings)[:, :2]) - np.array(sizes.cell) / 2
    free = (apart < -1e-4).all(axis=2).any(axis=1)
    between = (apart > 1e-4).any(axis=2).all(axis=1)
    filled = np.any([inside(piece, np.column_stack([points, np.full(len(points), 0.05)])) for piece in dividers], axis=0)
    assert not filled[free].any()
    assert filled[between].all()
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
    with pytest.raises(ConfigError, match=message) as caught:
        read(tmp_path, ROWS.replace(old, new))
    assert "\n" not in str(caught.value)


def test_objects_that_do_not_fit_into_a_compartment_are_left_out(tmp_path):
    lines: list[str] = []
    config = read(tmp_path)
    catalog = load_catalog(config, report=lines.append)
    assert 0 < len(catalog) < len(load_catalog(load_config("smoke")))
    assert any("too large for the bin: " in line and "opening is 0.0997 x 0.252 m" in line for line in lines)


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
    with pytest.raises(ConfigError, match=message) as caught:
        made(**settings)
    assert "\n" not in str(caught.value)
