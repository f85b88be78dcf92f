"""Temporal accumulation of coarse light: an exponential moving average over the frames of an episode (after Schied et al., 2017, SVGF).

Cameras do not move, so a resting surface stays at its pixel and nothing is reprojected. A coarse pixel keeps less of its history the
farther its body moves, and the more other bodies that move near it can change its light.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.brdf import SplitRadiance
from synpick_warp.kernels.render.lighting.color import pack_half3, unpack_half3
from synpick_warp.kernels.render.lighting.moving_bodies import MAX_FRAMES, MovingBodies, mean_projected_area
from synpick_warp.kernels.render.lighting.tile_flags import TileFlags
from synpick_warp.kernels.render.visibility.camera import AnyViews
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Meshes, body_of
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.state import Frames

wp.set_module_options({"enable_backward": False})

LIGHT_CHANGE = wp.constant(0.07)
"""Temporal lag that an average may have, as a fraction of the light, see `lag_frames`; compared with others in tools/DECISIONS.md."""
MAX_TRAVEL = wp.constant(2.0)
"""Displacement of a body [sizes] from which on it changes no more of a point's light: it covers as much elsewhere as it has uncovered."""
LAG_STEPS = wp.constant(3)
"""Newton iterations of `lag_frames`: each before the solution brings at least one more body, the fastest first, to MAX_TRAVEL."""
MIN_CHANGE = wp.constant(1.0e-6)
"""Change of a point's light below which it counts as unchanged: histories are far shorter than LIGHT_CHANGE / MIN_CHANGE."""
MIN_SKIP_PATHS = wp.constant(2)
"""Shortest history [paths] that is updated in only some of the frames."""
MAX_PERIOD_BITS = wp.constant(5)
"""Binary logarithm of the longest update period [frames]."""
PHASE_STEP = wp.constant(11)
"""Difference of the phases of the update periods of two cameras, or of two episodes [frames]; odd, so that views are updated in turn."""
PERIOD_PATHS = wp.constant(64)
"""Length of the sample sequence of each update period [paths], after which it repeats: twice the default maximum history length."""
NEVER = wp.constant(-2)
"""Frame index of an empty history, which no frame continues."""


@wp.struct
class LightHistory:
    """Temporal accumulation: averaged light of the coarse pixels, its history length, and the previous frame's shadow rays, by world and
    camera.

    Members are named as in `CoarseLight`; the unoccluded light is not accumulated.
    """

    diffuse: wp.array3d[wp.uint64]
    specular: wp.array3d[wp.uint64]
    indirect: wp.array3d[wp.uint64]
    """(world_camera, cell_row, cell_column): packed as in `CoarseLight`."""
    segment: wp.array3d[wp.uint8]
    """(world_camera, cell_row, cell_column): segmentation id of the visible surface."""
    paths: wp.array3d[wp.uint8]
    """(world_camera, cell_row, cell_column): history length, the number of paths in the average, at most `max_paths`."""
    shadows: wp.array3d[wp.uint16]
    """(world_camera, shadow_row, shadow_column): shadow rays of the last frame, packed by `shadows.pack_last`."""
    episode: wp.array[int]
    """(world_camera): episode of the last frame."""
    frame: wp.array[int]
    """(world_camera): index of the last frame; NEVER: none."""
    cameras: int
    max_paths: int
    """Maximum history length [paths]; 0: no history is kept."""
    kept: int
    """Worlds times cameras, from the first on, of which tiles are kept from frame to frame."""


@kernel_of_views
def advance_history_kernel(snapshot: Frames, views: AnyViews, history_inout: LightHistory, moving_out: MovingBodies, flags_out: TileFlags):
    """Write `holds` (the history contains the previous frame of the same episode), set episode and frame of the history to this frame's,
    and choose the rows of `flags_out`: a view of which nothing is kept gets one behind the kept ones, as scratch. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    slot = world * history_inout.cameras + views.slot[view]
    is_kept = slot < history_inout.kept
    flags_out.history_row[view] = slot
    flags_out.kept_row[view] = wp.where(is_kept, slot, history_inout.kept + view)
    holds = history_inout.episode[slot] == snapshot.episode[world] and history_inout.frame[slot] + 1 == snapshot.frame[world]
    moving_out.holds[view] = int(holds)
    flags_out.holds[view] = int(holds and is_kept)
    history_inout.episode[slot] = snapshot.episode[world]
    history_inout.frame[slot] = snapshot.frame[world]


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
    shot: AnyShot,
    view: int,
    row: int,
    column: int,
    segment: int,
    point: wp.vec3,
) -> int:
    """Maximum history length of a coarse pixel [frames], from the body's displacement and the change of its light (`lag_frames`). 0 rejects
    the history: another segmentation id was visible, the body moved too far, or the previous frame is missing."""
    if history.max_paths == 0 or moving.holds[view] == 0:
        return 0
    slot = shot.views.world[view] * history.cameras + shot.views.slot[view]
    if int(history.segment[slot, row, column]) != segment:
        return 0
    frames = int(MAX_FRAMES)
    if segment != Segment.TABLE:
        frames = moving.drift_frames[view, body_of(segment, shot.views.instances)]
    if frames == 0:
        return 0
    enough = float(history.max_paths << MAX_PERIOD_BITS)
    return wp.min(frames, int(wp.min(lag_frames(meshes, moving, view, point, enough), float(MAX_FRAMES))))


@wp.func
def period_bits(paths: int, limit: int) -> int:
    """Base-2 logarithm of a coarse pixel's update period [frames]: a history of 2, 4 or 8 paths receives a new path every 2, 4 or 8 frames;
    0: every frame. The period is limited so that MIN_SKIP_PATHS periods fit into `limit` frames, see `lag_limit`."""
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
    """Sample index of a coarse pixel's path; unique within a history of default length. Each update period uses its own range of
    PERIOD_PATHS consecutive indices."""
    return (frame >> bits) % PERIOD_PATHS + PERIOD_PATHS * bits


@wp.func
def phase_frame(history: LightHistory, slot: int) -> int:
    """Frame of a row of the history, counted from the phase of its camera and episode (`is_due`)."""
    return history.frame[slot] + PHASE_STEP * (history.episode[slot] % (1 << MAX_PERIOD_BITS) + slot % history.cameras)


@wp.func
def is_due(frame: int, bits: int) -> bool:
    """Whether coarse pixels with update periods of 2^bits frames trace their path in a frame of `phase_frame`.

    All of a view do so in the same frame, and those of longer periods together with those of shorter ones: so in most frames much of a
    picture keeps its light, and whole tiles of it their bits (`dirty_tiles`).
    """
    return frame % (1 << bits) == 0


@wp.func
def scale_light(light: SplitRadiance, factor: float) -> SplitRadiance:
    """Light with all members multiplied by a factor."""
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
    """Exponential moving average: (1 - weight) times the history plus `weight` times `light`."""
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
    """Add the light of new paths to a coarse pixel's history, and return the new average. `light`: mean of the new paths, pre-exposed.
    `known`: paths of the history that are kept; 0: it is replaced. `samples`: number of new paths; 1 if `known` is above 0, so that the new
    path has the weight 1 / (known + 1)."""
    average = light
    if known > 0:
        average = blend_light(read_history(history, slot, row, column), light, 1.0 / float(known + 1))
    write_history(history, slot, row, column, segment, average, known + samples)
    return average
