"""Mode still: places of cameras on a dome, one frame of each pile at rest without gripper, the same files in any number of worlds."""

import json

import numpy as np
import pytest
import zarr
from scipy import stats
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.codes import Ending, Mode, Phase
from synpick_warp.configs.cell.cameras import Still
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.cameras import EpisodeCameras
from synpick_warp.stages.sim.simulate import Simulation
from tests.builders import COARSE, bake_boxes, mistake
from tests.worlds.cells import check_same
from tests.worlds.small_worlds import catalog, run_ticks, settings

DOME = {"still.views": 3, "still.distance": [0.5, 0.9], "still.elevation": [30, 80], "still.target_spread": 0.02, "still.roll": 20}
STILL = {"bake.mode": "still"} | DOME


def test_known_poses():
    """Due east at 30°, 2 m away: the optical axis falls by 30° to the west, and the image is upright; rolled by 90°, its right is up."""
    still = Still(distance=(1.0, 2.0), elevation=(30.0, 90.0), target=(0.1, 0.2, 0.3), roll=90.0)
    pose = still.pose((1.0, 0.0, 0.0, 0.5, 0.5, 0.5, 0.5))
    np.testing.assert_allclose(pose.position, (0.1 + 2 * np.sqrt(0.75), 0.2, 1.3), atol=1e-9)
    np.testing.assert_allclose((*pose.look_at, *pose.up), (0.1, 0.2, 0.3, -0.5, 0.0, np.sqrt(0.75)), atol=1e-9)
    np.testing.assert_allclose(still.pose((1.0, 0.0, 0.0, 1.0, 0.5, 0.5, 0.5)).up, (0.0, 1.0, 0.0), atol=1e-9)
    # From above, where the viewing direction is vertical, the azimuth is still the image's.
    pose = still.pose((0.0, 1.0, 0.25, 0.5, 1.0, 0.0, 0.5))
    np.testing.assert_allclose((*pose.position, *pose.up), (0.15, 0.15, 1.3, 0.0, -1.0, 0.0), atol=1e-9)


def test_cameras_are_uniform_on_the_dome_and_look_at_the_pile():
    config = load_config("smoke", STILL)
    drawn = EpisodeCameras(config.rig, 5)
    cameras = [camera for episode in range(1000) for camera in drawn.of_episode(episode)]
    assert len(cameras) == 3000
    center = np.array([camera.center for camera in cameras])
    forward = np.array([camera.rotation[2] for camera in cameras])
    # The target lies on the optical axis where this passes its height, which is within the spread; so is the point next to the middle.
    nearest = center + np.einsum("ni,ni->n", np.array([0.0, 0.0, 0.05]) - center, forward)[:, None] * forward
    assert (np.abs(nearest - (0.0, 0.0, 0.05)) <= np.sqrt(3.0) * 0.02).all()
    assert len(np.unique(nearest.round(9), axis=0)) == 3000
    elevation, azimuth = -forward[:, 2], np.arctan2(-forward[:, 1], -forward[:, 0])
    low, high = np.sin(np.radians([30.0, 80.0]))
    assert low <= elevation.min() < elevation.max() <= high
    assert stats.kstest((elevation - low) / (high - low), "uniform").pvalue > 1e-3
    assert stats.kstest(azimuth / (2 * np.pi) + 0.5, "uniform").pvalue > 1e-3
    distance = np.linalg.norm(center - (0.0, 0.0, 0.05), axis=1)
    assert 0.5 - 0.035 <= distance.min() < 0.51
    assert 0.89 < distance.max() <= 0.9 + 0.035
    side = np.array([-np.sin(azimuth), np.cos(azimuth), np.zeros(3000)])
    roll = np.degrees(np.arccos(np.clip(np.einsum("ni,in->n", [camera.rotation[0] for camera in cameras], side), -1, 1)))
    assert 19 < roll.max() <= 20 + 1e-6
    rotations = np.array([camera.rotation for camera in cameras])
    np.testing.assert_allclose(Rotation.from_matrix(rotations).as_matrix(), rotations, atol=1e-12)
    again = EpisodeCameras(config.rig, 5).of_episode(999)[2]
    np.testing.assert_array_equal(again.rotation, cameras[-1].rotation)
    assert (again.matrix == cameras[0].matrix).all()


def test_an_episode_is_the_tick_in_which_its_pile_rests_and_the_next_begins_at_once(device):
    simulation = Simulation(settings(**COARSE | STILL, bake__episodes=2, bake__formats=["zarr"]), catalog(), 1, device)
    for episode in range(2):
        for _ in range(80):
            (seen,) = run_ticks(simulation, 1)
            assert (seen.column("episode")[0], seen.column("mode")[0]) == (episode, Mode.STILL)
            if seen.column("live")[0]:
                break
            assert seen.column("phase")[0] == Phase.SETTLE
        assert [seen.column(name)[0] for name in ("phase", "ending", "frame")] == [Phase.OVER, Ending.FINISHED, 0]
        assert simulation.record.snapshot.fixture_visible.numpy()[0].tolist() == [1, 0, 0]


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (
            ["--set", "still.distance=[0.9,0.5]"],
            "still.distance is [0.9, 0.5] on the command line; allowed: minimum and maximum in this order",
        ),
        (["--set", "still.elevation=[80,30]"], "still.elevation is [80.0, 30.0]"),
        (["--set", "still.elevation=[-5,30]"], "still.elevation is [-5, 30]"),
        (["--set", "still.elevation=[0,30]", "--set", "still.target_spread=0.1"], "whose cameras have positions above the tote's floor"),
        (["--set", "still.views=65"], "still.views is 65"),
        (["--set", "still.target=[3,0,0]"], "still.target is [3.0, 0.0, 0.0]"),
        (["--set", "still.distance=[0.2,0.3]"], "still.distance is [0.2, 0.3] on the command line; allowed: a dome, with elevation"),
        (["--set", "arrangement.counts={mug=0}"], "allowed: numbers of at least 1"),
        (["--formats", "lerobot"], "allowed: without lerobot in mode still"),
        (["--formats", "picks"], "allowed: without picks where no episode picks"),
        (["--config", "hand.toml"], 'camera[0].fixed_to is "gripper" in hand.toml; allowed: world in mode still'),
        (["--config", "two.toml"], 'splits.b.mode is "pick" in two.toml; allowed: still in all splits or in none'),
    ],
)
def test_what_makes_no_still_is_refused(tmp_path, monkeypatch, given, words):
    monkeypatch.chdir(tmp_path)
    pose = "pose = { position = [0.0, 0.1, 0.1], look_at = [0.0, 0.0, -1.0], up = [0.0, 1.0, 0.0] }"
    (tmp_path / "hand.toml").write_text(f'[[camera]]\nfov = 40.0\nfixed_to = "gripper"\n{pose}\n')
    (tmp_path / "two.toml").write_text('[splits]\na = { episodes = 1, mode = "still" }\nb = { episodes = 1, mode = "pick" }\n')
    dome = [part for key, value in DOME.items() for part in ("--set", f"{key}={json.dumps(value)}")]
    first = () if "two.toml" in given else ("--mode", "still", *(("--config", "smoke") if "--config" not in given else ()))
    assert words in mistake("bake", *first, *dome, "--out", tmp_path / "set", *given)


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Three piles of boxes, in one world and in three."""
    given = (
        COARSE | STILL | {"bake.episodes": 3, "bake.formats": ["bop", "shards", "zarr"], "cameras.resolution": [64, 48], "cameras.fov": 60}
    )
    folders = []
    for worlds in (1, 3):
        folders.append(tmp_path_factory.mktemp("stills") / "set")
        bake_boxes(folders[-1], given | {"bake.worlds": worlds})
    return folders


def test_files_do_not_depend_on_worlds(baked):
    check_same(*baked)


def test_a_still_is_one_frame_of_each_view_without_gripper(baked):
    data_set = synpick_warp.open(baked[0])
    seen = []
    for episode in data_set.values():
        assert (episode.row["mode"], len(episode)) == ("still", 1)
        for camera in range(3):
            view = episode.view(frame=0, camera=camera)
            seen.append(tuple(view.world_to_camera.ravel()))
            assert view.masks.any()
    assert len(set(seen)) == 9
    assert len(list((baked[0] / "train").iterdir())) == 9
    rows = [json.loads(line) for line in (baked[0] / "episodes.jsonl").read_text().splitlines()]
    assert {(row["mode"], row["ending"], row["frames"], row["sentence"]) for row in rows} == {
        ("still", "finished", 1, "the pile was seen at rest")
    }
    assert {found.rule for found in synpick_warp.validate(baked[0], sample=None)} <= {"model-origin"}
    assert len(list(baked[0].rglob("*.tar"))) == 9
    assert len(list(zarr.open(baked[0] / "trajectory.zarr", mode="r").groups())) >= 1
