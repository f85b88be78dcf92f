"""Disk cache of reference images, which remain valid when only the denoiser changes, and take most of a report's time to render."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.stages.buffers import Snapshot
from synpick_warp.stages.render.scene import RenderScene
from tools.reports.render_checks import Shot, Studio

DENOISER_SETTINGS = ("coarse_pixel", "coarse_paths", "history", "mode")
"""Settings of section `render` that do not affect references, and are left out of the cache key."""
_ARRAYS = ("color", "radiance", "instance")
"""Arrays of a `Shot` that are stored; its rendering time is not."""


def existing_folder(text: str) -> Path:
    """Argument type of an option (`add_argument(type=...)`): the path of an existing folder."""
    path = Path(text)
    if not path.is_dir():
        raise argparse.ArgumentTypeError(f"there is no folder {path}; create it first")
    return path


class ReferenceStore:
    """Pairs of references with half of the paths each, cached in one file per pair. The key is a hash of settings and of the world's state.

    The key does not cover the code: clear the folder after a change of the reference renderer.
    """

    def __init__(self, folder: Path | None, config: Config, scene: RenderScene) -> None:
        """
        Args:
            folder: Folder of the files; None: no caching.
            config: Settings of the references, including the number of paths.
            scene: Scene of the references.
        """
        self._folder = folder
        half, room = {"render.mode": REFERENCE, "render.samples": max(1, config.render.samples // 2)}, config.arrangement.max_objects
        both = (config.with_values(half | {"bake.seed": config.bake.seed + offset}) for offset in (0, 1))
        self._studios = [Studio(make_renderer(each, scene, room, 1)) for each in both]
        content: dict[str, Any] = dataclasses.asdict(config)
        for name in DENOISER_SETTINGS:
            del content["render"][name]
        self._settings = repr(content).encode()

    def get(self, snapshot: Snapshot, world: int) -> list[Shot]:
        """Return the references of a world by camera 0, from the cache or else from the renderer."""
        path = None if self._folder is None else self._folder / f"{self._digest(snapshot, world)}.npz"
        if path is not None and path.exists():
            return _read(path)
        shots = self._render(snapshot, world)
        if path is None:
            return shots
        arrays = {f"{name}{index}": getattr(shot, name) for index, shot in enumerate(shots) for name in _ARRAYS}
        part = path.with_suffix(".part.npz")
        np.savez(part, **arrays)
        part.replace(path)
        return shots

    def _render(self, snapshot: Snapshot, world: int) -> list[Shot]:
        return [studio.render(snapshot, world, 0) for studio in self._studios]

    def _digest(self, snapshot: Snapshot, world: int) -> str:
        """SHA-256 of the settings and a world's snapshot, the key of its reference."""
        state = hashlib.sha256(self._settings)
        for item in dataclasses.fields(snapshot):
            state.update(getattr(snapshot, item.name).numpy()[world].tobytes())
        return state.hexdigest()


def _read(path: Path) -> list[Shot]:
    """Two reference renderings from a file; their times are not kept (0)."""
    with np.load(path) as content:
        return [Shot(*(content[f"{name}{index}"] for name in _ARRAYS), seconds=0.0) for index in (0, 1)]
