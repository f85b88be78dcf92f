"""Validation across settings: constraints between several of them."""

import dataclasses
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence

from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.cell.bins import OWN, PALLET, TOTE, BinRow, Bins, BinSizes, PropRow, Tote
from synpick_warp.configs.cell.cameras import GRIPPER
from synpick_warp.configs.cell.gripper import Gripper, find_gripper_conflicts
from synpick_warp.configs.dataset import MAX_SHARD_SCENES, DataLayout, bake_modes, may_pick, possible_modes
from synpick_warp.configs.episodes.manipulation import PICKS
from synpick_warp.configs.episodes.objects import EMBEDDED, most_objects
from synpick_warp.configs.fields import Conflict
from synpick_warp.configs.rules.camera_rules import FORMS, NAME, find_camera_conflicts, find_pose_conflicts
from synpick_warp.configs.schema import FORMATS, MIXED, STILL, Bake, Bop, Config, Move, Physics, Pick, Settle, Split
from synpick_warp.errors import format_value

_NAME = re.compile(r"(?!(tote|table|pallet)$)[a-z0-9_]{1,32}")
"""Regular expression of valid bin names: identifiers, as USD needs for prims, that are not the name of another kind of bin."""
_MIN_COMPARTMENT = 0.03
"""Least length and width of a compartment [m]."""
_SPLIT = re.compile(r"(train|val|test)(_[A-Za-z0-9]+)*")


def find_conflicts(config: Config) -> Iterator[Conflict]:
    """Find all violated constraints, the most basic first."""
    bins, bop = config.cell.bins, config.bop
    yield from _modes(config.bake, config.splits)
    yield from _bins(config.bins, config.bin)
    yield from _props(config.prop, config.arrangement.max_objects)
    for key, row in config.cell.tables.items():
        yield from _box(key, row)
    if config.move.start_height < config.move.height:
        yield "move.start_height", f"at least move.height, {config.move.height:g} [m]"
    if all(row.measured or not row.file for row in config.bin):
        yield from find_camera_conflicts(config)
        yield from _pick(config.pick, bins)
        yield from _move(config.move, config.gripper, bins if "move" in possible_modes(config.bake, config.splits) else ())
    yield from _times(config.settle, config.physics)
    mouths = [opening[2:] for one in bins if one.shell for opening in one.openings]
    yield from find_gripper_conflicts(config.gripper, config.suction, mouths)
    yield from _pictures(config)
    if bop.graph and config.physics.sleep > 0.0:
        yield "physics.sleep", "0 with bop.graph, which reads the contact forces of what rests [m]"
    yield from _split_folders(config.splits, bop)
    yield from _scene_ids(DataLayout.of(config))
    yield from _objects(config)
    if config.randomize.background_textures and config.render.table and not any(config.render.table_size):
        yield "render.table_size", "above 0 with randomize.background_textures, which are seen beyond the edge of the table [m]"


def _objects(config: Config) -> Iterator[Conflict]:
    """Yield conflicts of objects: ids that several rows have, distractors without room or of the same models, and numbers of parts that are
    more than there is room for, or none in some episodes."""
    arrangement, randomize, models = config.arrangement, config.randomize, config.bake.models
    if not config.objects.embedded:
        yield "objects.embedded", f"at least one of {', '.join(EMBEDDED)}"
    counts = Counter(row.id for row in config.object_rows)
    for repeated in sorted(row_id for row_id, count in counts.items() if count > 1):
        yield "object_rows", f"one row per id; {repeated} comes {counts[repeated]} times"
    distractors = randomize.most_distractors
    if distractors >= arrangement.max_objects:
        yield "randomize.distractors", f"less than arrangement.max_objects, {arrangement.max_objects}, which counts them, too"
    if distractors and models and os.path.realpath(randomize.distractor_models) == os.path.realpath(models):
        yield "randomize.distractor_models", "another folder than bake.models: its objects would be without labels"
    most, room = most_objects(arrangement.counts), arrangement.max_objects - distractors
    if most > room:
        beside = f", less {distractors} distractors" if distractors else ""
        yield "arrangement.counts", f"at most arrangement.max_objects, {arrangement.max_objects}{beside}, together, which are {most}"
    if arrangement.counts and not any(least for _, least, _ in arrangement.counts):
        yield "arrangement.counts", "at least one part that each episode has"


def _modes(bake: Bake, splits: Sequence[Split]) -> Iterator[Conflict]:
    """Yield conflicts of modes and formats."""
    if MIXED in bake_modes(bake, splits) and not any(bake.mix):
        yield "bake.mix", "at least one weight above 0, with the mode mixed"
    if STILL in bake_modes(bake, splits):
        yield from ((f"splits.{split.name}.mode", "still in all splits or in none") for split in splits if split.mode != STILL)
        if "lerobot" in bake.formats:
            yield "bake.formats", "without lerobot in mode still, as one frame is no video"
    if not bake.formats:
        yield "bake.formats", f"at least one of {', '.join(FORMATS)}"
    if PICKS in bake.formats and not may_pick(bake, splits):
        yield "bake.formats", "without picks where no episode picks, as in mode move"


def _box(key: str, tote: Tote) -> Iterator[Conflict]:
    """Yield conflicts of the sizes of the tote, or of a bin like it; `key`: of its table."""
    noun = TOTE if key == TOTE else "bin"
    if any(rim < floor for rim, floor in zip(tote.rim_size, tote.floor_size, strict=True)):
        yield f"{key}.rim_size", f"at least {key}.floor_size on both sides, {format_value(tote.floor_size)} [m]"
    if any(outer < rim + 2 * tote.wall for outer, rim in zip(tote.outer_size[:2], tote.rim_size, strict=True)):
        needed = [round(rim + 2 * tote.wall, 9) for rim in tote.rim_size]
        yield f"{key}.outer_size", f"at least {key}.rim_size and two walls, {format_value(needed)} [m]"
    if tote.outer_size[2] <= tote.wall:
        yield f"{key}.wall", f"less than the {noun}'s height, {tote.outer_size[2]:g} [m]"


def _bins(bins: Bins, rows: Sequence[BinRow]) -> Iterator[Conflict]:
    """Yield conflicts of what stands under the cameras: a kind that the tables do not fit, areas, names, weights and compartments."""
    if (bins.kind == OWN) != bool(rows):
        yield "bins.kind", f"{OWN} with [[bin]] tables, and another kind without"
    names = [row.name for row in rows]
    for index, row in enumerate(rows):
        if not _NAME.fullmatch(row.name) or names.count(row.name) > 1:
            yield (
                f"bin[{index}].name",
                "lower-case letters, digits and underscores, at most 32, other than those of other bins; not tote, table, pallet",
            )
        if row.file:
            continue
        sizes = BinSizes.of_row(row)
        if row.compartments != (1, 1) and row.divider_height > sizes.height:
            yield f"bin[{index}].divider_height", f"at most the height of the rim, {sizes.height:g} [m]"
        if min(sizes.cell) < _MIN_COMPARTMENT:
            yield f"bin[{index}].compartments", f"compartments of at least {_MIN_COMPARTMENT:g} m"
    if rows and not any(row.weight for row in rows):
        yield "bin[0].weight", "more than 0 of at least one bin"
    if bins.kind == PALLET and any(side > pallet for side, pallet in zip(bins.area, bins.pallet_size, strict=False)):
        yield "bins.area", f"at most the pallet's length and width, {format_value(bins.pallet_size[:2])} [m]"


def _props(rows: Sequence[PropRow], objects: int) -> Iterator[Conflict]:
    """Yield conflicts of the [[prop]] tables; `objects`: capacity of a world."""
    names = [row.name for row in rows]
    for index, row in enumerate(rows):
        if not NAME.fullmatch(row.name) or names.count(row.name) > 1:
            rule = "a lower-case letter, then such letters, digits and underscores, at most 32, other than those of other props"
            yield f"prop[{index}].name", rule
        yield from find_pose_conflicts(f"prop[{index}].pose", row.pose, (("position",), *FORMS))
        if row.collide and row.follows == GRIPPER:
            yield f"prop[{index}].collide", "false for what follows the gripper, which collides as gripper.mesh"
    if objects + len(rows) > MAX_INSTANCES:
        yield "arrangement.max_objects", f"at most {MAX_INSTANCES - len(rows)}, as {len(rows)} props count in pictures, too"


def _times(settle: Settle, physics: Physics) -> Iterator[Conflict]:
    """Yield conflicts of settling times: max_time is at least min_time, and at least rest_ticks long."""
    rest = settle.rest_ticks * physics.steps_per_tick * physics.step
    if settle.max_time < settle.min_time:
        yield "settle.max_time", f"at least settle.min_time, {settle.min_time:g} [s]"
    if settle.max_time < rest:
        yield "settle.max_time", f"at least the time of settle.rest_ticks ticks, {rest:g} [s]"


def _pick(pick: Pick, bins: Sequence[BinSizes]) -> Iterator[Conflict]:
    """Yield conflicts of the heights and speeds of picking."""
    height = max(one.height for one in bins)
    if pick.appear_height < pick.near:
        yield "pick.appear_height", f"at least pick.near, {pick.near:g} [m]"
    if pick.speed < pick.near_speed:
        yield "pick.speed", f"at least pick.near_speed, {pick.near_speed:g} [m/s]"
    if pick.floor > bins[0].origin[2]:
        yield "pick.floor", f"at most the floor of the {bins[0].noun}, {bins[0].origin[2]:g}: what is below it is removed [m]"
    if pick.lift_height < height:
        yield "pick.lift_height", f"at least the inner height of the {bins[0].noun}, {height:g}: attached objects must leave it [m]"


def _move(move: Move, gripper: Gripper, bins: Sequence[BinSizes]) -> Iterator[Conflict]:
    """Yield a conflict if the gripper at `move.height` does not fit between the leaning walls of a bin."""
    radius = max((math.hypot(*place) for place in gripper.cups), default=0.0) + gripper.cup_width / 2
    for sizes in bins:
        for floor, opening in zip(sizes.floors, sizes.openings, strict=True) if sizes.measured else ():
            depth = sizes.height - floor[6]
            sides = zip(floor[2:4], opening[2:], strict=True)
            missing = [(2 * radius - low) / (high - low) for low, high in sides if low < min(high, 2 * radius)]
            if (least := depth * max(missing, default=0.0)) > move.height:
                rule = f"from which on the gripper, {2 * radius:.3g} m wide, fits between the walls of bin {sizes.name}"
                yield "move.height", f"at least {least:.3g}, {rule} [m]"
                return


def _pictures(config: Config) -> Iterator[Conflict]:
    """Yield layers that are named twice, ranges of effects and depth sensor whose minimum exceeds the maximum, and a JPEG quality that
    begins at 0 or that the colour format has no use for."""
    layers, color_format = config.render.layers, config.bop.color_format
    if len(set(layers)) < len(layers):
        yield "render.layers", f"each layer once: {format_value(list(dict.fromkeys(layers)))}"
    for name, section in (("effects", config.effects), ("depth_sensor", config.depth_sensor), ("still", config.still)):
        for item in dataclasses.fields(section):
            value = getattr(section, item.name)
            if isinstance(value, tuple) and len(value) == 2 and value[0] > value[1]:
                yield f"{name}.{item.name}", f"minimum and maximum in this order: {format_value([value[1], value[0]])}"
    low, high = config.effects.jpeg_quality
    if high and not low:
        yield "effects.jpeg_quality", f"from 1 to 100, or 0, 0: {format_value([1, high])}"
    if high and color_format != "jpg":
        yield "effects.jpeg_quality", f"0, 0 with bop.color_format {color_format}"


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
    """Yield the number of episodes if shards have no names for so many scenes, one per episode and camera."""
    if "shards" in layout.formats and layout.episodes_end * layout.cameras > MAX_SHARD_SCENES:
        most = MAX_SHARD_SCENES // layout.cameras
        long = next((split.name for split in layout.splits if split.first + split.episodes > most), "")
        key = f"splits.{long}.episodes" if long else "bake.episodes"
        yield key, f"episode indices below {most} with the format shards, whose names hold no more scenes"
