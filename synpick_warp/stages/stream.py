"""Frame stream: renders snapshots in batches of views and copies them to the host asynchronously, as FrameBatches."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import Measure, Status, column_names
from synpick_warp.configs.rig import Rig
from synpick_warp.configs.schema import Render
from synpick_warp.stages.arrays import allocate, dry_run
from synpick_warp.stages.buffers import LayerBuffers, Snapshot, ViewBuffers, view_buffer_sizes
from synpick_warp.stages.encoding.jpeg import Compressor, JpegBuffers, JpegScratch, jpeg_sizes
from synpick_warp.stages.encoding.png import DepthBuffers, DepthEncoder, DepthScratch, allocate_depth_scratch, depth_sizes
from synpick_warp.stages.host_copies import DeviceImages, HostCopy, HostImages
from synpick_warp.stages.render.mask_runs import BoundaryBuffers, BoundaryScratch, boundary_sizes, list_boundaries
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views, pair_views
from synpick_warp.stages.render_streams import RenderStreams
from synpick_warp.stages.sim.simulate import TickRecord
from synpick_warp.stages.sim.step_log import host_record, record_arrays, tick_measures
from synpick_warp.stages.timing import scope
from synpick_warp.views.frames import FrameBatch, SelectedRows, TickBatch

# Size of one batch's images on a GPU [bytes]: large enough to fill the GPU, small enough for several batches in flight.
BATCH_BYTES = 512 << 20
# Size of color, depth, segmentation id and amodal bits of one pixel [bytes].
PIXEL_BYTES = 3 + 2 + 1 + 4
# Names of the snapshot's arrays that are copied to `TickReport.snapshot`.
_SNAPSHOT = ("fixture_pose", "fixture_visible", "light", "light_yaw", "light_exposure")
# Ring size of view batches: one is read while another is copied and a third is rendered.
RING = 3


def views_per_batch(render: Render, rig: Rig, worlds: int, device: wp.Device) -> int:
    """Number of views rendered at once: as set; else on a CPU one world's, on a GPU what BATCH_BYTES hold, up to all worlds'."""
    views = len(rig)
    if render.views_per_batch:
        return render.views_per_batch
    if not device.is_cuda:
        return views
    width, height = rig.largest
    with dry_run() as layers:
        allocate(LayerBuffers, {"view": 1, "row": height, "column": width}, device, render.layers)
    each = width * height * PIXEL_BYTES + sum(layer.row[3] for layer in layers)
    return max(1, min(BATCH_BYTES // each, views * worlds))


def view_sizes(render: Render, rig: Rig, worlds: int, objects: int, device: wp.Device) -> dict[str, int]:
    """Extents of the dimensions of `ViewBuffers` and `LayerBuffers`, for `worlds` worlds of at most `objects` objects."""
    return view_buffer_sizes(views_per_batch(render, rig, worlds, device), *rig.largest, objects)


@dataclass(frozen=True, eq=False)
class TickReport:
    """Results of one tick on the host, one row a world: status, measures, objects (-1: none), object-to-world poses [m], perception, and
    recorded physics (empty: not recorded).
    """

    status: np.ndarray
    """Status rows (world, status) int32; columns: `Status`."""
    measures: np.ndarray
    """Rows of real numbers (world, measure) float32; columns: `Measure`."""
    catalog_index: np.ndarray
    """Object of each instance; -1: none (world, instance) int32."""
    pose: np.ndarray
    """Object to world: x, y, z [m], quaternion x, y, z, w (world, instance, 7) float32."""
    observation: SimpleNamespace
    """Arrays of `Observation` by name, in its shapes; components of vectors are the last dimension. State after perception."""
    plan: SimpleNamespace
    """Arrays of `Plan`, likewise."""
    snapshot: SimpleNamespace = field(default_factory=SimpleNamespace)
    """Arrays of `Snapshot` that are not listed above, likewise."""
    tick: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays (world, ...) for `TickBatch.tick`, by name; empty unless physics is recorded."""
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays (world, step, ...) for `TickBatch.steps`, likewise."""

    def column(self, name: str) -> np.ndarray:
        """Column of the status rows by its name, such as "phase" or "attached" (world) int32."""
        return self.status[:, column_names(Status)[name]]

    def measure(self, name: str) -> np.ndarray:
        """Column of the measures by its name, such as "peak_force" (world) float32."""
        return self.measures[:, column_names(Measure)[name]]


@dataclass(frozen=True, eq=False)
class LightTable:
    """Environment maps: name, and unit direction towards the first lamp (the sun, or else the strongest light) before the map is rotated;
    zero: the map has none.
    """

    name: np.ndarray
    """Name (light) str."""
    direction: np.ndarray
    """Unit vector towards the first lamp (the sun, or the strongest) of the unrotated map (light, 3) float32; zero: none."""

    def directions(self, light: np.ndarray, yaw: np.ndarray) -> np.ndarray:
        """Directions to the first lamps in the world (..., 3) float32 of maps `light` (...) with yaw `yaw` (...) [rad]."""
        x, y, z = np.moveaxis(self.direction[light].astype(np.float64), -1, 0)
        c, s = np.cos(yaw), np.sin(yaw)
        return np.stack([c * x - s * y, s * x + c * y, z], axis=-1).astype(np.float32)


def name_lights(names: list[str], lights: Any) -> LightTable:
    """Build the table of environment maps from their names and the struct `Lights`."""
    return LightTable(np.array(names), lights.lamp.numpy()[:, 0, 0, :3].astype(np.float32))


class TickReader:
    """Copies the results of a tick to the host, except images: some kilobytes a world."""

    def __init__(self, record: TickRecord, target: list[wp.array] | None = None) -> None:
        """
        Args:
            record: Record of each tick.
            target: Arrays on the host for copies of `reported`; None: on a GPU the reader's own, on a CPU the record's.
        """
        self.parts = _reported_parts(record)
        self.physics = record_arrays(record.physics) if record.physics is not None else []
        self.copy = HostCopy(self.reported(record), target)

    @staticmethod
    def reported(record: TickRecord) -> list[wp.array]:
        """Arrays of a record that a report copies to the host."""
        first = [record.status.table, record.status.measures, record.snapshot.catalog_index, record.snapshot.pose]
        arrays = first + [getattr(part, name) for part, names in _reported_parts(record) for name in names]
        return arrays + (record_arrays(record.physics) if record.physics is not None else [])

    def start(self) -> None:
        """Begin to copy the results of the tick."""
        self.copy.start(None)

    def phase(self) -> np.ndarray | None:
        """Phases of the worlds (world) int32, valid until the next copy begins; None: the copy is not done."""
        return self.copy.target[0].numpy()[:, column_names(Status)["phase"]] if self.copy.is_done else None

    def wait(self) -> TickReport:
        """Wait for the copy; returns the report.

        It owns its arrays, except `tick` and `steps`, which are overwritten when the next copy begins (on a CPU without host arrays
        `target` there is no copy: when the next tick runs).
        """
        copied = self.copy.wait()
        last = len(copied) - len(self.physics)
        arrays = iter([array.copy() for array in copied[:last]])
        first = [next(arrays) for _ in range(4)]
        report = TickReport(*first, *(SimpleNamespace(**{name: next(arrays) for name in names}) for _, names in self.parts))
        if not self.physics:
            return report
        tick, steps = host_record(copied[last:], report.catalog_index.shape[1])
        columns = dict(zip(column_names(Status), report.status.T, strict=True))
        columns |= dict(zip(column_names(Measure), report.measures.T, strict=True))
        return replace(report, tick=tick | tick_measures(columns, report.catalog_index.shape[1]), steps=steps)


def read_tick(record: TickRecord) -> TickReport:
    """Copy the results of a tick to the host, and wait for them."""
    reader = TickReader(record)
    reader.start()
    return reader.wait()


def _reported_parts(record: TickRecord) -> list[tuple[Any, list[str]]]:
    """Parts of a record that become namespaces of a report, each with the names of the arrays that are copied."""
    parts: list[tuple[Any, list[str]]] = [(part, [item.name for item in fields(part)]) for part in (record.observation, record.plan)]
    return [*parts, (record.snapshot, list(_SNAPSHOT))]


def tick_batch(report: TickReport, object_ids: np.ndarray, tick_time: float) -> TickBatch:
    """Select the frames of a tick, in order of worlds; without live worlds the batch is empty. It is valid as long as the report.

    Args:
        report: Report of the tick.
        object_ids: obj_id of each catalog entry (entry) int32.
        tick_time: Time between two frames [s].
    """
    live = np.flatnonzero(report.column("live"))
    frame = report.column("frame")[live]
    return TickBatch(
        episode=report.column("episode")[live],
        frame=frame,
        time=frame * tick_time,
        object_id=np.append(object_ids, -1).astype(np.int32)[report.catalog_index[live]],
        pose=report.pose[live],
        tick=SelectedRows(report.tick, live),
        steps=SelectedRows(report.steps, live),
        **{name: getattr(report.snapshot, name)[live] for name in _SNAPSHOT},
    )


def describe_views(
    report: TickReport, world: np.ndarray, camera: np.ndarray, tick_time: float, object_ids: np.ndarray, lights: LightTable
) -> dict[str, Any]:
    """Fields of `FrameBatch` for B views, without images: episode, camera, frame, time [s], object ids, poses; name, yaw, exposure and
    direction of the light.

    Args:
        report: Report of the tick.
        world: World of each view (B) int32.
        camera: Camera of each view (B) int32.
        tick_time: Time between two frames [s].
        object_ids: obj_id of each catalog entry, and behind them -1 for none (entry + 1) int32.
        lights: Table of the environment maps.
    """
    frame = report.column("frame")[world]
    light, yaw = report.snapshot.light[world], report.snapshot.light_yaw[world]
    return {
        "episode": report.column("episode")[world],
        "camera": camera,
        "frame": frame,
        "time": frame * tick_time,
        "object_id": object_ids[report.catalog_index[world]],
        "pose": report.pose[world],
        "light_name": lights.name[light],
        "light_yaw": yaw,
        "light_exposure": report.snapshot.light_exposure[world],
        "light_direction": lights.directions(light, yaw),
    }


@dataclass(frozen=True, eq=False)
class BatchBuffers:
    """Device arrays of a batch of views in the ring: images, layers, and what is encoded of them."""

    images: ViewBuffers
    boundaries: BoundaryBuffers
    layers: LayerBuffers
    jpeg: JpegBuffers | None
    depth: DepthBuffers | None

    def copied(self, on_demand: Collection[str]) -> dict[str, wp.array]:
        """Arrays that are copied to the host, by name: all but `on_demand`."""
        parts = [part for part in (self.images, self.boundaries, self.jpeg, self.depth, self.layers) if part is not None]
        arrays = {item.name: getattr(part, item.name) for part in parts for item in fields(part)}
        return {name: array for name, array in arrays.items() if name not in on_demand and array is not None}


Scratch = tuple[BoundaryScratch, JpegScratch | None, tuple[DepthScratch, Any, Any] | None]
"""Scratch of run boundaries and encoders (see `allocate_depth_scratch`), which all batches of the ring share."""


def allocate_ring(
    sizes: dict[str, int], layers: Collection[str], host: HostImages, device: wp.Device
) -> tuple[list[BatchBuffers], Scratch]:
    """Allocate a ring of batches, on a CPU a single one, and the scratch of encoding; arguments as of `FrameStream`."""
    frame, boundaries = (sizes["view"], sizes["column"], sizes["row"]), boundary_sizes(sizes)
    ring = [
        BatchBuffers(
            allocate(ViewBuffers, sizes, device),
            allocate(BoundaryBuffers, boundaries, device),
            allocate(LayerBuffers, sizes, device, layers),
            allocate(JpegBuffers, jpeg_sizes(*frame), device) if host.jpeg_quality else None,
            allocate(DepthBuffers, depth_sizes(*frame), device) if host.depth_files else None,
        )
        for _ in range(RING if device.is_cuda else 1)
    ]
    jpeg = allocate(JpegScratch, jpeg_sizes(*frame), device) if host.jpeg_quality else None
    depth = allocate_depth_scratch(*frame, device) if host.depth_files else None
    return ring, (allocate(BoundaryScratch, boundaries, device), jpeg, depth)


@dataclass(eq=False)
class _Launched:
    """Batch in flight, which the device renders, encodes and copies: ring slot, number of views, description, and what to call when it is
    consumed.
    """

    slot: int
    """Index of the slot of the batch in the ring."""
    count: int
    """Number of views in use."""
    description: dict[str, Any]
    """Fields of `FrameBatch` by `describe_views`."""
    finished: Callable[[], None] | None = None
    """Called once the consumer is done with the batch."""


class FrameStream:
    """Renders the live worlds of snapshots as FrameBatches, in a ring: on a GPU up to two batches are in flight while one is consumed."""

    def __init__(
        self,
        sizes: dict[str, int],
        layers: Collection[str],
        cameras: int,
        tick_time: float,
        renderer: Renderer,
        object_ids: np.ndarray,
        lights: LightTable,
        device: wp.Device,
        host: HostImages | None = None,
    ) -> None:
        """Allocate the ring of batches.

        Args:
            sizes: Extents by `view_sizes`.
            layers: Names of the layers to render.
            cameras: Count of cameras.
            tick_time: Time between two frames [s].
            renderer: Renderer and annotator of views.
            object_ids: obj_id of each catalog entry (entry) int32.
            lights: Table of the environment maps.
            device: Device of rendering.
            host: Which images are copied to the host; None: all.
        """
        self.renderer = renderer
        self.host = host or HostImages()
        self.object_ids = np.append(object_ids, -1).astype(np.int32)
        self.lights = lights
        self.cameras = cameras
        self.tick_time = tick_time
        self.batch, self.instances = sizes["view"], sizes["instance"]
        self.device = device
        self.streams = RenderStreams(device)
        self.layers = [item.name for item in fields(LayerBuffers) if item.name in layers]
        self.ring, (self.boundary_scratch, jpeg, depth) = allocate_ring(sizes, layers, self.host, device)
        frame = (sizes["column"], sizes["row"])
        self.compressor = Compressor(jpeg, *frame, self.host.jpeg_quality) if jpeg is not None else None
        self.depth_encoder = DepthEncoder(depth, *frame) if depth is not None else None
        copied = [batch.copied(self.host.on_demand) for batch in self.ring]
        self.images = [name for name in copied[0] if name not in self.layers]
        self.copies = [HostCopy(list(arrays.values())) for arrays in copied]
        self.lists = [wp.zeros((2, self.batch), dtype=wp.int32, device=device) for _ in self.ring]
        self.in_flight: deque[_Launched] = deque()
        self.next_slot = 0

    def render(self, snapshot: Snapshot, report: TickReport) -> Iterator[FrameBatch]:
        """Yield the tick's views, world by world and camera by camera. A batch is valid until the next one is requested."""
        while self.in_flight:
            # Left by a consumer that stopped early.
            self.copies[self.in_flight.popleft().slot].wait()
        yield from self.advance(snapshot, report)
        yield from self.drain()

    def advance(self, snapshot: Snapshot, report: TickReport, finished: Callable[[], None] = lambda: None) -> Iterator[FrameBatch]:
        """Render a tick's views in batches; yield finished batches, oldest first: one whenever no slot of the ring is free, and after the
        last launch all of earlier ticks.

        On a GPU the tick's last batches stay in flight, so that the device has work between ticks; `drain` yields them. A batch is valid
        until the next one is requested.

        Args:
            snapshot: State of the worlds; reused after the rendering in the order of the device's stream.
            report: Report of the tick.
            finished: Called once the consumer is done with the tick's last batch (it requests the next one); ticks finish in order.
        """
        live = np.flatnonzero(report.column("live"))
        world, camera = pair_views(live, np.arange(self.cameras))
        ahead = 0
        for first in range(0, len(world), self.batch):
            if len(self.in_flight) == len(self.ring):
                yield from self._deliver()
            part = slice(first, min(first + self.batch, len(world)))
            self._launch(self.next_slot, snapshot, world[part], camera[part])
            description = describe_views(report, world[part], camera[part], self.tick_time, self.object_ids, self.lights)
            self.in_flight.append(_Launched(self.next_slot, part.stop - first, description))
            self.next_slot = (self.next_slot + 1) % len(self.ring)
            ahead += int(self.device.is_cuda)
        if len(world):
            self.in_flight[-1].finished = finished
        while len(self.in_flight) > ahead:
            yield from self._deliver()
        if not len(world):
            finished()

    def drain(self) -> Iterator[FrameBatch]:
        """Yield the batches that are still in flight."""
        while self.in_flight:
            yield from self._deliver()

    def _deliver(self) -> Iterator[FrameBatch]:
        """Wait for the oldest batch in flight, yield it, and call its `finished` afterwards."""
        launched = self.in_flight.popleft()
        yield self._collect(launched)
        if launched.finished is not None:
            launched.finished()

    def _launch(self, slot: int, snapshot: Snapshot, world: np.ndarray, camera: np.ndarray) -> None:
        """Render the views (world, camera) of a snapshot into a slot of the ring, then start to encode and copy the images."""
        rows = self.lists[slot]
        padded = np.zeros((2, self.batch), dtype=np.int32)
        padded[:, : len(world)] = world, camera
        rows.assign(padded)
        views = make_views(rows[0], rows[1], len(world), self.instances)
        with wp.ScopedStream(self.streams.render, sync_exit=True), scope("render", self.device):
            self.renderer.render(snapshot, views, self.ring[slot].images, self.ring[slot].layers)
        with wp.ScopedStream(self.streams.copy):
            with scope("encode", self.device):
                self._encode(slot, len(world))
            self.copies[slot].start(self.streams.copy)

    def _encode(self, slot: int, count: int) -> None:
        """Encode `count` views of a slot, on the device: run boundaries of the instance and amodal images, and JPEG and PNG data where
        these are enabled. Starts no copy; `_launch` does.

        Runs on the copy stream: after these views are rendered, beside the rendering of the next batch. Batches share one scratch; the
        order of this stream protects it.
        """
        batch = self.ring[slot]
        list_boundaries(self.boundary_scratch, count, batch.images, batch.boundaries)
        if self.compressor is not None and batch.jpeg is not None:
            self.compressor.compress(count, batch.images, batch.jpeg)
        if self.depth_encoder is not None and batch.depth is not None:
            self.depth_encoder.encode(batch.images.depth, count, batch.depth)

    def _collect(self, launched: _Launched) -> FrameBatch:
        """Wait for a batch's copies; returns the batch."""
        slot = launched.slot
        with scope("wait for images"):
            copied = self.copies[slot].wait()
        arrays = {name: array[: launched.count] for name, array in zip(self.images + self.layers, copied, strict=True)}
        return FrameBatch(
            **launched.description,
            **{name: arrays[name] for name in self.images},
            **{name: DeviceImages(getattr(self.ring[slot].images, name)) for name in self.host.on_demand},
            layers={name: arrays[name] for name in self.layers},
        )
