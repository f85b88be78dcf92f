"""Benchmark of pictures alone: which views a pass renders, from copies of the ticks, with which histories. No times are asserted."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from dataclasses import fields
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.sim.simulate import Simulation
from tests.builders import FEW_STEPS, assignments
from tools.bench import __main__ as bench
from tools.bench import pictures

WORLDS, CAMERAS, BATCH, AFTER, HISTORY_TICKS, KEPT_TICKS, ROUNDS = 2, 3, 4, 2, 2, 3, 2
SETTINGS = {"bake.mode": "move", "settle.rest_displacement": 1e-3, "render.views_per_batch": BATCH}
SMALL = ("--worlds", str(WORLDS), "--resolution", "32x18", *FEW_STEPS, *assignments(SETTINGS))


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """The rows of the benchmark by name, its simulation, and what each call of the renderer got and found."""
    file, batches, simulations = tmp_path_factory.mktemp("pictures") / "bench.json", [], []
    render, tick = Renderer.render, Simulation.tick

    def watch_render(self: Renderer, snapshot, views, out, layers=None) -> None:
        render(self, snapshot, views, out, layers)
        world, camera = (array.numpy()[: views.count] for array in (views.world, views.camera))
        history = pictures.light_history(self)
        slots = world * CAMERAS + camera
        batches.append(
            SimpleNamespace(
                renderer=self,
                snapshot=snapshot,
                views=list(zip(snapshot.episode.numpy()[world], snapshot.frame.numpy()[world], camera, strict=True)),
                live=snapshot.live.numpy()[world],
                holds=None if history is None else self.shading.moving.holds.numpy()[: views.count].copy(),
                paths=None if history is None else history.paths.numpy()[slots],
                color=out.color.numpy()[: views.count].copy(),
            )
        )

    def watch_tick(self: Simulation) -> None:
        tick(self)
        simulations.append((self, self.record.snapshot.frame.numpy().copy()))

    with (
        mock.patch.multiple(pictures, HISTORY_TICKS=HISTORY_TICKS, KEPT_TICKS=KEPT_TICKS, ROUNDS=ROUNDS),
        mock.patch.object(Renderer, "render", watch_render),
        mock.patch.object(Simulation, "tick", watch_tick),
    ):
        assert bench.main(["--parts", "pictures", "--after", str(AFTER), "--json", str(file), *SMALL]) == 0
    rows = {row["name"]: row for row in json.loads(file.read_text())["rows"]}
    return SimpleNamespace(rows=rows, batches=batches, ticks=simulations)


def split_passes(measured) -> tuple[list, dict[Renderer, list[list]]]:
    """Batches before the passes, and of each renderer those of each pass; a pass has two batches a tick."""
    per_tick = -(-WORLDS * CAMERAS // BATCH)
    first = HISTORY_TICKS * per_tick
    warmup, timed = measured.batches[first : first + 2 * per_tick], measured.batches[first + 2 * per_tick :]
    renderers = list(dict.fromkeys(batch.renderer for batch in warmup))
    size = KEPT_TICKS * per_tick
    passes = [timed[start : start + size] for start in range(0, len(timed), size)]
    return measured.batches[:first], {renderer: passes[index :: len(renderers)] for index, renderer in enumerate(renderers)}


def all_views(batches: Sequence) -> list[tuple]:
    """Episode, frame and camera of all views of some batches."""
    return [view for batch in batches for view in batch.views]


def test_each_pass_renders_each_view_of_each_kept_tick_once(measured):
    first, passes = split_passes(measured)
    assert [len(of_renderer) for of_renderer in passes.values()] == [ROUNDS] * 2
    assert len(all_views(first)) == HISTORY_TICKS * WORLDS * CAMERAS
    assert min(frame for _, frame, _ in all_views(first)) >= AFTER
    episodes = {episode for episode, *_ in all_views(first)}
    last = {episode: max(frame for other, frame, _ in all_views(first) if other == episode) for episode in episodes}
    assert len(episodes) == WORLDS
    wanted = {
        (episode, last[episode] + 1 + tick, camera) for episode in episodes for tick in range(KEPT_TICKS) for camera in range(CAMERAS)
    }
    for of_renderer in passes.values():
        for batches in of_renderer:
            assert {batch.renderer for batch in batches} == {of_renderer[0][0].renderer}
            assert Counter(all_views(batches)) == dict.fromkeys(wanted, 1)
            assert all(batch.live.all() for batch in batches)
            assert [len(batch.views) for batch in batches] == [4, 2] * KEPT_TICKS


def test_kept_snapshots_are_copies(measured):
    """They hold successive frames, though the simulation has overwritten its record since."""
    _, passes = split_passes(measured)
    snapshots = list(dict.fromkeys(batch.snapshot for batch in next(iter(passes.values()))[0]))
    assert len(snapshots) == KEPT_TICKS
    simulated = [frame for _, frame in measured.ticks[-KEPT_TICKS:]]
    assert [snapshot.frame.numpy().tolist() for snapshot in snapshots] == [frame.tolist() for frame in simulated]
    simulation = measured.ticks[0][0]
    names = [item.name for item in fields(Snapshot)]
    taken = {getattr(simulation.record.snapshot, name).ptr for name in names}
    kept = [getattr(snapshot, name).ptr for snapshot in snapshots for name in names]
    assert len(set(kept)) == len(kept)
    assert not taken & set(kept)


def test_histories_continue_in_every_pass_and_are_the_same_in_each(measured):
    first, passes = split_passes(measured)
    with_history, without = passes.values()
    assert all(not batch.holds.any() for batch in first[:2])
    assert all(batch.holds.all() for batches in with_history for batch in batches)
    assert all(batch.holds is None for batches in without for batch in batches)
    for batch, again in zip(*with_history, strict=True):
        np.testing.assert_array_equal(batch.paths, again.paths)
        np.testing.assert_array_equal(batch.color, again.color)
    longest = [max(batch.paths.max() for batch in batches) for batches in (first[:2], first[-2:], with_history[0][-2:])]
    assert longest[0] < longest[1] < longest[2]


def test_rows_state_counts_and_rates(measured):
    rows = {name: row["value"] for name, row in measured.rows.items()}
    assert {row["part"] for row in measured.rows.values()} == {"pictures"}
    assert rows["ticks in a pass"] == KEPT_TICKS
    assert rows["views in a pass"] == KEPT_TICKS * WORLDS * CAMERAS
    assert rows["views in a batch"] == BATCH
    assert rows["paths in a history before a pass, mean"] > 1.0
    for name in ("all stages", "all stages, render.history=0"):
        rate = rows[f"{name}: views, median of {ROUNDS} passes"]
        assert 0.0 < rows[f"{name}: views, slowest pass"] <= rate <= rows[f"{name}: views, fastest pass"]
        assert rows[f"{name}: pixels"] == pytest.approx(32 * 18e-6 * rate)
        assert rows[f"{name}: a view"] == pytest.approx(1e3 / rate)
        assert measured.rows[f"{name}: pixels"]["unit"] == "Mpx/s"
