"""Asset files of users: size limits, file names, encodings of text, and the files that a model or a set of lights refers to.

A model folder or light folder may come from anywhere. Its files are read whole, up to the limits here, and libraries get bytes.
"""

import codecs
import logging
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from synpick_warp.errors import CatalogError, SynpickError
from synpick_warp.system.inputs.files import MAX_NAME, path_inside, read_file
from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

MAX_MESH_FILE = 2**28
"""Largest binary mesh file [bytes]: 256 MiB, some 2 million triangles with their textures."""
MAX_TEXT_MESH = 2**27
"""Largest OBJ or ASCII PLY file [bytes]: 128 MiB, since text takes several times its size while it is read."""
MAX_ROWS = 2**21
"""Maximum number of vertices, and of triangles, of one model: 2 million; finer scans show no more at any resolution here."""
MAX_PARTS = 2**12
"""Maximum number of parts, materials, nodes or buffers of one model: 4096."""
MAX_SHOWN, MAX_LISTED = 200, 8
"""Length to which a library's message is cut, and number of names or notes that a line lists."""

_Image = TypeVar("_Image")
# Texture folders of common exporters, relative to the folder of the mesh or of the object.
_TEXTURE_FOLDERS = ((), ("textures",), ("texture",), ("materials", "textures"), ("materials",), ("maps",), ("images",), ("tex",))

# Readers log what they leave out; without a handler, Python prints such lines to standard error.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

_MARKS = ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF32_LE, "utf-32"), (codecs.BOM_UTF32_BE, "utf-32"))
_MARKS += ((codecs.BOM_UTF16_LE, "utf-16"), (codecs.BOM_UTF16_BE, "utf-16"))
_SAMPLE = 1024
_COMMA = re.compile(r"(?im)^[ \t]*(?=v|facet +normal|[-+.0-9]).*?(?<![\w,.])([-+]?[0-9]+,[0-9]+(?:e[-+]?[0-9]+)?)(?![\w.])")
"""Decimal comma in a line of coordinates."""


class MissingFileError(CatalogError):
    """A referenced file does not exist; `name` is its name."""

    def __init__(self, message: str, name: str = "") -> None:
        super().__init__(message)
        self.name = name


def ignore(line: str) -> None:
    """Default for `report`: drops the line."""


def list_names(names: Iterable[str]) -> str:
    """Comma-separated names for a message: at most MAX_LISTED, then the number of the others."""
    listed = list(names)
    return ", ".join(listed[:MAX_LISTED] + ([f"{len(listed) - MAX_LISTED} more"] if len(listed) > MAX_LISTED else []))


@dataclass(eq=False)
class Notes:
    """Log of a mesh import: warnings on replaced images, and unsupported features; one line per file."""

    substitute: bool = False
    """Whether a missing image is replaced by a plain colour, with a warning; otherwise it is an error."""
    said: list[str] = field(default_factory=list)
    """Warnings on missing images and their replacements."""
    ignored: list[str] = field(default_factory=list)
    """Names of unsupported features that the file uses."""

    def image(self, read: Callable[[], _Image]) -> _Image | None:
        """Result of `read`; None if the image is missing and a plain colour replaces it."""
        try:
            return read()
        except MissingFileError as error:
            if not self.substitute:
                raise
            self.said.append(f"the image {ascii(error.name)[:80]} is missing, a plain colour is used")
            return None

    def line(self, source: object) -> str | None:
        """All notes as one line; None: there are none."""
        said = list(dict.fromkeys(self.said))[:MAX_LISTED]
        said += [f"ignored: {list_names(dict.fromkeys(self.ignored))}"] if self.ignored else []
        return f"{source}: {'; '.join(said)}" if said else None


def read_isolated(
    function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], limits: Limits, error: type[SynpickError], smaller: str, repair: str
) -> Iterator[Any]:
    """Call a function for files, in a process each (`run_isolated`). `calls`: its arguments; the first is the path, or has it as `path`.
    `smaller`: advice for a file for which time or memory of this machine does not suffice. `repair`: advice for a file on which the process
    crashes. Yields what the function returned, or as `error` why there is nothing. Raises SynpickError: as `error`: time or memory does not
    suffice, so that elsewhere the same file might be read."""
    for (file, *_), result in zip(calls, run_isolated(function, calls, limits), strict=True):
        if isinstance(result, Failure):
            advice = smaller if result.by_machine else repair
            fault = error(f"{getattr(file, 'path', file)}: the process that reads it {result.reason}; {advice}")
            if result.by_machine:
                raise fault
            yield fault
        else:
            yield error(str(result)) if isinstance(result, SynpickError) and not isinstance(result, error) else result


@contextmanager
def quiet_decoding() -> Iterator[None]:
    """Silence warnings of NumPy and Pillow, since decoded values are validated afterwards. Text that is not a number remains an error."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*could not be read to its end.*")
        yield


def check_file_name(path: Path, error: type[SynpickError]) -> None:
    """Check that a file's name is printable UTF-8, since it becomes a name in the data set; raises `error`."""
    if not path.name.isprintable():
        shown = ascii(path.name)[1:-1]
        raise error(f'{ascii(str(path.parent))[1:-1]}: the file name "{shown}" is not printable UTF-8; rename the file')


def describe_error(error: BaseException) -> str:
    """Message of a library's exception as one short line."""
    if isinstance(error, ImportError):
        return "it uses a feature of the format that is not supported"
    text = " ".join(str(error).split()) or type(error).__name__
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


@contextmanager
def reading_as(kind: str, path: Path, data: bytes = b"") -> Iterator[None]:
    """Convert any exception of a reader to a `CatalogError`: damaged files can raise nearly every type. `data`: content of the file if it
    may be text, whose numbers may have decimal commas, as written under some locales."""
    try:
        yield
    except CatalogError:
        raise
    except Exception as error:
        if (match := _COMMA.search(decode_text(data))) is not None:
            raise CatalogError(f"{path}: its numbers have decimal commas, such as {match[1][:40]}; export it with decimal points") from None
        raise CatalogError(f"{path}: not readable as {kind} ({describe_error(error)})") from error


@dataclass(frozen=True)
class AssetScope:
    """Sandbox of an object's asset references: its root folder, and the references that were resolved to another path."""

    root: Path
    """Root folder of the object: references may lead up to it, but not out of it."""
    moved: list[str] = field(default_factory=list)
    """A line for each reference that was resolved to another path."""


_scope: ContextVar[AssetScope | None] = ContextVar("scope", default=None)


@contextmanager
def asset_scope(root: Path) -> Iterator[AssetScope]:
    """Allow references to the object's whole folder in this context; without it, files may refer to their own folder only."""
    token = _scope.set(scope := AssetScope(root))
    try:
        yield scope
    finally:
        _scope.reset(token)


def read_referred(folder: Path, name: str, owner: object, limit: int) -> tuple[Path, bytes]:
    """Read a file of up to `limit` bytes that the model file `owner` refers to, within the object's folder only (`asset_scope`).

    A name that is not there is also tried with Windows' separators, in other letter case, and in the folders where exporters put textures.
    Raises MissingFileError: there is no such file; CatalogError: the name leads out of the folder, or the file is too large or not a
    regular file."""
    scope = _scope.get() or AssetScope(folder)
    path = locate(folder, name, owner, CatalogError, scope.root)
    if not os.path.lexists(path):
        message = f"{owner} refers to {name!a}, but there is no file {path}; add it or remove the reference"
        inside = (folder / name.replace("\\", "/")).resolve().is_relative_to(scope.root.resolve())
        raise MissingFileError(message, name) if inside else CatalogError(message)
    if os.path.normpath(path) != os.path.normpath(folder / name):
        scope.moved.append(f"{owner} refers to {name!a}; {path} is read")
    return path, read_file(path, limit, CatalogError)


def is_missing(folder: Path, name: str, owner: object) -> bool:
    """Whether a reference has no file in the object's folder (see `read_referred`)."""
    scope = _scope.get() or AssetScope(folder)
    try:
        return not os.path.lexists(locate(folder, name, owner, CatalogError, scope.root))
    except CatalogError:
        return True


def locate(folder: Path, name: str, owner: object, error: type[SynpickError], root: Path | None = None) -> Path:
    """Path of a referenced file; if it does not exist, of the file that the reference may mean (see `read_referred`), if any. `root`:
    folder that the name must not lead out of; None: `folder`. Raises SynpickError: as `error`: the name leads out of the folder."""
    path, fault = folder, None
    try:
        path = path_inside(folder, name, owner, error)
    except SynpickError as caught:
        fault = caught
    if fault is None and os.path.lexists(path):
        return path
    found = _find_elsewhere(folder, name, root or folder) if name.isprintable() and len(name) <= MAX_NAME else None
    if found is None and fault is not None:
        raise fault
    return found or path


def _find_elsewhere(folder: Path, name: str, root: Path) -> Path | None:
    """File inside `root` that a reference from `folder` may mean; None: there is none."""
    parts = [part for part in re.sub(r"^[A-Za-z]:", "", name).replace("\\", "/").split("/") if part not in ("", ".")]
    if not parts:
        return None
    places = [(folder, parts)]
    if ".." not in parts:
        places += [(base, [*place, parts[-1]]) for base in dict.fromkeys((folder, root)) for place in _TEXTURE_FOLDERS]
    whole = root.resolve()
    for base, names in places:
        path = _match_case(base, names)
        if path is not None and path.is_file():
            return path if path.resolve().is_relative_to(whole) else None
    return None


def _match_case(folder: Path, names: Sequence[str]) -> Path | None:
    """Case-insensitive path lookup from a folder; exact matches first. None: there is no such entry."""
    path = folder
    for name in names:
        if name == "..":
            path = path.parent
            continue
        if not (path / name).exists():
            try:
                entries = sorted(path.iterdir()) if path.is_dir() else []
            except OSError:
                return None
            name = next((entry.name for entry in entries if entry.name.casefold() == name.casefold()), "")
            if not name:
                return None
        path = path / name
    return path


def decode_text(data: bytes) -> str:
    """Decode text: UTF-8, UTF-16 or UTF-32 by its byte order mark, UTF-16 without one by its zeros, otherwise UTF-8, or Latin-1.

    Damaged characters of UTF-16 and UTF-32 are replaced; names and comments alone have any beyond ASCII.
    """
    for mark, encoding in _MARKS:
        if data.startswith(mark):
            return data.decode(encoding, "replace")
    start = data[:_SAMPLE]
    for first, encoding in ((1, "utf-16-le"), (0, "utf-16-be")):
        # ASCII in UTF-16: every other byte is zero.
        if len(start) >= 4 and not any(start[first : len(start) // 2 * 2 : 2]) and all(start[1 - first : len(start) // 2 * 2 : 2]):
            return data.decode(encoding, "replace")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError:
        return data.decode("latin-1")
