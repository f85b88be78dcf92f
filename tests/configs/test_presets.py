"""The presets of data sets to evaluate on: shape, random numbers, what makes the hard cases hard, and changes of every row."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from synpick_warp.configs.dataset.splits import mode_weights
from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import load_config, sections
from synpick_warp.dataset.commit.manifest import make_manifest
from tests.builders import refusal
from tests.twins import rng

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
    configs = [load_config(name) for name in ("synpick", "randomized", "synpick-test", "synpick-hard")]
    assert [config.bop.split.split("_")[0] for config in configs] == ["train", "train", "test", "test"]
    keys = [int(rng.mix(np.uint64((config.bake.seed + int(rng.GAMMA)) % 2**64))) >> EPISODE_BITS for config in configs]
    for first, second in itertools.combinations(keys, 2):
        assert first != second


@pytest.mark.parametrize(
    ("name", "checksum"), [("synpick", "23fffdce0a4cdf09"), ("synpick-released", "adc115e029db0134"), ("smoke", "1363c0c37d93ffcf")]
)
def test_data_sets_of_other_presets_can_still_be_resumed(name, checksum):
    """Their manifests have the checksum of their settings. A new setting changes it: then say so in the changelog, and here."""
    assert make_manifest(load_config(name))["settings_checksum"].startswith(checksum)


def test_a_table_object_rows_changes_every_row_of_the_preset(tmp_path):
    path = tmp_path / "my.toml"
    path.write_text("[object_rows]\nmass = 2\nconcave = true\n")
    rows = load_config(path).object_rows
    before = load_config("synpick").object_rows
    assert rows == tuple(dataclasses.replace(row, mass=2.0, concave=True) for row in before)
    path.write_text("[object_rows]\n")
    assert load_config(path).object_rows == before


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("id = 1", "[object_rows] has the key id in {path}; keys that may hold for every row: mass, concave, metallic, roughness; "),
        ("diameter = 1", "[object_rows] has the key diameter in {path}; "),
        ("metalic = 1", "[object_rows] has the key metalic in {path}; "),
        ("mass = 0", "object_rows.mass is 0 in {path}; allowed: above 0 [kg]"),
        ("roughness = [1]", "object_rows.roughness is [1] in {path}; allowed: a finite number"),
    ],
)
def test_a_wrong_table_is_one_line(tmp_path, text, expected):
    path = tmp_path / "my.toml"
    path.write_text(f"[object_rows]\n{text}\n")
    assert refusal(load_config, path).startswith(expected.format(path=path))
