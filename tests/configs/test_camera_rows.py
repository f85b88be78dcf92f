"""[[camera]] tables: what they mean, how they are written, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from synpick_warp.configs.cell.cameras import CameraRow
from synpick_warp.configs.cell.rig import Rig, intrinsics, resized, viewing_direction
from synpick_warp.configs.files.load import COMMAND_LINE, load_config
from synpick_warp.configs.files.write import config_to_toml
from synpick_warp.configs.schema import Cameras, Config
from synpick_warp.errors import ConfigError

K = "matrix = [[275.0, 0.0, 163.8], [0.0, 274.6, 117.5], [0.0, 0.0, 1.0]]"
LOOK = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
DOWN = "[[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.2], [0, 0, 0, 1]]"
LEFT = f'[[camera]]\nname = "left"\nresolution = [320, 240]\n{K}\n{LOOK}\n'
TOP = f"[[camera]]\nfov = 40.0\npose = {{ matrix = {DOWN} }}\n"


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
    assert load(tmp_path, TOP, cameras__resolution=[64, 48]).rig.sizes == ((64, 48),)
    ours = Rig.of(Cameras())
    assert (ours.names[0], ours.sensors[0], ours.groups) == ("camera_0", "cam0", ((0, 1, 2),))


@pytest.mark.parametrize("comments", [False, True])
def test_tables_are_written_and_read(tmp_path, comments):
    config = load(tmp_path, LEFT + TOP)
    path = tmp_path / "again.toml"
    path.write_text(config_to_toml(config, comments=comments))
    assert load_config(str(path)) == config
    assert "[[camera]]" not in config_to_toml(load_config("smoke"))


def test_poses_of_all_forms_look_the_same_way(tmp_path):
    forms = (
        f"matrix = {DOWN}",
        "position = [0, 0, 1.2], quaternion = [1, 0, 0, 0]",
        "position = [0, 0, 1.2], look_at = [0, 0, 0.2], up = [0, 1, 0]",
    )
    rows = load(tmp_path, "".join(f"[[camera]]\nfov = 40\npose = {{ {form} }}\n" for form in forms)).camera
    assert [viewing_direction(row.pose) for row in rows] == [pytest.approx((0.0, 0.0, -1.0))] * 3


def test_another_size_keeps_width_of_view_and_middle():
    row = CameraRow(resolution=(320, 240), matrix=((275.0, 0.0, 163.8), (0.0, 274.6, 117.5), (0.0, 0.0, 1.0)))
    assert intrinsics(resized(row, (640, 360))) == pytest.approx((550.0, 549.2, 327.6, 175.0))


HEAD = '[[camera]]\nname = "left"\nresolution = [320, 240]\n'


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
        (HEAD + LOOK, "camera[0].fov is null in {path}; allowed: either fov or matrix"),
        (LEFT.replace("275.0", "0.0"), "allowed: fx from "),
        (LEFT.replace("275.0", "nan"), "camera[0].matrix is "),
        (LEFT.replace("274.6", "-274.6"), "and fy within twice fx [px]"),
        (LEFT.replace("275.0, 0.0", "275.0, 2.0"), "allowed: a matrix without skew"),
        (LEFT.replace("0.0, 0.0, 1.0]]", "163.8, 117.5, 1.0]]"), "allowed: [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"),
        (LEFT.replace("[320, 240]", "[240, 100]"), "a principal point cx, cy inside its images of 240 x 100 px"),
        (
            LEFT.replace(K, "matrix = [[163.8, 0, 275.0], [0, 117.5, 274.6], [0, 0, 1]]"),
            "are numbers, or width and height, swapped?",
        ),
        (LEFT.replace(K, "matrix = [[275.0, 0.0], [0.0, 274.6]]"), "allowed: 3 lists of 3 numbers in a list [px]"),
        (LEFT.replace("up = [0.0, 1.0, 0.0]", "quaternion = [0, 0, 0, 1]"), "allowed: {{matrix}} or {{position, quaternion}} or "),
        (TOP.replace("[0, -1, 0, 0]", "[0, 1, 0, 0]"), "this matrix is a mirror image"),
        (TOP.replace("[0, -1, 0, 0]", "[0, -2, 0, 0]"), "perpendicular and of length 1"),
        (TOP.replace(", [0, 0, 0, 1]]", "]"), "allowed: a matrix of 4 rows, the last 0, 0, 0, 1"),
        (TOP.replace(f"matrix = {DOWN}", "position = [0, 0, 1], quaternion = [0, 0, 0, 0]"), "a quaternion x, y, z, w of length 1"),
        (
            LEFT.replace("look_at = [0.0, 0.0, 0.1]", "look_at = [0.0, -0.4, 1.1]"),
            "positions other than look_at, the position of camera left",
        ),
        (LEFT.replace("up = [0.0, 1.0, 0.0]", "up = [0.0, 0.0, 0.0]"), "up vectors that are not zero or parallel"),
        (TOP.replace("-1, 1.2]", "-1, -1.2]"), "positions above the tote's floor, z > 0, below which camera camera_0"),
        (LEFT.replace("look_at = [0.0, 0.0, 0.1]", "look_at = [0.0, 0.0, 9.0]"), "outside of the images of camera left [m]"),
        (TOP.replace(f"matrix = {DOWN}", "position = [0.28, 0, 0.1], look_at = [0, 0, 0], up = [0, 1, 0]"), "outside of the tote's walls"),
        (LEFT + "[cameras]\nfov = 30.0\n", "cameras.fov is 30.0 in {path}; allowed: none, as the [[camera]] tables have values"),
        (LEFT + '[perception]\ncamera = "right"\n', 'perception.camera is "right" in {path}; allowed: the name of a camera, left, or none'),
        (LEFT.replace("[320, 240]", "[321, 240]") + '[bake]\nformats = ["lerobot"]\n', "camera[0].resolution is [321, 240] in {path}; "),
    ],
)
def test_what_is_refused_and_said(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    assert words.format(path=tmp_path / "cell.toml") in str(caught.value)
    assert "\n" not in str(caught.value)


CLOSE = "distortion = [-0.25, 0, 0, 0]\n[camera.jitter]\n"
"""A lens that folds over 4 % farther from the axis than the image's corners are."""


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("jitter = 3\n", "camera[0].jitter is 3 in {path}; allowed: a table of position, rotation, focal_length, center"),
        ("[camera.jitter]\nzoom = 1\n", "there is no key camera[0].jitter.zoom, set in {path}; keys: position, "),
        (
            "[camera.jitter]\nposition = 0.01\n",
            "camera[0].jitter.position is 0.01 in {path}; allowed: a distribution, such as {{ normal = [0, 0.002] }}",
        ),
        ("[camera.jitter]\nposition = [0.01, 0.02]\n", "camera[0].jitter.position is [0.01, 0.02] in {path}; allowed: finite numbers [m]"),
        ("[camera.jitter]\nposition = { normal = [0, -1] }\n", "with sigma at least 0"),
        ("[camera.jitter]\nposition = { uniform = [nan, 1] }\n", "camera[0].jitter.position is "),
        # Under the tote, in its wall, beside it, out of the image: each where single draws are.
        ("[camera.jitter]\nposition = { uniform = [-1.1, 0] }\n", "less, so that every draw has positions above the tote's floor"),
        ("[camera.jitter]\nposition = { normal = [0, 0.4] }\n", "less, so that every draw has positions above the tote's floor"),
        ("[camera.jitter]\nposition = { uniform = [-3, 3] }\n", "less, so that every draw has "),
        (
            "[camera.jitter]\nrotation = { uniform = [0, 80] }\n",
            "less, so that every draw has a point that lets each camera see the tote",
        ),
        ("[camera.jitter]\ncenter = { uniform = [-170, 0] }\n", "less, so that every draw has a principal point cx, cy inside"),
        # Near the radius where the distortion folds over: beyond it with a shorter focal length, and with both extremes together.
        (
            f"{CLOSE}focal_length = {{ normal = [0, 0.015] }}\n",
            "less, so that every draw has a lens that covers the image, but distortion ",
        ),
        (f"{CLOSE}focal_length = {{ choice = [-0.02, 0] }}\ncenter = {{ uniform = [-3, 3] }}\n", "camera[0].jitter.center is "),
    ],
)
def test_jitter_that_is_refused(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, LEFT + text)
    assert words.format(path=tmp_path / "cell.toml") in str(caught.value)
    assert "\n" not in str(caught.value)


HAND = '[[camera]]\nfixed_to = "gripper"\nfov = 60\npose = { position = [0.1, 0, 0.2], look_at = [0, 0, -0.1], up = [0, 1, 0] }\n'


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (HAND.replace("gripper", "hand"), 'camera[0].fixed_to is "hand" in {path}; allowed: world, gripper'),
        (LEFT + "modalities = []\n", "camera[0].modalities is [] in {path}; allowed: at least one of color, depth, masks, "),
        (LEFT + 'modalities = ["rgb"]\n', 'camera[0].modalities is ["rgb"] in {path}; allowed: any of color, depth, masks, '),
        (LEFT + 'modalities = ["flow"]\n', "allowed: names of layers that are in render.layers, as flow is not"),
        (LEFT + 'modalities = ["depth"]\n[bake]\nformats = ["bop", "coco"]\n', "allowed: color among them with the format coco"),
        (LEFT + "every = 0\n", "camera[0].every is 0 in {path}; allowed: at least 1, at most 1000 [frames]"),
        (LEFT + 'every = 2\n[bake]\nformats = ["lerobot"]\n', "camera[0].every is 2 in {path}; allowed: 1 with the format lerobot"),
        (LEFT + 'every = 2\n[render]\nlayers = ["flow"]\n', "allowed: 1 with the layer flow, which leads to the frame before"),
        (HAND.replace("[0.1, 0, 0.2]", "[0.01, 0, 0.2]"), "allowed: positions outside of the gripper's shaft and cup"),
        (HAND.replace("-0.1]", "5]"), "allowed: a point that lets camera camera_0 see below the gripper, z < 0 [m]"),
        (HAND.replace("up = [0, 1, 0]", "up = [0, 0, 0]"), "up vectors that are not zero or parallel"),
        (HAND + "[camera.jitter]\nposition = { uniform = [-0.1, 0.1] }\n", "every draw has positions outside of the gripper's shaft"),
        (HAND + "[camera.jitter]\nrotation = { uniform = [-90, 90] }\n", "every draw has a point that lets camera camera_0 see below"),
        (HAND + '[bake]\nmode = "pick"\n', 'perception.camera is "" by default; allowed: the name of a camera that is fixed to the world'),
        (
            LEFT + HAND + '[bake]\nmode = "pick"\n[perception]\ncamera = "camera_1"\n',
            'perception.camera is "camera_1" in {path}; allowed: the name of a camera that is fixed to the world',
        ),
    ],
)
def test_what_else_is_refused(tmp_path, text, words):
    with pytest.raises(ConfigError) as caught:
        load(tmp_path, text)
    assert words.format(path=tmp_path / "cell.toml") in str(caught.value)


def test_perception_takes_the_first_camera_that_does_not_move(tmp_path):
    rig = load(tmp_path, HAND + LEFT + '[bake]\nmode = "pick"\n').rig
    assert (rig.index(""), rig.groups) == (1, ((0,), (1,)))
    load(tmp_path, HAND)  # Nothing is planned where objects are only stirred.


def test_jitter_is_kept_and_makes_a_group_of_its_own(tmp_path):
    config = load(tmp_path, LEFT + "[camera.jitter]\nposition = { normal = [0.0, 0.002] }\n" + LEFT.replace('"left"', '"right"'))
    again = tmp_path / "again.toml"
    again.write_text(config_to_toml(config))
    assert load_config(str(again)) == config
    assert config.rig.groups == ((0,), (1,))


def test_cameras_are_rendered_together_where_they_are_alike(tmp_path):
    def groups(*more: str) -> tuple[tuple[int, ...], ...]:
        return load(tmp_path, "".join(LEFT.replace('"left"', f'"c{index}"') + text for index, text in enumerate(more))).rig.groups

    lens, drawn = "distortion = [-0.1, 0, 0, 0]\n", "jitter.center = { uniform = [-1, 1] }\n"
    assert groups("", lens, "") == ((0, 1, 2),)
    assert groups(drawn, lens + drawn, drawn, lens) == ((0, 2), (1,), (3,))
    assert groups('modalities = ["color"]\n', 'modalities = ["depth"]\n', 'modalities = ["color", "masks"]\n') == ((0, 2), (1,))


def test_options_that_would_have_no_effect_are_refused(tmp_path):
    for key, value in (("cameras.resolution", [64, 48]), ("cameras.fov", 30.0)):
        with pytest.raises(ConfigError, match=rf"{key} is .* on the command line; allowed: none, as the \[\[camera\]\] tables"):
            load(tmp_path, LEFT, **{key.replace(".", "__"): value})
    with pytest.raises(ConfigError, match=r"camera cannot be set on the command line; write \[\[camera\]\] tables into a file"):
        load(tmp_path, LEFT, camera__fov=3)
