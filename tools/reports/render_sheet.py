"""Contact sheets of piles under every light map: denoised image, reference, and their amplified difference."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from synpick_warp.apps.viz.drawing import FONT, put_text, write_picture
from tools.reports.render_piles import Pair

CELL_WIDTH = 640
"""Maximum width of an image [px]; smaller ones are enlarged by an integer factor."""
MAX_ROWS = 10
"""Image pairs on a sheet, at most."""
GAP, LINE = 6, 30
"""Gap between images, and height of a line of text [px]."""
GAIN = 5
"""Factor that makes differences visible."""
WHITE, INK = 255, (30, 30, 30)
"""Colors of background and text."""


def write_sheets(pairs: list[Pair], file: Path) -> list[Path]:
    """Write contact sheets with a row per pair; the first is `file`, further ones get the suffix -2, -3, ...; returns the files.

    Raises:
        OutputError: A file cannot be written.
    """
    groups = [pairs[first : first + MAX_ROWS] for first in range(0, len(pairs), MAX_ROWS)]
    files = [file if index == 1 else file.with_stem(f"{file.stem}-{index}") for index in range(1, len(groups) + 1)]
    return [write_picture(name, draw_sheet(group)[..., ::-1]) for name, group in zip(files, groups, strict=True)]


def draw_sheet(pairs: list[Pair]) -> np.ndarray:
    """Draw one contact sheet (H, W, 3) uint8 RGB."""
    blocks = []
    for pair in pairs:
        label = f"{pair.light}:  {pair.quality:.1f} dB,  bias {pair.bias:+.1f} %"
        row = np.concatenate([_pad(_scale(image)) for image in image_strip(pair)], axis=1)
        blocks += [_draw_line([label], row.shape[1]), row]
    width = blocks[-1].shape[1]
    headings = ["denoised", "reference", f"{GAIN} x their difference"]
    return np.concatenate([_draw_line(headings, width), *blocks])


def image_strip(pair: Pair) -> list[np.ndarray]:
    """Denoised image, reference and their difference times `GAIN`, each (H, W, 3) uint8."""
    denoised, reference = pair.denoised.color, pair.reference.color
    return [denoised, reference, cv2.absdiff(denoised, reference).clip(0, 255 // GAIN) * GAIN]


def _scale(image: np.ndarray) -> np.ndarray:
    """Image scaled to the cells' width."""
    height, width = image.shape[:2]
    if width > CELL_WIDTH:
        return cv2.resize(image, (CELL_WIDTH, round(height * CELL_WIDTH / width)), interpolation=cv2.INTER_AREA)
    factor = CELL_WIDTH // width
    return image.repeat(factor, axis=0).repeat(factor, axis=1)


def _pad(image: np.ndarray) -> np.ndarray:
    """Add the gap at the right and bottom of an image."""
    return cv2.copyMakeBorder(image, 0, GAP, 0, GAP, cv2.BORDER_CONSTANT, value=(WHITE, WHITE, WHITE))


def _draw_line(texts: list[str], width: int) -> np.ndarray:
    """Draw a line of evenly spaced texts, shrunk to fit their columns."""
    canvas = np.full((LINE, width, 3), WHITE, np.uint8)
    column = width // len(texts)
    for index, text in enumerate(texts):
        size = 0.65 * min(1.0, (column - 2 * GAP) / cv2.getTextSize(text, FONT, 0.65, 1)[0][0])
        put_text(canvas, text, (index * column + GAP, LINE - 9), size, INK)
    return canvas
