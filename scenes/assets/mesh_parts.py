"""Mesh parts: geometry and material as read from a mesh file, before they are validated and merged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from synpick_warp.scenes.assets.appearance import FileMaterial

# Default base colour (sRGB): a light grey, since highlights do not show on pure white.
GREY = (0.7, 0.7, 0.7)


@dataclass(frozen=True, eq=False)
class MeshPart:
    """A part of a mesh file: not yet validated, in the file's unit."""

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """Vertex indices (F, 3) int64."""
    normals: np.ndarray | None
    """(V, 3)."""
    uv: np.ndarray | None
    """(V, 2)."""
    colors: np.ndarray | None
    """sRGB (V, 3) uint8."""
    material: FileMaterial
