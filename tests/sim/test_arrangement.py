"""Which episode a world gets; its mode, objects and light, and where the objects fall from."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Ending, Mode, Phase, Stream
from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.schema import Config, Split
from synpick_warp.kernels.sim.drop import PARKED_HEIGHT
from synpick_warp.scenes.looks import Looks
from synpick_warp.stages.constants import mode_data, mode_rows
from synpick_warp.stages.render.looks import draw_looks
from synpick_warp.stages.sim import arrange
from tests.twins import arrangement, rng
from tests.worlds import small_worlds
from tests.worlds.kernel_worlds import BIN, KernelWorlds, arrangement_worlds

WORLDS = 24
SEED = 2**40 + 3
CYCLE = [Mode.PICK, Mode.TARGET, Mode.MOVE]


def drawn(device, worlds: int = WORLDS, episodes=None, arrangement: object = 0, **sizes) -> KernelWorlds:
    """Worlds whose episodes are sampled; see `arrangement_worlds`."""
    result = arrangement_worlds(device, worlds, **sizes)
    result.begin(Phase.START, episodes, arrangement)
    result.run(arrange.sample_episodes, SEED)
    return result


def dropped(device, worlds: int = WORLDS, episodes=None, arrangement: object = 0, **sizes) -> KernelWorlds:
    """Worlds whose objects begin to fall."""
    result = drawn(device, worlds, episodes, arrangement, **sizes)
    result.run(arrange.drop_objects, SEED)
    return result


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
    return bool(drop.move_repeats if worlds["mode"][world] == Mode.MOVE else drop.pick_repeats)


def expected_arrangement(worlds: KernelWorlds, world: int, seed: int) -> arrangement.Arrangement:
    """Arrangement that the twin samples for a world, in its mode."""
    return arrangement.sample_objects(
        seed,
        *map(int, worlds["arrangement_id"][world]),
        volume=worlds.volume,
        compound=worlds.compound,
        budget=worlds.scene.drop.volume,
        exceed=bool(worlds.scene.drop.exceed),
        repeats=may_repeat(worlds, world),
        room=worlds.instances,
        single_slots=worlds.single_slots,
        compound_slots=worlds.compound_slots,
    )


@given(sizes=catalogs(), seed=st.integers(0, 2**63 - 1), first=st.integers(0, 2**30), arrangement=st.integers(0, 20))
def test_draws_are_the_twins_and_keep_the_law(sizes, seed, first, arrangement, device):
    worlds = arrangement_worlds(device, WORLDS, **sizes)
    worlds.begin(Phase.START, first + np.arange(WORLDS), arrangement)
    worlds.put(catalog_index=99)
    worlds.run(arrange.sample_episodes, seed)
    catalog_index, slot = worlds["catalog_index"], worlds["body_slot"]
    for world in range(WORLDS):
        expected = expected_arrangement(worlds, world, seed)
        count = len(expected.entries)
        assert tuple(catalog_index[world, :count]) == expected.entries
        assert (catalog_index[world, count:] == -1).all()
        assert tuple(slot[world, :count]) == expected.slots
        assert (worlds["phase"][world], worlds["ending"][world]) == (
            (Phase.OVER, Ending.ARRANGEMENT_OVERFLOW) if expected.overflow else (Phase.START, Ending.RUNNING)
        )
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


def modes(device, config: Config, episodes: np.ndarray, arrangement: object = 0) -> np.ndarray:
    """Mode of each episode, one world an episode, from settings to the device and back."""
    worlds = arrangement_worlds(device, len(episodes))
    worlds.scene = dataclasses.replace(worlds.scene, modes=mode_data(mode_rows(config.bake, config.splits), device))
    worlds.begin(Phase.START, episodes, arrangement)
    worlds.put(mode=99)
    worlds.run(arrange.sample_episodes, SEED)
    return worlds["mode"]


def weighted(mode: str, mix: Sequence[float]) -> Config:
    return small_worlds.settings(bake__mode=mode, bake__mix=list(mix))


@given(mix=st.tuples(*[st.integers(0, 5)] * 3).filter(any), first=st.integers(0, 2**30), arrangements=st.integers(0, 20))
def test_mixed_modes_are_the_twins(mix, first, arrangements, device):
    """Whatever world has the episode, and however often its arrangement was drawn again."""
    episodes = np.random.default_rng(first).permutation(first + np.arange(2 * WORLDS))[:WORLDS]
    found = modes(device, weighted("mixed", mix), episodes, arrangements)
    np.testing.assert_array_equal(found, arrangement.sample_modes(SEED, episodes, mix))


@pytest.mark.parametrize("mix", [(1.0, 1.0, 1.0), (0.5, 0.3, 0.2), (3.0, 0.0, 1.0), (0.0, 2.0, 0.0), (1e-9, 0.0, 1e3), (1e3, 0.0, 1e-9)])
def test_shares_of_modes_are_the_weights(device, mix):
    """Within four standard deviations; a mode of weight 0 never comes, on whichever side it stands."""
    episodes = 4000
    found = modes(device, weighted("mixed", mix), np.arange(episodes))
    for code, share in zip(CYCLE, np.array(mix) / sum(mix), strict=True):
        assert (found == code).mean() == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / episodes))


@pytest.mark.parametrize(("mode", "codes"), [*((code.name.lower(), [code]) for code in CYCLE), ("cycle", CYCLE)])
@given(mix=st.tuples(*[st.integers(0, 5)] * 3), first=st.integers(0, 2**31 - WORLDS))
def test_a_single_mode_is_every_episodes_and_a_cycle_has_each_in_turn(mix, first, mode, codes, device):
    """Whatever the weights of mode mixed."""
    episodes = first + np.arange(WORLDS)
    assert modes(device, weighted(mode, mix), episodes).tolist() == np.array(codes)[episodes % len(codes)].tolist()


def test_each_split_has_its_own_mode(device):
    """Splits in one range of indices, with a gap; a cycle begins with the split."""
    splits = (Split("train", 4, 0, "move", "train"), Split("val", 5, 4, "cycle", "val"), Split("test", 3, 20, "target", "test"))
    config = dataclasses.replace(small_worlds.settings(), splits=splits)
    found = modes(device, config, np.array([0, 3, 4, 5, 6, 7, 8, 20, 22]))
    assert found.tolist() == [Mode.MOVE, Mode.MOVE, *CYCLE, *CYCLE[:2], Mode.TARGET, Mode.TARGET]


# ---- objects ----


@pytest.mark.parametrize("counts", [[(0, 0), (8, 8), (0, 0)], [(3, 3), (4, 4), (1, 1)], [(0, 2), (1, 3), (2, 3)]])
def test_numbers_of_parts_are_those_that_are_set_whatever_the_budget(device, counts):
    """Homogeneous, kitted and random fills, with a compound object among the parts; results do not depend on the number of worlds."""
    worlds = drawn(device, WORLDS, np.arange(WORLDS)[::-1] + 7, 1, counts=counts, drop={"volume": 1e-3})
    found, slot = worlds["catalog_index"], worlds["body_slot"]
    for world, episode in enumerate(range(WORLDS + 6, 6, -1)):
        expected = arrangement.draw_counted(SEED, episode, 1, counts)
        assert found[world].tolist() == expected + [-1] * (8 - len(expected))
        kinds = np.array(expected) == 1
        for kind, first in ((False, 0), (True, worlds.single_slots)):
            assert slot[world, : len(expected)][kinds == kind].tolist() == list(range(first, first + (kinds == kind).sum()))
    numbers = (found[:, :, None] == np.arange(3)).sum(axis=1)
    assert numbers.min(axis=0).tolist() == [low for low, _ in counts]
    assert numbers.max(axis=0).tolist() == [high for _, high in counts]
    assert len(np.unique(found, axis=0)) > (WORLDS // 2 if sum(high > 0 for _, high in counts) > 1 else 0)


@pytest.mark.parametrize(
    ("volume", "exceed", "objects"), [(1.0, 0, 4), (1.0, 1, 4), (1.1, 0, 4), (1.1, 1, 5), (0.9, 0, 3), (0.9, 1, 4), (9.0, 1, 8)]
)
def test_the_budget_may_be_met_exactly_and_the_object_that_exceeds_it_stays_or_not(device, volume, exceed, objects):
    """Objects of a quarter, of which a world holds eight."""
    one = {"volume": np.array([0.25]), "compound": np.array([0]), "radius": np.array([0.1])}
    worlds = drawn(device, **one, drop={"volume": volume, "exceed": exceed})
    assert ((worlds["catalog_index"] == 0).sum(axis=1) == objects).all()


@pytest.mark.parametrize("phase", [Phase.EMPTY, Phase.SETTLE, Phase.ACT, Phase.OVER])
def test_worlds_at_work_keep_their_objects(device, phase):
    worlds = arrangement_worlds(device, WORLDS)
    worlds.begin(phase)
    kept = {"catalog_index": 2, "light": 7, "mode": 9} | ({"joint_q": 0.5} if phase != Phase.OVER else {})
    worlds.put(**kept)
    worlds.run(arrange.sample_episodes, SEED)
    worlds.run(arrange.drop_objects, SEED)
    assert all((worlds[name] == value).all() for name, value in kept.items())
    if phase != Phase.OVER:
        assert (worlds["variant"].reshape(WORLDS, -1)[:, 2:] == -1).all()
        assert not worlds["restarted"].any()


# ---- drops ----


@given(sizes=catalogs(), spread=st.floats(0.0, 1.0), clearance=st.floats(0.0, 0.05), episode=st.integers(0, 2**30))
def test_objects_fall_from_a_column_within_the_opening(sizes, spread, clearance, episode, device):
    sizes["drop"] |= {"spread": spread, "clearance": clearance}
    worlds = drawn(device, WORLDS, episode + np.arange(WORLDS), **sizes)
    over = worlds["phase"] == Phase.OVER
    worlds.run(arrange.drop_objects, SEED)
    np.testing.assert_array_equal(worlds["phase"], np.where(over, Phase.OVER, Phase.SETTLE))
    rim = (*worlds.bins[0].opening, worlds.bins[0].height)
    for world in range(WORLDS):
        catalog_index = worlds["catalog_index"][world]
        catalog_index = catalog_index[catalog_index >= 0]
        poses = worlds.coordinates()[world, worlds["body_slot"][world, : len(catalog_index)]]
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
    drop = {"spread": spread, "layers": 1, "clearance": 0.004}
    worlds = dropped(device, 4, seed % 1000 + np.arange(4), **room, bins=(sizes,), drop=drop)
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
    worlds = drawn(device, 4, **room, drop={"spread": 1.0, "clearance": clearance})
    own = np.array([(0.015, -0.02, 0.026), (0.02, -0.03, 0.03), (0.04, -0.03, 0.03)], np.float32)
    cylinder = wp.array(own, dtype=wp.vec3, device=device)
    worlds.scene = dataclasses.replace(worlds.scene, upright=0.5, scattered=True, cylinder=cylinder)
    worlds.run(arrange.drop_objects, SEED)
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


def test_empty_slots_wait_without_weight_and_full_ones_get_their_variant(device):
    worlds = drawn(device)
    worlds.put(joint_qd=1.0, joint_f=7.0, stuck=5)
    worlds.run(arrange.drop_objects, SEED)
    catalog, variant = worlds.scene.catalog, worlds["variant"].reshape(WORLDS, -1)
    full = np.zeros((WORLDS, worlds.slots), dtype=bool)
    for world, instance in zip(*np.nonzero(worlds["catalog_index"] >= 0), strict=True):
        slot, catalog_index = worlds["body_slot"][world, instance], worlds["catalog_index"][world, instance]
        full[world, slot] = True
        assert variant[world, 2 + slot] == catalog.variant.numpy()[catalog_index]
    empty = np.where(np.arange(worlds.slots) < worlds.single_slots, catalog.empty_single, catalog.empty_compound)
    np.testing.assert_array_equal(variant[:, 2:][~full], np.broadcast_to(empty, full.shape)[~full])
    weight = np.array([0.0, 0.0, catalog.empty_mass * worlds.scene.drop.gravity, 0.0, 0.0, 0.0])
    np.testing.assert_allclose(worlds.forces(), np.where(full[:, :, None], 0.0, weight), rtol=1e-6)
    parked = [0.0, 0.0, PARKED_HEIGHT, 0.0, 0.0, 0.0, 1.0]
    np.testing.assert_array_equal(worlds.coordinates()[~full], np.broadcast_to(np.float32(parked), worlds.coordinates()[~full].shape))
    assert (worlds["joint_qd"] == 0.0).all()
    assert (worlds["stuck"] == 0).all()
    assert (worlds["progress"] == [0, 0, 0, 1]).all()
    assert worlds["restarted"].tolist() == [True] * WORLDS + [False]
    assert (worlds["joint_q"].reshape(WORLDS, -1)[:, :4] == [3.0, 0.0, 1.0, 0.0]).all()


@pytest.mark.parametrize("sizes", [{"compound_slots": 0}, {"counts": [(0, 0), (5, 5), (0, 0)], "compound_slots": 4}])
def test_a_world_without_room_for_what_was_drawn_has_no_objects(device, sizes):
    worlds = dropped(device, **sizes)
    over = worlds["ending"] == Ending.ARRANGEMENT_OVERFLOW
    assert over.any()
    assert over.all() == ("counts" in sizes)
    assert (worlds["catalog_index"][over] == -1).all()
    assert (worlds.coordinates()[over][:, :, 2] == PARKED_HEIGHT).all()
    assert (worlds.forces()[over][:, :, 2] > 0.0).all()


# ---- lights ----


def test_maps_turns_and_exposures_are_even_and_the_episodes_own(device):
    """Of exposures, half a stop either way: mean 0 and deviation 0.5 / √3, within four standard errors; other worlds draw the same."""
    worlds = drawn(device, 2000)
    counts = np.bincount(worlds["light"], minlength=5)
    assert counts.min() > 330
    assert len(counts) == 5
    exposure = worlds["light_exposure"]
    assert np.abs(exposure).max() <= 0.5
    assert exposure.mean() == pytest.approx(0.0, abs=4 * 0.5 / np.sqrt(3 * 2000))
    np.testing.assert_allclose(np.quantile(exposure, (0.05, 0.25, 0.5, 0.75, 0.95)), (-0.45, -0.25, 0.0, 0.25, 0.45), atol=0.05)
    keys = [rng.stream_key(SEED, episode, 0, Stream.LIGHT) for episode in range(2000)]
    np.testing.assert_allclose(worlds["light_yaw"], [2 * np.pi * rng.uniform(key, 1) for key in keys], rtol=1e-6)
    np.testing.assert_allclose(exposure, [rng.uniform(key, 2) - 0.5 for key in keys], atol=1e-6)
    few = drawn(device, 3, np.array([1999, 7, 300]))
    np.testing.assert_array_equal(few["light_exposure"], exposure[[1999, 7, 300]])
    wide = drawn(device, 2000, drop={"exposure_spread": 2.0})
    np.testing.assert_allclose(wide["light_exposure"], 4.0 * exposure, rtol=1e-6)
    np.testing.assert_array_equal(wide["light_yaw"], worlds["light_yaw"])


def test_a_distribution_of_exposure_replaces_the_spread_and_is_that_of_the_record(device):
    """A look is the episode's, not that of one of its arrangements."""
    randomize = Randomize(exposure=Distribution.parse({"uniform": [1.0, 3.0]}))
    plain, own = drawn(device, arrangement=2), drawn(device, arrangement=2, randomize=randomize)
    recorded = [draw_looks(Looks(randomize, (), ()), SEED, episode, 0)["exposure"] for episode in range(WORLDS)]
    np.testing.assert_allclose(own["light_exposure"], recorded, atol=1e-6)
    assert 1.0 <= min(recorded) < 1.5
    assert 2.5 < max(recorded) <= 3.0
    assert np.abs(plain["light_exposure"]).max() <= 0.5


@pytest.mark.parametrize("setting", ["random_yaw", "exposure_spread"])
def test_what_is_not_to_be_drawn_is_zero(device, setting):
    worlds = drawn(device, drop={setting: 0})
    for name, array in (("random_yaw", "light_yaw"), ("exposure_spread", "light_exposure")):
        assert (worlds[array] == 0.0).all() == (name == setting)


# ---- who gets which episode ----


@pytest.mark.parametrize(
    ("before", "following", "listed", "tries", "after", "taken"),
    [
        ([(Phase.EMPTY, 0, -1, 0)] * 3, 0, [7, 2], 1, [(Phase.START, 0, 7, 0), (Phase.START, 0, 2, 0), (Phase.IDLE, 0, -1, 0)], 2),
        (
            [
                (Phase.OVER, Ending.UNSETTLED, 3, 0),
                (Phase.OVER, Ending.FINISHED, 4, 0),
                (Phase.OVER, Ending.NOT_FINITE, 5, 1),
                (Phase.OVER, Ending.UNSETTLED, 6, 2),
            ],
            9,
            range(100),
            3,
            [(Phase.START, Ending.RUNNING, *episode) for episode in ((3, 1), (9, 0), (5, 2), (10, 0))],
            11,
        ),
        (busy := [(Phase.SETTLE, 0, 0, 0), (Phase.ACT, 0, 1, 0), (Phase.IDLE, 0, -1, 0)], 2, range(9), 3, busy, 2),
    ],
    ids=["empty worlds take the list in order", "without delivery an episode is resampled, then given up", "busy worlds keep theirs"],
)
def test_assignment_of_episodes(device, before, following, listed, tries, after, taken):
    """Phase, ending, episode and arrangement of each world, and the position in the list, before and after."""
    worlds = arrangement_worlds(device, len(before))
    phase, ending, *ids = zip(*before, strict=True)
    worlds.put(phase=phase, ending=ending, arrangement_id=np.transpose(ids), next_episode=following)
    worlds.run(arrange.assign_episodes, wp.array(list(listed), dtype=wp.int32, device=device), tries)
    found = np.column_stack([worlds["phase"], worlds["ending"], worlds["arrangement_id"]])
    assert [tuple(row) for row in found.tolist()] == after
    assert worlds["next_episode"].tolist() == [taken]


def test_idle_worlds_that_are_freed_take_episodes_of_another_list(device):
    worlds = arrangement_worlds(device, 3)
    worlds.put(phase=[Phase.IDLE, Phase.ACT, Phase.IDLE], arrangement_id=[[-1, 0], [4, 1], [-1, 0]])
    worlds.run(arrange.free_idle_worlds)
    worlds.run(arrange.assign_episodes, wp.array([8], dtype=wp.int32, device=device), 1)
    assert worlds["arrangement_id"].tolist() == [[8, 0], [4, 1], [-1, 0]]
    assert worlds["phase"].tolist() == [Phase.START, Phase.ACT, Phase.IDLE]


@given(count=st.integers(1, 6), episodes=st.integers(1, 20), tries=st.integers(1, 4), seed=st.integers(0, 2**32 - 1))
def test_every_episode_ends_once(count, episodes, tries, seed, device):
    """With random endings, each episode is delivered or given up exactly once; then all worlds are idle."""
    numbers, worlds = np.random.default_rng(seed), arrangement_worlds(device, count)
    worlds.begin(Phase.EMPTY, -1)
    started, ended = [], []
    listed = wp.array(np.arange(episodes), dtype=wp.int32, device=device)
    for _ in range(8 * episodes * tries):
        worlds.run(arrange.assign_episodes, listed, tries)
        phase, ending, arrangement_id = worlds["phase"], worlds["ending"], worlds["arrangement_id"]
        started += [tuple(arrangement_id[world]) for world in np.flatnonzero(phase == Phase.START)]
        for world in np.flatnonzero(phase != Phase.IDLE):
            phase[world], ending[world] = Phase.ACT, Ending.RUNNING
            if numbers.uniform() < 0.5:
                phase[world], ending[world] = Phase.OVER, numbers.choice([Ending.FINISHED, Ending.UNSETTLED])
                if ending[world] == Ending.FINISHED or arrangement_id[world, 1] == tries - 1:
                    ended.append(int(arrangement_id[world, 0]))
        if (phase == Phase.IDLE).all():
            break
        worlds.put(phase=phase, ending=ending)
    assert (worlds["phase"] == Phase.IDLE).all()
    assert sorted(ended) == list(range(episodes))
    assert len(set(started)) == len(started)
    assert [episode for episode, arrangement in started if arrangement == 0] == list(range(episodes))
    assert (worlds["arrangement_id"][:, 0] == -1).all()
