"""Hostile model folders and light maps: nothing outside is read or written, every mistake is one line, pictures are not black."""

from __future__ import annotations

import json
import os
import re
import struct
import time
import warnings
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.errors import CatalogError, LightError
from synpick_warp.exporters.bop.shared.models import write_models
from synpick_warp.scenes.assets.asset_files import MAX_ROWS
from synpick_warp.scenes.assets.meshes import read_mesh
from synpick_warp.scenes.collision.decomposition import ShapeRecipe
from synpick_warp.scenes.collision.shapes import collision_shapes
from synpick_warp.scenes.lights import MAX_RADIANCE, load_lights
from synpick_warp.stages.render.light_tables import precompute_environment
from tests.harness.fuzz import start_isolation
from tests.scenes.test_fuzz_assets import BINARY, CORNERS, DOCUMENT, FACES, OBJ, picture
from tests.worlds.model_files import binary_ply, box, exported, load_models, pack_glb, pack_png, read, unpack_glb

SECONDS = 5.0
"""Longest time that any input may take."""


def ply(*comments: str, scale: float = 100.0) -> bytes:
    """A textured tetrahedron in BOP's format."""
    rows = np.multiply(CORNERS, (scale, scale, scale, 1, 1))
    return binary_ply(rows, FACES, ("x", "y", "z", "texture_u", "texture_v"), "\n".join(comments))


def folder_of(parent: Path, *comments: str) -> Path:
    """A BOP folder of one model, three folders below `parent`, with pictures beside it and outside."""
    folder = parent / "a" / "b" / "models"
    (folder / "sub").mkdir(parents=True)
    (folder / "obj_000001.ply").write_bytes(ply(*comments))
    for path in (folder / "skin.png", folder / "sub" / "skin.png", parent / "a" / "evil.png"):
        path.write_bytes(picture())
    return folder


def refused(folder: Path, cache: Path, *words: str) -> str:
    start_isolation()
    started = time.monotonic()
    with pytest.raises(CatalogError) as caught:
        load_models(folder, cache)
    said = str(caught.value)
    assert said.isprintable()
    assert all(word in said for word in words), said
    assert time.monotonic() - started < SECONDS
    return said


# ---- names ----


@pytest.mark.parametrize("name", ["../../evil.png", "/etc/passwd", "sub/../../../evil.png", "link/evil.png", "evil\\\x07.png"])
@pytest.mark.parametrize("word", ["TextureFile", "texturefile"])
def test_a_texture_outside_of_the_folder_is_refused(tmp_path, name, word):
    folder = folder_of(tmp_path, f"comment {word} {name}")
    (folder / "link").symlink_to("../..")
    refused(folder, tmp_path, "names the file", "obj_000001.ply")


def test_a_second_texture_comment_is_refused(tmp_path):
    folder = folder_of(tmp_path, "comment TextureFile skin.png", "comment TextureFile models_info.json")
    refused(folder, tmp_path, "2 texture comments")


@pytest.mark.parametrize("line", ["comment texturefile skin.png", "comment  TEXTUREFILE  sub/skin.png", "comment TextureFile ./skin.png"])
def test_a_texture_that_is_read_is_copied_into_the_set(tmp_path, line):
    folder = folder_of(tmp_path, line)
    catalog = load_models(folder, tmp_path)[0]
    write_models(tmp_path / "models", catalog)
    name = line.split()[-1]
    assert (tmp_path / "models" / name).read_bytes() == picture()
    assert (tmp_path / "models" / "obj_000001.ply").read_bytes() == (folder / "obj_000001.ply").read_bytes()
    again = load_models(tmp_path / "models", tmp_path)[0]
    assert np.array_equal(again.entries[0].material.texture, catalog.entries[0].material.texture)


def test_only_the_texture_that_was_read_is_copied(tmp_path):
    """A texture that is replaced between reading and copying is not copied, whether by another image or by a file that is no image."""
    folder = folder_of(tmp_path, "comment TextureFile skin.png")
    catalog = load_models(folder, tmp_path)[0]
    other = cv2.imencode(".png", np.zeros((4, 3, 3), np.uint8))[1].tobytes()
    for number, content in enumerate((other, b"no picture")):
        (folder / "skin.png").write_bytes(content)
        with pytest.raises(CatalogError, match=r"changed since it was read|not readable as an image"):
            write_models(tmp_path / f"models{number}", catalog)
        assert not (tmp_path / f"models{number}" / "skin.png").exists()
    (folder / "obj_000001.ply").write_bytes(ply("comment TextureFile ../../evil.png"))
    (tmp_path / "set").mkdir()
    with pytest.raises(CatalogError, match="names the file"):
        write_models(tmp_path / "set" / "models", catalog)
    assert [path.name for path in (tmp_path / "set").iterdir()] == ["models"]


@pytest.mark.parametrize(("file", "text"), [("a.obj", "mtllib ../a.mtl\n"), ("a.mtl", "newmtl skin\nmap_Kd ../evil.png\n")])
def test_an_obj_stays_in_its_folder(tmp_path, file, text):
    folder = tmp_path / "models"
    folder.mkdir()
    for path in (tmp_path / "evil.png", folder / "skin.png"):
        path.write_bytes(picture())
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 1 0 0\n")
    (folder / "a.obj").write_text(OBJ)
    (folder / "a.mtl").write_text("newmtl skin\nmap_Kd skin.png\n")
    (folder / file).write_text(text + OBJ if file == "a.obj" else text)
    with pytest.raises(CatalogError, match=r"names the file .*; allowed: a relative name"):
        read_mesh(folder / "a.obj", 1.0)


@pytest.mark.parametrize("uri", ["../evil.bin", "/dev/zero", "%2e%2e/none.bin", "fifo"])
@pytest.mark.parametrize("key", ["buffers", "images"])
def test_a_glb_stays_in_its_folder(tmp_path, uri, key):
    folder = tmp_path / "models"
    folder.mkdir()
    os.mkfifo(folder / "fifo")
    (tmp_path / "evil.bin").write_bytes(BINARY)
    document = {**DOCUMENT, key: [{"uri": uri, "byteLength": len(BINARY)} for _ in DOCUMENT[key]]}
    (folder / "a.glb").write_bytes(pack_glb(json.dumps(document).encode(), BINARY))
    with pytest.raises(CatalogError, match=r"names the file|no file|not a regular file"):
        read_mesh(folder / "a.glb", 1.0)


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
    folder = tmp_path / "models"
    folder.mkdir()
    Path(os.fsdecode(os.fsencode(folder) + b"/" + name)).write_bytes(b"no model")
    assert said in refused(folder, tmp_path)


# ---- files ----


@pytest.mark.parametrize("name", ["obj_000001.ply", "skin.png", "models_info.json", "a.obj", "a.glb"])
@pytest.mark.parametrize("kind", ["fifo", "folder", "device"])
def test_what_is_no_regular_file_is_refused_at_once(tmp_path, name, kind):
    folder = folder_of(tmp_path, "comment TextureFile skin.png")
    if name[0] == "a":
        (folder / "obj_000001.ply").unlink()
    (folder / name).unlink(missing_ok=True)
    {"fifo": os.mkfifo, "folder": os.mkdir, "device": lambda path: os.symlink("/dev/zero", path)}[kind](folder / name)
    refused(folder, tmp_path, name)


def test_a_fifo_in_the_cache_of_shapes_is_no_obstacle(tmp_path):
    mesh, _ = read(tmp_path / "box.ply", box(0.1, 0.1, 0.1))
    recipe = ShapeRecipe(concave=False, hull_vertices=64, piece_vertices=16, pieces=8, concavity=0.2)
    shapes = collision_shapes(["box"], [mesh], [recipe], tmp_path / "cache", print)
    (file,) = (tmp_path / "cache").iterdir()
    file.unlink()
    os.mkfifo(file)
    again = collision_shapes(["box"], [mesh], [recipe], tmp_path / "cache", print)
    assert np.array_equal(again[0][0].vertices, shapes[0][0].vertices)
    assert file.is_file()


def png(width: int, height: int) -> bytes:
    """A PNG file of zeros that are never decoded."""
    return pack_png(width, height, (b"IDAT", zlib.compress(bytes(100))), kind=2)


@pytest.mark.parametrize("side", [8193, 13_000, 60_000])
def test_a_large_texture_is_refused_by_its_header_without_warnings(tmp_path, side):
    folder = folder_of(tmp_path, "comment TextureFile skin.png")
    (folder / "skin.png").write_bytes(png(side, side))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        refused(folder, tmp_path, "skin.png: too large an image", "8192 x 8192")


def test_an_image_that_another_program_would_decode_is_refused(tmp_path):
    folder = folder_of(tmp_path, "comment TextureFile skin.png")
    (folder / "skin.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n%%EndComments\nshowpage\n")
    refused(folder, tmp_path, "format is unknown")


def test_a_header_announces_no_more_than_the_file_has(tmp_path):
    good = ply().decode("latin-1")
    for text in (
        good.replace("vertex 4", "vertex 99999999999999999999"),
        good.replace("vertex 4", f"vertex {MAX_ROWS + 1}"),
        good.replace("vertex 4", f"vertex {MAX_ROWS}"),
        good.replace("binary_little_endian", "ascii"),
        "ply\nformat ascii 1.0\nelement vertex 2000000\nproperty float x\nproperty float y\nproperty float z\nend_header\n0 0 0\n",
        "ply\n" + "comment x\n" * 10**6,
    ):
        (tmp_path / "a.ply").write_bytes(text.encode("latin-1"))
        with pytest.raises(CatalogError) as caught:
            read_mesh(tmp_path / "a.ply", 1.0)
        assert str(caught.value).isprintable()


def test_instances_in_a_glb_are_counted_before_they_are_made(tmp_path):
    scene = trimesh.Scene([trimesh.creation.icosphere(5, 0.1)])
    document, binary = unpack_glb(exported(scene, "glb"))
    document["nodes"] = [{"mesh": 0} for _ in range(1000)]
    document["scenes"] = [{"nodes": list(range(1000))}]
    (tmp_path / "a.glb").write_bytes(pack_glb(json.dumps(document).encode(), binary))
    with pytest.raises(CatalogError, match="more than 2097152 vertices"):
        read_mesh(tmp_path / "a.glb", 1.0)
    document["nodes"] = [{"children": [number + 1]} for number in range(999)] + [{"mesh": 0, "children": [0]}]
    (tmp_path / "a.glb").write_bytes(pack_glb(json.dumps(document).encode(), binary))
    with pytest.raises(CatalogError, match=r"root and a child|nested deeper"):
        read_mesh(tmp_path / "a.glb", 1.0)


# ---- numbers and text ----


@pytest.mark.parametrize("value", ["NaN", "1e999", "-1", "7"])
@pytest.mark.parametrize("key", ["metallicFactor", "roughnessFactor"])
def test_a_material_out_of_range_is_refused(tmp_path, key, value):
    document = json.loads(json.dumps(DOCUMENT))
    document["materials"][0]["pbrMetallicRoughness"][key] = "VALUE"
    (tmp_path / "a.glb").write_bytes(pack_glb(json.dumps(document).replace('"VALUE"', value).encode(), BINARY))
    with pytest.raises(CatalogError, match=rf"{key}|malformed|out of range"):
        read_mesh(tmp_path / "a.glb", 1.0)


def test_a_colour_that_is_not_finite_is_refused(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd nan 0 0\n")
    with pytest.raises(CatalogError, match="Kd nan 0 0 is not finite"):
        read_mesh(tmp_path / "a.obj", 1.0)


# ---- light maps ----


def save(path: Path, image: np.ndarray) -> None:
    path.write_bytes(cv2.imencode(path.suffix, image)[1].tobytes())


def lights_refused(folder: Path, pattern: str) -> None:
    start_isolation()
    started = time.monotonic()
    with pytest.raises(LightError, match=pattern) as caught:
        load_lights(str(folder), strict=True)
    assert str(caught.value).isprintable()
    assert time.monotonic() - started < SECONDS


@pytest.mark.parametrize(("value", "said"), [(8e37, "radiance 7.97537e+37; allowed: up to 1e+11"), (1e-30, "black")])
def test_radiance_beyond_what_kernels_hold_is_refused(tmp_path, value, said):
    image = np.full((8, 16, 3), min(value, 0.5), np.float32)
    image[2, 3] = value
    save(tmp_path / "a.hdr", image)
    lights_refused(tmp_path, re.escape(said))


@pytest.mark.parametrize("whole", [False, True])
def test_tables_of_the_brightest_map_are_finite(tmp_path, whole):
    """Squares and cubes of radiance too, which kernels form as 32-bit floats."""
    image = np.full((64, 128, 3), 0.99 * MAX_RADIANCE if whole else 0.5, np.float32)
    image[10, 20] = 0.99 * MAX_RADIANCE
    save(tmp_path / "a.hdr", image)
    (light,) = load_lights(str(tmp_path))
    tables = precompute_environment(light, np.full(3, 0.5))
    assert len(tables.lamps) == (0 if whole else 1)
    values = [getattr(tables, name) for name in ("radiance", "lampless", "prefiltered", "irradiance")]
    for value in values + [lamp.irradiance.astype(np.float32) for lamp in tables.lamps]:
        assert np.isfinite(value).all()
        assert np.isfinite(value**3).all()
    assert 0.0 < np.float32(tables.exposure) < np.inf


def test_a_large_map_is_refused_by_its_header(tmp_path):
    start = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"
    for header in (start + b"\n-Y 30000 +X 60000\n", start + b"x" * 127 + b"\n-Y 30000 +X 60000\n\n-Y 8 +X 16\n"):
        (tmp_path / "a.hdr").write_bytes(header + bytes(99))
        lights_refused(tmp_path, "more than 33554432 pixels; allowed: up to 8192 x 4096")
    image = np.zeros((8, 16, 3), np.uint8)
    tiff = cv2.imencode(".tiff", image)[1].tobytes().replace(struct.pack("<HHII", 256, 3, 1, 16), struct.pack("<HHII", 256, 4, 1, 2**20))
    tiff = tiff.replace(struct.pack("<HHII", 257, 3, 1, 8), struct.pack("<HHII", 257, 4, 1, 2**9))
    jpeg = cv2.imencode(".jpg", image)[1].tobytes().replace(struct.pack(">HH", 8, 16), struct.pack(">HH", 9000, 18000))
    for content in (png(60_000, 30_000), tiff, jpeg):
        (tmp_path / "a.hdr").write_bytes(content)
        lights_refused(tmp_path, "more than 33554432 pixels; allowed")


@pytest.mark.parametrize("name", ["../map.hdr", "/dev/zero", "link/map.hdr"])
@pytest.mark.parametrize("key", ["[Background]\nBGfile", "[Enviroment]\nEVfile", "[Reflection]\nREFfile"])
def test_a_set_stays_in_its_folder(tmp_path, name, key):
    folder = tmp_path / "set"
    folder.mkdir()
    (folder / "link").symlink_to("..")
    for path in (tmp_path / "map.hdr", folder / "map.hdr"):
        save(path, np.full((8, 16, 3), 0.5, np.float32))
    text = f"{key} = {name}\n"
    (folder / "a.ibl").write_text(text if "REF" in key else f"{text}[Reflection]\nREFfile = map.hdr\n")
    lights_refused(folder, "names the file")


@pytest.mark.parametrize("name", ["a.hdr", "a.ibl"])
def test_a_light_map_that_is_a_fifo_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    lights_refused(tmp_path, f"{name} is not a regular file")


@pytest.mark.parametrize("line", ["REFmulti = 1\n  2", "REFgamma = 1e300", "a" + " " * 60_000 + "b", "SUNmulti = 1e-300"])
def test_numbers_of_a_set_that_are_absurd(tmp_path, line):
    save(tmp_path / "map.hdr", np.full((8, 16, 3), 0.5, np.float32))
    (tmp_path / "a.ibl").write_text(f"[Reflection]\nREFfile = map.hdr\n{line}\n[Sun]\nSUNu = 0.5\nSUNv = 0.3\nSUNmulti = 1e-300\n")
    if line.startswith("SUN"):
        assert load_lights(str(tmp_path))[0].sun is None
    else:
        lights_refused(tmp_path, "positive number|longer than")
