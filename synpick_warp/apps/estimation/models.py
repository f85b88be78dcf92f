"""Object models of a data set for pose estimation: textured meshes from its models folder, in metres.

A data set may come from anywhere, so models and textures are read in isolated processes, as a bake reads them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from synpick_warp.dataset.bop.models import find_models
from synpick_warp.errors import CatalogError, SynpickError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.catalog import READ_LIMITS
from synpick_warp.scenes.types import Material, TriangleMesh
from synpick_warp.system.processes.isolation import Failure, run_isolated

_MILLIMETRE = 1e-3
_METALLIC, _ROUGHNESS = 0.0, 0.5
"""Of materials, which PLY files do not state; colours are compared, not highlights."""


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """Textured mesh of an object whose pose is estimated."""

    object_id: int
    mesh: TriangleMesh
    """In the axes that poses refer to [m]."""
    material: Material


def read_object_models(folder: Path, object_ids: Iterable[int]) -> list[ObjectModel]:
    """Read the models of objects, ordered by obj_id.

    Args:
        folder: The data set.
        object_ids: Objects that are needed.

    Raises:
        DatasetError: The data set has no models, or an object has none.
        CatalogError: A model or its texture is missing or damaged.
    """
    found = find_models(folder, object_ids, "poses are estimated")
    results = run_isolated(read_mesh, [(path, _MILLIMETRE) for path, _ in found.values()], READ_LIMITS)
    models = []
    for (object_id, (path, _)), result in zip(found.items(), results, strict=True):
        if isinstance(result, Failure):
            raise CatalogError(f"{path}: the process that reads it {result.reason}; repair or simplify the file")
        if isinstance(result, SynpickError):
            raise result
        mesh, given = result
        metallic = _METALLIC if given.metallic is None else given.metallic
        roughness = _ROUGHNESS if given.roughness is None else given.roughness
        models.append(ObjectModel(object_id, mesh, Material(given.color, given.texture, metallic, roughness)))
    return models
