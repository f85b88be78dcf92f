"""Sampling of modes, objects and drop poses in NumPy, from the laws in the docstrings of kernels.sim.arrangement and drop."""

from dataclasses import dataclass

import numpy as np

from synpick_warp.codes import Stream
from tests.twins import rng

MAX_SAMPLES = 4096
MODE_ORDER = (1, 2, 0)
"""Codes of the modes in the order of their weights: pick, target, move."""


@dataclass(frozen=True)
class Arrangement:
    """Sampled catalog indices, body slots, and whether slots ran out."""

    entries: tuple[int, ...]
    slots: tuple[int, ...]
    overflow: bool = False


def sample_modes(seed: int, episodes: np.ndarray, weights: tuple[float, float, float]) -> np.ndarray:
    """Mode of each episode: the first whose cumulative fraction of the weights exceeds the episode's sample."""
    sample = rng.uniform(rng.stream_key(seed, episodes, 0, Stream.MODE), 0)
    share = (np.cumsum(weights) / np.sum(weights)).astype(np.float32)
    return np.array(MODE_ORDER)[np.searchsorted(share, sample, side="right")]


def sample_objects(
    seed: int,
    episode: int,
    arrangement: int,
    *,
    volume: np.ndarray,
    compound: np.ndarray,
    budget: float,
    exceed: bool,
    repeats: bool,
    room: int,
    single_slots: int,
    compound_slots: int,
) -> Arrangement:
    """Sample until the total reaches the budget (`exceed`), or until the next object would exceed it; sums in float32, as on the device."""
    key = rng.stream_key(seed, episode, arrangement, Stream.OBJECTS)
    sequence = rng.uniform_index(key, np.arange(MAX_SAMPLES), len(volume))
    entries: list[int] = []
    slots: list[int] = []
    free = {False: list(range(single_slots)), True: list(range(single_slots, single_slots + compound_slots))}
    total = np.float32(0.0)
    for candidate in map(int, sequence):
        if not repeats and candidate in entries:
            continue
        following = total + np.float32(volume[candidate])
        if (np.float32(volume[candidate]) if exceed else following) > np.float32(budget):
            if entries and not exceed:
                break
            continue
        if not free[bool(compound[candidate])]:
            return Arrangement((), (), overflow=True)
        entries.append(candidate)
        slots.append(free[bool(compound[candidate])].pop(0))
        total = following
        if (exceed and total >= np.float32(budget)) or len(entries) == room or (not repeats and len(entries) == len(volume)):
            break
    return Arrangement(tuple(entries), tuple(slots))


def draw_counted(seed: int, episode: int, arrangement: int, counts: list[tuple[int, int]]) -> list[int]:
    """Entries of an episode: each as often as drawn from its least to its largest number, then swapped from the last one down."""
    key, entries = rng.stream_key(seed, episode, arrangement, Stream.OBJECTS), []
    for entry, (low, high) in enumerate(counts):
        entries += [entry] * (low + int(rng.uniform_index(key, entry, high - low + 1)))
    for instance in range(len(entries) - 1, 0, -1):
        other = int(rng.uniform_index(key, len(counts) + instance, instance + 1))
        entries[instance], entries[other] = entries[other], entries[instance]
    return entries


def layer_places(
    compartments: np.ndarray, pitch: float, centers: np.ndarray, halves: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Layer, centre (2) and half extents (2) of the cell of each place, from the compartments of all places, in order."""
    layers, middles, cells = [], [], []
    for place, compartment in enumerate(compartments):
        grid = np.maximum(1, (2 * halves[compartment] / pitch).astype(int))
        layer, index = divmod(int((compartments[:place] == compartment).sum()), int(grid.prod()))
        cell = halves[compartment] / grid
        layers.append(layer)
        middles.append(centers[compartment] - halves[compartment] + cell * (1 + 2 * np.array([index % grid[0], index // grid[0]])))
        cells.append(cell)
    return np.array(layers), np.array(middles), np.array(cells)


def drop_poses(
    seed: int, episode: int, arrangement: int, radius: np.ndarray, *, rim: tuple[float, float, float], clearance: float, spread: float
) -> np.ndarray:
    """Poses (instance, 7) of the drop column of bounding spheres: z_i = rim + r_i + sum over j < i of (2 r_j + clearance)."""
    count = len(radius)
    key = rng.stream_key(seed, episode, arrangement, Stream.DROP)
    poses = np.zeros((count, 7))
    for axis in range(2):
        side = 2.0 * rng.uniform(key, 5 * np.arange(count) + axis).astype(np.float64) - 1.0
        poses[:, axis] = side * spread * np.maximum(0.0, rim[axis] / 2 - radius)
    poses[:, 2] = rim[2] + radius + np.cumsum(2 * radius + clearance) - (2 * radius + clearance)
    poses[:, 3:] = rng.uniform_rotation(key, 5 * np.arange(count) + 2)
    return poses
