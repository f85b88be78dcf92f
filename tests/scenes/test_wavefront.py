"""OBJ and MTL import: options of textures, PBR, what is missing or ignored, encodings, textures that repeat."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import MeshOptions, read_mesh

STRICT = MeshOptions()
RED = "newmtl skin\nKd 1 0 0\n"
GREY = (0.7, 0.7, 0.7)
UV = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
HEAD = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
FACES = ("f 1/1 3/2 2/3\n", "f 1/1 2/2 4/3\n", "f 1/1 4/2 3/3\n", "f 2/1 3/2 4/3\n")
OBJ = HEAD + "usemtl skin\n" + "".join(FACES)


def read(folder: Path, mtl: str | None, obj: str = OBJ, encoding: str = "utf-8", options: MeshOptions = STRICT) -> tuple[Any, Any, str]:
    """Read an OBJ with this library and two images; the last is the line without the file's name."""
    (folder / "a.obj").write_bytes(obj.encode(encoding))
    if mtl is not None:
        (folder / "a.mtl").write_bytes(mtl.encode(encoding))
    for name, color in (("skin.png", (200, 10, 30)), ("two words.png", (0, 255, 0)), ("grey.png", (51, 51, 51))):
        Image.new("RGB", (4, 2), color).save(folder / name)
    said: list[str] = []
    mesh, finish = read_mesh(folder / "a.obj", 1.0, options, said.append)
    assert len(said) <= 1
    return mesh, finish, said[0].removeprefix(f"{folder / 'a.obj'}: ") if said else ""


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
@pytest.mark.parametrize("name", ["skin.png", "two words.png"])
def test_options_of_a_texture(tmp_path, options, scale, offset, said, name):
    mesh, finish, line = read(tmp_path, f"newmtl skin\nmap_Kd {options} {name}\n")
    assert tuple(finish.texture[0, 0]) == ((200, 10, 30) if name == "skin.png" else (0, 255, 0))
    expected = np.unique(UV[:3] * scale + offset, axis=0)
    assert np.unique(mesh.uv, axis=0) == pytest.approx(expected)
    assert line == said


@pytest.mark.parametrize(
    ("mtl", "color", "metallic", "roughness", "said"),
    [
        ("newmtl skin\nKd 0.2 0.4 0.6\nPm 0.9\nPr 0.25\n", (0.2, 0.4, 0.6), 0.9, 0.25, ""),
        ("newmtl skin\nKd 1 1 1\nmap_Pm grey.png\nmap_Pr grey.png\n", (1, 1, 1), 0.2, 0.2, ""),
        ("newmtl skin\nKa 1 1 1\nKs 1 1 1\nNs 30\nillum 2\nd 1\n", GREY, None, None, ""),
        (
            RED + "norm n.png\nmap_d a.png\nKe 1 1 1\nd 0.5\n",
            (1, 0, 0),
            None,
            None,
            "ignored: norm, map_d, emission, transparency",
        ),
        ("newmtl skin\nKd spectral file.rfl\n", GREY, None, None, "ignored: Kd spectral"),
        (RED + "newmtl old\nmap_Kd grey.png\n", (1, 0, 0), None, None, ""),
        (
            "newmtl other\nKd 1 0 0\n",
            GREY,
            None,
            None,
            "no material 'skin' in its libraries, the default is used; ignored: texture coordinates without a texture",
        ),
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
    _, finish, line = read(tmp_path, "newmtl skin\nKd 1 0 0\n", obj)
    assert finish.color == GREY
    assert "ignored: texture coordinates without a texture" in line


def test_vertex_colours_beside_texture_coordinates(tmp_path):
    rows = "".join(f"v {corner} 1 0.5 0\n" for corner in ("0 0 0", "1 0 0", "0 1 0", "0 0 1"))
    _, finish, _ = read(tmp_path, None, rows + OBJ[OBJ.index("vt") :])
    assert finish.color == pytest.approx((1.0, 0.5, 0.0), abs=0.003)


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig", "latin-1"])
def test_text_of_any_encoding(tmp_path, encoding):
    mesh, finish, said = read(tmp_path, "newmtl grün\nKd 0 1 0\n", "# Grüße\n" + OBJ.replace("skin", "grün"), encoding)
    assert len(mesh.faces) == 4
    assert finish.color == (0.0, 1.0, 0.0)
    assert not said


def test_a_used_image_that_is_missing_is_refused(tmp_path):
    with pytest.raises(CatalogError, match=r"refers to 'gone\.png', but there is no file"):
        read(tmp_path, "newmtl skin\nmap_Kd gone.png\n")


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
def test_a_used_image_that_is_missing_is_replaced_by_a_colour(tmp_path, mtl, color, roughness):
    """As in bakes without objects.strict."""
    _, finish, line = read(tmp_path, f"newmtl skin\n{mtl}\n", options=MeshOptions(substitute=True))
    assert finish.texture is None
    assert finish.color == pytest.approx(color)
    assert finish.roughness == pytest.approx(roughness)
    assert re.fullmatch(r"the image '.*gone\.png' is missing, a plain colour is used", line)


@pytest.mark.parametrize("name", ["MAPS\\Skin.PNG", "Grey.png", "/data/tex/skin.png"])
def test_an_image_of_an_unused_material_is_sought_as_that_of_a_used_one(tmp_path, name):
    _, _, line = read(tmp_path, RED + f"newmtl old\nmap_Kd {name}\n")
    assert not line


@pytest.mark.parametrize(("low", "high"), [(-0.5, 1.0), (0.0, 2.5), (-1.25, 3.0)])
def test_a_clamped_texture_has_its_border_beyond(tmp_path, low, high):
    columns = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 100, 50]], np.uint8)
    obj = OBJ.replace("vt 0 0", f"vt {low} {low}").replace("vt 1 0", f"vt {high} 0.5").replace("vt 1 1", f"vt 0.375 {high}")
    read(tmp_path, None)
    Image.fromarray(np.tile(columns, (4, 1, 1))).save(tmp_path / "strip.png")
    mesh, finish, line = read(tmp_path, "newmtl skin\nmap_Kd -clamp on strip.png\n", obj)
    height, width = finish.texture.shape[:2]
    assert not line
    rows, places = ((1.0 - mesh.uv[:, 1]) * height).astype(int), (mesh.uv[:, 0] * width).astype(int)
    texel = finish.texture[np.clip(rows, 0, height - 1), np.clip(places, 0, width - 1)]
    for corner, column in ((0, 0), (1, 3), (2, 1)):
        at = np.flatnonzero(np.abs(mesh.uv[:, 0] - np.unique(mesh.uv[:, 0])[(0, 2, 1)[corner]]) < 1e-6)
        assert (texel[at] == columns[column]).all()


def test_a_texture_that_is_clamped_far_beyond_its_border_is_told(tmp_path):
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
    read(tmp_path, None)
    Image.fromarray(image).save(tmp_path / "half.png")
    mesh, finish, said = read(tmp_path, "newmtl skin\nmap_Kd half.png\nnewmtl other\nKd 0 1 0\n", obj)
    assert ("scaled to" in said) == (high == 200)
    assert mesh.uv.min() >= 0.0
    assert mesh.uv.max() <= 1.0
    height, width = finish.texture.shape[:2]
    texel = finish.texture[((1.0 - mesh.uv[:, 1]) * height).astype(int), (mesh.uv[:, 0] * width).astype(int)]
    painted = [face for face in mesh.faces if texel[face[0]].tolist() != [0, 255, 0]]
    assert len(painted) == 2
    for index in np.concatenate(painted) if high < 200 else ():
        # At a quarter of a repetition at the origin, at three quarters at the other corners.
        assert texel[index].tolist() == ([0, 0, 255] if mesh.vertices[index].any() else [255, 0, 0])


def test_the_atlas_is_scaled_down_where_textures_are_too_many(tmp_path, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.assets.appearance.MAX_TEXTURE_PIXELS", 2**12)
    for name in ("one.png", "two.png"):
        Image.new("RGB", (64, 60), (200, 10, 30)).save(tmp_path / name)
    obj = HEAD + "usemtl one\n" + "".join(FACES[:2]) + "usemtl two\n" + "".join(FACES[2:])
    _, finish, said = read(tmp_path, "newmtl one\nmap_Kd one.png\nnewmtl two\nmap_Kd two.png\n", obj)
    assert said == "its textures together are too large: scaled by 1/2"
    assert finish.texture.shape == (60, 32, 3)
