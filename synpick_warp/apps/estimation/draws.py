"""Counter-based random numbers on the host: SplitMix64 keyed by seed, scene, frame, stream and instance, as `kernels.rng` in NumPy.

Samples depend neither on the order in which views are read nor on which views are read at all.
"""

from __future__ import annotations

import enum

import numpy as np

# γ and the two multipliers of SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), and the samples' 24 bits; see `kernels.rng`.
_GAMMA = np.uint64(0x9E3779B97F4A7C15)
_MIX_A = np.uint64(0xBF58476D1CE4E5B9)
_MIX_B = np.uint64(0x94D049BB133111EB)
_UNIT = 2.0**-24


class Draw(enum.IntEnum):
    """Random number stream of an estimation. The streams of a bake (`codes.Stream`) are others."""

    MASK_ERROR = 101
    DISTURBANCE = 102


def sample_uniform(seed: int, scene: int, frame: int, stream: Draw, instances: np.ndarray, count: int) -> np.ndarray:
    """Samples of each instance of an image.

    Args:
        seed: Seed of the estimation, from 0 to 2⁶³ - 1.
        scene: Index of the scene.
        frame: Index of the image in the scene.
        stream: Purpose of the samples.
        instances: Instance indices (N,).
        count: Number of samples an instance.

    Returns:
        (N, count) float64, uniform in [0, 1).
    """
    with np.errstate(over="ignore"):
        key = _mix(np.uint64(seed) + _GAMMA)
        for part in (scene, frame, int(stream)):
            key = _mix((key ^ np.uint64(part)) + _GAMMA)
        keys = _mix((key ^ np.asarray(instances, np.int64).astype(np.uint64)) + _GAMMA)
        bits = _mix(keys[:, None] + np.arange(1, 1 + count, dtype=np.uint64) * _GAMMA)
    return (bits >> np.uint64(40)).astype(np.float64) * _UNIT


def _mix(x: np.ndarray | np.uint64) -> np.ndarray:
    """Output function of SplitMix64: a bijective 64-bit hash."""
    y = (x ^ (x >> np.uint64(30))) * _MIX_A
    y = (y ^ (y >> np.uint64(27))) * _MIX_B
    return np.asarray(y ^ (y >> np.uint64(31)))
