"""Bounded image decoding: PNG and JPEG, and TIFF in the data sets of others, whose stated size is checked before a pixel is decoded
(prevention of decompression bombs).

Other formats that OpenCV could read are refused. NumPy, OpenCV and Pillow are imported when they are first needed.
"""

from __future__ import annotations

import io
import struct
from typing import TYPE_CHECKING

from synpick_warp.errors import SynpickError

if TYPE_CHECKING:
    import numpy as np

MAX_SIDE = 8192
"""Largest width and height of an image [px]: the limit of cameras.resolution."""
MAX_IMAGE_FILE = 2**29
"""Largest image file [bytes]: an image of MAX_SIDE with three channels of 16 bits, not compressed, has 384 MiB."""
TEXTURE_KINDS = ("png", "jpg", "jpeg", "bmp", "tga", "tif", "tiff", "webp")
"""Suffixes, without dot, that a texture's file may have in a data set; what it holds is decided by its content."""
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_TIFF = (b"II*\0", b"MM\0*")


def image_size(data: bytes) -> tuple[int, int] | None:
    """Width and height [px] that the header of a PNG, JPEG or TIFF file states; None: it is none of these, or damaged."""
    if data.startswith(_PNG):
        return struct.unpack_from(">II", data, 16) if len(data) >= 24 and data[12:16] == b"IHDR" else None
    if not data.startswith((_JPEG, *_TIFF)):
        return None
    from PIL.JpegImagePlugin import JpegImageFile
    from PIL.TiffImagePlugin import TiffImageFile

    try:
        with (JpegImageFile if data.startswith(_JPEG) else TiffImageFile)(io.BytesIO(data)) as image:
            return image.size
    except Exception:  # Pillow raises nearly anything on damaged files
        return None


def decode_image(data: bytes, source: object, error: type[SynpickError], size: tuple[int, int] | None = None) -> np.ndarray:
    """Decode a PNG or JPEG file's content by OpenCV, unchanged; greyscale PNG files as a bake writes them by ISA-L, which is faster.
    `source`: where it comes from, for messages. `size`: width and height that it must have [px]; None: any up to MAX_SIDE. Returns the
    image (H, W[, 3]), blue first. Raises SynpickError: as `error`, in one line: it is not an image of that size."""
    stated = None if data.startswith(_TIFF) else image_size(data)
    if stated is None:
        raise error(f"{source} is not an image: neither PNG nor JPEG")
    if size is not None and stated != size:
        raise error(f"{source} has {_show(stated)} pixels; the images of this camera have {_show(size)}")
    if not (min(stated) > 0 and max(stated) <= MAX_SIDE):
        raise error(f"{source} has {_show(stated)} pixels; allowed: up to {MAX_SIDE} x {MAX_SIDE}")
    fast = _decode_grey(data, stated) if data.startswith(_PNG) else None
    return _decode_by_opencv(data, source, error, stated) if fast is None else fast


def decode_picture(data: bytes, source: object, error: type[SynpickError], size: tuple[int, int] | None = None) -> np.ndarray:
    """Decode a PNG, JPEG or TIFF file, keeping its channels and bit depth. Arguments, result and errors are those of `decode_image`."""
    if not data.startswith(_TIFF):
        return decode_image(data, source, error, size=size)
    stated = image_size(data)
    if stated is None or not (min(stated) > 0 and max(stated) <= MAX_SIDE):
        raise error(f"{source} is not a TIFF image of up to {MAX_SIDE} x {MAX_SIDE} pixels")
    if size is not None and stated != size:
        raise error(f"{source} has {_show(stated)} pixels; the images of this camera have {_show(size)}")
    return _decode_by_opencv(data, source, error, stated)


def _decode_by_opencv(data: bytes, source: object, error: type[SynpickError], stated: tuple[int, int]) -> np.ndarray:
    """Image of a file, unchanged; raises `error` unless it has the size that its header states, as after a TIFF's rotation."""
    import cv2
    import numpy as np

    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[1::-1] != stated:
        raise error(f"{source} is not an image that OpenCV can decode")
    return image


def _decode_grey(data: bytes, size: tuple[int, int]) -> np.ndarray | None:
    """Greyscale image of a PNG file by `system.inputs.png_crop`; None: it is left to OpenCV."""
    from synpick_warp.system.inputs.png_crop import decode_grey_crop

    if data[24:25] not in (b"\x08", b"\x10"):
        return None
    image = decode_grey_crop(data, size, slice(0, size[1]), slice(0, size[0]), bits=data[24])
    return None if image is None else image.astype(image.dtype.newbyteorder("="), copy=False)


def _show(size: tuple[int, ...]) -> str:
    """Size as text, such as "640 x 480"."""
    return f"{size[0]} x {size[1]}"
