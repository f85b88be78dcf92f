"""Pixels, rays and boxes of pinhole cameras. The one place that knows where in a pixel its ray passes."""

import warp as wp

wp.set_module_options({"enable_backward": False})

PIXEL_CENTER = wp.constant(0.5)
"""The ray of pixel (row, column) passes (column + 0.5, row + 0.5), as in OpenCV's and BOP's camera matrices."""
TILE_WIDTH = wp.constant(8)
TILE_HEIGHT = wp.constant(4)
TILE_PIXELS = wp.constant(32)
"""The threads of one warp share a tile of 8 x 4 pixels: their rays visit the same nodes of a mesh's tree."""
BOX_MARGIN = wp.constant(1.0)
"""Pixels added around a projected box, against rounding."""
NEAR_PLANE = wp.constant(1.0e-3)
"""A corner nearer to the camera's plane than this [m] has no useful projection."""


@wp.struct
class Cameras:
    """Constant, one row a camera."""

    intrinsics: wp.array[wp.vec4]
    """fx, fy, cx, cy [px]."""
    rotation: wp.array[wp.mat33d]
    """World to camera."""
    center: wp.array[wp.vec3d]
    """Optical centre in the world [m]."""
    to_world: wp.array[wp.mat33]
    """Camera's axes to the world's, in float32 for the per-pixel kernels."""


@wp.struct
class ImageGrid:
    """Size of the images and of their grid of tiles."""

    width: int
    height: int
    tile_columns: int
    tiles: int
    """Tiles in an image."""


@wp.struct
class Views:
    """Views of a batch: which camera shows which world. Rows from `count` on are not read."""

    world: wp.array[int]
    """(view); -1: the view is not in use."""
    camera: wp.array[int]
    """(view): row of `Cameras`; -1: the view is not in use."""
    count: int
    """Views in the batch."""
    instances: int
    """Instance capacity of a world."""


@wp.func
def tile_pixel(grid: ImageGrid, index: int) -> tuple[int, int, int]:
    """(view, row, column) of a flat index that walks views, tiles, and pixels within a tile; row or column may lie outside the image."""
    lane = index % TILE_PIXELS
    tile = index // TILE_PIXELS
    view = tile // grid.tiles
    tile = tile - view * grid.tiles
    tile_row = tile // grid.tile_columns
    tile_column = tile - tile_row * grid.tile_columns
    row = tile_row * TILE_HEIGHT + lane // TILE_WIDTH
    column = tile_column * TILE_WIDTH + lane % TILE_WIDTH
    return view, row, column


@wp.func
def in_image(grid: ImageGrid, row: int, column: int) -> bool:
    """True if a pixel lies within the image."""
    return row >= 0 and row < grid.height and column >= 0 and column < grid.width


@wp.func
def tile_of(grid: ImageGrid, row: int, column: int) -> int:
    """Number of the tile that holds a pixel."""
    return (row // TILE_HEIGHT) * grid.tile_columns + column // TILE_WIDTH


@wp.func
def camera_ray(intrinsics: wp.vec4, row: int, column: int, offset: wp.vec2) -> wp.vec3:
    """Direction ((x - cx) / fx, (y - cy) / fy, 1) in the camera's axes, so that a multiple of it is planar depth.

    `offset` [px] is measured from the pixel's centre; zero for depth, identities and masks.
    """
    x = float(column) + PIXEL_CENTER + offset[0]
    y = float(row) + PIXEL_CENTER + offset[1]
    return wp.vec3((x - intrinsics[2]) / intrinsics[0], (y - intrinsics[3]) / intrinsics[1], 1.0)


@wp.func
def hit_position(cameras: Cameras, camera: int, ray: wp.vec3, depth: float) -> wp.vec3:
    """Where a camera ray reaches a planar depth, in the world [m]."""
    return wp.vec3(cameras.center[camera]) + cameras.to_world[camera] * (depth * ray)


@wp.func
def projected_box(
    lower: wp.vec3,
    upper: wp.vec3,
    rotation: wp.mat33d,
    position: wp.vec3d,
    intrinsics: wp.vec4,
    grid: ImageGrid,
) -> wp.vec4i:
    """Pixels that a box can cover: x_min, y_min, x_max, y_max, inclusive; x_max < x_min: none.

    The box has corners `lower` and `upper` [m] in a frame that `rotation` and `position` carry to the camera's. The result is clipped
    to one image size beyond each border; it is that whole canvas where a corner lies behind the near plane, and empty where all do.
    """
    canvas = wp.vec4i(-grid.width, -grid.height, 2 * grid.width - 1, 2 * grid.height - 1)
    x_min = float(1.0e9)
    y_min = float(1.0e9)
    x_max = float(-1.0e9)
    y_max = float(-1.0e9)
    behind = int(0)
    for corner in range(8):
        x = lower[0]
        y = lower[1]
        z = lower[2]
        if corner & 1 != 0:
            x = upper[0]
        if corner & 2 != 0:
            y = upper[1]
        if corner & 4 != 0:
            z = upper[2]
        point = rotation * wp.vec3d(wp.float64(x), wp.float64(y), wp.float64(z)) + position
        depth = float(point[2])
        if depth < NEAR_PLANE:
            behind += 1
        else:
            column = intrinsics[0] * float(point[0]) / depth + intrinsics[2]
            row = intrinsics[1] * float(point[1]) / depth + intrinsics[3]
            x_min = wp.min(x_min, column)
            x_max = wp.max(x_max, column)
            y_min = wp.min(y_min, row)
            y_max = wp.max(y_max, row)
    if behind == 8:
        return wp.vec4i(0, 0, -1, -1)
    if behind > 0:
        return canvas
    # Clamped before the conversion: an int cannot hold what a corner close to the near plane may project to.
    x_min = wp.clamp(x_min - BOX_MARGIN, float(canvas[0]), float(canvas[2] + 1))
    y_min = wp.clamp(y_min - BOX_MARGIN, float(canvas[1]), float(canvas[3] + 1))
    x_max = wp.clamp(x_max + BOX_MARGIN, float(canvas[0] - 1), float(canvas[2]))
    y_max = wp.clamp(y_max + BOX_MARGIN, float(canvas[1] - 1), float(canvas[3]))
    if x_max < x_min or y_max < y_min:
        return wp.vec4i(0, 0, -1, -1)
    return wp.vec4i(int(wp.floor(x_min)), int(wp.floor(y_min)), int(wp.floor(x_max)), int(wp.floor(y_max)))
