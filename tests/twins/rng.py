"""Counter-based SplitMix64 in NumPy: the twin of kernels.rng. All functions take arrays as well as scalars."""

import numpy as np

GAMMA = np.uint64(0x9E3779B97F4A7C15)


def mix(x: np.ndarray | np.uint64) -> np.ndarray:
    with np.errstate(over="ignore"):
        y = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        y = (y ^ (y >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        return y ^ (y >> np.uint64(31))


def stream_key(seed, episode, arrangement, stream) -> np.ndarray:
    """Key of a stream of an episode's arrangement; negative values wrap around."""
    with np.errstate(over="ignore"):
        key = mix(np.uint64(seed) + GAMMA)
        for part in (episode, arrangement, stream):
            key = mix((key ^ np.asarray(part, np.int64).astype(np.uint64)) + GAMMA)
    return key


def bits(key, index) -> np.ndarray:
    """Sample `index` of a stream, 64 bits."""
    with np.errstate(over="ignore"):
        return mix(key + (np.asarray(index, np.int64).astype(np.uint64) + np.uint64(1)) * GAMMA)


def uniform(key, index) -> np.ndarray:
    """Sample `index` of a stream in [0, 1), float32: its upper 24 bits."""
    return (bits(key, index) >> np.uint64(40)).astype(np.float32) * np.float32(2.0**-24)


def uniform_index(key, index, count) -> np.ndarray:
    """Sample `index` of a stream in [0, count)."""
    return np.minimum((uniform(key, index) * np.float32(count)).astype(np.int32), count - 1)


def uniform_rotation(key, index) -> np.ndarray:
    """Shoemake's uniform rotation as a quaternion x, y, z, w (..., 4) float64, from samples index to index + 2."""
    u, a, b = (uniform(key, np.asarray(index) + step).astype(np.float64) for step in range(3))
    low, high = np.sqrt(1 - u), np.sqrt(u)
    a, b = 2 * np.pi * a, 2 * np.pi * b
    return np.stack([low * np.sin(a), low * np.cos(a), high * np.sin(b), high * np.cos(b)], axis=-1)
