"""Hostile model folders and light maps, also by fuzzing: one line or valid content; nothing outside is read or written, no hang."""

import json
import os
import resource
import struct
import tempfile
import time
import zlib
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
from synpick_warp.exporters.bop.shared import write_models
from synpick_warp.scenes.assets.asset_files import MAX_ROWS
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.assets.models_info import read_models_info
from synpick_warp.scenes.lights import MAX_RADIANCE, load_lights
from tests.harness.hostile import LEAVES, fuzz_examples, places, removed, replaced, start_isolation
from tests.worlds.model_files import FACES, ascii_ply, binary_ply, exported, load_models, pack_glb, pack_png, put, unpack_glb

SECONDS = 5.0
"""Longest time that any input may take."""
KIBIBYTES = 3 * 2**20
"""Most memory of the process while these tests run: 3 GiB."""
fuzz = settings(max_examples=fuzz_examples(100), suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large])
fuzz_maps = settings(fuzz, max_examples=fuzz_examples(40))
"""Fewer, as each map is decoded in a process of its own."""

CORNERS = [(0, 0, 0, 0.1, 0.2), (1, 0, 0, 0.3, 0.4), (0, 1, 0, 0.5, 0.6), (0, 0, 1, 0.7, 1.0)]
COLUMNS = ("x", "y", "z", "texture_u", "texture_v")
NUMBERS = ("-1", "0", "3", "4", "255", "2147483648", "99999999999999999999", "1e308", "-1e308", "nan", "inf", "x", "", "0.5")


def picture() -> bytes:
    return cv2.imencode(".png", np.arange(36, dtype=np.uint8).reshape(4, 3, 3))[1].tobytes()


def read(name: str, content: bytes, more: dict[str, bytes], check: Callable[[Path], None], error: type[SynpickError]) -> None:
    """Load files from a folder and check one of them; an error must be one line, write nothing, and come within SECONDS."""
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
    mesh, material, _ = read_mesh(path, 1.0)
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


PLY_LINES = ("property list uchar int vertex_indices", "property list uint float texcoord", "property list float double x")
PLY_LINES += ("property uchar red", "property double nx", "element edge 3", "element face 1000000000000", "element vertex 2097152")
PLY_LINES += ("element empty 2000000", "format ascii 1.0", "format binary_big_endian 1.0", "comment TextureFile ../../evil.png")
PLY_LINES += ("comment texturefile skin.png", "comment TextureFile /dev/zero", "comment \x1b[2J", "end_header", "")


@fuzz
@given(st.data())
def test_any_ply_is_one_line_or_a_mesh(data):
    binary = data.draw(st.booleans())
    made = (binary_ply if binary else ascii_ply)(CORNERS, FACES, COLUMNS, "comment TextureFile skin.png")
    header, end, body = (made if isinstance(made, bytes) else made.encode()).partition(b"end_header\n")
    if not binary:
        body = "\n".join(mutate_lines(data, body.decode().splitlines(), NUMBERS)).encode() + b"\n"
    lines = mutate_lines(data, (header + end).decode().splitlines(), PLY_LINES)
    content = "\n".join(lines).encode() + b"\n" + mutate_bytes(data, body)
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
OBJ_LINES = ("usemtl none", "mtllib ../a.mtl", "mtllib", "o x", "g y", "f 1 2", "f 1 2 3 4 5", "f -1 -2 -3", "f 1//1 2//1 3//1", "v 1")
OBJ_LINES += ("v", "vn nan nan nan", "v 1 2 3 4 5 6 7", "\x00", "f 1/9/9 2/9/9 3/9/9", "f 99 1 2", "\\", "vt 1e300 0", "fx")
OBJ_LINES += ("v 1,5 2,5 3,5",)
MTL_LINES = ("newmtl other", "Kd nan 0 0", "Kd 7", "Kd 1 2", "Kd -9 9 9", "map_Kd ../../evil.png", "map_Kd /dev/zero", "map_Kd")
MTL_LINES += ("map_kd a.mtl",)


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


@fuzz_maps
@given(st.data())
def test_any_radiance_map_is_one_line_or_a_map(data):
    image = np.full((8, 16, 3), data.draw(st.sampled_from([0.5, 1e-30, 8e37, 1e11, 3e9])), np.float32)
    header, _, body = cv2.imencode(".hdr", image)[1].tobytes().partition(b"\n\n")
    lines = mutate_lines(data, [*header.decode().split("\n"), "", body.split(b"\n")[0].decode()], HDR_LINES)
    content = "\n".join(lines).encode() + b"\n" + mutate_bytes(data, body.partition(b"\n")[2])
    read("a.hdr", content, {}, check_lights, LightError)


IBL_LINES = ("REFfile = ../../map.hdr", "REFfile = /dev/zero", "REFgamma = 1e300", "REFmulti = 1e300", "SUNmulti = 1e-300", "REFmap = 2")
IBL_LINES += ("[Sun]", "BGfile = a\x00b", "  continued", "a" + " " * 900 + "b", "= 3", "[", "[DEFAULT]", "SUNcolor = 0,0,255")
IBL_LINES += ("SUNu = nan", "%(x)s = %(y)s")


@fuzz_maps
@given(st.data())
def test_any_set_file_is_one_line_or_a_map(data):
    lines = ["[Reflection]", "REFfile = map.bin", "REFmap = 1", "REFmulti = 2.0", "[Sun]", "SUNu = 0.3", "SUNv = 0.2", "SUNmulti = 3"]
    image = cv2.imencode(".hdr", np.full((8, 16, 3), 0.5, np.float32))[1].tobytes()
    content = mutate_bytes(data, "\n".join(mutate_lines(data, lines, IBL_LINES)).encode())
    read("a.ibl", content, {"map.bin": image}, check_lights, LightError)


# ---- names ----


def ply(*comments: str) -> bytes:
    """A textured tetrahedron in BOP's format."""
    rows = np.multiply(CORNERS, (100.0, 100.0, 100.0, 1, 1))
    return binary_ply(rows, FACES, COLUMNS, "\n".join(comments))


def folder_of(parent: Path, *comments: str) -> Path:
    """A BOP folder of one model, three folders below `parent`, with pictures beside it and outside."""
    folder = parent / "a" / "b" / "models"
    put(folder / "obj_000001.ply", ply(*comments))
    for path in (folder / "skin.png", folder / "sub" / "skin.png", parent / "a" / "evil.png"):
        put(path, picture())
    return folder


def refused(folder: Path, cache: Path, *words: str) -> None:
    start_isolation()
    started = time.monotonic()
    with pytest.raises(CatalogError) as caught:
        load_models(folder, cache)
    said = str(caught.value)
    assert said.isprintable()
    assert all(word in said for word in words), said
    assert time.monotonic() - started < SECONDS


SKIN = "comment TextureFile skin.png"
POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n"
OUTSIDE = ("../../evil.png", "/etc/passwd", "sub/../../../evil.png", "link/evil.png", "evil\\\x07.png")


def png(width: int, height: int) -> bytes:
    """A PNG file of zeros that are never decoded."""
    return pack_png(width, height, (b"IDAT", zlib.compress(bytes(100))), kind=2)


@pytest.mark.parametrize(
    ("comments", "image", "words"),
    [
        *(((f"comment TextureFile {name}",), picture(), ("names the file", "obj_000001.ply")) for name in OUTSIDE),
        *(((f"comment texturefile {name}",), picture(), ("names the file", "obj_000001.ply")) for name in OUTSIDE),
        ((SKIN, "comment TextureFile models_info.json"), picture(), ("2 texture comments",)),
        *(((SKIN,), png(side, side), ("skin.png: too large an image", "8192 x 8192")) for side in (8193, 13_000, 60_000)),
        # Another program would decode it.
        ((SKIN,), POSTSCRIPT, ("format is unknown",)),
    ],
)
def test_textures_outside_of_the_folder_or_that_no_bake_can_use_are_refused(tmp_path, comments, image, words):
    folder = folder_of(tmp_path, *comments)
    (folder / "link").symlink_to("../..")
    (folder / "skin.png").write_bytes(image)
    refused(folder, tmp_path, *words)


@pytest.mark.parametrize("line", ["comment texturefile skin.png", "comment  TEXTUREFILE  sub/skin.png", "comment TextureFile ./skin.png"])
def test_a_texture_that_is_read_is_copied_into_the_set(tmp_path, line):
    folder = folder_of(tmp_path, line)
    catalog = load_models(folder, tmp_path)[0]
    write_models(catalog, tmp_path / "models")
    assert (tmp_path / "models" / line.split()[-1]).read_bytes() == picture()
    assert (tmp_path / "models" / "obj_000001.ply").read_bytes() == (folder / "obj_000001.ply").read_bytes()
    again = load_models(tmp_path / "models", tmp_path)[0]
    assert np.array_equal(again.entries[0].material.texture, catalog.entries[0].material.texture)


def test_only_the_texture_that_was_read_is_copied(tmp_path):
    """A texture that is replaced between reading and copying is not copied, whether by another image or by a file that is no image."""
    folder = folder_of(tmp_path, SKIN)
    catalog = load_models(folder, tmp_path)[0]
    other = cv2.imencode(".png", np.zeros((4, 3, 3), np.uint8))[1].tobytes()
    for number, content in enumerate((other, b"no picture")):
        (folder / "skin.png").write_bytes(content)
        with pytest.raises(CatalogError, match=r"changed since it was read|not readable as an image"):
            write_models(catalog, tmp_path / f"models{number}")
        assert not (tmp_path / f"models{number}" / "skin.png").exists()
    (folder / "obj_000001.ply").write_bytes(ply("comment TextureFile ../../evil.png"))
    (tmp_path / "set").mkdir()
    with pytest.raises(CatalogError, match="names the file"):
        write_models(catalog, tmp_path / "set" / "models")
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["models"]


@pytest.mark.parametrize(
    ("file", "text", "said"),
    [
        ("a.obj", "mtllib ../a.mtl\n" + OBJ, r"names the file .*; allowed: a relative name"),
        ("a.mtl", "newmtl skin\nmap_Kd ../skin.png\n", r"names the file .*skin\.png.*; allowed: a relative name"),
        ("a.mtl", "newmtl skin\nmap_Kd ..\\skin.png\n", r"skin\.png"),
        ("a.mtl", "newmtl skin\nmap_Kd textures/../../skin.png\n", r"skin\.png"),
        ("a.mtl", "newmtl skin\nmap_Kd link/skin.png\n", r"skin\.png"),
        ("a.mtl", "newmtl skin\nKd nan 0 0\n", "Kd nan 0 0 is not finite"),
    ],
)
def test_an_obj_stays_in_its_folder_and_has_finite_colours(tmp_path, file, text, said):
    folder = tmp_path / "models"
    for name, content in {
        "a.obj": OBJ,
        "a.mtl": "newmtl skin\nmap_Kd skin.png\n",
        file: text,
        "../a.mtl": "newmtl skin\nKd 1 0 0\n",
    }.items():
        put(folder / name, content)
    for name in ("link", "textures"):
        (folder / name).symlink_to("..")
    (tmp_path / "skin.png").write_bytes(picture())
    with pytest.raises(CatalogError, match=said):
        read_mesh(folder / "a.obj", 1.0)


@pytest.mark.parametrize("uri", ["../evil.bin", "/dev/zero", "%2e%2e/none.bin", "fifo"])
@pytest.mark.parametrize("key", ["buffers", "images"])
def test_a_glb_stays_in_its_folder(tmp_path, uri, key):
    document = {**DOCUMENT, key: [{"uri": uri, "byteLength": len(BINARY)} for _ in DOCUMENT[key]]}
    path = put(tmp_path / "models" / "a.glb", pack_glb(json.dumps(document).encode(), BINARY))
    os.mkfifo(path.with_name("fifo"))
    (tmp_path / "evil.bin").write_bytes(BINARY)
    with pytest.raises(CatalogError, match=r"names the file|no file|not a regular file"):
        read_mesh(path, 1.0)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (b"obj_99999999999999999999.ply", "the number in its name is too large; allowed: 0 to 2147483647"),
        (b"obj_\xd9\xa3.ply", "not readable"),
        (b"caf\xe9.ply", 'the file name "caf\\udce9.ply" is not printable UTF-8'),
        (b"two\nlines.ply", 'the file name "two\\nlines.ply" is not printable UTF-8'),
    ],
)
def test_file_names_that_cannot_be_kept_are_one_line(tmp_path, name, said):
    put(tmp_path / "models" / os.fsdecode(name), b"no model")
    refused(tmp_path / "models", tmp_path, said)


# ---- files ----


@pytest.mark.parametrize("name", ["obj_000001.ply", "skin.png", "models_info.json", "a.obj", "a.glb"])
@pytest.mark.parametrize("kind", ["fifo", "folder", "device"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, name, kind):
    folder = folder_of(tmp_path, SKIN)
    if name[0] == "a":
        (folder / "obj_000001.ply").unlink()
    (folder / name).unlink(missing_ok=True)
    {"fifo": os.mkfifo, "folder": os.mkdir, "device": lambda path: os.symlink("/dev/zero", path)}[kind](folder / name)
    refused(folder, tmp_path, name)


POINTS = "ply\nformat ascii 1.0\nelement vertex 2000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n"


def test_a_header_announces_no_more_than_the_file_has(tmp_path):
    good, many = ply().decode("latin-1"), "ply\n" + "comment x\n" * 10**6
    announced = [good.replace("vertex 4", f"vertex {count}") for count in (99999999999999999999, MAX_ROWS + 1, MAX_ROWS)]
    for text in (*announced, good.replace("binary_little_endian", "ascii"), POINTS, many):
        with pytest.raises(CatalogError) as caught:
            read_mesh(put(tmp_path / "a.ply", text.encode("latin-1")), 1.0)
        assert str(caught.value).isprintable()


def test_instances_in_a_glb_are_counted_before_they_are_made(tmp_path):
    document, binary = unpack_glb(exported(trimesh.Scene([trimesh.creation.icosphere(5, 0.1)]), "glb"))
    many = [{"mesh": 0} for _ in range(1000)]
    deep = [{"children": [number + 1]} for number in range(999)] + [{"mesh": 0, "children": [0]}]
    for nodes, said in ((many, "more than 2097152 vertices"), (deep, r"root and a child|nested deeper")):
        text = json.dumps(document | {"nodes": nodes, "scenes": [{"nodes": list(range(1000))}]}).encode()
        with pytest.raises(CatalogError, match=said):
            read_mesh(put(tmp_path / "a.glb", pack_glb(text, binary)), 1.0)


@pytest.mark.parametrize("value", ["NaN", "1e999", "-1", "7"])
@pytest.mark.parametrize("key", ["metallicFactor", "roughnessFactor"])
def test_a_material_out_of_range_is_refused(tmp_path, key, value):
    text = json.dumps(replaced(DOCUMENT, ("materials", 0, "pbrMetallicRoughness", key), "VALUE")).replace('"VALUE"', value)
    with pytest.raises(CatalogError, match=rf"{key}|malformed|out of range"):
        read_mesh(put(tmp_path / "a.glb", pack_glb(text.encode(), BINARY)), 1.0)
