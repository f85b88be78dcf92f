"""Benchmark of grasp trials: labels and world-steps per second, and where time goes, from states of the first attempts of episodes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import warp as wp

from synpick_warp.configs.schema import Bake
from synpick_warp.factory.assembly import Stages
from synpick_warp.factory.picks import PickEngine, count_batch
from synpick_warp.stages import timing
from synpick_warp.stages.sim.choices import ChoiceReader, ChoiceRecorder
from synpick_warp.stages.stream import read_tick
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.progress import SilentProgress
from tools.options import Row


def measure_picks(build: Callable[..., Stages], bake: Bake) -> Iterator[Row]:
    """Save as many states as a batch of a bake has, and run their trials twice; the second run is measured.

    `build`: `build_stages` with settings of episodes that pick; `bake`: their section.
    """
    device = pick_device(bake.device)
    stages = build(device, SilentProgress(), range(bake.worlds))
    simulation = stages.simulation
    engine = PickEngine(stages)
    batch = count_batch(engine.config.picks, bake.worlds, engine.simulation.layout.worlds)
    recorder = ChoiceRecorder(simulation, stages.config.picks.states, batch + simulation.layout.worlds)
    reader, choices = ChoiceReader(recorder, len(stages.catalog)), []
    while len(choices) < batch:
        simulation.tick()
        choices += reader.read(read_tick(simulation.record))
    yield Row("worlds", engine.simulation.layout.worlds, "")
    yield Row("size of a state", 1e-3 * recorder.ring.words.shape[1] * 4, "kB, without contacts")
    started = time.perf_counter()
    engine.run(recorder.ring, choices)
    yield Row("first run, which loads kernels", time.perf_counter() - started, "s")
    with timing.record() as times:
        started = time.perf_counter()
        batches = engine.run(recorder.ring, choices)
        wp.synchronize_device(device)
        seconds = time.perf_counter() - started
    columns = {name: np.concatenate([one.trials[name] for one in batches]) for name in ("duration", "success", "hits", "share")}
    trials, tick = len(columns["duration"]), stages.config.physics.tick_time
    ticks = sum(stage.calls for path, stage in times.times.items() if path[-1] == "judge")
    yield Row("states", len(choices), "")
    yield Row("labels", trials, "")
    yield Row("labels/s", trials / seconds, "1/s")
    yield Row("world-steps", ticks * stages.config.physics.steps_per_tick * engine.simulation.layout.worlds / seconds, "1/s")
    yield Row("world-steps that trials need", columns["duration"].sum() / stages.config.physics.step / seconds, "1/s")
    yield Row("ticks of a trial", columns["duration"].mean() / tick, "")
    yield Row("ticks of a success", columns["duration"][columns["success"]].mean() / tick, "")
    yield Row("successes", 100.0 * columns["success"].mean(), "%")
    yield Row("trials that hit nothing", 100.0 * (columns["hits"] == 0).mean(), "%")
    for path, stage in times.times.items():
        if len(path) < 4:
            yield Row("time: " + ": ".join(path), stage.device if device.is_cuda else stage.host, "s")
