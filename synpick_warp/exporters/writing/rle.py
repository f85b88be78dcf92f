"""Run-length encoding of masks along image columns, as in COCO RLE: from run boundaries of masks and id images to runs, boxes, counts."""

import functools
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from synpick_warp.codes import MAX_INSTANCES

_ID_BITS = 8
"""Bits of an id in a packed boundary, see `FrameBatch.boundaries`."""
_SIDE_BITS = 21
"""Bits of a row or column in `Runs.key`: no codec takes images of more pixels a side."""
_CACHED_MASKS = 4096
"""Results that `cached_by_runs` keeps, at most: of two masks of each instance in some 200 views. Files at full HD take 40 MB."""
_Result = TypeVar("_Result")


@dataclass(eq=False, slots=True)
class Runs:
    """Run-length encoding of a binary mask: vertical runs of true pixels, sorted by column, then row. Two runs of a column are separated by
    at least one False pixel."""

    column: np.ndarray
    """Column of each run (N) int64."""
    first: np.ndarray
    """Row of the run's first pixel (N) int64."""
    past: np.ndarray
    """Row after the run's last pixel (N) int64."""
    key: bytes
    """The three in one, by which masks are compared."""
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
        """COCO's uncompressed RLE: lengths of alternating False and True runs in column-major order, False first (M) int64."""
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
    visible: Runs


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
        (instance, begin), (_, end) = self._list_values(self.below), self._list_values(self.above)
        bounds = np.searchsorted(instance, np.arange(max(instances, default=-1) + 2, dtype=instance.dtype))
        return _split_runs(begin, end - begin, self.span, bounds, instances)

    def _list_values(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """List the boundaries beside which a value (N) denotes an instance: instance and position, sorted by both (M)."""
        instance = values - values.dtype.type(1)  # Of unsigned integers, 0 - 1 is the largest.
        listed = np.flatnonzero(instance < MAX_INSTANCES)
        found = instance[listed]
        order = np.argsort(found, kind="stable")  # By radix: instances are bytes.
        return found[order], self.place[listed[order]]


def cached_by_runs(function: Callable[[Runs, int, int], _Result]) -> Callable[[Runs, int, int], _Result]:
    """Decorator: least-recently-used cache of a function of a mask and the image's height and width. While an object rests, its masks are
    those of an earlier frame: 9 of 10 in mode pick, 3 of 10 in mode move."""
    known: OrderedDict[tuple[bytes, int, int], _Result] = OrderedDict()

    @functools.wraps(function)
    def cached(runs: Runs, height: int, width: int) -> _Result:
        key = runs.key, height, width
        if key in known:
            known.move_to_end(key)
            return known[key]
        while len(known) >= _CACHED_MASKS:
            known.popitem(last=False)
        return known.setdefault(key, function(runs, height, width))

    return cached


def split_listed_runs(places: np.ndarray, count: np.ndarray, height: int, instances: Sequence[int]) -> list[Runs]:
    """Masks of some instances, from the run boundaries of all masks that the device has listed: positions (M) column · (height + 1) + row,
    in turn of a run's first pixel and of the pixel below its last, mask by mask, and their number for each mask (I)."""
    bounds = np.concatenate(([0], np.cumsum(count // 2)))
    return _split_runs(places[::2], places[1::2] - places[::2], height + 1, bounds, instances)


def _split_runs(begin: np.ndarray, length: np.ndarray, span: int, bounds: np.ndarray, instances: Sequence[int]) -> list[Runs]:
    """Split runs by instance, and return those of some: position of each run's first pixel (M), sorted by instance, then by position,
    pixels of each run (M), `span` positions per column, index of each instance's first run, and past the last one (N + 1)."""
    length = length.astype(np.int64)
    column, first = (part.astype(np.int64) for part in _divide(begin, span))
    past = first + length
    # `reduceat` takes no empty segments; the last one ends at the last bound.
    filled = np.flatnonzero(bounds[1:] > bounds[:-1])
    measures = np.zeros((3, bounds.size - 1), np.int64)
    if filled.size:
        starts, stop = bounds[filled], bounds[-1]
        parts = ((np.add, length), (np.minimum, first), (np.maximum, past))
        measures[:, filled] = [operation.reduceat(values[:stop], starts) for operation, values in parts]
    rows = list(zip(bounds.tolist(), bounds[1:].tolist(), *measures.tolist(), strict=False))
    keys = (column << 2 * _SIDE_BITS) + (first << _SIDE_BITS) + past
    parts = ((slice(start, stop), measured) for start, stop, *measured in map(rows.__getitem__, instances))
    return [Runs(column[part], first[part], past[part], keys[part].tobytes(), *measured) for part, measured in parts]


def find_runs(mask: np.ndarray, top: int = 0, left: int = 0) -> Runs:
    """Runs of a mask (h, w) bool or uint8 of 0 and 1, or of a crop of it that begins at a row and a column."""
    return find_run_boundaries(mask.view(np.uint8), top, left).runs_of(1)


def unpack_run_boundaries(packed: np.ndarray, height: int) -> RunBoundaries:
    """Unpack run boundaries that the device has listed (2, N): column · (height + 1) + row; value above, and that below shifted by 8 bits;
    see `FrameBatch.boundaries`."""
    return RunBoundaries(packed[0], height + 1, packed[1].astype(np.uint8), (packed[1] >> _ID_BITS).astype(np.uint8))


def find_run_boundaries(image: np.ndarray, top: int = 0, left: int = 0) -> RunBoundaries:
    """Find the run boundaries of an image that is 0 outside of a crop (h, w), which begins at row `top` and column `left`."""
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
