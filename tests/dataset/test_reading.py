"""`synpick_warp.open`: what it gives of trajectories, and what it does not load. Views read back from BOP folders and from shards: the
arrays that went in, in metres, lazily, whatever the format; tracks of instances over cameras and time. Samples of PyTorch are these views,
also in pickled copies and in batches; the decoder for shards against webdataset itself."""

import importlib.util
import json
import pickle
import subprocess
import sys
import warnings
from pathlib import Path

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.pytorch import FIELDS, Views, collate
from synpick_warp.dataset.view import Tracks
from synpick_warp.dataset.webdataset import decode_view
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shards import ShardsExporter
from synpick_warp.testing import box_views
from synpick_warp.testing.box_views import OBJECT_IDS, SIZES, batches, config
from synpick_warp.testing.exporters import FRAMES, LENSES, export
from synpick_warp.views.frames import FrameBatch
from synpick_warp.views.layer_codec import decode_layer, encode_layer
from tests.harness.environment import checkout_environment
from tests.twins.masks import masks_of_batch
from tests.worlds import trajectories
from tests.worlds.box_sets import ATTEMPT, EPISODES, LAYERS, write_set

TICKS = 5
"""Frames of the trajectories."""
HEAVY = ("warp", "newton", "cv2", "pxr", "trimesh", "scipy", "coacd")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    folder = trajectories.write_set(tmp_path_factory.mktemp("reading") / "set", trajectories.config(), (0, 4), TICKS)
    (folder / "config.toml").write_text(config_to_toml(load_config("smoke", {})))
    return folder


def test_episodes_by_number(folder):
    data = synpick_warp.open(folder)
    assert list(data) == [0, 4]
    assert (len(data), 4 in data, 1 in data) == (2, True, False)
    with pytest.raises(KeyError, match="no episode 1"):
        data[1]
    assert repr(data[4]) == "Episode(4: 5 frames, emptied)"
    assert (data[4].number, len(data[4]), data[4].attributes["mode"]) == (4, TICKS, "pick")


def test_arrays_and_attempts_are_those_in_memory(folder):
    episode = synpick_warp.open(str(folder))[4]
    batches = list(trajectories.ticks((4,), TICKS))
    force = episode.steps["contact_force"]
    assert force.attrs["units"] == "N"
    assert force.shape == (TICKS * trajectories.STEP_COUNT, 4, 3)
    np.testing.assert_array_equal(force[4:8], batches[1].steps["contact_force"][0, :, :4])
    np.testing.assert_array_equal(episode.ticks["peak_force"][:], [batch.tick["peak_force"][0] for batch in batches])
    assert "seal_force" in episode.steps
    assert set(episode.arrangement) == {"object_id", "mass", "drop_pose"}
    with pytest.raises(KeyError, match="speed; there are angular_velocity, attached, contact_force"):
        episode.steps["speed"]
    assert episode.attempts == (trajectories.ATTEMPT | {"episode": 4}, trajectories.UNSEEN | {"episode": 4})
    assert episode.attempt_arrays["hits"][:].tolist() == [9, 0]


def test_objects_cameras_and_settings(folder):
    data = synpick_warp.open(folder)
    entries, lenses = box_views.catalog().entries, box_views.cameras()
    assert [(one.object_id, one.name, one.mass, one.volume) for one in data.objects] == [
        (entry.obj_id, entry.name, entry.mass, entry.volume) for entry in entries
    ]
    assert type(data.objects[0].object_id) is int
    np.testing.assert_array_equal(data.objects[1].inertia, entries[1].inertia)
    assert len(data.cameras) == len(lenses)
    for name in ("matrix", "rotation", "translation"):
        np.testing.assert_array_equal(getattr(data.cameras[2], name), getattr(lenses[2], name))
    assert data.cameras[0].resolution == lenses[0].resolution
    assert data.config == load_config("smoke", {})
    assert (data.attributes["steps_per_tick"], data.attributes["units"]["step"]) == (trajectories.STEP_COUNT, "s")


def test_a_folder_may_have_no_steps_or_be_no_data_set(tmp_path):
    with pytest.raises(DatasetError, match=r"is not a data set: it has neither manifest\.json nor trajectory\.zarr"):
        synpick_warp.open(tmp_path)
    trajectories.write_set(tmp_path, trajectories.config(steps=False), (0,), 2, steps=False)
    assert dict(synpick_warp.open(tmp_path)[0].steps) == {}


def test_opening_reads_nothing(tmp_path, folder):
    """Names are enough until something is asked for: here an episode's files are no zarr."""
    for name in ("episodes/000003/steps", "episodes/000003/ticks"):
        (tmp_path / "trajectory.zarr" / name).mkdir(parents=True)
    for place in ("", "episodes", "episodes/000003"):
        (tmp_path / "trajectory.zarr" / place / "zarr.json").write_text("not JSON")
    data = synpick_warp.open(tmp_path)
    episode = data[3]
    assert list(data) == [3]
    assert list(episode.steps) == []
    with pytest.raises(DatasetError, match=r"000003/zarr\.json is damaged: JSON is malformed"):
        _ = episode.attributes


def test_no_simulator_is_loaded(folder):
    """To open a data set, list it and read settings takes no zarr either."""
    code = (
        "import sys, synpick_warp\n"
        "data = synpick_warp.open(sys.argv[1])\n"
        "print(len(data), data[4].attributes['frames'], data.config.bake.seed, 'zarr' in sys.modules, 'numpy' in sys.modules)\n"
        "data[4].steps['pose'][:2], data.objects, data.cameras\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], capture_output=True, text=True, check=True, env=checkout_environment())
    assert done.stdout.splitlines() == [f"2 {TICKS} 0 False False", "[]"]


# ---- views and tracks ----

PRESENT = np.flatnonzero(OBJECT_IDS >= 0)


SETS = {"bop": (BopExporter, {}), "shards": (ShardsExporter, {}), "multisensor": (BopExporter, {"layout": "multisensor"})}


@pytest.fixture(scope="module", params=SETS)
def data(request, tmp_path_factory):
    """A data set in scene folders of both layouts, and in shards."""
    exporter, bop = SETS[request.param]
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("views") / "set", exporter, **bop))


def expected() -> dict[tuple[int, int, int], FrameBatch]:
    """(episode, camera, frame) -> batch of one view."""
    return {(int(one.episode[0]), int(one.camera[0]), int(one.frame[0])): one for one in batches(1, EPISODES, FRAMES, LENSES)}


def test_episodes_and_their_rows_and_what_a_format_lacks(data):
    assert list(data) == [0, 2]
    assert (len(data[2]), data[2].row["mode"], repr(data[2])) == (FRAMES, "pick", "Episode(2: 3 frames, finished)")
    assert data[0].attempts == ()
    assert list(data.attempts) == [ATTEMPT]
    for name in ("attributes", "objects"):
        with pytest.raises(DatasetError, match="--formats zarr"):
            getattr(data, name)
    assert list(data[0].ticks) == list(data[0].steps) == []
    assert set(data.models_info) == set(SIZES)


def test_images_and_truth_are_those_that_were_written(data):
    for (episode, camera, frame), one in expected().items():
        view = data[episode].view(frame, camera)
        np.testing.assert_array_equal(view.rgb, one.color[0])
        assert view.rgb is view.rgb, "read once"
        assert view.rgb.flags.c_contiguous
        assert view.depth.dtype == np.float32
        np.testing.assert_allclose(view.depth, one.depth[0] * 1e-4, rtol=1e-6)
        assert len(view) == len(PRESENT)
        assert (view.instance_ids.tolist(), view.object_ids.tolist()) == (PRESENT.tolist(), OBJECT_IDS[PRESENT].tolist())
        np.testing.assert_array_equal(view.masks, [one.instance[0] == 1 + instance for instance in PRESENT])
        np.testing.assert_array_equal(view.amodal_masks, masks_of_batch(one)[PRESENT])
        counts = one.pixels[0][PRESENT]
        np.testing.assert_allclose(view.visibility, counts[:, 2] / np.maximum(counts[:, 0], 1))


def test_poses_are_in_metres_and_agree_between_cameras(data):
    for episode in EPISODES:
        for frame in range(FRAMES):
            one = expected()[episode, 0, frame]
            places = [data[episode].view(frame, camera).object_to_world for camera in range(len(LENSES))]
            assert np.ptp(places, axis=0).max() < 1e-12
            np.testing.assert_allclose(places[0][:, :3, 3], one.pose[0][PRESENT, :3], atol=1e-12)
            np.testing.assert_allclose(np.linalg.det(places[0][:, :3, :3]), 1.0)


def test_projected_boxes_surround_the_amodal_masks(data):
    """The corners of each box, projected, have the bounding box of its silhouette within a pixel."""
    view = data[0].view(1, camera=2)
    for object_id, pose, mask, (x, y, width, height) in zip(
        view.object_ids, view.object_to_camera, view.amodal_masks, view.boxes, strict=True
    ):
        corners = np.stack(np.meshgrid(*[(-side / 2, side / 2) for side in SIZES[int(object_id)]]), axis=-1).reshape(-1, 3)
        points = view.project(corners, pose)
        assert np.abs(points.min(axis=0) - (x, y)).max() <= 1.0
        assert np.abs(points.max(axis=0) - (x + width + 1, y + height + 1)).max() <= 1.0
        rows, columns = np.nonzero(mask)
        assert rows.min() >= points[:, 1].min() - 0.5
        assert columns.max() <= points[:, 0].max() + 0.5
    np.testing.assert_allclose(
        view.project(view.object_to_camera[:, :3, 3]), [view.project(np.zeros(3), pose) for pose in view.object_to_camera]
    )


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_points_lie_on_the_surfaces_of_their_boxes(data, frame):
    """Largest distance of a visible point to its box is the depth image's rounding; points of the world are the same in all cameras."""
    for camera in range(len(LENSES)):
        view = data[0].view(1, camera)
        points, poses = view.points(frame), view.object_to_camera if frame == "camera" else view.object_to_world
        assert points.shape == (*view.depth.shape, 3)
        assert points.dtype == np.float32
        np.testing.assert_array_equal(np.isnan(points), np.repeat(view.depth[..., None] == 0, 3, axis=-1))
        for object_id, pose, mask in zip(view.object_ids, poses, view.masks, strict=True):
            local = (points[mask] - pose[:3, 3]) @ pose[:3, :3]
            outside = np.abs(local) - np.array(SIZES[int(object_id)]) / 2
            assert np.abs(outside.max(axis=1)).max() < 1e-4
        seen = view.masks.any(axis=0)
        if frame == "camera":
            rows, columns = np.nonzero(seen)
            np.testing.assert_allclose(view.project(points[seen]), np.stack((columns, rows), axis=-1) + 0.5, atol=2e-3)
            np.testing.assert_array_equal(view.points(depth=2 * view.depth)[seen], 2 * points[seen])
    with pytest.raises(ValueError, match='no frame "object"; frames: camera, world'):
        view.points("object")


def test_cameras_and_intrinsics_for_opencv_with_pixel_centres_at_integers(data):
    """Points that OpenCV projects are half a pixel before ours; arithmetic gives plain arrays."""
    for camera, lens in enumerate(LENSES):
        view = data[0].view(0, camera)
        np.testing.assert_array_equal(view.intrinsics, lens.matrix)
        np.testing.assert_allclose(view.world_to_camera[:3, :3], lens.rotation)
        np.testing.assert_allclose(view.world_to_camera[:3, 3], lens.translation)
    view = data[0].view(0, 1)
    points = np.array([[0.01, -0.02, 0.5], [0.1, 0.05, 1.0]])
    for convention in ("opencv", "open3d"):
        matrix = view.intrinsics(convention)
        assert type(matrix) is type(view.intrinsics @ matrix) is np.ndarray
        there = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix, None)[0][:, 0]
        np.testing.assert_allclose(there, view.project(points) - 0.5, atol=1e-9)
        np.testing.assert_allclose(data.intrinsics(convention)[1], matrix)
    np.testing.assert_array_equal(view.intrinsics(), LENSES[1].matrix)
    np.testing.assert_array_equal(data.intrinsics()[2], LENSES[2].matrix)
    with pytest.raises(ValueError, match='no convention "cv"; conventions: synpick, opencv, open3d'):
        view.intrinsics("cv")


def test_layers_are_decoded(data):
    for (episode, camera, frame), one in expected().items():
        view = data[episode].view(frame, camera)
        assert view.layers == LAYERS
        np.testing.assert_array_equal(view.layer("classes"), one.layers["classes"][0])
        flow = one.layers["flow"][0]
        # A pixel with one unknown component is unknown.
        np.testing.assert_array_equal(view.layer("flow"), np.where(np.isnan(flow).any(axis=-1, keepdims=True), np.nan, flow))
    with pytest.raises(DatasetError, match=r"has no layer albedo; it has classes, flow; bake with render\.layers"):
        view.layer("albedo")


def test_views_come_frame_by_frame_and_end_with_the_last(data):
    order = [(view.episode, view.frame, view.camera) for view in data.views()]
    assert order == [(episode, frame, camera) for episode in EPISODES for frame in range(FRAMES) for camera in range(len(LENSES))]
    assert [view.frame for view in data[0].views(camera=1)] == list(range(FRAMES))
    assert data[0].view(-1).frame == FRAMES - 1
    for wrong in ("x", 1.0, None, slice(0, 1), 99, -1):
        assert wrong not in data
        with pytest.raises(KeyError, match="has no episode"):
            data[wrong]
    for place, said in (
        ((FRAMES,), "episode 0 has no frame 3; it has 3 frames"),
        ((0, 3), "there is no camera 3"),
        ((0, "left"), "there is no camera left; there are"),
        (("x",), "episode 0 has no frame x"),
    ):
        with pytest.raises(IndexError, match=said):
            data[0].view(*place)


@pytest.mark.parametrize("exporter", [BopExporter, ShardsExporter])
def test_a_set_without_masks_says_so_and_an_episode_without_manifest_entry_is_not_listed(tmp_path, exporter):
    folder = write_set(tmp_path, exporter, masks=False, split="train_pbr", color_format="jpg")
    view = synpick_warp.open(folder)[2].view(0)
    assert view.rgb.shape == (LENSES[0].height, LENSES[0].width, 3)
    with pytest.raises(DatasetError, match=r"bake with bop\.masks = true"):
        _ = view.masks
    (folder / f"{episode_entry(0)}.json").unlink()
    data = synpick_warp.open(folder)
    assert list(data) == [2]
    with pytest.raises(KeyError, match="no episode 0"):
        data[0]


def test_tracks_have_every_instance_in_every_camera_and_frame(data):
    present = PRESENT.tolist()
    for batch in batches(1, EPISODES, FRAMES, LENSES):
        episode, camera, frame = int(batch.episode[0]), int(batch.camera[0]), int(batch.frame[0])
        tracks = data[episode].tracks
        view = data[episode].view(frame, camera)
        assert list(tracks) == present
        for row, instance in enumerate(present):
            track = tracks[instance]
            assert len(track) == FRAMES
            assert track.object_id == OBJECT_IDS[instance]
            assert track.present[frame]
            np.testing.assert_allclose(track.object_to_world[frame, :3, 3], batch.pose[0, instance, :3], atol=1e-6)
            np.testing.assert_array_equal(track.object_to_camera[camera, frame], view.object_to_camera[row])
            assert track.visible_pixels[camera, frame] == batch.pixels[0, instance, 2] == view.masks[row].sum()
            assert track.visibility[camera, frame] == view.visibility[row]
            np.testing.assert_array_equal(track.boxes[camera, frame], view.boxes[row])
            np.testing.assert_array_equal(track.visible_boxes[camera, frame], view.visible_boxes[row])


def test_tracks_come_in_order_and_an_instance_that_left_has_no_poses_afterwards(data):
    assert [(episode.index, track.instance_id) for episode, track in data.tracks] == [(e, i) for e in EPISODES for i in (0, 2, 3)]
    views = [view for view in data[0].views() if view.frame == 0]
    track = Tracks(views, cameras=3, frames=2)[0]
    assert track.present.tolist() == [True, False]
    assert np.isnan(track.object_to_world[1]).all()
    assert np.isnan(track.object_to_camera[:, 1]).all()
    assert (track.boxes[:, 1] == -1).all()
    assert repr(track) == "Track(instance 0, object 3, in 1 of 2 frames)"


# ---- samples for training ----

STUBS = Path(__file__).parents[1] / "stubs"


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def training(request, tmp_path_factory):
    return write_set(tmp_path_factory.mktemp("torch") / "set", request.param)


@pytest.fixture
def torch(monkeypatch):
    """PyTorch, or its stand-in where it is not installed, which is gone after the test: other libraries would take it for PyTorch."""
    missing = importlib.util.find_spec("torch") is None
    if missing:
        monkeypatch.syspath_prepend(str(STUBS))
    import torch

    yield torch
    if missing:
        for name in [name for name in sys.modules if name.partition(".")[0] == "torch"]:
            del sys.modules[name]


def test_fields_are_checked_when_it_is_made(training):
    with pytest.raises(DatasetError, match=r"no field depht; did you mean depth\?; fields: rgb, .*pick_weights; layers: .*normals"):
        Views(training, fields=("rgb", "depht"))


def test_samples_are_views_in_order_with_what_is_visible_enough(training):
    fields = (name for name in FIELDS if not name.startswith("pick_"))  # This set has no picks.
    views = Views(training, fields=(*fields, "classes"), min_visibility=0.8)
    expected = [(episode, camera, frame) for episode in EPISODES for frame in range(FRAMES) for camera in range(3)]
    assert len(views) == len(expected)
    data = synpick_warp.open(training)
    dropped = 0
    for index, (episode, camera, frame) in enumerate(expected):
        sample, view = views[index], data[episode].view(frame, camera)
        assert (sample["episode"], sample["camera"], sample["frame"]) == (episode, camera, frame)
        np.testing.assert_array_equal(sample["rgb"], view.rgb.transpose(2, 0, 1))
        np.testing.assert_array_equal(sample["depth"], view.depth[None])
        np.testing.assert_array_equal(sample["points"], view.points().transpose(2, 0, 1))
        np.testing.assert_array_equal(sample["classes"], view.layer("classes"))
        kept = (view.visibility >= 0.8) & view.masks.any(axis=(1, 2))
        dropped += int((~kept).sum())
        np.testing.assert_array_equal(sample["masks"], view.masks[kept])
        np.testing.assert_array_equal(sample["object_ids"], view.object_ids[kept])
        np.testing.assert_allclose(sample["poses"], view.object_to_camera[kept], rtol=1e-6)
        for mask, (x_min, y_min, x_max, y_max) in zip(sample["masks"], sample["boxes"].astype(int), strict=True):
            rows, columns = np.nonzero(mask)
            assert (x_min, y_min, x_max, y_max) == (columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)
    assert dropped > 0
    assert views[-1]["frame"] == FRAMES - 1
    with pytest.raises(IndexError):
        views[len(expected)]


def test_choices_of_cameras_and_frames(training):
    views = Views(training, split="train", cameras=(2,), stride=2)
    assert [(sample["episode"], sample["camera"], sample["frame"]) for sample in views] == [(e, 2, f) for e in EPISODES for f in (0, 2)]
    for wrong, said in (
        ({"cameras": (3,)}, "has the cameras 0 to 2"),
        ({"stride": 0}, "stride 0: at least 1"),
        ({"split": "nowhere"}, "nowhere"),
        ({"fields": ("colour",)}, "there is no field colour"),
    ):
        with pytest.raises(DatasetError, match=said):
            Views(training, **wrong)[0]


def test_a_pickled_copy_is_small_and_gives_the_same(training):
    views = Views(training)
    first = [views[index] for index in (3, 0)]
    data = pickle.dumps(views)
    assert len(data) < 5000
    for before, after in zip(first, (pickle.loads(data)[index] for index in (3, 0)), strict=True):
        assert before.keys() == after.keys()
        for name in before:
            np.testing.assert_array_equal(before[name], after[name])


def test_batches_of_workers_equal_those_of_this_process(training, torch):
    views = Views(training, fields=("rgb", "masks", "poses"))
    loaders = [torch.utils.data.DataLoader(views, batch_size=4, num_workers=workers, collate_fn=collate) for workers in (0, 2)]
    seen = []
    for alone, shared in zip(*loaders, strict=True):
        assert alone["rgb"].shape[1:] == (3, 72, 96)
        seen += [int(frame) for frame in alone["frame"]]
        np.testing.assert_array_equal(np.asarray(alone["rgb"]), np.asarray(shared["rgb"]))
        for one, other in zip(alone["masks"], shared["masks"], strict=True):
            np.testing.assert_array_equal(np.asarray(one), np.asarray(other))
    assert seen == [frame for _ in EPISODES for frame in range(FRAMES) for _ in range(3)]


# ---- webdataset ----

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # Its import looks for torch.
    import webdataset

LEFT_OPEN = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning", "ignore::ResourceWarning")
"""webdataset leaves its files to the garbage collector."""


@pytest.fixture(scope="module")
def shard(tmp_path_factory) -> Path:
    out = export(ShardsExporter, tmp_path_factory.mktemp("decoder") / "set", config(("flow", "classes")), (0,))
    return out / "train_pbr_web" / "shard-000000.tar"


def read(shard: Path, *handlers: object) -> list[dict]:
    """All samples of a shard, through webdataset's own pipeline."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        return list(webdataset.WebDataset(str(shard), shardshuffle=False).decode(*handlers))


@LEFT_OPEN
def test_webdatasets_pipeline_gives_what_was_written(shard):
    truth = [batch for batch in batches(1, (0,), 3, LENSES) if int(batch.camera[0]) == 0]
    samples = read(shard, decode_view)
    assert len(samples) == len(truth) == 3
    for sample, batch in zip(samples, truth, strict=True):
        assert sample["depth.png"].dtype == np.uint16
        np.testing.assert_array_equal(sample["depth.png"], batch.depth[0])
        assert sample["rgb.jpg"].flags.c_contiguous
        assert np.median(np.abs(sample["rgb.jpg"].astype(int) - batch.color[0])) <= 3
        np.testing.assert_array_equal(sample["classes.png"], batch.layers["classes"][0])
        expected = decode_layer("flow", encode_layer("flow", batch.layers["flow"][0]))
        np.testing.assert_array_equal(sample["flow.png"], expected)
        instances = [row["instance_id"] for row in sample["gt.json"]]
        np.testing.assert_array_equal(sample["mask_visib.json"], [batch.instance[0] == 1 + index for index in instances])
        np.testing.assert_array_equal(sample["mask.json"], masks_of_batch(batch)[instances])
        assert sample["camera.json"]["depth_scale"] == 0.1


def test_views_without_instances_have_no_masks_and_other_entries_are_left_to_webdataset():
    assert decode_view(".mask.json", b"{}").shape == (0, 0, 0)
    assert [decode_view(key, b"{}") for key in (".camera.json", ".txt", ".__key__")] == [None] * 3


@pytest.mark.parametrize(
    ("key", "data", "message"),
    [
        (".depth.png", b"\x89PNG", "not an image"),
        (".rgb.jpg", cv2.imencode(".jpg", np.zeros((4, 4, 3), np.uint8))[1].tobytes()[:60], "not an image"),
        (".mask.json", b'{"0": {"counts": [5], "size": [2, 2]}}', "5 of 4 pixels"),
        (".mask.json", b'{"1": {"counts": [4], "size": [2, 2]}}', "does not number its masks from 0"),
        (".mask.json", json.dumps({"0": {"counts": [4], "size": [2, 2]}, "1": {"counts": [6], "size": [2, 3]}}).encode(), "3 x 2 pixels"),
        (".mask.json", b'{"0": {"counts": [100000000000], "size": [100000, 1000000]}}', "is damaged"),
    ],
)
def test_damaged_entries_are_one_error(key, data, message):
    with pytest.raises(DatasetError, match=message):
        decode_view(key, data)
