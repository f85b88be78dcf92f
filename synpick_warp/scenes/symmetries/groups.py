"""Finite groups of rotations about a point: closure under composition, and exact elements from approximate ones."""

from __future__ import annotations

import numpy as np

from synpick_warp.system.linear_algebra import DECIMALS, matmul, nearest_rotation

MAX_ELEMENTS = 144
"""Largest group: dihedral ones have two elements for each fold; the rotations of the icosahedron are 60."""
_EQUAL = 1.0
"""Angle up to which two declared rotations are the same [°]: their matrices are rounded."""


def find_element(elements: np.ndarray, rotation: np.ndarray, within: float = _EQUAL) -> int:
    """Index of the element (N, 3, 3) that a rotation equals within an angle [°]; -1: none."""
    traces = np.einsum("nij,ij->n", elements, rotation)
    best = int(np.argmax(traces))
    return best if np.sqrt(max(1.0 + traces[best], 0.0)) / 2.0 >= np.cos(np.radians(within / 2.0)).round(DECIMALS) else -1


def close_transforms(matrices: list[np.ndarray]) -> list[np.ndarray] | None:
    """The rigid 4 x 4 matrices as they are, and all of their products that have other rotations; without the identity. None if they are
    more than MAX_ELEMENTS."""
    elements = [np.eye(4), *matrices]
    at = 1
    while at < len(elements):
        for matrix in matrices:
            product = matmul(elements[at], matrix)
            if find_element(np.array(elements)[:, :3, :3], product[:3, :3]) < 0:
                elements.append(product)
                if len(elements) > MAX_ELEMENTS:
                    return None
        at += 1
    return elements[1:]


def close_group(generators: np.ndarray, within: float) -> np.ndarray | None:
    """All products of rotations (N, 3, 3), with the identity first; None if they are more than MAX_ELEMENTS, or no group.

    Products within an angle [°] of an element count as it, so that axes which were found with errors of a degree still generate a finite
    group; `make_exact` then removes the errors.
    """
    elements = np.eye(3)[None]
    at = 0
    while at < len(elements):
        for generator in generators:
            product = matmul(elements[at], generator)
            if find_element(elements, product, within) < 0:
                elements = np.concatenate([elements, product[None]])
                if len(elements) > MAX_ELEMENTS:
                    return None
        at += 1
    return make_exact(elements, within)


def make_exact(elements: np.ndarray, within: float) -> np.ndarray | None:
    """Exact group closest to rotations (N, 3, 3) that are a group up to an angle [°]; None if there is none.

    Element a becomes the mean over all b of (a b) b⁻¹ (Grove, Karcher and Ruh, 1974), which converges quadratically, and then the
    rotation next to it.
    """
    count = len(elements)
    table = np.array([[find_element(elements, matmul(a, b), within) for b in elements] for a in elements])
    if (table < 0).any() or any(len(set(row)) < count for row in table):
        return None
    for _ in range(8):
        elements = nearest_rotation(np.einsum("abij,bkj->aik", elements[table], elements) / count)
    return elements


def describe_counts(discrete: int, continuous: int) -> str:
    """Text on the numbers of an object's symmetries."""
    return ", ".join(f"{count} {kind}" for count, kind in ((discrete, "discrete"), (continuous, "continuous")) if count) or "none"
