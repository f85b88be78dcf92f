"""Counts and boxes of every instance in every view, beyond the image border as well."""

import warp as wp

from synpick_warp.kernels.render.visibility.camera import Cameras, ImageGrid, Views, camera_ray
from synpick_warp.kernels.render.visibility.gbuffer import Meshes, ViewBodies, hits_body

wp.set_module_options({"enable_backward": False})

ALL = wp.constant(0)
VALID = wp.constant(1)
VISIBLE = wp.constant(2)
"""Rows of `pixels`; `boxes` has 0 for the whole silhouette and 1 for its visible part."""
UNSEEN = wp.constant(2147483647)
"""An edge that every pixel moves."""


@wp.kernel
def clear_annotation_kernel(
    # Out:
    pixels_out: wp.array3d[int],
    boxes_out: wp.array4d[int],
):
    """Counts to zero, boxes inside out."""
    view, instance = wp.tid()
    for i in range(3):
        pixels_out[view, instance, i] = 0
    for i in range(2):
        boxes_out[view, instance, i, 0] = UNSEEN
        boxes_out[view, instance, i, 1] = UNSEEN
        boxes_out[view, instance, i, 2] = -UNSEEN
        boxes_out[view, instance, i, 3] = -UNSEEN


@wp.func
def grown(box: wp.vec4i, row: int, column: int) -> wp.vec4i:
    """The smallest box that holds `box` and a pixel."""
    return wp.vec4i(wp.min(box[0], column), wp.min(box[1], row), wp.max(box[2], column), wp.max(box[3], row))


@wp.func
def merge_box(boxes: wp.array4d[int], view: int, instance: int, kind: int, box: wp.vec4i):
    """Grow a stored box. Integers, so that the order of threads does not matter."""
    wp.atomic_min(boxes, view, instance, kind, 0, box[0])
    wp.atomic_min(boxes, view, instance, kind, 1, box[1])
    wp.atomic_max(boxes, view, instance, kind, 2, box[2])
    wp.atomic_max(boxes, view, instance, kind, 3, box[3])


@wp.kernel
def count_inside_kernel(
    # Scene:
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    instance_image: wp.array3d[wp.uint8],
    depth_image: wp.array3d[wp.uint16],
    amodal_image: wp.array3d[wp.uint32],
    threads: int,
    # Out:
    pixels_out: wp.array3d[int],
    boxes_out: wp.array4d[int],
):
    """Count an instance's pixels inside the image: threads stride over its projected box and add up in registers first."""
    view, instance, thread = wp.tid()
    box = bodies.box[view, instance]
    left = wp.max(box[0], 0)
    top = wp.max(box[1], 0)
    right = wp.min(box[2], grid.width - 1)
    bottom = wp.min(box[3], grid.height - 1)
    columns = right - left + 1
    rows = bottom - top + 1
    if columns <= 0 or rows <= 0:
        return
    bit = wp.uint32(1) << wp.uint32(instance)
    segment = wp.uint8(instance + 1)
    all_pixels = int(0)
    valid = int(0)
    visible = int(0)
    whole_box = wp.vec4i(UNSEEN, UNSEEN, -UNSEEN, -UNSEEN)
    visible_box = wp.vec4i(UNSEEN, UNSEEN, -UNSEEN, -UNSEEN)
    for i in range(thread, rows * columns, threads):
        row = top + i // columns
        column = left + i % columns
        if (amodal_image[view, row, column] & bit) != wp.uint32(0):
            all_pixels += 1
            whole_box = grown(whole_box, row, column)
            if depth_image[view, row, column] != wp.uint16(0):
                valid += 1
            if instance_image[view, row, column] == segment:
                visible += 1
                visible_box = grown(visible_box, row, column)
    if all_pixels > 0:
        wp.atomic_add(pixels_out, view, instance, ALL, all_pixels)
        wp.atomic_add(pixels_out, view, instance, VALID, valid)
        merge_box(boxes_out, view, instance, 0, whole_box)
    if visible > 0:
        wp.atomic_add(pixels_out, view, instance, VISIBLE, visible)
        merge_box(boxes_out, view, instance, 1, visible_box)


@wp.kernel
def count_outside_kernel(
    # Scene:
    meshes: Meshes,
    cameras: Cameras,
    grid: ImageGrid,
    # In:
    bodies: ViewBodies,
    views: Views,
    threads: int,
    # Out:
    pixels_out: wp.array3d[int],
    boxes_out: wp.array4d[int],
):
    """Count an instance's pixels outside the image, up to one image size beyond each border, by casting rays where its box is."""
    view, instance, thread = wp.tid()
    box = bodies.box[view, instance]
    if box[2] < box[0] or (box[0] >= 0 and box[1] >= 0 and box[2] < grid.width and box[3] < grid.height):
        return
    intrinsics = cameras.intrinsics[views.camera[view]]
    columns = box[2] - box[0] + 1
    rows = box[3] - box[1] + 1
    count = int(0)
    found = wp.vec4i(UNSEEN, UNSEEN, -UNSEEN, -UNSEEN)
    for i in range(thread, rows * columns, threads):
        row = box[1] + i // columns
        column = box[0] + i % columns
        if row < 0 or column < 0 or row >= grid.height or column >= grid.width:
            if hits_body(meshes, bodies, view, instance, camera_ray(intrinsics, row, column, wp.vec2(0.0, 0.0))):
                count += 1
                found = grown(found, row, column)
    if count > 0:
        wp.atomic_add(pixels_out, view, instance, ALL, count)
        merge_box(boxes_out, view, instance, 0, found)


@wp.kernel
def close_boxes_kernel(
    # Out:
    boxes_inout: wp.array4d[int],
):
    """Empty boxes to (0, 0, -1, -1)."""
    view, instance, kind = wp.tid()
    if boxes_inout[view, instance, kind, 2] < boxes_inout[view, instance, kind, 0]:
        boxes_inout[view, instance, kind, 0] = 0
        boxes_inout[view, instance, kind, 1] = 0
        boxes_inout[view, instance, kind, 2] = -1
        boxes_inout[view, instance, kind, 3] = -1
