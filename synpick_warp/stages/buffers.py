"""Device arrays that stages hand over to each other: snapshots of the worlds, and images of a batch of views."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass
from typing import Any

import warp as wp

from synpick_warp.kernels.render.images.camera_effects import EffectParameters
from synpick_warp.kernels.render.visibility.masks import InstanceMasks
from synpick_warp.stages.arrays import allocate, device_array
from synpick_warp.views.layers import LAYER_TABLE, Layer
from synpick_warp.views.masks import most_words

FIXTURES = ("tote", "finger", "cup")
"""Order of the dimension "fixture"; finger: the gripper shaft."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """Snapshot of every world at the end of a tick: episode, frame, objects (-1: none), poses to the world, light, and the poses of the
    previous frame (`last_`); input of renderer and exporters.
    """

    live: wp.array = device_array("world", dtype=wp.int32)
    """1: this tick is a frame of the world's episode."""
    episode: wp.array = device_array("world", dtype=wp.int32)
    """Episode index."""
    frame: wp.array = device_array("world", dtype=wp.int32)
    """Frame index within the episode."""
    bin: wp.array = device_array("world", dtype=wp.int32)
    """Bin of the episode; its pose is that of the first fixture."""
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Catalog index of each instance; -1: none."""
    pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world."""
    fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    """Bin, gripper shaft and cup to world."""
    fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)
    """0: the fixture is not rendered."""
    light: wp.array = device_array("world", dtype=wp.int32)
    """Index of the episode's environment map."""
    light_yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """Environment yaw: rotation of the map counter-clockwise about +z."""
    light_exposure: wp.array = device_array("world", dtype=wp.float32, unit="EV")
    """Exposure value relative to the automatic exposure [EV]."""
    follows: wp.array = device_array("world", dtype=wp.int32)
    """1: the `last_` arrays hold the previous frame of the same episode; 0: there is none."""
    last_catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    last_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    last_fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    last_fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)


@dataclass(frozen=True, eq=False)
class LastFrame:
    """State of each world at the end of the previous tick: episode, objects and poses. The next snapshot copies it to its `last_` arrays.

    Members are named as in `Snapshot` and `FramePoses`.
    """

    live: wp.array = device_array("world", dtype=wp.int32)
    episode: wp.array = device_array("world", dtype=wp.int32)
    frame: wp.array = device_array("world", dtype=wp.int32)
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)


@dataclass(frozen=True, eq=False)
class ViewBuffers:
    """Output of the renderer for one batch of views: colour, depth in counts (0: none), segmentation ids, amodal masks, pixel counts,
    boxes, effects.
    """

    color: wp.array = device_array("view", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""
    depth: wp.array = device_array("view", "row", "column", dtype=wp.uint16, unit="depth_scale")
    """Planar depth in counts of the depth scale; 0: no surface, or above 65,535 counts."""
    instance: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    """Instance segmentation: 1 + instance_id, or a `Segment`."""
    mask_words: wp.array = device_array("view", "mask_word", dtype=wp.uint32)
    """Amodal masks, one bit per pixel of each instance's box (see `InstanceMasks.words`): set where the pixel's ray hits the instance,
    occluded or not."""
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


def _declare_layer(layer: Layer) -> Any:
    """Declaration of the device array that a layer is rendered to."""
    return device_array("view", "row", "column", dtype=_LAYER_DTYPES[layer.dtype, layer.components], unit=layer.unit)


_LAYER_DTYPES = {
    ("uint8", 1): wp.uint8,
    ("uint8", 3): wp.vec3ub,
    ("uint16", 1): wp.uint16,
    ("float32", 1): wp.float32,
    ("float32", 2): wp.vec2,
    ("float32", 3): wp.vec3,
}
_LAYER_FIELDS = [(name, wp.array, _declare_layer(layer)) for name, layer in LAYER_TABLE.items()]


class LayerBuffers(make_dataclass("LayerArrays", _LAYER_FIELDS, frozen=True, eq=False)):
    """Annotation layers of one batch of views: an array per layer of `LAYER_TABLE`, by its name; None: not in `render.layers`."""
