"""Shading and randomized looks: textures, exposure and tables of light; draws follow their distributions, records say what is shown."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
import scipy.stats
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Segment
from synpick_warp.configs.episodes.randomize import ColorDistribution, Distribution, Randomize
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import ConfigError
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.assets.appearance import linear_to_srgb, srgb_to_linear
from synpick_warp.scenes.environment import LUMINANCE, map_directions
from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import EnvironmentMap, Fixture
from synpick_warp.stages import launch
from synpick_warp.stages.render.light_tables import precompute_environment, prefilter_specular, sh_basis
from synpick_warp.stages.render.looks import add_lamps, black_body_color, draw_looks, load_scene_lights
from synpick_warp.stages.render.scene import mip_levels, uv_density
from synpick_warp.stages.render.view_setup import make_views
from tests.builders import STIRRING, bake_boxes
from tests.twins.layers import render_layers, surface_points
from tests.worlds.shapes import FLAT, GREY, HALF, UPRIGHT, ball, box, camera, entry, even_light, sheet, sun, surface
from tests.worlds.small_worlds import settings
from tests.worlds.toy_scene import ANNOTATIONS, ToyScene, assert_same, build_scene, render, render_objects, with_render

VIEW = camera(64, 48, 200.0, (0.0, 0.0, 2.0))


def shown(material, device, **more):
    return render_objects(device, (sheet(0.4, 0.3), material), view=VIEW, **more)


def test_fine_texture_is_averaged_in_linear_light(device):
    texture = np.zeros((512, 512, 3), np.uint8)
    texture[::2, ::2] = texture[1::2, 1::2] = 255
    picture = shown(surface(texture=texture), device)
    plain = shown(surface(color=HALF), device)
    middle = (0, slice(15, 33), slice(18, 46))
    np.testing.assert_allclose(picture.radiance[middle], plain.radiance[middle], rtol=0.01)


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (5, 3)])
def test_textures_of_any_size_render(device, size):
    # Red from left to right, as far as there are columns; green throughout.
    texture = np.zeros((*size, 3), np.uint8)
    texture[..., 0], texture[..., 1] = np.linspace(40, 200, size[1]), 120
    shown_rows = shown(surface(texture=texture), device).radiance[0, 12:36, 14:50]
    # Light is sampled without the surface's colour: its noise is the same on both.
    plain = shown(surface(color=(0.0, 120 / 255, 0.0)), device).radiance[0, 12:36, 14:50]
    # Texels are rounded to 10 bits of the square root.
    np.testing.assert_allclose(shown_rows[..., 1], plain[..., 1], rtol=2.5e-3)
    # Both colours have the same noise except for the specular part: some per cent of the light, to some per cent.
    ratio = shown_rows[..., 0] / shown_rows[..., 1]
    assert (np.ptp(ratio, axis=0) < 5e-3).all()
    assert (np.ptp(ratio) > 0.1) == (size[1] > 1)
    finest = mip_levels(texture)
    assert finest[0].shape[:2] == size
    assert finest[-1].shape[:2] == (1, 1)


def test_mip_levels_keep_the_mean_also_for_odd_sizes():
    texture = np.random.default_rng(0).integers(0, 256, (37, 50, 3), dtype=np.uint8)
    levels = mip_levels(texture)
    assert [level.shape[:2] for level in levels] == [(37, 50), (18, 25), (9, 12), (4, 6), (2, 3), (1, 1)]
    mean = srgb_to_linear(texture / 255.0).mean(axis=(0, 1))
    np.testing.assert_allclose(srgb_to_linear(levels[-1][0, 0] / 255.0), mean, atol=0.03)


def test_texture_density_is_texture_lengths_per_metre():
    np.testing.assert_allclose(uv_density(sheet(0.5, 0.5)), 2.0, rtol=1e-6)
    assert not uv_density(ball(0.1, 1)).any()


def test_exposure_depends_on_the_setting_and_not_on_the_maps_scale(device):
    dim, bright = (shown(GREY, device, lights=(even_light(s),)).color for s in (0.01, 100.0))
    assert np.abs(dim.astype(int) - bright).max() <= 1
    more = shown(GREY, device, config=with_render(exposure=1.5)).color
    assert (more.astype(int) - dim)[0, 24, 32].min() > 10


def test_denoised_plane_shows_no_sampling_pattern(device):
    # Wide filter kernels make a plane beside a wall smooth: the remaining noise has no edges. Two steps of 255 are hardly visible.
    toy = ToyScene([entry(sheet(1.0, 1.0)), entry(box(0.01, 2.0, 0.2))], [[(0, FLAT), (1, (0.25, 0.0, 0.1, *UPRIGHT))]], (VIEW,))
    toy.config = with_render(coarse_paths=8)
    lit = render(toy, device).radiance[0, 8:40, 8:40, 0]
    assert np.abs(np.diff(lit, axis=0)).max() < 2.0 / 255.0


def test_rendering_does_not_depend_on_the_number_of_threads(device, monkeypatch):
    toy = ToyScene([entry(sheet(0.6, 0.4)), entry(sheet(0.08, 0.08))], [[(0, FLAT), (1, (0.0, 0.0, 0.1, *UPRIGHT))]], (VIEW,))
    toy.lights, toy.config = (sun((1.0, 0.5, 1.0)),), with_render(coarse_paths=32)
    monkeypatch.setattr(launch, "_cores", lambda: 1)
    one = render(toy, device)
    monkeypatch.setattr(launch, "_cores", lambda: 2)
    monkeypatch.setattr(launch, "CPU_PIECE_PIXELS", 256)
    two = render(toy, device)
    assert_same(one, two, "color", *ANNOTATIONS)


@pytest.mark.parametrize("slope", [0.0, 1.0])
def test_sh_irradiance_of_a_gradient(slope):
    """Of radiance 1 + s z: E(n) = π + s 2π/3 n_z."""
    directions, _ = map_directions(64)
    radiance = np.repeat((1.0 + slope * directions[..., 2:]).astype(np.float32), 3, axis=2)
    normals = np.random.default_rng(0).normal(size=(20, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = sh_basis(normals) @ precompute_environment(EnvironmentMap("gradient", radiance), None).irradiance
    np.testing.assert_allclose(found, np.repeat(np.pi + slope * 2 * np.pi / 3 * normals[:, 2:], 3, axis=1), rtol=2e-3)


def test_prefiltered_maps_of_a_uniform_map_and_a_spot():
    np.testing.assert_allclose(prefilter_specular(np.full((16, 32, 3), 0.7)), 0.7, rtol=1e-6)
    spot = np.zeros((16, 32, 3))
    spot[5, 20] = 1.0
    filtered = prefilter_specular(spot)[..., 0]
    assert all(np.unravel_index(level.argmax(), level.shape)[1] == 20 for level in filtered)
    assert np.unravel_index(filtered[0].argmax(), filtered[0].shape) == (5, 20)
    assert (np.diff(filtered.max(axis=(1, 2))) < 0.0).all()


def test_a_batch_larger_than_the_scratch_is_refused(device):
    toy = ToyScene([entry(sheet(0.1, 0.1))], [[(0, FLAT)]], (VIEW,))
    scene = build_scene(toy, device)
    renderer = make_renderer(toy.settings(), scene, toy.instances, 1)
    views = make_views(None, None, 2, toy.instances)
    with pytest.raises(ValueError, match="2 views in a batch; this renderer has scratch for 1"):
        renderer.render(None, views, None)


# ---- randomized looks ----


DRAWS = 1000
WIDE = camera(160, 90, 200.0, (0.0, 0.0, 2.0))
ORANGE = (0.9, 0.5, 0.1)


def looks(textures: tuple[np.ndarray, ...] = (), **given: object) -> Looks:
    """Looks of settings as in TOML; `textures` for bin and table."""
    kinds = {name: ColorDistribution if name.endswith("color") else Distribution for name in given}
    randomize = Randomize(**{name: kinds[name].parse(value) for name, value in given.items()})
    return Looks(randomize, textures, textures)


def scene(drawn: Looks) -> ToyScene:
    """Two orange boxes beside each other in a flat bin, on a table."""
    placed = [[(0, (x, 0.0, 0.3, *UPRIGHT)) for x in (-0.2, 0.2)]]
    fixtures = (Fixture(box(0.8, 0.4, 0.1), surface(ORANGE)), *ToyScene([], [], ()).fixtures[1:])
    orange = entry(box(0.1, 0.1, 0.1), surface(ORANGE))
    more = {"fixtures": fixtures, "fixtures_visible": (1, 0, 0), "fixture_poses": (FLAT,) * 3, "table": True}
    return ToyScene([orange], placed, (WIDE,), looks=drawn, **more)


# ---- draws ----


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ({"uniform": [-30, 60]}, scipy.stats.uniform(-30, 90)),
        ({"log_uniform": [0.5, 8.0]}, scipy.stats.loguniform(0.5, 8.0)),
        ({"normal": [1.0, 0.1]}, scipy.stats.norm(1.0, 0.1)),
    ],
)
def test_draws_follow_their_distribution(value, expected):
    name = "object_hue" if "uniform" in value else "object_brightness"
    drawn = [row[name.removeprefix("object_")] for row in draw_looks(looks(**{name: value}), 1, 2, DRAWS)["objects"]]
    assert scipy.stats.kstest(drawn, expected.cdf).pvalue > 1e-3
    assert len(set(drawn)) > 0.99 * DRAWS


def test_choices_are_drawn_by_their_weights():
    given = looks(object_roughness={"choice": [0.1, 0.5, 0.9], "weights": [1, 0, 3]}, object_metallic={"choice": [0.0, 1.0]})
    rows = draw_looks(given, 1, 2, DRAWS)["objects"]
    counts = [sum(row["roughness"] == value for row in rows) for value in (0.1, 0.5, 0.9)]
    assert counts[1] == 0
    assert abs(counts[0] - DRAWS / 4) < 4 * np.sqrt(DRAWS * 3 / 16)
    assert abs(sum(row["metallic"] for row in rows) - DRAWS / 2) < 4 * np.sqrt(DRAWS / 4)


def test_normal_draws_are_clamped_and_values_are_fixed():
    rows = draw_looks(looks(object_roughness={"normal": [1.0, 0.3]}, object_metallic=0.25), 1, 2, DRAWS)["objects"]
    assert max(row["roughness"] for row in rows) == 1.0
    assert {row["metallic"] for row in rows} == {0.25}


def test_a_draw_depends_on_seed_episode_and_object_alone():
    given = looks(object_hue={"uniform": [-180, 180]}, bin_color={"uniform": [[0, 0, 0], [1, 1, 1]]})
    one = draw_looks(given, 1, 2, 3)
    assert draw_looks(given, 1, 2, 8)["objects"][:3] == one["objects"]
    others = [draw_looks(given, 1, 3, 3), draw_looks(given, 2, 2, 3)]
    hues = [row["hue"] for drawn in (one, *others) for row in drawn["objects"]]
    assert len(set(hues)) == 9
    assert len({tuple(drawn["bin"]["color"]) for drawn in (one, *others)}) == 3
    assert one["table"] == {}


# ---- pictures ----


def test_albedo_is_that_of_the_record(device):
    given = looks(
        object_hue={"uniform": [-180, 180]},
        object_brightness={"log_uniform": [0.5, 2.0]},
        bin_color={"uniform": [[0, 0, 0], [1, 1, 1]]},
        table_color={"choice": [[0.2, 0.4, 0.6]]},
    )
    rendered = render_layers(scene(given), device, names=("albedo",))
    record = draw_looks(given, 0, 0, 2)
    expected = {Segment.TOTE: record["bin"]["color"], Segment.TABLE: (0.2, 0.4, 0.6)}
    for instance, row in enumerate(record["objects"]):
        turn = Rotation.from_rotvec(np.radians(row["hue"]) * np.ones(3) / np.sqrt(3.0))
        expected[1 + instance] = linear_to_srgb(row["brightness"] * turn.apply(srgb_to_linear(ORANGE)))
    for segment, color in expected.items():
        pixels = rendered["albedo"][0][rendered.segment[0] == segment].astype(int)
        assert len(pixels) > 20
        assert np.abs(pixels - np.rint(255.0 * np.asarray(color))).max() <= 1


def test_textures_repeat_at_their_width(device):
    texture = np.kron(np.array([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]], np.uint8), np.ones((32, 32, 1), np.uint8))
    rendered = render_layers(scene(looks((texture,), texture_width=0.25)), device, names=("albedo",))
    view = WIDE
    world = (surface_points(rendered.depth[0], view) - view.translation) @ view.rotation
    place = world[..., :2] / 0.25
    share = place - np.floor(place)
    column, row = (share[..., 0] * 2).astype(int), ((1.0 - share[..., 1]) * 2).astype(int).clip(0, 1)
    color = texture[::32, ::32][row, column]
    inside = (np.abs(share * 2 - np.rint(share * 2)) > 0.2).all(axis=-1)
    flat = np.isin(rendered.segment[0], (Segment.TABLE, Segment.TOTE))
    flat &= (rendered.segment[0] == Segment.TABLE) | (np.abs(world[..., 2] - 0.05) < 1e-3)  # The bin's upper side.
    for segment in (Segment.TABLE, Segment.TOTE):
        seen = inside & flat & (rendered.segment[0] == segment)
        assert seen.sum() > 200
        assert np.abs(rendered["albedo"][0][seen].astype(int) - color[seen]).max() <= 2


FLOORS = [(200, 30, 30), (30, 200, 30), (30, 30, 200)]
"""Colours of textures, of which an episode has one."""


@pytest.mark.parametrize("mode", ["fast", "reference"])
@pytest.mark.parametrize("floor", [False, True])
def test_beyond_the_table_is_the_map_or_a_floor_without_depth(device, mode, floor):
    """In the even light of radiance 1, the map is white, and a diffuse floor has the radiance of the texture that is recorded."""
    images = tuple(np.full((4, 4, 3), color, np.uint8) for color in FLOORS)
    given = replace(looks(texture_width=0.5), background_textures=images if floor else ())
    toy = scene(given)
    sized = with_render(mode, table_size=(0.6, 0.4), samples=4)
    rendered = render(replace(toy, placed=[[]], fixtures_visible=(0, 0, 0), config=sized), device)
    places = np.stack(np.meshgrid((np.arange(160) - 79.5) / 200.0, (44.5 - np.arange(90)) / 200.0), axis=-1) * (2.0 + sized.tote.wall)
    on_table = (np.abs(places) < (0.3, 0.2)).all(axis=-1)
    inside = np.abs(np.abs(places) - (0.3, 0.2)).min(axis=-1) > 0.02  # Away from the edge, which is anti-aliased.
    assert 0 < (on_table & inside).sum() < (~on_table & inside).sum()
    np.testing.assert_array_equal(rendered.instance[0], np.where(on_table, Segment.TABLE, Segment.NOTHING))
    assert ((rendered.depth[0] > 0) == on_table).all()
    beyond = rendered.radiance[0][~on_table & inside]
    record = draw_looks(given, 0, 0, 0).get("background", {})
    assert record.get("texture_width") == (0.5 if floor else None)
    expected = srgb_to_linear(np.array(FLOORS[record["texture"]]) / 255) if floor else np.ones(3)
    np.testing.assert_allclose(beyond, np.broadcast_to(expected, beyond.shape), rtol=0.01)


# ---- bakes ----

TINY = STIRRING | {"bake.episodes": 2, "cameras.resolution": [48, 27], "randomize.object_hue": {"uniform": [-90, 90]}}


def test_bakes_record_their_looks(tmp_path):
    bake_boxes(tmp_path, TINY | {"bake.worlds": 2, "bake.formats": ["bop", "zarr"]})
    rows = [json.loads(line) for line in (tmp_path / "episodes.jsonl").read_text().splitlines()]
    drawn = Looks(settings(**TINY).randomize, (), ())
    for row in rows:
        assert row["looks"] == draw_looks(drawn, 0, row["episode"], row["objects"])
    group = json.loads((tmp_path / "trajectory.zarr" / "episodes" / "000001" / "zarr.json").read_text())
    assert group["attributes"]["looks"] == rows[1]["looks"]


def test_a_bake_is_not_resumed_with_other_textures(tmp_path):
    for color in (0, 200):
        (tmp_path / "textures").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "textures" / "a.png"), np.full((4, 4, 3), color, np.uint8))
        given = TINY | {"bake.episodes": 1, "bake.worlds": 1, "randomize.table_textures": str(tmp_path / "textures")}
        if color == 0:
            bake_boxes(tmp_path / "set", given)
    with pytest.raises(ConfigError, match="was started with other textures"):
        bake_boxes(tmp_path / "set", given | {"bake.episodes": 2})


# ---- settings ----


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ({"uniform": [1.0]}, "uniform = a list of 2"),
        ({"uniform": [0.9, 0.1]}, "low at most high"),
        ({"log_uniform": [0.0, 0.1]}, "above 0"),
        ({"normal": [0.5, -1.0]}, "sigma at least 0"),
        ({"choice": []}, "a list of 1 to 256"),
        ({"choice": [0.1], "weights": [0.0]}, "not all 0"),
        ({"choice": [0.1], "weights": [1.0, 2.0]}, "one for each value"),
        ({"uniform": [0.0, 1.0], "weights": [1.0, 2.0]}, "weights for a choice"),
        ({"gaussian": [0.0, 1.0]}, '"off", a number, { uniform'),
        ({"uniform": [0.1, 0.2], "normal": [0.1, 0.2]}, '"off", a number, { uniform'),
        ({"uniform": [0.5, 1.5]}, "at least 0, at most 1"),
        ("on", "finite numbers"),
        (True, "finite numbers"),
        (float("nan"), "finite numbers"),
    ],
)
def test_what_is_no_distribution_is_one_line(value, said):
    with pytest.raises(ConfigError) as caught:
        load_config("smoke", {"randomize.object_roughness": value})
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "value",
    [
        "off",
        0.5,
        {"uniform": [0.1, 0.2]},
        {"log_uniform": [0.1, 0.2]},
        {"normal": [0.1, 0.2]},
        {"choice": [0.1, 0.2], "weights": [1.0, 2.0]},
    ],
)
def test_distributions_are_written_as_they_are_read(value, tmp_path):
    from synpick_warp.configs.files.load import config_to_toml

    config = load_config("smoke", {"randomize.object_roughness": value, "randomize.bin_color": {"choice": [[0.1, 0.2, 0.3]]}})
    (tmp_path / "c.toml").write_text(config_to_toml(config, comments=True))
    assert replace(load_config(tmp_path / "c.toml")) == config


# ---- lamps ----


def test_lamps_add_their_share_of_light():
    """With one lamp of strength 0.5, a surface that faces up gets half as much again, from a disc at its elevation."""
    given = looks(lamps=1, lamp_strength=0.5, lamp_elevation=40.0, lamp_radius=3.0, lamp_temperature=3000.0)
    plain = EnvironmentMap("even", np.ones((256, 512, 3), np.float32))
    directions, angles = map_directions(len(plain.radiance))
    upward = np.maximum(directions[..., 2], 0.0) * angles
    for variant in range(3):
        lit = add_lamps(plain, "lit", given, 7, variant)
        added = (lit.radiance - plain.radiance) @ LUMINANCE
        assert (added * upward).sum() == pytest.approx(0.5 * (plain.radiance @ LUMINANCE * upward).sum(), rel=5e-3)
        middle = (added * angles)[..., None] * directions
        middle = middle.sum(axis=(0, 1)) / np.linalg.norm(middle.sum(axis=(0, 1)))
        assert np.degrees(np.arcsin(middle[2])) == pytest.approx(40.0, abs=0.3)
        assert np.degrees(np.arccos((directions @ middle)[added > 0.0].min())) < 3.0 + 360.0 / len(added)


def test_variants_of_maps_have_lamps_of_their_own():
    randomize = looks(lamps={"uniform": [1, 4]}).randomize
    lights = load_scene_lights("", replace(randomize, lamp_variants=2), 3, print)
    plain = load_scene_lights("", Randomize(), 3, print)
    assert [light.name for light in lights] == [f"{light.name}+{variant}" for light in plain for variant in range(2)]
    assert len({light.radiance.tobytes() for light in lights}) == len(lights)


@pytest.mark.parametrize("temperature", [1800.0, 2700.0, 4000.0, 6500.0, 12000.0])
def test_black_bodies_have_the_colour_of_their_spectrum(temperature):
    """Planck's law through the CIE 1931 observer, in the fit of Wyman, Sloan and Shirley (2013)."""
    nm = np.arange(360.0, 830.0)
    spectrum = nm**-5 / np.expm1(1.438776877e7 / (nm * temperature))

    def lobe(peak: float, left: float, right: float) -> np.ndarray:
        return np.exp(-0.5 * ((nm - peak) * np.where(nm < peak, left, right)) ** 2)

    x = 1.056 * lobe(599.8, 0.0264, 0.0323) + 0.362 * lobe(442.0, 0.0624, 0.0374) - 0.065 * lobe(501.1, 0.0490, 0.0382)
    y = 0.821 * lobe(568.8, 0.0213, 0.0247) + 0.286 * lobe(530.9, 0.0613, 0.0322)
    z = 1.217 * lobe(437.0, 0.0845, 0.0278) + 0.681 * lobe(459.0, 0.0385, 0.0725)
    xyz = np.array([(spectrum * curve).sum() for curve in (x, y, z)])
    to_rgb = np.linalg.inv([[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]])
    expected = np.maximum(to_rgb @ xyz, 0.0)
    expected /= expected @ LUMINANCE
    np.testing.assert_allclose(black_body_color(temperature), expected, rtol=0.04, atol=0.02)
