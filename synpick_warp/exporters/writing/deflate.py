"""Deflate by ISA-L, made to give the same bytes for the same data in every process.

ISA-L's fast levels enter one of a stream's first positions into their table of matches by the hash of a register that holds the address
of the stream (write_first_byte in igzip_icf_body_h1_gr_bt.asm, version 2.31). So a few streams in a thousand are packed otherwise where
memory is laid out otherwise. The code for the last bytes before a flush has no such fault; so it gets the first ones.
"""

from __future__ import annotations

import numpy as np
from isal import isal_zlib

LEVEL = 1
"""ISA-L's level: on depth images, 0 makes files a third larger in the same time, 3 takes twice as long and gains nothing."""
HEAD = 16
"""So many bytes are flushed by themselves: all, and at least four, of what ISA-L leaves to the code for the last bytes."""


class Deflater:
    """A deflate stream. Use one for each stream."""

    def __init__(self, window_bits: int = isal_zlib.MAX_WBITS) -> None:
        """`window_bits` is zlib's: negative for a stream without header and checksum."""
        self._stream = isal_zlib.compressobj(LEVEL, isal_zlib.DEFLATED, window_bits)
        self._begun = False

    def compress(self, data: bytes | np.ndarray) -> bytes:
        """Pack bytes, C-contiguous ones; the first call gets at least HEAD, or all there are."""
        view = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
        if self._begun:
            return self._stream.compress(view)
        self._begun = True
        head = self._stream.compress(view[:HEAD]) + self._stream.flush(isal_zlib.Z_SYNC_FLUSH)
        return head + self._stream.compress(view[HEAD:])

    def flush(self, mode: int = isal_zlib.Z_FINISH) -> bytes:
        """What is still to come, by default to the stream's end."""
        return self._stream.flush(mode)


def deflate(data: bytes | np.ndarray) -> bytes:
    """A zlib stream of all data."""
    stream = Deflater()
    return stream.compress(data) + stream.flush()
