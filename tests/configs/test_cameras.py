"""[[camera]] tables and look-at cameras: what they mean, how they are written, where they project, and what is refused."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.configs.cell.cameras import Rig, intrinsics, resized, viewing_direction
from synpick_warp.configs.files.load import COMMAND_LINE, config_to_toml, load_config
from synpick_warp.configs.schema import Cameras, Config
from synpick_warp.errors import ConfigError
from synpick_warp.scenes.cameras import describe_cameras, make_cameras
from tests.builders import refusal

K = "matrix = [[275.0, 0.0, 163.8], [0.0, 274.6, 117.5], [0.0, 0.0, 1.0]]"
LOOK = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
DOWN = "[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]"
FIVE = [-0.12, 0.08, 0.0005, -0.0003, 0.01]
DISTRIBUTION = "in {path}; allowed: a distribution, such as {{ normal = [0, 0.002] }}"
HAND = '[[camera]]\nfixed_to = "gripper"\nfov = 60\npose = { position = [0.1, 0, 0.2], look_at = [0, 0, -0.1], up = [0, 1, 0] }\n'
LEFT = f'[[camera]]\nname = "left"\nresolution = [320, 240]\n{K}\n{LOOK}\n'
TOP = f"[[camera]]\nfov = 40.0\npose = {{ matrix = {DOWN} }}\n"


def posed(pose: str, fov: float = 20.0) -> str:
    """Text of a camera of this pose."""
    return f"[[camera]]\nfov = {fov}\npose = {{ {pose} }}\n"


def load(folder: Path, text: str, **settings: object) -> Config:
    path = folder / "cell.toml"
    path.write_text(f'preset = "smoke"\n{text}')
    return load_config(str(path), {key.replace("__", "."): value for key, value in settings.items()}, source=COMMAND_LINE)


def test_tables_replace_the_section(tmp_path):
    rig = load(tmp_path, LEFT + TOP + TOP).rig
    assert (rig.names, rig.sensors) == (("left", "camera_1", "camera_2"),) * 2
    assert rig.sizes == ((320, 240), (320, 180), (320, 180))
    assert rig.groups == ((0,), (1, 2))
    assert intrinsics(rig.rows[0]) == (275.0, 274.6, 163.8, 117.5)
    # Another size keeps width of view and middle.
    assert intrinsics(resized(rig.rows[0], (640, 360))) == pytest.approx((550.0, 549.2, 327.6, 175.0))
    assert load(tmp_path, TOP, cameras__resolution=[64, 48]).rig.sizes == ((64, 48),)
    ours = Rig.of(Cameras())
    assert (ours.names[0], ours.sensors[0], ours.groups) == ("camera_0", "cam0", ((0, 1, 2),))


@pytest.mark.parametrize("comments", [False, True])
def test_tables_are_written_and_read(tmp_path, comments):
    """Jitter, too, which makes a group of its own."""
    drawn = JITTER + "position = { normal = [0.0, 0.002] }\n" + LEFT.replace('"left"', '"right"')
    for config in (load(tmp_path, LEFT + TOP), load(tmp_path, drawn)):
        path = tmp_path / "again.toml"
        path.write_text(config_to_toml(config, comments=comments))
        assert load_config(str(path)) == config
    assert config.rig.groups == ((0,), (1,))
    assert "[[camera]]" not in config_to_toml(load_config("smoke"))


def test_tables_on_a_preset_with_cameras_of_its_own_are_read_back(tmp_path):
    """What the preset sets of [cameras] has no effect, so that a data set's config.toml, which lacks it, is that of its manifest."""
    (tmp_path / "cell.toml").write_text(f'preset = "tabletop"\n{TOP}')
    config = load_config(tmp_path / "cell.toml")
    (tmp_path / "again.toml").write_text(config_to_toml(config))
    assert load_config(tmp_path / "again.toml") == config
    assert (config.cameras.resolution, config.rig.sizes) == ((1280, 720), ((1280, 720),))


def test_poses_of_all_forms_look_the_same_way(tmp_path):
    forms = (
        f"matrix = {DOWN}",
        "position = [0, 0, 1.2], quaternion = [1, 0, 0, 0]",
        "position = [0, 0, 1.2], look_at = [0, 0, 0.2], up = [0, 1, 0]",
    )
    rows = load(tmp_path, "".join(map(posed, forms))).camera
    assert [viewing_direction(row.pose) for row in rows] == [pytest.approx((0.0, 0.0, -1.0))] * 3


@pytest.mark.parametrize(
    "pose",
    [
        "matrix = [[1, 0, 0, 0.1], [0, 0.6, -0.8, -0.9], [0, 0.8, 0.6, 1.2], [0, 0, 0, 1]]",
        "position = [0.1, -0.9, 1.2], quaternion = [0.4472135955, 0, 0, 0.894427191]",
    ],
)
def test_poses_of_opengl_are_those_of_opencv_with_y_and_z_turned(tmp_path, pose):
    """A camera that is tilted by atan2(0.8, 0.6) about x looks along its -z axis, and up is its y axis."""
    config = load(tmp_path, posed(f'axes = "opengl", {pose}', 60.0))
    (camera,) = make_cameras(config.rig)
    np.testing.assert_allclose(camera.rotation, [[1, 0, 0], [0, -0.6, -0.8], [0, 0.8, -0.6]], atol=1e-9)
    np.testing.assert_allclose(camera.center, [0.1, -0.9, 1.2], atol=1e-12)
    (tmp_path / "again.toml").write_text(config_to_toml(config))
    assert load_config(str(tmp_path / "again.toml")) == config


SIDE = "[[1, 0, 0, 0.1], [0, -0.6, 0.8, -0.9], [0, -0.8, -0.6, 1.2], [0, 0, 0, 1]]"
FROM_WORLD = "[[1, 0, 0, -0.1], [0, -0.6, -0.8, 0.42], [0, 0.8, -0.6, 1.44], [0, 0, 0, 1]]"


def test_an_inverse_that_sees_the_bin_by_chance_is_named_as_it_is_baked(tmp_path):
    def lines(matrix: str) -> list[str]:
        config = load(tmp_path, posed(f"matrix = {matrix}", 60.0))
        return describe_cameras(False, config.rig, config.cell.bins, config.gripper, config.pick)

    assert lines(SIDE) == lines(DOWN) == []
    (line,) = lines(FROM_WORLD)
    assert "the middle of the tote beside its images; if its pose leads from the world to the camera, invert it" in line


@pytest.mark.parametrize(("scale", "size"), [(0.25, (80, 60)), (0.3, (96, 72)), (1 / 3, (107, 80))])
def test_a_scaled_camera_projects_where_its_scaled_picture_has_it(tmp_path, scale, size):
    """OpenCV counts pixel centres at integers: there a point at x is at (x + 0.5) s - 0.5 of a picture that is scaled by s."""
    lens = f"distortion = {FIVE}\n"
    (full,), (small,) = (make_cameras(load(tmp_path, LEFT + lens + more).rig) for more in ("", f"scale = {scale}\n"))
    assert (small.width, small.height) == small.lens.size == size
    point = np.array([[0.2, -0.1, 1.0]])
    half = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])
    x, y = (cv2.projectPoints(point, np.zeros(3), np.zeros(3), one.matrix - half, np.array(FIVE))[0].ravel() for one in (full, small))
    np.testing.assert_allclose(y, (x + 0.5) * np.divide(size, (320, 240)) - 0.5, atol=1e-9)
    np.testing.assert_allclose(small.lens.project(point[:, :2])[0], y + 0.5, atol=1e-9)
    (row,) = load(tmp_path, TOP + f"resolution = [320, 240]\nscale = {scale}\n").rig.rows
    assert (row.fov, row.resolution) == (40.0, size)


def test_a_rectified_rig_has_the_same_matrices_without_distortion(tmp_path):
    both = LEFT + f"distortion = {FIVE}\n" + HAND.replace("60", "60\ndistortion = [0.1, 0, 0, 0]")
    bent, flat = (load(tmp_path, both, bop__rectified=value) for value in (False, True))
    assert [camera.lens is None for camera in make_cameras(bent.rig)] == [False, False]
    for camera, plain in zip(make_cameras(bent.rig), make_cameras(flat.rig), strict=True):
        assert plain.distortion == {}
        np.testing.assert_array_equal(plain.matrix, camera.matrix)
    assert flat.camera == bent.camera


INVERSE = "it would see the tote with the inverse, so it may lead from the world to the camera"
AWAY = "it looks away from the tote, and would see it with columns 2 and 3 negated"
FROM_WORLD_OPENGL = "[[1, 0, 0, -0.1], [0, 0.6, 0.8, -0.42], [0, -0.8, 0.6, -1.44], [0, 0, 0, 1]]"
HEAD = '[[camera]]\nname = "left"\nresolution = [320, 240]\n'
JITTER = LEFT + "[camera.jitter]\n"
CLOSE = LEFT + "distortion = [-0.25, 0, 0, 0]\n[camera.jitter]\n"
"""A lens that folds over 4 % farther from the axis than the image's corners are."""
SWAPPED = "matrix = [[163.8, 0, 275.0], [0, 117.5, 274.6], [0, 0, 1]]"
IN_WALL = "position = [0.28, 0, 0.1], look_at = [0, 0, 0], up = [0, 1, 0]"
PICK = '[bake]\nmode = "pick"\n'
NOT_FIXED = "in {path}; allowed: the name of a camera that is fixed to the world"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("camera = 3\n", "camera is 3 in {path}; allowed: [[camera]] tables"),
        ("[camera]\nfov = 3\n", "camera is a table in {path}; allowed: [[camera]] tables, one for each"),
        ("[[camera]]\nfov = 40\n", "camera[0] has no pose in {path}; a row needs pose"),
        (LEFT.replace("matrix", "matrx"), "there is no key camera[0].matrx, set in {path}"),
        (LEFT.replace("look_at", "lookat"), "there is no key camera[0].pose.lookat, set in {path}"),
        (f"{HEAD}{K}\npose = 3\n", "camera[0].pose is 3 in {path}; allowed: a table of matrix, position, "),
        (LEFT + LEFT, "camera[0].name is "),
        (LEFT.replace('"left"', '"Left"'), 'camera[0].name is "Left" in {path}; allowed: a lower-case letter, '),
        (LEFT.replace('"left"', '"info"'), 'camera[0].name is "info" in {path}; allowed: a lower-case letter, '),
        (LEFT + "fov = 3\n", "camera[0].matrix is "),
        (LEFT + "scale = 0.0\n", "camera[0].scale is 0.0 in {path}; allowed: above 0, at most 1"),
        (LEFT.replace("up =", 'axes = "opengl", up ='), 'camera[0].pose.axes is "opengl" in {path}; allowed: none beside look_at'),
        (TOP.replace("{ matrix", '{ axes = "blender", matrix'), 'camera[0].pose.axes is "blender" in {path}; allowed: opencv, opengl'),
        (HEAD + LOOK, "camera[0].fov is null in {path}; allowed: either fov or matrix"),
        (LEFT.replace("275.0", "0.0"), "allowed: fx from "),
        (LEFT.replace("275.0", "nan"), "camera[0].matrix is "),
        (LEFT.replace("274.6", "-274.6"), "and fy within twice fx [px]"),
        (LEFT.replace("275.0, 0.0", "275.0, 2.0"), "allowed: a matrix without skew"),
        (LEFT.replace("0.0, 0.0, 1.0]]", "163.8, 117.5, 1.0]]"), "allowed: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        (LEFT.replace("[320, 240]", "[240, 100]"), "a principal point cx, cy inside its images of 240 x 100 px"),
        (LEFT.replace(K, SWAPPED), "are numbers, or width and height, swapped?"),
        (LEFT.replace(K, "matrix = [[275.0, 0.0], [0.0, 274.6]]"), "allowed: 3 lists of 3 numbers in a list [px]"),
        (LEFT.replace("up = [0.0, 1.0, 0.0]", "quaternion = [0, 0, 0, 1]"), "allowed: {{matrix}} or {{position, quaternion}} or "),
        (TOP.replace("[0, -1, 0, 0]", "[0, 1, 0, 0]"), "this matrix is a mirror image"),
        (TOP.replace("[0, -1, 0, 0]", "[0, -2, 0, 0]"), "perpendicular and of length 1"),
        (TOP.replace(", [0, 0, 0, 1]]", "]"), "allowed: a matrix of 4 rows, the last 0, 0, 0, 1"),
        (TOP.replace(f"matrix = {DOWN}", "position = [0, 0, 1], quaternion = [0, 0, 0, 0]"), "a quaternion x, y, z, w of length 1"),
        (LEFT.replace("[0.0, 0.0, 0.1]", "[0.0, -0.4, 1.1]"), "positions other than look_at, the position of camera left"),
        (LEFT.replace("up = [0.0, 1.0, 0.0]", "up = [0.0, 0.0, 0.0]"), "up vectors that are not zero or parallel"),
        (TOP.replace("-1, 1.2]", "-1, -1.2]"), "positions above the tote's floor, z > 0, below which camera camera_0"),
        (LEFT.replace("look_at = [0.0, 0.0, 0.1]", "look_at = [0.0, 0.0, 9.0]"), "outside of the images of camera left [m]"),
        (TOP.replace(f"matrix = {DOWN}", IN_WALL), "outside of the tote's walls"),
        (LEFT + "[cameras]\nfov = 30.0\n", "cameras.fov is 30.0 in {path}; allowed: none, as the [[camera]] tables have values"),
        (LEFT + '[perception]\ncamera = "right"\n', 'perception.camera is "right" in {path}; allowed: the name of a camera, left, or none'),
        (LEFT.replace("[320, 240]", "[321, 240]") + '[bake]\nformats = ["lerobot"]\n', "camera[0].resolution is [321, 240] in {path}; "),
        (LEFT + "modalities = []\n", "camera[0].modalities is [] in {path}; allowed: at least one of color, depth, masks, "),
        (LEFT + 'modalities = ["rgb"]\n', 'camera[0].modalities is ["rgb"] in {path}; allowed: any of color, depth, masks, '),
        (LEFT + 'modalities = ["flow"]\n', "allowed: names of layers that are in render.layers, as flow is not"),
        (LEFT + 'modalities = ["depth"]\n[bake]\nformats = ["bop", "coco"]\n', "allowed: color among them with the format coco"),
        (LEFT + 'modalities = ["color"]\n[bake]\nformats = ["points"]\n', "allowed: depth among them with the format points"),
        (LEFT + "readout_time = -0.1\n", "camera[0].readout_time is -0.1 in {path}; allowed: at least 0, at most 10 [s]"),
        (
            LEFT + "exposure_time = 0.04\nreadout_time = 0.03\n",
            "camera[0].exposure_time is 0.04 in {path}; allowed: with readout_time at most 0.066",
        ),
        (
            LEFT + 'exposure_time = 0.01\nmodalities = ["depth"]\n',
            "exposure_time is 0.01 in {path}; allowed: 0 in mode still and without",
        ),
        (LEFT + 'readout_time = 0.01\n[bake]\nmode = "still"\n', "readout_time is 0.01 in {path}; allowed: 0 in mode still and without"),
        (LEFT + "readout_time = 0.07\n", "allowed: with exposure_time at most 0.066, the time from one frame to the next [s]"),
        (LEFT + "every = 0\n", "camera[0].every is 0 in {path}; allowed: at least 1, at most 1000 [frames]"),
        (LEFT + 'every = 2\n[bake]\nformats = ["lerobot"]\n', "camera[0].every is 2 in {path}; allowed: 1 with the format lerobot"),
        (LEFT + 'every = 2\n[render]\nlayers = ["flow"]\n', "allowed: 1 with the layer flow, which leads to the frame before"),
        # Other axes, or the inverse.
        (posed(f'axes = "opengl", matrix = {SIDE}'), 'columns 2 and 3 negated: set axes = "opencv" if its axes are OpenCV\'s'),
        (posed("position = [0, 0, 1.2], quaternion = [0, 0, 0, 1]"), AWAY),
        (posed(f"matrix = {FROM_WORLD}"), f"; {INVERSE}: invert it"),
        (posed(f"matrix = {FROM_WORLD_OPENGL}"), "invert it; and with columns 2 and 3 negated"),
        # Cameras on the gripper.
        (HAND.replace("gripper", "hand"), 'camera[0].fixed_to is "hand" in {path}; allowed: world, gripper'),
        (HAND.replace("[0.1, 0, 0.2]", "[0.01, 0, 0.2]"), "allowed: positions outside of the gripper's shaft and cup"),
        (HAND.replace("-0.1]", "5]"), "allowed: a point that lets camera camera_0 see below the gripper, z < 0 [m]"),
        (HAND + "[camera.jitter]\nposition = { uniform = [-0.1, 0.1] }\n", "every draw has positions outside of the gripper's shaft"),
        (HAND + "[camera.jitter]\nrotation = { uniform = [-90, 90] }\n", "every draw has a point that lets camera camera_0 see below"),
        (HAND + PICK, 'perception.camera is "" by default; allowed: the name of a camera that is fixed to the world'),
        (LEFT + HAND + PICK + '[perception]\ncamera = "camera_1"\n', f'perception.camera is "camera_1" {NOT_FIXED}'),
        (LEFT + "jitter = 3\n", "camera[0].jitter is 3 in {path}; allowed: a table of position, rotation, focal_length, center"),
        (JITTER + "zoom = 1\n", "there is no key camera[0].jitter.zoom, set in {path}; keys: position, "),
        (JITTER + "position = 0.01\n", f"camera[0].jitter.position is 0.01 {DISTRIBUTION}"),
        (JITTER + "position = [0.01, 0.02]\n", "camera[0].jitter.position is [0.01, 0.02] in {path}; allowed: finite numbers [m]"),
        (JITTER + "position = { normal = [0, -1] }\n", "with sigma at least 0"),
        (JITTER + "position = { uniform = [nan, 1] }\n", "camera[0].jitter.position is "),
        # Under the tote, in its wall, beside it, out of the image: each where single draws are.
        (JITTER + "position = { uniform = [-1.1, 0] }\n", "less, so that every draw has positions above the tote's floor"),
        (JITTER + "position = { uniform = [-3, 3] }\n", "less, so that every draw has "),
        (JITTER + "rotation = { uniform = [0, 80] }\n", "less, so that every draw has a point that lets each camera see the tote"),
        (JITTER + "center = { uniform = [-170, 0] }\n", "less, so that every draw has a principal point cx, cy inside"),
        # Near the radius where the distortion folds over: beyond it with a shorter focal length, and with both extremes together.
        (CLOSE + "focal_length = { normal = [0, 0.015] }\n", "less, so that every draw has a lens that covers the image, but distortion "),
        (CLOSE + "focal_length = { choice = [-0.02, 0] }\ncenter = { uniform = [-3, 3] }\n", "camera[0].jitter.center is "),
    ],
)
def test_what_is_refused_and_said(tmp_path, text, words):
    assert words.format(path=tmp_path / "cell.toml") in refusal(load, tmp_path, text)


def test_options_that_would_have_no_effect_are_refused(tmp_path):
    for key, value in (("resolution", [64, 48]), ("fov", 30.0)):
        said = refusal(load, tmp_path, LEFT, **{f"cameras__{key}": value})
        assert said.endswith("on the command line; allowed: none, as the [[camera]] tables have values of their own")
    assert "camera cannot be set on the command line; write [[camera]] tables into a file" in refusal(load, tmp_path, LEFT, camera__fov=3)


def test_perception_takes_the_first_camera_that_does_not_move(tmp_path):
    rig = load(tmp_path, HAND + LEFT + '[bake]\nmode = "pick"\n').rig
    assert (rig.index(""), rig.groups) == (1, ((0,), (1,)))
    load(tmp_path, HAND)  # Nothing is planned where objects are only stirred.


def test_cameras_are_rendered_together_where_they_are_alike(tmp_path):
    def groups(*more: str) -> tuple[tuple[int, ...], ...]:
        return load(tmp_path, "".join(LEFT.replace('"left"', f'"c{index}"') + text for index, text in enumerate(more))).rig.groups

    lens, drawn = "distortion = [-0.1, 0, 0, 0]\n", "jitter.center = { uniform = [-1, 1] }\n"
    assert groups("", lens, "") == ((0, 1, 2),)
    assert groups(drawn, lens + drawn, drawn, lens) == ((0, 2), (1,), (3,))
    assert groups('modalities = ["color"]\n', 'modalities = ["depth"]\n', 'modalities = ["color", "masks"]\n') == ((0, 2), (1,))


# ---- look-at cameras: projections with known answers ----


ONE = Cameras(positions=((0.0, 0.0, 2.0),), ups=((0.0, 1.0, 0.0),))


def project(camera, point):
    x = camera.matrix @ (camera.rotation @ np.array(point) + camera.translation)
    return x[:2] / x[2]


def test_the_first_camera_looks_straight_down_with_y_up():
    (camera,), (small,) = (make_cameras(Rig.of(rig)) for rig in (ONE, replace(ONE, resolution=(640, 360))))
    assert np.allclose(small.matrix, [[1814.81, 0, 320], [0, 1814.81, 180], [0, 0, 1]], atol=5e-3)
    assert np.allclose(camera.rotation, [[1, 0, 0], [0, -1, 0], [0, 0, -1]])
    assert np.allclose(camera.translation, [0, 0, 2])
    assert project(camera, (0, 0, 0.16)) == pytest.approx((960, 540))
    # 0.1 m to the right and to the top, 2 m away.
    assert project(camera, (0.1, 0, 0)) == pytest.approx((960 + 272.2213, 540), abs=1e-3)
    assert project(camera, (0, 0.1, 0)) == pytest.approx((960, 540 - 272.2213), abs=1e-3)


def test_the_papers_cameras_have_its_matrix_and_look_at_the_target_with_the_centre_line_up():
    cameras = make_cameras(Rig.of(Cameras()))
    for camera, side in zip(cameras, (0.0, 1.0, -1.0), strict=True):
        assert (camera.width, camera.height) == (1920, 1080)
        assert np.allclose(camera.matrix, [[5444.43, 0, 960], [0, 5444.43, 540], [0, 0, 1]], atol=5e-3)
        assert camera.rotation @ camera.rotation.T == pytest.approx(np.eye(3))
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        assert np.allclose(-camera.rotation.T @ camera.translation, (0, side * 0.573, 2.0))
        assert project(camera, (0, 0, 0.16)) == pytest.approx((960, 540))
        if side:
            # The image's upper edge points across the centre line, away from where the camera stands.
            assert project(camera, (0, -side * 0.1, 0.16))[1] < 540
            assert project(camera, (side * 0.1, 0, 0.16))[0] < 960


@given(st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-3, 3)] * 3), st.tuples(*[st.floats(-1, 1)] * 3), st.floats(1, 170))
def test_up_vectors_point_up_and_the_target_is_in_the_image_centre(position, target, up, fov):
    forward = np.subtract(target, position)
    if np.linalg.norm(np.cross(forward, up)) < 1e-3 * np.linalg.norm(forward) or np.linalg.norm(forward) < 1e-2:
        return
    (camera,) = make_cameras(Rig.of(Cameras(positions=(position,), target=target, ups=(up,), fov=fov)))
    assert np.linalg.det(camera.rotation) == pytest.approx(1)
    assert project(camera, target) == pytest.approx((960, 540), abs=1e-3)
    higher = (np.array(target) + 1e-3 * np.array(up)).tolist()
    assert project(camera, higher)[1] < 540 + 1e-9
    # Half the field of view lies between the middle and the right edge.
    assert np.degrees(np.arctan(960 / camera.matrix[0, 0])) == pytest.approx(fov / 2)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"ups": ((0.0, 0.0, 1.0),)}, "parallel"),
        ({"ups": ((0.0, 0.0, 0.0),)}, "zero"),
        ({"ups": ((0.0, 1.0, 0.0), (0.0, 1.0, 0.0))}, "1 entries and cameras.ups 2"),
        ({"positions": (), "ups": ()}, "empty"),
        ({"target": (0.0, 0.0, 2.0)}, "is at its look-at point"),
        ({"target": (0.0, float("nan"), 0.0)}, "not finite"),
    ],
)
def test_invalid_cameras_are_refused(change, words):
    with pytest.raises(ConfigError, match=rf"\A.*{words}.*\Z"):
        make_cameras(Rig.of(replace(ONE, **change)))
