"""Device arrays that stages hand over to each other: snapshots of the worlds, and images of a batch of views."""

from dataclasses import dataclass, make_dataclass
from functools import cached_property
from typing import Any

import warp as wp

from synpick_warp.kernels.render.images.camera_effects import EffectParameters
from synpick_warp.kernels.render.visibility.masks import InstanceMasks
from synpick_warp.kernels.state import FramePoses, Frames, Snapshots
from synpick_warp.stages.arrays import allocate, array_group, bundle, device_array
from synpick_warp.views.frames import most_words
from synpick_warp.views.layers import LAYER_TABLE

FIXTURES = ("tote", "finger", "cup")
"""Order of the dimension "fixture"; finger: the gripper shaft."""


_WORLD = dict.fromkeys(("live", "episode", "frame", "bin", "light", "light_yaw", "light_exposure", "follows"), ("world",))
_FIXTURES = dict.fromkeys(("fixture_pose", "fixture_visible", "last_fixture_pose", "last_fixture_visible"), ("world", "fixture"))
_METRES = dict.fromkeys(("pose", "fixture_pose", "last_pose", "last_fixture_pose"), "m")
_UNITS = _METRES | {"light_yaw": "rad", "light_exposure": "EV"}


class Snapshot(array_group(Snapshots, "world", "instance", units=_UNITS, **_WORLD, **_FIXTURES)):
    """Snapshot of every world at the end of a tick: input of renderer and exporters."""

    @cached_property
    def frames(self) -> Any:
        """The struct `Frames` of these arrays."""
        return bundle(Frames, self)


_WORLD = dict.fromkeys(("live", "episode", "frame"), ("world",))
_FIXTURES = dict.fromkeys(("fixture_pose", "fixture_visible"), ("world", "fixture"))
_METRES = {"pose": "m", "fixture_pose": "m"}


class LastFrame(array_group(FramePoses, "world", "instance", units=_METRES, **_WORLD, **_FIXTURES)):
    """State of each world at the end of the previous tick."""


@dataclass(frozen=True, eq=False)
class ViewBuffers:
    """Renderer's output for a batch: colour, depth in counts (0: none), segmentation ids, amodal masks, pixel counts, boxes, effects."""

    color: wp.array = device_array("view", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""
    depth: wp.array = device_array("view", "row", "column", dtype=wp.uint16, unit="depth_scale")
    """Planar depth in counts of the depth scale; 0: no surface, or above 65,535 counts."""
    instance: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    """Instance segmentation: 1 + instance_id, or a `Segment`."""
    mask_words: wp.array = device_array("view", "mask_word", dtype=wp.uint32)
    """Amodal masks, one bit per pixel of each instance's box (see `InstanceMasks.words`): where its ray hits, occluded or not."""
    mask_first: wp.array = device_array("view", "instance", dtype=wp.int32)
    """Index of the first word of each mask."""
    mask_box: wp.array = device_array("view", "instance", dtype=wp.vec4i, unit="px")
    """Box of each mask within the image: x_min, y_min, x_max, y_max, inclusive; x_max < x_min: empty. Conservative."""
    mask_length: wp.array = device_array("view", dtype=wp.int32)
    """Words in use."""
    pixels: wp.array = device_array("view", "instance", "count", dtype=wp.int32, unit="px")
    """BOP's px_count_all, px_count_valid, px_count_visib."""
    boxes: wp.array = device_array("view", "instance", "box", "side", dtype=wp.int32, unit="px")
    """BOP's bbox_obj and bbox_visib as (x_min, y_min, x_max, y_max), inclusive; x_max < x_min: empty."""
    effects: wp.array = device_array("view", dtype=EffectParameters)
    """Camera-effect parameters of each view, by `Effect`; zero: off."""


def view_buffer_sizes(views: int, width: int, height: int, instances: int) -> dict[str, int]:
    """Extents of the dimensions of `ViewBuffers` and `LayerBuffers`, with words for masks as large as the image, so that none can lack."""
    sizes = {"view": views, "row": height, "column": width, "instance": instances, "count": 3, "box": 2, "side": 4}
    return sizes | {"mask_word": instances * most_words(width, height)}


def allocate_view_buffers(views: int, width: int, height: int, instances: int, device: wp.Device) -> ViewBuffers:
    """`ViewBuffers` of a batch of at most `views` views of `width` x `height` px, with space for `instances` instances of a world."""
    return allocate(ViewBuffers, view_buffer_sizes(views, width, height, instances), device)


def masks_of(buffers: ViewBuffers | None) -> Any:
    """The struct `InstanceMasks` of a batch's masks; None: that of no masks."""
    masks = InstanceMasks()
    if buffers is not None:
        masks.words, masks.first, masks.box, masks.length = buffers.mask_words, buffers.mask_first, buffers.mask_box, buffers.mask_length
    return masks


_LAYER_DTYPES = {
    ("uint8", 1): wp.uint8,
    ("uint8", 3): wp.vec3ub,
    ("uint16", 1): wp.uint16,
    ("float32", 1): wp.float32,
    ("float32", 2): wp.vec2,
    ("float32", 3): wp.vec3,
}
_LAYER_FIELDS = [
    (name, wp.array, device_array("view", "row", "column", dtype=_LAYER_DTYPES[layer.dtype, layer.components], unit=layer.unit))
    for name, layer in LAYER_TABLE.loadable()
]


class LayerBuffers(make_dataclass("LayerArrays", _LAYER_FIELDS, frozen=True, eq=False)):
    """Annotation layers of one batch of views: an array per layer of `LAYER_TABLE`, by its name; None: not in `render.layers`."""
