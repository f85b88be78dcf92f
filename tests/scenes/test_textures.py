"""Texture import: any bit depth, channels and size; missing or invalid texture coordinates."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.assets.meshes import MeshOptions, read_mesh
from tests.scenes.test_gltf import TEXTURE, Builder, pbr
from tests.worlds.model_files import CORNERS, FACES, ascii_ply, picture, put, read

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
