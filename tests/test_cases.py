"""Inputs of users in tests/cases, one row each: what a command says of them, or what is right."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import yaml

import synpick_warp
from synpick_warp.apps.evaluation.errors import read_models
from synpick_warp.cli.commands import new_cell
from synpick_warp.configs.calibration.files import Calibration, read_calibration
from synpick_warp.configs.cell.bins import BinRow
from synpick_warp.configs.cell.gripper import describe_forces
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import CatalogError
from synpick_warp.exporters.picks import pick_files
from synpick_warp.scenes.assets.appearance import decode_texture
from synpick_warp.scenes.bin_meshes.reading import read_bin
from synpick_warp.scenes.cameras import make_cameras
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.types import CatalogEntry
from tests.builders import mistake, run
from tests.worlds.box_sets import write_pick_set
from tests.worlds.cells import bake_cell, cell_config
from tests.worlds.model_files import load_models

CASES = Path(__file__).parent / "cases"
KINDS = ("bins", "calibrations", "cells", "meshes", "parts", "picks", "settings")
"""Folders whose inputs have a row here; lights and others have theirs in tests/scenes."""
Check = Callable[[Path, Path], None]
"""Takes the path of an input and an empty folder for output; asserts."""


# ---- bins: floor and opening, and what is said ----


def _measures(floor: tuple[float, float], opening: tuple[float, float], said: str, **settings: str) -> Check:
    """Floor and opening of a bin's mesh [mm], and a line on it."""

    def check(file: Path, _: Path) -> None:
        file = file / "wire.stl" if file.is_dir() else file
        model = read_bin(BinRow(name="own", file=str(file), **settings))
        assert said in " ".join(model.notes)
        for sides, expected in ((model.measured.floor or model.measured.opening, floor), (model.measured.opening, opening)):
            np.testing.assert_allclose(1000.0 * np.array(sides), expected, atol=0.5 if model.measured.floor else 4.0)

    return check


BINS = {
    "bins/hopper.stl": _measures((232.0, 172.0), (488.0, 340.0), "floor 232 x 172 mm, opening 488 x 340 mm", unit="mm"),
    "bins/nofloor.stl": _measures((390.0, 290.0), (390.0, 290.0), "it has no floor: parts will lie on the table"),
    "bins/sloped.stl": _measures((412.0, 262.0), (492.0, 342.0), "floor 412 x 262 mm, opening 492 x 342 mm", unit="mm"),
    "parts/bin_wire": _measures((392.0, 292.0), (392.0, 292.0), "it collides as a closed box", unit="mm", collision="box"),
}


# ---- cameras: calibrations, cells of several cameras, poses ----


POSE = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"


def cell(folder: Path, *lines: str) -> Path:
    """File of settings with a camera for each group of lines."""
    path = folder / "cell.toml"
    path.write_text('preset = "smoke"\n' + "".join(f"[[camera]]\n{each}\n{POSE}\n" for each in lines))
    return path


def bakes_with_the_other(case: Path, out: Path) -> None:
    """Boxes around objects are those of their vertices as OpenCV projects them, in the images of both cameras."""
    files = [case, *(path for path in sorted(case.parent.glob("*.yaml")) if path != case)]
    rows = load_config(str(cell(out, *(f'name = "{path.stem}"\nfile = "{path}"' for path in files)))).camera
    bake_cell(out / "set", cell_config(rows))
    data, checked = synpick_warp.open(out / "set"), 0
    models = read_models(out / "set", data.models_info)
    for camera, path in enumerate(files):
        said, view = yaml.safe_load(path.read_text()), data[0].view(0, camera)
        assert view.rgb.shape == (said["image_height"], said["image_width"], 3)
        matrix, lens = (np.array(said[name]["data"]) for name in ("camera_matrix", "distortion_coefficients"))
        for obj_id, pose, (left, top, width, height) in zip(view.object_ids.tolist(), view.object_to_camera, view.boxes, strict=True):
            points = models[obj_id].vertices @ pose[:3, :3].T + pose[:3, 3]
            pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), matrix.reshape(3, 3), lens)[0][:, 0]
            # Pixels are those whose centres lie in the outline, whose corners may be as thin as two pixels.
            margins = np.array([left, top, -left - width, -top - height]) - (*pixels.min(axis=0), *-pixels.max(axis=0))
            assert ((margins > -1e-3) & (margins < 2.0)).all(), margins
            checked += 1
    assert checked >= 4


def is_read(expected: Calibration) -> Check:
    """A calibration is read, and a camera's row has its numbers."""

    def check(case: Path, out: Path) -> None:
        assert read_calibration(case) == expected
        resolution = "" if expected.width else "resolution = [320, 240]\n"
        (row,) = load_config(str(cell(out, f'{resolution}file = "{case}"'))).camera
        size = (expected.width or 320, expected.height or 240)
        assert (row.resolution, row.matrix[0][0], row.distortion or ()) == (size, expected.fx, expected.distortion)

    return check


def is_refused(*words: str) -> Check:
    """One line has these words, from a cell of a calibration and from new-cell, and nothing is written."""

    def check(case: Path, out: Path) -> None:
        settings = cell(out, f'file = "{case}"')
        for command in (("bake", "--config", settings, "--out"), ("new-cell", "--calibration", case, "--bin", "600x400x220mm")):
            said = mistake(*command, out / "made")
            assert [word for word in words if word in said] == [*words], said
        assert [*out.iterdir()] == [settings]

    return check


def needs_a_size(case: Path, out: Path) -> None:
    """The file of a cell lies where the cell says; it says no size."""
    settings = out / "a" / case.name
    for path in (settings, out / "in" / "cal" / case.stem):
        path.parent.mkdir(parents=True)
        path.write_bytes((case.parent / path.name).read_bytes())
    said = mistake("bake", "--config", settings, "--out", out / "made")
    assert "camera[0].file does not say the image's size in " in said
    assert "set camera[0].resolution" in said


def looks_away(case: Path, out: Path) -> None:
    """The line says how the camera would see the bin, and so it does."""
    said = mistake("bake", "--config", case, "--out", out / "made")
    assert (
        'it looks away from the tote, and would see it with columns 2 and 3 negated: set axes = "opengl" if its axes are OpenGL\'s' in said
    )
    (out / "gl.toml").write_text(case.read_text().replace("pose = {", 'pose = { axes = "opengl",'))
    (camera,) = make_cameras(load_config(str(out / "gl.toml")).rig)
    np.testing.assert_array_equal(camera.rotation, np.diag([1.0, -1.0, -1.0]))
    np.testing.assert_allclose(camera.center, [0.0, 0.0, 1.2])


CAMERAS = {
    "cells/left.yaml": bakes_with_the_other,
    "cells/right.yaml": is_read(Calibration(256, 192, 275.0, 274.6, 128.5, 96.5, distortion=(-0.12, 0.08, 0.0005, -0.0003, 0.01))),
    "calibrations/D_1e308.yaml": is_refused("D_1e308.yaml", "above 1e+06"),
    "calibrations/bop_cam_dist_model_weird_132.json": is_refused('its distortion model is "weird"; allowed: pinhole, fisheye'),
    "calibrations/cam_K.txt": is_read(Calibration(0, 0, 250.0, 250.0, 160.5, 120.5)),
    "calibrations/cam_K.txt.toml": needs_a_size,
    "calibrations/ros.ini": is_read(Calibration(320, 240, 250.0, 250.0, 160.5, 120.5, distortion=(-0.1, 0.05, 0.0, 0.0, 0.0))),
    "calibrations/ros_rational_cols5.yaml": is_read(
        Calibration(320, 240, 250.0, 250.0, 160.5, 120.5, distortion=(0.19, -0.018, -0.0006, 0.00005, -0.0002, 0.54, -0.028, 0.0))
    ),
    "settings/posegl.toml": looks_away,
}


# ---- meshes, parts, models_info.json and TOML ----


def _one_part(sides: tuple[float, ...], turns: int = 0, said: str = "", **objects) -> Check:
    """One object of these sides [m], with a number of continuous symmetries, and a line that ends so; empty: none."""

    def check(case: Path, out: Path) -> None:
        catalog, lines = load_models(case, out, **objects)
        (entry,) = catalog.entries
        assert np.ptp(entry.mesh.vertices, axis=0) == pytest.approx(sides, rel=1e-5)
        assert len(entry.symmetries_continuous) == turns
        assert sum(line.endswith(said) for line in lines if said) == bool(said), lines

    return check


def _has_one_world(case: Path, out: Path) -> None:
    assert load_config(str(case)).bake.worlds == 1


def _is_refused_with_a_line(case: Path, out: Path) -> None:
    """Whatever an earlier bake left in the cache, an object whose decomposition takes too long has no other shape instead."""
    (out / "models").mkdir()
    trimesh.creation.torus(40.0, 10.0).export(out / "models" / "ring.ply")
    config = load_config(str(case))
    config = replace(config, bake=replace(config.bake, models=str(out / "models")))
    for _ in range(2):
        with pytest.raises(CatalogError, match=r"ring: .* took longer than 0\.2 s of processor time .*; decimate"):
            load_catalog(config, out / "cache", lambda line: None)
        assert not (out / "cache").exists()


GREY, ORANGE = (0.7, 0.7, 0.7), (0.962, 0.588, 0.237)
"""ORANGE: sRGB of the linear colour 60000, 20000, 3000 of 65535."""
TILED = CASES / "meshes" / "obj_two_materials_tiled"


def _mesh(
    color: tuple[float, ...] | None = None, *said: str, check: Callable[[CatalogEntry], bool] = lambda entry: True, center: bool = False
) -> Check:
    """The box of a folder with a colour (None: white, with a texture), and one line with these words; none: there is no line."""

    def run(case: Path, out: Path) -> None:
        catalog, lines = load_models(case, out, center=center)
        (entry,) = catalog.entries
        assert entry.material.color == pytest.approx(color or (1.0, 1.0, 1.0), abs=0.003)
        assert (entry.material.texture is None) == (color is not None)
        assert check(entry)
        # Six normals, whether its file has any or not.
        assert len(np.unique(entry.mesh.normals.round(4), axis=0)) == 6
        assert len(lines) == bool(said)
        assert all(words in lines[0] for words in said)

    return run


def _uv_range(low: tuple[float, float], high: tuple[float, float]) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose((entry.mesh.uv.min(axis=0), entry.mesh.uv.max(axis=0)), (low, high), atol=1e-4)


def _extent(*sides: float) -> Callable[[CatalogEntry], bool]:
    return lambda entry: np.allclose(np.ptp(entry.mesh.vertices, axis=0), sides, atol=1e-4)


def _texels(entry: CatalogEntry) -> np.ndarray:
    assert entry.material.texture is not None
    return np.unique(entry.material.texture.reshape(-1, 3), axis=0)


def _shows_both_textures(entry: CatalogEntry) -> bool:
    images = [decode_texture((TILED / name).read_bytes(), name) for name in ("tex.png", "tex2.png")]
    wanted = np.unique(np.concatenate([image.reshape(-1, 3) for image in images]), axis=0)
    atlas = entry.material.texture
    assert atlas is not None
    tiled = any(np.array_equal(atlas[:rows, :columns], np.tile(image, (3, 3, 1))) for image in images for rows, columns in [(192, 192)])
    return tiled and {tuple(color) for color in wanted.tolist()} <= {tuple(color) for color in _texels(entry).tolist()}


def _is_centred(entry: CatalogEntry) -> bool:
    return bool(np.abs(entry.mesh.vertices.min(axis=0) + entry.mesh.vertices.max(axis=0)).max() < 1e-6)


NO_UV = "ignored: texture coordinates without a texture"
SIDES = (0.04, 0.03, 0.02)
MESHES = {
    "cells/decomposition_limit.toml": _is_refused_with_a_line,
    "meshes/glb_plain": _mesh(check=_uv_range((0, 0), (1, 1))),
    "meshes/glb_colour_f32": _mesh(ORANGE),
    "meshes/glb_colour_u16_rgba": _mesh(ORANGE),
    "meshes/glb_colour_f32_factor": _mesh((0.707, 0.427, 0.164)),
    "meshes/glb_uv_u16": _mesh(check=_uv_range((0, 0), (1, 1))),
    "meshes/glb_texture_transform": _mesh(check=_uv_range((0, 0.75), (0.25, 1))),
    "meshes/glb_quantized": _mesh(check=_extent(0.1, 0.08, 0.06)),
    "meshes/mtl_backslash": _mesh(None, r"refers to '.\\tex.png'; "),
    "meshes/mtl_scale": _mesh(check=_uv_range((0.5, 0), (3.5, 3))),
    "meshes/mtl_map_ka_only": _mesh(GREY, "ignored: map_Ka"),
    "meshes/mtl_not_used": _mesh(GREY, "triangles without a material, the default is used", NO_UV),
    "meshes/obj_uv_no_material": _mesh(GREY, NO_UV),
    "meshes/mtl_absent": _mesh(GREY, "there is no material library 'part.mtl', the default material is used"),
    "meshes/mtl_unused_missing_texture": _mesh(None, "the image 'gone.png' of an unused material is missing"),
    "meshes/ply_vertex_colour": _mesh(check=lambda entry: [230, 120, 20] in _texels(entry).tolist()),
    "meshes/ply_face_colour": _mesh(check=lambda entry: len(_texels(entry)) >= 2),
    "meshes/obj_two_materials_tiled": _mesh(check=_shows_both_textures),
    "meshes/obj_utf16": _mesh(GREY, check=_extent(0.1, 0.08, 0.06)),
    "meshes/obj_off_origin": _mesh(GREY, "centred: moved by -0.4, -0.1, -0.2 m", check=_is_centred, center=True),
    "meshes/obj_sheet_1mm": _mesh(GREY, check=_extent(0.1, 0.08, 0.001)),
    "parts/gltf_skin": _one_part(SIDES),
    "parts/models_info_padded_key": _one_part((0.03, 0.03, 0.05), 1),
    "parts/other_formats_silent": _one_part(
        SIDES, said=": of a format that is not read: a.3mf, b.usd, c.dae, d.fbx; save them as PLY, OBJ, glTF, STL or STEP files", unit="mm"
    ),
    "parts/stl_count_zero": _one_part(
        SIDES, said="its header announces 0 triangles, its body holds 12: 12 are read; 40 x 30 x 20 mm, unit mm", unit="mm"
    ),
    "settings/bom.toml": _has_one_world,
}


# ---- tables of picks that replace a data set's own, and parts that suction does not hold ----


def _is_refused(column: str, value: str, path: Path, out: Path) -> None:
    """The line names table, column, row and value."""
    place = pick_files(0)[path.name.startswith("states")]
    shutil.copyfile(path, write_pick_set(out / "set") / place)
    for command in (("explain", "--state=0"), ("preview", "--picks")):
        said = mistake(command[0], out / "set", command[1], f"--out={out / 'picture.png'}")
        assert said.startswith(f"{out / 'set' / place}, column {column}, row 0 is {value}; allowed: ")
    assert [path.name for path in out.iterdir()] == ["set"]


def _has_physics(parts: Path, out: Path) -> None:
    """Break forces follow from the vacuum, as `tests/sim/test_suction.py` measures on these parts; a bake without one tells its forces."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(new_cell, "draw_cell", lambda file, name, picture, *_: picture.write_bytes(b""))
        assert run("new-cell", out / "cell", "--part", parts / "pin.stl", "--unit", "mm").code == 0
    cell = load_config(str(out / "cell/cell.toml"), {"gripper.cup_width": 0.022})
    found = cell.suction.vacuum, cell.suction.surface, cell.suction.radius, round(cell.suction.good_force, 1)
    assert found == (60.0, "mesh", 0.011, 22.8)
    line = describe_forces(cell.gripper, load_config("smoke").suction)
    assert line.startswith("suction: a seal breaks at 40 or 2 N, as in the paper, whatever cup")
    assert "(full vacuum below this cup: 38.5 N)" in line


PICKS = {
    f"picks/{name}.parquet": partial(_is_refused, *said)
    for name, said in {
        "states_frame_2147483647": ("frame", "2147483647"),
        "trials_outcome_255": ("outcome", "255"),
        "trials_point_floatnan": ("point", "[nan, nan, nan]"),
        "trials_state_-1": ("state", "-1"),
    }.items()
} | {"parts/suction_default_porous": _has_physics}


ROWS: dict[str, Check] = BINS | CAMERAS | MESHES | PICKS
"""By path below CASES."""


@pytest.mark.parametrize("case", ROWS)
def test_an_input_of_a_user(tmp_path, case):
    ROWS[case](CASES / case, tmp_path)


def test_every_input_has_a_row():
    assert {str(path.relative_to(CASES)) for kind in KINDS for path in (CASES / kind).iterdir()} == ROWS.keys()
