"""Command new-cell: what it writes of calibrations, bins and parts, that its examples are valid, and what is refused."""

import itertools
import json
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.apps.viz import cell
from synpick_warp.apps.viz.frusta import project
from synpick_warp.cli.commands import new_cell
from synpick_warp.configs.cell.cameras import intrinsics
from synpick_warp.configs.episodes.objects import MATERIALS
from synpick_warp.configs.files.cell_file import WIDTH
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import LightError
from synpick_warp.scenes.bin_meshes.loading import load_settings
from synpick_warp.scenes.cameras import describe_cameras, make_cameras
from synpick_warp.scenes.catalog import load_catalog
from tests.builders import mistake, run
from tests.worlds.bin_meshes import sloped_bin
from tests.worlds.model_files import OBJ, exported, put

K = np.array([[275.0, 0.0, 163.3], [0.0, 274.6, 117.0], [0.0, 0.0, 1.0]])
"""With pixel centres at integers: 163.8, 117.5 here."""
FIVE = [-0.12, 0.08, 5e-4, -3e-4, 0.01]
ZIVID = {
    "CameraMatrix": {"FX": 275.0, "FY": 274.6, "CX": 163.3, "CY": 117.0},
    "Distortion": dict(zip(("K1", "K2", "P1", "P2", "K3"), FIVE, strict=True)),
}


def opencv(path: Path, distortion=FIVE) -> Path:
    """A calibration as OpenCV writes it."""
    path.parent.mkdir(exist_ok=True)
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in (("image_width", 320), ("image_height", 240), ("camera_matrix", K)):
        storage.write(name, value)
    storage.write("distortion_coefficients", np.array([distortion]))
    storage.release()
    return path


@pytest.fixture
def drawn(monkeypatch) -> list[str]:
    """Pictures are not rendered; titles of those asked for, and parts that need not be read again."""
    titles: list[str] = []

    def draw(file, name, out, progress, say, objects):
        titles.extend([name, *(raw.name for raw in objects or ())])
        out.write_bytes(b"")

    monkeypatch.setattr(new_cell, "draw_cell", draw)
    return titles


def test_a_cell_without_options_is_complete(tmp_path, monkeypatch):
    monkeypatch.setattr(cell, "scaled_down", partial(cell.scaled_down, most=96))
    monkeypatch.chdir(tmp_path)
    ran = run("new-cell", "CELL")
    assert ran.code == 0, ran.err
    assert ran.out.splitlines()[-2:] == [
        "cell: CELL/cell.toml, picture: CELL/cell.png",
        "bake it: synpick-warp bake --config CELL/cell.toml --out DATA",
    ]
    assert sorted(path.name for path in Path("CELL").iterdir()) == ["cell.png", "cell.toml"]
    assert [path.name for path in tmp_path.iterdir()] == ["CELL"]
    sheet = cv2.imread("CELL/cell.png")
    assert sheet is not None
    assert min(sheet.shape[:2]) > 800
    config = load_config("CELL/cell.toml")
    assert config.rig.names == ("top", "side")
    assert config.cell.bins[0].outer == (0.6, 0.4)


def test_commands_are_quoted_where_the_folder_needs_it(tmp_path, monkeypatch, drawn):
    monkeypatch.chdir(tmp_path)
    assert run("new-cell", "Zelle ö 1").out.endswith("bake it: synpick-warp bake --config 'Zelle ö 1/cell.toml' --out DATA\n")
    assert "preview --cell 'Zelle ö 1/cell.toml'" in Path("Zelle ö 1/cell.toml").read_text()


@pytest.mark.parametrize("options", [[], ["--bin", "kanban.stl"]])
def test_each_setting_is_explained_and_each_example_is_valid(tmp_path, monkeypatch, drawn, options):
    monkeypatch.chdir(tmp_path)
    put(tmp_path / "kanban.stl", exported(sloped_bin(), "stl"))
    assert run("new-cell", "cell", *options).code == 0
    text = Path("cell/cell.toml").read_text()
    lines = text.splitlines()
    assert max(len(line) for line in lines if line.startswith("# ")) <= WIDTH
    table, explained = "", set()
    for before, line in itertools.pairwise(lines):
        header = re.fullmatch(r"#?\[+([a-z_]+)\]+", line)
        table = header[1] if header else table
        setting = re.match(r"#?([a-z_]+) = ", line)
        if setting and (table, setting[1]) not in explained and setting[1] != "preset":
            assert re.match(r"# .*\.$", before), line
            explained.add((table, setting[1]))
    assert len(explained) > 40
    said = text.replace("\n# ", " ")
    for word in ("[px]", "[°]", "[m]", "[m³]", "[kg]", "[sRGB]", "at least -180, at most 180"):
        assert word in said
    assert ("Allowed: above 0, at most 10." in said) == (not options)  # Of a divider's height.
    path = Path("cell/all.toml")
    path.write_text(re.sub(r"^#(?=[\[a-z])", "", text, flags=re.MULTILINE))
    config = load_config(path)
    assert config.rig.names == ("top", "side", "measured")
    assert (config.bake.seed, config.randomize.object_hue.kind, config.depth_sensor.preset) == (7, "normal", "d435")
    assert config.object_rows[0].name == "NAME"


@pytest.mark.parametrize(
    ("file", "text", "options"),
    [
        ("Left 1.yaml", None, []),
        ("zivid.json", json.dumps({"CameraIntrinsics": ZIVID}), ["--resolution", "320x240"]),
        ("camera.json", json.dumps({"width": 320, "height": 240, "fx": 275.0, "fy": 274.6, "cx": 163.8, "cy": 117.5}), []),
        ("world.xml", None, []),
    ],
)
def test_a_camera_is_that_of_its_calibration_and_sees_the_bin(tmp_path, drawn, file, text, options):
    path = tmp_path / "calibration" / file
    path.parent.mkdir()
    opencv(path) if text is None else path.write_text(text)
    before = path.read_bytes()
    assert run("new-cell", tmp_path / "cell", "--calibration", path, "--calibration", path, *options, "--bin", "400x300x120mm").code == 0
    config = load_config(tmp_path / "cell" / "cell.toml")
    assert f'file = "../calibration/{file}"' in (tmp_path / "cell" / "cell.toml").read_text()
    assert config.rig.sizes == ((320, 240),) * 2
    assert intrinsics(config.camera[0]) == pytest.approx((275.0, 274.6, 163.8, 117.5))
    assert config.camera[0].distortion == (None if "cx" in (text or "") else tuple(FIVE))
    assert config.rig.names[0] in ("left_1", "zivid", "camera", "camera_world")
    assert config.rig.names[1] == f"{config.rig.names[0]}_2"
    assert config.perception.resolution == (640, 480)
    for camera in make_cameras(config.rig):
        pixels, depth = project(camera, np.array(config.cell.bins[0].corners))
        assert (depth > 0.0).all()
        assert ((pixels > 0.0) & (pixels < (320.0, 240.0))).all()
        assert not describe_cameras(True, config.rig, config.cell.bins, config.gripper, config.pick)
        # No farther than needed: the bin reaches a border that is kept free.
        assert np.min([pixels, (320.0, 240.0) - pixels]) < 0.06 * 320
    assert path.read_bytes() == before


def test_four_coefficients_may_be_of_a_fisheye(tmp_path, drawn):
    path = opencv(tmp_path / "a.yaml", [0.02, -0.01, 0.003, -0.001])
    assert 'set model = "pinhole" or "fisheye"' in mistake("new-cell", tmp_path / "cell", "--calibration", path)
    assert run("new-cell", tmp_path / "cell", "--calibration", path, "--lens", "fisheye").code == 0
    assert load_config(tmp_path / "cell" / "cell.toml").camera[0].model == "fisheye"


@pytest.mark.parametrize(("offset", "center"), [(0.0, False), (8.0, False), (10.0, True), (500.0, True)])
def test_parts_are_copied_with_their_unit(tmp_path, drawn, offset, center):
    mesh = trimesh.creation.box((80.0, 40.0, 12.0))
    mesh.apply_translation((offset, 0.0, 0.0))
    part = put(tmp_path / "in" / "bracket.stl", exported(mesh, "stl"))
    assert run("new-cell", tmp_path / "cell", "--part", part, "--unit", "mm", "--bin", "0.3x0.2x0.1").code == 0
    assert (tmp_path / "cell" / "parts" / "bracket.stl").read_bytes() == part.read_bytes()
    config = load_config(tmp_path / "cell" / "cell.toml")
    assert config.bake.models == str(tmp_path / "cell" / "parts")
    assert (config.objects.unit, config.objects.center, config.objects.symmetries) == ("mm", center, "detect")
    assert drawn == ["cell/cell.toml", "bracket"]
    (tmp_path / "cell").rename(tmp_path / "moved")
    assert load_config(tmp_path / "moved" / "cell.toml").bake.models == str(tmp_path / "moved" / "parts")


@pytest.mark.parametrize(
    ("options", "mass", "said"),
    [
        (["--density", "steel"], 7850 * 38.4e-6, "mass of block: 0.301 kg, 7850 kg/m³ of their meshes\n"),
        (["--density", "700"], 700 * 38.4e-6, "mass of block: 0.0269 kg, 700 kg/m³ of their meshes\n"),
        (["--mass", "0.25"], 0.25, ""),
        ([], 400 * 38.4e-6, "mass of block: 0.0154 kg, 400 kg/m³ of their convex hulls, is a guess; set objects.density"),
    ],
)
def test_parts_have_the_mass_or_the_density_that_is_given(tmp_path, drawn, options, mass, said):
    part = put(tmp_path / "in" / "block.stl", exported(trimesh.creation.box((80.0, 40.0, 12.0)), "stl"))
    ran = run("new-cell", tmp_path / "cell", "--part", part, "--unit", "mm", "--bin", "0.3x0.2x0.1", *options)
    assert said in ran.out + ran.err
    assert ("mass of block" in ran.out + ran.err) == bool(said)
    lines: list[str] = []
    (entry,) = load_catalog(load_settings(tmp_path / "cell" / "cell.toml"), tmp_path / "cache", lines.append).entries
    assert entry.mass == pytest.approx(mass)
    assert any("is a guess" in line for line in lines) == (not options)


def test_a_large_part_has_its_volume_and_a_folder_is_named(tmp_path, drawn):
    put(tmp_path / "in" / "block.ply", exported(trimesh.creation.box((0.3, 0.2, 0.15)), "ply"))
    assert run("new-cell", tmp_path / "cell", "--part", tmp_path / "in").code == 0
    config = load_config(tmp_path / "cell" / "cell.toml")
    assert config.bake.models == str(tmp_path / "in")
    assert config.arrangement.volume == pytest.approx(2 * 0.3 * 0.2 * 0.15)
    assert sorted(path.name for path in (tmp_path / "cell").iterdir()) == ["cell.png", "cell.toml"]


@pytest.mark.parametrize(
    ("file", "options", "up", "kept"),
    [
        ("kanban 1.stl", ["--bin-unit", "mm"], "z", "bins/kanban 1.stl"),
        ("kanban.glb", ["--bin-unit", "mm", "--bin-up", "y"], "y", "bins/kanban.glb"),
        ("kanban.obj", ["--bin-unit", "mm"], "z", "../in/kanban.obj"),
    ],
)
def test_a_bin_is_that_of_its_mesh(tmp_path, drawn, file, options, up, kept):
    mesh = sloped_bin()
    mesh.apply_scale(1e3)
    if up == "y":
        mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, (1.0, 0.0, 0.0)))
    path = put(tmp_path / "in" / file, (b"mtllib gone.mtl\n" if file.endswith("obj") else b"") + exported(mesh, file[-3:]))
    assert run("new-cell", tmp_path / "cell", "--bin", path, *options).code == 0
    assert f'file = "{kept}"' in (tmp_path / "cell" / "cell.toml").read_text()
    config = load_settings(tmp_path / "cell" / "cell.toml")
    assert (config.bin[0].name, config.bin[0].unit, config.bin[0].up) == ("bin", "mm", up)
    assert Path(config.bin[0].file or "").read_bytes() == path.read_bytes()
    (sizes,) = config.cell.bins
    assert (*sizes.outer, sizes.height, sizes.base) == pytest.approx((0.408, 0.308, 0.2, -0.004), abs=1e-3)
    # A tenth of the inside: the floor rises by 40 mm, and the divider takes 6 mm of 400.
    assert config.arrangement.volume == pytest.approx(0.1 * 0.394 * 0.3 * 0.18, rel=0.03)
    for camera in make_cameras(config.rig):
        pixels, _ = project(camera, np.array(sizes.corners))
        assert ((pixels > 0.0) & (pixels < (640.0, 480.0))).all()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["full"], "full is not empty; new-cell takes a new or an empty folder"),
        (["file"], "file cannot be used: Not a directory; new-cell takes"),
        (["file/cell"], "cannot write file/cell: Not a directory; free space or rights there"),
        (["set/cell"], "DIR is set/cell, among the files of the data set"),
        (["c", "--calibration", "gone.yaml"], "there is no file gone.yaml"),
        (["c", "--calibration", "empty.yaml"], "empty.yaml is no calibration file"),
        (["c", "--calibration", "folds.yaml"], "folds.yaml: distortion "),
        (["c", "--calibration", "zivid.json"], "zivid.json does not say the image's size; add --resolution WIDTHxHEIGHT"),
        (["c", "--lens", "fish"], '--lens is "fish"; allowed: pinhole, fisheye; did you mean fisheye?'),
        (["c", "--resolution", "0x0"], "--resolution is 0x0; allowed: each side at least 1, at most 8192 [px]"),
        (["c", "--resolution", "640"], '--resolution is "640"; allowed: WIDTHxHEIGHT'),
        (["c", "--bin", "600x400"], '--bin is "600x400"; allowed: LENGTHxWIDTHxHEIGHT in metres'),
        (["c", "--bin", "1.2.3x1x1"], '--bin is "1.2.3x1x1"; allowed'),
        (
            ["c", "--bin", "600x400x220"],
            "--bin is 600 x 400 x 220 m; allowed: 0.08 to 3 m long and wide, 0.03 to 1 m high; did you mean mm?",
        ),
        (["c", "--bin", "0.6x0.4x0.001"], "--bin is 0.6 x 0.4 x 0.001 m; allowed"),
        (["c", "--bin", "in"], '--bin is "in"; allowed: LENGTHxWIDTHxHEIGHT in metres, or as 600x400x220mm, or a mesh file'),
        (["c", "--bin", "gone.stl"], "gone.stl cannot be read (No such file or directory)"),
        (["c", "--bin", "bin.stl"], "bin.stl is 408 x 308 x 204 m, unit m; allowed: a longest side of 0.02 to 10 m; did you mean --bin-u"),
        (["c", "--bin", "bin.stl", "--bin-unit", "mm", "--bin-up", "x"], "bin.stl has no inside as seen from above, with up = x"),
        (["c", "--bin", "bin.stl", "--bin-unit", "inch"], '--bin-unit is "inch"; allowed: m, cm, mm, in'),
        (["c", "--bin", "bin.stl", "--bin-up", "w"], '--bin-up is "w"; allowed: z, -z, y, -y, x, -x'),
        (["c", "--bin-unit", "mm"], "--bin-unit is given without a mesh file; allowed: beside --bin FILE"),
        (["c", "--bin", "bin.stl", "--bin-unit", "mm", "--part", "nut.stl"], "nut: too large for the bin"),
        (["c", "--bin", "b\udcff.stl", "--bin-unit", "mm"], "cannot write c/cell.toml: the name of a file or folder in it is not UTF-8"),
        (["c", "--part", "gone.stl"], "there is no file gone.stl"),
        (["c", "--part", "gone"], "there is no file or folder gone, which --part names"),
        (["c", "--part", "empty.yaml"], '--part is "empty.yaml"; allowed: a file that ends in'),
        (["c", "--part", "a.obj"], "--part is a.obj, which refers to other files; name its folder"),
        (["c", "--part", "nut.stl"], "nut: too large for the bin"),
        (["c", "--part", "nut.stl", "--unit", "inch"], '--unit is "inch"; allowed: m, cm, mm, in'),
        (["c", "--unit", "mm"], "--unit is given without --part"),
        (["c", "--mass", "0.1"], "--mass is given without --part"),
        (["c", "--part", "nut.stl", "--mass", "0"], "--mass is 0; allowed: 1e-07 to 10000 kg"),
        (["c", "--part", "nut.stl", "--mass", "1", "--density", "abs"], "--mass is given beside --density; allowed: one of both"),
        (["c", "--part", "nut.stl", "--density", "stel"], '--density is "stel"; allowed: 10 to 100000 kg/m³, or abs, '),
        (
            ["c", "--part", "nut.stl", "--density", "7.85"],
            f'--density is "7.85"; allowed: 10 to 100000 kg/m³, or {", ".join(MATERIALS)}; did you mean 7850?',
        ),
        (["c", "--part", "nut.stl", "--density", "nan"], '--density is "nan"; allowed: '),
        (["c", "--part", "nut.stl", "--part", "in/nut.stl", "--unit", "mm"], '--part names "nut" 2 times'),
        (["c", "--part", "nut.stl", "--part", "in", "--unit", "mm"], "--part names a folder beside other parts"),
        (["c", "--part", "void.stl"], "c/parts/void.stl: "),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(tmp_path, monkeypatch, drawn, arguments, said):
    monkeypatch.chdir(tmp_path)
    for name in ("full/x", "file", "empty.yaml", "set/manifest.json", "set/manifest/x", "in/x", "void.stl"):
        put(tmp_path / name, b"")
    put(tmp_path / "a.obj", OBJ.encode())
    for name in ("nut.stl", "in/nut.stl"):
        put(tmp_path / name, exported(trimesh.creation.cylinder(10.0, 8.0, sections=6), "stl"))
    kanban = sloped_bin()
    kanban.apply_scale(1e3)
    for name in ("bin.stl", "b\udcff.stl"):
        put(tmp_path / name, exported(kanban, "stl"))
    put(tmp_path / "zivid.json", json.dumps({"CameraIntrinsics": ZIVID}).encode())
    opencv(tmp_path / "folds.yaml", [-2.0, 0.0, 0.0, 0.0, 0.0])
    before = sorted(tmp_path.rglob("*"))
    assert mistake("new-cell", *arguments).startswith(said)
    assert sorted(tmp_path.rglob("*")) == before
    assert not drawn


@pytest.mark.parametrize("exists", [False, True])
def test_nothing_is_half_written(tmp_path, monkeypatch, exists):
    def fail(*_):
        raise LightError("no light")

    monkeypatch.setattr(new_cell, "draw_cell", fail)
    folder = tmp_path / "deep" / "cell"
    if exists:
        folder.mkdir(parents=True)
    assert mistake("new-cell", folder) == "no light"
    assert list(tmp_path.rglob("*")) == ([folder.parent, folder] if exists else [])
    monkeypatch.setattr(new_cell, "draw_cell", lambda file, name, out, *_: out.write_bytes(b""))
    assert run("new-cell", folder).code == 0
    assert sorted(path.name for path in folder.iterdir()) == ["cell.png", "cell.toml"]
