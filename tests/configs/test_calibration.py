"""Calibration files as other programs write them: equal intrinsics from each, and one line for what is wrong in one."""

from __future__ import annotations

import contextlib
import io
import json
import os

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from synpick_warp.configs.calibration.files import FISHEYE, PINHOLE, Calibration, read_calibration
from synpick_warp.configs.calibration.sensor_presets import SENSORS, sensor_camera
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.cameras import make_cameras

FIVE = (-0.12, 0.08, 5e-4, -3e-4, 0.01)
EIGHT = (*FIVE, 0.02, -0.01, 0.03)
MATRIX = "275.0, 0.0, 163.3, 0.0, 274.6, 117.0, 0.0, 0.0, 1.0"
SIZED = Calibration(320, 240, 275.0, 274.6, 163.8, 117.5)
"""The camera of all files: at integers its principal point is 163.3, 117.0."""


def with_lens(distortion, model=PINHOLE, size=(320, 240)):
    return Calibration(*size, 275.0, 274.6, 163.8, 117.5, model, tuple(distortion))


def yaml_matrix(name, rows, numbers):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {len(numbers.split(',')) // rows}\n   dt: d\n   data: [ {numbers} ]\n"


def numbers(values):
    return ", ".join(map(str, values))


OPENCV = (
    '%YAML:1.0\n---\ncalibration_time: "Thu Nov 26 2026"\nimage_width: 320\nimage_height: 240\nboard_width: 9\n'
    "flags: 0\n"
    + yaml_matrix("camera_matrix", 3, "2.7500000000000000e+02, 0., 1.6330000000000001e+02, 0.,\n       2.746e+02, 117., 0., 0., 1.")
)
XML = (
    '<?xml version="1.0"?>\n<opencv_storage>\n<!-- sample --><image_Width>320</image_Width><image_Height>240</image_Height>\n'
    '<Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols><dt>d</dt><data>\n  275. 0. 163.3 0. 274.6 117. 0. 0. 1.</data>'
    "</Camera_Matrix>\n"
    '<Distortion_Coefficients type_id="opencv-matrix"><rows>5</rows><cols>1</cols><dt>d</dt><data>-1.2e-01 8e-02 5e-04 -3e-04 1e-02</data>'
    "</Distortion_Coefficients></opencv_storage>\n"
)
ROS = (
    "image_width: 320\nimage_height: 240\ncamera_name: left\ncamera_matrix:\n  rows: 3\n  cols: 3\n"
    f"  data: [{MATRIX}]\ndistortion_model: MODEL\ndistortion_coefficients:\n  rows: 1\n  cols: COUNT\n  data: [VALUES]\n"
    "rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n"
    "projection_matrix:\n  rows: 3\n  cols: 4\n  data: [250, 0, 160, 0, 0, 250, 120, 0, 0, 0, 1, 0]\n"
)
MESSAGE = (
    "header:\n  seq: 1\n  frame_id: left\nheight: 240\nwidth: 320\ndistortion_model: plumb_bob\n"
    "D:\n- -0.12\n- 0.08\n- 0.0005\n- -0.0003\n- 0.01\n"
    f"K: [{MATRIX}]\nR: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nbinning_x: 0\nbinning_y: 0\n"
    "roi:\n  x_offset: 0\n  height: 0\n  width: 0\n  do_rectify: false\n---\n"
)
ZIVID = (
    "__version__:\n  serializer: 1\n  data: 2\nCameraIntrinsics:\n"
    "  CameraMatrix:\n    CX: 163.3\n    CY: 117.0\n    FX: 275.0\n    FY: 274.6\n"
    "  Distortion:\n    K1: -0.12\n    K2: 0.08\n    K3: 0.01\n    P1: 0.0005\n    P2: -0.0003\n"
)


def ros(model, values):
    return ROS.replace("MODEL", model).replace("COUNT", str(len(values))).replace("VALUES", numbers(values))


def realsense(model="distortion.brown_conrady", coeffs=FIVE, **more):
    values = {"width": 320, "height": 240, "ppx": 163.3, "ppy": 117.0, "fx": 275.0, "fy": 274.6, "model": model, "coeffs": coeffs}
    return json.dumps(values | more, default=list)


def opencv(coefficients, more=""):
    return OPENCV + yaml_matrix("distortion_coefficients", len(coefficients), numbers(coefficients)) + more


def array(values):
    np.save(file := io.BytesIO(), values)
    return file.getvalue()


def archive(**arrays):
    np.savez(file := io.BytesIO(), **arrays)
    return file.getvalue()


def nerfstudio(**more):
    return json.dumps({"w": 320, "h": 240, "fl_x": 275.0, "fl_y": 274.6, "cx": 163.8, "cy": 117.5, "frames": [{"file_path": "a"}]} | more)


K = np.array([[275, 0, 163.3], [0, 274.6, 117], [0, 0, 1]])
FILES = {
    "OpenCV, 5": (opencv(FIVE), with_lens(FIVE)),
    "OpenCV, 8, of Python": (
        f'{{"K": [[275, 0, 163.3], [0, 274.6, 117], [0, 0, 1]], "dist": [{list(EIGHT)}]}}',
        with_lens(EIGHT, size=(0, 0)),
    ),
    "OpenCV, 12": (opencv((*EIGHT, 0.1, 0.0, 0.0, 0.2)), with_lens((*EIGHT, 0.1, 0.0, 0.0, 0.2))),
    "OpenCV, 14 without tilt": (opencv((*EIGHT, 0.1, 0.0, 0.0, 0.2, 0, 0)), with_lens((*EIGHT, 0.1, 0.0, 0.0, 0.2))),
    "OpenCV, zeros": (opencv((0,) * 5), SIZED),
    "OpenCV, no distortion": (OPENCV, SIZED),
    "OpenCV, fisheye": (opencv(FIVE[:4], "fisheye_model: 1\n"), with_lens(FIVE[:4], FISHEYE)),
    "OpenCV, 4 and a flag": (opencv(FIVE[:4], "fisheye_model: 0\n"), with_lens(FIVE[:4])),
    "OpenCV, XML": (XML, with_lens(FIVE)),
    "with byte order mark and Windows lines": ("\ufeff" + opencv(FIVE).replace("\n", "\r\n"), with_lens(FIVE)),
    "ROS, plumb_bob": (ros("plumb_bob", FIVE), with_lens(FIVE)),
    "ROS, rational": (ros("rational_polynomial", EIGHT), with_lens(EIGHT)),
    "ROS, equidistant": (ros("equidistant", FIVE[:4]), with_lens(FIVE[:4], FISHEYE)),
    "ROS, zeros": (ros("plumb_bob", (0,) * 5), SIZED),
    "ROS, message": (MESSAGE, with_lens(FIVE)),
    "BOP": ('{"cx": 163.8, "cy": 117.5, "depth_scale": 0.1, "fx": 275.0, "fy": 274.6, "height": 240, "width": 320}', SIZED),
    "RealSense": (realsense(), with_lens(FIVE)),
    "RealSense, by number": (realsense(4), with_lens(FIVE)),
    "RealSense, inverse, zeros": (realsense("distortion.inverse_brown_conrady", (0.0,) * 5), SIZED),
    "RealSense, modified, radial": (realsense("Modified Brown Conrady", (-0.1, 0.08, 0, 0, 0.01)), with_lens((-0.1, 0.08, 0.0, 0.0, 0.01))),
    "RealSense, fisheye": (realsense("distortion.kannala_brandt4", (*FIVE[:4], 0)), with_lens(FIVE[:4], FISHEYE)),
    "cam_K.txt": ("275.0 0.0 163.3\n0.0 274.6 117.0\n0.0 0.0 1.0\n", with_lens((), size=(0, 0))),
    "cam_K.txt with commas": ("275,0,163.3\r\n0,274.6,117\r\n0,0,1e0\r\n", with_lens((), size=(0, 0))),
    "a list": ("[[2.75e2, 0, 163.3], [0, 274.6, 117], [0, 0, 1]]", with_lens((), size=(0, 0))),
    "NumPy, .npz": (
        archive(mtx=K, dist=np.array([FIVE]), rvecs=np.ones((900, 3, 1)), odd=np.array([K, 1], object)),
        with_lens(FIVE, size=(0, 0)),
    ),
    "NumPy, .npy": (array(K), with_lens((), size=(0, 0))),
    "ROS, .ini": (
        "# left\n\n[image]\n\nwidth\n320\n\nheight\n240\n\n[left]\n\ncamera matrix\n275.0 0.0 163.3\n0.0 274.6 117.0\n0.0 0.0 1.0\n\n"
        f"distortion\n{' '.join(map(str, FIVE))}\n\nprojection\n250 0 160 0\n0 250 120 0\n0 0 1 0\n",
        with_lens(FIVE),
    ),
    "ROS, rational with 5 columns": (ros("rational_polynomial", EIGHT).replace("cols: 8", "cols: 5"), with_lens(EIGHT)),
    "Kalibr": (
        "cam0:\n  camera_model: pinhole\n  distortion_coeffs: [-0.12, 0.08, 0.0005, -0.0003]\n  distortion_model: radtan\n"
        "  intrinsics: [275, 274.6, 163.3, 117]\n  resolution: [320, 240]\n",
        with_lens(FIVE[:4]),
    ),
    "COLMAP": (
        "# Camera list\n# CAMERA_ID, MODEL\n\n1 OPENCV 320 240 275 274.6 163.8 117.5 -0.12 0.08 5e-4 -3e-4\n",
        with_lens((*FIVE[:4], 0.0)),
    ),
    "COLMAP, fisheye": ("1 OPENCV_FISHEYE 320 240 275 274.6 163.8 117.5 -0.12 0.08 5e-4 -3e-4\n", with_lens(FIVE[:4], FISHEYE)),
    "COLMAP, two alike": ("1 PINHOLE 320 240 275 274.6 163.8 117.5\n2 PINHOLE 320 240 275 274.6 163.8 117.5\n", SIZED),
    "nerfstudio": (nerfstudio(k1=-0.12, k2=0.08, p1=5e-4, p2=-3e-4, k3=0.01), with_lens(FIVE)),
    "nerfstudio, fisheye": (
        nerfstudio(camera_model="OPENCV_FISHEYE", **dict(zip(("k1", "k2", "k3", "k4"), FIVE, strict=False))),
        with_lens(FIVE[:4], FISHEYE),
    ),
    "nerfstudio, equal frames": (json.dumps({"camera_angle_x": 1.0, "frames": [json.loads(nerfstudio())] * 2}), SIZED),
    "BOP, scene_camera": (
        json.dumps({key: {"cam_K": [275, 0, 163.8, 0, 274.6, 117.5, 0, 0, 1], "depth_scale": 0.1} for key in "03"}),
        with_lens((), size=(0, 0)),
    ),
    "Open3D": ('{"width": 320, "height": 240, "intrinsic_matrix": [275, 0, 0, 0, 274.6, 0, 163.3, 117, 1]}', SIZED),
    "names of one's own": (
        '{"Camera Matrix": [275, 0, 163.3, 0, 274.6, 117, 0, 0, 1], "distCoef": [-0.12, 0.08, 5e-4, -3e-4, 0.01], "W": 320, "H": 240}',
        with_lens(FIVE),
    ),
    "names of each": (
        '{"fx": 275, "fy": 274.6, "cx": 163.3, "cy": 117, "k1": -0.12, "k2": 0.08, "p1": 5e-4, "p2": -3e-4, "k3": 0.01}',
        with_lens(FIVE, size=(0, 0)),
    ),
    "Zivid": (ZIVID, with_lens(FIVE, size=(0, 0))),
}


def saved(folder, text):
    path = folder / "camera.file"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize("name", FILES)
def test_files_of_all_programs_give_the_same_camera(name, tmp_path):
    text, expected = FILES[name]
    assert read_calibration(saved(tmp_path, text)) == expected


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
def test_what_opencv_writes_is_read(suffix, tmp_path):
    path = str(tmp_path / f"camera{suffix}")
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 320), ("image_height", 240)):
        storage.write(name, value)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", np.array([FIVE]))
    storage.release()
    assert read_calibration(tmp_path / f"camera{suffix}") == with_lens(FIVE)


def test_the_callers_words_hold_where_the_file_says_nothing(tmp_path):
    path = saved(tmp_path, opencv(FIVE[:4]))
    assert read_calibration(path, model=FISHEYE) == with_lens(FIVE[:4], FISHEYE)
    assert read_calibration(path, model=PINHOLE, pixel_center=0.5).cx == 163.3
    assert read_calibration(saved(tmp_path, FILES["BOP"][0]), pixel_center=0.0).cy == 118.0


REFUSED = {
    "nothing": ("", "no calibration file"),
    "a list": ("- 1\n- 2\n", "no calibration file"),
    "another file": ('{"object_rows": 3}', 'no intrinsics of a known format, but "object_rows"; known: Zivid, RealSense, COLMAP'),
    "stereo": (yaml_matrix("M1", 3, MATRIX), "no intrinsics of a known format"),
    "four coefficients": (opencv(FIVE[:4]), 'may be of both models; set model = "pinhole" or "fisheye"'),
    "three coefficients": (opencv(FIVE[:3]), "it has 3 coefficients of distortion; allowed: 4 or 5 or 8 or 12"),
    "six coefficients": (opencv(EIGHT[:6]), "it has 6 coefficients"),
    "a tilted sensor": (opencv((*EIGHT, 0, 0, 0, 0, 0.1, 0)), "sensor is tilted"),
    "a skewed matrix": (OPENCV.replace("2.7500000000000000e+02, 0.,", "275, 0.5,"), "has skew"),
    "a transposed matrix": (ros("plumb_bob", FIVE).replace(MATRIX, "275, 0, 0, 0, 274.6, 0, 163.3, 117, 1"), "column by column"),
    "no focal length": (realsense(fx=0.0), "focal lengths are 0 and 274.6; allowed: above 0"),
    "a negative size": (realsense(width=-1), "-1 x 240 pixels"),
    "half a pixel": (realsense(width=320.5), "whole numbers"),
    "a matrix of two rows": (OPENCV.replace("rows: 3", "rows: 2"), "has 9 numbers for 2 x 3"),
    "a word in a matrix": (OPENCV.replace("117.", "seven"), 'camera matrix is "seven"; allowed: a finite number'),
    "not a number": (opencv((".nan", *FIVE[1:])), "allowed: a finite number"),
    "infinite": (realsense(ppx=1e308 * 10).replace("Infinity", "1e999"), "damaged|finite"),
    "a missing number": ('{"cx": 1, "cy": 1, "fx": 1, "fy": null}', "fy is missing"),
    "a binned image": (MESSAGE.replace("binning_x: 0", "binning_x: 2"), "binning_x is 2"),
    "a part of the image": (MESSAGE.replace("  width: 0", "  width: 100").replace("  height: 0", "  height: 50"), "100 x 50 of 320 x 240"),
    "an uncalibrated camera": (MESSAGE.replace(MATRIX, numbers([0] * 9)), "not calibrated"),
    "an unknown model of ROS": (ros("thin_prism_fisheye", EIGHT), 'distortion model is "thin_prism_fisheye"; allowed: plumb_bob'),
    "a wrong count of ROS": (ros("plumb_bob", EIGHT), "plumb_bob has 8 coefficients; allowed: 4 or 5"),
    "an inverse model": (realsense("distortion.inverse_brown_conrady"), "not OpenCV's; calibrate the stream with OpenCV"),
    "a modified model": (realsense("distortion.modified_brown_conrady"), "not OpenCV's"),
    "an ftheta model": (realsense(3), "not OpenCV's"),
    "Zivid without lens": (ZIVID[: ZIVID.index("  Distortion")], "has no Distortion"),
    "an alias": ("a: &b [1]\ncamera_matrix: *b\n", "anchors or aliases in line 1"),
    "a tag of Python": ("camera_matrix: !!python/object/apply:os.system [ls]\n", "tag .*python.* in line 1; allowed: !!opencv-matrix"),
    "deep nesting": ("a: " + "[" * 30 + "]" * 30, "nested too deeply"),
    "deep JSON": ('{"a": ' + "[" * 100_000, "nested too deeply"),
    "broken YAML": ("a: [1, 2\nb: {", "is no YAML in line 2"),
    "a tab": ("a:\n\tb: 1\n", "is no YAML"),
    "control characters": ("a: \0\n", "is no YAML"),
    "broken XML": ("<opencv_storage><a></opencv_storage>", "is no XML"),
    "entities": ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "document type or entities"),
    "not UTF-8": (b"\xff\xfe\0a", "byte 0 is not UTF-8"),
    "four numbers": ("275 274.6 163.3 117", "the camera matrix has 4 numbers; allowed: 9"),
    "a projection": ("275 0 163.3 0\n0 274.6 117 0\n0 0 1 0\n", "the camera matrix has 12 numbers"),
    "decimal commas": ("275,0 0,0 163,3\n0,0 274,6 117,0\n0,0 0,0 1,0\n", "the camera matrix has 18 numbers"),
    "a transposed text": ("275 0 0\n0 274.6 0\n163.3 117 1\n", "column by column"),
    "a negative focal length": ("-275 0 163.3\n0 274.6 117\n0 0 1\n", "focal lengths are -275 and 274.6; allowed: above 0"),
    "an unknown model of BOP": (
        '{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "cam_dist_model": "weird"}',
        'model is "weird"; allowed: pinhole, fisheye',
    ),
    "a raised digit": (realsense("²"), 'distortion model "²"'),
    "a raised digit as width": (ros("plumb_bob", FIVE).replace("320", "²"), 'width is "²"; allowed: a finite number'),
    "thousands of digits": (ros("plumb_bob", FIVE).replace("320", "9" * 5000), 'width is "999.*…; allowed: a finite number'),
    "thousands of digits of JSON": (realsense(width=0).replace('"width": 0', f'"width": {"9" * 5000}'), "damaged|allowed: a finite number"),
    "a huge size": (realsense(width=1e308), "the image has 1e\\+308 x 240 pixels"),
    "unnamed coefficients": (
        '{"K": [275, 0, 163.3, 0, 274.6, 117, 0, 0, 1], "dist_params": [1, 2]}',
        '"dist_params", which is no known name',
    ),
    "four named coefficients": ('{"fx": 1, "fy": 1, "cx": 1, "cy": 1, "k1": 1, "k2": 1, "k3": 1, "k4": 1}', "may be of both models"),
    "a model of COLMAP": (
        "1 THIN_PRISM_FISHEYE 320 240 275 274.6 163 117 0 0 0 0 0 0 0 0",
        'model is "THIN_PRISM_FISHEYE"; allowed: SIMPLE_',
    ),
    "parameters of COLMAP": ("1 PINHOLE 320 240 275 163 117", "PARAMS has 3 numbers; allowed: 4"),
    "two cameras": ("1 PINHOLE 320 240 275 275 163 117\n2 PINHOLE 320 240 276 275 163 117", "has 2 cameras that differ"),
    "frames that differ": (
        json.dumps({"camera_angle_x": 1.0, "frames": [{"fl_x": 1.0, "cx": 1, "cy": 1}, {"fl_x": 2.0, "cx": 1, "cy": 1}]}),
        "its frames are of 2 cameras",
    ),
    "a model of nerfstudio": (nerfstudio(camera_model="EQUIRECTANGULAR"), 'camera_model is "EQUIRECTANGULAR"'),
    "Kalibr, omni": ("cam0: {camera_model: omni, intrinsics: [1, 2, 3, 4]}", 'camera model is "omni"; allowed: pinhole'),
    "a cut archive": (archive(mtx=K)[:200], "is no archive of NumPy's arrays: its reader failed"),
    "an archive of objects": (archive(mtx=np.array([K, 1], object)), "no intrinsics of a known format"),
    "an array of a shape that is not there": (
        array(K).replace(b"(3, 3), }" + 12 * b" ", b"(9999999999999, 3), }"),
        "is no archive of NumPy's arrays",
    ),
    "a large file": (b" " * (2**20 + 1), "larger than 1 MiB"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_cannot_be_used_is_one_line(name, tmp_path):
    text, message = REFUSED[name]
    path = saved(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        read_calibration(path)
    assert str(caught.value).isprintable()
    assert str(path) in str(caught.value)


def test_what_is_no_file_is_one_line(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("absent", ".", "pipe", "a\0b"):
        with pytest.raises(ConfigError):
            read_calibration(tmp_path / name)


@settings(max_examples=100, deadline=None)
@given(st.sampled_from(sorted(FILES)), st.data())
def test_damaged_files_are_read_or_refused(tmp_path_factory, name, data):
    """Any cut and any replaced piece: a camera of finite numbers, or one line."""
    text = FILES[name][0]
    text = text if isinstance(text, bytes) else text.encode()
    start, stop = (data.draw(st.integers(0, len(text))) for _ in range(2))
    piece = data.draw(st.binary(max_size=4) | st.sampled_from([b"-", b": ", b"[", b"{", b"*a", b"&a ", b"<", b"1e999", b"!!str "]))
    path = saved(tmp_path_factory.getbasetemp(), text[:start] + piece + text[max(start, stop) :])
    with contextlib.suppress(ConfigError):
        camera = read_calibration(path)
        assert np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]).all()


POSE = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
INLINE = "resolution = [320, 240]\nmatrix = [[275.0, 0, 163.3], [0, 274.6, 117.0], [0, 0, 1]]\n"


def cell(folder, lines, settings=None):
    """Configuration of one camera with these lines in its table."""
    path = folder / "cell.toml"
    path.write_text(f'preset = "smoke"\n[[camera]]\n{lines}\n{POSE}\n')
    return load_config(str(path), settings)


@pytest.mark.parametrize(
    ("lines", "model"),
    [
        ('file = "camera.file"', "pinhole"),
        (f"{INLINE}pixel_center = 0.0\ndistortion = {list(FIVE)}", None),
    ],
)
def test_a_camera_table_has_the_numbers_of_its_file(lines, model, tmp_path):
    """They are written to config.toml, and the file is not read again."""
    saved(tmp_path, opencv(FIVE))
    config = cell(tmp_path, lines)
    row = config.camera[0]
    assert (row.resolution, row.distortion, row.model, row.file) == ((320, 240), FIVE, model, None)
    assert row.matrix == ((275.0, 0.0, 163.8), (0.0, 274.6, 117.5), (0.0, 0.0, 1.0))
    (tmp_path / "camera.file").unlink()
    (tmp_path / "config.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "config.toml")).camera == config.camera
    (camera,) = make_cameras(config.rig)
    assert camera.lens.lens.coefficients == FIVE
    assert camera.distortion == {"cam_dist_model": "pinhole", "cam_dist": list(FIVE)}


@pytest.mark.parametrize("name", [name for name in SENSORS if sensor_camera(name) is not None])
def test_a_camera_table_has_the_intrinsics_of_its_sensor(name, tmp_path):
    row, figures = cell(tmp_path, f'sensor = "{name}"').camera[0], SENSORS[name]
    assert row.resolution == figures["resolution"].value
    assert (row.matrix[0][0], row.matrix[1][1]) == figures["focal"].value
    assert (row.matrix[0][2], row.matrix[1][2]) == figures["center"].value


TABLES_REFUSED = {
    "no file": ('file = "absent.yml"', "there is no file .*absent.yml"),
    "a file beside a matrix": (
        f'file = "camera.file"\n{INLINE}',
        r"camera\[0\]\.matrix stands beside camera\[0\]\.file in .*; allowed: one",
    ),
    "a file beside a sensor": ('file = "camera.file"\nsensor = "d435"', "sensor stands beside"),
    "another size": (
        'file = "camera.file"\nresolution = [640, 480]',
        r"resolution is \[640, 480\] .*; allowed: \[320, 240\], that of its file",
    ),
    "a number as file": ("file = 3", "file is 3 .*; allowed: a string"),
    "an unknown sensor": ('sensor = "d436"', 'sensor is "d436" .*; allowed: d435, .*; did you mean d43'),
    "the ideal sensor": ('sensor = "ideal"', 'sensor is "ideal" .*; allowed: d435'),
    "another centre": (f"{INLINE}pixel_center = 1.0", r"pixel_center is 1\.0 .*; allowed: 0 or 0\.5"),
    "an unknown model": (f'{INLINE}model = "brown"\ndistortion = [0.1, 0, 0, 0]', 'model is "brown" .*; allowed: pinhole, fisheye'),
    "six coefficients": (
        f"{INLINE}distortion = [0.1, 0, 0, 0, 0, 0]",
        r"camera\[0\]\.distortion is .* in .*6 coefficients; allowed: 4 or 5",
    ),
    "a fold": (
        f"{INLINE}distortion = [-0.9, 0, 0, 0]",
        r"camera\[0\]\.distortion is .*distortion folds over at \d+ px .* inside the image",
    ),
    "nan": (f"{INLINE}distortion = [nan, 0, 0, 0]", "distortion is .*; allowed: "),
    "an empty list of coefficients and a word": (f'{INLINE}distortion = "none"', 'distortion is "none" .*; allowed: a list of numbers'),
}


@pytest.mark.parametrize("name", TABLES_REFUSED)
def test_a_wrong_camera_table_is_one_line(name, tmp_path):
    saved(tmp_path, opencv(FIVE))
    lines, message = TABLES_REFUSED[name]
    with pytest.raises(ConfigError, match=message) as caught:
        cell(tmp_path, lines)
    assert "\n" not in str(caught.value)


def test_a_distorted_camera_has_no_depth_sensor(tmp_path):
    with pytest.raises(ConfigError, match="none with the layer depth_sensor"):
        cell(tmp_path, f"{INLINE}distortion = [0.1, 0, 0, 0]", {"render.layers": ["depth_sensor"]})
    assert cell(tmp_path, f"{INLINE}distortion = [0, 0, 0, 0]", {"render.layers": ["depth_sensor"]}).camera


def test_a_file_without_size_needs_a_resolution(tmp_path):
    saved(tmp_path, ZIVID)
    with pytest.raises(ConfigError, match="does not say the image's size"):
        cell(tmp_path, 'file = "camera.file"')
    assert cell(tmp_path, 'file = "camera.file"\nresolution = [320, 240]').camera[0].distortion == FIVE
