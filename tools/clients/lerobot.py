"""LeRobot v3 by its parts' readers, parquet by pyarrow and videos by PyAV, and each split by LeRobotDataset where it is installed."""

# Runs where the packages are, which the type checker may not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import importlib.util
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import PICTURE, Reading, Sources, first_episode, sample_frames, sampled_views

PACKAGES = ("av", "pyarrow", "lerobot", "torch")
BOUNDS = {"position": 1e-6, "dataset": 1e-6}
CAMERA = "observation.images.camera_0"


def find(data: Path, sources: Sources) -> Path | None:
    """Folder of the LeRobot data set; None: there is none."""
    place = data / "lerobot"
    return place if (place / "meta" / "info.json").is_file() else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """State of the sampled frames of the first episode, and their pictures in the first camera's video."""
    import av
    import pyarrow.parquet as parquet

    info = json.loads((place / "meta" / "info.json").read_text())
    episode = parquet.read_table(place / "meta" / "episodes", columns=None).to_pylist()[0]
    table = parquet.read_table(place / info["data_path"].format(chunk_index=0, file_index=0)).to_pylist()
    rows = [row for row in table if row["episode_index"] == episode["episode_index"]]
    frames = sample_frames(first_episode(data)["frames"])
    values = {"frames": np.array([len(rows), episode["length"]])}
    values["position"] = np.array([rows[frame]["observation.state"][:3] for frame in frames])
    chunk, file = (episode[f"videos/{CAMERA}/{name}_index"] for name in ("chunk", "file"))
    with av.open(str(place / info["video_path"].format(video_key=CAMERA, chunk_index=chunk, file_index=file))) as video:
        pictures = [picture.to_ndarray(format="rgb24") for picture in video.decode(video=0)]
    for frame in frames:
        values[f"{PICTURE} {frame}"] = pictures[frame] / 255.0
    what = f"{place.name}: {info['total_episodes']} episodes, {info['total_frames']} frames; {len(pictures)} pictures"
    if importlib.util.find_spec("lerobot") is None:
        return Reading(what, values, ["the package lerobot is not installed: its reader was not tried"])
    ranges = {name: range(*map(int, span.split(":"))) for name, span in info["splits"].items()}
    for name, episodes in ranges.items():
        values |= read_split(place, name, list(episodes), frames)
    return Reading(f"{what}; {len(ranges)} splits by LeRobotDataset", values, ["decoded by pyav: torchcodec needs a system's FFmpeg"])


def read_split(place: Path, name: str, episodes: list[int], frames: list[int]) -> dict[str, np.ndarray]:
    """Read a split by LeRobot's own reader: its numbers of episodes and frames; of the first episode of all, the sampled frames, too."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if not episodes:
        return {}
    data_set = LeRobotDataset("local/set", root=place, episodes=episodes, video_backend="pyav")
    first, last = data_set[0], data_set[len(data_set) - 1]
    values = {f"split {name}": np.array([data_set.num_episodes, len(data_set), bool(last["next.done"])])}
    if int(first["episode_index"]) == 0:
        rows = [data_set[frame] for frame in frames]
        values["dataset position"] = np.array([row["observation.state"][:3].numpy() for row in rows])
        for frame, row in zip(frames, rows, strict=True):
            values[f"{PICTURE} of dataset {frame}"] = row[CAMERA].permute(1, 2, 0).numpy()
    return values


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from memory: cup poses, which need the trajectories (zarr), and pictures."""
    episode = data_set[min(data_set)]
    values = {"frames": np.array([len(episode), len(episode)])}
    views = sampled_views(data_set)
    if data_set.has_store:
        values["position"] = np.asarray(episode.ticks["fixture_pose"][:])[list(views), 2, :3]
        values["dataset position"] = values["position"]
    for frame, view in views.items():
        values[f"{PICTURE} {frame}"] = values[f"{PICTURE} of dataset {frame}"] = view.rgb / 255.0
    for name, part in (data_set.splits or {"train": data_set}).items():
        values[f"split {name}"] = np.array([len(part), sum(len(part[index]) for index in part), True])
    return values
