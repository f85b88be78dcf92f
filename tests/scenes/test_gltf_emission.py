"""Emission of glTF: factor, strength and texture, and the parts of an object that shine."""

from typing import Any

import numpy as np
import pytest

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from tests.scenes.test_gltf import COLORS, TEXTURE, UV, Builder, pbr


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
    mixed = shining(2.0).with_(nodes=[{"mesh": 0}, {"mesh": 1}], scenes=[{"nodes": [0, 1]}])
    mixed.content["meshes"].append({"primitives": [{**mixed.primitive, "material": 1}]})
    mixed.content["materials"].append({})
    mesh, finish, said = mixed.read(tmp_path)
    made = finish.complete(0.0, 0.5)
    column, row = (mesh.uv * (1.0, -1.0) + (0.0, 1.0)).T * np.array([[made.glow.shape[1]], [made.glow.shape[0]]])
    light = srgb_to_linear(made.glow[row.astype(int), column.astype(int)] / 255.0) * made.emission
    shines = light[:, 0] > 1.0
    assert shines.sum() == len(mesh.uv) // 2
    np.testing.assert_allclose(light[shines], np.broadcast_to([2.0, 1.0, 0.0], (shines.sum(), 3)), atol=0.01)
    np.testing.assert_array_equal(light[~shines], 0.0)
    assert not said


def test_a_part_too_faint_beside_another_is_named(tmp_path):
    mixed = shining(1e4).with_(nodes=[{"mesh": 0}, {"mesh": 1}], scenes=[{"nodes": [0, 1]}])
    mixed.content["meshes"].append({"primitives": [{**mixed.primitive, "material": 1}]})
    mixed.content["materials"].append({"emissiveFactor": [1.0, 1.0, 1.0]})
    assert mixed.read(tmp_path)[2] == ["ignored: emission of less than 1/6,500 of an object's brightest part"]


@pytest.mark.parametrize(
    ("builder", "said"),
    [
        (shining(-1.0), "emissiveStrength is -1; allowed: 0 to 10000; correct the material"),
        (Builder(emissiveFactor=[0.0, 2.0, 0.0]), "emissiveFactor is 2; allowed: 0 to 1; correct the material"),
    ],
)
def test_emission_that_cannot_be_is_refused(tmp_path, builder, said):
    with pytest.raises(CatalogError, match=said):
        builder.read(tmp_path)
