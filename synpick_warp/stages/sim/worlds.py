"""Simulation state: device arrays of all worlds, one row a world, which persist between ticks."""

from dataclasses import dataclass

import warp as wp

from synpick_warp.codes import Measure, Status
from synpick_warp.kernels.state import Attempts, Seals, Worlds
from synpick_warp.stages.arrays import array_group, count_words, device_array
from synpick_warp.stages.buffers import FIXTURES

# Waypoints of a round of moving: the corners of a compartment.
CORNERS = 4


_INSTANCES = dict.fromkeys(("catalog_index", "body_slot", "stuck", "previous_pose", "displacement"), ("world", "instance"))
_OTHERS = {"next_episode": ("one",), "penetration": ("body",), "variant": ("body",), "restarted": ("world_and_global",)}
_METRES = dict.fromkeys(("bin_pose", "previous_pose", "displacement", "penetration", "setpoint"), "m")
_UNITS = _METRES | {"stuck": "ticks", "light_yaw": "rad", "light_exposure": "EV"}


class WorldState(array_group(Worlds, "world", units=_UNITS, corner_order=("world", "waypoint"), **_INSTANCES, **_OTHERS)):
    """State of each world."""


_WORDS = dict.fromkeys(("engaged_words", "attached_words"), ("world", "word"))
_INSTANCES = dict.fromkeys(("target_failures", "removed"), ("world", "instance"))


class AttemptState(array_group(Attempts, "world", units={"steps": "steps"}, **_WORDS, **_INSTANCES)):
    """Attempt to pick of each world."""


_CUPS = dict.fromkeys(("cup_force", "break_force"), ("world", "cup"))
_UNITS = dict.fromkeys(("seal_force", "cup_force", "break_force", "peak"), "N") | {"object_in_tcp": "m"}


class SealState(array_group(Seals, "world", "instance", units=_UNITS, peak=("world",), **_CUPS)):
    """Seals of each world's cups."""


@dataclass(frozen=True, eq=False)
class WorldStatus:
    """Status rows of the worlds, integers (`Status`) and real numbers (`Measure`), and sets of instances, as read after each tick."""

    table: wp.array = device_array("world", "status", dtype=wp.int32)
    """Columns: `Status`."""
    measures: wp.array = device_array("world", "measure", dtype=wp.float32)
    """Columns: `Measure`."""
    engaged: wp.array = device_array("world", "word", dtype=wp.uint32)
    """Bit set of the instances that rays hit in the attempt to which the row belongs."""
    attached: wp.array = device_array("world", "word", dtype=wp.uint32)
    """Bit set of the instances that are attached to the gripper, or were picked in this tick."""


def world_sizes(worlds: int, objects: int, rounds: int, bodies_per_world: int, cups: int) -> dict[str, int]:
    """Extents of the dimensions of the dataclasses here, and of `Snapshot` and `Observation`."""
    return {
        "one": 1,
        "world": worlds,
        "world_and_global": worlds + 1,
        "instance": objects,
        "word": count_words(objects),
        "body": worlds * bodies_per_world,
        "waypoint": CORNERS * rounds,
        "cup": cups,
        "status": len(Status),
        "measure": len(Measure),
        "fixture": len(FIXTURES),
    }
