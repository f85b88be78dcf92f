"""A small environment of whole picks, which the tests of this room share."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from synpick_warp.environment.make import make_picking
from synpick_warp.environment.picking import PickingEnvironment
from synpick_warp.environment.settings import make_choice
from tests.worlds.small_worlds import COARSE, QUICK, QUICK_PICKS

SIZE = (64, 48)
SETTINGS = {key: value for key, value in QUICK.items() if key.split(".")[0] in ("arrangement", "settle", "move")}
SETTINGS |= COARSE | QUICK_PICKS | {"physics.guide_height": 0.4}
SETTINGS.pop("settle.tries")
"""Three objects that settle soon, and attempts of few and short ticks."""
ARGUMENTS: dict[str, Any] = {
    "task": "pick",
    "num_envs": 2,
    "obs": ("depth", "instances", "state"),
    "resolution": SIZE,
    "action": None,
    "autoreset": "next_step",
    "backend": "numpy",
    "seed": 3,
    "max_steps": 4,
    "piles": None,
    "course": "attempt",
}
"""Of `make_choice`."""


def build(device: Any, source: Path | str = "smoke", **changed: Any) -> PickingEnvironment:
    """An environment of ARGUMENTS with changes, which need not be Gymnasium's, by another preset or file."""
    choice = make_choice(**(ARGUMENTS | changed))
    return make_picking(choice, source, SETTINGS, str(device))


def centers(instances: np.ndarray) -> np.ndarray:
    """Pixel (column, row) of each image that is farthest from the border of its largest visible instance; of no instance the middle."""
    pixels = []
    for image in instances:
        numbers, counts = np.unique(image[(image > 0) & (image < 200)], return_counts=True)
        mask = image == numbers[counts.argmax()] if len(numbers) else np.ones_like(image)
        row, column = np.unravel_index(cv2.distanceTransform(mask.astype(np.uint8), cv2.DIST_L2, 5).argmax(), image.shape)
        pixels.append((column, row))
    return np.array(pixels)


def same(first: Any, second: Any) -> bool:
    """Whether two observations are equal, byte by byte."""
    return first.keys() == second.keys() and all(first[name].tobytes() == second[name].tobytes() for name in first)


@pytest.fixture(scope="package")
def shared(device):
    return build(device)


@pytest.fixture
def environment(shared):
    """As `build` makes it, at the first episodes of seed 3."""
    shared.choice = make_choice(**ARGUMENTS)
    shared.reset(seed=3)
    return shared
