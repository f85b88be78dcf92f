"""Keypoints of objects in COCO annotations: points of the surface by farthest point sampling, with visibility from the depth image.

PVNet (Peng et al., CVPR 2019) found such points easier to locate than the corners of the bounding box. Here they have one more advantage:
they lie on the surface, so the depth image tells whether one is hidden; corners of boxes float in the air, and a centre is always inside.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from synpick_warp.configs.calibration.lens import LensMap, read_lens
from synpick_warp.system.linear_algebra import matmul

MILLIMETERS = 1000.0
"""Millimetres per metre."""
UNLABELED, OCCLUDED, VISIBLE = 0, 1, 2
"""COCO's visibility flags: outside of the image (with x = y = 0), in it but hidden, in it and seen."""
TOLERANCE = 2.0
"""Distance by which a surface may lie in front of a keypoint that still counts as visible [mm], besides one pixel's width at its depth:
within a pixel, a surface inclined by 45° changes its depth by that width. Thinner than any object of YCB."""
_DECIMALS = 2
"""Decimal places of pixel coordinates."""
_POSITION_DECIMALS = 4
"""Decimal places of positions on the model [mm]."""


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one object, in the order in which they were sampled."""

    positions: np.ndarray
    """In the model's frame (K, 3) float64 [mm]."""
    edges: tuple[tuple[int, int], ...]
    """Skeleton edges, a tree: each keypoint is connected to its nearest predecessor in sampling order."""


def sample_keypoints(vertices: np.ndarray, count: int) -> Keypoints:
    """Farthest point sampling of vertices (V, 3) [m]: the first is farthest from the centre of the box, each next one from all before it.
    Objects with fewer than `count` different vertices have as many keypoints as these."""
    points = np.round(MILLIMETERS * vertices.astype(np.float64), _POSITION_DECIMALS)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    chosen = [int(np.argmax(np.linalg.norm(points - centre, axis=1)))]
    nearest = np.zeros(len(points), np.int64)
    distance = np.linalg.norm(points - points[chosen[0]], axis=1)
    edges = []
    while len(chosen) < count and distance.max() > 0.0:
        point = int(np.argmax(distance))
        edges.append((int(nearest[point]), len(chosen)))
        apart = np.linalg.norm(points - points[point], axis=1)
        nearest[apart < distance] = len(chosen)
        distance = np.minimum(distance, apart)
        chosen.append(point)
    return Keypoints(points[chosen], tuple(edges))


def make_category_keys(keypoints: Keypoints) -> dict[str, Any]:
    """Keys of an object's COCO category: names, skeleton (from 1, as COCO counts), and positions in the model's frame [mm] as an extra."""
    return {
        "keypoints": [f"surface_{index}" for index in range(len(keypoints.positions))],
        "skeleton": [[a + 1, b + 1] for a, b in keypoints.edges],
        "keypoint_positions": keypoints.positions.tolist(),
    }


def project_keypoints(
    entries: list[dict[str, Any]], camera: dict[str, Any], depth: np.ndarray, keypoints: Mapping[int, Keypoints]
) -> list[dict[str, Any]]:
    """Keys of COCO annotations: `keypoints` as x, y, v for each, pixel centres at + 0.5, and `num_keypoints`, the number with v > 0.

    `entries` and `camera` are the view's in scene_gt.json and scene_camera.json, `keypoints` are by obj_id; depth (H, W) uint16 is in units
    of `depth_scale`, 0: no surface, which hides nothing.
    """
    matrix, lens = np.reshape(camera["cam_K"], (3, 3)), read_lens(camera, depth.shape[::-1])
    return [_project(entry, matrix, lens, depth, camera["depth_scale"], keypoints[entry["obj_id"]].positions) for entry in entries]


def _project(
    entry: dict[str, Any], matrix: np.ndarray, lens: LensMap | None, depth: np.ndarray, scale: float, positions: np.ndarray
) -> dict[str, Any]:
    """Project an instance's keypoints into the image: COCO's (x, y, visibility) for each; 0, 0, 0 outside of the image."""
    points = matmul(positions, np.reshape(entry["cam_R_m2c"], (3, 3)).T) + entry["cam_t_m2c"]
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = matmul(points, matrix.T)
        pixels = pixels[:, :2] / pixels[:, 2:]
        if lens is not None:
            pixels = lens.project(points[:, :2] / np.where(z > 0.0, z, np.inf)[:, None])
    height, width = depth.shape
    inside = (z > 0.0) & (pixels >= 0.0).all(axis=1) & (pixels < (width, height)).all(axis=1)
    columns, rows = np.where(inside[:, None], pixels, 0.0).astype(np.int64).T
    surface = scale * depth[rows, columns].astype(np.float64)
    hidden = (surface > 0.0) & (surface < z - TOLERANCE - z / matrix[0, 0])
    flags = np.where(inside, np.where(hidden, OCCLUDED, VISIBLE), UNLABELED)
    values: list[float] = []
    for (x, y), flag in zip(pixels.tolist(), flags.tolist(), strict=True):
        values += [round(x, _DECIMALS), round(y, _DECIMALS), flag] if flag else [0, 0, UNLABELED]
    return {"keypoints": values, "num_keypoints": int(inside.sum())}
