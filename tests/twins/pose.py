"""NumPy twins of pose estimation, in float64: boxes, crops, surface points, closest points, steps, light, correlation."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

CROP = 64
MARGIN = 0.06
MAX_TAPS = 8


def find_box(mask: np.ndarray) -> tuple[list[int], int]:
    """Inclusive bounding box x_min, y_min, x_max, y_max and size of a mask; of an empty one the image's size and -1."""
    rows, columns = np.nonzero(mask)
    if not rows.size:
        return [mask.shape[1], mask.shape[0], -1, -1], 0
    return [int(columns.min()), int(rows.min()), int(columns.max()), int(rows.max())], int(rows.size)


def crop_centers(corner: np.ndarray, pitch: float) -> tuple[np.ndarray, np.ndarray]:
    """Columns and rows (CROP,) [px] of the centres of a crop's pixels, in float32 like the device."""
    steps = np.arange(CROP, dtype=np.float32) + np.float32(0.5)
    return corner[0] + steps * np.float32(pitch), corner[1] + steps * np.float32(pitch)


def sample_mask(mask: np.ndarray, corner: np.ndarray, pitch: float) -> np.ndarray:
    """The mask's pixels at the centres of the crop's pixels (CROP, CROP) bool; outside of the image False."""
    x, y = (np.floor(line).astype(int) for line in crop_centers(corner, pitch))
    padded = np.pad(mask, CROP)
    return padded[np.clip(y + CROP, 0, padded.shape[0] - 1)][:, np.clip(x + CROP, 0, padded.shape[1] - 1)]


def on_borders(corner: np.ndarray, pitch: float, tolerance: float = 1e-4) -> np.ndarray:
    """Crop pixels (CROP, CROP) bool with a tap within `tolerance` [px] of the border of two image pixels."""
    taps = int(np.clip(np.rint(pitch), 1, MAX_TAPS))
    near = []
    for begin in corner:
        steps = np.concatenate((np.arange(CROP)[:, None] + (np.arange(taps) + 0.5) / taps, np.arange(CROP)[:, None] + 0.5), axis=1)
        place = begin + steps * pitch
        near.append((np.abs(place - np.rint(place)) < tolerance).any(axis=1))
    return near[1][:, None] | near[0][None, :]


def sample_color(linear: np.ndarray, mask: np.ndarray, corner: np.ndarray, pitch: float) -> np.ndarray:
    """Mean of the linear image (H, W, 3) at regular taps in each crop pixel's footprint that the mask shows; the edge is repeated."""
    height, width = linear.shape[:2]
    taps = int(np.clip(np.rint(pitch), 1, MAX_TAPS))
    steps = (np.arange(CROP)[:, None] + (np.arange(taps) + 0.5) / taps).reshape(-1)
    x = np.clip(np.floor(corner[0] + steps * pitch).astype(int), 0, width - 1)
    y = np.clip(np.floor(corner[1] + steps * pitch).astype(int), 0, height - 1)
    weights = mask[y][:, x].astype(np.float64)[..., None]
    sums = [(values[y][:, x] * weights).reshape(CROP, taps, CROP, taps, -1).sum(axis=(1, 3)) for values in (linear, np.ones_like(linear))]
    return sums[0] / np.maximum(sums[1], 1.0)


def chosen_ranks(total: int, capacity: int) -> np.ndarray:
    """Ranks of the points that are taken of `total`: of each i < min(total, capacity) the first r with ⌊r n / total⌋ = i."""
    count = min(total, capacity)
    return np.ceil(np.arange(count) * total / max(count, 1)).astype(int)


def closest_points(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Closest points (N, 3) of a mesh by brute force: the plane's foot where it lies in a triangle, else the closest point of the edges."""
    best, distance = np.zeros_like(points), np.full(len(points), np.inf)
    for corners in vertices[faces].astype(np.float64):
        candidates = [_on_segment(points, corners[i], corners[(i + 1) % 3]) for i in range(3)]
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
        normal /= np.linalg.norm(normal)
        foot = points - ((points - corners[0]) @ normal)[:, None] * normal
        inside = np.logical_and.reduce([np.cross(corners[(i + 1) % 3] - corners[i], foot - corners[i]) @ normal >= 0.0 for i in range(3)])
        candidates.append(np.where(inside[:, None], foot, np.inf))
        for found in candidates:
            away = np.linalg.norm(points - found, axis=1)
            nearer = away < distance
            best[nearer], distance[nearer] = found[nearer], away[nearer]
    return best


def _on_segment(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    along = end - start
    place = np.clip((points - start) @ along / (along @ along), 0.0, 1.0)
    return start + place[:, None] * along


def stepped(pose: np.ndarray, step: np.ndarray, radius: float) -> tuple[Rotation, np.ndarray]:
    """Rotation and translation of a pose (7,) after a step (w, v) [m]: turned by w / radius about its origin, and moved by v."""
    return Rotation.from_rotvec(step[:3] / radius) * Rotation.from_quat(pose[3:]), pose[:3].astype(np.float64) + step[3:]


def surface_energy(pose: np.ndarray, step: np.ndarray, radius: float, points: np.ndarray, mesh) -> float:
    """Half the sum of squared distances [m²] from points (N, 3) to a mesh in the stepped pose."""
    rotation, translation = stepped(pose, step, radius)
    local = rotation.inv().apply(points - translation)
    return 0.5 * float(((local - closest_points(local, mesh.vertices, mesh.faces)) ** 2).sum())


def numeric_gradient(energy, size: int = 6, step: float = 1e-5) -> np.ndarray:
    """Central differences of a function of a step (6,)."""
    units = np.eye(size) * step
    return np.array([(energy(unit) - energy(-unit)) / (2.0 * step) for unit in units])


def bilinear(image: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Bilinear values (N, C) of an image (H, W, C) at (column, row) relative to the first pixel's centre."""
    column, row = np.floor(place).astype(int).T
    u, v = (place - np.floor(place)).T[..., None]
    upper = (1.0 - u) * image[row, column] + u * image[row, column + 1]
    lower = (1.0 - u) * image[row + 1, column] + u * image[row + 1, column + 1]
    return (1.0 - v) * upper + v * lower


def fit_light(normal: np.ndarray, base: np.ndarray, intensity: np.ndarray, weight: np.ndarray, ridge: float) -> np.ndarray:
    """Weighted ridge regression: b, b₀ (4,) of intensity = base (b₀ + b · normal) for one channel; the ridge on b is relative."""
    rows = base[:, None] * np.concatenate([normal, np.ones((len(normal), 1))], axis=1)
    moments = rows.T @ (weight[:, None] * rows)
    moments[range(3), range(3)] += ridge * moments[3, 3]
    return np.linalg.solve(moments, rows.T @ (weight * intensity))


def correlation(intensity: np.ndarray, base: np.ndarray) -> float:
    """Correlation coefficient of colours (N, 3) after each channel's mean is removed."""
    return float(np.corrcoef((intensity - intensity.mean(axis=0)).ravel(), (base - base.mean(axis=0)).ravel())[0, 1])
