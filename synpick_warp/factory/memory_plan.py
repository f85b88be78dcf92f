"""Memory budget of a bake: the size of every allocation, worked out in whole numbers before anything is loaded, against what is free.

The plan is a lower bound: what it refuses cannot run on this machine, what it accepts may still run out. Counted are all arrays that a
bake declares, Newton's by measured factors, the pinned copies of images, shared memory of writers, and the lists of episodes.

Automatic sizes (0) are chosen to fit; outputs do not depend on them. Worlds follow from the number of episodes. While plan and headroom
exceed the free memory, first the pictures of fewer worlds are kept over frames, then the automatic size behind the largest part shrinks:
`bake.worlds` by a quarter, others by half.
"""

import contextlib
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import warp as wp

from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.cell.cameras import COLOR
from synpick_warp.configs.dataset import DataLayout, may_pick
from synpick_warp.configs.episodes.manipulation import PICKS
from synpick_warp.configs.episodes.objects import most_objects
from synpick_warp.configs.episodes.randomize import OFF, Randomize
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.schema import Arrangement, Config, Perception, Physics
from synpick_warp.errors import ConfigError, SynpickError, format_value
from synpick_warp.exporters.registry import Needs
from synpick_warp.factory.picks import count_batch, count_rows
from synpick_warp.newton_patches.history import CONTACT_BYTES
from synpick_warp.scenes import build
from synpick_warp.scenes.bins import GUIDES, make_bins
from synpick_warp.scenes.build import FREE_DOFS
from synpick_warp.scenes.capacities import FEW
from synpick_warp.scenes.grippers import make_head
from synpick_warp.scenes.props import make_props
from synpick_warp.stages.arrays import DryArray, Row, dry_run
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.online.batches import allocate_slot
from synpick_warp.stages.perception.images import allocate_batch, count_views
from synpick_warp.stages.perception.perceive import allocate_votes
from synpick_warp.stages.render.cameras import allocate_lenses
from synpick_warp.stages.render.looks import allocate_materials, materials_of_view
from synpick_warp.stages.render.raster import allocate_background, allocate_visibility
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import blank_scene
from synpick_warp.stages.render.view_setup import allocate_placed
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS, with_enough_worlds
from synpick_warp.stages.sim.simulate import allocate_worlds
from synpick_warp.stages.sim.step_log import allocate_record, record_sizes
from synpick_warp.stages.sim.trials import count_trial_worlds
from synpick_warp.stages.sim.worlds import world_sizes
from synpick_warp.stages.stream import TickReader
from synpick_warp.stages.ticks import allocate_rings, queue_lead, record_bytes
from synpick_warp.stages.view_ring import (
    RING,
    TransferSettings,
    allocate_ring,
    choose_transfers,
    history_count,
    view_sizes,
    views_per_batch,
)
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.device import ALL, pick_device, pick_devices
from synpick_warp.system.hardware.free_memory import free_device_memory, free_host_memory

KEPT_PICTURES = "pictures kept over frames"
"""Name of the term of `render.reuse`."""
EPISODE_BYTES = 100
"""Lists and sets of episode indices of a bake at their peak, for each episode [bytes]: tracemalloc has 115 for two million."""
ROW_BYTES = 12
"""A constraint row in a saved state: impulse, type and parent [bytes]."""
_VIEWS = ("cameras.resolution", "render.views_per_batch", "cameras.positions", "arrangement.max_objects")
_CAMERAS = ("cameras.resolution", "cameras.positions")
_HISTORY = ("bake.worlds", "cameras.resolution", "render.history", "cameras.positions")
_WORLDS = ("bake.worlds", "arrangement.max_objects", "move.rounds")
_STEPS = ("bake.worlds", "physics.steps_per_tick", "arrangement.max_objects")
_PERCEPTION = ("perception.resolution", "perception.contour_points", "perception.views", "bake.worlds")


@dataclass(frozen=True)
class Term:
    """Part of a bake's memory plan: arrays that grow with the same settings, on the device or the host."""

    name: str
    rows: tuple[Row, ...]
    """One row for each copy."""
    settings: tuple[str, ...]
    """Full keys of the settings by which it grows ..."""
    values: tuple[Any, ...] = ()
    """... and their values."""
    on_device: bool = True
    """Whether it lies in the device's memory; always False on the CPU, whose memory is the host's."""
    indexed: bool = True
    """Whether kernels index the arrays by 32-bit integers."""

    @property
    def size(self) -> int:
        """Size of all rows [bytes]."""
        return sum(row[3] for row in self.rows)


def plan_memory(config: Config, device: wp.Device, writers: int = 1, pieces: int = 1, transparent: bool = False) -> list[Term]:
    """Work out what a bake takes on a device by a dry run of its stages: nothing is allocated. On a GPU the plan is for
    `with_enough_worlds`.

    Body slots are counted at their maximum: the object capacity for each slot type. Without `writers` (0) views stay on the device;
    `pieces` are the convex pieces of each object, as far as they are known, and `transparent` says whether some are."""
    config, needs = with_enough_worlds(config, device), Needs.of(config)
    worlds, objects, rig = config.bake.worlds, config.arrangement.max_objects, config.rig
    bodies = build.GRIPPER_BODIES + 2 * objects
    sizes = record_sizes(
        world_sizes(worlds, objects, config.move.rounds, bodies, len(make_head(config.gripper).cups)), config.physics.steps_per_tick
    )
    terms = [*_simulation(sizes, config.trajectory.steps if needs.physics else None, config.bop.graph, device)]
    for index, group in enumerate(rig.groups):
        count, views = len(group), view_sizes(config.render, rig, worlds, objects, device, index)
        size, layers = rig.sizes[group[0]], rig.chosen(group[0], config.render.layers)
        sections = replace(config.render, layers=layers), config.effects, config.depth_sensor
        with dry_run() as arrays:
            glass = transparent or config.randomize.object_transmission.kind != OFF or None
            scene = blank_scene(count, *size, device, glass, len(config.prop))
            counts = {"instances": objects, "views": views["view"], "histories": history_count(rig, worlds, index)}
            colors, shutter = rig.writes(group[0], COLOR), rig.shutter(group[0])
            Renderer(scene, *sections, seed=0, depth_scale=1.0, colors=colors, shutter=shutter, **counts)
            if config.randomize != Randomize() or transparent:
                allocate_materials(views["view"] * materials_of_view(objects + len(config.prop)), 1, device)
            allocate_placed(worlds, objects, len(config.prop), device)
            if rig.draws_lens(group[0]):
                _ = [allocate_lenses(views, device) for _ in range(RING if device.is_cuda else 1)]
        host = choose_transfers(config.bop, size[1], device, needs.images, needs.depth_files) if writers else None
        terms += _images(arrays, views, count, layers, host, device)
    if may_pick(config.bake, config.splits):
        terms.append(_perception(config.perception, worlds, objects, device, len(config.prop)))
    solid = sum(len(prop.pieces) for prop in make_props(config.prop, config.cell.bins))
    built = (config.arrangement, config.physics, config.cell.bins, bool(config.bin), device.is_cuda, pieces, solid)
    terms += [Term(row[0], (row,), keys) for row, keys in newton_rows(worlds, *built)]
    if PICKS in config.bake.formats:
        planned = DataLayout.of(config).planned
        trying = count_trial_worlds(config.picks, planned, device)
        batch = count_batch(config.picks, planned, trying)
        terms += _trials(sizes | {"world": trying, "body": trying * bodies}, count_rows(batch, worlds), config.physics, device)
        terms.append(_perception(config.perception, trying, objects, device, len(config.prop)))
        terms += [Term(f"{row[0]} of trials", (row,), ("picks.worlds", *keys)) for row, keys in newton_rows(trying, *built)]
    if writers:
        # A writer is counted with one slot of shared memory: those of its queue get memory only once they are used.
        row = ("shared memory of writers", (writers, needs.slot_bytes), "", writers * needs.slot_bytes)
        terms.append(Term(f"images in {writers:,} writers", (row,), ("cameras.resolution", "bake.writers"), on_device=False, indexed=False))
    return [replace(term, values=tuple(map(config.value, term.settings)), on_device=term.on_device and device.is_cuda) for term in terms]


def free_memory(device: wp.Device | None) -> int:
    """Free memory of a GPU, or of the host for None and the CPU [bytes]."""
    return free_device_memory(device) if device is not None and device.is_cuda else free_host_memory()


def split_memories(terms: Sequence[Term], device: wp.Device, processes: int) -> Iterator[tuple[list[Term], int]]:
    """Terms of a plan that lie in the device's memory, and in the host's, each with the memory free for them [bytes]; none without terms.

    `processes`: processes, such as one per device, that share the host's memory.
    """
    for on_device in (True, False):
        if part := [term for term in terms if term.on_device == on_device]:
            yield part, free_memory(device) if on_device else free_memory(None) // processes


def check_memory(terms: Sequence[Term], device: wp.Device, processes: int = 1) -> None:
    """Refuse a bake that certainly exceeds the memory of this machine, or the 32-bit indices of kernels: raises ConfigError in one line
    with the largest term, its size, what is available, and the setting to lower. `processes`: as of `split_memories`."""
    shared = "this machine" if processes == 1 else f"each of {processes} processes"
    for part, free in split_memories(terms, device, processes):
        needed, largest = sum(term.size for term in part), max(part, key=lambda term: term.size)
        if needed > free:
            place = device.alias if largest.on_device else shared
            raise ConfigError(
                f"a bake with these settings takes at least {_gib(needed)} of memory, {_gib(largest.size)} of them for {largest.name}, "
                f"but {place} has {_gib(free)} free; {_advice(largest)}"
            )
    for term in terms:
        for name, shape, _, size in term.rows:
            # Kernels count elements by int32. Warp keeps strides [bytes] as int32, too, and wraps larger ones without a word; that of the
            # first dimension is the largest, and not used if this has one element.
            stride = size // shape[0] if shape[0] > 1 else 0
            if term.indexed and max(math.prod(shape), stride) > INT32_MAX:
                extents = " x ".join(f"{extent:,}" for extent in shape)
                raise ConfigError(f"{name} would have {extents} elements, more than 32-bit indices reach; {_advice(term)}")


def check_episodes(count: int, planned: int) -> None:
    """Raise ConfigError for more episodes than this machine can list, before they are listed: `count` are those of this bake, or of its
    shard, and `planned` is `bake.episodes`."""
    needed, free = count * EPISODE_BYTES, free_host_memory()
    if needed > free:
        raise ConfigError(
            f"the lists of {count:,} episodes take at least {_gib(needed)} of memory, but this machine has {_gib(free)} free; "
            f"lower bake.episodes ({planned}), or bake a part with --shard"
        )


@contextlib.contextmanager
def explain_shortage(config: Config) -> Iterator[None]:
    """Replace an out-of-memory error of the enclosed code by a ConfigError that names the setting to lower."""
    try:
        yield
    except Exception as error:
        # Python's own error, that of Warp's allocators, and CUDA's error 2 (graphs, modules); Warp raises plain exceptions, too.
        is_shortage = isinstance(error, MemoryError) or str(error).startswith("Failed to allocate") or "out of memory" in str(error).lower()
        if isinstance(error, SynpickError) or not is_shortage:
            raise
        largest = max(plan_memory(config, pick_device(config.bake.device)), key=lambda term: term.size)
        raise ConfigError(
            f"the bake ran out of memory; its largest part are {largest.name}, {_gib(largest.size)}; {_advice(largest)}"
        ) from error


def _term(
    name: str, arrays: Iterable[DryArray], settings: tuple[str, ...], prefix: str = "", on_device: bool = True, indexed: bool = True
) -> Term:
    """Term of the arrays of a dry run; `prefix`: of their names."""
    rows = tuple((prefix + name, shape, unit, size) for name, shape, unit, size in (array.row for array in arrays))
    return Term(name, rows, settings, on_device=on_device, indexed=indexed)


def _simulation(sizes: dict[str, int], stores_steps: bool | None, supports: bool, device: wp.Device) -> Iterator[Term]:
    """State and record of the worlds (extents: `record_sizes`), and the queue of ticks as `TickLoop` sizes it. `stores_steps`: True records
    each physics step, False each tick, None neither."""
    with dry_run() as state:
        *_, record = allocate_worlds(sizes, device)
    yield _term(f"the state of {sizes['world']:,} worlds", state, _WORLDS)
    if stores_steps is not None or supports:
        with dry_run() as steps:
            record = replace(record, physics=allocate_record(sizes, device, steps=bool(stores_steps), supports=supports))
        yield _term("the record of physics steps", steps, _STEPS)
    slots = 1 + queue_lead(record_bytes(record), device)
    with dry_run() as queued:
        allocate_rings([getattr(record.snapshot, item.name) for item in fields(Snapshot)], slots, device)
    # Kernels index the part of a slot.
    yield _term(f"a queue of {slots:,} ticks", queued, _WORLDS, "queued ", indexed=False)
    with dry_run() as reported:
        allocate_rings(TickReader.reported(record), slots, device)
    settings = _WORLDS if stores_steps is None else _STEPS
    yield _term(f"reports of {slots:,} ticks", reported, settings, "reported ", on_device=False, indexed=False)


def _trials(sizes: dict[str, int], rows: int, physics: Physics, device: wp.Device) -> Iterator[Term]:
    """State of the worlds of grasp trials, whose extents by `record_sizes` are `sizes`, and a ring of saved states with `rows` rows."""
    with dry_run() as state:
        allocate_worlds(sizes, device)
    settings = ("picks.worlds", "arrangement.max_objects")
    yield _term(f"the state of {sizes['world']:,} worlds of grasp trials", state, settings, "trial ")
    each = sum(array.row[3] for array in state) // sizes["world"]
    each += physics.contacts_per_world * CONTACT_BYTES + ROW_BYTES * (physics.rows_per_world + physics.gripper_rows_per_world)
    row = ("saved states", (rows, each), "", rows * each)
    yield Term(f"{rows:,} saved states", (row,), ("bake.worlds", "picks.worlds"), indexed=False)


def _images(
    arrays: list[DryArray], sizes: dict[str, int], cameras: int, layers: tuple[str, ...], host: TransferSettings | None, device: wp.Device
) -> Iterator[Term]:
    """Scratch of the renderer and images of a batch of views, by `view_sizes`; `host`: what is copied to the host, None: nothing."""
    views, size = sizes["view"], f"{sizes['column']:,}x{sizes['row']:,} px"
    copied: list[Any] = []
    with dry_run() as images:
        if host is None:
            for _ in range(RING if device.is_cuda else 1):
                allocate_slot(sizes, layers, device)
        else:
            ring, _ = allocate_ring(sizes, layers, host, device)
            copied = [array for batch in ring for array in batch.copied(host.on_demand).values()]
    over_frames = ("world_camera", "kept", "camera")
    history, kept, background = ([array for array in arrays if name in array.spec.shape] for name in over_frames)
    others = [array for array in arrays if not set(over_frames).intersection(array.spec.shape)]
    if history:
        yield _term("light averaged over frames", history, _HISTORY)
    # Kernels index these by image, row and column.
    yield _term(KEPT_PICTURES, kept, _HISTORY, indexed=False)
    yield _term(f"images of {views:,} views of {size}", others + images, _VIEWS)
    yield _term(f"backgrounds of {cameras:,} cameras of {size}", background, _CAMERAS)
    if copied and device.is_cuda:
        yield _term(f"pinned copies of {views:,} views", copied, _VIEWS, "pinned ", on_device=False)


def _perception(settings: Perception, worlds: int, objects: int, device: wp.Device, props: int) -> Term:
    """Images, contours and votes of a batch of worlds that plan grasps, with at most `objects` objects, and `props`, each."""
    count = count_views(settings, worlds, objects, device)
    width, height = settings.resolution
    with dry_run() as arrays:
        allocate_batch(settings, objects, count, device, props)
        allocate_placed(worlds, objects, props, device)
        allocate_visibility(count, width, height, objects, device)
        allocate_background(1, width, height, device)
        allocate_votes(settings, objects, count, device)
    return _term(f"perception of {count:,} worlds at {width:,}x{height:,} px", arrays, _PERCEPTION)


def _advice(term: Term) -> str:
    """Advice to lower the setting that exceeds its default by the largest factor, with its value."""
    default = Config()
    pairs = zip(term.settings, term.values, strict=True)
    key, value = max(pairs, key=lambda pair: _amount(pair[1]) / max(1, _amount(default.value(pair[0]))))
    return f"lower {key} ({format_value(value) if not _is_list(value) else f'{len(value):,} cameras'})"


def _amount(value: Any) -> int:
    """Size of a setting by its value: pixels of a resolution, count of cameras, the number itself."""
    return len(value) if _is_list(value) else math.prod(value) if isinstance(value, tuple) else value


def _is_list(value: object) -> bool:
    """Whether a value is a list of vectors, as the positions of cameras."""
    return isinstance(value, tuple) and bool(value) and isinstance(value[0], tuple)


def _gib(size: int) -> str:
    """Size in GiB with one decimal place, rounded up; integer arithmetic, as sizes may exceed a float's range."""
    tenths = -(-size * 10 // 1024**3) if size else 0
    return f"{tenths // 10:,}.{tenths % 10} GiB"


# Allocations for each item of a world's capacities [bytes]: name, setting, size on a CPU, on a GPU, and there at least. Measured on a CPU
# from the growth of all allocations of model, collision pipeline and solver: 928, 24, 180 and, with the options of a GPU, 952, 24, 156. On
# a GPU rows have further arrays (solve mode "colored"): by Newton's source 109 for its graph coloring, and 128 for our packed row.
# Contacts and pairs have at least those of `newton.Contacts` and their sorter.
_CAPACITIES = (
    ("Newton's contacts", "contacts_per_world", 900, 900, 250),
    ("Newton's shape pairs", "pairs_per_world", 24, 24, 16),
    ("Newton's contact rows", "rows_per_world", 160, 397, 397),
    ("Newton's gripper rows", "gripper_rows_per_world", 48, 40, 40),
)
_ROW_DOF = 16
"""Memory of a gripper's row for each degree of freedom of its world: Jacobian and response, for all of them and by body [bytes]."""
_BODY, _SHAPE = (3200, 5700), 680
"""Memory of a body slot, on a CPU and on a GPU, and of each of its shapes, measured as above [bytes]."""


def newton_rows(
    worlds: int,
    arrangement: Arrangement,
    physics: Physics,
    bins: Sequence[BinSizes],
    own_bins: bool,
    is_cuda: bool,
    pieces: int = 1,
    solid: int = 0,
) -> Iterator[tuple[Row, tuple[str, ...]]]:
    """Rows of Newton's arrays, each with the full keys of the settings by which it grows.

    With `arrangement.counts` the number of bodies is known, and rows are within 10 % of what is allocated; with a fill volume it is not,
    and they are lower bounds. `own_bins`: whether bins are the user's own, which have shapes of their own; `is_cuda`: whether the arrays
    lie in a GPU's memory; `pieces`: as of `plan_memory`; `solid`: collision shapes of props."""
    bodies = most_objects(arrangement.counts)
    # The capacities of many objects follow from their number.
    many = ("bake.worlds", "arrangement.max_objects") if arrangement.max_objects > FEW else ()
    for name, setting, cpu, gpu, least in _CAPACITIES:
        count, each = getattr(physics, setting), (gpu if bodies else least) if is_cuda else cpu
        if name == "Newton's gripper rows":
            each += _ROW_DOF * FREE_DOFS * bodies
        yield (name, (worlds * count,), "", worlds * count * each), many or (f"physics.{setting}", "bake.worlds")
    if bodies:
        size = worlds * bodies * (_BODY[is_cuda] + _SHAPE * pieces)
        yield ("Newton's bodies", (worlds * bodies,), "", size), ("bake.worlds", "arrangement.max_objects")
    if own_bins or bodies or solid:
        # A separating axis for each pair of a world's shapes, of all bins with their guide walls, and at least one for each object.
        objects = pieces * bodies or arrangement.max_objects
        shapes = sum(len(one.pieces) + GUIDES for one in make_bins(bins)) + objects + solid
        row = ("separating axes", (worlds, shapes * (shapes - 1) // 2), "", worlds * 2 * shapes * (shapes - 1))
        yield row, many or ("bake.worlds",)


HEADROOM = 1.5
"""Safety factor on the memory plan, which is a lower bound, but on kept pictures, whose arrays are all of it. Bakes on a CPU take 0.6 to
0.7 GiB beyond it."""
RUNTIME_BYTES = 1 << 30
"""Room for what no plan counts: CUDA's context and kernels; a process's libraries and objects, 0.7 GiB [bytes]."""
_OPEN_SIZES = ("render.views_per_batch", "perception.views", "picks.worlds", "bake.worlds")
"""Settings of sizes that are chosen automatically if they are 0. (So is `bake.writers`, see `count_writers`.)"""


def without_pictures(config: Config) -> Config:
    """Settings for a bake whose formats need no views: image buffers of one view a batch, no light histories; others are unchanged."""
    if Needs.of(config).views:
        return config
    return config.with_values({"render.views_per_batch": 1, "render.history": 0})


def fit_to_device(config: Config, device: wp.Device, episodes: int, writers: int = 1, processes: int = 1) -> Config:
    """Choose worlds and batches that the settings leave open, for a device that simulates `episodes` and has `writers`; `processes` share
    the host's memory. What settings name stays, whether it fits or not, but for kept pictures."""
    is_open = {key: config.value(key) == 0 for key in _OPEN_SIZES}
    config = with_enough_worlds(config, device, episodes)
    while short := _short_memory(split_memories(plan_memory(config, device, writers), device, processes)):
        terms, free = short
        if kept := sum(term.size for term in terms if term.name == KEPT_PICTURES):
            config = _keep_less(config, kept, with_headroom(terms) - free, device)
            continue
        worlds, objects = config.bake.worlds, config.arrangement.max_objects
        amounts = {
            "render.views_per_batch": max(
                views_per_batch(config.render, config.rig, worlds, objects, device, group) for group in range(len(config.rig.groups))
            ),
            "perception.views": count_views(config.perception, worlds, objects, device),
            "picks.worlds": count_trial_worlds(config.picks, DataLayout.of(config).planned, device),
            "bake.worlds": worlds,
        }
        lowered = [key for key in _OPEN_SIZES if is_open[key] and amounts[key] > _least(key, device)]
        for term in sorted(terms, key=lambda term: -term.size):
            key = next((key for key in lowered if key in term.settings), "")
            if key:
                config = config.with_values({key: _reduce(key, amounts[key], device)})
                break
        else:
            return config
    return config


def pick_processes(config: Config, names: Sequence[str], episodes: int) -> tuple[str, ...]:
    """Devices of a bake's processes: those named, by `pick_devices`, whose errors are raised, but no more than there are episodes.

    For `ALL` without a GPU the CPU is repeated: once per usable core, since a process simulates on one, as far as the host's free memory
    has room for each process with the fewest worlds and the smallest batches."""
    picked = pick_devices(names)
    if list(names) == [ALL] and picked == ("cpu",):
        least = config.with_values({key: 1 for key in _OPEN_SIZES if not config.value(key)})
        room = free_memory(None) // with_headroom(plan_memory(without_pictures(least), pick_device("cpu")))
        picked *= max(1, min(count_cores(), room))
    return picked[: max(1, episodes)]


def advise_processes(config: Config, names: Sequence[str], episodes: int) -> str:
    """Hint to pass `--devices all`, for a bake on a CPU with one process where memory and cores allow several; otherwise empty.

    Arguments as in `pick_processes`.
    """
    if len(names) > 1 or pick_device(names[0]).is_cuda or pick_devices([ALL]) != ("cpu",):
        return ""
    processes = len(pick_processes(config, [ALL], episodes))
    return f"one process simulates on one CPU core; --devices all starts {processes}, which write the same bytes" if processes > 1 else ""


def _short_memory(memories: Iterable[tuple[list[Term], int]]) -> tuple[list[Term], int] | None:
    """Terms and free size of the first memory of `split_memories` that `with_headroom` exceeds; None: everything fits."""
    return next(((terms, free) for terms, free in memories if with_headroom(terms) > free), None)


def _keep_less(config: Config, kept: int, excess: int, device: wp.Device) -> Config:
    """Settings that free `excess` bytes by keeping the pictures (unchanged tiles, `render.reuse`) of fewer worlds, or of none. `kept`
    [bytes]: all kept pictures now; with only part of the worlds kept, a batch of views also needs scratch rows."""
    rig, worlds, objects, is_partial = config.rig, config.bake.worlds, config.arrangement.max_objects, config.render.reuse_worlds > 0
    batches = (views_per_batch(config.render, rig, worlds, objects, device, group) for group in range(len(rig.groups)))
    scratch = max(-(-views // len(group)) for views, group in zip(batches, rig.groups, strict=True))
    count = min(config.render.reuse_worlds or worlds, worlds)
    left = count - -(-(count + scratch * is_partial) * excess // kept) - scratch * (not is_partial)
    return config.with_values({"render.reuse_worlds": left} if left > 0 else {"render.reuse": False})


def with_headroom(terms: Sequence[Term]) -> int:
    """Memory to reserve for terms [bytes]: sizes times HEADROOM (kept pictures: as they are), plus RUNTIME_BYTES."""
    factors = (1.0 if term.name == KEPT_PICTURES else HEADROOM for term in terms)
    return sum(int(factor * term.size) for factor, term in zip(factors, terms, strict=True)) + RUNTIME_BYTES


def _least(key: str, device: wp.Device) -> int:
    """Least value that automatic sizing chooses for a setting."""
    return MIN_GPU_WORLDS if key in ("bake.worlds", "picks.worlds") and device.is_cuda else 1


def _reduce(key: str, amount: int, device: wp.Device) -> int:
    """Next smaller value of an automatic size: three quarters for bake.worlds, half for all others, never below `_least`."""
    kept = amount - max(1, amount // 4) if key == "bake.worlds" else -(-amount // 2)
    return max(_least(key, device), kept)
