"""Grasp trials within a bake: the same tables in any number of worlds and after a failure, beside the ordinary data set as it always is."""

from __future__ import annotations

import pyarrow.parquet as parquet
import pytest

from synpick_warp.codes import Outcome
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import ConfigError
from synpick_warp.factory import picks
from tests.builders import bake_boxes, failing_after
from tests.harness.exporter_contract import digests
from tests.worlds.sights import BRIEF
from tests.worlds.small_worlds import QUICK

GIVEN = {key.replace("__", "."): value for key, value in BRIEF.items()} | {
    "bake.mode": "pick",
    "bake.worlds": 2,
    "bake.episodes": 2,
    "bake.formats": ["bop", "picks"],
    "arrangement.max_objects": 2,
    "cameras.resolution": [32, 18],
    "picks.states": 2,
    "picks.candidates": 4,
    "picks.repeats": 2,
    "picks.near": 0.02,
    "picks.hold": 0.1,
    "picks.lift_height": 0.05,
}


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    folder = tmp_path_factory.mktemp("picks") / "set"
    bake_boxes(folder, GIVEN)
    return folder


def files(folder) -> dict[str, str]:
    """Digests of what episodes have, but for the tables beside their scenes."""
    found = {name: digest for name, digest in digests(folder).items() if name.startswith(("train", "picks"))}
    return {name: digest for name, digest in found.items() if not name.endswith("scene_picks.json")}


def test_tables_have_every_trial_and_the_own_grasp_succeeds_as_in_its_episode(baked):
    for episode in range(GIVEN["bake.episodes"]):
        table = parquet.read_table(baked / f"picks/{episode:06d}.parquet").to_pydict()
        states = parquet.read_table(baked / f"picks/states/{episode:06d}.parquet").to_pydict()
        assert states["state"] == [0, 1]
        assert states["candidates"] == [4, 4]
        assert list(zip(table["state"], table["candidate"], table["repeat"], strict=True)) == [
            (state, candidate, repeat) for state in range(2) for candidate in range(4) for repeat in range(2)
        ]
        own = [index for index, candidate in enumerate(table["candidate"]) if candidate == 0]
        assert all(table["outcome"][index] == Outcome.TARGET_PICKED and table["intended"][index] for index in own)
        assert all(1 <= held <= 10 for held in table["hits"])
        assert all((margin > 0) == bool(success) for margin, success in zip(table["margin"], table["success"], strict=True))


@pytest.mark.slow
def test_tables_do_not_depend_on_worlds_nor_on_a_failure(baked, tmp_path, monkeypatch):
    """Each state is tried by itself, in other numbers of worlds, by a bake that fails in between and is resumed."""
    monkeypatch.setattr(picks, "BATCH_ROUNDS", 0)
    other = GIVEN | {"bake.worlds": 1, "picks.worlds": 3}
    with failing_after(1):
        bake_boxes(tmp_path / "set", other)
    assert len(list(tmp_path.glob("set/picks/*.parquet"))) == 1
    bake_boxes(tmp_path / "set", other)
    assert files(tmp_path / "set") == files(baked)


def test_the_ordinary_data_set_is_the_same_without_trials(baked, tmp_path):
    bake_boxes(tmp_path / "set", GIVEN | {"bake.formats": ["bop"]})
    ordinary = {name: digest for name, digest in files(baked).items() if not name.startswith("picks")}
    assert len(ordinary) > 50
    assert files(tmp_path / "set") == ordinary


def test_episodes_must_pick():
    with pytest.raises(ConfigError, match=r"bake.formats is .*; allowed: without picks where no episode picks"):
        load_config("smoke", QUICK | {"bake.mode": "move", "bake.formats": ["picks"]})
