"""The contact sheets of tools/reports/render.py: piles under every light map, fast picture, reference, and their difference."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from synpick_warp.viz.preview import FONT, put_text, write_picture
from tools.reports.render_piles import Pair

CELL_WIDTH = 640
"""Most width of a picture [px]; smaller ones are enlarged by whole numbers."""
MOST_ROWS = 10
"""Light maps on a sheet."""
GAP, LINE = 6, 30
"""Between pictures, and the height of a line of text [px]."""
GAIN = 5
"""Factor on differences, so that they show."""
WHITE, INK = 255, (30, 30, 30)


def contact_sheets(pairs: list[Pair], file: Path) -> list[Path]:
    """Write sheets with a row a pair; the first is `file`, further ones get a number.

    Raises:
        OutputError: They cannot be written.
    """
    parts = [pairs[first : first + MOST_ROWS] for first in range(0, len(pairs), MOST_ROWS)]
    files = [file if number == 1 else file.with_stem(f"{file.stem}-{number}") for number in range(1, len(parts) + 1)]
    return [write_picture(name, draw_sheet(part)[..., ::-1]) for name, part in zip(files, parts, strict=True)]


def draw_sheet(pairs: list[Pair]) -> np.ndarray:
    """One sheet (H, W, 3) uint8, red first."""
    blocks = []
    for pair in pairs:
        words = f"{pair.light}:  {pair.quality:.1f} dB,  bias {pair.bias:+.1f} %"
        row = np.concatenate([_padded(_scaled(picture)) for picture in strip(pair)], axis=1)
        blocks += [_line([words], row.shape[1]), row]
    width = blocks[-1].shape[1]
    heads = ["fast", "reference", f"{GAIN} x their difference"]
    return np.concatenate([_line(heads, width), *blocks])


def strip(pair: Pair) -> list[np.ndarray]:
    """Fast picture, reference and their difference, enhanced, each (H, W, 3) uint8."""
    fast, reference = pair.fast.color, pair.reference.color
    return [fast, reference, cv2.absdiff(fast, reference).clip(0, 255 // GAIN) * GAIN]


def _scaled(picture: np.ndarray) -> np.ndarray:
    height, width = picture.shape[:2]
    if width > CELL_WIDTH:
        return cv2.resize(picture, (CELL_WIDTH, round(height * CELL_WIDTH / width)), interpolation=cv2.INTER_AREA)
    factor = CELL_WIDTH // width
    return picture.repeat(factor, axis=0).repeat(factor, axis=1)


def _padded(picture: np.ndarray) -> np.ndarray:
    return cv2.copyMakeBorder(picture, 0, GAP, 0, GAP, cv2.BORDER_CONSTANT, value=(WHITE, WHITE, WHITE))


def _line(words: list[str], width: int) -> np.ndarray:
    """A line of text, its words evenly spread, made small enough to fit."""
    canvas = np.full((LINE, width, 3), WHITE, np.uint8)
    column = width // len(words)
    for number, text in enumerate(words):
        size = 0.65 * min(1.0, (column - 2 * GAP) / cv2.getTextSize(text, FONT, 0.65, 1)[0][0])
        put_text(canvas, text, (number * column + GAP, LINE - 9), size, INK)
    return canvas
