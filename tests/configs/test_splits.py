"""Splits: tables, defaults, ranges of episodes, random streams, and mistakes that are one line."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Stream
from synpick_warp.configs.dataset.splits import DataLayout, episode_range, may_pick
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Split
from synpick_warp.dataset.commit.manifest import make_manifest
from tests.builders import mistake, refusal
from tests.twins import rng

GAMMA_INVERSE = pow(int(rng.GAMMA), -1, 2**64)
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


def test_the_paper_has_80_and_20_sequences_of_each_mode():
    config = load_config("synpick", splits=True)
    train, test = config.splits
    assert train == Split("train", 3 * 80, 0, "cycle", "train_pbr")
    assert test == Split("test", 3 * 20, 240, "cycle", "test_pbr")
    assert len(config.cameras.positions) == 3
    assert (config.bake.episodes, DataLayout.of(config).episodes_end) == (300, 300)
    assert may_pick(config.bake, config.splits)


def test_without_splits_all_is_as_before():
    """A preset's splits hold only if they are asked for."""
    config = load_config("synpick")
    assert config == load_config()
    assert config.splits == ()
    assert "splits" not in make_manifest(config)["settings"]
    assert "splits" not in config_to_toml(config)
    assert DataLayout.of(config).plan() == [range(config.bake.episodes)]
    assert DataLayout.of(config).folder(3) == "train_pbr"


def test_no_stream_of_test_meets_one_of_train():
    """Streams of the paper's splits, all arrangements included, lie farther apart on SplitMix64's orbit than the longest one is long."""
    config = load_config("synpick", splits=True)
    episodes = [index for split in config.splits for index in episode_range(split)]
    assert len(set(episodes)) == 300
    keys = [
        int(rng.stream_key(config.bake.seed, episode, arrangement, stream))
        for episode, arrangement, stream in itertools.product(episodes, range(config.settle.tries), Stream)
    ]
    places = np.sort(np.array([key * GAMMA_INVERSE % 2**64 for key in keys], np.uint64))
    gaps = np.diff(np.append(places, places[0]))  # The last one goes around.
    assert gaps.min() > LONGEST_STREAM


def test_a_file_has_any_number_of_splits(load):
    config = load(
        """
        preset = "synpick"
        [bake]
        mode = "move"
        [splits.train]
        episodes = 10
        [splits.val]
        episodes = 2
        mode = "mixed"
        [splits.test_easy]
        episodes = 3
        first = 100
        [splits.hard]
        episodes = 1
        folder = "test_hard_pbr"
        """
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
    assert [layout.folder(index) for index in (0, 9, 10, 50, 102, 103)] == [
        "train_pbr",
        "train_pbr",
        "val_pbr",
        "val_pbr",
        "test_easy_pbr",
        "test_hard_pbr",
    ]


def test_splits_are_written_and_read_again(load):
    config = load_config("synpick", {"splits.test.first": 1000}, splits=True)
    for comments in (False, True):
        assert load(config_to_toml(config, comments=comments)) == config
    manifest = make_manifest(config)
    assert manifest["settings"]["splits"][1] == {"name": "test", "first": 1000, "mode": "cycle", "folder": "test_pbr"}
    longer = load_config("synpick", {"splits.test.first": 1000, "splits.train.episodes": 241}, splits=True)
    assert make_manifest(longer) == manifest


def test_a_file_takes_the_splits_of_its_preset_if_they_are_asked_for_and_it_has_no_mode_of_its_own(load):
    assert load('preset = "synpick"\n[cameras]\nfov = 30').splits == ()
    assert len(load('preset = "synpick"\n[cameras]\nfov = 30', splits=True).splits) == 2
    assert load('[bake]\nmode = "pick"', splits=True).splits == ()
    assert load("[bake]\nepisodes = 5", splits=True).splits == ()
    assert load_config("smoke", splits=True).splits == ()
    assert [split.name for split in load("[splits.val]\nepisodes = 5", splits=True).splits] == ["val"]


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
    ("text", "expected"),
    [
        ("splits = 3", "splits is 3 in {path}; allowed: tables such as [splits.train]"),
        ("splits = {}", "splits is {{}} in {path}; allowed: tables"),
        ("[splits]\ntrain = 3", 'splits is {{"train": 3}} in {path}; allowed: tables'),
        ("[splits.'a/b']\nepisodes = 1", "the split a/b in {path} has no name of up to 32"),
        ("[splits.'..']\nepisodes = 1", "the split .. in {path} has no name of up to 32"),
        ("[splits.train]\nepisode = 1", "there is no key splits.train.episode, set in {path}; keys of splits.train: episodes, "),
        ("[splits.train]\nepisodes = 0", "splits.train.episodes is 0 in {path}; allowed: at least 1"),
        ("[splits.train]\nmode = 'stir'", 'splits.train.mode is "stir" in {path}; allowed: '),
        ("[splits.train]\nfirst = 2147483647", "splits.train ends with episode 2147483647 in {path}; allowed: less than"),
        ("[splits.train]\nfolder = '../out'", 'splits.train.folder is "../out" in {path}; allowed: train, val or test'),
        ("[splits.train]\nfolder = 'train'", 'bop.color_format is "jpg" by default; allowed: png with the split train'),
        ("[splits.extra]\nepisodes = 1", 'splits.extra.folder is "extra_pbr" in {path}; allowed: train, val or test'),
        (
            "[splits.train]\nepisodes = 5\n[splits.test]\nfirst = 4",
            "splits.test.first is 4 in {path}; allowed: at least 5, after the episodes of train",
        ),
        (
            "[splits.train]\n[splits.test]\nfolder = 'train_pbr'",
            "splits.test would write to train_pbr/ in {path}, as would train; set another folder",
        ),
        ("[bake]\nepisodes = 3\n[splits.train]\nepisodes = 4", "bake.episodes is 3 in {path}; allowed: 4 or none"),
        ("[bake]\nmode = 'mixed'\nmix = [0, 0, 0]\n[splits.train]\nepisodes = 4", "bake.mix is "),
    ],
)
def test_a_wrong_table_is_one_line(load, tmp_path, text, expected):
    assert refusal(load, text).startswith(expected.format(path=tmp_path / "my.toml"))


def test_too_many_splits_are_refused(load):
    assert refusal(load, "".join(f"[splits.train_{index}]\n" for index in range(65))).startswith("splits has 65 tables")


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
        (["--split", "train", "--set", "splits.train.episode=4"], "there is no key splits.train.episode, set on the command line"),
        (["--split", "train", "--set", "splits.train=4"], "there is no key splits.train., set on the command line"),
        (["--split", "train", "--set", "splits.test.first=4"], "splits.test.first is 4 on the command line; allowed: at least 240"),
    ],
)
def test_a_wrong_option_is_one_line(arguments, expected):
    assert mistake("bake", "--out", "gone/set", *arguments).startswith(expected)
