"""Reuse of worlds by successive bakes: same bytes as a single bake, and a rebuild when settings or episode counts demand it."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from synpick_warp.codes import Phase
from synpick_warp.factory import kept
from synpick_warp.factory.kept import KeptStages, keeping_baker
from synpick_warp.factory.order import EpisodeSource
from synpick_warp.factory.pipeline import bake_episodes
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKED, boxes
from tests.harness.exporter_contract import digests
from tests.worlds.small_worlds import settings


@pytest.mark.slow
def test_chunks_in_kept_worlds_have_the_bytes_of_one_bake(picked_set, tmp_path, monkeypatch):
    bake, config, quiet = keeping_baker(), settings(**PICKED), SilentProgress()
    with boxes():
        bake(config, tmp_path / "set", quiet, [1], deliver=lambda: None)
        monkeypatch.setattr(kept, "build_factory", None)
        bake(config, tmp_path / "set", quiet, [0])
    assert digests(tmp_path / "set") == digests(picked_set)


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


@pytest.mark.parametrize("worlds", [0, 2])
def test_worlds_are_built_anew_for_other_settings_more_episodes_and_after_a_failure(worlds, monkeypatch):
    phase = np.full(2, Phase.IDLE)
    factory = SimpleNamespace(config=None, catalog=None, picks=None, stream=SimpleNamespace(in_flight=[]), make_log=lambda: None)
    state = SimpleNamespace(phase=SimpleNamespace(numpy=lambda: phase))
    factory.simulation = SimpleNamespace(restart=lambda _: None, device=None, state=state)
    built: list[object] = []
    fakes = {"build_factory": lambda config, *_, **__: built.append(config) or factory, "replace": lambda factory, log: factory}
    for name, fake in (fakes | {"order_longest_first": lambda *_: []}).items():
        monkeypatch.setattr(kept, name, fake)
    stages, config = KeptStages(), settings(**{"bake.worlds": worlds})

    def builds(episodes: int, config=config) -> int:
        before = len(built)
        stages(config, SilentProgress(), range(episodes), False, True, longest_first=True)
        return len(built) - before

    assert [builds(4), builds(4), builds(2)] == [1, 0, 0]
    assert builds(5) == (worlds == 0)
    assert [builds(2, config.with_values({"bake.seed": 1})), builds(2)] == [1, 1]
    phase[1] = Phase.ACT
    assert builds(2) == 1
    phase[1] = Phase.IDLE
    factory.stream.in_flight = [None]
    assert builds(2) == 1
    factory.stream.in_flight, factory.picks = [], SimpleNamespace(waits=True)
    assert builds(2) == 1
    factory.picks.waits = False
    assert builds(2) == 0
