"""Random numbers and low-discrepancy sequences on the host, which follow from keys and counts alone.

A counter-based generator, `kernels.rng` (SplitMix64, Steele, Lea and Flood, OOPSLA 2014), in whole numbers. Points that fill an interval or
a square evenly for any count, and points of triangles by area: the golden-ratio (Kronecker) sequence in one dimension, R2 in two (Roberts,
The unreasonable effectiveness of quasirandom sequences, 2018).
"""

import numpy as np

GAMMA, _MIX_A, _MIX_B = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_MASK = 2**64 - 1


def stream_key(seed: int, *parts: int) -> int:
    """Key of a stream of random numbers: of the seed, then of episode, arrangement and `Stream`, and within it of further whole numbers."""
    key = mix(seed + GAMMA)
    for part in parts:
        key = mix((key ^ (part & _MASK)) + GAMMA)
    return key


def uniform(key: int, index: int) -> float:
    """Sample `index` of a stream, uniform in [0, 1): the upper 24 bits."""
    return (mix(key + (index + 1) * GAMMA) >> 40) * 2.0**-24


def mix(x: int) -> int:
    """Output function of SplitMix64: a bijective 64-bit hash."""
    x &= _MASK
    y = (x ^ (x >> 30)) * _MIX_A & _MASK
    y = (y ^ (y >> 27)) * _MIX_B & _MASK
    return y ^ (y >> 31)


_GOLDEN_STEP = (np.sqrt(5.0) - 1.0) / 2.0
"""1 / golden ratio."""
_PLASTIC = 1.324717957244746
"""Plastic number p, the real root of p³ = p + 1."""


def r2_points(index: np.ndarray, start: float = 0.0) -> np.ndarray:
    """Points of the R2 sequence in the unit square (N, 2): multiples of 1 / p and 1 / p², from `start`, modulo 1, for indices (N)."""
    return np.mod(start + index[:, None] / _PLASTIC ** np.array([1.0, 2.0]), 1.0)


def sample_triangles(areas: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Sample points of triangles evenly by area. `areas`: (F), in any unit. `count`: number of points S. Returns the triangle (S) of each
    point by a golden-ratio sequence over the cumulative area, and its barycentric weights (S, 3) by R2."""
    cumulative = np.cumsum(areas)
    index = np.arange(1, count + 1)
    place = np.mod(index * _GOLDEN_STEP, 1.0) * cumulative[-1]
    face = np.minimum(np.searchsorted(cumulative, place, side="right"), len(areas) - 1)
    u, v = r2_points(index).T
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    return face, np.stack([1.0 - u - v, u, v], axis=1)
