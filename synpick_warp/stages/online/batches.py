"""Ring of view batches on the device: rendered views with their ground truth, which nothing copies to the host.

They are exchanged by DLPack, with the order of producer and consumers kept by CUDA events. A slot is a set of buffers that is rendered into
again and again. Its `Gate` keeps two orders on a GPU, neither of which blocks the host: a consumer's stream reads after the rendering of
its batch (and not after whatever else was queued since), and the next rendering into the slot begins after everything that consumers'
streams had been given until the batch expired. On the CPU both hold by themselves for libraries that compute when they are called, such as
PyTorch and NumPy. JAX computes later, on a CPU, too, and on streams of its own: its users wait for their results before they request the
next batch.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.images.ground_truth import ViewTruth, expand_masks_kernel, gather_cameras_kernel, gather_objects_kernel
from synpick_warp.stages.arrays import allocate, array_group, device_array
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, masks_of
from synpick_warp.stages.launch import launch
from synpick_warp.stages.render.view_setup import with_cameras
from synpick_warp.stages.timing import scope
from synpick_warp.stages.view_ring import CameraGroup, widen

_LEGACY_STREAM = 1
"""DLPack's number of CUDA's legacy default stream, which `stream=None` means."""
_NO_ORDER = -1
"""DLPack's stream argument for "do not synchronize"."""
_EXPIRED = "this batch has expired: its buffers are rendered into again; clone what you keep before you ask for the next batch"


class ConsumerStream(wp.Stream):
    """Non-owning wrapper of another library's CUDA stream. It is not registered with Warp, whose registry has one entry a handle, which may
    belong to a stream object of the consumer."""

    def __init__(self, device: wp.Device, handle: int) -> None:
        self.device, self.cuda_stream = device, handle

    def __del__(self) -> None:
        """Nothing to release."""


class Gate:
    """Order of the renderer's and the consumers' work on the buffers of a slot; see the module.

    Attributes:
        turn: Number of batches that the slot has held and that have expired.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device, self.turn = device, 0
        self._ready = wp.Event(device) if device.is_cuda else None
        self._consumers: dict[int, tuple[wp.Stream, wp.Event]] = {}
        """By the stream's handle: the stream, and the event behind its work on this batch."""

    def wait_for_consumers(self) -> None:
        """Make the current stream wait for the consumers of the previous batch, and forget these."""
        for _, event in self._consumers.values():
            self.device.stream.wait_event(event)
        self._consumers.clear()

    def mark_ready(self) -> None:
        """Record the event "rendered" of this batch on the current stream."""
        if self._ready is not None:
            self.device.stream.record_event(self._ready)

    def admit(self, handle: int | None) -> None:
        """Let a stream wait for this batch. `handle`: the stream by DLPack's convention; it must live until the batch expires."""
        if self._ready is None or handle == _NO_ORDER:
            return
        handle = _LEGACY_STREAM if handle is None else handle
        if handle not in self._consumers:
            self._consumers[handle] = (ConsumerStream(self.device, handle), wp.Event(self.device))
        with wp.ScopedDevice(self.device):
            self._consumers[handle][0].wait_event(self._ready)

    def admit_current(self) -> None:
        """Let the device's current stream, which may be that of a consumer that uses Warp, wait for the rendering of this batch."""
        if self._ready is not None:
            self.admit(self.device.stream.cuda_stream)

    def expire(self) -> None:
        """End the batch: its arrays refuse further use, and what the consumers' streams have queued so far is noted."""
        self.turn += 1
        if self._consumers:
            with wp.ScopedDevice(self.device):
                for stream, event in self._consumers.values():
                    stream.record_event(event)


class DeviceArray:
    """Array in a batch's buffers, on the device that renders: torch, JAX, CuPy, Warp and NumPy read it through DLPack, without a copy.

        color = torch.from_dlpack(batch.color)          # likewise jax.dlpack, cupy, warp; numpy on the CPU

    Attributes:
        shape: Extents, components of vectors and matrices last.
        dtype: Type of the elements.
        device: Where the array lies, "cpu" or "cuda:N".
    """

    def __init__(self, array: wp.array, gate: Gate) -> None:
        self._array, self._gate, self._turn = array, gate, gate.turn
        scalar, inner = getattr(array.dtype, "_wp_scalar_type_", array.dtype), getattr(array.dtype, "_shape_", ())
        self.shape = (*array.shape, *inner)
        self.dtype = np.dtype(wp.dtype_to_numpy(scalar))
        self.device = array.device.alias

    def __dlpack_device__(self) -> tuple[int, int]:
        """Type and index of the device by DLPack's numbers."""
        kind, index = self._array.__dlpack_device__()
        return int(kind), int(index)

    def __dlpack__(
        self,
        stream: int | None = None,
        *,
        max_version: tuple[int, int] | None = None,
        dl_device: tuple[int, int] | None = None,
        copy: bool | None = None,
    ) -> Any:
        """Export the array; called by `from_dlpack` of the consumer's library. `stream`: the consumer's stream, which will wait for the
        rendering; -1: it does not. `max_version`: not used: the capsule is of the first version, which all libraries read. `dl_device`:
        device that the consumer asks for. `copy`: whether the consumer asks for a copy, which stays valid when the batch has expired.
        Raises BufferError: the batch has expired, or the consumer asks for another device."""
        if dl_device is not None and tuple(dl_device) != self.__dlpack_device__():
            raise BufferError(f"this array lies on {self.device}; import it there, then move it")
        array = self._valid()
        if copy:
            self._gate.admit_current()
            return wp.clone(array).__dlpack__(stream=stream)
        self._gate.admit(stream)
        return array.__dlpack__(stream=_NO_ORDER)

    def numpy(self) -> np.ndarray:
        """The array on the host: on the CPU the buffer itself, on a GPU a copy, awaited. Raises BufferError: the batch has expired."""
        array = self._valid()
        self._gate.admit_current()
        return array.numpy()

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """For `numpy.asarray`; as `numpy()`."""
        return np.array(self.numpy(), dtype=dtype, copy=copy)

    def check(self) -> None:
        """Raise a BufferError if the batch has expired."""
        self._valid()

    def _valid(self) -> wp.array:
        """The array, if the batch has not expired; else raises BufferError."""
        if self._turn != self._gate.turn:
            raise BufferError(_EXPIRED)
        return self._array

    def __len__(self) -> int:
        return self.shape[0]

    def __repr__(self) -> str:
        return f"DeviceArray({self.dtype}, {self.shape}, {self.device})"


GPU_RING = 3
"""Slots on a GPU: one with the consumer, one rendered ahead, and one that the consumer's queue may still read."""


_METRES = dict.fromkeys(("pose", "object_to_camera", "world_to_camera"), "m")
_INSTANCES = dict.fromkeys(("object_id", "pose", "object_to_camera"), ("view", "instance"))


class TruthBuffers(array_group(ViewTruth, "view", units=_METRES | {"intrinsics": "px"}, **_INSTANCES)):
    """Ground truth of one batch of views, beside what the renderer writes."""


@dataclass(frozen=True, eq=False)
class MaskBuffers:
    """Visible and amodal masks of one batch of views, an image per instance; allocated when they are first asked for."""

    visible: wp.array = device_array("view", "instance", "row", "column", dtype=wp.bool)
    amodal: wp.array = device_array("view", "instance", "row", "column", dtype=wp.bool)


def allocate_slot(sizes: dict[str, int], layers: Collection[str], device: wp.Device) -> tuple[ViewBuffers, TruthBuffers, LayerBuffers]:
    """Allocate images, ground truth and layers of a batch; arguments as of `BatchRing`."""
    return allocate(ViewBuffers, sizes, device), allocate(TruthBuffers, sizes, device), allocate(LayerBuffers, sizes, device, layers)


class Slot:
    """Images, layers, ground truth and masks of one batch in the ring, and the gate that orders the access to these."""

    def __init__(self, sizes: dict[str, int], layers: list[str], device: wp.Device) -> None:
        self.sizes, self.device = sizes, device
        self.pooled, self.truth, self.layers = allocate_slot(sizes, layers, device)
        self.images = self.pooled
        """The same with the pool of mask words as it is divided among the views."""
        self.lists = wp.zeros((3, sizes["view"]), dtype=wp.int32, device=device)
        self.masks: dict[str, wp.array] = {}
        self.gate = Gate(device)
        self._expanded: dict[str, int] = {}
        """Turn of the gate in which each of `masks` was written last."""

    def expand_masks(self, name: str, count: int) -> wp.array:
        """Masks of the first `count` views; `name` is a field of `MaskBuffers`."""
        if name not in self.masks:
            self.masks[name] = getattr(allocate(MaskBuffers, self.sizes, self.device, [name]), name)
        mask, images = self.masks[name], self.images
        if self._expanded.get(name) == self.gate.turn:
            return mask
        self._expanded[name] = self.gate.turn
        self.gate.admit_current()
        wp.launch(
            expand_masks_kernel,
            dim=(count, *mask.shape[1:]),
            inputs=[images.instance, masks_of(images), name == "amodal"],
            outputs=[mask],
            device=self.device,
        )
        self.gate.mark_ready()
        return mask


class ViewBatch:
    """Batch of `B` rendered views with their ground truth, on the device: what the writers of a bake get.

    The arrays are valid until the next batch is requested; copy what you keep. They are `DeviceArray`s: give them to `from_dlpack` of
    torch, JAX, CuPy, Warp or NumPy. `I` is the instance capacity of a world; an instance's index along `I` is its `instance_id`, which
    denotes the same object for the whole episode.

    Attributes:
        color: Colour image, sRGB, red first (B, H, W, 3) uint8; None for cameras without colour in their modalities.
        depth: Planar depth in units of `depth_scale` mm; 0: no surface (B, H, W) uint16.
        instance: Segmentation id of the nearest surface: 0 none, 1 + instance_id, 252 to 255 table with props, and fixtures (`Segment`)
            (B, H, W) uint8.
        mask_words, mask_first, mask_box, mask_length: Amodal masks as bits, each in its own box (B, W) uint32, (B, I) int32, (B, I, 4)
            int32 [px], (B) int32: words in use, the others mean nothing; see `InstanceMasks`. `amodal_masks` makes images of them. W is not
            the same in all batches of many instances.
        layers: Layers (AOVs) that `render.layers` names and the modalities of the cameras have, as they are before quantization
            (B, H, W[, C]); see `synpick_warp.views.layers`.
        object_id: obj_id of each instance; -1: the instance is not in the scene; below: a distractor, without label (B, I) int32.
        pose: Object to world: x, y, z [m], quaternion x, y, z, w (B, I, 7) float32.
        object_to_camera: The same in the camera's frame, as matrices (B, I, 4, 4) float32 [m].
        pixels: BOP's px_count_all, px_count_valid, px_count_visib (B, I, 3) int32.
        boxes: Amodal and visible boxes x_min, y_min, x_max, y_max [px], inclusive; x_max < x_min: empty (B, I, 2, 4) int32.
        effects: Camera-effect parameters in the order of `Effect`; 0: off (B, E) float32.
        intrinsics: Camera matrix K (B, 3, 3) float32 [px].
        world_to_camera: Extrinsics (B, 4, 4) float32 [m].
        episode: Episode index (B) int32.
        camera: Camera index (B) int32.
        frame: Frame index within the episode, from 0 (B) int32.
        depth_scale: Millimetres per count of `depth`.
        host: The numbers of the views that the host knows anyway, as NumPy arrays that stay valid, by name: episode, arrangement (how
            often the episode's arrangement was resampled), camera, frame, time [s], object_id, pose, light_name, light_yaw,
            light_exposure, light_direction; bin_name and bin_pose unless there is a tote in its place; matrix, rotation and
            translation where these are not those of the cameras; see `synpick_warp.views.frames.FrameBatch`.
    """

    color: DeviceArray | None
    depth: DeviceArray
    instance: DeviceArray
    mask_words: DeviceArray
    mask_first: DeviceArray
    mask_box: DeviceArray
    mask_length: DeviceArray
    pixels: DeviceArray
    boxes: DeviceArray
    effects: DeviceArray
    episode: DeviceArray
    camera: DeviceArray
    frame: DeviceArray
    object_id: DeviceArray
    pose: DeviceArray
    object_to_camera: DeviceArray
    intrinsics: DeviceArray
    world_to_camera: DeviceArray

    def __init__(self, slot: Slot, count: int, depth_scale: float, host: Mapping[str, np.ndarray], colors: bool) -> None:
        self._slot, self._count, self.depth_scale, self.host = slot, count, depth_scale, host
        for part in (slot.images, slot.truth):
            for item in fields(part):
                setattr(self, item.name, self._export(getattr(part, item.name)))
        self.color = self.color if colors else None
        present = {item.name: getattr(slot.layers, item.name) for item in fields(slot.layers)}
        self.layers = {name: self._export(array) for name, array in present.items() if array is not None}

    def visible_masks(self) -> DeviceArray:
        """Modal (visible) mask of each instance (B, I, H, W) bool, made on the device. Takes I bytes a pixel."""
        return self._masks("visible")

    def amodal_masks(self) -> DeviceArray:
        """Amodal mask of each instance, hidden parts included (B, I, H, W) bool, valid as long as the batch."""
        return self._masks("amodal")

    def expire(self) -> None:
        """End the batch; called before the next one is made. Its arrays refuse further use."""
        self._slot.gate.expire()

    def _masks(self, name: str) -> DeviceArray:
        """Expand the masks of a kind (B, I, H, W), and export these."""
        self.depth.check()
        return self._export(self._slot.expand_masks(name, self._count))

    def _export(self, array: wp.array) -> DeviceArray:
        """Array of the views in use, which expires with the batch."""
        return DeviceArray(array[: self._count], self._slot.gate)

    def __len__(self) -> int:
        """Number of views B."""
        return self._count

    def __repr__(self) -> str:
        return f"ViewBatch({self._count} views of {self.depth.shape[2]}x{self.depth.shape[1]} px on {self.depth.device})"


class BatchRing:
    """Renders batches of views into a ring of slots; `render` only launches kernels."""

    def __init__(self, group: CameraGroup, layers: tuple[str, ...], depth_scale: float) -> None:
        """Allocate the slots. `group`: cameras and their renderer. `layers`: names of those to render. `depth_scale`: [mm] of a count."""
        renderer, sizes = group.renderer, group.sizes
        self.group, self.renderer, self.device, self.depth_scale = group, renderer, renderer.scene.device, depth_scale
        self.views, self.instances = sizes["view"], sizes["instance"]
        names = [item.name for item in fields(LayerBuffers) if item.name in layers]
        self.slots = [Slot(sizes, names, self.device) for _ in range(GPU_RING if self.device.is_cuda else 1)]
        self._cameras = [group.allocate_cameras() for _ in self.slots]
        self._next = 0

    def render(
        self,
        snapshot: Snapshot,
        world: np.ndarray,
        camera: np.ndarray,
        host: Mapping[str, Any],
        last: Mapping[str, np.ndarray],
        wide: bool = False,
    ) -> ViewBatch:
        """Render views into the next slot, whose last batch must have expired. `world`: world of each view (B) int32, at most `views`.
        `camera`: camera of each view (B) int32. `host`: for `ViewBatch.host`. `last`: their cameras in the tick before, as in
        `ViewExtrinsics`. `wide`: as of `ViewRing.launch`."""
        slot, cameras, count = self.slots[self._next], self._cameras[self._next], len(world)
        self._next = (self._next + 1) % len(self.slots)
        slot.gate.wait_for_consumers()
        slot.images = widen(slot.pooled) if wide else slot.pooled
        views = self.group.write_views(slot.lists, world, camera, cameras, (host, last))
        views = with_cameras(views, self.renderer.cameras if cameras is None else cameras[0])
        with scope("render", self.device):
            self.renderer.render(snapshot, views, slot.images, slot.layers, cameras)
            self._gather(snapshot, views, slot.truth)
        slot.gate.mark_ready()
        return ViewBatch(slot, count, self.depth_scale, host, self.group.colors)

    def _gather(self, snapshot: Snapshot, views: Any, truth: TruthBuffers) -> None:
        objects, ids = (views.count, self.instances), self.renderer.scene.obj_id
        launch(gather_cameras_kernel, views.count, snapshot=snapshot.frames, views=views, truth=truth.bundle)
        launch(gather_objects_kernel, objects, snapshot, views=views, object_ids=ids, truth=truth.bundle)
