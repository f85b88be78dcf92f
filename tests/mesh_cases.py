"""What is right for the inputs of users that are meshes, parts, models_info.json and TOML."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import CatalogEntry
from tests.worlds.model_files import load_models


def _one_part(sides: tuple[float, ...], turns: int = 0, said: str = "", **objects) -> Callable[[Path, Path], None]:
    """One object of these sides [m], with a number of continuous symmetries, and a line that ends so; empty: none."""

    def check(case: Path, out: Path) -> None:
        catalog, lines = load_models(case, out, **objects)
        (entry,) = catalog.entries
        assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx(sides, rel=1e-5)
        assert len(entry.symmetries_continuous) == turns
        assert sum(line.endswith(said) for line in lines if said) == bool(said), lines

    return check


def _has_one_world(case: Path, out: Path) -> None:
    assert load_config(str(case)).bake.worlds == 1


def _is_refused_with_a_line(case: Path, out: Path) -> None:
    """Whatever an earlier bake left in the cache, an object whose decomposition takes too long has no other shape instead."""
    (out / "models").mkdir()
    trimesh.creation.torus(40.0, 10.0).export(out / "models" / "ring.ply")
    config = load_config(str(case))
    config = replace(config, bake=replace(config.bake, models=str(out / "models")))
    for _ in range(2):
        with pytest.raises(CatalogError, match=r"ring: .* took longer than 0\.2 s of processor time .*; decimate"):
            load_catalog(config, out / "cache", lambda line: None)
        assert not (out / "cache").exists()


GREY, ORANGE = (0.7, 0.7, 0.7), (0.962, 0.588, 0.237)
"""ORANGE: sRGB of the linear colour 60000, 20000, 3000 of 65535."""
TILED = Path(__file__).parent / "cases" / "meshes" / "obj_two_materials_tiled"


def _mesh(
    color: tuple[float, ...] | None = None, *said: str, check: Callable[[CatalogEntry], bool] = lambda entry: True, center: bool = False
) -> Callable[[Path, Path], None]:
    """The box of a folder with a colour (None: white, with a texture), and one line with these words; none: there is no line."""

    def run(case: Path, out: Path) -> None:
        catalog, lines = load_models(case, out, center=center)
        (entry,) = catalog.entries
        assert entry.material.color == pytest.approx(color or (1.0, 1.0, 1.0), abs=0.003)
        assert (entry.material.texture is None) == (color is not None)
        assert check(entry)
        # Six normals, whether its file has any or not.
        assert len(np.unique(entry.mesh.normals.round(4), axis=0)) == 6
        assert len(lines) == bool(said)
        assert all(words in lines[0] for words in said)

    return run


def _uv_range(low: tuple[float, float], high: tuple[float, float]) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose((entry.mesh.uv.min(axis=0), entry.mesh.uv.max(axis=0)), (low, high), atol=1e-4)


def _extent(*sides: float) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose(np.ptp(entry.mesh.vertices, axis=0), sides, atol=1e-4)


def _texels(entry: CatalogEntry) -> np.ndarray:
    assert entry.material.texture is not None
    return np.unique(entry.material.texture.reshape(-1, 3), axis=0)


def _shows_both_textures(entry: CatalogEntry) -> bool:
    images = [decode_texture((TILED / name).read_bytes(), name) for name in ("tex.png", "tex2.png")]
    wanted = np.unique(np.concatenate([image.reshape(-1, 3) for image in images]), axis=0)
    atlas = entry.material.texture
    assert atlas is not None
    tiled = any(np.array_equal(atlas[:rows, :columns], np.tile(image, (3, 3, 1))) for image in images for rows, columns in [(192, 192)])
    return tiled and {tuple(color) for color in wanted.tolist()} <= {tuple(color) for color in _texels(entry).tolist()}


def _is_centred(entry: CatalogEntry) -> bool:
    return bool(np.abs(entry.mesh.vertices.min(axis=0) + entry.mesh.vertices.max(axis=0)).max() < 1e-6)


NO_UV = "ignored: texture coordinates without a texture"
SIDES = (0.04, 0.03, 0.02)
ROWS = {
    "cells/decomposition_limit.toml": _is_refused_with_a_line,
    "meshes/glb_plain": _mesh(check=_uv_range((0, 0), (1, 1))),
    "meshes/glb_colour_f32": _mesh(ORANGE),
    "meshes/glb_colour_u16_rgba": _mesh(ORANGE),
    "meshes/glb_colour_f32_factor": _mesh((0.707, 0.427, 0.164)),
    "meshes/glb_uv_u16": _mesh(check=_uv_range((0, 0), (1, 1))),
    "meshes/glb_texture_transform": _mesh(check=_uv_range((0, 0.75), (0.25, 1))),
    "meshes/glb_quantized": _mesh(check=_extent(0.1, 0.08, 0.06)),
    "meshes/mtl_backslash": _mesh(None, r"refers to '.\\tex.png'; "),
    "meshes/mtl_scale": _mesh(check=_uv_range((0.5, 0), (3.5, 3))),
    "meshes/mtl_map_ka_only": _mesh(GREY, "ignored: map_Ka"),
    "meshes/mtl_not_used": _mesh(GREY, "triangles without a material, the default is used", NO_UV),
    "meshes/obj_uv_no_material": _mesh(GREY, NO_UV),
    "meshes/mtl_absent": _mesh(GREY, "there is no material library 'part.mtl', the default material is used"),
    "meshes/mtl_unused_missing_texture": _mesh(None, "the image 'gone.png' of an unused material is missing"),
    "meshes/ply_vertex_colour": _mesh(check=lambda entry: [230, 120, 20] in _texels(entry).tolist()),
    "meshes/ply_face_colour": _mesh(check=lambda entry: len(_texels(entry)) >= 2),
    "meshes/obj_two_materials_tiled": _mesh(check=_shows_both_textures),
    "meshes/obj_utf16": _mesh(GREY, check=_extent(0.1, 0.08, 0.06)),
    "meshes/obj_off_origin": _mesh(GREY, "centred: moved by -0.4, -0.1, -0.2 m", check=_is_centred, center=True),
    "meshes/obj_sheet_1mm": _mesh(GREY, check=_extent(0.1, 0.08, 0.001)),
    "parts/gltf_skin": _one_part(SIDES),
    "parts/models_info_padded_key": _one_part((0.03, 0.03, 0.05), 1),
    "parts/other_formats_silent": _one_part(
        SIDES, said=": of a format that is not read: a.3mf, b.usd, c.dae, d.fbx; save them as PLY, OBJ, glTF, STL or STEP files", unit="mm"
    ),
    "parts/stl_count_zero": _one_part(
        SIDES, said="its header announces 0 triangles, its body holds 12: 12 are read; 40 x 30 x 20 mm, unit mm", unit="mm"
    ),
    "settings/bom.toml": _has_one_world,
}
