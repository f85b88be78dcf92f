"""Surface points of an observation: evenly spread over the visible mask, with normals of fitted planes."""

import warp as wp

from synpick_warp.kernels.pose.observation import CROP, Images, Observation, Targets, back_project, crop_pixel, read_depth

wp.set_module_options({"enable_backward": False})

NORMAL_REACH = wp.constant(2)
"""Half width of the window to which a surface point's plane is fitted [crop px]."""
MIN_NEIGHBOURS = wp.constant(6.0)
"""Smallest number of points of a plane fit."""
MIN_SPREAD = wp.constant(1.0e-3)
"""Smallest determinant of the points' covariance relative to that of uncorrelated axes, 1 - ρ²; below, they lie on a line."""
MAX_SLOPE = wp.constant(6.0)
"""Largest change of distance along the ray per distance across it with which two pixels count as one surface: 80° of tilt."""


@wp.func
def has_point(observation: Observation, images: Images, instance: int, view: int, row: int, column: int) -> bool:
    """True if a crop pixel shows the instance and has depth."""
    if observation.inside[instance, row, column] == wp.uint8(0):
        return False
    y, x = crop_pixel(observation, images, instance, row, column)
    return images.depth[view, y, x] != wp.uint16(0)


@wp.func
def crop_point(observation: Observation, images: Images, instance: int, view: int, row: int, column: int) -> wp.vec3:
    """Surface point [m] at a crop pixel; depth 0: the pixel lies outside the crop or the mask, or has no depth."""
    if row < 0 or row >= CROP or column < 0 or column >= CROP:
        return wp.vec3(0.0, 0.0, 0.0)
    if observation.inside[instance, row, column] == wp.uint8(0):
        return wp.vec3(0.0, 0.0, 0.0)
    y, x = crop_pixel(observation, images, instance, row, column)
    return back_project(images.intrinsics[view], y, x, read_depth(images, view, y, x))


@wp.func
def on_surface(a: wp.vec3, b: wp.vec3) -> bool:
    """True if two neighbouring points are so close along the ray through `a` that they may lie on one smooth surface."""
    ray = wp.normalize(a)
    along = wp.dot(b - a, ray)
    return wp.abs(along) <= MAX_SLOPE * wp.length(b - a - along * ray)


@wp.func
def surface_normal(observation: Observation, images: Images, instance: int, view: int, row: int, column: int, here: wp.vec3) -> wp.vec3:
    """Unit normal towards the camera at a crop pixel with the point `here`: of the plane z = z₀ + a x + b y fitted to its neighbourhood.

    Least squares, which depth noise calls for; zero: the neighbours do not determine a plane.
    """
    count = float(0.0)
    mean = wp.vec3(0.0, 0.0, 0.0)
    xx = float(0.0)
    xy = float(0.0)
    yy = float(0.0)
    xz = float(0.0)
    yz = float(0.0)
    for i in range(-NORMAL_REACH, NORMAL_REACH + 1):
        for j in range(-NORMAL_REACH, NORMAL_REACH + 1):
            other = crop_point(observation, images, instance, view, row + i, column + j)
            if other[2] > 0.0 and on_surface(here, other):
                offset = other - here
                count += 1.0
                mean += offset
                xx += offset[0] * offset[0]
                xy += offset[0] * offset[1]
                yy += offset[1] * offset[1]
                xz += offset[0] * offset[2]
                yz += offset[1] * offset[2]
    if count < MIN_NEIGHBOURS:
        return wp.vec3(0.0, 0.0, 0.0)
    xx -= mean[0] * mean[0] / count
    xy -= mean[0] * mean[1] / count
    yy -= mean[1] * mean[1] / count
    xz -= mean[0] * mean[2] / count
    yz -= mean[1] * mean[2] / count
    determinant = xx * yy - xy * xy
    if determinant <= MIN_SPREAD * xx * yy:
        return wp.vec3(0.0, 0.0, 0.0)
    normal = wp.normalize(wp.vec3((xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant, -1.0))
    if wp.dot(normal, here) > 0.0:
        normal = -normal
    return normal


@wp.kernel
def count_points_kernel(
    # In:
    images: Images,
    targets: Targets,
    # Out:
    observation_out: Observation,
):
    """Count the mask pixels with depth in each row of the crops: writes `row_points`. Launched over instance, crop row."""
    instance, row = wp.tid()
    if observation_out.pixels[instance] == 0:
        observation_out.row_points[instance, row] = 0
        return
    view = targets.view[instance]
    count = int(0)
    for column in range(CROP):
        if has_point(observation_out, images, instance, view, row, column):
            count += 1
    observation_out.row_points[instance, row] = count


@wp.kernel
def sample_points_kernel(
    # In:
    images: Images,
    targets: Targets,
    # Out:
    observation_out: Observation,
):
    """Subsample the surface points evenly: of n mask pixels in scanline order, the first with each value of rank · min(n, capacity) // n.

    Writes `points` (their number), `point`, `normal` and `gray` at these pixels. Launched over instance, crop row.
    """
    instance, row = wp.tid()
    rank = int(0)
    total = int(0)
    for other in range(CROP):
        if other < row:
            rank += observation_out.row_points[instance, other]
        total += observation_out.row_points[instance, other]
    count = wp.min(total, observation_out.point.shape[1])
    if row == 0:
        observation_out.points[instance] = count
    if observation_out.row_points[instance, row] == 0:
        return
    view = targets.view[instance]
    for column in range(CROP):
        if has_point(observation_out, images, instance, view, row, column):
            index = rank * count // total
            if rank == 0 or (rank - 1) * count // total != index:
                here = crop_point(observation_out, images, instance, view, row, column)
                observation_out.point[instance, index] = here
                color = observation_out.color[instance, row, column]
                observation_out.gray[instance, index] = (color[0] + color[1] + color[2]) / 3.0
                observation_out.normal[instance, index] = surface_normal(observation_out, images, instance, view, row, column, here)
            rank += 1


@wp.kernel
def summarize_points_kernel(
    # In:
    images: Images,
    targets: Targets,
    # Out:
    observation_out: Observation,
):
    """Centroid and mean intensity of the points of each instance, and the area that one point stands for, that of the mask over the number.

    Writes `centroid`, `intensity` and `area`. Launched over instance.
    """
    instance = wp.tid()
    count = observation_out.points[instance]
    total = wp.vec3(0.0, 0.0, 0.0)
    gray = float(0.0)
    for index in range(count):
        total += observation_out.point[instance, index]
        gray += observation_out.gray[instance, index]
    observation_out.intensity[instance] = gray / float(wp.max(count, 1))
    centroid = total / float(wp.max(count, 1))
    intrinsics = images.intrinsics[targets.view[instance]]
    visible = float(observation_out.pixels[instance]) * centroid[2] * centroid[2] / (intrinsics[0] * intrinsics[1])
    observation_out.centroid[instance] = centroid
    observation_out.area[instance] = visible / float(wp.max(count, 1))
