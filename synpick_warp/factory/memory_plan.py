"""Memory budget of a bake: the size of every allocation, worked out in whole numbers before anything is loaded, against what is free.

The plan is a lower bound: what it refuses cannot run on this machine, what it accepts may still run out. Counted are all arrays that a
bake declares, Newton's by measured factors, the pinned copies of images, shared memory of writers, and the lists of episodes.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass, fields
from typing import Any

import warp as wp

from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.modes import may_pick
from synpick_warp.configs.schema import REFERENCE, Config, Perception, Physics, Trajectory
from synpick_warp.errors import ConfigError, SynpickError, format_value
from synpick_warp.exporters.registry import Needs
from synpick_warp.scenes import build
from synpick_warp.stages.arrays import memory_table
from synpick_warp.stages.buffers import LastFrame, LayerBuffers, Snapshot, ViewBuffers
from synpick_warp.stages.encoding.jpeg import JpegBuffers, JpegScratch, jpeg_sizes
from synpick_warp.stages.encoding.png import DEPTH_SCRATCH, DepthBuffers, depth_sizes
from synpick_warp.stages.host_copies import HostImages, host_images
from synpick_warp.stages.perception.arrays import Observation, Plan
from synpick_warp.stages.perception.images import SCRATCH, count_views, perception_sizes
from synpick_warp.stages.perception.plan import CYCLES, VoteArrays, plan_sizes
from synpick_warp.stages.render.annotate import BORDER_BOXES, border_sizes
from synpick_warp.stages.render.denoised import (
    DENOISED_SCRATCH,
    LIGHT_HISTORY,
    MOVING_BODIES,
    PATH_QUEUES,
    history_sizes,
    queue_sizes,
    scratch_sizes,
)
from synpick_warp.stages.render.layers import BODY_MOTIONS, MOTION_LAYERS
from synpick_warp.stages.render.mask_runs import BoundaryBuffers, BoundaryScratch, boundary_sizes
from synpick_warp.stages.render.postprocess import LensArrays, has_lens_filter
from synpick_warp.stages.render.raster import VISIBILITY_BUFFER, visibility_sizes
from synpick_warp.stages.render.renderer import SHADED_IMAGE
from synpick_warp.stages.render.view_setup import GBUFFER, VIEW_BODIES, body_sizes
from synpick_warp.stages.sim.physics import with_enough_worlds
from synpick_warp.stages.sim.step_log import record_kinds, record_sizes
from synpick_warp.stages.sim.worlds import AttemptState, SealState, WorldState, WorldStatus, world_sizes
from synpick_warp.stages.stream import REPORTED_SNAPSHOT, RING, view_sizes
from synpick_warp.stages.tick_queue import queue_lead
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.system.hardware.free_memory import free_device_memory, free_host_memory

Row = tuple[str, tuple[int, ...], str, int]
"""Name, shape, unit and size [bytes] of an array."""

EPISODE_BYTES = 100
"""Lists and sets of episode indices of a bake at their peak, for each episode [bytes]: tracemalloc has 115 for two million."""
# Newton's allocations for each item of a world's capacities [bytes]: name, setting, size on a CPU, size on a GPU. Measured on a CPU with
# Newton 1.8 from the growth of all allocations of model, collision pipeline and solver: 932, 16, 180 and 688. On a GPU rows have other
# arrays (solve mode "colored"): by Newton's source 160 bytes per row and 109 for its graph coloring, plus 128 for our packed row.
# Contacts and pairs have at least those of `newton.Contacts` and their sorter.
_NEWTON = (
    ("Newton's contacts", "contacts_per_world", 900, 250),
    ("Newton's shape pairs", "pairs_per_world", 24, 16),
    ("Newton's contact rows", "rows_per_world", 160, 397),
    ("Newton's gripper rows", "gripper_rows_per_world", 640, 40),
)
_VIEWS = ("cameras.resolution", "render.views_per_batch", "cameras.positions")
_CAMERAS = ("cameras.resolution", "cameras.positions")
_HISTORY = ("bake.worlds", "cameras.resolution", "render.history", "cameras.positions")
_WORLDS = ("bake.worlds", "arrangement.max_objects", "move.rounds")
_STEPS = ("bake.worlds", "physics.steps_per_tick", "arrangement.max_objects")
_RECORD = (Snapshot, WorldStatus, Observation, Plan)
"""Declarations of a tick's record, besides physics."""
_PERCEPTION = ("perception.resolution", "perception.contour_points", "perception.views", "bake.worlds")


@dataclass(frozen=True)
class Term:
    """Part of a bake's memory plan: arrays that grow with the same settings, on the device or the host."""

    name: str
    rows: tuple[Row, ...]
    """One row for each copy."""
    settings: tuple[str, ...]
    """Full keys of the settings by which it grows."""
    on_device: bool = True
    """Whether it lies in the device's memory; always False on the CPU, whose memory is the host's."""
    indexed: bool = True
    """Whether kernels index the arrays by 32-bit integers."""

    @property
    def size(self) -> int:
        """Size of all rows [bytes]."""
        return sum(row[3] for row in self.rows)


def plan_memory(config: Config, device: wp.Device, writers: int = 1) -> list[Term]:
    """Work out what a bake takes on a device, without allocating anything.

    Args:
        config: All settings.
        device: Device of the simulation; on a GPU the plan is for `with_enough_worlds`.
        writers: Writer processes; 0: nothing is written, views stay on the device.
    """
    config, needs = with_enough_worlds(config, device), Needs.of(config)
    host = _host_images(config, needs, device) if writers else None
    terms = _declared(config, needs, device, host)
    if not device.is_cuda:
        terms = [Term(term.name, term.rows, term.settings, False, term.indexed) for term in terms]
    terms.append(_queued_reports(queue_slots(config, device), _world_sizes(config), _physics_kinds(config.trajectory, needs)))
    terms += _newton(config.physics, config.bake.worlds, device)
    if host is not None and device.is_cuda:
        terms.append(_pinned(view_sizes(config, device), config.render.layers, config.cameras.resolution, host))
    if writers:
        # A writer is counted with one slot of shared memory: those of its queue get memory only once they are used.
        row = ("shared memory of writers", (writers, needs.slot_bytes), "", writers * needs.slot_bytes)
        terms.append(Term(f"images in {writers:,} writers", (row,), ("cameras.resolution", "bake.writers"), False, False))
    return terms


def _declared(config: Config, needs: Needs, device: wp.Device, host: HostImages | None) -> list[Term]:
    """Terms of all device arrays that a bake declares; `host`: what is copied to the host, None: nothing is written."""
    sizes, recorded = _world_sizes(config), _physics_kinds(config.trajectory, needs)
    slots = queue_slots(config, device)
    terms = [*_simulation(config.bake.worlds, sizes, recorded), _queue(slots, sizes), *_images(config, device, host)]
    if may_pick(config.bake, config.splits):
        terms.append(_perception(config.perception, config.bake.worlds, config.arrangement.max_objects, device))
    return terms


def free_memory(device: wp.Device | None) -> int:
    """Free memory of a GPU, or of the host for None and the CPU [bytes]."""
    return free_device_memory(device) if device is not None and device.is_cuda else free_host_memory()


def check_memory(config: Config, device: wp.Device, writers: int = 1, processes: int = 1) -> None:
    """Refuse a bake that certainly exceeds the memory of this machine, or the 32-bit indices of kernels.

    Args:
        config: All settings.
        device: Device of the simulation.
        writers: Writer processes of the device.
        processes: Processes, such as one per device, that share the host's memory.

    Raises:
        ConfigError: One line with the largest term, its size, what is available, and the setting to lower.
    """
    config = with_enough_worlds(config, device)
    terms = plan_memory(config, device, writers)
    shared = "this machine" if processes == 1 else f"each of {processes} processes"
    for on_device, place in ((True, device.alias), (False, shared)):
        part = [term for term in terms if term.on_device == on_device]
        needed = sum(term.size for term in part)
        free = free_memory(device) if on_device else free_memory(None) // processes
        if needed > free:
            largest = max(part, key=lambda term: term.size)
            raise ConfigError(
                f"a bake with these settings takes at least {_gib(needed)} of memory, {_gib(largest.size)} of them for {largest.name}, "
                f"but {place} has {_gib(free)} free; {_advice(largest, config)}"
            )
    for term in terms:
        for name, shape, _, size in term.rows:
            # Kernels count elements by int32. Warp keeps strides [bytes] as int32, too, and wraps larger ones without a word; that of the
            # first dimension is the largest, and not used if this has one element.
            stride = size // shape[0] if shape[0] > 1 else 0
            if term.indexed and max(math.prod(shape), stride) > INT32_MAX:
                extents = " x ".join(f"{extent:,}" for extent in shape)
                raise ConfigError(f"{name} would have {extents} elements, more than 32-bit indices reach; {_advice(term, config)}")


def check_episodes(count: int, planned: int) -> None:
    """Refuse more episodes than this machine can list, before they are listed.

    Args:
        count: Episodes of this bake, or of its shard.
        planned: `bake.episodes`.

    Raises:
        ConfigError: The lists alone exceed the free memory.
    """
    needed, free = count * EPISODE_BYTES, free_host_memory()
    if needed > free:
        raise ConfigError(
            f"the lists of {count:,} episodes take at least {_gib(needed)} of memory, but this machine has {_gib(free)} free; "
            f"lower bake.episodes ({planned}), or bake a part with --shard"
        )


def is_shortage(error: BaseException) -> bool:
    """Whether an error says that memory ran out: Python's own, that of Warp's allocators, or CUDA's error 2 (graphs, modules)."""
    return isinstance(error, MemoryError) or str(error).startswith("Failed to allocate") or "out of memory" in str(error).lower()


@contextlib.contextmanager
def explain_shortage(config: Config) -> Iterator[None]:
    """Replace an out-of-memory error of the enclosed code by one that names the setting to lower.

    Raises:
        ConfigError: Memory ran out.
    """
    try:
        yield
    except Exception as error:  # Warp raises plain exceptions, too.
        if isinstance(error, SynpickError) or not is_shortage(error):
            raise
        raise shortage_error(config, pick_device(config.bake.device)) from error


def shortage_error(config: Config, device: wp.Device) -> ConfigError:
    """Error for memory that ran out although the plan, a lower bound, had accepted the settings."""
    config = with_enough_worlds(config, device)
    largest = max(plan_memory(config, device), key=lambda term: term.size)
    return ConfigError(f"the bake ran out of memory; its largest part are {largest.name}, {_gib(largest.size)}; {_advice(largest, config)}")


def describe_memory(config: Config) -> list[Row]:
    """Memory table: rows (name, shape, unit, bytes) of the plan, one per copy; Newton's and the host's shares are estimates."""
    return [row for term in plan_memory(config, pick_device(config.bake.device)) for row in term.rows]


def describe_arrays(config: Config) -> list[Row]:
    """Memory table: rows (name, shape, unit, bytes) of every device array that a bake declares, one per copy.

    Newton's own arrays are not included. Body slots are counted at their maximum: the object capacity for each slot type.
    """
    device, needs = pick_device(config.bake.device), Needs.of(config)
    config = with_enough_worlds(config, device)
    return [row for term in _declared(config, needs, device, _host_images(config, needs, device)) for row in term.rows]


def _term(name: str, settings: tuple[str, ...], groups: list[tuple[Any, dict[str, int], int]]) -> Term:
    """Term of declarations: (declaration, extents of its dimensions, copies)."""
    return Term(name, tuple(row for kind, sizes, copies in groups for row in memory_table(kind, sizes) for _ in range(copies)), settings)


def _world_sizes(config: Config) -> dict[str, int]:
    """Extents of the dimensions of state and records."""
    objects = config.arrangement.max_objects
    worlds = world_sizes(config.bake.worlds, objects, config.move.rounds, build.GRIPPER_BODIES + 2 * objects)
    return record_sizes(worlds, config.physics.steps_per_tick)


def _physics_kinds(trajectory: Trajectory, needs: Needs) -> tuple[type, ...]:
    """Declarations of a tick's physics, if a format needs it."""
    return record_kinds(trajectory) if needs.physics else ()


def _simulation(worlds: int, sizes: dict[str, int], recorded: tuple[type, ...]) -> Iterator[Term]:
    """Yield the memory of the worlds: state, and records of ticks."""
    kinds = (WorldState, AttemptState, SealState, LastFrame, *_RECORD)
    yield _term(f"the state of {worlds:,} worlds", _WORLDS, [(kind, sizes, 1) for kind in kinds])
    if recorded:
        yield _term("the record of physics steps", _STEPS, [(kind, sizes, 1) for kind in recorded])


def queue_slots(config: Config, device: wp.Device) -> int:
    """Ticks in the queue between physics and renderer, as `TickLoop` chooses them."""
    kinds = (*_RECORD, *_physics_kinds(config.trajectory, Needs.of(config)))
    rows = (row for kind in kinds for row in memory_table(kind, _world_sizes(config)))
    return 1 + queue_lead(sum(row[3] for row in rows), device)


def _queue(slots: int, sizes: dict[str, int]) -> Term:
    """Snapshots of the queued ticks: arrays of all slots. Kernels index the part of a slot."""
    return Term(f"a queue of {slots:,} ticks", tuple(_ring_rows("queued", Snapshot, sizes, slots)), _WORLDS, indexed=False)


def _queued_reports(slots: int, sizes: dict[str, int], recorded: tuple[type, ...]) -> Term:
    """Memory of the reports of queued ticks, on the host."""
    rows = _ring_rows("reported", Snapshot, sizes, slots, REPORTED_SNAPSHOT)
    for kind in (WorldStatus, Observation, Plan, *recorded):
        rows += _ring_rows("reported", kind, sizes, slots)
    return Term(f"reports of {slots:,} ticks", tuple(rows), _STEPS if recorded else _WORLDS, on_device=False, indexed=False)


def _ring_rows(prefix: str, kind: type, sizes: dict[str, int], slots: int, only: Collection[str] | None = None) -> list[Row]:
    """Rows of arrays that hold those of all slots of a queue, as `allocate_slots` makes them; `only`: these fields, None: all."""
    rows = memory_table(kind, sizes | {"world": slots * sizes["world"]}, only)
    return [(f"{prefix} {name}", shape, unit, size) for name, shape, unit, size in rows]


def _images(config: Config, device: wp.Device, host: HostImages | None) -> Iterator[Term]:
    """Images of a batch of views, and scratch of the renderer; `host`: what is copied to the host, None: nothing is written."""
    room, ring = config.arrangement.max_objects, RING if device.is_cuda else 1
    width, height = config.cameras.resolution
    views = view_sizes(config, device) | body_sizes(room, width, height)
    name = f"images of {views['view']:,} views of {width:,}x{height:,} px"
    groups: list[tuple[Any, dict[str, int], int]] = [(ViewBuffers, views, ring)]
    if host is not None:
        boundaries = boundary_sizes(views)
        groups += [(BoundaryBuffers, boundaries, ring), (BoundaryScratch, boundaries, 1)]
    groups += [(kind, views, 1) for kind in (VIEW_BODIES, GBUFFER, SHADED_IMAGE)]
    groups += [(VISIBILITY_BUFFER, visibility_sizes(views["view"], width, height), 1), (BORDER_BOXES, border_sizes(views["view"], room), 1)]
    if MOTION_LAYERS.intersection(config.render.layers):
        groups += [(BODY_MOTIONS, views, 1)]
    if has_lens_filter(config.effects):
        groups += [(LensArrays, views, 1)]
    if config.render.mode != REFERENCE:
        histories = config.bake.worlds * len(config.cameras.positions)
        scratch = views | scratch_sizes(config.render, width, height, histories)
        groups += [(kind, scratch, copies) for kind, copies in DENOISED_SCRATCH]
        groups += [(MOVING_BODIES, views, 1)]
        groups += [(PATH_QUEUES, queue_sizes(config.render, width, height, views["view"], histories, device), 1)]
        sizes = history_sizes(config.render, width, height, histories)
        yield _term("light averaged over frames", _HISTORY, [(LIGHT_HISTORY, sizes, 1)])
    if host is not None and host.jpeg_quality:
        files = jpeg_sizes(views["view"], width, height)
        groups += [(JpegBuffers, files, ring), (JpegScratch, files, 1)]
    if host is not None and host.depth_files:
        data = depth_sizes(views["view"], width, height)
        groups += [(DepthBuffers, data, ring), *((kind, data, 1) for kind in DEPTH_SCRATCH)]
    term = _term(name, _VIEWS, groups)
    layers = memory_table(LayerBuffers, views, config.render.layers)
    yield Term(term.name, (*term.rows, *(ring * layers)), term.settings)
    cameras = len(config.cameras.positions)
    background = visibility_sizes(cameras, width, height)
    yield _term(f"backgrounds of {cameras:,} cameras of {width:,}x{height:,} px", _CAMERAS, [(GBUFFER, background, 1)])


def _perception(settings: Perception, worlds: int, room: int, device: wp.Device) -> Term:
    """Images, contours and votes of a batch of worlds that plan grasps, with `room` objects each."""
    count = count_views(settings, worlds, room, device)
    sizes = perception_sizes(settings, room, count)
    groups: list[tuple[Any, dict[str, int], int]] = [(kind, sizes, 1) for kind in SCRATCH] + [(GBUFFER, sizes | {"view": 1}, 1)]
    groups += [(kind, plan_sizes(settings, room, count), 1) for kind in (VoteArrays, CYCLES)]
    width, height = settings.resolution
    return _term(f"perception of {count:,} worlds at {width:,}x{height:,} px", _PERCEPTION, groups)


def _newton(physics: Physics, worlds: int, device: wp.Device) -> Iterator[Term]:
    """Contacts, pairs and constraint rows of Newton's collision pipeline and solver."""
    for name, setting, cpu, gpu in _NEWTON:
        capacity = getattr(physics, setting)
        size = worlds * capacity * (gpu if device.is_cuda else cpu)
        yield Term(name, ((name, (worlds * capacity,), "", size),), (f"physics.{setting}", "bake.worlds"), device.is_cuda)


def _pinned(views: dict[str, int], layers: tuple[str, ...], resolution: tuple[int, int], host: HostImages) -> Term:
    """Pinned copies of a GPU's images on the host, of `view_sizes`."""
    copied = [item.name for item in fields(ViewBuffers) if item.name not in host.on_demand]
    groups = memory_table(ViewBuffers, views, copied)
    groups += memory_table(LayerBuffers, views, layers)
    if host.jpeg_quality:
        groups += memory_table(JpegBuffers, jpeg_sizes(views["view"], *resolution))
    if host.depth_files:
        groups += memory_table(DepthBuffers, depth_sizes(views["view"], *resolution))
    rows = tuple((f"pinned {name}", shape, unit, size) for name, shape, unit, size in RING * groups)
    return Term(f"pinned copies of {views['view']:,} views", rows, _VIEWS, False)


def _host_images(config: Config, needs: Needs, device: wp.Device) -> HostImages:
    """Which images and files a bake copies to the host."""
    return host_images(config.bop, config.cameras.resolution[1], device, needs.images, needs.depth_files)


def _advice(term: Term, config: Config) -> str:
    """Advice to lower the setting that exceeds its default by the largest factor, with its value."""
    default = Config()
    key = max(term.settings, key=lambda name: _amount(config.value(name)) / max(1, _amount(default.value(name))))
    value = config.value(key)
    return f"lower {key} ({format_value(value) if not _is_list(value) else f'{len(value):,} cameras'})"


def _amount(value: Any) -> int:
    """Size of a setting by its value: pixels of a resolution, count of cameras, the number itself."""
    return len(value) if _is_list(value) else math.prod(value) if isinstance(value, tuple) else value


def _is_list(value: object) -> bool:
    """Whether a value is a list of vectors, as the positions of cameras."""
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], tuple)


def _gib(size: int) -> str:
    """Size in GiB, with commas and one decimal place; whole numbers, since sizes may exceed a float's range."""
    tenths = -(-size * 10 // 1024**3) if size else 0
    return f"{tenths // 10:,}.{tenths % 10} GiB"
