"""Two-phase stratified sampling (Särndal, Swensson and Wretman, 1992) of grasp candidates, pixels of the perception image of a state.

Phase one draws a pool of pixels uniformly and scores them; phase two draws candidates from strata of the pool, by instance and score.
Candidates have inverse-probability weights. Random numbers are functions of (seed, episode, arrangement, attempt, index), so that
candidates depend on the state alone. A view shows the world into which the state is loaded.
"""

import warp as wp

from synpick_warp.codes import Share, Stream
from synpick_warp.kernels.grasps import Grasps
from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.render.images.layers import LayerScene
from synpick_warp.kernels.render.images.suction_map import loaded_wrench, obstructed_seal, place_cup
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.render.visibility.gbuffer import ShotData
from synpick_warp.kernels.rng import GAMMA, mix, pixel_key, stream_key
from synpick_warp.kernels.state import Attempts, Observations, Plans, Worlds

wp.set_module_options({"enable_backward": False})

POOL = wp.constant(1024)
"""Pixels of the pool."""
STRATA = wp.constant(5)
"""Strata of an instance, of equal width in seal score x wrench score: their limits are SuctionNet's thresholds 0.2, 0.4, 0.6 and 0.8."""
STARTS = wp.constant(2**30)
"""Index of the random sample that chooses the first instance; samples below draw the pixels, those above choose strata."""
NOWHERE = wp.constant(wp.vec2i(-1, -1))
"""Pixel of a draw without one."""


@wp.struct
class Pool:
    """Sample buffer: drawn pixels of each view (POOL of phase one, the uniform share, the planned grasp's), scores, pixel counts."""

    row_first: wp.array2d[int]
    """(view, image row): number of labelled pixels in the rows above (exclusive prefix sum)."""
    pixels: wp.array[int]
    """(view): number of labelled pixels."""
    visible: wp.array2d[int]
    """(view, instance): 1: visible; 0: not."""
    pixel: wp.array2d[wp.vec2i]
    """(view, draw): column and row [px]; (-1, -1): none."""
    seal: wp.array2d[float]
    """(view, draw): seal score."""
    wrench: wp.array2d[float]
    """(view, draw): wrench score."""
    count: wp.array3d[int]
    """(view, instance, stratum): number of pixels of phase one."""


@wp.struct
class Candidates:
    """Sampling design of grasp candidates: `Share`, inverse probability, pixel, object, normal, scores. A state's are consecutive."""

    share: wp.array[int]
    """(grasp): `Share`."""
    weight: wp.array[float]
    """(grasp): inverse of the probability with which one draw of its share gets the pixel; 0: the planned grasp, which is not drawn."""
    pixel: wp.array[wp.vec2i]
    """(grasp): column and row [px]."""
    entry: wp.array[int]
    """(grasp): catalog index of the instance."""
    surface_normal: wp.array[wp.vec3]
    """(grasp): smoothed unit normal of the surface in the world; `Grasps.normal` is the axis of the cup."""
    seal: wp.array[float]
    """(grasp): seal score."""
    wrench: wp.array[float]
    """(grasp): wrench score."""


@wp.struct
class Sampling:
    """A batch of `count` states from number `first` on, whose candidates are sampled, one a view."""

    count: int
    first: int
    index: wp.array[int]
    """(one): index of the candidate whose grasp is planned."""
    row: wp.array[int]
    """(world): row of the saved state; -1: none."""


@wp.func
def view_stream(seed: wp.uint64, arrangement_id: wp.vec2i, attempt: int) -> wp.uint64:
    """Key of the random stream that samples the candidates of a state."""
    return pixel_key(stream_key(seed, arrangement_id[0], arrangement_id[1], Stream.CANDIDATES), attempt)


@wp.func
def wide_index(key: wp.uint64, index: int, count: int) -> int:
    """Sample `index` of a stream as an integer, uniform in [0, count): 63 bits modulo `count`, where `rng.uniform_index` has 24 bits."""
    bits = mix(key + (wp.uint64(index) + wp.uint64(1)) * GAMMA)
    return int((bits >> wp.uint64(1)) % wp.uint64(count))


@wp.func
def stratum_of(seal: float, wrench: float) -> int:
    """Stratum of a pixel: STRATA equal intervals of the product of its scores, each 0 to 1."""
    return wp.min(int(seal * wrench * float(STRATA)), STRATA - 1)


@wp.kernel
def assign_states_kernel(
    # Scene:
    first: int,
    views: int,
    # In:
    rows: wp.array[int],  # (state)
    # Out:
    row_out: wp.array[int],  # (world)
    world_out: wp.array[int],  # (view)
):
    """Assign a batch of states to worlds: world w gets `rows[first + w]`, and view w shows it; -1: none. Launched over world."""
    world = wp.tid()
    row = int(-1)
    if world < views and first + world < rows.shape[0]:
        row = rows[first + world]
    row_out[world] = row
    if world < views:
        world_out[world] = wp.where(row < 0, -1, world)


@wp.kernel
def label_instances_kernel(layer: LayerScene, shot: ShotData, patches_out: Patches):
    """Instance segmentation: write the instance that each pixel shows; -1: none, or one whose object has no `obj_id`.

    Written where perception keeps the labels of connected components. Launched over view, image row, column.
    """
    view, row, column = wp.tid()
    if shot.views.world[view] < 0:
        return
    instance = int(shot.gbuffer.segment[view, row, column]) - 1
    label = int(-1)
    if instance >= 0 and instance < shot.views.instances:
        if layer.obj_id[shot.bodies.mesh[view, instance]] >= 0:
            label = instance
    patches_out.component[view, row, column] = label


@wp.kernel
def count_rows_kernel(views: Views, patches: Patches, pool_inout: Pool):
    """Count the labelled pixels of each image row, and set `visible` of its instances to 1; 0 before. Launched over view, image row."""
    view, row = wp.tid()
    if views.world[view] < 0:
        return
    count = int(0)
    for column in range(patches.component.shape[2]):
        instance = patches.component[view, row, column]
        if instance >= 0:
            count += 1
            pool_inout.visible[view, instance] = 1
    pool_inout.row_first[view, row] = count


@wp.kernel
def sum_rows_kernel(views: Views, patches_out: Patches, pool_inout: Pool):
    """Exclusive prefix sum of the counts of image rows, in place, and their total.

    `largest`, perception's largest component of each instance, becomes the instance itself: all its visible pixels. Launched over view.
    """
    view = wp.tid()
    if views.world[view] < 0:
        return
    total = int(0)
    for row in range(pool_inout.row_first.shape[1]):
        count = pool_inout.row_first[view, row]
        pool_inout.row_first[view, row] = total
        total += count
    pool_inout.pixels[view] = total
    for instance in range(views.instances):
        patches_out.largest[view, instance] = instance


@wp.func
def pixel_of_rank(pool: Pool, component: wp.array3d[int], view: int, rank: int) -> wp.vec2i:
    """Rank selection: column and row of the labelled pixel of a rank, from 0 in row-major order; (-1, -1): none.

    By binary search for the row in the prefix sums, then a scan of the row.
    """
    low = int(0)
    high = int(component.shape[1] - 1)
    while low < high:
        middle = (low + high + 1) // 2
        if pool.row_first[view, middle] <= rank:
            low = middle
        else:
            high = middle - 1
    left = rank - pool.row_first[view, low]
    for column in range(component.shape[2]):
        if component[view, low, column] >= 0:
            if left == 0:
                return wp.vec2i(column, low)
            left -= 1
    return NOWHERE


@wp.kernel
def draw_pixels_kernel(
    seed: wp.uint64,
    state: Worlds,
    attempts: Attempts,
    plan: Plans,
    observation: Observations,
    views: Views,
    patches: Patches,
    pool_inout: Pool,
):
    """Simple random sampling with replacement: draw labelled pixels uniformly; the last draw is the pixel of the planned grasp.

    Launched over view, draw.
    """
    view, draw = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    pixel = NOWHERE
    if draw == pool_inout.pixel.shape[1] - 1:
        if plan.target[world] >= 0:
            pixel = observation.grasp_pixel[world, plan.target[world]]
    elif pool_inout.pixels[view] > 0:
        key = view_stream(seed, state.arrangement_id[world], attempts.attempt[world])
        pixel = pixel_of_rank(pool_inout, patches.component, view, wide_index(key, draw, pool_inout.pixels[view]))
    pool_inout.pixel[view, draw] = pixel


@wp.kernel
def score_pixels_kernel(scene: PathScene, layer: LayerScene, shot: ShotData, pool_inout: Pool):
    """Write SuctionNet's analytic scores of each drawn pixel, as in the layers `suction_seal` and `suction_wrench`; 0: no pixel.

    Launched over view, draw.
    """
    view, draw = wp.tid()
    if shot.views.world[view] < 0:
        return
    seal = float(0.0)
    wrench = float(0.0)
    pixel = pool_inout.pixel[view, draw]
    if pixel[0] >= 0:
        cup = place_cup(scene, shot, layer.obj_id, view, pixel[1], pixel[0])
        if cup.body >= 0:
            seal = obstructed_seal(scene, shot, view, cup, layer.suction.radius)
            wrench = loaded_wrench(layer, shot, view, cup)
    pool_inout.seal[view, draw] = seal
    pool_inout.wrench[view, draw] = wrench


@wp.kernel
def count_strata_kernel(views: Views, patches: Patches, pool_inout: Pool):
    """Histogram of the pixels of phase one by instance and stratum. Launched over view, instance."""
    view, instance = wp.tid()
    if views.world[view] < 0:
        return
    for stratum in range(STRATA):
        pool_inout.count[view, instance, stratum] = 0
    for draw in range(POOL):
        pixel = pool_inout.pixel[view, draw]
        if pixel[0] >= 0:
            if patches.component[view, pixel[1], pixel[0]] == instance:
                stratum = stratum_of(pool_inout.seal[view, draw], pool_inout.wrench[view, draw])
                pool_inout.count[view, instance, stratum] = pool_inout.count[view, instance, stratum] + 1


@wp.func
def stratum_size(pool: Pool, view: int, instance: int, stratum: int) -> int:
    """Number of pool pixels of an instance in a stratum; stratum -1: in all strata."""
    if stratum >= 0:
        return pool.count[view, instance, stratum]
    total = int(0)
    for one in range(STRATA):
        total += pool.count[view, instance, one]
    return total


@wp.func
def find_stratum(pool: Pool, view: int, instance: int, place: int) -> wp.vec2i:
    """Round robin: element `place`, modulo their number, of the list of an instance's strata that have pool pixels; and their number.

    Instance -1: of the list of instances that have pool pixels.
    """
    length = STRATA
    if instance < 0:
        length = pool.count.shape[1]
    members = int(0)
    for index in range(length):
        if instance < 0:
            members += wp.min(stratum_size(pool, view, index, -1), 1)
        else:
            members += wp.min(stratum_size(pool, view, instance, index), 1)
    left = place % wp.max(members, 1)
    found = int(-1)
    for index in range(length):
        size = int(0)
        if instance < 0:
            size = stratum_size(pool, view, index, -1)
        else:
            size = stratum_size(pool, view, instance, index)
        if size > 0:
            if left == 0:
                found = index
            left -= 1
    return wp.vec2i(found, members)


@wp.func
def find_draw(pool: Pool, component: wp.array3d[int], view: int, instance: int, stratum: int, place: int) -> int:
    """Index of the draw of phase one that is the `place`-th, from 0, in a stratum of an instance; -1: none."""
    left = int(place)
    for draw in range(POOL):
        pixel = pool.pixel[view, draw]
        if component[view, pixel[1], pixel[0]] == instance:
            if stratum_of(pool.seal[view, draw], pool.wrench[view, draw]) == stratum:
                if left == 0:
                    return draw
                left -= 1
    return -1


@wp.kernel
def choose_candidates_kernel(
    seed: wp.uint64,
    uniform: int,
    sampling: Sampling,
    state: Worlds,
    attempts: Attempts,
    views: Views,
    patches: Patches,
    pool: Pool,
    candidates_out: Candidates,
    grasps_out: Grasps,
):
    """Stratified sampling of the pool: write the planned grasp, stratified candidates, and last `uniform` uniform ones of each view.

    Two nested round robins with random starts, over instances and over the strata of each that have pixels, equalize their numbers of
    candidates; pixels of a stratum are taken in the order in which they were drawn. Skips empty views. Launched over view, candidate.
    """
    view, candidate = wp.tid()
    world = views.world[view]
    if world < 0 or pool.pixels[view] == 0:
        return
    draw = int(pool.pixel.shape[1] - 1)
    share = int(Share.OWN)
    weight = float(0.0)
    if candidate >= sampling.count - uniform:
        draw = POOL + candidate - (sampling.count - uniform)
        share = int(Share.UNIFORM)
        weight = float(pool.pixels[view])
    elif candidate > 0:
        share = int(Share.STRATIFIED)
        key = view_stream(seed, state.arrangement_id[world], attempts.attempt[world])
        instances = find_stratum(pool, view, -1, 0)[1]
        place = candidate - 1 + wide_index(key, STARTS, instances)
        instance = find_stratum(pool, view, -1, place)[0]
        visit = (candidate - 1) // instances
        chosen = find_stratum(pool, view, instance, visit + wide_index(key, STARTS + 1 + instance, STRATA * (STRATA - 1) * 12))
        size = stratum_size(pool, view, instance, chosen[0])
        draw = find_draw(pool, patches.component, view, instance, chosen[0], (visit // chosen[1]) % size)
        weight = float(pool.pixels[view]) / float(POOL) * float(instances * chosen[1] * size)
    grasp = (sampling.first + view) * sampling.count + candidate
    pixel = pool.pixel[view, draw]
    instance = patches.component[view, pixel[1], pixel[0]]
    candidates_out.share[grasp] = share
    candidates_out.weight[grasp] = weight
    candidates_out.pixel[grasp] = pixel
    candidates_out.entry[grasp] = state.catalog_index[world, instance]
    candidates_out.seal[grasp] = pool.seal[view, draw]
    candidates_out.wrench[grasp] = pool.wrench[view, draw]
    grasps_out.row[grasp] = sampling.row[world]
    grasps_out.candidate[grasp] = candidate
    grasps_out.target[grasp] = instance


@wp.kernel
def aim_candidates_kernel(
    sampling: Sampling, views: Views, candidates: Candidates, grasps: Grasps, plan_out: Plans, observation_out: Observations
):
    """Write target and grasp pixel of a candidate to the plan of each view's world. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    grasp = (sampling.first + view) * sampling.count + sampling.index[0]
    plan_out.target[world] = grasps.target[grasp]
    observation_out.grasp_pixel[world, grasps.target[grasp]] = candidates.pixel[grasp]


@wp.kernel
def store_normals_kernel(sampling: Sampling, plan: Plans, views: Views, candidates_out: Candidates):
    """Write the smoothed surface normals, as unit vectors. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world >= 0:
        grasp = (sampling.first + view) * sampling.count + sampling.index[0]
        candidates_out.surface_normal[grasp] = wp.normalize(plan.normal[world])


@wp.kernel
def store_grasps_kernel(sampling: Sampling, plan: Plans, views: Views, grasps_out: Grasps):
    """Write the planned grasps of the worlds to a candidate of each view's state. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    grasp = (sampling.first + view) * sampling.count + sampling.index[0]
    grasps_out.point[grasp] = plan.point[world]
    grasps_out.normal[grasp] = plan.normal[world]
    grasps_out.yaw[grasp] = plan.yaw[world]
    grasps_out.tilt[grasp] = plan.tilt[world]


@wp.kernel
def increment_kernel(sampling_inout: Sampling):
    """Increment the candidate index, on the device so that a graph can be replayed. A single thread (dim 1)."""
    sampling_inout.index[0] = sampling_inout.index[0] + 1
