"""Alpha masks: areas that are cut out of triangles are those of the mask, and what is left is what it was."""

import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from synpick_warp.scenes.assets import alpha_masks
from synpick_warp.scenes.assets.alpha_masks import CLAMP, MAX_TRIANGLES, MIRROR, cut_mask
from synpick_warp.scenes.assets.appearance import NO_MATERIAL
from synpick_warp.scenes.assets.mesh_parts import MeshPart
from tests.scenes.test_gltf import UV, Builder

REPEAT = 10497
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
QUAD = MeshPart(SQUARE, np.array([[0, 1, 2], [0, 2, 3]]), np.tile([0.0, 0.0, 1.0], (4, 1)), SQUARE[:, :2], None, NO_MATERIAL)
"""A square whose texture coordinates are x and y."""


def disc(size: int, radius: float) -> np.ndarray:
    """Alpha of a soft disc about the middle, 127.5 at the radius [widths]."""
    at = (np.indices((size, size)) + 0.5) / size - 0.5
    return np.clip(127.5 + 255.0 * (radius - np.hypot(*at)) * size / 2.0, 0, 255).astype(np.uint8)


def areas(part: MeshPart) -> np.ndarray:
    corners = part.vertices[part.faces]
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2.0


def cut(part: MeshPart, alpha: np.ndarray, *modes: int, threshold: float = 127.5) -> MeshPart:
    found = cut_mask(part, alpha, threshold, modes if modes else (REPEAT, REPEAT))
    assert found is not None
    return found


@pytest.mark.parametrize("size", [16, 64])
def test_a_disc_is_cut_with_the_accuracy_of_a_fraction_of_a_texel(size):
    part = cut(QUAD, disc(size, 0.35))
    assert areas(part).sum() == pytest.approx(np.pi * 0.35**2, rel=0.02)
    used = part.vertices[np.unique(part.faces)]
    radii = np.hypot(*(used[:, :2] - 0.5).T)
    assert radii.max() == pytest.approx(0.35, abs=0.3 / size)
    np.testing.assert_allclose(part.vertices[:, :2], part.uv, atol=1e-12)
    np.testing.assert_array_equal(part.normals[:, :2], 0.0)


def test_triangles_keep_their_side_and_share_vertices():
    part = cut(QUAD, disc(32, 0.3))
    corners = part.vertices[part.faces]
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2] > 0.0).all()
    used = np.unique(part.faces)
    assert len(np.unique(part.vertices[used].round(9), axis=0)) == len(used)


def test_what_is_opaque_stays_and_what_is_clear_goes():
    whole, none = (np.full((4, 4), value, np.uint8) for value in (255, 0))
    np.testing.assert_array_equal(cut(QUAD, whole).faces, QUAD.faces)
    assert not len(cut(QUAD, none).faces)


@pytest.mark.parametrize(("modes", "share"), [((REPEAT, REPEAT), 0.5), ((CLAMP, CLAMP), 0.25), ((MIRROR, MIRROR), 0.5)])
def test_wrap_modes_hold(modes, share):
    """The left half of an image is opaque: repeated twice; only the first of two and ever after; and mirrored."""
    alpha = np.zeros((64, 64), np.uint8)
    alpha[:, :32] = 255
    part = cut(replace(QUAD, uv=QUAD.uv * 2.0), alpha, *modes)
    assert areas(part).sum() == pytest.approx(share, abs=0.01)
    opaque = (part.vertices[part.faces].mean(axis=1)[:, 0] * areas(part)).sum() / areas(part).sum()
    assert opaque == pytest.approx({REPEAT: 0.375, CLAMP: 0.125, MIRROR: 0.5}[modes[0]], abs=0.02)


def test_too_many_triangles_halve_the_mask(monkeypatch):
    fine = cut(QUAD, disc(256, 0.35))
    coarse = cut_mask(QUAD, disc(256, 0.35), 127.5, (REPEAT, REPEAT), 1500)
    assert coarse is not None
    assert len(coarse.faces) <= 1500 + len(QUAD.faces) < len(fine.faces)
    assert areas(coarse).sum() == pytest.approx(areas(fine).sum(), rel=0.03)
    monkeypatch.setattr(alpha_masks, "MAX_TEXELS", 100)
    assert cut_mask(QUAD, disc(256, 0.35), 127.5, (REPEAT, REPEAT)) is None


@pytest.mark.parametrize("far", [1e4, np.nan])
def test_vertices_that_no_triangle_uses_count_for_nothing(far):
    more = replace(
        QUAD,
        **{
            name: np.vstack([getattr(QUAD, name), np.full(3, far)[: getattr(QUAD, name).shape[1]]])
            for name in ("vertices", "normals", "uv")
        },
    )
    assert areas(cut(more, disc(64, 0.35))).sum() == areas(cut(QUAD, disc(64, 0.35))).sum()
    empty = replace(more, faces=more.faces[:0])
    assert cut(empty, disc(64, 0.35)) is empty


def masked(alpha: np.ndarray | None, factor: float = 1.0, cutoff: float = 0.5) -> Builder:
    """The tetrahedron with an alpha mask, by an image of this alpha."""
    base = {"baseColorFactor": [1.0, 1.0, 1.0, factor]} | ({} if alpha is None else {"baseColorTexture": {"index": 0}})
    builder = Builder(pbrMetallicRoughness=base, alphaMode="MASK", alphaCutoff=cutoff)
    if alpha is None:
        return builder
    file = io.BytesIO()
    Image.fromarray(np.dstack([np.full((*alpha.shape, 3), 200, np.uint8), alpha])).save(file, "png")
    builder.with_(images=[{"bufferView": builder.view(file.getvalue()), "mimeType": "image/png"}], textures=[{"source": 0}])
    return builder.attribute("TEXCOORD_0", UV)


def test_masks_of_gltf_are_cut(tmp_path):
    """Left columns of the image are clear: there u is small. What is left has the image's colours."""
    alpha = np.full((32, 32), 255, np.uint8)
    alpha[:, :8] = 0
    mesh, finish, said = masked(alpha).wrap(CLAMP, CLAMP).read(tmp_path)
    assert not said
    assert mesh.uv[:, 0].min() == pytest.approx(0.25, abs=0.02)
    assert (finish.texture == 200).all()
    whole, _, _ = masked(np.full((32, 32), 255, np.uint8)).read(tmp_path)
    assert len(whole.faces) == 4 < len(mesh.faces)


def test_the_factor_counts_and_the_cutoff_decides(tmp_path):
    alpha = np.full((8, 8), 200, np.uint8)
    assert len(masked(alpha, 0.5, 0.39).read(tmp_path)[0].faces) == 4
    assert len(masked(None, 0.5).read(tmp_path)[0].faces) == 4


def test_nodes_share_what_is_cut_once(tmp_path, monkeypatch):
    alpha = disc(256, 0.35)
    twice = masked(alpha).with_(nodes=[{"mesh": 0}, {"mesh": 0, "translation": [3.0, 0.0, 0.0]}], scenes=[{"nodes": [0, 1]}])
    cuts = []
    monkeypatch.setattr(alpha_masks, "cut_mask", lambda *given: cuts.append(given[-1]) or cut_mask(*given))
    assert len(twice.read(tmp_path)[0].faces) == 2 * len(masked(alpha).read(tmp_path)[0].faces)
    assert cuts == [MAX_TRIANGLES // 2, MAX_TRIANGLES]


def test_vertex_colors_of_a_cut_part_are_named(tmp_path):
    """They would be baked with the few texels of its small triangles."""
    colors = np.array([[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, 255], [255, 255, 0, 255]], np.uint8)
    mesh, finish, said = masked(disc(32, 0.2)).attribute("COLOR_0", colors, normalized=True).read(tmp_path)
    assert ["vertex colours" in line for line in said] == [True]
    assert len(mesh.faces) > 4
    assert finish.texture.shape == (32, 32, 3)
