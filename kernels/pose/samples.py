"""Model samples in a view: projection, visibility by label and depth, and the crop's colour there."""

import warp as wp

from synpick_warp.kernels.pose.observation import CROP, Images, Observation, Targets, read_depth
from synpick_warp.kernels.pose.residuals import LossParameters, Models

wp.set_module_options({"enable_backward": False})

MIN_FACING = wp.constant(0.1)
"""Smallest cosine between a sample's normal and the direction to the camera; more oblique samples say little."""
HIDDEN = wp.constant(0)
VISIBLE = wp.constant(1)
PROTRUDING = wp.constant(2)
"""States of a model sample: occluded, unknown or averted; in the instance's mask; in free space, where the mask should reach
(free-space violation)."""


@wp.struct
class SampleView:
    """Model sample in a view: state, position, normal and area, and depth in front of what is seen there."""

    state: int
    """HIDDEN, VISIBLE or PROTRUDING."""
    position: wp.vec3
    """In the camera frame [m]."""
    normal: wp.vec3
    """Unit normal in the camera frame."""
    crop: wp.vec2
    """Crop coordinates (column, row) relative to the centre of the first crop pixel [crop px]."""
    area: float
    """Area across the viewing direction [m²]."""
    excess: float
    """Depth by which the sample lies in front of what is seen there [m]."""


@wp.func
def view_sample(
    models: Models,
    images: Images,
    targets: Targets,
    observation: Observation,
    loss: LossParameters,
    instance: int,
    pose: wp.transform,
    sample: int,
) -> SampleView:
    """Visibility test of a model sample at a pose, against the label and depth of the pixel that it projects to.

    VISIBLE: the pixel has the instance's label, and the sample lies at most `margin` behind its depth. PROTRUDING, a free-space violation:
    the pixel shows something else that lies farther away by more than `margin`. Otherwise, and where the sample faces away: HIDDEN.
    """
    result = SampleView()
    result.state = HIDDEN
    model = targets.model[instance]
    view = targets.view[instance]
    result.position = wp.transform_point(pose, models.position[model, sample])
    result.normal = wp.transform_vector(pose, models.normal[model, sample])
    if result.position[2] <= 0.0:
        return result
    facing = -wp.dot(result.normal, wp.normalize(result.position))
    if facing < MIN_FACING:
        return result
    intrinsics = images.intrinsics[view]
    x = intrinsics[0] * result.position[0] / result.position[2] + intrinsics[2]
    y = intrinsics[1] * result.position[1] / result.position[2] + intrinsics[3]
    # Comparing before converting: an int cannot hold every float.
    if x < 0.0 or y < 0.0 or x >= float(images.width) or y >= float(images.height):
        return result
    row = int(y)
    column = int(x)
    result.area = models.sample_area[model] * facing
    corner = observation.corner[instance]
    pitch = observation.pitch[instance]
    result.crop = wp.vec2((x - corner[0]) / pitch - 0.5, (y - corner[1]) / pitch - 0.5)
    depth = read_depth(images, view, row, column)
    result.excess = depth - result.position[2]
    if int(images.label[view, row, column]) == targets.label[instance]:
        if depth == 0.0 or result.excess > -loss.margin:
            result.state = VISIBLE
    elif depth > 0.0 and result.excess > loss.margin:
        result.state = PROTRUDING
    return result


@wp.func
def has_color(observation: Observation, instance: int, crop: wp.vec2) -> bool:
    """True if the four crop pixels around a position lie in the mask, so that colours can be interpolated there."""
    column = int(wp.floor(crop[0]))
    row = int(wp.floor(crop[1]))
    if row < 0 or column < 0 or row + 1 >= CROP or column + 1 >= CROP:
        return False
    zero = wp.uint8(0)
    upper = observation.inside[instance, row, column] != zero and observation.inside[instance, row, column + 1] != zero
    lower = observation.inside[instance, row + 1, column] != zero and observation.inside[instance, row + 1, column + 1] != zero
    return upper and lower


@wp.func
def interpolate_color(observation: Observation, instance: int, crop: wp.vec2) -> tuple[wp.vec3, wp.vec3, wp.vec3]:
    """Bilinear colour at a position of the crop, and its derivatives along columns and rows [1/crop px]."""
    column = int(wp.floor(crop[0]))
    row = int(wp.floor(crop[1]))
    u = crop[0] - float(column)
    v = crop[1] - float(row)
    a = observation.color[instance, row, column]
    b = observation.color[instance, row, column + 1]
    c = observation.color[instance, row + 1, column]
    d = observation.color[instance, row + 1, column + 1]
    across = (1.0 - v) * (b - a) + v * (d - c)
    down = (1.0 - u) * (c - a) + u * (d - b)
    return a + u * (b - a) + v * (c - a) + u * v * (a - b - c + d), across, down
