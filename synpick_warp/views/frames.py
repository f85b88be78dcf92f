"""Schema of the host-side batches from stages to exporters: rendered views with their amodal masks, simulation frames (ticks), and ends of
episodes, with the records of their bins.

A tick is one output frame of simulated time (`physics.steps_per_tick` physics steps); a view is one camera's image of it.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Protocol

import numpy as np

from synpick_warp.codes import MASK_ROWS


class Images(Protocol):
    """Images of a batch on the device, of which single ones can be copied to the host."""

    def __getitem__(self, index: int | tuple[int, slice]) -> np.ndarray:
        """Copy an image, or a part of it, to the host; waits for the device."""
        ...


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """Batch of `B` rendered views with their ground truth.

    Arrays are slices of a ring buffer, valid until the next batch is requested; exporters copy what they keep. `I` is the instance
    capacity of a world. An instance's index along `I` is its `instance_id`; it denotes the same object for the whole episode.
    """

    episode: np.ndarray
    """Episode index (B) int32."""
    camera: np.ndarray
    """Camera index (B) int32."""
    frame: np.ndarray
    """Frame index within the episode, from 0, (B) int32."""
    time: np.ndarray
    """Simulated time since the episode's first frame [s] (B) float64."""
    color: np.ndarray | Images
    """Colour image, sRGB, RGB order (B, H, W, 3) uint8."""
    depth: np.ndarray | Images
    """Planar depth (along the optical axis) in units of `bop.depth_scale` mm; 0: no surface (B, H, W) uint16."""
    instance: np.ndarray | Images
    """Segmentation id of the nearest surface: 0 none, 1 + instance_id, or a `Segment` (B, H, W) uint8."""
    mask_words: np.ndarray | Images
    """Amodal masks: a bit a pixel for each instance in its own box, set where the pixel's ray hits it, hidden or not (B, W) uint32; see
    `synpick_warp.views.frames`."""
    mask_first: np.ndarray
    """Index of the first word of each mask (B, I) int32."""
    mask_box: np.ndarray
    """Box of each mask in the image, x_min, y_min, x_max, y_max [px], inclusive, not tight; x_max < x_min: empty (B, I, 4) int32."""
    mask_length: np.ndarray
    """Number of words in use (B) int32."""
    object_id: np.ndarray
    """obj_id of each instance; -1: the instance is not in the scene; below: a distractor, without label (B, I) int32."""
    pose: np.ndarray
    """Object-to-world poses: x, y, z [m], quaternion x, y, z, w (B, I, 7) float32."""
    pixels: np.ndarray
    """Pixel counts px_count_all, px_count_valid, px_count_visib of BOP (B, I, 3) int32."""
    boxes: np.ndarray
    """Amodal and visible bounding boxes x_min, y_min, x_max, y_max [px], inclusive; x_max < x_min: empty (B, I, 2, 4) int32."""
    effects: np.ndarray
    """Camera-effect parameters of the view, in the order of `Effect`; 0: off (B, E) float32."""
    light_name: np.ndarray
    """Name of the episode's environment map (B) str."""
    light_yaw: np.ndarray
    """Environment yaw: rotation of the map about +z, counter-clockwise [rad] (B) float32."""
    light_exposure: np.ndarray
    """Exposure compensation of the episode, relative to the automatic exposure [EV] (B) float32."""
    light_direction: np.ndarray
    """Unit vector towards the sun or strongest lamp of the map, in the world frame; zero: the map has none (B, 3) float32."""
    matrix: np.ndarray | None = None
    """Camera matrix of each view (B, 3, 3) float64 [px]; None, as of the next two: that of the camera, the same in all views."""
    rotation: np.ndarray | None = None
    """World-to-camera rotation (B, 3, 3) float64."""
    translation: np.ndarray | None = None
    """World-to-camera translation (B, 3) float64 [m]."""
    layers: dict[str, np.ndarray] = field(default_factory=dict)
    """Layers (AOVs) that `render.layers` names, each (B, H, W[, C]); see `synpick_warp.views.layer_codec`."""
    bin_name: np.ndarray | None = None
    """Name of the episode's bin (B) str; None: a tote that is always in its place."""
    bin_pose: np.ndarray | None = None
    """Its pose to the world: x, y, z [m], quaternion x, y, z, w (B, 7) float32."""
    boundary_count: np.ndarray | None = None
    """Number of run boundaries (value changes down a column) of `instance` (B) int32; above R: `boundaries` is cut."""
    boundaries: np.ndarray | None = None
    """Per run boundary column · (H + 1) + row of the pixel below; value above + 256 · value below; sorted by the first (B, 2, R) uint32."""
    run_count: np.ndarray | None = None
    """Number of run boundaries of each amodal mask (B, I) int32; above S in all: `runs` is cut."""
    runs: np.ndarray | None = None
    """Positions of the run boundaries of the amodal masks, as those of `boundaries`, mask by mask (B, S) uint32."""
    jpeg_size: np.ndarray | None = None
    """Size of each JPEG file [B] (B) int32; above F: `jpeg` is cut."""
    jpeg: np.ndarray | None = None
    """JPEG files of `color` that the device has made (B, F) uint8."""
    depth_idat_size: np.ndarray | None = None
    """Size of the data of each depth PNG [B] (B) int32; above G: `depth_idat` is cut."""
    depth_idat: np.ndarray | None = None
    """Data (IDAT) of the PNG files of `depth` that the device has made (B, G) uint8."""

    def __len__(self) -> int:
        return len(self.episode)

    def color_source(self, view: int) -> np.ndarray:
        """JPEG file (bytes) uint8 of a view if the device has made it, else its colour image (H, W, 3) uint8."""
        if self.jpeg is None or self.jpeg_size is None or self.jpeg_size[view] > self.jpeg.shape[1]:
            return self.color[view]
        return self.jpeg[view, : self.jpeg_size[view]]

    def depth_source(self, view: int) -> np.ndarray:
        """Data of a view's depth PNG (bytes) uint8 if the device has made it, else its depth image (H, W) uint16."""
        if self.depth_idat is None or self.depth_idat_size is None or self.depth_idat_size[view] > self.depth_idat.shape[1]:
            return self.depth[view]
        return self.depth_idat[view, : self.depth_idat_size[view]]


class SelectedRows(Mapping[str, np.ndarray]):
    """Rows of named arrays, gathered anew by each read: what no exporter reads is never copied."""

    def __init__(self, arrays: Mapping[str, np.ndarray], rows: np.ndarray) -> None:
        """Select rows by their indices along the first dimension (row) int; those of an earlier selection are composed with these."""
        if isinstance(arrays, SelectedRows):
            arrays, rows = arrays._arrays, arrays._rows[rows]
        self._arrays, self._rows = arrays, rows

    def __getitem__(self, name: str) -> np.ndarray:
        """Copy of the rows of an array."""
        return self._arrays[name][self._rows]

    def __contains__(self, name: object) -> bool:
        """Whether there is an array of that name; without this method `Mapping` would gather its rows to find out."""
        return name in self._arrays

    def __iter__(self) -> Iterator[str]:
        return iter(self._arrays)

    def __len__(self) -> int:
        return len(self._arrays)


@dataclass(frozen=True, eq=False)
class TickBatch:
    """Batch of one tick: the simulation frame of each of the `W` worlds that recorded one.

    Arrays are valid until the next tick; exporters copy what they keep. `I` is the instance capacity of a world, as in `FrameBatch`;
    `S` is the number of physics steps in a tick.
    """

    episode: np.ndarray
    """Episode index (W) int32."""
    frame: np.ndarray
    """Frame index within the episode, from 0, (W) int32."""
    time: np.ndarray
    """Simulated time since the episode's first frame [s] (W) float64."""
    object_id: np.ndarray
    """obj_id of each instance; -1: the instance is not in the scene; below: a distractor, without label (W, I) int32."""
    pose: np.ndarray
    """Object-to-world poses: x, y, z [m], quaternion x, y, z, w (W, I, 7) float32."""
    bin: np.ndarray
    """Index of the episode's bin (W) int32."""
    fixture_pose: np.ndarray
    """Fixture-to-world poses of the bin, the gripper shaft ("finger") and the cup: x, y, z [m], quaternion x, y, z, w (W, 3, 7) float32."""
    fixture_visible: np.ndarray
    """1 if the fixture is visible in the images, else 0 (W, 3) int32."""
    light: np.ndarray
    """Index of the episode's environment map (W) int32."""
    light_yaw: np.ndarray
    """Environment yaw: rotation of the map about +z, counter-clockwise [rad] (W) float32."""
    light_exposure: np.ndarray
    """Exposure compensation of the episode, relative to the automatic exposure [EV] (W) float32."""
    tick: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further arrays (W, ...) of the tick, by name; empty unless an exporter needs physics. Read each once: a read may copy it."""
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays (W, S, ...) of the physics steps that lead to the frame, by name; see `tick`."""

    def __len__(self) -> int:
        return len(self.episode)

    def select(self, rows: np.ndarray) -> "TickBatch":
        """Batch of the frames with these indices (row) int."""
        values: dict[str, Any] = {}
        for item in fields(self):
            value = getattr(self, item.name)
            values[item.name] = SelectedRows(value, rows) if isinstance(value, Mapping) else value[rows]
        return TickBatch(**values)


@dataclass(frozen=True)
class EpisodeEnd:
    """End of an episode: indices, frames, `Ending`, and its lines of episodes.jsonl (empty: the arrangement will be resampled) and
    attempts.jsonl. Exporters commit its files, or discard them if the ending delivers nothing."""

    episode: int
    arrangement: int
    """Number of arrangements of this episode that were discarded and resampled before this one."""
    frames: int
    ending: int
    row: Mapping[str, Any] = field(default_factory=dict)
    attempts: tuple[str, ...] = ()
    """The episode's lines of attempts.jsonl: JSON, each with its newline."""
    image_ids: tuple[int, ...] | None = None
    """BOP's im_id of each frame, ascending; None: the frame's index."""

    @property
    def images(self) -> Sequence[int]:
        """BOP's im_id of each frame."""
        return range(self.frames) if self.image_ids is None else self.image_ids


_DIGITS = 6
"""Decimal places of the pose of a bin in records."""
_FLAT = ("table", "pallet")
"""Names of bins without walls."""
WORD_BYTES = 4
"""Bytes of a word."""


def bin_record(name: str, pose: np.ndarray) -> dict[str, Any]:
    """Record of a bin: name, position [m] and yaw [rad] in the world, from its pose (7): x, y, z [m], quaternion x, y, z, w."""
    x, y, z, _, _, sine, cosine = pose.astype(np.float64).tolist()
    yaw = round(2.0 * math.atan2(sine, cosine), _DIGITS)
    return {"name": name, "position": [round(part, _DIGITS) for part in (x, y, z)], "yaw": yaw}


def name_bin(sentence: str, record: Mapping[str, Any] | None) -> str:
    """Replace "tote" in a sentence by what the episode's bin is, such as "table" or "bin"; record None (a fixed tote): unchanged."""
    if record is None:
        return sentence
    name = record["name"]
    if name in _FLAT:
        sentence = sentence.replace("in the tote", "on the tote")
    return sentence.replace("tote", name if name in ("tote", *_FLAT) else "bin")


def most_words(width: int, height: int) -> int:
    """Number of 32-bit words of a mask of the whole image [px]: one for each column and band of MASK_ROWS rows."""
    return width * -(-height // MASK_ROWS)


def paint_masks(words: np.ndarray, first: np.ndarray, box: np.ndarray, width: int, height: int) -> np.ndarray:
    """Masks of a view as images (I, H, W) bool, from its words, the first of each mask (I) and the boxes (I, 4)."""
    masks = np.zeros((len(first), height, width), bool)
    for mask, index, (left, top, right, bottom) in zip(masks, first.tolist(), box.tolist(), strict=True):
        mask[top : bottom + 1, left : right + 1] = unpack_mask(words, index, np.array((left, top, right, bottom)))
    return masks


def unpack_mask(words: np.ndarray, first: int, box: np.ndarray) -> np.ndarray:
    """Unpack an instance's mask to bool (rows, columns) of its box (inclusive; x_max < x_min: empty). `words`: of the view (W) uint32, from
    index `first` on one for each column of a band of MASK_ROWS rows, band by band, the top row in the lowest bit."""
    columns, rows = (max(0, int(past) - int(start) + 1) for start, past in zip(box[:2], box[2:], strict=True))
    bands = -(-rows // MASK_ROWS)
    own = words[first : first + bands * columns].astype("<u4", copy=False).reshape(bands, columns, 1)
    bits = np.unpackbits(own.view(np.uint8), axis=-1, bitorder="little")
    return bits.swapaxes(1, 2).reshape(bands * MASK_ROWS, columns)[:rows].astype(bool)
