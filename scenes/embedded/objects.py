"""The embedded catalog: 21 household objects made in code, with the sizes and masses of the object table of the paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from synpick_warp.scenes.embedded import goods, tools, vessels
from synpick_warp.scenes.embedded.meshes import make_mesh, rotation
from synpick_warp.scenes.embedded.packs import Shape
from synpick_warp.scenes.types import Material, RawObject

Matrix = tuple[float, ...]


def _turns(*steps: tuple[str, float]) -> tuple[Matrix, ...]:
    """All rotations but the identity that follow from the given ones (axis, angle [°]), as BOP writes them."""
    group = [np.eye(3)]
    for axis, angle in steps:
        step = rotation(axis, angle)
        for known in list(group):
            new = step @ known
            while not any(np.allclose(new, member) for member in group):
                group.append(new)
                new = step @ new
    matrices = []
    for turn in group[1:]:
        matrix = np.eye(4)
        matrix[:3, :3] = turn
        matrices.append(tuple(float(value) for value in matrix.reshape(-1)))
    return tuple(matrices)


def _about(axis: tuple[float, float, float]) -> tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...]:
    return ((axis, (0.0, 0.0, 0.0)),)


@dataclass(frozen=True)
class _Row:
    """One row of the object table: mass [kg], look, and what its turns leave unchanged."""

    name: str
    make: Callable[[], Shape]
    mass: float
    metallic: float
    roughness: float
    concave: bool = False
    discrete: tuple[Matrix, ...] = ()
    continuous: tuple[tuple[tuple[float, float, float], tuple[float, float, float]], ...] = ()


ROWS = (
    _Row("coffee_tin", goods.coffee_tin, 0.414, 0.6, 0.2, discrete=_turns(("z", 180))),
    _Row("cracker_carton", goods.cracker_carton, 0.411, 0.1, 0.5),
    _Row("sugar_carton", goods.sugar_carton, 0.514, 0.1, 0.5),
    _Row("soup_tin", goods.soup_tin, 0.349, 0.1, 0.5),
    _Row("squeeze_bottle", goods.squeeze_bottle, 0.603, 0.3, 0.5),
    _Row("fish_tin", goods.fish_tin, 0.171, 0.6, 0.2),
    _Row("dessert_carton", goods.dessert_carton, 0.187, 0.1, 0.5),
    _Row("jelly_carton", goods.jelly_carton, 0.097, 0.1, 0.5),
    _Row("meat_tin", goods.meat_tin, 0.370, 0.6, 0.3),
    _Row("banana", tools.banana, 0.066, 0.3, 0.3),
    _Row("pitcher", vessels.pitcher, 0.244, 0.1, 0.5),
    _Row("cleaner_bottle", goods.cleaner_bottle, 1.131, 0.1, 0.5),
    _Row("bowl", vessels.bowl, 0.147, 0.6, 0.3, concave=True, continuous=_about((0.0, 0.0, 1.0))),
    _Row("mug", vessels.mug, 0.118, 0.6, 0.3, concave=True),
    _Row("drill", tools.drill, 0.895, 0.1, 0.6, concave=True),
    _Row("wood_block", tools.wood_block, 0.729, 0.3, 0.5, discrete=_turns(("z", 90), ("x", 180))),
    _Row("scissors", tools.scissors, 0.082, 0.1, 0.5),
    _Row("marker", tools.marker, 0.016, 0.1, 0.5, continuous=_about((0.0, 1.0, 0.0))),
    _Row("clamp", tools.clamp, 0.125, 0.1, 0.5, discrete=_turns(("y", 180))),
    _Row("large_clamp", tools.large_clamp, 0.202, 0.1, 0.5, discrete=_turns(("x", 180))),
    _Row("foam_block", tools.foam_block, 0.028, 0.1, 0.7, discrete=_turns(("z", 180), ("x", 180))),
)
"""Ids 1 to 21 in this order; masses, concavity and materials of the paper and its released code (README, object table)."""


def procedural_objects() -> list[RawObject]:
    """The 21 embedded objects, made anew: closed meshes [m] centred on their bounding boxes, with textures; always the same."""
    objects = []
    for obj_id, row in enumerate(ROWS, start=1):
        patch, texture = row.make()
        objects.append(
            RawObject(
                obj_id=obj_id,
                name=row.name,
                mesh=make_mesh(patch, centered=True),
                material=Material(color=(1.0, 1.0, 1.0), texture=texture, metallic=row.metallic, roughness=row.roughness),
                mass=row.mass,
                concave=row.concave,
                symmetries_discrete=row.discrete,
                symmetries_continuous=row.continuous,
                source=None,
            )
        )
    return objects
