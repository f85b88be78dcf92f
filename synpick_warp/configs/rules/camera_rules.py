"""Validation across the settings of cameras, bins and depth: invalid poses and matrices, cameras that do not see the bin."""

import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

from synpick_warp.codes import MAX_DISPARITIES
from synpick_warp.configs.cell.bins import BinSizes, Sides
from synpick_warp.configs.cell.cameras import (
    COLOR,
    DEPTH,
    MASKS,
    MODALITIES,
    OPENCV,
    OPENGL,
    CameraRow,
    Cameras,
    Jitter,
    Pose,
    Rig,
    Still,
    intrinsics,
    inverted,
    lens_map,
    moved,
    position,
    turned,
    viewing_direction,
)
from synpick_warp.configs.dataset import may_pick
from synpick_warp.configs.episodes.randomize import FIXED
from synpick_warp.configs.fields import Conflict
from synpick_warp.configs.schema import Bop, Config, DepthSensor, Gripper
from synpick_warp.errors import ConfigError
from synpick_warp.views.layers import LAYER_TABLE

DEPTH_COUNTS = 65535
"""Maximum value of a 16-bit depth image."""
PARALLEL = 1e-6
"""Sine of the angle below which a camera's up vector counts as parallel to its viewing direction."""
ORTHONORMAL = 1e-3
"""Largest error of the lengths and products of a rotation's columns: calibration files have four digits or more."""
ASPECT = 2.0
"""Largest ratio of fx and fy: sensors that bin pixels in one direction reach it."""
FOCAL_LENGTHS = (1 / (2 * math.tan(math.radians(85.0))), 1 / (2 * math.tan(math.radians(0.5))))
"""Least and largest focal length in widths of the image: those of fov."""
DOME_STEPS = 8
"""Steps of the azimuth at which places on a dome are checked."""
STEPS = 4
"""Steps of positions within their jitter that are checked."""
NAME = re.compile(r"[a-z][a-z0-9_]{0,31}")
RESERVED = ("world", "gripper", "info", "coco", "visib")
"""Words that mean something else where the names of cameras are: what a pose refers to, and in names of BOP's files."""
SENSOR_LAYERS = {"depth_sensor", "ir_left", "ir_right", "depth_stereo"}
"""Layers that are rectified images of a depth sensor."""
FORMS = (("matrix",), ("position", "quaternion"), ("position", "look_at", "up"))
"""Keys of a pose: one of these sets."""


def find_camera_conflicts(config: Config) -> Iterator[Conflict]:
    """Find the violated constraints of cameras, the most basic first."""
    listed = _rows(config.camera) if config.camera else _section(config.cameras)
    if found := list(listed):
        # What follows needs a rig.
        yield from found
        return
    rig = config.rig
    for layer in config.render.layers:
        LAYER_TABLE[layer]  # Raises ConfigError if it is of a package that is broken.
    for index in range(1 if rig.dome else len(rig)):
        yield from _view(rig, index, config)
    yield from _perception(config.perception.camera, rig, may_pick(config.bake, config.splits))
    if SENSOR_LAYERS.intersection(config.render.layers):
        yield from _depth_sensor(config.depth_sensor, rig, config.cell.bins)
    if "depth_stereo" in config.render.layers:
        yield from _search(config.depth_sensor, rig, config.cell.bins)
    yield from _depth_scale(config.bop, rig, config.cell.bins)


def _perception(name: str, rig: Rig, plans: bool) -> Iterator[Conflict]:
    """Yield the camera of perception if there is none of that name, or if it moves although grasps are planned with it."""
    if name and name not in rig.names:
        yield "perception.camera", f"the name of a camera, {', '.join(rig.names)}, or none"
    elif plans and rig.moves(rig.index(name)):
        yield "perception.camera", "the name of a camera that is fixed to the world, as the gripper waits elsewhere while perception looks"


def _section(cameras: Cameras) -> Iterator[Conflict]:
    """Yield conflicts of the section [cameras]."""
    if not cameras.positions:
        yield "cameras.positions", "at least one position"
    elif len(cameras.ups) != len(cameras.positions):
        yield "cameras.ups", f"one direction for each of the {len(cameras.positions)} cameras.positions"


def _rows(rows: tuple[CameraRow, ...]) -> Iterator[Conflict]:
    """Yield conflicts within the [[camera]] tables."""
    names = [row.name or f"camera_{index}" for index, row in enumerate(rows)]
    counts = Counter(names)
    for index, (row, name) in enumerate(zip(rows, names, strict=True)):
        key = f"camera[{index}]"
        if not NAME.fullmatch(name) or name in RESERVED:
            rule = "a lower-case letter, then up to 31 of these, digits and underscores"
            yield f"{key}.name", f"{rule}; not {', '.join(RESERVED)}"
        if counts[name] > 1:
            yield f"{key}.name", f"names that differ; {name} comes {counts[name]} times"
        if (row.fov is None) == (row.matrix is None):
            yield f"{key}.{'fov' if row.matrix is None else 'matrix'}", "either fov or matrix"
        yield from find_pose_conflicts(f"{key}.pose", row.pose)


def find_pose_conflicts(key: str, pose: Pose, forms: Sequence[tuple[str, ...]] = FORMS) -> Iterator[Conflict]:
    """Yield conflicts of a pose whose keys are not those of one of `forms`, or whose values do not make a rigid transform."""
    given = {name for name in ("matrix", "position", "quaternion", "look_at", "up") if getattr(pose, name) is not None}
    if given not in map(set, forms):
        yield key, " or ".join(f"{{{', '.join(form)}}}" for form in forms)
    elif pose.axes == OPENGL and pose.look_at is not None:
        yield f"{key}.axes", "none beside look_at and up, which have no axes"
    elif pose.quaternion is not None and abs(math.hypot(*pose.quaternion) - 1.0) > ORTHONORMAL:
        yield key, "a quaternion x, y, z, w of length 1"
    elif pose.matrix is not None:
        if len(pose.matrix) != 4 or any(abs(a - b) > 0.0 for a, b in zip(pose.matrix[3], (0.0, 0.0, 0.0, 1.0), strict=True)):
            yield key, "a matrix of 4 rows, the last 0, 0, 0, 1"
            return
        columns = [tuple(row[column] for row in pose.matrix[:3]) for column in range(3)]
        products = [(i == j) - sum(a * b for a, b in zip(columns[i], columns[j], strict=True)) for i in range(3) for j in range(i + 1)]
        if max(map(abs, products)) > ORTHONORMAL:
            yield key, "a matrix whose first three columns are perpendicular and of length 1 [m]"
        elif sum(a * b for a, b in zip(_cross(columns[0], columns[1]), columns[2], strict=True)) < 0.0:
            yield key, "a rotation; this matrix is a mirror image: x is right, y down and z forward"


def _view(rig: Rig, index: int, config: Config) -> Iterator[Conflict]:
    """Yield conflicts of a camera's intrinsics, odd sides with videos, and a degenerate view or one that does not show the bins."""
    bins = config.cell.bins
    row, label = rig.rows[index], rig.label(index)
    width, height = rig.sizes[index]
    if "lerobot" in config.bake.formats and (width % 2 or height % 2):
        key = rig.key(index, "resolution") if config.camera and config.camera[index].resolution else "cameras.resolution"
        yield key, "even width and height with the format lerobot, whose videos have a colour for 2 x 2 pixels"
    shown = rig.chosen(index, config.render.layers)
    if rig.every[index] > 1:
        yield from _every(rig.key(index, "every"), config.bake.formats, shown)
    if row.modalities is not None:
        yield from _modalities(rig.key(index, "modalities"), row.modalities, config.bake.formats, config.render.layers)
    if row.matrix is not None:
        yield from _matrix(rig.key(index, "matrix"), row.matrix, width, height)
    if row.distortion:
        yield from _lens(rig.key(index, "distortion"), row, config.render.layers)
    if sum(times := rig.shutter(index)) > config.physics.tick_time:
        name, other = ("exposure_time", "readout_time")[:: -1 if times[1] > times[0] else 1]
        yield rig.key(index, name), f"with {other} at most {config.physics.tick_time:g}, the time from one frame to the next [s]"
    elif any(times) and (rig.still or not rig.writes(index, "color")):
        yield rig.key(index, "exposure_time" if times[0] else "readout_time"), "0 in mode still and without colour: nothing is blurred"
    keys = [rig.key(index, "pose", name) for name in ("positions", "ups", "target")]
    placement = partial(_placement, label=label, bins=bins, shift=config.bins.shift)
    if rig.moves(index):
        placement = partial(_mounting, label=label, gripper=config.gripper)
    if rig.still and rig.moves(index):
        yield rig.key(index, "fixed_to"), "world in mode still, in which the gripper is away"
    elif rig.dome:
        yield from _dome(row, rig.dome, placement)
    for place, rule in () if rig.dome else placement(row, keys):
        axes = config.camera[index].pose.axes if config.camera else None
        yield place, rule + _other_pose(row.pose, lambda pose: not list(placement(replace(row, pose=pose), keys)), bins[0].noun, axes)
    if row.jitter is not None:
        yield from _jitter(rig.key(index, "jitter"), row, row.jitter, placement)


def _dome(row: CameraRow, dome: Still, placement: Callable[..., Iterator[Conflict]]) -> Iterator[Conflict]:
    """Yield the first place of a dome, at the ends of its ranges, at which a camera would not be allowed by `placement`."""
    ends, turns = (0.0, 1.0), [step / DOME_STEPS for step in range(DOME_STEPS)]
    for samples in itertools.product(ends, ends, turns, (0.5,), ends, ends, ends):
        for key, rule in placement(replace(row, pose=dome.pose(samples)), ("still.distance", "still.roll", "still.target")):
            yield key, f"a dome, with elevation and target_spread, whose cameras have {rule}"
            return


def _other_pose(pose: Pose, fits: Callable[[Pose], bool], noun: str, axes: str | None) -> str:
    """Clause on a pose of other axes, or the inverse, if that `fits` in place of one that does not; empty: none does."""
    name, owner = (OPENCV, "OpenCV's") if axes == OPENGL else (OPENGL, "OpenGL's or Blender's")
    turn = f'columns 2 and 3 negated: set axes = "{name}" if its axes are {owner}'
    inverse = f"it would see the {noun} with the inverse, so it may lead from the world to the camera: invert it"
    for other, clause in (
        (turned(pose), f"it looks away from the {noun}, and would see it with {turn}"),
        (inverted(pose), inverse),
        (turned(inverted(pose)), f"{inverse}; and with {turn}"),
    ):
        if other != pose and fits(other):
            return f"; {clause}"
    return ""


def _modalities(key: str, chosen: tuple[str, ...], formats: tuple[str, ...], layers: tuple[str, ...]) -> Iterator[Conflict]:
    """Yield images that are none, are not rendered, or lack what a format consists of."""
    if not chosen:
        yield key, f"at least one of {', '.join(MODALITIES)}"
    if missing := [name for name in chosen if name not in (COLOR, DEPTH, MASKS, *layers)]:
        yield key, f"names of layers that are in render.layers, as {missing[0]} is not"
    if COLOR not in chosen and (found := [name for name in ("lerobot", "coco", "yolo") if name in formats]):
        yield key, f"color among them with the format {found[0]}, which consists of colour images"
    if DEPTH not in chosen and "points" in formats:
        yield key, "depth among them with the format points, which is made of it"


def _every(key: str, formats: tuple[str, ...], layers: Sequence[str]) -> Iterator[Conflict]:
    """Yield what needs a picture of every frame."""
    if "lerobot" in formats:
        yield key, "1 with the format lerobot, whose videos have the frames of its states"
    if found := [name for name in ("flow", "scene_flow") if name in layers]:
        yield key, f"1 with the layer {found[0]}, which leads to the frame before"


def _view_axes(row: CameraRow, keys: Sequence[str], label: str) -> Iterator[Conflict]:
    """Yield a degenerate view; arguments as of `_placement`."""
    place, aim, _ = keys
    forward, up = viewing_direction(row.pose), row.pose.up
    if math.hypot(*forward) == 0.0:
        other = "look_at" if place != "cameras.positions" else "cameras.target"
        yield place, f"positions other than {other}, the position of {label}"
    elif up is not None and math.hypot(*_cross(forward, up)) <= PARALLEL * math.hypot(*forward) * math.hypot(*up):
        yield aim, f"up vectors that are not zero or parallel to the viewing direction, as that of {label} is"


def _mounting(row: CameraRow, keys: Sequence[str], turn: float = 0.0, *, label: str, gripper: Gripper) -> Iterator[Conflict]:
    """Yield a camera on the gripper that is in its shaft or cup, or sees nothing below; arguments as of `_placement`."""
    place, _, target = keys
    yield from _view_axes(row, keys, label)
    x, y, z = position(row.pose)
    if -gripper.cup_length <= z <= gripper.finger_length and math.hypot(x, y) <= max(gripper.finger_width, gripper.cup_width) / 2:
        yield place, f"positions outside of the gripper's shaft and cup, in which {label} is [m]"
    forward = viewing_direction(row.pose)
    down = math.acos(max(-1.0, min(1.0, -forward[2] / (math.hypot(*forward) or 1.0))))
    if down + turn - _cone(row) >= math.pi / 2:
        yield target, f"a point that lets {label} see below the gripper, z < 0 [m]"


def _placement(
    row: CameraRow, keys: Sequence[str], turn: float = 0.0, *, label: str, bins: Sequence[BinSizes], shift: Sides
) -> Iterator[Conflict]:
    """Yield a degenerate view, or one that does not show the bins, even if it were turned by an angle [rad]. `keys`: of its position, up
    vector and look-at point; `label`: name of the camera for messages."""
    (place, _, target), (fx, fy, *_) = keys, intrinsics(row)
    at = position(row.pose)
    if found := list(_view_axes(row, keys, label)):
        yield from found
    elif at[2] <= (floor := bins[0].origin[2]):
        yield place, f"positions above the {bins[0].noun}'s floor, z > {floor:g}, below which {label} sees no object [m]"
    elif fx > 0.0 < fy and not all(_sees_bin(row, one, spot, turn) for one in bins for spot in _places(shift)):
        yield target, f"a point that lets each camera see the {bins[0].noun}, which lies outside of the images of {label} [m]"
    elif any(_in_wall(at, one) for one in bins if one.shell):
        yield place, f"positions outside of the {bins[0].noun}'s walls, in which {label} is [m]"


def _jitter(key: str, row: CameraRow, jitter: Jitter, placement: Callable[..., Iterator[Conflict]]) -> Iterator[Conflict]:
    """Yield jitter that is none, or after which the camera would not be allowed by its matrix or `placement`; each draw by itself."""
    for name in ("position", "rotation", "focal_length", "center"):
        kind = getattr(jitter, name)
        if kind.kind == FIXED and kind.bounds() != (0.0, 0.0):
            yield f"{key}.{name}", "a distribution, such as { normal = [0, 0.002] }; what all episodes share belongs to pose and matrix"
    turn = math.radians(math.sqrt(2.0) * max(map(abs, jitter.rotation.bounds())))
    for name, drawn in _extremes(row, jitter):
        width, height = drawn.resolution or (0, 0)
        found = [*_matrix(key, drawn.matrix, width, height)] if drawn.matrix is not None else []
        found += placement(drawn, (key,) * 3, turn if name == "rotation" else 0.0)
        if name in ("focal_length", "center") and (fault := _lens_fault(drawn)):
            found.append((key, f"a lens that covers the image, but {fault}"))
        yield from ((f"{key}.{name}", f"less, so that every draw has {rule}") for _, rule in found)


def _extremes(row: CameraRow, jitter: Jitter) -> Iterator[tuple[str, CameraRow]]:
    """Rows over what may be drawn of a camera, its ends included, each with the name of its distribution; without rotations."""
    least, most = jitter.position.bounds()
    even = [least + (most - least) * part / STEPS for part in range(STEPS + 1)]
    # And those that lead to the axes, about which the shaft and the bins lie.
    x, y, z = ((*even, max(least, min(most, -value))) for value in position(row.pose))
    for offset in itertools.product(x, y, z):
        yield "position", replace(row, pose=moved(row.pose, offset))
    yield "rotation", row
    fx, fy, cx, cy = intrinsics(row)
    zooms, ends = jitter.focal_length.bounds(), jitter.center.bounds()
    for zoom in zooms:
        yield "focal_length", replace(row, fov=None, matrix=((fx * (1.0 + zoom), 0.0, cx), (0.0, fy * (1.0 + zoom), cy), (0.0, 0.0, 1.0)))
    for x, y in itertools.product(ends, ends):
        # A lens bends most where the image reaches farthest from its axis: with the shortest focal length.
        zoom = 1.0 + (min(zooms) if row.distortion else 0.0)
        yield "center", replace(row, fov=None, matrix=((fx * zoom, 0.0, cx + x), (0.0, fy * zoom, cy + y), (0.0, 0.0, 1.0)))


def _matrix(key: str, matrix: tuple[tuple[float, float, float], ...], width: int, height: int) -> Iterator[Conflict]:
    """Yield a camera matrix that is singular, skewed or implausible for images of this size."""
    (fx, skew, cx), (other, fy, cy), last = matrix
    low, high = (factor * width for factor in FOCAL_LENGTHS)
    if last != (0.0, 0.0, 1.0) or other != 0.0:
        yield key, "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
    elif skew != 0.0:
        yield key, "a matrix without skew: 0 beside fx"
    elif not (low <= fx <= high and max(fx, fy) <= ASPECT * min(fx, fy)):
        yield key, f"fx from {low:.4g} to {high:.4g}, which are a fov of 170° and 1° of {width} px, and fy within twice fx [px]"
    elif not (0.0 <= cx <= width and 0.0 <= cy <= height):
        yield key, f"a principal point cx, cy inside its images of {width} x {height} px: are numbers, or width and height, swapped? [px]"


def _lens(key: str, row: CameraRow, layers: tuple[str, ...]) -> Iterator[Conflict]:
    """Yield a distortion that is not invertible over the image, or with which a layer cannot be rendered."""
    if fault := _lens_fault(row):
        yield key, f"that of a lens which covers the image, but {fault}"
    elif lens_map(row) is not None and (found := [name for name in layers if name in SENSOR_LAYERS]):
        yield key, f"none with the layer {found[0]}, which is the rectified image of a sensor"


def _lens_fault(row: CameraRow) -> str:
    """Why a camera's distortion is not invertible over its image; empty: it is."""
    try:
        lens_map(row)
    except ConfigError as error:
        return str(error)
    return ""


def _depth_sensor(sensor: DepthSensor, rig: Rig, bins: Sequence[BinSizes]) -> Iterator[Conflict]:
    """With layers of a depth sensor: the bins must lie within what the sensor measures, and its disparity be more than a step."""
    for index, row in _world_rows(rig):
        focal, depths = intrinsics(row)[0], _bin_depths(row, bins)
        near, far = max(0.0, min(depths)), max(depths)
        if sensor.distances[1] < near or sensor.distances[0] > far:
            yield (
                "depth_sensor.distances",
                f"a range that reaches the {bins[0].noun}, {near:.3g} to {far:.3g} m from {rig.label(index)} [m]",
            )
        if focal * sensor.baseline > far * sensor.max_disparity > 0.0:
            most = sensor.max_disparity * far / focal
            yield (
                "depth_sensor.baseline",
                f"at most {most:.3g}, so that the {bins[0].noun}'s disparity is within max_disparity; or a shorter lens [m]",
            )
        if focal * sensor.baseline < sensor.disparity_step * far:
            least = sensor.disparity_step * far / focal
            rule = f"so that the disparity of the {bins[0].noun} is a disparity_step or more [m]"
            yield "depth_sensor.baseline", f"at least {least:.3g}, {rule}"


def _search(sensor: DepthSensor, rig: Rig, bins: Sequence[BinSizes]) -> Iterator[Conflict]:
    """With the layer depth_stereo: the bins must lie within the disparities that are searched, which begin at the farthest depth's."""
    for _, row in _world_rows(rig):
        focal, near = intrinsics(row)[0], min(_bin_depths(row, bins))
        if near <= 0.0:
            continue
        scale, reach = focal * sensor.baseline, MAX_DISPARITIES - 2
        nearest = min(scale / near, sensor.max_disparity or math.inf)
        if nearest - scale / sensor.distances[1] > reach:
            rule = f"a maximum of at most {scale / (nearest - reach):.3g}, from which on {MAX_DISPARITIES} disparities are searched"
            yield "depth_sensor.distances", f"{rule}, as the {bins[0].noun} begins at {near:.3g} m; or a shorter lens [m]"


def _depth_scale(bop: Bop, rig: Rig, bins: Sequence[BinSizes]) -> Iterator[Conflict]:
    """Yield the depth scale if 16 bits do not reach the farthest corner of the bins."""
    far = max((depth for _, row in _world_rows(rig) for depth in _bin_depths(row, bins)), default=0.0)
    if bop.depth_scale * 1e-3 * DEPTH_COUNTS < far:
        yield "bop.depth_scale", f"at least {far * 1e3 / DEPTH_COUNTS:.3g}, so that 16 bits reach the {bins[0].noun} at {far:.3g} m [mm]"


def _world_rows(rig: Rig) -> Iterator[tuple[int, CameraRow]]:
    """Indices and rows of the cameras that do not move: the others come as close to a bin as the gripper, and as far as it waits."""
    return ((index, row) for index, row in enumerate(rig.rows) if not rig.moves(index))


def _bin_depths(row: CameraRow, bins: Sequence[BinSizes]) -> list[float]:
    """Planar depths of the corners of the bins' outer boxes in the image of a camera [m]."""
    at, forward = position(row.pose), viewing_direction(row.pose)
    size = math.hypot(*forward) or 1.0
    corners = [corner for one in bins for corner in one.corners]
    return [sum((c - a) * f for a, c, f in zip(at, corner, forward, strict=True)) / size for corner in corners]


def _places(shift: Sides) -> list[Sides]:
    """Places of the bin at the ends of its offsets [m]."""
    x, y = shift
    return sorted({(-x, -y), (-x, y), (x, -y), (x, y)})


def _sees_bin(row: CameraRow, sizes: BinSizes, place: Sides, turn: float) -> bool:
    """Whether the bounding sphere of a bin at a place meets the cone around a camera's view, which is wider than its image, even if it is
    turned by an angle [rad]."""
    height = sizes.height - sizes.base
    center = (place[0] + sizes.origin[0], place[1] + sizes.origin[1], sizes.ground + height / 2)
    forward = viewing_direction(row.pose)
    away, radius = [b - a for a, b in zip(position(row.pose), center, strict=True)], math.hypot(*sizes.outer, height) / 2
    distance = math.hypot(*away)
    if distance <= radius:
        return True
    cosine = sum(a * b for a, b in zip(forward, away, strict=True)) / (math.hypot(*forward) * distance)
    return math.acos(max(-1.0, min(1.0, cosine))) + turn <= _cone(row) + math.asin(radius / distance)


def _cone(row: CameraRow) -> float:
    """Angle between the optical axis and the farthest corner of a camera's image, without its distortion [rad]."""
    (columns, rows), (fx, fy, cx, cy) = row.resolution or (0, 0), intrinsics(row)
    return math.atan(math.hypot(max(cx, columns - cx) / fx, max(cy, rows - cy) / fy))


def _in_wall(at: tuple[float, ...], sizes: BinSizes) -> bool:
    """Whether a point lies in the walls of a bin: in its outer box, but not above the floor between the walls of the opening."""
    x, y, z = sizes.to_frame(at)
    inside = [abs(value) < size / 2 for value, size in zip((x, y), sizes.outer, strict=True)]
    share = z / sizes.height
    free = [abs(v) < (f + (r - f) * share) / 2 for v, f, r in zip((x, y), sizes.floor, sizes.opening, strict=True)]
    return 0.0 < share < 1.0 and all(inside) and not all(free)


def _cross(a: tuple[float, ...], b: tuple[float, ...]) -> tuple[float, float, float]:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
