"""Rules about colour, greyscale and depth images: that they decode, their sizes and types."""

from __future__ import annotations

import numpy as np

from synpick_warp.apps.validation.registry import Findings, Level, rule
from synpick_warp.apps.validation.subjects import ViewSubject

MIN_KNOWN_DEPTH = 0.05
"""Smallest fraction of pixels with depth that raises no warning; the poorest sensors of BOP's sets have half."""


@rule(ViewSubject, "image-decodes", "restore the file: it is damaged, empty or of another format")
def check_decodes(view: ViewSubject) -> Findings:
    """Every image is a PNG, JPEG or TIFF file that decodes."""
    _ = view.colour, view.depth, view.masks
    yield from dict.fromkeys(view.faults)


@rule(ViewSubject, "image-size", "write them at the resolution of the camera")
def check_sizes(view: ViewSubject) -> Findings:
    """Colour, depth and masks of an image have the same width and height."""
    if view.size is None:
        return
    sizes = [(mask.file, mask.size) for masks in view.masks.values() for mask in masks if mask is not None]
    if view.depth_file is not None:
        sizes.append((view.depth_file[0], (view.depth_file[1].shape[1], view.depth_file[1].shape[0])))
    for file, size in sizes:
        if size != view.size:
            yield file, f"{size[0]} x {size[1]} px; the image has {view.size[0]} x {view.size[1]}"


@rule(ViewSubject, "colour-type", "convert the image; put greyscale images into gray")
def check_colour(view: ViewSubject) -> Findings:
    """rgb has three channels of 8 bits, gray one of 8 or 16 bits."""
    if view.colour is None:
        return
    file, image = view.colour
    if view.scene.colour == "rgb":
        if image.ndim == 3 and image.shape[2] == 3 and image.dtype == np.uint8:
            return
    elif image.dtype in (np.uint8, np.uint16) and (image.ndim == 2 or (image[..., :1] == image[..., :3]).all()):
        return
    yield file, f"{(*image.shape[2:], 1)[0]} channels of type {image.dtype}"


@rule(ViewSubject, "depth-type", "write uint16 counts, clamped to 65535; 0 is no measurement")
def check_depth_type(view: ViewSubject) -> Findings:
    """Depth is a PNG (or TIFF) file of one channel with 16 bits."""
    if view.depth_file is None:
        return
    file, image, kind = view.depth_file
    if image.ndim != 2 or image.dtype != np.uint16:
        bits = f"{kind[0]} bits {kind[1]}" if kind else f"type {image.dtype}"
        yield file, f"{(*image.shape[2:], 1)[0]} channels, {bits}"


@rule(ViewSubject, "depth-known", "check the writer, and depth_scale: counts above 65535 do not fit", level=Level.WARNING)
def check_depth_known(view: ViewSubject) -> Findings:
    """A depth image has measurements."""
    if view.depth is not None and view.depth_file is not None:
        known = np.count_nonzero(view.depth) / view.depth.size
        if known < MIN_KNOWN_DEPTH:
            yield view.depth_file[0], f"only {known:.1%} of the pixels have depth"
