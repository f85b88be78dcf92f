"""Webdataset decoder: images and masks of a shard as arrays of their full depth, for `webdataset.WebDataset(urls).decode(decode_view)`.

webdataset's own image decoders ("rgb8", "torchrgb", "pil", ...) convert every PNG file to 8 bits by clipping: each depth of a 16-bit image
becomes 0 or 255, without a warning. This one keeps what was written; entries that it does not name go on to webdataset's decoders for JSON.
"""

import numpy as np

from synpick_warp.dataset.annotations import MASK_SCHEMA, MAX_INSTANCES, check_json
from synpick_warp.dataset.view_files import check_run_lengths, decode_run_lengths
from synpick_warp.errors import DatasetError
from synpick_warp.system.inputs.image_files import decode_image
from synpick_warp.views.layer_codec import decode_layer
from synpick_warp.views.layers import LAYER_TABLE

_IMAGES = (".png", ".jpg")
_MASKS = (".mask.json", ".mask_visib.json")


def decode_view(key: str, data: bytes) -> np.ndarray | None:
    """Decode one entry of a view, by its name after the view's key, such as ".depth.png".

    Returns `rgb`: (H, W, 3) uint8, red first. `depth`: (H, W) uint16, in units of `depth_scale` mm of `camera.json`; 0: no surface. `mask`,
    `mask_visib`: (N, H, W) bool, one for each entry of `gt.json`; (0, 0, 0) if it has none. Layers: values of `layer_codec.decode_layer`.
    None: the entry is none of these. Raises DatasetError if the entry is damaged; webdataset passes the error on, or calls the handler that
    `decode` was given.
    """
    if key.endswith(_MASKS):
        return _decode_masks(data, key)
    if not key.endswith(_IMAGES):
        return None
    image = decode_image(data, key, DatasetError)
    pixels = np.ascontiguousarray(image[..., ::-1] if image.ndim == 3 else image)
    layer = key.split(".")[-2]
    return decode_layer(layer, pixels) if layer in LAYER_TABLE else pixels


def _decode_masks(data: bytes, key: str) -> np.ndarray:
    """Decode the masks (N, H, W) bool of a view from run lengths; raises DatasetError unless they are numbered from 0 on."""
    records = check_json(data, MASK_SCHEMA, key)
    if len(records) > MAX_INSTANCES or sorted(records) != list(range(len(records))):
        raise DatasetError(f"{key} does not number its masks from 0 on, or has more than {MAX_INSTANCES}")
    if not records:
        return np.zeros((0, 0, 0), bool)
    height, width = records[0]["size"]
    for record in records.values():
        check_run_lengths(record, (width, height), key)
    return np.stack([decode_run_lengths(records[index]["counts"], (height, width)) for index in range(len(records))])
