"""The plain types that everything in a scene is made of."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """A triangle mesh, outward orientation, metres."""

    vertices: np.ndarray
    """(V, 3) float32 [m]."""
    faces: np.ndarray
    """(F, 3) int32, counter-clockwise seen from outside."""
    normals: np.ndarray
    """Unit normal of each vertex (V, 3) float32."""
    uv: np.ndarray
    """Texture coordinates (V, 2) float32, v grows upward (row 0 of the image is v = 1); zeros without a texture."""


@dataclass(frozen=True, eq=False)
class Material:
    """Metallic-roughness."""

    color: tuple[float, float, float]
    """Base colour, sRGB; multiplies the texture (in linear light)."""
    texture: np.ndarray | None
    """(H, W, 3) uint8, sRGB, red first, row 0 at the top (v = 1); None: the base colour alone."""
    metallic: float
    roughness: float


@dataclass(frozen=True, eq=False)
class RawObject:
    """One object as it was read or made, before it gets a collision shape and mass properties."""

    obj_id: int
    name: str
    mesh: TriangleMesh
    material: Material
    mass: float | None
    """[kg]; None: from the configured density."""
    concave: bool | None
    """Whether a convex hull is too coarse a collision shape; None: the volumes of mesh and hull decide."""
    symmetries_discrete: tuple[tuple[float, ...], ...]
    """Row-major 4 x 4 matrices as BOP has them, but in metres."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    """(axis, offset [m])."""
    source: Path | None
    """The PLY file of a BOP model folder; None: embedded, or from another format."""


@dataclass(frozen=True, eq=False)
class ConvexPiece:
    """One convex collision shape, in the object's frame."""

    vertices: np.ndarray
    """(V, 3) float32 [m]."""
    faces: np.ndarray
    """(F, 3) int32."""


@dataclass(frozen=True, eq=False)
class CatalogEntry:
    """One object: what it looks like, how it collides, what it weighs."""

    obj_id: int
    name: str
    mesh: TriangleMesh
    material: Material
    pieces: tuple[ConvexPiece, ...]
    """Collision shape; more than one piece for concave objects."""
    volume: float
    """Volume of the collision shape [m³]; counts against the arrangement's budget."""
    radius: float
    """Radius of the bounding sphere about the object's origin [m]."""
    mass: float
    """[kg]"""
    center_of_mass: np.ndarray
    """In the object's frame (3) float64 [m]."""
    inertia: np.ndarray
    """About the centre of mass, in the object's axes (3, 3) float64 [kg·m²]."""
    diameter: float
    """Largest distance of two vertices [m]."""
    symmetries_discrete: tuple[tuple[float, ...], ...]
    """Row-major 4 x 4 matrices as BOP has them, but in metres."""
    symmetries_continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]
    """(axis, offset [m])."""
    source: Path | None
    """The PLY file the object came from; None: embedded, or from another format."""


@dataclass(frozen=True, eq=False)
class Catalog:
    """The object set of a bake, ordered by obj_id."""

    entries: tuple[CatalogEntry, ...]

    def __len__(self) -> int:
        return len(self.entries)


@dataclass(frozen=True)
class Interior:
    """A convex room in a mesh's own frame that no triangle reaches into, open at the top: |x| <= half[0], |y| <= half[1] and |x| + |y| <=
    half[2] at z = 0, each wider by its growth a metre up."""

    half: tuple[float, float, float]
    """[m]"""
    growth: tuple[float, float, float]
    """[m/m]"""
    floor: float
    """Least z [m]."""
    top: float
    """No vertex of the mesh is higher [m]."""


@dataclass(frozen=True, eq=False)
class Fixture:
    """A visible thing that is no object: tote, finger, cup."""

    mesh: TriangleMesh
    material: Material
    interior: Interior | None = None
    """The room in it, if it is a container."""


@dataclass(frozen=True, eq=False)
class Sun:
    """A directional light that a set of light maps names."""

    direction: np.ndarray
    """Unit vector (3) float64 towards it, in the map's frame."""
    irradiance: np.ndarray
    """Linear RGB (3) float64 on a surface that faces it, in the map's units; not black."""


@dataclass(frozen=True, eq=False)
class EnvironmentMap:
    """An equirectangular environment. Row 0 looks up (+z); azimuth atan2(y, x) lies at column share u = azimuth / 2π + 0.5."""

    name: str
    radiance: np.ndarray
    """Linear RGB (H, 2H, 3) float32, finite, not negative."""
    sun: Sun | None = None
    """Stands for the bright place that the map has there, which cameras clip."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole in OpenCV's convention: x right, y down, z forward; the centre of pixel (row, column) is (column + 0.5, row + 0.5)."""

    width: int
    height: int
    matrix: np.ndarray
    """K (3, 3) float64 [px]."""
    rotation: np.ndarray
    """World to camera (3, 3) float64."""
    translation: np.ndarray
    """World to camera (3) float64 [m]."""
