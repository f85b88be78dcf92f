"""OpenEXR images (linear light, float), by the format's own library."""

from __future__ import annotations

import io

import numpy as np
import OpenEXR

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import describe_error

EXR_MAGIC = b"\x76\x2f\x31\x01"
"""First bytes of an OpenEXR file."""
_COLORS = (("R", "G", "B"), ("Y",))


def decode_exr(data: bytes, source: str, most: int) -> np.ndarray:
    """Decode the colour or grey channels of an OpenEXR image as (H, W, 3) float32, linear; the first layer that has them.

    Args:
        data: The file.
        source: Where it comes from, for errors.
        most: Maximum number of pixels, which is checked by the header.

    Raises:
        CatalogError: The image is too large, damaged or has no such channels.
    """
    try:
        low, high = OpenEXR.File(io.BytesIO(data), header_only=True).header()["dataWindow"]
        width, height = (int(size) for size in np.subtract(high, low, dtype=np.int64) + 1)
        if width * height > most:
            raise CatalogError(f"{source}: too large an image, {width} x {height} pixels; allowed: {most} pixels; scale it down")
        channels = OpenEXR.File(io.BytesIO(data), separate_channels=True).channels()
    except CatalogError:
        raise
    except Exception as error:  # the library raises nearly anything on damaged files
        raise CatalogError(f"{source}: not readable as OpenEXR ({describe_error(error)}); use PNG or JPEG") from None
    planes = _planes({str(name): np.asarray(channel.pixels) for name, channel in channels.items()})
    if planes is None:
        raise CatalogError(f"{source}: an OpenEXR image without channels R, G, B or Y of one size; use PNG or JPEG")
    return np.nan_to_num(np.stack(planes, axis=-1).astype(np.float32), nan=0.0, posinf=1.0, neginf=0.0)


def _planes(channels: dict[str, np.ndarray]) -> list[np.ndarray] | None:
    """Three planes (H, W) of the first layer with colours, or with grey; a sole channel of any name is grey. None: there are none."""
    layers = sorted({name.rpartition(".")[0] for name in channels}, key=lambda layer: (len(layer), layer))
    for names in _COLORS:
        for layer in layers:
            found = [channels.get(f"{layer}.{name}" if layer else name) for name in names]
            planes = [plane for plane in found if plane is not None]
            if len(planes) == len(names) and len({plane.shape for plane in planes}) == 1:
                return planes * (3 // len(planes))
    return list(channels.values()) * 3 if len(channels) == 1 else None
