"""Presets and splits: what they change, random numbers, changes of every row, ranges of episodes; the reference of all settings."""

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Stream
from synpick_warp.configs.dataset import DataLayout, episode_range, may_pick, mode_weights
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import config_to_toml, load_config, preset_names, sections
from synpick_warp.configs.schema import Split
from synpick_warp.dataset.commit.manifest import make_manifest
from tests.builders import mistake
from tests.twins import rng
from tools.docs import SETTINGS_REFERENCE, settings_reference

EPISODE_BITS = 32
"""Bits of an episode's index: bake.episodes is at most 2³¹ - 1."""


def resolved(name: str) -> dict[str, object]:
    """Full key -> value of every setting of a preset."""
    config = load_config(name)
    return {f"{section}.{key}": getattr(getattr(config, section), key) for section, kind in sections().items() for key in settings_of(kind)}


def changes(name: str, base: str) -> dict[str, object]:
    """Settings of a preset that differ from those of another one."""
    before = resolved(base)
    return {key: value for key, value in resolved(name).items() if value != before[key]}


def test_the_released_generator_differs_from_the_paper_in_exactly_this():
    assert changes("synpick-released", "synpick") == {
        "move.damping": 1.0,
        "pick.failures": 4,
        "suction.tolerated_misses": 2,
        "suction.poor_force": 0.2,
        "bop.coco": False,
    }
    paper = load_config("synpick")
    assert (paper.move.damping, paper.pick.failures, paper.suction.tolerated_misses) == (60.0, 3, 0)
    assert (paper.suction.poor_force, paper.bop.coco) == (2.0, True)


def test_the_smoke_preset_stirs_few_objects_in_small_images():
    changed = changes("smoke", "synpick")
    assert (load_config("synpick").bake.mode, changed["bake.mode"]) == ("pick", "move")
    # Physics and the rules of picking are the paper's; settings in pixels shrink with the image.
    assert {key.split(".")[0] for key in changed} == {"bake", "cameras", "arrangement", "move", "perception", "bop"}
    pixels = ("resolution", "contour_points", "contour_offset", "min_votes", "normal_window")
    assert {key for key in changed if key.startswith("perception.")} == {f"perception.{name}" for name in pixels}


def test_the_test_preset_differs_from_the_paper_in_exactly_this():
    assert changes("synpick-test", "synpick") == {
        "bake.mode": "cycle",
        "bake.worlds": 60,
        "bake.episodes": 60,
        "bake.seed": int.from_bytes(b"test"),
        "cameras.resolution": (960, 540),
        "bop.split": "test_pbr",
    }
    test = load_config("synpick-test")
    assert test.object_rows == load_config("synpick").object_rows
    assert len(test.cameras.positions) == 3
    assert len(set(mode_weights(test.bake).values())) == 1


def test_the_hard_preset_is_the_test_preset_with_fuller_faster_shinier_totes():
    changed = changes("synpick-hard", "synpick-test")
    assert changed.pop("bake.seed") == int.from_bytes(b"hard")
    assert {key.split(".")[0] for key in changed} == {"arrangement", "pick", "move", "physics", "objects"}
    test, hard = load_config("synpick-test"), load_config("synpick-hard")
    assert hard.arrangement.volume > test.arrangement.volume
    assert hard.arrangement.max_objects > test.arrangement.max_objects
    assert hard.move.speed > test.move.speed
    assert hard.move.rounds / hard.move.speed == test.move.rounds / test.move.speed
    assert hard.pick.lift_speed > test.pick.lift_speed
    for calm, shiny in zip(test.object_rows, hard.object_rows, strict=True):
        assert dataclasses.replace(shiny, metallic=calm.metallic, roughness=calm.roughness) == calm
        assert shiny.metallic > calm.metallic
        assert shiny.roughness < calm.roughness
        assert (shiny.metallic, shiny.roughness) == (hard.objects.metallic, hard.objects.roughness)


def test_no_two_presets_to_evaluate_on_or_to_train_on_share_random_numbers():
    """Streams of two seeds can coincide only if mix(seed + γ) agrees in the bits above the episode index, as mix is a bijection."""
    configs = [load_config(name) for name in ("synpick", "randomized", "stills", "synpick-test", "synpick-hard")]
    assert [config.bop.split.split("_")[0] for config in configs] == ["train"] * 3 + ["test"] * 2
    keys = [int(rng.mix(np.uint64((config.bake.seed + int(rng.GAMMA)) % 2**64))) >> EPISODE_BITS for config in configs]
    for first, second in itertools.combinations(keys, 2):
        assert first != second


@pytest.mark.parametrize(
    ("name", "checksum"), [("synpick", "7ead3b470d2a3a11"), ("synpick-released", "d8109a24b417e573"), ("smoke", "37c497c0be404b49")]
)
def test_data_sets_of_other_presets_can_still_be_resumed(name, checksum):
    """Their manifests have the checksum of their settings. A new setting changes it: then say so in the changelog, and here."""
    found = make_manifest(load_config(name))["settings_checksum"]
    assert found.startswith(checksum), f"bakes of {name} no longer resume: {found[:16]}; if meant, put it here and into CHANGELOG.md"


def test_a_table_object_rows_changes_every_row_of_the_preset(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text("[object_rows]\nmass = 2\nconcave = true\n")
    rows = load_config(path).object_rows
    before = load_config("synpick").object_rows
    assert rows == tuple(dataclasses.replace(row, mass=2.0, concave=True) for row in before)
    path.write_text("[object_rows]\n")
    assert load_config(path).object_rows == before


# ---- the reference of settings, and the guide in configs/README.md ----


def test_every_setting_is_in_the_reference_and_every_preset_in_the_guide():
    text, guide = settings_reference(), SETTINGS_REFERENCE.with_name("README.md").read_text(encoding="utf-8")
    assert SETTINGS_REFERENCE.read_text(encoding="utf-8") == text, "run python -m tools.docs"
    assert [key for key in resolved("smoke") if f"\n`{key}` | " not in text] == []
    assert [name for name in preset_names() if f"| `{name}` |" not in guide] == []
    assert len(guide.splitlines()) <= 300


# ---- splits: tables, defaults, ranges of episodes, random streams ----


GAMMA_INVERSE = np.uint64(pow(int(rng.GAMMA), -1, 2**64))
"""Sample i of a stream with key k is mix(k + (i + 1)·γ): k/γ is its place on the one orbit that all streams follow."""
LONGEST_STREAM = 2**24
"""More samples than any stream has."""


@pytest.fixture
def load(tmp_path):
    def load(text: str, settings: dict[str, object] | None = None, **options: bool):
        path = tmp_path / "my.toml"
        path.write_text(text)
        return load_config(str(path), settings, **options)

    return load


def test_the_paper_has_80_and_20_sequences_of_each_mode_if_splits_are_asked_for(load):
    config = load_config("synpick", splits=True)
    train, test = config.splits
    assert train == Split("train", 3 * 80, 0, "cycle", "train_pbr")
    assert test == Split("test", 3 * 20, 240, "cycle", "test_pbr")
    assert len(config.cameras.positions) == 3
    assert (config.bake.episodes, DataLayout.of(config).episodes_end) == (300, 300)
    assert may_pick(config.bake, config.splits)
    # Otherwise all is as before.
    config = load_config("synpick")
    assert config == load_config()
    assert config.splits == ()
    assert "splits" not in make_manifest(config)["settings"]
    assert "splits" not in config_to_toml(config)
    assert DataLayout.of(config).plan() == [range(config.bake.episodes)]
    assert DataLayout.of(config).folder(3) == "train_pbr"
    # A file takes those of its preset if it has no mode and no number of episodes of its own.
    fov = 'preset = "synpick"\n[cameras]\nfov = 30'
    names = [[split.name for split in load(text, splits=True).splits] for text in (fov, "[splits.val]\nepisodes = 5")]
    assert names == [["train", "test"], ["val"]]
    assert load(fov).splits == load_config("smoke", splits=True).splits == ()
    for text in ('[bake]\nmode = "pick"', "[bake]\nepisodes = 5"):
        assert load(text, splits=True).splits == ()


def test_no_stream_of_test_meets_one_of_train():
    """Streams of the paper's splits, all arrangements included, lie farther apart on SplitMix64's orbit than the longest one is long."""
    config = load_config("synpick", splits=True)
    episodes = [index for split in config.splits for index in episode_range(split)]
    assert len(set(episodes)) == 300
    addresses = np.array(list(itertools.product(episodes, range(config.settle.tries), Stream)))
    places = np.sort(rng.stream_key(config.bake.seed, *addresses.T) * GAMMA_INVERSE)
    gaps = np.diff(np.append(places, places[0]))  # The last one goes around.
    assert gaps.min() > LONGEST_STREAM


def test_a_file_has_any_number_of_splits(load):
    config = load(
        'preset = "synpick"\n[bake]\nmode = "move"\n[splits]\ntrain = { episodes = 10 }\nval = { episodes = 2, mode = "mixed" }\n'
        'test_easy = { episodes = 3, first = 100 }\nhard = { episodes = 1, folder = "test_hard_pbr" }\n'
    )
    assert config.splits == (
        Split("train", 10, 0, "move", "train_pbr"),
        Split("val", 2, 10, "mixed", "val_pbr"),
        Split("test_easy", 3, 100, "move", "test_easy_pbr"),
        Split("hard", 1, 103, "move", "test_hard_pbr"),
    )
    assert config.bake.episodes == 16
    layout = DataLayout.of(config)
    assert [layout.is_planned(index) for index in (9, 11, 12, 99, 100, 103, 104)] == [True, True, False, False, True, True, False]
    folders = [layout.folder(index).removesuffix("_pbr") for index in (0, 9, 10, 50, 102, 103)]
    assert folders == ["train", "train", "val", "val", "test_easy", "test_hard"]


def test_splits_are_written_and_read_again(load):
    config = load_config("synpick", {"splits.test.first": 1000}, splits=True)
    for comments in (False, True):
        assert load(config_to_toml(config, comments=comments)) == config
    manifest = make_manifest(config)
    assert manifest["settings"]["splits"][1] == {"name": "test", "first": 1000, "mode": "cycle", "folder": "test_pbr"}
    longer = load_config("synpick", {"splits.test.first": 1000, "splits.train.episodes": 241}, splits=True)
    assert make_manifest(longer) == manifest


@given(
    lengths=st.lists(st.integers(1, 50), min_size=1, max_size=5),
    gaps=st.lists(st.integers(0, 9), min_size=5, max_size=5),
    count=st.integers(1, 7),
)
def test_shards_divide_the_episodes_of_all_splits(lengths, gaps, count):
    first, splits = 0, []
    for index, (length, gap) in enumerate(zip(lengths, gaps, strict=False)):
        splits.append(Split(f"s{index}", length, first + gap, "move", f"train_s{index}"))
        first += gap + length
    config = dataclasses.replace(load_config("smoke"), splits=tuple(splits))
    layout = DataLayout.of(config)
    planned = [index for each in layout.plan() for index in each]
    assert sorted(planned) == planned
    shards = [[index for each in layout.plan((), (shard, count)) for index in each] for shard in range(count)]
    assert sorted(index for shard in shards for index in shard) == planned
    assert all(index % count == shard for shard, indices in enumerate(shards) for index in indices)
    for split in splits:
        assert layout.plan((split.name,)) == [episode_range(split)]
        assert all(layout.split_of(index) == split for index in episode_range(split))


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--config", "synpick", "--split", "tset"], 'there is no split "tset"; splits: train, test; did you mean test?'),
        (["--config", "synpick", "--split", ""], 'there is no split ""; splits: train, test'),
        (["--config", "smoke", "--split", "train"], 'there is no split "train": the settings have no splits; '),
        (["--split", "train", "--episodes", "4"], "bake.episodes is 4 on the command line; allowed: 300 or none"),
        (["--split", "train", "--mode", "pick"], 'bake.mode is "pick" on the command line; allowed: none'),
        (["--split", "test", "--shard", "61/1000"], "--shard 61/1000 has none of 60 episodes; use fewer shards"),
        (["--set", "splits.train.episodes=4"], "there is no split train, set on the command line; the settings have none"),
        (["--split", "train", "--set", "splits.train=4"], "there is no key splits.train., set on the command line"),
        (["--split", "train", "--set", "splits.test.first=4"], "splits.test.first is 4 on the command line; allowed: at least 240"),
    ],
)
def test_a_wrong_option_is_one_line(arguments, expected):
    assert mistake("bake", "--out", "gone/set", *arguments).startswith(expected)
