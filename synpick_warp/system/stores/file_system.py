"""Object store on a file system of fsspec, such as hf://, sftp:// or webdav://: without conditional writes.

Whether a write is atomic depends on the server: a worker that is killed may leave an empty or truncated file, over SFTP for example.
"""

from __future__ import annotations

import datetime
import importlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from synpick_warp.errors import StoreError
from synpick_warp.system.stores.base import BLOCK_BYTES, Stat, TransientError, persist

_Result = TypeVar("_Result")


class FileSystemStore:
    """`Store` of fsspec."""

    conditional = False

    def __init__(self, url: str) -> None:
        """Open the file system; some connect. Raises StoreError: a package is not installed, or the URL cannot be opened."""
        try:
            fsspec = importlib.import_module("fsspec")
        except ImportError:
            raise StoreError(f"{url} needs the package fsspec; install it by pip install 'synpick-warp[cloud]'") from None
        try:
            self._files, root = fsspec.core.url_to_fs(url)
        except ImportError as error:
            raise StoreError(f"{url} needs a package that is not installed: {_text(error)}") from None
        except Exception as error:  # Some connect, and each library has errors of its own.
            raise StoreError(f"{url} cannot be opened: {_text(error)}") from None
        self.url, self._root = url.rstrip("/"), str(root).rstrip("/")

    def _try(self, request: Callable[[], _Result], what: str) -> _Result:
        """Retry a request, whatever its error; FileNotFoundError is raised at once, missing rights and operations as StoreError."""

        def attempt() -> _Result:
            try:
                return request()
            except FileNotFoundError:
                raise
            except PermissionError as error:
                raise StoreError(f"cannot {what}: {error.strerror or error}; give the right to read, list and write there") from None
            except NotImplementedError:
                raise StoreError(f"cannot {what}: its file system cannot do that; name another place") from None
            except Exception as error:  # Errors of libraries (paramiko, ftplib, webdav4) have no common class, so all may pass.
                raise TransientError(_text(error)) from None

        return persist(attempt, what)

    def _write(self, key: str, write: Callable[[str], None]) -> None:
        """Make the folder of an object, and write it to its path."""
        path = self._path(key)

        def request() -> None:
            self._files.makedirs(path.rpartition("/")[0], exist_ok=True)
            write(path)

        try:
            self._try(request, f"write {self.url}/{key}")
        except FileNotFoundError as error:
            raise StoreError(f"cannot write {self.url}/{key}: {_text(error)}; make the place that it names first") from None

    def _path(self, key: str) -> str:
        """Path of an object in the file system; of the prefix, if the key is empty."""
        return f"{self._root}/{key}" if key else self._root

    def put(self, key: str, data: bytes) -> None:
        """See `Store`."""
        self._write(key, lambda path: self._files.pipe_file(path, data))

    def put_file(self, key: str, path: Path) -> None:
        """See `Store`."""
        self._write(key, lambda place: self._files.put_file(str(path), place))

    def get(self, key: str) -> bytes:
        """See `Store`."""
        return self._try(lambda: self._files.cat_file(self._path(key)), f"read {self.url}/{key}")

    def blocks(self, key: str) -> Iterator[bytes]:
        """See `Store`."""
        stat = self.stat(key)
        if stat is None:
            raise FileNotFoundError(f"{self.url}/{key}")
        for start in range(0, stat.size, BLOCK_BYTES):
            end = min(start + BLOCK_BYTES, stat.size)
            yield self._try(lambda first=start, last=end: self._files.cat_file(self._path(key), first, last), f"read {self.url}/{key}")

    def stat(self, key: str) -> Stat | None:
        """See `Store`."""
        self._files.invalidate_cache()
        try:
            found = self._try(lambda: self._files.info(self._path(key)), f"look up {self.url}/{key}")
        except FileNotFoundError:
            return None
        return None if found["type"] != "file" else Stat(found["size"], _time(found))

    def list(self, folder: str, after: str = "") -> Iterator[tuple[str, int]]:
        """See `Store`."""
        self._files.invalidate_cache()
        try:
            found = self._try(lambda: self._files.find(self._path(folder), detail=True), f"list {self.url}/{folder}")
        except FileNotFoundError:
            return
        start = len(self._files._strip_protocol(self._root)) + 1
        pairs = ((name[start:], each["size"]) for name, each in found.items())
        yield from sorted(pair for pair in pairs if pair[0] > after)

    def delete(self, key: str) -> None:
        """See `Store`."""
        if self.stat(key) is not None:
            self._try(lambda: self._files.rm_file(self._path(key)), f"delete {self.url}/{key}")

    def create(self, key: str, data: bytes) -> str | None:
        """See `Store`: not implemented."""
        raise StoreError(f"{self.url} has no conditional writes")

    def replace(self, key: str, data: bytes, tag: str) -> str | None:
        """See `Store`: not implemented."""
        raise StoreError(f"{self.url} has no conditional writes")

    def get_tagged(self, key: str) -> tuple[bytes, str] | None:
        """See `Store`; every tag is the empty string."""
        try:
            return self.get(key), ""
        except FileNotFoundError:
            return None


def _text(error: BaseException) -> str:
    """First line of an error's text; the name of its class, if it has none."""
    return (str(error).splitlines() or [type(error).__name__])[0][:300]


def _time(info: dict[str, Any]) -> datetime.datetime:
    """Modification time of an object, by fsspec's record of it; the current time where the file system does not tell."""
    found = next((info[name] for name in ("mtime", "LastModified", "last_modified", "created", "updated") if info.get(name)), None)
    if isinstance(found, datetime.datetime):
        return found if found.tzinfo else found.replace(tzinfo=datetime.UTC)
    return datetime.datetime.fromtimestamp(found, datetime.UTC) if isinstance(found, int | float) else datetime.datetime.now(datetime.UTC)
