"""Run-length encoding of masks along image columns, as in COCO RLE: from run boundaries of id images to runs, boxes and counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Runs:
    """True pixels of a binary mask as vertical runs within single columns.

    Sorted by column, then row. Two runs of a column are separated by at least one False pixel.
    """

    column: np.ndarray
    """Column of each run (N) int64."""
    first: np.ndarray
    """Row of the run's first pixel (N) int64."""
    past: np.ndarray
    """Row after the run's last pixel (N) int64."""

    @property
    def count(self) -> int:
        """Number of True pixels."""
        return int(self.past.sum() - self.first.sum())

    def box(self) -> tuple[int, int, int, int] | None:
        """Bounding box x_min, y_min, x_max, y_max of the True pixels, inclusive; None if there are none."""
        if not self.column.size:
            return None
        return int(self.column[0]), int(self.first.min()), int(self.column[-1]), int(self.past.max()) - 1

    def counts(self, height: int, width: int) -> np.ndarray:
        """COCO's uncompressed RLE: lengths of alternating False and True runs in column-major order, False first.

        Returns:
            (M) int64; they sum to height · width.
        """
        bounds = np.empty(2 * self.column.size + 2, np.int64)
        bounds[0], bounds[-1] = 0, height * width
        offset = self.column * height
        np.add(offset, self.first, out=bounds[1:-1:2])
        np.add(offset, self.past, out=bounds[2:-1:2])
        # A run that ends at the bottom of a column may continue at the top of the next: merge the two.
        apart = bounds[3:-1:2] != bounds[2:-2:2]
        if not apart.all():
            bounds = np.concatenate((bounds[:2], np.stack((bounds[2:-2:2], bounds[3:-1:2]), axis=1)[apart].ravel(), bounds[-2:]))
        counts = np.diff(bounds)
        return counts if counts[-1] else counts[:-1]


@dataclass(frozen=True, eq=False)
class RunBoundaries:
    """Column-wise run boundaries of an integer image: pairs of vertical neighbours whose values differ.

    Sorted by column, then row. Above and below the image, values count as 0.
    """

    column: np.ndarray
    """(N) int64."""
    row: np.ndarray
    """Row of the pixel below the boundary (N) int64."""
    above: np.ndarray
    """Value of the pixel above the boundary (N)."""
    below: np.ndarray
    """Value of the pixel below the boundary (N)."""

    def runs_of(self, value: int) -> Runs:
        """Mask of the pixels that equal a value other than 0."""
        typed = self.above.dtype.type(value)
        return self._runs((self.above == typed) | (self.below == typed))

    def runs_with(self, bit: int) -> Runs:
        """Mask of the pixels that have a bit set; 0 is the lowest."""
        return self._runs((self.above ^ self.below) & self.above.dtype.type(1 << bit) != 0)

    def _runs(self, chosen: np.ndarray) -> Runs:
        """Pair the chosen boundaries: they alternate between start and end of a run, as both neighbours of a boundary differ."""
        index = np.flatnonzero(chosen)
        row = self.row[index]
        return Runs(self.column[index[::2]], row[::2], row[1::2])


def unpack_run_boundaries(packed: np.ndarray, height: int) -> RunBoundaries:
    """Unpack run boundaries that the device has listed.

    Args:
        packed: (3, N): column · (height + 1) + row, value above, value below; see `FrameBatch.boundaries`.
        height: Height of the image [px].
    """
    column, row = np.divmod(packed[0].astype(np.int64), height + 1)
    return RunBoundaries(column, row, packed[1], packed[2])


def find_run_boundaries(image: np.ndarray, top: int = 0, left: int = 0) -> RunBoundaries:
    """Find the run boundaries of an image that is 0 outside of a crop.

    Args:
        image: The crop (h, w).
        top: Row of its first pixel in the image.
        left: Column of its first pixel in the image.
    """
    rows, columns = image.shape
    if not image.size:
        nothing = np.zeros(0, np.int64)
        return RunBoundaries(nothing, nothing, nothing.astype(image.dtype), nothing.astype(image.dtype))
    changes = np.empty((rows + 1, columns), bool)
    np.not_equal(image[0], 0, out=changes[0])
    np.not_equal(image[1:], image[:-1], out=changes[1:-1])
    np.not_equal(image[-1], 0, out=changes[-1])
    # Boundaries are few: finding them row by row and sorting is faster than transposing the image.
    row, column = np.divmod(np.flatnonzero(changes), columns)
    column, row = np.divmod(np.sort(column * (rows + 1) + row), rows + 1)
    above, below = image[row - 1, column], image[np.minimum(row, rows - 1), column]
    above[row == 0] = 0
    below[row == rows] = 0
    return RunBoundaries(left + column, top + row, above, below)
