"""What stages hand to exporters, on the host: views with their images and ground truth, ticks of the worlds, ends of episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class FrameBatch:
    """`B` views. Arrays are views into a ring buffer: valid until the batch is released; exporters copy what they keep.

    `I` is the room for instances of a world; `instance_id` runs from 0 and is the index along `I`. An instance_id keeps its
    object for the whole episode.
    """

    episode: np.ndarray
    """Episode number (B) int32."""
    camera: np.ndarray
    """Camera index (B) int32."""
    frame: np.ndarray
    """Number of the frame in its episode, from 0, (B) int32."""
    time: np.ndarray
    """Simulated time since the episode's first frame [s] (B) float64."""
    color: np.ndarray
    """Colour, sRGB (B, H, W, 3) uint8, red first."""
    depth: np.ndarray
    """Planar depth in counts of the configured depth scale, 0: no surface (B, H, W) uint16."""
    instance: np.ndarray
    """0 nothing, 1 + instance_id, or a `Segment` (B, H, W) uint8."""
    amodal: np.ndarray
    """Bit i set: the ray hits instance i, hidden or not (B, H, W) uint32."""
    object_id: np.ndarray
    """obj_id of each instance; -1: no such instance in this view's world (B, I) int32."""
    pose: np.ndarray
    """Object to world: x, y, z [m], quaternion x, y, z, w (B, I, 7) float32."""
    pixels: np.ndarray
    """px_count_all, px_count_valid, px_count_visib (B, I, 3) int32."""
    boxes: np.ndarray
    """bbox_obj and bbox_visib as x_min, y_min, x_max, y_max, inclusive; x_max < x_min: empty (B, I, 2, 4) int32."""
    effects: np.ndarray
    """Strengths of what the camera did to colour in the order of `Effect` (B, E) float32; zero: off."""
    light_name: np.ndarray
    """Name of the episode's light map (B) str."""
    light_yaw: np.ndarray
    """The map is turned counter-clockwise about +z by this angle [rad] (B) float32."""
    light_exposure: np.ndarray
    """How much longer than the automatic exposure the episode's pictures are exposed [stops] (B) float32."""
    light_direction: np.ndarray
    """Unit vector towards the map's main light, the sun or a lamp, in the world; zero: none stands out (B, 3) float32."""
    layers: dict[str, np.ndarray] = field(default_factory=dict)
    """The layers that the settings name (B, H, W[, C]); see `synpick_warp.layers`."""
    boundary_count: np.ndarray | None = None
    """Run boundaries of `instance` and `amodal`: changes of the value down a column (B, 2) int32; above R: `boundaries` is cut."""
    boundaries: np.ndarray | None = None
    """Per run boundary column · (H + 1) + row of the pixel below, value above, value below; sorted by the first (B, 2, 3, R) uint32."""

    def __len__(self) -> int:
        return len(self.episode)


@dataclass(frozen=True, eq=False)
class TickBatch:
    """One frame of each of the `W` worlds that have one in a tick. Arrays are valid until the next tick; exporters copy what they keep.

    `I` is the room for instances of a world, as in `FrameBatch`, `S` the number of steps in a tick.
    """

    episode: np.ndarray
    """Episode number (W) int32."""
    frame: np.ndarray
    """Number of the frame in its episode, from 0, (W) int32."""
    time: np.ndarray
    """Simulated time since the episode's first frame [s] (W) float64."""
    object_id: np.ndarray
    """obj_id of each instance; -1: no such instance in the scene (W, I) int32."""
    pose: np.ndarray
    """Object to world: x, y, z [m], quaternion x, y, z, w (W, I, 7) float32."""
    fixture_pose: np.ndarray
    """The same of tote, finger and cup (W, 3, 7) float32."""
    fixture_visible: np.ndarray
    """0: not in the picture (W, 3) int32."""
    light: np.ndarray
    """Index of the episode's light map (W) int32."""
    light_yaw: np.ndarray
    """The light map is turned counter-clockwise about +z by this angle [rad] (W) float32."""
    light_exposure: np.ndarray
    """How much longer than the automatic exposure the episode's pictures are exposed [stops] (W) float32."""
    tick: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Further arrays (W, ...) of the tick; empty unless an exporter records physics."""
    steps: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Arrays (W, S, ...) of the steps that led to the frame; empty unless an exporter records physics."""

    def __len__(self) -> int:
        return len(self.episode)


@dataclass(frozen=True)
class EpisodeEnd:
    """An episode is over. Exporters finish its files, or drop them if the ending delivers nothing."""

    episode: int
    redraw: int
    """How often this episode's arrangement was drawn again before."""
    frames: int
    ending: int
    """Code of an `Ending`."""
    row: Mapping[str, Any] = field(default_factory=dict)
    """What the data set's list of episodes says of it; empty if the episode will be drawn again."""
    attempts: tuple[str, ...] = ()
    """Its lines of the data set's list of attempts: JSON, each with its end."""
