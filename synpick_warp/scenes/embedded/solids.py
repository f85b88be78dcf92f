"""Geometric solids as distractors beside the embedded objects (Tobin et al., IROS 2017), plain or textured. Lengths [m]."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from synpick_warp.scenes.collision.hulls import hull_size
from synpick_warp.scenes.embedded.surfaces import surface_textures
from synpick_warp.scenes.modelling import BOX_FACES, NO_TEXTURE, Patch, lathe, make_mesh, project_from_box, rounded_box, solid
from synpick_warp.scenes.types import Material, RawObject

SIDES = 32
"""Points per ring of a round solid."""
DENSITY = 400.0
"""[kg/m³], between foam and wood."""
SCALES = ((1.0, 1.0, 1.0), (1.6, 1.6, 1.8), (1.2, 2.0, 2.2), (2.2, 1.4, 1.0))
"""Factors on x, y and z of textured solids: tins, cartons, books and bottles of a household."""
REPEAT = 0.3
"""Width of one repeat of a textured solid's texture [m]."""
_EDGE = 0.003
"""Radius of the edges of boxes."""


def _box(*size: float) -> Patch:
    """Box with rounded edges."""
    x, y, z = size
    return rounded_box((x, y, z), _EDGE, dict.fromkeys(BOX_FACES, NO_TEXTURE))


def _turned(points: int, *profile: tuple[float, float]) -> Patch:
    """Surface of revolution, or with few points a prism or pyramid, through (radius, z)."""
    return solid(lathe(list(profile), points))


def _ball(radius: float) -> Patch:
    """Sphere."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, SIDES // 2)[1:-1]
    return _turned(SIDES, *((radius * float(np.cos(angle)), radius * float(np.sin(angle))) for angle in angles))


def solids(textured: bool = False) -> list[RawObject]:
    """Make the solids, all convex: closed meshes [m], centred on their bounding boxes; deterministic. Textured, each has all SCALES."""
    rows = (
        ("cube", _box(0.05, 0.05, 0.05), (0.75, 0.2, 0.15)),
        ("slab", _box(0.12, 0.08, 0.016), (0.2, 0.35, 0.7)),
        ("bar", _box(0.14, 0.025, 0.025), (0.85, 0.7, 0.2)),
        ("cylinder", _turned(SIDES, (0.02, -0.05), (0.02, 0.05)), (0.25, 0.6, 0.3)),
        ("disc", _turned(SIDES, (0.045, -0.01), (0.045, 0.01)), (0.8, 0.8, 0.78)),
        ("cone", _turned(SIDES, (0.035, -0.04), (0.003, 0.04)), (0.85, 0.45, 0.1)),
        ("ball", _ball(0.032), (0.5, 0.25, 0.6)),
        ("prism", _turned(6, (0.03, -0.03), (0.03, 0.03)), (0.15, 0.15, 0.16)),
    )
    made = []
    for obj_id, (name, patch, color) in enumerate(rows, start=1):
        mesh = make_mesh(patch, centered=True)
        material = Material(color, None, 0.0, 0.5)
        hull = hull_size(mesh.vertices)
        made.append(RawObject(obj_id, name, mesh, hull, material, DENSITY * hull.volume, False, (), (), None))
    return _dress(made) if textured else made


def _dress(plain: list[RawObject]) -> list[RawObject]:
    """Solids in all SCALES, each with a texture of its own by cube projection."""
    made = []
    for scale in SCALES:
        for raw in plain:
            mesh = replace(raw.mesh, vertices=raw.mesh.vertices * np.array(scale, np.float32))
            mesh = project_from_box(replace(mesh, normals=_normalize(mesh.normals / np.array(scale, np.float32))))
            mesh = replace(mesh, uv=(mesh.uv / REPEAT + 0.5).astype(np.float32))
            index, hull = len(made), hull_size(mesh.vertices)
            (texture,) = surface_textures(1, index)
            material = Material((1.0, 1.0, 1.0), texture, 0.0, 0.5)
            made.append(
                replace(
                    raw,
                    obj_id=index + 1,
                    name=f"textured_{raw.name}_{index}",
                    mesh=mesh,
                    hull=hull,
                    material=material,
                    mass=DENSITY * hull.volume,
                )
            )
    return made


def _normalize(vectors: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) float32."""
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)
