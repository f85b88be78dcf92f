"""Checks what single settings cannot show: that they fit each other."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Iterator

from synpick_warp.configs.check import shown
from synpick_warp.configs.schema import FORMATS, MIXED, Config

DEPTH_COUNTS = 65535
"""Largest value of a 16-bit depth image."""
_PARALLEL = 1e-6
"""Sine of the angle below which a camera's up direction says nothing about the image's upper edge."""
_SPLIT = re.compile(r"(train|val|test)(_[A-Za-z0-9]+)*")

Complaint = tuple[str, str]
"""Key at fault, and what is allowed there."""


def complaints(config: Config) -> Iterator[Complaint]:
    """Everything that does not fit, the most basic first."""
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


def _mix(config: Config) -> Iterator[Complaint]:
    if config.bake.mode == MIXED and not any(config.bake.mix):
        yield "bake.mix", "at least one weight above 0, with the mode mixed"
    if not config.bake.formats:
        yield "bake.formats", f"at least one of {', '.join(FORMATS)}"


def _tote(config: Config) -> Iterator[Complaint]:
    tote = config.tote
    if any(rim < floor for rim, floor in zip(tote.rim_size, tote.floor_size, strict=True)):
        yield "tote.rim_size", f"at least tote.floor_size on both sides, {shown(tote.floor_size)} [m]"
    if any(outer < rim + 2 * tote.wall for outer, rim in zip(tote.outer_size[:2], tote.rim_size, strict=True)):
        least = [round(rim + 2 * tote.wall, 9) for rim in tote.rim_size]
        yield "tote.outer_size", f"at least tote.rim_size and two walls, {shown(least)} [m]"
    if tote.outer_size[2] <= tote.wall:
        yield "tote.wall", f"less than the tote's height, {tote.outer_size[2]:g} [m]"
    if config.move.start_height < config.move.height:
        yield "move.start_height", f"at least move.height, {config.move.height:g} [m]"


def _cameras(config: Config) -> Iterator[Complaint]:
    cameras = config.cameras
    if not cameras.positions:
        yield "cameras.positions", "at least one position"
    if len(cameras.ups) != len(cameras.positions):
        yield "cameras.ups", f"one direction for each of the {len(cameras.positions)} cameras.positions"
        return
    for number, (position, up) in enumerate(zip(cameras.positions, cameras.ups, strict=True)):
        forward = tuple(b - a for a, b in zip(position, cameras.target, strict=True))
        if math.hypot(*forward) == 0.0:
            yield "cameras.positions", f"positions other than cameras.target, where camera {number} stands"
        elif math.hypot(*_cross(forward, up)) <= _PARALLEL * math.hypot(*forward) * math.hypot(*up):
            yield "cameras.ups", f"directions across the line of sight; camera {number} looks along its own, or it is zero"


def _times(config: Config) -> Iterator[Complaint]:
    settle = config.settle
    rest = settle.rest_ticks * config.physics.steps_per_tick * config.physics.step
    if settle.max_time < settle.min_time:
        yield "settle.max_time", f"at least settle.min_time, {settle.min_time:g} [s]"
    if settle.max_time < rest:
        yield "settle.max_time", f"at least the time of settle.rest_ticks ticks, {rest:g} [s]"


def _pick(config: Config) -> Iterator[Complaint]:
    pick, height = config.pick, config.tote.outer_size[2] - config.tote.wall
    if pick.appear_height < pick.near:
        yield "pick.appear_height", f"at least pick.near, {pick.near:g} [m]"
    if pick.speed < pick.near_speed:
        yield "pick.speed", f"at least pick.near_speed, {pick.near_speed:g} [m/s]"
    if pick.lift_height < height:
        yield "pick.lift_height", f"at least the inner height of the tote, {height:g}: what hangs on the cup must have left it [m]"


def _suction(config: Config) -> Iterator[Complaint]:
    suction, widest = config.suction, config.gripper.cup_width / 2
    if suction.radius > widest:
        yield "suction.radius", f"at most half of gripper.cup_width, {widest:g} [m]"
    if suction.tolerated_misses >= suction.rays:
        yield "suction.tolerated_misses", f"less than suction.rays, {suction.rays}: a ray must hit"
    if suction.poor_force > suction.good_force:
        yield "suction.poor_force", f"at most suction.good_force, {suction.good_force:g} [N]"


def _render(config: Config) -> Iterator[Complaint]:
    layers = config.render.layers
    if len(set(layers)) < len(layers):
        yield "render.layers", f"each layer once: {shown(list(dict.fromkeys(layers)))}"


def _sensors(config: Config) -> Iterator[Complaint]:
    for section in ("effects", "depth_sensor"):
        for item in dataclasses.fields(getattr(config, section)):
            value = getattr(getattr(config, section), item.name)
            if isinstance(value, tuple) and value[0] > value[1]:
                yield f"{section}.{item.name}", f"the lesser first: {shown([value[1], value[0]])}"
    least, most = config.effects.jpeg_quality
    if most and not least:
        yield "effects.jpeg_quality", f"from 1 to 100, or 0, 0: {shown([1, most])}"
    if most and config.bop.color_format != "jpg":
        yield "effects.jpeg_quality", f"0, 0 with bop.color_format {config.bop.color_format}"


def _bop(config: Config) -> Iterator[Complaint]:
    bop = config.bop
    if not _SPLIT.fullmatch(bop.split):
        yield "bop.split", "train, val or test, and after an underscore letters and digits, as in train_pbr"
    elif (bop.color_format == "jpg") != bop.split.endswith("_pbr"):
        fitting = "png" if bop.color_format == "jpg" else "jpg"
        rule = "BOP's toolkit reads jpg from splits that end in _pbr, and png from all others"
        yield "bop.color_format", f"{fitting} with the split {bop.split}: {rule}"
    far = max((math.dist(position, (0.0, 0.0, 0.0)) for position in config.cameras.positions), default=0.0)
    if bop.depth_scale * 1e-3 * DEPTH_COUNTS < far:
        yield "bop.depth_scale", f"at least {far * 1e3 / DEPTH_COUNTS:.3g}, so that 16 bits reach the tote from {far:.3g} m [mm]"


def _object_rows(config: Config) -> Iterator[Complaint]:
    ids = [row.id for row in config.object_rows]
    for repeated in sorted({number for number in ids if ids.count(number) > 1}):
        yield "object_rows", f"one row an id; {repeated} comes {ids.count(repeated)} times"


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
