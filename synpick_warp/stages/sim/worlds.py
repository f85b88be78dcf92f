"""Simulation state: device arrays of all worlds, one row a world, which persist between ticks."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.codes import Measure, Status
from synpick_warp.stages.arrays import count_words, device_array
from synpick_warp.stages.buffers import FIXTURES

# Waypoints of a round of moving: the corners of a compartment.
CORNERS = 4


@dataclass(frozen=True, eq=False)
class WorldState:
    """State of each world: episode (-1: none), phase, mode, objects (-1: none) and their body slots, progress of settling, frame, waypoints
    and setpoint [m], light.
    """

    arrangement_id: wp.array = device_array("world", dtype=wp.vec2i)
    """Episode index, and index of the arrangement in it: 0, plus 1 for each resample. Episode -1: none."""
    phase: wp.array = device_array("world", dtype=wp.int32)
    """`Phase`."""
    ending: wp.array = device_array("world", dtype=wp.int32)
    """`Ending`."""
    mode: wp.array = device_array("world", dtype=wp.int32)
    """`Mode`."""
    next_episode: wp.array = device_array("one", dtype=wp.int32)
    """Position in the bake's list of episodes of the next one to start."""
    progress: wp.array = device_array("world", dtype=wp.vec4i)
    """Ticks since the drop, ticks at rest, number of re-drops, 1 while the guide walls stand."""
    bin: wp.array = device_array("world", dtype=wp.int32)
    """Bin of the episode."""
    bin_pose: wp.array = device_array("world", dtype=wp.transformf, unit="m")
    """Bin to world."""
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Object of each instance; -1: none."""
    body_slot: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Body slot of each instance: its body is the slot-th after the gripper's."""
    stuck: wp.array = device_array("world", "instance", dtype=wp.int32, unit="ticks")
    """Time in deep penetration."""
    previous_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world, one tick ago."""
    displacement: wp.array = device_array("world", "instance", dtype=wp.float32, unit="m")
    """Upper bound of the motion of any point of the instance in the last tick."""
    penetration: wp.array = device_array("body", dtype=wp.float32, unit="m")
    """Deepest penetration of each body."""
    variant: wp.array = device_array("body", dtype=wp.int32)
    """Body variant to select; -1: no change."""
    restarted: wp.array = device_array("world_and_global", dtype=wp.bool)
    """Worlds that were reset in this tick; the last element is Newton's global world."""
    frame: wp.array = device_array("world", dtype=wp.int32)
    """Frame index since phase ACT began; -1: not yet."""
    corner_order: wp.array = device_array("world", "waypoint", dtype=wp.int32)
    """Corner, 0 to 3, of each waypoint, plus 4 times the compartment."""
    waypoint: wp.array = device_array("world", dtype=wp.int32)
    """Waypoints that the setpoint has reached."""
    setpoint: wp.array = device_array("world", dtype=wp.vec3f, unit="m")
    """Setpoint of the wrist, the origin of shaft and cup."""
    light: wp.array = device_array("world", dtype=wp.int32)
    """Environment map of the episode."""
    light_yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Rotation of the map about +z, counter-clockwise."""
    light_exposure: wp.array = device_array("world", dtype=wp.float32, unit="EV")
    """Exposure relative to the automatic one."""


@dataclass(frozen=True, eq=False)
class AttemptState:
    """Attempt to pick of each world: task, outcome, failures, instances that the cup holds, and what has left the scene."""

    task: wp.array = device_array("world", dtype=wp.int32)
    """`Task`."""
    steps: wp.array = device_array("world", dtype=wp.int32, unit="steps")
    """Time since the task began."""
    attempt: wp.array = device_array("world", dtype=wp.int32)
    """Index of the attempt in its episode, of the running one or the one that ended in this tick; -1: none yet."""
    outcome: wp.array = device_array("world", dtype=wp.int32)
    """`Outcome` of the attempt that ended in this tick."""
    failures: wp.array = device_array("world", dtype=wp.int32)
    """Failed attempts that count towards the limit."""
    target_failures: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Failed attempts at the instance in the episode, plus 1024 times those since the last success; 0 with `pick.retry` "same"."""
    hits: wp.array = device_array("world", dtype=wp.vec2i)
    """Suction rays that hit an object when suction was switched on, and the cups with a good seal: bit k, cup k."""
    engaged_words: wp.array = device_array("world", "word", dtype=wp.uint32)
    """Bit set of the instances that were engaged, that is, hit by a ray."""
    attached_words: wp.array = device_array("world", "word", dtype=wp.uint32)
    """Bit set of the instances that were attached to the cup at the end of the tick, before picked objects were removed."""
    removed: wp.array = device_array("world", "instance", dtype=wp.int32)
    """`Removal`: why the instance has left the scene."""


@dataclass(frozen=True, eq=False)
class SealState:
    """Seals of each world's cups: attached instances, with their poses and forces."""

    attached: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Cups that hold the instance: bit k, cup k; 0: none."""
    object_in_tcp: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object pose in the TCP frame when the seals engaged."""
    seal_force: wp.array = device_array("world", "instance", dtype=wp.float32, unit="N")
    """Largest force of tension and shear among the instance's seals in the last step, including seals that broke; 0 without a seal."""
    cup_force: wp.array = device_array("world", "cup", dtype=wp.float32, unit="N")
    """Force of tension and shear of each cup, summed over the instances that it holds."""
    break_force: wp.array = device_array("world", "cup", dtype=wp.float32, unit="N")
    """Break force of a cup's seals."""
    peak: wp.array = device_array("world", dtype=wp.vec2f, unit="N")
    """Largest seal force since the beginning of the tick, including seals that broke, and largest relative to the seal's break force."""


@dataclass(frozen=True, eq=False)
class WorldStatus:
    """Status rows of the worlds, integers (`Status`) and real numbers (`Measure`), and sets of instances, which the host reads after each
    tick."""

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
