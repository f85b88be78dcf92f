"""Device state of all worlds, and the constants that the simulation's kernels share."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.arrays import device_array
from synpick_warp.configs.schema import Config
from synpick_warp.kernels import structs
from synpick_warp.scenes import build
from synpick_warp.scenes.shapes import Catalog
from synpick_warp.stages.buffers import FIXTURES

# Where the gripper waits while objects fall [m]: beside the tote, outside every camera's view.
GRIPPER_HOME = (3.0, 0.0, 1.0)
# Corners of the tote that a round of moving visits.
CORNERS = 4
STATUS_COLUMNS = ("phase", "outcome", "episode", "attempt", "frame", "live")
"""Columns of `WorldStatus.table`."""


@dataclass(frozen=True, eq=False)
class WorldState:
    """Changes every tick; lives on the device."""

    address: wp.array = device_array("world", dtype=wp.vec2i)
    """Episode number and attempt; episode -1: none."""
    phase: wp.array = device_array("world", dtype=wp.int32)
    """A phase of `kernels.phases`."""
    outcome: wp.array = device_array("world", dtype=wp.int32)
    """An `Outcome`."""
    next_episode: wp.array = device_array("one", dtype=wp.int32)
    """The first episode number that no world has taken."""
    progress: wp.array = device_array("world", dtype=wp.vec4i, unit="ticks")
    """Ticks since the drop, ticks at rest, re-drops, whether the guide walls stand."""
    entry: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Catalog index of each instance; -1: none."""
    slot: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Body slot of each instance."""
    stuck: wp.array = device_array("world", "instance", dtype=wp.int32, unit="ticks")
    """How long the instance has been stuck."""
    previous: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world, one tick ago."""
    shift: wp.array = device_array("world", "instance", dtype=wp.float32, unit="m")
    """How far the instance moved in the last tick."""
    depth: wp.array = device_array("body", dtype=wp.float32, unit="m")
    """Deepest penetration of each body."""
    variant: wp.array = device_array("body", dtype=wp.int32)
    """Body variant to select; -1: as it is."""
    restarted: wp.array = device_array("world_and_global", dtype=wp.bool)
    """Worlds that got new objects this tick; the last entry stands for what belongs to no world."""
    frame: wp.array = device_array("world", dtype=wp.int32)
    """Frames since the gripper began to act; -1: not yet."""
    order: wp.array = device_array("world", "waypoint", dtype=wp.int32)
    """Corners in the order of their visit."""
    waypoint: wp.array = device_array("world", dtype=wp.int32)
    """How many corners the goal has reached."""
    goal: wp.array = device_array("world", dtype=wp.vec3f, unit="m")
    """Goal of the finger's tilt axis."""
    light: wp.array = device_array("world", dtype=wp.int32)
    """Light map of the episode."""
    light_turn: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Its turn about +z."""


@dataclass(frozen=True, eq=False)
class WorldStatus:
    """The few numbers of each world that the host reads."""

    table: wp.array = device_array("world", "status", dtype=wp.int32)
    """Columns as STATUS_COLUMNS."""


@dataclass(frozen=True, eq=False)
class SceneData:
    """Constants for the kernels."""

    layout: structs.LayoutData
    catalog: structs.CatalogData
    drop: structs.DropData
    settle: structs.SettleData
    move: structs.MoveData
    guide_shapes: wp.array


def world_sizes(config: Config, bodies_per_world: int) -> dict[str, int]:
    """Extents of the dimensions that `WorldState`, `WorldStatus` and `Snapshot` name."""
    worlds = config.bake.worlds
    return {
        "one": 1,
        "world": worlds,
        "world_and_global": worlds + 1,
        "instance": config.arrangement.max_objects,
        "body": worlds * bodies_per_world,
        "waypoint": CORNERS * config.move.rounds,
        "status": len(STATUS_COLUMNS),
        "fixture": len(FIXTURES),
    }


def make_scene_data(config: Config, catalog: Catalog, built: build.BuiltModel, lights: int, device: wp.Device) -> SceneData:
    """Put settings and catalog into the structs that kernels take."""
    return SceneData(
        _layout_data(built.layout),
        _catalog_data(catalog, built, device),
        _drop_data(config, lights),
        _settle_data(config),
        _move_data(config),
        wp.array(np.array(built.layout.guide_shapes, dtype=np.int32), device=device),
    )


def _layout_data(layout: build.Layout) -> structs.LayoutData:
    data = structs.LayoutData()
    data.instances = layout.instances
    data.single_slots = layout.single_slots
    data.slots = layout.slots
    data.gripper_bodies = build.GRIPPER_BODIES
    data.gripper_dofs = build.GRIPPER_DOFS
    data.bodies = layout.bodies_per_world
    data.coords = layout.coords_per_world
    data.dofs = layout.dofs_per_world
    data.shapes = layout.shapes_per_world
    return data


def _catalog_data(catalog: Catalog, built: build.BuiltModel, device: wp.Device) -> structs.CatalogData:
    def column(values: list[float], dtype: type) -> wp.array:
        return wp.array(np.array(values), dtype=dtype, device=device)

    data = structs.CatalogData()
    entries = catalog.entries
    data.count = len(entries)
    data.volume = column([entry.volume for entry in entries], float)
    data.radius = column([entry.radius for entry in entries], float)
    data.compound = column([int(len(entry.pieces) > 1) for entry in entries], int)
    data.variant = wp.array(built.variant, dtype=int, device=device)
    data.empty_single, data.empty_compound = built.empty_variant
    data.empty_mass = build.EMPTY_MASS
    return data


def _drop_data(config: Config, lights: int) -> structs.DropData:
    data = structs.DropData()
    data.volume = config.arrangement.volume
    data.repeats = int(config.arrangement.repeats)
    data.clearance = config.arrangement.clearance
    data.spread = config.arrangement.spread
    data.rim_length, data.rim_width = config.tote.rim_size
    data.rim_height = config.tote.outer_size[2] - config.tote.wall
    data.gravity = config.physics.gravity
    data.gripper_home = wp.vec3(*GRIPPER_HOME)
    data.lights = lights
    data.turn_lights = int(config.render.turn_lights)
    return data


def _settle_data(config: Config) -> structs.SettleData:
    tick = config.physics.step * config.physics.steps_per_tick
    data = structs.SettleData()
    data.min_ticks = math.ceil(config.settle.min_time / tick)
    data.max_ticks = math.ceil(config.settle.max_time / tick)
    data.rest_ticks = config.settle.rest_ticks
    data.stuck_ticks = math.ceil(config.settle.stuck_time / tick)
    data.late_ticks = math.ceil(config.settle.late_time / tick)
    data.rest_shift = config.settle.rest_shift
    data.last_shift = config.settle.last_shift
    data.stuck_depth = config.settle.stuck_depth
    data.max_redrops = config.settle.max_redrops
    return data


def _move_data(config: Config) -> structs.MoveData:
    move, gripper = config.move, config.gripper
    data = structs.MoveData()
    data.stiffness, data.damping, data.force, data.speed = move.stiffness, move.damping, move.force, move.speed
    length, width = config.tote.floor_size
    data.corner = wp.vec3(move.corner * length / 2, move.corner * width / 2, move.height)
    data.start_height = move.start_height
    data.waypoints = CORNERS * move.rounds
    data.mass = gripper.finger_mass + gripper.cup_mass
    data.gravity = config.physics.gravity
    data.step = config.physics.step
    data.tip = gripper.cup_length
    return data
