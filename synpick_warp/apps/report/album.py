"""Pictures of a page, encoded, and held within a budget of bytes."""

from __future__ import annotations

import base64
import enum
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import cv2
import numpy as np

from synpick_warp.errors import OutputError

BUDGET = 25_000_000
"""Most bytes of all pictures of a page, as they stand in it, in Base64."""
PHOTO_QUALITY = 82
"""WebP quality of colour images and false colours."""


class Section(enum.Enum):
    """Part of a page; its value is its share of the budget."""

    FRAMES = 0.45
    EPISODES = 0.40
    ATTEMPTS = 0.15


class EncodedPicture(NamedTuple):
    """Encoded image (WebP or PNG) of a report."""

    kind: str
    """webp or png."""
    data: bytes

    @property
    def size(self) -> int:
        """Bytes that the image takes in Base64."""
        return 4 * -(-len(self.data) // 3)


@dataclass
class Album:
    """Encoded pictures of a page in the order in which they were added, within a budget of bytes."""

    budget: int = BUDGET
    pictures: list[EncodedPicture] = field(default_factory=list)
    spent: Counter[Section] = field(default_factory=Counter)
    """Bytes of each section."""

    def left(self, section: Section) -> int:
        """Bytes that a section may still add to the album's budget."""
        return int(section.value * self.budget) - self.spent[section]

    def add(self, section: Section, pictures: Sequence[EncodedPicture]) -> list[int] | None:
        """Add pictures that belong together; returns their indices, or None, and adds none, if the section's share is too small."""
        size = sum(picture.size for picture in pictures)
        if size > self.left(section):
            return None
        self.spent[section] += size
        first = len(self.pictures)
        self.pictures += pictures
        return list(range(first, len(self.pictures)))

    def encoded(self) -> list[tuple[str, str]]:
        """(kind, Base64 text) of each picture, in order."""
        return [(picture.kind, base64.b64encode(picture.data).decode("ascii")) for picture in self.pictures]


def shrink(image: np.ndarray, width: int, *, smooth: bool = True) -> np.ndarray:
    """Scale an image down to at most that width [px]; nearest neighbour unless `smooth`, as ids and masks need it."""
    if image.shape[1] <= width:
        return image
    size = width, max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smooth else cv2.INTER_NEAREST)


def encode_photo(image: np.ndarray, quality: int = PHOTO_QUALITY) -> EncodedPicture:
    """Encode an image (H, W, 3) uint8, blue first, as WebP."""
    return EncodedPicture("webp", _encode(".webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality]))


def encode_ids(image: np.ndarray) -> EncodedPicture:
    """Encode an id image (H, W) uint8 as a lossless PNG."""
    return EncodedPicture("png", _encode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9]))


def _encode(suffix: str, image: np.ndarray, options: list[int]) -> bytes:
    """Encode an image by OpenCV; raises OutputError if it cannot."""
    try:
        encoded, data = cv2.imencode(suffix, image, options)
    except cv2.error:
        encoded, data = False, np.empty(0, np.uint8)
    if not encoded:
        raise OutputError(f"OpenCV cannot encode {image.shape[1]} x {image.shape[0]} pixels as {suffix}; use another build of OpenCV")
    return data.tobytes()
