"""Interface of a client, a third-party library that reads our formats, and shared helpers. Imports only NumPy: clients also run in
interpreters without our packages."""

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
"""Lowest PSNR of a picture [dB]: lossy video stays above, and so does another path tracer's noise; a wrong light falls below."""
MILLIMETERS = 1000.0
"""Millimetres per metre."""
Values = dict[str, np.ndarray]
"""Arrays by name, read by a client or expected; the first word of a name is the kind of value, a last number the frame."""


@dataclass
class ClientReading:
    """Values that a client has read, with remarks and versions for the table."""

    what: str
    """Summary for the printed table, as "3 scenes, 5 classes"."""
    values: Values
    remarks: list[str] = field(default_factory=list)
    versions: dict[str, str] = field(default_factory=dict)
    """Of packages that are not installed, but imported from a folder."""


def expect_views(data_set: Any) -> Values:
    """Expected values of the sampled views, from `synpick_warp.open`. A client need not read all: those that it read are compared.

    `visible_...`: only of the instances with visible pixels. `depth` is in metres, `depth_count` in integer counts of `depth_scale`.
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
    """A third-party reader of one of our formats, and how its values are compared with ours."""

    packages: tuple[str, ...]
    """Distributions that it needs; the first one's version is printed."""
    find: Callable[[Path], Path | None]
    """File or folder of a data set that it opens; None: the data set has not that format."""
    read: Callable[[Path, Path, str], ClientReading]
    """Reads, from the path that `find` returned, the data set's folder, and that of a copy of the BOP toolkit (empty: none). Runs in the
    client's interpreter."""
    expect: Callable[[Any], Values] = expect_views
    """Expected values, by the same names, of a data set opened by `synpick_warp.open`. Runs in our interpreter."""
    bounds: Mapping[str, float] = field(default_factory=dict)
    """Largest absolute difference allowed, by kind of value (0 if not listed)."""
    tone_map: Callable[[np.ndarray], np.ndarray] = np.asarray
    """Maps a picture of the client to one like ours, as by tone mapping. Runs in our interpreter."""


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
