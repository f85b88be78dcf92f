"""Spellings of OBJ and MTL files that mean the same: line ends, indentation, comments, relative indices, names; and concave polygons."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.meshes import read_mesh, signed_volume
from synpick_warp.scenes.assets.polygons import clip_ears, find_concave

VERTICES = ("v 0 0 0", "v 1 0 0", "v 0 1 0", "v 0 0 1")
FACES = ("f 1 3 2", "f 1 2 4", "f 1 4 3", "f 2 3 4")
OBJ = "\n".join(["mtllib a.mtl", *VERTICES, "usemtl skin", *FACES, ""])
MTL = "newmtl skin\nKd 1 0 0\n"
RELATIVE = "\n".join(["mtllib a.mtl", *VERTICES[:3], "usemtl skin", "f -3 -1 -2", VERTICES[3], "f 1 2 -1", "f -4 -1 -2", "f 2 3 4", ""])


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize(
    ("obj", "mtl"),
    [
        (OBJ, MTL),
        (RELATIVE, MTL),
        (OBJ.replace("f 1 3 2", "f 1 \\\n 3 2"), MTL.replace("1 0 0", "1 \\\n0 0")),
        (OBJ.replace("\n", "\n  "), MTL.replace("\n", "\n\t")),
        (OBJ.replace(" ", "\t"), MTL),
        (OBJ.replace("f ", "fo "), MTL),
        (OBJ.replace("v 1 0 0", "v 1 0 0 # x").replace("f 1 3 2", "f 1 3 2 # a").replace("l skin", "l skin # red"), MTL),
        (OBJ, MTL.replace("1 0 0", "1 0 0 # red")),
        (OBJ.replace("skin", "Skin"), MTL),
        (OBJ.replace("skin", "my  skin #3"), MTL.replace("skin", "my  skin #3")),
        (OBJ.replace("a.mtl", '"a.mtl"'), MTL),
        (OBJ.replace("a.mtl", "a.mtl # colours"), MTL),
        (OBJ.replace("a.mtl", "b.mtl A.mtl"), MTL),
        ("# usemtl other\n" + OBJ, "# newmtl other\n" + MTL),
    ],
)
def test_spellings_of_the_same_file(tmp_path, obj, mtl, end):
    (tmp_path / "a.obj").write_bytes(obj.replace("\n", end).encode())
    (tmp_path / "a.mtl").write_bytes(mtl.replace("\n", end).encode())
    (tmp_path / "b.mtl").write_text("newmtl other\nKd 0 1 0\n")
    said: list[str] = []
    mesh, finish = read_mesh(tmp_path / "a.obj", 1.0, report=said.append)
    assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(1 / 6)
    assert len(mesh.faces) == 4
    assert finish.color == (1.0, 0.0, 0.0)
    assert not said


@pytest.mark.parametrize("name", ["skin.png # wood", "skin.png"])
def test_an_image_with_a_comment_behind_it(tmp_path, name):
    (tmp_path / "a.obj").write_text("mtllib a.mtl\n" + "\n".join(VERTICES) + "\nvt 0 0\nusemtl skin\nf 1/1 3/1 2/1\nf 1/1 2/1 4/1\n")
    (tmp_path / "a.mtl").write_text(f"newmtl skin\nmap_Kd {name}\n")
    Image.new("RGB", (2, 2), (9, 8, 7)).save(tmp_path / "skin.png")
    texture = read_mesh(tmp_path / "a.obj", 1.0)[1].texture
    assert texture is not None
    assert tuple(texture[0, 0]) == (9, 8, 7)


@pytest.mark.parametrize("face", ["f 0 3 2", "f 1 0 2", "f 1 3 0", "f 1/1 3/1 0/1"])
def test_vertex_0_is_refused(tmp_path, face):
    """It would be the last one."""
    (tmp_path / "a.obj").write_text(OBJ.replace("f 1 3 2", face).replace("mtllib a.mtl\n", "vt 0 0\n"))
    with pytest.raises(CatalogError, match="a face refers to vertex 0, but indices begin at 1"):
        read_mesh(tmp_path / "a.obj", 1.0)


def test_colours_beyond_one_are_told(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 255 128 0\n")
    said: list[str] = []
    assert read_mesh(tmp_path / "a.obj", 1.0, report=said.append)[1].color == (1.0, 1.0, 0.0)
    assert said == [f"{tmp_path / 'a.obj'}: ignored: Kd beyond 1 (255 128 0)"]


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
        path.write_text("\n".join(rows))
        return path
    binary = path.stem == "binary"
    head = [f"ply\nformat {'binary_big_endian' if binary else 'ascii'} 1.0\nelement vertex {len(vertices)}"]
    head += [*(f"property double {axis}" for axis in "xyz"), f"element face {len(polygons)}", "property list uchar uint vertex_index"]
    lists = [np.array(each, ">u4").tobytes() for each in polygons]
    rows = [*(" ".join(map(str, row)) for row in vertices), *(f"{len(each)} " + " ".join(map(str, each)) for each in polygons)]
    body = vertices.astype(">f8").tobytes() + b"".join(bytes([len(data) // 4]) + data for data in lists)
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + (body if binary else "\n".join(rows).encode() + b"\n"))
    return path


def area(vertices: np.ndarray, faces: np.ndarray) -> float:
    corners = vertices[faces].astype(np.float64)
    return float(np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2.0)


@pytest.mark.parametrize("name", ["a.obj", "text.ply", "binary.ply"])
@pytest.mark.parametrize("outline", OUTLINES)
def test_concave_polygons_cover_their_outline_alone(tmp_path, outline, name):
    """Fans cover the notches, too: their area is larger."""
    points = np.array(OUTLINES[outline])
    following = np.roll(points, -1, axis=0)
    flat = abs(float((points[:, 0] * following[:, 1] - points[:, 1] * following[:, 0]).sum())) / 2
    sides = float(np.linalg.norm(following - points, axis=1).sum())
    for start in range(len(points)):
        mesh, _ = read_mesh(write(tmp_path / name, *prism(OUTLINES[outline], start)), 1.0)
        assert area(mesh.vertices, mesh.faces) == pytest.approx(2 * flat + sides, rel=1e-6)
        assert signed_volume(mesh.vertices, mesh.faces) == pytest.approx(flat, rel=1e-6)


def test_polygons_in_any_plane_are_clipped_as_they_are_wound():
    random = np.random.default_rng(1)
    for outline in OUTLINES.values():
        rotation = np.linalg.qr(random.normal(size=(3, 3)))[0]
        corners = np.column_stack([outline, np.zeros(len(outline))]) @ rotation.T
        triangles = np.array(clip_ears(corners))
        assert len(triangles) == len(corners) - 2
        normals = np.cross(corners[triangles[:, 1]] - corners[triangles[:, 0]], corners[triangles[:, 2]] - corners[triangles[:, 0]])
        # All on one side, that of the polygon.
        assert (normals @ (rotation[:, 2] * np.linalg.det(rotation)) >= -1e-12).all()


def test_too_many_corners_are_told_and_convex_polygons_are_not_concave(monkeypatch):
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0.1), (0, 1, 0)], np.float64)
    dart = np.array([(0, 0, 0), (2, 0, 0), (0.5, 0.5, 0), (0, 2, 0)], np.float64)
    corners, lengths, ignored = np.arange(8), np.array([4, 4]), []
    assert find_concave(np.concatenate([square, dart]), corners, lengths, ignored).tolist() == [1]
    assert not ignored
    monkeypatch.setattr("synpick_warp.scenes.assets.polygons._MAX_WORK", 15)
    assert not len(find_concave(np.concatenate([square, dart]), corners, lengths, ignored))
    assert ignored == ["concavity of polygons with many corners"]
