"""File writes: atomic replacement by rename, fsync, many files of one folder, the check that an output folder is usable, and
SHA-256 lists in the format of `sha256sum`."""

import contextlib
import ctypes
import errno
import hashlib
import json
import os
import re
import shutil
import stat
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.system.inputs.files import make_folder, path_inside
from synpick_warp.system.inputs.urls import store_url

PARTIAL = ".partial"
"""Staging folder in the data set for uncommitted files: on the same file system, so that a rename commits them atomically.

The name is reserved beside a manifest, which is written first and removed last; a folder of this name without a manifest is not ours, and
is neither used nor removed."""
LINES = ".lines"
"""Folder of index lines made by the worker of each episode: LINES/INDEX/NUMBER are the parts of the file INDEX, which are concatenated
by their numbers. It exists only where a data set in an object store is finalized."""
MANIFEST_FILE = "manifest.json"
"""Marks a folder as a data set."""
Buffer = bytes | memoryview
"""Contiguous bytes."""
_WRITE = os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC
_JOIN_BYTES = 1 << 20
"""Size of a block of lines that are joined [B]."""
_LITTER = ("thumbs.db", "ehthumbs.db", "desktop.ini")
"""What Windows leaves in folders, in lower case."""
_ALLOWED = "--out takes a new or an empty folder"


def check_output_folder(out: Path) -> None:
    """Check that a data set can be written to a folder; creates nothing that stays. Raises OutputError if the folder holds something other
    than a data set, lies in another data set, or cannot be created or written."""
    check_local(out, "--out")
    _check_outside(out)
    created = [folder for folder in (out, *out.parents) if not os.path.lexists(folder)]
    try:
        make_folder(out)
        # Other hidden names are never touched: what a bake leaves that was killed before its manifest, or the user's, such as .git.
        names = [] if (out / MANIFEST_FILE).exists() else [name for name in os.listdir(out) if name == PARTIAL or not is_litter(name)]
        if names:
            kind = "a folder" if (out / PARTIAL).is_dir() else "a file"
            reason = f": it has {kind} {PARTIAL} of another program" if names == [PARTIAL] else ""
            raise OutputError(f"{out} is not empty{reason}; {_ALLOWED}, or a data set to resume")
        with tempfile.TemporaryFile(dir=out, buffering=0) as probe:  # It has no name that would stay after a kill.
            probe.write(b"\0")
    except FileExistsError:
        raise OutputError(f"{out} is a file; {_ALLOWED}") from None
    except OSError as error:
        raise output_error(out, error) from error
    finally:
        for folder in created:
            with contextlib.suppress(OSError):
                folder.rmdir()


def check_local(out: Path, option: str) -> None:
    """Raise OutputError if an option names a place in an object store, into which only a bake writes."""
    if (url := store_url(out)) is not None:
        raise OutputError(f"{option} is {url}; only bake writes into object stores: name a path on this machine, and copy it there")


def _check_outside(out: Path) -> None:
    """Raise OutputError if a data set would lie in another one, whose files it would mix with, or its path cannot be resolved."""
    try:
        parents = out.resolve().parents
        outer = next((each for each in parents if (each / MANIFEST_FILE).is_file() and (each / "manifest").is_dir()), None)
    except (OSError, RuntimeError, ValueError) as error:
        raise OutputError(f"--out is {out}: {getattr(error, 'strerror', None) or error}; {_ALLOWED}") from None
    if outer is not None:
        raise OutputError(f"--out is {out}, among the files of the data set {outer}; name a folder outside of it")


def is_litter(name: str) -> bool:
    """Whether a name is one that file managers and editors leave in folders, or is hidden: `.DS_Store`, `._x`, `Thumbs.db`, `.x.swp`, `x~`.
    No format has such names."""
    return name.startswith(".") or name.endswith("~") or name.lower() in _LITTER


def remove_folder(folder: Path, *, ignore_errors: bool = False) -> None:
    """Remove a folder with its content, if it is one. `shutil.rmtree` would open a pipe of this name and wait for its other end."""
    if is_folder(folder):
        shutil.rmtree(folder, ignore_errors=ignore_errors)


def is_folder(path: Path) -> bool:
    """Whether a path is a folder, not a link to one."""
    return path.is_dir() and not path.is_symlink()


def output_error(path: Path | str, error: OSError) -> OutputError:
    """Convert an operating-system error into an `OutputError` of one line that names the file, the reason and the remedy."""
    reason = error.strerror or str(error) or type(error).__name__
    return OutputError(f"cannot write {error.filename or path}: {reason}; free space or rights there, or name another folder with --out")


@contextlib.contextmanager
def output_errors(path: Path | str) -> Iterator[None]:
    """Convert operating-system errors of the enclosed code by `output_error`."""
    try:
        yield
    except OSError as error:
        raise output_error(path, error) from error


def write_atomically(path: Path, data: bytes | Iterable[bytes]) -> None:
    """Replace a file atomically and durably: write a hidden sibling, fsync, rename, fsync the folder.

    Readers find either the old or the new content, even after a power cut. `data`: the content, or its pieces in order.
    """
    temporary = path.with_name(f".{path.name}.new")
    try:
        temporary.unlink(missing_ok=True)  # A link of this name is not followed.
        write_synced(temporary, data)
        temporary.replace(path)
    except BaseException:
        with contextlib.suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def write_synced(path: Path, data: bytes | Iterable[bytes], folder: Path = Path()) -> str:
    """Write a file, given whole or in pieces, and fsync it; returns its `checksum_line`, in that folder."""
    digest, size = hashlib.sha256(), 0
    with path.open("wb") as file:
        for piece in [data] if isinstance(data, bytes) else data:
            digest.update(piece)
            size += file.write(piece)
        file.flush()
        os.fsync(file.fileno())
    return checksum_line(digest.hexdigest(), size, str(folder / path.name))


def join_lines(parts: Iterable[Path], begin: bytes, end: bytes) -> Iterator[bytes]:
    """Lines of files, which all end in a newline, as the rows of a JSON list or object, lazily: `begin`, lines behind commas, `end`."""
    yield begin + b"\n"
    held = b""
    for part in parts:
        with part.open("rb") as file:
            while block := file.read(_JOIN_BYTES):
                block = held + block
                held = b"\n" if block.endswith(b"\n") else b""
                yield block.removesuffix(b"\n").replace(b"\n", b",\n")
    yield b"\n" + end


def sync_file(path: Path) -> None:
    """fsync a file that other code (USD, zarr) has written."""
    with path.open("rb") as file:
        os.fsync(file.fileno())


def sync_folder(folder: Path) -> None:
    """fsync a folder's list of names, so that renames into it are durable."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_file_system(folder: Path) -> None:
    """Flush all that was written to a folder's file system, once for many thousand files: by syncfs of Linux, or where there is none, or a
    sandbox forbids it, by sync. Raises OSError if the system could not write some of it."""
    syncfs = getattr(ctypes.CDLL(None, use_errno=True), "syncfs", None)
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        code = syncfs(handle) and ctypes.get_errno() if syncfs else errno.ENOSYS
    finally:
        os.close(handle)
    if code in (errno.ENOSYS, errno.EINVAL, errno.EPERM):
        os.sync()
    elif code:
        raise OSError(code, os.strerror(code), str(folder))


class Folder:
    """Writer of many small files in one folder with the fewest system calls: openat relative to the folder's handle, write, close."""

    def __init__(self, path: Path, handle: int, hashes: bool) -> None:
        self._path = path
        self._handle = handle
        self._hashes = hashes
        self.checksums: list[str] = []
        """`checksum_line` of each written file, if the folder `hashes` them."""

    def write(self, name: str, data: Buffer, digest: str = "") -> None:
        """Write a file. `name` is relative to the folder; subfolders in it must exist. `digest`: its SHA-256, if known."""
        self._write(name, data, os.O_TRUNC)
        if self._hashes:
            self.checksums.append(checksum_line(digest or hashlib.sha256(data).hexdigest(), len(data), name))

    def append(self, name: str, data: Buffer) -> None:
        """Append to a file (O_APPEND). Processes may append at the same time: the bytes of one call stay contiguous."""
        self._write(name, data, os.O_APPEND)

    def _write(self, name: str, data: Buffer, flag: int) -> None:
        """Write all of a file of this folder, opened with `flag`; raises OSError that names it."""
        try:
            handle = os.open(name, _WRITE | flag, 0o666, dir_fd=self._handle)
            try:
                written = os.write(handle, data)
                while written < len(data):
                    written += os.write(handle, memoryview(data)[written:])
            finally:
                os.close(handle)
        except OSError as error:
            raise OSError(error.errno, error.strerror, str(self._path / name)) from error


def checksum_line(digest: str, size: int, name: str) -> str:
    """Line of a list of files before they are in the manifest: SHA-256 in hexadecimal, size [bytes] and name."""
    return f"{digest} {size} {name}\n"


@contextlib.contextmanager
def open_folder(path: Path, spool: str = "") -> Iterator[Folder]:
    """Open a folder handle, so that the kernel resolves the folder's own path once instead of once a file. `spool`: file of the folder to
    which the checksum lines of the written files are appended at the end; empty: they are not hashed."""
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield (folder := Folder(path, handle, bool(spool)))
        if spool:
            folder.append(spool, "".join(folder.checksums).encode())
    finally:
        os.close(handle)


_LINE = re.compile(r"([0-9a-f]{64})  (.+)")
"""Line of a checksum list: digest and name."""
_RESERVED = (MANIFEST_FILE, "manifest", "config.toml", PARTIAL)
"""First parts of names that no list has: the data set's own records."""
_WHOLE = 1 << 22
"""Largest file that is read at once [bytes]."""
_FLAGS = os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOCTTY | os.O_NOFOLLOW


def open_regular(path: Path | str) -> int:
    """Open a regular file for reading. Raises FileNotFoundError, or OSError with a reason, also for a link, a pipe or a device."""
    try:
        handle = os.open(path, _FLAGS)
    except OSError as error:
        if os.path.islink(path):
            raise OSError(error.errno, "it is a symbolic link", str(path)) from None
        raise
    if not stat.S_ISREG(os.fstat(handle).st_mode):
        os.close(handle)
        raise OSError(0, "it is not a regular file", str(path))
    return handle


def checksum(path: Path | str, limit: int | None = None) -> str:
    """SHA-256 of a regular file, in hexadecimal. Raises as `open_regular`, and OSError if it is larger than `limit` [bytes]."""
    return _hash_file(path, limit)[0]


def parse_checksums(lines: bytes, folder: Path, source: Path, advice: str) -> dict[str, str]:
    """Parse a checksum list in the format of `sha256sum`: name, relative to the data set -> SHA-256.

    Raises DatasetError, with `source` and `advice` in its message, if the list is not UTF-8, a line is no digest and name, or a name leads
    out of the folder, is one of the data set's own records, or is there twice.
    """
    known: dict[str, str] = {}
    folders: set[str] = set()
    try:
        text = lines.decode()
    except UnicodeDecodeError as error:
        raise DatasetError(f"{source} is damaged: byte {error.start} is not UTF-8; {advice}") from None
    for number, line in enumerate(text.removesuffix("\n").split("\n") if text else (), start=1):
        match = _LINE.fullmatch(line)
        if match is None:
            raise DatasetError(f"{source}, line {number}, is damaged: it is not a SHA-256 and a name; {advice}")
        digest, name = match.groups()
        parent, _, last = name.rpartition("/")
        # Resolving a path takes several system calls: once for each folder, and for those of its names that are links.
        plain = not name.startswith("/") and last not in (".", "..") and last.isprintable()
        if parent not in folders or not plain or os.path.islink(f"{folder}/{name}"):
            path_inside(folder, name, f"{source}, line {number},", DatasetError)
            folders.add(parent)
        if name in known or name != str(Path(name)) or name.partition("/")[0] in _RESERVED:
            raise DatasetError(f"{source}, line {number}, is damaged: it names a file twice, or one of the data set's records; {advice}")
        known[name] = digest
    return known


def list_files(out: Path, paths: Sequence[Path]) -> list[str]:
    """Expand files and folders into the names of all files in them, relative to the data set, sorted and without duplicates.

    Names are strings: an episode has 100,000 files, and to create a `Path` takes as long as to hash a small file.
    """
    names: set[str] = set()
    for path in map(str, paths):
        names.update(_walk(f"{out}/{path}", path) if os.path.isdir(f"{out}/{path}") else (path,))
    return sorted(names)


def _walk(folder: str, name: str) -> Iterator[str]:
    """Yield the names of all files in a folder and its subfolders but litter, with `name` in place of the folder's path."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if is_litter(entry.name):
                continue
            if entry.is_dir():
                yield from _walk(entry.path, f"{name}/{entry.name}")
            else:
                yield f"{name}/{entry.name}"


def _hash_file(path: Path | str, limit: int | None = None) -> tuple[str, int]:
    """Hash a regular file; returns its SHA-256 in hexadecimal and its size [bytes]."""
    with open(open_regular(path), "rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        if limit is not None and size > limit:
            raise OSError(0, "it is larger than all files of its entry together", str(path))
        digest = hashlib.sha256(file.read()) if size <= _WHOLE else hashlib.file_digest(file, "sha256")
        return digest.hexdigest(), size


def spooled_checksums(out: Path, path: Path) -> Path:
    """Temporary list of the `checksum_line`s of a committed file or folder whose format has hashed all as it wrote them."""
    return out / PARTIAL / f"{quote(str(path), safe='')}.sha256"


def write_checksums(out: Path, path: Path, part: Path) -> None:
    """Writer task: write the `checksum_line`s of a file, or of all files in a folder, to `part`: those that its format has spooled, else
    those of the files on disk."""
    try:
        spooled_checksums(out, path).rename(part)
    except FileNotFoundError:
        part.write_bytes("".join(checksum_line(*hashed, name) for name, hashed in _hash_files(out, (path,)).items()).encode())


def join_manifest_entry(out: Path, place: Path, parts: Sequence[Path], content: dict[str, Any]) -> None:
    """Writer task: merge the lists of `write_checksums` into a manifest entry like that of `write_manifest_entry`, and remove them."""
    known: dict[str, tuple[str, int]] = {}
    for part in parts:
        for line in part.read_bytes().splitlines():
            digest, size, name = line.decode().split(" ", 2)
            known[name] = digest, int(size)
    _write_entry(out, place, known, content)
    for part in parts:
        part.unlink()


def write_manifest_entry(out: Path, place: Path, paths: Sequence[Path], content: dict[str, Any]) -> None:
    """Commit files, or folders that hold nothing else: write `place`.sha256 with their checksums, then `place`.json, whose presence marks
    all of them as complete. All paths are relative to the data set; `content`: further keys of the entry, besides file count, size and the
    SHA-256 of the checksum list."""
    _write_entry(out, place, _hash_files(out, paths), content)


def _hash_files(out: Path, paths: Sequence[Path]) -> dict[str, tuple[str, int]]:
    """Hash files, and all files in folders; returns SHA-256 and size [bytes] by name."""
    return {name: _hash_file(f"{out}/{name}") for name in list_files(out, paths)}


def _write_entry(out: Path, place: Path, known: dict[str, tuple[str, int]], content: dict[str, Any]) -> None:
    """Write a manifest entry, as `write_manifest_entry`, of files with known SHA-256 and size [bytes] by name."""
    lines = "".join(f"{known[name][0]}  {name}\n" for name in sorted(known)).encode()
    size = sum(size for _, size in known.values())
    entry = {**content, "files": len(known), "bytes": size, "checksum": hashlib.sha256(lines).hexdigest()}
    write_atomically(out / f"{place}.sha256", lines)
    write_atomically(out / f"{place}.json", (json.dumps(entry, allow_nan=False) + "\n").encode())


def name_parts(out: Path, place: Path, count: int) -> list[Path]:
    """Paths of the `count` temporary checksum lists that are merged into a manifest entry."""
    return [out / PARTIAL / f"{place.name}-{index}.sha256" for index in range(count)]
