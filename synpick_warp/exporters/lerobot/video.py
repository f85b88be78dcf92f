"""H.264 videos: closed groups of pictures (GOPs), encoded independently by any writer process and remuxed into MP4 files.

A group has its own encoder of one thread, and colour is converted in fixed-point arithmetic, so bytes do not depend on the number of
threads, processes or worlds, nor on the CPU. Of AV1 and H.264 at equal quality, H.264 takes a quarter of the time (exporters/README.md).
"""

from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
from av.codec.context import Flags
from av.video.reformatter import ColorPrimaries, ColorRange, Colorspace, ColorTrc

from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import StoredScene
from synpick_warp.exporters.lerobot.layout import PIXEL_FORMAT

GROUP = 8
"""Length of a group of pictures [frames]: random access decodes at most one group. A quarter of the size of intra frames only."""
_OPTIONS = {
    "preset": "veryfast",
    "crf": "18",  # Constant quality; visually lossless by x264's authors.
    "bf": "0",  # No B-frames, so that frames are decoded in their order.
    "g": str(GROUP),
    # The same algorithms on every CPU. By default those with AVX-512 read past the end of the macroblock tree's data (x264 165): bytes then
    # depend on what freed memory held.
    "x264-params": "cpu-independent=1",
}
"""Options of x264."""
_ENCODER = "libx264"
_STRIDE = 4
"""Sampling stride of colour statistics, in rows and columns [px]."""
LEVELS = 256
"""Levels of an 8-bit colour channel."""


def split_planes(color: np.ndarray) -> np.ndarray:
    """Convert an RGB image (H, W, 3) uint8, H and W even, to planar YUV 4:2:0 (I420; BT.601, limited range): planes Y, U and V, one after
    the other (3 H / 2, W) uint8."""
    return cv2.cvtColor(color, cv2.COLOR_RGB2YUV_I420)


def count_levels(color: np.ndarray) -> np.ndarray:
    """Histogram of each colour channel, over every _STRIDE-th row and column (3, LEVELS) int64."""
    sample = color[::_STRIDE, ::_STRIDE]
    return np.stack([np.bincount(sample[..., channel].ravel(), minlength=LEVELS) for channel in range(3)])


def write_frame(color: np.ndarray, path: Path) -> None:
    """Task: spool a frame's histogram and planes for its group."""
    with path.open("wb") as file:
        file.write(count_levels(color).tobytes())
        file.write(split_planes(color).tobytes())


def write_spooled_group(frames: Sequence[Path], size: tuple[int, int], rate: Fraction, path: Path) -> None:
    """Task: encode the spooled frames of a group, and remove them."""
    width, height = size
    levels = np.zeros((3, LEVELS), np.int64)
    planes = []
    for frame in frames:
        data = frame.read_bytes()
        levels += np.frombuffer(data, np.int64, levels.size).reshape(levels.shape)
        planes.append(np.frombuffer(data, np.uint8, offset=levels.nbytes).reshape(height * 3 // 2, width))
    write_group(planes, levels, rate, path)
    for frame in frames:
        frame.unlink()


def write_stored_group(scene: StoredScene, first: int, rate: Fraction, path: Path) -> None:
    """Task: encode a group of frames of a stored scene, from `first` on."""
    planes, levels = [], np.zeros((3, LEVELS), np.int64)
    for view in scene.views(range(first, min(first + GROUP, scene.frames))):
        color = view.color_image()
        levels += count_levels(color)
        planes.append(split_planes(color))
    write_group(planes, levels, rate, path)


def write_group(planes: Sequence[np.ndarray], levels: np.ndarray, rate: Fraction, path: Path) -> None:
    """Encode a group of pictures to a file: histogram, number of packets, their sizes, and the packets, one per frame."""
    encoder = av.CodecContext.create(_ENCODER, "w")
    _configure(encoder, planes[0].shape[1], planes[0].shape[0] * 2 // 3, rate)
    packets = []
    for index, plane in enumerate(planes):
        frame = av.VideoFrame.from_ndarray(plane, PIXEL_FORMAT)
        frame.pts, frame.time_base = index, 1 / rate
        packets += encoder.encode(frame)
    packets += encoder.encode(None)
    if len(packets) != len(planes):
        raise OutputError(
            f"the encoder made {len(packets)} packets of {len(planes)} frames; this is an error of synpick-warp, please report it"
        )
    with path.open("wb") as file:
        file.write(levels.astype(np.int64).tobytes())
        file.write(np.array([len(packets), *(packet.size for packet in packets)], np.uint32).tobytes())
        file.writelines(bytes(packet) for packet in packets)


def join_groups(groups: Sequence[Path], size: tuple[int, int], rate: Fraction, path: Path) -> np.ndarray:
    """Remux encoded groups into an MP4 file; returns the histogram of all frames (3, LEVELS) int64."""
    levels = np.zeros((3, LEVELS), np.int64)
    with av.open(str(path), "w", format="mp4") as container:
        stream = container.add_stream(_ENCODER, rate=rate)
        _configure(stream.codec_context, *size, rate)
        stream.time_base = 1 / rate
        frame = 0
        for group in groups:
            data = group.read_bytes()
            levels += np.frombuffer(data, np.int64, levels.size).reshape(levels.shape)
            for index, payload in enumerate(_split_packets(data[levels.nbytes :])):
                packet = av.Packet(payload)
                packet.stream, packet.time_base = stream, 1 / rate
                packet.pts = packet.dts = frame
                packet.duration, packet.is_keyframe = 1, index == 0
                container.mux(packet)
                frame += 1
    return levels


def _split_packets(data: bytes) -> Iterator[bytes]:
    """Yield the packets of an encoded group of pictures: their count and sizes (uint32) come first."""
    count = int(np.frombuffer(data, np.uint32, 1)[0])
    sizes = np.frombuffer(data, np.uint32, count, offset=4).tolist()
    place = 4 * (1 + count)
    for size in sizes:
        yield data[place : place + size]
        place += size


def _configure(context: av.VideoCodecContext, width: int, height: int, rate: Fraction) -> None:
    """Configure an encoder: the same for every group and for the file, whose header holds the parameter sets that all groups share."""
    context.width, context.height, context.pix_fmt = width, height, PIXEL_FORMAT
    context.framerate, context.time_base = rate, 1 / rate
    context.options = dict(_OPTIONS)
    context.thread_count = 1
    context.flags |= Flags.global_header
    context.color_range, context.colorspace = ColorRange.MPEG, Colorspace.ITU601
    context.color_primaries, context.color_trc = ColorPrimaries.BT709, ColorTrc.IEC61966_2_1
