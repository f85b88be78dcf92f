"""Memory pool of amodal masks: splits views into batches whose masks fit, by upper bounds computed on the host from the poses.

A view's share of the pool is that of some dozens of masks as large as the image; 150 parts in a bin take a fifteenth of it. Views that
might take more are rendered in batches of fewer views, each with room for masks as large as the image, so that no mask can lack words, and
the host never waits for the device.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from synpick_warp.codes import MASK_ROWS
from synpick_warp.kernels.render.visibility.camera import BOX_MARGIN, NEAR_PLANE
from synpick_warp.scenes.cameras import CAMERA_KEYS
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.frames import most_words

SHARE = 32
"""Pool size per view, in full-image masks: 32 bits a pixel."""
ROUNDING = 1.0
"""Additional margin of the bounds [px], since the device computes boxes in float32."""


def share_words(views: int, instances: int, width: int, height: int) -> int:
    """A view's share of the pool [words]: that of SHARE masks as large as the image, and more in batches of so few views that the masks of
    a single one would not fit into their pool."""
    return most_words(width, height) * max(min(instances, SHARE), -(-instances // views))


def widen(images: ViewBuffers) -> ViewBuffers:
    """The same buffers with the pool divided among fewer views, so that every mask may cover the whole image."""
    height, width = images.instance.shape[1:]
    share = images.mask_first.shape[1] * most_words(width, height)
    pool: Any = images.mask_words.flatten()
    views = pool.size // share
    return replace(images, mask_words=pool[: views * share].reshape((views, share)))


@dataclass(frozen=True, eq=False)
class MaskBounds:
    """Upper bounds of the mask words of views, from bounding spheres about the objects' origins; for cameras without lens distortion."""

    radius: np.ndarray
    """Radius of each object's bounding sphere; the last entry is negative and stands for an empty slot (entry + 1) [m]."""
    cameras: Mapping[str, np.ndarray]
    """Matrices and poses of the cameras, by CAMERA_KEYS (slot, ...)."""
    size: tuple[int, int]
    """Width and height of the images [px]."""

    @classmethod
    def of(cls, meshes: Any, cameras: Sequence[Camera]) -> MaskBounds:
        """Bounds for the objects of the struct `Meshes`, and the cameras of a group."""
        corner = np.abs(np.stack((meshes.lower.numpy(), meshes.upper.numpy()))).max(axis=0)[: meshes.entries].astype(np.float64)
        placed = {key: np.stack([getattr(camera, key) for camera in cameras]) for key in CAMERA_KEYS}
        return cls(np.append(np.linalg.norm(corner, axis=1), -1.0), placed, cameras[0].resolution)

    def count_words(self, index: np.ndarray, pose: np.ndarray, cameras: Mapping[str, np.ndarray]) -> np.ndarray:
        """Upper bound of the words of each view's masks (B) int64, from the object of each instance, -1: none (B, I) int32, its pose to the
        world: x, y, z [m], quaternion x, y, z, w (B, I, 7), and matrix and pose of each view's camera, by CAMERA_KEYS (B, ...)."""
        matrix, rotation, translation = (cameras[key] for key in CAMERA_KEYS)
        x, y, z = np.moveaxis(matmul(pose[..., :3], rotation.swapaxes(1, 2)) + translation[:, None], -1, 0)
        radius = self.radius[index]
        near = np.maximum(z - radius, NEAR_PLANE)
        far = np.maximum(z + radius, near)
        sides = []
        for axis, (at, extent) in enumerate(zip((x, y), self.size, strict=True)):
            focal, middle = (matrix[:, axis, column][:, None] for column in (axis, 2))
            low = focal * np.minimum((at - radius) / near, (at - radius) / far) + middle - BOX_MARGIN - ROUNDING
            high = focal * np.maximum((at + radius) / near, (at + radius) / far) + middle + BOX_MARGIN + ROUNDING
            sides.append(np.floor(np.clip(high, -1, extent - 1)) - np.floor(np.clip(low, 0, extent)) + 1)
        columns, rows = (np.nan_to_num(np.maximum(side, 0)).astype(np.int64) for side in sides)
        # Written so that it holds of no pose that is not a number.
        is_before = z - radius > 2.0 * NEAR_PLANE
        words = np.where(is_before, columns * -(-rows // MASK_ROWS), most_words(*self.size))
        return np.where((radius < 0) | (z + radius <= 0), 0, words).sum(axis=1)


def split_batches(words: np.ndarray, share: int, views: int, wide: int) -> Iterator[tuple[slice, bool]]:
    """Split views into batches, in their order: a slice of each, and whether it is one of few views with room for all of their masks.

    `words` are upper bounds of the words of each view (B), `share` is a view's share of the pool [words], and `views` and `wide` are the
    most views of a batch, and of one with room for all masks."""
    large, first = words > share, 0
    while first < len(words):
        most = wide if large[first] else views
        same = large[first : first + most] == large[first]
        past = first + (same.size if same.all() else int(same.argmin()))
        yield slice(first, past), bool(large[first])
        first = past
