"""Material maps and wear: normal maps shade like tilted vertex normals, constant maps like plain materials; wear covers its fraction."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.configs.episodes.randomize import Distribution, Randomize
from synpick_warp.configs.schema import UNOCCLUDED, Config, Render
from synpick_warp.kernels.render.lighting import wear
from synpick_warp.kernels.render.lighting.surfaces import ROUGHNESS_MASK, ROUGHNESS_SHIFT
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import MAP_CENTER, Material
from synpick_warp.stages.render.looks import make_noise
from synpick_warp.stages.render.scene import detail_levels, mip_levels
from tests.worlds.shapes import FLAT, camera, sheet, sun, surface
from tests.worlds.toy_scene import render_objects

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))
PLAIN = Config(render=Render(mode=UNOCCLUDED))
MIDDLE = (0, slice(15, 33), slice(18, 46))
SQUARE = sheet(0.4, 0.3)
TURNED = (*FLAT[:3], *Rotation.from_euler("z", 140.0, degrees=True).as_quat())


def mapped(x: float = 0.0, y: float = 0.0, roughness: float = 0.5, metallic: float = 0.0, size: tuple[int, int] = (4, 4)) -> Material:
    """White material of constant maps; x and y are those of the normal."""
    values = [x * (MAP_CENTER - 1) + MAP_CENTER, y * (MAP_CENTER - 1) + MAP_CENTER, 255 * roughness, 255 * metallic]
    maps = np.broadcast_to(np.rint(values).astype(np.uint8), (*size, 4))
    return replace(surface(texture=np.full((*size, 3), 255, np.uint8), roughness=1.0), maps=maps)


def radiance(device, mesh, material, pose=FLAT, looks=None):
    return render_objects(device, (mesh, material, pose), view=VIEW, config=PLAIN, lights=(sun((0.7, 0.5, 0.5)),), looks=looks).radiance[
        MIDDLE
    ]


@pytest.mark.parametrize(
    ("frame", "tilt"),
    [
        *(("plain", tilt) for tilt in ((64 / 127, 0.0), (0.0, -64 / 127))),
        *((frame, (-38 / 127, 51 / 127)) for frame in ("plain", "mirrored", "quarter turn", "turned body", "from behind")),
    ],
)
def test_a_normal_map_shades_like_normals_of_the_mesh(device, tilt, frame):
    """The map's x is the direction in which u grows, and y that of v, also where the texture is mirrored, turned or seen from behind."""
    uv, along, across = SQUARE.uv, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    if frame == "mirrored":
        uv, along = uv * (-1.0, 1.0), -along
    elif frame == "quarter turn":
        uv, along, across = np.stack([uv[:, 1], -uv[:, 0]], axis=1), across, -along
    up = np.array([0.0, 0.0, 1.0])
    faces = SQUARE.faces
    if frame == "from behind":
        # The front faces down, and the viewer sees the map's normal turned round: its tilt is the opposite one.
        faces, along, across = faces[:, ::-1], -along, -across
    normal = tilt[0] * along + tilt[1] * across + np.sqrt(1.0 - np.dot(tilt, tilt)) * up
    pose = TURNED if frame == "turned body" else FLAT
    flat = replace(SQUARE, uv=uv.astype(np.float32), faces=faces)
    tilted = replace(flat, normals=np.tile(normal, (4, 1)).astype(np.float32))
    expected = radiance(device, tilted, surface(roughness=64 / 127), pose)
    plain = radiance(device, flat, surface(roughness=64 / 127), pose)
    assert np.abs(expected - plain).max() > 0.02 * plain.max()
    np.testing.assert_allclose(
        radiance(device, flat, mapped(*tilt, roughness=64 / 127), pose), expected, rtol=0.02, atol=0.01 * plain.max()
    )


@pytest.mark.parametrize(("roughness", "metallic"), [(64 / 127, 0.0), (32 / 127, 1.0), (1.0, 1.0)])
def test_roughness_and_metallic_maps_shade_like_plain_materials(device, roughness, metallic):
    expected = radiance(device, SQUARE, surface(roughness=roughness, metallic=metallic))
    np.testing.assert_allclose(radiance(device, SQUARE, mapped(roughness=roughness, metallic=metallic)), expected, rtol=0.01)


def test_normals_below_a_texel_widen_its_roughness():
    """Normals tilted by ±20° average to the surface normal; the length of the mean, cos 20°, determines the variance."""
    x = round(np.sin(np.radians(20.0)) * 127)
    maps = np.zeros((8, 8, 4), np.uint8)
    maps[..., 0], maps[..., 1], maps[..., 2] = MAP_CENTER + x * np.where(np.arange(8) % 2, 1, -1), MAP_CENTER, 51
    levels = [level.astype(np.int64) >> int(ROUGHNESS_SHIFT) & int(ROUGHNESS_MASK) for level in detail_levels(maps)]
    assert [level.size for level in levels] == [64, 16, 4, 1]
    assert np.all(levels[0] == round(0.2 * 127))
    length = np.cos(np.arcsin(x / 127))
    widened = (0.2**4 + 2.0 * (1.0 - length**2) / (length * (3.0 - length**2))) ** 0.25
    assert all(np.all(np.abs(level - widened * 127) <= 1) for level in levels[1:])


@pytest.mark.parametrize("size", [(5, 7), (20, 4), (1, 9), (6, 1)])
def test_maps_of_any_size_have_the_mip_levels_of_their_texture(device, size):
    material = mapped(64 / 127, 0.0, size=size)
    assert [level.size for level in detail_levels(material.maps)] == [level.size // 3 for level in mip_levels(material.texture)]
    np.testing.assert_allclose(radiance(device, SQUARE, material), radiance(device, SQUARE, mapped(64 / 127, 0.0)), rtol=1e-3)


# ---- wear ----


@wp.kernel
def measure_wear_kernel(
    noise: wp.array3d[wp.uint32], place: wp.array[wp.vec3], kind: int, amount: float, footprint: float, out: wp.array[wp.vec3]
):
    index = wp.tid()
    amounts = wp.vec4(0.0, 0.0, 0.0, 0.0)
    amounts[kind] = amount
    found = wear.find_wear(noise, amounts, 7 * (index % 64), place[index], footprint)
    worn = wear.apply_wear(found, wp.vec3(0.5, 0.5, 0.5), 1.0, 0.3)
    out[index] = wp.vec3(worn.color[0], worn.metallic, worn.roughness)


def measure_wear(device, kind: int, amount: float, footprint: float = 0.0) -> np.ndarray:
    """Red, metallic and roughness (N, 3) of a grey metal at places that are drawn uniformly, in 64 patterns."""
    places = wp.array(np.random.default_rng(0).uniform(-1.0, 1.0, (50_000, 3)), dtype=wp.vec3, device=device)
    out = wp.zeros(len(places), dtype=wp.vec3, device=device)
    wp.launch(
        measure_wear_kernel, dim=len(places), inputs=[make_noise(device), places, kind, amount, footprint], outputs=[out], device=device
    )
    return out.numpy()


@pytest.mark.parametrize("coverage", [0.05, 0.3, 0.5, 0.9])
def test_rust_and_stains_cover_their_fraction_of_the_surface(device, coverage):
    assert 1.0 - measure_wear(device, 1, coverage)[:, 1].mean() == pytest.approx(coverage, rel=0.35, abs=0.01)
    assert 2.0 * (1.0 - measure_wear(device, 2, coverage)[:, 1].mean()) == pytest.approx(coverage, rel=0.35, abs=0.01)


def test_scratches_are_few_and_fade_into_a_wide_pixel(device):
    sharp, wide = (measure_wear(device, 0, 1.0, footprint)[:, 2] for footprint in (0.0, 0.2))
    assert 0.01 < (sharp > 0.45).mean() < 0.4
    assert (wide > 0.45).mean() < 0.05
    usual = measure_wear(device, 0, 1.0, 0.01)[:, 2]
    assert (usual.mean() - 0.3) / 0.3 == pytest.approx(float(wear.MEAN_SHARE[0]), rel=0.25)
    # Their light is kept in the mean, as far as they do not overlap.
    assert wide.mean() - 0.3 == pytest.approx(sharp.mean() - 0.3, rel=0.5)


def test_a_label_covers_its_rectangle_of_one_side_and_has_codes(device):
    metal = surface(color=(0.5, 0.5, 0.5), metallic=1.0, roughness=0.3)
    looks = Looks(Randomize(object_label=Distribution.parse(0.15)), (), ())

    def drawn(pose, **options):
        return render_objects(device, (SQUARE, metal, pose), view=VIEW, config=PLAIN, lights=(sun((0.7, 0.5, 0.5)),), **options).radiance[0]

    upside_down = (*FLAT[:3], 1.0, 0.0, 0.0, 0.0)
    sides = [(drawn(pose, looks=looks), drawn(pose)) for pose in (FLAT, upside_down)]
    labels = sorted((np.abs(with_label - plain).max(axis=2) > 0.0 for with_label, plain in sides), key=np.sum)
    # 100 px/m; it is turned a little, and nowhere else.
    assert [labels[0].sum(), labels[1].sum()] == [0, pytest.approx(15 * 9, abs=20)]
    print_of = next(with_label for with_label, plain in sides if not np.array_equal(with_label, plain))[labels[1]]
    assert print_of.std() > 0.1 * print_of.mean()


def test_each_object_wears_its_own_way_and_plastic_does_not_rust(device):
    def worn(material, **amounts):
        given = {name: Distribution.parse(amount) for name, amount in amounts.items()}
        return radiance(device, SQUARE, material, looks=Looks(Randomize(**given), (), ()))

    metal = surface(color=(0.5, 0.5, 0.5), metallic=1.0, roughness=0.3)
    plastic = replace(metal, metallic=0.0)
    assert np.abs(worn(metal, object_rust=0.5) - worn(metal)).max() > 0.1 * worn(metal).max()
    assert np.array_equal(worn(plastic, object_rust=0.5), worn(plastic))
    assert np.array_equal(worn(plastic, bin_dust=0.5), worn(plastic))
    assert not np.array_equal(worn(plastic, object_dust=0.5), worn(plastic))
