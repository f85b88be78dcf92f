"""Choice of the target instance, and of grasp points on it where the surface is flat. Grasp poses: inverse kinematics of the gripper, grasp
points and normals of surfaces with known answers."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.codes import MAX_INSTANCES, Mode, Outcome, Phase, Stream
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.perception import grasp
from synpick_warp.stages.arrays import allocate, count_words
from synpick_warp.stages.buffers import ViewBuffers, view_buffer_sizes
from synpick_warp.stages.perception.images import Observation, PerceptionArrays, Plan
from synpick_warp.stages.perception.perceive import GraspPlanner
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim.worlds import AttemptState
from tests.harness.probe import probe
from tests.twins import planning, rng
from tests.twins.planning import PlannerHarness, paint_shapes
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import KernelWorlds, cup_places, filled
from tests.worlds.shapes import ball, box, camera, entry, flat_shaded, sheet
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot

SEED = 9


def harness_of(device, visible, fraction, ancestors) -> PlannerHarness:
    """One world and one view a row."""
    visible = np.atleast_2d(visible)
    harness = PlannerHarness.unseen(device, *visible.shape)
    harness.observation.visible.assign(visible)
    harness.observation.visible_fraction.assign(np.atleast_2d(fraction))
    harness.observation.ancestors.assign(np.reshape(ancestors, harness.observation.ancestors.shape).astype(np.uint32))
    harness.worlds.begin(Phase.ACT)
    harness.attempts.attempt.fill_(-1)
    return harness


def choose(harness: PlannerHarness, mode: int) -> list[int]:
    harness.worlds.state.mode.fill_(mode)
    return harness.choose(SEED)


@pytest.mark.parametrize(
    ("failures", "picked", "targeted"),
    [
        ([0, 0, 0, 0], 0, 2),
        ([1, 0, 0, 0], 1, 2),
        ([1, 2, 0, 0], 0, 2),
        ([4, 2, 0, 0], 2, 2),
        ([0, 0, 1, 0], 0, 3),
        ([1025, 9, 1025, 3], 3, 3),
    ],
)
def test_a_failure_weighs_as_an_object_above_or_more_than_all_since_the_last_success(device, failures, picked, targeted):
    harness = harness_of(device, [1, 1, 1, 1], [0.1, 0.9, 0.5, 0.5], [0b0000, 0b0001, 0b1001, 0b0011])
    harness.attempts.target_failures.assign(np.array([failures]))
    assert (choose(harness, Mode.PICK), choose(harness, Mode.TARGET)) == ([picked], [targeted])


def test_ancestors_of_all_words_count(device):
    """Instance i has i ancestors, the last ones."""
    there = np.arange(MAX_INSTANCES)[None, :] >= MAX_INSTANCES - np.arange(MAX_INSTANCES)[:, None]
    octets = np.packbits(np.pad(there, ((0, 0), (0, 32 * count_words(MAX_INSTANCES) - MAX_INSTANCES))), axis=1, bitorder="little")
    harness = harness_of(device, [1] * MAX_INSTANCES, [0.5] * MAX_INSTANCES, octets.view(np.uint32))
    assert choose(harness, Mode.PICK) == [0]
    assert choose(harness, Mode.TARGET) == [MAX_INSTANCES - 1]


@given(rows=st.lists(st.tuples(st.integers(0, 1), st.sampled_from([0.2, 0.4, 0.9]), st.integers(0, 15)), min_size=1, max_size=6))
def test_targets_equal_the_reference(rows, device):
    visible, fraction, above = (np.array(column) for column in zip(*rows, strict=True))
    harness = harness_of(device, visible, fraction, above)
    counts = [int(bits).bit_count() for bits in above]
    assert choose(harness, Mode.PICK) == [planning.choose_target(visible, fraction, counts, False)]
    assert choose(harness, Mode.TARGET) == [planning.choose_target(visible, fraction, counts, True)]


# ---- random choice after a failure ----


def failed(device, worlds: int, outcome: Outcome, switch: int) -> PlannerHarness:
    harness = harness_of(device, [[1, 1, 0, 1, 1]] * worlds, [[0.5] * 5] * worlds, [[0, 1, 3, 0, 0]] * worlds)
    harness.worlds.scene.pick.random_after_failure = switch
    harness.attempts.outcome.fill_(int(outcome))
    harness.attempts.attempt.assign(np.arange(worlds) % 3)
    return harness


@pytest.mark.parametrize("outcome", list(Outcome))
@pytest.mark.parametrize("switch", [0, 1])
@pytest.mark.parametrize("mode", [Mode.PICK, Mode.TARGET])
def test_random_choice_only_after_failures_in_target_mode_if_enabled(device, outcome, switch, mode):
    harness = failed(device, 40, outcome, switch)
    fails = outcome not in (Outcome.NONE, Outcome.TARGET_PICKED, Outcome.OTHER_PICKED)
    found = choose(harness, mode)
    is_random = bool(switch) and fails and mode == Mode.TARGET
    assert (len(set(found)) > 1) == is_random
    if not is_random:
        assert set(found) == {0 if mode == Mode.PICK else 1}


def test_random_choices_use_their_stream_and_are_uniform(device):
    worlds = 400
    harness = failed(device, worlds, Outcome.DROPPED, 1)
    arrangement = np.arange(worlds) % 2
    harness.worlds.begin(Phase.ACT, arrangement=arrangement)
    key = rng.stream_key(SEED, np.arange(worlds), arrangement, Stream.TARGETS)
    index = rng.uniform_index(key, np.arange(worlds) % 3 + 1, 4)
    found = np.array(choose(harness, Mode.TARGET))
    np.testing.assert_array_equal(found, np.array([0, 1, 3, 4])[index])
    assert (np.bincount(found, minlength=5)[[0, 1, 3, 4]] > worlds / 6).all()


def test_no_visible_instance_to_sample_from(device):
    harness = failed(device, 1, Outcome.NOTHING_CAUGHT, 1)
    harness.observation.visible.zero_()
    assert choose(harness, Mode.TARGET) == [-1]


def test_an_unused_view_keeps_the_target(device):
    harness = harness_of(device, [[1, 1]] * 2, [[0.5, 0.6]] * 2, [[0, 0]] * 2)
    harness.grasp.target.fill_(7)
    harness.images.views.world.assign(np.array([1, -1]))
    assert choose(harness, Mode.PICK) == [7, 1]


# ---- flat points, on synthetic images of angles and slopes ----


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
    filled(harness.scene.suction, {"radius": RADIUS})
    harness.scene.cups.count, harness.scene.cups.place = len(cups), cup_places(cups, device)
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


# ---- grasps ----

QUARTER = np.pi / 2
VIEW = camera(160, 120, 400.0, (0.02, -0.03, 2.0))


# ---- inverse kinematics ----


@wp.func
def limit_and_solve(normal: wp.vec3, limit: float):
    """Yaw and tilt [rad] for a normal of any length, and the limited normal."""
    limited = grasp.limit_normal(normal, limit)
    return grasp.gripper_angles(limited), limited


solve = probe(limit_and_solve)


@pytest.mark.parametrize(
    ("normal", "yaw", "tilt"),
    [
        ((0, 0, 1), 0, 0),
        ((1e-9, -1e-8, 1), 0, 0),
        ((0, 1, 1), QUARTER, np.pi / 4),
        ((0, -1, 1), QUARTER, -np.pi / 4),
    ],
)
def test_angles_of_known_normals(device, normal, yaw, tilt):
    angles, _ = solve(normal, QUARTER, device=device)
    np.testing.assert_allclose(angles, (yaw, tilt), atol=1e-6)


directions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1)).filter(lambda v: np.linalg.norm(v) > 1e-2)


@given(direction=directions)
def test_forward_kinematics_returns_the_normal(direction, device):
    (yaw, tilt), limited = solve(direction, QUARTER, device=device)
    normal = np.array(direction) / np.linalg.norm(direction)
    assert -QUARTER < yaw <= np.float32(QUARTER)
    assert abs(tilt) <= QUARTER + 1e-6
    np.testing.assert_allclose(limited, normal, atol=2e-6)
    np.testing.assert_allclose([np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)], normal, atol=2e-6)
    # The wrist axis is perpendicular to the normal.
    assert abs(np.array([-np.sin(yaw), np.cos(yaw), 0.0]) @ normal) < 2e-6
    if abs(tilt) > 1e-2 and abs(abs(yaw) - QUARTER) > 1e-2:
        np.testing.assert_allclose((yaw, tilt), planning.gripper_angles(normal), atol=2e-3)


@given(direction=st.tuples(*[st.floats(-1, 1)] * 3), limit=st.floats(5, 90))
def test_normals_are_limited_to_the_tilt_limit(direction, limit, device):
    length, across = np.linalg.norm(direction), np.linalg.norm(direction[:2])
    assume(length > 1e-2 and across > 1e-3)
    limit = np.radians(limit)
    (yaw, tilt), limited = solve(direction, limit, device=device)
    assert abs(tilt) <= limit + 1e-5
    lean = min(np.arctan2(across, direction[2]), limit)
    expected = [*(np.sin(lean) / across * np.array(direction[:2])), np.cos(lean)]
    np.testing.assert_allclose(limited, expected, atol=1e-4)
    assert -QUARTER < yaw <= np.float32(QUARTER)


def test_zero_and_downward_normals_become_vertical(device):
    _, limited = solve([(0, 0, 0), (0, 0, -3)], QUARTER, device=device)
    np.testing.assert_array_equal(limited, [[0, 0, 1]] * 2)


# ---- surfaces ----


class GraspHarness:
    """Worlds rendered by one camera; instance 0 of each is the target."""

    def __init__(self, device, toy: ToyScene, window: int = 10, tilt_limit: float = QUARTER, cups=((0.0, 0.0),)) -> None:
        views, instances = len(toy.placed), toy.instances
        scene = build_scene(toy, device)
        renderer = make_renderer(toy.settings(), scene, instances, views)
        sizes = view_buffer_sizes(views, scene.width, scene.height, instances) | {"world": views, "word": 1, "point": planning.CAPACITY}
        self.arrays, self.observation = allocate(PerceptionArrays, sizes, device), allocate(Observation, sizes, device)
        self.grasp = allocate(Plan, sizes, device)
        world, camera_index = (wp.array(values, dtype=wp.int32, device=device) for values in (range(views), [0] * views))
        batch = make_views(world, camera_index, views, instances)
        renderer.render_gbuffer(snapshot(toy, device), batch, allocate(ViewBuffers, sizes, device))
        self.ids, self.depth = renderer.gbuffer.segment.numpy().astype(int) - 1, renderer.gbuffer.depth.numpy()
        self.expected = planning.segment(self.ids, self.depth, instances)
        self.arrays.component.assign(self.expected["component"])
        self.arrays.largest.assign(self.expected["largest"])
        self.grasp_pixel = self.expected["grasp_pixel"]
        self.worlds = KernelWorlds(device, views, len(toy.entries), instances, cups=cups)
        filled(self.worlds.scene.perception, {**planning.SETTINGS, "normal_window": window})
        self.worlds.scene.pick.tilt_limit = tilt_limit
        self.scene = self.worlds.scene
        self.images: Any = SimpleNamespace(scene=scene, views=batch, bodies=renderer.bodies, gbuffer=renderer.gbuffer)
        self.planner = GraspPlanner(toy.settings().perception, self.images, self.arrays)

    def plan_grasps(self) -> Plan:
        self.observation.grasp_pixel.assign(self.grasp_pixel)
        self.planner.smooth_normal(self.scene, self.observation, self.grasp)
        self.planner.frame_grasp(self.scene, self.observation, self.grasp)
        self.planner.align_cups(self.scene, self.grasp)
        return self.grasp


def axis_angle(axis: tuple[float, float, float], angle: float) -> tuple[float, ...]:
    return (*(np.sin(angle / 2) * np.array(axis)), np.cos(angle / 2))


def test_the_normal_and_the_point_of_tilted_planes(device):
    """Sheets in five poses: the normal is the sheet's z axis, and the grasp point lies on the sheet."""
    poses = [(0.02 * i, 0.01 * i, 0.1 * i, *axis_angle((np.cos(i), np.sin(i), 0.0), 0.25 * i)) for i in range(5)]
    harness = GraspHarness(device, ToyScene([entry(sheet(0.2, 0.2))], [[(0, pose)] for pose in poses], (VIEW,)))
    plan = harness.plan_grasps()
    for i, pose in enumerate(poses):
        normal = rotation_of(pose[3:])[:, 2]
        # A sum of 441 normals in float32.
        np.testing.assert_allclose(plan.normal.numpy()[i], normal, atol=5e-6)
        assert abs((plan.point.numpy()[i] - pose[:3]) @ normal) < 5e-6
        # The point projects to the centre of the grasp pixel.
        x, y, z = plan.point.numpy()[i] - (0.02, -0.03, 2.0)
        np.testing.assert_allclose((80 - 400 * x / z, 60 + 400 * y / z), harness.grasp_pixel[i, 0] + 0.5, atol=1e-3)
        yaw, tilt = plan.yaw.numpy()[i], plan.tilt.numpy()[i]
        np.testing.assert_allclose([np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)], normal, atol=5e-6)


def test_normals_of_a_ball_are_interpolated_and_point_outward(device):
    center = np.array((0.0, 0.05, 0.2))
    harness = GraspHarness(device, ToyScene([entry(ball(0.1, 4))], [[(0, (*center, *axis_angle((1, 0, 0), 1.0)))]], (VIEW,)), window=0)
    harness.grasp_pixel[0, 0] += (6, -5)
    plan = harness.plan_grasps()
    outward = plan.point.numpy()[0] - center
    np.testing.assert_allclose(plan.normal.numpy()[0], outward / np.linalg.norm(outward), atol=2e-3)
    # Face normals of this ball deviate by up to 2 degrees; interpolated normals do not.
    assert outward[2] > 0.09


def roof() -> ToyScene:
    """Two planes that slope down by 45 degrees on both sides of the ridge x = 0, under a camera."""
    corners = np.array([(0, -1, 0), (0, 1, 0), (-1, -1, -1), (-1, 1, -1), (1, -1, -1), (1, 1, -1)]) * 0.1
    mesh = flat_shaded(corners, np.array([(0, 1, 2), (1, 3, 2), (0, 4, 1), (1, 4, 5)]))
    return ToyScene([entry(mesh)], [[(0, (0, 0, 0, 0, 0, 0, 1))]], (camera(160, 120, 400.0, (0.0, 0.0, 2.0)),))


def test_the_window_averages_over_a_ridge(device):
    """Columns from 80 on show the right side; the window has 21 columns."""
    harness = GraspHarness(device, roof())
    for column, left, right in ((83, 7, 14), (79, 11, 10), (95, 0, 21)):
        harness.grasp_pixel[0, 0] = (column, 60)
        expected = np.array([right - left, 0.0, right + left])
        np.testing.assert_allclose(harness.plan_grasps().normal.numpy()[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_the_window_uses_only_the_targets_largest_component(device):
    """A post splits the right side of the roof: neither the post nor the component behind it contributes."""
    toy = roof()
    toy.entries.append(entry(box(0.015, 0.3, 0.1)))
    toy.placed[0].append((1, (0.0125, 0.0, 0.05, 0, 0, 0, 1)))
    harness = GraspHarness(device, toy, window=12)
    harness.grasp_pixel[0, 0] = (78, 60)
    shown = harness.ids[0, 60, 66:91]
    pieces = harness.expected["component"][0, 60, 66:91][shown == 0]
    assert (shown == 1).any()
    assert len(np.unique(pieces)) == 2
    kept = (pieces == harness.expected["largest"][0, 0]).sum()
    largest = harness.expected["component"][0, 60, 66:91] == harness.expected["largest"][0, 0]
    right = (np.flatnonzero((shown == 0) & largest) + 66 >= 80).sum()
    expected = np.array([2 * right - kept, 0.0, kept])
    np.testing.assert_allclose(harness.plan_grasps().normal.numpy()[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_the_window_is_clipped_to_the_image(device):
    harness = GraspHarness(device, ToyScene([entry(sheet(2.0, 2.0))], [[(0, (0, 0, 0, *axis_angle((0, 1, 0), 0.3)))]], (VIEW,)), window=200)
    harness.grasp_pixel[0, 0] = (159, 0)
    np.testing.assert_allclose(harness.plan_grasps().normal.numpy()[0], (np.sin(0.3), 0.0, np.cos(0.3)), atol=1e-4)


def test_the_tilt_limit(device):
    toy = ToyScene([entry(sheet(0.2, 0.2))], [[(0, (0, 0, 0, *axis_angle((0, 1, 0), 1.0)))]], (VIEW,))
    plan = GraspHarness(device, toy, tilt_limit=np.radians(30)).plan_grasps()
    np.testing.assert_allclose(plan.normal.numpy()[0], (0.5, 0.0, np.sqrt(0.75)), atol=1e-6)
    assert plan.tilt.numpy()[0] == pytest.approx(np.radians(30), abs=1e-6)


def test_worlds_without_a_target_and_unused_views_keep_their_plan(device):
    pose = (0, 0, 0, *axis_angle((0, 1, 0), 0.3))
    harness = GraspHarness(device, ToyScene([entry(sheet(0.2, 0.2))], [[(0, pose)]] * 3, (VIEW,)))
    harness.grasp.target.assign(np.array([-1, 0, 0]))
    harness.images.views.world.assign(np.array([0, 1, -1]))
    for array in (harness.grasp.normal, harness.grasp.point, harness.grasp.yaw, harness.grasp.tilt):
        array.fill_(5.0)
    plan = harness.plan_grasps()
    for array in (plan.normal, plan.point, plan.yaw, plan.tilt):
        assert (array.numpy()[[0, 2]] == 5.0).all()
        assert (array.numpy()[1] != 5.0).all()


def test_two_cups_turn_along_a_narrow_sheet(device):
    """Also where it leans to its side by less than the free swing; by more, they meet the normal, and do not fit."""
    angles = ((30, 0), (-65, 0), (30, 3), (120, 12))  # Of the long axis x, then the lean about it [°].
    poses = [(0, 0, 0, *Rotation.from_euler("ZX", pair, degrees=True).as_quat()) for pair in angles]
    toy = ToyScene([entry(sheet(0.2, 0.04))], [[(0, pose)] for pose in poses], (camera(320, 240, 1600.0, (0.0, 0.0, 2.0)),))
    planned = GraspHarness(device, toy).plan_grasps()
    harness = GraspHarness(device, toy, cups=((-0.06, 0.0), (0.06, 0.0)))
    filled(harness.scene.suction, {"radius": 0.01, "swing_limit": np.radians(5)})
    plan = harness.plan_grasps()
    yaw, tilt, axis = (getattr(plan, name).numpy() for name in ("yaw", "tilt", "normal"))
    for index, expected in enumerate((30, -65, 30)):
        assert abs((np.degrees(yaw[index]) - expected + 90) % 180 - 90) < 6
    np.testing.assert_allclose(np.arccos((axis * planned.normal.numpy()).sum(axis=1).clip(-1, 1)), np.radians([0, 0, 3, 0]), atol=1e-2)
    assert (yaw[3], tilt[3]) == (planned.yaw.numpy()[3], planned.tilt.numpy()[3])
    np.testing.assert_allclose(axis.T, [np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)], atol=1e-5)


def test_the_whole_planner(device):
    """A box across the edge of a larger one; the second world has them in reverse order, the third is empty, and one view is unused."""
    lower, upper = (0.0, 0.0, 0.0, 0, 0, 0, 1), (0.08, 0.0, 0.05, *axis_angle((0, 1, 0), 0.1))
    wide, small = 0, 1
    placed = [[(wide, lower), (small, upper)], [(small, upper), (wide, lower)], [], [(wide, lower)]]
    harness = GraspHarness(device, ToyScene([entry(box(0.2, 0.15, 0.04)), entry(box(0.12, 0.08, 0.04))], placed, (VIEW,)))
    harness.images.views.world.assign(np.array([0, 1, 2, -1]))
    worlds, attempts = harness.worlds, allocate(AttemptState, {"world": 4, "instance": 4, "word": 1}, device)
    worlds.put(catalog_index=[[0, 1, -1, -1], [1, 0, -1, -1], [-1] * 4, [0, -1, -1, -1]])
    for name in ("contour", "contour_length"):
        getattr(harness.arrays, name).assign(harness.expected[name])
    for name in ("visible", "visible_fraction", "grasp_pixel", "depth"):
        getattr(harness.observation, name).assign(harness.expected[name])
    harness.grasp.target.fill_(7)
    worlds.state.mode.assign(np.array([Mode.PICK, Mode.TARGET, Mode.PICK, Mode.PICK]))
    harness.planner.plan(harness.scene, worlds.state, attempts, harness.observation, harness.grasp, 0)
    assert harness.observation.above.numpy()[..., 0].tolist() == [[0b10, 0, 0, 0], [0, 0b01, 0, 0], [0] * 4, [0] * 4]
    assert harness.grasp.target.numpy().tolist() == [1, 1, -1, 7]
    np.testing.assert_allclose(harness.grasp.normal.numpy()[:2], [(np.sin(0.1), 0, np.cos(0.1)), (0, 0, 1)], atol=1e-5)
    np.testing.assert_allclose(harness.grasp.point.numpy()[1, 2], 0.02, atol=1e-6)
    assert harness.grasp.tilt.numpy()[:2].tolist() == pytest.approx([0.1, 0.0], abs=1e-5)
