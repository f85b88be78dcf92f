"""The simulation model: layout, number of body slots, and selection of body variants."""

import dataclasses

import newton
import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.schema import Config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes import build
from synpick_warp.scenes.bins import guide_walls
from synpick_warp.scenes.types import Catalog
from tests.harness.hostile import fuzz_examples
from tests.twins import arrangement
from tests.worlds.small_worlds import ANGLE, BOX, CUBE, catalog, settings

WORLDS = 3


def config_of(**overrides: object):
    return settings(bake__worlds=WORLDS, **overrides)


def count_slots(config: Config, objects: Catalog) -> tuple[int, int]:
    return build.count_slots(config.arrangement, build.find_repeat_rules(config.bake, config.pick, config.move), objects)


@pytest.fixture(scope="module")
def objects() -> Catalog:
    return catalog(BOX, ANGLE, CUBE)


@pytest.fixture(scope="module")
def built(device, objects) -> build.BuiltModel:
    return build.build_model(config_of(), objects, device)


# ---- layout ----


def test_the_layout_agrees_with_the_model(built):
    layout, model = built.layout, built.model
    assert model.world_count == layout.worlds == WORLDS
    assert model.body_count == WORLDS * layout.bodies_per_world
    assert model.joint_coord_count == WORLDS * layout.coords_per_world
    assert model.joint_dof_count == WORLDS * layout.dofs_per_world
    # Variants' shapes follow after those of all worlds.
    assert model.shape_count >= WORLDS * layout.shapes_per_world
    np.testing.assert_array_equal(model.body_world.numpy(), np.repeat(np.arange(WORLDS), layout.bodies_per_world))
    shapes = model.shape_world.numpy()[: WORLDS * layout.shapes_per_world]
    np.testing.assert_array_equal(shapes, np.repeat(np.arange(WORLDS), layout.shapes_per_world))


def test_bodies_of_gripper_and_slots_have_the_indices_of_the_layout(built):
    layout, labels = built.layout, [label.split("/")[-1] for label in built.model.body_label]
    for world in range(WORLDS):
        first = world * layout.bodies_per_world
        assert labels[first : first + build.GRIPPER_BODIES] == ["finger", "cup"]
        slots = labels[first + build.GRIPPER_BODIES : first + layout.bodies_per_world]
        assert slots[: layout.single_slots] == [f"single_{slot}" for slot in range(layout.single_slots)]
        assert slots[layout.single_slots :] == [f"compound_{slot}" for slot in range(layout.compound_slots)]


def test_joint_coordinates_place_the_body_of_their_slot(built):
    """Slot s of world w: seven coordinates from w · coords + 4 + 7 s. The gripper: x, y, z, tilt."""
    layout, model = built.layout, built.model
    state = model.state()
    q = np.zeros((WORLDS, layout.coords_per_world), np.float32)
    q[:, 6 + build.GRIPPER_DOFS :: 7] = 1.0
    for world in range(WORLDS):
        q[world, :4] = (world, 0.2, 0.3, 0.0)
        for slot in range(layout.slots):
            first = build.GRIPPER_DOFS + 7 * slot
            q[world, first : first + 3] = (world, slot, 7.0)
    state.joint_q.assign(q.reshape(-1))
    newton.eval_fk(model, state.joint_q, state.joint_qd, state)
    place = state.body_q.numpy().reshape(WORLDS, layout.bodies_per_world, 7)[:, :, :3]
    for world in range(WORLDS):
        np.testing.assert_allclose(place[world, :2], np.tile([world, 0.2, 0.3], (2, 1)), atol=1e-6)
        np.testing.assert_allclose(place[world, 2:], [[world, slot, 7.0] for slot in range(layout.slots)], atol=1e-6)


def test_dofs_belong_to_the_body_of_their_slot(built):
    layout, model = built.layout, built.model
    starts, children = model.joint_qd_start.numpy(), model.joint_child.numpy()
    for world in range(WORLDS):
        for slot in range(layout.slots):
            dof = world * layout.dofs_per_world + build.GRIPPER_DOFS + 6 * slot
            joint = int(np.flatnonzero(starts == dof)[0])
            assert children[joint] == world * layout.bodies_per_world + build.GRIPPER_BODIES + slot


def test_guide_shapes_are_the_guide_walls(built):
    config = config_of()
    walls = guide_walls(BinSizes.of_tote(config.tote), config.physics.guide_height)
    guides = [part.shape for part in built.layout.parts if part.guide]
    for world in range(WORLDS):
        for guide, wall in zip(guides, walls, strict=True):
            shape = world * built.layout.shapes_per_world + guide
            assert built.model.shape_body.numpy()[shape] == -1
            source = built.model.shape_source[shape]
            np.testing.assert_allclose(np.sort(source.vertices, axis=0), np.sort(wall.vertices, axis=0), atol=1e-6)


def test_slots_are_initially_empty_and_the_gripper_has_its_configured_mass(built):
    layout, gripper = built.layout, config_of().gripper
    mass, selected = (array.numpy().reshape(WORLDS, -1) for array in (built.model.body_mass, built.model.body_variant))
    np.testing.assert_allclose(mass[:, :2], np.tile([gripper.finger_mass, gripper.cup_mass], (WORLDS, 1)), rtol=1e-6)
    np.testing.assert_allclose(mass[:, build.GRIPPER_BODIES :], build.EMPTY_MASS)
    kinds = np.where(np.arange(layout.slots) < layout.single_slots, *built.empty_variant)
    np.testing.assert_array_equal(selected[:, build.GRIPPER_BODIES :], np.tile(kinds, (WORLDS, 1)))


# ---- objects in slots ----


def test_a_slot_becomes_the_selected_object(built, objects):
    """Each object in the first slot of its type in world 1: mass, centre of mass, inertia; others keep theirs."""
    layout, model = built.layout, built.model
    for index, entry in enumerate(objects.entries):
        slot = layout.single_slots if len(entry.pieces) > 1 else 0
        body = layout.bodies_per_world + build.GRIPPER_BODIES + slot
        variant = np.full(model.body_count, -1, np.int32)
        variant[body] = built.variant[index]
        model.select_body_variants(wp.array(variant, dtype=int, device=model.device))
        assert model.body_mass.numpy()[body] == pytest.approx(entry.mass, rel=1e-6)
        np.testing.assert_allclose(model.body_com.numpy()[body], entry.center_of_mass, atol=1e-7)
        np.testing.assert_allclose(model.body_inertia.numpy()[body], entry.inertia, rtol=1e-4, atol=1e-6 * np.trace(entry.inertia))
        np.testing.assert_allclose(model.body_inv_mass.numpy()[body], 1 / entry.mass, rtol=1e-6)
        np.testing.assert_allclose(model.body_inv_inertia.numpy()[body] @ entry.inertia, np.eye(3), atol=1e-3)
        assert model.body_mass.numpy()[body + layout.bodies_per_world] == pytest.approx(build.EMPTY_MASS)
        shapes = np.flatnonzero(model.shape_body.numpy() == body)
        flags = model.shape_flags.numpy()[shapes] & int(newton.ShapeFlags.COLLIDE_SHAPES)
        assert (flags != 0).sum() == len(entry.pieces)
        variant[body] = built.empty_variant[slot > 0]
        model.select_body_variants(wp.array(variant, dtype=int, device=model.device))
        assert (model.shape_flags.numpy()[shapes] & int(newton.ShapeFlags.COLLIDE_SHAPES) == 0).all()
        assert model.body_mass.numpy()[body] == pytest.approx(build.EMPTY_MASS)


@pytest.mark.parametrize(("shapes", "kinds"), [((BOX, CUBE), (3, 0)), ((ANGLE,), (0, 3))], ids=("single", "compound"))
def test_catalogs_with_one_type_of_slot(device, shapes, kinds):
    built = build.build_model(config_of(), catalog(*shapes), device)
    assert (built.layout.single_slots > 0, built.layout.compound_slots > 0) == (kinds[0] > 0, kinds[1] > 0)
    assert built.model.body_count == WORLDS * built.layout.bodies_per_world
    assert built.variant.tolist() == list(range(len(shapes)))


# ---- slot counts ----


def fake(volume: np.ndarray, compound: np.ndarray, objects: Catalog) -> Catalog:
    """A catalog of given volumes and slot types."""
    kinds = objects.entries[:2]
    return Catalog(tuple(dataclasses.replace(kinds[int(kind)], volume=float(size)) for size, kind in zip(volume, compound, strict=True)))


def needs(config, volume, compound, episodes: int, *, repeats: bool) -> np.ndarray:
    """Slots (episode, type) that the twin's draws need with unlimited slots."""
    room, taken = config.arrangement.max_objects, []
    limits = {"budget": config.arrangement.volume, "exceed": config.arrangement.fill == "exceed", "repeats": repeats, "room": room}
    limits |= {"single_slots": room, "compound_slots": room}
    for episode in range(episodes):
        drawn = arrangement.sample_objects(0, episode, 0, volume=volume, compound=compound, **limits)
        kinds = compound[list(drawn.entries)] == 1
        taken.append(((~kinds).sum(), kinds.sum()))
    return np.array(taken)


def overflows(taken: np.ndarray, slots: tuple[int, int]) -> float:
    """Fraction of draws with an object for which there is no slot."""
    return float((taken > slots).any(axis=1).mean())


@hypothesis_settings(max_examples=12)
@given(
    seed=st.integers(0, 2**32 - 1),
    size=st.sampled_from((0.5e-3, 1.5e-3, 6e-3)),
    share=st.sampled_from((0.2, 0.5)),
    mode=st.sampled_from(("pick", "target", "move")),
    fill=st.sampled_from(("exceed", "within")),
)
def test_slots_suffice_for_all_but_the_accepted_fraction_of_draws(seed, size, share, mode, fill, objects):
    """By brute force with the twin's draws, also where single objects may exceed the whole budget. One slot fewer would not suffice."""
    numbers = np.random.default_rng(seed)
    volume, compound = numbers.uniform(0.1 * size, size, 9), (numbers.uniform(size=9) < share).astype(int)
    shortfall, episodes = 0.05, 400
    limits = {"arrangement__volume": 3e-3, "arrangement__max_objects": 20, "arrangement__slot_shortfall": shortfall}
    config = settings(bake__mode=mode, arrangement__fill=fill, **limits)
    slots = count_slots(config, fake(volume, compound, objects))
    taken = needs(config, volume, compound, episodes, repeats=mode == "move")
    # Four standard deviations of the brute force.
    margin = 4 * np.sqrt(shortfall / episodes)
    assert overflows(taken, slots) <= shortfall + margin
    for fewer in ((slots[0] - 1, slots[1]), (slots[0], slots[1] - 1)):
        if min(fewer) >= 0:
            assert overflows(taken, fewer) >= shortfall - margin
    assert max(slots) <= 20
    if mode != "move":
        assert slots[0] <= (compound == 0).sum()
        assert slots[1] <= (compound == 1).sum()


def even(volume: float, *compound: int) -> tuple[np.ndarray, np.ndarray]:
    """Objects of one volume [m³], and whether each takes a compound slot."""
    return np.full(len(compound), volume), np.array(compound)


HALVES, FIVE, THIRTY = even(1e-4, 0, 1), even(1e-4, 0, 1, 1, 0, 0), even(1e-4, *[0] * 28, 1, 1)
RARE = np.where(np.arange(100) == 40, 1e-4, 1e-3), np.arange(100) == 40
"""Of a hundred objects only one fits, and it fits twice."""
WITHIN, EXCEED = {"fill": "within"}, {"fill": "exceed"}
FEW, TWICE = {"volume": 7.5e-4, "max_objects": 32}, {"volume": 2.5e-4, "max_objects": 2}
LITRE = np.nextafter(1e-3, 1.0)
"""The volume of a cube of 100 mm comes as 1.0000000000000002e-3 m³, with which 64-bit floats found room for two in three litres."""


@pytest.mark.parametrize(
    ("given", "mode", "limits", "slots"),
    [
        # The accepted fraction is that of both types: with a slot of either kind a quarter of draws fails twice, which makes a half.
        (HALVES, "move", {"max_objects": 2, "volume": 1.0, "slot_shortfall": 0.3}, (2, 1)),
        (HALVES, "move", {"max_objects": 2, "volume": 1.0, "slot_shortfall": 0.2}, (2, 2)),
        # With a budget for everything and no repeats every object has a slot, but for the maximum of objects.
        (FIVE, "pick", {"max_objects": 8, "volume": 1.0}, (3, 2)),
        (FIVE, "pick", {"max_objects": 2, "volume": 1.0}, (2, 2)),
        (even(1e-5, 0, 0, 1, 1), "move", {"max_objects": 4, "volume": 1.0}, (4, 4)),
        (even(1e-5, 0, 0), "move", {"max_objects": 4, "volume": 1.0}, (4, 0)),
        # Seven of thirty stay within the budget and eight exceed it; with repeats as many bodies, of any kind.
        (THIRTY, "pick", FEW | WITHIN, (7, 2)),
        (THIRTY, "pick", FEW | EXCEED, (8, 2)),
        (THIRTY, "move", FEW | WITHIN, (7, None)),
        (THIRTY, "move", FEW | EXCEED, (8, None)),
        # The first is redrawn until it fits. A second one fits in one draw of a hundred with repeats, and never without.
        (RARE, "move", TWICE | WITHIN | {"slot_shortfall": 0.02}, (0, 1)),
        (RARE, "move", TWICE | WITHIN | {"slot_shortfall": 0.005}, (0, 2)),
        (RARE, "pick", TWICE | WITHIN | {"slot_shortfall": 0.005}, (0, 1)),
        # Drawing on until the budget is exceeded, the other 99 are passed over.
        (RARE, "move", TWICE | EXCEED | {"slot_shortfall": 0.02}, (0, 2)),
        (RARE, "move", TWICE | EXCEED | {"slot_shortfall": 0.005}, (0, 2)),
        (RARE, "pick", TWICE | EXCEED | {"slot_shortfall": 0.005}, (0, 1)),
        # An object of the whole budget is drawn but for rounding, and three of a third: the kernels compare in 32-bit floats.
        *((even(LITRE, 0), mode, {"volume": 1e-3}, (1, 0)) for mode in ("move", "pick")),
        *((even(LITRE, *[0] * n), mode, {"volume": 3e-3, "max_objects": 24}, (3, 0)) for n in (1, 2, 3) for mode in ("move", "mixed")),
        *((even(LITRE, *[0] * n), mode, {"volume": 3e-3, "max_objects": 24}, (n, 0)) for n in (1, 2, 3) for mode in ("pick", "target")),
    ],
)
def test_known_numbers_of_slots(objects, given, mode, limits, slots):
    """Slots of each type; None: more than two."""
    config = settings(bake__mode=mode, **{f"arrangement__{name}": value for name, value in limits.items()})
    single, compound = count_slots(config, fake(*given, objects))
    assert single == slots[0]
    assert compound > 2 if slots[1] is None else compound == slots[1]


@pytest.mark.parametrize(
    ("mode", "mix", "rules", "expected"),
    [
        ("pick", (1, 1, 1), (False, True), {False}),
        ("target", (1, 1, 1), (False, True), {False}),
        ("move", (1, 1, 1), (False, True), {True}),
        ("mixed", (1, 1, 1), (False, True), {False, True}),
        ("mixed", (1, 1, 0), (False, True), {False}),
        ("mixed", (0, 0, 1), (False, True), {True}),
        ("mixed", (0, 1, 1), (True, True), {True}),
        ("mixed", (0, 1, 1), (True, False), {False, True}),
        ("cycle", (0, 0, 1), (False, True), {False, True}),
    ],
)
def test_repeat_rules_of_the_possible_modes(mode, mix, rules, expected):
    config = settings(bake__mode=mode, bake__mix=list(mix), pick__repeats=rules[0], move__repeats=rules[1])
    assert build.find_repeat_rules(config.bake, config.pick, config.move) == expected


def test_mixed_modes_have_enough_slots_for_each_mode(objects):
    """For each slot type: picking may need more of one and moving more of the other."""
    some = fake(*even(1e-4, 0, 0, 0, 0, 1, 1), objects)
    config = {"arrangement__volume": 5.5e-4, "arrangement__max_objects": 12, "arrangement__fill": "within"}
    single = [count_slots(settings(bake__mode=mode, **config), some) for mode in ("pick", "target", "move")]
    assert count_slots(settings(bake__mode="mixed", **config), some) == tuple(np.max(single, axis=0))
    assert count_slots(settings(bake__mode="mixed", bake__mix=[1, 1, 0], **config), some) == single[0] == single[1] != single[2]


@pytest.mark.parametrize("mode", ["move", "pick"])
def test_a_budget_below_the_smallest_object_is_an_error(objects, mode):
    config = settings(arrangement__volume=1e-4, bake__mode=mode)
    with pytest.raises(ConfigError, match=r"volume is 0\.0001 m³, but the smallest object, boxes_3, takes 0\.000125 m³; make it larger"):
        count_slots(config, objects)


def sizes_of_boxes(budget: float) -> st.SearchStrategy[float]:
    """Volumes [m³] from a pinhead to more than the budget, and those of which a whole number meets the budget but for rounding."""
    near = st.builds(lambda parts, ulps: budget / parts * (1.0 + ulps * 2.0**-52), st.integers(1, 40), st.integers(-4, 4))
    cubes = st.builds(lambda side: (side * 1e-3) ** 3, st.integers(2, 200))
    return st.one_of(near, cubes, st.floats(1e-9, 4 * budget))


@hypothesis_settings(max_examples=fuzz_examples(40), deadline=None)
@given(
    data=st.data(),
    budget=st.sampled_from((1e-3, 3e-3, 7e-3, 1e-4)),
    room=st.sampled_from((1, 2, 3, 24, 32)),
    mode=st.sampled_from(("move", "pick")),
    repeats=st.booleans(),
    fill=st.sampled_from(("exceed", "within")),
)
def test_any_catalog_of_one_to_three_objects_gets_arrangements(data, budget, room, mode, repeats, fill, objects):
    """Either all but single draws have their body slots, or one line says that no object fits."""
    volume = np.array(data.draw(st.lists(sizes_of_boxes(budget), min_size=1, max_size=3)))
    compound = np.array(data.draw(st.lists(st.integers(0, 1), min_size=len(volume), max_size=len(volume))))
    limits = {"arrangement__volume": budget, "arrangement__fill": fill, "arrangement__max_objects": room}
    config = settings(bake__mode=mode, move__repeats=repeats, pick__repeats=repeats, arrangement__slot_shortfall=1e-3, **limits)
    if np.float32(volume.min()) > np.float32(budget):
        with pytest.raises(ConfigError, match=r"\Aarrangement\.volume is .*, but the smallest object, .*; make it larger\Z"):
            count_slots(config, fake(volume, compound, objects))
        return
    slots = count_slots(config, fake(volume, compound, objects))
    taken = needs(config, volume, compound, 40, repeats=repeats)
    assert (taken.sum(axis=1) >= 1).all()
    # More than three of 40 with a chance of 1e-3 each: less than once in ten million.
    assert (taken > slots).any(axis=1).sum() <= 3


# ---- settings that follow from the catalog ----


@pytest.mark.parametrize(
    ("limits", "shapes", "repeats"),
    [
        ({"volume": 3e-3}, [BOX], True),
        ({"volume": 3e-3}, [BOX, CUBE], True),
        ({"volume": 3e-3, "repeat_to_fill": False}, [BOX, CUBE], False),
        ({"volume": 3e-3, "max_objects": 2}, [BOX, CUBE], False),
        ({"volume": 3.1e-4}, [BOX, CUBE], False),
        ({"volume": 1.5e-4}, [BOX, CUBE], True),
    ],
)
def test_objects_repeat_where_all_of_them_stay_below_the_budget(limits, shapes, repeats):
    """An object that alone exceeds the budget is never drawn, and does not count."""
    config = settings(bake__mode="pick", **{f"arrangement__{name}": value for name, value in ({"max_objects": 24} | limits).items()})
    assert build.must_repeat(config.arrangement, catalog(*shapes)) is repeats
    filled = config.with_values(build.REPEATS)
    assert build.find_repeat_rules(filled.bake, filled.pick, filled.move) == {True}
