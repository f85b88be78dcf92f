"""Interface of an object store, and retries: whole objects by key, listed in order, written always, if absent, or if unchanged.

Objects are neither renamed nor appended to. Keys are relative to the data set's prefix, with "/" between their parts.
"""

from __future__ import annotations

import datetime
import random
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple, Protocol, TypeVar

from synpick_warp.errors import StoreError

TRIES = 6
"""Attempts of a request that may succeed when it is repeated."""
FIRST_PAUSE, MAX_PAUSE = 0.2, 20.0
"""Exponential back-off: pause before the second attempt, doubled for each further one, and its limit [s]. Jitter: each pause is drawn from
50 to 100 % of that, so that workers whose requests failed together do not repeat them together."""
BLOCK_BYTES = 8 << 20
"""Size of the blocks in which large objects are read [B]."""

_Result = TypeVar("_Result")


class Stat(NamedTuple):
    """Metadata of an object: its size, and when the store received it, by the store's clock."""

    size: int
    """Size [B]."""
    modified: datetime.datetime


class TransientError(Exception):
    """Transient failure of a request, which `persist` repeats: the answer was 5xx, late or lost, or the object arrived incomplete."""


class Store(Protocol):
    """Object store below a prefix. Thread-safe. Each method repeats requests that fail for a while, then raises StoreError."""

    url: str
    """Address of the prefix, without a slash at the end."""
    conditional: bool
    """Whether `create` and `replace` are implemented; `opening.probe` measures whether the store honours them."""

    def put(self, key: str, data: bytes) -> None:
        """Write an object; by obstore atomically: readers see the old or the new one, whole. By fsspec that depends on the server."""
        ...

    def put_file(self, key: str, path: Path) -> None:
        """Upload a file as an object, in several parts if it is large."""
        ...

    def get(self, key: str) -> bytes:
        """Read an object; raises FileNotFoundError."""
        ...

    def blocks(self, key: str) -> Iterator[bytes]:
        """Stream an object in blocks of at most BLOCK_BYTES, one range request each; raises FileNotFoundError.

        Object stores raise StoreError if the object is replaced meanwhile."""
        ...

    def stat(self, key: str) -> Stat | None:
        """Look up the metadata of an object; None: there is no such object."""
        ...

    def list(self, folder: str, after: str = "") -> Iterator[tuple[str, int]]:
        """List the objects below a folder, sorted by key, lazily where the store sorts: yields key and size [B].

        Args:
            folder: First parts of their keys, without a slash at the end; empty: all objects.
            after: Only keys that sort after this one.
        """
        ...

    def delete(self, key: str) -> None:
        """Delete an object, if it is there."""
        ...

    def create(self, key: str, data: bytes) -> str | None:
        """Write an object if absent; returns its tag. None: the key is taken, perhaps by an attempt of this call whose answer was lost."""
        ...

    def replace(self, key: str, data: bytes, tag: str) -> str | None:
        """Compare-and-swap: write an object if the one that is there has this tag; returns the new tag. None: it has another tag, perhaps
        that of an attempt of this call whose answer was lost, or was deleted."""
        ...

    def get_tagged(self, key: str) -> tuple[bytes, str] | None:
        """Read an object and its tag, which identifies its version; None: there is no such object."""
        ...


def persist(request: Callable[[], _Result], what: str, tries: int = TRIES) -> _Result:
    """Retry a request while it raises `TransientError`, with exponential back-off and jitter; returns its result.

    Args:
        request: The request; must be safe to repeat.
        what: What it does, for the message: "write s3://bucket/key".
        tries: Attempts.

    Raises:
        StoreError: No attempt succeeded.
    """
    pause = FIRST_PAUSE
    for attempt in range(1, tries + 1):
        try:
            return request()
        except TransientError as error:
            if attempt == tries:
                raise StoreError(f"cannot {what}: {error}; {tries} attempts failed; the same command resumes") from error
        time.sleep(pause * random.uniform(0.5, 1.0))
        pause = min(2.0 * pause, MAX_PAUSE)
    raise AssertionError("unreachable")
