"""Collision shapes: hulls of few vertices, mass properties, convex decomposition and its cache."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import coacd
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import smooth_normals
from synpick_warp.scenes.collision import shapes as collision
from synpick_warp.scenes.collision.decomposition import ShapeRecipe, decompose
from synpick_warp.scenes.collision.hulls import hull_volume, mass_properties
from synpick_warp.scenes.collision.shapes import collision_shapes, default_cache_dir
from synpick_warp.scenes.collision.simplification import simplify_hull
from synpick_warp.scenes.types import ConvexPiece, TriangleMesh
from synpick_warp.system.processes.isolation import Failure
from tests.harness.environment import checkout_environment
from tests.harness.pieces import assert_valid

HULL = ShapeRecipe(concave=False, hull_vertices=64, piece_vertices=16, pieces=8, concavity=0.2)
CONCAVE = replace(HULL, concave=True)


def as_mesh(shape: trimesh.Trimesh) -> TriangleMesh:
    vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.int32)
    return TriangleMesh(vertices, faces, smooth_normals(vertices, faces), np.zeros((len(vertices), 2), np.float32))


def bowl(segments: int = 10) -> trimesh.Trimesh:
    """Half a spherical shell, 0.1 m outside, 0.09 m inside, open at the top."""
    angle = np.linspace(0.0, np.pi / 2, 5)
    outer = np.stack([np.sin(angle), -np.cos(angle)], axis=1) * 0.1
    inner = np.stack([np.sin(angle), -np.cos(angle)], axis=1)[::-1] * 0.09
    return trimesh.creation.revolve(np.concatenate([outer, inner]), sections=segments)


def never(line: str) -> None:
    pytest.fail(line)


def nothing(function, calls, limits):
    assert not calls, "computed again"
    return []


def test_mass_properties_of_a_cube_far_from_its_origin():
    box = trimesh.creation.box((1.0, 1.0, 1.0))
    box.apply_translation((3.0, -2.0, 7.0))
    result = mass_properties([ConvexPiece(box.vertices.astype(np.float32), box.faces.astype(np.int32))])
    assert result.volume == pytest.approx(1.0)
    assert result.center_of_mass == pytest.approx((3.0, -2.0, 7.0))
    assert np.allclose(result.unit_inertia, np.eye(3) / 6)


def test_mass_properties_of_two_half_boxes_are_those_of_the_whole():
    halves = [trimesh.creation.box(bounds=((left, 0.0, 0.0), (left + 0.1, 0.2, 0.3))) for left in (0.0, 0.1)]
    result = mass_properties([ConvexPiece(half.vertices.astype(np.float32), half.faces.astype(np.int32)) for half in halves])
    assert result.volume == pytest.approx(0.012)
    assert np.allclose(np.diag(result.unit_inertia), np.array((0.2**2 + 0.3**2, 0.2**2 + 0.3**2, 0.2**2 + 0.2**2)) / 12)


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


def test_the_second_time_a_shape_comes_from_the_cache(bowl_shape, monkeypatch):
    cache, mesh, shape = bowl_shape
    monkeypatch.setattr(collision, "run_isolated", nothing)
    (again,) = collision_shapes(["bowl"], [mesh], [CONCAVE], cache, never)
    assert len(again) == len(shape)
    for one, two in zip(again, shape, strict=True):
        assert np.array_equal(one.vertices, two.vertices)
        assert np.array_equal(one.faces, two.faces)
        assert one.vertices.dtype == np.float32
        assert one.faces.dtype == np.int32


def test_hulls_are_cached_too_and_no_temporary_file_is_left(tmp_path, monkeypatch):
    mesh = as_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    (shape,) = collision_shapes(["box"], [mesh], [HULL], tmp_path / "new", never)
    assert [file.suffix for file in (tmp_path / "new").iterdir()] == [".npz"]
    monkeypatch.setattr(collision, "run_isolated", nothing)
    (again,) = collision_shapes(["box"], [mesh], [HULL], tmp_path / "new", never)
    assert np.array_equal(again[0].vertices, shape[0].vertices)


def test_other_settings_and_other_meshes_have_cache_files_of_their_own(tmp_path):
    mesh = as_mesh(trimesh.creation.icosphere(3, radius=0.05))
    moved = replace(mesh, vertices=mesh.vertices + np.float32(1e-3))
    shapes = collision_shapes(["a", "b", "c"], [mesh, mesh, moved], [HULL, replace(HULL, hull_vertices=20), HULL], tmp_path, never)
    assert len(list(tmp_path.iterdir())) == 3
    assert [len(shape[0].vertices) for shape in shapes] == [64, 20, 64]


@pytest.mark.parametrize("damage", [b"", b"scrap", None])
def test_a_damaged_cache_file_is_computed_again(tmp_path, damage):
    mesh = as_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    collision_shapes(["box"], [mesh], [HULL], tmp_path, never)
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if damage is None else damage)
    (shape,) = collision_shapes(["box"], [mesh], [HULL], tmp_path, never)
    assert_valid(shape[0])
    assert file.read_bytes() == whole


def test_a_cache_file_with_vertex_indices_out_of_range_is_computed_again(tmp_path):
    mesh = as_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    collision_shapes(["box"], [mesh], [HULL], tmp_path, never)
    (file,) = tmp_path.iterdir()
    with np.load(file) as data:
        arrays = {**data, "faces": data["faces"] + 5}
    np.savez(file, **arrays)
    (shape,) = collision_shapes(["box"], [mesh], [HULL], tmp_path, never)
    assert_valid(shape[0])


def test_without_a_writable_cache_shapes_are_computed_all_the_same(tmp_path):
    (tmp_path / "file").write_text("")
    mesh = as_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    lines: list[str] = []
    shapes = collision_shapes(["a", "b"], [mesh, mesh], [HULL, HULL], tmp_path / "file" / "cache", lines.append)
    assert len(shapes) == 2
    assert len(lines) == 1
    assert "cannot be written" in lines[0]


def test_parallel_decomposition_gives_the_same_pieces(tmp_path, bowl_shape):
    _, mesh, shape = bowl_shape
    other = as_mesh(bowl(8))
    first, _ = collision_shapes(["one", "two"], [mesh, other], [CONCAVE, CONCAVE], tmp_path, lambda _: None)
    assert len(first) == len(shape)
    assert all(np.array_equal(a.vertices, b.vertices) for a, b in zip(first, shape, strict=True))


GUARDLESS = """
import sys
from pathlib import Path
import numpy as np, trimesh
from synpick_warp.scenes.collision.decomposition import ShapeRecipe
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


def fall_back(tmp_path, monkeypatch, result):
    """Collision shape of a mug, and the progress lines, where the decomposition returns or raises `result`."""

    def run(function, calls, limits):
        return [result if function is decompose else function(*call) for call in calls]

    monkeypatch.setattr(collision, "run_isolated", run)
    lines: list[str] = []
    (shape,) = collision_shapes(["mug"], [as_mesh(bowl())], [CONCAVE], tmp_path, lines.append)
    return shape, lines


@pytest.mark.parametrize(
    ("result", "said"),
    [
        ((), "found no convex pieces"),
        (Failure("crashed (SIGSEGV)"), "crashed (SIGSEGV)"),
        (CatalogError("all vertices lie in one plane"), "failed (all vertices lie in one plane)"),
    ],
)
def test_what_cannot_be_decomposed_gets_its_hull_with_a_line_and_is_tried_again(tmp_path, monkeypatch, result, said):
    for _ in range(2):
        (hull,), lines = fall_back(tmp_path, monkeypatch, result)
        assert_valid(hull)
        assert lines[-1].startswith(f"mug: its convex decomposition {said}; its convex hull is used instead: ")
        assert len(lines) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("reason", ["took longer than 300 s of processor time and was stopped", "was killed, probably for lack of memory"])
def test_a_decomposition_for_which_the_machine_does_not_suffice_is_an_error_and_leaves_no_file(tmp_path, monkeypatch, reason):
    for _ in range(2):
        with pytest.raises(CatalogError, match=f"^mug: its convex decomposition {reason}; .*raise objects.decomposition_time"):
            fall_back(tmp_path, monkeypatch, Failure(reason, by_machine=True))
    assert not list(tmp_path.iterdir())


def test_a_hull_that_cannot_be_computed_is_the_error_of_its_object(tmp_path):
    flat = as_mesh(trimesh.creation.box((0.1, 0.1, 0.0)))
    good, bad = collision_shapes(["good", "bad"], [as_mesh(bowl()), flat], [HULL, HULL], tmp_path, never)
    assert len(good) == 1
    assert isinstance(bad, CatalogError)
    assert str(bad) == "bad: all vertices lie in one plane; a body needs a volume"


@pytest.mark.parametrize(
    ("kind", "modes"),
    [
        ("closed", ["off"]),
        ("open", ["auto"]),
        ("apart", ["off"]),
        ("joined", ["auto"]),
        ("folded", ["off"]),
        ("lost", ["off", "auto"]),
    ],
)
def test_only_open_meshes_inner_walls_and_lost_parts_are_preprocessed(monkeypatch, kind, modes):
    shell, asked = bowl(), []
    if kind == "open":
        shell.update_faces(np.arange(len(shell.faces)) > 0)
    if kind in ("apart", "joined"):
        other = trimesh.creation.icosphere(2, 0.05)
        other.apply_translation((0.5 if kind == "apart" else 0.0, 0.0, 0.0))
        shell = trimesh.util.concatenate([trimesh.creation.box((0.06, 0.2, 0.06)), other])
    if kind == "folded":
        shell = trimesh.Trimesh(shell.vertices, [*shell.faces, (0, 9, 30), (9, 0, 30)], process=False)

    def run_coacd(mesh, *, preprocess_mode, **_):
        asked.append(preprocess_mode)
        small = kind == "lost" and preprocess_mode == "off"
        return [(mesh.vertices * (0.1 if small else 1.0), mesh.indices)]

    monkeypatch.setattr(coacd, "run_coacd", run_coacd)
    (piece,) = decompose(as_mesh(shell), CONCAVE)
    assert asked == modes
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
    (piece,) = decompose(as_mesh(trimesh.creation.box((0.1, 0.1, 0.1))), CONCAVE)
    assert mass_properties([piece]).volume == pytest.approx(1e-3)


def test_the_default_cache_follows_the_environment(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_dir() == tmp_path / "synpick-warp" / "collision"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative")
    assert default_cache_dir() == Path.home() / ".cache" / "synpick-warp" / "collision"
