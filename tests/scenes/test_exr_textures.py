"""OpenEXR textures and maps of material files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import OpenEXR
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.assets.meshes import read_mesh
from tests.worlds.model_files import OBJ, put

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
