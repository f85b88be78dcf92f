"""Baseline JPEG encoder on the device, with 4:2:0 chroma subsampling and restart intervals.

Its files equal libjpeg's (`system.codecs.jpeg.encode_jpeg`) byte for byte. Only the files are copied to the host; at quality 95 they have a
tenth of the image's size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.encoding.dct import BLOCK, BLOCK_SIZE, BLOCKS_PER_MCU, MCU, convert_colors_kernel, transform_blocks_kernel
from synpick_warp.kernels.encoding.huffman import (
    CODE_BITS,
    HuffmanTables,
    measure_blocks_kernel,
    place_blocks_kernel,
    write_blocks_kernel,
)
from synpick_warp.kernels.encoding.stuffing import (
    MARKER_BYTES,
    WORD_BYTES,
    count_stuffing_kernel,
    join_intervals_kernel,
    place_intervals_kernel,
)
from synpick_warp.kernels.render.images.camera_effects import jpeg_quality_kernel
from synpick_warp.kernels.tuning import JPEG_THREADS
from synpick_warp.stages.arrays import allocate_struct, device_array, struct_arrays
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.system.codecs.jpeg import (
    DIVISOR_SCALE,
    QUALITIES,
    RESTART_INTERVAL,
    huffman_codes,
    make_header,
    quantization,
    reciprocals,
)

SLOT_BYTES_PER_PIXEL = 1.0
"""Capacity of a restart interval: nearly four times the mean at quality 95 (568 kB for a full-HD view of a tote)."""
FILE_BYTES_PER_PIXEL = 0.75
"""Capacity of a file: nearly three times its size at quality 95."""
MIN_FILE_BYTES = 1024
"""Capacity for header and markers [B]."""
LANES = 32
"""Lanes: threads that count and copy the bytes of an interval, a warp."""
INTERVAL_BLOCKS = RESTART_INTERVAL * int(BLOCKS_PER_MCU)
"""Blocks of a restart interval."""
QUAD = 4
"""Coefficients of 16 bits in an element of 64."""
HUFFMAN = struct_arrays(HuffmanTables, "component", "symbol")


@dataclass(frozen=True, eq=False)
class JpegBuffers:
    """JPEG files of one batch of views, and their sizes [B]; above the capacity: the file is incomplete."""

    jpeg_size: wp.array = device_array("view", dtype=wp.int32)
    """Size of each file [B]; above the capacity of `jpeg`: the file is incomplete."""
    jpeg: wp.array = device_array("view", "byte", dtype=wp.uint8)
    """The files, from the first byte."""


@dataclass(frozen=True, eq=False)
class JpegScratch:
    """Samples, DCT coefficients, bit strings and positions of one batch: scratch of the encoder."""

    sample: wp.array = device_array("view", "sample_row", "sample_block", dtype=wp.uint64)
    """Rows of eight samples: Y, below it Cb and Cr side by side, of whole MCUs."""
    coefficient: wp.array = device_array("view", "quad", "block", dtype=wp.uint64)
    """Quantized DCT coefficients in zigzag order, four of 16 bits in each element."""
    nonzero: wp.array = device_array("view", "block", dtype=wp.uint64)
    """Bit field of the coefficients that are not 0."""
    block_bits: wp.array = device_array("view", "block", dtype=wp.int32)
    """Length of each block's bit string [bit]."""
    block_begin: wp.array = device_array("view", "block", dtype=wp.int32)
    """First bit of each block in its interval."""
    slot: wp.array = device_array("view", "interval", "slot_word", dtype=wp.uint32)
    """Bit string of each restart interval, most significant bit first."""
    coded: wp.array = device_array("view", "interval", dtype=wp.int32)
    """Size of each bit string [B], also beyond its slot."""
    stuffing: wp.array = device_array("view", "interval", "lane", dtype=wp.int32)
    """Bytes that each lane stuffs into its chunk of an interval."""
    interval_size: wp.array = device_array("view", "interval", dtype=wp.int32)
    """Size of each interval in the file [B], with stuffing and marker."""
    interval_begin: wp.array = device_array("view", "interval", dtype=wp.int32)
    """First byte of each interval in the file."""


def jpeg_sizes(views: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions of `JpegBuffers` and `JpegScratch`, for `views` images [px]."""
    across, down = -(-width // int(MCU)), -(-height // int(MCU))
    mcus = across * down
    slot_bytes = int(SLOT_BYTES_PER_PIXEL * MCU**2 * RESTART_INTERVAL)
    sizes = {"view": views, "block": mcus * int(BLOCKS_PER_MCU), "quad": int(BLOCK_SIZE) // QUAD}
    sizes |= {"sample_row": down * int(MCU + BLOCK), "sample_block": across * int(MCU // BLOCK)}
    sizes |= {"interval": -(-mcus // RESTART_INTERVAL), "lane": LANES, "slot_word": slot_bytes // int(WORD_BYTES)}
    return sizes | {"byte": MIN_FILE_BYTES + int(FILE_BYTES_PER_PIXEL * width * height)}


class JpegEncoder:
    """Encodes batches of views; `encode` only launches kernels."""

    def __init__(self, scratch: JpegScratch, width: int, height: int) -> None:
        """
        Args:
            scratch: Scratch for the largest batch.
            width: Of the images [px].
            height: Of the images [px].
        """
        self.scratch, self.device = scratch, scratch.sample.device
        device = self.device
        self.tables = upload_huffman(device)
        divisor = np.stack([quantization(quality) for quality in range(QUALITIES)]) * DIVISOR_SCALE
        self.reciprocal = wp.array(reciprocals(divisor), dtype=wp.uint32, device=device)
        header = [np.frombuffer(make_header(width, height, quality), np.uint8) for quality in range(QUALITIES)]
        self.header = wp.array(np.stack(header), dtype=wp.uint8, device=device)
        rows = self.scratch.sample
        shape = (*rows.shape[:2], rows.shape[2] * int(BLOCK))
        self._samples = wp.array(ptr=rows.ptr, dtype=wp.uint8, shape=shape, device=device)

    def encode(self, image: wp.array, quality: wp.array, count: int, out: JpegBuffers) -> None:
        """Encode the first `count` views.

        Args:
            image: RGB images (view, row, column) vec3ub.
            quality: 1 to 100 (view) int32.
            count: Views in use.
            out: Written.
        """
        scratch = self.scratch
        blocks, intervals = (count, scratch.nonzero.shape[1]), (count, scratch.slot.shape[1])
        _, rows, columns = self._samples.shape
        # A third of the rows are chroma: a row for each pair of rows of Y.
        self._launch(convert_colors_kernel, (count, rows // 3, columns // 2), [image], [self._samples])
        inputs = [scratch.sample, *image.shape[1:3], quality, self.reciprocal]
        self._launch(transform_blocks_kernel, blocks, inputs, [scratch.coefficient, scratch.nonzero])
        inputs = [self.tables, scratch.coefficient, scratch.nonzero]
        self._launch(measure_blocks_kernel, blocks, [*inputs, INTERVAL_BLOCKS], [scratch.block_bits])
        placed = [scratch.block_begin, scratch.slot, scratch.coded, scratch.interval_size]
        self._launch(place_blocks_kernel, intervals, [scratch.block_bits, INTERVAL_BLOCKS, int(MARKER_BYTES)], placed)
        self._launch(write_blocks_kernel, blocks, [*inputs, scratch.block_begin, INTERVAL_BLOCKS], [scratch.slot])
        self._join(quality, count, out)

    def _join(self, quality: wp.array, count: int, out: JpegBuffers) -> None:
        """Launch the last passes: stuff bytes, and join the restart intervals to files."""
        scratch = self.scratch
        lanes, slot_bytes = (count, *scratch.stuffing.shape[1:]), int(WORD_BYTES) * scratch.slot.shape[2]
        self._launch(count_stuffing_kernel, lanes, [scratch.slot, scratch.coded], [scratch.stuffing, scratch.interval_size])
        inputs = [scratch.coded, scratch.interval_size, slot_bytes, self.header.shape[1], out.jpeg.shape[1]]
        self._launch(place_intervals_kernel, count, inputs, [scratch.interval_begin, out.jpeg_size])
        inputs = [scratch.slot, scratch.coded, scratch.interval_size, scratch.interval_begin, scratch.stuffing, quality, self.header]
        self._launch(join_intervals_kernel, lanes, inputs, [out.jpeg])

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list[Any], outputs: list[wp.array]) -> None:
        """Launch a kernel with the block size of the encoder."""
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=JPEG_THREADS)


class Compressor:
    """JPEG files of batches of views."""

    def __init__(self, scratch: JpegScratch, width: int, height: int, quality: int) -> None:
        """
        Args:
            scratch, width, height: As of `JpegEncoder`.
            quality: JPEG quality of views without a sampled one.
        """
        self.encoder = JpegEncoder(scratch, width, height)
        self.fixed_quality, self.device = quality, self.encoder.device
        self.quality = wp.empty(scratch.sample.shape[0], dtype=wp.int32, device=self.device)

    def compress(self, count: int, images: ViewBuffers, out: JpegBuffers) -> None:
        """Encode the colour images of the first `count` views into `out`, with the quality of their effects."""
        inputs = [images.effects, self.fixed_quality]
        wp.launch(jpeg_quality_kernel, dim=count, inputs=inputs, outputs=[self.quality], device=self.device)
        self.encoder.encode(images.color, self.quality, count, out)


def upload_huffman(device: wp.Device) -> Any:
    """Upload the standard Huffman tables (T.81, annex K) as the struct `HuffmanTables`."""
    tables = allocate_struct(HUFFMAN, {"component": 2, "symbol": 256}, device)
    for kind, (codes, lengths) in huffman_codes().items():
        getattr(tables, kind).assign(codes | lengths.astype(np.uint32) << np.uint32(CODE_BITS))
    return tables
