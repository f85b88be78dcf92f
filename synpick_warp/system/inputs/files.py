"""Input files: bounded reads, paths inside a folder, JSON and TOML.

Reads take regular files up to a size limit, and never block on a pipe or read a device. Names read from a file are resolved inside a folder
(prevention of path traversal, CWE-22). JSON is decoded with a schema: msgspec types, with path and position of the first mismatch in the
error; numbers are finite, integers fit into 64 bits unless declared otherwise, nesting ends at Python's recursion limit. TOML has limits on
size, nesting and the length of dotted keys, where the standard library's parser is quadratic.
"""

import codecs
import os
import re
import stat
import tomllib
from itertools import takewhile
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import msgspec

from synpick_warp.errors import SynpickError

_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY
_BLOCK = 1 << 20
"""Read at a time after the stated size [bytes]."""


def read_file(path: Path | str, limit: int, error: type[SynpickError]) -> bytes:
    """Read a regular file of at most `limit` bytes, or what a symbolic link to one names. Raises SynpickError: as `error`, in one line:
    there is no such file, it is not a regular file, is too large, or cannot be read."""
    data = read_file_if_present(path, limit, error)
    if data is None:
        raise error(f"there is no file {path}")
    return data


def read_file_if_present(path: Path | str, limit: int, error: type[SynpickError]) -> bytes | None:
    """Read a regular file as `read_file`; None: there is no such file."""
    try:
        handle = os.open(path, _FLAGS)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as fault:  # ValueError: a name with a null byte.
        raise error(f"{path} cannot be read: {getattr(fault, 'strerror', None) or fault}") from None
    try:
        state = os.fstat(handle)
        if not stat.S_ISREG(state.st_mode):
            raise error(f"{path} is not a regular file")
        data = _read_all(handle, state.st_size, limit) if state.st_size <= limit else None
    except OSError as fault:
        raise error(f"{path} cannot be read: {fault.strerror}") from None
    finally:
        os.close(handle)
    if data is None or len(data) > limit:
        raise error(f"{path} is larger than {describe_bytes(limit)}, the limit for such files")
    return data


def _read_all(handle: int, size: int, limit: int) -> bytes:
    """Read to the end, or one byte more than `limit`: a file may be longer than the `size` that it has stated."""
    data = os.read(handle, size + 1)
    if len(data) == size:
        return data
    parts = [data]
    while data and (left := limit + 1 - sum(map(len, parts))) > 0:
        data = os.read(handle, min(left, _BLOCK))
        parts.append(data)
    return b"".join(parts)


def check_regular_file(path: Path, limit: int, error: type[SynpickError]) -> None:
    """Check that a library may open a path by name: a regular file up to `limit` bytes. Raises as `read_file`."""
    try:
        state = path.stat()
    except FileNotFoundError:
        raise error(f"there is no file {path}") from None
    except (OSError, ValueError) as fault:
        raise error(f"{path} cannot be read: {getattr(fault, 'strerror', None) or fault}") from None
    if not stat.S_ISREG(state.st_mode):
        raise error(f"{path} is not a regular file")
    if state.st_size > limit:
        raise error(f"{path} is larger than {describe_bytes(limit)}, the limit for such files")


def describe_bytes(count: int) -> str:
    """Format a size, rounded down to whole KiB, MiB or GiB."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20), ("KiB", 2**10)):
        if count >= size:
            return f"{count // size} {unit}"
    return f"{count} bytes"


MAX_NAME = 4096
"""Longest name in characters: PATH_MAX of Linux."""


def path_inside(folder: Path, name: str, source: object, error: type[SynpickError]) -> Path:
    """Resolve a relative name to a path inside a folder. Nothing has to exist there.

    Symbolic links may lead to other places inside the folder, never out of it. `folder`: the folder that must contain the path. `name`:
    relative name with "/" between its parts, as read from the file `source`. Raises SynpickError: as `error`: the name is empty, absolute,
    has parts "..", control characters, or leads out of the folder by a link."""
    parts = PurePosixPath(name).parts
    if not parts or len(name) > MAX_NAME or ".." in parts or name.startswith("/") or not name.isprintable():
        raise error(f"{source} names the file {_quote(name)}; allowed: a relative name without .. inside {folder}")
    path = folder.joinpath(*parts)
    try:
        root, target = folder.resolve(), path.resolve()
    except (OSError, RuntimeError) as fault:  # A name too long for the file system; links in a circle.
        raise error(f"{source} names the file {_quote(name)}, which cannot be resolved: {fault}") from None
    if target == root or not target.is_relative_to(root):
        raise error(f"{source} names the file {_quote(name)}, which leads out of {folder} by a symbolic link")
    return path


def _quote(name: str) -> str:
    """Name in quotes for a message: cut to 80 characters, unprintable ones escaped."""
    shown = name if len(name) <= 80 else f"{name[:79]}…"
    return f'"{shown.encode("unicode_escape").decode() if not shown.isprintable() else shown}"'


def make_folder(folder: Path) -> None:
    """Create a folder with its parents, unless it exists: `mkdir -p`. `Path.mkdir` calls itself for each parent, which ends at 1,000.
    Raises OSError: as `Path.mkdir`; FileExistsError: it is a file."""
    missing = list(takewhile(lambda each: not os.path.lexists(each), (folder, *folder.parents)))
    for each in reversed(missing or [folder]):
        each.mkdir(exist_ok=True)


MAX_JSON = 2**29
"""Largest JSON file [bytes]; the annotations of a long episode at full HD have some 10 MB."""
_Content = TypeVar("_Content")


def decode_json(data: bytes, schema: type[_Content], source: object, error: type[SynpickError], advice: str = "") -> _Content:
    """Decode JSON and validate it against a schema. `schema`: type of the content as msgspec understands it: a Struct, a TypedDict,
    `dict[str, int]`, `Any`. `source`: where it comes from, for messages: a path, or a path with a line number. `advice`: end of the
    message: what to do. Raises SynpickError: as `error`, in one line: not JSON, or not of this schema."""
    try:
        return msgspec.json.decode(data, type=schema)
    except (ValueError, RecursionError) as fault:  # msgspec's errors are ValueErrors.
        raise error(f"{source} is damaged: {_describe(fault)}{advice and f'; {advice}'}") from None


def read_json(path: Path, schema: type[_Content], error: type[SynpickError], advice: str = "", limit: int = MAX_JSON) -> _Content:
    """Read and validate a JSON file; arguments and errors as `decode_json` and `read_file`."""
    return decode_json(read_file(path, limit, error), schema, path, error, advice)


def _describe(fault: Exception) -> str:
    """Format a decoding error as part of an error message."""
    text: Any = "nested too deeply" if isinstance(fault, RecursionError) else str(fault).replace("`", "")
    return text if text.startswith("JSON") else f"{text[:1].lower()}{text[1:]}"


MAX_TOML = 2**20
"""Maximum size of a TOML file [bytes]; all settings with comments take 30 kB."""
MAX_KEY_PARTS = 8
"""Maximum number of parts of a dotted key; settings have two."""
_STRINGS = re.compile(r'"""(?:[^\\]|\\.)*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:[^"\\\n]|\\.)*+"?|\'[^\'\n]*+\'?|#[^\n]*+', re.DOTALL)
"""Strings and comments, which may be left unclosed. Both patterns take linear time."""
_LONG_KEY = re.compile(rf"(?<![\w'-])(?:[\w'-]++[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")
"""A key of more than MAX_KEY_PARTS parts."""


def decode_toml(text: str) -> dict[str, Any]:
    """Decode TOML. Raises ValueError: the text is not TOML, or exceeds a limit; the message says which."""
    if _LONG_KEY.search(_STRINGS.sub("''", text)):
        raise ValueError(f"a key has more than {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("its values are nested too deeply") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # Python's limit on decimal digits; its message advises programmers.
        raise ValueError("a number has more digits than any setting") from None


def read_toml(path: Path, error: type[SynpickError]) -> dict[str, Any]:
    """Read a TOML file, with a byte order mark or without. Raises SynpickError: as `error`, in one line: it cannot be read, is too large,
    is not UTF-8, or is not TOML."""
    data = read_file(path, MAX_TOML, error)
    if data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)) or b"\0" in data[:4]:
        raise error(f"{path} is text in UTF-16 or UTF-32, which TOML does not allow; save it as UTF-8")
    try:
        return decode_toml(data.decode("utf-8-sig"))
    except UnicodeDecodeError as fault:
        raise error(f"{path} is not valid TOML: byte {fault.start} is not UTF-8") from None
    except ValueError as fault:
        text = str(fault)
        raise error(f"{path} is not valid TOML: {text[:1].lower()}{text[1:]}") from None
