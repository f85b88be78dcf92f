"""OBJ and MTL import: spellings of the same, options of textures, PBR, what is missing or ignored, textures that repeat; polygons. Vertex
normals of meshes without any: creases, seams, degenerate triangles, and what must not notice split vertices."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from trimesh.exchange.gltf import export_gltf

from synpick_warp.errors import CatalogError
from synpick_warp.exporters.bop.shared import write_models
from synpick_warp.scenes.assets.mesh_parts import clip_ears, find_concave
from synpick_warp.scenes.assets.meshes import MeshOptions, merge_positions, read_mesh, signed_volume
from synpick_warp.scenes.assets.normals import crease_normals, smooth_normals
from tests.twins.layers import render_layers
from tests.worlds.model_files import exported, load_models, picture, put, read_told, texels
from tests.worlds.shapes import camera, entry
from tests.worlds.toy_scene import ToyScene

RED = "newmtl skin\nKd 1 0 0\n"
GREY = (0.7, 0.7, 0.7)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
VERTICES = ("v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1")
HEAD = "mtllib a.mtl\n" + "\n".join(VERTICES) + "\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = ("f 1/1 3/2 2/3\n", "f 1/1 2/2 4/3\n", "f 1/1 4/2 3/3\n", "f 2/1 3/2 4/3\n")
OBJ = HEAD + "usemtl skin\n" + "".join(FACES)
PLAIN = "\n".join(["mtllib a.mtl", *VERTICES, "usemtl skin", "f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4", ""])
"""Without texture coordinates."""
RELATIVE = "\n".join(["mtllib a.mtl", *VERTICES[:3], "usemtl skin", "f -3 -1 -2", VERTICES[3], "f 1 2 -1", "f -4 -1 -2", "f 2 3 4", ""])


def read(folder: Path, mtl: str | None, obj: str = OBJ, encoding: str = "utf-8", **options: bool) -> tuple[Any, Any, str]:
    """Read an OBJ with this library and three images; the last is the one line that may be told."""
    if mtl is not None:
        put(folder / "a.mtl", mtl.encode(encoding))
    for name, color in (("skin.png", (200, 10, 30)), ("two words.png", (0, 255, 0)), ("grey.png", (51, 51, 51))):
        picture(folder / name, color)
    mesh, finish, said = read_told(folder / "a.obj", obj.encode(encoding), MeshOptions(**options))
    assert len(said) <= 1
    return mesh, finish, "".join(said)


# ---- text ----


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("obj", "mtl"),
    [
        (PLAIN, RED),
        (RELATIVE, RED),
        (PLAIN.replace("f 1 3 2", "f 1 \\\n 3 2"), RED.replace("1 0 0", "1 \\\n0 0")),
        (PLAIN.replace("\n", "\n  "), RED.replace("\n", "\n\t")),
        (PLAIN.replace(" ", "\t"), RED),
        (PLAIN.replace("f ", "fo "), RED),
        (PLAIN.replace("v 1 0 0", "v 1 0 0 # x").replace("f 1 3 2", "f 1 3 2 # a").replace("l skin", "l skin # red"), RED),
        (PLAIN, RED.replace("1 0 0", "1 0 0 # red")),
        (PLAIN.replace("skin", "Skin"), RED),
        (PLAIN.replace("skin", "my  skin #3"), RED.replace("skin", "my  skin #3")),
        (PLAIN.replace("a.mtl", '"a.mtl"'), RED),
        (PLAIN.replace("a.mtl", "a.mtl # colours"), RED),
        (PLAIN.replace("a.mtl", "b.mtl A.mtl"), RED),
        ("# usemtl other\n" + PLAIN, "# newmtl other\n" + RED),
    ],
)
def test_spellings_of_the_same_file(tmp_path, obj, mtl, end):
    put(tmp_path / "b.mtl", "newmtl other\nKd 0 1 0\n")
    mesh, finish, said = read(tmp_path, mtl.replace("\n", end), obj.replace("\n", end))
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)
    assert len(mesh.faces) == 4
    assert finish.color == (1.0, 0.0, 0.0)
    assert not said


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "latin-1"])
def test_text_of_any_encoding(tmp_path, encoding):
    mesh, finish, said = read(tmp_path, "newmtl grün\nKd 0 1 0\n", "# Grüße\n" + PLAIN.replace("skin", "grün"), encoding)
    assert len(mesh.faces) == 4
    assert (finish.color, said) == ((0.0, 1.0, 0.0), "")


@pytest.mark.parametrize("face", ["f 0 3 2", "f 1 0 2", "f 1 3 0", "f 1/1 3/1 0/1"])
def test_vertex_0_is_refused(tmp_path, face):
    """It would be the last one."""
    with pytest.raises(CatalogError, match="a face refers to vertex 0, but indices begin at 1"):
        read(tmp_path, None, PLAIN.replace("f 1 3 2", face).replace("mtllib a.mtl\n", "vt 0 0\n"))


# ---- materials ----


@pytest.mark.parametrize(
    ("options", "scale", "offset", "said"),
    [
        ("-s 15 15 1", (15, 15), (0, 0), ""),
        ("-s 3 3 1 -o 0.5 0 0", (3, 3), (0.5, 0), ""),
        ("-o 0.5 0.25 -s 2 4", (2, 4), (0.5, 0.25), ""),
        ("-s 2", (2, 1), (0, 0), ""),
        ("-O 0.5", (1, 1), (0.5, 0), ""),
        ("-clamp off -blendu on -mm 0 1 -s 2 2 2", (2, 2), (0, 0), ""),
        ("-clamp on -s 0.5 0.5", (0.5, 0.5), (0, 0), ""),
        ("-clamp on -clamp off -s 2 2", (2, 2), (0, 0), ""),
        ("-mm 0.1 0.8 -cc on", (1, 1), (0, 0), "ignored: map_Kd -mm, map_Kd -cc"),
    ],
)
@pytest.mark.parametrize("name", ["skin.png", "two words.png", "skin.png # wood"])
def test_options_of_a_texture(tmp_path, options, scale, offset, said, name):
    mesh, finish, line = read(tmp_path, f"newmtl skin\nKd 0 0 0\nmap_Kd {options} {name}\n")
    assert tuple(finish.texture[0, 0]) == ((0, 255, 0) if name == "two words.png" else (200, 10, 30))
    assert finish.color == (1.0, 1.0, 1.0)
    assert np.unique(mesh.uv, axis=0) == pytest.approx(np.unique(UV[:3] * scale + offset, axis=0))
    assert line == said


ABSENT = "no material 'skin' in its libraries, the default is used; ignored: texture coordinates without a texture"


@pytest.mark.parametrize(
    ("mtl", "color", "metallic", "roughness", "said"),
    [
        ("newmtl skin\nKd 0.2 0.4 0.6\nPm 0.9\nPr 0.25\n", (0.2, 0.4, 0.6), 0.9, 0.25, ""),
        ("newmtl skin\nKd 1 1 1\nmap_Pm grey.png\nmap_Pr grey.png\n", (1, 1, 1), 0.2, 0.2, ""),
        ("newmtl skin\nKa 1 1 1\nKs 1 1 1\nNs 30\nillum 2\nd 1\n", GREY, None, None, ""),
        (RED + "norm n.png\nmap_d a.png\nKe 1 1 1\nd 0.5\n", (1, 0, 0), None, None, "ignored: norm, map_d, emission, transparency"),
        ("newmtl skin\nKd spectral file.rfl\n", GREY, None, None, "ignored: Kd spectral"),
        ("newmtl skin\nKd 255 128 0\n", (1, 1, 0), None, None, "ignored: Kd beyond 1 (255 128 0)"),
        (RED + "newmtl old\nmap_Kd grey.png\n", (1, 0, 0), None, None, ""),
        # An image of an unused material is sought as that of a used one.
        (RED + "newmtl old\nmap_Kd MAPS\\Skin.PNG\n", (1, 0, 0), None, None, ""),
        (RED + "newmtl old\nmap_Kd Grey.png\n", (1, 0, 0), None, None, ""),
        (RED + "newmtl old\nmap_Kd /data/tex/skin.png\n", (1, 0, 0), None, None, ""),
        ("newmtl other\nKd 1 0 0\n", GREY, None, None, ABSENT),
    ],
)
def test_materials(tmp_path, mtl, color, metallic, roughness, said):
    _, finish, line = read(tmp_path, mtl)
    assert finish.texture is None
    assert finish.color == pytest.approx(color)
    assert (finish.metallic, finish.roughness) == (pytest.approx(metallic), pytest.approx(roughness))
    assert line == said


@pytest.mark.parametrize("obj", [OBJ.replace("mtllib a.mtl\n", ""), OBJ.replace("usemtl skin\n", "")])
def test_without_a_known_material_the_default_is_used(tmp_path, obj):
    _, finish, line = read(tmp_path, RED, obj)
    assert finish.color == GREY
    assert "ignored: texture coordinates without a texture" in line


def test_vertex_colours_beside_texture_coordinates(tmp_path):
    rows = "".join(f"{row} 1 0.5 0\n" for row in VERTICES)
    _, finish, _ = read(tmp_path, None, rows + OBJ[OBJ.index("vt") :])
    assert finish.color == pytest.approx((1.0, 0.5, 0.0), abs=0.003)


@pytest.mark.parametrize(
    ("mtl", "color", "roughness"),
    [
        ("map_Kd gone.png", GREY, None),
        ("Kd 0.2 0.4 0.6\nmap_Kd maps\\gone.png\nPr 0.25", (0.2, 0.4, 0.6), 0.25),
        ("Kd 1 1 1\nmap_Kd -s 2 2 gone.png", GREY, None),
        ("Kd 0 0 0\nmap_Kd gone.png", GREY, None),
        ("Kd 1 0 0\nmap_Pr gone.png\nPr 0.5", (1, 0, 0), 0.5),
    ],
)
def test_a_used_image_that_is_missing_is_refused_or_replaced_by_a_colour(tmp_path, mtl, color, roughness):
    """The latter in bakes without objects.strict."""
    with pytest.raises(CatalogError, match=r"refers to '.*gone\.png', but there is no file"):
        read(tmp_path, f"newmtl skin\n{mtl}\n")
    _, finish, line = read(tmp_path, f"newmtl skin\n{mtl}\n", substitute=True)
    assert finish.texture is None
    assert finish.color == pytest.approx(color)
    assert finish.roughness == pytest.approx(roughness)
    assert re.fullmatch(r"the image '.*gone\.png' is missing, a plain colour is used", line)


# ---- textures that are clamped or repeat ----


@pytest.mark.parametrize(("low", "high"), [(-0.5, 1.0), (0.0, 2.5), (-1.25, 3.0)])
def test_a_clamped_texture_has_its_border_beyond(tmp_path, low, high):
    columns = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]], np.uint8)
    obj = OBJ.replace("vt 0 0", f"vt {low} {low}").replace("vt 1 0", f"vt {high} 0.5").replace("vt 1 1", f"vt 0.375 {high}")
    Image.fromarray(np.tile(columns, (4, 1, 1))).save(tmp_path / "strip.png")
    mesh, finish, line = read(tmp_path, "newmtl skin\nmap_Kd -clamp on strip.png\n", obj)
    assert not line
    texel = texels(mesh, finish.texture)
    for corner, column in ((0, 0), (1, 3), (2, 1)):
        at = np.flatnonzero(np.abs(mesh.uv[:, 0] - np.unique(mesh.uv[:, 0])[(0, 2, 1)[corner]]) < 1e-6)
        assert (texel[at] == columns[column]).all()
    _, _, line = read(tmp_path, "newmtl skin\nmap_Kd -clamp on -s 9000 9000 skin.png\n")
    assert line == "ignored: clamping of a texture far beyond its borders"


@pytest.mark.parametrize(("low", "high"), [(0, 3), (-2, 1), (5, 6), (0, 200)])
def test_textures_that_repeat_beside_others(tmp_path, low, high):
    """Two materials on two triangles each; the colour at the corners of the first, in the middle of the image's left or right half."""
    image = np.zeros((64, 64, 3), np.uint8)
    image[:, :32], image[:, 32:] = (255, 0, 0), (0, 0, 255)
    first, second, third = f"vt {low + 0.25} {low + 0.5}", f"vt {high - 0.25} 0.5", f"vt {low + 0.75} {high}"
    obj = HEAD.replace("vt 0 0", first).replace("vt 1 0", second).replace("vt 1 1", third)
    obj += "usemtl skin\n" + "".join(FACES[:2]) + "usemtl other\n" + "".join(FACES[2:])
    Image.fromarray(image).save(tmp_path / "half.png")
    mesh, finish, said = read(tmp_path, "newmtl skin\nmap_Kd half.png\nnewmtl other\nKd 0 1 0\n", obj)
    assert ("scaled to" in said) == (high == 200)
    assert mesh.uv.min() >= 0.0
    assert mesh.uv.max() <= 1.0
    texel = texels(mesh, finish.texture)
    painted = [face for face in mesh.faces if texel[face[0]].tolist() != [0, 255, 0]]
    assert len(painted) == 2
    for index in np.concatenate(painted) if high < 200 else ():
        # At a quarter of a repetition at the origin, at three quarters at the other corners.
        assert texel[index].tolist() == ([0, 0, 255] if mesh.vertices[index].any() else [255, 0, 0])


def test_the_atlas_is_scaled_down_where_textures_are_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.assets.appearance.MAX_TEXTURE_PIXELS", 2**12)
    for name, size in (("one.png", (64, 20)), ("two.png", (8, 200))):
        picture(tmp_path / name, size=size)
    obj = HEAD + "usemtl one\n" + "".join(FACES[:2]) + "usemtl two\n" + "".join(FACES[2:])
    _, finish, said = read(tmp_path, "newmtl one\nmap_Kd one.png\nnewmtl two\nmap_Kd two.png\n", obj)
    assert said == "its textures together are too large: scaled by 1/2"
    assert finish.texture.shape == (110, 32, 3)


# ---- concave polygons ----

_TURN = np.arange(10) * np.pi / 5
_RADIUS = np.where(np.arange(10) % 2, 0.3, 1.0)
OUTLINES = {
    "L": [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)],
    "dart": [(0, 0), (2, 0), (0.5, 0.5), (0, 2)],
    "star": list(zip(_RADIUS * np.cos(_TURN), _RADIUS * np.sin(_TURN), strict=True)),
    "square with a middle": [(0, 0), (1, 0), (2, 0), (2, 2), (0, 2)],
}


def prism(outline: list[tuple[float, float]], start: int) -> tuple[np.ndarray, list[list[int]]]:
    """Vertices and polygons of a prism of height 1; its caps begin at the corner `start`."""
    count = len(outline)
    vertices = np.array([(x, y, z) for z in (0, 1) for x, y in outline], np.float64)
    around = [(start + index) % count for index in range(count)]
    caps = [[count + index for index in around], around[::-1]]
    return vertices, [*caps, *([at, (at + 1) % count, count + (at + 1) % count, count + at] for at in range(count))]


def write(path: Path, vertices: np.ndarray, polygons: list[list[int]]) -> Path:
    if path.suffix == ".obj":
        rows = [f"v {x} {y} {z}" for x, y, z in vertices] + ["f " + " ".join(str(at + 1) for at in each) for each in polygons]
        return put(path, "\n".join(rows))
    binary = path.stem == "binary"
    head = [f"ply\nformat {'binary_big_endian' if binary else 'ascii'} 1.0\nelement vertex {len(vertices)}"]
    head += [*(f"property double {axis}" for axis in "xyz"), f"element face {len(polygons)}", "property list uchar uint vertex_index"]
    lists = [np.array(each, ">u4").tobytes() for each in polygons]
    rows = [*(" ".join(map(str, row)) for row in vertices), *(f"{len(each)} " + " ".join(map(str, each)) for each in polygons)]
    body = vertices.astype(">f8").tobytes() + b"".join(bytes([len(data) // 4]) + data for data in lists)
    return put(path, "\n".join([*head, "end_header\n"]).encode() + (body if binary else "\n".join(rows).encode() + b"\n"))


def normals_of(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals of triangles, as long as twice their area."""
    corners = vertices[faces].astype(np.float64)
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


@pytest.mark.parametrize("name", ["a.obj", "text.ply", "binary.ply"])
@pytest.mark.parametrize("outline", OUTLINES)
def test_concave_polygons_cover_their_outline_alone(tmp_path, outline, name):
    """Fans cover the notches, too: their area is larger."""
    points = np.array(OUTLINES[outline])
    following = np.roll(points, -1, axis=0)
    flat = abs(float((points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum())) / 2
    sides = float(np.linalg.norm(following - points, axis=1).sum())
    for start in range(len(points)):
        mesh, *_ = read_mesh(write(tmp_path / name, *prism(OUTLINES[outline], start)), 1.0)
        area = np.linalg.norm(normals_of(mesh.vertices, mesh.faces), axis=1).sum() / 2.0
        assert area == pytest.approx(2 * flat + sides, rel=1e-6)
        assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(flat, rel=1e-6)


def test_polygons_in_any_plane_are_clipped_as_they_are_wound():
    random = np.random.default_rng(1)
    for outline in OUTLINES.values():
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        corners = np.column_stack([outline, np.zeros(len(outline))]) @ rotation.T
        triangles = np.array(clip_ears(corners))
        assert len(triangles) == len(corners) - 2
        # All on one side, that of the polygon.
        assert (normals_of(corners, triangles) @ (rotation[:, 2] * np.linalg.det(rotation)) >= -1e-12).all()


def test_too_many_corners_are_told_and_convex_polygons_are_not_concave(monkeypatch):
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.1), (0, 1, 0)], np.float64)
    dart = np.array([(0, 0, 0), (2, 0, 0), (0.5, 0.5, 0), (0, 2, 0)], np.float64)
    corners, lengths, ignored = np.arange(8), np.array([4, 4]), []
    assert find_concave(np.concatenate([square, dart]), corners, lengths, ignored).tolist() == [1]
    assert not ignored
    monkeypatch.setattr("synpick_warp.scenes.assets.mesh_parts._MAX_WORK", 15)
    assert not len(find_concave(np.concatenate([square, dart]), corners, lengths, ignored))
    assert ignored == ["concavity of polygons with many corners"]


# ---- vertex normals ----

KINDS = ("ply", "obj", "glb", "gltf", "stl")


def write_bare(folder, mesh: trimesh.Trimesh, kind: str, *, split: bool = False):
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
    mesh, *_ = read_mesh(write_bare(tmp_path, box, kind, split=split), 1.0)
    pose = (0.0, 0.0, 0.2, -0.28, 0.12, 0.35, 0.88)
    view = camera(160, 90, 500.0, (0.0, 0.0, 1.0))
    rendered = render_layers(ToyScene([entry(mesh)], [[(0, pose)]], (view,)), device, names=("normals",))
    seen = rendered["normals"][0][rendered.segment[0] == 1]
    assert len(seen) > 500
    assert len(np.unique(seen.round(4), axis=0)) == 3


@pytest.mark.parametrize("kind", KINDS)
def test_a_ball_stays_smooth(tmp_path, kind):
    ball = trimesh.creation.icosphere(3, 0.1)
    mesh, *_ = read_mesh(write_bare(tmp_path, ball, kind), 1.0)
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
    file = write_bare(tmp_path / "models", trimesh.creation.box((0.1, 0.08, 0.06)), "ply")
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
    write_models(catalog, tmp_path / "out")
    again, *_ = read_mesh(tmp_path / "out" / "obj_000001.ply", 1e-3)
    assert np.array_equal(again.normals, other.mesh.normals)
    exported = trimesh.load_mesh(tmp_path / "out" / "obj_000001.ply")
    exported.merge_vertices(merge_norm=True)
    assert exported.is_watertight
    assert exported.volume == pytest.approx(4.8e5)
