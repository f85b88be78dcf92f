"""Compute the collision shapes of the embedded objects again, and write the file that is shipped with them.

    python -m tools.embedded_shapes      # in a minute

Run it when an embedded object, a default of the section objects, or the decomposition changes.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np

from synpick_warp.configs.load import load_config
from synpick_warp.scenes.catalog import shape_recipe
from synpick_warp.scenes.collision import embedded_shapes
from synpick_warp.scenes.collision.shapes import collision_shapes
from synpick_warp.scenes.embedded.objects import procedural_objects


def main() -> None:
    """Compute the collision shapes of all embedded objects, and write their file."""
    objects = load_config("synpick").objects
    raws = procedural_objects()
    names, meshes, recipes = [raw.name for raw in raws], [raw.mesh for raw in raws], [shape_recipe(raw, objects) for raw in raws]
    embedded_shapes._read_shapes = dict  # type: ignore[assignment]  # nothing is taken from the present file
    with tempfile.TemporaryDirectory() as cache:
        shapes = collision_shapes(names, meshes, recipes, Path(cache), lambda line: print(line, file=sys.stderr))
    arrays = {}
    for mesh, recipe, shape in zip(meshes, recipes, shapes, strict=True):
        if not isinstance(shape, tuple):
            raise shape
        key = embedded_shapes.shape_key(mesh, recipe)
        arrays |= {f"{key}.{name}": array for name, array in embedded_shapes.pack_pieces(shape).items()}
    np.savez_compressed(embedded_shapes.FILE, **arrays)


if __name__ == "__main__":
    main()
