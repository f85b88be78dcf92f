"""Amodal boxes against masks that the border of the image cuts: what a mask tells of each side."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from synpick_warp.apps.validation.rules.masks import wrong_sides

LEFT, TOP, RIGHT, BOTTOM = range(4)
SIZE = (100, 60)
"""Width and height of the image [px]."""


def mask(*box: int) -> Any:
    """Mask with a tight box x_min, y_min, width, height [px]."""
    return SimpleNamespace(box=box, size=SIZE)


@pytest.mark.parametrize(
    ("seen", "stated", "wrong"),
    [
        pytest.param((10, 20, 30, 15), [10, 20, 29, 14], [], id="inside"),
        pytest.param((10, 20, 30, 15), [10, 20, 30, 15], [RIGHT, BOTTOM], id="inside, with one more"),
        pytest.param((10, 20, 30, 15), [-5, 20, 44, 14], [LEFT], id="inside, beyond the border"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 23], [], id="cut at the top, wider beyond"),
        pytest.param((10, 0, 30, 15), [4, -9, 45, 24], [BOTTOM], id="cut at the top, and too low"),
        pytest.param((10, 0, 30, 15), [12, -9, 40, 23], [LEFT], id="cut at the top, and narrower than the mask"),
        pytest.param((0, 0, 30, 15), [-9, -9, 50, 50], [], id="cut at two sides"),
        pytest.param((15, 0, 23, 2), [-52, -165, 194, 176], [], id="cut at the top, and lower around the corner"),
        pytest.param((15, 0, 23, 2), [-52, -165, 80, 176], [RIGHT], id="around the corner, and narrower than the mask"),
    ],
)
def test_sides_are_wrong_where_the_mask_contradicts_them(seen, stated, wrong):
    assert wrong_sides(stated, mask(*seen)) == wrong
