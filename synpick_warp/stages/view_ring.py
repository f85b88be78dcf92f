"""Ring of batches of views of one image size: renders and encodes views, and copies them to the host asynchronously; which images are
copied, and which are replaced by encoded files or run boundaries.

Run boundaries are the pixels at which a mask changes along a column; its run-length encoding (RLE) follows from them; see `annotate`.

Memory pool of amodal masks: views are split into batches whose masks fit, by upper bounds computed on the host from the poses. A view's
share of the pool is that of some dozens of masks as large as the image; 150 parts in a bin take a fifteenth of it. Views that might take
more are rendered in batches of fewer views, each with room for masks as large as the image, so that no mask can lack words, and the host
never waits for the device.
"""

import math
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import MASK_ROWS
from synpick_warp.configs.calibration.lens import LensMap
from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.schema import Bop, Render
from synpick_warp.kernels.render.visibility.camera import BOX_MARGIN, NEAR_PLANE
from synpick_warp.scenes.cameras import CAMERA_KEYS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages import encoding
from synpick_warp.stages.arrays import allocate, dry_run
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.render.annotate import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from synpick_warp.stages.render.cameras import allocate_lenses, allocate_view_cameras, place_cameras
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.render_streams import RenderStreams
from synpick_warp.stages.timing import scope
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.frames import WORD_BYTES, most_words

# Smallest image height at which the lists of run boundaries, at full length, are no larger than the images that they replace [px].
MIN_LISTED_ROWS = 288
# Polling interval of a copy's event: seconds, or a fraction of the time waited so far, whichever is longer. A batch of 50 full-HD views
# takes 80 ms on an H200, and the next batch is already queued.
PAUSE_SECONDS, PAUSE_FRACTION = 5e-4, 1 / 32
# Longest wait with pauses [s]. A query does not tell a failed copy from an unfinished one, and Warp prints a line for each that fails;
# the synchronisation that comes next raises the error.
MAX_PAUSED_SECONDS = 0.5


class DeviceImages:
    """Images of a batch that stay on the device until they are indexed; implements the protocol `frames.Images`."""

    def __init__(self, array: wp.array) -> None:
        self.array = array

    def __getitem__(self, index: int | tuple[int, slice]) -> np.ndarray:
        """Copy an image, or a part of it, to the host; waits for the device."""
        return self.array[index].numpy()


@dataclass(frozen=True)
class TransferSettings:
    """Which images of a batch are copied to the host, and which are replaced by encoded files or run boundaries."""

    on_demand: tuple[str, ...] = ()
    """Arrays of `ViewBuffers` that stay on the device: files or run boundaries are copied instead; single ones can still be indexed."""
    jpeg_quality: int = 0
    """Quality of the JPEG files that the device encodes and that are copied instead of colour images; 0: none."""
    depth_files: bool = False
    """Whether the device encodes depth as PNG data (IDAT), copied instead of depth images, or beside them if these are needed, too."""


def choose_transfers(bop: Bop, height: int, device: wp.Device, needs_images: bool, depth_files: bool) -> TransferSettings:
    """Choose which images of a batch are copied to the host and which stay on the device.

    On the CPU nothing is left out: the arrays are the host's. For an exporter that needs all images, only masks stay on the device. Else
    files and run boundaries replace images; of those lower than MIN_LISTED_ROWS only depth, since lists of run boundaries, capped at the
    size of an image, may overflow, and fetching the image then stalls. Depth files are made on every device: their bytes are the same.
    `height`: rows of an image [px]. `needs_images`: whether an exporter reads all images. `depth_files`: whether an exporter writes depth
    files."""
    if not device.is_cuda:
        return TransferSettings(depth_files=depth_files)
    if needs_images:
        return TransferSettings(("mask_words",) if height >= MIN_LISTED_ROWS else (), depth_files=depth_files)
    # Keypoints read depth: from its file, or from the image if no format has depth files.
    depth = ("depth",) if depth_files or not bop.keypoints else ()
    if height < MIN_LISTED_ROWS:
        return TransferSettings(depth, depth_files=depth_files)
    if bop.color_format != "jpg":
        return TransferSettings((*depth, "instance", "mask_words"), depth_files=depth_files)
    return TransferSettings((*depth, "color", "instance", "mask_words"), bop.jpeg_quality, depth_files)


class HostCopy:
    """Host mirror of device arrays: asynchronous copies into pinned memory on CUDA; on a CPU by default the arrays themselves."""

    def __init__(self, arrays: list[wp.array], target: list[wp.array] | None = None) -> None:
        """`arrays`: arrays of one device. `target`: arrays on the host that they are copied to, pinned for a GPU; None: new ones for a GPU,
        on a CPU the arrays themselves."""
        self.source = arrays
        self.device = arrays[0].device
        if target is None:
            is_cuda = self.device.is_cuda
            target = [wp.empty(a.shape, dtype=a.dtype, device="cpu", pinned=True) for a in arrays] if is_cuda else arrays
        self.target = target
        self.done = wp.Event(self.device) if self.device.is_cuda else None

    def start(self, stream: wp.Stream | None) -> None:
        """Begin to copy on `stream` (None: the current one), after the work queued on the current one. On a CPU copies are synchronous."""
        if self.target is self.source:
            return
        if self.done is None:
            for target, source in zip(self.target, self.source, strict=True):
                wp.copy(target, source)
            return
        if stream is None:
            stream = self.device.stream
        else:
            stream.wait_stream(self.device.stream)
        for target, source in zip(self.target, self.source, strict=True):
            wp.copy(target, source, stream=stream)
        stream.record_event(self.done)

    @property
    def is_done(self) -> bool:
        """Whether the copies that were started are done."""
        return self.done is None or self.done.is_complete

    def wait(self) -> list[np.ndarray]:
        """Wait for the copies and return them as NumPy arrays (views, no further copy)."""
        if self.done is not None:
            wait_event(self.done)
        return [array.numpy() for array in self.target]


def wait_event(event: wp.Event) -> None:
    """Wait for an event with pauses: `wp.synchronize_event` alone keeps a core busy, since CUDA spins."""
    started = time.monotonic()
    while not event.is_complete and (waited := time.monotonic() - started) < MAX_PAUSED_SECONDS:
        time.sleep(max(PAUSE_SECONDS, PAUSE_FRACTION * waited))
    wp.synchronize_event(event)


SHARE = 32
"""Pool size per view, in full-image masks: 32 bits a pixel."""
ROUNDING = 1.0
"""Additional margin of the bounds [px], since the device computes boxes in float32."""
# Size of one batch's images on a GPU [bytes]: large enough to fill the GPU, small enough for several batches in flight.
BATCH_BYTES = 512 << 20
# Size of color, depth and segmentation id of one pixel, and size that amodal masks are counted with at least [bytes].
PIXEL_BYTES, MASK_BYTES = 3 + 2 + 1, SHARE // 8
# Ring size of view batches: one is read while another is copied and a third is rendered.
RING = 3


def views_per_batch(render: Render, rig: Rig, worlds: int, objects: int, device: wp.Device, group: int = 0) -> int:
    """Number of views of a group of cameras rendered at once: as set; else on a CPU one world's, on a GPU what the group's share of
    BATCH_BYTES holds, up to all worlds'."""
    cameras = rig.groups[group]
    views = len(cameras)
    if render.views_per_batch:
        return render.views_per_batch
    if not device.is_cuda:
        return views
    width, height = rig.sizes[cameras[0]]
    with dry_run() as layers:
        allocate(LayerBuffers, {"view": 1, "row": height, "column": width}, device, rig.chosen(cameras[0], render.layers))
    counted = objects if rig.bends(cameras) else min(objects, SHARE)
    masks = max(width * height * MASK_BYTES, counted * most_words(width, height) * WORD_BYTES)
    each = width * height * PIXEL_BYTES + masks + sum(layer.row[3] for layer in layers)
    pixels = sum(map(math.prod, rig.sizes))
    return max(1, min(BATCH_BYTES * views * width * height // (pixels * each), views * worlds))


def view_sizes(render: Render, rig: Rig, worlds: int, objects: int, device: wp.Device, group: int = 0) -> dict[str, int]:
    """Extents of `ViewBuffers` and `LayerBuffers` of a group of cameras, for `worlds` worlds of at most `objects` objects."""
    cameras, views = rig.groups[group], views_per_batch(render, rig, worlds, objects, device, group)
    size = rig.sizes[cameras[0]]
    sizes = view_buffer_sizes(views, *size, objects)
    return sizes if rig.bends(cameras) else sizes | {"mask_word": share_words(views, objects, *size)}


ViewExtrinsics = tuple[dict[str, Any], Mapping[str, Any]]
"""Matrix, rotation and translation of the cameras of views as `FrameBatch` has them, in this frame and in the one before."""


def history_count(rig: Rig, worlds: int, group: int = 0) -> int:
    """Number of light histories of a group of cameras, one a world and camera; 0: none is averaged, as cameras move or leave frames out, or
    episodes have one frame."""
    cameras = rig.groups[group]
    return 0 if rig.still or rig.moves(cameras[0]) or rig.every[cameras[0]] > 1 else worlds * len(cameras)


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """Cameras of one image size, which are rendered together; see `Rig.groups`."""

    cameras: tuple[int, ...]
    """Their indices; their order is that of the cameras in the renderer's scene."""
    sizes: dict[str, int]
    """Extents by `view_sizes`."""
    renderer: Renderer
    placed: bool = False
    """Whether each view has a matrix and pose of its own, as of `Rig.is_placed`."""
    moves: bool = False
    """Whether the cameras move within an episode, as of `Rig.moves`."""
    every: int = 1
    """Frames from one picture to the next."""
    colors: bool = True
    """Whether they have colour images."""
    lenses: tuple[LensMap | None, ...] = ()
    """Lens of each camera (None: a pinhole) if episodes draw camera matrices; none: the scene has those of all views."""
    bounds: "MaskBounds | None" = None
    """Bounds of the words of views' masks; None: any masks fit a view's share of the pool."""

    def slots(self, camera: np.ndarray) -> np.ndarray:
        """Row of cameras in the renderer's scene (view) int32, by their indices (view)."""
        return np.searchsorted(np.array(self.cameras), camera).astype(np.int32)

    def allocate_cameras(self) -> tuple[Any, Any] | None:
        """Allocate cameras of a batch in this frame and the one before, the same if fixed; None: the scene has those of all views."""
        if not self.placed:
            return None
        scene, views = self.renderer.scene, self.sizes["view"]
        now, last = (allocate_view_cameras(views, scene.device, scene.cameras) for _ in range(2))
        if self.lenses:
            now.lenses = allocate_lenses(self.sizes, scene.device)
        return now, last if self.moves else now

    def write_views(
        self, lists: wp.array, world: np.ndarray, camera: np.ndarray, made: tuple[Any, Any] | None, placed: ViewExtrinsics
    ) -> Any:
        """The struct `Views` of views of these cameras (world, camera), whose indices are written to `lists` (3, view) int32. `made`: as of
        `allocate_cameras`; written. `placed`: what its cameras are set to."""
        slot = self.slots(camera)
        padded = np.zeros(lists.shape, np.int32)
        padded[1] = self.cameras[0]
        padded[:, : len(world)] = world, camera, slot
        lists.assign(padded)
        if made is not None:
            place_cameras(made[0], self.renderer.scene.cameras, slot, placed[0], self.lenses)
            if self.moves:
                place_cameras(made[1], self.renderer.scene.cameras, slot, placed[1])
        return make_views(lists[0], lists[1], len(world), self.sizes["instance"], slot=lists[2])


@dataclass(frozen=True, eq=False)
class BatchBuffers:
    """Device arrays of a batch of views in the ring: images, layers, and what is encoded of them."""

    images: ViewBuffers
    boundaries: BoundaryBuffers
    layers: LayerBuffers
    jpeg: encoding.JpegBuffers | None
    depth: encoding.DepthBuffers | None

    def copied(self, on_demand: Collection[str]) -> dict[str, wp.array]:
        """Arrays that are copied to the host, by name: all but `on_demand`."""
        parts = [part for part in (self.images, self.boundaries, self.jpeg, self.depth, self.layers) if part is not None]
        arrays = {item.name: getattr(part, item.name) for part in parts for item in fields(part)}
        return {name: array for name, array in arrays.items() if name not in on_demand and array is not None}


Scratch = tuple[BoundaryScratch, encoding.JpegScratch | None, tuple[encoding.DepthScratch, Any, Any] | None]
"""Scratch of run boundaries and encoders (see `allocate_depth_scratch`), which all batches of the ring share."""


def allocate_ring(
    sizes: dict[str, int], layers: Collection[str], host: TransferSettings, device: wp.Device
) -> tuple[list[BatchBuffers], Scratch]:
    """Allocate a ring of batches, on a CPU a single one, and the scratch of encoding; arguments as of `FrameStream`."""
    frame, boundaries = (sizes["view"], sizes["column"], sizes["row"]), boundary_sizes(sizes)
    ring = [
        BatchBuffers(
            allocate(ViewBuffers, sizes, device),
            allocate(BoundaryBuffers, boundaries, device),
            allocate(LayerBuffers, sizes, device, layers),
            allocate(encoding.JpegBuffers, encoding.jpeg_sizes(*frame), device) if host.jpeg_quality else None,
            allocate(encoding.DepthBuffers, encoding.depth_sizes(*frame), device) if host.depth_files else None,
        )
        for _ in range(RING if device.is_cuda else 1)
    ]
    jpeg = allocate(encoding.JpegScratch, encoding.jpeg_sizes(*frame), device) if host.jpeg_quality else None
    depth = encoding.allocate_depth_scratch(*frame, device) if host.depth_files else None
    return ring, (allocate(BoundaryScratch, boundaries, device), jpeg, depth)


class ViewRing:
    """Batches of a group's views: on a GPU up to two are in flight while one is consumed."""

    def __init__(self, group: CameraGroup, layers: Collection[str], device: wp.Device, host: TransferSettings | None = None) -> None:
        """Allocate the ring of batches. `group`: cameras and their renderer. `layers`: names of the layers to render. `device`: device of
        rendering. `host`: which images are copied to the host; None: all."""
        sizes = group.sizes
        self.group, self.cameras, self.renderer = group, group.cameras, group.renderer
        self.host = host or TransferSettings()
        self.batch, self.instances = sizes["view"], sizes["instance"]
        self.device = device
        self.layers = [item.name for item in fields(LayerBuffers) if item.name in layers]
        self.slots, (self.boundary_scratch, jpeg, depth) = allocate_ring(sizes, layers, self.host, device)
        frame = (sizes["column"], sizes["row"])
        self.compressor = encoding.Compressor(jpeg, *frame, self.host.jpeg_quality) if jpeg is not None else None
        self.depth_encoder = encoding.DepthEncoder(depth, *frame) if depth is not None else None
        copied = [batch.copied(self.host.on_demand) for batch in self.slots]
        self.images = [name for name in copied[0] if name not in self.layers]
        self.copies = [HostCopy(list(arrays.values())) for arrays in copied]
        self.lists = [wp.zeros((3, self.batch), dtype=wp.int32, device=device) for _ in self.slots]
        self.view_cameras = [group.allocate_cameras() for _ in self.slots]
        self.divided = [batch.images for batch in self.slots]
        """Images of each slot, with its pool of mask words as it is divided among the views."""
        self._next = 0

    def launch(
        self, snapshot: Snapshot, world: np.ndarray, camera: np.ndarray, streams: RenderStreams, placed: ViewExtrinsics, wide: bool = False
    ) -> int:
        """Render the views (world, camera) of a snapshot into the next slot, then start to encode and copy the images; returns the slot.

        `placed`: as of `CameraGroup.write_views`. `wide`: the pool of mask words is divided by `widen`.
        """
        slot, count = self._next, len(world)
        images = self.divided[slot] = widen(self.slots[slot].images) if wide else self.slots[slot].images
        self._next = (slot + 1) % len(self.slots)
        cameras = self.view_cameras[slot]
        views = self.group.write_views(self.lists[slot], world, camera, cameras, placed)
        with wp.ScopedStream(streams.render, sync_exit=True), scope("render", self.device):
            self.renderer.render(snapshot, views, images, self.slots[slot].layers, cameras)
        with wp.ScopedStream(streams.copy):
            with scope("encode", self.device):
                self._encode(slot, count)
            self.copies[slot].start(streams.copy)
        return slot

    def _encode(self, slot: int, count: int) -> None:
        """Encode `count` views of a slot, on the device: run boundaries of ids and amodal masks, and JPEG and PNG data where
        these are enabled. Starts no copy; `launch` does.

        Runs on the copy stream: after these views are rendered, beside the rendering of the next batch. Batches share one scratch; the
        order of this stream protects it.
        """
        batch = self.slots[slot]
        list_boundaries(self.boundary_scratch, count, self.divided[slot], batch.boundaries)
        if self.compressor is not None and batch.jpeg is not None and self.group.colors:
            self.compressor.compress(count, batch.images, batch.jpeg)
        if self.depth_encoder is not None and batch.depth is not None:
            self.depth_encoder.encode(batch.images.depth, count, batch.depth)

    def wait(self, slot: int) -> list[np.ndarray]:
        """Wait for the copies of a slot."""
        return self.copies[slot].wait()

    def collect(self, slot: int, count: int) -> dict[str, Any]:
        """Wait for the copies of a slot; returns the images of its `count` views as fields of `FrameBatch`."""
        with scope("wait for images"):
            copied = self.wait(slot)
        images, arrays = self.divided[slot], dict(zip(self.images + self.layers, copied, strict=True))
        views, words = images.mask_words.shape
        if "mask_words" in arrays:
            arrays["mask_words"] = arrays["mask_words"].reshape(-1)[: views * words].reshape(views, words)
        arrays = {name: array[:count] for name, array in arrays.items()}
        if (arrays["mask_length"] > words).any():
            raise RuntimeError("masks take more words than their bound; this is an error of synpick-warp, please report it")
        return {
            **{name: arrays[name] for name in self.images},
            **{name: DeviceImages(getattr(images, name)) for name in self.host.on_demand},
            "layers": {name: arrays[name] for name in self.layers},
        }


def share_words(views: int, instances: int, width: int, height: int) -> int:
    """A view's share of the pool [words]: that of SHARE masks as large as the image, and more in batches of so few views that the masks of
    a single one would not fit into their pool."""
    return most_words(width, height) * max(min(instances, SHARE), -(-instances // views))


def widen(images: ViewBuffers) -> ViewBuffers:
    """The same buffers with the pool divided among fewer views, so that every mask may cover the whole image."""
    height, width = images.instance.shape[1:]
    share = images.mask_first.shape[1] * most_words(width, height)
    pool: Any = images.mask_words.flatten()
    views = pool.size // share
    return replace(images, mask_words=pool[: views * share].reshape((views, share)))


@dataclass(frozen=True, eq=False)
class MaskBounds:
    """Upper bounds of the mask words of views, from bounding spheres about the objects' origins; for cameras without lens distortion."""

    radius: np.ndarray
    """Radius of each object's bounding sphere; the last entry is negative and stands for an empty slot (entry + 1) [m]."""
    cameras: Mapping[str, np.ndarray]
    """Matrices and poses of the cameras, by CAMERA_KEYS (slot, ...)."""
    size: tuple[int, int]
    """Width and height of the images [px]."""

    @classmethod
    def of(cls, meshes: Any, cameras: Sequence[Camera]) -> "MaskBounds":
        """Bounds for the objects of the struct `Meshes`, and the cameras of a group."""
        corner = np.abs(np.stack((meshes.lower.numpy(), meshes.upper.numpy()))).max(axis=0)[: meshes.entries].astype(np.float64)
        placed = {key: np.stack([getattr(camera, key) for camera in cameras]) for key in CAMERA_KEYS}
        return cls(np.append(np.linalg.norm(corner, axis=1), -1.0), placed, cameras[0].resolution)

    def count_words(self, index: np.ndarray, pose: np.ndarray, cameras: Mapping[str, np.ndarray]) -> np.ndarray:
        """Upper bound of the words of each view's masks (B) int64, from the object of each instance, -1: none (B, I) int32, its pose to the
        world: x, y, z [m], quaternion x, y, z, w (B, I, 7), and matrix and pose of each view's camera, by CAMERA_KEYS (B, ...)."""
        matrix, rotation, translation = (cameras[key] for key in CAMERA_KEYS)
        x, y, z = np.moveaxis(matmul(pose[..., :3], rotation.swapaxes(1, 2)) + translation[:, None], -1, 0)
        radius = self.radius[index]
        near = np.maximum(z - radius, NEAR_PLANE)
        far = np.maximum(z + radius, near)
        sides = []
        for axis, (at, extent) in enumerate(zip((x, y), self.size, strict=True)):
            focal, middle = (matrix[:, axis, column][:, None] for column in (axis, 2))
            low = focal * np.minimum((at - radius) / near, (at - radius) / far) + middle - BOX_MARGIN - ROUNDING
            high = focal * np.maximum((at + radius) / near, (at + radius) / far) + middle + BOX_MARGIN + ROUNDING
            sides.append(np.floor(np.clip(high, -1, extent - 1)) - np.floor(np.clip(low, 0, extent)) + 1)
        columns, rows = (np.nan_to_num(np.maximum(side, 0)).astype(np.int64) for side in sides)
        # Written so that it holds of no pose that is not a number.
        is_before = z - radius > 2.0 * NEAR_PLANE
        words = np.where(is_before, columns * -(-rows // MASK_ROWS), most_words(*self.size))
        return np.where((radius < 0) | (z + radius <= 0), 0, words).sum(axis=1)


def split_batches(words: np.ndarray, share: int, views: int, wide: int) -> Iterator[tuple[slice, bool]]:
    """Split views into batches, in their order: a slice of each, and whether it is one of few views with room for all of their masks.

    `words` are upper bounds of the words of each view (B), `share` is a view's share of the pool [words], and `views` and `wide` are the
    most views of a batch, and of one with room for all masks."""
    large, first = words > share, 0
    while first < len(words):
        most = wide if large[first] else views
        same = large[first : first + most] == large[first]
        past = first + (same.size if same.all() else int(same.argmin()))
        yield slice(first, past), bool(large[first])
        first = past
