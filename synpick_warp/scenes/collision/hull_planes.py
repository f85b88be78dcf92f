"""Half-space representation (H-representation) of collision shapes, against which the suction cup's rays are clipped."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.scenes.types import Catalog, ConvexPiece

# Coplanar triangles are merged into one half-space if normal and offset [m] agree to this many decimals. Vertices in single precision tilt
# the triangles of a facet against each other by up to 1e-6.
_DECIMALS = 5


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """Planes of all collision shapes of a catalog, in compressed row layout.

    The pieces of entry e are first_piece[e] to first_piece[e + 1] - 1; the planes of piece p are first_plane[p] to first_plane[p + 1] - 1.
    """

    first_piece: np.ndarray
    """(entry + 1) int32."""
    first_plane: np.ndarray
    """(piece + 1) int32."""
    plane: np.ndarray
    """(plane, 4) float32: outward unit normal n and offset d [m] in the object's frame; the inside is n·x ≤ d."""


def hull_planes(piece: ConvexPiece) -> np.ndarray:
    """H-representation of a piece (plane, 4) float64: outward unit normal n and offset d [m] of each half-space n·x ≤ d.

    Computed from the hull of the vertices, not from the triangles: normals of thin triangles are unreliable.
    """
    equations = ConvexHull(piece.vertices.astype(np.float64)).equations
    _, index = np.unique(equations.round(_DECIMALS), axis=0, return_index=True)
    planes = equations[np.sort(index)]
    return np.concatenate([planes[:, :3], -planes[:, 3:]], axis=1)


def plane_table(catalog: Catalog) -> PlaneTable:
    """Collect the half-spaces of all entries' pieces."""
    pieces = [[hull_planes(piece) for piece in entry.pieces] for entry in catalog.bodies]
    planes = [plane for entry in pieces for plane in entry]
    first_piece = np.cumsum([0] + [len(entry) for entry in pieces])
    first_plane = np.cumsum([0] + [len(plane) for plane in planes])
    return PlaneTable(first_piece.astype(np.int32), first_plane.astype(np.int32), np.concatenate(planes).astype(np.float32))
