"""BOP result files: what is read, what is written, and one line with a number for each fault."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import synpick_warp
from synpick_warp.apps.evaluation import results
from synpick_warp.apps.evaluation.poses import PoseTable
from synpick_warp.apps.evaluation.results import HEADER, check_results, encode_results, read_results, write_results
from synpick_warp.apps.evaluation.truth import read_truth
from synpick_warp.errors import OutputError, ResultError
from tests.harness.fuzz import fuzz_examples
from tests.worlds.evaluation_set import moved, write_evaluation_set

GOOD = "0,1,2,0.5,1 0 0 0 1 0 0 0 1,10 20 1900,-1"
OTHER = "0,1,2,0.5,1 0 0 0 1 0 0 0 1,11 20 1900,-1"


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    return read_truth(synpick_warp.open(write_evaluation_set(tmp_path_factory.mktemp("results") / "set")))


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
    with pytest.raises(ResultError, match=message) as caught:
        read(tmp_path, text)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400 + len(str(tmp_path))


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


def test_missing_files_and_folders_are_refused(tmp_path):
    with pytest.raises(ResultError, match="there is no file"):
        read_results(tmp_path / "none.csv")
    with pytest.raises(ResultError, match="is not a regular file"):
        read_results(tmp_path)
    with pytest.raises(OutputError, match="is a folder; name a file"):
        write_results(tmp_path, table(1, 0))
    with pytest.raises(OutputError, match="cannot write"):
        write_results(tmp_path / "none" / "a.csv", table(1, 0))


def check(tmp_path, truth, poses: PoseTable) -> None:
    write_results(tmp_path / "method.csv", poses)
    check_results(read_results(tmp_path / "method.csv"), truth, {1, 2, 3})


def test_poses_of_the_data_set_pass(tmp_path, truth):
    check(tmp_path, truth, truth.poses)
    check(tmp_path, truth, moved(truth.poses, (0.0, 0.0, -1.0)))


@pytest.mark.parametrize(
    ("column", "value", "message"),
    [
        ("scene", 6, r"line 9: the data set has no scene 6; its scenes: 0, 1, 2, 3, 4, 5$"),
        ("object_id", 9, r"line 9: the data set has no object 9; its objects: 1, 2, 3$"),
        ("image", 4, r"line 9: scene 0 has no image 4; its images are 0 to 3$"),
    ],
)
def test_unknown_scenes_objects_and_images_are_named(tmp_path, truth, column, value, message):
    values = getattr(truth.poses, column).copy()
    values[7] = value
    with pytest.raises(ResultError, match=message):
        check(tmp_path, truth, PoseTable(**(vars(truth.poses) | {column: values})))


@pytest.mark.parametrize(
    ("factor", "message"),
    [
        (1e-3, r"line 2: t seems to be in metres; BOP result files have millimetres: multiply t by 1000 \(median distance .* 1\.9.* mm, "),
        (1e3, "line 2: t seems to be 1000 times too large; BOP result files have millimetres: divide t by 1000"),
    ],
)
def test_wrong_units_are_recognised(tmp_path, truth, factor, message):
    poses = PoseTable(**(vars(truth.poses) | {"translation": factor * truth.poses.translation}))
    with pytest.raises(ResultError, match=message):
        check(tmp_path, truth, poses)
