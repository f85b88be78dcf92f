"""Likeness of an object in an image and in its twin: a score from 0 to 1 without training, appearance times geometry.

The product is that of SADGE (Bartkowiak et al., 2026), which compares features of trained networks; here both factors are plain statistics.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

LIGHTNESS = 100.0
"""Distance of black and white in CIELAB, at which colours have nothing in common."""
ROUNDING = 1.0 / (255.0 * 12.0**0.5)
"""Standard deviation of rounding to 8 bits: less detail than this is none."""
DEPTH_TOLERANCE = 0.1
"""Largest deviation of depth that agrees, as a fraction of the object's diameter (Hinterstoisser et al., ACCV 2012)."""
_LEVELS = 255.0
"""Largest value of 8 bits."""
_DETAIL, _LAB = 2, 3
"""Columns of detail, and of the first of three CIELAB coordinates, in features."""


class Appearance(NamedTuple):
    """Statistics of an object's sRGB pixels, in 0..1: mean and standard deviation of grey values, mean saturation (of HSV), and standard
    deviation of grey values less those blurred by 1 px (texture, sharpening, noise)."""

    brightness: float
    contrast: float
    saturation: float
    detail: float


@dataclass(frozen=True)
class Likeness:
    """Comparison of an object in an image and in its twin; without pixels in common both statistics are None, and all factors 0."""

    obj_id: int
    image: Appearance | None
    twin: Appearance | None
    appearance: float
    geometry: float
    score: float


def find_features(color: np.ndarray) -> np.ndarray:
    """Features (H, W, 6) float32 of an image (H, W, 3) uint8: grey value, saturation, detail, and CIELAB."""
    values = color.astype(np.float32) / _LEVELS
    grey, high, low = values.mean(axis=2), values.max(axis=2), values.min(axis=2)
    detail = grey - cv2.GaussianBlur(grey, (0, 0), 1.0)
    return np.dstack([grey, (high - low) / np.maximum(high, 1.0 / _LEVELS), detail, cv2.cvtColor(values, cv2.COLOR_RGB2LAB)])


def measure_appearance(pixels: np.ndarray) -> Appearance:
    """Appearance of pixels, at least one, by their features (n, 6)."""
    grey, saturation, detail = pixels.T[:_LAB]
    return Appearance(*map(float, (grey.mean(), grey.std(), saturation.mean(), detail.std())))


def compare_appearance(image: np.ndarray, twin: np.ndarray) -> float:
    """Similarity of the appearance of two sets of pixels, by their features (n, 6), from 0 to 1: that of colours, which falls with the
    Wasserstein distance of normal distributions with their means and covariances, times the ratio of details."""
    (mean, covariance), (other, spread) = ((lab.mean(axis=1), np.cov(lab, bias=True)) for lab in (image.T[_LAB:], twin.T[_LAB:]))
    roots = np.sqrt(np.linalg.eigvals(covariance @ spread).real.clip(0.0)).sum()
    distance = np.sqrt(((mean - other) ** 2).sum() + max(0.0, np.trace(covariance + spread) - 2.0 * roots))
    less, more = sorted(float(pixels[:, _DETAIL].std()) + ROUNDING for pixels in (image, twin))
    return float(max(0.0, 1.0 - distance / LIGHTNESS) * less / more)


def compare_objects(obj_id: int, image: np.ndarray, twin: np.ndarray, geometry: float) -> Likeness:
    """Likeness of an object from the features (n, 6) of its pixels in image and twin, if there are any, and the agreement of geometry."""
    if not len(image):
        return Likeness(obj_id, None, None, 0.0, geometry, 0.0)
    appearance = compare_appearance(image, twin)
    return Likeness(obj_id, measure_appearance(image), measure_appearance(twin), appearance, geometry, appearance * geometry)


def average(found: Iterable[Likeness]) -> list[Likeness]:
    """Means over the likenesses of each object, by obj_id."""
    groups = dict[int, list[Likeness]]()
    for one in found:
        groups.setdefault(one.obj_id, []).append(one)
    return [_mean(index, group) for index, group in sorted(groups.items())]


def _mean(obj_id: int, group: list[Likeness]) -> Likeness:
    pairs = np.array([(one.image, one.twin) for one in group if one.image is not None]).reshape(-1, 2, len(Appearance._fields))
    image, twin = (Appearance(*each) for each in pairs.mean(axis=0).tolist()) if len(pairs) else (None, None)
    appearance, geometry, score = np.mean([(one.appearance, one.geometry, one.score) for one in group], axis=0).tolist()
    return Likeness(obj_id, image, twin, appearance, geometry, score)


def compare_geometry(
    rendered: np.ndarray, depth: np.ndarray, annotated: np.ndarray | None, measured: np.ndarray | None, tolerance: float | None
) -> float:
    """Agreement of a rendered object with an image, from 0 to 1: the share of its annotated visible pixels (H, W) bool that are `rendered`,
    times the share of these whose depth agrees with the measured one up to `tolerance`; depth (H, W) in m, 0: none. What is None, or depth
    that no pixel has in both, is left out. Pixels that something without annotation may hide do not count."""
    overlap, result = rendered if annotated is None else rendered & annotated, 1.0
    if annotated is not None:
        result = np.count_nonzero(overlap) / max(1, np.count_nonzero(annotated))
    if measured is not None and tolerance is not None and (both := overlap & (measured > 0) & (depth > 0)).any():
        result *= (np.abs(measured[both] - depth[both]) <= tolerance).mean()
    return float(result)
