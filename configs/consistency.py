"""Validation across settings: constraints between several of them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections import Counter
from collections.abc import Iterator, Sequence

from synpick_warp.configs.modes import bake_modes
from synpick_warp.configs.schema import (
    FORMATS,
    MIXED,
    Bake,
    Bop,
    Cameras,
    Config,
    DepthSensor,
    Effects,
    Gripper,
    Move,
    ObjectRow,
    Physics,
    Pick,
    Settle,
    Split,
    Suction,
    Tote,
)
from synpick_warp.configs.splits import MAX_SHARD_SCENES, DataLayout
from synpick_warp.errors import format_value

DEPTH_COUNTS = 65535
"""Maximum value of a 16-bit depth image."""
_PARALLEL = 1e-6
"""Sine of the angle below which a camera's up vector counts as parallel to its viewing direction."""
_SPLIT = re.compile(r"(train|val|test)(_[A-Za-z0-9]+)*")

Conflict = tuple[str, str]
"""Key of the wrong setting, and its allowed values."""


def find_conflicts(config: Config) -> Iterator[Conflict]:
    """Find all violated constraints, the most basic first."""
    bake, cameras, tote, bop = config.bake, config.cameras, config.tote, config.bop
    yield from _mix(bake, config.splits, cameras)
    yield from _tote(tote, config.move)
    yield from _cameras(cameras, tote)
    yield from _times(config.settle, config.physics)
    yield from _pick(config.pick, tote)
    yield from _suction(config.suction, config.gripper)
    yield from _layers(config.render.layers)
    yield from _ranges(config.effects, config.depth_sensor)
    if "depth_sensor" in config.render.layers:
        yield from _depth_sensor(config.depth_sensor, cameras, tote)
    yield from _jpeg_quality(config.effects, bop)
    yield from _split_folders(config.splits, bop)
    yield from _scene_ids(DataLayout.of(config))
    yield from _depth_scale(bop, cameras, tote)
    yield from _object_rows(config.object_rows)


def _mix(bake: Bake, splits: Sequence[Split], cameras: Cameras) -> Iterator[Conflict]:
    """Yield conflicts of modes, formats and resolution."""
    if MIXED in bake_modes(bake, splits) and not any(bake.mix):
        yield "bake.mix", "at least one weight above 0, with the mode mixed"
    if not bake.formats:
        yield "bake.formats", f"at least one of {', '.join(FORMATS)}"
    if "lerobot" in bake.formats and any(side % 2 for side in cameras.resolution):
        yield "cameras.resolution", "even width and height with the format lerobot, whose videos have a colour for 2 x 2 pixels"


def _tote(tote: Tote, move: Move) -> Iterator[Conflict]:
    """Yield conflicts of the tote's sizes, and a height at which the gripper starts below that at which it moves."""
    if any(rim < floor for rim, floor in zip(tote.rim_size, tote.floor_size, strict=True)):
        yield "tote.rim_size", f"at least tote.floor_size on both sides, {format_value(tote.floor_size)} [m]"
    if any(outer < rim + 2 * tote.wall for outer, rim in zip(tote.outer_size[:2], tote.rim_size, strict=True)):
        needed = [round(rim + 2 * tote.wall, 9) for rim in tote.rim_size]
        yield "tote.outer_size", f"at least tote.rim_size and two walls, {format_value(needed)} [m]"
    if tote.outer_size[2] <= tote.wall:
        yield "tote.wall", f"less than the tote's height, {tote.outer_size[2]:g} [m]"
    if move.start_height < move.height:
        yield "move.start_height", f"at least move.height, {move.height:g} [m]"


def _cameras(cameras: Cameras, tote: Tote) -> Iterator[Conflict]:
    """Yield conflicts of camera positions, up vectors and target: degenerate, below the floor, or not showing the tote."""
    if not cameras.positions:
        yield "cameras.positions", "at least one position"
    if len(cameras.ups) != len(cameras.positions):
        yield "cameras.ups", f"one direction for each of the {len(cameras.positions)} cameras.positions"
        return
    for index, (position, up) in enumerate(zip(cameras.positions, cameras.ups, strict=True)):
        forward = tuple(b - a for a, b in zip(position, cameras.target, strict=True))
        if math.hypot(*forward) == 0.0:
            yield "cameras.positions", f"positions other than cameras.target, the position of camera {index}"
        elif math.hypot(*_cross(forward, up)) <= _PARALLEL * math.hypot(*forward) * math.hypot(*up):
            yield "cameras.ups", f"up vectors that are not zero or parallel to the viewing direction, as that of camera {index} is"
        elif position[2] <= 0.0:
            yield "cameras.positions", f"positions above the tote's floor, z > 0, below which camera {index} sees no object [m]"
        elif not _sees_tote(cameras, tote, position):
            yield "cameras.target", f"a point that lets each camera see the tote, which lies outside of the images of camera {index} [m]"


def _times(settle: Settle, physics: Physics) -> Iterator[Conflict]:
    """Yield conflicts of the times of settling."""
    rest = settle.rest_ticks * physics.steps_per_tick * physics.step
    if settle.max_time < settle.min_time:
        yield "settle.max_time", f"at least settle.min_time, {settle.min_time:g} [s]"
    if settle.max_time < rest:
        yield "settle.max_time", f"at least the time of settle.rest_ticks ticks, {rest:g} [s]"


def _pick(pick: Pick, tote: Tote) -> Iterator[Conflict]:
    """Yield conflicts of the heights and speeds of picking."""
    height = tote.outer_size[2] - tote.wall
    if pick.appear_height < pick.near:
        yield "pick.appear_height", f"at least pick.near, {pick.near:g} [m]"
    if pick.speed < pick.near_speed:
        yield "pick.speed", f"at least pick.near_speed, {pick.near_speed:g} [m/s]"
    if pick.lift_height < height:
        yield "pick.lift_height", f"at least the inner height of the tote, {height:g}: attached objects must leave the tote [m]"


def _suction(suction: Suction, gripper: Gripper) -> Iterator[Conflict]:
    """Yield conflicts of cup, rays and break forces."""
    max_radius = gripper.cup_width / 2
    if suction.radius > max_radius:
        yield "suction.radius", f"at most half of gripper.cup_width, {max_radius:g} [m]"
    if suction.tolerated_misses >= suction.rays:
        yield "suction.tolerated_misses", f"less than suction.rays, {suction.rays}: one ray must hit"
    if suction.poor_force > suction.good_force:
        yield "suction.poor_force", f"at most suction.good_force, {suction.good_force:g} [N]"


def _layers(layers: tuple[str, ...]) -> Iterator[Conflict]:
    """Yield layers that are named twice."""
    if len(set(layers)) < len(layers):
        yield "render.layers", f"each layer once: {format_value(list(dict.fromkeys(layers)))}"


def _ranges(effects: Effects, depth_sensor: DepthSensor) -> Iterator[Conflict]:
    """Yield ranges of effects and depth sensor whose minimum exceeds the maximum."""
    for name, section in (("effects", effects), ("depth_sensor", depth_sensor)):
        for item in dataclasses.fields(section):
            value = getattr(section, item.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                yield f"{name}.{item.name}", f"minimum and maximum in this order: {format_value([value[1], value[0]])}"


def _jpeg_quality(effects: Effects, bop: Bop) -> Iterator[Conflict]:
    """Yield a JPEG quality that begins at 0 or that the colour format has no use for."""
    low, high = effects.jpeg_quality
    if high and not low:
        yield "effects.jpeg_quality", f"from 1 to 100, or 0, 0: {format_value([1, high])}"
    if high and bop.color_format != "jpg":
        yield "effects.jpeg_quality", f"0, 0 with bop.color_format {bop.color_format}"


def _depth_sensor(sensor: DepthSensor, cameras: Cameras, tote: Tote) -> Iterator[Conflict]:
    """With the layer depth_sensor: the tote must lie within what the sensor measures, and its disparity be more than a step."""
    width, _ = cameras.resolution
    focal = width / 2 / math.tan(math.radians(cameras.fov) / 2)
    for index, position in enumerate(cameras.positions):
        depths = _tote_depths(cameras, tote, position)
        near, far = max(0.0, min(depths)), max(depths)
        if sensor.distances[1] < near or sensor.distances[0] > far:
            yield "depth_sensor.distances", f"a range that reaches the tote, {near:.3g} to {far:.3g} m from camera {index} [m]"
        if focal * sensor.baseline > far * sensor.max_disparity > 0.0:
            most = sensor.max_disparity * far / focal
            yield (
                "depth_sensor.baseline",
                f"at most {most:.3g}, so that the tote's disparity is within max_disparity; or a shorter lens [m]",
            )
        if focal * sensor.baseline < sensor.disparity_step * far:
            least = sensor.disparity_step * far / focal
            yield "depth_sensor.baseline", f"at least {least:.3g}, so that the disparity of the tote is a disparity_step or more [m]"


def _tote_depths(cameras: Cameras, tote: Tote, position: tuple[float, ...]) -> list[float]:
    """Planar depths of the corners of the tote's outer box in the image of a camera at `position`, which looks at cameras.target [m]."""
    length, width, height = tote.outer_size
    forward = [b - a for a, b in zip(position, cameras.target, strict=True)]
    size = math.hypot(*forward) or 1.0
    corners = itertools.product((-length / 2, length / 2), (-width / 2, width / 2), (-tote.wall, height - tote.wall))
    return [sum((c - a) * f for a, c, f in zip(position, corner, forward, strict=True)) / size for corner in corners]


def _sees_tote(cameras: Cameras, tote: Tote, position: tuple[float, ...]) -> bool:
    """Whether the tote's bounding sphere meets the cone around a camera's view, which is wider than its image."""
    length, width, height = tote.outer_size
    center = (0.0, 0.0, height / 2 - tote.wall)
    forward = [b - a for a, b in zip(position, cameras.target, strict=True)]
    away, radius = [b - a for a, b in zip(position, center, strict=True)], math.hypot(length, width, height) / 2
    distance = math.hypot(*away)
    if distance <= radius:
        return True
    cosine = sum(a * b for a, b in zip(forward, away, strict=True)) / (math.hypot(*forward) * distance)
    columns, rows = cameras.resolution
    cone = math.atan(math.tan(math.radians(cameras.fov) / 2) * math.hypot(1.0, rows / columns))
    return math.acos(max(-1.0, min(1.0, cosine))) <= cone + math.asin(radius / distance)


def _split_folders(splits: Sequence[Split], bop: Bop) -> Iterator[Conflict]:
    """Yield folders of splits with names that BOP does not allow, or that do not fit the colour format."""
    folders = [(f"splits.{split.name}.folder", split.folder) for split in splits] or [("bop.split", bop.split)]
    for key, folder in folders:
        if not _SPLIT.fullmatch(folder):
            yield key, "train, val or test, and after an underscore letters and digits, as in train_pbr"
        elif (bop.color_format == "jpg") != folder.endswith("_pbr"):
            fitting = "png" if bop.color_format == "jpg" else "jpg"
            rule = "BOP's toolkit reads jpg from splits that end in _pbr, and png from all others"
            yield "bop.color_format", f"{fitting} with the split {folder}: {rule}"


def _scene_ids(layout: DataLayout) -> Iterator[Conflict]:
    """Yield the number of episodes if shards have no names for so many scenes."""
    if "shards" in layout.formats and layout.scenes_end > MAX_SHARD_SCENES:
        most = MAX_SHARD_SCENES // layout.cameras
        long = next((split.name for split in layout.splits if split.first + split.episodes > most), "")
        key = f"splits.{long}.episodes" if long else "bake.episodes"
        yield key, f"episode indices below {most} with the format shards, whose names hold no more scenes"


def _depth_scale(bop: Bop, cameras: Cameras, tote: Tote) -> Iterator[Conflict]:
    """Yield the depth scale if 16 bits do not reach the farthest corner of the tote."""
    far = max((depth for position in cameras.positions for depth in _tote_depths(cameras, tote, position)), default=0.0)
    if bop.depth_scale * 1e-3 * DEPTH_COUNTS < far:
        yield "bop.depth_scale", f"at least {far * 1e3 / DEPTH_COUNTS:.3g}, so that 16 bits reach the tote at {far:.3g} m [mm]"


def _object_rows(rows: Sequence[ObjectRow]) -> Iterator[Conflict]:
    """Yield ids that several object rows have."""
    counts = Counter(row.id for row in rows)
    for repeated in sorted(row_id for row_id, count in counts.items() if count > 1):
        yield "object_rows", f"one row per id; {repeated} comes {counts[repeated]} times"


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float]:
    """Cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
