"""Tasks of a validation: pickled messages that check a model, the views of a scene, or a rig, in this process or in another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from synpick_warp.apps.validation.model_files import ModelsFolder, ModelSubject
from synpick_warp.apps.validation.registry import Tolerance, Violation, apply_rules
from synpick_warp.apps.validation.rules.sets import RigSubject
from synpick_warp.apps.validation.scene_files import open_scene
from synpick_warp.apps.validation.subjects import SceneSubject, ViewSubject
from synpick_warp.dataset.bop.layout import Layout, Listing, SceneRef


class TaskResult(NamedTuple):
    """Result of a validation task, which checks a scene or a part of its views."""

    violations: list[Violation]
    views: int = 0
    """Views whose images were checked."""
    rendered: Sequence[int] = ()
    """Images that were rendered again."""
    deviations: Sequence[tuple[str, int, float]] = ()
    """(rule, obj_id, value) of each deviation; empty without a tolerance."""


class TaskState:
    """State that a process keeps between tasks: layout, tolerance, scene that was read last, renderer."""

    def __init__(self, folder: Path, tolerance: Tolerance | None = None) -> None:
        self.folder, self.tolerance = folder, tolerance
        self._scene: tuple[tuple[SceneRef, int], SceneSubject] | None = None
        self._models: tuple[str, ModelsFolder] | None = None

    @cached_property
    def layout(self) -> Layout:
        """Layout of the data set."""
        return Layout(self.folder)

    @cached_property
    def renderer(self) -> Any:
        """The `ObjectRenderer`; Warp is imported when the first view is rendered."""
        from synpick_warp.apps.validation.rendering import ObjectRenderer

        return ObjectRenderer(self.layout)

    def scene(self, ref: SceneRef, targets: dict[str, Any]) -> SceneSubject:
        """Subject of a scene; the last one is cached."""
        if self._scene is None or self._scene[0] != (ref, id(targets)):
            self._scene = (ref, id(targets)), SceneSubject(self.layout, open_scene(self.layout, ref), targets)
        return self._scene[1]

    def models(self, name: str) -> ModelsFolder:
        """Models folder by name; the last one is cached, a missing one is empty."""
        if self._models is None or self._models[0] != name:
            self._models = name, ModelsFolder(self.layout.models.get(name, Listing(self.layout.root, name)))
        return self._models[1]


class ValidationTask(Protocol):
    """A message to a process; see `WorkerProgram`."""

    def __call__(self, state: TaskState) -> TaskResult:
        """Check."""
        ...


@dataclass(frozen=True)
class CheckModel:
    """Task: check a model by all rules about models; without an obj_id (None), the models folder."""

    folder: str
    obj_id: int | None

    def __call__(self, state: TaskState) -> TaskResult:
        folder = state.models(self.folder)
        return TaskResult(list(apply_rules(folder if self.obj_id is None else ModelSubject(folder, self.obj_id))))


@dataclass(frozen=True)
class CheckScene:
    """Task: check views `first` to `last` - 1 of a scene (None: to the end), and with the first part the scene itself; `poses`: images that
    are rendered again.
    """

    ref: SceneRef
    first: int
    """Position of the part's first view in the sorted list of images."""
    last: int | None
    """Position after its last view; None: to the end."""
    images: bool
    """Whether images are checked, not only annotations."""
    poses: frozenset[int] = frozenset()
    """Images that are rendered again."""
    targets: dict[str, Any] = field(default_factory=dict)

    def __call__(self, state: TaskState) -> TaskResult:
        scene = state.scene(self.ref, self.targets)
        violations: list[Violation] = []
        deviations: list[tuple[str, int, float]] = []
        if self.first == 0:
            violations += apply_rules(scene, state.tolerance, deviations)
        if not self.images:
            return TaskResult(violations, deviations=deviations)
        images = scene.images[self.first : self.last]
        rendered: list[int] = []
        for image in images:
            view = ViewSubject(scene, image)
            violations += apply_rules(view, state.tolerance, deviations)
            if image in self.poses and any(state.renderer.has(truth.obj_id) for truth in view.truths):
                from synpick_warp.apps.validation.diagnosis import DiagnosedView

                rendered.append(image)
                violations += apply_rules(DiagnosedView(view, state.renderer, state.tolerance), state.tolerance, deviations)
        return TaskResult(violations, len(images), rendered, deviations)


@dataclass(frozen=True)
class CheckRig:
    """Task: check the scenes of the cameras of one episode, or of the sensors of one scene, against each other."""

    refs: tuple[SceneRef, ...]
    cameras: int

    def __call__(self, state: TaskState) -> TaskResult:
        scenes = tuple(SceneSubject(state.layout, open_scene(state.layout, ref)) for ref in self.refs)
        return TaskResult(list(apply_rules(RigSubject(self.refs[0].place, scenes, self.cameras))))


@dataclass(frozen=True)
class CheckPicks:
    """Task: check the tables of picks of an episode."""

    index: int

    def __call__(self, state: TaskState) -> TaskResult:
        from synpick_warp.apps.validation.rules.trials import PicksSubject

        violations = []
        for violation in apply_rules(PicksSubject(state.layout.root, self.index)):
            violations.append(violation)
            if violation.rule == "picks-tables":
                break  # The other rules read the same tables.
        return TaskResult(violations)
