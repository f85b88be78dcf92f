"""Factory of object stores by URL, and a capability probe: rights, difference of the clocks, conditional writes."""

from __future__ import annotations

import contextlib
import datetime
import uuid
from pathlib import Path
from typing import NamedTuple

from synpick_warp.errors import StoreError
from synpick_warp.system.stores.base import Store
from synpick_warp.system.stores.file_system import FileSystemStore
from synpick_warp.system.stores.object_store import ObjectStore

OBJECT_STORES = ("s3", "s3a", "gs", "az", "abfs", "abfss", "file", "memory")
"""Schemes of obstore; all others are fsspec's."""
CONTROL = ".store"
"""Folder of control objects, which are no part of a data set: marks, claims, probes. Hidden, so that local commands ignore it in a copy."""
MAX_SKEW = 300.0
"""Largest difference of this machine's clock from the store's [s]: stores refuse signed requests beyond 5 to 15 minutes."""


class Probe(NamedTuple):
    """Result of a probe: offset of the clock, and whether conditional writes work."""

    offset: float
    """The store's clock less this machine's [s]."""
    conditional: bool
    """Whether the store has conditional writes and honours them."""


def open_store(url: str, *, make: bool = True) -> Store:
    """Open the object store of a URL. Object stores are sent no request; file systems of fsspec may connect, and file:// makes its folder.

    Args:
        url: Its prefix.
        make: Whether file:// may make its folder, in one that is there; otherwise the folder itself must be there.

    Raises:
        StoreError: A package or credentials are missing, or the URL names no bucket, has a part "." or "..", an unknown scheme, or with
            file:// no folder to be.
    """
    scheme, _, rest = url.partition("://")
    if not {".", ".."}.isdisjoint(rest.split("/")):
        raise StoreError(f"{url} has a part . or ..; name a prefix without")
    if not rest.strip("/"):
        raise StoreError(f"{url} names no bucket; name one with a prefix, such as s3://bucket/prefix")
    needed = Path(rest).parent if make else Path(rest)
    if scheme == "file" and not needed.is_dir():
        raise StoreError(f"{url} cannot be opened: {needed} is no folder; {'make it' if make else 'name one that is'}")
    return ObjectStore(url) if scheme in OBJECT_STORES else FileSystemStore(url)


def probe(store: Store) -> Probe:
    """Probe a store's capabilities: write, look up, read and delete a small object below CONTROL.

    Raises:
        StoreError: The store cannot be read and written, or this machine's clock is off by more than MAX_SKEW.
    """
    key, data = f"{CONTROL}/probe/{uuid.uuid4().hex}", b"probe"
    sent = datetime.datetime.now(datetime.UTC)
    store.put(key, data)
    state, found = store.stat(key), store.get_tagged(key)
    if state is None or found is None or found[0] != data:
        raise StoreError(f"{store.url} does not return what was written; name a store that reads what it has just acknowledged")
    offset = (state.modified - sent).total_seconds()
    if abs(offset) > MAX_SKEW:
        raise StoreError(f"the clock of this machine differs from that of {store.url} by {abs(offset):,.0f} s; set it (NTP)")
    conditional = store.conditional and _is_conditional(store, key, data)
    with contextlib.suppress(StoreError):  # The right to delete is not needed.
        store.delete(key)
    return Probe(offset, conditional)


def _is_conditional(store: Store, key: str, data: bytes) -> bool:
    """Test of conditional writes: whether the store refuses to create an object that exists and to replace one whose tag has changed, and
    replaces one whose tag has not."""
    try:
        if store.create(key, b"other") is not None:
            return False
        found = store.get_tagged(key)
        if found is None or found[0] != data:
            return False
        tag = store.replace(key, b"next", found[1])
        return tag is not None and store.replace(key, b"late", found[1]) is None and store.get(key) == b"next"
    except (StoreError, FileNotFoundError):
        return False
