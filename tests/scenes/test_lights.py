"""Environment maps: orientation, sIBL sets, and invalid files."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from synpick_warp.errors import LightError
from synpick_warp.scenes import lights
from synpick_warp.scenes.embedded.skies import HEIGHT, skies
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.lights import load_lights

IBL = """[Header]
Name = "A set"
[Enviroment]
--blurred
EVfile = "env.hdr"
EVgamma = 1.0
[Reflection]
REFfile = "ref.hdr"
REFmap = 1
REFmulti = {multi}
REFgamma = {gamma}
[Sun]
SUNcolor = 255,255,245
{sun}"""


def picture(height=8, value=0.5):
    return np.full((height, 2 * height, 3), value, np.float32)


def save(path, image):
    assert cv2.imwrite(str(path), np.ascontiguousarray(image[..., ::-1]))


def make_set(folder, multi="2.0", gamma="2.2", image=None, sun=""):
    folder.mkdir()
    save(folder / "env.hdr", picture(4))
    save(folder / "ref.hdr", picture() if image is None else image)
    (folder / "room.ibl").write_text(IBL.format(multi=multi, gamma=gamma, sun=sun))
    return folder


def refused(folder, *words, strict=False):
    with pytest.raises(LightError) as caught:
        load_lights(str(folder), strict=strict)
    message = str(caught.value)
    assert "\n" not in message
    for word in words:
        assert word in message
    return message


def test_directions_follow_the_convention():
    view = map_directions(64)[0]
    assert np.allclose(np.linalg.norm(view, axis=2), 1)
    assert view[0, :, 2].min() > 0.99
    assert view[-1, :, 2].max() < -0.99
    # u = azimuth / 2π + 0.5: the middle is +x, three quarters are +y, the edge is -x.
    assert np.allclose(view[32, 64], (1, 0, 0), atol=0.05)
    assert np.allclose(view[32, 96], (0, 1, 0), atol=0.05)
    assert np.allclose(view[32, 0], (-1, 0, 0), atol=0.05)


def test_embedded_maps_are_brighter_above_the_horizon():
    maps = load_lights("")
    assert len(maps) >= 6
    assert [light.name for light in maps] == sorted({light.name for light in maps})
    weight = np.sin((np.arange(HEIGHT) + 0.5) / HEIGHT * np.pi)[:, None, None]
    for light in maps:
        assert light.radiance.shape == (HEIGHT, 2 * HEIGHT, 3)
        assert light.radiance.dtype == np.float32
        assert np.isfinite(light.radiance).all()
        assert light.radiance.min() >= 0
        half = HEIGHT // 2
        above, below = ((light.radiance * weight)[rows].mean() for rows in (slice(0, half), slice(half, None)))
        assert above > 1.2 * below
        assert 0.2 < 2 * (light.radiance * weight).mean() < 3
        # Smooth across the seam: no column differs more from its neighbour there than anywhere else.
        steps = np.abs(np.diff(light.radiance, axis=1)).max()
        assert np.abs(light.radiance[:, 0] - light.radiance[:, -1]).max() <= steps + 1e-6
    assert sum(light.radiance.max() > 10 for light in maps) >= 4


def test_the_low_sun_has_its_azimuth_and_elevation():
    sun = next(light for light in skies() if light.name == "low_sun")
    row, column = np.unravel_index(sun.radiance.sum(axis=2).argmax(), sun.radiance.shape[:2])
    x, y, z = map_directions(HEIGHT)[0][row, column]
    assert np.degrees(np.arctan2(y, x)) == pytest.approx(35, abs=2)
    assert np.degrees(np.arcsin(z)) == pytest.approx(22, abs=2)


def test_embedded_maps_are_deterministic():
    for one, other in zip(skies(), skies(), strict=True):
        assert one.name == other.name
        assert np.array_equal(one.radiance, other.radiance)


def test_a_file_keeps_colours_and_up_and_its_right_becomes_negative_azimuth(tmp_path):
    image = picture()
    image[0] = (4.0, 2.0, 1.0)
    image[4, 11] = (64.0, 32.0, 8.0)  # right of the middle (columns 7 and 8), just below the horizon
    save(tmp_path / "a.hdr", image)
    (light,) = load_lights(str(tmp_path))
    assert light.name == "a"
    assert np.allclose(light.radiance[0], (4, 2, 1), rtol=0.01)
    row, column = np.unravel_index(light.radiance[..., 0].argmax(), (8, 16))
    assert np.allclose(light.radiance[row, column], (64, 32, 8), rtol=0.01)
    assert (row, column) == (4, 4)
    x, y, z = map_directions(8)[0][row, column]
    assert x > 0
    assert y < 0
    assert z < 0


def test_maps_come_sorted_from_folder_and_subfolders(tmp_path):
    for name in ("c.hdr", "a.HDR"):
        save(tmp_path / "x.hdr", picture())
        (tmp_path / "x.hdr").rename(tmp_path / name)
    make_set(tmp_path / "set")
    (tmp_path / "more").mkdir()
    save(tmp_path / "more" / "b.hdr", picture())
    (tmp_path / "note.txt").write_text("no map")
    assert [light.name for light in load_lights(str(tmp_path))] == ["a", "b", "c", "room"]


def test_maps_of_one_name_are_refused_as_a_data_set_names_the_map_of_a_view(tmp_path):
    for folder in (tmp_path / "first", tmp_path / "second"):
        folder.mkdir()
        save(folder / "sky.hdr", picture())
    refused(tmp_path, "two maps have the name sky")


def test_a_set_is_its_reflection_map_times_multi_without_gamma_for_linear_files(tmp_path):
    make_set(tmp_path / "set", multi="3.0", gamma="2.2")
    for place in (tmp_path, tmp_path / "set"):
        (light,) = load_lights(str(place))
        assert light.radiance.shape == (8, 16, 3)
        assert np.allclose(light.radiance, 1.5)


def test_gamma_is_applied_to_8_bit_images(tmp_path):
    folder = make_set(tmp_path / "set", multi="1.0", gamma="2.0")
    (folder / "ref.hdr").unlink()
    save(folder / "ref.png", np.full((8, 16, 3), 128, np.uint8))
    text = (folder / "room.ibl").read_text()
    (folder / "room.ibl").write_text(text.replace("ref.hdr", "ref.png"))
    (light,) = load_lights(str(tmp_path))
    assert np.allclose(light.radiance, (128 / 255) ** 2)


def test_large_maps_are_downsampled_with_their_energy(tmp_path, monkeypatch):
    monkeypatch.setattr(lights, "MAX_HEIGHT", 4)
    image = picture(8, 1.0)
    image[2, 2] = 33.0
    save(tmp_path / "a.hdr", image)
    (light,) = load_lights(str(tmp_path))
    assert light.radiance.shape == (4, 8, 3)
    assert light.radiance.mean() == pytest.approx(image.mean(), rel=1e-3)
    assert light.radiance.max() == pytest.approx(9.0, rel=1e-3)


def test_real_maps_load(real_lights):
    maps = load_lights(str(real_lights))
    assert len(maps) == 8
    for light in maps:
        assert light.radiance.shape == (512, 1024, 3)
        assert light.radiance.max() > 5
    plain = cv2.imread(str(real_lights / "sibl_kiara_dawn" / "kiara_1_dawn_1k.hdr"), cv2.IMREAD_UNCHANGED)
    kiara = next(light for light in maps if light.name == "Kiara_Dawn")
    assert np.allclose(kiara.radiance, 1.2 * plain[:, ::-1, ::-1], rtol=1e-5)


def test_missing_and_empty_folders(tmp_path):
    refused(tmp_path / "nowhere", "nowhere", "does not exist")
    refused(tmp_path, str(tmp_path), "no environment map")
    (tmp_path / "a.hdr").write_bytes(b"")
    refused(tmp_path / "a.hdr", "does not exist")


@pytest.mark.parametrize("keep", [0.0, 0.02, 0.5, 0.99])
def test_a_truncated_map(tmp_path, capfd, keep):
    rng = np.random.default_rng(1)
    save(tmp_path / "a.hdr", rng.random((64, 128, 3)).astype(np.float32))
    data = (tmp_path / "a.hdr").read_bytes()
    (tmp_path / "a.hdr").write_bytes(data[: int(keep * len(data))])
    refused(tmp_path, "a.hdr", "cut short")
    assert capfd.readouterr() == ("", "")


def test_a_file_that_is_not_a_map(tmp_path):
    (tmp_path / "a.hdr").write_text("hello, this is no picture")
    refused(tmp_path, "a.hdr", "another format")
    save(tmp_path / "a.hdr", np.ones((8, 12, 3), np.float32))
    refused(tmp_path, "a.hdr", "12 x 8", "twice as wide")


@pytest.mark.parametrize(
    ("value", "words"), [(np.nan, "not a number"), (np.inf, "infinite"), (-1.0, "negative radiance (-1)")], ids=("nan", "inf", "negative")
)
def test_invalid_radiance(tmp_path, value, words):
    """Radiance files cannot contain such values, other formats with their suffix can."""
    image = picture()
    image[3, 5, 1] = value
    (tmp_path / "a.hdr").write_bytes(cv2.imencode(".tiff", image)[1].tobytes())
    refused(tmp_path, "a.hdr", words)


def test_a_black_map(tmp_path):
    save(tmp_path / "a.hdr", picture(value=0.0))
    refused(tmp_path, "a.hdr", "black")


@pytest.mark.parametrize("file", ["back.jpg", "ref.hdr", "env.hdr"])
def test_a_set_with_a_missing_file(tmp_path, file):
    folder = make_set(tmp_path / "set")
    if file == "back.jpg":
        (folder / "room.ibl").write_text(f"[Background]\nBGfile = {file}\n" + (folder / "room.ibl").read_text())
    (folder / file).unlink(missing_ok=True)
    refused(tmp_path, "room.ibl", file, strict=True)
    lines = []
    if file == "ref.hdr":
        refused(tmp_path, "room.ibl", file)
    else:  # Only the reflection map is used.
        assert len(load_lights(str(tmp_path), lines.append)) == 1
        assert f"{file}, but there is no such file beside it; it is not used" in lines[0]


@pytest.mark.parametrize("value", ["-1", "0", "nan", "inf", "bright"])
@pytest.mark.parametrize("key", ["multi", "gamma"])
def test_a_set_with_an_invalid_number(tmp_path, key, value):
    make_set(tmp_path / "set", **{key: value})
    refused(tmp_path, "room.ibl", f"REF{key} = {value}", "positive")


def test_a_set_that_overflows(tmp_path):
    make_set(tmp_path / "set", multi="1e38", image=picture(value=1e6))
    refused(tmp_path, "ref.hdr", "infinite")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[Header]\nName = x\n", "no reflection map"),
        ("no ini at all\n", "not an sIBL set file"),
        ('[Reflection]\nREFfile = "ref.hdr"\nREFmap = 2\n', "REFmap = 2"),
    ],
)
def test_invalid_set_files(tmp_path, text, words):
    folder = make_set(tmp_path / "set")
    (folder / "room.ibl").write_text(text)
    refused(tmp_path, "room.ibl", words)
