"""Semi-global matching of a rectified pair, written from its formulas in NumPy."""

from __future__ import annotations

import numpy as np

RADIUS, BITS, SMALL, LARGE = 3, 24, 8, 32


def census(image: np.ndarray) -> np.ndarray:
    """Centre-symmetric census (H, W, BITS) bool: whether a pixel of the window is brighter than the opposite one."""
    height, width = image.shape
    padded = np.pad(image, RADIUS, mode="edge")
    offsets = [(down, right) for down in range(-RADIUS, 1) for right in range(-RADIUS, RADIUS + 1) if down < 0 or right < 0]

    def moved(down: int, right: int) -> np.ndarray:
        return padded[RADIUS + down : RADIUS + down + height, RADIUS + right : RADIUS + right + width]

    return np.stack([moved(down, right) > moved(-down, -right) for down, right in offsets], axis=-1)


def matching_costs(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> np.ndarray:
    """Hamming distance of each pixel of the left image to its partner (H, W, disparity); BITS without a partner."""
    ours, theirs = census(left), census(right)
    costs = np.full((*left.shape, count), BITS)
    for index in range(count):
        shift = lowest + index
        if shift < left.shape[1]:
            costs[:, shift:, index] = (ours[:, shift:] != theirs[:, : left.shape[1] - shift]).sum(axis=-1)
    return costs


def path_costs(costs: np.ndarray) -> np.ndarray:
    """Sum over paths to the right, to the left, down and up of L(p, d), as of Hirschmüller (2008)."""
    total = np.zeros_like(costs)
    for axis in (0, 1):
        for backwards in (False, True):
            lines = np.moveaxis(costs, axis, 0)
            lines = lines[::-1] if backwards else lines
            result = np.empty_like(lines)
            last = np.zeros_like(lines[0])
            for step, cost in enumerate(lines):
                least = last.min(axis=-1, keepdims=True)
                beside = np.pad(last, ((0, 0), (1, 1)), constant_values=10**6)
                beside = np.minimum(beside[:, :-2], beside[:, 2:]) + SMALL
                last = cost + np.minimum(np.minimum(last, beside), least + LARGE) - least
                result[step] = last
            total += np.moveaxis(result[::-1] if backwards else result, 0, axis)
    return total
