"""Ring of view batches on the device: rendered views with their ground truth, which nothing copies to the host."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.images.ground_truth import ViewTruth, expand_masks_kernel, gather_cameras_kernel, gather_objects_kernel
from synpick_warp.stages.arrays import allocate, array_group, device_array
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, masks_of
from synpick_warp.stages.launch import launch
from synpick_warp.stages.online.exchange import DeviceArray, Gate
from synpick_warp.stages.render.view_setup import with_cameras
from synpick_warp.stages.timing import scope
from synpick_warp.stages.view_ring import CameraGroup, widen

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
        instance: Segmentation id of the nearest surface: 0 none, 1 + instance_id, 252 to 255 table and fixtures (`Segment`)
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
        """Allocate the slots.

        Args:
            group: Cameras and their renderer.
            layers: Names of the layers to render.
            depth_scale: Millimetres per count of the depth image.
        """
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
        """Render views into the next slot, whose last batch must have expired.

        Args:
            snapshot: State of the worlds.
            world: World of each view (B) int32, at most `views`.
            camera: Camera of each view (B) int32.
            host: For `ViewBatch.host`.
            last: Their cameras in the tick before, as in `ViewExtrinsics`.
            wide: As of `ViewRing.launch`.
        """
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
        """Launch the kernels that write `truth` for a batch of views."""
        objects, ids = (views.count, self.instances), self.renderer.scene.obj_id
        launch(gather_cameras_kernel, views.count, snapshot=snapshot.frames, views=views, truth=truth.bundle)
        launch(gather_objects_kernel, objects, snapshot, views=views, object_ids=ids, truth=truth.bundle)
