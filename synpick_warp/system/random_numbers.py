"""Counter-based random number generator on the host: `kernels.rng` (SplitMix64, Steele, Lea and Flood, OOPSLA 2014) in whole numbers."""

from __future__ import annotations

_GAMMA, _MIX_A, _MIX_B = 0x9E3779B97F4A7C15, 0xBF58476D1CE4E5B9, 0x94D049BB133111EB
_MASK = 2**64 - 1


def stream_key(seed: int, *parts: int) -> int:
    """Key of a stream of random numbers: of the seed, then of episode, arrangement and `Stream`, and within it of further whole numbers."""
    key = _mix(seed + _GAMMA)
    for part in parts:
        key = _mix((key ^ (part & _MASK)) + _GAMMA)
    return key


def uniform(key: int, index: int) -> float:
    """Sample `index` of a stream, uniform in [0, 1): the upper 24 bits."""
    return (_mix(key + (index + 1) * _GAMMA) >> 40) * 2.0**-24


def _mix(x: int) -> int:
    """Output function of SplitMix64: a bijective 64-bit hash."""
    x &= _MASK
    y = (x ^ (x >> 30)) * _MIX_A & _MASK
    y = (y ^ (y >> 27)) * _MIX_B & _MASK
    return y ^ (y >> 31)
