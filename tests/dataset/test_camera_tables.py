"""A bake of cameras of three sizes, with matrix, field of view and lens, in every format, read back by other libraries; of a lens as it is
and rectified; of cameras that have files of some images only: of every third frame, depth and masks without colour, or the reverse; and
of cameras drawn anew by each episode, or carried by the gripper: files against formulas, in float64."""

import json
import math
from dataclasses import replace
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
import trimesh
import zarr
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.codes import Stream
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import FORMATS
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.pytorch import Views
from synpick_warp.errors import ConfigError, DatasetError
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.system.progress import SilentProgress
from synpick_warp.testing.exporters import digests
from tests.builders import boxes, failing_after, mistake, once, run
from tests.online.test_stream import taken
from tests.twins import rng
from tests.worlds.cells import CELL, SIDE, bake_cell, camera_matrix, cell_config, check_same, check_valid, make_camera
from tools.checks.dataset import check

CAMERAS = (
    make_camera("left", **SIDE, matrix=camera_matrix(82.5, 82.38, 49.14, 35.25)),
    make_camera("top", resolution=[64, 48], fov=40.0),
    make_camera(
        "right",
        (0.5, 0.2, 0.9),
        (0.0, 0.0, 0.1),
        (0.0, 0.0, 1.0),
        resolution=[80, 60],
        matrix=camera_matrix(75.0, 74.5, 41.5, 28.75),
        distortion=[-0.12, 0.08, 0.0005, -0.0003, 0.01],
    ),
)
TABLE_NAMES = ("left", "top", "right")
SIZES = [(96, 72), (64, 48), (80, 60)]
TOP = 32.0 / np.tan(np.radians(20.0))
INTRINSICS = (82.5, 82.38, 49.14, 35.25), (TOP, TOP, 32.0, 24.0), (75.0, 74.5, 41.5, 28.75)
MATRICES = [np.array(camera_matrix(*numbers)) for numbers in INTRINSICS]
DISTORTION = [None, None, [-0.12, 0.08, 0.0005, -0.0003, 0.01]]


def bake_tables(out, layout: str, formats: tuple[str, ...]) -> None:
    bake_cell(out, cell_config(CAMERAS, **{"bake.formats": list(formats), "bop.layout": layout}))


@pytest.fixture(scope="module", params=["classic", "multisensor"])
def cell(tmp_path_factory, request):
    formats = tuple(name for name in FORMATS if name != "picks") if request.param == "classic" else ("bop", "usd")
    return once(tmp_path_factory, f"cell-{request.param}", lambda out: bake_tables(out, request.param, formats))[0]


def test_it_is_valid_and_every_view_has_its_cameras_size_and_matrix(cell):
    check_valid(cell)
    data = synpick_warp.open(cell)
    assert [tuple(camera.resolution) for camera in data.cameras] == SIZES
    seen = set()
    for view in data.views():
        width, height = SIZES[view.camera]
        assert (view.rgb.shape, view.depth.shape) == ((height, width, 3), (height, width))
        np.testing.assert_array_equal(view.intrinsics, data.cameras[view.camera].matrix)
        np.testing.assert_allclose(view.intrinsics, MATRICES[view.camera], rtol=1e-9)
        seen.add(view.camera)
    assert seen == {0, 1, 2}


@pytest.mark.parametrize("cell", ["classic"], indirect=True)
def test_pictures_are_those_of_each_camera(cell):
    """Masks, depth and boxes by rays in float64, from the models and the exported cameras; objects stand in one place for all."""
    found = vars(check(cell, 12))
    assert not [line for line in found.values() if not line.holds]
    assert found["mask"].total > 1000


@pytest.mark.parametrize("cell", ["classic"], indirect=True)
def test_zarr_and_lerobot_have_cameras_of_their_sizes(cell):
    cameras = zarr.open_group(str(cell / "trajectory.zarr"), mode="r")["cameras"]
    np.testing.assert_array_equal(cameras["resolution"][:], SIZES)
    np.testing.assert_allclose(cameras["matrix"][:], MATRICES, rtol=1e-12)
    assert cameras.attrs["distortion"] == [values and {"cam_dist_model": "pinhole", "cam_dist": values} for values in DISTORTION]
    features = json.loads(next(cell.rglob("meta/info.json")).read_text())["features"]
    for name, (width, height) in zip(TABLE_NAMES, SIZES, strict=True):
        assert features[f"observation.images.{name}"]["shape"] == [height, width, 3]
        (video,) = cell.rglob(f"observation.images.{name}/**/*.mp4")
        with av.open(str(video)) as container:
            assert {(frame.width, frame.height) for frame in container.decode(video=0)} == {(width, height)}


BENT = (
    make_camera("bent", **SIDE, matrix=MATRICES[0].tolist(), distortion=[-0.3, 0.08, 0.0005, -0.0003]),
    make_camera("flat", fov=40.0, exposure_time=0.01),
)


@pytest.mark.parametrize("rectified", [False, True])
def test_a_rectified_set_is_that_of_a_pinhole_with_the_same_matrix(tmp_path, rectified):
    bake_cell(
        tmp_path / "set",
        cell_config(BENT, **{"bop.rectified": rectified, "bake.formats": ["bop", "shards", "points"], "render.shutter_samples": 2}),
    )
    bent, flat = (json.loads((tmp_path / f"set/train/{scene:06d}/scene_camera.json").read_text())["0"] for scene in (0, 1))
    assert bent["cam_K"] == np.ravel(MATRICES[0]).tolist()
    assert (bent.get("cam_dist"), flat.get("cam_dist")) == (None if rectified else [-0.3, 0.08, 0.0005, -0.0003], None)
    assert ("cam_dist" in (tmp_path / "set/camera_bent.json").read_text()) is not rectified
    assert ("exposure_time" in bent, flat["exposure_time"], flat["readout_time"]) == (False, 0.01, 0.0)
    assert json.loads((tmp_path / "set/camera_flat.json").read_text())["exposure_time"] == 0.01
    assert all(line.holds for line in vars(check(tmp_path / "set", 4)).values())
    for card in ("dataset_info.md", "README.md"):
        lines = (tmp_path / "set" / card).read_text().splitlines()
        (first,) = (lines[index + 2] for index, line in enumerate(lines) if line.startswith("# "))
        assert first.startswith("**Pictures are rectified**" if rectified else "**Pictures are distorted** by the lens of bent:")
    view = synpick_warp.open(tmp_path / "set")[0].view(0, camera=0)
    rows, columns = np.nonzero(view.depth)
    points, pixels = view.points()[rows, columns].astype(float), np.stack((columns, rows), axis=-1)
    there = cv2.projectPoints(points, np.zeros(3), np.zeros(3), view.intrinsics("opencv"), np.array(bent.get("cam_dist", [0.0] * 4)))[0]
    np.testing.assert_allclose(there[:, 0], pixels, atol=2e-3)
    cloud = trimesh.load(str(tmp_path / "set/points/train/000000/000000.ply")).vertices
    np.testing.assert_allclose(cloud, view.points("world")[rows, columns], atol=1e-6)
    np.testing.assert_allclose(view.unproject(pixels + 0.5, view.depth[rows, columns]), points, atol=1e-6)


# ---- files of some images only ----


def test_a_camera_without_masks_is_named_before_a_conversion(tmp_path):
    cameras = make_camera("bare", modalities=["color", "depth"], fov=40.0), make_camera("whole", fov=40.0)
    bake_cell(tmp_path / "set", cell_config(cameras, **{"bake.formats": ["bop"]}))
    said = mistake("convert", tmp_path / "set", "--to", "points", "--out", tmp_path / "out")
    assert "has no masks of camera bare, which a format needs; bake it with these" in said
    assert not (tmp_path / "out").exists()


NAMES, EVERY = ("slow", "fast"), (3, 1)
SPARSE = make_camera("slow", **SIDE, every=3, fov=40.0), make_camera("fast", fov=40.0)
CHOSEN = (
    make_camera("slow", **SIDE, every=3, modalities=["masks", "depth"], fov=40.0),
    make_camera("fast", modalities=["color", "normals"], fov=40.0),
)
"""Depth and masks of one camera, colour and normals of the other."""
KINDS = ({"depth", "mask", "mask_visib"}, {"rgb", "normals"})
EPISODES = 2
GIVEN = {"bake.episodes": EPISODES, "bake.worlds": 2}
MANY = {"bake.formats": ["bop", "shards", "coco", "yolo", "points", "usd", "zarr"]}
LAYERS = {"bake.formats": ["bop", "shards", "zarr"], "render.layers": ["normals", "nocs"]}
SENSORS = {"bop.layout": "multisensor", "bake.formats": ["bop", "zarr"]}
SETS = {
    "sparse": (SPARSE, MANY),
    "modalities": (CHOSEN, LAYERS),
    "modalities of sensors": (CHOSEN, LAYERS | SENSORS),
}


def bake(name: str, out: Path, shard: tuple[int, int] = (0, 1), **given: object) -> None:
    cameras, settings = SETS[name]
    bake_cell(out, cell_config(cameras, **GIVEN | settings | given), shard)


@pytest.fixture
def baked(request, tmp_path_factory) -> Path:
    """A set by its name, made once."""
    name = request.param
    return once(tmp_path_factory, f"chosen-{name.replace(' ', '-')}", lambda out: bake(name, out))[0]


def of(*names: str):
    """Run a test on sets of these names."""
    return pytest.mark.parametrize("baked", names, indirect=True)


@of("sparse", "modalities of sensors")
def test_every_format_has_the_frames_of_each_camera(baked):
    for episode, row in enumerate(map(json.loads, (baked / "episodes.jsonl").read_text().splitlines())):
        assert row["frames"] > 4
        for camera, every in enumerate(EVERY):
            scene, frames = EPISODES * episode + camera, list(range(0, row["frames"], every))
            if not (baked / "coco").exists():
                sensor = json.loads((baked / f"train/{episode:06d}/scene_gt_{NAMES[camera]}.json").read_text())
                assert sorted(map(int, sensor)) == frames
                continue
            assert sorted(map(int, json.loads((baked / f"train/{scene:06d}/scene_camera.json").read_text()))) == frames
            for folder in (f"train/{scene:06d}/rgb", f"train/{scene:06d}/depth", f"coco/images/{scene:06d}"):
                assert sorted(int(path.stem) for path in (baked / folder).iterdir()) == frames
            assert len(list((baked / f"yolo/images/train/{scene:06d}").iterdir())) == len(frames)


@of("modalities", "modalities of sensors")
def test_each_camera_has_its_own_files(baked):
    scenes = sorted(path for path in (baked / "train").iterdir() if path.is_dir())
    folders = [{path.name for path in scene.iterdir() if path.is_dir()} for scene in scenes]
    if len(folders) == 2 * EPISODES:
        assert folders == [*KINDS] * EPISODES
    else:
        assert folders == [{f"{kind}_{name}" for name, kinds in zip(NAMES, KINDS, strict=True) for kind in kinds}] * EPISODES
        assert "'slow': ['depth'], 'fast': ['rgb']" in (baked / "bop_dataset_params.py").read_text()
    data = synpick_warp.open(baked)
    deep, flat = data[0].view(3, 0), data[0].view(3, 1)
    assert (deep.depth > 0).any()
    assert deep.masks.shape[1:] == (72, 96)
    assert flat.rgb.shape == (72, 96, 3)
    assert np.abs(flat.layer("normals")).max() > 0.5
    for view, name in ((deep, "rgb"), (flat, "depth"), (flat, "masks")):
        with pytest.raises(DatasetError, match=r"there is no|has no"):
            getattr(view, name)
    assert deep.object_to_camera.shape == flat.object_to_camera.shape


@pytest.mark.parametrize("command", ["verify", "validate", "stats", "report", "preview"])
@of(*SETS)
def test_commands_take_it(baked, command, tmp_path):
    extra = {"report": ("--out", tmp_path / "page.html"), "preview": ("--out", tmp_path / "sheet.png")}
    ran = run(command, baked, *extra.get(command, ()))
    assert ran.code == 0, ran
    assert command != "validate" or "0 errors" in ran.out, ran


@of("sparse")
def test_it_is_read_by_episode_and_frame(baked):
    data = synpick_warp.open(baked)
    episode = data[1]
    views = [(view.camera, view.frame) for view in episode.views()]
    assert views == [(camera, frame) for frame in range(len(episode)) for camera in (0, 1) if frame % EVERY[camera] == 0]
    with pytest.raises(IndexError, match="no picture of camera 0 in frame 4; it has one every 3 frames"):
        episode.view(4, 0)
    track = episode.tracks[0]
    assert np.isfinite(track.visibility[1]).all()
    assert len(Views(baked, cameras=[0], stride=3)) == sum(len(data[each].frames(0)) for each in data)
    with pytest.raises(DatasetError, match="camera 0 has a picture every 3 frames; give a stride of 3, or cameras without it"):
        Views(baked)


@pytest.mark.parametrize(
    ("baked", "name", "to"), [("sparse", "sparse", "coco,shards"), ("modalities", "modalities", "shards")], indirect=["baked"]
)
def test_it_is_converted_to_the_same_files(baked, name, to, tmp_path):
    bake(name, tmp_path / "set", **{"bake.formats": ["bop"]})
    ran = run("convert", tmp_path / "set", "--to", to, "--out", tmp_path / "more")
    assert ran.code == 0, ran
    for folder in ("train_web", *(["coco"] if "coco" in to else [])):
        assert digests(baked / folder) == digests(tmp_path / "more" / folder)


@of("modalities")
def test_in_shares_and_fewer_worlds_it_has_the_same_bytes(baked, tmp_path):
    for part in range(2):
        bake("modalities", tmp_path / str(part), (part, 2), **{"bake.worlds": 1})
    assert merge([tmp_path / "0", tmp_path / "1"], tmp_path / "merged").missing == []
    check_same(baked, tmp_path / "merged")


@pytest.mark.parametrize(("baked", "name"), [("sparse", "sparse"), ("modalities", "modalities")], indirect=["baked"])
def test_a_stream_has_the_images_of_each_camera(baked, name):
    """What a camera lacks is not rendered; depth and masks, from which all follows, are there for all."""
    cameras, settings = SETS[name]
    with boxes():
        views = taken(synpick_warp.stream(cell_config(cameras, **GIVEN | settings)))
    data = synpick_warp.open(baked)
    assert views.keys() == {(view.episode, view.camera, view.frame) for view in data.views()}
    for (episode, camera, frame), made in views.items():
        view = data[episode].view(frame, camera)
        if cameras is CHOSEN:
            assert {"color", "normals", "nocs"} & made.keys() == ({"color", "normals"} if camera else set())
        if cameras is SPARSE or camera:
            np.testing.assert_array_equal(made["color"], view.rgb)
        else:
            np.testing.assert_allclose(made["depth"] * 1e-4, view.depth, atol=1e-6)


# ---- drawn cameras ----

DRAWN = len(CELL)
MOVING = {"bake.formats": ["bop", "usd", "zarr"], "render.layers": ["flow", "scene_flow"], "bake.episodes": EPISODES, "bake.worlds": 2}
CONFIG = cell_config(CELL, **MOVING)


def bake_drawn(out: Path, **given: object) -> None:
    bake_cell(out, cell_config(CELL, **MOVING | given))


@pytest.fixture(scope="module")
def drawn_cell(tmp_path_factory):
    return once(tmp_path_factory, "drawn-cameras", bake_drawn)[0]


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


def test_each_episode_draws_its_own_camera_and_all_formats_have_it(drawn_cell):
    seen = []
    rows = [json.loads(line) for line in (drawn_cell / "episodes.jsonl").read_text().splitlines()]
    store = zarr.open_group(drawn_cell / "trajectory.zarr", mode="r")
    for episode in range(EPISODES):
        matrix, rotation, translation = drawn_camera(CONFIG, episode)
        scene = json.loads((drawn_cell / f"train/{DRAWN * episode:06d}/scene_camera.json").read_text())
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
        stage = Usd.Stage.Open(str(drawn_cell / f"usd/{episode:06d}.usdc"))
        lens = UsdGeom.Camera(stage.GetPrimAtPath("/Episode/Cameras/drawn"))
        pose = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(lens.GetPrim())).T
        np.testing.assert_allclose(pose[:3, 3], -rotation.T @ translation, atol=1e-12)
        np.testing.assert_allclose(pose[:3, :3], rotation.T * [1, -1, -1], atol=1e-12)
        focal = lens.GetFocalLengthAttr().Get() / lens.GetHorizontalApertureAttr().Get() * 96
        assert focal == pytest.approx(matrix[0, 0], rel=1e-6)
        seen.append(translation)
    assert np.abs(seen[0] - seen[1]).max() > 1e-3
    assert np.linalg.norm(Rotation.from_matrix(rotation @ make_cameras(CONFIG.rig)[0].rotation.T).as_rotvec()) > 1e-3


def hand_poses(drawn_cell: Path, episode: int) -> tuple[np.ndarray, np.ndarray]:
    """World-to-camera rotations and translations of the camera on the gripper, from the recorded poses of the shaft."""
    down = make_cameras(CONFIG.rig)[2]
    store = zarr.open_group(drawn_cell / "trajectory.zarr", mode="r")
    shaft = np.array(store[f"episodes/{episode:06d}/ticks/fixture_pose"])[:, 1].astype(float)
    turned = np.stack([down.rotation @ Rotation.from_quat(pose[3:]).as_matrix().T for pose in shaft])
    center = [pose[:3] + Rotation.from_quat(pose[3:]).as_matrix() @ [0.12, 0.02, 0.4] for pose in shaft]
    return turned, -np.einsum("nij,nj->ni", turned, center)


def test_a_camera_on_the_gripper_goes_where_it_goes(drawn_cell):
    for episode in range(EPISODES):
        rotations, translations = hand_poses(drawn_cell, episode)
        assert np.ptp(translations, axis=0).max() > 0.05
        scene = json.loads((drawn_cell / f"train/{DRAWN * episode + 2:06d}/scene_camera.json").read_text())
        stage = Usd.Stage.Open(str(drawn_cell / f"usd/{episode:06d}.usdc"))
        prim = stage.GetPrimAtPath("/Episode/Cameras/hand")
        assert len(scene) == len(rotations)
        for frame, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
            entry = scene[str(frame)]
            np.testing.assert_allclose(np.reshape(entry["cam_R_w2c"], (3, 3)), rotation, rtol=0, atol=1e-12)
            np.testing.assert_allclose(entry["cam_t_w2c"], 1e3 * translation, rtol=0, atol=1e-9)
            pose = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim)).T
            np.testing.assert_allclose(pose[:3, :3], rotation.T * [1, -1, -1], atol=1e-12)
            np.testing.assert_allclose(pose[:3, 3], -rotation.T @ translation, atol=1e-12)


def test_flow_through_the_moving_camera_leads_to_the_frame_before(drawn_cell):
    """Points of what does not move, from depth and flow, are where the exported cameras of both frames see them."""
    scene, checked = synpick_warp.open(drawn_cell)[0], 0
    for frame in range(1, len(scene)):
        now, before = scene.view(frame, 2), scene.view(frame - 1, 2)
        points = now.points()
        to_before = before.world_to_camera @ np.linalg.inv(now.world_to_camera)
        then = points @ to_before[:3, :3].T + to_before[:3, 3]
        flow, scene_flow = now.layer("flow"), now.layer("scene_flow")
        # What has no instance stands still, but for the gripper, which is nearer.
        still = ~now.masks.any(axis=0) & np.isfinite(flow).all(axis=-1) & (now.depth > 0.48)
        expected = before.project(then) - now.project(points)
        assert still.sum() > 200
        # Depth has steps of 0.1 mm, and flow of 1/64 px.
        assert np.abs(flow - expected)[still].max() < 0.05
        assert np.abs(scene_flow - (then - points))[still].max() < 5e-4
        checked += np.abs(expected[still]).max() > 2.0
    assert checked


def test_pictures_are_those_of_the_drawn_camera(drawn_cell):
    """Masks, depth and boxes by rays in float64, from the models and the exported cameras."""
    check_valid(drawn_cell)
    view = synpick_warp.open(drawn_cell)[1].view(3, 0)
    np.testing.assert_allclose(view.intrinsics, drawn_camera(CONFIG, 1)[0], rtol=0, atol=1e-12)
    found = vars(check(drawn_cell, 8))
    assert not [line for line in found.values() if not line.holds]
    assert found["mask"].total > 1000


def test_the_number_of_worlds_changes_no_byte(drawn_cell, tmp_path):
    bake_drawn(tmp_path / "set", **{"bake.worlds": 1})
    check_same(drawn_cell, tmp_path / "set")


@pytest.mark.slow
def test_an_interrupted_bake_resumes_to_the_same_bytes(drawn_cell, tmp_path):
    """The first episode is committed when the second fails; the settings are then read back from the data set."""
    with failing_after(1):
        bake_drawn(tmp_path / "set", **{"bake.worlds": 1})
    assert len(list((tmp_path / "set/manifest").glob("0*.json"))) == 1
    with boxes():
        summary = run_bake(load_config(str(tmp_path / "set/config.toml")), tmp_path / "set", SilentProgress())
    assert (summary.resumed, len(summary.episodes)) == (1, EPISODES)
    check_same(drawn_cell, tmp_path / "set")


@pytest.mark.parametrize(
    ("index", "change"),
    [(0, {"distortion": (-0.12, 0.08, 0.0, 0.0)}), (0, {"jitter": None}), (2, {"fixed_to": "world"}), (2, {"fov": 71.0})],
)
def test_other_cameras_do_not_resume(drawn_cell, index, change):
    other = replace(CELL[index], **change)
    with pytest.raises(ConfigError, match="camera"):
        bake_cell(drawn_cell, cell_config((*CELL[:index], other, *CELL[index + 1 :]), **MOVING))
