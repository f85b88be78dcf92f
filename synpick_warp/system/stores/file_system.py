"""Store of any file system that fsspec knows, such as hf://, sftp:// or webdav://: without conditional writes."""

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
        """Raises StoreError: fsspec, or the package that it needs for the URL, is not installed."""
        try:
            fsspec = importlib.import_module("fsspec")
            self._files, root = fsspec.core.url_to_fs(url)
        except ImportError as error:
            raise StoreError(f"{url} needs a package that is not installed: {error}; pip install 'synpick-warp[cloud]'") from None
        except ValueError as error:
            raise StoreError(f"{url} cannot be opened: {error}") from None
        self.url, self._root = url.rstrip("/"), str(root).rstrip("/")

    def _try(self, request: Callable[[], _Result], what: str) -> _Result:
        """Repeat a request while its errors may pass; missing objects pass through."""

        def attempt() -> _Result:
            try:
                return request()
            except FileNotFoundError:
                raise
            except PermissionError as error:
                raise StoreError(f"cannot {what}: {error.strerror or error}; give the right to read, list and write there") from None
            except OSError as error:
                raise TransientError(str(error) or type(error).__name__) from None

        return persist(attempt, what)

    def _path(self, key: str) -> str:
        return f"{self._root}/{key}" if key else self._root

    def put(self, key: str, data: bytes) -> None:
        """See `Store`."""

        def write() -> None:
            self._files.makedirs(self._path(key).rpartition("/")[0], exist_ok=True)
            self._files.pipe_file(self._path(key), data)

        self._try(write, f"write {self.url}/{key}")

    def put_file(self, key: str, path: Path) -> None:
        """See `Store`."""

        def write() -> None:
            self._files.makedirs(self._path(key).rpartition("/")[0], exist_ok=True)
            self._files.put_file(str(path), self._path(key))

        self._try(write, f"write {self.url}/{key}")

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
        """See `Store`; all tags are empty."""
        try:
            return self.get(key), ""
        except FileNotFoundError:
            return None


def _time(info: dict[str, Any]) -> datetime.datetime:
    """When an object was written; the present where the file system does not say."""
    found = next((info[name] for name in ("mtime", "LastModified", "last_modified", "created", "updated") if info.get(name)), None)
    if isinstance(found, datetime.datetime):
        return found if found.tzinfo else found.replace(tzinfo=datetime.UTC)
    return datetime.datetime.fromtimestamp(found, datetime.UTC) if isinstance(found, int | float) else datetime.datetime.now(datetime.UTC)
