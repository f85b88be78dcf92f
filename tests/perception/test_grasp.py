"""Grasp poses: inverse kinematics of the gripper, and grasp points and normals of surfaces with known answers."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Mode
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.perception import grasp
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import ViewBuffers, view_buffer_sizes
from synpick_warp.stages.perception.arrays import Observation, PerceptionArrays, Plan
from synpick_warp.stages.perception.plan import GraspPlanner
from synpick_warp.stages.render.view_setup import make_views
from synpick_warp.stages.sim.worlds import AttemptState
from tests.harness.probe import probe
from tests.twins import planning
from tests.twins.raycast import rotation_of
from tests.worlds.kernel_worlds import KernelWorlds, filled
from tests.worlds.shapes import ball, box, camera, entry, flat_shaded, sheet
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot

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
        ((1, 0, 1), 0, np.pi / 4),
        ((-1, 0, 1), 0, -np.pi / 4),
        ((0, 1, 1), QUARTER, np.pi / 4),
        ((0, -1, 1), QUARTER, -np.pi / 4),
        ((1, 1, 0), np.pi / 4, QUARTER),
        ((-1, 1, 0), -np.pi / 4, -QUARTER),
        ((-1, -1, 0), np.pi / 4, -QUARTER),
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
