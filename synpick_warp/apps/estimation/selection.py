"""Selection of the images of a data set: by mode, camera, episode, every n-th frame, or a BOP target list."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from synpick_warp.apps.estimation.scenes import ScenePlan
from synpick_warp.apps.evaluation.targets import TargetList
from synpick_warp.codes import Mode, names
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import ConfigError, DatasetError, ResultError

MAX_LISTED = 10
"""Maximum number of values that a message lists."""


@dataclass(frozen=True)
class Selection:
    """Filters of the images to estimate: modes, cameras, episodes (None: all), every n-th frame, or the images and objects of a target
    list.
    """

    modes: tuple[str, ...] | None = None
    cameras: tuple[int, ...] | None = None
    episodes: tuple[int, ...] | None = None
    every: int = 1
    """Every n-th frame of a scene, from its first one."""
    targets: TargetList | None = field(default=None, repr=False)
    """Images and objects; instead of `every`."""


def plan_scenes(data_set: DataSet, selection: Selection) -> tuple[list[ScenePlan], bool]:
    """List the scenes of a data set and the frames of each that are estimated.

    Returns:
        Scenes with at least one frame, in order; and whether these are all images of the data set.

    Raises:
        ConfigError: A mode, camera or episode does not exist, or nothing is left.
        DatasetError: The data set has no episode.
        ResultError: An image of the target list does not exist.
    """
    known = list(data_set)
    if not known:
        raise DatasetError(f"{data_set.folder} has no episode to estimate poses in; finish the bake first")
    cameras = data_set.camera_count
    _check("--modes", selection.modes, names(Mode))
    _check("--cameras", selection.cameras, range(cameras))
    _check("--episodes", selection.episodes, known)
    listed: dict[int, list[int]] | None = None
    if selection.targets is not None:
        listed = {}
        for scene, image in sorted(selection.targets.objects):
            listed.setdefault(scene, []).append(image)
        scenes = {data_set.scene_id(episode, camera) for episode in known for camera in range(cameras)}
        if missing := sorted(listed.keys() - scenes):
            raise ResultError(f"{selection.targets.path}: the data set has no scene {missing[0]}")
    plans, total = [], 0
    for index in known:
        episode = data_set[index]
        total += sum(len(episode.images(camera)) for camera in episode.cameras)
        if selection.episodes is not None and index not in selection.episodes:
            continue
        if selection.modes is not None and episode.row.get("mode") not in selection.modes:
            continue
        for camera in episode.cameras if selection.cameras is None else sorted(set(selection.cameras) & set(episode.cameras)):
            scene, images = data_set.scene_id(index, camera), episode.images(camera)
            chosen = images[:: selection.every] if listed is None else listed.get(scene, [])
            if unknown := set(chosen) - set(images):
                path = selection.targets.path if selection.targets else data_set.folder
                raise ResultError(f"{path}: scene {scene} has no image {max(unknown)}; its images are {images[0]} to {images[-1]}")
            if chosen:
                plans.append(ScenePlan(scene, index, camera, tuple(chosen)))
    if not plans:
        raise ConfigError(f"no image of {data_set.folder} is left by --modes, --cameras, --episodes and --targets; drop one of them")
    return plans, sum(len(plan.frames) for plan in plans) == total


def _check(option: str, values: Sequence[object] | None, allowed: Sequence[object]) -> None:
    """Raise ConfigError for the first of an option's values (None: not given) that is not in `allowed`."""
    for value in values or ():
        if value not in allowed:
            shown = ", ".join(map(str, allowed[:MAX_LISTED])) + (", ..." if len(allowed) > MAX_LISTED else "")
            raise ConfigError(f"{option} names {value}; allowed: {shown}")
