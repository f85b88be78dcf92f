"""Device arrays that pass from one stage to the next."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass
from typing import Any

import warp as wp

from synpick_warp.arrays import allocate, device_array
from synpick_warp.kernels.render.images.camera_effects import EffectParameters
from synpick_warp.layers import LAYER_TABLE, Layer

FIXTURES = ("tote", "finger", "cup")
"""What `Snapshot.fixture_pose` holds, in order."""


@dataclass(frozen=True, eq=False)
class Snapshot:
    """What every world looks like at the end of a tick; what the renderer and the exporters see."""

    live: wp.array = device_array("world", dtype=wp.int32)
    """1: this tick is a frame of the world's episode."""
    episode: wp.array = device_array("world", dtype=wp.int32)
    """Episode number."""
    frame: wp.array = device_array("world", dtype=wp.int32)
    """Number of the frame in its episode."""
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    """Catalog index of each instance; -1: none."""
    pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    """Object to world."""
    fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    """Tote, finger and cup to world."""
    fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)
    """0: not in the picture."""
    light: wp.array = device_array("world", dtype=wp.int32)
    """Index of the episode's light map."""
    light_yaw: wp.array = device_array("world", dtype=wp.float32, unit="rad")
    """The light map is turned counter-clockwise about +z by this angle."""
    light_exposure: wp.array = device_array("world", dtype=wp.float32, unit="stops")
    """How much longer than the automatic exposure the episode's pictures are exposed."""
    follows: wp.array = device_array("world", dtype=wp.int32)
    """1: the arrays below hold the frame before this one, of the same episode; 0: there is none."""
    last_catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    last_pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    last_fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    last_fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)


@dataclass(frozen=True, eq=False)
class LastFrame:
    """The part of every world's last snapshot that the next one repeats; fields as those of `Snapshot` and of the struct `FramePoses`."""

    live: wp.array = device_array("world", dtype=wp.int32)
    episode: wp.array = device_array("world", dtype=wp.int32)
    frame: wp.array = device_array("world", dtype=wp.int32)
    catalog_index: wp.array = device_array("world", "instance", dtype=wp.int32)
    pose: wp.array = device_array("world", "instance", dtype=wp.transformf, unit="m")
    fixture_pose: wp.array = device_array("world", "fixture", dtype=wp.transformf, unit="m")
    fixture_visible: wp.array = device_array("world", "fixture", dtype=wp.int32)


@dataclass(frozen=True, eq=False)
class ViewBuffers:
    """Images and counts of one batch of views."""

    color: wp.array = device_array("view", "row", "column", dtype=wp.vec3ub)
    """sRGB, red first."""
    depth: wp.array = device_array("view", "row", "column", dtype=wp.uint16, unit="depth_scale")
    """Planar depth in counts of the depth scale; 0: no surface, or farther than 65,535 counts."""
    instance: wp.array = device_array("view", "row", "column", dtype=wp.uint8)
    """Instance segmentation: 1 + instance_id, or a `Segment`."""
    amodal: wp.array = device_array("view", "row", "column", dtype=wp.uint32)
    """Bit i: the ray hits instance i."""
    pixels: wp.array = device_array("view", "instance", "count", dtype=wp.int32, unit="px")
    """px_count_all, px_count_valid, px_count_visib."""
    boxes: wp.array = device_array("view", "instance", "box", "side", dtype=wp.int32, unit="px")
    """bbox_obj and bbox_visib: x_min, y_min, x_max, y_max, inclusive; x_max < x_min: empty."""
    effects: wp.array = device_array("view", dtype=EffectParameters)
    """Camera-effect parameters of each view, by `Effect`; zero: off."""


def view_buffer_sizes(views: int, width: int, height: int, instances: int) -> dict[str, int]:
    """Extents of the dimensions of `ViewBuffers` and `LayerBuffers`."""
    return {"view": views, "row": height, "column": width, "instance": instances, "count": 3, "box": 2, "side": 4}


def allocate_view_buffers(views: int, width: int, height: int, instances: int, device: wp.Device) -> ViewBuffers:
    """`ViewBuffers` of a batch of at most `views` views of `width` x `height` px, with space for `instances` instances of a world."""
    return allocate(ViewBuffers, view_buffer_sizes(views, width, height, instances), device)


def _declare_layer(layer: Layer) -> Any:
    return device_array("view", "row", "column", dtype=_LAYER_DTYPES[layer.dtype, layer.components], unit=layer.unit)


_LAYER_DTYPES = {("float32", 2): wp.vec2, ("float32", 3): wp.vec3, ("uint8", 3): wp.vec3ub, ("uint16", 1): wp.uint16}
_LAYER_FIELDS = [(name, wp.array, _declare_layer(layer)) for name, layer in LAYER_TABLE.items()]


class LayerBuffers(make_dataclass("LayerArrays", _LAYER_FIELDS, frozen=True, eq=False)):
    """Annotation layers of one batch of views: an array per layer of `LAYER_TABLE`, by its name; None: not in `render.layers`."""
