"""Validation of a data set: plans its tasks, runs them in parallel over parts of scenes, and yields violations in a fixed order."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synpick_warp.apps.validation.registry import Level, Tolerance, Violation, apply_rules
from synpick_warp.apps.validation.rules.cross_file import RigSubject
from synpick_warp.apps.validation.rules.models import ModelsFolder, ModelSubject
from synpick_warp.apps.validation.rules.poses import DiagnosedView
from synpick_warp.apps.validation.rules.trials import PicksSubject
from synpick_warp.apps.validation.scene_files import FolderScene, open_scene
from synpick_warp.apps.validation.subjects import SceneSubject, TargetLists, TreeSubject, ViewSubject
from synpick_warp.dataset.bop.images import KeyedFolder
from synpick_warp.dataset.bop.layout import Layout, Listing, SceneRef
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
    models: int = 0
    errors: int = 0
    warnings: int = 0
    deviations: dict[tuple[str, int], array[float]] = field(default_factory=dict)
    """Deviations of instances by rule and obj_id, in the unit of the rule."""


class TaskResult(NamedTuple):
    """Result of a validation task, which checks a model, a part of a scene's views, or what belongs together."""

    violations: list[Violation]
    scene: SceneRef | None = None
    """Whose views were checked."""
    views: int = 0
    """Views whose images were checked."""
    rendered: Sequence[int] = ()
    """Images that were rendered again."""
    deviations: Sequence[tuple[str, int, float]] = ()
    """(rule, obj_id, value) of each deviation; empty without a tolerance."""


def validate(folder: Path, options: ValidationOptions, summary: Summary, report: Report = ignore_progress) -> Iterator[Violation]:
    """Check a data set by all rules; yields violations, in an order that does not depend on the number of processes, and writes the totals
    to `summary`. Raises DatasetError if the folder is no BOP data set."""
    layout = Layout(folder)
    lists = TargetLists(layout)
    scenes = _list_scenes(layout)
    counted = {_key(ref): ref for ref, _ in reversed(scenes)}
    summary.scenes = len(counted)
    total = sum(len(images) for ref, images in scenes if counted[_key(ref)] == ref)
    for subject in (TreeSubject(layout), lists, *map(KeyedFolder, layout.keyed.values())):
        for violation in apply_rules(subject):
            yield _finish(violation, layout, summary)
    models = [(name, obj_id) for name, listing in layout.models.items() for obj_id in (None, *ModelsFolder(listing).files)]
    summary.models = len({obj_id for _, obj_id in models if obj_id is not None})
    cameras, picks = _read_plan(layout)
    tasks: list[Task] = [partial(check_model, *model) for model in models]
    tasks += [*_plan_scenes(scenes, lists, options), *_plan_rigs(cameras, scenes)]
    tasks += [partial(check_picks, index) for index in committed_episodes(layout.root)] if picks else ()
    processes = max(1, min(options.threads, -(-total // VIEWS_PER_PROCESS) if options.images else 1, len(tasks)))
    program = WorkerProgram(partial(TaskState, layout.root, options.tolerance), "process that validates")
    rendered: set[tuple[tuple[str, int, str], int]] = set()
    for checked in map_ordered(program, tasks, processes):
        if checked.scene is not None:
            key = _key(checked.scene)
            summary.views += checked.views * (counted[key] == checked.scene)
            rendered |= {(key, image) for image in checked.rendered}
            summary.rendered = len(rendered)
        for rule, obj_id, value in checked.deviations:
            summary.deviations.setdefault((rule, obj_id), array("d")).append(value)
        report("views" if options.images else "scenes", summary.views, total)
        for violation in checked.violations:
            yield _finish(violation, layout, summary)


def _finish(violation: Violation, layout: Layout, summary: Summary) -> Violation:
    """Count a violation in the summary; returns it with paths relative to the data set, and the file's own name not twice."""
    if violation.level is Level.ERROR:
        summary.errors += 1
    else:
        summary.warnings += 1
    text = violation.text.replace(f"{layout.root}/", "").removeprefix(violation.file).lstrip(" :,")
    return violation._replace(text=text)


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


def _plan_scenes(scenes: list[tuple[SceneRef, np.ndarray]], lists: TargetLists, options: ValidationOptions) -> Iterator[Task]:
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
            views = slice(part * PART, None if part == parts - 1 else (part + 1) * PART) if options.images else None
            yield partial(check_scene, ref, part == 0, views, frozenset(poses.tolist()), targets if part == 0 else {})
        start += len(images)


def _plan_rigs(cameras: int, scenes: list[tuple[SceneRef, np.ndarray]]) -> Iterator[Task]:
    """Yield tasks for scenes that belong together: those of the cameras of an episode, or of the sensors of one scene."""
    groups: dict[tuple[str, int], list[SceneRef]] = {}
    sensors: dict[tuple[str, int], list[SceneRef]] = {}
    for ref, _ in scenes:
        sensors.setdefault((ref.split, ref.scene), []).append(ref)
        groups.setdefault((ref.split, ref.scene // cameras), []).append(ref)
    for refs in sensors.values():
        if len(refs) > 1:
            yield partial(check_rig, refs, len(refs))
    for refs in groups.values() if cameras > 1 else ():
        if not any(ref.sensor for ref in refs):
            yield partial(check_rig, refs, cameras)


def _read_plan(layout: Layout) -> tuple[int, bool]:
    """Number of cameras, and whether the data set has picks, by its settings; 1 and False without settings, or if these are damaged."""
    if layout.ours:
        with suppress(SynpickError):
            config = read_settings(layout.root, read_manifest(layout.root))
            return len(config.rig), "picks" in config.bake.formats
    return 1, False


# ---- tasks, in this process or in another ----


class TaskState:
    """State that a process keeps between tasks: layout, tolerance, scene and models that were read last, renderer."""

    def __init__(self, folder: Path, tolerance: Tolerance | None = None) -> None:
        self.folder, self.tolerance = folder, tolerance
        self._scene: SceneSubject | None = None
        self._models: tuple[str, ModelsFolder] | None = None

    @cached_property
    def layout(self) -> Layout:
        """Layout of the data set."""
        return Layout(self.folder)

    @cached_property
    def renderer(self) -> Any:
        """The `ObjectRenderer`; Warp is imported when the first view is rendered."""
        from synpick_warp.apps.validation.comparison import ObjectRenderer

        return ObjectRenderer(self.layout)

    def scene(self, ref: SceneRef, targets: Mapping[str, Any]) -> SceneSubject:
        """Subject of a scene with records of target lists about it; the last one is cached."""
        if self._scene is None or self._scene.files.ref != ref or targets:
            self._scene = SceneSubject(self.layout, open_scene(self.layout, ref), targets)
        return self._scene

    def models(self, name: str) -> ModelsFolder:
        """Models folder by name; the last one is cached, a missing one is empty."""
        if self._models is None or self._models[0] != name:
            self._models = name, ModelsFolder(self.layout.models.get(name, Listing(self.layout.root, name)))
        return self._models[1]


Task = Callable[[TaskState], TaskResult]
"""Message to a process: one of the functions below with its arguments but for the state."""


def check_model(folder: str, obj_id: int | None, state: TaskState) -> TaskResult:
    """Check a model by all rules about models; without an obj_id (None), the models folder."""
    models = state.models(folder)
    return TaskResult(list(apply_rules(models if obj_id is None else ModelSubject(models, obj_id))))


def check_scene(
    ref: SceneRef, first: bool, views: slice | None, poses: frozenset[int], targets: Mapping[str, Any], state: TaskState
) -> TaskResult:
    """Check a part of a scene's views, with the first part also the scene itself.

    `views` is the place of the part in the sorted list of images, None: images are not checked, only annotations; `poses` are images that
    are rendered again; `targets` are records of target lists about the scene.
    """
    scene, rendered = state.scene(ref, targets), list[int]()
    deviations: list[tuple[str, int, float]] = []
    violations = list(apply_rules(scene, state.tolerance, deviations)) if first else []
    images = [] if views is None else scene.images[views]
    for image in images:
        view = ViewSubject(scene, image)
        violations += apply_rules(view, state.tolerance, deviations)
        if image in poses and any(state.renderer.has(truth.obj_id) for truth in view.truths):
            rendered.append(image)
            violations += apply_rules(DiagnosedView(view, state.renderer, state.tolerance), state.tolerance, deviations)
    return TaskResult(violations, ref, len(images), rendered, deviations)


def check_rig(refs: Sequence[SceneRef], cameras: int, state: TaskState) -> TaskResult:
    """Check the scenes of the cameras of one episode, or of the sensors of one scene, against each other."""
    scenes = tuple(SceneSubject(state.layout, open_scene(state.layout, ref)) for ref in refs)
    return TaskResult(list(apply_rules(RigSubject(refs[0].place, scenes, cameras))))


def check_picks(index: int, state: TaskState) -> TaskResult:
    """Check the tables of picks of an episode."""
    violations = []
    for violation in apply_rules(PicksSubject(state.layout.root, index)):
        violations.append(violation)
        if violation.rule == "picks-tables":
            break  # The other rules read the same tables.
    return TaskResult(violations)
