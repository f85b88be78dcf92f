"""The table of what glossy lobes reflect, measured by their own sampling."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.render.lighting.brdf import GLOSS_COLUMNS, GLOSS_ROWS, Gloss, measure_gloss_kernel

MEAN_STEPS = 4096
"""Steps of the integral over the table of albedos, which is smooth between nodes."""


def measure_gloss(device: wp.Device) -> Any:
    """The struct `Gloss`: albedos of the glossy lobe, measured by its own sampling; made once for a device."""
    return _measured(device.alias)


@functools.cache
def _measured(alias: str) -> Any:
    """Devices have no hash; their names do."""
    device: wp.Device = wp.get_device(alias)
    gloss = Gloss()
    gloss.albedo = wp.empty((int(GLOSS_ROWS), int(GLOSS_COLUMNS)), dtype=wp.vec2, device=device)
    wp.launch(measure_gloss_kernel, dim=gloss.albedo.shape, outputs=[gloss.albedo], device=device)
    # With t the root of μ, 2 ∫ a μ dμ = 4 ∫ a t³ dt, of what the kernels interpolate.
    albedo = gloss.albedo.numpy().astype(np.float64)
    root = (np.arange(MEAN_STEPS) + 0.5) / MEAN_STEPS
    nodes = np.arange(albedo.shape[1]) / (albedo.shape[1] - 1)
    mean = [[4.0 * np.mean(np.interp(root, nodes, part) * root**3) for part in row.T] for row in albedo]
    gloss.mean = wp.array(mean, dtype=wp.vec2, device=device)
    return gloss
