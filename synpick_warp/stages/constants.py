"""Constants that the simulation's kernels share, from settings and catalog."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from synpick_warp.configs.modes import mode_weights
from synpick_warp.configs.schema import Config
from synpick_warp.kernels import structs
from synpick_warp.scenes import build
from synpick_warp.scenes.types import Catalog, CatalogEntry
from synpick_warp.stages.sim.worlds import CORNERS

# Where the gripper waits while objects fall and while the worlds are looked at [m]: beside the tote, outside every camera's view.
GRIPPER_HOME = (3.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class SceneData:
    """Constants for the kernels."""

    layout: structs.LayoutData
    catalog: structs.CatalogData
    drop: structs.DropData
    settle: structs.SettleData
    mode: structs.ModeData
    move: structs.MoveData
    pick: structs.PickData
    perception: structs.PerceptionData
    suction: structs.SuctionData
    guide_shapes: wp.array


def make_scene_data(config: Config, catalog: Catalog, built: build.BuiltModel, lights: int, device: wp.Device) -> SceneData:
    """Put settings and catalog into the structs that kernels take."""
    return SceneData(
        _layout_data(built.layout),
        _catalog_data(catalog, built, device),
        _drop_data(config, lights),
        _settle_data(config),
        _mode_data(config),
        _move_data(config),
        _pick_data(config),
        _perception_data(config),
        _suction_data(config),
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
    data.finger_shape, data.cup_shape = layout.finger_shape, layout.cup_shape
    return data


def _catalog_data(catalog: Catalog, built: build.BuiltModel, device: wp.Device) -> structs.CatalogData:
    def column(values: list[float], dtype: type) -> wp.array:
        return wp.array(np.array(values), dtype=dtype, device=device)

    data = structs.CatalogData()
    entries = catalog.entries
    data.count = len(entries)
    data.volume = column([entry.volume for entry in entries], float)
    data.radius = column([entry.radius for entry in entries], float)
    data.mass = column([entry.mass for entry in entries], float)
    data.area = column([_extents(entry)[1] * _extents(entry)[2] for entry in entries], float)
    data.diagonal = column([float(np.linalg.norm(_extents(entry))) for entry in entries], float)
    data.compound = column([int(len(entry.pieces) > 1) for entry in entries], int)
    data.variant = wp.array(built.variant, dtype=int, device=device)
    data.empty_single, data.empty_compound = built.empty_variant
    data.empty_mass = build.EMPTY_MASS
    return data


def _extents(entry: CatalogEntry) -> np.ndarray:
    """Sides of the mesh's box in the object's frame, ascending (3) [m]."""
    return np.sort(np.ptp(entry.mesh.vertices.astype(np.float64), axis=0))


def _mode_data(config: Config) -> structs.ModeData:
    weights = mode_weights(config)
    pick, target, move = weights["pick"], weights["target"], weights["move"]
    data = structs.ModeData()
    data.pick_share = pick / (pick + target + move)
    data.pick_or_target_share = (pick + target) / (pick + target + move)
    return data


def _drop_data(config: Config, lights: int) -> structs.DropData:
    data = structs.DropData()
    data.volume = config.arrangement.volume
    data.move_repeats = int(config.move.repeats)
    data.pick_repeats = int(config.pick.repeats)
    data.clearance = config.arrangement.clearance
    data.spread = config.arrangement.spread
    data.rim_length, data.rim_width = config.tote.rim_size
    data.rim_height = config.tote.outer_size[2] - config.tote.wall
    data.gravity = config.physics.gravity
    data.gripper_home = wp.vec3(*GRIPPER_HOME)
    data.lights = lights
    data.turn_lights = int(config.render.turn_lights)
    data.exposure_spread = config.render.exposure_spread
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


def _pick_data(config: Config) -> structs.PickData:
    pick = config.pick
    data = structs.PickData()
    data.stiffness, data.damping, data.force = pick.stiffness, pick.damping, pick.force
    data.appear_height, data.speed, data.near, data.near_speed = pick.appear_height, pick.speed, pick.near, pick.near_speed
    data.press_steps = math.ceil(pick.press_time / config.physics.step)
    data.lift_height, data.lift_speed = pick.lift_height, pick.lift_speed
    data.failures, data.floor = pick.failures, pick.floor
    data.tilt_limit = math.radians(config.gripper.tilt_limit)
    data.forgive, data.random_after_failure = int(config.target.forgive), int(config.target.random_after_failure)
    return data


def _perception_data(config: Config) -> structs.PerceptionData:
    sight = config.sight
    data = structs.PerceptionData()
    data.center_share, data.heavy_mass, data.heavy_center_share = sight.center_share, sight.heavy_mass, sight.heavy_center_share
    data.contour_offset, data.deep_distance, data.deep_weight = sight.contour_offset, sight.deep_distance, sight.deep_weight
    data.min_votes, data.reach, data.exact_cycle, data.normal_window = sight.min_votes, sight.reach, sight.exact_cycle, sight.normal_window
    return data


def _suction_data(config: Config) -> structs.SuctionData:
    suction, gripper = config.suction, config.gripper
    data = structs.SuctionData()
    data.rays, data.radius, data.reach, data.tolerated_misses = suction.rays, suction.radius, suction.reach, suction.tolerated_misses
    data.good_force, data.poor_force = suction.good_force, suction.poor_force
    data.stiffness, data.damping = suction.stiffness, suction.damping
    data.twist_stiffness, data.twist_damping = suction.twist_stiffness, suction.twist_damping
    data.swing_limit, data.swing_stiffness = math.radians(suction.swing_limit), suction.swing_stiffness
    data.tip, data.step = gripper.cup_length, config.physics.step
    data.finger_mass, data.cup_mass = gripper.finger_mass, gripper.cup_mass
    data.tilt_inertia = build.CUP_ARMATURE + data.step * (gripper.tilt_damping + data.step * gripper.tilt_stiffness)
    return data
