"""Coarse path pass: few paths per coarse pixel, and the unoccluded light that they are compared with (ratio estimator).

Next to the light that paths find, the kernel stores what the surface would reflect of the unoccluded environment map, which needs no ray.
Their ratio, the visibility ratio, varies slowly over a surface even where it bends or its colour changes. So the denoiser filters the
ratio, and each pixel multiplies it by its own unoccluded light (after Heitz, Hill and McGuire, 2018).
"""

from typing import Any

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.lighting.brdf import SplitRadiance
from synpick_warp.kernels.render.lighting.coarse_grid import (
    CoarseGrid,
    Guide,
    coarse_surface,
    flat_index,
    interleaved_pixel,
    morton_index,
    write_guide,
)
from synpick_warp.kernels.render.lighting.history import (
    LightHistory,
    accumulate,
    history_frame,
    path_number,
    scale_light,
)
from synpick_warp.kernels.render.lighting.paths.light import CoarseLight, clamp_path, lamplit_radiance, limit_specular, store_light
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS, PathLists, listed_pixel
from synpick_warp.kernels.render.lighting.paths.queues import PathPixel, PathQueues, queue_path
from synpick_warp.kernels.render.lighting.paths.tracing import (
    TERMINATED,
    AnyScene,
    PathContext,
    PathRules,
    extend_path,
    init_path,
    make_vertex,
    next_vertex,
)
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.visibility.camera import in_image
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot
from synpick_warp.kernels.render.visibility.records import write_record
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.rng import stream_key
from synpick_warp.kernels.tuning import COARSE_PATH_REGISTERS, SINGLE_PATH_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

SEQUENCE_PERIOD = wp.constant(16)
"""Tile width of the sampler [coarse pixels]: the pixels of a tile share one Sobol' sequence, dealt out by Morton index, so that every
aligned power-of-two sub-tile holds a contiguous, well-stratified part of it."""
SHIFT_RANGE = wp.constant(1.0)
"""Range of the Cranley-Patterson rotation of the first dimension over the image: a slow gradient keeps neighbouring pixels stratified
within a filter kernel, and a range of 1 leaves the image's mean unbiased."""


@wp.func
def make_context(scene: AnyScene, coarse: CoarseGrid, rules: PathRules, shot: AnyShot, view: int, row: int, column: int) -> PathContext:
    """Path-tracing context of a coarse pixel: its view, environment maps, random number stream and rotation of sample points.

    `shift` is a Cranley-Patterson rotation of the sample sequence that grows with `row` and `column`. All images of an episode use one
    stream; see `first_path_index`. The first surface is lit by the map without its lamps: its row plus the number of maps of
    `Lights.radiance`.
    """
    world = shot.views.world[view]
    context = PathContext()
    context.view = view
    context.light = shot.snapshot.light[world]
    context.first_light = context.light + scene.lights.maps
    context.yaw = shot.snapshot.light_yaw[world]
    context.key = stream_key(rules.seed, shot.snapshot.episode[world], 0, Stream.PATHS)
    context.shift = wp.vec2(SHIFT_RANGE * float(row) / float(coarse.grid.height), SHIFT_RANGE * float(column) / float(coarse.grid.width))
    return context


@wp.func
def average_paths(
    scene: AnyScene, shot: AnyShot, rules: PathRules, context: PathContext, samples: int, first: Any, width: float, pixel: PathPixel
) -> SplitRadiance:
    """Monte Carlo mean of the reflected light over `samples` paths of a coarse pixel, each limited by the firefly clamp (`clamp_path`). The
    paths start at the vertex `first`; `width` is their footprint there [m]."""
    sum = SplitRadiance()
    lamplit = lamplit_radiance(scene.lights, context.light)
    # One loop over all bounces of all paths: a thread whose path ends early starts the next while others of its warp go on.
    sample = int(0)
    path = init_path(width)
    while sample < samples:
        vertex = first
        if path.bounce > 0:
            vertex = next_vertex(scene, shot, rules, context, path)
        path = extend_path(scene, shot, rules, context, pixel.number + sample, pixel.diffuse, path, vertex)
        if path.bounce == TERMINATED:
            light = clamp_path(path.radiance, pixel.unoccluded, lamplit, pixel.specular_limit, rules.firefly_clamp)
            sum.diffuse += light.diffuse
            sum.indirect += light.indirect
            sum.specular += light.specular
            path = init_path(width)
            sample += 1
    return scale_light(sum, 1.0 / float(samples))


@wp.func
def first_path_index(samples: int, row: int, column: int, number: int, has_history: bool) -> int:
    """Sobol' index of a coarse pixel's first path, in the sequence of its tile of SEQUENCE_PERIOD² coarse pixels.

    A coarse pixel without a history takes its first `samples` points. One with a history takes one point, behind the `samples` points with
    which a history may have begun; `number`, the `path_number`, says which.
    """
    index = morton_index(SEQUENCE_PERIOD, row, column)
    if has_history:
        return index + SEQUENCE_PERIOD * SEQUENCE_PERIOD * (samples + number)
    return index * samples


@wp.func
def new_paths(rules: PathRules, history: LightHistory, slot: int, known: int) -> int:
    """Number of paths that a coarse pixel traces in this frame; `known` is the number of paths of its history that are still valid.

    1 if the history has any; otherwise `rules.samples`, or `rules.first_samples` in the first frame of an episode, since all histories
    begin there and most persist.
    """
    if known > 0:
        return 1
    if history.max_paths > 0:
        if history.frame[slot] == 0:
            return rules.first_samples
    return rules.samples


@wp.func
def finish_pixel(
    out: CoarseLight,
    history: LightHistory,
    exposure: float,
    cell: int,
    slot: int,
    row: int,
    column: int,
    pixel: PathPixel,
    paths: SplitRadiance,
    samples: int,
):
    """Temporal accumulation: blend new light into the history of a coarse pixel, and store the result for the denoiser.

    `paths` is the mean light of `samples` new paths, `cell` the pixel's `flat_index`, `slot` the row of its camera in the history. The
    light is multiplied by `exposure`, the map's; the unoccluded light, with which the denoiser forms ratios, is stored beside it.
    """
    mean = accumulate(history, slot, row, column, pixel.segment, scale_light(paths, exposure), pixel.known, samples)
    store_light(out, cell, mean, scale_light(pixel.unoccluded, exposure))


@wp.func
def finish_path(
    scene: AnyScene,
    rules: PathRules,
    context: PathContext,
    out: CoarseLight,
    history: LightHistory,
    cell: int,
    slot: int,
    row: int,
    column: int,
    pixel: PathPixel,
    radiance: SplitRadiance,
):
    """Finish a coarse pixel whose single path has terminated: firefly clamp of its `radiance`, then `finish_pixel`. Parameters that are not
    named here are those of `finish_pixel`."""
    lamplit = lamplit_radiance(scene.lights, context.light)
    light = clamp_path(radiance, pixel.unoccluded, lamplit, pixel.specular_limit, rules.firefly_clamp)
    finish_pixel(out, history, scene.lights.exposure[context.light], cell, slot, row, column, pixel, light, 1)


@wp.func
def make_path_pixel(
    scene: AnyScene, rules: PathRules, context: PathContext, vertex: Any, index: int, segment: int, known: int, number: int
) -> PathPixel:
    """Data with which the light of a coarse pixel's paths is combined: unoccluded light, diffuse colour, firefly limit, history length.
    `vertex`: the surface that the coarse pixel shows, with segmentation id `segment`. `index`: index of the coarse pixel in interleaved
    order. `known`: number of valid paths of its history. `number`: Sobol' index of its first path, by `first_path_index`."""
    lamplit = lamplit_radiance(scene.lights, context.light)
    pixel = PathPixel()
    pixel.offset = index % REGION_PIXELS
    pixel.segment = segment
    pixel.known = known
    pixel.number = number
    pixel.diffuse = vertex.brdf.diffuse
    pixel.unoccluded = unoccluded_light(scene.lights, context.light, context.yaw, vertex.brdf)
    pixel.specular_limit = limit_specular(vertex.brdf, pixel.unoccluded, lamplit, rules.firefly_clamp)
    return pixel


@wp.func
def trace_pixel(
    scene: AnyScene,
    coarse: CoarseGrid,
    shot: AnyShot,
    lists: PathLists,
    rules: PathRules,
    thread: int,
    queues: PathQueues,
    history: LightHistory,
    guide_out: Guide,
    coarse_light_out: CoarseLight,
    queued: bool,
):
    """Trace the paths of a thread's coarse pixel, if this kernel is responsible: writes guide image and light, or queues the path. With
    `queued` (a constant, so that the compiler removes the other case) it is for pixels with one path; else for others."""
    regions = queues.count.shape[1]
    index = thread
    known, bits = int(0), int(0)
    if history.max_paths > 0:
        index, known, bits = listed_pixel(lists, index)
        if index < 0:
            return
    view, row, column = interleaved_pixel(coarse, index)
    if not in_image(coarse.grid, row, column):
        return
    slot = shot.views.world[view] * history.cameras + shot.views.slot[view]
    samples = new_paths(rules, history, slot, known)
    if queued != (samples == 1 and regions > 0):
        return
    cell = flat_index(coarse.grid, view, row, column)
    surface = coarse_surface(coarse, shot, view, row, column)
    if surface.hit.segment == Segment.NOTHING:
        write_record(guide_out.surface, cell, wp.vec4())
        return
    vertex = make_vertex(scene, shot, view, surface.hit, surface.position, surface.outgoing, surface.width, 0.0, True)
    write_guide(guide_out, shot.views.cameras.to_world[view], cell, surface.hit, vertex.brdf.normal)
    context = make_context(scene, coarse, rules, shot, view, row, column)
    beginning = wp.where(known > 0, rules.first_samples, samples)
    number = first_path_index(beginning, row, column, path_number(history_frame(history, slot, known), bits), known > 0)
    pixel = make_path_pixel(scene, rules, context, vertex, index, surface.hit.segment, known, number)
    if queued:
        path = extend_path(scene, shot, rules, context, pixel.number, pixel.diffuse, init_path(surface.width), vertex)
        if path.bounce == TERMINATED:
            finish_path(scene, rules, context, coarse_light_out, history, cell, slot, row, column, pixel, path.radiance)
        else:
            queue_path(queues, view, (index // REGION_PIXELS) % regions, path, pixel)
    else:
        paths = average_paths(scene, shot, rules, context, samples, vertex, surface.width, pixel)
        exposure = scene.lights.exposure[context.light]
        finish_pixel(coarse_light_out, history, exposure, cell, slot, row, column, pixel, paths, samples)


def kernel_of_paths(name: str, queued: bool, registers: int) -> Any:
    """Kernel of `trace_pixel`, whose argument `queued` is a constant. Launched over view, coarse pixel (interleaved or listed order, from
    flat index `first` on)."""

    @kernel_of_views(name=name, cuda_max_registers=registers)
    def trace_pixels_kernel(
        scene: AnyScene,
        coarse: CoarseGrid,
        shot: AnyShot,
        lists: PathLists,
        rules: PathRules,
        first: int,
        queues_inout: PathQueues,
        history_inout: LightHistory,
        guide_out: Guide,
        coarse_light_out: CoarseLight,
    ):
        """`trace_pixel` of each coarse pixel."""
        thread = wp.tid() + first
        trace_pixel(scene, coarse, shot, lists, rules, thread, queues_inout, history_inout, guide_out, coarse_light_out, queued)

    return trace_pixels_kernel


trace_coarse_paths_kernel = kernel_of_paths("trace_coarse_paths_kernel", False, COARSE_PATH_REGISTERS)
"""Coarse path pass: paths from the middle pixel of each coarse pixel; their mean light, the unoccluded light, and the guide image.

With a history only coarse pixels in `lists` are traced, with `new_paths` paths each, and their light is accumulated over frames. The lamps'
direct light is left out, see `shadows`. Where there are queues, coarse pixels with a single path are left to `start_paths_kernel`."""
start_paths_kernel = kernel_of_paths("start_paths_kernel", True, SINGLE_PATH_REGISTERS)
"""Wavefront path tracing, first stage: trace the first bounce of the path of each coarse pixel that has a single one.

Paths that terminate are stored as by `trace_coarse_paths_kernel`; others are queued for `extend_queued_paths_kernel`."""
