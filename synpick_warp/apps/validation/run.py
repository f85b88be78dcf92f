"""Validation of a data set: plans its tasks, runs them in parallel over parts of scenes, and yields violations in a fixed order."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from synpick_warp.apps.validation.model_files import ModelsFolder
from synpick_warp.apps.validation.registry import Level, Tolerance, Violation, apply_rules
from synpick_warp.apps.validation.scene_files import FolderScene, open_scene
from synpick_warp.apps.validation.subjects import TargetLists, TreeSubject
from synpick_warp.apps.validation.tasks import CheckModel, CheckPicks, CheckRig, CheckScene, TaskState, ValidationTask
from synpick_warp.dataset.bop.images import KeyedFolder
from synpick_warp.dataset.bop.layout import Layout, SceneRef
from synpick_warp.dataset.commit.manifest import committed_episodes, read_manifest, read_settings
from synpick_warp.errors import SynpickError
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.processes.pool import WorkerProgram, map_ordered
from synpick_warp.system.progress import Report, ignore_progress

DEFAULT_SAMPLE = 200
"""Views that are rendered again; some 30 a second on one core."""
PART = 100
"""Views of a task."""
VIEWS_PER_PROCESS = 100
"""Minimum number of views per process: starting one takes a second."""


@dataclass(frozen=True)
class ValidationOptions:
    """What is checked, by how many processes."""

    sample: int | None = DEFAULT_SAMPLE
    """Views that are rendered again, spread over all views; None: all."""
    images: bool = True
    """Whether images are read; otherwise only files, annotations, models and lists are checked."""
    threads: int = field(default_factory=count_cores)
    tolerance: Tolerance | None = None
    """Of measured data sets; None: each rule has its own bound, and no deviations are collected."""


@dataclass
class Summary:
    """Totals of a validation: numbers of what was checked and of violations, and the measured deviations.

    A view that the data set has twice, in a scene folder and in a shard, counts once; so does an object with several models.
    """

    scenes: int = 0
    views: int = 0
    """Views whose images were checked."""
    rendered: int = 0
    """Views that were rendered again."""
    models: int = 0
    errors: int = 0
    warnings: int = 0
    deviations: dict[tuple[str, int], array[float]] = field(default_factory=dict)
    """Deviations of instances by rule and obj_id, in the unit of the rule."""


def validate(folder: Path, options: ValidationOptions, summary: Summary, report: Report = ignore_progress) -> Iterator[Violation]:
    """Check a data set by all rules.

    Args:
        folder: A BOP data set, from `bake` or anybody else.
        options: What is checked.
        summary: Totals; written.
        report: Called with the progress.

    Yields:
        Violations, in an order that does not depend on the number of processes.

    Raises:
        DatasetError: The folder is no BOP data set.
    """
    layout = Layout(folder)
    lists = TargetLists(layout)
    scenes = _list_scenes(layout)
    counted = {_key(ref): ref for ref, _ in reversed(scenes)}
    summary.scenes = len(counted)
    total = sum(len(images) for ref, images in scenes if counted[_key(ref)] == ref)
    for violation in _check_folders(layout, lists):
        yield _finish(violation, layout, summary)
    models = list(_plan_models(layout))
    summary.models = len({task.obj_id for task in models if task.obj_id is not None})
    cameras, picks = _read_plan(layout)
    tasks: list[ValidationTask] = [*models, *_plan_scenes(scenes, lists, options), *_plan_rigs(cameras, scenes)]
    tasks += map(CheckPicks, committed_episodes(layout.root)) if picks else ()
    processes = max(1, min(options.threads, -(-total // VIEWS_PER_PROCESS) if options.images else 1, len(tasks)))
    program = WorkerProgram(partial(TaskState, layout.root, options.tolerance), "process that validates")
    rendered: set[tuple[tuple[str, int, str], int]] = set()
    for task, checked in zip(tasks, map_ordered(program, tasks, processes), strict=True):
        if isinstance(task, CheckScene):
            summary.views += checked.views * (counted[key := _key(task.ref)] == task.ref)
            rendered |= {(key, image) for image in checked.rendered}
            summary.rendered = len(rendered)
        for rule, obj_id, value in checked.deviations:
            summary.deviations.setdefault((rule, obj_id), array("d")).append(value)
        report("views" if options.images else "scenes", summary.views, total)
        for violation in checked.violations:
            yield _finish(violation, layout, summary)


def _finish(violation: Violation, layout: Layout, summary: Summary) -> Violation:
    """Count a violation in the summary; returns it with a shorter text: paths relative to the data set, and the file's own name
    not twice.
    """
    if violation.level is Level.ERROR:
        summary.errors += 1
    else:
        summary.warnings += 1
    text = violation.text.replace(f"{layout.root}/", "").removeprefix(violation.file).lstrip(" :,")
    return violation._replace(text=text)


def _check_folders(layout: Layout, lists: TargetLists) -> Iterator[Violation]:
    """Apply the rules about whole folders: data set, target lists, shards; yields violations."""
    yield from apply_rules(TreeSubject(layout))
    yield from apply_rules(lists)
    for listing in layout.keyed.values():
        yield from apply_rules(KeyedFolder(listing))


def _list_scenes(layout: Layout) -> list[tuple[SceneRef, np.ndarray]]:
    """List all scenes, each with the im_ids that its files have."""
    found = []
    for ref in layout.scenes():
        files = open_scene(layout, ref)
        assert isinstance(files, FolderScene)
        kind = next((kind for kind in ("rgb", "gray", "depth") if kind in files.kinds), "")
        found.append((ref, np.array(sorted(image for image, _ in files.indices(kind)), np.int32)))
    for listing in layout.keyed.values():
        found += [(ref, np.array(images, np.int32)) for ref, images in KeyedFolder(listing).scenes()]
    return found


def _key(ref: SceneRef) -> tuple[str, int, str]:
    """Split, index and sensor of a scene, which it shares with its shards."""
    return ref.split.removesuffix("_web"), ref.scene, ref.sensor


def _plan_models(layout: Layout) -> Iterator[CheckModel]:
    """Yield a task for each models folder, and one for each of its models."""
    for name, listing in layout.models.items():
        yield CheckModel(name, None)
        for obj_id in ModelsFolder(listing).files:
            yield CheckModel(name, obj_id)


def _plan_scenes(scenes: list[tuple[SceneRef, np.ndarray]], lists: TargetLists, options: ValidationOptions) -> Iterator[ValidationTask]:
    """Parts of scenes, with the views that are rendered again: evenly spread over the views of all scenes."""
    total = sum(len(images) for _, images in scenes)
    sample = total if options.sample is None else min(options.sample, total)
    # Views in the middle of `sample` equal parts.
    chosen = np.floor((np.arange(sample) + 0.5) * total / max(sample, 1)).astype(np.int64) if options.images else np.zeros(0, np.int64)
    start = 0
    for ref, images in scenes:
        low, high = np.searchsorted(chosen, (start, start + len(images)))
        poses = images[chosen[low:high] - start]
        parts = max(1, -(-len(images) // PART)) if options.images else 1
        targets = lists.of_scene(ref.split, ref.scene) if ref.name and not ref.sensor else {}
        for part in range(parts):
            last = None if part == parts - 1 else (part + 1) * PART
            yield CheckScene(ref, part * PART, last, options.images, frozenset(poses.tolist()), targets if part == 0 else {})
        start += len(images)


def _plan_rigs(cameras: int, scenes: list[tuple[SceneRef, np.ndarray]]) -> Iterator[ValidationTask]:
    """Yield tasks for scenes that belong together: those of the cameras of an episode, or of the sensors of one scene."""
    groups: dict[tuple[str, int], list[SceneRef]] = {}
    sensors: dict[tuple[str, int], list[SceneRef]] = {}
    for ref, _ in scenes:
        sensors.setdefault((ref.split, ref.scene), []).append(ref)
        groups.setdefault((ref.split, ref.scene // cameras), []).append(ref)
    for refs in sensors.values():
        if len(refs) > 1:
            yield CheckRig(tuple(refs), len(refs))
    for refs in groups.values() if cameras > 1 else ():
        if not any(ref.sensor for ref in refs):
            yield CheckRig(tuple(refs), cameras)


def _read_plan(layout: Layout) -> tuple[int, bool]:
    """Number of cameras, and whether the data set has picks, by its settings; 1 and False for data sets from other sources, and where
    the settings are damaged."""
    if layout.ours:
        with suppress(SynpickError):
            config = read_settings(layout.root, read_manifest(layout.root))
            return len(config.rig), "picks" in config.bake.formats
    return 1, False
