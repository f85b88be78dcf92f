"""Convex pieces as half-spaces: what rays are clipped against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull

from synpick_warp.scenes.types import Catalog, ConvexPiece

# Triangles of one flat face are one half-space: their planes agree to this many decimals (of 1, and of a metre).
_DECIMALS = 7


@dataclass(frozen=True, eq=False)
class PlaneTable:
    """The collision shapes of a catalog's entries. Pieces of entry e: first_piece[e] to first_piece[e + 1]; planes of a piece likewise."""

    first_piece: np.ndarray
    """(entry + 1) int32."""
    first_plane: np.ndarray
    """(piece + 1) int32."""
    plane: np.ndarray
    """(plane, 4) float32: outward unit normal n and d [m] in the object's frame; the inside is n·x ≤ d."""


def hull_planes(piece: ConvexPiece) -> np.ndarray:
    """Half-spaces whose intersection is the piece (plane, 4) float64: outward unit normal, and distance from the origin [m].

    From the hull of the vertices, not from the triangles: thin ones have no normal to go by.
    """
    equations = ConvexHull(piece.vertices.astype(np.float64)).equations
    _, index = np.unique(equations.round(_DECIMALS), axis=0, return_index=True)
    planes = equations[np.sort(index)]
    return np.concatenate([planes[:, :3], -planes[:, 3:]], axis=1)


def plane_table(catalog: Catalog) -> PlaneTable:
    """Half-spaces of all entries' pieces."""
    pieces = [[hull_planes(piece) for piece in entry.pieces] for entry in catalog.entries]
    planes = [plane for entry in pieces for plane in entry]
    first_piece = np.cumsum([0] + [len(entry) for entry in pieces])
    first_plane = np.cumsum([0] + [len(plane) for plane in planes])
    return PlaneTable(first_piece.astype(np.int32), first_plane.astype(np.int32), np.concatenate(planes).astype(np.float32))
