"""PyTorch: batches of its DataLoader with two workers, from `synpick_warp.dataset.pytorch.Views`."""

# Runs where torch is, which the type checker may not see.
# pyright: reportMissingImports=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, first_scene, first_shard, sample_frames, sampled_views

PACKAGES = ("torch", "synpick-warp")
FIELDS = ("rgb", "depth", "masks", "object_ids", "poses")
BOUNDS = {"poses": 1e-6}
BATCH, WORKERS = 2, 2


def find(data: Path, sources: Sources) -> Path | None:
    """The data set, if it has views; else None."""
    return data if first_scene(data) or first_shard(data) else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Sampled views of the first camera of the first episode, out of batches of all its frames."""
    import torch

    from synpick_warp.dataset.pytorch import Views, collate

    entry = first_episode(data)
    views = Views(data, cameras=[0], fields=FIELDS, min_visibility=0.0)
    subset = torch.utils.data.Subset(views, range(entry["frames"]))
    values: dict[str, np.ndarray] = {}
    batches = 0
    for batch in torch.utils.data.DataLoader(subset, batch_size=BATCH, num_workers=WORKERS, collate_fn=collate):
        batches += 1
        for row, frame in enumerate(batch["frame"].tolist()):
            if frame in sample_frames(entry["frames"]):
                values |= {f"{name} {frame}": batch[name][row].numpy() for name in FIELDS}
    return Reading(f"{len(views)} views; {batches} batches of {BATCH} by {WORKERS} workers", values)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory: instances with visible pixels."""
    values: dict[str, np.ndarray] = {}
    for frame, view in sampled_views(data_set).items():
        seen = view.visible_boxes[:, 2] >= 0
        values |= {f"rgb {frame}": view.rgb.transpose(2, 0, 1), f"depth {frame}": view.depth[None], f"masks {frame}": view.masks[seen]}
        values |= {f"object_ids {frame}": view.object_ids[seen], f"poses {frame}": view.object_to_camera[seen]}
    return values
