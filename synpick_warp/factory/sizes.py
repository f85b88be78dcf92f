"""Sizes of a bake that its settings leave open (0): worlds and batches of a device, and writer processes, from what the machine has free.

No output depends on them. Worlds follow from the number of episodes; where memory is short, pictures are no longer kept over frames, then
batches are halved, and worlds reduced by a quarter, until the memory plan and its headroom fit.
"""

from collections.abc import Iterable, Sequence

import warp as wp

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.registry import Needs
from synpick_warp.exporters.writing.pool import QUEUE_DEPTH
from synpick_warp.factory.memory_plan import KEPT_PICTURES, Term, free_memory, plan_memory, split_memories
from synpick_warp.stages.perception.images import count_views
from synpick_warp.stages.sim.physics import MIN_GPU_WORLDS, with_enough_worlds
from synpick_warp.stages.sim.trials import count_trial_worlds
from synpick_warp.stages.view_ring import views_per_batch
from synpick_warp.system.hardware.cores import count_cores
from synpick_warp.system.hardware.device import ALL, pick_device, pick_devices

HEADROOM = 1.5
"""Safety factor on the memory plan, which is a lower bound. Bakes on a CPU take 0.6 to 0.7 GiB beyond it."""
RUNTIME_BYTES = 1 << 30
"""Room for what no plan counts: CUDA's context and kernels; a process's libraries and objects, 0.7 GiB [bytes]."""
WRITER_BYTES = 100 << 20
"""Memory reserved for a writer process besides its image slots [bytes]. Measured are 50 MB, with its part of shared libraries, at full HD
with bop and shards; the rest is headroom for formats with larger libraries."""
WRITERS_FRACTION = 0.5
"""Fraction of the free host memory that writer processes may take if their number is chosen."""
_OPEN_SIZES = ("render.views_per_batch", "perception.views", "picks.worlds", "bake.worlds")
"""Settings of sizes that are chosen automatically if they are 0. (So is `bake.writers`, see `count_writers`.)"""


def without_pictures(config: Config) -> Config:
    """Settings for a bake whose formats need no views: image buffers of one view a batch, no light histories; others are unchanged."""
    if Needs.of(config).views:
        return config
    return config.with_values({"render.views_per_batch": 1, "render.history": 0})


def fit_to_device(config: Config, device: wp.Device, episodes: int, writers: int = 1, processes: int = 1) -> Config:
    """Choose worlds and batches that the settings leave open, for a device that simulates `episodes` and has `writers`; `processes` share
    the host's memory. What settings name stays, whether it fits or not."""
    is_open = {key: config.value(key) == 0 for key in _OPEN_SIZES}
    config = with_enough_worlds(config, device, episodes)
    while terms := _short_terms(split_memories(plan_memory(config, device, writers), device, processes)):
        if any(term.name == KEPT_PICTURES and term.size for term in terms):
            config = config.with_values({"render.reuse": False})
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


def count_writers(writers: int, slot_bytes: int) -> int:
    """Writer processes of a bake: `bake.writers`, or if it is 0, one per usable CPU core, as far as the host's free memory has room for
    them and their slots of `slot_bytes` (see `Needs`)."""
    if writers:
        return writers
    each = WRITER_BYTES + QUEUE_DEPTH * slot_bytes
    room = int(WRITERS_FRACTION * free_memory(None)) // each
    return max(1, min(count_cores(), room))


def pick_processes(config: Config, names: Sequence[str], episodes: int) -> tuple[str, ...]:
    """Devices of a bake's processes: those named, by `pick_devices`, whose errors are raised, but no more than there are episodes.

    For `ALL` without a GPU the CPU is repeated: once per usable core, since a process simulates on one, as far as the host's free memory
    has room for each process with the fewest worlds and the smallest batches."""
    picked = pick_devices(names)
    if list(names) == [ALL] and picked == ("cpu",):
        least = config.with_values({key: 1 for key in _OPEN_SIZES if not config.value(key)})
        room = free_memory(None) // _planned(plan_memory(without_pictures(least), pick_device("cpu")))
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


def _short_terms(memories: Iterable[tuple[list[Term], int]]) -> Sequence[Term]:
    """Terms in the first memory that is too small for them with HEADROOM, of those by `split_memories`; empty: all fit."""
    return next((terms for terms, free in memories if _planned(terms) > free), ())


def _planned(terms: Sequence[Term]) -> int:
    """Memory that terms of a plan take with HEADROOM [bytes]."""
    return int(HEADROOM * sum(term.size for term in terms)) + RUNTIME_BYTES


def _least(key: str, device: wp.Device) -> int:
    """Least value that automatic sizing chooses for a setting."""
    return MIN_GPU_WORLDS if key in ("bake.worlds", "picks.worlds") and device.is_cuda else 1


def _reduce(key: str, amount: int, device: wp.Device) -> int:
    """Smaller value of a setting: a half of the views of a batch, three quarters of the worlds, never below `_least`."""
    kept = amount - max(1, amount // 4) if key == "bake.worlds" else -(-amount // 2)
    return max(_least(key, device), kept)
