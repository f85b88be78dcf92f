"""Shipped collision shapes: each embedded object has one, that which is computed, and keys tolerate rounding of vertices."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from synpick_warp.configs.episodes.objects import EMBEDDED
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.catalog import shape_recipe
from synpick_warp.scenes.collision import shapes
from synpick_warp.scenes.collision.decomposition import decompose
from synpick_warp.scenes.collision.shapes import embedded_shape
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.embedded.objects import PIECES, procedural_objects
from tools.embedded_shapes import modelled_shape

OBJECTS = {raw.name: raw for raw in procedural_objects(EMBEDDED)}
SETTINGS = load_config("synpick").objects


def pieces_of(shape):
    return [(piece.vertices.tolist(), piece.faces.tolist()) for piece in shape]


def corners(shape):
    """Vertices of each convex piece as a set, in nanometres: zeros of either sign decide their order, and how planar faces are divided."""
    return [set(map(tuple, np.rint(1e9 * piece.vertices).astype(int).tolist())) for piece in shape]


@pytest.mark.parametrize("name", OBJECTS)
def test_each_object_has_its_shape(name):
    """`python -m tools.embedded_shapes` computes it again where an object has changed. Releases of NumPy differ by 5e-14 m at zero."""
    raw, recipe = OBJECTS[name], shape_recipe(OBJECTS[name], SETTINGS)
    shape = embedded_shape(raw.mesh, recipe)
    assert shape is not None
    if name in PIECES:
        assert corners(shape) == corners(modelled_shape(name, recipe))
        # Nothing of the surface is far outside of all pieces, which have no holes: least the bracket's fillet of 3 mm.
        equations = [ConvexHull(piece.vertices.astype(np.float64)).equations for piece in shape]
        outside = np.min([(raw.mesh.vertices @ each[:, :3].T + each[:, 3]).max(axis=1) for each in equations], axis=0)
        assert outside.max() < 9e-4
    if not recipe.concave:
        (found,), computed = shape, simplify_hull(raw.mesh.vertices, recipe.hull_vertices)
        np.testing.assert_array_equal(found.faces, computed.faces)
        np.testing.assert_allclose(found.vertices, computed.vertices, rtol=0, atol=1e-13)


@pytest.mark.slow
def test_a_decomposition_is_that_of_its_object():
    """The smallest one: seconds, where those of mug and bowl take minutes."""
    raw, recipe = OBJECTS["drill"], shape_recipe(OBJECTS["drill"], SETTINGS)
    assert pieces_of(embedded_shape(raw.mesh, recipe)) == pieces_of(decompose(raw.mesh, recipe))


def test_rounding_errors_do_not_hide_shapes_and_changes_do():
    raw = OBJECTS["mug"]
    recipe = shape_recipe(raw, SETTINGS)
    rounded = replace(raw.mesh, vertices=np.nextafter(raw.mesh.vertices, np.float32(1.0)))
    assert embedded_shape(rounded, recipe) is not None
    assert embedded_shape(replace(raw.mesh, vertices=raw.mesh.vertices * np.float32(1.01)), recipe) is None
    assert embedded_shape(raw.mesh, replace(recipe, pieces=recipe.pieces - 1)) is None


def test_the_file_has_no_other_shapes():
    assert len(shapes.read_embedded_shapes()) == len(OBJECTS)
