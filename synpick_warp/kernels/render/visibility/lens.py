"""Lens distortion in float32: the models of `configs.calibration.lens`, continued linearly beyond their domain, and rays beyond the image.

Rays of pixels inside the image come from a table that the host computed in float64; what is computed here bounds where surfaces may be
seen, and traces amodal masks beyond the image.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

FISHEYE_MODEL = wp.constant(1.0)
"""Value of MODEL for the fisheye model; 0: the pinhole model."""
MODEL = wp.constant(0)
FIRST = wp.constant(1)
"""Column of the first of twelve coefficients, in OpenCV's order."""
RADIUS = wp.constant(13)
"""Radius of the domain in the normalised plane."""
BEND = wp.constant(14)
"""Upper bound of the second derivative [px]."""
STRETCH = wp.constant(15)
"""Upper bound of the distance of two rays in the normalised plane, by the distance of their pixels [1/px]."""
NUMBERS = wp.constant(16)
"""Columns of `Lenses.number`."""
CLOSE = wp.constant(1.0e-6)
"""Squared radius below which the fisheye model is evaluated by its series."""
STEPS = wp.constant(12)
"""Newton steps for a ray beyond the image."""
DAMPED = wp.constant(0.5)
"""Longest step, in radii of the domain."""


@wp.struct
class Lenses:
    """Distorted cameras: rays of their pixels, and their models. Null arrays: no camera is distorted. Constant."""

    ray: wp.array3d[wp.vec2]
    """(lens, row, column): x and y of the ray (x, y, 1) of a pixel's centre."""
    number: wp.array2d[float]
    """(lens, number): model, coefficients, domain and bounds, in the columns above."""


@wp.func
def radial(lenses: Lenses, lens: int, square: float) -> wp.vec2:
    """Radial scale of points with this squared radius, and its derivative by the squared radius."""
    k1 = lenses.number[lens, FIRST]
    k2 = lenses.number[lens, FIRST + 1]
    k3 = lenses.number[lens, FIRST + 2]
    k4 = lenses.number[lens, FIRST + 3]
    if lenses.number[lens, MODEL] == FISHEYE_MODEL:
        if square < CLOSE:
            return wp.vec2(1.0 + (k1 - 1.0 / 3.0) * square, k1 - 1.0 / 3.0)
        radius = wp.sqrt(square)
        angle = wp.atan(radius)
        even = angle * angle
        scale = angle * (1.0 + even * (k1 + even * (k2 + even * (k3 + even * k4)))) / radius
        growth = (1.0 + even * (3.0 * k1 + even * (5.0 * k2 + even * (7.0 * k3 + even * 9.0 * k4)))) / (1.0 + square)
        return wp.vec2(scale, (growth - scale) / (2.0 * square))
    # OpenCV's order: k1 k2 p1 p2 k3 k4 k5 k6.
    k3 = lenses.number[lens, FIRST + 4]
    k4 = lenses.number[lens, FIRST + 5]
    k5 = lenses.number[lens, FIRST + 6]
    k6 = lenses.number[lens, FIRST + 7]
    above = 1.0 + square * (k1 + square * (k2 + square * k3))
    below = 1.0 + square * (k4 + square * (k5 + square * k6))
    above_slope = k1 + square * (2.0 * k2 + 3.0 * square * k3)
    below_slope = k4 + square * (2.0 * k5 + 3.0 * square * k6)
    return wp.vec2(above / below, (above_slope * below - above * below_slope) / (below * below))


@wp.func
def linearize(lenses: Lenses, lens: int, point: wp.vec2) -> tuple[wp.vec2, wp.mat22]:
    """Distorted point and Jacobian matrix at a point of the normalised plane within the domain."""
    x = point[0]
    y = point[1]
    square = x * x + y * y
    scale = radial(lenses, lens, square)
    p1 = float(0.0)
    p2 = float(0.0)
    s = wp.vec4(0.0, 0.0, 0.0, 0.0)
    if lenses.number[lens, MODEL] != FISHEYE_MODEL:
        p1 = lenses.number[lens, FIRST + 2]
        p2 = lenses.number[lens, FIRST + 3]
        for i in range(4):
            s[i] = lenses.number[lens, FIRST + 8 + i]
    image = wp.vec2(
        x * scale[0] + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x) + square * (s[0] + s[1] * square),
        y * scale[0] + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y + square * (s[2] + s[3] * square),
    )
    prism_x = 2.0 * (s[0] + 2.0 * s[1] * square)
    prism_y = 2.0 * (s[2] + 2.0 * s[3] * square)
    shared = 2.0 * (scale[1] * x * y + p1 * x + p2 * y)
    jacobian = wp.mat22(
        scale[0] + 2.0 * scale[1] * x * x + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x,
        shared + prism_x * y,
        shared + prism_y * x,
        scale[0] + 2.0 * scale[1] * y * y + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y,
    )
    return image, jacobian


@wp.func
def distort(lenses: Lenses, lens: int, point: wp.vec2) -> tuple[wp.vec2, wp.mat22]:
    """Distorted point, continued linearly beyond the domain along each direction from the axis, and Jacobian matrix at its foot there."""
    domain = lenses.number[lens, RADIUS]
    distance = wp.length(point)
    at = point
    if distance > domain:
        at = point * (domain / distance)
    image, jacobian = linearize(lenses, lens, at)
    return image + jacobian * (point - at), jacobian


@wp.func
def undistort(lenses: Lenses, lens: int, goal: wp.vec2, guess: wp.vec2) -> wp.vec2:
    """Point of the normalised plane whose distorted point is `goal`, by Newton's method from a guess, for places beyond the image."""
    point = wp.vec2(guess[0], guess[1])
    most = DAMPED * lenses.number[lens, RADIUS]
    steps = int(0)
    # Not a loop over a range, which would be unrolled.
    while steps < STEPS:
        image, jacobian = distort(lenses, lens, point)
        step = wp.inverse(jacobian) * (image - goal)
        point -= step * wp.min(1.0, most / wp.max(wp.length(step), 1.0e-20))
        steps += 1
    return point


@wp.func
def table_ray(lenses: Lenses, lens: int, row: int, column: int, offset: wp.vec2) -> wp.vec3:
    """Ray (x, y, 1) of a pixel, or the nearest in the image, `offset` [px] from its centre by the differences of the table."""
    height = lenses.ray.shape[1]
    width = lenses.ray.shape[2]
    at_row = wp.clamp(row, 0, height - 1)
    at_column = wp.clamp(column, 0, width - 1)
    ray = lenses.ray[lens, at_row, at_column]
    if offset[0] != 0.0 or offset[1] != 0.0:
        left = wp.max(at_column - 1, 0)
        right = wp.min(at_column + 1, width - 1)
        top = wp.max(at_row - 1, 0)
        bottom = wp.min(at_row + 1, height - 1)
        across = (lenses.ray[lens, at_row, right] - lenses.ray[lens, at_row, left]) / float(wp.max(right - left, 1))
        down = (lenses.ray[lens, bottom, at_column] - lenses.ray[lens, top, at_column]) / float(wp.max(bottom - top, 1))
        ray += offset[0] * across + offset[1] * down
    return wp.vec3(ray[0], ray[1], 1.0)
