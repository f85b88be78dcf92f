"""Temporal reuse: lists of the coarse pixels that trace paths in a frame, and the light of those that do not."""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.render.lighting.coarse_grid import CoarseGrid, Guide, coarse_surface, flat_index, interleaved_pixel, write_guide
from synpick_warp.kernels.render.lighting.history import (
    LightHistory,
    MovingBodies,
    is_due,
    lag_limit,
    phase_frame,
    read_history,
    scale_light,
    usable_paths,
)
from synpick_warp.kernels.render.lighting.moving_bodies import rests
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight, store_light
from synpick_warp.kernels.render.lighting.paths.lists import PathLists, append_pixel
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene, make_vertex
from synpick_warp.kernels.render.lighting.tile_flags import LIGHT_STAGE, TileFlags, skips
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.visibility.camera import in_image, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot
from synpick_warp.kernels.render.visibility.records import write_record
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def schedule_paths_kernel(
    scene: AnyScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    moving: MovingBodies,
    first: int,
    history_inout: LightHistory,
    lists_inout: PathLists,
    flags_out: TileFlags,
):
    """Schedule paths: append the coarse pixels that trace paths in this frame (see `period_bits`) to the path lists.

    Where no surface is visible, the history is reset. `due`, which must be 0, becomes 1 in tiles whose light changes: where a path is
    traced, and where the visible body moved. Launched over view, coarse pixel (interleaved order, from flat index `first` on).
    """
    index = wp.tid() + first
    view, row, column = interleaved_pixel(coarse, index)
    if not in_image(coarse.grid, row, column):
        return
    slot = shot.views.world[view] * history_inout.cameras + shot.views.slot[view]
    surface = coarse_surface(coarse, shot, view, row, column)
    segment = surface.hit.segment
    tile = tile_of(coarse.grid, row, column)
    if not rests(moving, view, segment, shot.views.instances) or int(history_inout.segment[slot, row, column]) != segment:
        flags_out.due[view, tile] = wp.uint8(1)
    lists_inout.listed[view, row, column] = wp.uint8(0)
    if segment == Segment.NOTHING:
        history_inout.segment[slot, row, column] = wp.uint8(Segment.NOTHING)
        return
    limit = lag_limit(scene.meshes, history_inout, moving, shot, view, row, column, segment, surface.position)
    known, bits = usable_paths(history_inout, slot, row, column, limit)
    if bits == 0 or is_due(phase_frame(history_inout, slot), bits):
        flags_out.due[view, tile] = wp.uint8(1)
        lists_inout.listed[view, row, column] = wp.uint8(1)
        append_pixel(lists_inout, view, index, known, bits)


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def reuse_histories_kernel(
    scene: AnyScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    lists: PathLists,
    flags: TileFlags,
    first: int,
    history: LightHistory,
    guide_out: Guide,
    coarse_light_out: CoarseLight,
):
    """Temporal reuse: coarse pixels that trace no path in this frame get the light of their history, in tiles of LIGHT_STAGE. Launched over
    view, coarse pixel (tile order, from flat index `first` on)."""
    view, row, column = tile_pixel(coarse.grid, wp.tid() + first)
    if skips(coarse.grid, flags, LIGHT_STAGE, view, row, column) or lists.listed[view, row, column] != wp.uint8(0):
        return
    cell = flat_index(coarse.grid, view, row, column)
    world, snapshot = shot.views.world[view], shot.snapshot
    surface = coarse_surface(coarse, shot, view, row, column)
    if surface.hit.segment == Segment.NOTHING:
        write_record(guide_out.surface, cell, wp.vec4())
        return
    slot = world * history.cameras + shot.views.slot[view]
    vertex = make_vertex(scene, shot, view, surface.hit, surface.position, surface.outgoing, surface.width, 0.0, True)
    unoccluded = unoccluded_light(scene.lights, snapshot.light[world], snapshot.light_yaw[world], vertex.brdf)
    exposure = scene.lights.exposure[snapshot.light[world]]
    store_light(coarse_light_out, cell, read_history(history, slot, row, column), scale_light(unoccluded, exposure))
    write_guide(guide_out, shot.views.cameras.to_world[view], cell, surface.hit, vertex.brdf.normal)
