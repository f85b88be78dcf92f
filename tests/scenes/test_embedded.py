"""The embedded objects: watertight, with the right sizes, masses, label orientation and symmetries."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, cKDTree

from synpick_warp.configs.episodes.objects import EMBEDDED
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes import modelling
from synpick_warp.scenes.assets.meshes import merge_positions, signed_volume
from synpick_warp.scenes.catalog import read_objects, shape_recipe
from synpick_warp.scenes.collision import shapes
from synpick_warp.scenes.collision.shapes import decompose, shipped_shape
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.embedded import objects
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.embedded.parts import PIECES
from synpick_warp.scenes.embedded.textures import KINDS, PADDING, SIDE, blank, pack, surface_textures
from synpick_warp.scenes.symmetries.detection import find_symmetries
from tests.harness.pieces import assert_closed
from tests.twins.raycast import edges_match
from tests.worlds.model_files import REAL_HULLS
from tools.embedded_shapes import modelled_shape

TABLE = {row.id: row for row in load_config("synpick").object_rows}
"""The paper's object table, with diameters of the real objects."""
PRINTED = (1, 2, 3, 4, 5, 6, 7, 8, 9, 12, 14)
CONCAVE = (13, 14, 15)
ALL = {raw.obj_id: raw for raw in procedural_objects(EMBEDDED)}
OBJECTS = {raw.obj_id: raw for raw in ALL.values() if raw.obj_id in TABLE}
PARTS = {
    # name: sides of the bounding box in the frame of the mesh [mm], density of its mass [kg/m³], rotations onto itself
    "bolt": ((20.78, 18.0, 67.5), 7850.0, 6),
    "nut": ((20.78, 18.0, 10.8), 7850.0, 12),
    "bracket": ((60.0, 40.0, 50.0), 7850.0, 1),
    "pipe_tee": ((76.0, 34.0, 55.0), 7200.0, 2),
    "gear": ((44.0, 44.0, 12.0), 7850.0, 40),
    "sheet_part": ((62.0, 50.0, 22.0), 7850.0, 2),
    "box": ((80.0, 60.0, 40.0), 784.0, 4),
}


@pytest.fixture(params=OBJECTS.values(), ids=lambda raw: raw.name)
def raw(request):
    return request.param


@pytest.fixture(params=ALL.values(), ids=lambda raw: raw.name)
def any_raw(request):
    return request.param


def corners(raw):
    return raw.mesh.vertices[raw.mesh.faces].astype(np.float64), raw.mesh.uv[raw.mesh.faces].astype(np.float64)


def printed(obj_id):
    """Corners and texture coordinates of a printed object; of the mug only the outside of its wall, without the handle."""
    points, uv = corners(OBJECTS[obj_id])
    if OBJECTS[obj_id].name != "mug":
        return points, uv
    radius = 0.0465
    outside = np.abs(np.hypot(points[..., 0] - points[..., 0].min() - radius, points[..., 1]) - radius).max(axis=1) < 1e-5
    return points[outside], uv[outside]


def colors(raw, uv):
    texture = raw.material.texture
    height, width = texture.shape[:2]
    columns = np.clip((uv[:, 0] * width).astype(int), 0, width - 1)
    rows = np.clip(((1 - uv[:, 1]) * height).astype(int), 0, height - 1)
    return texture[rows, columns].astype(int)


def surface_samples(raw):
    """Points (N, 3) and colours (N, 3), four to a triangle."""
    points, uv = corners(raw)
    weights = np.array([[1, 1, 1], [4, 1, 1], [1, 4, 1], [1, 1, 4]], dtype=float)
    weights /= weights.sum(axis=1, keepdims=True)
    return (weights @ points).reshape(-1, 3), colors(raw, (weights @ uv).reshape(-1, 2))


def test_ids_masses_materials_and_symmetries_are_those_of_the_table_and_of_bop():
    assert list(OBJECTS) == list(TABLE) == list(range(1, 22))
    for raw, row in zip(OBJECTS.values(), TABLE.values(), strict=True):
        assert (raw.mass, raw.material.metallic, raw.material.roughness) == (row.mass, row.metallic, row.roughness)
        assert raw.concave == row.concave == (raw.obj_id in CONCAVE)
        assert raw.source is None
    assert len({raw.name for raw in OBJECTS.values()}) == 21
    discrete = {obj_id: len(raw.symmetries_discrete) for obj_id, raw in OBJECTS.items() if raw.symmetries_discrete}
    assert discrete == {1: 1, 16: 7, 19: 1, 20: 1, 21: 3}
    assert {obj_id for obj_id, raw in OBJECTS.items() if raw.symmetries_continuous} == {13, 18}


def test_sizes_are_near_the_real_ones(raw):
    hull = ConvexHull(raw.mesh.vertices).volume
    assert raw.hull.diameter == pytest.approx(TABLE[raw.obj_id].diameter, rel=0.1)
    assert hull * 1000 == pytest.approx(REAL_HULLS[raw.obj_id], rel=0.16)
    if raw.obj_id in CONCAVE:
        assert signed_volume(raw.mesh.vertices, raw.mesh.faces) / hull < 0.6


def test_surfaces_are_closed_face_outward_and_lie_about_the_origin(any_raw):
    mesh = any_raw.mesh
    assert_closed(mesh)
    assert 200 <= len(mesh.faces) <= 6000
    assert np.abs(mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)).max() < 2e-6
    points, _ = corners(any_raw)
    flat = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    assert ((mesh.normals[mesh.faces].astype(np.float64) * flat[:, None]).sum(axis=2) > 0).all()


def test_textures_have_several_colours_and_are_used(raw):
    texture = raw.material.texture
    assert texture.dtype == np.uint8
    assert texture.shape[2] == 3
    assert raw.mesh.uv.min() >= 0
    assert raw.mesh.uv.max() <= 1
    assert len(np.unique(surface_samples(raw)[1], axis=0)) >= 3


@pytest.mark.parametrize("obj_id", PRINTED)
def test_labels_are_upright_and_not_mirrored(obj_id):
    """Seen from outside, triangles run counter-clockwise in space and so they must in the picture. On upright faces its v grows with
    height: for v as a linear function on the triangle, dv/dz > 0."""
    points, uv = printed(obj_id)
    first, second = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0] > -1e-9).all()
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    area = np.linalg.norm(normal, axis=1)
    upright = (np.abs(normal[:, 2]) < 1e-3 * area) & (area > 1e-7)
    assert upright.any()
    edges = np.stack([points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]], axis=1)[upright]
    rise = np.stack([first[:, 1], second[:, 1]], axis=1)[upright]
    slope = np.einsum("nij,nj->ni", np.linalg.pinv(edges), rise)
    assert (slope[:, 2] >= -1e-6).all()
    assert (slope[:, 2] > 0.1).any()


@pytest.mark.parametrize(("name", "row"), [pytest.param(*row, marks=[pytest.mark.slow] * (row[0] == "gear")) for row in PARTS.items()])
def test_parts_have_the_sizes_masses_and_symmetries_of_their_drawings(name, row):
    """Their rotations are all that the detection of symmetries finds by shape alone, which knows nothing of how they are made."""
    sides, density, order = row
    part = NAMED[name]
    np.testing.assert_allclose(np.ptp(part.mesh.vertices, axis=0), np.array(sides) / 1000, atol=3e-5)
    assert part.mass == pytest.approx(density * signed_volume(part.mesh.vertices, part.mesh.faces), rel=0.01)
    found = find_symmetries(part.mesh.vertices.astype(np.float64), part.mesh.faces, part.hull.diameter, 6e-4)
    assert not found.continuous
    known = [np.array(matrix).reshape(4, 4)[:3, :3] for matrix in part.symmetries_discrete]
    assert len(known) == len(found.discrete) == order - 1
    assert all(min(np.abs(turn[:3, :3] - other).max() for other in known) < 0.02 for turn in found.discrete)


def rotations(raw):
    yield from (np.array(matrix).reshape(4, 4)[:3, :3] for matrix in raw.symmetries_discrete)
    for axis, offset in raw.symmetries_continuous:
        assert offset == (0.0, 0.0, 0.0)
        name = "xyz"[int(np.argmax(axis))]
        # The turned surfaces have 32 or 48 sides: these turns meet both.
        yield from (modelling.rotation(name, 360 / 16 * step) for step in (1, 3, 8))


def test_symmetries_keep_shape_and_colour(raw):
    points, tint = surface_samples(raw)
    tree = cKDTree(points)
    for turn in rotations(raw):
        assert np.linalg.det(turn) == pytest.approx(1)
        assert not np.allclose(turn, np.eye(3))
        distance, index = tree.query(points @ turn.T)
        assert np.quantile(distance, 0.99) < 2e-3
        near = distance < 1e-4
        assert near.mean() > 0.9
        assert np.quantile(np.abs(tint[near] - tint[index[near]]).max(axis=1), 0.95) <= 40


def test_embedded_objects_are_deterministic():
    for obj_id, row in list(enumerate(objects.ROWS, start=1))[::4]:
        old, new = OBJECTS[obj_id], objects._make_object.__wrapped__(obj_id, row)
        for name in ("vertices", "faces", "normals", "uv"):
            assert np.array_equal(getattr(old.mesh, name), getattr(new.mesh, name))
        assert np.array_equal(old.material.texture, new.material.texture)


def volume(patch):
    mesh = modelling.make_mesh(patch, centered=False)
    assert edges_match(merge_positions(mesh.vertices, mesh.faces)[1])
    return signed_volume(mesh.vertices, mesh.faces)


@given(st.floats(0.02, 0.3), st.floats(0.02, 0.3), st.floats(0.02, 0.3), st.floats(0.01, 0.3))
def test_a_rounded_box_has_the_volume_of_its_parts(x, y, z, share):
    radius = share * min(x, y, z)
    a, b, c = x - 2 * radius, y - 2 * radius, z - 2 * radius
    exact = a * b * c + 2 * radius * (a * b + b * c + c * a) + np.pi * radius**2 * (a + b + c) + 4 / 3 * np.pi * radius**3
    result = volume(modelling.rounded_box((x, y, z), radius, dict.fromkeys(modelling.BOX_FACES, modelling.NO_TEXTURE), segments=6))
    assert result == pytest.approx(exact, rel=0.01)
    assert result <= exact * (1 + 1e-3)


def test_a_cylinder_has_the_volume_of_its_prism_and_a_ring_that_of_a_torus():
    exact = 0.5 * 40 * np.sin(2 * np.pi / 40) * 0.05**2 * 0.1
    assert volume(modelling.solid(modelling.lathe([(0.05, 0.0), (0.05, 0.1)], 40))) == pytest.approx(exact, rel=1e-3)
    turn = 2 * np.pi * np.arange(-1, 65) / 64
    path = np.stack([0.05 * np.cos(turn), 0.05 * np.sin(turn), 0 * turn], axis=1)
    rings = modelling.sweep(path, modelling.ellipse(0.02, 0.02, 32), np.ones((len(path), 1)), (0.0, 0.0, 1.0))[1:-1]
    assert volume(modelling.torus(rings)) == pytest.approx(2 * np.pi**2 * 0.05 * 0.01**2, rel=0.02)


def test_a_prism_has_hard_edges_and_a_smooth_side():
    outline = modelling.rounded_rectangle(0.1, 0.06, 0.02, 8)
    mesh = modelling.make_mesh(modelling.solid(np.stack([modelling.at_height(outline, z) for z in (0.0, 0.1)])), centered=False)
    top = mesh.normals[(mesh.vertices[:, 2] == np.float32(0.1))]
    assert np.allclose(np.sort(np.unique(np.abs(top[:, 2]).round(3))), [0, 1])
    out = 0.02 * np.sqrt(0.5)
    middle = np.abs(mesh.vertices - np.array([0.05 - 0.02 + out, 0.03 - 0.02 + out, 0.0])).max(axis=1) < 1e-6
    side = mesh.normals[middle & (np.abs(mesh.normals[:, 2]) < 0.1)]
    assert np.allclose(side, [[np.sqrt(0.5), np.sqrt(0.5), 0]], atol=1e-3)


def test_an_atlas_contains_each_image_at_its_rectangle():
    pictures = {name: blank(30, 20, (value, 0, 255 - value)) for name, value in (("a", 10), ("b", 90), ("c", 200))}
    pictures["a"][0] = (0, 255, 0)
    sheet, rects = pack(pictures, 90)
    for name, (u0, v0, u1, v1) in rects.items():
        rows = slice(round((1 - v1) * sheet.shape[0]), round((1 - v0) * sheet.shape[0]))
        columns = slice(round(u0 * sheet.shape[1]), round(u1 * sheet.shape[1]))
        assert np.array_equal(sheet[rows, columns], pictures[name])
        assert np.array_equal(sheet[rows.start - PADDING, columns], pictures[name][0])


# ---- textures of surfaces ----


def test_textures_follow_from_their_index_and_differ():
    made = surface_textures(len(KINDS))
    assert all(image.shape == (SIDE, SIDE, 3) and image.dtype == np.uint8 for image in made)
    assert len({image.tobytes() for image in made}) == len(made)
    (again,) = surface_textures(1, 2)
    np.testing.assert_array_equal(again, made[2])


# ---- shipped collision shapes ----


NAMED = {raw.name: raw for raw in ALL.values()}
SETTINGS = load_config("synpick").objects
YCBV_OBJECTS = 21


def piece_corners(shape):
    """Vertices of each convex piece as a set, in nanometres: zeros of either sign decide their order, and how planar faces are divided."""
    return [set(map(tuple, np.rint(1e9 * piece.vertices).astype(int).tolist())) for piece in shape]


@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (index % 3 > 0)) for index, name in enumerate(NAMED)])
def test_each_object_has_its_shape(name):
    """`python -m tools.embedded_shapes` computes it again where an object has changed. Releases of NumPy differ by 5e-14 m at zero."""
    raw, recipe = NAMED[name], shape_recipe(NAMED[name], SETTINGS)
    shape = shipped_shape(raw.mesh, recipe)
    assert shape is not None
    if name in PIECES:
        assert piece_corners(shape) == piece_corners(modelled_shape(name, recipe))
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
    raw, recipe = NAMED["drill"], shape_recipe(NAMED["drill"], SETTINGS)
    found, computed = (
        [(piece.vertices.tolist(), piece.faces.tolist()) for piece in shape]
        for shape in (shipped_shape(raw.mesh, recipe), decompose(raw.mesh, recipe))
    )
    assert found == computed


def test_rounding_errors_do_not_hide_shapes_and_changes_do():
    raw = NAMED["mug"]
    recipe = shape_recipe(raw, SETTINGS)
    rounded = replace(raw.mesh, vertices=np.nextafter(raw.mesh.vertices, np.float32(1.0)))
    assert shipped_shape(rounded, recipe) is not None
    assert shipped_shape(replace(raw.mesh, vertices=raw.mesh.vertices * np.float32(1.01)), recipe) is None
    assert shipped_shape(raw.mesh, replace(recipe, pieces=recipe.pieces - 1)) is None
    assert len(shapes.read_shipped_shapes()) == len(NAMED) + YCBV_OBJECTS


def test_the_models_of_ycb_video_have_their_shapes(real_models):
    config = load_config("synpick", {"bake.models": str(real_models)})
    raws = read_objects(config.bake.models, config.objects, config.object_rows, config.cell.bins)
    assert len(raws) == YCBV_OBJECTS
    for raw in raws:
        assert shipped_shape(raw.mesh, shape_recipe(raw, config.objects)) is not None, f"{raw.name}: run tools.embedded_shapes --models"
