"""Deterministic deflate by ISA-L: equal data gives equal bytes in every process.

ISA-L's fast levels insert one of a stream's first positions into their match table by the hash of a register that holds the stream's
address (write_first_byte in igzip_icf_body_h1_gr_bt.asm, version 2.31). So a few streams in a thousand are compressed differently when
the memory layout differs. The code path for the last bytes before a flush has no such fault; the first bytes are sent through it.
"""

from __future__ import annotations

import numpy as np
from isal import isal_zlib

LEVEL = 1
"""ISA-L's level: on depth images, 0 makes files a third larger in the same time, 3 takes twice as long and gains nothing."""
HEAD = 16
"""Number of first bytes that are flushed separately: ISA-L handles all of them, and at least four, by its code for the last bytes."""


class Deflater:
    """Compressor of one deflate stream."""

    def __init__(self, window_bits: int = isal_zlib.MAX_WBITS) -> None:
        """`window_bits` is zlib's: negative for a raw stream without header and checksum."""
        self._stream = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, window_bits)
        self._started = False

    def compress(self, data: bytes | np.ndarray) -> bytes:
        """Compress C-contiguous bytes. The first call must get at least HEAD of them, or all there are."""
        view = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
        if self._started:
            return self._stream.compress(view)
        self._started = True
        head = self._stream.compress(view[:HEAD]) + self._stream.flush(isal_zlib.Z_SYNC_FLUSH)
        return head + self._stream.compress(view[HEAD:])

    def flush(self, mode: int = isal_zlib.Z_FINISH) -> bytes:
        """Return the pending output; by default finishes the stream."""
        return self._stream.flush(mode)


def deflate(data: bytes | np.ndarray) -> bytes:
    """Compress all data into one zlib stream."""
    stream = Deflater()
    return stream.compress(data) + stream.flush()
