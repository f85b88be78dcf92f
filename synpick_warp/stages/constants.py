"""Constants of the simulation's and perception's kernels: structs filled from the settings and the catalog."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Mode
from synpick_warp.configs import schema
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.configs.dataset import mode_weights
from synpick_warp.configs.episodes.manipulation import ANOTHER
from synpick_warp.configs.episodes.objects import Counts, most_objects
from synpick_warp.kernels import structs
from synpick_warp.kernels.distributions import LookTable
from synpick_warp.scenes import build
from synpick_warp.scenes.bin_meshes.inside import HeightField
from synpick_warp.scenes.capacities import count_entries
from synpick_warp.scenes.grippers import CUP_ARMATURE, Head
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Catalog, CatalogEntry
from synpick_warp.stages.render.looks import build_look_table
from synpick_warp.stages.sim.worlds import CORNERS
from synpick_warp.system.linear_algebra import norm

# Height of what has no walls, so that whatever is beside it is outside [m].
FAR = 1e30
# Home position of the wrist, used while objects fall and while perception runs [m]: beside the bin, outside every camera's view.
GRIPPER_HOME = (3.0, 0.0, 1.0)


@dataclass(frozen=True, eq=False)
class SceneData:
    """Constants of the kernels: one struct for each subject, and the modes of the splits: `modes` has one `ModeData` each.

    `tries_another`: whether failed attempts are counted by instance (`pick.retry`); `upright`, and `scattered` by
    `drop`: of the settings `arrangement`; `cylinder`: radius about the z axis, lower and upper end of each object as it stands (body) [m].
    """

    layout: structs.LayoutData
    catalog: structs.CatalogData
    drop: structs.DropData
    settle: structs.SettleData
    modes: wp.array
    move: structs.MoveData
    pick: structs.PickData
    perception: structs.PerceptionData
    suction: structs.SuctionData
    cups: structs.CupData
    bins: structs.BinData
    looks: LookTable
    tries_another: bool = False
    upright: float = 0.0
    scattered: bool = False
    cylinder: wp.array | None = None


def fill(kind: Any, *sections: Any, **derived: Any) -> Any:
    """Make a struct whose members come from `derived`, else from the first section that has a field of that name. `kind`: a `wp.struct`.
    `sections`: sections of the settings, or other objects with attributes; booleans become integers. `derived`: members that no section
    holds under their name or in their unit. Raises AttributeError: a member is in neither; TypeError: `derived` names no member."""
    unknown = derived.keys() - kind.vars.keys()
    if unknown:
        raise TypeError(f"{kind.key} has no members {sorted(unknown)}")
    result = kind()
    for name in kind.vars:
        if name in derived:
            value = derived[name]
        else:
            owner = next((section for section in sections if hasattr(section, name)), None)
            if owner is None:
                raise AttributeError(f"no value for {kind.key}.{name}")
            value = getattr(owner, name)
        setattr(result, name, int(value) if isinstance(value, bool) else value)
    return result


def make_scene_data(config: schema.Config, catalog: Catalog, built: build.BuiltModel, lights: int, device: wp.Device) -> SceneData:
    """Fill the structs that kernels take from settings, catalog and model; `lights` is the count of environment maps."""
    physics, gripper = config.physics, config.gripper
    labelled = build.without_distractors(config.arrangement, config.randomize.most_distractors)
    return SceneData(
        _layout_data(built.layout),
        _catalog_data(catalog, built, config.arrangement.counts, device),
        drop_data(labelled, config.render, config.pick, config.move, physics.gravity, lights),
        _settle_data(config.settle, physics.tick_time),
        mode_data(mode_rows(config.bake, config.splits), device),
        _move_data(config.move, gripper, physics),
        fill(
            structs.PickData,
            config.pick,
            config.target,
            forgive=(config.pick.forgive << Mode.PICK) | (config.target.forgive << Mode.TARGET),
            press_steps=math.ceil(config.pick.press_time / physics.step),
            tilt_limit=math.radians(gripper.tilt_limit),
        ),
        fill(structs.PerceptionData, config.perception),
        _suction_data(config.suction, gripper, physics.step),
        _cup_data(gripper, built.head, device),
        bin_data(config.cell.bins, config.bins, config.move, built.layout.parts, device, built.fields),
        build_look_table(Looks(config.randomize, (), ()), 0, device),
        config.pick.retry == ANOTHER,
        config.arrangement.upright,
        config.arrangement.drop == schema.SCATTERED,
        wp.array([_cylinder(entry) for entry in catalog.bodies], dtype=wp.vec3, device=device),
    )


def _layout_data(layout: build.WorldLayout) -> structs.LayoutData:
    return fill(
        structs.LayoutData,
        layout,
        gripper_bodies=build.GRIPPER_BODIES,
        gripper_dofs=build.GRIPPER_DOFS,
        bodies=layout.bodies_per_world,
        coords=layout.coords_per_world,
        dofs=layout.dofs_per_world,
        shapes=layout.shapes_per_world,
    )


def count_columns(counts: Counts, catalog: Catalog, device: wp.Device) -> dict[str, Any]:
    """Members of `CatalogData` that set the numbers of objects."""
    least, most = (wp.array(column, dtype=int, device=device) for column in count_entries(counts, catalog).T)
    return {"least": least, "most": most, "counted": most_objects(counts)}


def _catalog_data(catalog: Catalog, built: build.BuiltModel, counts: Counts, device: wp.Device) -> structs.CatalogData:
    """Fill `CatalogData`: a column for each property of the entries of the catalog."""

    def column(values: list[float], dtype: type) -> wp.array:
        return wp.array(np.array(values), dtype=dtype, device=device)

    entries = catalog.bodies
    empty_single, empty_compound = built.empty_variant
    return fill(
        structs.CatalogData,
        count=len(catalog.entries),
        distractors=len(catalog.distractors),
        volume=column([entry.volume for entry in entries], float),
        radius=column([entry.radius for entry in entries], float),
        mass=column([entry.mass for entry in entries], float),
        area=column([_extents(entry)[1] * _extents(entry)[2] for entry in entries], float),
        diagonal=column([float(norm(_extents(entry))) for entry in entries], float),
        compound=column([int(len(entry.pieces) > 1) for entry in entries], int),
        variant=wp.array(built.variant, dtype=int, device=device),
        **count_columns(counts, catalog, device),
        empty_single=empty_single,
        empty_compound=empty_compound,
        empty_mass=build.EMPTY_MASS,
    )


def _extents(entry: CatalogEntry) -> np.ndarray:
    """Side lengths of the mesh's bounding box in the object's frame, ascending (3) [m]."""
    return np.sort(np.ptp(entry.mesh.vertices.astype(np.float64), axis=0))


def _cylinder(entry: CatalogEntry) -> tuple[float, float, float]:
    """Cylinder about the z axis that encloses the mesh: radius, lower and upper end [m]."""
    points = entry.mesh.vertices.astype(np.float64)
    return float(np.linalg.norm(points[:, :2], axis=1).max()), float(points[:, 2].min()), float(points[:, 2].max())


def mode_data(rows: Sequence[tuple[int, float, float, int, int]], device: wp.Device) -> wp.array:
    """Array of `ModeData` from the values of its members, in order."""
    names = structs.ModeData.vars
    return wp.array([fill(structs.ModeData, **dict(zip(names, row, strict=True))) for row in rows], dtype=structs.ModeData, device=device)


def mode_rows(bake: schema.Bake, splits: Sequence[schema.Split]) -> list[tuple[int, float, float, int, int]]:
    """Members of `ModeData` of each split, or of the one range without splits."""
    ranges = [(split.first, split.mode) for split in splits] or [(0, bake.mode)]
    rows = []
    for first, mode in ranges:
        weights = mode_weights(bake, mode)
        pick, target, total = weights["pick"], weights["target"], sum(weights.values())
        period = len(schema.MODES) if mode == schema.CYCLE else 0
        rows.append((first, pick / total, (pick + target) / total, period, int(mode == schema.STILL)))
    return rows


def drop_data(
    arrangement: schema.Arrangement,
    render: schema.Render,
    pick: schema.Pick,
    move: schema.Move,
    gravity: float,
    lights: int,
) -> structs.DropData:
    """Fill `DropData` from the settings, those of the draw of objects with labels; `lights` is the number of environment maps."""
    return fill(
        structs.DropData,
        arrangement,
        render,
        objects=arrangement.max_objects,
        exceed=arrangement.fill == schema.EXCEED,
        layers=arrangement.drop == schema.LAYERED,
        move_repeats=move.repeats,
        pick_repeats=pick.repeats,
        gravity=gravity,
        gripper_home=wp.vec3(*GRIPPER_HOME),
        lights=lights,
    )


def bin_data(
    sizes: Sequence[BinSizes],
    bins: schema.Bins,
    move: schema.Move,
    parts: Sequence[build.WorldPart],
    device: wp.Device,
    fields: Sequence[HeightField | None] = (),
) -> structs.BinData:
    """Fill `BinData` but for the arrays of worlds. `bins`: settings of their place. `move`: settings of the waypoints. `parts`: the
    collision shapes of the bins in a world. `fields`: height field of the inside of each bin; None, or none at all: it is a box."""
    fields = fields or [None] * len(sizes)
    shape = next((one.limit.shape for one in fields if one), (1, 1))

    def array(values: Sequence[Any], dtype: type) -> wp.array:
        return wp.array(np.array(values), dtype=dtype, device=device)

    shares = np.cumsum([one.weight for one in sizes])
    return fill(
        structs.BinData,
        count=len(sizes),
        visible=sizes[0].is_visible,
        share=array(shares / shares[-1], float),
        origin=array([(*one.origin[:2], sizes[0].ground - one.base) for one in sizes], wp.vec3),
        shift=wp.vec2(*bins.shift),
        turn=array([one.turn for one in sizes], float),
        yaw=math.radians(bins.yaw),
        reach=array([np.array(one.opening) / 2 + one.margin for one in sizes], wp.vec2),
        rim_height=array([one.height for one in sizes], float),
        wall_height=array([one.height if one.shell else FAR for one in sizes], float),
        limit=array([one.limit if one else np.zeros(shape) for one in fields], float),
        pitch=array([one.pitch if one else (0.0, 0.0) for one in fields], wp.vec2),
        first_compartment=array(np.cumsum([0, *(len(one.floors) for one in sizes)]), int),
        center=array([opening[:2] for one in sizes for opening in one.openings], wp.vec2),
        half=array([np.array(opening[2:]) / 2 for one in sizes for opening in one.openings], wp.vec2),
        waypoint=array([corners for one in sizes for corners in one.waypoints(move.corner, move.height)], wp.vec3),
        shape=array([part.shape for part in parts], int),
        shape_bin=array([part.bin for part in parts], int),
        shape_guide=array([int(part.guide) for part in parts], int),
        chosen=None,
        pose=None,
    )


def _settle_data(settle: schema.Settle, tick: float) -> structs.SettleData:
    """Fill `SettleData`; times become numbers of ticks of `tick` seconds."""
    return fill(
        structs.SettleData,
        settle,
        min_ticks=math.ceil(settle.min_time / tick),
        max_ticks=math.ceil(settle.max_time / tick),
        stuck_ticks=math.ceil(settle.stuck_time / tick),
        late_ticks=math.ceil(settle.relax_time / tick),
        rest_threshold=settle.rest_displacement,
        relaxed_rest_threshold=settle.relaxed_displacement,
    )


def _move_data(move: schema.Move, gripper: schema.Gripper, physics: schema.Physics) -> structs.MoveData:
    return fill(
        structs.MoveData,
        move,
        physics,
        waypoints=CORNERS * move.rounds,
        mass=gripper.finger_mass + gripper.cup_mass,
        tcp_offset=gripper.cup_length,
    )


def _suction_data(suction: schema.Suction, gripper: schema.Gripper, step: float) -> structs.SuctionData:
    """Fill `SuctionData` from the settings; `step` is the time step [s]."""
    return fill(
        structs.SuctionData,
        suction,
        gripper,
        swing_limit=math.radians(suction.swing_limit),
        tcp_offset=gripper.cup_length,
        tilt_inertia=CUP_ARMATURE + step * (gripper.tilt_damping + step * gripper.tilt_stiffness),
        step=step,
    )


def _cup_data(gripper: schema.Gripper, head: Head, device: wp.Device) -> structs.CupData:
    places = np.array([(x, y, -gripper.cup_length) for x, y in head.cups])
    place = wp.array(places, dtype=wp.vec3, device=device)
    return fill(structs.CupData, count=len(places), place=place, common_valve=head.has_common_valve)
