"""Temporal accumulation of coarse light: an exponential moving average over the frames of an episode (after Schied et al., 2017, SVGF).

Cameras do not move, so a resting surface stays at its pixel and nothing is reprojected. A coarse pixel keeps less of its history the
farther its body moves, and the more other bodies that move near it can change its light.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import SplitRadiance
from synpick_warp.kernels.render.lighting.color import pack_half3, unpack_half3
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.render.visibility.gbuffer import Meshes, body_of

wp.set_module_options({"enable_backward": False})

REST_DISPLACEMENT = wp.constant(2.5e-4)
"""Rest threshold: a body that displaces none of its points by more in a frame does not change the light of others [m]."""
MAX_DRIFT = wp.constant(4.0e-3)
"""Maximum displacement of a body over the frames that its own histories average [m]: at most two coarse pixels in full HD."""
LIGHT_CHANGE = wp.constant(0.05)
"""Temporal lag that an average may have, as a fraction of the light; see `lag_frames`."""
MAX_TRAVEL = wp.constant(2.0)
"""Displacement of a body [sizes] from which on it changes no more of a point's light: it has uncovered all that it covered, and covers as
much elsewhere."""
LAG_STEPS = wp.constant(3)
"""Newton iterations of `lag_frames`: each that does not reach the solution brings at least one more body, the fastest first, to
MAX_TRAVEL."""
MIN_CHANGE = wp.constant(1.0e-6)
"""Change of a point's light below which it counts as unchanged: histories are far shorter than LIGHT_CHANGE / MIN_CHANGE."""
MIN_SKIP_PATHS = wp.constant(2)
"""Shortest history [paths] that is updated in only some of the frames."""
MAX_PERIOD_BITS = wp.constant(3)
"""Binary logarithm of the longest update period [frames]."""
BAYER_BITS = wp.constant(4)
"""Bits of a threshold of the 4 x 4 Bayer matrix."""
PERIOD_PATHS = wp.constant(64)
"""Part of the sample sequence of each update period, which repeats after it [paths]: four times as many as a history counts by default."""
MAX_FRAMES = wp.constant(1 << 20)
"""Maximum history length where nothing changes [frames]: longer than any history."""
NEVER = wp.constant(-2)
"""Frame index of an empty history, which no frame continues."""


@wp.struct
class LightHistory:
    """Average light of the coarse pixels of each world and camera, over the frames of an episode; members as in `CoarseLight`."""

    diffuse: wp.array3d[wp.uint64]
    specular: wp.array3d[wp.uint64]
    indirect: wp.array3d[wp.uint64]
    """(world_camera, cell_row, cell_column): packed as in `CoarseLight`."""
    segment: wp.array3d[wp.uint8]
    """(world_camera, cell_row, cell_column): segmentation id of the visible surface."""
    paths: wp.array3d[wp.uint8]
    """(world_camera, cell_row, cell_column): history length, the number of paths in the average, at most `max_paths`."""
    episode: wp.array[int]
    """(world_camera): episode of the last frame."""
    frame: wp.array[int]
    """(world_camera): index of the last frame; NEVER: none."""
    cameras: int
    """Cameras of a world."""
    max_paths: int
    """Maximum history length [paths]; 0: no history is kept."""


@wp.struct
class MovingBodies:
    """Motion of the bodies of each view since the previous frame. Scratch."""

    holds: wp.array[int]
    """(view): 1: the history contains the previous frame of the same episode."""
    drift_frames: wp.array2d[int]
    """(view, body): maximum history length on the body itself, MAX_DRIFT over its displacement in a frame."""
    count: wp.array[int]
    """(view): number of bodies that moved, appeared or disappeared."""
    mesh: wp.array2d[int]
    """(view, rank): row of `Meshes` of each moving body."""
    to_body: wp.array2d[wp.transformf]
    """(view, rank): world to body [m]; of a body that disappeared, at its last pose."""
    change: wp.array2d[float]
    """(view, rank): displacement as a fraction of the body's size, at most 1."""


@wp.func
def mean_projected_area(size: wp.vec3) -> float:
    """Mean area of the projections of a box along all directions: a quarter of its surface (Cauchy) [m²]."""
    return 0.5 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])


@wp.func
def max_displacement(now: wp.transformf, then: wp.transformf, center: wp.vec3, radius: float) -> float:
    """Upper bound of the displacement of the points of a body: that of its bounding sphere's centre and the turn about it [m]."""
    turn = wp.transform_get_rotation(now) * wp.quat_inverse(wp.transform_get_rotation(then))
    sine = wp.length(wp.vec3(turn[0], turn[1], turn[2]))
    return wp.length(wp.transform_point(now, center) - wp.transform_point(then, center)) + 2.0 * radius * wp.min(sine, 1.0)


@wp.kernel
def advance_history_kernel(
    # State: worlds
    episode: wp.array[int],  # (world)
    frame: wp.array[int],  # (world)
    # In:
    views: Views,
    # Out:
    history_inout: LightHistory,
    moving_out: MovingBodies,
):
    """Write `holds`, and advance the history's frame index to this frame."""
    view = wp.tid()
    world = views.world[view]
    slot = world * history_inout.cameras + views.camera[view]
    moving_out.holds[view] = int(history_inout.episode[slot] == episode[world] and history_inout.frame[slot] + 1 == frame[world])
    history_inout.episode[slot] = episode[world]
    history_inout.frame[slot] = frame[world]


@wp.func
def displacement_fraction(meshes: Meshes, mesh: int, displacement: float) -> float:
    """Displacement of a body's points [m] as a fraction of its size, at most 1; 0: it rests."""
    if displacement <= REST_DISPLACEMENT:
        return 0.0
    return wp.min(displacement / wp.sqrt(mean_projected_area(meshes.upper[mesh] - meshes.lower[mesh])), 1.0)


@wp.kernel
def find_moving_bodies_kernel(
    # Scene:
    meshes: Meshes,
    # State: worlds
    catalog_index: wp.array2d[int],  # (world, instance)
    pose: wp.array2d[wp.transformf],  # (world, instance) [m]
    fixture_pose: wp.array2d[wp.transformf],  # (world, fixture) [m]
    fixture_visible: wp.array2d[int],  # (world, fixture)
    last_catalog_index: wp.array2d[int],  # (world, instance)
    last_pose: wp.array2d[wp.transformf],  # (world, instance) [m]
    last_fixture_pose: wp.array2d[wp.transformf],  # (world, fixture) [m]
    last_fixture_visible: wp.array2d[int],  # (world, fixture)
    # In:
    views: Views,
    bodies: int,
    # Out:
    moving_inout: MovingBodies,
):
    """List the bodies of each view that moved since the previous frame, came or went, if the history holds that frame (`holds`)."""
    view = wp.tid()
    if moving_inout.holds[view] == 0:
        return
    world = views.world[view]
    count = int(0)
    for body in range(bodies):
        mesh = int(-1)
        last_mesh = int(-1)
        now = wp.transform_identity(dtype=float)
        then = wp.transform_identity(dtype=float)
        if body < views.instances:
            mesh = catalog_index[world, body]
            last_mesh = last_catalog_index[world, body]
            now = pose[world, body]
            then = last_pose[world, body]
        else:
            fixture = body - views.instances
            mesh = wp.where(fixture_visible[world, fixture] != 0, meshes.entries + fixture, -1)
            last_mesh = wp.where(last_fixture_visible[world, fixture] != 0, meshes.entries + fixture, -1)
            now = fixture_pose[world, fixture]
            then = last_fixture_pose[world, fixture]
        change = float(mesh != last_mesh)
        drift_frames = wp.where(mesh != last_mesh, 0, MAX_FRAMES)
        if mesh == last_mesh and mesh >= 0:
            displacement = max_displacement(now, then, meshes.center[mesh], meshes.radius[mesh])
            change = displacement_fraction(meshes, mesh, displacement)
            drift_frames = int(MAX_DRIFT / wp.max(displacement, MAX_DRIFT / float(MAX_FRAMES)))
        moving_inout.drift_frames[view, body] = drift_frames
        if change > 0.0:
            moving_inout.mesh[view, count] = wp.where(mesh >= 0, mesh, last_mesh)
            moving_inout.to_body[view, count] = wp.transform_inverse(wp.where(mesh >= 0, now, then))
            moving_inout.change[view, count] = change
            count += 1
    moving_inout.count[view] = count


@wp.func
def covered_fraction(meshes: Meshes, moving: MovingBodies, view: int, rank: int, point: wp.vec3) -> float:
    """Fraction of the full sphere around a point that a moving body covers: its mean projected area at the distance of its box."""
    mesh = moving.mesh[view, rank]
    local = wp.transform_point(moving.to_body[view, rank], point)
    lower = meshes.lower[mesh]
    upper = meshes.upper[mesh]
    away = local - wp.max(lower, wp.min(local, upper))
    area = mean_projected_area(upper - lower)
    return area / (4.0 * wp.PI * wp.dot(away, away) + area)


@wp.func
def lag_frames(meshes: Meshes, moving: MovingBodies, view: int, point: wp.vec3, enough: float) -> float:
    """Number of frames n after which the moving bodies have changed a point's light by LIGHT_CHANGE; iterations end at `enough`.

    The change is estimated as the sum over the bodies of the `covered_fraction` times min(n · displacement in sizes, MAX_TRAVEL). It is
    concave in n, so Newton's method from n = 0 approaches the solution from below.
    """
    frames = float(0.0)
    step = int(0)
    while step < LAG_STEPS and frames < enough:
        change = float(0.0)
        slope = float(0.0)
        for rank in range(moving.count[view]):
            covered = covered_fraction(meshes, moving, view, rank, point)
            travel = frames * moving.change[view, rank]
            if travel < MAX_TRAVEL:
                change += travel * covered
                slope += moving.change[view, rank] * covered
            else:
                change += MAX_TRAVEL * covered
        frames += (LIGHT_CHANGE - change) / wp.max(slope, MIN_CHANGE)
        step += 1
    return frames


@wp.func
def lag_limit(
    meshes: Meshes,
    history: LightHistory,
    moving: MovingBodies,
    views: Views,
    view: int,
    row: int,
    column: int,
    segment: int,
    point: wp.vec3,
) -> int:
    """Maximum history length of a coarse pixel [frames], from the body's displacement and the change of its light (`lag_frames`).

    0 rejects the history: another segmentation id was visible, the body moved too far, or the previous frame is missing.
    """
    if history.max_paths == 0 or moving.holds[view] == 0:
        return 0
    slot = views.world[view] * history.cameras + views.camera[view]
    if int(history.segment[slot, row, column]) != segment:
        return 0
    frames = int(MAX_FRAMES)
    if segment != Segment.TABLE:
        frames = moving.drift_frames[view, body_of(segment, views.instances)]
    if frames == 0:
        return 0
    enough = float(history.max_paths << MAX_PERIOD_BITS)
    return wp.min(frames, int(wp.min(lag_frames(meshes, moving, view, point, enough), float(MAX_FRAMES))))


@wp.func
def period_bits(paths: int, limit: int) -> int:
    """Binary logarithm of a coarse pixel's update period: with 2, 4, 8 paths it traces one every 2, 4, 8 frames; 0: every frame.

    The period is shortened until MIN_SKIP_PATHS periods fit into `limit` frames, see `lag_limit`.
    """
    bits = int(0)
    while bits < MAX_PERIOD_BITS and (MIN_SKIP_PATHS << bits) <= paths and (MIN_SKIP_PATHS << (bits + 1)) <= limit:
        bits += 1
    return bits


@wp.func
def usable_paths(history: LightHistory, slot: int, row: int, column: int, limit: int) -> tuple[int, int]:
    """History rejection: (number of paths of the history to keep, `period_bits`), for the `limit` of `lag_limit`; (0, 0): rejected."""
    if limit == 0:
        return 0, 0
    paths = int(history.paths[slot, row, column])
    bits = period_bits(paths, limit)
    return wp.min(paths, limit >> bits), bits


@wp.func
def path_number(frame: int, bits: int) -> int:
    """Index of a coarse pixel's path in its sequence, distinct within a history of default length that begins in any frame.

    Each update period has a part of the sequence of its own, PERIOD_PATHS long, and takes its paths in order.
    """
    return (frame >> bits) % PERIOD_PATHS + PERIOD_PATHS * bits


@wp.func
def update_frame(row: int, column: int, bits: int) -> int:
    """Frame of the update period, 0 to 2^bits - 1, in which a coarse pixel traces its path: 4 x 4 ordered dithering (Bayer, 1973).

    Coarse pixels that trace in the same frame are spread evenly. The pattern repeats every LANE_STRIDE coarse pixels, so that threads of
    a warp with the same update period trace in the same frame.
    """
    other = row ^ column
    threshold = ((other & 1) << 3) | ((row & 1) << 2) | (other & 2) | ((row & 2) >> 1)
    return threshold >> (BAYER_BITS - bits)


@wp.func
def scale_light(light: SplitRadiance, factor: float) -> SplitRadiance:
    """Multiply all members by a factor."""
    result = SplitRadiance()
    result.diffuse = factor * light.diffuse
    result.specular = factor * light.specular
    result.indirect = factor * light.indirect
    return result


@wp.func
def history_frame(history: LightHistory, slot: int, usable: int) -> int:
    """Index of this frame in its episode; 0 if the history has no usable paths."""
    if usable == 0:
        return 0
    return history.frame[slot]


@wp.func
def read_history(history: LightHistory, slot: int, row: int, column: int) -> SplitRadiance:
    """Average light of a coarse pixel, in units of `CoarseLight`."""
    result = SplitRadiance()
    result.diffuse = unpack_half3(history.diffuse[slot, row, column])
    result.specular = unpack_half3(history.specular[slot, row, column])
    result.indirect = unpack_half3(history.indirect[slot, row, column])
    return result


@wp.func
def blend_light(history: SplitRadiance, light: SplitRadiance, weight: float) -> SplitRadiance:
    """Exponential moving average: `light` counts with `weight`."""
    result = SplitRadiance()
    result.diffuse = wp.lerp(history.diffuse, light.diffuse, weight)
    result.specular = wp.lerp(history.specular, light.specular, weight)
    result.indirect = wp.lerp(history.indirect, light.indirect, weight)
    return result


@wp.func
def write_history(history: LightHistory, slot: int, row: int, column: int, segment: int, light: SplitRadiance, paths: int):
    """Store the average light of a coarse pixel and the paths that it counts, if a history is kept."""
    if history.max_paths == 0:
        return
    history.diffuse[slot, row, column] = pack_half3(light.diffuse)
    history.specular[slot, row, column] = pack_half3(light.specular)
    history.indirect[slot, row, column] = pack_half3(light.indirect)
    history.segment[slot, row, column] = wp.uint8(segment)
    history.paths[slot, row, column] = wp.uint8(wp.min(paths, history.max_paths))


@wp.func
def accumulate(
    history: LightHistory, slot: int, row: int, column: int, segment: int, light: SplitRadiance, known: int, samples: int
) -> SplitRadiance:
    """Add the light of new paths to a coarse pixel's history, and return the new average.

    Args:
        light: Mean of the new paths, pre-exposed.
        known: Paths of the history that are kept; 0: it is replaced.
        samples: Number of new paths; 1 if `known` is above 0, so that the new path has the weight 1 / (known + 1).
    """
    average = light
    if known > 0:
        average = blend_light(read_history(history, slot, row, column), light, 1.0 / float(known + 1))
    write_history(history, slot, row, column, segment, average, known + samples)
    return average
