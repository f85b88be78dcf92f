"""Training samples of pickers: images of camera 0 at the states of a data set, and the simulated picks from them. Needs PyTorch."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch  # pyright: ignore[reportMissingImports]

import synpick_warp
from synpick_warp.dataset.grasp_maps import find_pixels
from synpick_warp.dataset.reading import Episode
from synpick_warp.dataset.view import View
from synpick_warp.errors import DatasetError
from synpick_warp.system.processes.threads import map_in_threads
from tools.examples.picking_scores import Sight

MAPS = ("suction_seal", "suction_wrench")
"""Layers of the analytic maps."""
_KEPT = ("frame", "candidate", "repeat", "obj_id", "share", "weight", "seal", "wrench", "success", "intended")


@dataclass(frozen=True, eq=False)
class Samples:
    """Training samples: images of camera 0 at the states of a data set, and the trials with their state and pixel."""

    sight: Sight
    """Images on the CPU, a row for each state."""
    maps: torch.Tensor | None
    """Analytic seal and wrench maps (state, 2, H, W) float16; None: the data set has none."""
    episode: np.ndarray
    """Episode of each state (state) int."""
    trials: dict[str, np.ndarray]
    """Columns of the trials, and `state`, `x` and `y` [px] (trial); sorted by state."""

    def part(self, states: np.ndarray) -> Samples:
        """Subset of the states, in ascending order: their images, and their trials, whose `state` becomes the position in `states`."""
        place = np.full(len(self.episode), -1)
        place[states] = np.arange(len(states))
        kept = place[self.trials["state"]] >= 0
        rows = {name: values[kept] for name, values in self.trials.items()}
        chosen = torch.from_numpy(states)
        maps = None if self.maps is None else self.maps[chosen]
        return Samples(self.sight.part(chosen), maps, self.episode[states], rows | {"state": place[rows["state"]]})


@dataclass(frozen=True, eq=False)
class _Shot:
    """Image of a state (H, W), analytic maps (2, H, W) or None, focal length [px] and columns of its trials."""

    depth: np.ndarray
    instance: np.ndarray
    maps: np.ndarray | None
    focal: float
    trials: dict[str, np.ndarray]


def load_samples(folder: Path) -> Samples:
    """Read all states of a data set with picks and images of camera 0, on all cores; raises DatasetError if it lacks them."""
    data = synpick_warp.open(folder)
    read = map_in_threads(lambda index: _read_episode(data[index]), list(data))
    shots = [shot for part in read for shot in part]
    if not shots:
        raise DatasetError(
            f"{folder} has no state that was tried and is in a picture; bake it with picks.candidates and --formats shards,picks"
        )
    images = [torch.from_numpy(np.stack([getattr(shot, name) for shot in shots])) for name in ("depth", "instance")]
    known = [shot.maps for shot in shots if shot.maps is not None]
    maps = torch.from_numpy(np.stack(known)) if len(known) == len(shots) else None
    columns = {name: np.concatenate([shot.trials[name] for shot in shots]) for name in shots[0].trials}
    columns["state"] = np.repeat(np.arange(len(shots)), [len(shot.trials["x"]) for shot in shots])
    episode = np.repeat(list(data), [len(part) for part in read])
    return Samples(Sight(*images, shots[0].focal), maps, episode, columns)


def _read_episode(episode: Episode) -> list[_Shot]:
    """Shots of the states of an episode that are in a picture."""
    trials, shots = episode.picks, []
    for state in episode.pick_states:
        if int(state["frame"]) in episode.frames(int(state["camera"])):
            view = episode.view(int(state["frame"]), int(state["camera"]))
            shots.append(_read_shot(view, trials[trials["state"] == state["state"]]))
    return shots


def _read_shot(view: View, trials: np.ndarray) -> _Shot:
    """Image of a view, with the trials whose grasp points it contains."""
    pixels = find_pixels(view, trials)
    inside = ((pixels >= 0) & (pixels < view.size)).all(axis=1)
    rows = {name: np.asarray(trials[name][inside]) for name in _KEPT} | {"x": pixels[inside, 0], "y": pixels[inside, 1]}
    instance = np.zeros(view.depth.shape, np.uint8)
    for index, mask in enumerate(view.masks):
        instance[mask] = index + 1
    maps = np.stack([view.layer(name) for name in MAPS]).astype(np.float16) if set(MAPS) <= set(view.layers) else None
    return _Shot(view.depth, instance, maps, float(view.intrinsics[0, 0]), rows)
