"""LeRobot v3 by its parts' own readers: parquet by pyarrow, videos by PyAV."""

# Runs where the packages are, which the type checker may not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import PICTURE, Reading, Sources, first_episode, sample_frames, sampled_views

PACKAGES = ("av", "pyarrow")
BOUNDS = {"position": 1e-6}
CAMERA = "observation.images.camera_0"


def find(data: Path, sources: Sources) -> Path | None:
    """Folder of the LeRobot data set."""
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
    return Reading(f"{place.name}: {info['total_episodes']} episodes, {info['total_frames']} frames; {len(pictures)} pictures", values)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Cup and pictures in memory; the cup needs the trajectories (zarr)."""
    episode = data_set[min(data_set)]
    values = {"frames": np.array([len(episode), len(episode)])}
    views = sampled_views(data_set)
    if data_set.has_store:
        values["position"] = np.asarray(episode.ticks["fixture_pose"][:])[list(views), 2, :3]
    for frame, view in views.items():
        values[f"{PICTURE} {frame}"] = view.rgb / 255.0
    return values
