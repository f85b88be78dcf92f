"""Baseline pickers as dense score maps from depth or segmentation, and statistics of scores. Needs PyTorch.

A picker chooses the pixel with the largest score (B, H, W). Baselines: variance of surface normals (Zeng et al., 2017/19), distance to
the contour of the object (Cartman, Morrison et al., 2018), a random visible point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch  # pyright: ignore[reportMissingImports]
from torch.nn import functional  # pyright: ignore[reportMissingImports]

WINDOW = 7
"""Side of the window over which normals are averaged [px]: about the cup's lip (10 mm radius) in 320 px across the tote."""
LONGEST = 40
"""Largest distance to a contour; greater ones are clamped [px]."""
Z = 1.959964
"""Quantile of the normal distribution for a 95 % interval."""


@dataclass(frozen=True, eq=False)
class Sight:
    """Observation of pickers: batch of B images on a device."""

    depth: torch.Tensor
    """Planar depth (B, H, W) float32 [m]; 0: nothing."""
    instance: torch.Tensor
    """1 + instance that is visible (B, H, W) uint8; 0: none. For the baselines that segment."""
    focal: float
    """Focal length [px]."""
    target: torch.Tensor | None = None
    """Pixels of the object that is to be picked (B, H, W) bool; None: any may be."""

    def part(self, rows: torch.Tensor | slice) -> Sight:
        """Subset of the images, by index."""
        return Sight(self.depth[rows], self.instance[rows], self.focal, None if self.target is None else self.target[rows])

    def to(self, device: torch.device) -> Sight:
        """Copy on a device."""
        return Sight(self.depth.to(device), self.instance.to(device), self.focal, None if self.target is None else self.target.to(device))


def find_normals(depth: torch.Tensor, focal: float) -> torch.Tensor:
    """Surface normals towards the camera (B, 3, H, W), by central differences of depth (B, H, W) [m]; camera frame, with weak perspective
    (scaled orthography) about each pixel."""
    padded = functional.pad(depth[:, None], (1, 1, 1, 1), mode="replicate")[:, 0]
    across, along = padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2], padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]
    slope = focal / (2.0 * depth.clamp(min=1e-3))
    return functional.normalize(torch.stack((across * slope, along * slope, -torch.ones_like(depth)), dim=1), dim=1)


def score_flatness(sight: Sight) -> torch.Tensor:
    """Flatness of visible objects (B, H, W): length of the mean normal in a window, 1 where it is flat; 0 without object."""
    mean = functional.avg_pool2d(find_normals(sight.depth, sight.focal), WINDOW, 1, WINDOW // 2, count_include_pad=False)
    return torch.where(sight.instance > 0, mean.norm(dim=1), 0.0)


def score_contour_distance(sight: Sight) -> torch.Tensor:
    """Distance transform (chessboard) of each visible instance to its contour (B, H, W) [px], at most LONGEST; smoothing breaks ties."""
    segment = sight.instance.float()[:, None]
    apart = (functional.max_pool2d(segment, 3, 1, 1) != segment) | (-functional.max_pool2d(-segment, 3, 1, 1) != segment)
    inside = ((segment > 0) & ~apart).float()
    distance = inside.clone()
    for _ in range(LONGEST - 1):
        inside = -functional.max_pool2d(-inside, 3, 1, 1)
        distance += inside
    return (distance + 1e-2 * functional.avg_pool2d(distance, 5, 1, 2))[:, 0]


def score_random(sight: Sight, generator: torch.Generator) -> torch.Tensor:
    """Uniform random scores at pixels of visible objects, 0 elsewhere (B, H, W)."""
    drawn = torch.rand(sight.depth.shape, generator=generator, device=sight.depth.device)
    return torch.where(sight.instance > 0, drawn, 0.0)


def wilson(successes: int, count: int) -> tuple[float, float]:
    """Wilson score interval, 95 %, of a success rate; (0, 1) without samples."""
    if not count:
        return 0.0, 1.0
    share, spread = successes / count, Z * Z / count
    middle, half = share + spread / 2.0, Z * np.sqrt((share * (1.0 - share) + spread / 4.0) / count)
    return float((middle - half) / (1.0 + spread)), float((middle + half) / (1.0 + spread))
