"""Tests of deterministic H.264 encoding: the output depends neither on the contents of freed memory nor on the CPU's instruction set."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.exporters.lerobot import video

CHUNK = 100_000
"""Allocation size [bytes], below glibc's mmap threshold of 128 KiB: larger blocks are newly mapped, zero-filled pages."""


def moving_noise(width: int, height: int) -> list[np.ndarray]:
    """Synthetic video: YUV planes of a group of pictures, from a crop window that moves across a blurred noise image."""
    noise = np.random.default_rng(0).integers(0, 256, (height + 40, width + 40, 3), dtype=np.uint8)
    picture = cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 4), None, 0, 255, cv2.NORM_MINMAX)
    windows = [picture[2 * step : 2 * step + height, 3 * step : 3 * step + width] for step in range(video.GROUP)]
    return [video.split_planes(np.ascontiguousarray(window)) for window in windows]


def encode(planes: list[np.ndarray], path: Path) -> bytes:
    video.write_group(planes, np.zeros((3, video.LEVELS), np.int64), Fraction(15), path)
    return path.read_bytes()


def fill_free_memory(value: int) -> bytes:
    """Fill 10 MB of the heap with a byte value and free it, except the last chunk, which prevents the heap from shrinking."""
    chunks = [bytes([value]) * CHUNK for _ in range(100)]
    return chunks.pop()


@pytest.mark.parametrize(("width", "height"), [(96, 72), (224, 224), (320, 240), (480, 270)])
def test_bytes_do_not_depend_on_freed_memory(tmp_path, width, height):
    """Regression test: at these sizes x264's macroblock tree with AVX-512 reads out of bounds, unless `cpu-independent` is set."""
    planes = moving_noise(width, height)
    found = set()
    for value in (0, 255, 128):
        last_chunk = fill_free_memory(value)
        found.add(encode(planes, tmp_path / "group"))
        del last_chunk
    assert len(found) == 1


@pytest.mark.parametrize(("width", "height"), [(96, 72), (320, 240)])
def test_bytes_do_not_depend_on_the_instruction_set(tmp_path, monkeypatch, width, height):
    planes = moving_noise(width, height)
    fastest = encode(planes, tmp_path / "group")
    monkeypatch.setitem(video._OPTIONS, "x264-params", video._OPTIONS["x264-params"] + ":asm=0")
    assert encode(planes, tmp_path / "group") == fastest
