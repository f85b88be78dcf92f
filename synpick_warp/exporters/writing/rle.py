"""Masks cut out of a view's images as runs down their columns: what COCO's run lengths and mask files are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Runs:
    """The True pixels of a mask: runs down single columns, in order of columns, then rows; between two there is a gap or a column's end."""

    column: np.ndarray
    """(N) int64."""
    first: np.ndarray
    """Row of a run's first pixel (N) int64."""
    past: np.ndarray
    """Row after a run's last pixel (N) int64."""

    @property
    def count(self) -> int:
        """How many pixels are True."""
        return int(self.past.sum() - self.first.sum())

    def box(self) -> tuple[int, int, int, int] | None:
        """x_min, y_min, x_max, y_max of the True pixels, inclusive; None: there are none."""
        if not self.column.size:
            return None
        return int(self.column[0]), int(self.first.min()), int(self.column[-1]), int(self.past.max()) - 1

    def counts(self, height: int, width: int) -> np.ndarray:
        """COCO's uncompressed run lengths: down all columns, False first, in turn (M) int64; they sum to height · width."""
        edges = np.empty(2 * self.column.size + 2, np.int64)
        edges[0], edges[-1] = 0, height * width
        foot = self.column * height
        np.add(foot, self.first, out=edges[1:-1:2])
        np.add(foot, self.past, out=edges[2:-1:2])
        # A run that ends at a column's foot may go on at the head of the next.
        apart = edges[3:-1:2] != edges[2:-2:2]
        if not apart.all():
            edges = np.concatenate((edges[:2], np.stack((edges[2:-2:2], edges[3:-1:2]), axis=1)[apart].ravel(), edges[-2:]))
        counts = np.diff(edges)
        return counts if counts[-1] else counts[:-1]


@dataclass(frozen=True, eq=False)
class RunBoundaries:
    """Run boundaries of a label image: changes of its value down a column, in order of columns, then rows; 0 above and below the image."""

    column: np.ndarray
    """(N) int64."""
    row: np.ndarray
    """Row of the pixel below the boundary (N) int64."""
    above: np.ndarray
    """Value of the pixel above the boundary (N)."""
    below: np.ndarray
    """Value of the pixel below the boundary (N)."""

    def runs_of(self, value: int) -> Runs:
        """Pixels with a value other than 0."""
        number = self.above.dtype.type(value)
        return self._runs((self.above == number) | (self.below == number))

    def runs_with(self, bit: int) -> Runs:
        """Pixels with a bit set; 0 is the lowest."""
        return self._runs((self.above ^ self.below) & self.above.dtype.type(1 << bit) != 0)

    def _runs(self, chosen: np.ndarray) -> Runs:
        """A pixel's value differs from both neighbours': of the chosen boundaries, each second is an end."""
        index = np.flatnonzero(chosen)
        row = self.row[index]
        return Runs(self.column[index[::2]], row[::2], row[1::2])


def unpack_run_boundaries(packed: np.ndarray, height: int) -> RunBoundaries:
    """Unpack run boundaries that the device listed, (3, N) as in `FrameBatch.boundaries`, of images of this height [px]."""
    column, row = np.divmod(packed[0].astype(np.int64), height + 1)
    return RunBoundaries(column, row, packed[1], packed[2])


def find_run_boundaries(image: np.ndarray, top: int = 0, left: int = 0) -> RunBoundaries:
    """Run boundaries of an image that is 0 outside of a part (h, w), whose first pixel is at row `top` and column `left`."""
    rows, columns = image.shape
    if not image.size:
        nothing = np.zeros(0, np.int64)
        return RunBoundaries(nothing, nothing, nothing.astype(image.dtype), nothing.astype(image.dtype))
    changes = np.empty((rows + 1, columns), bool)
    np.not_equal(image[0], 0, out=changes[0])
    np.not_equal(image[1:], image[:-1], out=changes[1:-1])
    np.not_equal(image[-1], 0, out=changes[-1])
    # Boundaries are few: to find them row by row and to sort them is faster than to transpose the image.
    row, column = np.divmod(np.flatnonzero(changes), columns)
    column, row = np.divmod(np.sort(column * (rows + 1) + row), rows + 1)
    above, below = image[row - 1, column], image[np.minimum(row, rows - 1), column]
    above[row == 0] = 0
    below[row == rows] = 0
    return RunBoundaries(left + column, top + row, above, below)
