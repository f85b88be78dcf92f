"""BOP target lists: read, written, and the ground truth reduced to them."""

from __future__ import annotations

import json

import numpy as np
import pytest

import synpick_warp
from synpick_warp.apps.evaluation.targets import TargetRow, count_targets, encode_targets, in_layout, read_targets, select_targets
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.errors import ResultError
from tests.worlds.evaluation_set import BOX, BRICK, write_evaluation_set


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return read_truth(synpick_warp.open(write_evaluation_set(tmp_path_factory.mktemp("targets") / "set")))


def test_lists_are_read_as_they_were_written(tmp_path):
    targets = count_targets([(1, 2, 5), (0, 3, 4), (1, 2, 5)])
    path = tmp_path / "list.json"
    path.write_bytes(encode_targets(targets))
    assert json.loads(path.read_text()) == [
        {"scene_id": 0, "im_id": 3, "obj_id": 4, "inst_count": 1},
        {"scene_id": 1, "im_id": 2, "obj_id": 5, "inst_count": 2},
    ]
    assert read_targets(path).targets == (TargetRow(0, 3, 4, 1), TargetRow(1, 2, 5, 2))
    assert read_targets(path).objects == {(0, 3): frozenset({4}), (1, 2): frozenset({5})}


def test_the_truth_is_reduced_to_images_and_objects(truth, tmp_path):
    path = tmp_path / "list.json"
    path.write_text(
        json.dumps([{"im_id": 1, "scene_id": 4}, {"im_id": 2, "scene_id": 0, "obj_id": BOX}, {"im_id": 1, "scene_id": 4, "obj_id": 9}])
    )
    part = select_targets(truth, read_targets(path))
    assert part.images.tolist() == [[0, 2], [4, 1]]
    keys = list(zip(part.poses.scene.tolist(), part.poses.image.tolist(), part.poses.object_id.tolist(), strict=True))
    assert keys == [(0, 2, BOX), (4, 1, BRICK), (4, 1, BRICK), (4, 1, 2), (4, 1, 3)]
    rows = (truth.poses.scene == 4) & (truth.poses.image == 1)
    for name in ("visibility", "speed", "mode", "episode", "camera"):
        np.testing.assert_array_equal(getattr(part, name)[1:], getattr(truth, name)[rows])


SENSORS = ("cam0", "cam1", "cam2")


@pytest.mark.parametrize(
    ("entry", "images"),
    [
        ({"scene_id": 2, "im_id": 5}, [(6, 5)]),
        ({"scene_id": 2, "im_id": 5, "sensor": "cam2"}, [(8, 5)]),
        ({"scene_id": 1, "im_id": [["cam0", 4], ["cam1", 4]]}, [(3, 4), (4, 4)]),
    ],
)
def test_lists_of_several_sensors_name_images_of_the_first_one_or_their_own(tmp_path, entry, images):
    path = tmp_path / "list.json"
    path.write_text(json.dumps([entry]))
    assert sorted(read_targets(path).in_classic_layout(SENSORS).objects) == images


def test_lists_of_several_sensors_are_read_as_they_were_written(tmp_path):
    path = tmp_path / "list.json"
    classic = count_targets([(1, 2, 5), (3, 3, 4), (1, 2, 5)])
    path.write_bytes(encode_targets(in_layout(classic, SENSORS)))
    assert json.loads(path.read_text())[0] == {"scene_id": 0, "im_id": 2, "obj_id": 5, "inst_count": 2, "sensor": "cam1"}
    assert sorted(read_targets(path).in_classic_layout(SENSORS).targets) == sorted(classic)
    assert in_layout(classic, ()) == classic


@pytest.mark.parametrize(("sensors", "message"), [((), "a scene for each"), (SENSORS, "cam0, cam1, cam2")])
def test_unknown_sensors_are_refused(tmp_path, sensors, message):
    path = tmp_path / "list.json"
    path.write_text('[{"scene_id": 0, "im_id": 0, "sensor": "cam7"}]')
    with pytest.raises(ResultError, match=f'the sensor "cam7", which the data set does not have; .*{message}'):
        read_targets(path).in_classic_layout(sensors)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "lists no images"),
        ("{}", "is damaged"),
        ('[{"scene_id": -1, "im_id": 0}]', "is damaged"),
        ('[{"scene_id": 0}]', "im_id"),
        ('[{"scene_id": 0, "im_id": 4}]', "the data set has no image 4 in scene 0"),
    ],
)
def test_lists_that_cannot_be_used_are_refused(truth, tmp_path, text, message):
    path = tmp_path / "list.json"
    path.write_text(text)
    with pytest.raises(ResultError, match=message):
        select_targets(truth, read_targets(path))
