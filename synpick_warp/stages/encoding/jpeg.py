"""JPEG encoder on the device: baseline, 4:2:0, with restart intervals; the same files as libjpeg's, `synpick_warp.jpeg.encode_jpeg`.

Only the files are copied to the host: at quality 95 a tenth of the pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.arrays import allocate, allocate_struct, device_array, struct_arrays
from synpick_warp.jpeg import (
    AC_COUNTS,
    AC_SYMBOLS,
    DC_COUNTS,
    DC_SYMBOLS,
    DIVISOR_SCALE,
    QUALITIES,
    RESTART_INTERVAL,
    huffman_codes,
    make_header,
    quantization,
    zigzag_order,
)
from synpick_warp.kernels.encoding.dct import transform_blocks_kernel
from synpick_warp.kernels.encoding.huffman import HuffmanTables, encode_intervals_kernel, join_intervals_kernel
from synpick_warp.kernels.encoding.tables import BLOCK_SIZE, BLOCKS_PER_MCU, MCU
from synpick_warp.kernels.render.images.camera_effects import jpeg_quality_kernel
from synpick_warp.stages.buffers import ViewBuffers

SLOT_BYTES_PER_PIXEL = 1.0
"""Capacity of a restart interval: nearly four times the mean at quality 95 (568 kB for a full-HD view of a tote)."""
FILE_BYTES_PER_PIXEL = 0.75
"""Capacity of a file: nearly three times its size at quality 95."""
MIN_FILE_BYTES = 1024
"""Capacity for header and markers [B]."""
LANES = 32
"""Threads that copy an interval: a warp."""
HUFFMAN = struct_arrays(HuffmanTables, "component", "symbol")


@dataclass(frozen=True, eq=False)
class JpegBuffers:
    """JPEG files of one batch of views."""

    jpeg_size: wp.array = device_array("view", dtype=wp.int32)
    """Size of each file [B]; above the capacity of `jpeg`: the file is incomplete."""
    jpeg: wp.array = device_array("view", "byte", dtype=wp.uint8)
    """The files, from the first byte."""


@dataclass(frozen=True, eq=False)
class JpegScratch:
    """Scratch of the encoder."""

    coefficient: wp.array = device_array("view", "mcu", "block", "coefficient", dtype=wp.int16)
    """Quantized DCT coefficients in zigzag order."""
    slot: wp.array = device_array("view", "interval", "slot_byte", dtype=wp.uint8)
    """Data of each restart interval."""
    slot_size: wp.array = device_array("view", "interval", dtype=wp.int32)
    """Size of each interval [B], also beyond its slot."""


def jpeg_sizes(views: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions of `JpegBuffers` and `JpegScratch`, for `views` images [px]."""
    mcus = -(-width // int(MCU)) * -(-height // int(MCU))
    sizes = {"view": views, "mcu": mcus, "block": int(BLOCKS_PER_MCU), "coefficient": int(BLOCK_SIZE)}
    sizes |= {"interval": -(-mcus // RESTART_INTERVAL), "slot_byte": int(SLOT_BYTES_PER_PIXEL * MCU**2 * RESTART_INTERVAL)}
    return sizes | {"byte": MIN_FILE_BYTES + int(FILE_BYTES_PER_PIXEL * width * height)}


class JpegEncoder:
    """Encodes batches of views. Owns its scratch; `encode` only launches kernels."""

    def __init__(self, views: int, width: int, height: int, device: wp.Device) -> None:
        """
        Args:
            views: Maximum number of views.
            width: Of the images [px].
            height: Of the images [px].
            device: Where to encode.
        """
        self.device = device
        self.scratch: JpegScratch = allocate(JpegScratch, jpeg_sizes(views, width, height), device)
        self.tables = _upload_huffman(device)
        divisor = np.stack([quantization(quality) for quality in range(QUALITIES)]) * DIVISOR_SCALE
        self.divisor = wp.array(divisor, dtype=wp.int32, device=device)
        header = [np.frombuffer(make_header(width, height, quality), np.uint8) for quality in range(QUALITIES)]
        self.header = wp.array(np.stack(header), dtype=wp.uint8, device=device)
        self.zigzag = wp.array(zigzag_order(), dtype=wp.int32, device=device)

    def encode(self, image: wp.array, quality: wp.array, count: int, out: JpegBuffers) -> None:
        """Encode the first `count` views.

        Args:
            image: RGB images (view, row, column) vec3ub.
            quality: 1 to 100 (view) int32.
            count: Views in use.
            out: Written.
        """
        scratch, device = self.scratch, self.device
        wp.launch(
            transform_blocks_kernel,
            dim=(count, *scratch.coefficient.shape[1:3]),
            inputs=[image, quality, self.divisor, self.zigzag],
            outputs=[scratch.coefficient],
            device=device,
        )
        wp.launch(
            encode_intervals_kernel,
            dim=(count, scratch.slot.shape[1]),
            inputs=[self.tables, scratch.coefficient, RESTART_INTERVAL],
            outputs=[scratch.slot, scratch.slot_size],
            device=device,
        )
        wp.launch(
            join_intervals_kernel,
            dim=(count, scratch.slot.shape[1], LANES),
            inputs=[scratch.slot, scratch.slot_size, quality, self.header, LANES],
            outputs=[out.jpeg, out.jpeg_size],
            device=device,
        )


class Compressor:
    """JPEG files of a ring of view batches.

    Attributes:
        out: `JpegBuffers` of each batch of the ring.
    """

    def __init__(self, sizes: dict[str, int], quality: int, ring: int, device: wp.Device) -> None:
        """
        Args:
            sizes: Extents of `ViewBuffers`.
            quality: JPEG quality of views without a sampled one.
            ring: Number of batches.
            device: Where to encode.
        """
        views, width, height = sizes["view"], sizes["column"], sizes["row"]
        self.fixed_quality, self.device = quality, device
        self.encoder = JpegEncoder(views, width, height, device)
        self.quality = wp.empty(views, dtype=wp.int32, device=device)
        self.out = [allocate(JpegBuffers, jpeg_sizes(views, width, height), device) for _ in range(ring)]

    def compress(self, slot: int, count: int, images: ViewBuffers) -> None:
        """Encode the colour images of the first `count` views into `out[slot]`, with the quality of their effects."""
        inputs = [images.effects, self.fixed_quality]
        wp.launch(jpeg_quality_kernel, dim=count, inputs=inputs, outputs=[self.quality], device=self.device)
        self.encoder.encode(images.color, self.quality, count, self.out[slot])


def _upload_huffman(device: wp.Device) -> Any:
    """The standard codes, as the struct `HuffmanTables`."""
    tables = allocate_struct(HUFFMAN, {"component": 2, "symbol": 256}, device)
    for kind, counts, symbols in (("dc", DC_COUNTS, DC_SYMBOLS), ("ac", AC_COUNTS, AC_SYMBOLS)):
        codes = [huffman_codes(*table) for table in zip(counts, symbols, strict=True)]
        getattr(tables, f"{kind}_code").assign(np.stack([code for code, _ in codes]))
        getattr(tables, f"{kind}_length").assign(np.stack([length for _, length in codes]))
    return tables
