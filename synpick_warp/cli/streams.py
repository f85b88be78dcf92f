"""Standard streams of the program: characters beyond the locale, full devices, readers that leave.

A write to the standard output that fails raises `StreamError` once, whoever prints; later output is dropped, so that clean-up code and
the interpreter's own flush at its end meet no second error. The standard error never raises: there is nowhere left to report to.
"""

from __future__ import annotations

import contextlib
import io
import sys
import threading
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

from synpick_warp.errors import SynpickError
from synpick_warp.system.interpreter import open_standard_descriptors

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer


class StreamError(SynpickError):
    """The standard output cannot be written: its device is full, or its reader has closed it."""


class _Descriptor(io.FileIO):
    """Descriptor of a standard stream. Records the first failed write, and drops everything after it."""

    def __init__(self, handle: int, raises: bool) -> None:
        """`raises`: whether the fault is raised, once, as StreamError in the main thread."""
        super().__init__(handle, "wb", closefd=False)
        self.fault: OSError | None = None
        """First error of a write."""
        self._raises = raises

    def write(self, data: ReadableBuffer, /) -> int:
        if self.fault is None:
            try:
                return super().write(data)
            except OSError as fault:
                self.fault = fault
        if self._raises and threading.current_thread() is threading.main_thread():
            self._raises = False
            raise StreamError(describe_fault(self.fault))
        return memoryview(data).nbytes


@contextlib.contextmanager
def safe_streams() -> Iterator[_Descriptor]:
    """Make the standard streams safe, and restore them; the value has the standard output's `fault`. Replaced ones are left alone."""
    open_standard_descriptors()
    before, output = (sys.stdout, sys.stderr), _Descriptor(1, raises=True)
    if sys.stdout is sys.__stdout__:
        sys.stdout = _wrap(output, sys.stdout)
    if sys.stderr is sys.__stderr__:
        sys.stderr = _wrap(_Descriptor(2, raises=False), sys.stderr)
    try:
        yield output
    finally:
        flush_output()
        sys.stderr.flush()
        sys.stdout, sys.stderr = before


def flush_output() -> None:
    """Flush the standard output; an error is recorded, not raised."""
    with contextlib.suppress(StreamError):
        sys.stdout.flush()


def describe_fault(fault: OSError) -> str:
    """Describe why the standard output cannot be written, in one line."""
    return f"the standard output cannot be written: {fault.strerror or fault}; send it elsewhere, for instance to a file on another disk"


def _wrap(raw: io.FileIO, like: Any) -> io.TextIOWrapper:
    """Text stream on a descriptor, which escapes characters that its encoding lacks; `like`: the stream that it replaces, None: closed."""
    encoding, by_lines = ("utf-8", False) if like is None else (like.encoding, like.line_buffering or like.write_through)
    return io.TextIOWrapper(io.BufferedWriter(raw), encoding, "backslashreplace", line_buffering=by_lines)
