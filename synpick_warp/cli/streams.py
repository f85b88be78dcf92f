"""Standard streams of the program: closed descriptors, characters beyond the locale, full devices, readers that leave, terminal widths.

A write to the standard output that fails raises `StreamError` once, whoever prints; later output is dropped, so that clean-up code and
the interpreter's own flush at its end meet no second error. The standard error never raises: there is nowhere left to report to.
"""

from __future__ import annotations

import contextlib
import io
import os
import re
import select
import sys
import threading
from typing import TYPE_CHECKING, Any, Self

from synpick_warp.errors import SynpickError
from synpick_warp.system.descriptors import open_standard_descriptors

if TYPE_CHECKING:
    from _typeshed import ReadableBuffer

MIN_COLUMNS, MAX_COLUMNS = 40, 1000
"""Range of the width of text [characters]; at width 1, the help text takes a minute and a half."""
_DECIMAL = re.compile(r"0*([1-9][0-9]*)")
_LENIENT = "backslashreplace"
"""Error handler for characters that the encoding lacks: nothing is lost, and nothing raises."""


class StreamError(SynpickError):
    """The standard output cannot be written: its device is full, or its reader has closed it."""


class _StandardOutput(io.FileIO):
    """Descriptor 1. Records the first failed write, raises it once in the main thread, and drops everything after it."""

    def __init__(self) -> None:
        super().__init__(1, "wb", closefd=False)
        self.fault: OSError | None = None
        self._raised = False

    def write(self, data: ReadableBuffer, /) -> int:
        """Write to the stream; a fault is raised once as StreamError in the main thread, later text is dropped."""
        if self.fault is None:
            try:
                return _write_all(super().write, self, data)
            except OSError as fault:
                self.fault = fault
        if not self._raised and threading.current_thread() is threading.main_thread():
            self._raised = True
            raise StreamError(describe_fault(self.fault))
        return memoryview(data).nbytes


class _StandardError(io.FileIO):
    """Descriptor 2. Drops what cannot be written."""

    def __init__(self) -> None:
        super().__init__(2, "wb", closefd=False)

    def write(self, data: ReadableBuffer, /) -> int:
        """Write to the stream; faults are ignored."""
        try:
            return _write_all(super().write, self, data)
        except OSError:
            return memoryview(data).nbytes


def _write_all(write: Any, file: io.FileIO, data: ReadableBuffer) -> int:
    """Write; wait for a non-blocking descriptor until it takes something. Returns the number of bytes written."""
    while (count := write(data)) is None:
        select.select((), (file,), ())
    return count


class SafeStreams:
    """Context manager that makes the standard streams and the terminal's width safe, and restores them.

    Streams that the caller has replaced, as pytest does, are left alone.
    """

    def __init__(self) -> None:
        self._output: _StandardOutput | None = None

    def __enter__(self) -> Self:
        open_standard_descriptors()
        self._before = sys.stdout, sys.stderr, {name: os.environ.get(name) for name in ("COLUMNS", "LINES")}
        clamp_columns()
        if sys.stdout is sys.__stdout__:
            self._output = _StandardOutput()
            sys.stdout = _wrap(self._output, sys.stdout)
        if sys.stderr is sys.__stderr__:
            sys.stderr = _wrap(_StandardError(), sys.stderr)
        return self

    def __exit__(self, *_: object) -> None:
        self.flush()
        with contextlib.suppress(OSError):
            sys.stderr.flush()
        sys.stdout, sys.stderr, variables = self._before
        for name, value in variables.items():
            os.environ.pop(name, None)
            if value is not None:
                os.environ[name] = value

    def flush(self) -> None:
        """Flush the standard output; an error is recorded, not raised."""
        with contextlib.suppress(StreamError):
            sys.stdout.flush()

    @property
    def fault(self) -> OSError | None:
        """First error of a write to the standard output."""
        return self._output.fault if self._output is not None else None


def describe_fault(fault: OSError) -> str:
    """Describe why the standard output cannot be written, in one line."""
    return f"the standard output cannot be written: {fault.strerror or fault}; send it elsewhere, for instance to a file on another disk"


def clamp_columns() -> None:
    """Keep the environment variable COLUMNS, or else the terminal's width, within MIN_COLUMNS to MAX_COLUMNS; drop what is no number."""
    for name in ("COLUMNS", "LINES"):
        match = _DECIMAL.fullmatch(os.environ.pop(name, ""))
        if match is not None:
            os.environ[name] = str(min(int(match[1][:9]), MAX_COLUMNS))
    columns = int(os.environ.get("COLUMNS") or _terminal_columns())
    if columns and not MIN_COLUMNS <= columns <= MAX_COLUMNS:
        os.environ["COLUMNS"] = str(min(max(columns, MIN_COLUMNS), MAX_COLUMNS))


def _terminal_columns() -> int:
    """Width of the first standard stream that is a terminal [characters]; 0: none is, or it does not tell."""
    for handle in range(3):
        with contextlib.suppress(OSError):
            return os.get_terminal_size(handle).columns
    return 0


def _wrap(raw: io.FileIO, like: Any) -> io.TextIOWrapper:
    """Text stream on a descriptor, with encoding and buffering of the stream that it replaces; None: that one was closed."""
    if like is None:
        return io.TextIOWrapper(io.BufferedWriter(raw), "utf-8", _LENIENT)
    errors = _LENIENT if like.errors in ("strict", "surrogateescape") else like.errors
    # PYTHONUNBUFFERED writes characters at once; here lines, since the buffer is what makes a write whole.
    return io.TextIOWrapper(io.BufferedWriter(raw), like.encoding, errors, line_buffering=like.line_buffering or like.write_through)
