"""Clear coats, anisotropy and emission of glTF: factors, textures, coordinates, parts."""

from typing import Any

import numpy as np
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.assets.gltf.finish import brush_coordinates
from synpick_warp.scenes.types import PLAIN, Finish
from tests.scenes.test_gltf import COLORS, TEXTURE, UV, Builder, pbr
from tests.worlds.model_files import texels


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
    mixed = finished({}, BRUSHED)
    joined, found, said = mixed.beside({**mixed.content["materials"][0], **pbr(**other)}, 2.0, 1.0).read(tmp_path)
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
    larger = {"extensions": {"KHR_materials_clearcoat": {"clearcoatFactor": 1.0}}}
    _, found, said = finished(COAT, {}).beside(larger, 1.0, 2.0).read(tmp_path)
    assert found.finish == Finish(1.0)
    assert said == ["ignored: clearcoat and anisotropy but for those of the largest part"]


def test_vertex_colours_leave_no_direction(tmp_path):
    colors = np.random.default_rng(0).random((4, 3)).astype(np.float32)
    _, found, said = finished(COAT, BRUSHED).attribute("COLOR_0", colors).read(tmp_path)
    assert found.finish == Finish(0.5, 0.25)
    assert said == ["ignored: anisotropy beneath vertex colours"]


# ---- emission ----


def shining(strength: float = 1.0, **more: Any) -> Builder:
    named = {"KHR_materials_emissive_strength": {"emissiveStrength": strength}}
    return Builder(emissiveFactor=[1.0, 0.5, 0.0], extensions=named, **more).with_(extensionsUsed=list(named))


def test_emission_is_factor_times_strength_times_texture(tmp_path):
    _, finish, said = shining(4.0).read(tmp_path)
    assert finish.complete(0.0, 0.5).emission == (4.0, 2.0, 0.0)
    assert finish.complete(0.0, 0.5).glow is None
    _, finish, more = shining(4.0, emissiveTexture={"index": 0}).image().attribute("TEXCOORD_0", UV).read(tmp_path)
    made = finish.complete(0.0, 0.5)
    assert made.emission == (4.0, 2.0, 0.0)
    for row, column in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        np.testing.assert_array_equal(made.glow[row, column], COLORS[row, column])
    assert not said + more


def test_an_emission_texture_that_is_not_used_leaves_no_emission(tmp_path):
    _, finish, said = shining(emissiveTexture={"index": 0}).image().read(tmp_path)
    assert finish.complete(0.0, 0.5).emission == (0.0, 0.0, 0.0)
    assert said == ["ignored: maps without texture coordinates"]
    other = shining(emissiveTexture={"index": 0, "texCoord": 1}, **pbr(**TEXTURE)).image().attribute("TEXCOORD_0", UV)
    _, finish, said = other.read(tmp_path)
    assert finish.complete(0.0, 0.5).emission == (0.0, 0.0, 0.0)
    assert said == ["ignored: emissiveTexture with other texture coordinates"]


def test_parts_keep_their_emission(tmp_path):
    """A lamp beside a part that emits nothing: an emission texture tells them apart."""
    mesh, finish, said = shining(2.0).beside({}).read(tmp_path)
    made = finish.complete(0.0, 0.5)
    light = srgb_to_linear(texels(mesh, made.glow) / 255.0) * made.emission
    shines = light[:, 0] > 1.0
    assert shines.sum() == len(mesh.uv) // 2
    np.testing.assert_allclose(light[shines], np.broadcast_to([2.0, 1.0, 0.0], (shines.sum(), 3)), atol=0.01)
    np.testing.assert_array_equal(light[~shines], 0.0)
    assert not said


def test_a_part_too_faint_beside_another_is_named(tmp_path):
    mixed = shining(1e4).beside({"emissiveFactor": [1.0, 1.0, 1.0]})
    assert mixed.read(tmp_path)[2] == ["ignored: emission of less than 1/6,500 of an object's brightest part"]


@pytest.mark.parametrize(
    ("builder", "said"),
    [
        (finished({"clearcoatFactor": 1.5}, {}), "clearcoatFactor is 1.5; allowed: 0 to 1; correct the material"),
        (finished({"clearcoatRoughnessFactor": -1}, {}), "clearcoatRoughnessFactor is -1; allowed: 0 to 1; correct the material"),
        (finished({}, {"anisotropyStrength": 2}), "anisotropyStrength is 2; allowed: 0 to 1; correct the material"),
        (finished({}, {"anisotropyRotation": 1e9}), "anisotropyRotation is 1e[+]09; allowed: up to 10000; correct the material"),
        (finished({"clearcoatFactor": "much"}, {}), "damaged: expected float, got str"),
        (finished({}, {"anisotropyStrength": [1]}), "damaged: expected float, got array"),
        (finished([], {}), "damaged: expected object, got array"),
        (shining(-1.0), "emissiveStrength is -1; allowed: 0 to 10000; correct the material"),
        (Builder(emissiveFactor=[0.0, 2.0, 0.0]), "emissiveFactor is 2; allowed: 0 to 1; correct the material"),
    ],
)
def test_a_finish_or_an_emission_that_cannot_be_is_refused(tmp_path, builder, said):
    with pytest.raises(CatalogError, match=said) as error:
        builder.read(tmp_path)
    assert "\n" not in str(error.value)
