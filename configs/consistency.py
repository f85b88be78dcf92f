"""Validation across settings: constraints between several of them."""

from __future__ import annotations

import dataclasses
import math
import re
from collections import Counter
from collections.abc import Iterator

from synpick_warp.configs.check import format_value
from synpick_warp.configs.fields import INT32_MAX
from synpick_warp.configs.modes import bake_modes
from synpick_warp.configs.schema import FORMATS, MIXED, Config
from synpick_warp.configs.splits import MAX_SHARD_SCENES, scenes_end

DEPTH_COUNTS = 65535
"""Maximum value of a 16-bit depth image."""
_PARALLEL = 1e-6
"""Sine of the angle below which a camera's up vector counts as parallel to its viewing direction."""
_SPLIT = re.compile(r"(train|val|test)(_[A-Za-z0-9]+)*")

Conflict = tuple[str, str]
"""Key of the wrong setting, and its allowed values."""


def find_conflicts(config: Config) -> Iterator[Conflict]:
    """Find all violated constraints, the most basic first."""
    yield from _mix(config)
    yield from _tote(config)
    yield from _cameras(config)
    yield from _times(config)
    yield from _pick(config)
    yield from _suction(config)
    yield from _render(config)
    yield from _sensors(config)
    yield from _bop(config)
    yield from _object_rows(config)


def _mix(config: Config) -> Iterator[Conflict]:
    if MIXED in bake_modes(config) and not any(config.bake.mix):
        yield "bake.mix", "at least one weight above 0, with the mode mixed"
    if not config.bake.formats:
        yield "bake.formats", f"at least one of {', '.join(FORMATS)}"
    if "lerobot" in config.bake.formats and any(side % 2 for side in config.cameras.resolution):
        yield "cameras.resolution", "even width and height with the format lerobot, whose videos have a colour for 2 x 2 pixels"


def _tote(config: Config) -> Iterator[Conflict]:
    tote = config.tote
    if any(rim < floor for rim, floor in zip(tote.rim_size, tote.floor_size, strict=True)):
        yield "tote.rim_size", f"at least tote.floor_size on both sides, {format_value(tote.floor_size)} [m]"
    if any(outer < rim + 2 * tote.wall for outer, rim in zip(tote.outer_size[:2], tote.rim_size, strict=True)):
        needed = [round(rim + 2 * tote.wall, 9) for rim in tote.rim_size]
        yield "tote.outer_size", f"at least tote.rim_size and two walls, {format_value(needed)} [m]"
    if tote.outer_size[2] <= tote.wall:
        yield "tote.wall", f"less than the tote's height, {tote.outer_size[2]:g} [m]"
    if config.move.start_height < config.move.height:
        yield "move.start_height", f"at least move.height, {config.move.height:g} [m]"


def _cameras(config: Config) -> Iterator[Conflict]:
    cameras = config.cameras
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


def _times(config: Config) -> Iterator[Conflict]:
    settle, step = config.settle, config.physics.step
    tick = config.physics.steps_per_tick * step
    counted = [(f"settle.{name}", tick) for name in ("min_time", "max_time", "relax_time", "stuck_time")]
    for key, unit in [*counted, ("pick.press_time", step)]:
        section, _, name = key.partition(".")
        if getattr(getattr(config, section), name) > INT32_MAX * unit:
            yield key, f"at most {INT32_MAX * unit:g}, {INT32_MAX:,} {'steps' if unit == step else 'ticks'} of physics.step [s]"
    rest = settle.rest_ticks * config.physics.steps_per_tick * config.physics.step
    if settle.max_time < settle.min_time:
        yield "settle.max_time", f"at least settle.min_time, {settle.min_time:g} [s]"
    if settle.max_time < rest:
        yield "settle.max_time", f"at least the time of settle.rest_ticks ticks, {rest:g} [s]"


def _pick(config: Config) -> Iterator[Conflict]:
    pick, height = config.pick, config.tote.outer_size[2] - config.tote.wall
    if pick.appear_height < pick.near:
        yield "pick.appear_height", f"at least pick.near, {pick.near:g} [m]"
    if pick.speed < pick.near_speed:
        yield "pick.speed", f"at least pick.near_speed, {pick.near_speed:g} [m/s]"
    if pick.lift_height < height:
        yield "pick.lift_height", f"at least the inner height of the tote, {height:g}: attached objects must leave the tote [m]"


def _suction(config: Config) -> Iterator[Conflict]:
    suction, max_radius = config.suction, config.gripper.cup_width / 2
    if suction.radius > max_radius:
        yield "suction.radius", f"at most half of gripper.cup_width, {max_radius:g} [m]"
    if suction.tolerated_misses >= suction.rays:
        yield "suction.tolerated_misses", f"less than suction.rays, {suction.rays}: one ray must hit"
    if suction.poor_force > suction.good_force:
        yield "suction.poor_force", f"at most suction.good_force, {suction.good_force:g} [N]"


def _render(config: Config) -> Iterator[Conflict]:
    layers = config.render.layers
    if len(set(layers)) < len(layers):
        yield "render.layers", f"each layer once: {format_value(list(dict.fromkeys(layers)))}"


def _sensors(config: Config) -> Iterator[Conflict]:
    for section in ("effects", "depth_sensor"):
        for item in dataclasses.fields(getattr(config, section)):
            value = getattr(getattr(config, section), item.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                yield f"{section}.{item.name}", f"minimum and maximum in this order: {format_value([value[1], value[0]])}"
    low, high = config.effects.jpeg_quality
    if high and not low:
        yield "effects.jpeg_quality", f"from 1 to 100, or 0, 0: {format_value([1, high])}"
    if high and config.bop.color_format != "jpg":
        yield "effects.jpeg_quality", f"0, 0 with bop.color_format {config.bop.color_format}"


def _bop(config: Config) -> Iterator[Conflict]:
    bop = config.bop
    folders = [(f"splits.{split.name}.folder", split.folder) for split in config.splits] or [("bop.split", bop.split)]
    for key, folder in folders:
        if not _SPLIT.fullmatch(folder):
            yield key, "train, val or test, and after an underscore letters and digits, as in train_pbr"
        elif (bop.color_format == "jpg") != folder.endswith("_pbr"):
            fitting = "png" if bop.color_format == "jpg" else "jpg"
            rule = "BOP's toolkit reads jpg from splits that end in _pbr, and png from all others"
            yield "bop.color_format", f"{fitting} with the split {folder}: {rule}"
    if "shards" in config.bake.formats and scenes_end(config) > MAX_SHARD_SCENES:
        most = MAX_SHARD_SCENES // len(config.cameras.positions)
        long = next((split.name for split in config.splits if split.first + split.episodes > most), "")
        key = f"splits.{long}.episodes" if long else "bake.episodes"
        yield key, f"episode indices below {most} with the format shards, whose names hold no more scenes"
    far = max((math.dist(position, (0.0, 0.0, 0.0)) for position in config.cameras.positions), default=0.0)
    if bop.depth_scale * 1e-3 * DEPTH_COUNTS < far:
        yield "bop.depth_scale", f"at least {far * 1e3 / DEPTH_COUNTS:.3g}, so that 16 bits reach the tote from {far:.3g} m [mm]"


def _object_rows(config: Config) -> Iterator[Conflict]:
    counts = Counter(row.id for row in config.object_rows)
    for repeated in sorted(row_id for row_id, count in counts.items() if count > 1):
        yield "object_rows", f"one row per id; {repeated} comes {counts[repeated]} times"


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
