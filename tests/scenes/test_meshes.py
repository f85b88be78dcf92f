"""Mesh import: PLY, STL, GLB and STEP, materials, colours, textures of any depth, and invalid files."""

import json
import re
import struct
import sys
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import bake_vertex_colors, decode_texture, linear_to_srgb, rgb8, srgb_to_linear
from synpick_warp.scenes.assets.meshes import MeshOptions, merge_positions, read_mesh, signed_volume
from synpick_warp.scenes.assets.normals import smooth_normals
from synpick_warp.scenes.types import MAP_CENTER
from tests.builders import refusal
from tests.worlds import model_files
from tests.worlds.model_files import CORNERS, FACES, OBJ, ascii_ply, binary_ply, glb, picture, put, read, read_told, texels

SMOOTH = MeshOptions(crease_angle=180.0)


@pytest.mark.parametrize("binary", [False, True])
def test_a_ply_keeps_order_texture_coordinates_and_scale(tmp_path, binary):
    picture(tmp_path / "skin.png")
    # The first two rows are one place with two texture coordinates: a seam.
    columns = ("x", "y", "z", "texture_u", "texture_v")
    vertices = [(0, 0, 0, 0.1, 0.2), (0, 0, 0, 0.9, 0.8), (1000, 0, 0, 0.3, 0.4), (0, 1000, 0, 0.5, 0.6), (0, 0, 1000, 0.7, 1.0)]
    faces = [(0, 3, 2), (1, 2, 4), (0, 4, 3), (2, 3, 4)]
    data = (binary_ply if binary else ascii_ply)(vertices, faces, columns, comment="comment TextureFile skin.png")
    mesh, finish = read(tmp_path / "obj_000001.ply", data, SMOOTH, 1e-3)
    rows = np.asarray(vertices, np.float32)
    assert np.allclose(mesh.vertices, rows[:, :3] / 1000, atol=1e-7)
    assert np.array_equal(mesh.uv, rows[:, 3:])
    assert np.array_equal(mesh.faces, faces)
    assert mesh.vertices.dtype == mesh.normals.dtype == mesh.uv.dtype == np.float32
    assert mesh.faces.dtype == np.int32
    # The seam does not show: both rows have the normal of the corner of a cube.
    assert np.allclose(mesh.normals[:2], -np.sqrt(1 / 3), atol=1e-6)
    assert finish.texture is not None
    assert finish.texture.shape == (2, 4, 3)
    assert tuple(finish.texture[0, 0]) == (200, 10, 30)
    assert finish.color == (1.0, 1.0, 1.0)
    assert finish.metallic is None


def test_normals_of_the_file_are_used_and_made_unit(tmp_path):
    rows = [(*corner, *np.multiply(2.0, normal)) for corner, normal in zip(CORNERS, np.eye(3)[[0, 1, 2, 0]], strict=True)]
    rows[3] = (*CORNERS[3], 0.0, 0.0, 0.0)
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(rows, FACES, ("x", "y", "z", "nx", "ny", "nz")))
    assert np.allclose(mesh.normals[:3], np.eye(3))
    computed = smooth_normals(mesh.vertices, mesh.faces)
    assert np.allclose(mesh.normals[3], computed[3])


def test_texture_coordinates_at_the_faces_split_vertices(tmp_path):
    picture(tmp_path / "t.png")
    tails = [f"6 0 0 {i / 4} 0 0 1" for i in range(4)]
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(CORNERS, FACES, comment="comment TextureFile t.png", face_tail=tails))
    assert len(mesh.vertices) == 12
    assert np.allclose(mesh.uv[4], (0.25, 0.0))
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)


def test_a_mesh_is_turned_outward_and_what_is_not_needed_is_dropped(tmp_path):
    """Inside out, with and without normals; unused vertices, unknown columns, triangles without an area."""
    inside_out = [face[::-1] for face in FACES]
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(CORNERS, inside_out), SMOOTH)
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)
    assert mesh.normals[1, 0] > 0.0
    inward = [(*corner, *(0.25 - np.array(corner))) for corner in CORNERS]
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(inward, inside_out, ("x", "y", "z", "nx", "ny", "nz")))
    assert np.all(np.einsum("vi,vi->v", mesh.normals, mesh.vertices - 0.25) > 0.0)
    rows = [(*corner, 1, 2) for corner in [(9, 9, 9), *CORNERS]]
    faces = [*[tuple(i + 1 for i in face) for face in FACES], (1, 1, 2)]
    mesh, _, said = read_told(tmp_path / "a.ply", ascii_ply(rows, faces, ("x", "y", "z", "quality", "radius")), SMOOTH)
    assert np.array_equal(mesh.vertices, np.asarray(CORNERS, np.float32))
    assert np.array_equal(mesh.faces, FACES)
    assert said == ["ignored: quality, radius"]


RGB = ("red", "green", "blue")


@pytest.mark.parametrize(
    ("kind", "largest", "names"),
    [
        ("uchar", 255, RGB),
        ("uchar", 255, ("diffuse_red", "diffuse_green", "diffuse_blue")),
        ("uchar", 255, ("r", "g", "b")),
        ("ushort", 65535, RGB),
        ("int", 255, RGB),
        ("float", 1, RGB),
        ("float", 255, RGB),
    ],
)
@pytest.mark.parametrize("at", ["vertex", "face"])
def test_colors_of_any_type_and_name(tmp_path, kind, largest, names, at):
    color = [largest, 0, largest // 5 if kind != "float" else largest / 5]
    text = ascii_ply([(*corner, *color) if at == "vertex" else corner for corner in CORNERS])
    columns = "".join(f"property {kind} {name}\n" for name in names)
    before = "element face" if at == "vertex" else "end_header"
    text = text.replace(before, columns + before)
    if at == "face":
        text = "\n".join(f"{line} {color[0]} {color[1]} {color[2]}" if line.startswith("3 ") else line for line in text.split("\n"))
    _, finish = read(tmp_path / "a.ply", text)
    assert finish.texture is None
    assert finish.color == pytest.approx((1.0, 0.0, 0.2))


def test_each_vertex_and_each_face_has_its_color_also_polygons(tmp_path):
    """A box of quads and triangles mixed, text and binary."""
    content = ascii_ply([(*corner, 60 * i, 255 - 60 * i, 7) for i, corner in enumerate(CORNERS)], FACES, ("x", "y", "z", *RGB))
    mesh, finish = read(tmp_path / "a.ply", content)
    assert finish.color == (1.0, 1.0, 1.0)
    vertex = [CORNERS.index(tuple(int(x) for x in vertex)) for vertex in mesh.vertices]
    assert np.array_equal(texels(mesh, finish.texture), [(60 * i, 255 - 60 * i, 7) for i in vertex])
    box = trimesh.creation.box((2, 2, 2)).vertices
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    header = f"ply\nformat FORMAT 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face {len(sides)}\n"
    header += "property list uchar int vertex_indices\n" + "".join(f"property uchar {name}\n" for name in RGB) + "end_header\n"
    rows = [(len(side), *side, 30 * number, 255, 0) for number, side in enumerate(sides)]
    text = header.replace("FORMAT", "ascii") + "\n".join(" ".join(map(str, row)) for row in [*box.tolist(), *rows])
    contents = [text.encode()]
    for order, name in (("<", "binary_little_endian"), (">", "binary_big_endian")):
        body = box.astype(f"{order}f4").tobytes() + b"".join(struct.pack(f"{order}B{row[0]}i3B", *row) for row in rows)
        contents.append(header.replace("FORMAT", name).encode() + body)
    for content in contents:
        mesh, finish = read(tmp_path / "a.ply", content)
        assert len(mesh.faces) == 12
        assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(8.0)
        height, width = finish.texture.shape[:2]
        middle = mesh.uv[mesh.faces].mean(axis=1)
        texel = finish.texture[((1 - middle[:, 1]) * height).astype(int), (middle[:, 0] * width).astype(int)]
        centre = mesh.vertices[mesh.faces].mean(axis=1)
        found = {(int(np.abs(at).argmax()), bool(at.max() > 0.99), int(red)) for at, red in zip(centre, texel[:, 0], strict=True)}
        assert {red for _, _, red in found} == {30 * number for number in range(len(sides))}
        # Both halves of a quad have one colour: each of its sides has one, those of two triangles have two.
        assert len(found) == len(sides)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be"])
@pytest.mark.parametrize("kind", ["ply", "stl"])
def test_text_of_any_encoding(tmp_path, encoding, kind):
    text = trimesh.creation.box((1, 1, 1)).export(file_type=f"{kind}_ascii") if kind == "stl" else GOOD
    assert len(read(tmp_path / f"a.{kind}", str(text).encode(encoding))[0].faces) == (12 if kind == "stl" else 4)


def test_strips_of_triangles(tmp_path):
    text = ascii_ply(CORNERS, []).replace("face 0\nproperty list uchar", "tristrips 1\nproperty list int")
    mesh, _ = read(tmp_path / "a.ply", text + "8 0 2 1 3 -1 0 3 2\n", SMOOTH)
    assert np.array_equal(np.sort(mesh.faces), np.sort([(0, 2, 1), (1, 2, 3), (0, 3, 2)]))


@pytest.mark.parametrize("kind", ["stl", "stl_ascii", "solid"])
def test_an_stl_is_read_with_its_equal_corners_merged(tmp_path, kind):
    ball = trimesh.creation.icosphere(2, 0.1)
    data = ball.export(file_type="stl" if kind == "solid" else kind)
    if kind == "solid":  # A binary file that begins like text, and has bytes behind its end.
        data = b"solid".ljust(80, b"\0") + data[80:] + b"more"
    mesh, finish = read(tmp_path / "a.stl", data if isinstance(data, bytes) else data + data)
    assert len(mesh.vertices) == len(ball.vertices)
    assert finish.color == (0.7, 0.7, 0.7)


@pytest.mark.parametrize("header", [bytes(80), b"solid vertex".ljust(80, b"\0"), b" " * 80])
@pytest.mark.parametrize(
    ("announced", "more", "count"),
    [(12, 0, 12), (0, 0, 12), (0, 3, 12), (5, 0, 12), (12, 3, 12), (11, 60, 11), (13, 0, 0), (2**32 - 1, 0, 0)],
)
def test_a_binary_stl_has_as_many_triangles_as_its_body(tmp_path, header, announced, more, count):
    """Unless bytes that are no triangles follow those announced."""
    content = header + struct.pack("<I", announced) + model_files.box(1, 1, 1, kind="stl")[84:] + bytes(more)
    if not count:
        with pytest.raises(CatalogError, match=f"announces {announced} triangles"):
            read(tmp_path / "a.stl", content)
        return
    mesh, _, said = read_told(tmp_path / "a.stl", content)
    assert len(mesh.faces) == count
    assert len(said) == ((announced, more) != (12, 0))
    assert all(f"its header announces {announced} triangles, its body holds " in line for line in said)


@given(st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=3, max_size=3), st.tuples(*[st.floats(0.0, 1.0)] * 3))
def test_baked_vertex_colors_interpolate_linearly(colors, weights):
    total = sum(weights)
    share = np.array(weights) / total if total > 1e-3 else np.full(3, 1 / 3)
    uv, texture = bake_vertex_colors(np.array([[0, 1, 2]]), np.array(colors) / 255.0)
    light = srgb_to_linear(texture / 255.0)
    u, v = share @ uv
    x, y = u * 2 - 0.5, (1 - v) * 2 - 0.5
    found = (1 - y) * ((1 - x) * light[0, 0] + x * light[0, 1]) + y * ((1 - x) * light[1, 0] + x * light[1, 1])
    expected = share @ srgb_to_linear(np.array(colors) / 255.0)
    # The fourth texel is cut to 0..1: exact where it need not be, never off by more than that cut.
    fourth = light[0, 1] + light[1, 0] - light[0, 0]
    cut = np.maximum(np.maximum(fourth - 1.0, -fourth), 0.0) + 0.01
    assert np.all(np.abs(found - expected) <= cut)


@given(st.floats(0.0, 1.0))
def test_srgb_and_back(value):
    assert float(linear_to_srgb(srgb_to_linear(value))) == pytest.approx(value, abs=1e-6)


@pytest.mark.parametrize(
    ("mode", "value", "expected"),
    [
        ("L", 128, (128, 128, 128)),
        ("RGBA", (10, 20, 30, 0), (10, 20, 30)),
        ("LA", (77, 0), (77, 77, 77)),
        ("I;16", 257 * 100, (100, 100, 100)),
        ("I", 65535, (255, 255, 255)),
        ("F", 0.5, (128, 128, 128)),
        ("CMYK", (0, 255, 255, 0), (255, 0, 0)),
        ("1", 1, (255, 255, 255)),
        ("P", (250, 0, 0), (250, 0, 0)),
    ],
)
def test_images_of_any_mode_become_rgb(mode, value, expected):
    array = rgb8(Image.new("RGB", (3, 2), value).quantize(2) if mode == "P" else Image.new(mode, (3, 2), value))
    assert (array.shape, array.dtype) == ((2, 3, 3), np.uint8)
    assert np.all(array == expected)


def textured_box(color, **material) -> trimesh.Trimesh:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    uv = np.random.default_rng(0).random((8, 2))
    box.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=Image.new("RGB", (8, 8), color), **material))
    return box


def test_parts_of_a_glb_are_merged_with_their_transforms_and_materials(tmp_path):
    red, plain = textured_box((200, 10, 10), metallicFactor=0.7, roughnessFactor=0.2), trimesh.creation.box((0.1, 0.1, 0.1))
    mesh, finish = read(tmp_path / "a.glb", glb(red), SMOOTH)
    assert np.allclose(mesh.uv, red.visual.uv, atol=1e-6)
    assert np.all(finish.texture == (200, 10, 10))
    assert (finish.metallic, finish.roughness) == pytest.approx((0.7, 0.2))
    plain.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=(0, 255, 0, 255), metallicFactor=0.1))
    mesh, finish = read(tmp_path / "a.glb", glb(red, plain.apply_translation((0.3, 0, 0))))
    assert len(mesh.faces) == 24
    assert np.allclose((mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)), ((-0.05, -0.05, -0.05), (0.35, 0.05, 0.05)))
    # Each part keeps its metallic and roughness, and both have flat normals.
    texel = texels(mesh, finish.texture)
    assert np.all(texel[mesh.vertices[:, 0] < 0.1] == (200, 10, 10, MAP_CENTER, MAP_CENTER, 51, 178))
    assert np.all(texel[mesh.vertices[:, 0] > 0.1] == (0, 255, 0, MAP_CENTER, MAP_CENTER, 255, 26))
    bumpy = textured_box((200, 10, 10), normalTexture=Image.new("RGB", (8, 8), (200, 128, 220)))
    _, finish, said = read_told(tmp_path / "a.glb", glb(bumpy, trimesh.creation.box((0.1, 0.1, 0.1))))
    assert said == ["ignored: maps beside a part without metallic or roughness"]
    assert finish.texture.shape[2] == 3
    # Where it has a material, all have maps, which go on beside a narrow image.
    plain.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=(0, 255, 0, 255), metallicFactor=0.0, roughnessFactor=1.0))
    _, finish = read(tmp_path / "a.glb", glb(bumpy, plain))
    assert finish.texture.shape == (12, 8, 7)
    assert np.all(finish.texture[8:, :, 3:] == (MAP_CENTER, MAP_CENTER, 255, 0))
    # Parts with one material share its texture.
    mesh, finish = read(tmp_path / "a.glb", glb(red, red.copy().apply_translation((0.3, 0, 0))))
    assert len(mesh.faces) == 24
    assert np.all(finish.texture == (200, 10, 10))


def test_a_reflected_part_keeps_outward_orientation(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.1, 0.2, 0.3)), transform=np.diag((-2.0, 1.0, 1.0, 1.0)))
    mesh, _ = read(tmp_path / "a.glb", scene.export(file_type="glb"))
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(0.012)


GOOD = ascii_ply(CORNERS, FACES)
UNWRAPPED = ("x", "y", "z", "texture_u", "texture_v")
BARE_OBJ = "mtllib a.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
BARE_FACES = "f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
REFUSED = r"not readable as STEP \(OpenCASCADE refuses it\)"
STEP_FAULTS = (
    ("a.step", "no STEP file", REFUSED),
    ("a.step", model_files.step_cylinder(20, 60)[:700], REFUSED),
    ("a.step", model_files.step_cylinder(20, 60).replace("MANIFOLD_SOLID_BREP", "GEOMETRIC_SET"), "no triangles"),
)


def textured_ply(image: str, rows=CORNERS, columns=("x", "y", "z")) -> str:
    return ascii_ply(rows, FACES, columns, f"comment TextureFile {image}")


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.ply", ascii_ply(CORNERS, []), "no triangles"),
        ("a.ply", binary_ply(CORNERS, [], ("x", "y", "z")), "no triangles"),
        ("a.ply", GOOD.split("element face")[0] + "end_header\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n", "no triangles"),
        ("a.ply", ascii_ply(CORNERS, [(1, 1, 2)]), "no triangles"),
        ("a.ply", ascii_ply([(float("nan"), 0, 0), *CORNERS[1:]], FACES), "1 vertices are not finite"),
        ("a.ply", binary_ply([(float("inf"), 0, 0), *CORNERS[1:]], FACES, ("x", "y", "z")), "not finite"),
        ("a.ply", binary_ply([(1e38, 0, 0), *CORNERS[1:]], FACES, ("x", "y", "z")), "unit"),
        ("a.ply", ascii_ply(CORNERS, [*FACES[:3], (1, 2, 9)]), "refers to vertex 9"),
        ("a.ply", ascii_ply(CORNERS, [*FACES[:3], (-1, 0, 1)]), "refers to vertex -1, but there are 4"),
        ("a.ply", "\n".join(GOOD.split("\n")[:-3]), "not readable as PLY"),
        ("a.ply", ascii_ply(CORNERS, FACES, comment="comment TextureFile gone.png"), "gone.png"),
        ("a.ply", binary_ply(CORNERS, FACES, ("x", "y", "z"))[:-9], "not readable"),
        ("a.ply", ascii_ply([c[:2] for c in CORNERS], FACES, ("x", "y")), "a.ply"),
        ("a.ply", "hello", "not readable"),
        ("a.ply", "", "not readable"),
        ("a.ply", b"\x00\xff" * 50, "not readable"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "a.obj"),
        ("a.obj", "", "a.obj"),
        ("a.stl", "", "no triangles"),
        ("a.stl", b"\x00" * 80 + struct.pack("<I", 2) + bytes(50), "announces 2 triangles, its body holds 1"),
        ("a.stl", b"\x00" * 80 + struct.pack("<I", 2**32 - 1), "announces 4294967295 triangles"),
        ("a.stl", "solid x\nvertex 0 0 0\nvertex 1 0 0\n", "not readable as STL"),
        ("a.stl", "solid x\nvertex 0,0 0 0\nvertex 1 0 0\nvertex 0 -1,5 0\n", "decimal commas, such as 0,0; export it with decimal points"),
        ("a.obj", "o 1,5\nv 0 0 0\nv 1 0 0\nv 0 1e-2 0,5\nf 1 2 3\n", "decimal commas, such as 0,5; "),
        ("a.ply", ascii_ply([(0, 0, 0), ("-1,5e-3", 0, 0), (0, 1, 0), (0, 0, 1)]), "decimal commas, such as -1,5e-3; "),
        ("a.stl", "solid x\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 nan 0\n", "not finite"),
        ("a.gltf", "{}", "no triangles"),
        ("a.gltf", "hello", "a.gltf is damaged"),
        ("a.glb", b"glTF", "not readable"),
        ("a.glb", "", "not readable"),
        ("a.ply", textured_ply("good.png"), "texture_u"),
        ("a.ply", textured_ply("bad.png"), r"bad\.png: not readable as an image"),
        ("a.obj", BARE_OBJ + "usemtl skin\n" + BARE_FACES, "without texture coordinates; unwrap it"),
        *((name, content, said) for name, content, said in STEP_FAULTS),
    ],
)
def test_invalid_files_are_one_line(tmp_path, name, content, message):
    if name.endswith(".step"):
        pytest.importorskip("cascadio")
    picture(tmp_path / "good.png")
    put(tmp_path / "bad.png", b"no picture")
    put(tmp_path / "a.mtl", "newmtl skin\nmap_Kd good.png\n")
    said = refusal(read, tmp_path / name, content)
    assert re.search(message, said)
    assert said.count(str(tmp_path / ("bad.png" if "bad" in message else name))) == 1


@given(st.integers(0, 2**32 - 1))
def test_normals_do_not_depend_on_seams(seed):
    rng = np.random.default_rng(seed)
    ball = trimesh.creation.icosphere(1)
    vertices = (ball.vertices * rng.uniform(0.5, 1.5, 3)).astype(np.float32)
    whole = smooth_normals(vertices, ball.faces)
    split = ball.faces.reshape(-1)
    apart = smooth_normals(vertices[split], np.arange(len(split)).reshape(-1, 3))
    assert np.allclose(apart, whole[split], atol=1e-6)
    places, faces = merge_positions(vertices[split], np.arange(len(split)).reshape(-1, 3))
    assert (len(places), len(faces)) == (len(ball.vertices), len(ball.faces))
    # Where triangles cancel out.
    assert np.array_equal(smooth_normals(vertices[:3] * (1, 1, 0), np.array([(0, 1, 2), (0, 2, 1)])), [(0, 0, 1)] * 3)


def test_the_real_objects_agree_with_their_table(real_models):
    extents = json.loads((real_models / "models_info.json").read_text())
    for obj_id, entry in extents.items():
        mesh, finish, _ = read_mesh(real_models / f"obj_{int(obj_id):06d}.ply", 1e-3)
        assert finish.texture is not None
        assert len(mesh.faces) == 16384
        assert np.allclose(mesh.vertices.min(axis=0) * 1e3, [entry[f"min_{a}"] for a in "xyz"], atol=1e-2)
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        assert mesh.uv.min() >= -1e-3
        assert mesh.uv.max() <= 1.001


# ---- textures ----


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (37, 50)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_of_any_bit_depth_channels_and_size(channels, size, dtype):
    """Each pixel to the byte above its value or the one below; with alpha 0, the colour is still there."""
    largest = np.iinfo(dtype).max
    pixels = np.random.default_rng(0).integers(0, largest + 1, (*size, channels)).astype(dtype)
    if channels == 4:
        pixels[..., 3] = 0
    texture = decode_texture(cv2.imencode(".png", pixels)[1].tobytes(), "t.png")
    assert texture.shape == (*size, 3)
    assert texture.dtype == np.uint8
    expected = pixels[..., 2::-1] if channels > 1 else np.repeat(pixels, 3, axis=2)
    assert np.abs(texture - expected / largest * 255.0).max() <= (0 if dtype == np.uint8 else 1)


def test_a_mesh_without_texture_needs_no_coordinates(tmp_path):
    put(tmp_path / "a.mtl", "newmtl skin\nKd 0.2 0.4 0.6\n")
    for name, content, color in (("a.obj", BARE_OBJ + "usemtl skin\n" + BARE_FACES, (0.2, 0.4, 0.6)), ("a.ply", GOOD, (0.7, 0.7, 0.7))):
        mesh, finish = read(tmp_path / name, content)
        assert finish.texture is None
        assert finish.color == pytest.approx(color, abs=0.003)
        assert mesh.uv.shape == (len(mesh.vertices), 2)
        assert not mesh.uv.any()


@pytest.mark.parametrize("value", ["nan", "inf", "-1e30", "10001"])
def test_invalid_texture_coordinates(tmp_path, value):
    picture(tmp_path / "t.png")
    rows = [(*corner, 0.5, 0.5) for corner in CORNERS]
    with pytest.raises(CatalogError, match="not finite or beyond 10000; repair the mesh"):
        read(tmp_path / "a.ply", textured_ply("t.png", [*rows[:3], (*CORNERS[3], value, 0.5)], UNWRAPPED))
    # A vertex that no triangle uses may have any.
    mesh, _ = read(tmp_path / "a.ply", textured_ply("t.png", [*rows, (9, 9, 9, value, 0.5)], UNWRAPPED), SMOOTH)
    assert len(mesh.vertices) == 4


# ---- OpenEXR ----


def exr(path: Path, **channels: np.ndarray) -> bytes:
    names = {name.replace("_", "."): np.ascontiguousarray(plane) for name, plane in channels.items()}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, names) as file:
        file.write(str(path))
    return path.read_bytes()


def plane(value: float, kind: type = np.float32) -> np.ndarray:
    return np.full((2, 3), value, kind)


@pytest.mark.parametrize(
    ("channels", "linear", "expected"),
    [
        ({"R": plane(0.2), "G": plane(1.0), "B": plane(0.0)}, False, (124, 255, 0)),
        ({"R": plane(0.2), "G": plane(7.5), "B": plane(-1.0)}, True, (51, 255, 0)),
        ({"Y": plane(0.25, np.float16)}, True, (64, 64, 64)),
        ({"rough": plane(0.25)}, True, (64, 64, 64)),
        ({"v_Combined_R": plane(0.2), "v_Combined_G": plane(1.0), "v_Combined_B": plane(0.0)}, False, (124, 255, 0)),
        ({"R": plane(np.nan), "G": plane(np.inf), "B": plane(0.0)}, False, (0, 255, 0)),
    ],
)
def test_channels_of_any_name_and_kind(tmp_path, channels, linear, expected):
    image = decode_texture(exr(tmp_path / "a.exr", **channels), "a.exr", linear)
    assert image.shape == (2, 3, 3)
    assert (image == expected).all()


def test_maps_of_a_material_library(tmp_path):
    """Base colour maps are converted to sRGB, roughness and metallic maps stay linear, and normal maps are reported as ignored."""
    put(tmp_path / "a.mtl", "newmtl skin\nmap_Kd albedo.exr\nmap_Pr maps/rough.exr\nmap_Pm maps/rough.exr\nnorm maps/normal.exr\n")
    exr(tmp_path / "albedo.exr", R=plane(0.2), G=plane(0.5), B=plane(1.0))
    put(tmp_path / "maps" / "rough.exr", exr(tmp_path / "rough.exr", Y=plane(0.3, np.float16)))
    _, material, said = read_told(tmp_path / "a.obj", OBJ)
    assert (material.texture[0, 0] == (124, 188, 255)).all()
    assert (material.metallic, material.roughness) == (pytest.approx(0.3, abs=0.003), pytest.approx(0.3, abs=0.003))
    assert said == ["ignored: norm"]


def test_damaged_exr_files_are_one_line(tmp_path):
    magic, unknown = b"\x76\x2f\x31\x01", exr(tmp_path / "a.exr", U=plane(0.1), V=plane(0.1))
    for content, said in (
        (magic, "not readable as OpenEXR"),
        (magic + bytes(200), "not readable as OpenEXR"),
        (unknown, "without channels R, G, B or Y"),
    ):
        with pytest.raises(CatalogError, match=rf"^a\.exr: .*{said}"):
            decode_texture(content, "a.exr")


# ---- STEP files: cylinders, whose size is known ----


@pytest.mark.parametrize(
    ("name", "size", "prefix"), [("a.step", (20.0, 60.0), ".MILLI."), ("a.STP", (2.0, 6.0), ".CENTI."), ("a.stp", (0.02, 0.06), "$")]
)
def test_lengths_are_in_the_unit_that_a_step_file_names(tmp_path, name, size, prefix):
    pytest.importorskip("cascadio")
    put(tmp_path / "parts" / name, model_files.step_cylinder(size[0], size[1], prefix))
    catalog, lines = model_files.load_models(tmp_path / "parts", tmp_path, unit="in", center=True)
    (entry,), (line,) = catalog.entries, lines
    assert all(words in line for words in (" x 60 mm, unit of the file; centred: moved by ", ", -0.03 m"))
    assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx((0.04, 0.04, 0.06), rel=2e-3)
    # Within the distance of chords from the circle.
    assert signed_volume(entry.mesh.vertices, entry.mesh.faces) == pytest.approx(np.pi * 0.02**2 * 0.06, rel=0.01)


def test_step_files_beside_their_meshes_and_without_cascadio(tmp_path, monkeypatch):
    put(tmp_path / "parts" / "a.step", "no STEP file")
    put(tmp_path / "parts" / "a.stl", model_files.box(0.1, 0.1, 0.1, kind="stl"))
    catalog, lines = model_files.load_models(tmp_path / "parts", tmp_path)
    assert [entry.name for entry in catalog.entries] == ["a"]
    assert lines == [f"{tmp_path / 'parts'}: 1 STEP files beside meshes of the same name are ignored"]
    monkeypatch.setitem(sys.modules, "cascadio", None)
    said = r"a\.step: STEP files need cascadio, which is not installed: pip install 'synpick-warp\[step\]', or save"
    with pytest.raises(CatalogError, match=said):
        read(tmp_path / "a.step", model_files.step_cylinder(20, 60))
