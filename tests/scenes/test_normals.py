"""Vertex normals of meshes without any: creases, seams, degenerate triangles, and what must not notice split vertices."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from trimesh.exchange.gltf import export_gltf

from synpick_warp.exporters.bop.shared.models import write_models
from synpick_warp.scenes.assets.meshes import merge_positions, read_mesh, signed_volume
from synpick_warp.scenes.assets.normals import crease_normals, smooth_normals
from tests.twins.layers import render_layers
from tests.worlds.model_files import exported, load_models, put
from tests.worlds.shapes import camera, entry
from tests.worlds.toy_scene import ToyScene

KINDS = ("ply", "obj", "glb", "gltf", "stl")


def write(folder, mesh: trimesh.Trimesh, kind: str, *, split: bool = False):
    """Write a mesh without normals; `split`: with three vertices a triangle."""
    faces = np.arange(3 * len(mesh.faces)).reshape(-1, 3) if split else mesh.faces
    bare = trimesh.Trimesh(mesh.vertices[mesh.faces].reshape(-1, 3) if split else mesh.vertices, faces, process=False)
    file = folder / f"part.{kind}"
    if kind == "gltf":
        for name, data in export_gltf(trimesh.Scene([bare])).items():
            (folder / (file.name if name == "model.gltf" else name)).write_bytes(data)
    else:
        put(file, exported(bare, kind))
    return file


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("split", [False, True])
def test_a_box_shows_three_normals_in_the_layer(tmp_path, device, kind, split):
    box = trimesh.creation.box((0.1, 0.08, 0.06))
    mesh, *_ = read_mesh(write(tmp_path, box, kind, split=split), 1.0)
    pose = (0.0, 0.0, 0.2, -0.28, 0.12, 0.35, 0.88)
    view = camera(160, 90, 500.0, (0.0, 0.0, 1.0))
    rendered = render_layers(ToyScene([entry(mesh)], [[(0, pose)]], (view,)), device, names=("normals",))
    seen = rendered["normals"][0][rendered.segment[0] == 1]
    assert len(seen) > 500
    assert len(np.unique(seen.round(4), axis=0)) == 3


@pytest.mark.parametrize("kind", KINDS)
def test_a_ball_stays_smooth(tmp_path, kind):
    ball = trimesh.creation.icosphere(3, 0.1)
    mesh, *_ = read_mesh(write(tmp_path, ball, kind), 1.0)
    assert len(mesh.vertices) == len(ball.vertices)
    assert np.abs(mesh.normals - mesh.vertices / 0.1).max() < 0.03


@pytest.mark.parametrize(("sides", "smooth"), [(8, False), (12, True), (64, True)])
def test_a_cylinder_is_smooth_around_and_sharp_at_its_ends(sides, smooth):
    tube = trimesh.creation.cylinder(0.05, 0.2, sections=sides)
    source, faces, normals = crease_normals(tube.vertices, tube.faces, 35.0)
    corners = normals[faces]
    flat = np.cross(*np.diff(tube.vertices[source][faces], axis=1).transpose(1, 0, 2))
    flat /= np.linalg.norm(flat, axis=1, keepdims=True)
    ends = np.abs(flat[:, 2]) > 0.5
    assert np.allclose(corners[ends], flat[ends][:, None], atol=1e-6)
    assert np.allclose(corners[~ends][..., 2], 0.0, atol=1e-6)
    assert np.allclose(corners[~ends], flat[~ends][:, None], atol=1e-6) == (not smooth)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 180.0))
def test_creases_do_not_depend_on_how_vertices_are_stored(seed, angle):
    """Seams of texture coordinates, the order of triangles, copies of triangles without an area."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.creation.icosphere(1) if seed % 2 else trimesh.creation.box((1, 1, 1))
    vertices, faces = mesh.vertices * rng.uniform(0.3, 1.5, (len(mesh.vertices), 1)), np.asarray(mesh.faces)
    _, whole_faces, whole = crease_normals(vertices, faces, angle)
    order = rng.permutation(len(faces))
    corner = faces[order].reshape(-1)
    degenerate = np.array([[0, 1, 0], [3, 4, 4], [2, 2, 2]])
    split = np.concatenate([np.arange(len(corner)).reshape(-1, 3), degenerate])
    source, new_faces, normals = crease_normals(vertices[corner], split, angle)
    assert np.array_equal(source[: len(corner)], np.arange(len(corner)))
    assert np.allclose(normals[new_faces[: len(order)]], whole[whole_faces[order]], atol=1e-5)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-5)


def test_without_creases_normals_are_the_smooth_ones_also_of_triangles_without_an_area():
    ball = trimesh.creation.icosphere(2)
    source, faces, normals = crease_normals(ball.vertices, ball.faces, 180.0)
    assert np.array_equal(faces, ball.faces)
    assert np.array_equal(source, np.arange(len(ball.vertices)))
    assert np.allclose(normals, smooth_normals(ball.vertices, ball.faces), atol=1e-6)
    assert np.array_equal(crease_normals(np.zeros((3, 3)), np.array([[0, 1, 2]]), 35.0)[2], [[0, 0, 1]] * 3)


def test_a_fan_of_many_triangles_is_one_group():
    """The tip of a flat cone of 3,000 triangles, more than are compared one by one."""
    turn = np.linspace(0.0, 2.0 * np.pi, 3000, endpoint=False)
    vertices = np.vstack([[0, 0, 0.3], np.column_stack([np.cos(turn), np.sin(turn), np.zeros(3000)])])
    faces = np.column_stack([np.zeros(3000, int), np.arange(3000) + 1, (np.arange(3000) + 1) % 3000 + 1])
    source, _, normals = crease_normals(vertices, faces, 35.0)
    assert np.array_equal(source, np.arange(3001))
    assert normals[0] == pytest.approx((0, 0, 1), abs=1e-5)


def test_split_vertices_leave_mass_collision_and_models_as_they_are(tmp_path):
    """The same box with normals of one vertex a corner, and without normals, where its vertices are split."""
    (tmp_path / "models").mkdir()
    file = write(tmp_path / "models", trimesh.creation.box((0.1, 0.08, 0.06)), "ply")
    one, other = (load_models(file.parent, tmp_path, crease_angle=angle)[0].entries[0] for angle in (180.0, 35.0))
    assert (len(one.mesh.vertices), len(other.mesh.vertices)) == (8, 24)
    assert other.volume == pytest.approx(one.volume)
    assert other.inertia == pytest.approx(one.inertia)
    assert other.diameter == pytest.approx(one.diameter)
    assert len(other.pieces) == len(one.pieces) == 1
    assert signed_volume(other.mesh.vertices, other.mesh.faces) == pytest.approx(4.8e-4)
    places, faces = merge_positions(other.mesh.vertices, other.mesh.faces)
    assert trimesh.Trimesh(places, faces, process=False).is_watertight
    catalog = load_models(file.parent, tmp_path)[0]
    write_models(tmp_path / "out", catalog)
    again, *_ = read_mesh(tmp_path / "out" / "obj_000001.ply", 1e-3)
    assert np.array_equal(again.normals, other.mesh.normals)
    exported = trimesh.load_mesh(tmp_path / "out" / "obj_000001.ply")
    exported.merge_vertices(merge_norm=True)
    assert exported.is_watertight
    assert exported.volume == pytest.approx(4.8e5)
