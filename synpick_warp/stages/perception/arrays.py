"""Arrays of looking: what one batch of images shows, and what is concluded from it for every world.

Pixels are (column, row) indices of the sight image; the centre of a pixel has whole indices here, as in OpenCV's contours.
"""

from __future__ import annotations

from dataclasses import dataclass

import warp as wp

from synpick_warp.arrays import device_array


@dataclass(frozen=True, eq=False)
class LookArrays:
    """Scratch of one batch of looks; a view is one image of a world that must choose."""

    world: wp.array = device_array("view", dtype=wp.int32)
    """World of each view; -1: the view is not in use."""
    camera: wp.array = device_array("view", dtype=wp.int32)
    """Zero: all look through camera 0; -1: the view is not in use."""
    component: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    """Connected component of pixels (8 neighbours) of one instance: the least row-major index of its pixels; -1: no instance."""
    area: wp.array = device_array("view", "row", "column", dtype=wp.int32, unit="px")
    """Size of a component, at the pixel that names it; 0 elsewhere."""
    largest: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Largest component of each instance, the one with the least index of equal ones; -1: the instance is not visible."""
    distance: wp.array = device_array("view", "row", "column", dtype=wp.float32, unit="px")
    """Distance to the centre of the nearest pixel that is not of the same component; what lies beyond the border is not. 0: no instance,
    or not the largest component of one."""
    contour: wp.array = device_array("view", "instance", "point", dtype=wp.vec2i, unit="px")
    """Outer contour of the largest component, in order, as OpenCV's findContours with CHAIN_APPROX_NONE has it."""
    contour_length: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Points of the contour."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """What was concluded of each instance when its world was last looked at."""

    visible: wp.array = device_array("world", "instance", dtype=wp.int32, unit="px")
    """Pixels of the largest component; 0: not visible."""
    share: wp.array = device_array("world", "instance", dtype=wp.float32)
    """Visible area [m²], from depth, over the expected area, the product of the two larger extents."""
    pole: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Pole of inaccessibility."""
    centroid: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Centroid of what the outer contour encloses."""
    middle: wp.array = device_array("world", "instance", dtype=wp.vec2f, unit="px")
    """Half-way between the two."""
    distances: wp.array = device_array("world", "instance", dtype=wp.vec3f, unit="px")
    """Distance to the contour of pole, centroid and middle; 0 outside."""
    suction: wp.array = device_array("world", "instance", dtype=wp.vec2i, unit="px")
    """Suction point."""
    depth: wp.array = device_array("world", "instance", dtype=wp.float32, unit="m")
    """Planar depth of the suction point."""
    votes: wp.array = device_array("world", "instance", "instance", dtype=wp.float32)
    """votes[i, j]: what the contour of i says for j lying above it, before edges are made."""
    above: wp.array = device_array("world", "instance", dtype=wp.uint32)
    """Bit j: the clutter graph has the edge from j, above, to this instance."""
    all_above: wp.array = device_array("world", "instance", dtype=wp.uint32)
    """Bit j: there is a path from j to this instance."""
    overflow: wp.array = device_array("world", dtype=wp.int32)
    """1: a contour had no room."""


@dataclass(frozen=True, eq=False)
class Plan:
    """What was chosen when the world was last looked at."""

    target: wp.array = device_array("world", dtype=wp.int32)
    """The chosen instance; -1: none."""
    point: wp.array = device_array("world", dtype=wp.vec3f, unit="m")
    """Grasp point."""
    normal: wp.array = device_array("world", dtype=wp.vec3f)
    """Unit normal there, out of the object."""
    yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Turn of the finger about the vertical."""
    tilt: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Tilt of the cup about the finger's y axis."""
