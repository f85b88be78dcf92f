"""Mesh import: PLY, OBJ and GLB, materials, vertex colours, and invalid files."""

from __future__ import annotations

import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import bake_vertex_colors, linear_to_srgb, rgb8, srgb_to_linear
from synpick_warp.scenes.assets.meshes import MeshOptions, merge_positions, read_mesh, signed_volume
from synpick_warp.scenes.assets.normals import smooth_normals
from tests.worlds.model_files import CORNERS, FACES, OBJ, ascii_ply, binary_ply, exported, glb, picture, put, read

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


def test_an_inside_out_mesh_is_flipped(tmp_path):
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(CORNERS, [face[::-1] for face in FACES]), SMOOTH)
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)
    assert mesh.normals[1, 0] > 0.0


def test_inside_out_normals_are_flipped_with_their_triangles(tmp_path):
    inward = [(*corner, *(0.25 - np.array(corner))) for corner in CORNERS]
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(inward, [face[::-1] for face in FACES], ("x", "y", "z", "nx", "ny", "nz")))
    assert np.all(np.einsum("vi,vi->v", mesh.normals, mesh.vertices - 0.25) > 0.0)


def test_unused_vertices_and_degenerate_triangles_are_dropped(tmp_path):
    mesh, _ = read(
        tmp_path / "a.ply", ascii_ply([(9, 9, 9), *CORNERS], [*[tuple(i + 1 for i in face) for face in FACES], (1, 1, 2)]), SMOOTH
    )
    assert np.array_equal(mesh.vertices, np.asarray(CORNERS, np.float32))
    assert np.array_equal(mesh.faces, FACES)


def test_quads_become_triangles(tmp_path):
    box = trimesh.creation.box((1, 1, 1))
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    mesh, _ = read(tmp_path / "a.ply", ascii_ply(box.vertices, quads))
    assert len(mesh.faces) == 12
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1.0)


def test_vertex_colors_become_a_color_or_a_texture(tmp_path):
    columns = ("x", "y", "z", "red", "green", "blue")
    _, finish = read(tmp_path / "a.ply", ascii_ply([(*corner, 255, 0, 51) for corner in CORNERS], FACES, columns))
    assert finish.texture is None
    assert finish.color == pytest.approx((1.0, 0.0, 0.2))
    content = ascii_ply([(*corner, 60 * i, 255 - 60 * i, 7) for i, corner in enumerate(CORNERS)], FACES, columns)
    mesh, finish = read(tmp_path / "a.ply", content)
    assert finish.texture is not None
    assert finish.color == (1.0, 1.0, 1.0)
    height, width = finish.texture.shape[:2]
    column = np.rint(mesh.uv[:, 0] * width - 0.5).astype(int)
    row = np.rint((1 - mesh.uv[:, 1]) * height - 0.5).astype(int)
    tote_corner = [CORNERS.index(tuple(int(x) for x in vertex)) for vertex in mesh.vertices]
    assert np.array_equal(finish.texture[row, column], [(60 * i, 255 - 60 * i, 7) for i in tote_corner])


@pytest.mark.parametrize(
    ("kind", "largest", "names"),
    [
        ("uchar", 255, ("red", "green", "blue")),
        ("uchar", 255, ("diffuse_red", "diffuse_green", "diffuse_blue")),
        ("uchar", 255, ("r", "g", "b")),
        ("ushort", 65535, ("red", "green", "blue")),
        ("int", 255, ("red", "green", "blue")),
        ("float", 1, ("red", "green", "blue")),
        ("float", 255, ("red", "green", "blue")),
    ],
)
@pytest.mark.parametrize("at", ["vertex", "face"])
def test_colors_of_any_type_and_name(tmp_path, kind, largest, names, at):
    color = [largest, 0, largest // 5 if kind != "float" else largest / 5]
    text = ascii_ply([(*corner, *color) if at == "vertex" else corner for corner in CORNERS], FACES, ("x", "y", "z"))
    columns = "".join(f"property {kind} {name}\n" for name in names)
    before = "element face" if at == "vertex" else "end_header"
    text = text.replace(before, columns + before)
    if at == "face":
        text = "\n".join(f"{line} {color[0]} {color[1]} {color[2]}" if line.startswith("3 ") else line for line in text.split("\n"))
    _, finish = read(tmp_path / "a.ply", text)
    assert finish.color == pytest.approx((1.0, 0.0, 0.2))


def test_each_face_has_its_color_also_polygons(tmp_path):
    """A box of quads and triangles mixed, text and binary."""
    box = trimesh.creation.box((2, 2, 2)).vertices
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    header = f"ply\nformat FORMAT 1.0\nelement vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face {len(sides)}\n"
    header += "property list uchar int vertex_indices\nproperty uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
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
    data, said = exported(trimesh.creation.box((1, 1, 1)), "stl"), []
    path = put(tmp_path / "a.stl", header + struct.pack("<I", announced) + data[84:] + bytes(more))
    if not count:
        with pytest.raises(CatalogError, match=f"announces {announced} triangles"):
            read_mesh(path, 1.0)
        return
    assert len(read_mesh(path, 1.0, report=said.append)[0].faces) == count
    assert len(said) == ((announced, more) != (12, 0))
    assert all(f"its header announces {announced} triangles, its body holds " in line for line in said)


def test_what_is_ignored_of_a_ply_is_one_line(tmp_path):
    (tmp_path / "a.ply").write_text(ascii_ply([(*corner, 1, 2) for corner in CORNERS], FACES, ("x", "y", "z", "quality", "radius")))
    said: list[str] = []
    read_mesh(tmp_path / "a.ply", 1.0, report=said.append)
    assert said == [f"{tmp_path / 'a.ply'}: ignored: quality, radius"]


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
    ],
)
def test_images_of_any_mode_become_rgb(mode, value, expected):
    array = rgb8(Image.new(mode, (3, 2), value))
    assert array.shape == (2, 3, 3)
    assert array.dtype == np.uint8
    assert np.all(array == expected)


def test_a_palette_is_resolved():
    assert np.all(rgb8(Image.new("RGB", (2, 2), (250, 0, 0)).quantize(2)) == (250, 0, 0))


def textured_box(color, **material) -> trimesh.Trimesh:
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    uv = np.random.default_rng(0).random((8, 2))
    box.visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=Image.new("RGB", (8, 8), color), **material))
    return box


def test_a_glb_has_its_material(tmp_path):
    box = textured_box((200, 10, 10), metallicFactor=0.7, roughnessFactor=0.2)
    mesh, finish = read(tmp_path / "a.glb", glb(box), SMOOTH)
    assert np.allclose(mesh.uv, box.visual.uv, atol=1e-6)
    assert finish.texture is not None
    assert np.all(finish.texture == (200, 10, 10))
    assert (finish.metallic, finish.roughness) == pytest.approx((0.7, 0.2))


def test_parts_of_a_glb_are_merged_with_their_transforms(tmp_path):
    red, plain = textured_box((200, 10, 10), metallicFactor=1.0), trimesh.creation.box((0.1, 0.1, 0.1))
    plain.visual = TextureVisuals(material=PBRMaterial(baseColorFactor=(0, 255, 0, 255), metallicFactor=0.0))
    plain.apply_translation((0.3, 0, 0))
    mesh, finish = read(tmp_path / "a.glb", glb(red, plain))
    assert len(mesh.faces) == 24
    assert np.allclose((mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)), ((-0.05, -0.05, -0.05), (0.35, 0.05, 0.05)))
    assert finish.texture is not None
    height, width = finish.texture.shape[:2]
    texel = finish.texture[((1 - mesh.uv[:, 1]) * height).astype(int), (mesh.uv[:, 0] * width).astype(int)]
    assert np.all(texel[mesh.vertices[:, 0] < 0.1] == (200, 10, 10))
    assert np.all(texel[mesh.vertices[:, 0] > 0.1] == (0, 255, 0))
    assert finish.metallic == pytest.approx(0.5)


def test_parts_with_one_material_share_its_texture(tmp_path):
    one = textured_box((1, 2, 3))
    two = one.copy()
    two.apply_translation((0.3, 0, 0))
    mesh, finish = read(tmp_path / "a.glb", glb(one, two))
    assert len(mesh.faces) == 24
    assert finish.texture is not None
    assert np.all(finish.texture == (1, 2, 3))


def test_a_reflected_part_keeps_outward_orientation(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((0.1, 0.2, 0.3)), transform=np.diag((-2.0, 1.0, 1.0, 1.0)))
    mesh, _ = read(tmp_path / "a.glb", scene.export(file_type="glb"))
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(0.012)


def test_an_obj_with_an_image(tmp_path):
    put(tmp_path / "a.mtl", "newmtl skin\nKd 0 0 0\nmap_Kd skin.png\n")
    picture(tmp_path / "skin.png")
    mesh, finish = read(tmp_path / "a.obj", OBJ)
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)
    assert set(map(tuple, mesh.uv)) == {(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)}
    assert finish.texture is not None
    assert np.all(finish.texture == (200, 10, 30))
    assert finish.color == (1.0, 1.0, 1.0)


GOOD = ascii_ply(CORNERS, FACES)


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
        ("a.ply", "\n".join(GOOD.split("\n")[:-3]), "announces 4 rows of face, its body is shorter"),
        ("a.ply", ascii_ply(CORNERS, FACES, comment="comment TextureFile gone.png"), "gone.png"),
        ("a.ply", binary_ply(CORNERS, FACES, ("x", "y", "z"))[:-9], "not readable"),
        ("a.ply", ascii_ply([c[:2] for c in CORNERS], FACES, ("x", "y")), "a.ply"),
        ("a.ply", "hello", "not readable"),
        ("a.ply", "", "not readable"),
        ("a.ply", b"\x00\xff" * 50, "not readable"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", "a.obj"),
        ("a.obj", "", "a.obj"),
        ("a.stl", "", "no triangles"),
        ("a.stl", b"\x00" * 80 + struct.pack("<I", 2) + bytes(50), "cut short"),
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
    ],
)
def test_invalid_files_are_one_line(tmp_path, name, content, message):
    with pytest.raises(CatalogError, match=message) as caught:
        read(tmp_path / name, content)
    assert str(tmp_path / name) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_texture_needs_coordinates_and_a_readable_image(tmp_path):
    for skin, said in ((picture(tmp_path / "good.png").read_bytes(), "texture_u"), (b"no picture", "not readable as an image")):
        put(tmp_path / "t.png", skin)
        with pytest.raises(CatalogError, match=said):
            read(tmp_path / "a.ply", ascii_ply(CORNERS, comment="comment TextureFile t.png"))


def test_normals_where_triangles_cancel_out():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0)], np.float32)
    normals = smooth_normals(vertices, np.array([(0, 1, 2), (0, 2, 1)]))
    assert np.array_equal(normals, [(0, 0, 1)] * 3)


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


def test_the_real_objects_agree_with_their_table(real_models):
    extents = json.loads((real_models / "models_info.json").read_text())
    for obj_id, entry in extents.items():
        mesh, finish = read_mesh(real_models / f"obj_{int(obj_id):06d}.ply", 1e-3)
        assert finish.texture is not None
        assert len(mesh.faces) == 16384
        assert np.allclose(mesh.vertices.min(axis=0) * 1e3, [entry[f"min_{a}"] for a in "xyz"], atol=1e-2)
        assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-5)
        assert mesh.uv.min() >= -1e-3
        assert mesh.uv.max() <= 1.001
