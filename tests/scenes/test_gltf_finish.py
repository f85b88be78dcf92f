"""Clear coats and anisotropy of glTF: factors, means of textures, coordinates, parts."""

from typing import Any

import numpy as np
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.gltf.finish import brush_coordinates
from synpick_warp.scenes.types import PLAIN, Finish
from tests.scenes.test_gltf import COLORS, TEXTURE, UV, Builder, pbr


def finished(coat: dict[str, Any], brushed: dict[str, Any], **more: Any) -> Builder:
    named = {"KHR_materials_clearcoat": coat, "KHR_materials_anisotropy": brushed}
    return Builder(extensions=named, **more).with_(extensionsUsed=list(named))


COAT = {"clearcoatFactor": 0.5, "clearcoatRoughnessFactor": 0.25}
BRUSHED = {"anisotropyStrength": 0.75, "anisotropyRotation": 1.5}


def test_finish_is_that_of_both_extensions(tmp_path):
    _, found, said = finished(COAT, BRUSHED).read(tmp_path)
    assert found.complete(0.0, 0.5).finish == Finish(0.5, 0.25, 0.75, 1.5)
    assert not said
    none = finished({"clearcoatFactor": 0, "clearcoatRoughnessFactor": 1}, {"anisotropyStrength": 0, "anisotropyRotation": 1})
    assert none.read(tmp_path)[1].finish == PLAIN
    assert finished({}, {}).read(tmp_path)[1].finish == PLAIN


def test_textures_count_by_their_means(tmp_path):
    coat = COAT | {name: {"index": 0} for name in ("clearcoatTexture", "clearcoatRoughnessTexture", "clearcoatNormalTexture")}
    _, found, said = finished(coat, BRUSHED | {"anisotropyTexture": {"index": 0}}).image().read(tmp_path)
    red, green, blue = COLORS.reshape(-1, 3).mean(axis=0) / 255.0
    expected = Finish(0.5 * red, 0.25 * green, 0.75 * blue, 1.5 + np.arctan2(green - 0.5, red - 0.5))
    assert vars(found.finish) == pytest.approx(vars(expected))
    whats = "clearcoat but for its mean", "clearcoat roughness but for its mean"
    last = "the normal map of clearcoat, the texture of anisotropy but for its mean"
    assert said == [f"ignored: {', '.join(f'the texture of {what}' for what in whats)}, {last}"]


def directions(mesh) -> np.ndarray:
    """Unit tangents of the triangles (F, 3): u increases along them and v is constant. Zero where u is constant."""
    (edge, other), (b, c) = (np.moveaxis(np.diff(each[mesh.faces], axis=1), 1, 0) for each in (mesh.vertices, mesh.uv))
    along = np.sign(b[:, :1] * c[:, 1:] - b[:, 1:] * c[:, :1]) * (c[:, 1:] * edge - b[:, 1:] * other)
    return along / np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-9)


@pytest.mark.parametrize("other", [{"baseColorFactor": [0.1, 0.1, 0.1, 1.0]}, {"metallicFactor": 0.0}])
def test_a_part_in_an_atlas_keeps_its_directions(tmp_path, other):
    """Parts that differ in colour or in metalness are joined by a texture atlas, which replaces texture coordinates."""
    alone = finished({}, BRUSHED).read(tmp_path)[0]
    mixed = finished({}, BRUSHED).with_(nodes=[{"mesh": 0, "scale": [2, 2, 2]}, {"mesh": 1}], scenes=[{"nodes": [0, 1]}])
    mixed.content["meshes"].append({"primitives": [{**mixed.primitive, "material": 1}]})
    mixed.content["materials"].append({**mixed.content["materials"][0], **pbr(**other)})
    joined, found, said = mixed.read(tmp_path)
    assert (found.finish.anisotropy, said) == (0.75, [])
    np.testing.assert_allclose(directions(joined), np.tile(directions(alone), (2, 1)), atol=1e-5)


def test_anisotropic_surfaces_keep_or_get_coordinates(tmp_path):
    assert not finished(COAT, {}).attribute("TEXCOORD_0", UV).read(tmp_path)[0].uv.any()
    mesh = finished({}, BRUSHED).attribute("TEXCOORD_0", UV).read(tmp_path)[0]
    textured = finished({}, BRUSHED, **pbr(**TEXTURE)).image().attribute("TEXCOORD_0", UV).read(tmp_path)[0]
    np.testing.assert_allclose(directions(mesh), directions(textured), atol=1e-6)
    assert np.ptp(finished({}, BRUSHED).read(tmp_path)[0].uv, axis=0).min() > 0.0
    # Generated coordinates: lines of constant v are horizontal on a vertical surface, and parallel to x on one that faces up.
    front, top = (
        np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 1.0], [0.0, 1.0, 1.0]]),
        np.array([[1.0, 0.0, 1.0], [2.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
    )
    for corners in (front, top):
        (u, v), (du, _), (_, dv) = brush_coordinates(corners, None)
        assert (brush_coordinates(corners, None)[1, 1] == v) & (du > u) & (dv > v)


def test_the_largest_part_has_the_finish_of_all(tmp_path):
    mixed = finished(COAT, {}).with_(nodes=[{"mesh": 0}, {"mesh": 1, "scale": [2, 2, 2]}], scenes=[{"nodes": [0, 1]}])
    mixed.content["meshes"].append({"primitives": [{**mixed.primitive, "material": 1}]})
    mixed.content["materials"].append({"extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0}}})
    _, found, said = mixed.read(tmp_path)
    assert found.finish == Finish(1.0)
    assert said == ["ignored: clearcoat and anisotropy but for those of the largest part"]


def test_vertex_colours_leave_no_direction(tmp_path):
    colors = np.random.default_rng(0).random((4, 3)).astype(np.float32)
    _, found, said = finished(COAT, BRUSHED).attribute("COLOR_0", colors).read(tmp_path)
    assert found.finish == Finish(0.5, 0.25)
    assert said == ["ignored: anisotropy beneath vertex colours"]


@pytest.mark.parametrize(
    ("coat", "brushed", "said"),
    [
        ({"clearcoatFactor": 1.5}, {}, "clearcoatFactor is 1.5; allowed: 0 to 1; correct the material"),
        (
            {"clearcoatFactor": 1, "clearcoatRoughnessFactor": -1},
            {},
            "clearcoatRoughnessFactor is -1; allowed: 0 to 1; correct the material",
        ),
        ({}, {"anisotropyStrength": 2}, "anisotropyStrength is 2; allowed: 0 to 1; correct the material"),
        ({}, {"anisotropyRotation": 1e9}, "anisotropyRotation is 1e[+]09; allowed: up to 10000; correct the material"),
        ({"clearcoatFactor": "much"}, {}, "damaged: expected float, got str"),
        ({}, {"anisotropyStrength": [1]}, "damaged: expected float, got array"),
        ([], {}, "damaged: expected object, got array"),
    ],
)
def test_a_finish_that_cannot_be_is_refused(tmp_path, coat, brushed, said):
    with pytest.raises(CatalogError, match=said) as error:
        finished(coat, brushed).read(tmp_path)
    assert "\n" not in str(error.value)
