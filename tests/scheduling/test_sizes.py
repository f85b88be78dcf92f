"""Sizes that settings leave open: worlds from episodes, and batches, worlds and writers from free memory; the order of episodes; fills by
`arrangement.counts`, and capacities of a world for contacts, pairs and rows: what raises them, and that piles stay below."""

import math
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Mode
from synpick_warp.configs.cell.bins import BinRow, BinSizes
from synpick_warp.configs.files.load import config_to_toml, load_config, parse_assignment
from synpick_warp.configs.schema import Arrangement, Config, Physics
from synpick_warp.errors import ConfigError
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory import assembly, forecast, memory_plan
from synpick_warp.factory.episodes import EpisodeSource, count_writers
from synpick_warp.factory.forecast import (
    DEVIATIONS,
    FRAMES_OF_MODE,
    SORTED_EPISODES,
    deal_episodes,
    deal_writers,
    order_longest_first,
)
from synpick_warp.factory.memory_plan import (
    HEADROOM,
    KEPT_PICTURES,
    RUNTIME_BYTES,
    advise_processes,
    check_memory,
    fit_to_device,
    pick_processes,
    plan_memory,
    without_pictures,
)
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.kernels.newton_patches import contact_sweep
from synpick_warp.scenes import build, capacities
from synpick_warp.scenes.bin_meshes.reading import measure_bins
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.capacities import check_fill, count_entries, drop_height
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.types import Catalog, ConvexPiece
from synpick_warp.stages import view_ring
from synpick_warp.stages.perception.images import count_views
from synpick_warp.stages.sim.physics import balance_worlds
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing.exporters import digests
from tests.builders import PICKED, boxes, refusal
from tests.twins.arrangement import sample_modes, sample_objects
from tests.worlds.bin_meshes import round_bin, sloped_bin
from tests.worlds.small_worlds import ANGLE, BOX, CUBE, PLATE, catalog, cluttered_catalog, settings

GIB = 1024**3
CPU = SimpleNamespace(is_cuda=False, alias="cpu")
GPU = SimpleNamespace(is_cuda=True, alias="cuda:0", total_memory=64 * GIB)
"""Stand-ins for devices."""


def views_per_batch(config: Config, device: Any) -> int:
    return view_ring.views_per_batch(config.render, config.rig, config.bake.worlds, config.arrangement.max_objects, device)


def needed_bytes(config: Config, device: Any) -> float:
    terms = [term for term in plan_memory(config, device) if term.on_device == device.is_cuda]
    return sum((1.0 if term.name == KEPT_PICTURES else HEADROOM) * term.size for term in terms) + RUNTIME_BYTES


@pytest.fixture
def give(monkeypatch):
    """Set the memory of GPU and host, all of it free [GiB]."""

    def give(gpu: float = 140.0, host: float = 128.0) -> None:
        monkeypatch.setattr(GPU, "total_memory", int(gpu * GIB))
        monkeypatch.setattr(memory_plan, "free_device_memory", lambda device: int(gpu * GIB))
        for module in ("memory_plan", "episodes"):
            monkeypatch.setattr(f"synpick_warp.factory.{module}.free_host_memory", lambda: int(host * GIB))

    give()
    return give


@pytest.mark.parametrize(
    ("episodes", "limit", "worlds"),
    [(1, 512, 1), (150, 512, 150), (512, 512, 512), (513, 512, 257), (600, 512, 300), (1100, 512, 367), (0, 8, 1)],
)
def test_rounds_are_balanced(episodes, limit, worlds):
    assert balance_worlds(episodes, limit) == worlds


@pytest.mark.parametrize(
    ("machine", "episodes", "worlds"),
    [(GPU, 150, 150), (GPU, 60, 60), (GPU, 600, 300), (GPU, 2000, 500), (GPU, 3, 8), (CPU, 3, 3), (CPU, 6, 3), (CPU, 150, 4)],
)
def test_worlds_follow_from_the_number_of_episodes(give, machine, episodes, worlds):
    config = load_config("synpick", {"bake.mode": "mixed"})
    fitted = fit_to_device(config, machine, episodes)
    assert fitted.bake.worlds == worlds
    assert (fitted.render.views_per_batch, fitted.perception.views) == (0, 0)
    assert fit_to_device(load_config("synpick", {"bake.worlds": 60}), machine, episodes).bake.worlds == 60


@pytest.mark.parametrize("mode", ["mixed", "move"])
@pytest.mark.parametrize("gpu", [3.0, 4.0, 6.0, 8.0, 12.0, 24.0, 80.0])
def test_batches_shrink_until_plan_and_headroom_fit(give, gpu, mode):
    give(gpu)
    config = fit_to_device(load_config("synpick", {"bake.mode": mode}), GPU, 1024)
    assert needed_bytes(config, GPU) <= gpu * GIB
    # The larger part shrinks first: batches, or worlds where the light averaged over their frames is larger.
    assert config.bake.worlds >= min(512, 7.5 * gpu)
    if gpu >= 12.0:
        assert views_per_batch(config, GPU) >= 12
    check_memory(plan_memory(config, GPU), GPU)


def test_trajectories_alone_need_no_image_buffers(give):
    give()
    pictures, trajectories = (load_config("synpick", {"bake.formats": formats}) for formats in (["bop", "zarr"], ["usd", "zarr"]))
    assert without_pictures(pictures) == pictures
    needed = {term.name: term.size for term in plan_memory(fit_to_device(without_pictures(trajectories), GPU, 2048), GPU)}
    assert needed["light averaged over frames"] == 0
    before = {term.name: term.size for term in plan_memory(fit_to_device(trajectories, GPU, 2048), GPU)}
    assert before["light averaged over frames"] > 2 * GIB
    assert sum(needed.values()) < 0.6 * sum(before.values())


def test_settings_that_are_named_stay(give):
    give(2.0)  # No pictures are kept over frames.
    config = load_config("synpick", {"bake.worlds": 512, "render.views_per_batch": 25, "perception.views": 23, "bake.mode": "mixed"})
    assert fit_to_device(config, GPU, 512) == config.with_values({"render.reuse": False})


@pytest.mark.parametrize(("gpu", "least"), [(32.0, 20), (40.0, 150), (60.0, 400)])
def test_pictures_of_as_many_worlds_are_kept_as_fit(give, gpu, least):
    give(gpu)
    fitted = fit_to_device(load_config("synpick", {"bake.worlds": 512, "render.views_per_batch": 24}), GPU, 1024)
    assert fitted.render.reuse_worlds > least
    for more, fits in ((0, True), (12, False)):
        larger = fitted.with_values({"render.reuse_worlds": fitted.render.reuse_worlds + more})
        assert (needed_bytes(larger, GPU) <= gpu * GIB) == fits


@pytest.mark.parametrize(("key", "value", "part"), [("reuse", False, "pictures from"), ("reuse_worlds", 3, "than 3 of 8 worlds")])
def test_a_bake_says_that_it_does_not_keep_pictures(monkeypatch, key, value, part):
    notes, progress = [], SilentProgress()
    monkeypatch.setattr(progress, "note", notes.append)
    monkeypatch.setattr(assembly, "fit_to_device", lambda config, *_: config.with_values({f"render.{key}": value}))
    monkeypatch.setattr(assembly, "compiling_if_cold", Mock(side_effect=InterruptedError))
    with pytest.raises(InterruptedError):
        assembly.build_factory(load_config("synpick", {"bake.worlds": 8}), progress)
    assert [part in note for note in notes] == [True]


def test_processes_share_the_hosts_memory(give):
    give(host=4.0)
    config = load_config("synpick", {"bake.mode": "mixed", "cameras.resolution": [3840, 2160]})
    alone, shared = (fit_to_device(config, CPU, 4, processes=processes) for processes in (1, 4))
    assert views_per_batch(shared, CPU) < views_per_batch(alone, CPU) or count_views(shared.perception, 4, 24, CPU) < count_views(
        alone.perception, 4, 24, CPU
    )


@pytest.fixture
def cores(monkeypatch):
    """A machine of 16 cores and no GPU."""
    monkeypatch.setattr(memory_plan, "count_cores", lambda: 16)
    monkeypatch.setattr(memory_plan, "pick_devices", lambda names: ("cpu",) if list(names) == ["all"] else tuple(names))
    monkeypatch.setattr(memory_plan, "pick_device", lambda name: CPU)


def test_without_a_gpu_all_is_a_process_per_core_within_memory_and_episodes(give, cores):
    config = load_config("synpick", {"bake.mode": "mixed"})
    assert pick_processes(config, ["all"], 1000) == ("cpu",) * 16
    assert pick_processes(config, ["all"], 5) == ("cpu",) * 5
    assert pick_processes(config, ["all"], 0) == ("cpu",)
    give(host=12.0)
    few = pick_processes(config, ["all"], 1000)
    assert 2 <= len(few) < 12
    # The smallest sizes fit as often as was chosen, and not once more.
    least = load_config("synpick", {"bake.mode": "mixed", "bake.worlds": 1, "render.views_per_batch": 1, "perception.views": 1})
    needed = needed_bytes(least, CPU)
    assert len(few) * needed <= 12 * GIB < (len(few) + 1) * needed
    assert fit_to_device(config, CPU, 1000, processes=len(few)).bake.worlds >= 1
    give(host=0.5)
    assert pick_processes(config, ["all"], 1000) == ("cpu",)


def test_named_processes_stay(give, cores):
    give(host=0.5)
    assert pick_processes(load_config("synpick", {}), ["cpu"] * 3, 1000) == ("cpu",) * 3


def test_a_bake_on_one_of_several_cores_is_told_of_the_others(give, cores, monkeypatch):
    config = load_config("synpick", {})
    advice = "one process simulates on one CPU core; --devices all starts 3, which write the same bytes"
    assert advise_processes(config, ["cpu"], 3) == advice
    assert advise_processes(config, ["cpu"], 1) == ""
    assert advise_processes(config, ["cpu", "cpu"], 3) == ""
    monkeypatch.setattr(memory_plan, "pick_devices", lambda names: ("cuda:0",))
    assert advise_processes(config, ["cpu"], 3) == ""
    monkeypatch.setattr(memory_plan, "pick_device", lambda name: GPU)
    assert advise_processes(config, ["auto"], 3) == ""


def writers_of(config: Config) -> int:
    return count_writers(config.bake.writers, Needs.of(config).slot_bytes)


def test_writers_are_as_many_as_cores_if_memory_suffices(give, monkeypatch):
    monkeypatch.setattr("synpick_warp.factory.episodes.count_cores", lambda: 64)
    config = load_config("synpick", {})
    assert writers_of(config) == 64
    give(host=8.0)
    assert 1 < writers_of(config) < 64
    give(host=0.1)
    assert writers_of(config) == 1
    assert writers_of(load_config("synpick", {"bake.writers": 99})) == 99


# ---- order of episodes and their shares: the longest first, every episode once ----

OBJECTS = catalog(BOX, CUBE, ANGLE)
SEED = 5


def predicted_frames(config, episodes, modes) -> np.ndarray:
    """Frames that the order goes by, from the twins of the sampling kernels."""
    frames = []
    for episode, mode in zip(episodes, modes, strict=True):
        fixed, each, deviation = FRAMES_OF_MODE[Mode(mode)]
        sampled = sample_objects(
            SEED,
            int(episode),
            0,
            volume=np.array([entry.volume for entry in OBJECTS.entries]),
            compound=np.zeros(len(OBJECTS)),
            budget=config.arrangement.volume,
            exceed=config.arrangement.fill == "exceed",
            repeats=config.move.repeats if mode == Mode.MOVE else config.pick.repeats,
            room=config.arrangement.max_objects,
            single_slots=config.arrangement.max_objects,
            compound_slots=0,
        )
        frames.append(fixed + each * len(sampled.entries) + DEVIATIONS * deviation)
    return np.array(frames)


def test_the_episodes_that_may_be_longest_come_first(device):
    config = load_config("smoke", {"bake.mode": "mixed", "bake.mix": [2.0, 1.0, 1.0], "bake.seed": SEED, "pick.repeats": True})
    found = order_longest_first(config, OBJECTS, range(60), device)
    modes = sample_modes(SEED, np.arange(60), (2.0, 1.0, 1.0))
    frames = predicted_frames(config, range(60), modes)
    assert set(modes) == {Mode.PICK, Mode.TARGET, Mode.MOVE}
    assert len(set(frames.tolist())) > len(Mode)
    assert found == np.argsort(-frames, kind="stable").tolist()


def test_many_episodes_stay_mixed_but_for_the_last(device):
    config, count = load_config("smoke", {"bake.mode": "cycle", "bake.seed": SEED}), SORTED_EPISODES + 30
    found = order_longest_first(config, OBJECTS, range(count), device)
    assert found[:30] == list(range(30))
    assert sorted(found[30:]) == list(range(30, count))
    modes = np.array([Mode.PICK, Mode.TARGET, Mode.MOVE])[np.arange(count) % 3]
    frames = predicted_frames(config, range(count), modes)[found[30:]]
    assert (np.diff(frames) <= 0).all()


def test_only_the_episodes_that_are_sorted_are_sampled(device, monkeypatch):
    """A million episodes times their objects would take seconds, and more memory than is planned."""
    sampled = []

    def sample(config, catalog, episodes, device):
        sampled.extend(episodes.tolist())
        return np.full(len(episodes), Mode.MOVE), np.zeros(len(episodes))

    monkeypatch.setattr(forecast, "sample_episodes_ahead", sample)
    found = order_longest_first(load_config("smoke", {}), OBJECTS, range(10**6), device)
    assert found == list(range(10**6))
    assert sampled == found[-SORTED_EPISODES:]


@pytest.mark.parametrize(("episodes", "ordered"), [([4, 1, 3], [1, 3, 4]), ([], [])])
def test_episodes_of_equal_length_stay_in_order(device, episodes, ordered):
    assert order_longest_first(load_config("smoke", {"bake.mode": "move"}), OBJECTS, episodes, device) == ordered


def test_splits_of_different_modes(tmp_path, device):
    settings = tmp_path / "splits.toml"
    settings.write_text('[splits.train]\nepisodes = 2\nmode = "move"\n[splits.test]\nepisodes = 2\nmode = "target"\n')
    config = load_config(str(settings), {"arrangement.max_objects": 7, "arrangement.volume": 1.0, "pick.repeats": True})
    assert order_longest_first(config, OBJECTS, range(4), device) == [2, 3, 0, 1]


@given(episodes=st.lists(st.integers(0, 999), unique=True, max_size=50), devices=st.integers(1, 8))
def test_every_episode_is_dealt_once_and_in_order(episodes, devices):
    shares = deal_episodes(episodes, devices)
    assert sorted(episode for share in shares for episode in share) == sorted(episodes)
    assert max(map(len, shares)) - min(map(len, shares)) <= 1
    assert all(share == sorted(share, key=episodes.index) for share in shares)


def test_episodes_are_dealt_there_and_back():
    assert deal_episodes(range(7), 2) == [[0, 3, 4], [1, 2, 5, 6]]


@pytest.mark.parametrize(("writers", "devices", "dealt"), [(16, 2, [8, 8]), (17, 4, [5, 4, 4, 4]), (2, 3, [1, 1, 1]), (16, 1, [16])])
def test_writers_are_shared_out(writers, devices, dealt):
    assert deal_writers(writers, devices) == dealt


@pytest.mark.slow
def test_episodes_that_come_while_worlds_are_idle_have_the_bytes_of_one_bake(picked_set, tmp_path):
    class Source(EpisodeSource):
        def more(self, wait: bool) -> list[int]:
            return [rest.pop()] if rest else []

    rest = [0]
    with boxes():
        summary = bake_episodes(settings(**PICKED), tmp_path / "grown", SilentProgress(), Source([1]))
    assert not rest
    assert (summary.total, len(summary.episodes)) == (2, 2)
    assert digests(tmp_path / "grown") == digests(picked_set)


# ---- fills and capacities ----

PARTS = catalog(BOX, CUBE, PLATE)
NAMES = [entry.name for entry in PARTS.entries]


def load_fill(counts, **settings):
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
    config = load_fill(counts)
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
    said = refusal(load_fill, counts, **settings)
    assert "arrangement.counts" in said
    assert rule in said


def test_parts_are_found_by_name_and_by_obj_id_and_take_slots_of_their_largest_numbers():
    first, _, last = PARTS.entries
    counts = ((last.name, 1, 4), (str(first.obj_id), 2, 2))
    np.testing.assert_array_equal(count_entries(counts, PARTS), [(2, 2), (0, 0), (1, 4)])
    assert not count_entries((), PARTS).any()
    config = load_fill(((NAMES[0], 3, 7), (NAMES[2], 1, 2)))
    assert build.count_slots(config.arrangement, [False], PARTS) == (9, 0)
    assert not build.must_repeat(config.arrangement, PARTS)


def test_unknown_parts_are_named():
    with pytest.raises(ConfigError, match=f"which no object has.*{NAMES[0]}.*did you mean {NAMES[1]}"):
        count_entries(((f"{NAMES[1]}s", 1, 1),), PARTS)
    with pytest.raises(ConfigError, match="which is set already"):
        count_entries(((NAMES[0], 1, 1), (str(PARTS.entries[0].obj_id), 1, 1)), PARTS)


def test_more_than_the_bin_holds_is_refused():
    bins = load_config("smoke").cell.bins
    inside = bins[0].height * (np.prod(bins[0].floor) + np.prod(bins[0].opening)) / 2.0
    room = int(0.74 * inside / PARTS.entries[1].volume)
    few, many = (Arrangement(counts=((NAMES[1], 1, most),), drop="layers") for most in (room, room + 1))
    check_fill(few, 100.0, PARTS, bins)
    with pytest.raises(ConfigError, match="the tote has room for"):
        check_fill(many, 100.0, PARTS, bins)
    check_fill(many, 100.0, PARTS, load_config("tabletop").cell.bins)


def test_stacks_above_the_guide_walls_are_refused():
    """Known: cubes of 50 mm have spheres of 86.6 mm: in a column each takes 96.6 mm, over 545 x 352 mm a layer has 5 x 3 of them."""
    bins = load_config("smoke").cell.bins
    most, radius = np.array([0, 31, 0]), np.array([entry.radius for entry in PARTS.entries])
    column, layers = (Arrangement(counts=((NAMES[1], 31, 31),), drop=drop) for drop in ("column", "layers"))
    assert drop_height(most, radius, column, bins[0]) == pytest.approx(31 * 0.0966, rel=1e-3)
    assert drop_height(most, radius, layers, bins[0]) == pytest.approx(3 * 0.0966, rel=1e-3)
    check_fill(column, 3.0, PARTS, bins)
    check_fill(layers, 0.3, PARTS, bins)
    for arrangement, height, hint in ((column, 2.9, 'arrangement.drop = "layers"'), (layers, 0.28, "raise physics.guide_height")):
        with pytest.raises(ConfigError, match=hint):
            check_fill(arrangement, height, PARTS, bins)


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
