"""Procedural textures of surfaces."""

from __future__ import annotations

import numpy as np

from synpick_warp.scenes.embedded.surfaces import KINDS, SIDE, surface_textures


def test_textures_follow_from_their_index_and_differ():
    made = surface_textures(len(KINDS))
    assert all(image.shape == (SIDE, SIDE, 3) and image.dtype == np.uint8 for image in made)
    assert len({image.tobytes() for image in made}) == len(made)
    (again,) = surface_textures(1, 2)
    np.testing.assert_array_equal(again, made[2])
