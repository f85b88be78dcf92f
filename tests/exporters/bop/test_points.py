"""The format points: its contract, clouds as trimesh reads them, on surfaces and with colours and ids, and views of other sets."""

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.errors import DatasetError
from synpick_warp.exporters.bop.points import POINT, PointsExporter, write_view
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.writing.rle import find_run_boundaries
from synpick_warp.testing.box_views import SIZES, batches, config
from synpick_warp.testing.exporters import LENSES, ExporterContract, digests, export, with_files

PRESENT = 0, 2, 3
"""Slots with an object."""
MATRIX = np.array([[2.0, 0.5, 1.5], [0.0, 4.0, 1.0], [0.0, 0.0, 1.0]])
DEPTH = np.array([[10_000, 10_000, 10_000], [0, 20_000, 20_000]], np.uint16)
"""Of the view of `write_cloud`, in 0.1 mm."""
COLOR = np.arange(18, dtype=np.uint8).reshape(2, 3, 3)


class TestPointsContract(ExporterContract):
    exporter_class, row = PointsExporter, FORMAT_TABLE["points"]


def test_points_lie_on_their_objects_with_the_colours_of_the_view(tmp_path):
    out = export(PointsExporter, tmp_path / "set", config(), (0, 2)) / "points"
    checked = 0
    for batch in batches(1, (0, 2), 3, LENSES):
        scene = int(len(LENSES) * batch.episode[0] + batch.camera[0])
        place = f"train_pbr/{scene:06d}/{int(batch.frame[0]):06d}.ply"
        assert f"./{place}" in (out / f"{scene:06d}.txt").read_text().splitlines()
        cloud = trimesh.load(str(out / place))
        raw = cloud.metadata["_ply_raw"]["vertex"]["data"]
        seen = batch.depth[0] > 0
        assert len(cloud.vertices) == np.count_nonzero(seen)
        assert np.median(np.abs(cloud.colors[:, :3].astype(int) - batch.color[0][seen])) <= 3
        found = np.where(np.isin(batch.instance[0][seen], 1 + np.array(PRESENT)), batch.instance[0][seen].astype(int) - 1, -1)
        np.testing.assert_array_equal(raw["instance_id"], found)
        assert set(raw["object_id"][found < 0]) <= {0}
        for index in set(found[found >= 0].tolist()):
            own = found == index
            assert set(raw["object_id"][own]) == {batch.object_id[0, index]}
            pose = trimesh.transformations.quaternion_matrix(np.roll(batch.pose[0, index, 3:], 1))
            local = (cloud.vertices[own] - batch.pose[0, index, :3]) @ pose[:3, :3]
            outside = np.abs(local) - np.array(SIZES[int(batch.object_id[0, index])]) / 2
            assert np.abs(outside.max(axis=1)).max() < 1e-4
            checked += 1
    assert checked > 20


def test_depth_files_of_the_device_give_the_same_clouds(tmp_path):
    images = export(PointsExporter, tmp_path / "images", config())
    assert digests(export(PointsExporter, tmp_path / "files", config(), prepare=with_files)) == digests(images)


def write_cloud(folder: Path, *, depth: np.ndarray = DEPTH, file: bytes | None = b"", **camera: object) -> tuple[bytes, np.ndarray]:
    """Write the cloud of a view of 2 x 3 pixels, whose first two columns are an instance without an id; returns header and points."""
    given = {"cam_K": MATRIX.ravel().tolist(), "depth_scale": 0.1} | camera
    runs = find_run_boundaries(np.array([[1, 1, 0]] * 2, np.uint8)).runs_of(1)
    view = SimpleNamespace(
        scene=2,
        frame=4,
        camera={name: value for name, value in given.items() if value is not None},
        gt=[{"obj_id": 7}],
        color=(".png", file or cv2.imencode(".png", COLOR)[1].tobytes()),
        depth_image=lambda: depth,
        masks=lambda: [SimpleNamespace(visible=runs)],
    )
    write_view(view, folder, SimpleNamespace(resolution=(3, 2), color=file is not None))
    header, _, data = (folder / "000004.ply").read_bytes().partition(b"end_header\n")
    return header, np.frombuffer(data, POINT)


def test_a_view_of_others_has_points_in_its_cameras_frame_unless_it_has_a_pose(tmp_path):
    """Rays by the inverse of a matrix with skew; ids that are not there are not made up; black without a colour image."""
    header, found = write_cloud(tmp_path)
    pixels = np.array([[0.5, 0.5, 1.0], [1.5, 0.5, 1.0], [2.5, 0.5, 1.0], [1.5, 1.5, 1.0], [2.5, 1.5, 1.0]])
    expected = pixels @ np.linalg.inv(MATRIX).T * [[1.0], [1.0], [1.0], [2.0], [2.0]]
    np.testing.assert_allclose(np.stack([found[axis] for axis in "xyz"], axis=-1), expected, atol=1e-6)
    assert b"comment camera frame, metres" in header
    assert (found["object_id"].tolist(), set(found["instance_id"].tolist())) == ([7, 7, 0, 7, 0], {-1})
    assert np.stack([found[name] for name in ("blue", "green", "red")], axis=-1).tolist() == COLOR[DEPTH > 0].tolist()
    turn = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    header, moved = write_cloud(tmp_path, file=None, cam_R_w2c=turn, cam_t_w2c=[0.0, 0.0, 500.0])
    assert b"comment world frame, metres" in header
    assert not any(moved[name].any() for name in ("red", "green", "blue"))
    np.testing.assert_allclose(moved["x"], found["y"], atol=1e-6)
    np.testing.assert_allclose(moved["y"], -found["x"], atol=1e-6)
    np.testing.assert_allclose(moved["z"], found["z"] - 0.5, atol=1e-6)


def test_a_turned_photograph_keeps_the_pixels_of_its_file(tmp_path):
    """EXIF says that a viewer is to turn it by 180°, depth and masks are as stored."""
    plain = cv2.imencode(".jpg", COLOR, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    orientation = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x03\0\0\0\0\0\0"
    turned = plain[:2] + b"\xff\xe1" + (len(orientation) + 2).to_bytes(2, "big") + orientation + plain[2:]
    assert (
        cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR)[0, 0] != cv2.imdecode(np.frombuffer(plain, np.uint8), 1)[0, 0]
    ).any()
    np.testing.assert_array_equal(write_cloud(tmp_path, file=turned)[1], write_cloud(tmp_path, file=plain)[1])


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"cam_K": None}, "the camera of image 4 of scene 2 has no cam_K, of which points are made"),
        ({"depth_scale": None}, "has no depth_scale"),
        ({"cam_K": [0.0] * 9}, "has a cam_K without focal lengths above 0"),
        ({"cam_R_w2c": [0.0] * 9, "cam_t_w2c": [0.0] * 3}, "has a cam_R_w2c that is no rotation"),
        ({"cam_R_w2c": [1, 0, 0, 0, 1, 0, 0, 0, -1], "cam_t_w2c": [0.0] * 3}, "has a cam_R_w2c that is no rotation"),
        ({"cam_dist": ["much"]}, "the camera of image 4 of scene 2 has a cam_dist"),
        ({"depth": DEPTH[:, :2]}, "the depth of image 4 of scene 2 cannot be decoded, or is not of its camera's size"),
        ({"file": b"not a picture"}, "the colour of image 4 of scene 2 cannot be decoded"),
    ],
)
def test_what_has_no_points_is_one_line(tmp_path, given, said):
    with pytest.raises(DatasetError, match=said):
        write_cloud(tmp_path, **given)
    assert list(tmp_path.iterdir()) == []
