"""Layout of a LeRobot v3 data set: names of files, features of a frame, and info.json. Imports neither PyAV nor pyarrow.

Checked against `lerobot` 0.4.4 (codebase_version v3.0). LeRobot numbers the episodes of a data set without gaps; videos and parts are named
by the episode's index in the bake, which may have gaps, and meta/episodes says which file is whose.
"""

import itertools
from collections import Counter
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from synpick_warp.configs.cell.cameras import Rig
from synpick_warp.configs.dataset import DataLayout, split_kind
from synpick_warp.configs.schema import Physics

FOLDER = Path("lerobot")
"""Folder of the LeRobot data set, in ours."""
PARTS, VIDEOS, META = FOLDER / "parts", FOLDER / "videos", FOLDER / "meta"
CARD, INFO, STATS, TASKS = FOLDER / "README.md", META / "info.json", META / "stats.json", META / "tasks.parquet"
EPISODES, DATA = META / "episodes" / "chunk-000" / "file-000.parquet", FOLDER / "data" / "chunk-000" / "file-000.parquet"
CHUNK = 1000
"""Maximum number of files in a chunk's folder (LeRobot's default)."""
VERSION = "v3.0"
ROBOT = "suction_gripper"
CODEC, PIXEL_FORMAT = "h264", "yuv420p"
_MAX_DENOMINATOR = 100_000
"""Frame rates are taken for fractions of at most this denominator, such as 500/33 Hz."""
_CHUNKED = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_SIZES = {"data_files_size_in_mb": 100, "video_files_size_in_mb": 200}
"""LeRobot's defaults, for recorders that append to the data set [MB]."""

STATE = ("x", "y", "z", "qx", "qy", "qz", "qw", "suction", "attached")
"""Cup to world [m] and quaternion; 1 if the suction is on; 1 if an object hangs on the cup."""
ACTION = ("x", "y", "z", "suction")
"""Setpoint of the wrist (the cup's tilt axis) [m] and suction command of the tick that leads to the next frame."""


class Feature(NamedTuple):
    """Column of the table of frames: its NumPy type, and the names of its components (empty: a single number)."""

    dtype: str
    names: tuple[str, ...] = ()


FRAME_FEATURES = {
    "observation.state": Feature("float32", STATE),
    "action": Feature("float32", ACTION),
    "next.reward": Feature("float32"),
    "next.success": Feature("bool"),
    "next.done": Feature("bool"),
    "attempt.index": Feature("int64"),
    "attempt.outcome": Feature("int64"),
    "timestamp": Feature("float32"),
    "frame_index": Feature("int64"),
    "episode_index": Feature("int64"),
    "index": Feature("int64"),
    "task_index": Feature("int64"),
}
"""Columns of data/*.parquet. Reward is 1 and success true if the next frame is the one at which an attempt was judged, and an object was
picked; `attempt.index` is -1 outside of attempts, `attempt.outcome` the code of the attempt's `Outcome`, 0 outside."""

ROW = np.dtype(
    [
        ("state", "<f4", len(STATE)),
        ("action", "<f4", len(ACTION)),
        ("reward", "<f4"),
        ("success", "?"),
        ("attempt", "<i4"),
        ("outcome", "<i4"),
        ("task", "<i4"),
    ]
)
"""A frame in a part: what its episode alone determines. `task` is an index into the part's sentences."""


def camera_key(camera: str) -> str:
    """Feature name of a camera's video, by the camera's name."""
    return f"observation.images.{camera}"


def part_path(episode: int) -> Path:
    """File with the rows of an episode, relative to the data set."""
    return PARTS / f"{episode:06d}.json"


def video_path(camera: str, episode: int) -> Path:
    """Video of an episode, relative to the data set."""
    place = _CHUNKED.format(chunk_index=episode // CHUNK, file_index=episode % CHUNK)
    return VIDEOS / camera_key(camera) / f"{place}.mp4"


def video_folders(cameras: Sequence[str]) -> list[Path]:
    """Folders that hold the videos, each after the folders within it; see `SharedFiles.folders`."""
    keys = [VIDEOS / camera_key(camera) for camera in cameras]
    return [*(key / "chunk-*" for key in keys), *keys, VIDEOS]


def frame_rate(physics: Physics) -> float | int:
    """Frames per second of simulated time [Hz]; whole numbers as integers."""
    rate = 1.0 / physics.tick_time
    return round(rate) if abs(rate - round(rate)) < 1e-9 else rate


def video_rate(physics: Physics) -> Fraction:
    """Frames per second as a fraction."""
    return Fraction(frame_rate(physics)).limit_denominator(_MAX_DENOMINATOR)


def split_name(layout: DataLayout, episode: int) -> str:
    """Name of the split of an episode of the bake; without splits, BOP's kind of the one: train, val or test."""
    split = layout.split_of(episode)
    return split_kind(layout.split) if split is None else split.name


def make_info(rig: Rig, rate: float, splits: Sequence[str], frames: int, tasks: int) -> dict[str, Any]:
    """Content of meta/info.json; `rate`: see `frame_rate`; `splits`: name of the split of each episode."""
    counts = Counter(splits)  # The episodes of a split follow each other.
    ends = itertools.accumulate(counts.values())
    ranges = {name: f"{end - count}:{end}" for (name, count), end in zip(counts.items(), ends, strict=True)}
    videos = {camera_key(name): _video_feature(*size, rate) for name, size in zip(rig.names, rig.sizes, strict=True)}
    columns = {
        name: {"dtype": feature.dtype, "shape": [len(feature.names) or 1], "names": list(feature.names) or None}
        for name, feature in FRAME_FEATURES.items()
    }
    return {
        "codebase_version": VERSION,
        "robot_type": ROBOT,
        "total_episodes": len(splits),
        "total_frames": frames,
        "total_tasks": tasks,
        "chunks_size": CHUNK,
        **_SIZES,
        "fps": rate,
        "splits": ranges,
        "data_path": f"data/{_CHUNKED}.parquet",
        "video_path": f"videos/{{video_key}}/{_CHUNKED}.mp4",
        "features": videos | columns,
    }


def _video_feature(width: int, height: int, rate: float) -> dict[str, Any]:
    return {
        "dtype": "video",
        "shape": [height, width, 3],
        "names": ["height", "width", "channels"],
        "info": {
            "video.height": height,
            "video.width": width,
            "video.codec": CODEC,
            "video.pix_fmt": PIXEL_FORMAT,
            "video.is_depth_map": False,
            "video.fps": rate,
            "video.channels": 3,
            "has_audio": False,
        },
    }
