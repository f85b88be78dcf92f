"""synpick-warp: a GPU-parallel data factory for dynamic bin picking.

    import synpick_warp

    synpick_warp.bake("smoke", "DATA", {"bake.mode": "move"})
    view = synpick_warp.open("DATA")[0].view(frame=3)
    for batch in synpick_warp.stream("smoke", worlds=8):     # the same views on the device, without files
        ...
    env = synpick_warp.make_env(task="pick", num_envs=8)      # the same worlds, and you choose the picks
    images = synpick_warp.render([("part.stl", pose)], [camera])    # your meshes at your poses
    scores = synpick_warp.evaluate("DATA", ["method_set-test.csv"])     # also: validate, convert

Importing this package loads neither simulator, NumPy nor OpenCV; the functions import them when they are called.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from synpick_warp._version import __version__
from synpick_warp.errors import (
    ActionError,
    CatalogError,
    ConfigError,
    DatasetError,
    DeviceError,
    LightError,
    OutputError,
    StateError,
    SynpickError,
)
from synpick_warp.system.inputs.urls import parse_place
from synpick_warp.system.interpreter import collection_paused

if TYPE_CHECKING:
    from synpick_warp.apps.conversion.run import Converted
    from synpick_warp.apps.validation.registry import Violation
    from synpick_warp.configs.schema import Config
    from synpick_warp.dataset.reading import DataSet
    from synpick_warp.environment.vector import PickingVectorEnv
    from synpick_warp.factory.episodes import BakeSummary
    from synpick_warp.online.stream import ViewStream
    from synpick_warp.scenes.types import Camera
    from synpick_warp.system.progress import Progress

__all__ = [
    "ActionError",
    "CatalogError",
    "ConfigError",
    "DatasetError",
    "DeviceError",
    "LightError",
    "OutputError",
    "StateError",
    "SynpickError",
    "__version__",
    "bake",
    "convert",
    "evaluate",
    "load_config",
    "make_env",
    "open",
    "render",
    "stream",
    "validate",
]

_DOORS = ("pytorch", "webdataset")
"""Modules of `dataset` that are attributes of this package, too: notes in data sets name them so."""


def __getattr__(name: str) -> object:
    """Import a module of `_DOORS` when it is first asked for."""
    if name not in _DOORS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return importlib.import_module(f"{__name__}.dataset.{name}")


def bake(
    config: Config | Path | str | None,
    out: Path | str,
    settings: Mapping[str, object] | None = None,
    *,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    devices: Sequence[str] | str = (),
    claim: bool = False,
    engine: str = "",
    workers: int = 0,
    progress: Progress | None = None,
) -> BakeSummary:
    """Generate a data set: simulate, render and write it; or resume one that was interrupted. `synpick-warp bake` does the same.

    Args:
        config: Settings: a `Config`, or a preset's name or a .toml file as for `load_config`; None: the default preset.
        out: Folder of the data set: new, empty, or of an earlier bake with the same settings; or a prefix in an object store.
        settings: Full key, such as "bake.mode", -> value; they override a preset or file.
        shard: (i, n): only episodes with index % n == i.
        splits: Only episodes of these splits of the settings, such as ("train",) of the preset "synpick"; empty: all.
        devices: Devices with a process each: GPUs such as ("cuda:0", "cuda:1"), or "cpu" once per process, or "all": every GPU, or
            without one a process per CPU core. The bytes are those of one device. Empty: `bake.device` alone.
        claim: Whether this is one of several equal workers, on any number of machines, which share out the episodes of a prefix among them.
        engine: "ray" or "ray://HOST:PORT": claiming workers on a Ray cluster; empty: on this machine.
        workers: Number of the engine's workers; 0: as many as its cluster has room for.
        progress: Receives stages, counts and notes; None: the logger `synpick_warp`. See `synpick_warp.system.progress`.

    Returns:
        How every episode and attempt ended, and how long it took.

    Raises:
        SynpickError: An error that the user can correct. Committed episodes stay, and the same call resumes the bake.
        TypeError: `settings` beside a finished `Config`.
    """
    with collection_paused():
        from synpick_warp.configs.schema import Config
        from synpick_warp.factory.pipeline import run_bake
        from synpick_warp.system.progress import LoggedProgress

    if not isinstance(config, Config):
        config = load_config(config, settings, splits=bool(splits))
    elif settings:
        raise TypeError("settings override a preset or a file; pass them to load_config, or use dataclasses.replace on the Config")
    if isinstance(devices, str):
        devices = tuple(name.strip() for name in devices.split(","))
    out = parse_place(out)
    if isinstance(out, str):
        from synpick_warp.cloud.workers import Job, start_bake

        given = {"claim": claim, "engine": engine, "workers": workers}
        return start_bake(Job(config, out), progress or LoggedProgress(), shard, splits, devices, **given)
    if claim or engine:
        raise ConfigError("claiming workers share out the episodes of a prefix in an object store; name one as the place of the data set")
    return run_bake(config, out, progress or LoggedProgress(), shard, splits, devices)


def stream(
    config: Config | Path | str | None = None,
    settings: Mapping[str, object] | None = None,
    *,
    worlds: int | None = None,
    device: str | None = None,
    seed: int | None = None,
    mode: str | None = None,
    resolution: tuple[int, int] | None = None,
    models: Path | str | None = None,
    lights: Path | str | None = None,
    layers: Sequence[str] | None = None,
    batch: int | None = None,
    episodes: int | range | None = None,
    shard: tuple[int, int] = (0, 1),
    splits: Sequence[str] = (),
    cameras: Sequence[int] | None = None,
    stride: int = 1,
    progress: Progress | None = None,
) -> ViewStream:
    """Generate views for a consumer in this process: an iterator over batches whose arrays stay on the device, without files.

        for batch in synpick_warp.stream("synpick", mode="mixed", device="cuda:0", episodes=range(1000)):
            color = torch.from_dlpack(batch.color)      # (B, H, W, 3) uint8, no copy; valid until the next batch

    Views and values are those of a bake with the same settings, images before they are compressed. See `synpick_warp/online/README.md`.

    Args:
        config: Settings, as for `bake`.
        settings: Full key -> value; they override `config`, a finished `Config`, too.
        worlds, device, seed, mode, models, lights: Override the settings `bake.*` of these names.
        resolution: Width and height of the images [px], instead of `cameras.resolution`.
        layers: Names of the layers to render, instead of `render.layers`.
        batch: Maximum views of a batch, instead of `render.views_per_batch`; a tick's last batch may have fewer.
        episodes: How many, from 0 on, or a range of indices; None: those of the settings, which are
            `bake.episodes` (4 in the preset "synpick").
        shard: (i, n): only episodes with index % n == i, such as those of a training process.
        splits: Only episodes of these splits of the settings; empty: all.
        cameras: Indices of the cameras to render; None: all.
        stride: Every n-th frame of an episode; the others are simulated only. Above 1, colours are those of `render.history` 0.
        progress: Receives stages and notes; None: the logger `synpick_warp`.

    Raises:
        SynpickError: An error that the user can correct, before the first batch or while one is made.
    """
    with collection_paused():
        from synpick_warp.online.stream import Selection, open_stream, resolve_settings
        from synpick_warp.system.progress import LoggedProgress

    given = {"worlds": worlds, "device": device, "seed": seed, "mode": mode, "models": models, "lights": lights}
    given |= {"resolution": resolution, "layers": layers, "batch": batch}
    resolved = resolve_settings(config, settings or {}, given, bool(splits))
    selection = Selection(cameras, stride)
    progress = progress or LoggedProgress()
    return open_stream(resolved, progress, episodes=episodes, shard=shard, splits=splits, selection=selection)


def make_env(
    config: Config | Path | str | None = None,
    settings: Mapping[str, object] | None = None,
    *,
    task: str = "pick",
    num_envs: int = 1,
    device: str | None = None,
    obs: Sequence[str] = ("depth", "state"),
    resolution: tuple[int, int] = (160, 90),
    action: str | None = None,
    autoreset: str = "next_step",
    backend: str = "torch",
    seed: int = 0,
    max_steps: int | None = None,
    piles: int | None = None,
    course: str = "attempt",
    progress: Progress | None = None,
) -> PickingVectorEnv:
    """Make a vector environment (`gymnasium.vector.VectorEnv`) in which an action is a pick, or a twist of the gripper for a tick.

        env = synpick_warp.make_env(task="pick", num_envs=512, device="cuda:0", obs=("depth",), resolution=(160, 90), action="pixel")
        obs, info = env.reset(seed=3)
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())

    Piles are those of a bake with the same settings, at rest. See `synpick_warp/environment/README.md`.

    Args:
        config, settings: Settings, as for `bake`.
        task: "pick": any object; "target": the one that the observation names; "move": stir the bin.
        num_envs: Number of environments.
        device: Overrides `bake.device`.
        obs: Contents of the observation, a dict: of depth, rgb, instances, normals, points, state.
        resolution: Width and height of images, of `perception.camera` or the first camera [px].
        action: "pixel" or "point": a whole pick; "twist": a tick. None: "pixel", of task "move" "twist".
        autoreset: "next_step", "same_step" or "disabled", as Gymnasium defines them.
        backend: Library of the arrays: "torch" or "warp", on the device, or "numpy".
        seed: Seed of the first environment's episodes if `reset` gets none; the others follow.
        max_steps: Steps after which an episode is truncated; None: 30 attempts, or 600 ticks.
        piles: Number of different piles that episodes are drawn from; None: 2^31 - 1, so that repeats are rare.
        course: Course of a whole pick: "attempt", as in a bake, or "trial", as in the format picks, which takes a third of the ticks.
        progress: Receives stages and notes; None: the logger `synpick_warp`.

    Raises:
        SynpickError: An error that the user can correct.
        ModuleNotFoundError: Gymnasium is not installed, or for backend "torch" PyTorch.
    """
    with collection_paused():
        from synpick_warp.environment.make import make_picking, require_libraries
        from synpick_warp.environment.settings import make_choice

    choice = make_choice(task, num_envs, obs, resolution, action, autoreset, backend, seed, max_steps, piles, course)
    require_libraries(backend)
    from synpick_warp.environment.vector import PickingVectorEnv

    return PickingVectorEnv(make_picking(choice, config, settings or {}, device, progress))


def render(
    objects: Sequence[tuple[Path | str | tuple[Any, Any], Any]],
    cameras: Sequence[Camera],
    *,
    layers: Sequence[str] = (),
    unit: float = 1.0,
    device: str = "auto",
    backend: str = "numpy",
    settings: Mapping[str, object] | None = None,
) -> dict[str, Any]:
    """Render meshes at given poses, without simulation and files.

        from synpick_warp.scenes.types import Camera

        camera = Camera.at(matrix=K, resolution=(640, 480), pose=camera_to_world)
        views = synpick_warp.render([("bracket.stl", object_to_world)], [camera], layers=("normals",), unit=1e-3)

    Args:
        objects: (mesh, object to world (4, 4) [m]) of each instance; a mesh is a file, or (vertices (V, 3), faces (F, 3)).
        cameras: Cameras of one resolution.
        layers: Further layers, as of `render.layers`.
        unit: Unit of all meshes [m].
        device: As `bake.device`.
        backend: "numpy", or "torch": tensors on the device.
        settings: Full key, such as "render.mode" or "bake.lights", -> value, on top of the preset "synpick".

    Returns:
        Arrays (camera, H, W, ...): color uint8 sRGB; depth float32 [m], 0: none; instance uint8, 1 for the first object, 0: none; and the
        layers, as in `synpick_warp.views.layers`.

    Raises:
        SynpickError: An error that the user can correct.
    """
    with collection_paused():
        from synpick_warp.online.render import render_scene

    config = load_config(None, {"render.table": False} | dict(settings or {}))
    scale = config.bop.depth_scale / 1000.0
    arrays = render_scene(objects, cameras, layers, unit, device, config)
    if backend == "torch":
        import torch  # pyright: ignore[reportMissingImports]

        views = {name: torch.from_dlpack(array) for name, array in arrays.items()}
        return views | {"depth": views["depth"].float() * scale}
    if backend != "numpy":
        raise ConfigError(f'backend is "{backend}"; allowed: numpy, torch')
    views = {name: array.numpy() for name, array in arrays.items()}
    return views | {"depth": views["depth"].astype("float32") * scale}


def load_config(preset_or_file: Path | str | None = None, settings: Mapping[str, object] | None = None, *, splits: bool = False) -> Config:
    """Read a preset or a .toml file, override single settings, and validate the result.

    Args:
        preset_or_file: Name of a preset, such as "smoke", or path of a file that ends in .toml; None: the preset "synpick".
        settings: Full key, such as "physics.step", -> value.
        splits: Whether the splits that a preset defines apply; those of a file always do.

    Raises:
        ConfigError: There is no such preset, file or key, or a value is not allowed.
    """
    from synpick_warp.configs.files.load import load_config as load

    return load(None if preset_or_file is None else str(preset_or_file), settings or {}, splits=splits)


def open(folder: Path | str) -> DataSet:
    """Open a data set for reading; loads no simulator, and reads nothing before it is needed. See `synpick_warp.dataset.reading`.

    One in an object store (s3://bucket/prefix) is read episode by episode, with a cache in a temporary folder.

    Raises:
        DatasetError: The folder holds no data set.
    """
    if isinstance(place := parse_place(folder), str):
        from synpick_warp.cloud.reading import open_store_set

        return open_store_set(place)
    from synpick_warp.dataset.reading import open_data_set

    return open_data_set(place)


def evaluate(
    data: Path | str,
    results: Sequence[Path | str],
    *,
    min_visibility: float = 0.1,
    top: int = -1,
    vertices: int = 0,
    alpha: float | None = None,
    targets: Path | str | None = None,
    split: str | None = None,
) -> dict[str, Any]:
    """Score pose estimates, BOP result files of one method each: AUC of ADD, ADD-S and ADD(-S). `synpick-warp eval` does the same.

    Args:
        data: A data set in the format bop or shards.
        results: Result files.
        min_visibility: Smallest visible fraction of an instance that is to be found.
        top: Estimates that count per image and object, by score; -1: as many as instances to be found; 0: all.
        vertices: Vertices of a model that errors are averaged over; 0: all.
        alpha: Weight of the new estimate in the tracking filter of the SynPick paper, which scores each method once more; None: no filter.
        targets: Target list, such as BOP's test_targets_bop19.json; None: all images.
        split: Only the episodes of this split; None: all.

    Returns:
        What `eval --format json` writes: see `synpick_warp/apps/evaluation/README.md`.

    Raises:
        SynpickError: An error that the user can correct.
    """
    import json

    from synpick_warp.apps.evaluation.results import score_files
    from synpick_warp.apps.evaluation.tables import render as render_table
    from synpick_warp.apps.evaluation.tracking import check_alpha
    from synpick_warp.cli.commands.evaluate import check_options

    check_options(list(map(Path, results)), "json", None, min_visibility, "exact", top, vertices)
    if alpha is not None:
        check_alpha(alpha)
    data_set = open(data) if split is None else open(data).split(split)
    chosen = None if targets is None else Path(targets)
    scored = score_files(data_set, list(map(Path, results)), min_visibility, top, vertices, alpha, chosen)
    return json.loads(render_table(scored.rows, scored.truth, scored.scores, "json"))


def validate(
    data: Path | str,
    *,
    sample: int | None = 200,
    images: bool = True,
    tolerance: tuple[float, float] | None = None,
    threads: int = 0,
) -> list[Violation]:
    """Check a BOP data set, ours or not, by all rules: the violations. `synpick-warp validate` does the same.

    Args:
        data: Folder that contains train_pbr, models, ...
        sample: Views that are rendered again to check poses, spread evenly; None: all.
        images: Whether images are read; otherwise only files, annotations, models and target lists are checked.
        tolerance: Of a measured data set: deviations of depth [mm] and of outlines [px] that are no errors.
        threads: Number of processes; 0: one per core.

    Raises:
        DatasetError: The folder is not a BOP data set.
        ConfigError: A value is out of range.
    """
    from synpick_warp.apps.validation.registry import parse_tolerance
    from synpick_warp.apps.validation.run import Summary, ValidationOptions
    from synpick_warp.apps.validation.run import validate as check
    from synpick_warp.cli.options import MAX_THREADS, check_range
    from synpick_warp.configs.fields import INT32_MAX
    from synpick_warp.system.hardware.cores import count_cores

    check_range("sample", sample or 0, 0, INT32_MAX)
    check_range("threads", threads, 0, MAX_THREADS)
    bounds = None if tolerance is None else parse_tolerance(",".join(map(str, tolerance)))
    return list(check(Path(data), ValidationOptions(sample, images, threads or count_cores(), bounds), Summary()))


def convert(data: Path | str, out: Path | str, formats: Sequence[str], *, split: str | None = None, threads: int = 0) -> Converted:
    """Convert a data set to other formats, into a data set of its own. `synpick-warp convert` does the same.

    Args:
        data: Folder of a data set; its committed episodes are converted.
        out: Folder of the converted one: new, empty, or of an interrupted conversion.
        formats: Names of formats, such as ("coco", "shards").
        split: Split to convert, of a BOP data set from another source; None: the only one.
        threads: Number of processes; 0: one per core.

    Raises:
        SynpickError: An error that the user can correct. The same call resumes the conversion.
    """
    from synpick_warp.apps.conversion.run import convert as run_conversion
    from synpick_warp.cli.options import MAX_THREADS, check_range
    from synpick_warp.system.progress import ignore_progress

    check_range("threads", threads, 0, MAX_THREADS)
    return run_conversion(Path(data), Path(out), formats, threads, ignore_progress, split)
