"""Discrete-event model of claiming workers against analytic cases (rates, limits, losses), a measured bake and counted requests."""

from __future__ import annotations

import json
from collections import Counter

import pytest

from synpick_warp.cloud import run
from synpick_warp.cloud.claims import Sizes
from synpick_warp.system.progress import SilentProgress
from synpick_warp.system.stores.opening import open_store
from tests.cloud.conftest import tiny
from tests.harness import claiming, scripted_bake
from tools.figures import RESULTS
from tools.reports.store.model import Limits, Machine, Simulation, measured_machine

INSTANT = Limits(latency=1e-12)
PLAIN = Machine(start=10.0, rate=100.0, views=50.0, view_bytes=1.0, boot=5.0, worlds=64)


def test_one_worker_takes_the_sum_of_its_chunks():
    done = Simulation(1, 1_000, PLAIN, INSTANT, chunk=100).run()
    chunks = len(list(Sizes(1_000, 100).bounds()))
    assert done.seconds == pytest.approx(5.0 + 10.0 * chunks + 1_000 * 50.0 / 100.0)
    assert (done.views, done.wasted, done.losses, done.refused) == (50_000.0, 0.0, 0, 0.0)


def test_worlds_that_take_the_next_chunk_start_and_drain_once_a_worker():
    done = Simulation(1, 1_000, PLAIN._replace(drains=False), INSTANT, chunk=100).run()
    assert done.seconds == pytest.approx(5.0 + 10.0 + 1_000 * 50.0 / 100.0)


@pytest.mark.parametrize("workers", [4, 32])
def test_workers_share_the_plan(workers):
    alone, done = (Simulation(count, 8_000, PLAIN, INSTANT, chunk=100).run() for count in (1, workers))
    assert done.views == alone.views
    assert 1.0 <= done.seconds * workers / (alone.seconds + 5.0 * (workers - 1)) < 1.1


def test_the_limit_of_writes_is_the_rate_of_a_bake():
    limits = INSTANT._replace(writes=60.0)
    done = Simulation(50, 20_000, PLAIN._replace(start=0.0, boot=0.0), limits, chunk=100).run()
    limit = limits.writes / PLAIN.episode_requests()["write"] * PLAIN.views
    assert done.views / done.seconds == pytest.approx(limit, rel=0.05)
    assert done.refused > done.requests["write"]


def test_lost_machines_cost_what_they_had_in_flight():
    machine = PLAIN._replace(losses=200.0, replacement=50.0)
    done = Simulation(8, 20_000, machine, INSTANT, chunk=200).run()
    assert done.views == pytest.approx(20_000 * 50.0)
    assert done.losses == pytest.approx(8 * done.seconds * 200.0 / 86_400.0, rel=0.5)
    assert 0.0 < done.wasted < done.losses * machine.worlds * machine.views


def test_small_files_are_limited_by_latency():
    """16 at a time, each written and looked up: 16 files a view leave 1 / (2 x latency) views/s."""
    machine = PLAIN._replace(files=16 * 50)
    assert machine.upload_rate(0.03) == pytest.approx(1.0 / 0.06)


def test_the_fit_predicts_a_third_bake():
    rows = {row["name"]: row["value"] for row in json.loads((RESULTS / "speed_bake_paper.json").read_text())["rows"]}
    machine = measured_machine()
    assert machine.start + rows["views"] / machine.rate == pytest.approx(rows["start to exit"], rel=0.03)


def test_a_real_worker_asks_what_the_model_predicts(memory, monkeypatch):
    """All but what a set needs once: the difference of two plans."""
    kinds = {"put": "write", "get": "read", "head": "read", "list": "list"}
    store, counted = open_store(memory), []
    for (name, kind), real in zip(kinds.items(), [getattr(store._obs, name) for name in kinds], strict=True):

        def ask(opened, *arguments, real=real, kind=kind, **given):
            key = arguments[0] if arguments and isinstance(arguments[0], str) else ""
            counted[-1]["claim" if kind == "write" and key.startswith(".store/claims/") and "indices" not in key else kind] += 1
            return real(opened, *arguments, **given)

        monkeypatch.setattr(store._obs, name, ask)
    for episodes in (8, 16):
        counted.append(Counter())
        run.bake_into_store(tiny(episodes), f"{memory}{episodes}", SilentProgress(), bake=scripted_bake.bake_episodes, claim=True)
    few, many = (claiming.predict_requests(1, episodes) for episodes in (8, 16))
    assert counted[1] - counted[0] == many - few
