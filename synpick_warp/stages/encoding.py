"""Encoders of images on the device: baseline JPEG, with 4:2:0 chroma subsampling and restart intervals, and compressed data (IDAT) of depth
PNG files of 16 bits, to which writers add the other chunks.

JPEG files equal libjpeg's (`system.codecs.jpeg.encode_jpeg`) byte for byte. Only the files are copied to the host; at quality 95 they have
a tenth of the image's size. Depth files: see `system.codecs.depth_png`. Their bytes depend on the image alone, not on the device: all
arithmetic is in integers.
"""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.encoding import dct, huffman, png, stuffing
from synpick_warp.kernels.render.images.camera_effects import jpeg_quality_kernel
from synpick_warp.kernels.tuning import JPEG_THREADS
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, struct_arrays
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.launch import launch
from synpick_warp.system.codecs import depth_png, jpeg

SLOT_BYTES_PER_PIXEL = 1.0
"""Capacity of a restart interval: nearly four times the mean at quality 95 (568 kB for a full-HD view of a tote)."""
FILE_BYTES_PER_PIXEL = 0.75
"""Capacity of a file: nearly three times its size at quality 95."""
MIN_FILE_BYTES = 1024
"""Capacity for header and markers [B]."""
LANES = 32
"""Lanes: threads that count and copy the bytes of an interval, a warp."""
INTERVAL_BLOCKS = jpeg.RESTART_INTERVAL * int(dct.BLOCKS_PER_MCU)
"""Blocks of a restart interval."""
QUAD = 4
"""Coefficients of 16 bits in an element of 64."""
HUFFMAN = struct_arrays(huffman.HuffmanTables, "component", "symbol")


class JpegBuffers(array_group(stuffing.JpegFiles, "view", jpeg=("view", "byte"))):
    """JPEG files of one batch of views, and their sizes."""


_BLOCKS = dict.fromkeys(("nonzero", "block_bits", "block_begin"), ("view", "block")) | {"coefficient": ("view", "quad", "block")}
_INTERVALS = {"slot": ("view", "interval", "slot_word"), "stuffing": ("view", "interval", "lane")}
_SAMPLES = {"sample": ("view", "sample_row", "sample_block")}


class JpegScratch(array_group(dct.JpegData, "view", "interval", **_SAMPLES, **_BLOCKS, **_INTERVALS)):
    """Scratch of the encoder for one batch."""


def jpeg_sizes(views: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions of `JpegBuffers` and `JpegScratch`, for `views` images [px]."""
    across, down = -(-width // int(dct.MCU)), -(-height // int(dct.MCU))
    mcus = across * down
    slot_bytes = int(SLOT_BYTES_PER_PIXEL * dct.MCU**2 * jpeg.RESTART_INTERVAL)
    sizes = {"view": views, "block": mcus * int(dct.BLOCKS_PER_MCU), "quad": int(dct.BLOCK_SIZE) // QUAD}
    sizes |= {"sample_row": down * int(dct.MCU + dct.BLOCK), "sample_block": across * int(dct.MCU // dct.BLOCK)}
    sizes |= {"interval": -(-mcus // jpeg.RESTART_INTERVAL), "lane": LANES, "slot_word": slot_bytes // int(stuffing.WORD_BYTES)}
    return sizes | {"byte": MIN_FILE_BYTES + int(FILE_BYTES_PER_PIXEL * width * height)}


class JpegEncoder:
    """Encodes batches of views; `encode` only launches kernels."""

    def __init__(self, scratch: JpegScratch, width: int, height: int) -> None:
        """`scratch`: scratch for the largest batch. `width`: of the images [px]. `height`: of the images [px]."""
        self.scratch, self.device = scratch, scratch.sample.device
        device = self.device
        self.tables = upload_huffman(device)
        divisor = np.stack([jpeg.quantization(quality) for quality in range(jpeg.QUALITIES)]) * jpeg.DIVISOR_SCALE
        self.reciprocal = wp.array(jpeg.reciprocals(divisor), dtype=wp.uint32, device=device)
        header = [np.frombuffer(jpeg.make_header(width, height, quality), np.uint8) for quality in range(jpeg.QUALITIES)]
        self.header = wp.array(np.stack(header), dtype=wp.uint8, device=device)
        rows = self.scratch.sample
        shape = (*rows.shape[:2], rows.shape[2] * int(dct.BLOCK))
        self._samples = wp.array(ptr=rows.ptr, dtype=wp.uint8, shape=shape, device=device)

    def encode(self, image: wp.array, quality: wp.array, count: int, out: JpegBuffers) -> None:
        """Encode the first `count` views. `image`: RGB (view, row, column) vec3ub. `quality`: 1 to 100 (view) int32. `out`: written."""
        scratch, data = self.scratch, self.scratch.bundle
        blocks, intervals, lanes = ((count, *array.shape[1:]) for array in (scratch.nonzero, scratch.coded, scratch.stuffing))
        _, rows, columns = self._samples.shape
        # A third of the rows are chroma: a row for each pair of rows of Y.
        self._launch(dct.convert_colors_kernel, (count, rows // 3, columns // 2), [image], [self._samples])
        self._launch(dct.transform_blocks_kernel, blocks, [*image.shape[1:3], quality, self.reciprocal], [data])
        self._launch(huffman.measure_blocks_kernel, blocks, [self.tables, INTERVAL_BLOCKS], [data])
        self._launch(huffman.place_blocks_kernel, intervals, [INTERVAL_BLOCKS, int(stuffing.MARKER_BYTES)], [data])
        self._launch(huffman.write_blocks_kernel, blocks, [self.tables, INTERVAL_BLOCKS], [data])
        self._launch(stuffing.count_stuffing_kernel, lanes, [], [data])
        self._launch(stuffing.place_intervals_kernel, count, [self.header.shape[1]], [data, out.bundle])
        self._launch(stuffing.join_intervals_kernel, lanes, [data, quality, self.header], [out.bundle])

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, ...], inputs: list[Any], outputs: list[Any]) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device, block_dim=JPEG_THREADS)


class Compressor:
    """JPEG files of batches of views."""

    def __init__(self, scratch: JpegScratch, width: int, height: int, quality: int) -> None:
        """`scratch`, `width`, `height`: as of `JpegEncoder`. `quality`: JPEG quality of views without a sampled one."""
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
    for kind, (codes, lengths) in jpeg.huffman_codes().items():
        getattr(tables, kind).assign(codes | lengths.astype(np.uint32) << np.uint32(huffman.CODE_BITS))
    return tables


SEGMENT = 2 * depth_png.MAX_RUN
"""Pixels of a segment of a row; the last one may have fewer. Enough segments to fill a GPU; flat areas are whole runs, of a short code."""
DEFLATE_LANES = 8
"""Threads that copy a slot, which has 10 words on average."""
CODE_BITS = 13
"""Bits of a literal's code, at most; a match has fewer than the literals of two samples."""
CODES = struct_arrays(png.Codes, literal=("byte",), run=("run",), distance=("distance",))
SLOT_SUMS = struct_arrays(png.SlotSums, "view", "slot")
GROUP_SUMS = struct_arrays(png.SlotSums, "view", "group")


class DepthBuffers(array_group(png.DepthFiles, "view", depth_idat=("view", "depth_byte"))):
    """Compressed data (IDAT) of the depth PNGs of one batch of views, and their sizes."""


class DepthScratch(array_group(png.Slots, "view", "slot", slot=("view", "slot", "slot_word"), group_begin=("view", "group"))):
    """Scratch of the encoder for one batch."""


def depth_sizes(views: int, width: int, height: int) -> dict[str, int]:
    """Extents of the dimensions of all arrays of the encoder, for `views` images [px]."""
    slots = height * -(-width // SEGMENT) + 2
    bits = CODE_BITS * (1 + 2 * min(width, SEGMENT))
    sizes = {"view": views, "slot": slots, "group": -(-slots // int(png.GROUP))}
    return sizes | {
        "slot_word": max(len(depth_png.pack_words(depth_png.make_prefix())), -(-bits // 32)),
        "depth_byte": depth_png.max_data_bytes(width, height),
    }


def allocate_depth_scratch(views: int, width: int, height: int, device: wp.Device) -> tuple[DepthScratch, Any, Any]:
    """Allocate the scratch of the encoder for `views` images [px]; the others are structs `SlotSums`, of slots and of groups."""
    sizes = depth_sizes(views, width, height)
    return allocate(DepthScratch, sizes, device), allocate_struct(SLOT_SUMS, sizes, device), allocate_struct(GROUP_SUMS, sizes, device)


class DepthEncoder:
    """Encodes batches of depth images; `encode` only launches kernels."""

    def __init__(self, scratch: tuple[DepthScratch, Any, Any], width: int, height: int) -> None:
        """`scratch`: scratch by `allocate_depth_scratch`. `width`: of the images [px]. `height`: of the images [px]."""
        self.scratch, self.slots, self.groups = scratch
        self.device, self.width, self.height = self.scratch.slot.device, width, height
        device = self.device
        tables = {"literal": depth_png.literal_codes(), "run": depth_png.run_codes(), "distance": depth_png.distance_codes()}
        self.codes: Any = allocate_struct(CODES, {"byte": 256, "run": len(tables["run"]), "distance": len(tables["distance"])}, device)
        for name, codes in tables.items():
            getattr(self.codes, name).assign(depth_png.pack_codes(codes))
        self.end_code = int(depth_png.pack_codes([depth_png.end_code()])[0])
        self._fill_first_slot()

    def _fill_first_slot(self) -> None:
        """Write the header that all files begin with; no kernel writes to its slot."""
        prefix = depth_png.make_prefix()
        words = depth_png.pack_words(prefix)
        header = np.broadcast_to(words, (self.scratch.slot.shape[0], len(words)))
        wp.copy(self.scratch.slot[:, 0, : len(words)], wp.array(header, dtype=wp.uint32, device=self.device))
        self.slots.bits[:, 0].fill_(prefix[1])

    def encode(self, image: wp.array, count: int, out: DepthBuffers) -> None:
        """Encode the first `count` views. `image`: depth images (view, row, column) uint16. `count`: views in use. `out`: written."""
        scratch = self.scratch
        segments = (count, self.height, -(-self.width // SEGMENT))
        launch(png.encode_segments_kernel, segments, self, scratch, image=image, segment=SEGMENT, sums=self.slots)
        launch(png.sum_groups_kernel, (count, scratch.group_begin.shape[1]), self, scratch)
        launch(png.close_streams_kernel, count, self, scratch, rows=self.height, columns=self.width, files=out.bundle)
        launch(png.join_slots_kernel, (count, scratch.slot.shape[1], DEFLATE_LANES), self, scratch, lanes=DEFLATE_LANES, files=out.bundle)
