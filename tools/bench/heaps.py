"""Benchmark of perception and planning by stage, of simulated worlds, and against the number of instances.

For the latter, objects of the catalog lie in heaps of random poses, which may overlap: nothing is simulated, so that any number is quick.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import warp as wp

from synpick_warp.codes import Phase, Task
from synpick_warp.configs.schema import Config
from synpick_warp.scenes.build import build_model
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import load_lights
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.constants import make_scene_data
from synpick_warp.stages.perception.perceive import Perception
from synpick_warp.stages.sim.simulate import allocate_worlds
from synpick_warp.stages.sim.worlds import world_sizes
from synpick_warp.system.hardware.device import pick_device
from tools.bench.growth import Variant
from tools.bench.physics import MIN_REPEATS, Stopwatch, seconds_per_call
from tools.options import Row

INSTANCES = (10, 32, 64, 128, 251)
"""Numbers of instances of a world; the last is the largest that segmentation ids have room for."""
WORLDS = 64
"""Most worlds of a heap."""
SMALL = 4
"""Ratio of the catalog's objects to those in a heap, which are the smallest, so that many are visible."""
DENSITY = 0.5
"""Volume of a heap's objects relative to the heap."""
MAX_HEIGHT = 0.4
"""Height of a heap [m]; of more objects, it is denser."""


def measure_perception(perception: Perception, snapshot: Snapshot, device: wp.Device, min_seconds: float) -> Iterator[Row]:
    """Measure perception and planning by stage, in full batches of worlds that all look."""
    perception.state.phase.fill_(Phase.ACT)
    perception.attempts.task.fill_(Task.LOOK)
    stages = (
        (perception.images, "render", "ray tracing"),
        (perception.segmenter, "find_grasp_points", "components, distance transform, contours, suction points"),
        (perception.planner, "plan", "occlusion votes, clutter graph, target, grasp"),
    )
    graph = "of these, clutter graph"

    def perceive_batch() -> None:
        perception.list_worlds()
        perception.perceive_batch(snapshot)

    seconds_per_call(perceive_batch, device, 0.0)
    watch, calls = Stopwatch(device), 0
    with contextlib.ExitStack() as patches:
        for stage in (*stages, (perception.planner, "order_clutter", graph)):
            patches.enter_context(watch.time_method(*stage))
        while calls < MIN_REPEATS or sum(watch.seconds(name) for _, _, name in stages) < min_seconds:
            perceive_batch()
            calls += 1
    views = perception.images.views.count
    yield Row("views in a batch", views, "")
    for name in (*(name for _, _, name in stages), graph):
        yield Row(f"a view: {name}", 1e3 * watch.seconds(name) / (calls * views), "ms")
    yield Row("a view", 1e3 * sum(watch.seconds(name) for _, _, name in stages) / (calls * views), "ms")


def measure_heaps(config: Config, min_seconds: float) -> Iterator[Row]:
    """Measure perception of heaps of INSTANCES, each for at least `min_seconds` [s]."""
    worlds = min(config.bake.worlds, WORLDS)
    config = replace(config, bake=replace(config.bake, worlds=1, mode="pick"))
    own = Variant(config, load_catalog(config), load_lights(config.bake.lights), pick_device(config.bake.device), min_seconds)
    render_scene = own.build_scene()
    scene = make_scene_data(config, own.catalog, build_model(config, own.catalog, own.device), len(own.lights), own.device)
    for count in INSTANCES:
        sizes = world_sizes(worlds, count, config.move.rounds, 1, 1)
        state, attempts, _, _, record = allocate_worlds(sizes, own.device)
        parts = (render_scene, scene, state, attempts, record.observation, record.plan)
        perception = Perception(config.perception, config.rig, config.bake.seed, *parts)
        entry, pose = heap(own.catalog, config.tote.floor_size, config.bake.seed, worlds, count)
        state.catalog_index.assign(entry)
        record.snapshot.catalog_index.assign(entry)
        record.snapshot.pose.assign(pose)
        record.snapshot.fixture_pose.fill_(wp.transform_identity())
        for row in measure_perception(perception, record.snapshot, own.device, min_seconds):
            yield replace(row, name=f"{count} instances: {row.name}")
        seen = perception.images.views.world.numpy()
        visible, above = (getattr(record.observation, name).numpy()[seen] for name in ("visible", "above"))
        yield Row(f"{count} instances: visible", float((visible > 0).sum() / len(seen)))
        yield Row(f"{count} instances: edges of the clutter graph", float(np.bitwise_count(above).sum() / len(seen)))


def heap(catalog: Catalog, floor: tuple[float, ...], seed: int, worlds: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Small objects, repeated (world, instance) int32, and their random poses above a floor [m] (world, instance, 7) float32."""
    numbers = np.random.default_rng(seed)
    volume = np.array([entry.volume for entry in catalog.entries])
    room = np.array(floor)
    small = np.argsort(volume, stable=True)[: max(1, len(volume) // SMALL)]
    entry = numbers.permuted(np.resize(small, (worlds, count)), axis=1).astype(np.int32)
    height = np.minimum(volume[entry].sum(axis=1) / (DENSITY * room.prod()), MAX_HEIGHT)
    pose = np.empty((worlds, count, 7), np.float32)
    pose[..., :2] = 0.4 * room * numbers.uniform(-1, 1, (worlds, count, 2))
    pose[..., 2] = height[:, None] * numbers.uniform(0, 1, (worlds, count))
    turn = numbers.normal(size=(worlds, count, 4))
    pose[..., 3:] = turn / np.linalg.norm(turn, axis=-1, keepdims=True)
    return entry, pose
