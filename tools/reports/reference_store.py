"""Disk cache of reference images, which remain valid when only the denoiser changes, and take most of a report's time to render."""

from __future__ import annotations

import argparse
import dataclasses
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.schema import Config
from synpick_warp.stages.buffers import Snapshot
from tools.reports.render_checks import Shot

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
    """Cache of pairs of references, one file per pair. The key is a hash of the settings and of the world's state.

    The key does not cover the code: clear the folder after a change of the reference renderer.
    """

    def __init__(self, folder: Path | None, config: Config) -> None:
        """
        Args:
            folder: Folder of the files; None: no caching.
            config: Settings of the references, including the number of paths.
        """
        self._folder = folder
        content: dict[str, Any] = dataclasses.asdict(config)
        for name in DENOISER_SETTINGS:
            del content["render"][name]
        self._settings = repr(content).encode()

    def get(self, snapshot: Snapshot, world: int, render: Callable[[], tuple[Shot, Shot]]) -> tuple[Shot, Shot]:
        """Return the references of a world, from the cache or else from the renderer.

        Args:
            snapshot: State of the worlds.
            world: Index of the world.
            render: Renders both references on a cache miss.
        """
        if self._folder is None:
            return render()
        path = self._folder / f"{self._digest(snapshot, world)}.npz"
        if path.exists():
            return _read(path)
        shots = render()
        arrays = {f"{name}{index}": getattr(shot, name) for index, shot in enumerate(shots) for name in _ARRAYS}
        part = path.with_suffix(".part.npz")
        np.savez(part, **arrays)
        part.replace(path)
        return shots

    def _digest(self, snapshot: Snapshot, world: int) -> str:
        """SHA-256 of the settings and a world's snapshot, the key of its reference."""
        state = hashlib.sha256(self._settings)
        for item in dataclasses.fields(snapshot):
            state.update(getattr(snapshot, item.name).numpy()[world].tobytes())
        return state.hexdigest()


def _read(path: Path) -> tuple[Shot, Shot]:
    """Two reference renderings from a file; their times are not kept (0)."""
    with np.load(path) as content:
        first, second = (Shot(*(content[f"{name}{index}"] for name in _ARRAYS), seconds=0.0) for index in (0, 1))
    return first, second
