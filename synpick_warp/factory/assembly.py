"""Composition root: factory functions that build the stages of a bake (simulated worlds, renderer, encoders), load its assets, and compile
its kernels ahead of time, in parallel threads; and the warm-up, which compiles all kernels that a bake or stream launches.

A bake generates a data set. Callers (bake, online stream, warm-up) pass the whole `Config`; stages take the sections that they need.
"""

import contextlib
import gc
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Ending, Status
from synpick_warp.configs.cell.cameras import COLOR, Rig
from synpick_warp.configs.cell.gripper import describe_forces
from synpick_warp.configs.dataset import DataLayout, may_pick
from synpick_warp.configs.episodes.manipulation import PICKS
from synpick_warp.configs.schema import FAST, Config, Render
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.attempts import AttemptLog, EpisodeRecord
from synpick_warp.factory.episodes import PLACES, EpisodeOutcome, count_writers
from synpick_warp.factory.forecast import order_longest_first
from synpick_warp.factory.memory_plan import check_memory, explain_shortage, fit_to_device, plan_memory, without_pictures
from synpick_warp.factory.picks import PickEngine, PickQueue
from synpick_warp.kernels.render.images.ground_truth import gather_cameras_kernel
from synpick_warp.kernels.render.lighting.brdf import measure_albedo_kernel
from synpick_warp.kernels.render.lighting.paths.coarse import trace_coarse_paths_kernel
from synpick_warp.kernels.render.lighting.shading import shade_kernel
from synpick_warp.kernels.render.visibility.raster import rasterize_triangles_kernel
from synpick_warp.kernels.render.visibility.view_setup import set_up_views_kernel
from synpick_warp.kernels.render.visibility.wide_bvh import read_binary_bvh_kernel
from synpick_warp.kernels.sim.snapshot import take_snapshot_kernel
from synpick_warp.kernels.tuning import PIXEL_BLOCK
from synpick_warp.newton_patches.narrow_phase import early_builds, slow_builds, take_shipped
from synpick_warp.scenes.bins import Bin, make_bins, make_fixtures
from synpick_warp.scenes.build import REPEATS, find_drawn, find_repeat_rules, must_repeat, without_distractors
from synpick_warp.scenes.cameras import EpisodeCameras, describe_cameras
from synpick_warp.scenes.capacities import FEW, check_fill, with_capacities
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.collision.shapes import default_cache_dir
from synpick_warp.scenes.grippers import check_reach, make_head
from synpick_warp.scenes.looks import Looks, load_looks
from synpick_warp.scenes.types import Camera, Catalog, EnvironmentMap
from synpick_warp.stages.render.looks import draw_looks, load_scene_lights
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import RenderScene, build_render_scene, with_cameras
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.stages.stream import FrameStream, LightTable, TickReport, name_lights, read_tick
from synpick_warp.stages.view_ring import CameraGroup, MaskBounds, ViewRing, choose_transfers, history_count, view_sizes
from synpick_warp.system.hardware import kernels
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.hardware.kernels import Compiler, build_of, compilation_lock, dry_launches
from synpick_warp.system.interpreter import collection_paused
from synpick_warp.system.progress import Progress, SilentProgress
from synpick_warp.views.frames import bin_record, most_words

NO_WRITERS = 0
"""Writer processes in the memory plan where nothing is written."""


@dataclass(frozen=True, eq=False)
class Stages:
    """Assets, simulation and renderer on a device, shared by bakes and online streams."""

    config: Config
    """The settings; `bake.worlds` is the actual number."""
    catalog: Catalog
    episode_cameras: EpisodeCameras
    lights: tuple[EnvironmentMap, ...]
    simulation: Simulation
    groups: tuple[CameraGroup, ...]
    """The cameras by image size, with their renderers."""
    object_ids: np.ndarray
    """obj_id of each body of the catalog (body) int32."""
    light_table: LightTable
    """Names of the environment maps, and directions to their first lamps."""

    @property
    def tick_time(self) -> float:
        """Time between two frames (a tick) [s]."""
        return self.config.physics.tick_time

    @property
    def randomized(self) -> Looks | None:
        """Looks (textures and colours) from which each episode samples its own at random; None: they are not randomized."""
        return self.groups[0].renderer.scene.looks

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """The nominal cameras, before the random offsets of each episode."""
        return self.episode_cameras.cameras

    def episode_row(self, report: TickReport, world: int, record: EpisodeRecord) -> EpisodeOutcome:
        """Row of the episode that ended in a world."""
        episode, arrangement, frame, ending = (int(report.column(name)[world]) for name in ("episode", "arrangement", "frame", "ending"))
        config, bins, split = self.config, self.config.cell.recorded, DataLayout.of(self.config).split_of(episode)
        drawn = config.bake.seed, episode, record.objects, dict(record.distractors)
        return EpisodeOutcome(
            episode,
            arrangement,
            Ending(ending),
            frame + 1,
            round(max(0, frame) * self.tick_time, PLACES),
            record.mode,
            record.objects,
            len(record.attempts),
            record.picked,
            record.lost,
            record.left,
            "" if split is None else split.name,
            looks=draw_looks(self.randomized, *drawn) if self.randomized else None,
            bin=bin_record(bins[int(report.snapshot.bin[world])], report.snapshot.fixture_pose[world, 0]) if bins else None,
            cameras=self.episode_cameras.record(episode),
        )

    def make_log(self) -> AttemptLog:
        """Create an empty attempt log."""
        distractors = {body.obj_id: body.name for body in self.catalog.distractors}
        cups = len(make_head(self.config.gripper).cups)
        return AttemptLog(self.config.suction, self.config.perception.resolution, self.object_ids, distractors, cups)


@dataclass(frozen=True, eq=False)
class Factory(Stages):
    """The stages of a bake, with the stream of its views, which copies them to the host, and the log of pick attempts."""

    stream: FrameStream
    log: AttemptLog
    picks: PickQueue | None = None
    """Grasp trials; None: the format picks is not written."""


def build_factory(
    config: Config,
    progress: Progress,
    episodes: Sequence[int] | None = None,
    processes: int = 1,
    longest_first: bool = False,
    expected: int = 0,
) -> Factory:
    """Load assets and build the stages on the device.

    `episodes` are the indices to simulate, None: all, which `longest_first` reorders by `order_longest_first`; `expected` is the number of
    episodes by which the number of worlds is chosen, if these are fewer. `processes` of the bake share the host's memory. Raises
    SynpickError if the machine has too little memory, or device, models, lights, bins or cameras cannot be used."""
    device = pick_device(config.bake.device)
    planned = DataLayout.of(config).planned if episodes is None else max(expected, len(episodes))
    needs = Needs.of(config)
    writers = count_writers(config.bake.writers, needs.slot_bytes)
    config = _with_note(config, fit_to_device(without_pictures(config), device, planned, writers, processes), progress)
    check_memory(plan_memory(config, device, writers), device, processes)
    with compiling_if_cold(config, device, progress):
        stages = build_stages(config, device, progress, episodes, needs.physics, longest_first)
        return _add_picks(_add_stream(stages, device, needs.images, needs.depth_files), progress)


def build_online(config: Config, progress: Progress, episodes: Sequence[int]) -> Stages:
    """Load assets and build the stages of a stream or an environment, whose views stay on the device. Errors as of `build_factory`."""
    device = pick_device(config.bake.device)
    config = _with_note(config, fit_to_device(config, device, max(1, len(episodes)), NO_WRITERS), progress)
    check_memory(plan_memory(config, device, NO_WRITERS), device)
    with explain_shortage(config), compiling_if_cold(config, device, progress, online=True):
        return build_stages(config, device, progress, episodes)


def _with_note(config: Config, fitted: Config, progress: Progress) -> Config:
    """Settings after `fit_to_device`; a note if these keep fewer pictures, or none."""
    render = fitted.render
    if (render.reuse, render.reuse_worlds) != (config.render.reuse, config.render.reuse_worlds):
        part = f" of more than {render.reuse_worlds} of {fitted.bake.worlds} worlds" if render.reuse else ""
        progress.note(f"memory is too short to keep resting parts of pictures{part} from frame to frame (render.reuse): same files, slower")
    return fitted


def is_cache_warm(device: wp.Device) -> bool:
    """Whether the kernel cache is warm: it has a kernel that every bake launches, and that is compiled after all others.

    Kernels that other settings need may still be missing.
    """
    return build_of(take_snapshot_kernel, device).is_cached()


def sole_compiler(progress: Progress) -> AbstractContextManager[None]:
    """Lock under which one process at a time compiles; see `compilation_lock`."""
    return compilation_lock(lambda: progress.stage("waiting for another process, which compiles kernels"))


def make_compiler(device: wp.Device | None, progress: Progress) -> Compiler:
    """A compiler that reports "compiling kernels: 14 of 37 modules"; it compiles the kernel of `is_cache_warm` last.

    Without a device it has no such kernel, and only reports what launches compile: a warm cache lacks kernels of other settings.
    """
    last = None if device is None else build_of(take_snapshot_kernel, device)
    return Compiler(lambda ready, total: progress.stage(f"compiling kernels: {ready} of {total} modules"), last)


def submit_slow(compiler: Compiler, device: wp.Device, config: Config) -> None:
    """Start to compile what takes longest, and what is launched while worlds are built, before these are."""
    own = [build_of(kernel, device) for kernel in (measure_albedo_kernel, set_up_views_kernel)]
    shown = (trace_coarse_paths_kernel, shade_kernel) if Needs.of(config).views and config.render.mode == FAST else ()
    own += [build_of(kernel, device, PIXEL_BLOCK) for kernel in (rasterize_triangles_kernel, *shown)]
    compiler.submit([*slow_builds(device), build_of(read_binary_bvh_kernel, wp.get_device("cpu")), *early_builds(device), *own])


def submit_launches(compiler: Compiler, simulation: Simulation, stream: FrameStream | None) -> None:
    """Start to compile what `launch_all` launches in worlds that have not ticked yet. No kernel runs, so that their state stays; contents
    of scratch arrays may change. Without a stream nothing is rendered."""
    with dry_launches() as builds:
        launch_all(simulation, stream)
    simulation.clear_graphs()
    compiler.submit(builds)


def launch_all(simulation: Simulation, stream: FrameStream | None) -> None:
    """Launch every kernel of simulation, perception, renderer and encoders once."""
    record = simulation.record
    for _ in range(2):  # The first tick launches kernels one by one and captures graphs; the second launches the graphs.
        simulation.tick()
    if simulation.perception is not None:
        simulation.perception.load_kernels(record.snapshot)
    report = read_tick(record)
    if stream is not None:
        report.status[:, Status.LIVE] = 1
        for views in stream.render(record.snapshot, report):
            len(views)
    wp.synchronize_device(simulation.device)


def _add_picks(factory: Factory, progress: Progress) -> Factory:
    """Add the worlds of grasp trials, if the format picks is written."""
    if PICKS not in factory.config.bake.formats:
        return factory
    progress.stage("building worlds of grasp trials")
    return replace(factory, picks=PickQueue(factory.simulation, PickEngine(factory), len(factory.catalog)))


@contextlib.contextmanager
def compiling_if_cold(config: Config, device: wp.Device, progress: Progress, online: bool = False) -> Iterator[None]:
    """Compile the kernels of a bake in parallel if the kernel cache is cold, while the body of the context builds worlds.

    A dry run of a minimal factory, which is freed again, lists the kernels; all are compiled when the context is left. One process compiles
    at a time. With a warm cache, kernels are compiled only when they are launched and missing, which is reported. `online`: as of
    `build_smallest`.
    """
    if is_cache_warm(device):
        with make_compiler(None, progress):
            yield
        return
    with sole_compiler(progress):
        if is_cache_warm(device):
            yield
            return
        take_shipped(device)
        progress.stage("compiling kernels, once")
        with make_compiler(device, progress) as compiler:
            submit_slow(compiler, device, config)
            factory = build_smallest(config, device, SilentProgress(), online)
            submit_launches(compiler, factory.simulation, factory.stream if online or Needs.of(config).views else None)
            del factory
            gc.collect()  # Warp's code generation leaves tracebacks, whose frames keep the factory's arrays alive.
            yield


def build_smallest(config: Config, device: wp.Device, progress: Progress, online: bool = False) -> Factory:
    """Build a factory with as few worlds as the device allows (MIN_GPU_WORLDS) and one view a batch; `online`: without the physics that
    formats record, and with all images. Other arguments and errors: `build_factory`."""
    config = config.with_values({"bake.worlds": 1, "render.views_per_batch": 1})
    needs = Needs.of(config)
    config = fit_to_device(config, device, 1, count_writers(config.bake.writers, needs.slot_bytes))
    stages = build_stages(config, device, progress, [0], needs.physics and not online)
    return _add_stream(stages, device, needs.images or online, needs.depth_files)


def _add_stream(stages: Stages, device: wp.Device, needs_images: bool, depth_files: bool) -> Factory:
    """Add the stream of views to stages: a ring buffer of batches for each group of cameras. Other arguments: see `choose_transfers`."""
    config, table, tick_time = stages.config, stages.light_table, stages.tick_time
    rings = []
    for index, group in enumerate(stages.groups):
        host = choose_transfers(config.bop, group.sizes["row"], device, needs_images, depth_files)
        rings.append(ViewRing(group, group_layers(config.rig, config.render, index), device, host))
    stream = FrameStream(rings, tick_time, stages.object_ids, table, device, config.cell.recorded, stages.episode_cameras)
    return Factory(**vars(stages), stream=stream, log=stages.make_log())


@collection_paused()
def build_stages(
    config: Config,
    device: wp.Device,
    progress: Progress,
    episodes: Sequence[int] | None = None,
    records_physics: bool = False,
    longest_first: bool = False,
) -> Stages:
    """Load assets, and build worlds and renderer, from settings after `fit_to_device`. Other arguments and errors: `build_factory`."""
    progress.stage("loading objects and lights")
    episode_cameras = EpisodeCameras(config.rig, config.bake.seed)
    cameras = episode_cameras.cameras
    bins = make_bins(config.cell.bins)
    for line in (line for one in bins for line in one.notes):
        progress.note(line)
    catalog = load_catalog(config, report=progress.note)
    lights = load_scene_lights(config.bake.lights, config.randomize, config.bake.seed, progress.note, config.objects.strict)
    config = fit_to_catalog(config, catalog, bins, device, progress)
    if longest_first and episodes is not None:
        episodes = order_longest_first(config, catalog, episodes, device)
    progress.stage(f"building worlds on {device.alias} (worlds: {config.bake.worlds}, objects: {len(catalog)})")
    looks = load_looks(config.randomize, progress.note, config.objects.strict)
    fixtures = make_fixtures(bins, config.gripper)
    # The scene is built with the first group's cameras; `_build_group` replaces them by those of each group.
    first = tuple(cameras[index] for index in config.rig.groups[0])
    scene = build_render_scene(config.render, bins[0].sizes.ground, catalog, fixtures, first, lights, device, looks, config.suction.radius)
    simulation = Simulation(config, catalog, len(lights), device, scene, episodes, records_physics)
    groups = tuple(_build_group(config, scene, cameras, index) for index in range(len(config.rig.groups)))
    table = name_lights([light.name for light in lights], scene.lights)
    return Stages(config, catalog, episode_cameras, lights, simulation, groups, catalog.object_ids, table)


def group_layers(rig: Rig, render: Render, index: int) -> tuple[str, ...]:
    """Layers that a group of cameras renders: those that `render.layers` and its cameras' modalities both name."""
    return rig.chosen(rig.groups[index][0], render.layers)


def _build_group(config: Config, scene: RenderScene, cameras: tuple[Camera, ...], index: int) -> CameraGroup:
    """Group of cameras that are rendered together, with a renderer; renderers share the constants of `scene` but its cameras."""
    indices, worlds, objects = config.rig.groups[index], config.bake.worlds, config.arrangement.max_objects
    sizes = view_sizes(config.render, config.rig, worlds, objects, scene.device, index)
    own = tuple(cameras[camera] for camera in indices)
    scene, rig, first = with_cameras(scene, own), config.rig, indices[0]
    chosen = replace(config, render=replace(config.render, layers=group_layers(config.rig, config.render, index)))
    colors, histories = rig.writes(first, COLOR), history_count(rig, worlds, index)
    renderer = make_renderer(chosen, scene, objects, sizes["view"], rig.shutter(first), histories=histories, colors=colors)
    lenses = tuple(camera.lens for camera in own) if rig.draws_lens(first) else ()
    pooled = sizes["mask_word"] < objects * most_words(*rig.sizes[first])
    bounds = MaskBounds.of(scene.meshes, own) if pooled else None
    return CameraGroup(indices, sizes, renderer, rig.is_placed(first), rig.moves(first), rig.every[first], colors, lenses, bounds)


def fit_to_catalog(config: Config, catalog: Catalog, bins: Sequence[Bin], device: wp.Device, progress: Progress) -> Config:
    """Resolve settings that depend on objects and bins: whether objects repeat in an episode (if they are too few to fill the bin), and
    contact capacities. Raises ConfigError if the capacities do not fit into the device's memory, the objects of `arrangement.counts` do not
    fit into the bins, or no cup of the gripper can lie on any object."""
    labelled = without_distractors(config.arrangement, config.randomize.most_distractors)
    check_fill(labelled, config.physics.guide_height, catalog, config.cell.bins)
    picks = may_pick(config.bake, config.splits)
    if picks:
        check_reach(config.gripper, config.suction, catalog)
        if config.bake.models and config.suction.vacuum is None:
            progress.note(describe_forces(config.gripper, config.suction))
    for line in describe_cameras(picks, config.rig, config.cell.bins, config.gripper, config.pick):
        progress.note(line)
    filled = config.with_values(REPEATS) if must_repeat(labelled, catalog) else config
    if find_repeat_rules(filled.bake, filled.pick, filled.move) != find_repeat_rules(config.bake, config.pick, config.move):
        total = sum(entry.volume for entry in catalog.entries)
        budget = config.arrangement.volume
        progress.note(f"{len(catalog)} objects take {total:.3g} of {budget:g} m³ together, so that they repeat in an episode")
    arrangement = filled.arrangement
    physics = with_capacities(filled.physics, arrangement.max_objects, catalog, bins, arrangement.counts)
    transparent = any(body.material.glass.transmission > 0.0 for body in catalog.bodies)
    if physics is filled.physics and not transparent:
        return filled
    cause = "thin objects" if arrangement.max_objects <= FEW else "many objects"
    cause = "bins of many shapes" if any(one.is_detailed for one in bins) else cause
    if physics is not filled.physics:
        progress.note(f"{cause}: capacity for {physics.contacts_per_world:,} contacts a world")
    fitted = replace(filled, physics=physics)
    pieces = max(len(catalog.bodies[index].pieces) for index in find_drawn(arrangement, catalog))
    check_memory(plan_memory(fitted, device, 0, pieces, transparent), device)
    return fitted


def make_renderer(
    config: Config, scene: RenderScene, instances: int, views: int, shutter: tuple[float, float] = (0.0, 0.0), **given: Any
) -> Renderer:
    """Create the renderer of a bake from its sections of the settings, for `instances` instances a world and at most `views` views a batch.
    `shutter`: as of `Rig.shutter`. `given`: histories and colors, as of `Renderer`."""
    return Renderer(
        scene,
        config.render,
        config.effects,
        config.depth_sensor,
        seed=config.bake.seed,
        depth_scale=config.bop.depth_scale,
        instances=instances,
        views=views,
        **given,
        shutter=(shutter[0] / config.physics.tick_time, shutter[1] / config.physics.tick_time),
    )


@dataclass(frozen=True)
class WarmUp:
    """Result of a warm-up."""

    compiled: int
    """Number of modules that were compiled; the others were in the cache, or are shipped."""
    seconds: float
    """Duration [s]."""


def check_caches() -> None:
    """Raise CacheError unless kernels and collision shapes can be kept: a warm-up into a temporary cache is lost at its end."""
    caches = (
        ("kernel", kernels.kernel_cache(wp.config.version), kernels.KERNEL_VARIABLE),
        ("shape", default_cache_dir() if kernels.user_cache() else None, kernels.USER_VARIABLE),
    )
    for name, folder, variable in caches:
        reason = "the user has no home" if folder is None else kernels.find_fault(folder)
        if reason is not None:
            raise kernels.CacheError(
                f"the {name} cache {folder or '~/.cache'} cannot be written ({reason}), so that a warm-up would be lost; "
                f"set {variable} to a folder that can be written"
            )


def warm_up(config: Config, progress: Progress) -> WarmUp:
    """Compile the kernels of a bake or stream with these settings, then run two ticks and one rendering in the fewest worlds of the device;
    errors as of `synpick_warp.bake`.

    Nothing is written but caches, of kernels and collision shapes. Kernels depend on the settings only by which of them are
    used (mode, renderer, layers, formats)."""
    started = time.perf_counter()
    needs = Needs.of(config)
    device = pick_device(config.bake.device)
    with sole_compiler(progress):
        take_shipped(device)
        before = kernels.list_binaries()
        with make_compiler(device, progress) as compiler:
            submit_slow(compiler, device, config)
            compiler.submit([kernels.build_of(gather_cameras_kernel, device)])  # The one module that only the online stream needs.
            factory = build_smallest(config, device, progress)
            stream = factory.stream if needs.views else None
            submit_launches(compiler, factory.simulation, stream)
        launch_all(factory.simulation, stream)
    return WarmUp(len(kernels.list_binaries() - before), time.perf_counter() - started)
