"""Adaptive anti-aliasing by coverage rays (like SRAA, CSAA): unshaded primary rays, only where the G-buffer shows a discontinuity.

The unit is the AA footprint, the square between the centres of four neighbouring pixels. Where all four show one smooth surface, so does
the whole footprint. Where they do not, coverage rays within the footprint find the visible surface, and each takes the radiance of
whichever of the four pixels shows that surface; so a ray costs no shading. Textures are filtered already.
"""

import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.kernels.bitsets import lowest_bit
from synpick_warp.kernels.render.images.kept_sources import (
    SOURCE_BITS,
    KeptSources,
    clear_sources,
    footprint_mask,
    locate_sources,
    read_sources,
)
from synpick_warp.kernels.render.lighting.paths.tracing import PathScene
from synpick_warp.kernels.render.lighting.plane_distance import Plane, plane_distance, tangent_plane
from synpick_warp.kernels.render.lighting.sampling import UNIT, reverse_bits
from synpick_warp.kernels.render.lighting.tile_flags import needs
from synpick_warp.kernels.render.visibility.bvh_rays import hit_table, no_hit, trace_bodies
from synpick_warp.kernels.render.visibility.camera import ImageGrid, clamp_index, in_image, loop_ray, tile_of, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import (
    MASK_BITS,
    SHADE_PASS,
    AnyShot,
    GBuffer,
    Hit,
    Meshes,
    ShadedImage,
    ViewBodies,
    body_of,
    face_normal,
    segment_of,
    triangle_normal,
)
from synpick_warp.kernels.render.visibility.variants import kernel_of_views
from synpick_warp.kernels.tuning import RAY_REGISTERS

wp.set_module_options({"enable_backward": False, "fast_math": True})

QUADRANTS = wp.constant(4)
"""Quadrants of a pixel, in the order upper left, upper right, lower left, lower right. Each lies in a different footprint."""
FOOTPRINT_PIXELS = wp.constant(4)
"""Pixels whose centres are a footprint's corners: upper left, upper right, lower left, lower right."""
SOURCE_MASK = wp.constant(wp.uint32(3))
"""The lowest SOURCE_BITS."""
RANK_BITS, RANK_MASK = wp.constant(8), wp.constant(wp.uint32(0xFF))
"""Bits of a rank packed by `find_ranks`, and their mask: segmentation ids are bytes, so a view has at most 256 bodies."""
CHUNK_TILES = wp.constant(32)
"""Tiles of footprints that share a list and its counter: one counter per view would serialize the atomic additions of all threads."""
CREASE_SLOPE = wp.constant(1.5)
"""Change of a body's slope [m/m] across a footprint that makes a crease. A 90° edge that faces the camera has 2: slopes -1 and 1."""
CREASE_TURN = wp.constant(0.36)
"""Tangent of the smallest angle of a crease, 20°, between the surface across the footprint and that before or after it. At grazing view
angles slopes change much where a surface hardly turns: without this test a third of the coverage rays were traced there."""
FLAT_SLOPE = wp.constant(0.1)
JUMP_SLOPE = wp.constant(8.0)
"""If the slope changes by more than JUMP_SLOPE [m/m] in all, but by less than FLAT_SLOPE on one side of two pixels, both show the surface
of that side: the jump lies beyond them, not within the footprint. This saves rays, and changes no image."""
MIN_CONTRAST = wp.constant(0.08)
"""Footprints whose colours differ by at most this fraction in every channel are left out: an error of some four in 255."""
MIN_CHANNEL = wp.constant(0.1)
"""Contrast is relative to a channel's value, but at least to this fraction of the brightest channel: dark channels are hardly visible."""
DISTANCE_WEIGHT = wp.constant(0.1)
"""Cost of a source pixel per pixel of its distance to the sample, in units of plane distance [widths of a pixel]."""
NORMAL_WEIGHT = wp.constant(1.0)
"""Weight of the difference of normals, 1 - cosine, in a source pixel's cost [widths of a pixel]. Without it, a pixel centred on a crease,
which lies on both planes, would lend its colour to samples of the other face."""


@wp.struct
class FootprintLists:
    """Work lists of the footprints to resolve, by chunk of tiles, and their numbers. Scratch."""

    footprint: wp.array3d[int]
    """(view, chunk, chunk_footprint): row * columns + column of each listed footprint, in any order."""
    count: wp.array2d[int]
    """(view, chunk): footprints in each list."""


@wp.func
def sample_offset(sample: int, samples: int) -> wp.vec2:
    """Position (x, y) of a coverage sample [px from the pixel's centre]: a Hammersley point set, sorted by quadrant.

    The point set is digit-scrambled: y is shifted by half a pixel, modulo 1. Each of the `samples` rows and columns of a pixel contains
    exactly one sample, and 4 samples form the rotated grid (four rooks). Positions are computed, because a table with a variable index
    would lie in slow local memory.
    """
    per_quadrant = samples // QUADRANTS
    quadrant = sample // per_quadrant
    index = (quadrant % 2) * (samples // 2) + 2 * (sample % per_quadrant) + 1 - quadrant // 2
    # Radical inverse in base 2 (van der Corput, 1935), in [0, 1).
    inverse = UNIT * float(reverse_bits(wp.uint32(index)) >> wp.uint32(8))
    half_cell = 0.5 / float(samples)
    return wp.vec2(float(2 * index + 1) * half_cell - 0.5, wp.where(inverse < 0.5, inverse, inverse - 1.0) + half_cell)


@wp.func
def source_offset(resolve: wp.uint32, sample: int, quadrant: int) -> wp.vec2i:
    """Offset (rows, columns) from a pixel to the pixel whose radiance a sample takes: a corner of its footprint, itself for 0."""
    source = int((resolve >> wp.uint32(SOURCE_BITS * sample)) & SOURCE_MASK)
    return wp.vec2i((source // 2) * (2 * (quadrant // 2) - 1), (source % 2) * (2 * (quadrant % 2) - 1))


@wp.func
def resolve_radiance(image: ShadedImage, view: int, row: int, column: int) -> wp.vec3:
    """Multisample resolve: a pixel's own radiance, or the mean over its samples' source pixels."""
    resolve = image.resolve[view, row, column]
    if resolve == wp.uint32(0):
        return image.radiance[view, row, column]
    total = wp.vec3(0.0, 0.0, 0.0)
    per_quadrant = image.samples // QUADRANTS
    for sample in range(image.samples):
        step = source_offset(resolve, sample, sample // per_quadrant)
        total += image.radiance[view, row + step[0], column + step[1]]
    return total / float(image.samples)


@wp.func
def has_crease(gbuffer: GBuffer, grid: ImageGrid, focal: float, view: int, row: int, column: int, down: int, right: int) -> bool:
    """Crease or depth jump of one body between two pixels (step `down` or `right`), by the slopes before, across and after.

    1/z of a plane is linear in the image, so slopes are differences of 1/z over its value. At the image border, where one side is missing,
    the other's change of slope counts twice.
    """
    middle = 1.0 / gbuffer.depth[view, row, column]
    next = 1.0 / gbuffer.depth[view, row + down, column + right]
    scale = focal / middle
    across = scale * (next - middle)
    starts = row >= down and column >= right
    ends = row + 2 * down < grid.height and column + 2 * right < grid.width
    before = across
    after = across
    if starts:
        before = scale * (middle - 1.0 / gbuffer.depth[view, row - down, column - right])
    if ends:
        after = scale * (1.0 / gbuffer.depth[view, row + 2 * down, column + 2 * right] - next)
    if not starts:
        before = 2.0 * across - after
    elif not ends:
        after = 2.0 * across - before
    first = wp.abs(across - before)
    second = wp.abs(after - across)
    bend = first + second
    if bend <= CREASE_SLOPE or (bend >= JUMP_SLOPE and wp.min(first, second) <= FLAT_SLOPE):
        return False
    # The difference of two angles has the tangent (a - b) / (1 + a b).
    return first > CREASE_TURN * (1.0 + before * across) or second > CREASE_TURN * (1.0 + across * after)


@wp.func
def has_contrast(
    radiance: wp.array3d[wp.vec3],  # (view, row, column)
    view: int,
    top: int,
    left: int,
    bottom: int,
    right: int,
) -> bool:
    """True if the colours of a footprint's corners differ visibly, by MIN_CONTRAST in any channel."""
    a = radiance[view, top, left]
    b = radiance[view, top, right]
    c = radiance[view, bottom, left]
    d = radiance[view, bottom, right]
    largest = wp.max(wp.max(a, b), wp.max(c, d))
    spread = largest - wp.min(wp.min(a, b), wp.min(c, d))
    floor = MIN_CHANNEL * wp.max(largest)
    for channel in range(3):
        if spread[channel] > MIN_CONTRAST * wp.max(largest[channel], floor):
            return True
    return False


@wp.func
def has_discontinuity(
    gbuffer: GBuffer, grid: ImageGrid, intrinsics: wp.vec4, view: int, top: int, left: int, bottom: int, right: int
) -> bool:
    """True if the footprint between these rows and columns shows several bodies, or a crease or depth jump of one body."""
    segment = gbuffer.segment[view, top, left]
    if (
        gbuffer.segment[view, top, right] != segment
        or gbuffer.segment[view, bottom, left] != segment
        or gbuffer.segment[view, bottom, right] != segment
    ):
        return True
    if int(segment) == Segment.NOTHING or int(segment) == Segment.TABLE:
        return False
    fx = intrinsics[0]
    fy = intrinsics[1]
    bends = False
    if left < right:
        bends = has_crease(gbuffer, grid, fx, view, top, left, 0, 1) or has_crease(gbuffer, grid, fx, view, bottom, left, 0, 1)
    if top < bottom and not bends:
        bends = has_crease(gbuffer, grid, fy, view, top, left, 1, 0) or has_crease(gbuffer, grid, fy, view, top, right, 1, 0)
    if not bends:
        return False
    # Beside a crease, one triangle may fill the footprint.
    triangle = gbuffer.triangle[view, top, left]
    return (
        gbuffer.triangle[view, top, right] != triangle
        or gbuffer.triangle[view, bottom, left] != triangle
        or gbuffer.triangle[view, bottom, right] != triangle
    )


@wp.func
def corner_row(row: int, corner: int) -> int:
    """Row of the pixel at a corner of a footprint in this row."""
    return row - 1 + corner // 2


@wp.func
def corner_column(column: int, corner: int) -> int:
    """Column of the pixel at a corner of a footprint in this column."""
    return column - 1 + corner % 2


@wp.func
def place_sources(image: ShadedImage, view: int, row: int, column: int, sources: wp.uint32):
    """Scatter a footprint's source bits to its four corner pixels: each pixel receives those of its quadrant in the footprint."""
    bits = SOURCE_BITS * (image.samples // QUADRANTS)
    for own in range(FOOTPRINT_PIXELS):
        shift = wp.uint32(bits * (QUADRANTS - 1 - own))
        mine = ((sources >> shift) & ((wp.uint32(1) << wp.uint32(bits)) - wp.uint32(1))) << shift
        if mine != wp.uint32(0):
            wp.atomic_or(image.resolve, view, corner_row(row, own), corner_column(column, own), mine)


@kernel_of_views
def find_footprints_kernel(
    # Scene:
    footprints: ImageGrid,
    # In:
    shot: AnyShot,
    kept_row: wp.array[int],  # (view)
    # Out:
    image_inout: ShadedImage,
    lists_inout: FootprintLists,
    kept_inout: KeptSources,
):
    """Find footprints with a geometric discontinuity and visible contrast; list them, or place their source bits if these are kept.

    `count`, which must be 0, receives the numbers of listed footprints. Footprint (row, column) has pixel (row, column) as its lower right
    corner, and only one or two corners at the image border. Launched over view, footprint, in tile order.
    """
    grid = shot.grid
    view, row, column = tile_pixel(footprints, wp.tid())
    if not in_image(footprints, row, column):
        return
    top = wp.max(row - 1, 0)
    left = wp.max(column - 1, 0)
    bottom = wp.min(row, grid.height - 1)
    right = wp.min(column, grid.width - 1)
    # All pixels beside those of COLOR_PASS have it.
    if not needs(grid, image_inout.passes, SHADE_PASS, view, bottom, right):
        return
    # First the contrast: most footprints have none, and this test costs a fifth of the other.
    if not has_contrast(image_inout.radiance, view, top, left, bottom, right):
        return
    footprint = row * footprints.width + column
    if kept_inout.word.shape[0] > 0:
        kept, samples = kept_row[view], image_inout.samples
        sources = read_sources(kept_inout, kept, footprint, samples)
        if sources != footprint_mask(samples):
            place_sources(image_inout, view, row, column, sources)
            return
        clear_sources(kept_inout, kept, footprint, samples)
    if has_discontinuity(shot.gbuffer, grid, shot.views.cameras.intrinsics[view], view, top, left, bottom, right):
        chunk = tile_of(footprints, row, column) // CHUNK_TILES
        rank = wp.atomic_add(lists_inout.count, view, chunk, 1)
        lists_inout.footprint[view, chunk, rank] = footprint


@wp.func
def visible_segments(shot: AnyShot, view: int, row: int, column: int) -> wp.vec4i:
    """Segmentation ids at a footprint's corners; a corner outside the image has that of another."""
    segments = wp.vec4i(0, 0, 0, 0)
    for corner in range(FOOTPRINT_PIXELS):
        r = clamp_index(corner_row(row, corner), shot.grid.height)
        segments[corner] = int(shot.gbuffer.segment[view, r, clamp_index(corner_column(column, corner), shot.grid.width)])
    return segments


@wp.func
def find_ranks(bodies: ViewBodies, view: int, tile: int, segments: wp.vec4i, instances: int) -> tuple[wp.uint32, int]:
    """Find the bodies in a tile's mask that have one of four segmentation ids. Returns their ranks (indices into `ViewBodies.order`) in
    ascending order, packed with RANK_BITS each from bit 0 on, and the number of bodies."""
    ranks = wp.uint32(0)
    found = int(0)
    for word in range(bodies.body_mask.shape[2]):
        left = bodies.body_mask[view, tile, word]
        while left != wp.uint64(0):
            rank = word * MASK_BITS + lowest_bit(left)
            segment = segment_of(bodies.order[view, rank], instances)
            if segment == segments[0] or segment == segments[1] or segment == segments[2] or segment == segments[3]:
                ranks = ranks | (wp.uint32(rank) << wp.uint32(RANK_BITS * found))
                found += 1
            left = left & (left - wp.uint64(1))
    return ranks, found


@wp.func
def trace_visible(meshes: Meshes, shot: AnyShot, view: int, row: int, column: int, tile: int, ray: wp.vec3) -> Hit:
    """Closest hit of a coverage ray among the bodies that its footprint's corners show, at most four. All are found before the first is
    traced, so that rays of a warp traverse BVHs at the same time."""
    instances = shot.views.instances
    ranks, found = find_ranks(shot.bodies, view, tile, visible_segments(shot, view, row, column), instances)
    hit = no_hit()
    for index in range(found):
        rank = int((ranks >> wp.uint32(RANK_BITS * index)) & RANK_MASK)
        hit = trace_bodies(meshes, shot.bodies, view, rank, wp.uint64(1), ray, instances, hit)
    return hit


@wp.func
def select_source(
    meshes: Meshes, shot: AnyShot, view: int, row: int, column: int, own: int, offset: wp.vec2, hit: Hit, plane: Plane
) -> int:
    """Corner of a footprint that matches a coverage ray's hit best: same body, least sum of plane distance, normal difference and distance.

    Normals of background and table are not compared. `own`: corner whose pixel owns the sample; the result if no corner shows the body.
    `offset`: the sample [px from that pixel's centre]. `plane`: tangent plane of the hit, as seen from that pixel."""
    mesh = int(-1)
    if hit.segment != Segment.NOTHING and hit.segment != Segment.TABLE:
        mesh = shot.bodies.mesh[view, body_of(hit.segment, shot.views.instances)]
    best = own
    min_cost = float(wp.inf)
    for corner in range(FOOTPRINT_PIXELS):
        r = corner_row(row, corner)
        c = corner_column(column, corner)
        if in_image(shot.grid, r, c):
            if int(shot.gbuffer.segment[view, r, c]) == hit.segment:
                down = corner // 2 - own // 2
                right = corner % 2 - own % 2
                cost = DISTANCE_WEIGHT * wp.length(wp.vec2(float(right) - offset[0], float(down) - offset[1]))
                if hit.segment != Segment.NOTHING:
                    cost += plane_distance(plane, down, right, shot.gbuffer.depth[view, r, c]) / plane.width
                if mesh >= 0:
                    other = triangle_normal(meshes, mesh, shot.gbuffer.triangle[view, r, c])
                    cost += NORMAL_WEIGHT * (1.0 - wp.dot(triangle_normal(meshes, mesh, hit.triangle), other))
                if cost < min_cost:
                    min_cost = cost
                    best = corner
    return best


@kernel_of_views(cuda_max_registers=RAY_REGISTERS)
def resolve_footprints_kernel(
    # Scene:
    scene: PathScene,
    footprints: ImageGrid,
    # In:
    shot: AnyShot,
    lists: FootprintLists,
    kept_row: wp.array[int],  # (view)
    threads: int,
    # Out:
    image_inout: ShadedImage,
    kept_inout: KeptSources,
):
    """Trace a coverage ray for each sample in the listed footprints, and select the pixel whose radiance the sample takes.

    A footprint contains one quadrant of each of its corner pixels, with a quarter of that pixel's `samples`. `resolve` receives the
    samples' source bits, and so does `KeptSources`, unless it is empty. The host does not read the counts, so a fixed number of `threads`
    strides over the samples of a chunk; neighbouring threads take samples of one footprint, whose rays meet the same bodies. Launched over
    view, chunk, thread.
    """
    # Unsigned: cheaper to divide.
    thread = wp.uint32(wp.tid())
    place = thread // wp.uint32(threads)
    chunks = wp.uint32(lists.count.shape[1])
    view = int(place // chunks)
    chunk = int(place % chunks)
    cameras, samples = shot.views.cameras, image_inout.samples
    intrinsics = cameras.intrinsics[view]
    for index in range(int(thread % wp.uint32(threads)), samples * lists.count[view, chunk], threads):
        cell = wp.uint32(lists.footprint[view, chunk, int(wp.uint32(index) // wp.uint32(samples))])
        row = int(cell // wp.uint32(footprints.width))
        column = int(cell % wp.uint32(footprints.width))
        # The footprint contains the lower right quadrant of its upper left corner pixel, and so on.
        sample = samples - 1 - int(wp.uint32(index) % wp.uint32(samples))
        own = QUADRANTS - 1 - int(wp.uint32(sample) // (wp.uint32(samples) // wp.uint32(QUADRANTS)))
        r = corner_row(row, own)
        c = corner_column(column, own)
        if in_image(shot.grid, r, c):
            offset = sample_offset(sample, samples)
            ray = loop_ray(cameras, intrinsics, view, r, c, offset)
            hit = trace_visible(scene.meshes, shot, view, row, column, tile_of(shot.grid, r, c), ray)
            hit = hit_table(scene.table, cameras, view, ray, hit)
            normal = wp.vec3(0.0, 0.0, 0.0)
            if hit.segment != Segment.NOTHING:
                normal = wp.transpose(cameras.to_world[view]) * face_normal(scene.meshes, shot, view, hit)
            plane = tangent_plane(cameras, intrinsics, view, r, c, wp.uint8(hit.segment), hit.depth, normal)
            # The plane passes through the hit of the sample's ray, not through the pixel's centre.
            plane.height = hit.depth * wp.dot(normal, ray)
            best = select_source(scene.meshes, shot, view, row, column, own, offset, hit, plane)
            if best != own:
                bits = wp.uint32(best ^ own) << wp.uint32(SOURCE_BITS * sample)
                wp.atomic_or(image_inout.resolve, view, r, c, bits)
                if kept_inout.word.shape[0] > 0:
                    word, shift = locate_sources(int(cell), samples)
                    wp.atomic_or(kept_inout.word, kept_row[view], word, bits << shift)
