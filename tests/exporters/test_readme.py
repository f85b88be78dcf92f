"""The data format's description names every format, layer, array and key that the writers produce."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import synpick_warp.exporters
from synpick_warp.codes import Effect, Outcome, names
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.trajectory.arrays import CONSTANT_GROUPS, EPISODE_GROUPS
from synpick_warp.factory.attempts import AttemptRecord, ObservedInstance
from synpick_warp.factory.episodes import EpisodeOutcome
from synpick_warp.views.layers import LAYER_TABLE
from synpick_warp.views.picks import COLUMNS, STATES

README = Path(synpick_warp.exporters.__file__).with_name("README.md")


def described(section: str = "") -> set[str]:
    """Names in code style in a section, or in the whole text."""
    text = README.read_text(encoding="utf-8")
    part = text.partition(f"\n## {section}\n")[2].partition("\n## ")[0] if section else text
    assert part
    return set(re.findall(r"`([\w.]+)`", part))


def test_formats_and_modules_are_described():
    assert set(FORMAT_TABLE) <= described()
    for package in ("bop/", "usd/", "trajectory/", "writing/"):
        assert f"`{package}`" in README.read_text(encoding="utf-8")


def test_layers_are_described():
    assert set(LAYER_TABLE) <= described("Layers")


def test_keys_of_the_lists_are_described():
    keys = {field.name for record in (AttemptRecord, ObservedInstance) for field in dataclasses.fields(record)}
    keys |= {*EpisodeOutcome._fields, "sentence", "checksum", *names(Outcome)} - {"none"}
    assert keys <= described("Episode and attempt lists")


def test_keys_of_scenes_are_described():
    assert {"light", "effects", "instance_id", *names(Effect)} <= described("BOP scenes")


def test_arrays_of_the_store_are_described():
    groups = CONSTANT_GROUPS | EPISODE_GROUPS
    arrays = {name for group in groups.values() for name in group.arrays}
    assert arrays | set(groups) <= described("Zarr trajectories")


def test_columns_of_picks_are_described():
    assert {column.name for column in (*COLUMNS, *STATES)} <= described("Picks")
