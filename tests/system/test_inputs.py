"""Untrusted input: paths stay inside their folder, reads are bounded, every mistake is one line; crops of PNG files; tables as text.
Hostile settings: TOML files and `--set` values of any content give a configuration or one line, at once."""

import os
import time
import tomllib
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import config_to_toml, load_config, parse_assignment, sections
from synpick_warp.configs.schema import Config, ObjectRow
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.exporters.writing.png import encode_mask_png, encode_png
from synpick_warp.exporters.writing.rle import find_run_boundaries
from synpick_warp.system.codecs.tables import Column, Table, to_csv, to_latex, to_text
from synpick_warp.system.inputs.files import MAX_TOML, check_regular_file, decode_json, decode_toml, path_inside, read_file, read_toml
from synpick_warp.system.inputs.image_files import decode_image
from synpick_warp.system.inputs.png_crop import _WIDE, decode_grey_crop
from tests.builders import mistake, refusal
from tests.harness.hostile import fuzz_examples
from tests.worlds.model_files import pack_png

SECONDS = 5.0
"""Longest time that any input may take."""


class Record(msgspec.Struct):
    """A schema."""

    count: int
    name: str = ""


# ---- paths ----


@pytest.mark.parametrize(
    "name", ["", "/etc/passwd", "..", "../x", "a/../../x", "a/..", ".", "a\nb", "a\0b", "a" * 5000, "out/x", "loop/x", "out"]
)
def test_names_that_lead_out_of_the_folder_are_refused(tmp_path, name):
    folder = tmp_path / "in"
    folder.mkdir()
    (folder / "out").symlink_to(tmp_path)
    (folder / "loop").symlink_to("loop")
    with pytest.raises(DatasetError) as caught:
        path_inside(folder, name, "LIST", DatasetError)
    assert str(caught.value).startswith("LIST names the file ")
    assert str(caught.value).isprintable()


def test_names_and_links_inside_the_folder_are_kept(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "link").symlink_to("a")
    for name in ("a/b.png", "link/b.png", "a", "..a/b", "new/folder/file"):
        assert path_inside(tmp_path, name, "LIST", DatasetError) == tmp_path / name


@given(st.lists(st.sampled_from(["..", ".", "a", "", "/", "~", "link", "\t", "ü", "C:", "\\"]), max_size=6).map("/".join))
def test_a_path_is_inside_or_refused(name):
    folder = Path("/nowhere/set")
    try:
        path = path_inside(folder, name, "LIST", DatasetError)
    except DatasetError:
        return
    assert Path(os.path.normpath(path)).is_relative_to(folder)
    assert Path(os.path.normpath(path)) != folder


# ---- files ----


def test_only_regular_files_of_limited_size_are_read(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "zero").symlink_to("/dev/zero")
    (tmp_path / "ten").write_bytes(b"0123456789")
    for check in (read_file, check_regular_file):
        for name, message in (("fifo", "is not a regular file"), ("zero", "is not a regular file"), ("", "is not a regular file")):
            with pytest.raises(DatasetError, match=message):
                check(tmp_path / name, 10, DatasetError)
        with pytest.raises(DatasetError, match="there is no file"):
            check(tmp_path / "none", 10, DatasetError)
        with pytest.raises(DatasetError, match="larger than 9 bytes"):
            check(tmp_path / "ten", 9, DatasetError)
        with pytest.raises(DatasetError, match="null"):
            check(tmp_path / "a\0b", 9, DatasetError)
    assert read_file(tmp_path / "ten", 10, DatasetError) == b"0123456789"


# ---- JSON ----


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "F is damaged: input data was truncated; do it again"),
        (b'{"count": 3', "truncated"),
        (b"[]", "expected object, got array"),
        (b'{"count": "3"}', r"expected int, got str - at \$.count"),
        (b'{"count": 1.5}', r"expected int, got float - at \$.count"),
        (b'{"count": NaN}', "malformed"),
        (b'{"count": 1e999}', r"number out of range - at \$.count"),
        (b'{"count": ' + b"9" * 5000 + b"}", "out of range"),
        (b"{}", "missing required field count"),
        (b'{"count": 1, "name": "\xff"}', "codec can't decode|invalid UTF-8"),
    ],
)
def test_json_errors_name_source_place_and_advice(data, message):
    with pytest.raises(DatasetError, match=message):
        decode_json(data, Record, "F", DatasetError, "do it again")


def test_deep_json_is_refused():
    with pytest.raises(DatasetError, match="nested too deeply"):
        decode_json(b"[" * 10**6, Any, "F", DatasetError)


# ---- TOML ----


@pytest.mark.parametrize(
    "text",
    [
        "a." * 100_000 + "b = 1",
        "[" + "a." * 100_000 + "b]",
        "a = {" + "'b' . " * 100_000 + "c = 1}",
        "a = " + "[" * 100_000,
        "a = " + "9" * 100_000,
        "a = " + "{b = " * 20_000 + "1" + "}" * 20_000,
        '"' + '\\"' * 500_000,
        "'''" * 300_001,
        "a" * 1_000_000,
        "a " * 500_000,
        "a = 1\na = 2",
    ],
    ids=lambda text: text[:8],
)
def test_hostile_toml_is_an_error_at_once(text):
    started = time.monotonic()
    with pytest.raises(ValueError, match=r"^[^\n]{1,200}$"):
        decode_toml(text)
    assert time.monotonic() - started < SECONDS


def test_ordinary_toml_is_decoded():
    text = config_to_toml(load_config("synpick", {}), comments=True)
    assert decode_toml(text) == tomllib.loads(text)
    assert decode_toml("a = [1.0, 2.0, 3.0, 4.0, 5.0,\n 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0]")["a"][-1] == 9.0
    assert decode_toml("'a.b.c.d.e.f.g.h.i.j' = 'a.b.c.d.e.f.g.h.i.j.k'")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"a = '\xe4'", "byte 5 is not UTF-8"),
        (b"#" * (MAX_TOML + 1), "larger than 1 MiB"),
        *((" = 1".join("ab").encode(kind), "is text in UTF-16 or UTF-32") for kind in ("utf-16", "utf-16-le", "utf-16-be", "utf-32")),
    ],
    ids=str,
)
def test_toml_files_are_bounded_and_in_utf_8(tmp_path, data, message):
    (tmp_path / "a.toml").write_bytes(data)
    with pytest.raises(DatasetError, match=message):
        read_toml(tmp_path / "a.toml", DatasetError)
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "a.toml", DatasetError) == {"a": 1}, "a byte order mark is no part of TOML"


# ---- crops of greyscale PNG files: equal to OpenCV's decoding, or refused ----


SIZE = 70, 50
"""Width and height."""
ROWS, COLUMNS = slice(7, 40), slice(11, 70)
MASK = (np.hypot(*np.mgrid[-20:30, -30:40]) < 18).astype(np.uint8)
IMAGE = np.random.default_rng(0).integers(0, 256, SIZE[::-1], dtype=np.uint8)


def png(rows: bytes, header: tuple[int, ...] = (*SIZE, 8, 0, 0, 0, 0)) -> bytes:
    width, height, depth, kind, *rest = header
    parts = ((b"tEXt", b"note"), (b"IDAT", zlib.compress(rows)[:30]), (b"IDAT", zlib.compress(rows)[30:]))
    return pack_png(width, height, *parts, depth=depth, kind=kind, rest=tuple(rest))


def lines(kind: int, image: np.ndarray) -> bytes:
    return b"".join(bytes([kind]) + row.tobytes() for row in image)


def test_crops_equal_the_whole_image():
    mask = encode_mask_png(find_run_boundaries(MASK, 0, 0).runs_of(1), *SIZE[::-1])
    np.testing.assert_array_equal(decode_grey_crop(mask, SIZE, ROWS, COLUMNS), 255 * MASK[ROWS, COLUMNS])
    np.testing.assert_array_equal(decode_grey_crop(encode_png(IMAGE), SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])
    np.testing.assert_array_equal(decode_grey_crop(png(lines(0, IMAGE)), SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])
    mixed = b"".join(bytes([kind]) + row.tobytes() for kind, row in zip((2, 2, 0, 2, 0) * 10, IMAGE, strict=True))
    decoded = cv2.imdecode(np.frombuffer(png(mixed), np.uint8), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(decode_grey_crop(png(mixed), SIZE, ROWS, COLUMNS), decoded[ROWS, COLUMNS])
    crop = decode_grey_crop(cv2.imencode(".png", 255 * MASK)[1].tobytes(), SIZE, ROWS, COLUMNS)
    assert crop is None or (crop == 255 * MASK[ROWS, COLUMNS]).all(), "what OpenCV writes is equal or left to it"
    crop = decode_grey_crop(encode_png(IMAGE), SIZE, slice(0, 0), slice(3, 3))
    assert crop is not None
    assert crop.shape == (0, 0)


def test_images_of_16_bits_equal_opencv():
    depth = np.random.default_rng(1).integers(0, 1 << 16, SIZE[::-1], dtype=np.uint16)
    data = encode_png(depth)
    np.testing.assert_array_equal(decode_grey_crop(data, SIZE, ROWS, COLUMNS, bits=16), depth[ROWS, COLUMNS])
    for each in (data, png(lines(0, depth.astype(">u2")), (*SIZE, 16, 0, 0, 0, 0)), cv2.imencode(".png", depth)[1].tobytes()):
        image = decode_image(each, "depth.png", DatasetError, size=SIZE)
        assert image.dtype == np.dtype("=u2")
        np.testing.assert_array_equal(image, depth)
    assert decode_grey_crop(encode_png(IMAGE), SIZE, ROWS, COLUMNS, bits=16) is None


@pytest.mark.parametrize("width", [_WIDE // 2 - 1, _WIDE // 2, _WIDE])
def test_narrow_and_wide_crops_are_the_same(width):
    depth = np.random.default_rng(2).integers(0, 1 << 16, (9, width), dtype=np.uint16)
    np.testing.assert_array_equal(decode_image(encode_png(depth), "depth.png", DatasetError), depth)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xd8\xff",
        png(lines(1, IMAGE)),
        png(lines(0, IMAGE)[:-1]),
        png(lines(0, IMAGE), (*SIZE, 8, 0, 0, 0, 1)),
        png(lines(0, IMAGE), (*SIZE, 4, 0, 0, 0, 0)),
        png(lines(0, IMAGE), (*SIZE, 8, 3, 0, 0, 0)),
        png(lines(0, IMAGE), (SIZE[1], SIZE[0], 8, 0, 0, 0, 0)),
        png(lines(0, IMAGE)).replace(b"IDAT", b"IDAX"),
        png(lines(0, IMAGE))[:-20],
        png(lines(0, IMAGE))[:40],
        png(lines(0, IMAGE)).replace(b"tEXt", b"eXIf"),
        png(lines(0, IMAGE)).replace(b"tEXt", b"tRNS"),
        png(lines(0, IMAGE))[:29] + bytes(4) + png(lines(0, IMAGE))[33:],
        png(lines(0, IMAGE)).replace(zlib.crc32(b"IDAT" + zlib.compress(lines(0, IMAGE))[30:]).to_bytes(4, "big"), bytes(4)),
        encode_png(IMAGE.astype(np.uint16)),
        encode_png(np.zeros((*IMAGE.shape, 3), np.uint8)),
    ],
)
def test_other_files_are_refused(data):
    assert decode_grey_crop(data, SIZE, ROWS, COLUMNS) is None


def test_damaged_streams_are_refused_and_bombs_stay_small():
    data = bytearray(encode_png(IMAGE))
    for place in range(41, len(data) - 20, 97):
        broken = bytes(data[:place]) + bytes([data[place] ^ 0x5A]) + bytes(data[place + 1 :])
        assert decode_grey_crop(broken, SIZE, ROWS, COLUMNS) is None
    bomb = png(lines(0, IMAGE) + bytes(10**7))
    np.testing.assert_array_equal(decode_grey_crop(bomb, SIZE, ROWS, COLUMNS), IMAGE[ROWS, COLUMNS])


# ---- tables as text, LaTeX and CSV ----


TABLE = Table(
    "t",
    "",
    (Column("name", label=""), Column("a_b", ",", digits=".3g"), Column("c", ".1f"), Column("d", ".1f")),
    [("x_1", 1234, 0.25, None), ("=日本", None, 2.0, 3.0)],
    spans=(("a method", range(1, 3)), ("m", range(3, 4))),
    sections=frozenset({1}),
)


def test_text_is_aligned_and_split_into_blocks():
    whole = ["       a method    m", "         a b    c    d", "x_1    1,234  0.2    -", "", "=日本      -  2.0  3.0"]
    assert list(to_text(TABLE)) == [whole]
    narrow = [["         a b    c", "x_1    1,234  0.2", "", "=日本      -  2.0"], ["         d", "x_1      -", "", "=日本  3.0"]]
    assert list(to_text(TABLE, 18)) == narrow


def test_latex_has_rules_and_escaped_names():
    assert to_latex(TABLE).splitlines()[2:8] == [
        r" & \multicolumn{2}{c}{a method} & \multicolumn{1}{c}{m} \\",
        r"\cmidrule(lr){2-3}\cmidrule(lr){4-4}",
        r" & a b & c & d \\",
        r"x\_1 & 1,234 & 0.2 & -- \\",
        r"\midrule",
        r"=日本 & -- & 2.0 & 3.0 \\",
    ]


def test_names_in_csv_cannot_become_formulas_unless_they_are_to_stay_exact():
    assert to_csv(TABLE) == "name,a_b,c,d\nx_1,1.23e+03,0.25,\n'=日本,,2.0,3.0\n"
    assert to_csv(Table("names", "", (Column("name"),), [("[red]x",), ("\x1b[2J",)])) == "name\n[red]x\n\\x1b[2J\n"
    assert to_csv(TABLE, exact=True) == "name,a_b,c,d\nx_1,1.23e+03,0.25,\n=日本,,2.0,3.0\n"


# ---- hostile settings ----

TABLES = "".join(f"[[object_rows]]\nid = {index // 2}\ndiameter = 1\n" for index in range(20_000))


def refusal_at_once(file: Path) -> str:
    """Load a file, expect an error in one line within SECONDS, and return the message."""
    started = time.monotonic()
    said = refusal(load_config, file)
    assert time.monotonic() - started < SECONDS
    assert len(said) < 1000
    return said


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a." * 100_000 + "b = 1", "is not valid TOML: a key has more than 8 parts"),
        ("[bake]\nseed = " + "[" * 100_000, "is not valid TOML: its values are nested too deeply"),
        ("[bake]\nseed = " + "9" * 5000, "is not valid TOML: a number has more digits than any setting"),
        ("[bake]\nseed = 0x" + "f" * 5000, "bake.seed is a number of thousands of digits in "),
        ("[bake]\nepisodes = " + "9" * 400, "allowed: a whole number of at most 64 bits, as TOML has"),
        ("[physics]\ngravity = 0x" + "f" * 5000, "physics.gravity is a number of thousands of digits in "),
        ("[bake]\nmix = [0x" + "f" * 5000 + "]", "bake.mix is a list in "),
        ('["a\\nb"]\nc = 1', "there is no section a\\nb, set in "),
        ("[bake]\n" + "w" * 1_000_000 + " = 1", "there is no key bake.www"),
        (TABLES, "allowed: one row per id; 0 comes 2 times"),
        ("#" * 2_000_000, "is larger than 1 MiB, the limit for such files"),
    ],
    ids=lambda value: value[:10],
)
def test_hostile_files_are_one_line_at_once(tmp_path, text, said):
    """Faults 13 and 18."""
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    assert said in refusal_at_once(tmp_path / "my.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("physics.step=1e-3\nbake.seed=2", "--set physics.step is followed by further lines; write one --set for each setting"),
        ("bake.seed=1\nb=2", "--set bake.seed is followed by further lines; write one --set for each setting"),
        ("bake.seed=" + "9" * 5000, 'bake.seed is "99999'),
        ("bake.seed=0x" + "f" * 5000, "bake.seed is a number of thousands of digits on the command line"),
        ("bake.seed=" + "[" * 100_000, 'bake.seed is "[[['),
        ("bake.seed={" + "a." * 50_000 + "b=1}", 'bake.seed is "{a.a.'),
        ("a." * 50_000 + "b=1", "there is no section a, set on the command line"),
        ("bake." + "a." * 50_000 + "b=1", "there is no key bake.a.a.a"),
        ("a" * 100_000, "--set aaaa"),
        ("bake.device=cuda:" + "9" * 5000, ""),
    ],
    ids=lambda value: value[:16],
)
def test_hostile_assignments_are_one_line_at_once(tmp_path, text, said):
    """Fault 13; and of two lines, the second was dropped."""
    started = time.monotonic()
    command = ("bake", f"--out={tmp_path / 'deep' / 'set'}", "--device=cpu") if said else ("doctor",)
    line = mistake(*command, "--set", text)
    assert time.monotonic() - started < SECONDS
    assert line.startswith(said)
    assert len(line) < 2100
    assert list(tmp_path.iterdir()) == []


KEYS = [f"{section}.{name}" for section, kind in sections().items() for name in settings_of(kind)]
NUMBERS = ["1", "0", "-1", "0.5", "1e308", "-1e308", "nan", "inf", "9" * 19, "-9223372036854775808", "9" * 5000, "0x" + "f" * 5000]
LISTS = ["[]", "[1, 2]", "[0, 0, 0]", "[[0, 0, 1]]", "[1e308, 1e308, 1e308]", "[[1e308, 0, 0], [0, 1e308, 0]]", '["flow", "flow"]']
STRINGS = ['""', '"move"', '"\\u0000"', '"\\ud800"', "'''\n'''"]
ODD_VALUES = ["true", "1979-05-27", "07:32:00", "{}", "{a = {b = 1}}", "[" * 3000, "= =", "1\n[bake]", "1 # x"]
VALUES = st.sampled_from([*NUMBERS, *LISTS, *STRINGS, *ODD_VALUES]) | st.text(max_size=12)
WORDS = st.sampled_from([*KEYS, *sections(), "preset", "object_rows", "a.b.c.d", '"a\\nb".c', ""]) | st.text(max_size=8)
NAMES = st.sampled_from(sorted({key.split(".")[1] for key in KEYS} | set(settings_of(ObjectRow)))) | st.text(max_size=8)
LINES = st.one_of(
    st.builds("{} = {}".format, WORDS, VALUES),
    st.builds("{} = {}".format, NAMES, VALUES),
    st.sampled_from(["[bake]", "[physics]", "[cameras]", "[[object_rows]]", "[object_rows]", "[[bake]]", 'preset = "smoke"', "preset = 3"]),
    st.sampled_from(["\ufeff", "\0", "#", '"""', "'''", "[" * 3000, "a." * 3000, "id = 1\ndiameter = 0.1"]),
)


def check_config(load: Callable[[], Config]) -> None:
    """Load a configuration, which is complete, since it can be written; or expect one printable line."""
    try:
        config = load()
    except ConfigError as error:
        message = str(error)
    else:
        message = config_to_toml(config)[:1]
    assert message.isprintable()
    assert message


@settings(max_examples=fuzz_examples(150))
@given(lines=st.lists(LINES, max_size=6))
def test_any_document_is_a_configuration_or_one_line(tmp_path_factory, lines):
    file = tmp_path_factory.getbasetemp() / "fuzz.toml"
    file.write_bytes("\n".join(lines).encode("utf-8", "surrogatepass"))
    check_config(lambda: load_config(file))


@settings(max_examples=fuzz_examples(150))
@given(pairs=st.lists(st.tuples(st.sampled_from(KEYS), VALUES), max_size=3))
def test_any_values_of_settings_are_a_configuration_or_one_line(tmp_path_factory, pairs):
    file = tmp_path_factory.getbasetemp() / "values.toml"
    file.write_text("".join(f"{key} = {value}\n" for key, value in pairs), encoding="utf-8", errors="surrogatepass")
    check_config(lambda: load_config(file))
    check_config(lambda: load_config("smoke", dict(parse_assignment(f"{key}={value}") for key, value in pairs)))


@settings(max_examples=fuzz_examples(150))
@given(texts=st.lists(st.builds("{}={}".format, WORDS, VALUES) | st.text(max_size=12), max_size=4))
def test_any_assignments_are_a_configuration_or_one_line(texts):
    check_config(lambda: load_config("smoke", dict(map(parse_assignment, texts))))


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=8) | st.binary(max_size=4)
OBJECTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3), max_leaves=8
)


@settings(max_examples=fuzz_examples(150))
@given(overrides=st.dictionaries(st.sampled_from(KEYS) | SCALARS, OBJECTS, max_size=3), preset=st.just("smoke") | OBJECTS)
@example(overrides={10**5000: 1}, preset="smoke")
@example(overrides={}, preset=10**5000)
def test_any_objects_from_python_are_a_configuration_or_one_line(overrides, preset):
    check_config(lambda: load_config(preset, overrides))
