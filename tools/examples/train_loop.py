"""Train on webdataset shards: a PyTorch-style loop over shuffled batches, with a small NumPy model in place of a network.

The model is a logistic regression of "is there an object at this pixel?" on colour and depth. With PyTorch, wrap the same `batches` in
a `DataLoader` with `batch_size=None`.

    python -m tools.examples.train_loop DATA
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import webdataset

import synpick_warp
from synpick_warp.dataset.webdataset import decode_view

SETTINGS = {"bake.episodes": 1, "bake.worlds": 1, "bake.formats": ["shards"]}
BATCH_SIZE = 8
EPOCHS = 3
LEARNING_RATE = 0.5


def prepare(sample: dict[str, Any]) -> dict[str, np.ndarray]:
    """One view: image (H, W, 3) float32 from 0 to 1, depth (H, W) float32 [m], foreground (H, W) bool."""
    image = sample["rgb.png"] if "rgb.png" in sample else sample["rgb.jpg"]
    depth = sample["depth.png"] * np.float32(sample["camera.json"]["depth_scale"] / 1000.0)
    masks = sample["mask_visib.json"]
    foreground = masks.any(axis=0) if len(masks) else np.zeros(depth.shape, bool)
    return {"image": image / np.float32(255), "depth": depth, "foreground": foreground}


def batches(folder: Path, seed: int) -> Iterator[dict[str, np.ndarray]]:
    """Shuffled batches of views: the same keys, with a first dimension of at most BATCH_SIZE."""
    shards = sorted(str(path) for path in folder.glob("*_web/shard-*.tar"))
    views = webdataset.WebDataset(shards, shardshuffle=len(shards), seed=seed).shuffle(100, seed=seed).decode(decode_view).map(prepare)
    for batch in views.batched(BATCH_SIZE, collation_fn=None):
        yield {name: np.stack([view[name] for view in batch]) for name in batch[0]}


class PixelClassifier:
    """Logistic regression per pixel, trained by gradient descent."""

    def __init__(self) -> None:
        self.weights = np.zeros(5)

    def step(self, batch: dict[str, np.ndarray]) -> float:
        """Forward pass, gradient, update; returns the mean cross entropy."""
        depth = (batch["depth"] - 2.0)[..., None]  # Cameras are about 2 m above the tote.
        inputs = np.concatenate((batch["image"], depth, np.ones_like(depth)), axis=-1).reshape(-1, 5)
        target = batch["foreground"].reshape(-1)
        logits = inputs @ self.weights
        loss = np.mean(np.logaddexp(0.0, logits) - target * logits)
        self.weights -= LEARNING_RATE * inputs.T @ (1.0 / (1.0 + np.exp(-logits)) - target) / len(target)
        return float(loss)


def main(arguments: list[str] | None = None) -> None:
    """Bake if needed, train, check that the loss falls."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="data set with shards; baked if there is none")
    given = parser.parse_args(arguments)
    if not given.folder.exists():
        synpick_warp.bake("smoke", given.folder, SETTINGS)

    model, losses = PixelClassifier(), []
    for epoch in range(EPOCHS):
        losses.append(np.mean([model.step(batch) for batch in batches(given.folder, epoch)]))
        print(f"epoch {epoch}: cross entropy {losses[-1]:.4f}")
    if not losses[-1] < losses[0]:
        raise SystemExit("the loss did not fall")


if __name__ == "__main__":
    main()
