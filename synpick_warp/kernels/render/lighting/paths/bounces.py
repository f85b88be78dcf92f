"""Later bounces of the coarse path pass: extends the paths that `coarse` queued, see `queues`."""

import warp as wp

from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, flat_index, interleaved_pixel
from synpick_warp.kernels.render.lighting.history import LightHistory
from synpick_warp.kernels.render.lighting.paths.coarse import finish_path, make_context
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS
from synpick_warp.kernels.render.lighting.paths.queues import (
    QUEUE_CAPACITY,
    PathQueues,
    first_record,
    queued_slot,
    read_path,
    requeue_path,
)
from synpick_warp.kernels.render.lighting.paths.tracing import TERMINATED, AnyScene, PathRules, extend_path, next_vertex
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import SINGLE_PATH_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})


@kernel_of_views(cuda_max_registers=SINGLE_PATH_REGISTERS)
def extend_queued_paths_kernel(
    scene: AnyScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    rules: PathRules,
    stage: int,
    first: int,
    queues_inout: PathQueues,
    history_inout: LightHistory,
    coarse_light_out: CoarseLight,
):
    """Wavefront path tracing: extend the paths in the queues of a stage by one bounce.

    A path that terminates completes its coarse pixel, as in `trace_coarse_paths_kernel`; others are queued for the next stage. Launched
    over view, region, rank in the queue (flat, from `first` on).
    """
    index = wp.tid() + first
    rank = index % QUEUE_CAPACITY
    regions = queues_inout.count.shape[1]
    region = (index // QUEUE_CAPACITY) % regions
    view = index // (QUEUE_CAPACITY * regions)
    slot = queued_slot(queues_inout, view, region, stage, rank)
    if slot < 0:
        return
    path, pixel = read_path(queues_inout, first_record(queues_inout, view, region, slot))
    view, row, column = interleaved_pixel(coarse, (view * regions + region) * REGION_PIXELS + pixel.offset)
    context = make_context(scene, coarse, rules, shot, view, row, column)
    vertex = next_vertex(scene, shot, rules, context, path)
    path = extend_path(scene, shot, rules, context, pixel.number, pixel.diffuse, path, vertex)
    if path.bounce == TERMINATED:
        cell = flat_index(coarse.grid, view, row, column)
        history_slot = shot.views.world[view] * history_inout.cameras + shot.views.slot[view]
        finish_path(scene, rules, context, coarse_light_out, history_inout, cell, history_slot, row, column, pixel, path.radiance)
    else:
        requeue_path(queues_inout, view, region, stage + 1, slot, path, pixel)
