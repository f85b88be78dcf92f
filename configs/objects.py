"""Settings of objects: sections of the schema (see `schema`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from synpick_warp.configs.fields import INT32_MAX, setting

AUTO_UNIT = "auto"
"""Unit of mesh files by their kind: millimetres of BOP models, metres of others."""
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "in": 0.0254}
"""Units of mesh files [m]."""


@dataclass(frozen=True)
class Objects:
    """How a mesh becomes a rigid body: collision shape, mass and material."""

    unit: str = setting(
        AUTO_UNIT,
        "",
        "Unit of all mesh files; auto: mm for BOP models (obj_NNNNNN.ply), m for others. STEP files name their own.",
        choices=(AUTO_UNIT, *UNITS),
    )
    hull_vertices: int = setting(
        64,
        "",
        "Maximum vertices of a convex hull. With 64, all but 5 % of the vertices of the real objects' hulls lie less than 2.5 mm outside.",
        low=8,
        high=256,
    )
    piece_vertices: int = setting(32, "", "Maximum vertices of each piece of a convex decomposition.", low=8, high=256)
    pieces: int = setting(16, "", "Maximum pieces of a convex decomposition.", low=1, high=64)
    concavity: float = setting(0.05, "", "CoACD's concavity threshold; smaller values follow the surface more closely.", low=0.01, high=1.0)
    decomposition_time: float = setting(
        300.0, "s", "Time limit of a convex decomposition; an object that takes longer gets its convex hull.", above=0.0, high=86400.0
    )
    concave_ratio: float = setting(
        0.6, "", "Objects without a row in the object table are decomposed if mesh volume / hull volume is below this.", low=0.0, high=1.0
    )
    strict: bool = setting(
        False, "", "End the bake at the first object or light map that cannot be used, instead of leaving it out with a line."
    )
    density: float = setting(400.0, "kg/m³", "Density over the volume of the convex hull, for objects without a mass.", above=0.0, high=1e5)
    metallic: float = setting(0.1, "", "Metallic factor of objects whose material names none.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness of objects whose material names none.", low=0.0, high=1.0)
    crease_angle: float = setting(
        35.0,
        "°",
        "Meshes without normals are smooth where triangles meet at up to this angle, and have a sharp edge beyond; 180: smooth all over.",
        low=0.0,
        high=180.0,
    )
    center: bool = setting(
        False,
        "",
        "Move the centre of each mesh's bounding box to its origin; BOP models, whose poses refer to their origin, stay as they are.",
    )
    diameter_tolerance: float = setting(
        0.1,
        "",
        "Largest relative difference between a model's diameter and that of its row in the object table; with more, the row is not used.",
        above=0.0,
        high=1.0,
    )


@dataclass(frozen=True)
class ObjectRow:
    """A row of the object table: physical and material properties that model files do not contain."""

    REQUIRED: ClassVar = ("id", "diameter")
    IDENTITY: ClassVar = ("id", "name", "diameter")
    id: int = setting(0, "", "The model's obj_id in its BOP folder.", low=0, high=INT32_MAX)
    name: str = setting(
        "", "", "Name of the object; for meshes that are not BOP models the file name without suffix, by which the row is found."
    )
    diameter: float = setting(0.0, "m", "Diameter of the model, which must agree for the row to be used; 0: any.", low=0.0)
    mass: float = setting(0.1, "kg", "Mass.", above=0.0)
    concave: bool = setting(False, "", "Use a convex decomposition as collision shape instead of the convex hull.")
    metallic: float = setting(0.1, "", "Metallic factor, unless the mesh file names one.", low=0.0, high=1.0)
    roughness: float = setting(0.5, "", "Roughness, unless the mesh file names one.", low=0.0, high=1.0)
