"""Compute the collision shapes of the embedded objects again, or of a folder of known models, and write the file that is shipped.

    python -m tools.embedded_shapes                       # in some minutes
    python -m tools.embedded_shapes --models YCBV/models  # those of the real objects of YCB-Video, by the preset synpick

Run both when an embedded object, a default of the section objects, or the decomposition changes.
"""

import sys
import tempfile
from pathlib import Path

import numpy as np

from synpick_warp.configs.episodes.objects import EMBEDDED
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.catalog import read_objects, shape_recipe
from synpick_warp.scenes.collision import shapes
from synpick_warp.scenes.collision.shapes import ShapeRecipe, collision_shapes
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.embedded.parts import MILLIMETER, PIECES
from synpick_warp.scenes.types import Shape
from tools.options import make_parser

# Decimal places of modelled pieces [m]; further ones depend on the processor.
_DIGITS = 9


def main() -> None:
    """Compute the collision shapes of the objects, and write their file."""
    models = make_parser(__doc__, "models").parse_args().models
    config = load_config("synpick", {"bake.models": models})
    objects, arrays = config.objects, {}
    raws = read_objects(models, objects, config.object_rows, config.cell.bins) if models else procedural_objects(EMBEDDED)
    recipes = {raw.name: shape_recipe(raw, objects) for raw in raws}
    others = [raw for raw in raws if raw.name not in PIECES]
    names, meshes, rules = [raw.name for raw in others], [raw.mesh for raw in others], [recipes[raw.name] for raw in others]
    shapes.read_shipped_shapes = dict  # type: ignore[assignment]  # nothing is taken from the present files
    with tempfile.TemporaryDirectory() as cache:
        found = collision_shapes(names, meshes, rules, Path(cache), lambda line: print(line, file=sys.stderr))
    computed = dict(zip(names, found, strict=True)) | {name: modelled_shape(name, recipes[name]) for name in PIECES if name in recipes}
    for raw in raws:
        shape = computed[raw.name]
        if not isinstance(shape, tuple):
            raise shape
        key = shapes.shape_key(raw.mesh, recipes[raw.name])
        arrays |= {f"{key}.{name}": array for name, array in shapes.pack_pieces(shape).items()}
    np.savez_compressed(shapes.YCBV_FILE if models else shapes.EMBEDDED_FILE, **arrays)


def modelled_shape(name: str, recipe: ShapeRecipe) -> Shape:
    """Collision shape of an object that comes with its convex pieces, moved as its mesh: the middle of the bounding box to the origin."""
    pieces = PIECES[name]
    points = np.concatenate(pieces)
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    return tuple(simplify_hull((MILLIMETER * (piece - middle)).round(_DIGITS), recipe.piece_vertices) for piece in pieces)


if __name__ == "__main__":
    main()
