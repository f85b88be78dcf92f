"""Result files, target lists and ground truth: what is read, what is written, and one line with a number for each fault."""

import json
import re
import shutil

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.evaluation import results
from synpick_warp.apps.evaluation.errors import read_models
from synpick_warp.apps.evaluation.results import (
    HEADER,
    ResultFile,
    TargetRow,
    check_results,
    count_targets,
    encode_results,
    encode_targets,
    in_layout,
    make_methods,
    read_results,
    read_targets,
    select_targets,
    write_results,
)
from synpick_warp.apps.evaluation.tracking import filter_poses
from synpick_warp.apps.evaluation.truth import PoseTable, instance_speeds, read_truth
from synpick_warp.errors import CatalogError, DatasetError, ResultError
from synpick_warp.scenes.assets.ply import read_ply_vertices
from tests.builders import refusal
from tests.harness.hostile import fuzz_examples
from tests.worlds.evaluation_set import BOX, BRICK, CAMERAS, FRAMES, MODES, OBJECTS, PERIOD, PRISM, SPEED, VISIBILITY, moved, shapes
from tests.worlds.model_files import ascii_ply, put

SENSORS = ("cam0", "cam1", "cam2")
CAM7 = '[{"scene_id": 0, "im_id": 0, "sensor": "cam7"}]'
GOOD = "0,1,2,0.5,1 0 0 0 1 0 0 0 1,10 20 1900,-1"
OTHER = "0,1,2,0.5,1 0 0 0 1 0 0 0 1,11 20 1900,-1"


def read(tmp_path, text: str | bytes):
    path = tmp_path / "method.csv"
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return read_results(path)


def table(count: int, seed: int) -> PoseTable:
    random = np.random.default_rng(seed)
    keys = np.sort(random.integers(0, 3, (count, 3)) @ (100, 10, 1))
    return PoseTable(
        scene=keys // 100,
        image=keys // 10 % 10,
        object_id=keys % 10,
        rotation=Rotation.random(count, rng=random).as_matrix().reshape(-1, 3, 3),
        translation=random.uniform(-2.0, 2.0, (count, 3)),
        score=random.uniform(0.0, 1.0, count),
        seconds=np.where(random.random(count) < 0.3, -1.0, random.uniform(0.0, 9.0, count)),
        instance=np.full(count, -1),
    )


def assert_equal(ours: PoseTable, theirs: PoseTable) -> None:
    for name, column in vars(ours).items():
        np.testing.assert_allclose(column, getattr(theirs, name), rtol=1e-14, atol=1e-14, err_msg=name)


@pytest.mark.parametrize("header", [HEADER + "\n", "", "\ufeff" + HEADER + "\r\n"])
def test_the_header_is_optional(tmp_path, header):
    file = read(tmp_path, header + GOOD.replace(",-1", ",0.25") + "\r\n" + OTHER + "\n\n")
    poses, first = file.poses, 1 + bool(header)
    assert file.lines.tolist() == [first, first + 1]
    assert (poses.scene[0], poses.image[0], poses.object_id[0], poses.score[0]) == (0, 1, 2, 0.5)
    assert poses.translation[0] == pytest.approx([0.01, 0.02, 1.9])
    assert poses.seconds.tolist() == [0.25, -1.0]
    assert poses.instance.tolist() == [-1, -1]


def test_rows_are_sorted_and_equal_ones_keep_their_order(tmp_path):
    rows = [GOOD.replace("0,1,2,0.5", f"{key},{score}") for key, score in (("1,0,1", 0.1), ("0,0,2", 0.2), ("0,0,1", 0.3))]
    rows.append(rows[0].replace("0.1", "0.4").replace("10 20", "11 20"))
    file = read(tmp_path, "\n".join(rows))
    assert file.poses.score.tolist() == [0.3, 0.2, 0.1, 0.4]
    assert file.lines.tolist() == [3, 2, 1, 4]


@given(count=st.integers(1, 30), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=fuzz_examples(60))
def test_what_is_written_is_read(tmp_path_factory, count, seed):
    path = tmp_path_factory.getbasetemp() / "written.csv"
    poses = table(count, seed)
    write_results(path, poses)
    assert_equal(read_results(path).poses, poses)


def test_blocks_of_lines_make_no_difference(tmp_path, monkeypatch):
    poses = table(50, 1)
    monkeypatch.setattr(results, "_BLOCK", 7)
    assert_equal(read(tmp_path, encode_results(poses)).poses, poses)
    lines = encode_results(poses).split(b"\n")
    lines[39] = lines[39].rpartition(b" ")[0] + b" 1-1,-1"
    with pytest.raises(ResultError, match='line 40: t has "1-1", which is no number'):
        read(tmp_path, b"\n".join(lines))


FAULTS = [
    ("", r"method\.csv has no pose estimates; each line is scene_id,im_id,obj_id,score,R,t,time, with 9"),
    ("\n \n", "has no pose estimates"),
    (HEADER, "has no pose estimates"),
    (f"{GOOD}\n\n{OTHER}", "line 2 is empty; each line is"),
    (f"{GOOD}\n{OTHER},7", "line 2 has 8 columns; allowed: 7 separated by commas"),
    (f"{HEADER}\n{GOOD[2:]}", "line 2 has 6 columns; allowed: 7"),
    ("scene;im;obj\n" + GOOD, "line 1 has 1 columns; allowed: 7"),
    (GOOD.replace("0 0 0 1,", "0 0 1,"), "line 1 has 8 numbers in R; allowed: 9"),
    (GOOD.replace("20 1900", "1900"), "line 1 has 2 numbers in t; allowed: 3"),
    (GOOD.replace("10 20", "ten 20"), 'line 1: t has "ten", which is no number'),
    (GOOD.replace("10 20", "1_0 20"), "line 1 has a character that is not part of a number"),
    (GOOD.replace("0,1,2", "0,1,2.5"), 'line 1: obj_id is "2.5"; allowed: a whole number from 0 to 2147483647'),
    (GOOD.replace("0,1,2", "0,,2"), 'line 1: im_id is ""; allowed: a whole number'),
    (GOOD.replace("0,1,2", "0,1," + "9" * 5000), "line 1: obj_id is .*; allowed: a whole number"),
    (GOOD.replace("0,1,2", "-1,1,2"), "line 1: scene_id is -1; allowed: 0 to 2147483647"),
    (GOOD.replace("0,1,2", "0,9999999999,2"), "line 1: im_id is 9999999999; allowed: 0 to 2147483647"),
    (GOOD.replace("0.5", ""), 'line 1: score has "", which is no number'),
    (GOOD.replace("0.5", "0.5 1"), 'line 1: score is "0.5 1"; allowed: one number'),
    (f"{GOOD.replace('0.5', '')}\n{GOOD.replace('0.5', '0.5 1')}", 'line 1: score has ""'),
    (f"{GOOD}\n{GOOD.replace('10 20', 'nan 20')}", "line 2: t is not finite; leave out rows without a pose"),
    (GOOD.replace("0.5", "inf"), "line 1: score is not finite"),
    (GOOD.replace("1 0 0 0 1", "nan 0 0 0 1"), "line 1: R is not finite"),
    (GOOD.replace("10 20", "1e300 20"), r"line 1: t has a number above 1e\+09"),
    (GOOD.replace("1 0 0 0 1", "1.01 0 0 0 1"), "line 1: R is no rotation: R Rᵀ differs from 1 by 0.02; allowed: 0.001"),
    (GOOD.replace("1 0 0 0 1 0 0 0 1", "0 0 0 0 0 0 0 0 0"), "line 1: R is no rotation"),
    (GOOD.replace("1 0 0 0 1", "-1 0 0 0 1"), "line 1: R is a reflection"),
    (f"{HEADER}\n{GOOD}\n{OTHER}\n{GOOD}", "line 4 has the object and the pose of line 2; keep one of them"),
    (f"{GOOD}\n{GOOD.replace('0.5', '0.6').replace('1 0 0 0', '1 -0 0 0')}", "line 2 has the object and the pose of line 1"),
    (b"\xff\xfe" + GOOD.encode("utf-16-le"), "line 1"),
]


@pytest.mark.parametrize(("text", "message"), FAULTS, ids=range(len(FAULTS)))
def test_faults_of_a_file_are_one_line(tmp_path, text, message):
    said = refusal(read, tmp_path, text)
    assert re.search(message, said)
    assert len(said) < 400 + len(str(tmp_path))


@given(data=st.binary(max_size=200) | st.text("0123456789+-.,einfa \n", max_size=200).map(str.encode), where=st.integers(0, 300))
@settings(max_examples=fuzz_examples(200))
def test_any_bytes_are_read_or_refused(tmp_path_factory, data, where):
    path = tmp_path_factory.getbasetemp() / "fuzz.csv"
    good = f"{HEADER}\n{GOOD}\n{OTHER}\n".encode()
    for content in (data, good[:where] + data + good[where:], good[:where] + data + good[where + len(data) :]):
        path.write_bytes(content)
        fault, poses = "", None
        try:
            poses = read_results(path).poses
        except ResultError as error:
            fault = str(error)
        assert "\n" not in fault
        if poses is not None:
            assert np.isfinite(poses.translation).all()
            assert np.abs(poses.rotation @ poses.rotation.transpose(0, 2, 1) - np.eye(3)).max() < 2e-3


def check(tmp_path, truth, poses: PoseTable) -> None:
    write_results(tmp_path / "method.csv", poses)
    check_results(read_results(tmp_path / "method.csv"), truth, {1, 2, 3})


def test_poses_of_the_data_set_pass(tmp_path, truth):
    for poses in (truth.poses, moved(truth.poses, (0.0, 0.0, -1.0))):
        check(tmp_path, truth, poses)


def test_missing_files_and_folders_are_refused(tmp_path):
    one = table(1, 0)
    for call, path, said in (
        (read_results, tmp_path / "none.csv", "there is no file"),
        (read_results, tmp_path, "is not a regular file"),
        (lambda path: write_results(path, one), tmp_path, "is a folder; name a file"),
        (lambda path: write_results(path, one), tmp_path / "none" / "a.csv", "cannot write"),
    ):
        assert said in refusal(call, path)


METRES = r"line 2: t seems to be in metres; BOP result files have millimetres: multiply t by 1000 \(median distance .* 1\.9.* mm, "
TOO_LARGE = "line 2: t seems to be 1000 times too large; BOP result files have millimetres: divide t by 1000"


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("scene", 6, r"line 9: the data set has no scene 6; its scenes: 0, 1, 2, 3, 4, 5$"),
        ("object_id", 9, r"line 9: the data set has no object 9; its objects: 1, 2, 3$"),
        ("image", 4, r"line 9: scene 0 has no image 4; its images are 0 to 3$"),
        ("translation", 1e-3, METRES),
        ("translation", 1e3, TOO_LARGE),
    ],
)
def test_unknown_scenes_objects_and_images_and_wrong_units_are_named(tmp_path, truth, column, value, message):
    values = getattr(truth.poses, column).copy()
    if column == "translation":
        values *= value
    else:
        values[7] = value
    with pytest.raises(ResultError, match=message):
        check(tmp_path, truth, PoseTable(**(vars(truth.poses) | {column: values})))


# ---- target lists ----


def listed(tmp_path, content):
    """Target list of a file."""
    return read_targets(put(tmp_path / "list.json", content if isinstance(content, (str, bytes)) else json.dumps(content)))


def test_lists_are_read_as_they_were_written(tmp_path):
    targets = count_targets([(1, 2, 5), (0, 3, 4), (1, 2, 5)])
    assert json.loads(encode_targets(targets)) == [
        {"scene_id": 0, "im_id": 3, "obj_id": 4, "inst_count": 1},
        {"scene_id": 1, "im_id": 2, "obj_id": 5, "inst_count": 2},
    ]
    found = listed(tmp_path, encode_targets(targets))
    assert found.targets == (TargetRow(0, 3, 4, 1), TargetRow(1, 2, 5, 2))
    assert found.objects == {(0, 3): frozenset({4}), (1, 2): frozenset({5})}
    # Lists of several sensors.
    classic = count_targets([(1, 2, 5), (3, 3, 4), (1, 2, 5)])
    written = encode_targets(in_layout(classic, SENSORS))
    assert json.loads(written)[0] == {"scene_id": 0, "im_id": 2, "obj_id": 5, "inst_count": 2, "sensor": "cam1"}
    assert sorted(listed(tmp_path, written).in_classic_layout(SENSORS).targets) == sorted(classic)
    assert in_layout(classic, ()) == classic


def test_the_truth_is_reduced_to_images_and_objects(truth, tmp_path):
    rows = [{"im_id": 1, "scene_id": 4}, {"im_id": 2, "scene_id": 0, "obj_id": BOX}, {"im_id": 1, "scene_id": 4, "obj_id": 9}]
    part = select_targets(truth, listed(tmp_path, rows))
    assert part.images.tolist() == [[0, 2], [4, 1]]
    keys = list(zip(part.poses.scene.tolist(), part.poses.image.tolist(), part.poses.object_id.tolist(), strict=True))
    assert keys == [(0, 2, BOX), (4, 1, BRICK), (4, 1, BRICK), (4, 1, 2), (4, 1, 3)]
    rows = (truth.poses.scene == 4) & (truth.poses.image == 1)
    for name in ("visibility", "speed", "mode", "episode", "camera"):
        np.testing.assert_array_equal(getattr(part, name)[1:], getattr(truth, name)[rows])


@pytest.mark.parametrize(
    ("entry", "images"),
    [
        ({"scene_id": 2, "im_id": 5}, [(6, 5)]),
        ({"scene_id": 2, "im_id": 5, "sensor": "cam2"}, [(8, 5)]),
        ({"scene_id": 1, "im_id": [["cam0", 4], ["cam1", 4]]}, [(3, 4), (4, 4)]),
    ],
)
def test_lists_of_several_sensors_name_images_of_the_first_one_or_their_own(tmp_path, entry, images):
    assert sorted(listed(tmp_path, [entry]).in_classic_layout(SENSORS).objects) == images


@pytest.mark.parametrize(
    ("text", "sensors", "message"),
    [
        ("[]", (), "lists no images"),
        ("{}", (), "is damaged"),
        ('[{"scene_id": -1, "im_id": 0}]', (), "is damaged"),
        ('[{"scene_id": 0}]', (), "im_id"),
        ('[{"scene_id": 0, "im_id": 4}]', (), "the data set has no image 4 in scene 0"),
        (CAM7, (), 'the sensor "cam7", which the data set does not have; .*a scene for each'),
        (CAM7, SENSORS, 'the sensor "cam7", which the data set does not have; .*cam0, cam1, cam2'),
    ],
)
def test_lists_that_cannot_be_used_are_refused(truth, tmp_path, text, sensors, message):
    with pytest.raises(ResultError, match=message):
        select_targets(truth, listed(tmp_path, text).in_classic_layout(sensors))


# ---- ground truth as a pose table: columns, speeds, order; models and symmetries ----


def test_truth_has_a_row_per_instance_image_and_camera(folder, truth):
    data = synpick_warp.open(folder)
    assert len(truth) == len(truth.poses) == len(MODES) * CAMERAS * FRAMES * len(OBJECTS)
    assert truth.images.tolist() == [[scene, image] for scene in range(len(MODES) * CAMERAS) for image in range(FRAMES)]
    keys = np.stack((truth.poses.scene, truth.poses.image, truth.poses.object_id))
    assert (np.lexsort(keys[::-1]) == np.arange(len(truth))).all()
    for row in (0, 17, len(truth) - 1):
        instance, scene = truth.poses.instance[row], truth.poses.scene[row]
        view = data[scene // CAMERAS].view(int(truth.poses.image[row]), int(scene % CAMERAS))
        np.testing.assert_array_equal(truth.poses.rotation[row], view.object_to_camera[instance, :3, :3])
        np.testing.assert_allclose(truth.poses.translation[row], view.object_to_camera[instance, :3, 3])
        assert truth.poses.object_id[row] == OBJECTS[instance]
        assert truth.visibility[row] == VISIBILITY[instance]
        assert truth.speed[row] == pytest.approx(SPEED[instance], abs=1e-9)
        assert (truth.episode[row], truth.camera[row], truth.mode[row]) == (scene // CAMERAS, scene % CAMERAS, MODES[scene // CAMERAS])
    assert set(truth.poses.score) == {1.0}


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(0, 25))
@settings(max_examples=fuzz_examples(100))
def test_speeds_are_those_of_each_row(seed, count):
    random = np.random.default_rng(seed)
    keys = random.permutation(60)[:count]
    scene, instance, image = keys // 30, keys // 10 % 3, keys % 10
    places = random.normal(size=(count, 3))
    turns, one = np.zeros((count, 3, 3)), np.ones(count)
    speed = instance_speeds(PoseTable(scene, image, instance, turns, places, one, one, instance), PERIOD)
    rows = {tuple(key): row for row, key in enumerate(np.stack((scene, instance, image), axis=1).tolist())}
    for (a, b, frame), row in rows.items():
        other = rows.get((a, b, frame - 1), rows.get((a, b, frame + 1)))
        expected = np.nan if other is None else np.linalg.norm(places[row] - places[other]) / PERIOD
        assert speed[row] == pytest.approx(expected, nan_ok=True)


def test_models_are_in_metres_with_the_symmetries_of_the_set(folder):
    models = read_models(folder, OBJECTS)
    np.testing.assert_allclose(models[BRICK].vertices, 1e-3 * shapes()[BRICK].vertices, atol=1e-7)
    assert [models[key].symmetric for key in (BRICK, BOX, PRISM)] == [False, True, True]
    assert [len(models[key].symmetries) for key in (BRICK, BOX, PRISM)] == [1, 2, 315]
    thinned = read_models(folder, [PRISM], vertices=10)[PRISM].vertices
    assert len(thinned) == 10
    assert {tuple(row) for row in thinned} <= {tuple(row) for row in models[PRISM].vertices}
    assert len(read_models(folder, [BOX], vertices=10**6)[BOX].vertices) == len(models[BOX].vertices)


def test_sets_that_cannot_be_evaluated_on_are_named(folder, tmp_path):
    broken = tmp_path / "set"
    shutil.copytree(folder, broken)
    (broken / "models" / "obj_000002.ply").unlink()
    with pytest.raises(DatasetError, match=r"has no models/obj_000002\.ply, the model of an object in its ground truth"):
        read_models(broken, OBJECTS)
    (broken / "models" / "models_info.json").write_text(json.dumps({"1": {"diameter": 1.0}}))
    with pytest.raises(CatalogError, match="no entry for object 2"):
        read_models(broken, OBJECTS)
    (broken / "models" / "models_info.json").unlink()
    with pytest.raises(DatasetError, match=r"has no models/models_info\.json, .*; bake with --formats bop or shards"):
        read_models(broken, OBJECTS)
    entry = broken / "manifest" / "000000.json"
    entry.write_text(entry.read_text().replace('"mode"', '"mood"'))
    with pytest.raises(DatasetError, match="episode 0 has no mode"):
        read_truth(synpick_warp.open(broken))
    for path in (broken / "manifest").iterdir():
        path.unlink()
    with pytest.raises(DatasetError, match="has no episode to evaluate on"):
        read_truth(synpick_warp.open(broken))


def test_estimates_of_a_camera_that_moves_are_filtered_in_the_world(folder, truth, tmp_path):
    """A camera turns over a pile at rest: exact estimates stay exact, and nothing has a speed that has none in the world."""
    out = shutil.copytree(folder, tmp_path / "set")
    scene = sorted((out / "train_pbr").iterdir())[0]
    cameras, poses = (json.loads((scene / f"scene_{name}.json").read_text()) for name in ("camera", "gt"))
    for frame, camera in cameras.items():
        turn = Rotation.from_euler("xyz", [10 * int(frame), 0, 25 * int(frame)], degrees=True).as_matrix()
        shift = np.array([40.0, -30.0, 15.0]) * int(frame)
        camera |= {"cam_R_w2c": turn.ravel().tolist(), "cam_t_w2c": shift.tolist()}
        for row in poses[frame]:
            row["cam_t_m2c"] = (turn @ row["cam_t_m2c"] + shift).tolist()
            row["cam_R_m2c"] = (turn @ np.reshape(row["cam_R_m2c"], (3, 3))).ravel().tolist()
    for name, content in (("camera", cameras), ("gt", poses)):
        (scene / f"scene_{name}.json").write_text(json.dumps(content))
    before, truth = truth, read_truth(synpick_warp.open(out))
    assert (truth.motion.scene.tolist(), truth.motion.image.tolist()) == ([0] * FRAMES, list(range(FRAMES)))
    np.testing.assert_allclose(truth.speed, before.speed, atol=1e-9)
    world, back = truth.motion.to_world(truth.poses), truth.motion.to_camera(truth.motion.to_world(truth.poses))
    for name in ("rotation", "translation"):
        np.testing.assert_allclose(getattr(world, name), getattr(before.poses, name), atol=1e-12)
        np.testing.assert_allclose(getattr(back, name), getattr(truth.poses, name), atol=1e-12)
    (method,) = make_methods([tmp_path / "a.csv"], [ResultFile(tmp_path / "a.csv", truth.poses, np.arange(len(truth)))], 0.2, truth.motion)
    resting = np.array(SPEED)[truth.poses.instance] == 0.0
    np.testing.assert_allclose(method.filtered.translation[resting], truth.poses.translation[resting], atol=1e-9)
    assert np.abs(filter_poses(truth.poses, 0.2).translation - truth.poses.translation)[resting].max() > 0.05


@pytest.mark.parametrize("body", ["nan 0 0", "1e400 0 0", ""])
def test_vertices_that_are_no_points_are_refused(tmp_path, body):
    rows = [body.split()] if body else []
    with pytest.raises(CatalogError, match=r"not a finite number|no vertices|not readable"):
        read_ply_vertices(put(tmp_path / "a.ply", ascii_ply(rows, [])))
