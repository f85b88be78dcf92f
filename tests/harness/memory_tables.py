"""Memory tables: what a plan says of a bake's own arrays."""

import warp as wp

from synpick_warp.configs.schema import Config
from synpick_warp.factory.memory_plan import plan_memory
from synpick_warp.stages.arrays import Row
from synpick_warp.system.hardware.device import pick_device

_OTHERS = ("Newton's", "reported", "pinned", "shared memory")
"""First words of rows of Newton's arrays, and of the host's copies."""


def device_arrays(config: Config) -> list[Row]:
    """Rows of every array that a bake declares on its device, one per copy."""
    return [row for term in plan_memory(config, pick_device(config.bake.device)) for row in term.rows if not row[0].startswith(_OTHERS)]


def queued_ticks(config: Config, device: wp.Device | None = None) -> int:
    """Ticks in the queue between physics and renderer."""
    terms = plan_memory(config, device or pick_device(config.bake.device))
    return next(int(term.name.split()[3].replace(",", "")) for term in terms if term.name.startswith("a queue of"))
