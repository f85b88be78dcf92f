"""Cameras (OpenCV convention): pixel tiles, camera rays, projected boxes. The only place that defines where pixel centres are."""

from typing import Any

import warp as wp

from synpick_warp.kernels.render.visibility.lens import BEND, Lenses, distort, table_ray, undistort
from synpick_warp.kernels.render.visibility.variants import VARIANTS, variant_of

wp.set_module_options({"enable_backward": False})

PIXEL_CENTER = wp.constant(0.5)
"""Pixel (row, column) has its centre at (column + 0.5, row + 0.5) in coordinates of the camera matrix, as in BOP."""
TILE_WIDTH = wp.constant(8)
TILE_HEIGHT = wp.constant(4)
TILE_PIXELS = wp.constant(32)
"""A warp's threads share a tile of 8 x 4 pixels: their rays traverse the same BVH nodes."""
BOX_MARGIN = wp.constant(1.0)
"""Margin around a projected box [px], against rounding."""
NEAR_PLANE = wp.constant(1.0e-3)
"""Points closer to the camera's plane than this [m] are not projected."""


@wp.struct
class CameraTable:
    """Cameras, a row for each camera of a scene, or by `aim_cameras_kernel` or the host for each view of a batch."""

    intrinsics: wp.array[wp.vec4]
    """(row): fx, fy, cx, cy [px]."""
    rotation: wp.array[wp.mat33d]
    """(row): world to camera."""
    center: wp.array[wp.vec3d]
    """(row): optical centre in the world [m]."""
    to_world: wp.array[wp.mat33]
    """(row): camera to world, in float32 for the per-pixel kernels."""
    lens: wp.array[int]
    """(row): row of `lenses`; -1: a pinhole."""
    lenses: Lenses
    """Lenses of the cameras that are distorted; null: none is."""


# Kernels of `CameraTable` are those of pinholes, and never read its lenses: see `lens_of`. Without these members the compiler would order
# the instructions of every kernel of views otherwise, so that last bits of pictures could change.
LensCameras = variant_of(CameraTable, "LensCameras")
"""Cameras of the views of a batch, where some are distorted."""
AnyCameras = Any
"""`CameraTable`, or `LensCameras`: functions are compiled for each; see `variants`."""


@wp.struct
class ImageGrid:
    """Size of an image [px], tiles in a row of its grid, and tiles in the image."""

    width: int
    height: int
    tile_columns: int
    tiles: int


@wp.struct
class Views:
    """Views of a batch: world and camera of each (-1: not in use), where the cameras stand, number of views, instances per world. Rows from
    `count` on are not read.
    """

    world: wp.array[int]
    """(view); -1: the view is not in use."""
    camera: wp.array[int]
    """(view): index among all cameras, by which random numbers are addressed; -1: the view is not in use."""
    slot: wp.array[int]
    """(view): row of the scene's cameras, which are those of one image size."""
    cameras: CameraTable
    count: int
    instances: int


LensViews = variant_of(Views, "LensViews", cameras=LensCameras)
"""Views of a batch, where some cameras are distorted."""
AnyViews = Any
"""`Views`, or `LensViews`: kernels are compiled for each; see `variants`."""
VARIANTS["views"] = VARIANTS["views_inout"] = Views, LensViews


@wp.func
def tile_pixel(grid: ImageGrid, index: int) -> tuple[int, int, int]:
    """(view, row, column) of a flat thread index in tile order: view, tile, pixel of the tile; the pixel may lie outside the image."""
    # Unsigned: cheaper to divide, and known not to be negative, which spares each look-up the test for indices that count from the end.
    flat = wp.uint32(index)
    lane = flat % wp.uint32(TILE_PIXELS)
    tile = flat // wp.uint32(TILE_PIXELS)
    view = tile // wp.uint32(grid.tiles)
    tile = tile % wp.uint32(grid.tiles)
    tile_row = tile // wp.uint32(grid.tile_columns)
    tile_column = tile % wp.uint32(grid.tile_columns)
    row = tile_row * wp.uint32(TILE_HEIGHT) + lane // wp.uint32(TILE_WIDTH)
    column = tile_column * wp.uint32(TILE_WIDTH) + lane % wp.uint32(TILE_WIDTH)
    return int(view), int(row), int(column)


@wp.func
def in_image(grid: ImageGrid, row: int, column: int) -> bool:
    """True if a pixel lies within the image."""
    return row >= 0 and row < grid.height and column >= 0 and column < grid.width


@wp.func
def clamp_index(index: int, size: int) -> int:
    """Nearest index from 0 to `size` - 1. The maximum comes last: the compiler then knows that the result is not negative, which spares
    look-ups Warp's test for indices that count from the end."""
    return wp.max(wp.min(index, size - 1), 0)


@wp.func
def tile_of(grid: ImageGrid, row: int, column: int) -> int:
    """Index of the tile that contains a pixel."""
    return (row // TILE_HEIGHT) * grid.tile_columns + column // TILE_WIDTH


@wp.func
def pinhole_ray(intrinsics: wp.vec4, row: int, column: int, offset: wp.vec2) -> wp.vec3:
    """Ray ((x - cx) / fx, (y - cy) / fy, 1) of a pixel, `offset` [px] from its centre, in the axes of a pinhole camera."""
    x = float(column) + PIXEL_CENTER + offset[0]
    y = float(row) + PIXEL_CENTER + offset[1]
    return wp.vec3((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1], 1.0)


@wp.func
def lens_of(cameras: CameraTable, view: int) -> int:
    """Row of a view's lens in `LensCameras.lenses`; -1: a pinhole, known when the kernel is compiled."""
    return -1


@wp.func
def lens_of(cameras: LensCameras, view: int) -> int:  # noqa: F811
    """Row of a view's lens in `LensCameras.lenses`; -1: a pinhole."""
    return cameras.lens[view]


@wp.func
def camera_ray(cameras: AnyCameras, view: int, row: int, column: int, offset: wp.vec2) -> wp.vec3:
    """Camera ray (x, y, 1) of a pixel of a view in the camera's axes: its parameter is planar depth. `offset` [px] from the pixel's centre;
    zero for depth, ids and masks. The ray of a lens is that of the nearest pixel in the image."""
    return loop_ray(cameras, cameras.intrinsics[view], view, row, column, offset)


@wp.func
def loop_ray(cameras: AnyCameras, intrinsics: wp.vec4, view: int, row: int, column: int, offset: wp.vec2) -> wp.vec3:
    """As `camera_ray`, with the view's `intrinsics`: where more is done with them, and in loops, which would read them for each ray."""
    lens = lens_of(cameras, view)
    if lens >= 0:
        return table_ray(cameras.lenses, lens, row, column, offset)
    return pinhole_ray(intrinsics, row, column, offset)


@wp.func
def border_ray(cameras: AnyCameras, intrinsics: wp.vec4, view: int, row: int, column: int) -> wp.vec3:
    """As `loop_ray`, of a pixel's centre that may lie outside the image, where a lens is continued."""
    ray = pinhole_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))
    lens = lens_of(cameras, view)
    if lens >= 0:
        near = table_ray(cameras.lenses, lens, row, column, wp.vec2(0.0, 0.0))
        found = undistort(cameras.lenses, lens, wp.vec2(ray[0], ray[1]), wp.vec2(near[0], near[1]))
        ray = wp.vec3(found[0], found[1], 1.0)
    return ray


@wp.func
def hit_position(cameras: AnyCameras, view: int, ray: wp.vec3, depth: float) -> wp.vec3:
    """World position of a camera ray at a planar depth [m]."""
    return wp.vec3(cameras.center[view]) + cameras.to_world[view] * (depth * ray)


@wp.func
def clip_to_canvas(canvas: wp.vec4i, box: wp.vec4, margin: float) -> wp.vec4i:
    """Pixels of a box (x_min, y_min, x_max, y_max), enlarged by a margin [px], within those of a canvas, inclusive; x_max < x_min: none."""
    # Clamp before converting: the projection of a corner close to the near plane may overflow an int.
    x_min = wp.clamp(box[0] - margin, float(canvas[0]), float(canvas[2] + 1))
    y_min = wp.clamp(box[1] - margin, float(canvas[1]), float(canvas[3] + 1))
    x_max = wp.clamp(box[2] + margin, float(canvas[0] - 1), float(canvas[2]))
    y_max = wp.clamp(box[3] + margin, float(canvas[1] - 1), float(canvas[3]))
    if x_max < x_min or y_max < y_min:
        return wp.vec4i(0, 0, -1, -1)
    return wp.vec4i(int(wp.floor(x_min)), int(wp.floor(y_min)), int(wp.floor(x_max)), int(wp.floor(y_max)))


@wp.func
def projected_box(
    lower: wp.vec3, upper: wp.vec3, rotation: wp.mat33d, position: wp.vec3d, cameras: AnyCameras, view: int, grid: ImageGrid
) -> wp.vec4i:
    """Conservative screen box (x_min, y_min, x_max, y_max) [px] of a bounding box, inclusive; x_max < x_min: empty.

    The box has corners `lower` and `upper` [m] in a frame that `rotation` and `position` transform into the camera's. The result is
    clipped to one image size beyond each border; it is that whole canvas if a corner lies behind the near plane, and empty if all do. A
    lens bends the box: its image lies within bend D² / 6 of that of its corners, where D is their diameter in the normalised plane.
    """
    intrinsics = cameras.intrinsics[view]
    lens = lens_of(cameras, view)
    least = wp.vec2(1.0e9, 1.0e9)
    most = wp.vec2(-1.0e9, -1.0e9)
    canvas = wp.vec4i(-grid.width, -grid.height, 2 * grid.width - 1, 2 * grid.height - 1)
    x_min = float(1.0e9)
    y_min = float(1.0e9)
    x_max = float(-1.0e9)
    y_max = float(-1.0e9)
    behind = int(0)
    for corner in range(8):
        x = wp.where(corner & 1 != 0, upper[0], lower[0])
        y = wp.where(corner & 2 != 0, upper[1], lower[1])
        z = wp.where(corner & 4 != 0, upper[2], lower[2])
        point = rotation * wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(z)) + position
        depth = float(point[2])
        if depth < NEAR_PLANE:
            behind += 1
        else:
            column = intrinsics[0] * float(point[0]) / depth + intrinsics[2]
            row = intrinsics[1] * float(point[1]) / depth + intrinsics[3]
            if lens >= 0:
                slope = wp.vec2(float(point[0]) / depth, float(point[1]) / depth)
                least = wp.min(least, slope)
                most = wp.max(most, slope)
                image, _ = distort(cameras.lenses, lens, slope)
                column = intrinsics[0] * image[0] + intrinsics[2]
                row = intrinsics[1] * image[1] + intrinsics[3]
            x_min = wp.min(x_min, column)
            x_max = wp.max(x_max, column)
            y_min = wp.min(y_min, row)
            y_max = wp.max(y_max, row)
    if behind == 8:
        return wp.vec4i(0, 0, -1, -1)
    if behind > 0:
        return canvas
    margin = float(BOX_MARGIN)
    if lens >= 0:
        margin += cameras.lenses.number[lens, BEND] * wp.length_sq(most - least) / 6.0
    return clip_to_canvas(canvas, wp.vec4(x_min, y_min, x_max, y_max), margin)


@wp.kernel
def compute_rays_kernel(
    # Scene:
    cameras: CameraTable,
    # In:
    slot: wp.array[int],  # (view)
    view_cameras: LensCameras,
    # Out:
    ray_out: wp.array3d[wp.vec2],  # (view, row, column)
):
    """Ray of each pixel of the views that have a lens, by Newton's method from that of the same pixel in the scene, `cameras`. `slot` is
    the row of a view's camera in the scene. Launched over view, row, column."""
    view, row, column = wp.tid()
    if view_cameras.lens[view] >= 0:
        center = wp.vec2(0.0, 0.0)
        ray = pinhole_ray(view_cameras.intrinsics[view], row, column, center)
        near = table_ray(cameras.lenses, cameras.lens[slot[view]], row, column, center)
        goal = wp.vec2(ray[0], ray[1])
        ray_out[view, row, column] = undistort(view_cameras.lenses, view_cameras.lens[view], goal, wp.vec2(near[0], near[1]))
