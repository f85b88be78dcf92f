"""Texture import: any bit depth, channels and size; missing or invalid texture coordinates."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.assets.meshes import MeshOptions, read_mesh
from tests.scenes.test_gltf import TEXTURE, Builder, pbr
from tests.worlds.model_files import CORNERS, FACES, OBJ, ascii_ply, picture, put, read

UNWRAPPED = ("x", "y", "z", "texture_u", "texture_v")
UNWRAPPED_OBJ = "mtllib a.mtl\n" + "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS) + "usemtl skin\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("channels", [1, 3, 4])
@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (37, 50)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_images_of_any_bit_depth_channels_and_size(tmp_path, channels, size, dtype):
    """Each pixel to the byte above its value or the one below; with alpha 0, the colour is still there."""
    largest = np.iinfo(dtype).max
    pixels = np.random.default_rng(0).integers(0, largest + 1, (*size, channels)).astype(dtype)
    if channels == 4:
        pixels[..., 3] = 0
    assert cv2.imwrite(str(tmp_path / "t.png"), pixels)
    texture = decode_texture((tmp_path / "t.png").read_bytes(), "t.png")
    assert texture.shape == (*size, 3)
    assert texture.dtype == np.uint8
    expected = pixels[..., 2::-1] if channels > 1 else np.repeat(pixels, 3, axis=2)
    assert np.abs(texture - expected / largest * 255.0).max() <= (0 if dtype == np.uint8 else 1)


def test_a_texture_on_a_mesh_that_is_not_unwrapped_is_refused(tmp_path):
    put(tmp_path / "a.glb", Builder(**pbr(**TEXTURE)).image().glb())
    put(tmp_path / "a.obj", UNWRAPPED_OBJ)
    put(tmp_path / "a.mtl", "newmtl skin\nmap_Kd skin.png\n")
    picture(tmp_path / "skin.png")
    for path in (tmp_path / "a.glb", tmp_path / "a.obj"):
        with pytest.raises(CatalogError, match="without texture coordinates; unwrap it") as caught:
            read_mesh(path, 1.0)
        assert str(caught.value).startswith(f"{path}: ")
        assert str(caught.value).count(str(path)) == 1


def test_a_mesh_without_texture_needs_no_coordinates(tmp_path):
    (tmp_path / "a.obj").write_text(UNWRAPPED_OBJ)
    (tmp_path / "a.mtl").write_text("newmtl skin\nKd 0.2 0.4 0.6\n")
    (tmp_path / "a.ply").write_text(ascii_ply(CORNERS))
    for name, color in (("a.obj", (0.2, 0.4, 0.6)), ("a.ply", (0.7, 0.7, 0.7))):
        mesh, finish = read_mesh(tmp_path / name, 1.0)
        assert finish.texture is None
        assert finish.color == pytest.approx(color, abs=0.003)
        assert mesh.uv.shape == (len(mesh.vertices), 2)
        assert not mesh.uv.any()


@pytest.mark.parametrize("value", ["nan", "inf", "-1e30", "10001"])
def test_invalid_texture_coordinates(tmp_path, value):
    picture(tmp_path / "t.png")
    rows = [(*corner, 0.5, 0.5) for corner in CORNERS]

    def textured(last: tuple) -> str:
        return ascii_ply([*rows[: 4 if last[0] == 9 else 3], (*last, value, 0.5)], FACES, UNWRAPPED, "comment TextureFile t.png")

    with pytest.raises(CatalogError, match="not finite or beyond 10000; repair the mesh"):
        read(tmp_path / "a.ply", textured(CORNERS[3]))
    # A vertex that no triangle uses may have any.
    assert len(read(tmp_path / "a.ply", textured((9, 9, 9)), MeshOptions(crease_angle=180.0))[0].vertices) == 4


# ---- OpenEXR ----


MTL = "newmtl skin\nmap_Kd maps/albedo.exr\nmap_Pr maps/rough.exr\nmap_Pm maps/rough.exr\nnorm maps/normal.exr\n"


def write_exr(path: Path, **channels: np.ndarray) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    names = {name.replace("_", "."): np.ascontiguousarray(plane) for name, plane in channels.items()}
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, names) as file:
        file.write(str(path))
    return path


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
    image = decode_texture(write_exr(tmp_path / "a.exr", **channels).read_bytes(), "a.exr", linear)
    assert image.shape == (2, 3, 3)
    assert (image == expected).all()


def test_maps_of_a_material_library(tmp_path):
    """Base colour maps are converted to sRGB, roughness and metallic maps stay linear, and normal maps are reported as ignored."""
    put(tmp_path / "a.obj", OBJ)
    put(tmp_path / "a.mtl", MTL)
    write_exr(tmp_path / "maps" / "albedo.exr", R=plane(0.2), G=plane(0.5), B=plane(1.0))
    write_exr(tmp_path / "maps" / "rough.exr", Y=plane(0.3, np.float16))
    said: list[str] = []
    _, material = read_mesh(tmp_path / "a.obj", 1.0, report=said.append)
    assert material.texture is not None
    assert (material.texture[0, 0] == (124, 188, 255)).all()
    assert (material.metallic, material.roughness) == (pytest.approx(0.3, abs=0.003), pytest.approx(0.3, abs=0.003))
    assert said == [f"{tmp_path / 'a.obj'}: ignored: norm"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"\x76\x2f\x31\x01", "not readable as OpenEXR"),
        (b"\x76\x2f\x31\x01" + bytes(200), "not readable as OpenEXR"),
        (None, "without channels R, G, B or Y"),
    ],
)
def test_damaged_files_are_one_line(tmp_path, content, said):
    data = write_exr(tmp_path / "a.exr", U=plane(0.1), V=plane(0.1)).read_bytes() if content is None else content
    with pytest.raises(CatalogError, match=r"^a\.exr: ") as caught:
        decode_texture(data, "a.exr")
    assert said in str(caught.value)
