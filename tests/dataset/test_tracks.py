"""Tracks of instances over cameras and time, against the batches that were written; in scene folders of both layouts and in shards."""

from __future__ import annotations

import numpy as np
import pytest

import synpick_warp
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.shards.exporter import ShardsExporter
from tests.harness.exporter_contract import FRAMES, LENSES
from tests.worlds.box_sets import EPISODES, write_set
from tests.worlds.box_views import OBJECT_IDS, batches

SETS = {"bop": (BopExporter, {}), "shards": (ShardsExporter, {}), "multisensor": (BopExporter, {"layout": "multisensor"})}


@pytest.fixture(scope="module", params=SETS)
def data(request, tmp_path_factory):
    exporter, bop = SETS[request.param]
    return synpick_warp.open(write_set(tmp_path_factory.mktemp("tracks") / "set", exporter, **bop))


def test_tracks_have_every_instance_in_every_camera_and_frame(data):
    present = np.flatnonzero(OBJECT_IDS >= 0).tolist()
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


def test_tracks_of_all_episodes_come_in_order(data):
    assert [(episode.index, track.instance_id) for episode, track in data.tracks] == [(e, i) for e in EPISODES for i in (0, 2, 3)]


def test_an_instance_that_left_has_no_poses_afterwards(data):
    from synpick_warp.dataset.tracks import Tracks

    views = [view for view in data[0].views() if view.frame == 0]
    track = Tracks(views, cameras=3, frames=2)[0]
    assert track.present.tolist() == [True, False]
    assert np.isnan(track.object_to_world[1]).all()
    assert np.isnan(track.object_to_camera[:, 1]).all()
    assert (track.boxes[:, 1] == -1).all()
    assert repr(track) == "Track(instance 0, object 3, in 1 of 2 frames)"


def test_views_of_all_layouts_have_images_masks_and_layers(data):
    view = data[2].view(1, camera=2)
    assert view.rgb.shape == (72, 96, 3)
    assert view.layers == ("classes", "flow")
    assert view.layer("classes").shape == view.depth.shape
    assert view.masks.any()
    assert not (view.masks & ~view.amodal_masks).any()
