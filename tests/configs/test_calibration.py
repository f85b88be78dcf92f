"""Calibration files as other programs write them: equal intrinsics, and one line for what is wrong; lenses against OpenCV's."""

import contextlib
import io
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from synpick_warp.configs.calibration.files import FISHEYE, PINHOLE, Calibration, read_calibration
from synpick_warp.configs.calibration.lens import MAX_ANGLE, TOLERANCE, Lens, LensMap
from synpick_warp.configs.calibration.tables import SENSORS, sensor_camera
from synpick_warp.configs.files.load import config_to_toml, load_config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.cameras import make_cameras
from tests.builders import refusal

FIVE = (-0.12, 0.08, 5e-4, -3e-4, 0.01)
EIGHT = (*FIVE, 0.02, -0.01, 0.03)
MATRIX = "275.0, 0.0, 163.3, 0.0, 274.6, 117.0, 0.0, 0.0, 1.0"
SIZED = Calibration(320, 240, 275.0, 274.6, 163.8, 117.5)
"""The camera of all files: at integers its principal point is 163.3, 117.0."""


SAMPLES = Path(__file__).with_name("calibrations")
"""Files as programs write them; ros.yaml has MODEL, COUNT and VALUES of its distortion to be filled in."""
OPENCV, XML, ROS, MESSAGE, ZIVID, INI, KALIBR = (
    (SAMPLES / name).read_text()
    for name in ("opencv.yml", "opencv.xml", "ros.yaml", "camera_info.yaml", "zivid.yml", "ros.ini", "kalibr.yaml")
)


def with_lens(distortion, model=PINHOLE, size=(320, 240)):
    return Calibration(*size, 275.0, 274.6, 163.8, 117.5, model, tuple(distortion))


def without_size(distortion=()):
    return with_lens(distortion, size=(0, 0))


def yaml_matrix(name, rows, numbers):
    return f"{name}: !!opencv-matrix\n   rows: {rows}\n   cols: {len(numbers.split(',')) // rows}\n   dt: d\n   data: [ {numbers} ]\n"


def numbers(values):
    return ", ".join(map(str, values))


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


COLMAP = "320 240 275 274.6 163.8 117.5 -0.12 0.08 5e-4 -3e-4\n"
NAMED = {"fx": 275, "fy": 274.6, "cx": 163.3, "cy": 117, "k1": -0.12, "k2": 0.08, "p1": 5e-4, "p2": -3e-4, "k3": 0.01}
RADIAL = (-0.1, 0.08, 0.0, 0.0, 0.01)
CAM_K = [275, 0, 163.8, 0, 274.6, 117.5, 0, 0, 1]
K = np.array([[275, 0, 163.3], [0, 274.6, 117], [0, 0, 1]])
ODD = np.array([K, 1], object)
FILES = {
    "OpenCV, 5": (opencv(FIVE), with_lens(FIVE)),
    "OpenCV, 8, of Python": (f'{{"K": {K.tolist()}, "dist": [{list(EIGHT)}]}}', without_size(EIGHT)),
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
    "RealSense, modified, radial": (realsense("Modified Brown Conrady", RADIAL), with_lens(RADIAL)),
    "RealSense, fisheye": (realsense("distortion.kannala_brandt4", (*FIVE[:4], 0)), with_lens(FIVE[:4], FISHEYE)),
    "cam_K.txt": ("275.0 0.0 163.3\n0.0 274.6 117.0\n0.0 0.0 1.0\n", without_size()),
    "cam_K.txt with commas": ("275,0,163.3\r\n0,274.6,117\r\n0,0,1e0\r\n", without_size()),
    "a list": ("[[2.75e2, 0, 163.3], [0, 274.6, 117], [0, 0, 1]]", without_size()),
    "NumPy, .npz": (archive(mtx=K, dist=np.array([FIVE]), rvecs=np.ones((900, 3, 1)), odd=ODD), without_size(FIVE)),
    "NumPy, .npy": (array(K), without_size()),
    "ROS, .ini": (INI, with_lens(FIVE)),
    "ROS, rational with 5 columns": (ros("rational_polynomial", EIGHT).replace("cols: 8", "cols: 5"), with_lens(EIGHT)),
    "Kalibr": (KALIBR, with_lens(FIVE[:4])),
    "COLMAP": (f"# Camera list\n# CAMERA_ID, MODEL\n\n1 OPENCV {COLMAP}", with_lens((*FIVE[:4], 0.0))),
    "COLMAP, fisheye": (f"1 OPENCV_FISHEYE {COLMAP}", with_lens(FIVE[:4], FISHEYE)),
    "COLMAP, two alike": ("1 PINHOLE 320 240 275 274.6 163.8 117.5\n2 PINHOLE 320 240 275 274.6 163.8 117.5\n", SIZED),
    "nerfstudio": (nerfstudio(k1=-0.12, k2=0.08, p1=5e-4, p2=-3e-4, k3=0.01), with_lens(FIVE)),
    "nerfstudio, fisheye": (nerfstudio(camera_model="OPENCV_FISHEYE", k1=-0.12, k2=0.08, k3=5e-4, k4=-3e-4), with_lens(FIVE[:4], FISHEYE)),
    "nerfstudio, equal frames": (json.dumps({"camera_angle_x": 1.0, "frames": [json.loads(nerfstudio())] * 2}), SIZED),
    "BOP, scene_camera": (json.dumps({key: {"cam_K": CAM_K, "depth_scale": 0.1} for key in "03"}), without_size()),
    "Open3D": ('{"width": 320, "height": 240, "intrinsic_matrix": [275, 0, 0, 0, 274.6, 0, 163.3, 117, 1]}', SIZED),
    "names of one's own": (f'{{"Camera Matrix": [{MATRIX}], "distCoef": {list(FIVE)}, "W": 320, "H": 240}}', with_lens(FIVE)),
    "names of each": (json.dumps(NAMED), without_size(FIVE)),
    "Zivid": (ZIVID, without_size(FIVE)),
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


FRAMES = [{"fl_x": focal, "cx": 1, "cy": 1} for focal in (1.0, 2.0)]
ONES = '"fx": 1, "fy": 1, "cx": 1, "cy": 1'
SHAPES = b"(3, 3), }" + 12 * b" ", b"(9999999999999, 3), }"
LAUGHS = "a0: &a0 [1, 2]\n" + "".join(f"a{n + 1}: &a{n + 1} [*a{n}, *a{n}]\n" for n in range(40)) + "intrinsics: *a40\ncamera_model: *a40\n"
DAMAGED = "(is no calibration file|cannot be read on this machine): its reader "
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
    "aliases of aliases": (LAUGHS, DAMAGED),
    "a tag of Python": ("camera_matrix: !!python/object/apply:os.system [ls]\n", '"ls"; allowed: a finite number'),
    "deep nesting": ("a: " + "[" * 500_000 + "]" * 500_000, DAMAGED),
    "deep JSON": ('{"a": ' + "[" * 100_000, "nested too deeply"),
    "broken YAML": ("a: [1, 2\nb: {", DAMAGED),
    "a tab": ("a:\n\tb: 1\n", DAMAGED),
    "control characters": ("a: \0\n", DAMAGED),
    "broken XML": ("<opencv_storage><a></opencv_storage>", DAMAGED),
    "entities": ('<!DOCTYPE a [<!ENTITY b "c">]><opencv_storage>&b;</opencv_storage>', "no intrinsics of a known format"),
    "not UTF-8": (b"\xff\xfe\0a", DAMAGED),
    "four numbers": ("275 274.6 163.3 117", "the camera matrix has 4 numbers; allowed: 9"),
    "a projection": ("275 0 163.3 0\n0 274.6 117 0\n0 0 1 0\n", "the camera matrix has 12 numbers"),
    "decimal commas": ("275,0 0,0 163,3\n0,0 274,6 117,0\n0,0 0,0 1,0\n", "the camera matrix has 18 numbers"),
    "a transposed text": ("275 0 0\n0 274.6 0\n163.3 117 1\n", "column by column"),
    "a negative focal length": ("-275 0 163.3\n0 274.6 117\n0 0 1\n", "focal lengths are -275 and 274.6; allowed: above 0"),
    "an unknown model of BOP": (f'{{{ONES}, "cam_dist_model": "weird"}}', 'model is "weird"; allowed: pinhole, fisheye'),
    "a raised digit": (realsense("²"), 'distortion model "²"'),
    "a raised digit as width": (ros("plumb_bob", FIVE).replace("320", "²"), 'width is "²"; allowed: a finite number'),
    "thousands of digits": (ros("plumb_bob", FIVE).replace("320", "9" * 5000), 'width is "999.*…; allowed: a finite number'),
    "thousands of digits of JSON": (realsense(width=0).replace('"width": 0', f'"width": {"9" * 5000}'), "damaged|allowed: a finite number"),
    "a huge size": (realsense(width=1e308), "the image has 1e\\+308 x 240 pixels"),
    "unnamed coefficients": (f'{{"K": [{MATRIX}], "dist_params": [1, 2]}}', '"dist_params", which is no known name'),
    "four named coefficients": (f'{{{ONES}, "k1": 1, "k2": 1, "k3": 1, "k4": 1}}', "may be of both models"),
    "a model of COLMAP": (f"1 THIN_PRISM_FISHEYE {COLMAP.strip()} 0 0 0 0", 'model is "THIN_PRISM_FISHEYE"; allowed: SIMPLE_'),
    "parameters of COLMAP": ("1 PINHOLE 320 240 275 163 117", "PARAMS has 3 numbers; allowed: 4"),
    "two cameras": ("1 PINHOLE 320 240 275 275 163 117\n2 PINHOLE 320 240 276 275 163 117", "has 2 cameras that differ"),
    "frames that differ": (json.dumps({"camera_angle_x": 1.0, "frames": FRAMES}), "its frames are of 2 cameras"),
    "a model of nerfstudio": (nerfstudio(camera_model="EQUIRECTANGULAR"), 'camera_model is "EQUIRECTANGULAR"'),
    "Kalibr, omni": ("cam0: {camera_model: omni, intrinsics: [1, 2, 3, 4]}", 'camera model is "omni"; allowed: pinhole'),
    "a cut archive": (archive(mtx=K)[:200], DAMAGED),
    "an archive of objects": (archive(mtx=ODD), "no intrinsics of a known format"),
    "an array of a shape that is not there": (array(K).replace(*SHAPES), DAMAGED),
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
    for name, said in (("absent", "there is no file"), (".", "not a regular file"), ("pipe", "not a regular file"), ("a\0b", "file")):
        assert said in refusal(read_calibration, tmp_path / name)


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
FILE = 'file = "camera.file"'
INLINE = "resolution = [320, 240]\nmatrix = [[275.0, 0, 163.3], [0, 274.6, 117.0], [0, 0, 1]]\n"


def cell(folder, lines, settings=None):
    """Configuration of one camera with these lines in its table."""
    path = folder / "cell.toml"
    path.write_text(f'preset = "smoke"\n[[camera]]\n{lines}\n{POSE}\n')
    return load_config(str(path), settings)


@pytest.mark.parametrize(
    ("lines", "model"), [('file = "camera.file"', "pinhole"), (f"{INLINE}pixel_center = 0.0\ndistortion = {list(FIVE)}", None)]
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


ROW = r"camera\[0\]\."
TABLES_REFUSED = {
    "no file": ('file = "absent.yml"', "there is no file .*absent.yml"),
    "a file beside a matrix": (f'file = "camera.file"\n{INLINE}', rf"{ROW}matrix stands beside {ROW}file in .*; allowed: one"),
    "a file beside a sensor": ('file = "camera.file"\nsensor = "d435"', "sensor stands beside"),
    "another size": (f"{FILE}\nresolution = [640, 480]", r"resolution is \[640, 480\] .*; allowed: \[320, 240\], that of its file"),
    "a number as file": ("file = 3", "file is 3 .*; allowed: a string"),
    "an unknown sensor": ('sensor = "d436"', 'sensor is "d436" .*; allowed: d435, .*; did you mean d43'),
    "the ideal sensor": ('sensor = "ideal"', 'sensor is "ideal" .*; allowed: d435'),
    "another centre": (f"{INLINE}pixel_center = 1.0", r"pixel_center is 1\.0 .*; allowed: 0 or 0\.5"),
    "an unknown model": (f'{INLINE}model = "brown"\ndistortion = [0.1, 0, 0, 0]', 'model is "brown" .*; allowed: pinhole, fisheye'),
    "six coefficients": (f"{INLINE}distortion = [0.1, 0, 0, 0, 0, 0]", rf"{ROW}distortion is .* in .*6 coefficients; allowed: 4 or 5"),
    "a fold": (f"{INLINE}distortion = [-0.9, 0, 0, 0]", rf"{ROW}distortion is .*distortion folds over at \d+ px .* inside the image"),
    "a file without size": ('file = "zivid.yml"', "does not say the image's size"),
    "nan": (f"{INLINE}distortion = [nan, 0, 0, 0]", "distortion is .*; allowed: "),
    "a word": (f'{INLINE}distortion = "none"', 'distortion is "none" .*; allowed: a list of numbers'),
}


@pytest.mark.parametrize("name", TABLES_REFUSED)
def test_a_wrong_camera_table_is_one_line(name, tmp_path):
    saved(tmp_path, opencv(FIVE))
    (tmp_path / "zivid.yml").write_text(ZIVID)
    lines, message = TABLES_REFUSED[name]
    with pytest.raises(ConfigError, match=rf"\A.*{message}.*\Z"):
        cell(tmp_path, lines)


def test_a_distorted_camera_has_no_depth_sensor(tmp_path):
    with pytest.raises(ConfigError, match="none with the layer depth_sensor"):
        cell(tmp_path, f"{INLINE}distortion = [0.1, 0, 0, 0]", {"render.layers": ["depth_sensor"]})
    assert cell(tmp_path, f"{INLINE}distortion = [0, 0, 0, 0]", {"render.layers": ["depth_sensor"]}).camera


# ---- lens models against OpenCV's projections, and the properties that the renderer's bounds rely on ----


LENSES = {
    "issue": (PINHOLE, (275.0, 274.6, 163.8, 117.5), (-0.12, 0.08, 0.0005, -0.0003, 0.0), (320, 240)),
    "four": (PINHOLE, (275.0, 274.6, 163.8, 117.5), (-0.1, 0.03, 0.001, -0.002), (320, 240)),
    "webcam": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (-0.35, 0.12, 0.0, 0.0, 0.0), (1280, 720)),
    "rational": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (8.5, 3.2, 1e-3, -5e-4, 0.15, 8.8, 4.8, 0.6), (1280, 720)),
    "prism": (PINHOLE, (300.0, 290.0, 320.0, 180.0), (-0.2, 0.05, 2e-3, -3e-3, 0, 0.01, 0.02, 0, 0.01, -2e-3, 5e-3, 1e-3), (640, 360)),
    "pole beside the image": (PINHOLE, (600.0, 600.0, 640.0, 360.0), (0, 0, 0, 0, 0, -0.5, 0, 0), (1280, 720)),
    "fisheye": (FISHEYE, (300.0, 301.0, 320.0, 240.0), (-0.01, 0.02, -0.01, 0.002), (640, 480)),
    "none": (PINHOLE, (300.0, 301.0, 320.0, 240.0), (0.0,) * 4, (640, 480)),
}
number = st.floats(-1, 1)


def opencv_projection(model, intrinsics, coefficients, points):
    """Pixels of points (n, 2) of the normalised plane by OpenCV, with pixel centres where the matrix has them."""
    fx, fy, cx, cy = intrinsics
    project = cv2.fisheye.projectPoints if model == FISHEYE else cv2.projectPoints
    there = np.column_stack((points, np.ones(len(points)))).reshape(-1, 1, 3)
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    return project(there, np.zeros(3), np.zeros(3), matrix, np.array(coefficients, float))[0].reshape(-1, 2)


@st.composite
def maps(draw):
    """Lenses of all models, and images that they cover."""
    model, count = draw(st.sampled_from([(PINHOLE, 4), (PINHOLE, 5), (PINHOLE, 8), (PINHOLE, 12), (FISHEYE, 4)]))
    sizes = (0.1,) * 4 if model == FISHEYE else (0.5, 0.3, 0.01, 0.01, 0.2, 0.5, 0.2, 0.1, 0.01, 0.01, 0.01, 0.01)[:count]
    coefficients = tuple(draw(number) * size for size in sizes)
    focal = 100 * draw(st.floats(1, 20))
    intrinsics = (focal, focal * (1 + draw(number) / 20), 50 + 20 * draw(number), 40 + 20 * draw(number))
    try:
        return model, intrinsics, coefficients, LensMap(Lens(model, coefficients), intrinsics, (100, 80))
    except ConfigError:
        assume(False)


@pytest.mark.parametrize("name", LENSES)
def test_each_pixel_is_the_projection_of_its_ray(name):
    model, intrinsics, coefficients, size = LENSES[name]
    lens = LensMap(Lens(model, coefficients), intrinsics, size)
    pixels = np.stack(np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5), -1)
    rays = lens.unproject(pixels)
    assert np.abs(lens.project(rays) - pixels).max() < TOLERANCE
    some = tuple(np.unique(np.linspace(0, side - 1, 160, dtype=int)) for side in rays.shape[:2])
    few, there = (each[np.ix_(*some)].reshape(-1, 2) for each in (rays, pixels))
    assert np.abs(opencv_projection(model, intrinsics, coefficients, few) - there).max() < TOLERANCE
    assert np.linalg.norm(rays, axis=-1).max() <= lens.radius <= np.tan(np.radians(MAX_ANGLE))
    assert np.array_equal(lens.rays(), rays.astype(np.float32))
    assert lens.lens.is_identity == (name == "none")


@settings(max_examples=25, deadline=None)
@given(maps(), st.lists(st.tuples(number, number), min_size=1, max_size=20))
def test_projections_are_opencvs_within_the_domain(lens, places):
    model, intrinsics, coefficients, made = lens
    points = np.array(places) * made.radius / np.sqrt(2)
    np.testing.assert_allclose(made.project(points), opencv_projection(model, intrinsics, coefficients, points), rtol=1e-9, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(maps(), st.lists(st.tuples(number, number), min_size=1, max_size=20))
def test_the_inverse_holds_in_the_image_and_beyond_its_domain(lens, places):
    *_, made = lens
    pixels = (50, 40) + np.array(places) * 300
    assert np.abs(made.project(made.unproject(pixels)) - pixels).max() < TOLERANCE


@settings(max_examples=25, deadline=None)
@given(maps(), st.tuples(number, number, number, number), st.floats(1e-3, 6))
def test_no_segment_is_bent_more_than_the_bound(lens, ends, size):
    """Midpoints of segments inside of the domain and across its edge; the continuation has no step in value or slope there."""
    *_, made = lens
    start, stop = np.array(ends).reshape(2, 2) * min(size, 5) * made.radius
    along = np.linspace(0, 1, 41)[:, None]
    chord = made.project(start) + along * (made.project(stop) - made.project(start))
    off = np.linalg.norm(made.project(start + along * (stop - start)) - chord, axis=-1)
    assert off.max() <= made.bend * ((stop - start) ** 2).sum() / 8 + 1e-7


@pytest.mark.parametrize("name", LENSES)
def test_undistortion_maps_are_opencvs(name):
    """In OpenCV's convention, so with half a pixel less in the matrix."""
    model, (fx, fy, cx, cy), coefficients, size = LENSES[name]
    matrix, given = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), np.array(coefficients, float)
    make = cv2.fisheye.initUndistortRectifyMap if model == FISHEYE else cv2.initUndistortRectifyMap
    expected = make(matrix, given, np.eye(3), matrix, size, cv2.CV_32FC1)
    made = LensMap(Lens(model, coefficients), (fx, fy, cx, cy), size)
    # Beyond the domain, OpenCV folds and ours goes on; what a picture is made of lies within.
    rays = (np.stack(np.meshgrid(*(np.arange(side) for side in size)), -1) - (cx - 0.5, cy - 0.5)) / (fx, fy)
    domain = np.linalg.norm(rays, axis=-1) <= made.radius
    assert domain.mean() > 0.5
    np.testing.assert_allclose(made.undistortion_maps()[:, domain], np.array(expected)[:, domain], atol=2e-3)


IMPOSSIBLE = {
    "a fold in the image": (PINHOLE, (-0.35, 0.05, 0, 0, 0), "folds over at 216 px .* corner is 400 px away"),
    "a strong fold": (PINHOLE, (-30.0, 0, 0, 0, 0), r"folds over at \d+ px"),
    "a fold by tangential coefficients": (PINHOLE, (0, 0, 30.0, 0, 0), r"folds over at \d px"),
    "a fold in front of the pole": (PINHOLE, (-3.0, 0, 0, 0, 0, -0.9, 0, 0), "folds over"),
    "rays behind the camera": (FISHEYE, (-0.2, 0.0, 0.0, 0.0), "folds over|no ray within 85°"),
    "three coefficients": (PINHOLE, (0.1, 0.1, 0.1), "3 coefficients; allowed: 4 or 5 or 8 or 12"),
    "a fisheye with five": (FISHEYE, (0.1,) * 5, "5 coefficients; allowed: 4 with the model fisheye"),
    "not a number": (PINHOLE, (0.1, float("nan"), 0, 0), "not finite"),
    "another model": ("ftheta", (0.1,) * 4, 'model "ftheta"; allowed: pinhole, fisheye'),
}


@pytest.mark.parametrize("name", IMPOSSIBLE)
def test_impossible_lenses_are_refused_in_one_line(name):
    model, coefficients, message = IMPOSSIBLE[name]
    with pytest.raises(ConfigError, match=rf"\A.*({message}).*\Z"):
        LensMap(Lens(model, coefficients), (300.0, 300.0, 320.0, 240.0), (640, 480))
