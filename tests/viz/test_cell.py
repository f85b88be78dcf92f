"""Sheet of a cell: projections and frusta of known cameras, objects laid out, and the command. Sheet of symmetries: which axes are drawn,
and the command on folders of models and data sets."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.apps.viz.cell import CellScene, Picture, describe_camera, lay_out, scaled_down
from synpick_warp.apps.viz.frusta import Canvas, draw_camera, footprint, image_border, project, rays
from synpick_warp.apps.viz.symmetries import group_turns
from synpick_warp.configs.files.load import load_config
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.scenes.cameras import describe_cameras
from synpick_warp.scenes.embedded.objects import procedural_objects
from synpick_warp.scenes.symmetries.detection import turn_matrix
from tests.builders import mistake, run
from tests.worlds.bin_meshes import sloped_bin
from tests.worlds.model_files import exported, put
from tests.worlds.shapes import camera, distorted

BEHIND = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
"""World to camera of a camera that looks along +y; up in the image is +z."""
TOP = camera(80, 60, 100.0, (0.1, 0.2, 2.0))
BENT = distorted(TOP, -0.2, 0.05, 1e-3, -1e-3, 0.01)


def test_points_are_projected_as_by_opencv():
    points = np.random.default_rng(0).uniform((-0.5, -0.3, 0.0), (0.7, 0.7, 0.5), (50, 3))
    k, lens = BENT.matrix, BENT.lens
    assert lens
    expected = cv2.projectPoints(points, cv2.Rodrigues(BENT.rotation)[0], BENT.translation, k, np.array(lens.lens.coefficients))[0]
    places, depths = project(BENT, points)
    assert np.allclose(places, expected[:, 0], atol=1e-9)
    assert np.allclose(depths, 2.0 - points[:, 2])
    for view in (TOP, BENT):
        pixels = np.array([[0.0, 0.0], [80.0, 60.0], [12.5, 40.5]])
        at = np.array((0.1, 0.2, 2.0)) + 1.7 * rays(view, pixels)
        assert np.allclose(project(view, at)[0], pixels, atol=1e-8)


def test_a_footprint_is_where_the_borders_rays_meet_the_floor():
    border, meets = footprint(TOP, 0.0, 5.0)
    assert meets.all()
    # 80 px with a focal length of 100 px, from 2 m: 1.6 m.
    assert np.allclose((border.min(axis=0), border.max(axis=0)), ((0.1 - 0.8, 0.2 - 0.6, 0.0), (0.1 + 0.8, 0.2 + 0.6, 0.0)))
    border, meets = footprint(camera(80, 60, 100.0, (0.0, -3.0, 1.0), BEHIND), 0.0, 5.0)
    corners = border[:: len(border) // 4]
    assert not meets[: len(border) // 2].all()
    assert np.allclose(corners[:, 1], (2.0, 2.0, 1.0 / 0.3 - 3.0, 1.0 / 0.3 - 3.0))


def test_scaled_images_have_the_same_rays():
    for view in (TOP, BENT):
        small = scaled_down(view, 40)
        assert (small.width, small.height) == (40, 30)
        assert np.allclose(rays(small, image_border(small)), rays(view, image_border(view)), atol=1e-8)
    assert scaled_down(TOP) is TOP


@pytest.mark.parametrize(("wall", "opacity"), [(10.0, 1.0), (1.0, 0.3)])
def test_lines_behind_surfaces_are_faint(wall, opacity):
    outside = camera(120, 90, 100.0, (0.0, -3.0, 1.0), BEHIND)
    blank = Picture(outside, np.zeros((90, 120, 3), np.uint8), np.full((90, 120), wall, np.float32))
    canvas = Canvas(blank)
    canvas.line(np.array((-1.0, 0.0, 1.0)), np.array((1.0, 0.0, 1.0)), (0, 0, 200), 3)
    drawn = canvas.image()[44:47, 30:90, 2]
    assert np.abs(drawn.max(axis=0).astype(int) - round(200 * opacity)).max() <= 1


def test_a_camera_is_drawn_to_scale():
    outside = camera(400, 300, 200.0, (0.0, -4.0, 1.0), BEHIND)
    blank = Picture(outside, np.full((300, 400, 3), 255, np.uint8), np.full((300, 400), 1e30, np.float32))
    canvas = Canvas(blank)
    draw_camera(canvas, camera(80, 60, 100.0, (0.0, 0.0, 2.0)), "", (0, 0, 0), size=0.5, floor=0.0, most=9.0)
    dark = (canvas.image() < 128).all(axis=2)
    rows, columns = np.nonzero(dark)
    # The apex is 1 m above the middle, and 4 m away; the view is 1.6 m wide on the floor, of which the near edge is 3.4 m away.
    assert rows.min() == pytest.approx(150 - 50, abs=2)
    assert rows.max() == pytest.approx(150 + 200 / 3.4, abs=2)
    assert (columns.min() + 1, columns.max()) == pytest.approx((200 - 160 / 3.4, 200 + 160 / 3.4), abs=2)


@pytest.fixture
def sloped(tmp_path) -> Path:
    """Settings of a bin of a mesh, whose floor rises, with a divider, modelled 1 m away; both cameras look at it."""
    sloped_bin().apply_translation((1.0, 0.0, 0.5)).export(tmp_path / "sloped.stl")
    text = CELL.replace("[0.0, -0.4, 1.1]", "[1.0, -0.4, 1.6]").replace("[0.0, 0.0, 0.1]", "[1.0, 0.0, 0.6]")
    text = text.replace("[0.0, 0.0, 1.2]", "[1.0, 0.0, 1.7]").replace("[0.0, 0.0, 0.0]", "[1.0, 0.0, 0.5]")
    bins = '[bins]\nkind = "own"\n[[bin]]\nname = "sloped"\nfile = "sloped.stl"\nplace = "file"\ncolor = [0.65, 0.05, 0.04]\n'
    (tmp_path / "cell.toml").write_text(text + bins)
    return tmp_path / "cell.toml"


def test_objects_lie_on_a_slope_and_in_one_compartment(sloped):
    sizes, objects = load_settings(sloped).cell.bins[0], procedural_objects()
    laid = lay_out(objects, sizes)
    assert len(laid.indices) > 3
    for index, place in zip(laid.indices, laid.positions, strict=True):
        points = objects[index].mesh.vertices
        (left, front, bottom), (right, back, _) = points.min(axis=0) + place, points.max(axis=0) + place
        assert -0.2 < left < right < 0.047
        assert -0.15 < front < back < 0.15
        assert bottom == pytest.approx(0.04 * (right + 0.2) / 0.4, abs=2e-3)


def test_objects_lie_side_by_side_on_the_floor():
    for preset, settings in (("smoke", {}), ("tabletop", {}), ("smoke", {"bins.kind": "pallet"})):
        sizes, objects = load_config(preset, settings).cell.bins[0], procedural_objects()
        laid = lay_out(objects, sizes)
        boxes = [
            np.stack([objects[index].mesh.vertices.min(axis=0) + place, objects[index].mesh.vertices.max(axis=0) + place])
            for index, place in zip(laid.indices, laid.positions, strict=True)
        ]
        assert len(boxes) > 5
        assert np.allclose([box[0, 2] for box in boxes], 0.0, atol=1e-6)
        assert all((np.abs(box[:, :2]) < np.array(sizes.floor) / 2).all() for box in boxes)
        for index, one in enumerate(boxes):
            assert not any(((one[0] < other[1]) & (other[0] < one[1]))[:2].all() for other in boxes[:index])


def test_what_a_camera_covers_is_said():
    tote = load_config("smoke").cell.bins[0]
    lines = describe_camera(BENT, "left", tote)
    assert lines[0].startswith("left: 80 x 60 px, 4")
    assert lines[1].endswith(", pinhole 5 coefficients")
    assert describe_camera(TOP, "top", tote)[2] == "2.00 m to the floor, 20 mm/px; 8 of 8 corners of the tote in view"
    assert "; 0 of 8 corners" in describe_camera(camera(80, 60, 100.0, (3.0, 0.0, 2.0)), "off", tote)[2]


@pytest.mark.parametrize(
    ("settings", "blocked"),
    [
        ({"cameras.positions": [[0.0, 0.0, 2.0], [0.1, 0.1, 1.0], [0.4, 0.0, 1.0]]}, [1]),
        ({"pick.lift_height": 2.0, "bins.kind": "none"}, [0]),
    ],
)
def test_a_camera_in_the_way_of_the_gripper_is_named(settings, blocked):
    config = load_config("smoke", settings)
    lines, none = (describe_cameras(picks, config.rig, config.cell.bins, config.gripper, config.pick) for picks in (True, False))
    assert none == []
    assert [int(line[14]) for line in lines] == blocked
    assert all(line.startswith("camera camera_") and " stands over the t" in line for line in lines)


def test_a_camera_on_the_gripper_is_where_the_gripper_is_drawn():
    scene = object.__new__(CellScene)
    scene.config = config = load_config("smoke")
    scene.sizes = config.cell.bins
    placed = scene.placed(replace(TOP, fixed_to="gripper"))
    # The gripper's shaft ends at the wrist axis, a cup's length above the cup, which is 0.15 m over the rim.
    rim = config.tote.outer_size[2] - config.tote.wall
    assert placed.center == pytest.approx((0.1, 0.2, 2.0 + rim + 0.15 + config.gripper.cup_length))
    assert (placed.fixed_to, scene.placed(TOP)) == ("world", TOP)


CELL = """preset = "smoke"
[[camera]]
name = "left"
resolution = [64, 48]
fov = 50.0
pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }
[[camera]]
name = "top"
resolution = [32, 48]
fov = 30.0
pose = { position = [0.0, 0.0, 1.2], look_at = [0.0, 0.0, 0.0], up = [0.0, 1.0, 0.0] }
"""


@pytest.mark.parametrize("own", [False, True])
def test_the_command_draws_a_cell(tmp_path, own, request):
    cell = tmp_path / "cell.toml"
    if own:
        request.getfixturevalue("sloped")
    else:
        cell.write_text(CELL)
    ran = run("preview", "--cell", cell)
    assert ran.code == 0, ran.err
    assert ran.out.endswith(f"cell: {tmp_path / 'cell.png'}\n")
    sheet = cv2.imread(str(tmp_path / "cell.png"))
    assert sheet is not None
    # Both panels show the red tote, and cameras are drawn in colours of their own.
    panels = sheet[-560:, :1000].astype(int)
    assert ((panels[..., 2] > 80) & (panels[..., 1] < 40))[:, :480].any()
    assert {path.name for path in tmp_path.iterdir()} - {"sloped.stl"} == {"cell.png", "cell.toml"}


# ---- symmetries ----


def test_axes_are_grouped_with_their_largest_fold():
    turns = [(np.eye(3)[2], fold) for fold in (4, 2)] + [(-np.eye(3)[2], 4), (np.eye(3)[0], 2)]
    middle = np.array((0.1, 0.2, 0.3))
    matrices = tuple(tuple(turn_matrix(axis, middle, 2.0 * np.pi / fold).reshape(-1)) for axis, fold in turns)
    raw = replace(procedural_objects()[0], symmetries_discrete=matrices, symmetries_continuous=(((0.0, 1.0, 0.0), (0.0, 0.0, 0.0)),))
    found = group_turns(raw)
    assert [turn.fold for turn in found] == [0, 4, 2]
    assert [tuple(turn.axis.round(6) + 0.0) for turn in found] == [(0, 1, 0), (0, 0, 1), (1, 0, 0)]
    assert np.allclose(found[1].point[:2], middle[:2])


def test_the_symmetries_of_a_folder_of_parts(tmp_path):
    put(tmp_path / "parts" / "nut.stl", exported(trimesh.creation.cylinder(30.0, 20.0, sections=6), "stl"))
    put(tmp_path / "cell.toml", "preset = 'smoke'\n[objects]\nunit = 'mm'\n")
    said = run("preview", tmp_path / "parts", "--symmetries", "--config", tmp_path / "cell.toml", "--out", tmp_path / "a.png").out
    assert "nut.stl: 60 x 51.96 x 20 mm, unit mm" in said
    assert "nut.stl: symmetries detected: 6-fold about (0, 0, 1), 2-fold about (" in said
    assert ", 3 more axes; they move its surface by up to " in said
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    assert image.shape[1] == 5 * image.shape[0] * 260 // 304  # The part, and four rotations.
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 10


def test_parts_are_compared_with_the_bins_mesh(tmp_path):
    """A part that does not fit into a bin of the default size."""
    put(tmp_path / "parts" / "plate.stl", exported(trimesh.creation.box((0.6, 0.5, 0.1)), "stl"))
    sloped_bin().apply_scale(2.2).export(tmp_path / "bin.stl")
    put(tmp_path / "cell.toml", "preset = 'smoke'\n[bins]\nkind = 'own'\n[[bin]]\nname = 'large'\nfile = 'bin.stl'\n")
    assert "plate.stl: symmetries detected" in run("preview", tmp_path / "parts", "--symmetries", "--config", tmp_path / "cell.toml").out


def test_the_symmetries_that_a_data_set_states(picked_set, tmp_path):
    assert run("preview", picked_set, "--symmetries", "--out", tmp_path / "a.png").out == f"symmetries: {tmp_path / 'a.png'}\n"
    assert "which has its settings" in mistake("preview", picked_set, "--symmetries", "--config", "smoke")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--cell", "gone.toml"], "there is no file gone.toml"),
        (["--cell", "smoky"], 'there is no preset "smoky"'),
        (["--cell", "smoke", "--symmetries"], "--symmetries is given beside --cell"),
        (["--cell", "smoke", "--config", "smoke"], "--config is given beside --cell"),
        (["--cell", "smoke", "--out", "a.txt"], "a.txt is not an image file"),
        (["--cell", "cell.toml"], "camera[0].fov is 500.0 in cell.toml"),
        (["--cell", "parts.toml"], "models folder {here}/gone: no such folder"),
        (["gone", "--symmetries"], "models folder gone: no such folder"),
        (["--symmetries"], "no data set"),
        ([".", "--config", "smoke"], "--config is given without --symmetries"),
        ([".", "--symmetries", "--out", "a.txt"], "a.txt is not an image file"),
    ],
)
def test_mistakes_are_one_line(tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cell.toml").write_text(CELL.replace("50.0", "500.0"))
    (tmp_path / "parts.toml").write_text('preset = "smoke"\n[bake]\nmodels = "gone"\n')
    assert said.format(here=tmp_path) in mistake("preview", *arguments)
    assert len(list(tmp_path.iterdir())) == 2
