"""Depth PNG encoder on the device: compressed data (IDAT) of 16-bit greyscale PNG files, to which writers add the other chunks.

See `system.codecs.depth_png` for the format. The bytes depend on the image alone, not on the device: all arithmetic is in integers.
"""

from typing import Any

import numpy as np
import warp as wp

from synpick_warp.kernels.encoding import png
from synpick_warp.stages.arrays import allocate, allocate_struct, array_group, struct_arrays
from synpick_warp.stages.launch import launch
from synpick_warp.system.codecs import depth_png

SEGMENT = 2 * depth_png.MAX_RUN
"""Pixels of a segment of a row; the last one may have fewer. Enough segments to fill a GPU; flat areas are whole runs, of a short code."""
LANES = 8
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
        """
        Args:
            scratch: Scratch by `allocate_depth_scratch`.
            width: Of the images [px].
            height: Of the images [px].
        """
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
        """Encode the first `count` views.

        Args:
            image: Depth images (view, row, column) uint16.
            count: Views in use.
            out: Written.
        """
        scratch = self.scratch
        segments = (count, self.height, -(-self.width // SEGMENT))
        launch(png.encode_segments_kernel, segments, self, scratch, image=image, segment=SEGMENT, sums=self.slots)
        launch(png.sum_groups_kernel, (count, scratch.group_begin.shape[1]), self, scratch)
        launch(png.close_streams_kernel, count, self, scratch, rows=self.height, columns=self.width, files=out.bundle)
        launch(png.join_slots_kernel, (count, scratch.slot.shape[1], LANES), self, scratch, lanes=LANES, files=out.bundle)
