"""Coarse path pass: few paths per coarse pixel, and the unoccluded light that they are compared with (ratio estimator).

Next to the light that paths find, the kernel stores what the surface would reflect of the unoccluded environment map, which needs no ray.
Their ratio, the visibility ratio, varies slowly over a surface even where it bends or its colour changes. So the denoiser filters the
ratio, and each pixel multiplies it by its own unoccluded light (after Heitz, Hill and McGuire, 2018).
"""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.lighting.brdf import SplitRadiance, specular_albedo
from synpick_warp.kernels.render.lighting.coarse_grid import (
    CoarseGrid,
    Guide,
    flat_index,
    interleaved_pixel,
    middle_pixel,
    morton_index,
    pack_surface,
)
from synpick_warp.kernels.render.lighting.color import MAX_HALF, MIN_RADIANCE, luminance, pack_half3
from synpick_warp.kernels.render.lighting.history import (
    LightHistory,
    MovingBodies,
    accumulate,
    history_frame,
    lag_limit,
    path_number,
    read_history,
    scale_light,
    update_frame,
    usable_paths,
)
from synpick_warp.kernels.render.lighting.path_lists import PathLists, append_pixel, listed_pixel
from synpick_warp.kernels.render.lighting.path_tracing import (
    TERMINATED,
    PathContext,
    PathRules,
    PathScene,
    Vertex,
    extend_path,
    init_path,
    make_vertex,
)
from synpick_warp.kernels.render.lighting.unoccluded import unoccluded_light
from synpick_warp.kernels.render.visibility.camera import Cameras, Views, camera_ray, hit_position, in_image
from synpick_warp.kernels.render.visibility.gbuffer import GBuffer, Hit, ViewBodies, read_hit
from synpick_warp.kernels.render.visibility.records import write_record, write_uint64
from synpick_warp.kernels.rng import stream_key
from synpick_warp.kernels.tuning import COARSE_PATH_REGISTERS, RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

SEQUENCE_PERIOD = wp.constant(16)
"""Tile width of the sampler [coarse pixels]: the pixels of a tile share one Sobol' sequence, dealt out by Morton index, so that every
aligned power-of-two sub-tile holds a contiguous, well-stratified part of it."""
INDIRECT_CLAMP = wp.constant(4.0)
"""Firefly clamp of indirect light: at most this many times the radiance of a white surface that faces all lamps, on top of the clamp
for unoccluded light. Few paths find surfaces that lamps light, so each of them has a large weight."""
SHIFT_RANGE = wp.constant(1.0)
"""Range of the Cranley-Patterson rotation of the first dimension over the image: a slow gradient keeps neighbouring pixels stratified
within a filter kernel, and a range of 1 leaves the image's mean unbiased."""


@wp.struct
class CoarseLight:
    """Reflected light of the coarse pixels; diffuse light is demodulated (without the surface's colour). Scratch.

    All arrays are (view, cell_row, cell_column). Light is pre-exposed: radiance multiplied by the map's exposure, so
    that typical values are about 1.
    """

    diffuse: wp.array3d[wp.vec4]
    """Diffuse reflection of the environment map without its lamps, occluded and unoccluded; packed by `pack_light`."""
    specular: wp.array3d[wp.vec4]
    """Specular reflection, likewise; the occluded value includes light from other surfaces."""
    indirect: wp.array3d[wp.uint64]
    """Indirect diffuse light: diffuse reflection of light from other surfaces, packed by `pack_half3`. It varies slowly in the image, but
    few paths carry much of it."""


@wp.func
def clamp_light(light: wp.vec3, limit: wp.vec3) -> wp.vec3:
    """Firefly clamp: `light`, scaled down where its largest channel exceeds that of `limit`; its hue stays."""
    return light * wp.min(1.0, wp.max(limit) / wp.max(wp.max(light), MIN_RADIANCE))


@wp.func
def make_context(
    scene: PathScene,
    coarse: CoarseGrid,
    rules: PathRules,
    views: Views,
    view: int,
    row: int,
    column: int,
    episode: int,
    light: int,
    yaw: float,
) -> PathContext:
    """Path-tracing context of a coarse pixel: stream of random numbers, rotation and map of the environment.

    All images of an episode use one stream; see `first_path_index`. The first surface is lit by the map without its lamps: row `light` +
    number of maps of `Lights.radiance`. `yaw` is in radians.
    """
    context = PathContext()
    context.view = view
    context.instances = views.instances
    context.light = light
    context.first_light = light + scene.lights.maps
    context.yaw = yaw
    context.key = stream_key(rules.seed, episode, 0, Stream.PATHS)
    context.shift = wp.vec2(SHIFT_RANGE * float(row) / float(coarse.grid.height), SHIFT_RANGE * float(column) / float(coarse.grid.width))
    return context


@wp.func
def average_paths(
    scene: PathScene,
    bodies: ViewBodies,
    rules: PathRules,
    context: PathContext,
    index: int,
    samples: int,
    first: Vertex,
    width: float,
    unoccluded: SplitRadiance,
    firefly_clamp: float,
) -> SplitRadiance:
    """Monte Carlo mean of the reflected light over `samples` paths from `index` on, which start at `first`, `width` [m] wide.

    Firefly clamp: a path counts with at most `firefly_clamp` times the unoccluded light; indirect light with INDIRECT_CLAMP more, because
    the unoccluded light lacks the lamps.
    """
    sum = SplitRadiance()
    lamplit = (INDIRECT_CLAMP / wp.PI) * scene.lights.total_lamp_irradiance[context.light]
    # One loop over all bounces of all paths: a thread whose path ends early starts the next while others of its warp go on.
    sample = int(0)
    path = init_path(first, width)
    while sample < samples:
        path = extend_path(scene, bodies, rules, context, index + sample, first.brdf.diffuse, path)
        if path.bounce == TERMINATED:
            sum.diffuse += clamp_light(path.radiance.diffuse, firefly_clamp * unoccluded.diffuse)
            sum.indirect += clamp_light(path.radiance.indirect, firefly_clamp * unoccluded.diffuse + lamplit)
            limit = firefly_clamp * unoccluded.specular + wp.cw_mul(specular_albedo(first.brdf), lamplit)
            sum.specular += clamp_light(path.radiance.specular, limit)
            path = init_path(first, width)
            sample += 1
    scale = 1.0 / float(samples)
    sum.diffuse = scale * sum.diffuse
    sum.indirect = scale * sum.indirect
    sum.specular = scale * sum.specular
    return sum


@wp.func
def first_path_index(samples: int, row: int, column: int, number: int, has_history: bool) -> int:
    """Sobol' index of a coarse pixel's first path, in the sequence of its tile of SEQUENCE_PERIOD² coarse pixels.

    A coarse pixel without a history takes its first `samples` points. One with a history takes a point, which `number` selects, see
    `path_number`, behind the `samples` points with which a history may have begun.
    """
    index = morton_index(SEQUENCE_PERIOD, row, column)
    if has_history:
        return index + SEQUENCE_PERIOD * SEQUENCE_PERIOD * (samples + number)
    return index * samples


@wp.func
def new_paths(rules: PathRules, history: LightHistory, slot: int, known: int) -> int:
    """Number of paths that a coarse pixel traces, with `known` usable paths in its history.

    One with a usable history; otherwise `rules.samples`, in the first frame of an episode `rules.first_samples`, since all histories begin
    there and most persist.
    """
    if known > 0:
        return 1
    if history.max_paths > 0:
        if history.frame[slot] == 0:
            return rules.first_samples
    return rules.samples


@wp.func
def pack_half2(a: float, b: float) -> float:
    """Pack two non-negative values in half precision, clamped to its range, into the bits of a float that takes no part in arithmetic."""
    return wp.cast(wp.vec2h(wp.float16(wp.min(a, MAX_HALF)), wp.float16(wp.min(b, MAX_HALF))), wp.float32)


@wp.func
def unpack_half2(packed: float) -> wp.vec2:
    """Unpack the values of `pack_half2`."""
    halves = wp.cast(packed, wp.vec2h)
    return wp.vec2(float(halves[0]), float(halves[1]))


@wp.func
def pack_light(light: wp.vec3, unoccluded: wp.vec3, statistic: float) -> wp.vec4:
    """Pack occluded and unoccluded light in half precision, and a `statistic` of the luminance of their visibility ratio.

    For single coarse pixels the statistic is the ratio itself, for blocks the variance of the mean ratio.
    """
    return wp.vec4(pack_half2(light[0], light[1]), pack_half2(light[2], unoccluded[0]), pack_half2(unoccluded[1], unoccluded[2]), statistic)


@wp.func
def luminance_ratio(light: wp.vec3, unoccluded: wp.vec3) -> float:
    """Luminance of the visibility ratio. Unoccluded light is 0 only if the whole map is black."""
    return luminance(light) / wp.max(luminance(unoccluded), MIN_RADIANCE)


@wp.func
def store_light(out: CoarseLight, index: int, light: SplitRadiance, unoccluded: SplitRadiance):
    """Write a coarse pixel by its `flat_index`; `light` and `unoccluded` are pre-exposed, see `CoarseLight`."""
    diffuse = luminance_ratio(light.diffuse, unoccluded.diffuse)
    specular = luminance_ratio(light.specular, unoccluded.specular)
    write_record(out.diffuse, index, pack_light(light.diffuse, unoccluded.diffuse, diffuse))
    write_record(out.specular, index, pack_light(light.specular, unoccluded.specular, specular))
    write_uint64(out.indirect, index, pack_half3(light.indirect))


@wp.struct
class CoarseSurface:
    """Surface at the middle pixel of a coarse pixel."""

    hit: Hit
    position: wp.vec3
    """[m]"""
    outgoing: wp.vec3
    """Unit vector to the camera."""
    width: float
    """Width of the coarse pixel across the ray [m]."""


@wp.func
def coarse_surface(cameras: Cameras, coarse: CoarseGrid, gbuffer: GBuffer, view: int, camera: int, row: int, column: int) -> CoarseSurface:
    """Read a coarse pixel's surface from the G-buffer."""
    pixel = middle_pixel(coarse, row, column)
    ray = camera_ray(cameras.intrinsics[camera], pixel[0], pixel[1], wp.vec2(0.0, 0.0))
    surface = CoarseSurface()
    surface.hit = read_hit(gbuffer, view, pixel[0], pixel[1])
    surface.position = hit_position(cameras, camera, ray, surface.hit.depth)
    surface.outgoing = -wp.normalize(cameras.to_world[camera] * ray)
    surface.width = float(coarse.size) * surface.hit.depth / cameras.intrinsics[camera][0]
    return surface


@wp.func
def write_guide(guide: Guide, to_world: wp.mat33, index: int, hit: Hit, normal: wp.vec3):
    """Write the guide image of a coarse pixel that shows a surface, by its `flat_index`; `normal` is in the world."""
    write_record(guide.surface, index, pack_surface(hit.segment, hit.depth, wp.transpose(to_world) * normal))


@wp.kernel(cuda_max_registers=RAY_REGISTERS)
def reuse_histories_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    coarse: CoarseGrid,
    # State: worlds
    light: wp.array[int],  # (world)
    light_yaw: wp.array[float],  # (world) [rad]
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    moving: MovingBodies,
    history: LightHistory,
    first: int,
    # Out:
    lists_inout: PathLists,
    guide_out: Guide,
    coarse_light_out: CoarseLight,
):
    """Temporal reuse: the history's light for coarse pixels that trace no path in this frame, see `period_bits`; the others are listed.

    Of coarse pixels that are listed nothing is written.
    """
    index = wp.tid() + first
    view, row, column = interleaved_pixel(coarse, index)
    if not in_image(coarse.grid, row, column):
        return
    cell = flat_index(coarse.grid, view, row, column)
    camera, world = views.camera[view], views.world[view]
    surface = coarse_surface(cameras, coarse, gbuffer, view, camera, row, column)
    if surface.hit.segment == Segment.NOTHING:
        write_record(guide_out.surface, cell, wp.vec4())
        return
    limit = lag_limit(scene.meshes, history, moving, views, view, row, column, surface.hit.segment, surface.position)
    slot = world * history.cameras + camera
    known, bits = usable_paths(history, slot, row, column, limit)
    if bits == 0 or update_frame(row, column, bits) == history.frame[slot] % (1 << bits):
        append_pixel(lists_inout, view, index, known, bits)
        return
    vertex = make_vertex(scene, bodies, view, views.instances, surface.hit, surface.position, surface.outgoing, surface.width, 0.0)
    unoccluded = unoccluded_light(scene.lights, light[world], light_yaw[world], vertex.brdf)
    exposure = scene.lights.exposure[light[world]]
    store_light(coarse_light_out, cell, read_history(history, slot, row, column), scale_light(unoccluded, exposure))
    write_guide(guide_out, cameras.to_world[camera], cell, surface.hit, vertex.brdf.normal)


@wp.kernel(cuda_max_registers=COARSE_PATH_REGISTERS)
def trace_coarse_paths_kernel(
    # Scene:
    scene: PathScene,
    cameras: Cameras,
    coarse: CoarseGrid,
    # State: worlds
    episode: wp.array[int],  # (world)
    light: wp.array[int],  # (world)
    light_yaw: wp.array[float],  # (world) [rad]
    # In:
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    lists: PathLists,
    rules: PathRules,
    firefly_clamp: float,
    first: int,
    # Out:
    history_inout: LightHistory,
    guide_out: Guide,
    coarse_light_out: CoarseLight,
):
    """Trace paths from the middle pixel of each coarse pixel: their mean light and the unoccluded light, and the guide image.

    With a history only those in `lists` do, as many paths as `new_paths` says; the path of a coarse pixel with a usable history is
    blended into it. The lamps' direct light is left out, see `shadows`.
    """
    index = wp.tid() + first
    known, bits = int(0), int(0)
    if history_inout.max_paths > 0:
        index, known, bits = listed_pixel(lists, index)
        if index < 0:
            return
    view, row, column = interleaved_pixel(coarse, index)
    if not in_image(coarse.grid, row, column):
        return
    cell = flat_index(coarse.grid, view, row, column)
    camera, world = views.camera[view], views.world[view]
    surface = coarse_surface(cameras, coarse, gbuffer, view, camera, row, column)
    if surface.hit.segment == Segment.NOTHING:
        write_record(guide_out.surface, cell, wp.vec4())
        return
    vertex = make_vertex(scene, bodies, view, views.instances, surface.hit, surface.position, surface.outgoing, surface.width, 0.0)
    context = make_context(scene, coarse, rules, views, view, row, column, episode[world], light[world], light_yaw[world])
    unoccluded = unoccluded_light(scene.lights, context.light, context.yaw, vertex.brdf)
    slot = world * history_inout.cameras + camera
    frame = history_frame(history_inout, slot, known)
    samples = new_paths(rules, history_inout, slot, known)
    number = first_path_index(wp.where(known > 0, rules.first_samples, samples), row, column, path_number(frame, bits), known > 0)
    paths = average_paths(scene, bodies, rules, context, number, samples, vertex, surface.width, unoccluded, firefly_clamp)
    exposure = scene.lights.exposure[context.light]
    mean = accumulate(history_inout, slot, row, column, surface.hit.segment, scale_light(paths, exposure), known, samples)
    store_light(coarse_light_out, cell, mean, scale_light(unoccluded, exposure))
    write_guide(guide_out, cameras.to_world[camera], cell, surface.hit, vertex.brdf.normal)
