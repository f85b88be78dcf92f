"""Capacities of a world for contacts, pairs and rows: which objects and bins raise them, and that piles of many stay below."""

from __future__ import annotations

import math

import pytest

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.schema import Config, Physics
from synpick_warp.kernels.newton_patches import contact_sweep
from synpick_warp.scenes import capacities
from synpick_warp.scenes.bin_meshes.reading import measure_bins
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Catalog, ConvexPiece
from tests.worlds.bin_meshes import round_bin, sloped_bin
from tests.worlds.small_worlds import ANGLE, BOX, CUBE, catalog, cluttered_catalog, settings

SMALL = ((0.012, 0.013, 0.014),)
OF_SMALL = 5 * ((28 * 29 * 30 / (12 * 13 * 14) - 1) / 2 + 1.5)
"""Contacts per small box in a large pile: five per pair, with half of the boxes that fit within 8 mm around it, and with 1.5 bin shapes."""
LEAST = 512 / 24
"""Minimum number of contacts per object in a large pile: that of the default settings."""


def with_capacities(config: Config, objects: Catalog) -> Physics:
    return capacities.with_capacities(config.physics, config.arrangement.max_objects, objects)


def capacities_of(physics: Physics) -> tuple[int, int, int, int]:
    return physics.contacts_per_world, physics.pairs_per_world, physics.rows_per_world, physics.gripper_rows_per_world


def test_only_objects_thinner_than_the_contact_margin_raise_capacities():
    config = settings(bake__mode="move", arrangement__max_objects=24)
    assert with_capacities(config, catalog(BOX, CUBE, ANGLE)) is config.physics
    for size, least in (((0.1, 0.08, 0.001), 1300), ((0.002, 0.002, 0.1), 1300), ((0.3, 0.2, 0.0005), 1300), ((0.2, 0.2, 0.0079), 512)):
        physics = with_capacities(config, catalog(BOX, (size,)))
        assert least <= physics.contacts_per_world <= capacities.MAX_CONTACTS
        assert physics.rows_per_world in (1536, capacities.MAX_ROWS)
        assert physics.pairs_per_world >= 1024
    few = settings(bake__mode="move", arrangement__max_objects=3)
    assert with_capacities(few, catalog(((0.1, 0.08, 0.001),))) is few.physics
    roomy = settings(arrangement__max_objects=24, physics__contacts_per_world=8192)
    assert with_capacities(roomy, catalog(((0.1, 0.08, 0.001),))) is roomy.physics


def test_bins_of_more_shapes_than_a_box_raise_capacities(tmp_path):
    """By the shapes that are near an object on the floor, however many there are elsewhere."""
    config = settings(bake__mode="move", arrangement__max_objects=24)
    raised = {}
    for name, mesh in {"plain": sloped_bin(0.0, 0.0), "round": round_bin(0.1)}.items():
        mesh.export(tmp_path / f"{name}.stl")
        row = BinRow(name=name, file=str(tmp_path / f"{name}.stl"))
        bins = make_bins([BinSizes.of_row(each) for each in measure_bins((row,))["bin"]])
        raised[name] = capacities.with_capacities(config.physics, 24, catalog(BOX, CUBE), bins)
    assert raised["plain"] is config.physics
    assert 512 < raised["round"].contacts_per_world < 1024
    share = raised["round"].contacts_per_world / 512
    assert raised["round"].pairs_per_world == round(share * config.physics.pairs_per_world)
    assert capacities.with_capacities(config.physics, 24, catalog(BOX, CUBE), make_bins(config.cell.bins)) is config.physics


def test_rows_stay_in_shared_memory():
    assert capacities.MAX_ROWS == contact_sweep.MAX_SHARED_ROWS


def test_the_embedded_objects_keep_the_capacities():
    margin = 2.0 * settings().physics.gap
    for raw in procedural_objects():
        assert capacities.oriented_sides([ConvexPiece(raw.mesh.vertices, raw.mesh.faces)]).min() > margin


@pytest.mark.parametrize(
    ("shapes", "count", "each"),
    [
        ((BOX, CUBE), 33, LEAST),
        ((CUBE,), 251, LEAST),
        ((SMALL,), 150, OF_SMALL),
        ((CUBE, SMALL), 60, OF_SMALL),
    ],
)
def test_many_objects_have_contacts_in_proportion_and_three_rows_for_each(shapes, count, each):
    config = settings(arrangement__max_objects=count)
    contacts, pairs, rows, gripper = capacities_of(with_capacities(config, catalog(*shapes)))
    assert contacts == pytest.approx(count * each, abs=1)
    assert pairs == 2 * contacts
    assert rows == 3 * contacts
    assert gripper == round(each / LEAST * 256)


def test_numbers_of_parts_count_by_their_own_contacts():
    """Known: 40 cubes of 50 mm and up to 20 small boxes, not the plates that no episode has; distractors have the room that is left."""
    objects = catalog(CUBE, SMALL, ((0.1, 0.1, 0.001),))
    config, (cube, small, _) = settings(), objects.entries
    found = capacities.with_capacities(config.physics, 251, objects, (), ((cube.name, 40, 40), (small.name, 10, 20)))
    assert found.contacts_per_world == math.ceil(40 * LEAST + 20 * OF_SMALL)
    thick = catalog(CUBE, SMALL)
    assert capacities.with_capacities(config.physics, 251, thick, (), ((cube.name, 1, 32),)) is config.physics
    mixed = cluttered_catalog()
    few, many = (capacities.with_capacities(config.physics, 60, mixed, (), ((mixed.entries[0].name, 1, most),)) for most in (40, 60))
    assert few == many


def test_larger_capacities_of_the_settings_stay():
    config = settings(arrangement__max_objects=251, physics__contacts_per_world=20000)
    assert with_capacities(config, catalog(CUBE)) is config.physics
