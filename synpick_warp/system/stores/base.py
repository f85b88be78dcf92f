"""Interface of an object store: whole objects by key, listed in order, written unconditionally, if absent, or if unchanged.

Nothing is renamed or appended to. Keys are relative to the data set's prefix, with "/" between their parts.
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
"""Pause before the second attempt, doubled for each further one, and its limit [s]; each is drawn from half of it to all of it, so that
workers that a store has turned away together don't come back together."""
BLOCK_BYTES = 8 << 20
"""Size of the blocks in which large objects are read [B]."""

_Result = TypeVar("_Result")


class Stat(NamedTuple):
    """Size of an object, and when the store received it by its own clock."""

    size: int
    """Bytes."""
    modified: datetime.datetime


class TransientError(Exception):
    """A request failed in a way that may pass: the store answered 5xx, not in time or not at all, or the object arrived incomplete."""


class Store(Protocol):
    """Objects below a prefix. Methods may be called from several threads; each repeats what fails for a while, then raises `StoreError`."""

    url: str
    """Address of the prefix, without a slash at the end."""
    conditional: bool
    """Whether `create` and `replace` are implemented; whether the store honours them shows a probe (`probing.probe`)."""

    def put(self, key: str, data: bytes) -> None:
        """Write an object; readers see the old or the new one, whole."""
        ...

    def put_file(self, key: str, path: Path) -> None:
        """Write an object from a file, in several parts if it is large."""
        ...

    def get(self, key: str) -> bytes:
        """Read an object; raises FileNotFoundError."""
        ...

    def blocks(self, key: str) -> Iterator[bytes]:
        """Read an object in blocks of at most BLOCK_BYTES; raises FileNotFoundError."""
        ...

    def stat(self, key: str) -> Stat | None:
        """Describe an object; None: there is none."""
        ...

    def list(self, folder: str, after: str = "") -> Iterator[tuple[str, int]]:
        """List key and size [B] of all objects below a folder ("": all), in the order of keys, read as far as they are asked for.

        Args:
            folder: First parts of their keys, without a slash at the end.
            after: Only keys behind this one.
        """
        ...

    def delete(self, key: str) -> None:
        """Delete an object, if it is there."""
        ...

    def create(self, key: str, data: bytes) -> str | None:
        """Write an object unless the key is taken; returns its tag. None: it is taken, perhaps by an attempt of ours."""
        ...

    def replace(self, key: str, data: bytes, tag: str) -> str | None:
        """Compare-and-swap: write an object if the one that is there has this tag; returns the new tag. None: it has another one."""
        ...

    def get_tagged(self, key: str) -> tuple[bytes, str] | None:
        """Read an object and its tag; None: there is none."""
        ...


def persist(request: Callable[[], _Result], what: str, tries: int = TRIES) -> _Result:
    """Repeat a request while it raises `TransientError`, with randomized exponential back-off.

    Args:
        request: The request.
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
