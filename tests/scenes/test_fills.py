"""Fills by `arrangement.counts`, and capacities of a world for contacts, pairs and rows: what a table of parts may be, what does not fit,
the slots it takes, which objects and bins raise capacities, and that piles of many stay below.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.cell.extents import BinSizes
from synpick_warp.configs.files.load import load_config, parse_assignment
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Arrangement, Config, Physics
from synpick_warp.errors import ConfigError
from synpick_warp.kernels.newton_patches import contact_sweep
from synpick_warp.scenes import build, capacities
from synpick_warp.scenes.bin_meshes.reading import measure_bins
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.capacities import check_fill, count_entries, drop_height
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Catalog, ConvexPiece
from tests.builders import refusal
from tests.worlds.bin_meshes import round_bin, sloped_bin
from tests.worlds.small_worlds import ANGLE, BOX, CUBE, PLATE, catalog, cluttered_catalog, settings

OBJECTS = catalog(BOX, CUBE, PLATE)
NAMES = [entry.name for entry in OBJECTS.entries]


def load(counts, **settings):
    return load_config("smoke", {"arrangement.counts": counts} | settings)


@pytest.mark.parametrize(
    ("counts", "rows"),
    [
        ({"bracket": 12}, (("bracket", 12, 12),)),
        ({"bolt": [4, 8], "nut": 8}, (("bolt", 4, 8), ("nut", 8, 8))),
        ([["a part", 0, 3], ["b", 1, 1]], (("a part", 0, 3), ("b", 1, 1))),
        ({}, ()),
        (parse_assignment("arrangement.counts={bracket=12}")[1], (("bracket", 12, 12),)),
    ],
)
def test_tables_and_lists_are_read_and_written(tmp_path, counts, rows):
    config = load(counts)
    assert config.arrangement.counts == rows
    (tmp_path / "same.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "same.toml")).arrangement.counts == rows


@pytest.mark.parametrize(
    ("counts", "settings", "rule"),
    [
        (12, {}, "a table of parts"),
        ("bracket", {}, "a table of parts"),
        ({"bracket": "12"}, {}, "a table of parts"),
        ({"bracket": 1.5}, {}, "a table of parts"),
        ({"bracket": True}, {}, "a table of parts"),
        ({"bracket": [1, 2, 3]}, {}, "a table of parts"),
        ({"": 3}, {}, "a table of parts"),
        ({"bracket": 0}, {}, "numbers of at least 1"),
        ({"bracket": -1}, {}, "numbers of at least 1"),
        ({"bracket": [4, 2]}, {}, "numbers of at least 1"),
        ({"bracket": 2**31}, {}, "numbers of at least 1"),
        ([["bolt", 1, 1], ["bolt", 2, 2]], {}, "each part once"),
        ({"bracket": 25}, {}, "at most arrangement.max_objects, 24, together, which are 25"),
        ({"bolt": 12, "nut": [1, 13]}, {}, "which are 25"),
        ({"bolt": 20}, {"randomize.distractors": 6}, "24, less 6 distractors, together, which are 20"),
        ({"bolt": [0, 2], "nut": [0, 2]}, {}, "at least one part that each episode has"),
    ],
)
def test_what_no_fill_is_takes_one_line(counts, settings, rule):
    said = refusal(load, counts, **settings)
    assert "arrangement.counts" in said
    assert rule in said


def test_parts_are_found_by_name_and_by_obj_id_and_take_slots_of_their_largest_numbers():
    first, _, last = OBJECTS.entries
    counts = ((last.name, 1, 4), (str(first.obj_id), 2, 2))
    np.testing.assert_array_equal(count_entries(counts, OBJECTS), [(2, 2), (0, 0), (1, 4)])
    assert not count_entries((), OBJECTS).any()
    config = load(((NAMES[0], 3, 7), (NAMES[2], 1, 2)))
    assert build.count_slots(config.arrangement, [False], OBJECTS) == (9, 0)
    assert not build.must_repeat(config.arrangement, OBJECTS)


def test_unknown_parts_are_named():
    with pytest.raises(ConfigError, match=f"which no object has.*{NAMES[0]}.*did you mean {NAMES[1]}"):
        count_entries(((f"{NAMES[1]}s", 1, 1),), OBJECTS)
    with pytest.raises(ConfigError, match="which is set already"):
        count_entries(((NAMES[0], 1, 1), (str(OBJECTS.entries[0].obj_id), 1, 1)), OBJECTS)


def test_more_than_the_bin_holds_is_refused():
    bins = load_config("smoke").cell.bins
    inside = bins[0].height * (np.prod(bins[0].floor) + np.prod(bins[0].opening)) / 2.0
    room = int(0.74 * inside / OBJECTS.entries[1].volume)
    few, many = (Arrangement(counts=((NAMES[1], 1, most),), drop="layers") for most in (room, room + 1))
    check_fill(few, 100.0, OBJECTS, bins)
    with pytest.raises(ConfigError, match="the tote has room for"):
        check_fill(many, 100.0, OBJECTS, bins)
    check_fill(many, 100.0, OBJECTS, load_config("tabletop").cell.bins)


def test_stacks_above_the_guide_walls_are_refused():
    """Known: cubes of 50 mm have spheres of 86.6 mm: in a column each takes 96.6 mm, over 545 x 352 mm a layer has 5 x 3 of them."""
    bins = load_config("smoke").cell.bins
    most, radius = np.array([0, 31, 0]), np.array([entry.radius for entry in OBJECTS.entries])
    column, layers = (Arrangement(counts=((NAMES[1], 31, 31),), drop=drop) for drop in ("column", "layers"))
    assert drop_height(most, radius, column, bins[0]) == pytest.approx(31 * 0.0966, rel=1e-3)
    assert drop_height(most, radius, layers, bins[0]) == pytest.approx(3 * 0.0966, rel=1e-3)
    check_fill(column, 3.0, OBJECTS, bins)
    check_fill(layers, 0.3, OBJECTS, bins)
    for arrangement, height, hint in ((column, 2.9, 'arrangement.drop = "layers"'), (layers, 0.28, "raise physics.guide_height")):
        with pytest.raises(ConfigError, match=hint):
            check_fill(arrangement, height, OBJECTS, bins)


# ---- capacities ----


SMALL = ((0.012, 0.013, 0.014),)
OF_SMALL = 5 * ((28 * 29 * 30 / (12 * 13 * 14) - 1) / 2 + 1.5)
"""Contacts per small box in a large pile: five per pair, with half of the boxes that fit within 8 mm around it, and with 1.5 bin shapes."""
LEAST = 512 / 24
"""Minimum number of contacts per object in a large pile: that of the default settings."""


def with_capacities(config: Config, objects: Catalog) -> Physics:
    return capacities.with_capacities(config.physics, config.arrangement.max_objects, objects)


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
    assert capacities.MAX_ROWS == contact_sweep.MAX_SHARED_ROWS
    for count, contacts, shape in ((24, 8192, ((0.1, 0.08, 0.001),)), (251, 20000, CUBE)):
        roomy = settings(arrangement__max_objects=count, physics__contacts_per_world=contacts)
        assert with_capacities(roomy, catalog(shape)) is roomy.physics


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


def test_the_embedded_objects_keep_the_capacities():
    margin = 2.0 * settings().physics.gap
    for raw in procedural_objects():
        assert capacities.oriented_sides([ConvexPiece(raw.mesh.vertices, raw.mesh.faces)]).min() > margin


@pytest.mark.parametrize(
    ("shapes", "count", "each"),
    [((BOX, CUBE), 33, LEAST), ((CUBE,), 251, LEAST), ((SMALL,), 150, OF_SMALL), ((CUBE, SMALL), 60, OF_SMALL)],
)
def test_many_objects_have_contacts_in_proportion_and_three_rows_for_each(shapes, count, each):
    physics = with_capacities(settings(arrangement__max_objects=count), catalog(*shapes))
    contacts = physics.contacts_per_world
    assert contacts == pytest.approx(count * each, abs=1)
    assert (physics.pairs_per_world, physics.rows_per_world) == (2 * contacts, 3 * contacts)
    assert physics.gripper_rows_per_world == round(each / LEAST * 256)


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
