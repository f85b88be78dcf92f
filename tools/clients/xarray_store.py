"""xarray: trajectories of the zarr store, selected by names of dimensions."""

# Runs where the package is, which the type checker does not see.
# pyright: reportMissingImports=false

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, sample_frames

PACKAGES = ("xarray", "zarr")
ARRAYS = ("time", "object_id", "pose", "fixture_pose", "fixture_visible", "attached", "peak_force")


def find(data: Path, sources: Sources) -> Path | None:
    """Folder of the zarr store; None: there is none."""
    store = data / "trajectory.zarr"
    return store if store.is_dir() else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Arrays of the ticks at the sampled frames, and the objects' masses; coordinates along each labelled dimension."""
    import xarray

    row = first_episode(data)
    ticks = xarray.open_zarr(place, group=f"episodes/{row['episode']:06d}/ticks", consolidated=False)
    labels = ticks["pose"].attrs["labels"]
    ticks = ticks.assign_coords({name: values for name, values in labels.items() if name in ticks.dims})
    frames = sample_frames(row["frames"])
    values = {name: ticks[name].isel(tick=frames).to_numpy() for name in ARRAYS}
    height = ticks["pose"].isel(tick=frames).sel({ticks["pose"].dims[-1]: "z"})
    objects = xarray.open_zarr(place, group="objects", consolidated=False)
    values |= {"z by label": height.to_numpy(), "mass": objects["mass"].to_numpy()}
    return Reading(f"{place.name}: ticks of episode {row['episode']}, objects", values)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, read by plain zarr: arrays at the sampled frames, and masses."""
    episode = data_set[min(data_set)]
    frames = sample_frames(len(episode))
    values = {name: np.asarray(episode.ticks[name][:])[frames] for name in ARRAYS}
    masses = np.array([entry.mass for entry in data_set.objects])
    return values | {"z by label": values["pose"][..., 2], "mass": masses}
