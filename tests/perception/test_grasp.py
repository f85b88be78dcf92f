"""Where the cup meets the target: inverse kinematics, grasp points and normals of surfaces that can be worked out by hand."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp
from hypothesis import assume, given
from hypothesis import strategies as st

from synpick_warp.arrays import allocate
from synpick_warp.codes import Mode
from synpick_warp.scenes.types import Catalog
from synpick_warp.stages.buffers import ViewBuffers
from synpick_warp.stages.perception.arrays import LookArrays, Plan, Sighting
from synpick_warp.stages.perception.plan import Planner
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import build_render_scene
from synpick_warp.stages.sim.worlds import AttemptState
from tests.harness.grasp_probe import frame_kernel
from tests.twins import planning
from tests.worlds.kernel_worlds import KernelWorlds, filled
from tests.worlds.toy_scene import ToyScene, ball, box, camera, entry, flat_shaded, sheet, snapshot

QUARTER = np.pi / 2
VIEW = camera(160, 120, 400.0, (0.02, -0.03, 2.0))


# ---- inverse kinematics ----


def framed(device, normals, limit: float = QUARTER) -> tuple[np.ndarray, np.ndarray]:
    """Yaw and tilt, and limited normal, for normals of any length."""
    count = len(normals)
    outputs = [wp.zeros(count, dtype=dtype, device=device) for dtype in (wp.vec2, wp.vec3)]
    inputs = [wp.array(np.asarray(normals, np.float32), dtype=wp.vec3, device=device), limit]
    wp.launch(frame_kernel, dim=count, inputs=inputs, outputs=outputs, device=device)
    return tuple(array.numpy() for array in outputs)


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
    angles, _ = framed(device, [normal])
    np.testing.assert_allclose(angles[0], (yaw, tilt), atol=1e-6)


directions = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0, 1)).filter(lambda v: np.linalg.norm(v) > 1e-2)


@given(direction=directions)
def test_angles_lead_back_to_the_normal(direction, device):
    (yaw, tilt), limited = (array[0] for array in framed(device, [direction]))
    normal = np.array(direction) / np.linalg.norm(direction)
    assert -QUARTER < yaw <= np.float32(QUARTER)
    assert abs(tilt) <= QUARTER + 1e-6
    np.testing.assert_allclose(limited, normal, atol=2e-6)
    np.testing.assert_allclose([np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)], normal, atol=2e-6)
    # The tilt axis is perpendicular to the normal.
    assert abs(np.array([-np.sin(yaw), np.cos(yaw), 0.0]) @ normal) < 2e-6
    if abs(tilt) > 1e-2 and abs(abs(yaw) - QUARTER) > 1e-2:
        np.testing.assert_allclose((yaw, tilt), planning.angles_of(normal), atol=2e-3)


@given(direction=st.tuples(*[st.floats(-1, 1)] * 3), limit=st.floats(5, 90))
def test_normals_that_lean_too_far_are_turned_up(direction, limit, device):
    length, across = np.linalg.norm(direction), np.linalg.norm(direction[:2])
    assume(length > 1e-2 and across > 1e-3)
    limit = np.radians(limit)
    (yaw, tilt), limited = (array[0] for array in framed(device, [direction], limit))
    assert abs(tilt) <= limit + 1e-5
    lean = min(np.arctan2(across, direction[2]), limit)
    expected = [*(np.sin(lean) / across * np.array(direction[:2])), np.cos(lean)]
    np.testing.assert_allclose(limited, expected, atol=1e-4)
    assert -QUARTER < yaw <= np.float32(QUARTER)


def test_no_normal_and_one_that_points_down_are_vertical(device):
    _, limited = framed(device, [(0, 0, 0), (0, 0, -3)])
    np.testing.assert_array_equal(limited, [[0, 0, 1]] * 2)


# ---- surfaces ----


class Grasps:
    """Worlds seen by one camera; instance 0 of each is the target."""

    def __init__(self, device, toy: ToyScene, window: int = 10, tilt_limit: float = QUARTER) -> None:
        views, instances = len(toy.placed), toy.room
        scene = build_render_scene(toy.settings(), Catalog(tuple(toy.entries)), toy.fixtures, toy.cameras, toy.lights, device)
        renderer = Renderer(toy.settings(), scene, instances, views)
        sizes = {
            "view": views,
            "world": views,
            "row": scene.height,
            "column": scene.width,
            "instance": instances,
            "count": 3,
            "box": 2,
            "side": 4,
            "point": planning.ROOM,
        }
        self.look, self.sighting = allocate(LookArrays, sizes, device), allocate(Sighting, sizes, device)
        self.grasp = allocate(Plan, sizes, device)
        self.look.world.assign(np.arange(views))
        renderer.prepare_bodies(snapshot(toy, device), self.look.world, self.look.camera, views)
        renderer.find_hits(self.look.camera, views, allocate(ViewBuffers, sizes, device))
        self.ids, self.depth = renderer.hits.code.numpy().astype(int) - 1, renderer.hits.depth.numpy()
        self.found = planning.look_at(self.ids, self.depth, instances)
        self.look.component.assign(self.found["component"])
        self.look.largest.assign(self.found["largest"])
        self.suction = self.found["suction"]
        many = np.ones(len(toy.entries))
        self.worlds = KernelWorlds(
            device, views, volume=many, compound=many * 0, radius=many, instances=instances, single_slots=instances, compound_slots=0
        )
        filled(self.worlds.scene.sight, {**planning.SIGHT, "normal_window": window})
        self.worlds.scene.pick.tilt_limit = tilt_limit
        self.scene = self.worlds.scene
        self.seen: Any = SimpleNamespace(
            scene=scene, look=self.look, hits=renderer.hits, bodies=renderer.bodies, cameras=scene.cameras, grid=scene.grid
        )
        self.planner = Planner(toy.settings(), self.seen, device)

    def frame(self) -> Plan:
        self.sighting.suction.assign(self.suction)
        self.planner.smooth_normal(self.scene, self.seen, self.sighting, self.grasp)
        self.planner.frame_grasp(self.scene, self.seen, self.sighting, self.grasp)
        return self.grasp


def turn(axis: tuple[float, float, float], angle: float) -> tuple[float, ...]:
    return (*(np.sin(angle / 2) * np.array(axis)), np.cos(angle / 2))


def rotated(quaternion: tuple[float, ...], vector: tuple[float, ...]) -> np.ndarray:
    cross = 2 * np.cross(quaternion[:3], vector)
    return vector + quaternion[3] * cross + np.cross(quaternion[:3], cross)


def test_the_normal_and_the_point_of_tilted_planes(device):
    """Sheets in five poses: everywhere on each the normal is its z axis, and the grasp point lies on it."""
    poses = [(0.02 * i, 0.01 * i, 0.1 * i, *turn((np.cos(i), np.sin(i), 0.0), 0.25 * i)) for i in range(5)]
    made = Grasps(device, ToyScene([entry(sheet(0.2, 0.2))], [[(0, pose)] for pose in poses], (VIEW,)))
    plan = made.frame()
    for i, pose in enumerate(poses):
        normal = rotated(pose[3:], (0.0, 0.0, 1.0))
        # A sum of 441 normals in float32.
        np.testing.assert_allclose(plan.normal.numpy()[i], normal, atol=5e-6)
        assert abs((plan.point.numpy()[i] - pose[:3]) @ normal) < 5e-6
        # The point projects to the centre of the suction pixel.
        x, y, z = plan.point.numpy()[i] - (0.02, -0.03, 2.0)
        np.testing.assert_allclose((80 - 400 * x / z, 60 + 400 * y / z), made.suction[i, 0] + 0.5, atol=1e-3)
        yaw, tilt = plan.yaw.numpy()[i], plan.tilt.numpy()[i]
        np.testing.assert_allclose([np.sin(tilt) * np.cos(yaw), np.sin(tilt) * np.sin(yaw), np.cos(tilt)], normal, atol=5e-6)


def test_normals_of_a_ball_are_interpolated_and_point_outward(device):
    center = np.array((0.0, 0.05, 0.2))
    made = Grasps(device, ToyScene([entry(ball(0.1, 4))], [[(0, (*center, *turn((1, 0, 0), 1.0)))]], (VIEW,)), window=0)
    made.suction[0, 0] += (6, -5)
    plan = made.frame()
    outward = plan.point.numpy()[0] - center
    np.testing.assert_allclose(plan.normal.numpy()[0], outward / np.linalg.norm(outward), atol=2e-3)
    # Flat triangles of this ball lie up to 2 degrees off; interpolated normals do not.
    assert outward[2] > 0.09


def roof() -> ToyScene:
    """Two planes that fall off to both sides of the ridge x = 0 by 45 degrees; a camera right above it."""
    corners = np.array([(0, -1, 0), (0, 1, 0), (-1, -1, -1), (-1, 1, -1), (1, -1, -1), (1, 1, -1)]) * 0.1
    mesh = flat_shaded(corners, np.array([(0, 1, 2), (1, 3, 2), (0, 4, 1), (1, 4, 5)]))
    return ToyScene([entry(mesh)], [[(0, (0, 0, 0, 0, 0, 0, 1))]], (camera(160, 120, 400.0, (0.0, 0.0, 2.0)),))


def test_the_window_averages_over_a_ridge(device):
    """Columns 80 and up show the right side. A window of 21 columns about column 83 has 8 on the left and 13 on the right."""
    made = Grasps(device, roof())
    for column, left, right in ((83, 7, 14), (79, 11, 10), (95, 0, 21)):
        made.suction[0, 0] = (column, 60)
        expected = np.array([right - left, 0.0, right + left])
        np.testing.assert_allclose(made.frame().normal.numpy()[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_only_the_targets_largest_component_counts(device):
    """A post covers the right side of the roof, and another one cuts it: neither the post nor the piece behind it has a say."""
    toy = roof()
    toy.entries.append(entry(box(0.015, 0.3, 0.1)))
    toy.placed[0].append((1, (0.0125, 0.0, 0.05, 0, 0, 0, 1)))
    made = Grasps(device, toy, window=12)
    made.suction[0, 0] = (78, 60)
    shown = made.ids[0, 60, 66:91]
    pieces = made.found["component"][0, 60, 66:91][shown == 0]
    assert (shown == 1).any()
    assert len(np.unique(pieces)) == 2
    kept = (pieces == made.found["largest"][0, 0]).sum()
    right = (np.flatnonzero((shown == 0) & (made.found["component"][0, 60, 66:91] == made.found["largest"][0, 0])) + 66 >= 80).sum()
    expected = np.array([2 * right - kept, 0.0, kept])
    np.testing.assert_allclose(made.frame().normal.numpy()[0], expected / np.linalg.norm(expected), atol=1e-5)


def test_a_window_that_leaves_the_image(device):
    made = Grasps(device, ToyScene([entry(sheet(2.0, 2.0))], [[(0, (0, 0, 0, *turn((0, 1, 0), 0.3)))]], (VIEW,)), window=200)
    made.suction[0, 0] = (159, 0)
    np.testing.assert_allclose(made.frame().normal.numpy()[0], (np.sin(0.3), 0.0, np.cos(0.3)), atol=1e-4)


def test_the_tilt_limit(device):
    toy = ToyScene([entry(sheet(0.2, 0.2))], [[(0, (0, 0, 0, *turn((0, 1, 0), 1.0)))]], (VIEW,))
    plan = Grasps(device, toy, tilt_limit=np.radians(30)).frame()
    np.testing.assert_allclose(plan.normal.numpy()[0], (0.5, 0.0, np.sqrt(0.75)), atol=1e-6)
    assert plan.tilt.numpy()[0] == pytest.approx(np.radians(30), abs=1e-6)


def test_worlds_without_a_target_and_unused_views_keep_their_plan(device):
    pose = (0, 0, 0, *turn((0, 1, 0), 0.3))
    made = Grasps(device, ToyScene([entry(sheet(0.2, 0.2))], [[(0, pose)]] * 3, (VIEW,)))
    made.grasp.target.assign(np.array([-1, 0, 0]))
    made.look.world.assign(np.array([0, 1, -1]))
    for array in (made.grasp.normal, made.grasp.point, made.grasp.yaw, made.grasp.tilt):
        array.fill_(5.0)
    plan = made.frame()
    for array in (plan.normal, plan.point, plan.yaw, plan.tilt):
        assert (array.numpy()[[0, 2]] == 5.0).all()
        assert (array.numpy()[1] != 5.0).all()


def test_all_of_planning_in_one_go(device):
    """A box over the edge of a larger one; a second world has them the other way round, a third is empty, and a view is unused."""
    lower, upper = (0.0, 0.0, 0.0, 0, 0, 0, 1), (0.08, 0.0, 0.05, *turn((0, 1, 0), 0.1))
    wide, small = 0, 1
    placed = [[(wide, lower), (small, upper)], [(small, upper), (wide, lower)], [], [(wide, lower)]]
    made = Grasps(device, ToyScene([entry(box(0.2, 0.15, 0.04)), entry(box(0.12, 0.08, 0.04))], placed, (VIEW,)))
    made.look.world.assign(np.array([0, 1, 2, -1]))
    worlds, attempts = made.worlds, allocate(AttemptState, {"world": 4, "instance": 4}, device)
    worlds.set(worlds.state.entry, [[0, 1, -1, -1], [1, 0, -1, -1], [-1] * 4, [0, -1, -1, -1]])
    for name in ("contour", "contour_length"):
        getattr(made.look, name).assign(made.found[name])
    for name in ("visible", "share", "suction", "depth"):
        getattr(made.sighting, name).assign(made.found[name])
    made.grasp.target.fill_(7)
    worlds.state.mode.assign(np.array([Mode.PICK, Mode.TARGET, Mode.PICK, Mode.PICK]))
    made.planner.plan(made.scene, made.seen, worlds.state, attempts, made.sighting, made.grasp, 0)
    assert made.sighting.above.numpy().tolist() == [[0b10, 0, 0, 0], [0, 0b01, 0, 0], [0] * 4, [0] * 4]
    assert made.grasp.target.numpy().tolist() == [1, 1, -1, 7]
    np.testing.assert_allclose(made.grasp.normal.numpy()[:2], [(np.sin(0.1), 0, np.cos(0.1)), (0, 0, 1)], atol=1e-5)
    np.testing.assert_allclose(made.grasp.point.numpy()[1, 2], 0.02, atol=1e-6)
    assert made.grasp.tilt.numpy()[:2].tolist() == pytest.approx([0.1, 0.0], abs=1e-5)
