"""Environment maps: orientation, sIBL sets, and hostile or invalid files: one line at once, nothing outside is read."""

import os
import struct
import time
import zlib

import cv2
import numpy as np
import pytest

from synpick_warp.errors import LightError
from synpick_warp.scenes import lights
from synpick_warp.scenes.embedded.skies import HEIGHT, skies
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.lights import MAX_RADIANCE, load_lights
from synpick_warp.stages.render.light_tables import precompute_environment
from tests.harness.hostile import start_isolation
from tests.worlds.model_files import pack_png

SECONDS = 5.0
"""Longest time that any input may take."""
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
"""


def picture(height=8, value=0.5):
    return np.full((height, 2 * height, 3), value, np.float32)


def encoded(image, suffix=".hdr"):
    return cv2.imencode(suffix, np.ascontiguousarray(image[..., ::-1]))[1].tobytes()


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(image, path.suffix.lower()))


def make_set(folder, text=None, image=None, multi="2.0", gamma="2.2"):
    save(folder / "env.hdr", picture(4))
    save(folder / "ref.hdr", picture() if image is None else image)
    (folder / "room.ibl").write_text(IBL.format(multi=multi, gamma=gamma) if text is None else text)
    return folder


def refused(folder, *words, strict=False):
    start_isolation()
    started = time.monotonic()
    with pytest.raises(LightError) as caught:
        load_lights(str(folder), strict=strict)
    message = str(caught.value)
    assert message.isprintable()
    assert time.monotonic() - started < SECONDS
    assert all(word in message for word in words), message


def test_directions_follow_the_convention():
    view = map_directions(64)[0]
    assert np.allclose(np.linalg.norm(view, axis=2), 1)
    assert view[0, :, 2].min() > 0.99
    assert view[-1, :, 2].max() < -0.99
    # u = azimuth / 2π + 0.5: the middle is +x, three quarters are +y, the edge is -x.
    assert np.allclose(view[32, [64, 96, 0]], [(1, 0, 0), (0, 1, 0), (-1, 0, 0)], atol=0.05)


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
        above, below = ((light.radiance * weight)[rows].mean() for rows in (slice(0, HEIGHT // 2), slice(HEIGHT // 2, None)))
        assert above > 1.2 * below
        assert 0.2 < 2 * (light.radiance * weight).mean() < 3
        # Smooth across the seam: no column differs more from its neighbour there than anywhere else.
        steps = np.abs(np.diff(light.radiance, axis=1)).max()
        assert np.abs(light.radiance[:, 0] - light.radiance[:, -1]).max() <= steps + 1e-6
    assert sum(light.radiance.max() > 10 for light in maps) >= 4
    for one, other in zip(skies(), skies(), strict=True):
        assert one.name == other.name
        assert np.array_equal(one.radiance, other.radiance)


def test_the_low_sun_has_its_azimuth_and_elevation():
    sun = next(light for light in skies() if light.name == "low_sun")
    brightest = np.unravel_index(sun.radiance.sum(axis=2).argmax(), sun.radiance.shape[:2])
    x, y, z = map_directions(HEIGHT)[0][brightest]
    assert np.degrees([np.arctan2(y, x), np.arcsin(z)]) == pytest.approx([35, 22], abs=2)


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
    assert np.sign(map_directions(8)[0][row, column]).tolist() == [1, -1, -1]


def test_maps_come_sorted_from_folder_and_subfolders_with_a_name_each(tmp_path):
    for name in ("c.hdr", "a.HDR", "more/b.hdr"):
        save(tmp_path / name, picture())
    make_set(tmp_path / "set")
    (tmp_path / "note.txt").write_text("no map")
    assert [light.name for light in load_lights(str(tmp_path))] == ["a", "b", "c", "room"]
    save(tmp_path / "other" / "b.hdr", picture())
    refused(tmp_path, "two maps have the name b")


def test_a_set_is_its_reflection_map_times_multi_without_gamma_for_linear_files(tmp_path):
    make_set(tmp_path / "set", multi="3.0", gamma="2.2")
    for place in (tmp_path, tmp_path / "set"):
        (light,) = load_lights(str(place))
        assert light.radiance.shape == (8, 16, 3)
        assert np.allclose(light.radiance, 1.5)
    make_set(tmp_path / "set", multi="1e38", image=picture(value=1e6))
    refused(tmp_path, "ref.hdr", "infinite")


def test_gamma_is_applied_to_8_bit_images(tmp_path):
    folder = make_set(tmp_path / "set", multi="1.0", gamma="2.0")
    (folder / "ref.hdr").unlink()
    save(folder / "ref.png", np.full((8, 16, 3), 128, np.uint8))
    (folder / "room.ibl").write_text((folder / "room.ibl").read_text().replace("ref.hdr", "ref.png"))
    (light,) = load_lights(str(tmp_path))
    assert np.allclose(light.radiance, (128 / 255) ** 2)


def test_large_maps_are_downsampled_with_their_energy(tmp_path, monkeypatch):
    monkeypatch.setattr(lights, "MAX_HEIGHT", 4)
    image = picture(8, 1.0)
    image[2, 2] = 33.0
    save(tmp_path / "a.hdr", image)
    (light,) = load_lights(str(tmp_path))
    assert light.radiance.shape == (4, 8, 3)
    assert (light.radiance.mean(), light.radiance.max()) == pytest.approx((image.mean(), 9.0), rel=1e-3)


def test_real_maps_load(real_lights):
    maps = load_lights(str(real_lights))
    assert len(maps) == 8
    for light in maps:
        assert light.radiance.shape == (512, 1024, 3)
        assert light.radiance.max() > 5
    plain = cv2.imread(str(real_lights / "sibl_kiara_dawn" / "kiara_1_dawn_1k.hdr"), cv2.IMREAD_UNCHANGED)
    kiara = next(light for light in maps if light.name == "Kiara_Dawn")
    assert np.allclose(kiara.radiance, 1.2 * plain[:, ::-1, ::-1], rtol=1e-5)


@pytest.mark.parametrize("whole", [False, True])
def test_tables_of_the_brightest_map_are_finite(tmp_path, whole):
    """Squares and cubes of radiance too, which kernels form as 32-bit floats."""
    image = picture(64, 0.99 * MAX_RADIANCE if whole else 0.5)
    image[10, 20] = 0.99 * MAX_RADIANCE
    save(tmp_path / "a.hdr", image)
    (light,) = load_lights(str(tmp_path))
    tables = precompute_environment(light, np.full(3, 0.5))
    assert len(tables.lamps) == (0 if whole else 1)
    values = [getattr(tables, name) for name in ("radiance", "lampless", "prefiltered", "irradiance")]
    for value in values + [lamp.irradiance.astype(np.float32) for lamp in tables.lamps]:
        assert np.isfinite(value).all()
        assert np.isfinite(value**3).all()
    assert 0.0 < np.float32(tables.exposure) < np.inf


# ---- files that are refused ----


def test_missing_and_empty_folders(tmp_path):
    refused(tmp_path / "nowhere", "nowhere", "does not exist")
    refused(tmp_path, str(tmp_path), "no environment map")
    (tmp_path / "a.hdr").write_bytes(b"")
    refused(tmp_path / "a.hdr", "does not exist")


def with_pixel(value):
    image = picture(value=min(value, 0.5) if np.isfinite(value) else 0.5)
    image[3, 5] = value
    return image


RANDOM = encoded(np.random.default_rng(1).random((64, 128, 3)).astype(np.float32))
RADIANCE = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n"
ZEROS = np.zeros((8, 16, 3), np.uint8)
TIFF = encoded(ZEROS, ".tiff").replace(struct.pack("<HHII", 256, 3, 1, 16), struct.pack("<HHII", 256, 4, 1, 2**20))
TIFF = TIFF.replace(struct.pack("<HHII", 257, 3, 1, 8), struct.pack("<HHII", 257, 4, 1, 2**9))
"""An image whose header announces 2²⁰ x 2⁹ pixels."""
TOO_MANY = "more than 33554432 pixels; allowed"
MAPS = {
    **{f"cut to {share}": (RANDOM[: int(share * len(RANDOM))], "cut short") for share in (0.0, 0.02, 0.5, 0.99)},
    "text": (b"hello, this is no picture", "another format"),
    "not twice as wide": (encoded(np.ones((8, 12, 3), np.float32)), "12 x 8 pixels; ", "twice as wide"),
    # Radiance files cannot contain such values, other formats with their suffix can.
    "nan": (encoded(with_pixel(np.nan), ".tiff"), "not a number"),
    "inf": (encoded(with_pixel(np.inf), ".tiff"), "infinite"),
    "negative": (encoded(with_pixel(-1.0), ".tiff"), "negative radiance (-1)"),
    "black": (encoded(picture(value=0.0)), "black"),
    "nearly black": (encoded(with_pixel(1e-30)), "black"),
    "too bright": (encoded(with_pixel(8e37)), "radiance 7.97537e+37; allowed: up to 1e+11"),
    "large": (RADIANCE + b"\n-Y 30000 +X 60000\n" + bytes(99), f"{TOO_MANY}: up to 8192 x 4096"),
    "large at first": (RADIANCE + b"x" * 127 + b"\n-Y 30000 +X 60000\n\n-Y 8 +X 16\n" + bytes(99), f"{TOO_MANY}: up to 8192 x 4096"),
    "large png": (pack_png(60_000, 30_000, (b"IDAT", zlib.compress(bytes(100))), kind=2), TOO_MANY),
    "large tiff": (TIFF, TOO_MANY),
    "large jpeg": (encoded(ZEROS, ".jpg").replace(struct.pack(">HH", 8, 16), struct.pack(">HH", 9000, 18000)), TOO_MANY),
}
"""Contents of a light map, and words of the line that refuses it."""


@pytest.mark.parametrize("strict", [False, True])
@pytest.mark.parametrize("name", MAPS)
def test_maps_that_cannot_be_used_are_one_line(tmp_path, capfd, name, strict):
    content, *words = MAPS[name]
    (tmp_path / "a.hdr").write_bytes(content)
    refused(tmp_path, "a.hdr", *words, strict=strict)
    assert capfd.readouterr() == ("", "")


REFLECTION = '[Reflection]\nREFfile = "ref.hdr"\n'
SETS = [
    ("[Header]\nName = x\n", "no reflection map"),
    ("no ini at all\n", "not an sIBL set file"),
    (f"{REFLECTION}REFmap = 2\n", "REFmap = 2"),
    *((IBL.format(multi=value, gamma=2.2), f"REFmulti = {value}", "positive") for value in ("-1", "0", "nan", "inf", "bright")),
    *((IBL.format(multi=2.0, gamma=value), f"REFgamma = {value}", "positive") for value in ("-1", "0", "nan", "inf", "bright")),
    (f"{REFLECTION}REFmulti = 1\n  2\n", "positive number"),
    (f"{REFLECTION}REFgamma = 1e300\n", "positive number"),
    (f"{REFLECTION}a{' ' * 60_000}b\n", "longer than"),
    # Files outside of the set's folder.
    *((f"[Reflection]\nREFfile = {name}\n", "names the file") for name in ("../map.hdr", "/dev/zero", "link/map.hdr")),
    *((f"[Background]\nBGfile = {name}\n{REFLECTION}", "names the file") for name in ("../map.hdr", "/dev/zero", "link/map.hdr")),
    *((f"[Enviroment]\nEVfile = {name}\n{REFLECTION}", "names the file") for name in ("../map.hdr", "/dev/zero", "link/map.hdr")),
]
SUNS = [
    ("SUNu = 1.2", "a number from 0 to 1"),
    ("SUNv = -0.1", "a number from 0 to 1"),
    ("SUNu = 0,67", "a number from 0 to 1"),
    ("SUNv = nan", "a number from 0 to 1"),
    ("SUNu = left", "a number from 0 to 1"),
    ("SUNmulti = inf", "a number from 0 to 1e+06"),
    ("SUNmulti = -1", "a number from 0 to 1e+06"),
    ("SUNcolor = 255,255", "3 numbers"),
    ("SUNcolor = 1,2,256", "from 0 to 255"),
    ("SUNcolor = 1,,2", "3 numbers"),
    ("SUNcolor = white", "3 numbers"),
]
SETS += [(f"{REFLECTION}[Sun]\nSUNu = 0.5\nSUNv = 0.2\n{line}\n", line, words) for line, words in SUNS]
SETS += [
    (f"{REFLECTION}[Sun]\n{there} = 0.2\n", f"room.ibl has {there} alone; a sun needs SUNu and SUNv, or neither")
    for there in ("SUNu", "SUNv")
]
"""Texts of a set's file, and words of the line that refuses it."""


@pytest.mark.parametrize("row", range(len(SETS)))
def test_sets_that_cannot_be_used_are_one_line(tmp_path, row):
    text, *words = SETS[row]
    folder = make_set(tmp_path / "set", text)
    if "names the file" not in words:  # Below, `link` leads to a map that can be used.
        refused(folder, "room.ibl", *words)
    save(tmp_path / "map.hdr", picture())
    (folder / "link").symlink_to("..")
    refused(folder, "room.ibl", *words, strict=True)


@pytest.mark.parametrize("name", ["a.hdr", "a.ibl"])
def test_a_light_map_that_is_a_fifo_is_refused_at_once(tmp_path, name):
    os.mkfifo(tmp_path / name)
    refused(tmp_path, f"{name} is not a regular file", strict=True)


@pytest.mark.parametrize("file", ["back.jpg", "ref.hdr", "env.hdr"])
def test_a_set_with_a_missing_file(tmp_path, file):
    folder = make_set(tmp_path / "set")
    if file == "back.jpg":
        (folder / "room.ibl").write_text(f"[Background]\nBGfile = {file}\n" + (folder / "room.ibl").read_text())
    (folder / file).unlink(missing_ok=True)
    refused(tmp_path, "room.ibl", file, strict=True)
    if file == "ref.hdr":
        refused(tmp_path, "room.ibl", file)
    else:  # Only the reflection map is used.
        lines = []
        assert len(load_lights(str(tmp_path), lines.append)) == 1
        assert f"{file}, but there is no such file beside it; it is not used" in lines[0]
