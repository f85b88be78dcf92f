"""Retries of requests to an object store, and metadata of its objects."""

from __future__ import annotations

import datetime
import random
import time
from collections.abc import Callable
from typing import NamedTuple, TypeVar

from synpick_warp.errors import StoreError

TRIES = 6
"""Attempts of a request that may succeed when it is repeated."""
FIRST_PAUSE, MAX_PAUSE = 0.2, 20.0
"""Exponential back-off: pause before the second attempt, doubled for each further one, and its limit [s]. Jitter: each pause is drawn from
50 to 100 % of that, so that workers whose requests failed together do not repeat them together."""

_Result = TypeVar("_Result")


class Stat(NamedTuple):
    """Metadata of an object: its size, and when the store received it, by the store's clock."""

    size: int
    """Size [B]."""
    modified: datetime.datetime


class TransientError(Exception):
    """Transient failure of a request, which `persist` repeats: the answer was 5xx, late or lost, or the object arrived incomplete."""


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
