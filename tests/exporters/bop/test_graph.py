"""Scene graphs: edges by forces and masks, the order, and what a bake's files say of them."""

from __future__ import annotations

import json
from types import SimpleNamespace

import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.validation.rules.graph import find_gap
from synpick_warp.exporters.bop.graph import find_occlusions, find_supports, find_unstacking_order
from synpick_warp.exporters.writing.rle import Masks, find_runs


@pytest.mark.parametrize(
    ("nodes", "edges", "order"),
    [
        (2, [(1, 0)], [[1], [0]]),
        (3, [(2, 0), (2, 1), (0, -1), (1, -1)], [[2], [0], [1]]),
        (4, [(0, 1), (1, 2), (2, 0), (3, 1)], [[3], [0, 1, 2]]),
        (3, [], [[0], [1], [2]]),
        (70, [(one, one - 1) for one in range(1, 70)], [[one] for one in range(69, -1, -1)]),
        (0, [], []),
    ],
    ids=["stack", "bridge", "cycle", "apart", "tower", "nothing"],
)
def test_nothing_is_taken_from_below(nodes, edges, order):
    assert find_unstacking_order(nodes, edges) == order


def test_support_edges_are_upward_forces_that_matter():
    """Instance 1 lies on 0 and 3, the latter without label; 2 is not there; 0 leans on 1 by a hundredth of its weight."""
    support = np.zeros((1, 4, 4), np.float32)
    support[0, 1, [0, 3]], support[0, [0, 3], 1] = [1.5, 0.5], [-1.5, -0.5]
    support[0, 0, 3] = 0.01
    static = np.array([[2.5, 0.0, 0.0, 1.0]], np.float32)
    batch = SimpleNamespace(object_id=np.array([[7, 8, -1, -2]]), tick={"support": support, "static_support": static})
    (found,) = find_supports(batch, {7: 1.0, 8: 2.0})
    assert found.nodes == 2
    np.testing.assert_allclose(found.edges, [[0, -1, 2.51], [1, 0, 1.5], [1, -1, 0.5]], rtol=1e-6)


def test_occlusions_are_common_pixels_of_the_images():
    """Of visible masks that share out the image and any amodal ones, against counts in the images; and of no objects."""
    rng = np.random.default_rng(0)
    ids = rng.integers(0, 5, (13, 17))
    amodal = [rng.random((13, 17)) < 0.4, np.zeros((13, 17), bool), np.ones((13, 17), bool), np.eye(13, 17, dtype=bool)]
    masks = [Masks(find_runs(other), find_runs(ids == 1 + index)) for index, other in enumerate(amodal)]
    pairs = [(a, b, int(((ids == 1 + a) & amodal[b]).sum())) for a in range(4) for b in range(4) if a != b and b != 1]
    assert find_occlusions(masks) == pairs
    assert find_occlusions([]) == []


def test_a_bake_tells_who_lies_on_whom(picked_set):
    """In every view: loads of what rests on the bin and on each other, and pixels that the masks confirm."""
    views, seen = list(synpick_warp.open(picked_set).views()), 0
    for view in views[:: max(1, len(views) // 12)]:
        assert sorted(index for component in view.order for index in component) == list(range(len(view)))
        hidden = (view.amodal_masks & ~view.masks).sum(axis=(1, 2))
        assert (view.occlusion.sum(axis=0) <= hidden).all()
        assert view.support.shape == (len(view), len(view) + 1)
        seen += int((view.support[:, -1] > 0.0).sum())
    assert seen > 5


def test_a_gap_is_that_of_the_nearest_sides():
    """Of two boxes: side above side, apart by a turn, and one in the other."""
    corners = np.array([[x, y, z] for x in (-10.0, 10.0) for y in (-5.0, 5.0) for z in (-2.0, 2.0)])
    box = (corners, np.concatenate((np.eye(3), -np.eye(3))))
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    for rotation, move, gap in ((np.eye(3), [1.0, 1.0, 7.0], 3.0), (turn, [18.0, 0.0, 0.0], 3.0), (np.eye(3), [1.0, 0.0, 0.0], -4.0)):
        assert find_gap(box, box, np.column_stack((100.0 * rotation, move))) == pytest.approx(gap)


def test_models_say_what_suction_needs(picked_set):
    infos = json.loads((picked_set / "models" / "models_info.json").read_text())
    box, cube = infos["1"], infos["2"]
    assert box["mass"] == pytest.approx(500.0 * 0.08 * 0.06 * 0.04)
    np.testing.assert_allclose(box["center_of_mass"], 0.0, atol=1e-3)
    assert box["inertia"][0] == pytest.approx(box["mass"] * (60.0**2 + 40.0**2) / 12.0, rel=1e-5)
    # The cup of 10 mm radius must lie within a side, whose edges it may reach.
    for info, sides in ((box, (80.0, 60.0, 40.0)), (cube, (50.0, 50.0, 50.0))):
        pairs = [(sides[0], sides[1]), (sides[1], sides[2]), (sides[0], sides[2])]
        expected, area = (2 * sum((a - cut) * (b - cut) for a, b in pairs) for cut in (20.0, 0.0))
        assert info["suctionable_area"] == pytest.approx(expected, rel=0.05)
        assert info["suctionable_fraction"] == pytest.approx(expected / area, rel=0.05)
