"""Hugging Face `datasets`: shards by `load_dataset("webdataset")`, offline, with a cache in a temporary folder."""

# Runs where the package is, which the type checker does not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, first_shard, sample_frames, sampled_views

PACKAGES = ("datasets", "pillow")


def find(data: Path, sources: Sources) -> Path | None:
    """Folder of the first shard; None: there is none."""
    shard = first_shard(data)
    return None if shard is None else shard.parent


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Sampled views, streamed: depth with all its bits, colour, obj_id."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    with tempfile.TemporaryDirectory() as cache:
        os.environ["HF_HOME"] = cache
        import datasets

        # BOP's key_to_shard.json lies beside the shards, hence the pattern.
        stream = datasets.load_dataset("webdataset", data_dir=str(place), data_files="*.tar", streaming=True, cache_dir=cache)
        split = next(iter(stream))
        frames = set(sample_frames(first_episode(data)["frames"]))
        values: dict[str, np.ndarray] = {}
        for index, row in enumerate(stream[split]):
            if index in frames:
                color = row["rgb.png"] if "rgb.png" in row else row["rgb.jpg"]
                values |= {f"rgb {index}": np.asarray(color), f"depth count {index}": np.asarray(row["depth.png"]).astype(np.int64)}
                values[f"obj_id {index}"] = np.array([entry["obj_id"] for entry in row["gt.json"]])
            if index >= max(frames):
                break
    return Reading(f"{place.name}, split {split}", values)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory; depth as counts, which are integers."""
    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        scale = np.float32(view.records.camera["depth_scale"] / 1000.0)
        values |= {f"rgb {frame}": view.rgb, f"depth count {frame}": np.rint(view.depth / scale).astype(np.int64)}
        values[f"obj_id {frame}"] = view.object_ids
    return values
