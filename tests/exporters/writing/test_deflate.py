"""Deterministic deflate: zlib decompresses it, and its bytes do not depend on the stream's address."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.exporters.writing.deflate import HEAD, Deflater, deflate

STREAMS = 200
"""Number of streams, at different addresses. Without our workaround, one in 36 differs from the others for `flow_rows`."""


def flow_rows() -> np.ndarray:
    """PNG-filtered rows of an optical-flow image of a moving disc (720, 7680) uint8."""
    row, column = np.mgrid[0:720, 0:1280]
    inside = (column - 640) ** 2 + (row - 360) ** 2 < 60000
    codes = np.zeros((720, 1280, 3), ">u2")
    codes[inside, 0] = (32768 + 0.3 * column + 0.1 * row)[inside]
    codes[inside, 1] = (32768 + 0.3 * column - 0.2 * row)[inside]
    codes[inside, 2] = 1
    rows = codes.view(np.uint8).reshape(720, -1)
    return np.diff(rows, axis=0, prepend=np.zeros((1, rows.shape[1]), np.uint8))


@given(st.binary(max_size=5000), st.integers(0, 5000))
@settings(max_examples=50, deadline=None)
def test_round_trip_by_zlib(data, cut):
    assert zlib.decompress(deflate(data)) == data
    stream = Deflater(-zlib.MAX_WBITS)
    parts = stream.compress(data[:cut]), stream.compress(data[cut:]), stream.flush()
    assert zlib.decompress(b"".join(parts), -zlib.MAX_WBITS) == data


@pytest.mark.parametrize("shape", [(300,), (20, 15), (4, 5, 5, 3)])
def test_arrays_of_any_shape_are_compressed_as_bytes(shape):
    data = np.arange(300, dtype=np.uint16).astype(np.uint8).reshape(shape)
    assert zlib.decompress(deflate(data)) == data.tobytes()


def test_first_bytes_are_flushed_separately():
    data = flow_rows().tobytes()
    packed = deflate(data)
    reader = zlib.decompressobj()
    first = next(got for got in (reader.decompress(packed[place : place + 1]) for place in range(len(packed))) if got)
    assert first == data[: len(first)]
    assert len(first) <= HEAD


def test_bytes_do_not_depend_on_the_stream_address():
    data = flow_rows()
    streams = [Deflater() for _ in range(STREAMS)]
    assert len({stream.compress(data) + stream.flush() for stream in streams}) == 1
