"""Untrusted input: paths stay inside their folder, reads are bounded, and every mistake is one line."""

from __future__ import annotations

import os
import time
import tomllib
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.files import check_regular_file, read_file
from synpick_warp.system.inputs.json import decode_json
from synpick_warp.system.inputs.paths import path_inside
from synpick_warp.system.inputs.toml import MAX_TOML, decode_toml, read_toml

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
        (b'{"count": 1, "name": "\xff"}', "codec can't decode"),
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


def test_a_byte_order_mark_is_no_part_of_toml(tmp_path):
    (tmp_path / "a.toml").write_bytes(b"\xef\xbb\xbfa = 1\r\n")
    assert read_toml(tmp_path / "a.toml", DatasetError) == {"a": 1}
