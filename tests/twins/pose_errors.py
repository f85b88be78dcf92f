"""NumPy twin of the BOP toolkit's error functions (bop_toolkit_lib/pose_error.py: add, adi, re, te) and matching (pose_matching.py).

Written after them, one pair at a time; the toolkit itself is not on the package index.
"""

import math

import numpy as np
from scipy.spatial import cKDTree


def add(estimated_rotation, estimated_translation, true_rotation, true_translation, vertices) -> float:
    """Average distance of corresponding vertices."""
    estimated = vertices @ estimated_rotation.T + estimated_translation
    true = vertices @ true_rotation.T + true_translation
    return float(np.linalg.norm(estimated - true, axis=1).mean())


def adi(estimated_rotation, estimated_translation, true_rotation, true_translation, vertices) -> float:
    """Average distance from true vertices to the nearest estimated ones."""
    estimated = vertices @ estimated_rotation.T + estimated_translation
    true = vertices @ true_rotation.T + true_translation
    return float(cKDTree(estimated).query(true, k=1)[0].mean())


def re(estimated_rotation, true_rotation) -> float:
    """Rotation error [°]."""
    cosine = 0.5 * (np.trace(estimated_rotation @ np.linalg.inv(true_rotation)) - 1.0)
    return 180.0 * math.acos(min(1.0, max(-1.0, float(cosine)))) / np.pi


def te(estimated_translation, true_translation) -> float:
    """Translation error."""
    return float(np.linalg.norm(true_translation - estimated_translation))


def match_poses(scores: list[float], errors: np.ndarray, threshold: float, valid: list[bool]) -> dict[int, int]:
    """Greedy matching in one image and object. `scores`: of each estimate. `errors`: (estimates, instances). `threshold`: of correctness.
    `valid`: whether an instance can be matched. Returns instance -> estimate."""
    matched: dict[int, int] = {}
    for estimate in sorted(range(len(scores)), key=lambda index: scores[index], reverse=True):
        best, best_error = -1, threshold
        for instance, error in enumerate(errors[estimate]):
            if valid[instance] and instance not in matched and error < best_error:
                best, best_error = instance, error
        if best >= 0:
            matched[best] = estimate
    return matched


def vocap(errors: np.ndarray) -> float:
    """compute_auc_posecnn of the YCB-Video toolbox in Python, line by line; NaN if nothing was found."""
    d = np.sort(errors)
    d[d > 0.1] = np.inf
    accuracy = np.cumsum(np.ones(d.shape[0])) / d.shape[0]
    ids = np.isfinite(d)
    d, accuracy = d[ids], accuracy[ids]
    if ids.sum() == 0:
        return float("nan")
    mrec = np.concatenate(([0], d, [0.1]))
    mpre = np.concatenate(([0], accuracy, [accuracy[-1]]))
    for i in range(1, len(mpre)):
        mpre[i] = max(mpre[i], mpre[i - 1])
    ids = np.where(mrec[1:] != mrec[:-1])[0] + 1
    return float(((mrec[ids] - mrec[ids - 1]) * mpre[ids]).sum() * 10)
