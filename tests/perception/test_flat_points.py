"""Grasp points where the surface is flat, on synthetic images of angles and slopes."""

from __future__ import annotations

import numpy as np

from synpick_warp.codes import Phase
from tests.twins.planning import PlannerHarness, paint_shapes
from tests.worlds.kernel_worlds import filled

RADIUS = 0.1
"""Of the circle of rays [m]: in 1 m, its lip is 15 px from the middle."""
SQUARE = np.array([(10, 10), (110, 10), (110, 80), (10, 80)])


def angle(column: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """A roof whose ridge, at this column, is its grasp point; both sides are planes: 1 / z is affine."""
    ids, _ = paint_shapes([(SQUARE, (0.0, 0.0, 1.0))])
    return ids, (1.0 / (1.0 - 0.004 * np.abs(np.arange(ids.shape[1]) - column)) + np.zeros(ids.shape)).astype(np.float32)


def chosen(device, images, failures=0, flat=True, seed=1, attempt=0, cups=((0.0, 0.0),), grasp=(60, 45)) -> np.ndarray:
    """Grasp pixels of one instance in each of the images (view, 2); the depth must be that of the pixel."""
    ids, depths = zip(*images, strict=True)
    harness = PlannerHarness(device, list(ids), list(depths), 1)
    harness.planner.flat = flat
    harness.worlds.cups = cups
    filled(harness.scene.suction, {"radius": RADIUS})
    harness.scene.cups.count, harness.scene.cups.place = len(cups), harness.worlds._places()
    harness.worlds.begin(Phase.ACT)
    harness.arrays.distance.assign(harness.expected["distance"])
    harness.observation.distances.fill_(30.0)
    harness.observation.grasp_pixel.assign(np.full((len(ids), 1, 2), grasp))
    harness.attempts.target_failures.fill_(failures)
    harness.attempts.attempt.fill_(attempt)
    harness.planner.bound_contours(harness.scene, harness.worlds.state, harness.observation)
    harness.observation.depth.assign(np.array([[depth[grasp[1], grasp[0]]] for depth in depths]))
    harness.choose_flat_points(seed)
    pixels = harness.observation.grasp_pixel.numpy()[:, 0]
    for (_, depth), (column, row), z in zip(images, pixels, harness.observation.depth.numpy()[:, 0], strict=True):
        assert z == depth[row, column]
    return pixels


def lies_flat(pixel: np.ndarray, ridge: int = 60) -> bool:
    """Whether the lip, at 1 m or farther at most 15 px wide, is off the ridge and on the mask."""
    return abs(pixel[0] - ridge) > 9 and 20 <= pixel[0] <= 99 and 20 <= pixel[1] <= 69


def test_a_flat_grasp_point_stays_and_one_on_a_ridge_moves_off_it(device):
    plane = np.full((90, 120), 1.0, np.float32)
    stays, moves = chosen(device, [(angle()[0], plane), angle()])
    assert stays.tolist() == [60, 45]
    assert lies_flat(moves)


def test_it_moves_for_the_rule_or_after_a_failure(device):
    for flat, failures, moves in ((False, 0, False), (False, 1, True), (True, 0, True), (True, 2, True)):
        (pixel,) = chosen(device, [angle()], failures, flat)
        assert (pixel.tolist() != [60, 45]) == moves
        assert lies_flat(pixel) == moves


def test_each_attempt_has_points_of_its_own_which_follow_from_seed_and_episode(device):
    """A plane: the first sample is taken."""
    plane = (angle()[0], np.full((90, 120), 1.0, np.float32))
    draws = [chosen(device, [plane], 1, attempt=attempt)[0].tolist() for attempt in range(4)]
    assert len({tuple(pixel) for pixel in draws}) == 4
    assert chosen(device, [plane, plane], 1)[0].tolist() == draws[0]
    assert chosen(device, [plane], 1, seed=2)[0].tolist() != draws[0]


def test_a_wide_tool_needs_a_wide_plane(device):
    """Two cups 0.05 m from the middle need 20 px around it. Where the mask is too narrow for one, the point stays."""
    (pixel,) = chosen(device, [angle()], cups=((-0.05, 0.0), (0.05, 0.0)))
    assert abs(pixel[0] - 60) > 12
    narrow = paint_shapes([(np.array([(50, 10), (70, 10), (70, 80), (50, 80)]), (0.0, 0.0, 1.0))])
    assert chosen(device, [narrow])[0].tolist() == [60, 45]
