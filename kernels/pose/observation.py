"""Observations of instances: bounding boxes, square crops and sampled surface points of the visible masks in a batch of RGB-D views."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import pinhole_ray

wp.set_module_options({"enable_backward": False})

CROP = wp.constant(64)
"""Rows and columns of a crop."""
CROP_MARGIN = wp.constant(0.06)
"""Margin around the visible mask's box on each side, relative to the box."""
MAX_TAPS = wp.constant(8)
"""Maximum samples of a crop pixel's box filter along one axis; wider footprints are subsampled."""
NO_INSTANCE = wp.constant(-1)


@wp.struct
class Images:
    """Input images of a batch of RGB-D views: sRGB colour, depth in counts with the metres per count, instance labels, intrinsics (fx, fy,
    cx, cy), image size, and the lookup table from sRGB bytes to linear light.
    """

    color: wp.array3d[wp.vec3ub]
    """(view, row, column): sRGB, red first."""
    depth: wp.array3d[wp.uint16]
    """(view, row, column): planar depth in counts; 0: none."""
    label: wp.array3d[wp.uint8]
    """(view, row, column): 0: background; otherwise the label of the instance whose visible mask the pixel belongs to."""
    depth_scale: wp.array[float]
    """(view): depth of a count [m]."""
    intrinsics: wp.array[wp.vec4]
    """(view): fx, fy, cx, cy [px]."""
    linear: wp.array[float]
    """(256): linear value of each sRGB value."""
    width: int
    height: int
    """[px]"""


@wp.struct
class Targets:
    """Instances whose pose is estimated: view, mask label and model of each, and `row`, the instance by view and label (-1: none)."""

    view: wp.array[int]
    """(instance): view that shows the instance."""
    label: wp.array[int]
    """(instance): label of the instance in that view."""
    model: wp.array[int]
    """(instance): row of `Models`."""
    row: wp.array2d[int]
    """(view, label): instance with the label in the view; -1: none."""


@wp.struct
class Observation:
    """Observation of each instance: box and pixel count of the visible mask; square crop with mask, linear colour and feature transform;
    surface points with normals, grey values, mean, and the area [m²] that one point stands for. `row_*` are scratch.
    """

    box: wp.array2d[int]
    """(instance, side): bounding box of the visible mask: x_min, y_min, x_max, y_max [px], inclusive; x_max < x_min: not visible."""
    pixels: wp.array[int]
    """(instance): size of the visible mask [px]."""
    corner: wp.array[wp.vec2]
    """(instance): image coordinates of the crop's upper left corner [px]."""
    pitch: wp.array[float]
    """(instance): width of a crop pixel [px]."""
    inside: wp.array3d[wp.uint8]
    """(instance, row, column): 1: the image pixel at the crop pixel's centre belongs to the mask."""
    color: wp.array3d[wp.vec3]
    """(instance, row, column): mean linear RGB of the mask's pixels in the crop pixel's footprint; 0: there are none."""
    nearest: wp.array3d[wp.vec2]
    """(instance, row, column): offset (columns, rows) [crop px] to the nearest crop pixel of the mask: a feature transform."""
    row_nearest: wp.array3d[int]
    """(instance, row, column): column of the row's nearest pixel of the mask; scratch of the feature transform."""
    row_points: wp.array2d[int]
    """(instance, row): mask pixels with depth in a row of the crop; scratch of the point sampling."""
    point: wp.array2d[wp.vec3]
    """(instance, point): surface points in the camera frame [m], evenly spread over the visible mask."""
    normal: wp.array2d[wp.vec3]
    """(instance, point): unit surface normals towards the camera, of fitted planes; zero: unknown."""
    points: wp.array[int]
    """(instance): number of points."""
    area: wp.array[float]
    """(instance): area that a point stands for, across the viewing direction [m²]."""
    centroid: wp.array[wp.vec3]
    """(instance): mean of the points [m]."""
    gray: wp.array2d[float]
    """(instance, point): mean of the channels of the crop's colour at each point."""
    intensity: wp.array[float]
    """(instance): mean of `gray`."""


@wp.func
def back_project(intrinsics: wp.vec4, row: int, column: int, depth: float) -> wp.vec3:
    """Point of the camera frame [m] at a pixel's centre and planar depth."""
    return depth * pinhole_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))


@wp.func
def read_depth(images: Images, view: int, row: int, column: int) -> float:
    """Planar depth of a pixel [m]; 0: none."""
    return float(images.depth[view, row, column]) * images.depth_scale[view]


@wp.func
def crop_pixel(observation: Observation, images: Images, instance: int, row: int, column: int) -> tuple[int, int]:
    """(row, column) of the image pixel at the centre of a crop pixel, clamped to the image."""
    corner = observation.corner[instance]
    pitch = observation.pitch[instance]
    x = int(wp.floor(corner[0] + (float(column) + 0.5) * pitch))
    y = int(wp.floor(corner[1] + (float(row) + 0.5) * pitch))
    return wp.clamp(y, 0, images.height - 1), wp.clamp(x, 0, images.width - 1)


@wp.kernel
def clear_boxes_kernel(
    # Scene:
    images: Images,
    # Out:
    box_out: wp.array2d[int],  # (instance, side) [px]
    pixels_out: wp.array[int],  # (instance) [px]
):
    """Set boxes to inverted ones and pixel counts to 0, for the atomics of `find_boxes_kernel`. Launched over instance."""
    instance = wp.tid()
    box_out[instance, 0] = images.width
    box_out[instance, 1] = images.height
    box_out[instance, 2] = -1
    box_out[instance, 3] = -1
    pixels_out[instance] = 0


@wp.kernel
def find_boxes_kernel(
    # In:
    images: Images,
    targets: Targets,
    # Out:
    box_out: wp.array2d[int],  # (instance, side) [px]
    pixels_out: wp.array[int],  # (instance) [px]
):
    """Bounding boxes and pixel counts of visible masks, by integer atomics for each run of equal labels in a row.

    Launched over view, row.
    """
    view, row = wp.tid()
    start = int(0)
    label = int(images.label[view, row, 0])
    for column in range(1, images.width + 1):
        other = int(-1)
        if column < images.width:
            other = int(images.label[view, row, column])
        if other != label:
            instance = targets.row[view, label]
            if label > 0 and instance != NO_INSTANCE:
                wp.atomic_min(box_out, instance, 0, start)
                wp.atomic_min(box_out, instance, 1, row)
                wp.atomic_max(box_out, instance, 2, column - 1)
                wp.atomic_max(box_out, instance, 3, row)
                wp.atomic_add(pixels_out, instance, column - start)
            start = column
            label = other


@wp.kernel
def place_crops_kernel(
    # In:
    box: wp.array2d[int],  # (instance, side) [px]
    # Out:
    corner_out: wp.array[wp.vec2],  # (instance) [px]
    pitch_out: wp.array[float],  # (instance) [px]
):
    """Place the square crop of each instance: corner and pixel width (pitch) of the box around its mask, with a margin.

    A crop pixel is at least an image pixel wide, and coincides with one where it is as wide. Launched over instance.
    """
    instance = wp.tid()
    width = float(box[instance, 2] - box[instance, 0] + 1)
    height = float(box[instance, 3] - box[instance, 1] + 1)
    extent = (1.0 + 2.0 * CROP_MARGIN) * wp.max(width, height)
    pitch = wp.max(extent / float(CROP), 1.0)
    half = 0.5 * pitch * float(CROP)
    center = wp.vec2(float(box[instance, 0]) + 0.5 * width, float(box[instance, 1]) + 0.5 * height)
    corner = center - wp.vec2(half, half)
    if pitch == 1.0:
        corner = wp.vec2(wp.floor(corner[0]), wp.floor(corner[1]))
    corner_out[instance] = corner
    pitch_out[instance] = pitch


@wp.kernel
def sample_crops_kernel(
    # In:
    images: Images,
    targets: Targets,
    # Out:
    observation_out: Observation,
):
    """Resample the crops: whether the centre of a crop pixel lies in the mask, and the mean colour of the mask in its footprint.

    Colours are in linear light. Writes `inside` and `color`. Launched over instance, crop row, crop column.
    """
    instance, row, column = wp.tid()
    if observation_out.pixels[instance] == 0:
        return
    view = targets.view[instance]
    y, x = crop_pixel(observation_out, images, instance, row, column)
    corner = observation_out.corner[instance]
    pitch = observation_out.pitch[instance]
    inside = wp.uint8(0)
    in_image = corner[0] + (float(column) + 0.5) * pitch < float(images.width) and corner[1] + (float(row) + 0.5) * pitch < float(
        images.height
    )
    if in_image and corner[0] + (float(column) + 0.5) * pitch >= 0.0 and corner[1] + (float(row) + 0.5) * pitch >= 0.0:
        if int(images.label[view, y, x]) == targets.label[instance]:
            inside = wp.uint8(1)
    observation_out.inside[instance, row, column] = inside
    taps = wp.clamp(int(wp.round(pitch)), 1, MAX_TAPS)
    total = wp.vec3(0.0, 0.0, 0.0)
    count = float(0.0)
    for i in range(taps):
        for j in range(taps):
            u = corner[0] + (float(column) + (float(j) + 0.5) / float(taps)) * pitch
            v = corner[1] + (float(row) + (float(i) + 0.5) / float(taps)) * pitch
            y = wp.clamp(int(wp.floor(v)), 0, images.height - 1)
            x = wp.clamp(int(wp.floor(u)), 0, images.width - 1)
            if int(images.label[view, y, x]) == targets.label[instance]:
                texel = images.color[view, y, x]
                total += wp.vec3(images.linear[int(texel[0])], images.linear[int(texel[1])], images.linear[int(texel[2])])
                count += 1.0
    observation_out.color[instance, row, column] = total / wp.max(count, 1.0)


@wp.kernel
def find_row_nearest_kernel(
    # In:
    pixels: wp.array[int],  # (instance) [px]
    inside: wp.array3d[wp.uint8],  # (instance, row, column)
    # Out:
    row_nearest_out: wp.array3d[int],  # (instance, row, column)
):
    """First pass of the feature transform: the nearest mask pixel within each row, by a sweep each way; -1: the row has none.

    Launched over instance, crop row.
    """
    instance, row = wp.tid()
    if pixels[instance] == 0:
        return
    last = int(-1)
    for column in range(CROP):
        if inside[instance, row, column] != wp.uint8(0):
            last = column
        row_nearest_out[instance, row, column] = last
    last = int(-1)
    for k in range(CROP):
        column = CROP - 1 - k
        if inside[instance, row, column] != wp.uint8(0):
            last = column
        before = row_nearest_out[instance, row, column]
        if last >= 0 and (before < 0 or last - column < column - before):
            row_nearest_out[instance, row, column] = last


@wp.kernel
def find_nearest_kernel(
    # In:
    pixels: wp.array[int],  # (instance) [px]
    row_nearest: wp.array3d[int],  # (instance, row, column)
    # Out:
    nearest_out: wp.array3d[wp.vec2],  # (instance, row, column) [crop px]
):
    """Second pass of the feature transform (Saito and Toriwaki, 1994): writes to `nearest_out` the offset (columns, rows) [crop px] from
    each crop pixel to the nearest one of the mask. Launched over instance, crop row, crop column.
    """
    instance, row, column = wp.tid()
    if pixels[instance] == 0:
        return
    best = int(1 << 30)
    offset = wp.vec2(0.0, 0.0)
    for other in range(CROP):
        found = row_nearest[instance, other, column]
        if found >= 0:
            squared = (other - row) * (other - row) + (found - column) * (found - column)
            if squared < best:
                best = squared
                offset = wp.vec2(float(found - column), float(other - row))
    nearest_out[instance, row, column] = offset
