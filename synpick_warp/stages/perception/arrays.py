"""Device arrays of perception and grasp planning: scratch of one batch of images, and the results kept for every world.

Pixels are (column, row) indices of the perception image; pixel centres have integer coordinates here, as in OpenCV's contours.
"""

from dataclasses import dataclass

import warp as wp

from synpick_warp.kernels.perception.components import Patches
from synpick_warp.kernels.state import Observations, Plans
from synpick_warp.stages.arrays import array_group, device_array

_LENGTHS = dict.fromkeys(("area", "distance", "contour"), "px")
_LISTS = {"largest": ("view", "instance"), "contour": ("view", "instance", "point"), "contour_length": ("view", "instance")}


class PerceptionArrays(array_group(Patches, "view", "row", "column", units=_LENGTHS, **_LISTS)):
    """Segmentation of a batch of views, each an image of one world."""


@dataclass(frozen=True, eq=False)
class SegmentationScratch:
    """Scratch of segmentation: its other members."""

    patch: wp.array = device_array("view", "row", "column", dtype=wp.uint16)
    gap: wp.array = device_array("view", "row", "column", dtype=wp.int32)
    largest_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    pole_key: wp.array = device_array("view", "instance", dtype=wp.int64)
    square: wp.array = device_array("view", "instance", dtype=wp.int64, unit="2⁻²⁴ m²")


_PIXELS = dict.fromkeys(("visible", "pole", "centroid", "midpoint", "distances", "grasp_pixel"), "px")
_SETS = dict.fromkeys(("above", "ancestors"), ("world", "instance", "word"))
_SHAPES = _SETS | {"votes": ("world", "instance", "instance"), "overflow": ("world",)}


class Observation(array_group(Observations, "world", "instance", units=_PIXELS | {"depth": "m"}, **_SHAPES)):
    """Perception result of each instance, when its world was last observed. `factory.attempts.InstanceObservation` maps it to JSON."""


class Plan(array_group(Plans, "world", units={"point": "m", "yaw": "rad", "tilt": "rad"})):
    """Plan of each world, from when it was last observed."""
