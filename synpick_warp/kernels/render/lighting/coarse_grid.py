"""Coarse pixels: blocks of pixels that are lit by the rays of their middle pixel; visiting order, sample order, and guide image."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import TILE_PIXELS, ImageGrid, camera_ray, hit_position
from synpick_warp.kernels.render.visibility.gbuffer import AnyShot, Hit, read_hit
from synpick_warp.kernels.render.visibility.records import write_record
from synpick_warp.kernels.tuning import LANE_COLUMNS, LANE_STRIDE

wp.set_module_options({"enable_backward": False})

PLANE_TOLERANCE = wp.constant(1.0)
"""Coarse pixels lie on one surface up to this distance from its tangent plane, in widths of a coarse pixel times the filter's stride."""
NORMAL_STEPS = wp.constant(14)
"""Steps of each coordinate of a packed normal; even, so that a normal towards the camera is exact."""
MIN_WEIGHT = wp.constant(1.0e-4)
"""Joint bilateral upsampling: weight of a coarse pixel on another surface, which counts only where no other is left."""


@wp.struct
class CoarseGrid:
    """Grid of coarse pixels over an image: their size, both grids, and rays per lamp; the pixel in the middle of each represents it."""

    size: int
    """Width of a coarse pixel [px]; 0 in mode unoccluded, which has none."""
    rays: int
    """Shadow rays to a lamp from each full-resolution pixel at a steep edge of its shadow, 1 or 4; used by the shadow grid alone."""
    image: ImageGrid
    """Full-resolution grid [px]."""
    grid: ImageGrid


@wp.struct
class Guide:
    """Guide image of the joint bilateral filters at coarse resolution: normal, depth and segmentation id of each coarse pixel, packed;
    segmentation id NOTHING where no surface is visible. Scratch.
    """

    surface: wp.array3d[wp.vec4]
    """(view, cell_row, cell_column): packed by `pack_surface`; 0, with the segmentation id NOTHING, where no surface is visible."""


@wp.func
def flat_index(grid: ImageGrid, view: int, row: int, column: int) -> int:
    """Index of an element in a contiguous array (view, row, column) over `grid`."""
    return (view * grid.height + row) * grid.width + column


@wp.func
def pack_surface(segment: int, depth: float, normal: wp.vec3) -> wp.vec4:
    """Pack a surface: x and y of its shading normal in camera space, planar depth [m], and segmentation id. The id is negative where the
    normal points away from the camera; so z of the normal, a unit vector, follows from x and y."""
    return wp.vec4(normal[0], normal[1], depth, wp.where(normal[2] > 0.0, -float(segment), float(segment)))


@wp.func
def surface_segment(surface: wp.vec4) -> wp.uint8:
    """Segmentation id in a surface of `pack_surface`, as in `GBuffer`."""
    return wp.uint8(int(wp.abs(surface[3])))


@wp.func
def surface_depth(surface: wp.vec4) -> float:
    """Planar depth in a surface of `pack_surface` [m]."""
    return surface[2]


@wp.func
def surface_normal(surface: wp.vec4) -> wp.vec3:
    """Shading normal in a surface of `pack_surface`, in camera space."""
    z = wp.sqrt(wp.max(1.0 - surface[0] * surface[0] - surface[1] * surface[1], 0.0))
    return wp.vec3(surface[0], surface[1], wp.where(surface[3] < 0.0, z, -z))


@wp.func
def pack_normal(normal: wp.vec3) -> int:
    """Pack the unit normal of a visible surface in camera space into 8 bits: octahedral mapping (Meyer et al., 2010)."""
    x = wp.where(normal[2] > 0.0, -normal[0], normal[0])
    y = wp.where(normal[2] > 0.0, -normal[1], normal[1])
    scale = 0.5 * float(NORMAL_STEPS) / (wp.abs(x) + wp.abs(y) + wp.abs(normal[2]))
    half = 0.5 * float(NORMAL_STEPS) + 0.5
    return (int(scale * (x + y) + half) << 4) | int(scale * (x - y) + half)


@wp.func
def octahedral_vector(packed: int) -> wp.vec3:
    """Decode a normal of `pack_normal` (octahedral mapping), not normalized; its direction is up to 8° off."""
    p = 2.0 * float((packed >> 4) & 15) / float(NORMAL_STEPS) - 1.0
    q = 2.0 * float(packed & 15) / float(NORMAL_STEPS) - 1.0
    x = 0.5 * (p + q)
    y = 0.5 * (p - q)
    return wp.vec3(x, y, wp.abs(x) + wp.abs(y) - 1.0)


@wp.func
def unpack_normal(packed: int) -> wp.vec3:
    """Decode a normal of `pack_normal` to a unit vector, up to 8° off."""
    return wp.normalize(octahedral_vector(packed))


@wp.func
def middle_pixel(coarse: CoarseGrid, row: int, column: int) -> wp.vec2i:
    """(row, column) of the pixel that represents a coarse pixel."""
    middle = coarse.size // 2
    return wp.vec2i(
        wp.min(row * coarse.size + middle, coarse.image.height - 1), wp.min(column * coarse.size + middle, coarse.image.width - 1)
    )


@wp.func
def morton_index(period: int, row: int, column: int) -> int:
    """Morton code (Z-order) of a coarse pixel within squares of `period` (2 to 16) pixels: which of period² sample points it takes. The
    bits of row and column are interleaved, so that aligned squares of 2^k pixels hold aligned runs of 4^k indices."""
    index = int(0)
    for bit in range(4):
        if (1 << bit) < period:
            index += ((column >> bit) & 1) << (2 * bit)
            index += ((row >> bit) & 1) << (2 * bit + 1)
    return index


@wp.func
def coarse_coordinate(coarse: CoarseGrid, pixel: int) -> float:
    """Row or column of a pixel in coarse pixels, for interpolation between values at their middle pixels."""
    return float(pixel - coarse.size // 2) / float(coarse.size)


@wp.func
def interleaved_pixel(coarse: CoarseGrid, index: int) -> tuple[int, int, int]:
    """(view, row, column) of a thread in interleaved order; row or column may lie outside the grid. The threads of a warp take coarse
    pixels LANE_STRIDE apart, whose sample points are close together: their rays are nearly parallel and visit the same BVH nodes."""
    # Unsigned, as in `tile_pixel`.
    lanes, stride, columns = wp.uint32(TILE_PIXELS), wp.uint32(LANE_STRIDE), wp.uint32(LANE_COLUMNS)
    across = stride * columns
    down = stride * (lanes // columns)
    regions_across = (wp.uint32(coarse.grid.width) + across - wp.uint32(1)) // across
    regions = regions_across * ((wp.uint32(coarse.grid.height) + down - wp.uint32(1)) // down)
    flat = wp.uint32(index)
    lane = flat % lanes
    offset = (flat // lanes) % (stride * stride)
    region = flat // (lanes * stride * stride)
    view = region // regions
    region = region % regions
    row = (region // regions_across) * down + (lane // columns) * stride + offset // stride
    column = (region % regions_across) * across + (lane % columns) * stride + offset % stride
    return int(view), int(row), int(column)


@wp.struct
class CoarseSurface:
    """Shading point of a coarse pixel: hit, position, view direction and footprint at its middle pixel."""

    hit: Hit
    position: wp.vec3
    """[m]"""
    outgoing: wp.vec3
    """Unit vector to the camera."""
    width: float
    """Width of the coarse pixel across the ray [m]."""


@wp.func
def coarse_surface(coarse: CoarseGrid, shot: AnyShot, view: int, row: int, column: int) -> CoarseSurface:
    """Surface that a coarse pixel shows: hit, position, direction to the camera and footprint, from the G-buffer at its middle pixel."""
    cameras = shot.views.cameras
    pixel = middle_pixel(coarse, row, column)
    ray = camera_ray(cameras, view, pixel[0], pixel[1], wp.vec2(0.0, 0.0))
    surface = CoarseSurface()
    surface.hit = read_hit(shot.gbuffer, view, pixel[0], pixel[1])
    surface.position = hit_position(cameras, view, ray, surface.hit.depth)
    surface.outgoing = -wp.normalize(cameras.to_world[view] * ray)
    surface.width = float(coarse.size) * surface.hit.depth / cameras.intrinsics[view][0]
    return surface


@wp.func
def write_guide(guide: Guide, to_world: wp.mat33, index: int, hit: Hit, normal: wp.vec3):
    """Write the guide image of a coarse pixel that shows a surface, by its `flat_index`; `normal` is in the world."""
    write_record(guide.surface, index, pack_surface(hit.segment, hit.depth, wp.transpose(to_world) * normal))
