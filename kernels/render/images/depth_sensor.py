"""What a depth camera would measure: disparities to a projector beside the camera, with their noise, steps and holes."""

import warp as wp

from synpick_warp.codes import Segment, Stream
from synpick_warp.kernels.render.images.layers import hit_surface
from synpick_warp.kernels.render.lighting.materials import Surfaces
from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray, in_image, tile_pixel
from synpick_warp.kernels.render.visibility.gbuffer import MAX_COUNTS, GBuffer, Meshes, ViewBodies
from synpick_warp.kernels.rng import normal_pair, pixel_key, view_key

wp.set_module_options({"enable_backward": False})

HALF_PIXEL = wp.constant(0.5)
"""Two rays of the projector nearer to each other than this [px] are one."""


@wp.struct
class SensorRules:
    """See configs.sensors.DepthSensor. Angles in radians."""

    seed: wp.uint64
    baseline: float
    disparity_step: float
    near: float
    far: float
    noise: float
    noise_growth: float
    noise_distance: float
    noise_angle: float
    lateral_noise: float
    grazing_cosine: float
    """Cosine of the largest angle of incidence."""
    edge_width: int
    edge_step: float
    shadows: int
    counts_per_meter: float


@wp.func
def disparity_at(gbuffer: GBuffer, gain: float, view: int, row: int, column: int) -> float:
    """Disparity of what a pixel sees [px], 0 where it sees nothing; `gain` is focal length times baseline [px m]."""
    if int(gbuffer.segment[view, row, column]) == Segment.NOTHING:
        return 0.0
    return gain / gbuffer.depth[view, row, column]


@wp.func
def near_an_edge(gbuffer: GBuffer, grid: ImageGrid, sensor: SensorRules, gain: float, view: int, row: int, column: int) -> bool:
    """Whether a pixel of the window about this one has another disparity: no match is found, or one of another surface."""
    here = disparity_at(gbuffer, gain, view, row, column)
    for down in range(-sensor.edge_width, sensor.edge_width + 1):
        for right in range(-sensor.edge_width, sensor.edge_width + 1):
            at_row = wp.clamp(row + down, 0, grid.height - 1)
            at_column = wp.clamp(column + right, 0, grid.width - 1)
            if wp.abs(disparity_at(gbuffer, gain, view, at_row, at_column) - here) > sensor.edge_step:
                return True
    return False


@wp.func
def nearest_body(bodies: ViewBodies, view: int) -> float:
    """Least planar depth that a body of the view may have [m]."""
    nearest = float(1.0e9)
    for body in range(bodies.mesh.shape[1]):
        if bodies.mesh[view, body] >= 0:
            nearest = wp.min(nearest, bodies.near[view, body])
    return nearest


@wp.func
def in_shadow(gbuffer: GBuffer, bodies: ViewBodies, grid: ImageGrid, gain: float, view: int, row: int, column: int) -> bool:
    """Whether something hides the projector, which stands to the camera's right.

    The projector's column of a pixel is its own less its disparity. A pixel k columns to the right whose disparity is larger by k
    lies on the same ray of the projector and is nearer to it.
    """
    here = disparity_at(gbuffer, gain, view, row, column)
    most = gain / wp.max(nearest_body(bodies, view), 1.0e-3) - here
    reach = wp.min(int(wp.ceil(most)), grid.width - 1 - column)
    for right in range(1, reach + 1):
        more = disparity_at(gbuffer, gain, view, row, column + right) - here
        if wp.abs(more - float(right)) <= HALF_PIXEL:
            return True
    return False


@wp.func
def depth_deviation(sensor: SensorRules, depth: float, cosine: float) -> float:
    """Standard deviation of a measured depth [m], for the cosine of the angle of incidence; the law of configs.sensors.DepthSensor."""
    off = depth - sensor.noise_distance
    angle = wp.acos(wp.clamp(cosine, 0.0, 1.0))
    ratio = angle / (wp.HALF_PI - angle)
    return sensor.noise + sensor.noise_growth * off * off + sensor.noise_angle / wp.sqrt(depth) * ratio * ratio


@wp.func
def measured_depth(sensor: SensorRules, gain: float, depth: float) -> float:
    """The depth whose disparity is a whole number of steps [m]; 0: out of the sensor's reach."""
    if depth < sensor.near or depth > sensor.far:
        return 0.0
    steps = wp.rint(gain / (depth * sensor.disparity_step))
    if steps < 1.0:
        return 0.0
    return gain / (steps * sensor.disparity_step)


@wp.kernel
def draw_depth_sensor_kernel(
    # Scene:
    meshes: Meshes,
    surfaces: Surfaces,
    cameras: Cameras,
    grid: ImageGrid,
    # State:
    episode: wp.array[int],
    frame: wp.array[int],
    # In:
    sensor: SensorRules,
    bodies: ViewBodies,
    gbuffer: GBuffer,
    views: Views,
    first: int,
    # Out:
    depth_sensor_out: wp.array3d[wp.uint16],
):
    """Depth in counts as a sensor measures it, 0: hole. d = f b / (z + σ n), rounded to steps; n is standard normal.

    z is that of a pixel that lies off by lateral noise. Holes: no surface, grazing rays, edges, what the projector does not reach.
    Numbers are those of the stream (seed, episode, frame, camera, DEPTH_NOISE) and the pixel, so each picture has noise of its own.
    """
    view, row, column = tile_pixel(grid, wp.tid() + first)
    if not in_image(grid, row, column):
        return
    depth_sensor_out[view, row, column] = wp.uint16(0)
    camera = views.camera[view]
    world = views.world[view]
    key = pixel_key(view_key(sensor.seed, episode[world], frame[world], camera, Stream.DEPTH_NOISE), row * grid.width + column)
    shift = sensor.lateral_noise * normal_pair(key, 0)
    at_row = wp.clamp(row + int(wp.rint(shift[0])), 0, grid.height - 1)
    at_column = wp.clamp(column + int(wp.rint(shift[1])), 0, grid.width - 1)
    if int(gbuffer.segment[view, at_row, at_column]) == Segment.NOTHING:
        return
    intrinsics = cameras.intrinsics[camera]
    gain = intrinsics[0] * sensor.baseline
    depth = gbuffer.depth[view, at_row, at_column]
    surface = hit_surface(meshes, surfaces, cameras, bodies, gbuffer, view, at_row, at_column, camera, views.instances)
    ray = wp.normalize(cameras.to_world[camera] * camera_ray(intrinsics, at_row, at_column, wp.vec2(0.0, 0.0)))
    cosine = wp.abs(wp.dot(surface.face_normal, ray))
    if cosine < sensor.grazing_cosine:
        return
    if near_an_edge(gbuffer, grid, sensor, gain, view, at_row, at_column):
        return
    if sensor.shadows != 0:
        if in_shadow(gbuffer, bodies, grid, gain, view, at_row, at_column):
            return
    noisy = depth + depth_deviation(sensor, depth, cosine) * normal_pair(key, 2)[0]
    counts = wp.rint(sensor.counts_per_meter * measured_depth(sensor, gain, noisy))
    if counts <= MAX_COUNTS:
        depth_sensor_out[view, row, column] = wp.uint16(counts)
