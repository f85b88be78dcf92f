"""Fuzz tests of model files and light maps: one line, or valid content; nothing written, no hang, bounded memory."""

from __future__ import annotations

import json
import resource
import struct
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.errors import CatalogError, LightError, SynpickError
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import read_models_info
from synpick_warp.scenes.lights import MAX_RADIANCE, load_lights
from tests.harness.fuzz import fuzz_examples, start_isolation
from tests.harness.hostile import LEAVES, places, removed, replaced
from tests.worlds.model_files import exported, pack_glb, unpack_glb

SECONDS = 5.0
"""Longest time that any input may take."""
KIBIBYTES = 3 * 2**20
"""Most memory of the process while these tests run: 3 GiB."""
fuzz = settings(max_examples=fuzz_examples(100), suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])

CORNERS = [(0, 0, 0, 0.1, 0.2), (1, 0, 0, 0.3, 0.4), (0, 1, 0, 0.5, 0.6), (0, 0, 1, 0.7, 1.0)]
FACES = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
NUMBERS = ("-1", "0", "3", "4", "255", "2147483648", "99999999999999999999", "1e308", "-1e308", "nan", "inf", "x", "", "0.5")


def picture() -> bytes:
    return cv2.imencode(".png", np.arange(36, dtype=np.uint8).reshape(4, 3, 3))[1].tobytes()


def read(name: str, content: bytes, more: dict[str, bytes], check: Callable[[Path], None], error: type[SynpickError]) -> None:
    """Write the files into a folder, check what is read of one, and that an error is one line, nothing is written and time is short."""
    with tempfile.TemporaryDirectory() as parent:
        folder = Path(parent) / "models"
        folder.mkdir()
        for each, data in {**more, name: content}.items():
            (folder / each).write_bytes(data)
        before = sorted(Path(parent).rglob("*"))
        start_isolation()
        started, said = time.monotonic(), ""
        try:
            check(folder / name)
        except error as caught:
            said = str(caught)
        assert said.isprintable(), ascii(said)
        assert len(said) < 1000
        assert time.monotonic() - started < SECONDS
        assert sorted(Path(parent).rglob("*")) == before
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < KIBIBYTES


def check_mesh(path: Path) -> None:
    mesh, material = read_mesh(path, 1.0)
    assert np.isfinite(mesh.vertices).all()
    assert np.isfinite(mesh.uv).all()
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1.0, atol=1e-3)
    assert len(mesh.vertices) == len(mesh.normals) == len(mesh.uv)
    assert len(mesh.faces) > 0
    assert mesh.faces.min() >= 0
    assert mesh.faces.max() < len(mesh.vertices)
    assert all(0.0 <= value <= 1.0 for value in material.color)
    assert all(value is None or -0.01 <= value <= 1.01 for value in (material.metallic, material.roughness))


def mutate_bytes(data: st.DataObject, content: bytes) -> bytes:
    """Flip, remove or add some bytes."""
    changed = bytearray(content)
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, max(len(changed) - 1, 0)))
        piece = data.draw(st.one_of(st.binary(max_size=4), st.sampled_from([b"\xff" * 4, b"\0" * 4, struct.pack("<f", np.nan), b"\n"])))
        changed[at : at + data.draw(st.integers(0, 6))] = piece
    return bytes(changed[: data.draw(st.sampled_from([len(changed), len(changed) // 2]))] if data.draw(st.booleans()) else changed)


def mutate_lines(data: st.DataObject, lines: list[str], hostile: tuple[str, ...]) -> list[str]:
    """Insert or drop lines, or replace a word by a hostile number."""
    lines = list(lines)
    for _ in range(data.draw(st.integers(0, 3))):
        at = data.draw(st.integers(0, len(lines) - 1)) if lines else 0
        match data.draw(st.sampled_from(["insert", "drop", "word", "swap"])):
            case "insert":
                lines.insert(at, data.draw(st.sampled_from(hostile)))
            case "drop":
                del lines[at : at + 1]
            case "word" if lines and lines[at].split():
                words = lines[at].split()
                words[data.draw(st.integers(0, len(words) - 1))] = data.draw(st.sampled_from(NUMBERS))
                lines[at] = " ".join(words)
            case "swap" if lines:
                lines[at], lines[0] = lines[0], lines[at]
    return lines


PLY_LINES = (
    "property list uchar int vertex_indices",
    "property list uint float texcoord",
    "property list float double x",
    "property uchar red",
    "property double nx",
    "element edge 3",
    "element face 1000000000000",
    "element vertex 2097152",
    "element empty 2000000",
    "format ascii 1.0",
    "format binary_big_endian 1.0",
    "comment TextureFile ../../evil.png",
    "comment texturefile skin.png",
    "comment TextureFile /dev/zero",
    "comment \x1b[2J",
    "end_header",
    "",
)


@fuzz
@given(st.data())
def test_any_ply_is_one_line_or_a_mesh(data):
    binary = data.draw(st.booleans())
    header = ["ply", f"format {'binary_little_endian' if binary else 'ascii'} 1.0", "comment TextureFile skin.png", "element vertex 4"]
    header += [f"property float {name}" for name in ("x", "y", "z", "texture_u", "texture_v")]
    header += ["element face 4", "property list uchar int vertex_indices", "end_header"]
    body = np.asarray(CORNERS, "<f4").tobytes() + b"".join(struct.pack("<B3i", 3, *face) for face in FACES)
    if not binary:
        rows = [" ".join(map(str, row)) for row in CORNERS] + [f"3 {' '.join(map(str, face))}" for face in FACES]
        body = "\n".join(mutate_lines(data, rows, NUMBERS)).encode() + b"\n"
    content = "\n".join(mutate_lines(data, header, PLY_LINES)).encode() + b"\n" + mutate_bytes(data, body)
    read("a.ply", content, {"skin.png": picture()}, check_mesh, CatalogError)


def glb_chunks() -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a box with material and images."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    image = Image.new("RGB", (4, 4), (9, 8, 7))
    material = PBRMaterial(baseColorTexture=image, metallicRoughnessTexture=image, metallicFactor=0.5, baseColorFactor=(9, 9, 9, 255))
    box.visual = TextureVisuals(uv=np.zeros((8, 2)), material=material)
    return unpack_glb(exported(trimesh.Scene([box]), "glb"))


DOCUMENT, BINARY = glb_chunks()
PLACES = list(places(DOCUMENT))
GLB_VALUES = (*LEAVES, 1e308, float("nan"), 0, 1, 2, 7, 2**31 - 1, 5126, "data:,base64,x", "/etc/passwd", [0, 0], [0] * 16, {"index": 9})


@fuzz
@given(st.data())
def test_any_glb_is_one_line_or_a_mesh(data):
    document = DOCUMENT
    for _ in range(data.draw(st.integers(0, 3))):
        place = data.draw(st.sampled_from(PLACES))
        try:
            if data.draw(st.integers(0, 4)):
                document = replaced(document, place, data.draw(st.sampled_from(GLB_VALUES)))
            else:
                document = removed(document, place)
        except (KeyError, IndexError, TypeError):
            continue  # An earlier change took the place away.
    text = json.dumps(document).encode()
    content = pack_glb(text, mutate_bytes(data, BINARY))
    if not data.draw(st.integers(0, 3)):
        content = mutate_bytes(data, content)
    read("a.glb", content, {}, check_mesh, CatalogError)


OBJ = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvt 0 0\nvt 1 0\nvt 1 1\nvn 0 0 1\nusemtl skin\n"
OBJ += "f 1/1/1 3/2/1 2/3/1\nf 1/1/1 2/2/1 4/3/1\nf 1/1/1 4/2/1 3/3/1\nf 2/1/1 3/2/1 4/3/1"
OBJ_LINES = (
    "usemtl none",
    "mtllib ../a.mtl",
    "mtllib",
    "o x",
    "g y",
    "f 1 2",
    "f 1 2 3 4 5",
    "f -1 -2 -3",
    "f 1//1 2//1 3//1",
    "v 1",
    "v",
)
OBJ_LINES += ("vn nan nan nan", "v 1 2 3 4 5 6 7", "\x00", "f 1/9/9 2/9/9 3/9/9", "f 99 1 2", "\\", "vt 1e300 0", "fx", "v 1,5 2,5 3,5")
MTL_LINES = (
    "newmtl other",
    "Kd nan 0 0",
    "Kd 7",
    "Kd 1 2",
    "Kd -9 9 9",
    "map_Kd ../../evil.png",
    "map_Kd /dev/zero",
    "map_Kd",
    "map_kd a.mtl",
)


@fuzz
@given(st.data())
def test_any_obj_is_one_line_or_a_mesh(data):
    text = mutate_lines(data, OBJ.split("\n"), OBJ_LINES)
    library = mutate_lines(data, ["newmtl skin", "Kd 1 1 1", "map_Kd skin.png"], MTL_LINES)
    files = {"skin.png": picture(), "a.mtl": mutate_bytes(data, "\n".join(library).encode())}
    read("a.obj", mutate_bytes(data, "\n".join(text).encode()), files, check_mesh, CatalogError)


INFO = {
    "1": {
        "diameter": 100.0,
        "min_x": -1,
        "symmetries_discrete": [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]],
        "symmetries_continuous": [{"axis": [0, 0, 1], "offset": [0, 0, 0]}],
    }
}


def check_info(path: Path) -> None:
    info = read_models_info(path, [1])[1]
    assert info.diameter is None or 0.0 < info.diameter < np.inf
    assert all(len(matrix) == 16 and np.isfinite(matrix).all() for matrix in info.symmetries_discrete)
    assert all(np.linalg.norm(axis) == pytest.approx(1.0) and np.isfinite(at).all() for axis, at in info.symmetries_continuous)


@fuzz
@given(st.data())
def test_any_models_info_is_one_line_or_valid(data):
    place = data.draw(st.sampled_from(list(places(INFO))))
    value = data.draw(st.one_of(st.sampled_from((*LEAVES, float("nan"), 1e308, 1e-308)), st.floats(), st.integers()))
    content = json.dumps(replaced(INFO, place, value) if data.draw(st.booleans()) else removed(INFO, place)).encode()
    content = data.draw(st.sampled_from([content, content[: len(content) // 2], b"[" * 100_000, b'{"1": ' + b"[" * 20 + b"]" * 20 + b"}"]))
    read("models_info.json", content, {}, check_info, CatalogError)


HDR_LINES = ("FORMAT=32-bit_rle_rgbe", "FORMAT=32-bit_rle_xyze", "EXPOSURE=nan", "GAMMA=0", "x" * 127, "-Y 30000 +X 30000", "", "#?RGBE")
HDR_LINES += ("-Y 2147483647 +X 2147483647", "-Y -8 +X 16", "+X 16 -Y 8", "-Y 8 +X 16", "-Y 4096 +X 8192", "\x00")


def check_lights(path: Path) -> None:
    for light in load_lights(str(path.parent)):
        assert np.isfinite(light.radiance).all()
        assert 0.0 <= light.radiance.min() <= light.radiance.max() <= MAX_RADIANCE


@fuzz
@given(st.data())
def test_any_radiance_map_is_one_line_or_a_map(data):
    image = np.full((8, 16, 3), data.draw(st.sampled_from([0.5, 1e-30, 8e37, 1e11, 3e9])), np.float32)
    header, _, body = cv2.imencode(".hdr", image)[1].tobytes().partition(b"\n\n")
    lines = mutate_lines(data, [*header.decode().split("\n"), "", body.split(b"\n")[0].decode()], HDR_LINES)
    content = "\n".join(lines).encode() + b"\n" + mutate_bytes(data, body.partition(b"\n")[2])
    read("a.hdr", content, {}, check_lights, LightError)


IBL_LINES = (
    "REFfile = ../../map.hdr",
    "REFfile = /dev/zero",
    "REFgamma = 1e300",
    "REFmulti = 1e300",
    "SUNmulti = 1e-300",
    "REFmap = 2",
    "[Sun]",
)
IBL_LINES += (
    "BGfile = a\x00b",
    "  continued",
    "a" + " " * 900 + "b",
    "= 3",
    "[",
    "[DEFAULT]",
    "SUNcolor = 0,0,255",
    "SUNu = nan",
    "%(x)s = %(y)s",
)


@fuzz
@given(st.data())
def test_any_set_file_is_one_line_or_a_map(data):
    lines = ["[Reflection]", "REFfile = map.bin", "REFmap = 1", "REFmulti = 2.0", "[Sun]", "SUNu = 0.3", "SUNv = 0.2", "SUNmulti = 3"]
    image = cv2.imencode(".hdr", np.full((8, 16, 3), 0.5, np.float32))[1].tobytes()
    content = mutate_bytes(data, "\n".join(mutate_lines(data, lines, IBL_LINES)).encode())
    read("a.ibl", content, {"map.bin": image}, check_lights, LightError)
