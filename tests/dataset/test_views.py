"""Views read back from BOP folders and from shards: the arrays that went in, in metres, lazily, whatever the format;
and tracks of instances over cameras and time."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

import synpick_warp
from synpick_warp.dataset.commit.manifest import episode_entry
from synpick_warp.dataset.tracks import Tracks
from synpick_warp.dataset.view_files import decode_run_lengths
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from synpick_warp.views.frames import FrameBatch
from tests.harness.exporter_contract import FRAMES, LENSES
from tests.twins.masks import masks_of_batch
from tests.worlds.box_sets import ATTEMPT, EPISODES, LAYERS, write_set
from tests.worlds.box_views import OBJECT_IDS, SIZES, batches

PRESENT = np.flatnonzero(OBJECT_IDS >= 0)


@pytest.fixture(scope="module", params=[BopExporter, ShardsExporter], ids=["bop", "shards"])
def data(request, tmp_path_factory):
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("views") / "set", request.param))


def expected() -> dict[tuple[int, int, int], FrameBatch]:
    """(episode, camera, frame) -> batch of one view."""
    return {(int(one.episode[0]), int(one.camera[0]), int(one.frame[0])): one for one in batches(1, EPISODES, FRAMES, LENSES)}


def test_episodes_and_their_rows(data):
    assert list(data) == [0, 2]
    assert 2 in data
    assert 1 not in data
    assert (len(data[2]), data[2].row["mode"], repr(data[2])) == (FRAMES, "pick", "Episode(2: 3 frames, finished)")
    assert data[0].attempts == ()
    assert list(data.attempts) == [ATTEMPT]


def test_images_and_truth_are_those_that_were_written(data):
    for (episode, camera, frame), one in expected().items():
        view = data[episode].view(frame, camera)
        np.testing.assert_array_equal(view.rgb, one.color[0])
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


def test_cameras(data):
    for camera, lens in enumerate(LENSES):
        view = data[0].view(0, camera)
        np.testing.assert_array_equal(view.intrinsics, lens.matrix)
        np.testing.assert_allclose(view.world_to_camera[:3, :3], lens.rotation)
        np.testing.assert_allclose(view.world_to_camera[:3, 3], lens.translation)


def test_intrinsics_for_opencv_have_pixel_centres_at_integers(data):
    """Points that OpenCV projects are half a pixel before ours; arithmetic gives plain arrays."""
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
    with pytest.raises(IndexError, match="episode 0 has no frame 3; it has 3 frames"):
        data[0].view(FRAMES)
    with pytest.raises(IndexError, match="there is no camera 3"):
        data[0].view(0, camera=3)
    for wrong in ("x", 1.0, None, slice(0, 1), 99, -1):
        assert wrong not in data
        with pytest.raises(KeyError, match="has no episode"):
            data[wrong]
    with pytest.raises(IndexError, match="there is no camera left; there are"):
        data[0].view(0, camera="left")
    with pytest.raises(IndexError, match="episode 0 has no frame x"):
        data[0].view("x")


def test_an_episode_without_manifest_entry_is_not_listed(tmp_path):
    folder = write_set(tmp_path, BopExporter)
    (folder / f"{episode_entry(0)}.json").unlink()
    data = synpick_warp.open(folder)
    assert list(data) == [2]
    with pytest.raises(KeyError, match="no episode 0"):
        data[0]


@pytest.mark.parametrize("exporter", [BopExporter, ShardsExporter])
def test_a_set_without_masks_says_so(tmp_path, exporter):
    view = synpick_warp.open(write_set(tmp_path, exporter, masks=False, split="train_pbr", color_format="jpg"))[0].view(0)
    assert view.rgb.shape == (LENSES[0].height, LENSES[0].width, 3)
    with pytest.raises(DatasetError, match=r"bake with bop\.masks = true"):
        _ = view.masks


def test_what_a_format_lacks_is_an_error_that_names_the_format(data):
    for name in ("attributes", "objects"):
        with pytest.raises(DatasetError, match="--formats zarr"):
            getattr(data, name)
    assert list(data[0].ticks) == list(data[0].steps) == []
    assert set(data.models_info) == set(SIZES)


def test_a_damaged_image_is_named(tmp_path):
    folder = write_set(tmp_path, BopExporter)
    (folder / "train" / "000000" / "rgb" / "000001.png").write_bytes(b"no image")
    with pytest.raises(DatasetError, match=r"000001\.png is not an image"):
        _ = synpick_warp.open(folder)[0].view(1).rgb


def test_run_lengths_are_those_of_coco():
    """Columns from left to right; the first run is of zeros."""
    mask = np.array([[0, 1, 1], [1, 1, 0]], bool)
    np.testing.assert_array_equal(decode_run_lengths([1, 4, 1], [2, 3]), mask)
    assert not decode_run_lengths([6], [2, 3]).any()


def test_a_part_is_read_once(data):
    view = data[0].view(0)
    assert view.rgb is view.rgb
    assert view.rgb.flags.c_contiguous


# ---- tracks ----

SETS = {"bop": (BopExporter, {}), "shards": (ShardsExporter, {}), "multisensor": (BopExporter, {"layout": "multisensor"})}


@pytest.fixture(scope="module", params=SETS)
def tracked(request, tmp_path_factory):
    """A data set in scene folders of both layouts, and in shards."""
    exporter, bop = SETS[request.param]
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("tracks") / "set", exporter, **bop))


def test_tracks_have_every_instance_in_every_camera_and_frame(tracked):
    present = PRESENT.tolist()
    for batch in batches(1, EPISODES, FRAMES, LENSES):
        episode, camera, frame = int(batch.episode[0]), int(batch.camera[0]), int(batch.frame[0])
        tracks = tracked[episode].tracks
        view = tracked[episode].view(frame, camera)
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


def test_tracks_of_all_episodes_come_in_order(tracked):
    assert [(episode.index, track.instance_id) for episode, track in tracked.tracks] == [(e, i) for e in EPISODES for i in (0, 2, 3)]


def test_an_instance_that_left_has_no_poses_afterwards(tracked):
    views = [view for view in tracked[0].views() if view.frame == 0]
    track = Tracks(views, cameras=3, frames=2)[0]
    assert track.present.tolist() == [True, False]
    assert np.isnan(track.object_to_world[1]).all()
    assert np.isnan(track.object_to_camera[:, 1]).all()
    assert (track.boxes[:, 1] == -1).all()
    assert repr(track) == "Track(instance 0, object 3, in 1 of 2 frames)"


def test_views_of_all_layouts_have_images_masks_and_layers(tracked):
    view = tracked[2].view(1, camera=2)
    assert view.rgb.shape == (72, 96, 3)
    assert view.layers == ("classes", "flow")
    assert view.layer("classes").shape == view.depth.shape
    assert view.masks.any()
    assert not (view.masks & ~view.amodal_masks).any()
