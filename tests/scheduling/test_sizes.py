"""Sizes that settings leave open: worlds from episodes, and batches, worlds and writers from the memory that is free."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory import memory_plan, sizes
from synpick_warp.factory.memory_plan import check_memory, plan_memory
from synpick_warp.factory.sizes import (
    HEADROOM,
    RUNTIME_BYTES,
    advise_processes,
    count_writers,
    fit_to_device,
    pick_processes,
    without_pictures,
)
from synpick_warp.stages import view_ring
from synpick_warp.stages.perception.images import count_views
from synpick_warp.stages.sim.physics import balance_worlds

GIB = 1024**3
CPU = SimpleNamespace(is_cuda=False, alias="cpu")
GPU = SimpleNamespace(is_cuda=True, alias="cuda:0", total_memory=64 * GIB)
"""Stand-ins for devices."""


def views_per_batch(config: Config, device: Any) -> int:
    return view_ring.views_per_batch(config.render, config.rig, config.bake.worlds, device)


@pytest.fixture
def give(monkeypatch):
    """Set the memory of GPU and host, all of it free [GiB]."""

    def give(gpu: float = 140.0, host: float = 128.0) -> None:
        monkeypatch.setattr(GPU, "total_memory", int(gpu * GIB))
        monkeypatch.setattr(memory_plan, "free_device_memory", lambda device: int(gpu * GIB))
        monkeypatch.setattr(memory_plan, "free_host_memory", lambda: int(host * GIB))

    give()
    return give


@pytest.mark.parametrize(
    ("episodes", "limit", "worlds"),
    [(1, 512, 1), (150, 512, 150), (512, 512, 512), (513, 512, 257), (600, 512, 300), (1100, 512, 367), (0, 8, 1)],
)
def test_rounds_are_balanced(episodes, limit, worlds):
    assert balance_worlds(episodes, limit) == worlds


@pytest.mark.parametrize(
    ("machine", "episodes", "worlds"),
    [(GPU, 150, 150), (GPU, 60, 60), (GPU, 600, 300), (GPU, 2000, 500), (GPU, 3, 8), (CPU, 3, 3), (CPU, 6, 3), (CPU, 150, 4)],
)
def test_worlds_follow_from_the_number_of_episodes(give, machine, episodes, worlds):
    config = load_config("synpick", {"bake.mode": "mixed"})
    fitted = fit_to_device(config, machine, episodes)
    assert fitted.bake.worlds == worlds
    assert (fitted.render.views_per_batch, fitted.perception.views) == (0, 0)
    assert fit_to_device(load_config("synpick", {"bake.worlds": 60}), machine, episodes).bake.worlds == 60


@pytest.mark.parametrize("mode", ["mixed", "move"])
@pytest.mark.parametrize("gpu", [3.0, 4.0, 6.0, 8.0, 12.0, 24.0, 80.0])
def test_batches_shrink_until_plan_and_headroom_fit(give, gpu, mode):
    give(gpu)
    config = fit_to_device(load_config("synpick", {"bake.mode": mode}), GPU, 1024)
    planned = sum(term.size for term in plan_memory(config, GPU) if term.on_device)
    assert HEADROOM * planned + RUNTIME_BYTES <= gpu * GIB
    # The larger part shrinks first: batches, or worlds where the light averaged over their frames is larger.
    assert config.bake.worlds >= min(512, 13 * gpu)
    if gpu >= 12.0:
        assert views_per_batch(config, GPU) >= 12
    check_memory(plan_memory(config, GPU), GPU)


def test_trajectories_alone_need_no_image_buffers(give):
    give()
    pictures, trajectories = (load_config("synpick", {"bake.formats": formats}) for formats in (["bop", "zarr"], ["usd", "zarr"]))
    assert without_pictures(pictures) == pictures
    needed = {term.name: term.size for term in plan_memory(fit_to_device(without_pictures(trajectories), GPU, 2048), GPU)}
    assert needed["light averaged over frames"] == 0
    before = {term.name: term.size for term in plan_memory(fit_to_device(trajectories, GPU, 2048), GPU)}
    assert before["light averaged over frames"] > 2 * GIB
    assert sum(needed.values()) < 0.6 * sum(before.values())


def test_settings_that_are_named_stay(give):
    give(2.0)
    named = {"bake.worlds": 512, "render.views_per_batch": 25, "perception.views": 23, "bake.mode": "mixed"}
    config = load_config("synpick", named)
    assert fit_to_device(config, GPU, 512) == config


def test_processes_share_the_hosts_memory(give):
    give(host=4.0)
    config = load_config("synpick", {"bake.mode": "mixed", "cameras.resolution": [3840, 2160]})
    alone, shared = (fit_to_device(config, CPU, 4, processes=processes) for processes in (1, 4))
    assert views_per_batch(shared, CPU) < views_per_batch(alone, CPU) or count_views(shared.perception, 4, 24, CPU) < count_views(
        alone.perception, 4, 24, CPU
    )


@pytest.fixture
def cores(monkeypatch):
    """A machine of 16 cores and no GPU."""
    monkeypatch.setattr(sizes, "count_cores", lambda: 16)
    monkeypatch.setattr(sizes, "pick_devices", lambda names: ("cpu",) if list(names) == ["all"] else tuple(names))
    monkeypatch.setattr(sizes, "pick_device", lambda name: CPU)


def test_without_a_gpu_all_is_a_process_per_core_within_memory_and_episodes(give, cores):
    config = load_config("synpick", {"bake.mode": "mixed"})
    assert pick_processes(config, ["all"], 1000) == ("cpu",) * 16
    assert pick_processes(config, ["all"], 5) == ("cpu",) * 5
    assert pick_processes(config, ["all"], 0) == ("cpu",)
    give(host=12.0)
    few = pick_processes(config, ["all"], 1000)
    assert 2 <= len(few) < 12
    # The smallest sizes fit as often as was chosen, and not once more.
    least = load_config("synpick", {"bake.mode": "mixed", "bake.worlds": 1, "render.views_per_batch": 1, "perception.views": 1})
    needed = HEADROOM * sum(term.size for term in plan_memory(least, CPU)) + RUNTIME_BYTES
    assert len(few) * needed <= 12 * GIB < (len(few) + 1) * needed
    assert fit_to_device(config, CPU, 1000, processes=len(few)).bake.worlds >= 1
    give(host=0.5)
    assert pick_processes(config, ["all"], 1000) == ("cpu",)


def test_named_processes_stay(give, cores):
    give(host=0.5)
    assert pick_processes(load_config("synpick", {}), ["cpu"] * 3, 1000) == ("cpu",) * 3


def test_a_bake_on_one_of_several_cores_is_told_of_the_others(give, cores, monkeypatch):
    config = load_config("synpick", {})
    assert (
        advise_processes(config, ["cpu"], 3) == "one process simulates on one CPU core; --devices all starts 3, which write the same bytes"
    )
    assert advise_processes(config, ["cpu"], 1) == ""
    assert advise_processes(config, ["cpu", "cpu"], 3) == ""
    monkeypatch.setattr(sizes, "pick_devices", lambda names: ("cuda:0",))
    assert advise_processes(config, ["cpu"], 3) == ""
    monkeypatch.setattr(sizes, "pick_device", lambda name: GPU)
    assert advise_processes(config, ["auto"], 3) == ""


def writers_of(config: Config) -> int:
    return count_writers(config.bake.writers, Needs.of(config).slot_bytes)


def test_writers_are_as_many_as_cores_if_memory_suffices(give, monkeypatch):
    monkeypatch.setattr(sizes, "count_cores", lambda: 64)
    config = load_config("synpick", {})
    assert writers_of(config) == 64
    give(host=8.0)
    assert 1 < writers_of(config) < 64
    give(host=0.1)
    assert writers_of(config) == 1
    assert writers_of(load_config("synpick", {"bake.writers": 99})) == 99
