"""Device state of all worlds."""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.arrays import device_array
from synpick_warp.codes import Measure, Status
from synpick_warp.configs.schema import Config
from synpick_warp.stages.buffers import FIXTURES

# Corners of the tote that a round of moving visits.
CORNERS = 4


@dataclass(frozen=True, eq=False)
class WorldState:
    """Changes every tick; lives on the device."""

    arrangement_id: wp.array = device_array("world", dtype=wp.vec2i)
    """Episode number and redraw; episode -1: none."""
    phase: wp.array = device_array("world", dtype=wp.int32)
    """A `Phase`."""
    ending: wp.array = device_array("world", dtype=wp.int32)
    """An `Ending`."""
    mode: wp.array = device_array("world", dtype=wp.int32)
    """A `Mode`."""
    next_episode: wp.array = device_array("one", dtype=wp.int32)
    """How many of the bake's episode numbers worlds have taken."""
    progress: wp.array = device_array("world", dtype=wp.vec4i, unit="ticks")
    """Ticks since the drop, ticks at rest, re-drops, whether the guide walls stand."""
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Catalog index of each instance; -1: none."""
    body_slot: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Body slot of each instance."""
    stuck: wp.array = device_array("world", "instance", dtype=wp.int32, unit="ticks")
    """How long the instance has been stuck."""
    previous_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world, one tick ago."""
    displacement: wp.array = device_array("world", "instance", dtype=wp.float32, unit="m")
    """How far the instance moved in the last tick."""
    penetration: wp.array = device_array("body", dtype=wp.float32, unit="m")
    """Deepest penetration of each body."""
    variant: wp.array = device_array("body", dtype=wp.int32)
    """Body variant to select; -1: as it is."""
    restarted: wp.array = device_array("world_and_global", dtype=wp.bool)
    """Worlds that got new objects this tick; the last entry stands for what belongs to no world."""
    frame: wp.array = device_array("world", dtype=wp.int32)
    """Frames since the gripper began to act; -1: not yet."""
    corner_order: wp.array = device_array("world", "waypoint", dtype=wp.int32)
    """Corners in the order of their visit."""
    waypoint: wp.array = device_array("world", dtype=wp.int32)
    """How many corners the goal has reached."""
    setpoint: wp.array = device_array("world", dtype=wp.vec3f, unit="m")
    """Goal of the finger's tilt axis."""
    light: wp.array = device_array("world", dtype=wp.int32)
    """Light map of the episode."""
    light_yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Its turn about +z."""
    light_exposure: wp.array = device_array("world", dtype=wp.float32, unit="stops")
    """Exposure against the automatic one."""


@dataclass(frozen=True, eq=False)
class AttemptState:
    """What each world's gripper tries to pick, and how far it has come."""

    task: wp.array = device_array("world", dtype=wp.int32)
    """A `Task`."""
    steps: wp.array = device_array("world", dtype=wp.int32, unit="steps")
    """Time since the task began."""
    attempt: wp.array = device_array("world", dtype=wp.int32)
    """Number of the running attempt in its episode, or of the one that ended in this tick; -1: none yet."""
    outcome: wp.array = device_array("world", dtype=wp.int32)
    """`Outcome` of the attempt that ended in this tick."""
    failures: wp.array = device_array("world", dtype=wp.int32)
    """Attempts that have failed and count."""
    hits: wp.array = device_array("world", dtype=wp.int32)
    """Rays that hit an object when the suction was switched on."""
    engaged_bits: wp.array = device_array("world", dtype=wp.uint32)
    """Bit i: instance i was caught then."""
    attached_bits: wp.array = device_array("world", dtype=wp.uint32)
    """Bit i: instance i hung on the cup at the end of the tick."""
    removed: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Whether the instance has left the scene: 0 no, 1 picked, 2 lost."""


@dataclass(frozen=True, eq=False)
class SealState:
    """What hangs on each world's cup."""

    attached: wp.array = device_array("world", "instance", dtype=wp.int32)
    """1: a seal holds the instance."""
    object_in_tcp: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to the frame at the cup's tip (axes of the cup) when it was caught."""
    seal_force: wp.array = device_array("world", "instance", dtype=wp.float32, unit="N")
    """Tension and shear that the seal bore in the last step."""
    break_force: wp.array = device_array("world", dtype=wp.float32, unit="N")
    """Break force of every seal of the world."""
    peak_force: wp.array = device_array("world", dtype=wp.float32, unit="N")
    """Largest load of any seal since the tick began."""


@dataclass(frozen=True, eq=False)
class WorldStatus:
    """The few numbers of each world that the host reads."""

    table: wp.array = device_array("world", "status", dtype=wp.int32)
    """Columns: `Status`."""
    measures: wp.array = device_array("world", "measure", dtype=wp.float32)
    """Columns: `Measure`."""


def world_sizes(config: Config, bodies_per_world: int) -> dict[str, int]:
    """Extents of the dimensions that the dataclasses here, `Snapshot` and `Observation` name."""
    worlds = config.bake.worlds
    return {
        "one": 1,
        "world": worlds,
        "world_and_global": worlds + 1,
        "instance": config.arrangement.max_objects,
        "body": worlds * bodies_per_world,
        "waypoint": CORNERS * config.move.rounds,
        "status": len(Status),
        "measure": len(Measure),
        "fixture": len(FIXTURES),
    }
