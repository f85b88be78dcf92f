"""The meshes of tests/cases, one row each with what is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from synpick_warp.configs.schema import Bake, Config, Objects
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import CatalogEntry
from tests.worlds.model_files import heard

CASES = Path(__file__).parents[1] / "cases"
GREY = (0.7, 0.7, 0.7)
ORANGE = (0.962, 0.588, 0.237)
"""sRGB of the linear colour 60000, 20000, 3000 of 65535."""


@dataclass(frozen=True)
class Case:
    """What is right for the only object of a folder of models."""

    name: str
    color: tuple[float, float, float] | None = None
    """Base colour factor; None: white, with a texture."""
    said: tuple[str, ...] = ()
    """Words of its line; empty: there is no line."""
    check: Callable[[CatalogEntry], bool] = lambda entry: True
    center: bool = False

    @property
    def folder(self) -> Path:
        return CASES / "meshes" / self.name


def uv_range(low: tuple[float, float], high: tuple[float, float]) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose((entry.mesh.uv.min(axis=0), entry.mesh.uv.max(axis=0)), (low, high), atol=1e-4)


def extent(*sides: float) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose(np.ptp(entry.mesh.vertices, axis=0), sides, atol=1e-4)


def texels(entry: CatalogEntry) -> np.ndarray:
    assert entry.material.texture is not None
    return np.unique(entry.material.texture.reshape(-1, 3), axis=0)


def shows_both_textures(entry: CatalogEntry) -> bool:
    folder = CASES / "meshes" / "obj_two_materials_tiled"
    images = [decode_texture((folder / name).read_bytes(), name) for name in ("tex.png", "tex2.png")]
    wanted = np.unique(np.concatenate([image.reshape(-1, 3) for image in images]), axis=0)
    atlas = entry.material.texture
    assert atlas is not None
    tiled = any(np.array_equal(atlas[:rows, :columns], np.tile(image, (3, 3, 1))) for image in images for rows, columns in [(192, 192)])
    return tiled and {tuple(color) for color in wanted.tolist()} <= {tuple(color) for color in texels(entry).tolist()}


def is_centred(entry: CatalogEntry) -> bool:
    return bool(np.abs(entry.mesh.vertices.min(axis=0) + entry.mesh.vertices.max(axis=0)).max() < 1e-6)


NO_UV = "ignored: texture coordinates without a texture"
MESHES = (
    Case("glb_plain", check=uv_range((0, 0), (1, 1))),
    Case("glb_colour_f32", ORANGE),
    Case("glb_colour_u16_rgba", ORANGE),
    Case("glb_colour_f32_factor", (0.707, 0.427, 0.164)),
    Case("glb_uv_u16", check=uv_range((0, 0), (1, 1))),
    Case("glb_texture_transform", check=uv_range((0, 0.75), (0.25, 1))),
    Case("glb_quantized", check=extent(0.1, 0.08, 0.06)),
    Case("mtl_scale", check=uv_range((0.5, 0), (3.5, 3))),
    Case("mtl_map_ka_only", GREY, ("ignored: map_Ka",)),
    Case("mtl_not_used", GREY, ("triangles without a material, the default is used", NO_UV)),
    Case("obj_uv_no_material", GREY, (NO_UV,)),
    Case("mtl_absent", GREY, ("there is no material library 'part.mtl', the default material is used",)),
    Case("mtl_unused_missing_texture", said=("the image 'gone.png' of an unused material is missing",)),
    Case("ply_vertex_colour", check=lambda entry: [230, 120, 20] in texels(entry).tolist()),
    Case("ply_face_colour", check=lambda entry: len(texels(entry)) >= 2),
    Case("obj_two_materials_tiled", check=shows_both_textures),
    Case("obj_utf16", GREY, check=extent(0.1, 0.08, 0.06)),
    Case("obj_off_origin", GREY, ("centred: moved by -0.4, -0.1, -0.2 m",), is_centred, center=True),
    Case("obj_sheet_1mm", GREY, check=extent(0.1, 0.08, 0.001)),
)


@pytest.mark.parametrize("case", MESHES, ids=lambda case: case.name)
def test_meshes(tmp_path, case):
    lines: list[str] = []
    catalog = load_catalog(Config(bake=Bake(models=str(case.folder)), objects=Objects(center=case.center)), tmp_path, heard(lines))
    (entry,) = catalog.entries
    assert entry.material.color == pytest.approx(case.color or (1.0, 1.0, 1.0), abs=0.003)
    assert (entry.material.texture is None) == (case.color is not None)
    assert case.check(entry)
    # A box: six normals, whether its file has any or not.
    assert len(np.unique(entry.mesh.normals.round(4), axis=0)) == 6
    assert len(lines) == bool(case.said)
    assert all(words in lines[0] for words in case.said)


def test_every_mesh_has_a_row():
    assert {case.name for case in MESHES} | {"mtl_backslash"} == {path.name for path in (CASES / "meshes").iterdir()}
