"""Frame stream: renders snapshots in batches of views and copies them to the host asynchronously, as FrameBatches."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.codes import SHAFT, Measure, Status, column_names
from synpick_warp.scenes.cameras import EpisodeCameras
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.view_setup import pair_views
from synpick_warp.stages.render_streams import RenderStreams
from synpick_warp.stages.sim.simulate import TickRecord
from synpick_warp.stages.sim.step_log import host_record, record_arrays, tick_measures
from synpick_warp.stages.view_ring import CameraGroup, HostCopy, ViewExtrinsics, ViewRing, split_batches
from synpick_warp.views.frames import FrameBatch, SelectedRows, TickBatch, most_words

OWN_ARRAYS = 6
"""Arrays that a report copies before those of its namespaces: of `WorldStatus`, then objects and poses."""
# Names of the snapshot's arrays that are copied to `TickReport.snapshot`.
_REPORTED = ("last_fixture_pose",)
"""Further arrays, which `TickBatch` does not have."""
_SNAPSHOT = ("bin", "fixture_pose", "fixture_visible", "light", "light_yaw", "light_exposure")


@dataclass(frozen=True, eq=False)
class TickReport:
    """Results of one tick on the host, one row a world."""

    status: np.ndarray
    """Status rows (world, status) int32; columns: `Status`."""
    measures: np.ndarray
    """Rows of real numbers (world, measure) float32; columns: `Measure`."""
    engaged: np.ndarray
    """Bit sets of the instances that rays hit in the running attempt (world, word) uint32; see `stages.arrays.unpack_words`."""
    attached: np.ndarray
    """Bit sets of the instances that are attached to the gripper, or were picked in this tick (world, word) uint32."""
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
        """Column of the status rows by its name, such as "phase" or "hits" (world) int32."""
        return self.status[:, column_names(Status)[name]]

    def measure(self, name: str) -> np.ndarray:
        """Column of the measures by its name, such as "peak_force" (world) float32."""
        return self.measures[:, column_names(Measure)[name]]


@dataclass(frozen=True, eq=False)
class LightTable:
    """Environment maps: name, and unit direction towards the first lamp (the sun, or else the strongest light) before the map is rotated;
    zero: the map has none."""

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
        """Read each tick's record into `target`, host arrays for `reported`; None: on a GPU the reader's own, on a CPU the record's."""
        self.parts = _reported_parts(record)
        self.physics, self.arrays = record.physics, record_arrays(record.physics) if record.physics is not None else []
        self.copy = HostCopy(self.reported(record), target)

    @staticmethod
    def reported(record: TickRecord) -> list[wp.array]:
        """Arrays of a record that a report copies to the host."""
        first = [getattr(record.status, item.name) for item in fields(record.status)]
        first += [record.snapshot.catalog_index, record.snapshot.pose]
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
        last = len(copied) - len(self.arrays)
        arrays = iter([array.copy() for array in copied[:last]])
        first = [next(arrays) for _ in range(OWN_ARRAYS)]
        report = TickReport(*first, *(SimpleNamespace(**{name: next(arrays) for name in names}) for _, names in self.parts))
        if self.physics is None:
            return report
        tick, steps = host_record(self.physics, copied[last:], report.catalog_index.shape[1])
        columns = dict(zip(column_names(Status), report.status.T, strict=True))
        columns |= dict(zip(column_names(Measure), report.measures.T, strict=True))
        sets = {"engaged": report.engaged, "attached": report.attached}
        return replace(report, tick=tick | tick_measures(columns, sets, report.catalog_index.shape[1]), steps=steps)


def read_tick(record: TickRecord) -> TickReport:
    """Copy the results of a tick to the host, and wait for them."""
    reader = TickReader(record)
    reader.start()
    return reader.wait()


def _reported_parts(record: TickRecord) -> list[tuple[Any, list[str]]]:
    """Parts of a record that become namespaces of a report, each with the names of the arrays that are copied."""
    parts: list[tuple[Any, list[str]]] = [(part, [item.name for item in fields(part)]) for part in (record.observation, record.plan)]
    return [*parts, (record.snapshot, [*_SNAPSHOT, *_REPORTED])]


def tick_batch(report: TickReport, object_ids: np.ndarray, tick_time: float) -> TickBatch:
    """Select the frames of a tick, in order of worlds; without live worlds the batch is empty. It is valid as long as the report.
    `object_ids` has the obj_id of each catalog entry (entry) int32; `tick_time` is the time between two frames [s]."""
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
    report: TickReport,
    world: np.ndarray,
    camera: np.ndarray,
    tick_time: float,
    object_ids: np.ndarray,
    lights: LightTable,
    bins: Sequence[str] = (),
    cameras: EpisodeCameras | None = None,
) -> dict[str, Any]:
    """Fields of `FrameBatch` for B views, without images: episode, camera, frame, time [s], object ids, poses; name, yaw, exposure and
    direction of the light.

    `world` and `camera` of each view are (B) int32; `tick_time` is as of `tick_batch`; `object_ids`, too, but behind them -1 for none
    (entry + 1). `bins` are `Cell.recorded`, empty: without those of the views; `cameras` those of episodes and views, None: without them.
    """
    own = {"bin_name": np.array(bins)[report.snapshot.bin[world]], "bin_pose": report.snapshot.fixture_pose[world, 0]} if bins else {}
    episode, frame = report.column("episode")[world], report.column("frame")[world]
    own |= cameras.of_views(episode, camera, report.snapshot.fixture_pose[world, SHAFT]) if cameras is not None else {}
    light, yaw = report.snapshot.light[world], report.snapshot.light_yaw[world]
    return {
        "episode": episode,
        "camera": camera,
        "frame": frame,
        "time": frame * tick_time,
        "object_id": object_ids[report.catalog_index[world]],
        "pose": report.pose[world],
        "light_name": lights.name[light],
        "light_yaw": yaw,
        "light_exposure": report.snapshot.light_exposure[world],
        "light_direction": lights.directions(light, yaw),
        **own,
    }


def split_views(
    group: CameraGroup, report: TickReport, world: np.ndarray, camera: np.ndarray, cameras: EpisodeCameras | None
) -> Iterator[tuple[slice, bool]]:
    """Split a tick's views (world, camera) of a group into batches, see `split_batches`; other arguments as of `describe_views`."""
    views, share, bounds = group.sizes["view"], group.sizes["mask_word"], group.bounds
    if bounds is None:
        return split_batches(np.zeros(len(world), np.int64), share, views, views)
    placed = cameras.of_views(report.column("episode")[world], camera, report.snapshot.fixture_pose[world, SHAFT]) if cameras else {}
    placed = placed or {key: values[group.slots(camera)] for key, values in bounds.cameras.items()}
    words = bounds.count_words(report.catalog_index[world], report.pose[world], placed)
    return split_batches(words, share, views, views * share // (group.sizes["instance"] * most_words(*bounds.size)))


def describe_batches(
    group: CameraGroup, report: TickReport, world: np.ndarray, camera: np.ndarray, *known: Any, cameras: EpisodeCameras | None
) -> Iterator[tuple[slice, bool, ViewExtrinsics]]:
    """The batches of `split_views`, and in each the views by `describe_views`, with their cameras in the tick before."""
    for part, wide in split_views(group, report, world, camera, cameras):
        views = describe_views(report, world[part], camera[part], *known, cameras=cameras)
        last: dict[str, np.ndarray] = {}
        if cameras is not None:
            last = cameras.of_views(views["episode"], camera[part], report.snapshot.last_fixture_pose[world[part], SHAFT])
        yield part, wide, (views, last)


@dataclass(eq=False)
class _Launched:
    """Batch in flight, rendered, encoded and copied: ring slot, number of views, description, and what to call when it is consumed."""

    ring: ViewRing
    slot: int
    count: int
    description: dict[str, Any]
    """Fields of `FrameBatch` by `describe_views`."""
    finished: Callable[[], None] | None = None


class FrameStream:
    """Renders the live worlds of snapshots as FrameBatches, in a ring for each group of cameras: on a GPU up to two batches of a group are
    in flight while one is consumed."""

    def __init__(
        self,
        rings: Sequence[ViewRing],
        tick_time: float,
        object_ids: np.ndarray,
        lights: LightTable,
        device: wp.Device,
        bins: Sequence[str] = (),
        cameras: EpisodeCameras | None = None,
    ) -> None:
        """Take rings of batches, one for each group of cameras; other arguments as of `tick_batch` and `describe_views`."""
        self.rings = tuple(rings)
        self.object_ids = np.append(object_ids, -1).astype(np.int32)
        self.lights, self.bins, self.cameras = lights, bins, cameras
        self.tick_time = tick_time
        self.device = device
        self.streams = RenderStreams(device)
        self.in_flight: deque[_Launched] = deque()

    def render(self, snapshot: Snapshot, report: TickReport) -> Iterator[FrameBatch]:
        """Yield the tick's views by groups of cameras, worlds and cameras. A batch is valid until the next one is requested."""
        while self.in_flight:
            # Left by a consumer that stopped early.
            launched = self.in_flight.popleft()
            launched.ring.wait(launched.slot)
        yield from self.advance(snapshot, report)
        yield from self.drain()

    def advance(self, snapshot: Snapshot, report: TickReport, finished: Callable[[], None] = lambda: None) -> Iterator[FrameBatch]:
        """Render a tick's views in batches; yield finished batches, oldest first: one whenever no slot of a ring is free, and after the
        last launch all of earlier ticks.

        On a GPU the tick's last batches stay in flight, so that the device has work between ticks; `drain` yields them. A batch is valid
        until the next one is requested. The snapshot may be reused after the rendering in the order of the device's stream. `finished` is
        called once the consumer is done with the tick's last batch (it requests the next one); ticks finish in order."""
        launched, ahead = 0, 0
        for ring in self.rings:
            shown = report.column("live").astype(bool) & (report.column("frame") % ring.group.every == 0)
            world, camera = pair_views(np.flatnonzero(shown), np.array(ring.cameras))
            known = (self.tick_time, self.object_ids, self.lights, self.bins)
            for part, wide, views in describe_batches(ring.group, report, world, camera, *known, cameras=self.cameras):
                while sum(batch.ring is ring for batch in self.in_flight) == len(ring.slots):
                    yield from self._deliver()
                slot = ring.launch(snapshot, world[part], camera[part], self.streams, views, wide)
                self.in_flight.append(_Launched(ring, slot, part.stop - part.start, views[0]))
                launched, ahead = launched + 1, ahead + int(self.device.is_cuda)
        if launched:
            self.in_flight[-1].finished = finished
        while len(self.in_flight) > ahead:
            yield from self._deliver()
        if not launched:
            finished()

    def drain(self) -> Iterator[FrameBatch]:
        """Yield the batches that are still in flight."""
        while self.in_flight:
            yield from self._deliver()

    def _deliver(self) -> Iterator[FrameBatch]:
        """Wait for the oldest batch in flight, yield it, and call its `finished` afterwards."""
        launched = self.in_flight.popleft()
        yield FrameBatch(**launched.description, **launched.ring.collect(launched.slot, launched.count))
        if launched.finished is not None:
            launched.finished()
