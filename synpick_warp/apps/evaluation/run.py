"""Evaluation of BOP result files: read estimates and ground truth, match them, and average the errors by object, mode and visibility."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from synpick_warp.apps.evaluation.errors import Model, read_models
from synpick_warp.apps.evaluation.figures import Method
from synpick_warp.apps.evaluation.results import ResultFile, check_results, read_results, read_targets, select_targets, targets_file
from synpick_warp.apps.evaluation.scoring import Scores, score
from synpick_warp.apps.evaluation.tables import GROUPS, ScoreRow, summarize
from synpick_warp.apps.evaluation.tracking import filter_poses
from synpick_warp.apps.evaluation.truth import CameraMotion, PoseTable, Truth, read_truth
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import ConfigError, escape


class Evaluation(NamedTuple):
    """Scores of several methods on the same targets, and what they were made of."""

    truth: Truth
    methods: list[Method]
    scores: list[Scores]
    rows: list[ScoreRow]
    """Averages by object, mode, camera, visibility and speed."""
    models: Mapping[int, Model]


def score_files(
    data_set: DataSet,
    results: Sequence[Path],
    min_visibility: float,
    top: int,
    vertices: int,
    alpha: float | None = None,
    targets: Path | None = None,
    remark: Callable[[str], None] = lambda _: None,
) -> Evaluation:
    """Score BOP result files, one for each method, as `synpick_warp.evaluate`; `remark` receives a line for each file without estimates in
    some images. Raises SynpickError if a file is missing, damaged or of another data set, or nothing is as visible as that."""
    # Result files first: their mistakes are the likely ones, and quick to find.
    files = [read_results(path) for path in results]
    truth = read_truth(data_set)
    models = read_models(data_set.folder, truth.poses.object_id.tolist(), vertices)
    for file in files:
        check_results(file, truth, set(data_set.models_info) | set(models))
    if targets is not None:
        truth = select_targets(truth, read_targets(targets).in_classic_layout(data_set.sensors))
    if not truth.shown(min_visibility).any():
        raise ConfigError(f"--visib-min is {min_visibility:g}; no instance of {data_set.folder} is as visible as that; lower it")
    for line in describe_gaps(files, truth, listed=targets is not None):
        remark(line)
    methods = make_methods(results, files, alpha, truth.motion)
    scores = [score(label, truth, poses, models, min_visibility, top) for method in methods for label, poses in method.variants()]
    # Modes are those of a bake.
    groups = [group for group in GROUPS if group != "mode" or data_set.found is None]
    return Evaluation(truth, methods, scores, summarize(truth, scores, object_names(data_set), groups), models)


def describe_gaps(files: Sequence[ResultFile], truth: Truth, *, listed: bool) -> Iterator[str]:
    """A line for each result file without any estimate in an image that has targets. `listed`: images are those of a target list."""
    wanted = set(zip(truth.poses.scene.tolist(), truth.poses.image.tolist(), strict=True))
    for file in files:
        missing = len(wanted - set(zip(file.poses.scene.tolist(), file.poses.image.tolist(), strict=True)))
        own = targets_file(file.path)
        advice = f"; --targets {own} scores those that were estimated" if not listed and own.is_file() else ""
        if missing:
            yield f"{file.path} has no estimate in {missing:,} of {len(wanted):,} images, whose objects count as missed{advice}"


def make_methods(results: Sequence[Path], files: Sequence[ResultFile], alpha: float | None, motion: CameraMotion) -> list[Method]:
    """Named estimates of each file, with the filtered ones, by their motion in the world, if there is a weight `alpha`."""

    def filtered(poses: PoseTable) -> PoseTable | None:
        return None if alpha is None else motion.to_camera(filter_poses(motion.to_world(poses), alpha))

    return [Method(name, file.poses, filtered(file.poses), alpha) for name, file in zip(method_names(results), files, strict=True)]


def object_names(data_set: DataSet) -> dict[int, str]:
    """Names of objects by obj_id, which the trajectory store has; empty without."""
    return {item.object_id: item.name for item in data_set.objects} if data_set.has_store else {}


def method_names(results: Sequence[Path]) -> list[str]:
    """Name of each method: its file's up to the first underscore, as BOP has it; the whole path where two would be equal."""
    stems = [escape(path.stem) for path in results]
    short = [stem.partition("_")[0] or stem for stem in stems]
    if len(set(short)) == len(short):
        return short
    return stems if len(set(stems)) == len(stems) else [escape(str(path)) for path in results]
