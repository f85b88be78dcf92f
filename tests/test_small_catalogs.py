"""Bakes of catalogs of one or two objects, at the ends of what fits: episodes come, in each mode."""

from __future__ import annotations

import pytest
import trimesh

from synpick_warp.configs.files.load import load_config
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING
from tests.harness.bake_server import TINY
from tests.worlds.small_worlds import QUICK

SETTINGS = {key: value for key, value in (QUICK | PICKING | TINY).items() if not key.startswith("arrangement.")} | {
    "bake.worlds": 1,
    "bake.episodes": 1,
    "bake.formats": ["bop"],
    "render.layers": [],
}
"""Settings of quick bakes, with the budget and the capacity of the preset `smoke`: 3 litres, 24 objects."""

IN_WAY, ASIDE = [0.1, 0.1, 0.6], [0.0, 0.6, 1.0]
"""Positions of cameras [m]."""


@pytest.mark.parametrize(
    ("mode", "sizes"),
    [
        ("move", [(0.1, 0.1, 0.1)]),
        ("target", [(0.1, 0.1, 0.1), (0.1, 0.1, 0.1)]),
        ("move", [(0.003, 0.003, 0.003)]),
        ("pick", [(0.144, 0.144, 0.144)]),
    ],
    ids=["a litre", "twins", "3 mm", "the whole budget"],
)
@pytest.mark.slow
def test_a_catalog_of_one_or_two_objects_gives_episodes(mode, sizes, tmp_path):
    """Fault 4: with cubes of 100 mm, all 20 arrangements needed more body slots than a world had."""
    (tmp_path / "models").mkdir()
    for index, size in enumerate(sizes):
        trimesh.creation.box(size).export(tmp_path / "models" / f"box_{index}.ply")
    config = load_config("smoke", SETTINGS | {"bake.mode": mode, "bake.models": str(tmp_path / "models")})
    summary = run_bake(config, tmp_path / "out", SilentProgress())
    assert [row.ending.delivers for row in summary.episodes] == [True]
    assert summary.resampled == 0
    assert summary.views > 0


def test_plates_of_a_millimetre_come_to_rest(tmp_path):
    """All 20 arrangements had more contacts than the solver has capacity for by default: 24 plates have 700."""
    (tmp_path / "models").mkdir()
    trimesh.creation.box((0.1, 0.08, 0.001)).export(tmp_path / "models" / "plate.ply")
    settings = {"bake.mode": "move", "bake.models": str(tmp_path / "models"), "cameras.positions": [IN_WAY, ASIDE, IN_WAY]}
    progress = Notes()
    summary = run_bake(load_config("smoke", SETTINGS | settings), tmp_path / "out", progress)
    assert [(row.ending.delivers, row.objects) for row in summary.episodes] == [(True, 24)]
    assert summary.views > 0
    assert not any("more contacts arose" in line or "in the gripper's way" in line for line in progress.lines)
    assert sum("thin objects: capacity for" in line for line in progress.lines) == 1


def test_one_model_fills_the_tote_in_mode_pick(tmp_path):
    """There was one object in the tote, and no word."""
    (tmp_path / "models").mkdir()
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "models" / "box.ply")
    settings = {"bake.mode": "pick", "bake.models": str(tmp_path / "models"), "cameras.positions": [IN_WAY, ASIDE, IN_WAY]}
    progress = Notes()
    summary = run_bake(load_config("smoke", SETTINGS | settings), tmp_path / "out", progress)
    assert [row.objects for row in summary.episodes] == [3]
    assert [line.split(" stands")[0] for line in progress.lines if "in the gripper's way" in line] == ["camera camera_0", "camera camera_2"]
    assert "1 objects take 0.001 of 0.003 m³ together, so that they repeat in an episode" in progress.lines


class Notes(SilentProgress):
    """Keeps notes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)
