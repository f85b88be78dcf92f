"""Bins: what stands under the cameras, and rules of its settings."""

from __future__ import annotations

import numpy as np
import pytest

from synpick_warp.configs.cell import bin_sizes
from synpick_warp.configs.load import load_config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.bins import guide_walls, make_bins
from tests.scenes.test_tote_gripper import test_fixtures_are_closed_and_face_outward as check_closed


def made(**settings):
    config = load_config("smoke", {f"bins.{name}": value for name, value in settings.items()})
    return make_bins(bin_sizes(config))


def test_a_pallet_is_closed_and_its_box_holds_its_boards():
    (pallet,) = made(kind="pallet", area=[0.3, 0.2], pallet_size=[0.5, 0.4, 0.1])
    check_closed(pallet.fixture)
    (box,) = pallet.pieces
    for points in (pallet.fixture.mesh.vertices, box.vertices):
        np.testing.assert_allclose([points.min(axis=0), points.max(axis=0)], [[-0.25, -0.2, -0.1], [0.25, 0.2, 0.0]], atol=1e-6)
    assert pallet.sizes.base == -0.1


def test_a_table_has_no_shapes_and_guides_around_its_area():
    (table,) = made(kind="none", area=[0.3, 0.2])
    assert (table.pieces, table.sizes.is_visible, table.sizes.base) == ((), False, 0.0)
    inner = [np.abs(wall.vertices).min(axis=0) for wall in guide_walls(table.sizes, 2.0)]
    assert sorted({round(float(value), 6) for wall in inner for value in wall} - {0.0}) == [0.1, 0.15, 0.2, 0.25]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"kind": "crate"}, 'bins.kind is "crate" .*; allowed: tote, none, pallet'),
        ({"area": [0.0, 0.3]}, "bins.area is .*; allowed: .* above 0"),
        ({"margin": -1.0}, "bins.margin is -1.0 .*; allowed: "),
        ({"kind": "pallet", "area": [0.3, 0.5]}, r"bins.area is .*; allowed: at most the pallet's length and width, \[0.6, 0.4\] \[m\]"),
    ],
)
def test_a_wrong_bin_is_refused_in_one_line(settings, message):
    with pytest.raises(ConfigError, match=message) as caught:
        made(**settings)
    assert "\n" not in str(caught.value)
