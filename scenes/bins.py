"""Bins that stand under the cameras: visual mesh with material and empty interior, collision shapes, guide walls."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from synpick_warp.configs.cell import BinSizes
from synpick_warp.scenes.tote import box_piece, tote_colliders, tote_fixture
from synpick_warp.scenes.types import ConvexPiece, Fixture

GUIDE_THICKNESS = 0.1
"""Thickness of the guide walls [m]."""


@dataclass(frozen=True, eq=False)
class Bin:
    """A bin in its own frame: origin at the centre of the inner floor, z up."""

    sizes: BinSizes
    fixture: Fixture
    """Visual mesh, material and empty interior."""
    pieces: tuple[ConvexPiece, ...]
    """Collision shapes."""


def make_bins(sizes: Iterable[BinSizes]) -> tuple[Bin, ...]:
    """Build bins.

    Raises:
        ConfigError: The sizes of a bin do not fit each other.
    """
    return tuple(Bin(one, tote_fixture(one.shell), tote_colliders(one.shell)) for one in sizes)


def guide_walls(sizes: BinSizes, height: float) -> tuple[ConvexPiece, ...]:
    """Build four temporary walls on the rim, flush with the opening, that keep falling objects over the bin; height [m]."""
    low = sizes.height
    x, y = sizes.opening[0] / 2, sizes.opening[1] / 2
    far_x, far_y, high = x + GUIDE_THICKNESS, y + GUIDE_THICKNESS, low + height
    return (
        box_piece((x, -far_y, low), (far_x, far_y, high)),
        box_piece((-far_x, -far_y, low), (-x, far_y, high)),
        box_piece((-far_x, y, low), (far_x, far_y, high)),
        box_piece((-far_x, -far_y, low), (far_x, -y, high)),
    )
