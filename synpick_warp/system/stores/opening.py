"""Choice of a store by its URL, and the probe of what it can do: right to write, clock, conditional writes."""

from __future__ import annotations

import contextlib
import datetime
import uuid
from typing import NamedTuple

from synpick_warp.errors import StoreError
from synpick_warp.system.stores.base import Store
from synpick_warp.system.stores.file_system import FileSystemStore
from synpick_warp.system.stores.object_store import ObjectStore

OBJECT_STORES = ("s3", "s3a", "gs", "az", "abfs", "abfss", "file", "memory")
"""Schemes of obstore; all others are fsspec's."""
CONTROL = ".store"
"""Folder of what is no part of a data set: marks, claims and probes. Hidden, so that local commands pass over it in a copy."""
MAX_SKEW = 300.0
"""Largest difference of this machine's clock from the store's [s]: stores refuse signed requests beyond 5 to 15 minutes."""


class Probe(NamedTuple):
    """What a store can do."""

    offset: float
    """The store's clock less this machine's [s]."""
    conditional: bool
    """Whether it has and honours conditional writes."""


def open_store(url: str) -> Store:
    """Open a store; nothing is asked of it.

    Raises:
        StoreError: A package or credentials are missing, or the URL has no meaning.
    """
    scheme, _, rest = url.partition("://")
    if not rest.strip("/"):
        raise StoreError(f"{url} names no bucket; name one with a prefix, such as s3://bucket/prefix")
    return ObjectStore(url) if scheme in OBJECT_STORES else FileSystemStore(url)


def probe(store: Store) -> Probe:
    """Write, look up, read and delete a small object.

    Raises:
        StoreError: The store cannot be read and written, or this machine's clock is off by more than MAX_SKEW.
    """
    key, data = f"{CONTROL}/probe/{uuid.uuid4().hex}", b"probe"
    sent = datetime.datetime.now(datetime.UTC)
    store.put(key, data)
    state = store.stat(key)
    if state is None or store.get(key) != data:
        raise StoreError(f"{store.url} does not return what was written; name a store that reads what it has just acknowledged")
    offset = (state.modified - sent).total_seconds()
    if abs(offset) > MAX_SKEW:
        raise StoreError(f"the clock of this machine differs from that of {store.url} by {abs(offset):,.0f} s; set it (NTP)")
    conditional = store.conditional and _is_conditional(store, key, data)
    with contextlib.suppress(StoreError):  # The right to delete is not needed.
        store.delete(key)
    return Probe(offset, conditional)


def _is_conditional(store: Store, key: str, data: bytes) -> bool:
    """Whether a store refuses to create an object that is there, and to replace one that has changed, and replaces one that has not."""
    try:
        if store.create(key, b"other") is not None:
            return False
        found = store.get_tagged(key)
        if found is None or found[0] != data:
            return False
        tag = store.replace(key, b"next", found[1])
        return tag is not None and store.replace(key, b"late", found[1]) is None and store.get(key) == b"next"
    except StoreError:
        return False
