"""Data sets of released versions, one each in tests/cases/data_sets: this version reads them, or says in a line that it does not."""

from __future__ import annotations

import tarfile
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from tests.builders import mistake, run
from tests.harness.scripted_bake import snapshot

SETS = Path(__file__).parents[1] / "cases" / "data_sets"
FRAMES, CAMERAS, FILES = 4, 2, 174
"""Of an episode in which one of two boxes is picked, 64x48, as scenes and trajectories."""


@pytest.fixture(params=["0.2.0"])
def released(request, tmp_path) -> Path:
    """The set that a version baked, beside the folder of its models."""
    with tarfile.open(SETS / f"{request.param}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path / request.param


def test_a_released_data_set_is_read(released, tmp_path):
    before = snapshot(released)
    data = synpick_warp.open(released)
    assert (len(data), len(data[0]), data.camera_count) == (1, FRAMES, CAMERAS)
    view = data[0].view(0, camera=1)
    assert view.rgb.shape == (48, 64, 3)
    assert [attempt["outcome"] for attempt in data[0].attempts] == ["target_picked"]
    assert verify(released) == ("", 1, FILES, True)
    assert "8 views, 6 of them rendered again: 0 errors, 0 warnings" in run("validate", released).out
    assert "target_picked         1    100.0%" in run("stats", released).out
    merge([released], tmp_path / "merged")
    assert snapshot(tmp_path / "merged").keys() == before.keys()
    assert snapshot(released) == before


def test_a_released_data_set_is_converted_and_back_to_its_bytes(released, tmp_path):
    synpick_warp.convert(released, tmp_path / "shards", ("shards", "lerobot"))
    synpick_warp.convert(tmp_path / "shards", tmp_path / "scenes", ("bop",))
    back, before = snapshot(tmp_path / "scenes" / "train"), snapshot(released / "train")
    assert back == before
    assert [verify(tmp_path / name).problem for name in ("shards", "scenes")] == ["", ""]


def test_a_released_data_set_is_not_taken_for_one_of_this_version(released, tmp_path):
    other = f'versions.synpick-warp is "{synpick_warp.__version__}", there "{released.name}"'
    assert other in mistake("prove", released)
    assert other in mistake("bake", "--config", released / "config.toml", "--out", released)
    said = mistake("convert", released, "--to", "usd", "--out", tmp_path / "usd")
    assert f"were digested by synpick-warp {released.name}, this is {synpick_warp.__version__}; convert with that version" in said
    assert not (tmp_path / "usd").exists()
