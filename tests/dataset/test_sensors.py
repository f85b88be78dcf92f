"""Bakes in the layout of several sensors that are killed, resumed or baked in parts: the files are those of an undisturbed bake."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from synpick_warp.dataset.commit.merge import merge
from tests.dataset.test_resume import digests

SENSORS = {"bop.layout": "multisensor", "bop.keypoints": 4, "bake.formats": ["bop"], "bake.episodes": 2}


@pytest.fixture(scope="module")
def once(server, tmp_path_factory) -> Path:
    """An undisturbed bake."""
    out = tmp_path_factory.mktemp("sensors") / "set"
    assert server.bake(out, settings=SENSORS, warm=True) == 0
    return out


@pytest.mark.slow
def test_scenes_are_whole_after_kills(server, once, tmp_path):
    """A scene brings the files of all cameras together by many renames, some of which a kill prevents."""
    count = tmp_path / "count"
    assert server.bake(tmp_path / "counted", settings=SENSORS, alone=True, count=str(count)) == 0
    out = tmp_path / "set"
    for share in (0.5, 0.3):
        assert server.bake(out, settings=SENSORS, alone=True, kill_at=round(share * int(count.read_text()))) == -signal.SIGKILL
    assert server.bake(out, settings=SENSORS) == 0
    assert digests(out) == digests(once)


@pytest.mark.slow
def test_parts_are_merged(server, once, tmp_path):
    parts = [tmp_path / str(part) for part in range(2)]
    for part, folder in enumerate(parts):
        assert server.bake(folder, settings=SENSORS, arguments=["--shard", f"{part}/2"]) == 0
    assert merge(parts, tmp_path / "merged").missing == []
    assert digests(tmp_path / "merged") == digests(once)
