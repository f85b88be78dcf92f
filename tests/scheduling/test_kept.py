"""Bakes that follow one another with kept worlds: the bytes of one bake, and new worlds where the kept ones do not do."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from synpick_warp.factory import kept
from synpick_warp.factory.kept import KeptBaker
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKED, boxes
from tests.harness.exporter_contract import digests
from tests.worlds.small_worlds import settings


@pytest.mark.slow
def test_chunks_in_kept_worlds_have_the_bytes_of_one_bake(picked_set, tmp_path, monkeypatch):
    bake, config, quiet = KeptBaker(), settings(**PICKED), SilentProgress()
    with boxes():
        bake(config, tmp_path / "set", quiet, [1], deliver=lambda: None)
        monkeypatch.setattr(kept, "build_factory", None)
        bake(config, tmp_path / "set", quiet, [0])
    assert digests(tmp_path / "set") == digests(picked_set)


@pytest.mark.parametrize("worlds", [0, 2])
def test_worlds_are_built_anew_for_other_settings_more_episodes_and_after_a_failure(worlds, monkeypatch):
    built, ends = [], []

    def build(config, *_, **__):
        built.append(config)
        simulation = SimpleNamespace(restart=lambda _: None, device=None)
        return SimpleNamespace(simulation=simulation, catalog=None, config=config, make_log=lambda: None)

    def bake(config, out, progress, episodes, devices, deliver, build):
        build(config, progress, episodes, False, True, longest_first=True)
        if ends and isinstance(end := ends.pop(), Exception):
            raise end
        return SimpleNamespace(stopped=bool(ends))

    given = {"build_factory": build, "bake_episodes": bake, "order_longest_first": lambda *_: [], "replace": lambda factory, log: factory}
    for name, fake in given.items():
        monkeypatch.setattr(kept, name, fake)
    one, config = KeptBaker(), settings(**{"bake.worlds": worlds})

    def builds(episodes: int, config=config) -> int:
        before = len(built)
        one(config, None, None, range(episodes))
        return len(built) - before

    assert [builds(4), builds(4), builds(2)] == [1, 0, 0]
    assert builds(5) == (worlds == 0)
    assert builds(2, config.with_values({"bake.seed": 1})) == 1
    ends.append(OSError("full"))
    with pytest.raises(OSError, match="full"):
        one(built[-1], None, None, range(2))
    assert builds(2, built[-1]) == 1
    ends.extend([None, None])  # Stopped.
    assert [builds(2, built[-1]), builds(2, built[-1])] == [0, 1]
