"""Device arrays of perception and grasp planning: scratch of one batch of images, and the results kept for every world.

Pixels are (column, row) indices of the perception image; pixel centres have integer coordinates here, as in OpenCV's contours.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.stages.arrays import device_array


@dataclass(frozen=True, eq=False)
class PerceptionArrays:
    """Segmentation of a batch of views, each an image of one world: connected components (-1: no instance), largest one of each instance,
    distance transform [px], outer contours.
    """

    component: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    """Connected-component label (8-connectivity, within one instance): the smallest row-major index of its pixels; -1: no instance."""
    area: wp.array = device_array("view", "row", "column", dtype=wp.int32, unit="px")
    """Size of a component, stored at its root, the pixel whose index is the label; 0 elsewhere."""
    largest: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Label of each instance's largest component; ties go to the smallest label; -1: the instance is not visible."""
    distance: wp.array = device_array("view", "row", "column", dtype=wp.float32, unit="px")
    """Distance transform: distance to the centre of the nearest pixel outside the component; pixels beyond the image border are outside.
    0 where the pixel does not belong to the largest component of an instance."""
    contour: wp.array = device_array("view", "instance", "point", dtype=wp.vec2i, unit="px")
    """Outer contour of the largest component, in the order of OpenCV's findContours with CHAIN_APPROX_NONE."""
    contour_length: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Number of contour points."""


@dataclass(frozen=True, eq=False)
class SegmentationScratch:
    """Patches, column distances, packed maxima and sums of a batch of views: scratch of segmentation.

    A patch is the largest component of an instance.
    """

    patch: wp.array = device_array("view", "row", "column", dtype=wp.uint16)
    """Low byte: 1 + instance, 0: no patch; bit 8 + d: the neighbour in direction d belongs to the same patch."""
    gap: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    """256 x distance within the column [px] + low byte of `patch`."""
    largest_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Size and label of the largest component, packed by `pack_key`."""
    pole_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    """Squared distance [px²] and pixel of the pole, packed by `pack_key`."""
    square: wp.array = device_array("view", "instance", dtype=wp.int64, unit="2⁻²⁴ m²")
    """Sum of squared depths over the patch."""


@dataclass(frozen=True, eq=False)
class Observation:
    """Perception result of each instance, when its world was last observed: visible pixels and fraction, grasp point candidates [px], depth
    [m], votes[i, j] for j lying above i, clutter graph as bit sets of the instances above.

    `factory.attempts.InstanceObservation` maps it to JSON.
    """

    visible: wp.array = device_array("world", "instance", dtype=wp.int32, unit="px")
    """Visible pixels: size of the largest component; 0: not visible."""
    visible_fraction: wp.array = device_array("world", "instance", dtype=wp.float32)
    """Visible area [m²], measured from depth, divided by the expected area: the product of the two larger sides of the bounding box."""
    pole: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Pole of inaccessibility: the pixel farthest from the contour."""
    centroid: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Centroid of the polygon that the outer contour encloses."""
    midpoint: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Midpoint of pole and centroid."""
    distances: wp.array = device_array("world", "instance", dtype=wp.vec3f, unit="px")
    """Distance to the contour at pole, centroid and midpoint; 0 outside the component."""
    grasp_pixel: wp.array = device_array("world", "instance", dtype=wp.vec2i, unit="px")
    """Suction grasp point in the image: the candidate chosen among pole, centroid and midpoint."""
    depth: wp.array = device_array("world", "instance", dtype=wp.float32, unit="m")
    """Planar depth of the grasp point."""
    votes: wp.array = device_array("world", "instance", "instance", dtype=wp.float32)
    """Occlusion votes: votes[i, j] is the evidence along i's contour that j lies on top of i; not thresholded."""
    above: wp.array = device_array("world", "instance", "word", dtype=wp.uint32)
    """Edges of the clutter graph, as bit sets (`kernels.bitsets`). Member j: edge from j, on top, to this instance."""
    ancestors: wp.array = device_array("world", "instance", "word", dtype=wp.uint32)
    """Transitive closure of `above`. Member j: a path leads from j to this instance."""
    overflow: wp.array = device_array("world", dtype=wp.int32)
    """1: a contour exceeded its capacity."""


@dataclass(frozen=True, eq=False)
class Plan:
    """Plan of each world, from when it was last observed: target instance (-1: none), grasp point [m] and outward normal in the world, yaw
    of the shaft and tilt of the cup [rad].
    """

    target: wp.array = device_array("world", dtype=wp.int32)
    """Chosen instance; -1: none."""
    point: wp.array = device_array("world", dtype=wp.vec3f, unit="m")
    """Grasp point."""
    normal: wp.array = device_array("world", dtype=wp.vec3f)
    """Unit surface normal at the grasp point, pointing out of the object."""
    yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Rotation of the gripper shaft about the vertical."""
    tilt: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Rotation of the cup about the wrist axis, the shaft's y axis."""
