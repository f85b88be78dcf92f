"""Small USD data sets: objects made of one or two boxes that drift through an episode; one of them is picked."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from synpick_warp.codes import Ending
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.base import ExportContext
from synpick_warp.exporters.usd.exporter import UsdExporter
from synpick_warp.exporters.writing.files import PARTIAL
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import Catalog, EnvironmentMap, Finish, Material
from synpick_warp.views.frames import EpisodeEnd, TickBatch

FRAMES = 70
"""More than the spool buffers in memory."""
OBJECT_IDS = np.array([3, -1, 1, 2], np.int32)
"""At the first frame; instance 1 does not exist."""
PICKED, PICKED_FRAME = 2, 41
"""Picked instance, and the first frame without it."""
GRIPPER = (3, 60)
"""First frame with the gripper, and first frame without it after that."""
LIGHT, YAW, EXPOSURE = 1, 0.7, -0.25
"""Index of the environment map, its yaw [rad], and exposure compensation [EV]."""


def settings(**overrides: object) -> Config:
    """The preset `smoke` with overrides; keys have __ for the dot."""
    return load_config("smoke", {key.replace("__", "."): value for key, value in overrides.items()})


def textured(catalog: Catalog) -> Catalog:
    """Copy of a catalog whose first object shines, and whose second one has texture coordinates, a texture with maps and a base colour."""
    first, second, *others = catalog.entries
    numbers = np.random.default_rng(7)
    mesh = dataclasses.replace(second.mesh, uv=numbers.random((len(second.mesh.vertices), 2), dtype=np.float32))
    material = Material((0.9, 0.8, 0.7), numbers.integers(0, 256, (24, 32, 3), dtype=np.uint8), 0.3, 0.6)
    maps = numbers.integers(64, 192, (24, 32, 4), dtype=np.uint8)
    material = dataclasses.replace(material, maps=maps, emission=(0.0, 3.0, 1.0), glow=maps[..., :3])
    first = dataclasses.replace(
        first, material=dataclasses.replace(first.material, emission=(0.5, 0.25, 0.0), finish=Finish(0.5, 0.25, 0.75))
    )
    return Catalog((first, dataclasses.replace(second, mesh=mesh, material=material), *others))


def episode_ticks(episode: int, frames: int = FRAMES) -> list[TickBatch]:
    """Ticks of one world. Quaternions alternate their sign from frame to frame, which leaves poses unchanged."""
    numbers = np.random.default_rng(episode)
    start = numbers.normal(size=(7, 7))
    start[:, :3] *= 0.1
    drift = 0.02 * numbers.normal(size=(7, 7))
    drift[3] = 0.0  # instance 3 rests
    drift[4], start[4] = 0.0, [0, 0, 0, 0, 0, 0, 1]  # so does the tote
    result = []
    for frame in range(frames):
        pose = start + frame * drift
        pose[:, 3:] *= (-1.0) ** frame / np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        pose[3:5, 3:] = start[3:5, 3:] / np.linalg.norm(start[3:5, 3:], axis=1, keepdims=True)
        object_id = OBJECT_IDS.copy()
        if frame >= PICKED_FRAME:
            object_id[PICKED] = -1
            pose[PICKED, :] = 0.0  # readers must ignore it
        visible = GRIPPER[0] <= frame < GRIPPER[1]
        result.append(
            TickBatch(
                episode=np.array([episode], np.int32),
                frame=np.array([frame], np.int32),
                time=np.array([frame / 15.0]),
                object_id=object_id[None],
                pose=pose[None, :4].astype(np.float32),
                bin=np.zeros(1, np.int32),
                fixture_pose=pose[None, 4:].astype(np.float32),
                fixture_visible=np.array([[1, visible, visible]], np.int32),
                light=np.array([LIGHT], np.int32),
                light_yaw=np.array([YAW], np.float32),
                light_exposure=np.array([EXPOSURE], np.float32),
            )
        )
    return result


def write_set(
    out: Path,
    config: Config,
    catalog: Catalog,
    episodes: Iterable[int] = (0,),
    lights: tuple[EnvironmentMap, ...] | None = None,
    frames: int = FRAMES,
) -> Path:
    """Write a complete data set in this process; returns the folder of its USD files."""
    (out / PARTIAL).mkdir(parents=True)
    with WriterPool(0, 0) as pool:
        exporter = UsdExporter(
            ExportContext(out, ExportSettings.of(config), catalog, make_cameras(config.rig), lights or skies()[:2], pool)
        )
        assert exporter.write_constants() == [Path("usd/assets")]
        for episode in episodes:
            for batch in episode_ticks(episode, frames):
                exporter.write_ticks(batch)
            exporter.end_episode(EpisodeEnd(episode, 0, frames, int(Ending.EMPTIED)), lambda: None)
        exporter.close()
    return out / "usd"
