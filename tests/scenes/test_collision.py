"""Collision shapes: simplified hulls, mass properties, convex decomposition and its cache."""

import itertools
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from unittest import mock

import coacd
import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import cdist, pdist
from scipy.spatial.transform import Rotation

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.schema import Objects
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import smooth_normals
from synpick_warp.scenes.collision import shapes as collision
from synpick_warp.scenes.collision import simplification
from synpick_warp.scenes.collision.hulls import hull_planes, hull_volume, mass_properties
from synpick_warp.scenes.collision.shapes import ShapeRecipe, collision_shapes, decompose, default_cache_dir
from synpick_warp.scenes.collision.simplification import MIN_VERTICES, simplify_hull
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from synpick_warp.system.processes.isolation import Failure
from tests.harness.environment import checkout_environment
from tests.harness.pieces import assert_valid

HULL = ShapeRecipe(concave=False, hull_vertices=64, piece_vertices=16, pieces=8, concavity=0.2)
CONCAVE = replace(HULL, concave=True)


def as_mesh(shape: trimesh.Trimesh) -> TriangleMesh:
    vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int32)
    return TriangleMesh(vertices, faces, smooth_normals(vertices, faces), np.zeros((len(vertices), 2), np.float32))


BOX = as_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))


def bowl(segments: int = 10) -> trimesh.Trimesh:
    """Half a spherical shell, 0.1 m outside, 0.09 m inside, open at the top."""
    angle = np.linspace(0.0, np.pi / 2, 5)
    outer = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * 0.1
    inner = np.stack([np.sin(angle), -np.cos(angle)], axis=1)[::-1] * 0.09
    return trimesh.creation.revolve(np.concatenate([outer, inner]), sections=segments)


def test_mass_properties_of_a_cube_far_from_its_origin_and_of_two_half_boxes():
    cube = trimesh.creation.box((1.0, 1.0, 1.0)).apply_translation((3.0, -2.0, 7.0))
    halves = [trimesh.creation.box(bounds=((left, 0.0, 0.0), (left + 0.1, 0.2, 0.3))) for left in (0.0, 0.1)]
    for boxes, sides, middle in (([cube], (1.0, 1.0, 1.0), (3.0, -2.0, 7.0)), (halves, (0.2, 0.2, 0.3), (0.1, 0.1, 0.15))):
        result = mass_properties([ConvexPiece(box.vertices.astype(np.float32), box.faces.astype(np.int32)) for box in boxes])
        squares = np.square(sides)
        assert result.volume == pytest.approx(np.prod(sides))
        assert result.center_of_mass == pytest.approx(middle)
        assert np.allclose(result.unit_inertia, np.diag(squares.sum() - squares) / 12)


@given(st.integers(0, 2**32 - 1), st.integers(5, 60), st.floats(1e-2, 1.0))
def test_mass_properties_are_physical_and_agree_with_trimesh(seed, count, flatness):
    points = np.random.default_rng(seed).normal(size=(count, 3)) * (0.1, 0.1, 0.1 * flatness)
    piece = simplify_hull(points, 64)
    result = mass_properties([piece])
    twin = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
    assert result.volume == pytest.approx(twin.volume, rel=1e-4)
    assert np.allclose(result.center_of_mass, twin.center_mass, atol=1e-5)
    assert np.allclose(result.unit_inertia, twin.moment_inertia / twin.volume, atol=1e-4 * result.unit_inertia.max())
    low, middle, high = np.linalg.eigvalsh(result.unit_inertia)
    assert low > 0.0
    assert low + middle >= high


@pytest.fixture(scope="module")
def bowl_shape(tmp_path_factory) -> tuple[Path, TriangleMesh, tuple[ConvexPiece, ...]]:
    cache, mesh = tmp_path_factory.mktemp("cache"), as_mesh(bowl())
    lines: list[str] = []
    (shape,) = collision_shapes(["bowl"], [mesh], [CONCAVE], cache, lines.append)
    assert any("bowl" in line for line in lines)
    return cache, mesh, shape


def test_a_decomposed_bowl_stays_hollow(bowl_shape):
    _, mesh, shape = bowl_shape
    assert 2 <= len(shape) <= CONCAVE.pieces
    for piece in shape:
        assert_valid(piece)
        assert len(piece.vertices) <= CONCAVE.piece_vertices
    assert mass_properties(shape).volume < 0.7 * hull_volume(mesh.vertices)
    # The middle of the opening is free: it lies outside of every piece.
    middle = np.array((0.0, 0.0, -0.03))
    for piece in shape:
        corners = piece.vertices[piece.faces].astype(np.float64)
        doubled = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.einsum("fi,fi->f", doubled, middle - corners[:, 0]).max() > 0.0


def test_the_second_time_shapes_come_from_the_cache(bowl_shape, tmp_path, monkeypatch):
    """Hulls too; and decompositions in parallel give the same pieces."""
    cache, mesh, shape = bowl_shape
    (parallel, _) = collision_shapes(["one", "two"], [mesh, BOX], [CONCAVE, CONCAVE], tmp_path, lambda _: None)
    (hull,) = collision_shapes(["box"], [BOX], [HULL], tmp_path / "new", pytest.fail)
    assert [file.suffix for file in (tmp_path / "new").iterdir()] == [".npz"]
    monkeypatch.setattr(collision, "run_isolated", lambda function, calls, limits: pytest.fail("computed again") if calls else [])
    (again,) = collision_shapes(["bowl"], [mesh], [CONCAVE], cache, pytest.fail)
    (hull_again,) = collision_shapes(["box"], [BOX], [HULL], tmp_path / "new", pytest.fail)
    for one, two in zip((*again, *hull_again, *parallel), (*shape, *hull, *shape), strict=True):
        assert np.array_equal(one.vertices, two.vertices)
        assert np.array_equal(one.faces, two.faces)
        assert (one.vertices.dtype, one.faces.dtype) == (np.float32, np.int32)


def test_other_settings_and_other_meshes_have_cache_files_of_their_own(tmp_path):
    mesh = as_mesh(trimesh.creation.icosphere(2, radius=0.05))
    moved = replace(mesh, vertices=mesh.vertices + np.float32(1e-3))
    shapes = collision_shapes(["a", "b", "c"], [mesh, mesh, moved], [HULL, replace(HULL, hull_vertices=20), HULL], tmp_path, pytest.fail)
    assert len(list(tmp_path.iterdir())) == 3
    assert [len(shape[0].vertices) for shape in shapes] == [64, 20, 64]


@pytest.mark.parametrize("damage", ["empty", "scrap", "half", "indices", "fifo"])
def test_a_damaged_cache_file_is_computed_again(tmp_path, damage):
    """Also one with vertex indices out of range."""
    collision_shapes(["box"], [BOX], [HULL], tmp_path, pytest.fail)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    if damage == "fifo":
        file.unlink()
        os.mkfifo(file)
    elif damage == "indices":
        with np.load(file) as data:
            arrays = {**data, "faces": data["faces"] + 5}
        np.savez(file, **arrays)
    else:
        file.write_bytes({"empty": b"", "scrap": b"scrap", "half": whole[: len(whole) // 2]}[damage])
    (shape,) = collision_shapes(["box"], [BOX], [HULL], tmp_path, pytest.fail)
    assert_valid(shape[0])
    assert file.read_bytes() == whole


def test_without_a_writable_cache_shapes_are_computed_all_the_same(tmp_path):
    (tmp_path / "file").write_text("")
    lines: list[str] = []
    assert len(collision_shapes(["a", "b"], [BOX, BOX], [HULL, HULL], tmp_path / "file" / "cache", lines.append)) == 2
    (line,) = lines
    assert "cannot be written" in line


GUARDLESS = """
import sys
from pathlib import Path
import numpy as np, trimesh
from synpick_warp.scenes.collision.shapes import ShapeRecipe
from synpick_warp.scenes.collision.shapes import collision_shapes
from synpick_warp.scenes.types import TriangleMesh

def cube(size):
    box = trimesh.creation.box((size,) * 3)
    vertices = box.vertices.astype(np.float32)
    return TriangleMesh(vertices, box.faces.astype(np.int32), vertices, np.zeros((8, 2), np.float32))

recipe = ShapeRecipe(True, 64, 16, 8, 0.2)
shapes = collision_shapes(["a", "b"], [cube(0.1), cube(0.2)], [recipe, recipe], Path(sys.argv[1]), lambda line: None)
print([len(shape) for shape in shapes])
"""


def test_a_script_without_main_guard_can_decompose(tmp_path):
    """Processes of `multiprocessing` would run the script again in each child, and die."""
    script = tmp_path / "script.py"
    script.write_text(GUARDLESS)
    result = subprocess.run(
        [sys.executable, script, tmp_path / "cache"], env=checkout_environment(), capture_output=True, text=True, check=False
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, "[1, 1]\n", "")


@pytest.mark.parametrize(
    ("result", "said"),
    [
        ((), "found no convex pieces"),
        (Failure("crashed (SIGSEGV)"), "crashed (SIGSEGV)"),
        (CatalogError("all vertices lie in one plane"), "failed (all vertices lie in one plane)"),
        *(
            (Failure(reason, by_machine=True), reason)
            for reason in ("took longer than 300 s of processor time and was stopped", "was killed, probably for lack of memory")
        ),
    ],
)
def test_what_cannot_be_decomposed_gets_its_hull_with_a_line_or_is_an_error_and_is_tried_again(tmp_path, monkeypatch, result, said):
    """An error where the machine does not suffice. No file is left."""

    def run(function, calls, limits):
        return [result if function is decompose else function(*call) for call in calls]

    monkeypatch.setattr(collision, "run_isolated", run)
    for _ in range(2):
        lines: list[str] = []
        if isinstance(result, Failure) and result.by_machine:
            with pytest.raises(CatalogError, match=f"^mug: its convex decomposition {said}; .*raise objects.decomposition_time"):
                collision_shapes(["mug"], [as_mesh(bowl())], [CONCAVE], tmp_path, lines.append)
            continue
        (((hull,),)) = collision_shapes(["mug"], [as_mesh(bowl())], [CONCAVE], tmp_path, lines.append)
        assert_valid(hull)
        assert lines[-1].startswith(f"mug: its convex decomposition {said}; its convex hull is used instead: ")
        assert len(lines) == 2
    assert not list(tmp_path.iterdir())


def test_a_hull_that_cannot_be_computed_is_the_error_of_its_object(tmp_path):
    flat = as_mesh(trimesh.creation.box((0.1, 0.1, 0.0)))
    good, bad = collision_shapes(["good", "bad"], [as_mesh(bowl()), flat], [HULL, HULL], tmp_path, pytest.fail)
    assert len(good) == 1
    assert isinstance(bad, CatalogError)
    assert str(bad) == "bad: all vertices lie in one plane; a body needs a volume"


@pytest.mark.parametrize(
    ("kind", "modes"),
    [("closed", "off"), ("open", "auto"), ("apart", "off"), ("joined", "auto"), ("folded", "off"), ("lost", "off auto")],
)
def test_only_open_meshes_inner_walls_and_lost_parts_are_preprocessed(monkeypatch, kind, modes):
    shell, asked = bowl(), []
    if kind == "open":
        shell.update_faces(np.arange(len(shell.faces)) > 0)
    if kind in ("apart", "joined"):
        other = trimesh.creation.icosphere(2, 0.05).apply_translation((0.5 if kind == "apart" else 0.0, 0.0, 0.0))
        shell = trimesh.util.concatenate([trimesh.creation.box((0.06, 0.2, 0.06)), other])
    if kind == "folded":
        shell = trimesh.Trimesh(shell.vertices, [*shell.faces, (0, 9, 30), (9, 0, 30)], process=False)

    def run_coacd(mesh, *, preprocess_mode, **_):
        asked.append(preprocess_mode)
        small = kind == "lost" and preprocess_mode == "off"
        return [(mesh.vertices * (0.1 if small else 1.0), mesh.indices)]

    monkeypatch.setattr(coacd, "run_coacd", run_coacd)
    (piece,) = decompose(as_mesh(shell), CONCAVE)
    assert asked == modes.split()
    assert_valid(piece)


@pytest.mark.parametrize("copies", [1, 3])
def test_repeated_triangles_and_needles_do_not_reach_coacd(monkeypatch, copies):
    """Each triangle of an open box three times, another turned round once, and needles between its corners."""
    box, given = trimesh.creation.box((0.1, 0.1, 0.1)), []
    corners = np.concatenate([box.vertices, (box.vertices[:1] + box.vertices[1:2]) / 2, [(0.3, 0.0, 0.0)]])
    faces = np.concatenate([*[box.faces[1:]] * copies, box.faces[1:3, ::-1][: copies - 1], [(0, 8, 1), (0, 0, 1)] * copies])
    monkeypatch.setattr(coacd, "run_coacd", lambda mesh, **_: given.append(mesh) or [(box.vertices, None)])
    mesh = TriangleMesh(corners.astype(np.float32), faces.astype(np.int32), corners, corners[:, :2])
    decompose(mesh, CONCAVE)
    assert len(given[0].indices) == 11
    assert len(given[0].vertices) == 8
    given.clear()
    assert decompose(replace(mesh, faces=faces[-2:].astype(np.int32)), CONCAVE) == ()
    assert not given


def test_slivers_of_a_decomposition_are_dropped(monkeypatch):
    big, flat = trimesh.creation.box((0.1, 0.1, 0.1)).vertices, trimesh.creation.box((0.01, 0.01, 1e-5)).vertices
    monkeypatch.setattr(coacd, "run_coacd", lambda *_, **__: [(big, None), (flat, None), (flat * (1, 1, 0), None)])
    (piece,) = decompose(BOX, CONCAVE)
    assert mass_properties([piece]).volume == pytest.approx(1e-3)


def test_the_default_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "synpick-warp" / "collision"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert default_cache_dir() == Path.home() / ".cache" / "synpick-warp" / "collision"


# ---- simplification of hulls: boxes, scans of boxes, spheres, random and degenerate points ----


def ring(radius: float, height: float, count: int) -> np.ndarray:
    """Points of a circle about the z-axis."""
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    return np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)])


def ball(rng: np.random.Generator, radius: float, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return radius * points / np.linalg.norm(points, axis=1, keepdims=True)


def ladle(rng: np.random.Generator) -> np.ndarray:
    """A sphere with a thin, long handle."""
    thickness, length = rng.uniform(0.005, 0.1), rng.uniform(3.0, 10.0)
    return np.concatenate([ball(rng, rng.uniform(0.2, 1.0), 80), ring(thickness, length, 12), ring(0.7 * thickness, 1.01 * length, 12)])


def wedge(rng: np.random.Generator) -> np.ndarray:
    """Elongated wedge with rough sides."""
    width, edge = rng.uniform(0.3, 1.0, 2), rng.uniform(0.001, 0.05)
    corners = [(x * width[0], y * width[1], 0.0) for x in (-1, 1) for y in (-1, 1)]
    corners += [(x * edge, y * rng.uniform(0.2, 1.0) * width[1], 3.0) for x in (-1, 1) for y in (-1, 1)]
    points = np.concatenate([corners, rng.dirichlet(np.full(8, 0.3), 150) @ corners])
    return points + rng.normal(size=points.shape) * 0.005


def cone(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([ring(1.0, 0.0, int(rng.integers(30, 90))), [(0.0, 0.0, rng.uniform(0.2, 6.0))]])


def rod(rng: np.random.Generator) -> np.ndarray:
    """A thin rod with one chamfered end."""
    radius, count = rng.uniform(0.001, 0.05), int(rng.integers(16, 40))
    return np.concatenate([ring(radius, -1.0, count), ring(radius, 1.0, count), ring(0.7 * radius, 1.0 + 0.4 * radius, count)])


def disc(rng: np.random.Generator) -> np.ndarray:
    """A thin disc with one chamfered rim."""
    thickness, count = rng.uniform(0.001, 0.05), int(rng.integers(30, 60))
    return np.concatenate([ring(1.0, -thickness, count), ring(1.0, thickness, count), ring(0.97, 1.2 * thickness, count)])


def tetrahedron(rng: np.random.Generator) -> np.ndarray:
    """A rounded tetrahedron of any shape."""
    return (rng.normal(size=(4, 1, 3)) + ball(rng, 0.08, 20)).reshape(-1, 3)


FAMILIES = (ladle, wedge, cone, rod, disc, tetrahedron)
SEEDS = st.integers(0, 2**32 - 1)


def turned(points: np.ndarray, seed: int) -> np.ndarray:
    """Points in a random orientation: quaternions of normal components are uniformly distributed."""
    return points @ Rotation.from_quat(np.random.default_rng(seed).normal(size=4)).as_matrix().T


def reach(piece: ConvexPiece, points: np.ndarray) -> float:
    """Largest distance of a piece's vertex from a side of the points' hull, outside of it."""
    planes = ConvexHull(points).equations
    return float((piece.vertices @ planes[:, :3].T + planes[:, 3]).max())


@settings(max_examples=8)
@pytest.mark.parametrize("family", FAMILIES)
@given(SEEDS, st.integers(8, 64), st.floats(-4.0, 4.0))
def test_hulls_of_any_shape_and_size_become_half_spaces_of_their_volume(family, seed, limit, exponent):
    points = (turned(family(np.random.default_rng(seed)), seed) * 10.0**exponent).astype(np.float32)
    with mock.patch.object(simplification, "_decimate", wraps=simplification._decimate) as decimate:
        piece = simplify_hull(points, limit)
    assert decimate.call_count <= 1  # A second call is the fallback.
    assert_valid(piece)
    assert len(piece.vertices) <= limit
    size = np.ptp(points, axis=0).max()
    assert mass_properties([piece]).volume == pytest.approx(ConvexHull(points.astype(np.float64)).volume, rel=2e-3)
    assert len(ConvexHull(piece.vertices.astype(np.float64)).vertices) == len(piece.vertices)
    assert pdist(piece.vertices.astype(np.float64)).min() > 4e-7 * size


@settings(max_examples=10)
@given(SEEDS, st.integers(8, 12))
def test_a_diagonal_rod_of_few_vertices_stays_thin(seed, limit):
    points = turned(rod(np.random.default_rng(seed)), seed)
    piece = simplify_hull(points, limit)
    radius = np.linalg.norm(np.cross(points, turned(np.array([(0.0, 0.0, 1.0)]), seed)), axis=1).max()
    assert reach(piece, points) < 4.0 * radius


@settings(max_examples=8)
@given(SEEDS, st.integers(8, 64))
def test_a_turned_hull_gives_the_turned_result(seed, limit):
    points = np.random.default_rng(seed).normal(size=(60, 3)) * (0.1, 0.06, 0.03)
    piece, other = simplify_hull(points, limit), simplify_hull(turned(points, seed), limit)
    assert mass_properties([other]).volume == pytest.approx(mass_properties([piece]).volume, rel=1e-5)
    distances = cdist(turned(piece.vertices, seed), other.vertices)
    assert max(distances.min(axis=0).max(), distances.min(axis=1).max()) < 1e-4


@settings(max_examples=8)
@given(SEEDS, st.integers(-30, 30))
def test_a_scaled_hull_gives_the_scaled_result(seed, exponent):
    points = tetrahedron(np.random.default_rng(seed)).astype(np.float32)
    scale = np.float32(2.0**exponent)
    assert np.array_equal(simplify_hull(points * scale, 24).vertices, simplify_hull(points, 24).vertices * scale)


@settings(max_examples=8)
@pytest.mark.parametrize("family", FAMILIES)
@given(SEEDS)
def test_no_useful_half_space_is_left_over(family, seed):
    """Without a limit: a candidate of little volume but great height must not end the selection."""
    hull = ConvexHull(turned(family(np.random.default_rng(seed)), seed))
    facets, frame = simplification._cluster(hull, simplification._centroid(hull))
    min_gain = 1e-3 * hull.volume
    chosen = simplification._select(facets, frame, len(facets.normal), min_gain)
    current = simplification._intersect(facets, chosen)
    for index in set(range(len(facets.normal))) - set(chosen):
        cut = simplification._intersect(facets, [*chosen, index])
        assert simplification._gain(current, cut, facets.normal[index], facets.offset[index]) < min_gain


def test_where_half_spaces_fail_the_hull_of_selected_points_is_returned():
    points = np.random.default_rng(0).normal(size=(300, 3))
    with mock.patch.object(simplification, "_choose_facets", side_effect=QhullError):
        piece = simplify_hull(points, 32)
    assert_valid(piece)
    assert 24 <= len(piece.vertices) <= 32
    assert reach(piece, points) < 1e-6


@pytest.mark.parametrize("limit", [0, 4, MIN_VERTICES - 1])
def test_fewer_vertices_than_a_box_has_are_refused_also_by_the_settings(limit):
    with pytest.raises(ValueError, match=f"max_vertices is {limit}, but must be at least 8"):
        simplify_hull(np.random.default_rng(0).random((50, 3)), limit)
    assert [settings_of(Objects)[name].bounds.low for name in ("hull_vertices", "piece_vertices")] == [MIN_VERTICES] * 2


def test_a_cube_keeps_its_eight_corners():
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 6)] * 3), axis=-1).reshape(-1, 3)
    piece = simplify_hull(grid, 64)
    assert_valid(piece)
    assert np.array_equal(np.unique(piece.vertices, axis=0), np.unique(np.sign(grid[np.abs(grid).min(axis=1) == 0.5]) / 2, axis=0))


@settings(max_examples=20)
@given(st.integers(0, 2**32 - 1), st.integers(4, 400), st.integers(8, 64), st.floats(1e-3, 1.0))
@example(0, 4, 8, 1e-3)  # Half-spaces with a vertex at infinity in a plane through the inner point.
def test_simplified_hulls_are_valid(seed, count, limit, flatness):
    points = np.random.default_rng(seed).normal(size=(count, 3)) * (0.1, 0.05, 0.1 * flatness)
    piece = simplify_hull(points, limit)
    assert_valid(piece)
    assert len(piece.vertices) <= limit
    assert np.array_equal(simplify_hull(points, limit).vertices, piece.vertices)


@given(st.integers(0, 2**32 - 1), st.floats(1e-5, 2e-4))
def test_a_scanned_box_gets_six_planar_sides(seed, roughness):
    """Points of a box's sides, moved by up to `roughness` [m]: each side becomes one plane, no farther from it than twice that."""
    rng, size = np.random.default_rng(seed), np.array((0.1, 0.15, 0.05))
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, 9)] * 3), axis=-1).reshape(-1, 3)
    points = grid[np.abs(grid).max(axis=1) == 0.5] * size
    scanned = points + rng.uniform(-roughness, roughness, points.shape)
    piece = simplify_hull(scanned, 64)
    assert mass_properties([piece]).volume == pytest.approx(hull_volume(scanned), rel=2e-3)
    vertices, planes = piece.vertices.astype(np.float64), hull_planes(piece)
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        assert (side * vertices[:, axis]).max() == pytest.approx(size[axis] / 2, abs=2 * roughness)
        facing = planes[side * planes[:, axis] > np.cos(np.radians(2.0))]
        distances = np.abs(vertices @ facing[:, :3].T - facing[:, 3])
        corners = vertices[distances[:, (distances < 1e-6).sum(axis=0).argmax()] < 1e-6]
        assert len(corners) >= 4
        assert (np.ptp(np.delete(corners, axis, axis=1), axis=0) > 0.9 * np.delete(size, axis)).all()


def test_a_sphere_keeps_its_volume_in_64_vertices():
    # Its vertices lie outside and the middles of its facets inside: by 12 and 8 % of the radius at most.
    sphere = trimesh.creation.icosphere(3, radius=0.05)
    piece = simplify_hull(sphere.vertices, 64)
    assert_valid(piece)
    assert 50 <= len(piece.vertices) <= 64
    assert mass_properties([piece]).volume == pytest.approx(hull_volume(sphere.vertices), rel=1e-3)
    assert np.linalg.norm(piece.vertices, axis=1).max() < 1.12 * 0.05
    assert hull_planes(piece)[:, 3].min() > 0.92 * 0.05


@pytest.mark.parametrize("points", [np.zeros((9, 3)), np.eye(3), np.random.default_rng(0).random((50, 3)) * (1, 1, 0), np.ones((1, 3))])
def test_coplanar_points_have_no_hull(points):
    assert hull_volume(points) == 0.0
    with pytest.raises(CatalogError, match="one plane"):
        simplify_hull(points, 64)
