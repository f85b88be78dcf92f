"""Structured-light depth sensor model: quantized disparity to a projector beside the camera, with noise, shadow and invalid pixels."""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.images.camera_effects import SensorParameters, shot_key
from synpick_warp.kernels.render.images.layers import LayerScene, hit_surface, kernel_of_layer
from synpick_warp.kernels.render.lighting.paths.tracing import AnyScene
from synpick_warp.kernels.render.visibility.camera import TILE_HEIGHT, TILE_PIXELS, ImageGrid, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import FAR, MAX_COUNTS, AnyShot, GBuffer
from synpick_warp.kernels.rng import normal_pair, pixel_key

wp.set_module_options({"enable_backward": False})

SAME_RAY = wp.constant(0.5)
"""Projector columns that differ by at most this [px] count as the same projector ray."""


@wp.func
def disparity_at(gbuffer: GBuffer, focal_baseline: float, view: int, row: int, column: int) -> float:
    """Disparity of a pixel's surface d = f b / z [px], 0 without surface; `focal_baseline` is f b [px m]."""
    if int(gbuffer.segment[view, row, column]) == Segment.NOTHING:
        return 0.0
    return focal_baseline / gbuffer.depth[view, row, column]


@wp.func
def near_discontinuity(shot: AnyShot, sensor: SensorParameters, focal_baseline: float, view: int, row: int, column: int) -> bool:
    """Edge invalidation: True if any disparity in the matching window differs from the center's by more than the threshold. Block matching
    fails, or matches the wrong surface, where a window covers a depth discontinuity."""
    here = disparity_at(shot.gbuffer, focal_baseline, view, row, column)
    for down in range(-sensor.edge_width, sensor.edge_width + 1):
        for right in range(-sensor.edge_width, sensor.edge_width + 1):
            at_row = wp.clamp(row + down, 0, shot.grid.height - 1)
            at_column = wp.clamp(column + right, 0, shot.grid.width - 1)
            if wp.abs(disparity_at(shot.gbuffer, focal_baseline, view, at_row, at_column) - here) > sensor.edge_step:
                return True
    return False


@wp.kernel
def find_nearest_kernel(
    # In:
    grid: ImageGrid,
    gbuffer: GBuffer,
    # Out:
    nearest_inout: wp.array2d[float],  # (view, row of tiles) [m]
):
    """Lower `nearest_inout` to the least depth in each row of tiles. Launched over view, tile."""
    view, tile = wp.tid()
    nearest = float(FAR)
    for index in range(TILE_PIXELS):
        _, row, column = tile_pixel(grid, tile * TILE_PIXELS + index)
        if in_image(grid, row, column):
            if int(gbuffer.segment[view, row, column]) != Segment.NOTHING:
                nearest = wp.min(nearest, gbuffer.depth[view, row, column])
    wp.atomic_min(nearest_inout, view, tile // grid.tile_columns, nearest)


@wp.func
def is_occluded(shot: AnyShot, nearest: wp.array2d[float], focal_baseline: float, side: int, view: int, row: int, column: int) -> bool:
    """Shadow test against a second viewpoint at the camera's right (`side` 1) or left (-1): True if a surface in the same row occludes it.

    The column of a pixel in the second view is its own column minus `side` times its disparity. A pixel k columns to that side whose
    disparity is larger by k lies on the same ray and is nearer. The largest disparity in the row of tiles bounds the search.
    """
    here = disparity_at(shot.gbuffer, focal_baseline, view, row, column)
    max_difference = focal_baseline / nearest[view, row // TILE_HEIGHT] - here
    space = shot.grid.width - 1 - column
    if side < 0:
        space = column
    reach = wp.min(int(wp.ceil(max_difference)), space)
    for away in range(1, reach + 1):
        difference = disparity_at(shot.gbuffer, focal_baseline, view, row, column + side * away) - here
        if wp.abs(difference - float(away)) <= SAME_RAY:
            return True
    return False


@wp.func
def in_shadow(layer: LayerScene, shot: AnyShot, focal_baseline: float, view: int, row: int, column: int) -> bool:
    """True if the projector, right of the depth image's camera, or the infrared camera, left of it, does not see a pixel's surface."""
    registration = layer.sensor.registration
    if is_occluded(shot, layer.nearest, focal_baseline * (1.0 - registration), 1, view, row, column):
        return True
    if registration == 0.0:
        return False
    return is_occluded(shot, layer.nearest, focal_baseline * registration, -1, view, row, column)


@wp.func
def lattice_normals(key: wp.uint64, grid: ImageGrid, width: int, row: int, column: int, index: int) -> wp.vec2:
    """Two independent standard normal samples of a pixel, correlated with those of its neighbours: value noise.

    Bilinear interpolation between samples of the points of a lattice, `width` px apart, divided by the root of the sum of squared
    weights, so that the variance is 1 everywhere. `key` is that of the view; `index` counts samples as in `normal_pair`.
    """
    if width == 1:
        return normal_pair(pixel_key(key, row * grid.width + column), index)
    x, y = float(column) / float(width), float(row) / float(width)
    left, top = int(x), int(y)
    right_part, lower_part = x - float(left), y - float(top)
    total, squares = wp.vec2(0.0, 0.0), float(0.0)
    for corner in range(4):
        right, lower = corner % 2, corner // 2
        across, down = 1.0 - right_part, 1.0 - lower_part
        if right == 1:
            across = right_part
        if lower == 1:
            down = lower_part
        weight = across * down
        total += weight * normal_pair(pixel_key(key, (top + lower) * (grid.width + 1) + left + right), index)
        squares += weight * weight
    return total / wp.sqrt(squares)


@wp.func
def measured_pixel(sensor: SensorParameters, grid: ImageGrid, key: wp.uint64, row: int, column: int) -> tuple[int, int]:
    """Row and column that a pixel shows by lateral noise; `key` is that of the view."""
    displacement = sensor.lateral_noise * lattice_normals(key, grid, sensor.noise_width, row, column, 0)
    at_row = wp.clamp(row + int(wp.rint(displacement[0])), 0, grid.height - 1)
    at_column = wp.clamp(column + int(wp.rint(displacement[1])), 0, grid.width - 1)
    return at_row, at_column


@wp.func
def axial_noise(sensor: SensorParameters, depth: float, cosine: float) -> float:
    """Standard deviation of a measured depth [m] for the cosine of the angle of incidence; the law of configs.cell.cameras.DepthSensor."""
    off = depth - sensor.noise_distance
    angle = wp.acos(wp.clamp(cosine, 0.0, 1.0))
    ratio = angle / (wp.HALF_PI - angle)
    return sensor.noise + sensor.noise_growth * off * off + sensor.noise_angle / wp.sqrt(depth) * ratio * ratio


@wp.func
def quantize_depth(sensor: SensorParameters, focal_baseline: float, depth: float, noise: float) -> float:
    """Depth whose disparity, with `noise` standard deviations added, is rounded to the nearest multiple of the step [m]. 0: outside of the
    measuring range."""
    if depth < sensor.near or depth > sensor.far:
        return 0.0
    if sensor.max_disparity > 0.0 and focal_baseline > sensor.max_disparity * depth:
        return 0.0
    steps = wp.rint(focal_baseline / (depth * sensor.disparity_step) + sensor.disparity_noise * noise / sensor.disparity_step)
    if steps < 1.0:
        return 0.0
    return focal_baseline / (steps * sensor.disparity_step)


@wp.func
def read_out(layer: LayerScene, shot: AnyShot, view: int, row: int, column: int, depth: float, cosine: float, bias: float) -> wp.uint16:
    """Measured depth of a pixel in counts, with axial noise, noise of disparity and disparity steps; 0: outside of the measuring range.
    `cosine`: of the angle of incidence. `bias`: systematic error of the depth [m]."""
    sensor, key = layer.sensor, shot_key(layer.sensor.seed, shot, view, Stream.DEPTH_NOISE)
    noise = lattice_normals(key, shot.grid, sensor.noise_width, row, column, 2)
    noisy = depth + bias + axial_noise(sensor, depth, cosine) * noise[0]
    counts = sensor.counts_per_meter * quantize_depth(sensor, shot.views.cameras.intrinsics[view][0] * sensor.baseline, noisy, noise[1])
    return wp.uint16(wp.where(wp.rint(counts) <= MAX_COUNTS, wp.rint(counts), 0.0))


@wp.func
def sensor_depth_at(scene: AnyScene, layer: LayerScene, shot: AnyShot, view: int, row: int, column: int) -> wp.uint16:
    """Simulate a structured-light depth image: disparity d = f b / (z + σ n) + σ' n', rounded to steps; n and n' are standard normal.

    z is the depth of a pixel displaced by lateral noise, σ its axial noise, σ' the noise of disparity. The result is f b / d in counts, 0
    for invalid pixels (holes): no surface, grazing incidence, depth discontinuities, shadow of the projector or of the infrared camera,
    outside of the measuring range. n and n' are of the random number stream (seed, episode, frame, camera, DEPTH_NOISE) and the pixel, or
    the lattice points around it, so each image has noise of its own.
    """
    sensor, grid, cameras = layer.sensor, shot.grid, shot.views.cameras
    key = shot_key(sensor.seed, shot, view, Stream.DEPTH_NOISE)
    at_row, at_column = measured_pixel(sensor, grid, key, row, column)
    if int(shot.gbuffer.segment[view, at_row, at_column]) == Segment.NOTHING:
        return wp.uint16(0)
    focal_baseline = cameras.intrinsics[view][0] * sensor.baseline
    depth = shot.gbuffer.depth[view, at_row, at_column]
    surface = hit_surface(scene, shot, view, at_row, at_column)
    ray = wp.normalize(cameras.to_world[view] * camera_ray(cameras, view, at_row, at_column, wp.vec2(0.0, 0.0)))
    cosine = wp.abs(wp.dot(surface.face_normal, ray))
    if cosine < sensor.grazing_cosine:
        return wp.uint16(0)
    if near_discontinuity(shot, sensor, focal_baseline, view, at_row, at_column):
        return wp.uint16(0)
    if sensor.shadows != 0:
        if in_shadow(layer, shot, focal_baseline, view, at_row, at_column):
            return wp.uint16(0)
    return read_out(layer, shot, view, row, column, depth, cosine, 0.0)


render_depth_sensor_kernel = kernel_of_layer(sensor_depth_at, "depth_sensor", wp.uint16)
