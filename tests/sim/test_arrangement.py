"""Which objects are expected_arrangements, where they fall from, and who gets which episode."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Mode, Phase, Stream
from synpick_warp.configs.schema import Split
from synpick_warp.kernels.sim.drop import PARKED_HEIGHT
from synpick_warp.scenes import build
from synpick_warp.stages.constants import make_scene_data
from synpick_warp.stages.sim import arrange
from tests.twins import arrangement, rng
from tests.worlds import small_worlds
from tests.worlds.kernel_worlds import BIN, KernelWorlds, arrangement_worlds

WORLDS = 24
SEED = 2**40 + 3


@st.composite
def catalogs(draw):
    count = draw(st.integers(1, 12))
    numbers = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    volume = numbers.uniform(0.02, draw(st.sampled_from((0.1, 0.5, 2.0))), count)
    compound = (numbers.uniform(size=count) < draw(st.sampled_from((0.0, 0.3, 1.0)))).astype(np.int32)
    return {
        "volume": volume,
        "compound": compound,
        "radius": numbers.uniform(0.02, 0.3, count),
        "instances": draw(st.integers(1, 16)),
        "single_slots": draw(st.integers(0, 16)),
        "compound_slots": draw(st.integers(0, 6)),
        "drop": {
            "volume": draw(st.floats(0.01, 3.0)),
            "exceed": draw(st.integers(0, 1)),
            "move_repeats": draw(st.integers(0, 1)),
            "pick_repeats": draw(st.integers(0, 1)),
        },
        "mix": draw(st.sampled_from(((0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (1.0, 1.0, 2.0)))),
    }


def may_repeat(worlds: KernelWorlds, world: int) -> bool:
    """Whether objects may come several times in the mode that this world has."""
    drop = worlds.scene.drop
    return bool(drop.move_repeats if worlds.state.mode.numpy()[world] == Mode.MOVE else drop.pick_repeats)


def expected_arrangements(worlds: KernelWorlds, seed: int = SEED) -> list[arrangement.Arrangement]:
    """Arrangement that the twin samples for each world, in the mode of that world."""
    return [
        arrangement.sample_objects(
            seed,
            *map(int, arrangement_id),
            volume=worlds.volume,
            compound=worlds.compound,
            budget=worlds.scene.drop.volume,
            exceed=bool(worlds.scene.drop.exceed),
            repeats=may_repeat(worlds, world),
            room=worlds.instances,
            single_slots=worlds.single_slots,
            compound_slots=worlds.compound_slots,
        )
        for world, arrangement_id in enumerate(worlds.state.arrangement_id.numpy())
    ]


@given(sizes=catalogs(), seed=st.integers(0, 2**63 - 1), first=st.integers(0, 2**30), arrangement=st.integers(0, 20))
def test_draws_are_the_twins_and_keep_the_law(sizes, seed, first, arrangement, device):
    worlds = arrangement_worlds(device, WORLDS, **sizes)
    worlds.begin(Phase.START, first + np.arange(WORLDS), arrangement)
    worlds.set(worlds.state.catalog_index, 99)
    arrange.sample_episodes(worlds.scene, worlds.state, seed)
    catalog_index, slot = worlds.state.catalog_index.numpy(), worlds.state.body_slot.numpy()
    for world, expected in enumerate(expected_arrangements(worlds, seed)):
        count = len(expected.entries)
        assert tuple(catalog_index[world, :count]) == expected.entries
        assert (catalog_index[world, count:] == -1).all()
        assert tuple(slot[world, :count]) == expected.slots
        state = (worlds.state.phase.numpy()[world], worlds.state.ending.numpy()[world])
        assert state == ((Phase.OVER, Ending.ARRANGEMENT_OVERFLOW) if expected.overflow else (Phase.START, Ending.RUNNING))
        check_law(worlds, world, catalog_index[world, :count], slot[world, :count])


def check_law(worlds: KernelWorlds, world: int, catalog_index: np.ndarray, slot: np.ndarray) -> None:
    drop, volume = worlds.scene.drop, worlds.volume[catalog_index]
    assert (volume <= drop.volume * (1 + 1e-6)).all()
    if not drop.exceed:
        assert volume.sum() <= drop.volume * (1 + 1e-6)
    elif len(volume):
        # Only the last object exceeds the budget, and none is missing unless there is no further room or object.
        assert volume[:-1].sum() < drop.volume * (1 + 1e-6)
        drawable = (worlds.volume <= drop.volume).sum()
        full = len(volume) == (worlds.instances if may_repeat(worlds, world) else min(worlds.instances, drawable))
        assert full or volume.sum() >= drop.volume * (1 - 1e-6)
    assert len(set(slot)) == len(slot)
    np.testing.assert_array_equal(slot >= worlds.single_slots, worlds.compound[catalog_index] == 1)
    assert (slot < worlds.slots).all()
    if not may_repeat(worlds, world):
        assert len(set(catalog_index)) == len(catalog_index)


# ---- modes ----


@pytest.fixture(scope="module")
def built(device) -> build.BuiltModel:
    return build.build_model(small_worlds.settings(), small_worlds.catalog(), device)


def modes(built, device, mode: str, mix: tuple[float, float, float], episodes: np.ndarray, arrangement: object = 0) -> np.ndarray:
    """Mode of each episode, one world an episode, from settings to the device and back."""
    config = small_worlds.settings(bake__mode=mode, bake__mix=list(mix))
    worlds = arrangement_worlds(device, worlds=len(episodes))
    scene = make_scene_data(config, small_worlds.catalog(), built, 1, device)
    worlds.scene = dataclasses.replace(worlds.scene, modes=scene.modes)
    worlds.begin(Phase.START, episodes, arrangement)
    worlds.set(worlds.state.mode, 99)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    return worlds.state.mode.numpy()


@pytest.mark.parametrize(("mode", "code"), [("pick", Mode.PICK), ("target", Mode.TARGET), ("move", Mode.MOVE)])
def test_a_single_mode_is_every_episodes(built, device, mode, code):
    assert (modes(built, device, mode, (1.0, 2.0, 3.0), np.arange(500)) == code).all()


@given(mix=st.tuples(*[st.integers(0, 5)] * 3).filter(any), first=st.integers(0, 2**30))
def test_mixed_modes_are_the_twins(mix, first, built, device):
    episodes = first + np.arange(WORLDS)
    np.testing.assert_array_equal(modes(built, device, "mixed", mix, episodes), arrangement.sample_modes(SEED, episodes, mix))


@pytest.mark.parametrize("mix", [(1.0, 1.0, 1.0), (0.5, 0.3, 0.2), (3.0, 0.0, 1.0), (0.0, 2.0, 0.0), (1e-9, 0.0, 1e3), (1e3, 0.0, 1e-9)])
def test_shares_of_modes_are_the_weights(built, device, mix):
    """Within four standard deviations; a mode of weight 0 never comes, on whichever side it stands."""
    episodes = 4000
    found = modes(built, device, "mixed", mix, np.arange(episodes))
    for code, share in zip((Mode.PICK, Mode.TARGET, Mode.MOVE), np.array(mix) / sum(mix), strict=True):
        assert (found == code).mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / episodes))


@given(mix=st.tuples(*[st.integers(0, 5)] * 3), first=st.integers(0, 2**31 - WORLDS))
def test_a_cycle_has_each_mode_once_in_three_episodes(mix, first, built, device):
    """Of any three episodes in a row, whatever the weights of mode mixed."""
    episodes = first + np.arange(WORLDS)
    found = modes(built, device, "cycle", mix, episodes)
    np.testing.assert_array_equal(found, np.array((Mode.PICK, Mode.TARGET, Mode.MOVE))[episodes % 3])


def test_each_split_has_its_own_mode(built, device):
    """Splits in one range of indices, with a gap; a cycle begins with the split."""
    config = small_worlds.settings()
    splits = (Split("train", 4, 0, "move", "train"), Split("val", 5, 4, "cycle", "val"), Split("test", 3, 20, "target", "test"))
    episodes = np.array([0, 3, 4, 5, 6, 7, 8, 20, 22])
    worlds = arrangement_worlds(device, worlds=len(episodes))
    scene = make_scene_data(dataclasses.replace(config, splits=splits), small_worlds.catalog(), built, 1, device)
    worlds.scene = dataclasses.replace(worlds.scene, modes=scene.modes)
    worlds.begin(Phase.START, episodes, 0)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    cycle = [Mode.PICK, Mode.TARGET, Mode.MOVE, Mode.PICK, Mode.TARGET]
    assert worlds.state.mode.numpy().tolist() == [Mode.MOVE, Mode.MOVE, *cycle, Mode.TARGET, Mode.TARGET]


def test_an_episode_keeps_its_mode_in_any_world_and_arrangement(built, device):
    """Whatever world has the episode, of however many, and however often its arrangement was expected_arrangements again."""
    mix, episodes = (1.0, 1.0, 1.0), np.arange(60)
    expected = modes(built, device, "mixed", mix, episodes)
    numbers = np.random.default_rng(5)
    for count in (7, 60):
        some = numbers.permutation(episodes)[:count]
        arrangement = numbers.integers(0, 20, count)
        np.testing.assert_array_equal(modes(built, device, "mixed", mix, some, arrangement), expected[some])


def test_modes_are_drawn_apart_from_objects(device):
    """Where modes differ and the rules of repeating do not, all else of an episode is the same."""
    episodes, objects = np.arange(WORLDS), []
    for mix in ((1.0, 0.0, 0.0), (1.0, 1.0, 1.0)):
        worlds = arrangement_worlds(device, WORLDS, mix=mix, drop={"move_repeats": 1, "pick_repeats": 1})
        worlds.begin(Phase.START, episodes)
        arrange.sample_episodes(worlds.scene, worlds.state, SEED)
        objects.append((worlds.state.catalog_index.numpy(), worlds.state.light_yaw.numpy()))
    for pick, mixed in zip(*objects, strict=True):
        np.testing.assert_array_equal(pick, mixed)


def test_a_budget_for_everything_draws_everything_without_repeats(device):
    worlds = arrangement_worlds(device, WORLDS, drop={"volume": 10.0, "move_repeats": 0})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    assert (np.sort(worlds.state.catalog_index.numpy(), axis=1)[:, -3:] == [0, 1, 2]).all()
    assert len(np.unique(worlds.state.catalog_index.numpy(), axis=0)) == 6


@pytest.mark.parametrize("counts", [[(0, 0), (8, 8), (0, 0)], [(3, 3), (4, 4), (1, 1)], [(0, 2), (1, 3), (2, 3)]])
def test_numbers_of_parts_are_those_that_are_set_whatever_the_budget(device, counts):
    """Homogeneous, kitted and random fills, with a compound object among the parts; results do not depend on the number of worlds."""
    worlds = arrangement_worlds(device, WORLDS, counts=counts, drop={"volume": 1e-3})
    worlds.begin(Phase.START, np.arange(WORLDS)[::-1] + 7, 1)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    found, slot = worlds.state.catalog_index.numpy(), worlds.state.body_slot.numpy()
    for world, episode in enumerate(range(WORLDS + 6, 6, -1)):
        expected = arrangement.draw_counted(SEED, episode, 1, counts)
        assert found[world].tolist() == expected + [-1] * (8 - len(expected))
        kinds = np.array(expected) == 1
        for kind, first in ((False, 0), (True, worlds.single_slots)):
            assert slot[world, : len(expected)][kinds == kind].tolist() == list(range(first, first + (kinds == kind).sum()))
    drawn = (found[:, :, None] == np.arange(3)).sum(axis=1)
    assert drawn.min(axis=0).tolist() == [low for low, _ in counts]
    assert drawn.max(axis=0).tolist() == [high for _, high in counts]
    assert len(np.unique(found, axis=0)) > (WORLDS // 2 if sum(high > 0 for _, high in counts) > 1 else 0)


def test_numbers_of_parts_without_slots_for_them_end_the_episode(device):
    worlds = arrangement_worlds(device, WORLDS, counts=[(0, 0), (5, 5), (0, 0)], compound_slots=4)
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    assert (worlds.state.ending.numpy() == Ending.ARRANGEMENT_OVERFLOW).all()
    assert (worlds.state.catalog_index.numpy() == -1).all()


@pytest.mark.parametrize(
    ("volume", "exceed", "objects"), [(1.0, 0, 4), (1.0, 1, 4), (1.1, 0, 4), (1.1, 1, 5), (0.9, 0, 3), (0.9, 1, 4), (9.0, 1, 8)]
)
def test_the_budget_may_be_met_exactly_and_the_object_that_exceeds_it_stays_or_not(device, volume, exceed, objects):
    """Objects of a quarter, of which a world holds eight."""
    one = {"volume": np.array([0.25]), "compound": np.array([0]), "radius": np.array([0.1])}
    worlds = arrangement_worlds(device, WORLDS, **one, drop={"volume": volume, "exceed": exceed})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    assert ((worlds.state.catalog_index.numpy() == 0).sum(axis=1) == objects).all()


@pytest.mark.parametrize("repeats", [0, 1])
@pytest.mark.parametrize("exceed", [0, 1])
def test_an_object_that_never_fits_is_never_drawn(device, exceed, repeats):
    worlds = arrangement_worlds(device, WORLDS, drop={"volume": 0.25, "exceed": exceed, "move_repeats": repeats})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    catalog_index = worlds.state.catalog_index.numpy()
    assert (catalog_index[:, 0] >= 0).all()
    assert not (catalog_index == 2).any()


def test_each_mode_has_its_own_rule_of_repeating(device):
    """One bake: episodes of picking without repeats, episodes of moving with them."""
    worlds = arrangement_worlds(device, worlds=200, mix=(1.0, 1.0, 1.0), drop={"volume": 10.0, "move_repeats": 1, "pick_repeats": 0})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    moving = worlds.state.mode.numpy() == Mode.MOVE
    assert 0 < moving.sum() < 200
    count = (worlds.state.catalog_index.numpy() >= 0).sum(axis=1)
    # Three entries, room for eight instances, a budget for all.
    np.testing.assert_array_equal(count, np.where(moving, 8, 3))


@pytest.mark.parametrize(
    ("mix", "fill", "slots"),
    [
        ((1.0, 0.0, 0.0), "within", (2, 1)),
        ((1.0, 1.0, 2.0), "within", None),
        ((1.0, 0.0, 0.0), "exceed", (2, 1)),
        ((1.0, 1.0, 2.0), "exceed", None),
    ],
)
def test_counted_slots_hold_the_draws_of_all_modes(device, mix, fill, slots):
    """What scenes.build counts is enough for what the device draws, but for the accepted share."""
    shortfall, episodes = 0.02, 2000
    config = small_worlds.settings(
        bake__mode="mixed",
        bake__mix=list(mix),
        arrangement__volume=1.2e-3,
        arrangement__max_objects=12,
        arrangement__slot_shortfall=shortfall,
        arrangement__fill=fill,
    )
    objects = small_worlds.catalog()
    single, compound = build.count_slots(config.arrangement, build.find_repeat_rules(config.bake, config.pick, config.move), objects)
    worlds = arrangement_worlds(
        device,
        episodes,
        mix,
        volume=np.array([catalog_index.volume for catalog_index in objects.entries]),
        compound=np.array([len(catalog_index.pieces) > 1 for catalog_index in objects.entries]),
        instances=12,
        single_slots=single,
        compound_slots=compound,
        drop={"volume": 1.2e-3, "exceed": int(fill == "exceed"), "move_repeats": 1, "pick_repeats": 0},
    )
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    over = (worlds.state.ending.numpy() == Ending.ARRANGEMENT_OVERFLOW).mean()
    assert over <= shortfall + 4 * np.sqrt(shortfall / episodes)
    assert (single, compound) == slots if slots else over > 0.0


@pytest.mark.parametrize("phase", [Phase.EMPTY, Phase.SETTLE, Phase.ACT, Phase.OVER])
def test_worlds_at_work_keep_their_objects(device, phase):
    worlds = arrangement_worlds(device, WORLDS)
    worlds.begin(phase)
    worlds.set(worlds.state.catalog_index, 2)
    worlds.set(worlds.state.light, 7)
    worlds.set(worlds.state.mode, 9)
    joints = worlds.physics.state.joint_q
    worlds.set(joints, 0.5)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    assert (worlds.state.catalog_index.numpy() == 2).all()
    assert (worlds.state.light.numpy() == 7).all()
    assert (worlds.state.mode.numpy() == 9).all()
    if phase != Phase.OVER:
        assert (worlds.state.variant.numpy().reshape(WORLDS, -1)[:, 2:] == -1).all()
        assert (joints.numpy() == 0.5).all()
        assert not worlds.state.restarted.numpy().any()


@given(sizes=catalogs(), spread=st.floats(0.0, 1.0), clearance=st.floats(0.0, 0.05), episode=st.integers(0, 2**30))
def test_objects_fall_from_a_column_within_the_opening(sizes, spread, clearance, episode, device):
    sizes["drop"] |= {"spread": spread, "clearance": clearance}
    worlds = arrangement_worlds(device, WORLDS, **sizes)
    worlds.begin(Phase.START, episode + np.arange(WORLDS))
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    over = worlds.state.phase.numpy() == Phase.OVER
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    np.testing.assert_array_equal(worlds.state.phase.numpy(), np.where(over, Phase.OVER, Phase.SETTLE))
    rim = (*worlds.bins[0].opening, worlds.bins[0].height)
    for world in range(WORLDS):
        catalog_index = worlds.state.catalog_index.numpy()[world]
        catalog_index = catalog_index[catalog_index >= 0]
        poses = worlds.coordinates()[world, worlds.state.body_slot.numpy()[world, : len(catalog_index)]]
        radius = worlds.radius[catalog_index]
        expected = arrangement.drop_poses(SEED, episode + world, 0, radius, rim=rim, clearance=clearance, spread=spread)
        np.testing.assert_allclose(poses, expected, atol=1e-5)
        place, bottom = poses[:, :3].astype(np.float64), poses[:, 2] - radius
        assert (bottom >= rim[2] - 1e-5).all()
        gaps = np.linalg.norm(place[:, None] - place[None], axis=2) - radius[:, None] - radius[None]
        assert (gaps[~np.eye(len(catalog_index), dtype=bool)] >= -1e-5).all()
        for axis in range(2):
            assert (np.abs(place[:, axis]) <= np.maximum(0.0, rim[axis] / 2 - radius) + 1e-6).all()


@given(seed=st.integers(0, 2**32 - 1), compartments=st.sampled_from([(1, 1), (3, 2)]), spread=st.sampled_from([0.0, 0.3, 1.0]))
def test_in_layers_objects_fall_from_cells_of_their_compartments(seed, compartments, spread, device):
    """No two bounding spheres overlap, all are over the opening, and no layer is empty below another; the twin has the same poses."""
    numbers = np.random.default_rng(seed)
    radius, most = numbers.uniform(0.008, 0.03, 3), numbers.integers(0, 14, 3) + 1
    sizes = dataclasses.replace(BIN, floor=(0.5, 0.3), compartments=compartments)
    counts = [(int(number), int(number)) for number in most]
    room = {"instances": 40, "single_slots": 40, "compound_slots": 40, "counts": counts, "radius": radius}
    worlds = arrangement_worlds(device, 4, **room, bins=(sizes,), drop={"spread": spread, "layers": 1, "clearance": 0.004})
    worlds.begin(Phase.START, seed % 1000 + np.arange(4))
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    count, pitch = int(most.sum()), np.float32(2 * radius.max()) + np.float32(0.004)
    centers, halves = np.hsplit(np.array(sizes.openings) * (1, 1, 0.5, 0.5), 2)
    for world in range(4):
        entries, slots = (array.numpy()[world, :count] for array in (worlds.state.catalog_index, worlds.state.body_slot))
        place, each = worlds.coordinates()[world, slots, :3].astype(np.float64), radius[entries]
        episode = seed % 1000 + world
        places = rng.stream_key(SEED, episode, 0, Stream.COMPARTMENT)
        chosen = rng.uniform_index(places, np.arange(count), len(halves))
        layer, middle, cell = arrangement.layer_places(chosen, pitch, centers, halves)
        key, index = rng.stream_key(SEED, episode, 0, Stream.DROP), np.arange(count)
        sides = np.stack([2 * rng.uniform(key, 5 * index + axis) - 1 for axis in (0, 1)], axis=1)
        across = middle + sides * spread * np.maximum(0.0, cell - each[:, None])
        np.testing.assert_allclose(place, np.column_stack([across, sizes.height + each + layer * pitch]), atol=2e-6)
        gaps = np.linalg.norm(place[:, None] - place[None], axis=2) - each[:, None] - each[None]
        assert gaps[~np.eye(count, dtype=bool)].min() > -1e-6
        assert (np.abs(place[:, :2] - centers[chosen]) <= halves[chosen] - each[:, None] + 1e-6).all()
        assert place[:, 2].max() < sizes.height + each.max() + pitch * (count - 1) / 2


@pytest.mark.parametrize("number", [2, 12])
def test_scattered_objects_rest_on_the_rim_or_on_those_below(number, device):
    """Cylinders about objects, their own if upright, do not overlap, are over the opening, and one clearance above what carries them."""
    radius, clearance = np.array([0.03, 0.04, 0.05]), 0.004
    room = {"instances": 36, "single_slots": 36, "compound_slots": 36, "counts": [(number // 2, number // 2)] * 3, "radius": radius}
    worlds = arrangement_worlds(device, 4, **room, drop={"spread": 1.0, "clearance": clearance})
    own = np.array([(0.015, -0.02, 0.026), (0.02, -0.03, 0.03), (0.04, -0.03, 0.03)], np.float32)
    cylinder = wp.array(own, dtype=wp.vec3, device=device)
    worlds.scene = dataclasses.replace(worlds.scene, upright=0.5, scattered=True, cylinder=cylinder)
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    count, stacked = 3 * (number // 2), 0
    for world in range(4):
        entries, slots = (array.numpy()[world, :count] for array in (worlds.state.catalog_index, worlds.state.body_slot))
        pose = worlds.coordinates()[world, slots].astype(np.float64)
        stands = (pose[:, 3:5] == 0.0).all(axis=1)
        assert 0 < stands.sum() < count
        sphere = radius[entries, None] * (1.0, -1.0, 1.0)
        wide, low, high = np.where(stands[:, None], own[entries], sphere).T
        low, high = low + pose[:, 2], high + pose[:, 2]
        assert (np.abs(pose[:, :2]) <= np.array(BIN.mouth) / 2 - wide[:, None] + 1e-6).all()
        apart = np.linalg.norm(pose[:, None, :2] - pose[None, :, :2], axis=2) - wide[:, None] - wide[None]
        near = (apart < clearance - 1e-6) & ~np.eye(count, dtype=bool)
        assert (np.maximum(low[:, None] - high[None], low[None] - high[:, None])[near] > clearance - 1e-6).all()
        on_rim = np.isclose(low, BIN.height + clearance, atol=1e-6)
        carried = (near & np.isclose(low[:, None], high[None] + clearance, atol=1e-6)).any(axis=1)
        assert (on_rim | carried).all()
        stacked += int(carried.sum())
    assert (stacked > 0) == (number > 2)


def test_the_drop_uses_the_whole_spread(device):
    worlds = arrangement_worlds(device, worlds=500, radius=np.full(3, 0.05), drop={"spread": 1.0})
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    full = worlds.coordinates()[worlds.forces()[:, :, 2] == 0.0]
    np.testing.assert_allclose(full[:, :2].min(axis=0), [-0.2, -0.1], atol=5e-3)
    np.testing.assert_allclose(full[:, :2].max(axis=0), [0.2, 0.1], atol=5e-3)


def test_empty_slots_wait_without_weight_and_full_ones_get_their_variant(device):
    worlds = arrangement_worlds(device, WORLDS)
    worlds.begin(Phase.START)
    worlds.set(worlds.physics.state.joint_qd, 1.0)
    worlds.set(worlds.physics.control.joint_f, 7.0)
    worlds.set(worlds.state.stuck, 5)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    state, catalog = worlds.state, worlds.scene.catalog
    variant = state.variant.numpy().reshape(WORLDS, -1)
    full = np.zeros((WORLDS, worlds.slots), dtype=bool)
    for world, instance in zip(*np.nonzero(state.catalog_index.numpy() >= 0), strict=True):
        slot, catalog_index = state.body_slot.numpy()[world, instance], state.catalog_index.numpy()[world, instance]
        full[world, slot] = True
        assert variant[world, 2 + slot] == catalog.variant.numpy()[catalog_index]
    empty = np.where(np.arange(worlds.slots) < worlds.single_slots, catalog.empty_single, catalog.empty_compound)
    np.testing.assert_array_equal(variant[:, 2:][~full], np.broadcast_to(empty, full.shape)[~full])
    weight = np.array([0.0, 0.0, catalog.empty_mass * worlds.scene.drop.gravity, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(worlds.forces(), np.where(full[:, :, None], 0.0, weight), rtol=1e-6)
    parked = [0.0, 0.0, PARKED_HEIGHT, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_array_equal(worlds.coordinates()[~full], np.broadcast_to(np.float32(parked), worlds.coordinates()[~full].shape))
    assert (worlds.physics.state.joint_qd.numpy() == 0.0).all()
    assert (state.stuck.numpy() == 0).all()
    np.testing.assert_array_equal(state.progress.numpy(), np.broadcast_to([0, 0, 0, 1], (WORLDS, 4)))
    assert state.restarted.numpy()[:-1].all()
    assert not state.restarted.numpy()[-1]
    gripper = worlds.physics.state.joint_q.numpy().reshape(WORLDS, -1)[:, :4]
    np.testing.assert_array_equal(gripper, np.tile([3.0, 0.0, 1.0, 0.0], (WORLDS, 1)))


def test_a_world_without_room_for_what_was_drawn_has_no_objects(device):
    worlds = arrangement_worlds(device, WORLDS, compound_slots=0)
    worlds.begin(Phase.START)
    arrange.sample_episodes(worlds.scene, worlds.state, SEED)
    arrange.drop_objects(worlds.scene, worlds.state, worlds.physics, SEED)
    over = worlds.state.ending.numpy() == Ending.ARRANGEMENT_OVERFLOW
    assert over.any()
    assert not over.all()
    assert (worlds.state.catalog_index.numpy()[over] == -1).all()
    assert (worlds.coordinates()[over][:, :, 2] == PARKED_HEIGHT).all()
    assert (worlds.forces()[over][:, :, 2] > 0.0).all()
