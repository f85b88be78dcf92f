"""Decoder processes: the same batches as threads make, the same errors, and nothing left behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.estimation import decoder_pool, reading
from synpick_warp.apps.estimation.decoder_pool import VIEWS_PER_PROCESS, DecoderPool, ReadScene, open_pool
from synpick_warp.apps.estimation.reading import SceneReader
from synpick_warp.apps.estimation.scenes import Scene, ScenePlan, read_scene
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.system.processes.worker import ProcessError
from tests.estimation.probes import Divide, ListModules, Sleep, Stop
from tests.harness.environment import checkout_environment
from tests.harness.processes import wait_until_gone
from tests.worlds.box_sets import write_set

PLANS = [ScenePlan(0, 0, 0, (0, 1, 2)), ScenePlan(8, 2, 2, (2,)), ScenePlan(1, 0, 1, (1, 0))]


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def data(request, tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("decoding") / "set", request.param))


@pytest.fixture
def folder(tmp_path):
    return write_set(tmp_path / "set", BopExporter)


@pytest.fixture(scope="module")
def pool():
    with DecoderPool(2) as pool:
        yield pool


def arrays(item: object) -> dict[str, np.ndarray]:
    return {each.name: value for each in fields(item) if isinstance(value := getattr(item, each.name), np.ndarray)}


def assert_same(item: object, other: object) -> None:
    assert arrays(item).keys() == arrays(other).keys()
    for name, array in arrays(item).items():
        assert array.dtype == arrays(other)[name].dtype
        np.testing.assert_array_equal(array, arrays(other)[name], err_msg=name)


def pids(pool: DecoderPool) -> list[int]:
    return list(pool.pids())


def collect(scenes: list[Scene], pool: DecoderPool | None, batches: list[RgbdBatch]) -> None:
    with SceneReader(scenes, pool=pool) as reader:
        batches.extend(reader)


def read_all(reader: SceneReader) -> list[RgbdBatch]:
    return [type(batch)(**{name: array.copy() for name, array in arrays(batch).items()}) for batch in reader]


@pytest.mark.parametrize(("ahead", "mask_seed", "views"), [(0, None, 1), (2, 5, 8), (1, 1, 2)])
def test_batches_equal_those_of_threads(data, pool, ahead, mask_seed, views, monkeypatch):
    """Also of several jobs in turn, and with scenes that end early."""
    monkeypatch.setattr(reading, "MAX_VIEWS_PER_TASK", views)
    scenes = [read_scene(data, plan) for plan in PLANS] * 3
    options = {"mask_seed": mask_seed, "ahead": ahead}
    for chosen in (scenes, scenes[1:5]):
        with SceneReader(chosen, **options) as threads, SceneReader(chosen, pool=pool, **options) as processes:
            pairs = list(zip(read_all(threads), read_all(processes), strict=True))
        assert len(pairs) == 3
        for expected, batch in pairs:
            assert expected.label.any()
            assert_same(batch, expected)


def test_batches_lie_in_shared_memory(data, pool):
    with SceneReader([read_scene(data, PLANS[0])], pool=pool) as reader:
        batch = next(iter(reader))
    assert not any(array.flags.owndata for array in arrays(batch).values())
    assert len({id(array.base) for array in arrays(batch).values()}) == 1


def test_scenes_are_read_in_order(data, pool):
    plans = [ScenePlan(3 * episode + camera, episode, camera, (2, 0)) for episode in (0, 2) for camera in range(3)] * 4
    read = list(pool.map_ordered(ReadScene(data.folder, plan) for plan in plans))
    for plan, scene in zip(plans, read, strict=True):
        expected = read_scene(data, plan)
        assert isinstance(scene, Scene)
        assert (scene.plan, scene.size, scene.files.place) == (plan, expected.size, expected.files.place)
        assert_same(scene, expected)


def test_errors_are_those_of_threads_and_the_pool_goes_on(folder, pool):
    data = synpick_warp.open(folder)
    scenes = [read_scene(data, plan) for plan in PLANS]
    path = folder / "train" / "000000" / "mask_visib" / "000001_000001.png"
    content = path.read_bytes()
    path.write_bytes(content[:50])
    messages = []
    for chosen in (None, pool):
        batches = []
        with pytest.raises(DatasetError, match="is not an image that OpenCV can decode") as caught:
            collect(scenes, chosen, batches)
        assert len(batches) == 1
        messages.append(str(caught.value))
    assert messages[0] == messages[1]
    path.write_bytes(content)
    with SceneReader(scenes, pool=pool) as reader:
        assert len(read_all(reader)) == 3
    (folder / "train" / "000000" / "scene_gt.json").write_text("{")
    with pytest.raises(DatasetError, match=r"scene_gt\.json"):
        list(pool.map_ordered([ReadScene(folder, PLANS[0])]))


def test_errors_of_the_program_have_a_trace(pool):
    with pytest.raises(RuntimeError, match="ZeroDivisionError: division by zero") as caught:
        pool.wait(pool.submit(Divide()))
    assert "Traceback" in caught.value.__notes__[0]


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (signal.SIGKILL, "images was ended by SIGKILL; if memory ran out, set --threads to a smaller number"),
        (signal.SIGTERM, "images was ended by SIGTERM; see its message above"),
    ],
)
def test_a_process_that_dies_is_reported(data, number, message):
    scenes = [read_scene(data, plan) for plan in PLANS]
    with DecoderPool(2) as pool:
        pool.submit(Stop(number))
        with pytest.raises(ProcessError, match=message):
            collect(scenes, pool, [])


def test_processes_ignore_ctrl_c_and_never_import_the_simulator(pool):
    modules = pool.wait(pool.submit(ListModules()))
    assert not {"warp", "newton", "trimesh", "scipy", "zarr"} & modules
    assert all(os.getpgid(pid) != os.getpgid(0) for pid in pids(pool))


def test_large_answers_and_many_messages_do_not_block(pool):
    assert sum(map(len, pool.map_ordered(Sleep(0.0, 1 << 20) for _ in range(40)))) == 40 << 20
    futures = [pool.submit(Sleep(0.0)) for _ in range(3000)]
    assert all(pool.wait(future) == b"" for future in futures)


def test_nothing_is_left_open(data):
    scenes = [read_scene(data, plan) for plan in PLANS]
    before = sorted(os.listdir("/proc/self/fd"))
    with DecoderPool(2) as pool:
        running = pids(pool)
        for _ in range(3):
            with SceneReader(scenes, pool=pool) as reader:
                next(iter(reader))
        pool.submit(Sleep(60.0))
    wait_until_gone(running, timeout=1.0)
    del reader
    assert sorted(os.listdir("/proc/self/fd")) == before
    pool.kill()


def test_few_views_or_threads_are_read_by_this_process(data, monkeypatch):
    assert open_pool(8, 2 * VIEWS_PER_PROCESS - 1) is None
    assert open_pool(1, 10**6) is None
    monkeypatch.setattr(decoder_pool, "VIEWS_PER_PROCESS", 1)
    with SceneReader([read_scene(data, PLANS[0])], threads=2) as reader:
        assert reader._own_pool is not None
        running = pids(reader._own_pool)
        assert len(running) == 2
        assert len(read_all(reader)) == 3
    wait_until_gone(running, timeout=1.0)


SCRIPT = """
import os, signal, sys
from synpick_warp.apps.estimation.decoder_pool import DecoderPool
from tests.estimation.probes import Sleep
print("imported", flush=True)
with DecoderPool(2) as pool:
    pool.wait(pool.submit(Sleep(0.0)))
    print(*pool.pids(), flush=True)
    future = pool.submit(Sleep(float(sys.argv[2])))
    os.kill(os.getpid(), getattr(signal, sys.argv[1]))
    pool.wait(future)
"""
"""Has no guard for `__main__`: processes started by `multiprocessing` with spawn would run it again, and fail."""


@pytest.mark.parametrize(("name", "seconds"), [("SIGINT", 60.0), ("SIGKILL", 0.5)])
def test_processes_end_with_the_estimation(tmp_path: Path, name, seconds):
    """After Ctrl-C in the middle of their work; if it is killed, when they answer and nobody is there."""
    (tmp_path / "script.py").write_text(SCRIPT)
    command = [sys.executable, "script.py", name, str(seconds)]
    ran = subprocess.run(command, cwd=tmp_path, env=checkout_environment(), capture_output=True, text=True, timeout=50)
    assert ran.returncode == -getattr(signal, name)
    first, running = ran.stdout.splitlines()
    assert first == "imported"
    assert ran.stderr.count("Traceback") == (name == "SIGINT")
    wait_until_gone([int(pid) for pid in running.split()])
