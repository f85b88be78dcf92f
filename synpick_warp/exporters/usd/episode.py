"""Spool of an episode's ticks on disk, so that memory stays constant however long and many the episodes are, and the task that makes its
USD file of them; with the plain descriptions that the bake sends to it.

It runs in writer processes, so this module imports neither Warp nor Newton, and pxr only when there is an episode to write.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from synpick_warp.codes import LookPart
from synpick_warp.configs.cell.bins import BinSizes
from synpick_warp.errors import OutputError
from synpick_warp.exporters.writing.files import sync_file, sync_folder
from synpick_warp.scenes.types import FIRST_DISTRACTOR, Camera, Material
from synpick_warp.views.frames import EpisodeEnd, TickBatch


@dataclass(frozen=True)
class StageLight:
    """Environment map as a dome light, and its sun as a distant light."""

    name: str
    file: str
    """EXR file, relative to the asset library."""
    intensity: float
    """Intensity of the dome light: scale of the map's radiance for display."""
    sun_azimuth: float
    """Azimuth of the sun in the map's frame, counter-clockwise about +z from +x [°]."""
    sun_polar: float
    """Zenith angle of the sun [°]."""
    sun_irradiance: tuple[float, float, float] | None
    """Irradiance of a surface that faces the sun, linear RGB, in the map's units; None: no distant light."""
    sun_angle: float
    """Angular diameter of the sun [°]."""


TEXTURES = "textures"
"""Folder of textures in the asset library."""
FLOOR = Material((1.0, 1.0, 1.0), None, 0.0, 1.0)
"""Material of the floor before an episode draws its texture."""


@dataclass(frozen=True)
class AssetSurface:
    """Material of an asset, without the pixels of its texture."""

    material: Material
    texture: str | None
    """File of its texture, relative to the asset library; None: it has none."""
    maps: frozenset[str] = frozenset()
    """Names of the maps that are stored next to the texture."""

    @staticmethod
    def of(name: str, material: Material) -> "AssetSurface":
        """That of the asset of this name."""
        texture = None if material.texture is None else texture_file(name)
        return AssetSurface(replace(material, texture=None, maps=None, opacity=None, glow=None), texture, material.map_names)


def texture_file(name: str) -> str:
    """File of a texture, relative to the asset library: that of the asset of this name, or one of those that episodes draw from."""
    return f"{TEXTURES}/{name}.png"


def drawn_texture(part: LookPart, index: int) -> str:
    """Name of a texture that episodes draw for the bin, the table or the background."""
    return f"{part.name.lower()}_{index:03d}"


@dataclass(frozen=True)
class UsdSettings:
    """Settings common to all episodes."""

    tick_rate: float
    """Frames per second of simulated time [1/s]."""
    gravity: float
    """[m/s²]"""
    bins: tuple[str | None, ...]
    """Asset of each bin; None: there is nothing but the table."""
    cameras: tuple[Camera, ...]
    lights: tuple[StageLight, ...]
    names: dict[int, str]
    """obj_id -> name of the object."""
    surfaces: dict[str, AssetSurface]
    """Materials by asset, of those that looks are drawn for; empty: looks are not randomized."""
    props: tuple[tuple[str, tuple[float, ...], bool], ...] = ()
    """Name of each prop, its pose, and whether this is in the frame of the gripper's shaft."""


def bin_asset(sizes: BinSizes) -> str:
    """Name of a bin's asset."""
    return sizes.name if sizes.noun == sizes.name else f"bin_{sizes.name}"


def object_asset(obj_id: int) -> str:
    """Name of an object's asset: stem of its file, and name of its root prim. Distractors have obj_ids from FIRST_DISTRACTOR downwards."""
    return f"obj_{obj_id:06d}" if obj_id >= 0 else f"distractor_{FIRST_DISTRACTOR - obj_id:06d}"


def prop_asset(name: str) -> str:
    """Name of a prop's asset."""
    return f"prop_{name}"


TICKS = 64
"""Number of ticks that are buffered in memory: about 50 kB per world."""


class TickSpool:
    """Buffered writer of one arrangement's ticks, which appends to a file, TICKS rows at a time; `instances`: capacity of a world."""

    def __init__(self, path: Path, instances: int) -> None:
        self.path, self.instances = path, instances
        self._rows = np.zeros((TICKS, tick_type(instances).itemsize), np.uint8)
        self._count = 0

    def add(self, row: np.ndarray) -> None:
        """Append a row of `tick_rows`. Raises OSError."""
        self._rows[self._count] = row
        self._count += 1
        if self._count == TICKS:
            self.flush()

    def flush(self) -> None:
        """Write the buffered ticks to the file. Raises OSError."""
        with self.path.open("ab") as file:
            file.write(self._rows[: self._count].tobytes())
        self._count = 0


def tick_type(instances: int) -> np.dtype:
    """Structured type of a row of the file: fields of `TickBatch`."""
    return np.dtype(
        [
            ("frame", "<i4"),
            ("bin", "<i4"),
            ("object_id", "<i4", instances),
            ("pose", "<f4", (instances, 7)),
            ("fixture_pose", "<f4", (3, 7)),
            ("fixture_visible", "<i4", 3),
            ("light", "<i4"),
            ("light_yaw", "<f4"),
            ("light_exposure", "<f4"),
        ]
    )


def tick_rows(batch: TickBatch) -> np.ndarray:
    """Rows of `tick_type`, as bytes, of all frames of a batch (frame, byte) uint8."""
    rows = np.empty(len(batch), tick_type(batch.object_id.shape[1]))
    for name in rows.dtype.names or ():
        rows[name] = getattr(batch, name)
    return rows.view(np.uint8).reshape(len(rows), rows.itemsize)


def read_ticks(path: Path, instances: int) -> np.ndarray:
    """Read all ticks of a file, in order, as rows of `tick_type` (frame)."""
    return np.fromfile(path, tick_type(instances))


def write_episode(spool: Path, instances: int, place: Path, end: EpisodeEnd, settings: UsdSettings) -> None:
    """Task: write an episode's file beside its spool, of a `TickSpool` with this capacity, and rename it to its place beside `assets/`."""
    from synpick_warp.exporters.usd.assets import save_layer
    from synpick_warp.exporters.usd.stage import make_episode_layer

    ticks = read_ticks(spool, instances)
    if ticks["frame"].tolist() != list(range(end.frames)):
        raise OutputError(f"{place} has {len(ticks)} of {end.frames} frames; this is an error of synpick-warp, please report it")
    staged = spool.with_name(f"{spool.name}.usdc")
    save_layer(make_episode_layer(ticks, end, settings), staged)
    sync_file(staged)
    staged.rename(place)
    sync_folder(place.parent)
