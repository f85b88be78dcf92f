"""Temporal reuse: light of the coarse pixels that trace no path in a frame, and lists of those that do."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, Guide, coarse_surface, flat_index, interleaved_pixel, write_guide
from synpick_warp.kernels.render.lighting.history import (
    LightHistory,
    MovingBodies,
    lag_limit,
    read_history,
    scale_light,
    update_frame,
    usable_paths,
)
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight, store_light
from synpick_warp.kernels.render.lighting.paths.lists import PathLists, append_pixel
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene, make_vertex
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.visibility.camera import in_image
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot
from synpick_warp.kernels.render.visibility.records import write_record
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def reuse_histories_kernel(
    scene: AnyScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    moving: MovingBodies,
    first: int,
    history_inout: LightHistory,
    lists_inout: PathLists,
    guide_out: Guide,
    coarse_light_out: CoarseLight,
):
    """Temporal reuse: coarse pixels that trace no path in this frame (see `period_bits`) get the light of their history.

    All other coarse pixels are appended to the path lists; their light and history are left unchanged. Where no surface is visible, the
    history is reset. Launched over view, coarse pixel (interleaved order, from flat index `first` on).
    """
    index = wp.tid() + first
    view, row, column = interleaved_pixel(coarse, index)
    if not in_image(coarse.grid, row, column):
        return
    cell = flat_index(coarse.grid, view, row, column)
    world, snapshot = shot.views.world[view], shot.snapshot
    surface = coarse_surface(coarse, shot, view, row, column)
    slot = world * history_inout.cameras + shot.views.slot[view]
    if surface.hit.segment == Segment.NOTHING:
        write_record(guide_out.surface, cell, wp.vec4())
        history_inout.segment[slot, row, column] = wp.uint8(Segment.NOTHING)
        return
    limit = lag_limit(scene.meshes, history_inout, moving, shot, view, row, column, surface.hit.segment, surface.position)
    known, bits = usable_paths(history_inout, slot, row, column, limit)
    if bits == 0 or update_frame(row, column, bits) == history_inout.frame[slot] % (1 << bits):
        append_pixel(lists_inout, view, index, known, bits)
        return
    vertex = make_vertex(scene, shot, view, surface.hit, surface.position, surface.outgoing, surface.width, 0.0)
    unoccluded = unoccluded_light(scene.lights, snapshot.light[world], snapshot.light_yaw[world], vertex.brdf)
    exposure = scene.lights.exposure[snapshot.light[world]]
    store_light(coarse_light_out, cell, read_history(history_inout, slot, row, column), scale_light(unoccluded, exposure))
    write_guide(guide_out, shot.views.cameras.to_world[view], cell, surface.hit, vertex.brdf.normal)
