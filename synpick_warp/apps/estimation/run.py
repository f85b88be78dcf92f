"""Run of an estimation: groups of scenes through reader and estimator, to a table of poses, with times."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from synpick_warp.apps.estimation.decoder_pool import SCENES_AHEAD, DecoderPool, ReadScene
from synpick_warp.apps.estimation.methods import TRACK, EstimatorFactory, Group, ask, estimate_frame, make_group, to_rotations
from synpick_warp.apps.estimation.reading import AHEAD, BYTES_PER_PIXEL, DEPTHS, SceneReader
from synpick_warp.apps.estimation.scenes import Scene, ScenePlan, group_scenes, read_scene
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.targets import Target, TargetList, count_targets
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from synpick_warp.stages.pose.batch import Estimates
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.free_memory import free_host_memory
from synpick_warp.system.progress import Report, ignore_progress

MAX_VIEWS = 128
"""Views that are estimated at a time, if their number is left open: enough to fill a GPU."""
MEMORY_FRACTION = 0.25
"""Of the host's free memory for images, if the number of views is left open."""


@dataclass(frozen=True)
class Options:
    """Options of an estimation: method, kind of depth, mask errors, least visibility, seed, views at a time (0: automatic), processes."""

    method: str
    depth: str = "clean"
    """Key of `reading.DEPTHS`."""
    noisy_masks: bool = False
    min_visibility: float = 0.1
    seed: int = 0
    """Of disturbed starts and mask errors."""
    views: int = 0
    """Views at a time; 0: automatic."""
    threads: int = field(default_factory=count_cores)
    """Processes that read scenes and images, or threads if there are few."""


@dataclass(frozen=True, eq=False)
class Run:
    """Result of an estimation: table of the finite estimates, numbers of views and of dropped estimates, and wall, reading and estimator
    time [s].
    """

    poses: PoseTable
    views: int
    skipped: int
    """Estimates that were not finite, and are left out."""
    wall: float
    """Time of all [s]."""
    reading: float
    """Time that was spent waiting for images [s]; reading goes on behind the estimator."""
    estimating: float
    """Time in the estimator [s]."""


def read_scenes(
    data_set: DataSet,
    plans: Sequence[ScenePlan],
    options: Options,
    targets: TargetList | None = None,
    report: Report = ignore_progress,
    pool: DecoderPool | None = None,
) -> list[Scene]:
    """Read the ground truth of scenes, and check that there are images to estimate on.

    Args:
        data_set: The data set.
        plans: Scenes with their frames.
        options: Method and inputs.
        targets: Objects that count in each image; None: all.
        report: Observer.
        pool: Processes that read; None: this one.

    Raises:
        DatasetError: A file is missing or damaged; there are no depth images or masks as they are asked; nothing is visible enough.
    """
    listed = None if targets is None else targets.objects
    scenes = []
    if pool is None:
        read = (read_scene(data_set, plan) for plan in plans)
    else:
        read = pool.map_ordered((ReadScene(data_set.folder, plan) for plan in plans), depth=SCENES_AHEAD, ahead=SCENES_AHEAD)
    report("scenes", 0, len(plans))
    for plan, scene in zip(plans, read, strict=True):
        if options.method == TRACK and not scene.tracked:
            place = scene.files.place
            raise DatasetError(f"{place} has no instance_id in its ground truth, by which instances are tracked; use another method")
        objects = [None if listed is None else listed[plan.scene, frame] for frame in plan.frames]
        scenes.append(ask(scene, options.method, options.min_visibility, objects))
        report("scenes", len(scenes), len(plans))
    layer = DEPTHS[options.depth]
    for scene in scenes:
        if layer != "depth" and layer not in scene.files.layers():
            raise DatasetError(f'{scene.files.place} has no {layer}; bake with render.layers = ["{layer}"], or use --depth clean')
    if not any(scene.asked.any() for scene in scenes):
        raise DatasetError(f"no instance of {data_set.folder} is as visible as --visib-min {options.min_visibility:g} in these images")
    first = next(scene for scene in scenes if scene.asked.any())
    with SceneReader([first], options.depth) as reader:
        reader.check(int(np.argmax(first.asked.any(axis=1))))
    return scenes


def list_targets(scenes: Sequence[Scene]) -> list[Target]:
    """Target list of the instances that are asked for: scene, frame, object and number of instances."""
    rows = []
    for scene in scenes:
        for step, slot in zip(*np.nonzero(scene.asked), strict=True):
            rows.append((scene.plan.scene, scene.plan.frames[step], int(scene.object_ids[slot])))
    return count_targets(rows)


def count_views(scenes: Sequence[Scene], views: int, free: int | None = None) -> int:
    """Number of views at a time: `views`, or if that is 0, as many as scenes, MAX_VIEWS and memory allow.

    Args:
        scenes: All scenes.
        views: Number that is asked for; 0: automatic.
        free: Free memory [bytes]; None: the host's.
    """
    if views:
        return min(views, len(scenes))
    width, height = scenes[0].size
    size = (1 + AHEAD) * BYTES_PER_PIXEL * width * height
    room = int(MEMORY_FRACTION * (free_host_memory() if free is None else free)) // size
    return max(1, min(len(scenes), MAX_VIEWS, room))


def run_estimation(
    scenes: Sequence[Scene],
    object_ids: Sequence[int],
    factory: EstimatorFactory,
    options: Options,
    report: Report = ignore_progress,
    pool: DecoderPool | None = None,
) -> Run:
    """Estimate the poses of all instances that are asked for; returns the table of poses, with times.

    Args:
        scenes: The scenes.
        object_ids: obj_id of each model.
        factory: Makes an estimator for each group of scenes.
        options: Method and inputs.
        report: Observer.
        pool: Processes that decode images; None: as `SceneReader` chooses.

    Raises:
        DatasetError: An image or mask is missing or damaged, or has another size than the data set's.
    """
    begin = time.perf_counter()
    # Views of a batch have at least one instance each, so that the table tells how many views there are.
    by_scene = {scene.plan.scene: scene for scene in scenes if scene.asked.any()}
    collector, total = _Collector(), sum(map(len, scenes))
    collector.views = total - sum(map(len, by_scene.values()))
    for plans in group_scenes([scene.plan for scene in by_scene.values()], count_views(scenes, options.views)):
        group = make_group([by_scene[plan.scene] for plan in plans], object_ids)
        width, height = group.scenes[0].size
        clock = time.perf_counter()
        estimator = factory(group.table, height, width)
        collector.estimating += time.perf_counter() - clock
        seed = options.seed if options.noisy_masks else None
        with SceneReader(group.scenes, options.depth, mask_seed=seed, threads=options.threads, pool=pool) as reader:
            clock = time.perf_counter()
            for step, batch in enumerate(reader):
                ready = time.perf_counter()
                estimates = estimate_frame(options.method, estimator, batch, group, step, options.seed)
                collector.reading += ready - clock
                collector.estimating += time.perf_counter() - ready
                collector.add(estimates, group, step)
                report("views", collector.views, total)
                clock = time.perf_counter()
    return collector.finish(time.perf_counter() - begin)


class _Collector:
    """Collects the rows of the pose table, and the times of an estimation."""

    def __init__(self) -> None:
        self._parts: list[PoseTable] = []
        self.views = self.skipped = 0
        self.reading = self.estimating = 0.0

    def add(self, estimates: Estimates, group: Group, step: int) -> None:
        """Add the valid estimates of a step, and its times."""
        showing = [step < len(scene) for scene in group.scenes]
        self.views += sum(showing)
        # A quaternion that cannot be normalised is no rotation.
        finite = np.isfinite(estimates.pose).all(axis=1) & np.isfinite(estimates.score) & (np.abs(estimates.pose[:, 3:]).max(axis=1) > 0.0)
        self.skipped += int((estimates.valid & ~finite).sum())
        rows = np.flatnonzero(estimates.valid & finite)
        if not len(rows):
            return
        views, slots = group.table.view[rows], group.table.slot[rows]
        # BOP wants one time for all rows of an image.
        seconds = np.zeros(len(group.scenes))
        np.maximum.at(seconds, views, estimates.seconds[rows])
        scenes = group.scenes
        self._parts.append(
            PoseTable(
                scene=np.array([scenes[view].plan.scene for view in views], np.int64),
                image=np.array([scenes[view].plan.frames[step] for view in views], np.int64),
                object_id=np.array([scenes[view].object_ids[slot] for view, slot in zip(views, slots, strict=True)], np.int64),
                rotation=to_rotations(estimates.pose[rows]),
                translation=estimates.pose[rows, :3].astype(np.float64),
                score=estimates.score[rows].astype(np.float64),
                seconds=seconds[views],
                instance=np.array([scenes[view].instances[slot] for view, slot in zip(views, slots, strict=True)], np.int64),
            )
        )

    def finish(self, wall: float) -> Run:
        """Result with the table sorted by scene, image, object and instance."""
        names = PoseTable.__dataclass_fields__
        ints, reals = np.empty(0, np.int64), np.empty(0)
        empty = PoseTable(ints, ints, ints, np.empty((0, 3, 3)), np.empty((0, 3)), reals, reals, ints)
        table = PoseTable(*(np.concatenate([getattr(part, name) for part in (empty, *self._parts)]) for name in names))
        order = np.lexsort((table.instance, table.object_id, table.image, table.scene))
        return Run(table.select(order), self.views, self.skipped, wall, self.reading, self.estimating)
