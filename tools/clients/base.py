"""Contract of a client, and what clients share. Imports NumPy only, as clients also run in interpreters that have nothing of ours.

A client is a module of this package, named in `CLIENTS`. It has

- `PACKAGES`: distributions that it needs; the first one's version is printed;
- `find(data, sources)`: the file or folder that it opens, None if the data set has not that format;
- `read(place, data, sources) -> Reading`: what the client makes of it. Runs in the client's interpreter;
- `expect(data_set) -> dict`: the same values as `synpick_warp.open` has them in memory, by the same names. Runs in ours;
- `BOUNDS`, optional: largest absolute difference by name (0 if it is not named).
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

CLIENTS = ("bop_toolkit", "shards", "pytorch", "hugging_face", "coco", "yolo", "xarray_store", "newton_usd", "blender", "lerobot")
"""Client modules, in the order of the table's rows."""
SAMPLES = 3
"""Number of frames read from an episode."""
MISSING = 3
"""Exit code of a client's process that lacks a package."""
PICTURE = "picture"
"""Prefix of values that are pictures from 0 to 1; they are compared by PSNR."""
PSNR = 28.0
"""Lowest PSNR of a picture [dB]: lossy video, and a path tracer's noise against our denoiser, stay above; a wrong light does not."""
MILLIMETERS = 1000.0


@dataclass
class Reading:
    """Values that a client has read, by name, with remarks and versions for the table."""

    what: str
    """For the table."""
    values: dict[str, np.ndarray]
    remarks: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    """Of packages that are not installed, but imported from a folder."""


@dataclass(frozen=True)
class Sources:
    """Options that name folders of clients which no package index has."""

    bop_toolkit: str = ""
    """Folder of a copy of the BOP toolkit."""


def sample_frames(count: int) -> list[int]:
    """Frames spread evenly over an episode, the first and the last among them."""
    return sorted({round(index * (count - 1) / max(SAMPLES - 1, 1)) for index in range(SAMPLES)})


def first_scene(data: Path) -> Path | None:
    """Folder of the BOP scene with the lowest scene_id; None: the data set has none."""
    scenes = [path.parent for path in data.glob("[!.]*/*/scene_camera.json") if path.parent.name.isdigit()]
    return min(scenes, key=lambda path: int(path.name), default=None)


def first_shard(data: Path) -> Path | None:
    """Shard with the lowest index; None: the data set has none."""
    return min(data.glob("*_web/shard-*.tar"), key=lambda path: path.name, default=None)


def first_episode(data: Path) -> dict[str, Any]:
    """Entry of episodes.jsonl with the lowest index."""
    rows = [json.loads(line) for line in (data / "episodes.jsonl").read_text().splitlines()]
    return min(rows, key=lambda row: row["episode"])


def make_matrix(rotation: Any, translation: Any) -> np.ndarray:
    """Homogeneous transform (4, 4) [m] from BOP's rotation and translation [mm]."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), np.reshape(translation, 3) / MILLIMETERS
    return matrix


def pose_matrix(pose: np.ndarray) -> np.ndarray:
    """Homogeneous transform (4, 4) from x, y, z [m] and a quaternion x, y, z, w."""
    x, y, z, w = np.asarray(pose[3:], np.float64) / np.linalg.norm(pose[3:])
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    matrix = np.eye(4)
    matrix[:3, :3] += 2 * w * cross + 2 * cross @ cross
    matrix[:3, 3] = pose[:3]
    return matrix


def sampled_views(data_set: Any) -> dict[int, Any]:
    """`View` of the first camera for each sampled frame of the first episode."""
    episode = data_set[min(data_set)]
    return {frame: episode.view(frame) for frame in sample_frames(len(episode))}
