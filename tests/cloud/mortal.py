"""Store whose worker dies: at a chosen request everything ends, before or after the store has taken it; and the set that a store has."""

from __future__ import annotations

import threading
from typing import Any

from synpick_warp.system.stores.opening import CONTROL, open_store
from synpick_warp.system.stores.store import Store


class Killed(BaseException):
    """What no code handles."""


class MortalStore:
    """`Store` that passes `lives` requests on, then raises at each one; every second death comes after its request was carried out."""

    def __init__(self, store: Store, lives: int) -> None:
        self._store, self.lives, self.url = store, lives, store.url
        self._late, self._lock = lives % 2 == 1, threading.Lock()

    def __getattr__(self, name: str) -> Any:
        method = getattr(self._store, name)

        def request(*arguments: Any) -> Any:
            with self._lock:
                self.lives -= 1
                lives = self.lives
            if lives == 0 and self._late:
                method(*arguments)
            if lives <= 0:
                raise Killed
            return method(*arguments)

        return request


def stored(url: str) -> dict[str, bytes]:
    """Files of the data set in a store."""
    store = open_store(url)
    return {key: store.get(key, 1 << 30) for key, _ in store.list("") if not key.startswith(f"{CONTROL}/")}
