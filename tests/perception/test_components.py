"""Connected components of instances in the images of a look."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.codes import Segment
from synpick_warp.kernels.perception.components import STRIP
from tests.twins import perception
from tests.twins.perception import Look

WIDTH, HEIGHT = 75, 24
"""Two whole strips of a row and a piece of a third."""


@pytest.fixture(scope="module")
def look(device):
    return Look(device, WIDTH, HEIGHT, worlds=2, instances=4)


def empty() -> np.ndarray:
    return np.zeros((HEIGHT, WIDTH), np.uint8)


def drawn(seed: int, scale: float, instances: int = 4) -> np.ndarray:
    """Random codes (H, W); `scale` [px] is the size of their features: noise at 0, large patches at 8."""
    rng = np.random.default_rng(seed)
    codes = rng.choice(np.array([0, *range(1, instances + 1), Segment.TOTE], np.uint8), size=(HEIGHT, WIDTH))
    if scale > 0.0:
        rows, columns = np.mgrid[:HEIGHT, :WIDTH]
        wave = [(np.sin(columns / scale + a) * 2, np.cos(rows / scale + b) * 2) for a, b in rng.uniform(0, 6, (2, 2))]
        rows = np.clip(rows / scale + wave[0][0], 0, HEIGHT - 1).astype(int)
        codes = codes[rows, np.clip(columns / scale + wave[1][1], 0, WIDTH - 1).astype(int)]
    return codes


def test_two_components_and_the_larger_counts(look):
    codes = empty()
    codes[2:5, 3:7] = 1
    codes[10:15, 20:70] = 1
    look.see(codes)
    first, second = 2 * WIDTH + 3, 10 * WIDTH + 20
    expected = np.full((HEIGHT, WIDTH), -1)
    expected[2:5, 3:7], expected[10:15, 20:70] = first, second
    assert (look.image("component") == expected).all()
    area = look.image("area").ravel()
    assert [area[first], area[second], area.sum()] == [12, 250, 262]
    assert look.image("largest").tolist() == [second, -1, -1, -1]
    assert [look.of("visible", instance) for instance in range(2)] == [250, 0]


def test_of_equal_components_the_first_counts(look):
    codes = empty()
    codes[20, 1:4] = 3
    codes[4:7, 60] = 3
    look.see(codes)
    assert look.image("largest")[2] == 4 * WIDTH + 60


@pytest.mark.parametrize("column", [int(STRIP) - 1, 40])
@pytest.mark.parametrize("step", [1, -1])
def test_pixels_that_touch_at_a_corner_are_one_component(look, column, step):
    codes = empty()
    codes[5, column], codes[6, column + step] = 2, 2
    look.see(codes)
    assert look.image("largest")[1] == 5 * WIDTH + column
    assert look.of("visible", 1) == 2


def test_instances_that_touch_stay_apart(look):
    codes = empty()
    codes[:, :37], codes[:, 37:] = 1, 2
    look.see(codes)
    assert look.image("largest").tolist() == [0, 37, -1, -1]
    assert [look.of("visible", i) for i in range(2)] == [37 * HEIGHT, 38 * HEIGHT]


def test_fixtures_and_codes_beyond_the_room_are_no_instances(look):
    codes = empty()
    codes[:8], codes[8:16], codes[16:] = Segment.TOTE, Segment.TABLE, 5
    look.see(codes)
    assert (look.image("component") == -1).all()
    assert (look.image("area") == 0).all()
    assert (look.image("largest") == -1).all()


def test_a_spiral_is_one_component(look):
    """Its arms meet late, so that names must travel through many rows and strips."""
    codes = empty()
    top, left, bottom, right = 0, 0, HEIGHT - 1, WIDTH - 1
    while top < bottom and left < right:
        codes[top, left : right + 1], codes[top : bottom + 1, right] = 1, 1
        codes[bottom, left + 2 : right + 1], codes[top + 2 : bottom + 1, left + 2] = 1, 1
        top, left, bottom, right = top + 2, left + 2, bottom - 2, right - 2
    look.see(codes)
    assert set(np.unique(look.image("component"))) == {-1, 0}
    assert look.of("visible") == (codes == 1).sum()


def test_views_are_of_their_worlds_and_unused_ones_change_nothing(look):
    codes = empty()
    codes[3:9, 3:9] = 1
    look.see(codes, codes)
    before = look.image("component", 1)
    other = empty()
    other[12:15, 3:9] = 1
    look.see(other, np.full_like(codes, 2), worlds=[1])
    assert [look.of("visible", 0, world) for world in range(2)] == [36, 18]
    assert look.of("visible", 1, world=0) == 0
    assert (look.image("component", 1) == before).all()
    assert (look.image("largest", 1) == -1).all()
    assert (look.image("contour_length", 1) == 0).all()


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.0, 1.5, 3.0, 8.0]))
def test_same_as_opencv(seed, scale, look):
    codes = drawn(seed, scale)
    look.see(codes)
    named = perception.components(codes, 4)
    assert (look.image("component") == named).all()
    names, sizes = np.unique(named[named >= 0], return_counts=True)
    area = np.zeros(HEIGHT * WIDTH)
    area[names] = sizes
    assert (look.image("area").ravel() == area).all()
    assert look.image("largest").tolist() == [perception.largest(named, codes, i) for i in range(4)]
