"""Run-length encoding of masks along image columns, as in COCO RLE: from run boundaries of id images to runs, boxes and counts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MAX_INSTANCES = 32
"""Largest number of instances of an image: bits of `FrameBatch.amodal`."""


@dataclass(eq=False, slots=True)
class Runs:
    """Run-length encoding of a binary mask: vertical runs of true pixels, from row `first` to before `past`; with pixel count and rows
    spanned.

    Sorted by column, then row. Two runs of a column are separated by at least one False pixel.
    """

    column: np.ndarray
    """Column of each run (N) int64."""
    first: np.ndarray
    """Row of the run's first pixel (N) int64."""
    past: np.ndarray
    """Row after the run's last pixel (N) int64."""

    count: int
    """Number of True pixels."""
    top: int
    """First row with a True pixel; 0 if there is none."""
    bottom: int
    """Row after the last True pixel; 0 if there is none."""

    def box(self) -> tuple[int, int, int, int] | None:
        """Bounding box x_min, y_min, x_max, y_max of the True pixels, inclusive; None if there are none."""
        if not self.column.size:
            return None
        return int(self.column[0]), self.top, int(self.column[-1]), self.bottom - 1

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
        if self.bottom == height:
            apart = bounds[3:-1:2] != bounds[2:-2:2]
            bounds = np.concatenate((bounds[:2], np.stack((bounds[2:-2:2], bounds[3:-1:2]), axis=1)[apart].ravel(), bounds[-2:]))
        counts = bounds[1:] - bounds[:-1]
        return counts if counts[-1] else counts[:-1]


@dataclass(frozen=True, eq=False)
class Masks:
    """Amodal (silhouette, hidden parts included) and visible mask of an instance, as runs clipped to the image."""

    amodal: Runs
    """Silhouette, including hidden parts."""
    visible: Runs
    """Visible (modal) part."""


@dataclass(frozen=True, eq=False)
class RunBoundaries:
    """Column-wise run boundaries of an integer image: pairs of vertical neighbours whose values differ.

    Above and below the image, values count as 0.
    """

    place: np.ndarray
    """Position column · `span` + row of the pixel below the boundary, in increasing order (N) unsigned integers."""
    span: int
    """Positions per column: greater than the number of rows, since a boundary may lie below the last one."""
    above: np.ndarray
    """Value of the pixel above the boundary (N)."""
    below: np.ndarray
    """Value of the pixel below the boundary (N)."""

    def runs_of(self, value: int) -> Runs:
        """Mask of the pixels that equal a value from 1 to MAX_INSTANCES."""
        return self.split_by_value([value - 1])[0]

    def split_by_value(self, instances: Sequence[int]) -> list[Runs]:
        """Masks of the pixels that equal 1 + i for instances i, from one pass over the boundaries."""
        return self._split(self._list_values(self.below), self._list_values(self.above), instances)

    def split_by_bit(self, instances: Sequence[int]) -> list[Runs]:
        """Masks of the pixels that have bit i set for instances i, 0 the lowest, from one pass over the boundaries."""
        changed = self.above ^ self.below
        return self._split(self._list_bits(changed & self.below), self._list_bits(changed & self.above), instances)

    def _make_keys(self, instance: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Sort keys, by instance and then by position (M): of 32 bits if they suffice, which NumPy sorts in half the time."""
        kind = np.uint32 if MAX_INSTANCES * self._places < 1 << 32 else np.uint64
        return instance.astype(kind, copy=False) * kind(self._places) + place.astype(kind, copy=False)

    @property
    def _places(self) -> int:
        """Number of positions up to the last boundary: the range of keys that an instance takes."""
        return 1 + int(self.place[-1]) if self.place.size else 1

    def _list_values(self, values: np.ndarray) -> np.ndarray:
        """List the boundaries beside which a value (N) denotes an instance, as sorted keys (M)."""
        # Of unsigned integers, 0 - 1 is the largest.
        instance = values.astype(np.uint32, copy=False) - np.uint32(1)
        listed = np.flatnonzero(instance < MAX_INSTANCES)
        return np.sort(self._make_keys(instance[listed], self.place[listed]))

    def _list_bits(self, words: np.ndarray) -> np.ndarray:
        """List the boundaries beside which a bit is set in a word (N), each once for each bit, as sorted keys (M)."""
        keys: list[np.ndarray] = []
        listed = np.flatnonzero(words != 0)
        words, place = words[listed].astype(np.uint32, copy=False), self.place[listed]
        while words.size or not keys:
            # Take the lowest bit of each word, and go on with the few words that have another.
            others = words & (words - np.uint32(1))
            bit = np.bitwise_count((words ^ others) - np.uint32(1))
            keys.append(self._make_keys(bit, place))
            rest = np.flatnonzero(others != 0)
            words, place = others[rest], place[rest]
        return np.sort(np.concatenate(keys))

    def _split(self, begin: np.ndarray, end: np.ndarray, instances: Sequence[int]) -> list[Runs]:
        """Pair the keys (M) at which runs begin and end, and split the runs by instance: those of one do not overlap."""
        bounds = np.searchsorted(begin, np.arange(MAX_INSTANCES + 1, dtype=begin.dtype) * self._places)
        length = (end - begin).astype(np.int64)
        column, first = (part.astype(np.int64) for part in _divide(_divide(begin, self._places)[1], self.span))
        past = first + length
        # `reduceat` takes no empty segments.
        filled = np.flatnonzero(bounds[1:] > bounds[:-1])
        measures = np.zeros((3, MAX_INSTANCES), np.int64)
        if filled.size:
            starts = bounds[filled]
            measures[:, filled] = np.add.reduceat(length, starts), np.minimum.reduceat(first, starts), np.maximum.reduceat(past, starts)
        rows = list(zip(bounds.tolist(), bounds[1:].tolist(), *measures.tolist(), strict=False))
        chosen = (rows[instance] for instance in instances)
        return [Runs(column[start:stop], first[start:stop], past[start:stop], *measured) for start, stop, *measured in chosen]


def unpack_run_boundaries(packed: np.ndarray, height: int) -> RunBoundaries:
    """Unpack run boundaries that the device has listed.

    Args:
        packed: (3, N): column · (height + 1) + row, value above, value below; see `FrameBatch.boundaries`.
        height: Height of the image [px].
    """
    return RunBoundaries(packed[0], height + 1, packed[1], packed[2])


def find_run_boundaries(image: np.ndarray, top: int = 0, left: int = 0) -> RunBoundaries:
    """Find the run boundaries of an image that is 0 outside of a crop.

    Args:
        image: The crop (h, w).
        top: Row of its first pixel in the image.
        left: Column of its first pixel in the image.
    """
    rows, columns = image.shape
    span = top + rows + 1
    if not image.size:
        return RunBoundaries(np.zeros(0, np.uint64), span, np.zeros(0, image.dtype), np.zeros(0, image.dtype))
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
    return RunBoundaries(((left + column) * span + top + row).astype(np.uint64), span, above, below)


def _divide(number: np.ndarray, divisor: int) -> tuple[np.ndarray, np.ndarray]:
    """Quotient and remainder: `np.divmod`, which does not use SIMD instructions and takes ten times as long (NumPy 2.4)."""
    quotient = number // divisor
    return quotient, number - quotient * divisor
