"""A bake of cameras that are not the same in all views: drawn anew by each episode, behind a lens, or carried by the
gripper. Files against formulas, in float64."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import zarr
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.codes import Stream
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import ConfigError
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.system.progress import SilentProgress
from tests.builders import boxes, failing_after, once
from tests.twins import rng
from tests.worlds.cells import SIDE, bake_cell, camera_matrix, cell_config, check_same, check_valid, make_camera
from tools.checks.dataset import check

CELL = (
    make_camera(
        "drawn",
        **SIDE,
        matrix=camera_matrix(82.5, 82.38, 49.14, 35.25),
        distortion=[-0.12, 0.08, 0.0005, -0.0003, 0.0],
        jitter={
            "position": {"normal": [0.0, 0.01]},
            "rotation": {"uniform": [-1.0, 1.5]},
            "focal_length": {"choice": [-0.02, 0.03], "weights": [1, 3]},
            "center": {"normal": [0.5, 1.0]},
        },
    ),
    make_camera("still", fov=40.0),
    make_camera("hand", (0.12, 0.02, 0.4), (0.02, 0.0, -0.1), fov=70.0, fixed_to="gripper"),
)
CAMERAS, EPISODES = len(CELL), 2
GIVEN = {"bake.formats": ["bop", "usd", "zarr"], "render.layers": ["flow", "scene_flow"], "bake.episodes": EPISODES, "bake.worlds": 2}
CONFIG = cell_config(CELL, **GIVEN)


def bake(out: Path, **given: object) -> None:
    bake_cell(out, cell_config(CELL, **GIVEN | given))


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    return once(tmp_path_factory, "drawn-cameras", bake)[0]


def cut_normal(mean: float, sigma: float, first: float, second: float) -> float:
    """Box-Muller transform (1958), cut at three standard deviations."""
    value = math.sqrt(-2 * math.log(1 - first)) * math.cos(2 * math.pi * second)
    return mean + sigma * min(3.0, max(-3.0, value))


def drawn_camera(config, episode: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Matrix, rotation and translation of camera 0 in an episode, by formula."""
    with np.errstate(over="ignore"):
        key = rng.mix((rng.stream_key(config.bake.seed, episode, 0, Stream.CAMERA) ^ np.uint64(0)) + rng.GAMMA)
    pairs = rng.uniform(key, np.arange(18)).astype(float).reshape(9, 2).tolist()
    offset = np.array([cut_normal(0.0, 0.01, *pair) for pair in pairs[:3]])
    turn = np.radians([-1.0 + 2.5 * first for first, _ in pairs[3:6]])
    zoom = -0.02 if pairs[6][0] < 0.25 else 0.03
    center = [cut_normal(0.5, 1.0, *pair) for pair in pairs[7:]]
    camera = make_cameras(config.rig)[0]
    matrix = camera.matrix.copy()
    matrix[0, 0], matrix[1, 1] = 82.5 * (1 + zoom), 82.38 * (1 + zoom)
    matrix[:2, 2] += center
    angle = np.linalg.norm(turn)
    x, y, z = turn / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Rodrigues' formula.
    turned = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    rotation = turned.T @ camera.rotation
    return matrix, rotation, -rotation @ (np.array([0.0, -0.4, 1.1]) + offset)


def test_each_episode_draws_its_own_camera_and_all_formats_have_it(cell):
    seen = []
    rows = [json.loads(line) for line in (cell / "episodes.jsonl").read_text().splitlines()]
    store = zarr.open_group(cell / "trajectory.zarr", mode="r")
    for episode in range(EPISODES):
        matrix, rotation, translation = drawn_camera(CONFIG, episode)
        scene = json.loads((cell / f"train/{CAMERAS * episode:06d}/scene_camera.json").read_text())
        for entry in scene.values():
            np.testing.assert_allclose(np.reshape(entry["cam_K"], (3, 3)), matrix, rtol=0, atol=1e-12)
            # Sines of the drawn turn are rounded to twelve decimal places.
            np.testing.assert_allclose(np.reshape(entry["cam_R_w2c"], (3, 3)), rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(entry["cam_t_w2c"], 1e3 * translation, rtol=0, atol=2e-9)
        row = rows[episode]["cameras"]
        assert list(row) == ["drawn", "hand"]
        assert store[f"episodes/{episode:06d}"].attrs["cameras"] == row
        assert np.ravel(row["drawn"]["matrix"]).tolist() == entry["cam_K"]
        assert (1e3 * np.array(row["drawn"]["translation"])).tolist() == entry["cam_t_w2c"]
        stage = Usd.Stage.Open(str(cell / f"usd/{episode:06d}.usdc"))
        lens = UsdGeom.Camera(stage.GetPrimAtPath("/Episode/Cameras/drawn"))
        pose = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(lens.GetPrim())).T
        np.testing.assert_allclose(pose[:3, 3], -rotation.T @ translation, atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3], rotation.T * [1, -1, -1], atol=1e-12)
        focal = lens.GetFocalLengthAttr().Get() / lens.GetHorizontalApertureAttr().Get() * 96
        assert focal == pytest.approx(matrix[0, 0], rel=1e-6)
        seen.append(translation)
    assert np.abs(seen[0] - seen[1]).max() > 1e-3
    assert np.linalg.norm(Rotation.from_matrix(rotation @ make_cameras(CONFIG.rig)[0].rotation.T).as_rotvec()) > 1e-3


def hand_poses(cell: Path, episode: int) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotations and translations of the camera on the gripper, from the recorded poses of the shaft."""
    down = make_cameras(CONFIG.rig)[2]
    shaft = np.array(zarr.open_group(cell / "trajectory.zarr", mode="r")[f"episodes/{episode:06d}/ticks/fixture_pose"])[:, 1].astype(float)
    turned = np.stack([down.rotation @ Rotation.from_quat(pose[3:]).as_matrix().T for pose in shaft])
    center = [pose[:3] + Rotation.from_quat(pose[3:]).as_matrix() @ [0.12, 0.02, 0.4] for pose in shaft]
    return turned, -np.einsum("nij,nj->ni", turned, center)


def test_a_camera_on_the_gripper_goes_where_it_goes(cell):
    for episode in range(EPISODES):
        rotations, translations = hand_poses(cell, episode)
        assert np.ptp(translations, axis=0).max() > 0.05
        scene = json.loads((cell / f"train/{CAMERAS * episode + 2:06d}/scene_camera.json").read_text())
        stage = Usd.Stage.Open(str(cell / f"usd/{episode:06d}.usdc"))
        prim = stage.GetPrimAtPath("/Episode/Cameras/hand")
        assert len(scene) == len(rotations)
        for frame, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
            entry = scene[str(frame)]
            np.testing.assert_allclose(np.reshape(entry["cam_R_w2c"], (3, 3)), rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(entry["cam_t_w2c"], 1e3 * translation, rtol=0, atol=1e-9)
            pose = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim)).T
            np.testing.assert_allclose(pose[:3, :3], rotation.T * [1, -1, -1], atol=1e-12)
            np.testing.assert_allclose(pose[:3, 3], -rotation.T @ translation, atol=1e-12)


def test_flow_through_the_moving_camera_leads_to_the_frame_before(cell):
    """Points of what does not move, from depth and flow, are where the exported cameras of both frames see them."""
    scene, checked = synpick_warp.open(cell)[0], 0
    for frame in range(1, len(scene)):
        now, before = scene.view(frame, 2), scene.view(frame - 1, 2)
        height, width = now.depth.shape
        columns, rows = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(now.intrinsics).T
        points = rays * now.depth[..., None]
        to_before = before.world_to_camera @ np.linalg.inv(now.world_to_camera)
        then = points @ to_before[:3, :3].T + to_before[:3, 3]
        flow, scene_flow = now.layer("flow"), now.layer("scene_flow")
        # What has no instance stands still, but for the gripper, which is nearer.
        still = ~now.masks.any(axis=0) & np.isfinite(flow).all(axis=-1) & (points[..., 2] > 0) & (now.depth > 0.48)
        pixels = then @ before.intrinsics.T
        expected = pixels[..., :2] / pixels[..., 2:] - np.stack([columns, rows], -1)
        assert still.sum() > 200
        # Depth has steps of 0.1 mm, and flow of 1/64 px.
        assert np.abs(flow - expected)[still].max() < 0.05
        assert np.abs(scene_flow - (then - points))[still].max() < 5e-4
        checked += np.abs(expected[still]).max() > 2.0
    assert checked


def test_pictures_are_those_of_the_drawn_camera(cell):
    """Masks, depth and boxes by rays in float64, from the models and the exported cameras."""
    check_valid(cell)
    view = synpick_warp.open(cell)[1].view(3, 0)
    np.testing.assert_allclose(view.intrinsics, drawn_camera(CONFIG, 1)[0], rtol=0, atol=1e-12)
    found = vars(check(cell, 8))
    assert not [line for line in found.values() if not line.holds]
    assert found["mask"].total > 1000


@pytest.mark.parametrize("worlds", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_the_number_of_worlds_changes_no_byte(cell, tmp_path, worlds):
    bake(tmp_path / "set", **{"bake.worlds": worlds})
    check_same(cell, tmp_path / "set")


@pytest.mark.slow
def test_an_interrupted_bake_resumes_to_the_same_bytes(cell, tmp_path):
    """The first episode is committed when the second fails; the settings are then read back from the data set."""
    with failing_after(1):
        bake(tmp_path / "set", **{"bake.worlds": 1})
    assert len(list((tmp_path / "set/manifest").glob("0*.json"))) == 1
    with boxes():
        summary = run_bake(load_config(str(tmp_path / "set/config.toml")), tmp_path / "set", SilentProgress())
    assert (summary.resumed, len(summary.episodes)) == (1, EPISODES)
    check_same(cell, tmp_path / "set")


@pytest.mark.parametrize(
    ("index", "change"),
    [(0, {"distortion": (-0.12, 0.08, 0.0, 0.0)}), (0, {"jitter": None}), (2, {"fixed_to": "world"}), (2, {"fov": 71.0})],
)
def test_other_cameras_do_not_resume(cell, index, change):
    other = replace(CELL[index], **change)
    with pytest.raises(ConfigError, match="camera"):
        bake_cell(cell, cell_config((*CELL[:index], other, *CELL[index + 1 :]), **GIVEN))
