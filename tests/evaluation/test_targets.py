"""BOP target lists: read, written, and the ground truth reduced to them."""

from __future__ import annotations

import json

import numpy as np
import pytest

import synpick_warp
from synpick_warp.errors import ResultError
from synpick_warp.evaluation.targets import Target, count_targets, encode_targets, read_targets, select_targets
from synpick_warp.evaluation.truth import read_truth
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
    assert read_targets(path).targets == (Target(0, 3, 4, 1), Target(1, 2, 5, 2))
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
