"""Grasp candidates of a view: pixels drawn uniformly and by strata of instance and analytic score, for trials of many grasps in a state.

Two-phase sampling (Särndal, Swensson and Wretman, 1992): a pool of pixels is drawn uniformly and scored, and candidates are drawn from its
strata. Random numbers are named by (seed, episode, arrangement, attempt, index), so that candidates depend on the state alone.
"""

import warp as wp

from synpick_warp.codes import Share, Stream
from synpick_warp.kernels.render.images.suction_map import GRAVITY as WEIGHT
from synpick_warp.kernels.render.images.suction_map import SuctionScene, is_obstructed, place_cup, seal_score, wrench_score
from synpick_warp.kernels.render.lighting.materials import Surfaces
from synpick_warp.kernels.render.visibility.camera import Views
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Meshes, Table, ViewBodies
from synpick_warp.kernels.rng import GAMMA, mix, pixel_key, stream_key

wp.set_module_options({"enable_backward": False})

POOL = wp.constant(1024)
"""Pixels of the first phase."""
STRATA = wp.constant(5)
"""Strata of an instance's pixels by score: SuctionNet's thresholds 0.2, 0.4, 0.6 and 0.8 are their limits."""
STARTS = wp.constant(2**30)
"""Index of the first sample that is not a pixel's."""
NOWHERE = wp.constant(wp.vec2i(-1, -1))


@wp.struct
class Pool:
    """Pixels of the first phase of each view, then those of the uniform share and the own grasp's, with their scores; and counts."""

    row_first: wp.array2d[int]
    """(view, image row): visible pixels of instances in the rows above."""
    pixels: wp.array[int]
    """(view): their number in the image."""
    visible: wp.array2d[int]
    """(view, instance): 1: it is visible."""
    pixel: wp.array2d[wp.vec2i]
    """(view, draw): column and row [px]; (-1, -1): none."""
    seal: wp.array2d[float]
    """(view, draw): seal score."""
    wrench: wp.array2d[float]
    """(view, draw): wrench score."""
    count: wp.array3d[int]
    """(view, instance, stratum): number of pixels of the first phase."""


@wp.struct
class Candidates:
    """Grasp candidates of states, those of a state in a row: how they were drawn, pixel, instance, surface normal and scores."""

    share: wp.array[int]
    """(grasp): `Share`."""
    weight: wp.array[float]
    """(grasp): inverse of the probability with which a draw of this share gets the pixel; 0: not drawn."""
    pixel: wp.array[wp.vec2i]
    """(grasp): column and row [px]."""
    entry: wp.array[int]
    """(grasp): catalog index of the instance."""
    surface_normal: wp.array[wp.vec3]
    """(grasp): smoothed unit normal of the surface; `Grasps.normal` is that of the cup."""
    seal: wp.array[float]
    """(grasp): seal score."""
    wrench: wp.array[float]
    """(grasp): wrench score."""


@wp.func
def view_stream(seed: wp.uint64, arrangement_id: wp.vec2i, attempt: int) -> wp.uint64:
    """Key of the stream of a state."""
    return pixel_key(stream_key(seed, arrangement_id[0], arrangement_id[1], Stream.CANDIDATES), attempt)


@wp.func
def wide_index(key: wp.uint64, index: int, count: int) -> int:
    """Sample `index` of a stream as an integer, uniform in [0, count); evenly so for millions, as samples have 63 bits."""
    bits = mix(key + (wp.uint64(index) + wp.uint64(1)) * GAMMA)
    return int((bits >> wp.uint64(1)) % wp.uint64(count))


@wp.func
def stratum_of(seal: float, wrench: float) -> int:
    """Stratum of a pixel by the product of its scores."""
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
    """Assign the rows of states from `first` on to the first worlds, which views of the same index show; -1: none. Launched over world."""
    world = wp.tid()
    row = int(-1)
    if world < views and first + world < rows.shape[0]:
        row = rows[first + world]
    row_out[world] = row
    if world < views:
        world_out[world] = wp.where(row < 0, -1, world)


@wp.kernel
def label_instances_kernel(
    # Scene:
    obj_id: wp.array[int],  # (entry)
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    # Out:
    component_out: wp.array3d[int],  # (view, row, column)
):
    """Label each pixel with the instance that it shows; -1: none, or one without label. Launched over view, row, column.

    In place of the labels of connected components.
    """
    view, row, column = wp.tid()
    if views.world[view] < 0:
        return
    instance = int(gbuffer.segment[view, row, column]) - 1
    label = int(-1)
    if instance >= 0 and instance < views.instances:
        if obj_id[bodies.mesh[view, instance]] >= 0:
            label = instance
    component_out[view, row, column] = label


@wp.kernel
def count_rows_kernel(
    # In:
    views: Views,
    component: wp.array3d[int],  # (view, row, column)
    # Out:
    pool_inout: Pool,
):
    """Count the labelled pixels of each image row, and flag visible instances, which must be 0 before. Launched over view, image row."""
    view, row = wp.tid()
    if views.world[view] < 0:
        return
    count = int(0)
    for column in range(component.shape[2]):
        instance = component[view, row, column]
        if instance >= 0:
            count += 1
            pool_inout.visible[view, instance] = 1
    pool_inout.row_first[view, row] = count


@wp.kernel
def sum_rows_kernel(
    # In:
    views: Views,
    # Out:
    pool_inout: Pool,
    largest_out: wp.array2d[int],  # (view, instance)
):
    """Replace the counts of image rows by exclusive prefix sums; the "largest component" of an instance is all that is visible of it.

    Launched over view.
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
        largest_out[view, instance] = instance


@wp.func
def pixel_of_rank(pool: Pool, component: wp.array3d[int], view: int, rank: int) -> wp.vec2i:
    """The labelled pixel with `rank` others before it in row-major order: binary search of the row, then a walk along it."""
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
    # Scene:
    seed: wp.uint64,
    # State:
    arrangement_id: wp.array[wp.vec2i],  # (world)
    attempt: wp.array[int],  # (world)
    target: wp.array[int],  # (world)
    grasp_pixel: wp.array2d[wp.vec2i],  # (world, instance) [px]
    # In:
    views: Views,
    component: wp.array3d[int],  # (view, row, column)
    # Out:
    pool_inout: Pool,
):
    """Draw pixels uniformly among the labelled ones, with replacement; the last draw is the planned grasp point.

    Launched over view, draw.
    """
    view, draw = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    pixel = NOWHERE
    if draw == pool_inout.pixel.shape[1] - 1:
        if target[world] >= 0:
            pixel = grasp_pixel[world, target[world]]
    elif pool_inout.pixels[view] > 0:
        key = view_stream(seed, arrangement_id[world], attempt[world])
        pixel = pixel_of_rank(pool_inout, component, view, wide_index(key, draw, pool_inout.pixels[view]))
    pool_inout.pixel[view, draw] = pixel


@wp.kernel
def score_pixels_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    obj_id: wp.array[int],  # (entry)
    suction: SuctionScene,
    table: Table,
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    # Out:
    pool_inout: Pool,
):
    """Analytic scores of a cup at each drawn pixel, as the layers `suction_seal` and `suction_wrench` have them.

    Launched over view, draw.
    """
    view, draw = wp.tid()
    if views.world[view] < 0:
        return
    seal = float(0.0)
    wrench = float(0.0)
    pixel = pool_inout.pixel[view, draw]
    if pixel[0] >= 0:
        cup = place_cup(meshes, surfaces, bodies, gbuffer, views, obj_id, view, pixel[1], pixel[0])
        if cup.body >= 0:
            mesh = bodies.mesh[view, cup.body]
            seal = seal_score(meshes, mesh, cup, suction.radius)
            if seal > 0.0 and is_obstructed(meshes, table, bodies, view, cup, suction.radius, views.instances):
                seal = 0.0
            weight = bodies.world_rotation[view, cup.body] * wp.vec3(0.0, 0.0, -WEIGHT)
            wrench = wrench_score(cup, suction.center_of_mass[mesh], weight, suction.radius)
    pool_inout.seal[view, draw] = seal
    pool_inout.wrench[view, draw] = wrench


@wp.kernel
def count_strata_kernel(
    # In:
    views: Views,
    component: wp.array3d[int],  # (view, row, column)
    # Out:
    pool_inout: Pool,
):
    """Count the pixels of the first phase by instance and stratum. Launched over view, instance."""
    view, instance = wp.tid()
    if views.world[view] < 0:
        return
    for stratum in range(STRATA):
        pool_inout.count[view, instance, stratum] = 0
    for draw in range(POOL):
        pixel = pool_inout.pixel[view, draw]
        if pixel[0] >= 0:
            if component[view, pixel[1], pixel[0]] == instance:
                stratum = stratum_of(pool_inout.seal[view, draw], pool_inout.wrench[view, draw])
                pool_inout.count[view, instance, stratum] = pool_inout.count[view, instance, stratum] + 1


@wp.func
def stratum_size(pool: Pool, view: int, instance: int, stratum: int) -> int:
    """Pixels of an instance in a stratum; stratum -1: in all."""
    if stratum >= 0:
        return pool.count[view, instance, stratum]
    total = int(0)
    for one in range(STRATA):
        total += pool.count[view, instance, one]
    return total


@wp.func
def find_stratum(pool: Pool, view: int, instance: int, place: int) -> wp.vec2i:
    """Member `place`, modulo their number, of the instances with pixels in the pool (instance -1), or of an instance's strata with pixels;
    and their number.
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
    """Draw of the first phase that is member `place` of a stratum of an instance, in their order."""
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
    # Scene:
    seed: wp.uint64,
    uniform: int,
    candidates: int,
    first: int,
    # State:
    row: wp.array[int],  # (world)
    arrangement_id: wp.array[wp.vec2i],  # (world)
    attempt: wp.array[int],  # (world)
    catalog_index: wp.array2d[int],  # (world, instance)
    # In:
    views: Views,
    component: wp.array3d[int],  # (view, row, column)
    pool: Pool,
    # Out:
    candidates_out: Candidates,
    row_out: wp.array[int],  # (grasp)
    candidate_out: wp.array[int],  # (grasp)
    target_out: wp.array[int],  # (grasp)
):
    """Choose the candidates of each view's state: the planned grasp, then by strata, and `uniform` ones at the end.

    Visit v of an instance takes its next stratum that has pixels, and of these the next one, in the order of their draw; which instance and
    which stratum begin is random. Launched over view, candidate.
    """
    view, candidate = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    draw = int(pool.pixel.shape[1] - 1)
    share = int(Share.OWN)
    weight = float(0.0)
    if candidate >= candidates - uniform:
        draw = POOL + candidate - (candidates - uniform)
        share = int(Share.UNIFORM)
        weight = float(pool.pixels[view])
    elif candidate > 0:
        share = int(Share.STRATIFIED)
        key = view_stream(seed, arrangement_id[world], attempt[world])
        instances = find_stratum(pool, view, -1, 0)[1]
        place = candidate - 1 + wide_index(key, STARTS, instances)
        instance = find_stratum(pool, view, -1, place)[0]
        visit = (candidate - 1) // instances
        chosen = find_stratum(pool, view, instance, visit + wide_index(key, STARTS + 1 + instance, STRATA * (STRATA - 1) * 12))
        size = stratum_size(pool, view, instance, chosen[0])
        draw = find_draw(pool, component, view, instance, chosen[0], (visit // chosen[1]) % size)
        weight = float(pool.pixels[view]) / float(POOL) * float(instances * chosen[1] * size)
    grasp = (first + view) * candidates + candidate
    pixel = pool.pixel[view, draw]
    instance = component[view, pixel[1], pixel[0]]
    candidates_out.share[grasp] = share
    candidates_out.weight[grasp] = weight
    candidates_out.pixel[grasp] = pixel
    candidates_out.entry[grasp] = catalog_index[world, instance]
    candidates_out.seal[grasp] = pool.seal[view, draw]
    candidates_out.wrench[grasp] = pool.wrench[view, draw]
    row_out[grasp] = row[world]
    candidate_out[grasp] = candidate
    target_out[grasp] = instance


@wp.kernel
def aim_candidates_kernel(
    # Scene:
    candidates: int,
    first: int,
    # In:
    index: wp.array[int],  # (one)
    views: Views,
    pixel: wp.array[wp.vec2i],  # (grasp)
    grasp_target: wp.array[int],  # (grasp)
    # Out:
    target_out: wp.array[int],  # (world)
    grasp_pixel_out: wp.array2d[wp.vec2i],  # (world, instance) [px]
):
    """Make candidate `index` of each view's state the plan's target and grasp pixel. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    grasp = (first + view) * candidates + index[0]
    target_out[world] = grasp_target[grasp]
    grasp_pixel_out[world, grasp_target[grasp]] = pixel[grasp]


@wp.kernel
def store_normals_kernel(
    # Scene:
    candidates: int,
    first: int,
    # In:
    index: wp.array[int],  # (one)
    views: Views,
    normal: wp.array[wp.vec3],  # (world)
    # Out:
    surface_normal_out: wp.array[wp.vec3],  # (grasp)
):
    """Store the smoothed normals as unit vectors, of candidate `index`. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world >= 0:
        surface_normal_out[(first + view) * candidates + index[0]] = wp.normalize(normal[world])


@wp.kernel
def store_grasps_kernel(
    # Scene:
    candidates: int,
    first: int,
    # In:
    index: wp.array[int],  # (one)
    views: Views,
    point: wp.array[wp.vec3],  # (world) [m]
    normal: wp.array[wp.vec3],  # (world)
    yaw: wp.array[float],  # (world) [rad]
    tilt: wp.array[float],  # (world) [rad]
    # Out:
    grasp_point_out: wp.array[wp.vec3],  # (grasp) [m]
    grasp_normal_out: wp.array[wp.vec3],  # (grasp)
    grasp_yaw_out: wp.array[float],  # (grasp) [rad]
    grasp_tilt_out: wp.array[float],  # (grasp) [rad]
):
    """Store the planned grasps as candidate `index`. Launched over view."""
    view = wp.tid()
    world = views.world[view]
    if world < 0:
        return
    grasp = (first + view) * candidates + index[0]
    grasp_point_out[grasp] = point[world]
    grasp_normal_out[grasp] = normal[world]
    grasp_yaw_out[grasp] = yaw[world]
    grasp_tilt_out[grasp] = tilt[world]


@wp.kernel
def increment_kernel(
    # Out:
    index_inout: wp.array[int],  # (one)
):
    """Go on to the next candidate. A single thread (dim 1)."""
    index_inout[0] = index_inout[0] + 1
