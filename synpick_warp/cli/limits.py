"""Errors of exhausted resources, in one line: memory, file descriptors, threads and processes that the system does not grant."""

from __future__ import annotations

import errno
from collections.abc import Iterator

_REMEDIES = {
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
    errno.ENFILE: "close other programs: the system has too many files open",
    errno.ENOMEM: "free memory, or raise its limit (ulimit -v)",
    errno.EAGAIN: "close other programs, or raise the limit of processes (ulimit -u)",
}
_MEMORY = ("memory", "failed to map segment", "unable to allocate")
"""Parts of the messages of other libraries that ran out of memory, in lower case."""
_FILES = "too many open files"
_NO_THREAD = "can't start new thread"


def describe_limit(error: BaseException) -> str | None:
    """Say which resource an error, or one that it follows from, is about, and what to do; None: it is about none."""
    for each in _chain(error):
        text = " ".join(str(each).split())
        low = text.lower()
        foreign = isinstance(each, ImportError) or type(each).__module__ == "cv2"
        if isinstance(each, OSError) and each.errno in _REMEDIES:
            return f"{text}; {_REMEDIES[each.errno]}"
        if isinstance(each, RuntimeError) and _NO_THREAD in low:
            return f"no thread can be started; {_REMEDIES[errno.EAGAIN]}"
        if isinstance(each, MemoryError) or (foreign and any(part in low for part in _MEMORY)):
            return f"memory is exhausted{f' ({text})' if text else ''}; {_REMEDIES[errno.ENOMEM]}"
        if foreign and _FILES in low:
            return f"{text}; {_REMEDIES[errno.EMFILE]}"
    return None


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Exception chain: an error, then its causes and contexts."""
    following: BaseException | None = error
    while following is not None:
        yield following
        following = following.__cause__ or following.__context__
