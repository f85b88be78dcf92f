"""webdataset: shards through its own pipeline with our decoder; batches by a torch DataLoader where torch is installed."""

# webdataset does not declare its names, and torch is optional.
# pyright: reportAttributeAccessIssue=false, reportMissingImports=false

from __future__ import annotations

import importlib.util
import warnings
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import MILLIMETERS, Reading, Sources, first_episode, first_shard, sample_frames, sampled_views

PACKAGES = ("webdataset", "torch", "synpick-warp")
BOUNDS = {"depth": 1e-6}
BATCH = 2


def find(data: Path, sources: Sources) -> Path | None:
    """First shard; None: there is none."""
    return first_shard(data)


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Sampled views of the first shard; two batches with torch."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Its import looks for torch.
        import webdataset
    from synpick_warp.dataset.webdataset import decode_view

    frames = set(sample_frames(first_episode(data)["frames"]))
    values: dict[str, np.ndarray] = {}
    for frame, view in enumerate(webdataset.WebDataset(str(place), shardshuffle=False).decode(decode_view)):
        if frame not in frames:
            continue
        color = view["rgb.png"] if "rgb.png" in view else view["rgb.jpg"]
        scale = np.float32(view["camera.json"]["depth_scale"] / MILLIMETERS)
        values |= {f"rgb {frame}": color, f"depth {frame}": view["depth.png"] * scale, f"mask_visib {frame}": view["mask_visib.json"]}
        values[f"obj_id {frame}"] = np.array([row["obj_id"] for row in view["gt.json"]])
        if not view["gt.json"]:  # An entry without masks does not tell the image's size.
            values[f"mask_visib {frame}"] = np.zeros((0, *color.shape[:2]), bool)
    stock = next(iter(webdataset.WebDataset(str(place), shardshuffle=False).decode("l8")))["depth.png"]
    remarks = ["its own decoders clip depth to 0 and 255: use decode_view"] if set(np.unique(stock)) <= {0, 255} else []
    if importlib.util.find_spec("torch") is None:
        return Reading(place.name, values, [*remarks, "torch is not installed: no DataLoader"])
    import torch

    views = webdataset.WebDataset(str(place), shardshuffle=False).decode(decode_view).to_tuple("depth.png")
    batches = list(islice(torch.utils.data.DataLoader(views, batch_size=BATCH), 2))
    return Reading(f"{place.name}, {len(batches)} batches of {len(batches[0][0])}", values, remarks)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory: colour, depth, masks, obj_ids."""
    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        values |= {f"rgb {frame}": view.rgb, f"depth {frame}": view.depth, f"mask_visib {frame}": view.masks}
        values[f"obj_id {frame}"] = view.object_ids
    return values
