"""Hostile settings: TOML files and `--set` values of any content give a configuration or one line, at once."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from synpick_warp.configs.fields import settings_of
from synpick_warp.configs.files.load import load_config, parse_assignment, sections
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Config, ObjectRow
from synpick_warp.errors import ConfigError
from tests.builders import mistake, refusal
from tests.harness.fuzz import fuzz_examples

SECONDS = 5.0
"""Longest time that any settings may take."""
ROWS = "".join(f"[[object_rows]]\nid = {index // 2}\ndiameter = 1\n" for index in range(20_000))


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
        (ROWS, "allowed: one row per id; 0 comes 2 times"),
        ("#" * 2_000_000, "is larger than 1 MiB, the limit for such files"),
    ],
    ids=lambda value: value[:10],
)
def test_hostile_files_are_one_line_at_once(tmp_path, text, said):
    """Faults 13 and 18."""
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    assert said in refusal_at_once(tmp_path / "my.toml")


def test_files_that_are_not_regular_are_refused(tmp_path):
    """Fault 18: a FIFO hung, /dev/zero was read until memory ended."""
    os.mkfifo(tmp_path / "fifo.toml")
    (tmp_path / "zero.toml").symlink_to("/dev/zero")
    (tmp_path / "loop.toml").symlink_to("loop.toml")
    for name in ("fifo", "zero"):
        assert refusal_at_once(tmp_path / f"{name}.toml") == f"{tmp_path}/{name}.toml is not a regular file"
    assert "cannot be read" in refusal_at_once(tmp_path / "loop.toml")
    assert "there is no file" in refusal_at_once(Path("a\0.toml"))


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
OTHERS = ["true", "1979-05-27", "07:32:00", "{}", "{a = {b = 1}}", "[" * 3000, "= =", "1\n[bake]", "1 # x"]
VALUES = st.sampled_from([*NUMBERS, *LISTS, *STRINGS, *OTHERS]) | st.text(max_size=12)
WORDS = st.sampled_from([*KEYS, *sections(), "preset", "object_rows", "a.b.c.d", '"a\\nb".c', ""]) | st.text(max_size=8)
NAMES = st.sampled_from(sorted({key.split(".")[1] for key in KEYS} | set(settings_of(ObjectRow)))) | st.text(max_size=8)
LINES = st.one_of(
    st.builds("{} = {}".format, WORDS, VALUES),
    st.builds("{} = {}".format, NAMES, VALUES),
    st.sampled_from(["[bake]", "[physics]", "[cameras]", "[[object_rows]]", "[object_rows]", "[[bake]]", 'preset = "smoke"', "preset = 3"]),
    st.sampled_from(["\ufeff", "\0", "#", '"""', "'''", "[" * 3000, "a." * 3000, "id = 1\ndiameter = 0.1"]),
)


def check(load: Callable[[], Config]) -> None:
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
    check(lambda: load_config(file))


@settings(max_examples=fuzz_examples(150))
@given(pairs=st.lists(st.tuples(st.sampled_from(KEYS), VALUES), max_size=3))
def test_any_values_of_settings_are_a_configuration_or_one_line(tmp_path_factory, pairs):
    file = tmp_path_factory.getbasetemp() / "values.toml"
    file.write_text("".join(f"{key} = {value}\n" for key, value in pairs), encoding="utf-8", errors="surrogatepass")
    check(lambda: load_config(file))
    check(lambda: load_config("smoke", dict(parse_assignment(f"{key}={value}") for key, value in pairs)))


@settings(max_examples=fuzz_examples(150))
@given(texts=st.lists(st.builds("{}={}".format, WORDS, VALUES) | st.text(max_size=12), max_size=4))
def test_any_assignments_are_a_configuration_or_one_line(texts):
    check(lambda: load_config("smoke", dict(map(parse_assignment, texts))))


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(st.characters(), max_size=8) | st.binary(max_size=4)
OBJECTS = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner, max_size=3), max_leaves=8
)


@settings(max_examples=fuzz_examples(150))
@given(overrides=st.dictionaries(st.sampled_from(KEYS) | SCALARS, OBJECTS, max_size=3), preset=st.just("smoke") | OBJECTS)
@example(overrides={10**5000: 1}, preset="smoke")
@example(overrides={}, preset=10**5000)
def test_any_objects_from_python_are_a_configuration_or_one_line(overrides, preset):
    check(lambda: load_config(preset, overrides))
