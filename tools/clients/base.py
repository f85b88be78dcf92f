"""Contract of a client, and what clients share. Imports NumPy only, as clients also run in interpreters that have nothing of ours."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

SAMPLES = 3
"""Number of frames read from an episode."""
PICTURE = "picture"
"""Prefix of values that are pictures from 0 to 1; they are compared by PSNR."""
PSNR = 28.0
"""Lowest PSNR of a picture [dB]: lossy video, and a path tracer's noise against our denoiser, stay above; a wrong light does not."""
MILLIMETERS = 1000.0
Values = dict[str, np.ndarray]
"""What was read, or is in memory, by name; the first word of a name tells its kind, a last number the frame."""


@dataclass
class ClientReading:
    """Values that a client has read, with remarks and versions for the table."""

    what: str
    """For the table."""
    values: Values
    remarks: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    """Of packages that are not installed, but imported from a folder."""


def expect_views(data_set: Any) -> Values:
    """What clients of images may read of the sampled views, as `synpick_warp.open` has it in memory; all are compared that were read.

    Names with `visible_` are of the instances with visible pixels alone. Depth is in metres, `depth_count` in counts, which are integers.
    """
    values: Values = {}
    for frame, view in sampled_views(data_set).items():
        seen, scale = view.masks.any(axis=(1, 2)), np.float32(view.records.camera["depth_scale"] / MILLIMETERS)
        found = {
            "rgb": view.rgb,
            "depth": view.depth,
            "depth_count": np.rint(view.depth / scale).astype(np.int64),
            "cam_K": view.intrinsics,
            "world_to_camera": view.world_to_camera,
            "object_to_camera": view.object_to_camera,
            "obj_id": view.object_ids,
            "visib_fract": view.visibility,
            "mask": view.amodal_masks,
            "mask_visib": view.masks,
            "visible_obj_id": view.object_ids[seen],
            "visible_mask": view.masks[seen],
            "visible_pose": view.object_to_camera[seen],
        }
        values |= {f"{name} {frame}": value for name, value in found.items()}
    return values


@dataclass(frozen=True)
class Client:
    """Other people's reader of one of our formats."""

    packages: tuple[str, ...]
    """Distributions that it needs; the first one's version is printed."""
    find: Callable[[Path], Path | None]
    """File or folder of a data set that it opens; None: the data set has not that format."""
    read: Callable[[Path, Path, str], ClientReading]
    """What the client makes of it, given that, the data set's folder, and that of a copy of the BOP toolkit (empty: none). Runs in the
    client's interpreter."""
    expect: Callable[[Any], Values] = expect_views
    """The same values as `synpick_warp.open` has them in memory, by the same names. Runs in ours."""
    bounds: Mapping[str, float] = field(default_factory=dict)
    """Largest absolute difference by kind of value (0 if it is not named)."""
    develop: Callable[[np.ndarray], np.ndarray] = np.asarray
    """What makes a picture of the client comparable with ours. Runs in ours."""


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


def find_usd(data: Path) -> Path | None:
    """USD file of the first episode; None: there is none."""
    return find_in(f"usd/{first_episode(data)['episode']:06d}.usdc")(data)


def find_in(name: str) -> Callable[[Path], Path | None]:
    """Function that returns the file or folder of that name in a data set; None: there is none."""
    return lambda data: data / name if (data / name).exists() else None


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
