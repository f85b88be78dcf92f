"""Model and light folders of strangers: one bad file leaves the others, names and layouts are as exporters write them."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.errors import CatalogError, LightError, SynpickError
from synpick_warp.exporters.bop.shared import write_models
from synpick_warp.scenes.assets import asset_files
from synpick_warp.scenes.lights import load_lights
from synpick_warp.system.processes import isolation
from synpick_warp.system.processes.isolation import Failure
from tests.builders import mistake, refusal
from tests.worlds.model_files import OBJ, box, exported, load_models, put

CASES = Path(__file__).resolve().parents[1] / "cases"
SMALL = OBJ.replace("v 1 ", "v 0.1 ").replace("v 0 1 ", "v 0 0.1 ").replace("v 0 0 1\n", "v 0 0 0.1\n", 1)
"""A textured tetrahedron of 0.1 m."""
CUBE = box(0.1, 0.1, 0.1)


PART = box(100.0, 60.0, 20.0)
"""Diameter 118.3 mm."""


def write(folder: Path, files: dict[str, str | bytes]) -> Path:
    """Files by name."""
    for name, content in files.items():
        put(folder / name, content)
    return folder


def picture() -> bytes:
    return cv2.imencode(".png", np.full((4, 3, 3), 9, np.uint8))[1].tobytes()


# ---- the inputs of tests/cases ----


def test_where_coacd_crashes_the_hull_stands(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(CASES / "coacd_crash" / "stub"))
    isolation._server.stop()
    try:
        catalog, lines = load_models(CASES / "coacd_crash" / "two", tmp_path)
    finally:
        isolation._server.stop()
    assert [(entry.name, len(entry.pieces)) for entry in catalog.entries] == [("a", 1), ("b", 1)]
    said = [f"{name}: its convex decomposition crashed (SIGSEGV); its convex hull is used instead" for name in "ab"]
    assert [line.rpartition(": ")[0] for line in lines[1:]] == said


LIGHT = cv2.imencode(".hdr", np.full((8, 16, 3), 0.5, np.float32))[1].tobytes()


@pytest.mark.parametrize(
    ("option", "suffix", "content", "remedy"),
    [
        ("bake.models", "ply", box(0.1, 0.1, 0.1), "decimate its mesh and scale down its textures, or remove the file"),
        ("bake.lights", "hdr", LIGHT, "scale the map down, or remove it"),
        ("randomize.table_textures", "png", picture(), "scale the image down, or remove it"),
    ],
)
def test_a_file_for_which_the_machine_does_not_suffice_is_not_left_out(tmp_path, monkeypatch, option, suffix, content, remedy):
    """Elsewhere the same command would make another data set. What is damaged stays left out."""
    for name, data in (("damaged", b"none"), ("good", content), ("slow", content)):
        put(tmp_path / "given" / f"{name}.{suffix}", data)
    real, reason = asset_files.run_isolated, "was killed, probably for lack of memory"

    def too_slow(function, calls, limits):
        for call, result in zip(calls, real(function, calls, limits), strict=True):
            yield Failure(reason, by_machine=True) if f"slow.{suffix}" in str(call) else result

    monkeypatch.setattr(asset_files, "run_isolated", too_slow)
    folder = tmp_path / "given"
    said = mistake("bake", "--config", "smoke", "--device", "cpu", "--out", tmp_path / "set", "--set", f"{option}={folder}")
    assert said == f"{folder / f'slow.{suffix}'}: the process that reads it {reason}; {remedy}"
    assert not (tmp_path / "set").exists()


@pytest.mark.parametrize(
    ("case", "brightness", "said"),
    [
        ("flat", 1.0, ""),
        ("radiance_rle", 1.0, ""),
        ("rgbe_magic", 1.0, ""),
        ("bottom_up", 1.0, ""),
        ("no_format_line", 1.0, ""),
        ("comment_first_exposure", 0.5, ""),
        ("mixed", 1.0, "studio_1k.exr: OpenEXR maps are not read"),
        ("exr_only", None, "studio_1k.exr: OpenEXR maps are not read; save it as Radiance (.hdr)"),
        ("zero_rows", None, "4 of 64 rows are black"),
        ("not_two_to_one", None, "128 x 62 pixels"),
    ],
)
def test_light_maps_of_all_kinds(case, brightness, said):
    lines: list[str] = []
    try:
        (light,) = load_lights(str(CASES / "lights" / case), lines.append)
    except LightError as error:
        assert brightness is None
        lines.append(str(error))
    else:
        # The sky above, the ground below.
        assert light.radiance[0].mean() == pytest.approx(0.8646 * brightness, rel=1e-3)
        assert light.radiance[-1].mean() == pytest.approx(0.1729 * brightness, rel=1e-3)
    assert len(lines) == bool(said)
    assert said in "".join(lines)


@pytest.mark.parametrize(("names", "beside"), [(["a.usdz", "B.Blend"], ""), (["a.step.abc", "x.urdf"], "part.stl"), (["Part/a.dae"], "")])
def test_files_of_formats_that_are_not_read_are_named(tmp_path, names, beside):
    for name in names:
        put(tmp_path / "models" / name, b"")
    said = f"models folder {tmp_path / 'models'}: of a format that is not read: {', '.join(sorted(names))}; save them as PLY, OBJ, glTF, "
    if not beside:
        with pytest.raises(CatalogError, match=re.escape(said)):
            load_models(tmp_path / "models", tmp_path)
        return
    put(tmp_path / "models" / beside, box(0.1, 0.1, 0.1, kind=beside[-3:]))
    _, (line, *_) = load_models(tmp_path / "models", tmp_path)
    assert line.startswith(said)


# ---- one bad file ----


def test_a_bad_mesh_is_left_out_with_a_line_and_keeps_its_number(tmp_path):
    bad = {"b.ply": b"no mesh", "c.ply": box(3.0, 3.0, 3.0), "d.glb": b"glTF", "e.ply": box(0.1, 0.1, 0.0)}
    good = {"a.ply": CUBE, "f.ply": CUBE, "g.ply": CUBE, "g.obj": box(0.1, 0.1, 0.1, kind="obj")}
    folder = write(tmp_path / "models", bad | good)
    catalog, lines = load_models(folder, tmp_path)
    assert [(entry.obj_id, entry.name) for entry in catalog.entries] == [(1, "a"), (6, "f"), (7, "g")]
    assert all(line.startswith("left out: ") for line in lines)
    with pytest.raises(CatalogError, match=r"g\.obj and g\.ply have the same name"):
        load_models(folder, tmp_path, strict=True)
    none = write(tmp_path / "none", {"a.ply": b"no mesh", "b.ply": b"no mesh either"})
    said = f"models folder {none}: none of its 2 objects can be used; the first: {none / 'a.ply'}: "
    assert refusal(load_models, none, tmp_path).startswith(said)


def test_a_bad_light_map_is_left_out(tmp_path):
    """A set from Windows is read."""
    maps = {"good.hdr": LIGHT, "bad.hdr": b"#?RADIANCE\n", "set/maps/ref.hdr": LIGHT}
    write(tmp_path, maps | {"set/a.ibl": "[Reflection]\nREFfile = Maps\\REF.hdr\n"})
    lines: list[str] = []
    assert [light.name for light in load_lights(str(tmp_path), lines.append)] == ["a", "good"]
    assert lines[0].startswith(f"left out: {tmp_path / 'bad.hdr'} cannot be read as an image")
    with pytest.raises(LightError, match=r"bad\.hdr"):
        load_lights(str(tmp_path), strict=True)


# ---- names ----


@pytest.mark.parametrize(
    ("name", "place"),
    [
        *((name, "skin.png") for name in ("SKIN.PNG", "C:\\Users\\x\\skin.png", "/data/x/skin.png", "maps/skin.png")),
        *((name, "tex/skin.png") for name in ("Tex\\Skin.png", ".\\tex\\SKIN.png")),
    ],
)
def test_a_texture_is_found_by_names_of_other_systems(tmp_path, name, place):
    files = {"a.obj": SMALL.replace("a.mtl", "A.MTL"), "a.mtl": f"newmtl skin\nmap_Kd {name}\n", place: picture()}
    catalog, lines = load_models(write(tmp_path / "models", files), tmp_path)
    assert catalog.entries[0].material.texture is not None
    assert len(lines) == 1
    assert "is read" in lines[0]


def test_a_folder_per_object(tmp_path):
    catalog, lines = load_models(CASES / "gso_layout", tmp_path)
    assert [entry.name for entry in catalog.entries] == ["Shoe"]
    assert catalog.entries[0].material.texture is not None
    assert not lines


@pytest.mark.parametrize("mtl", ["texture.png", "../materials/textures/texture.png", "..\\materials\\textures\\Texture.PNG"])
@pytest.mark.parametrize("depth", ["", "meshes/"])
def test_a_folder_per_object_with_textures_beside(tmp_path, mtl, depth):
    if depth == "":
        mtl = mtl.replace("../", "").replace("..\\", "")
    files = {f"{depth}model.obj": SMALL, f"{depth}a.mtl": f"newmtl skin\nmap_Kd {mtl}\n", "meshes/nontextured.ply": CUBE}
    for name in ("Shoe", "Mug"):
        write(tmp_path / "models" / name, files | {"materials/textures/texture.png": picture()})
    put(tmp_path / "models" / "no_model" / "readme.txt", "none")
    catalog, lines = load_models(tmp_path / "models", tmp_path)
    assert [(entry.obj_id, entry.name) for entry in catalog.entries] == [(1, "Mug"), (2, "Shoe")]
    assert all(entry.material.texture is not None for entry in catalog.entries)
    assert sum("2 meshes, of which" in line for line in lines) == 2


YCB = "002_master_chef_can"
"""Name of an object folder in the YCB data set; its download has meshes of several resolutions and reconstructions, and point clouds."""


COLLISION, BY_KIND = "meshes/collision.stl thumbnails/0.jpg", "google_16k/nontextured.ply google_16k/nontextured.stl"


@pytest.mark.parametrize(
    ("read", "others"),
    [
        ("google_16k/textured.obj", f"{BY_KIND} tsdf/textured.obj clouds/merged_cloud.ply"),
        ("google_16k/textured.obj", "google_64k/textured.obj google_512k/textured.obj"),
        ("tsdf/textured.obj", "poisson/nontextured.stl"),
        ("meshes/model.obj", COLLISION),
        ("visual.glb", "collision.obj"),
        (f"{YCB}.stl", "a.stl"),
    ],
)
def test_the_mesh_of_an_object_that_has_a_folder(tmp_path, read, others):
    """A box of 60 mm is the one to be read; its texture lies beside it, or where Google Scanned Objects have theirs."""
    folder = tmp_path / "models" / YCB
    for name in (read, *others.split()):
        side = 0.06 if name == read else 0.1
        kind = Path(name).suffix[1:]
        content = SMALL.replace("0.1", str(side)) if kind == "obj" else b"" if kind == "jpg" else box(side, side, side, kind=kind)
        beside = {"a.mtl": "newmtl skin\nmap_Kd texture_map.png\n", "texture_map.png": picture()}
        write((folder / name).parent, {(folder / name).name: content} | beside)
    catalog, lines = load_models(tmp_path / "models", tmp_path)
    assert [entry.name for entry in catalog.entries] == [YCB]
    assert np.ptp(catalog.entries[0].mesh.vertices, axis=0) == pytest.approx([0.06] * 3, rel=1e-5)
    assert (catalog.entries[0].material.texture is not None) == read.endswith(".obj")
    assert any(f"of which {read} is read" in line for line in lines)


def test_a_whole_bop_data_set_is_pointed_to_its_models(tmp_path):
    write(tmp_path / "set", {"models/obj_000001.ply": PART, "camera.json": "{}"})
    with pytest.raises(CatalogError, match=r"its folder models has BOP models; give .*/set/models$"):
        load_models(tmp_path / "set", tmp_path)


# ---- models_info.json ----


def bop(tmp_path: Path, model: bytes = PART, **info) -> Path:
    return write(tmp_path / "models", {"obj_000001.ply": model, "models_info.json": json.dumps({"1": info})})


TURN = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
QUARTER = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
ELSEWHERE = "or elsewhere than it is; its own, 100 x 60 x 20 mm"
SIZES = {"min_x": -50, "min_y": -30, "min_z": -10, "size_x": 100, "size_y": 60, "size_z": 20}


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"diameter": 118.3, "symmetries_discrete": [TURN], **SIZES}, ""),
        ({"diameter": 119.0}, ""),
        ({"diameter": 250.0}, "diameter 250 mm, which belongs to another mesh; its own, 118.3 mm, is used"),
        ({"diameter": 0.1183}, "diameter 0.1183, where its mesh has 118.3 mm: lengths in metres; they are converted"),
        ({"diameter": 118.3, **SIZES, "size_x": 200}, f"a bounding box of 200 x 60 x 20 mm, {ELSEWHERE}"),
        ({"symmetries_discrete": [QUARTER]}, "symmetries_discrete[0], which moves its surface by "),
        ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, "symmetries_continuous[0], which moves its surface by "),
    ],
)
def test_a_stale_models_info_is_named_and_not_copied(tmp_path, info, said):
    catalog, lines = load_models(bop(tmp_path, **info), tmp_path)
    assert catalog.entries[0].diameter == pytest.approx(0.1183, rel=1e-3)
    assert len(lines) == bool(said)
    assert said in "".join(lines)
    write_models(catalog, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "models_info.json").read_text())["1"]
    sizes = "symmetries" not in said and said
    assert written == info if not sizes else written["diameter"] == pytest.approx(118.3, rel=1e-3)
    assert written.get("size_x", 100) == pytest.approx(100) or not sizes


def test_the_diagonal_in_models_info_is_named(tmp_path):
    """Also where it is hardly longer than the diameter: by 2 % for a rod."""
    catalog, (line,) = load_models(CASES / "models_info_diagonal", tmp_path)
    assert catalog.entries[0].diameter == pytest.approx(0.01)
    assert "diameter 12.81 mm, which is the diagonal of its bounding box; its own, 10 mm, is used" in line
    rod = exported(trimesh.creation.cylinder(10.0, 100.0))
    _, (line,) = load_models(bop(tmp_path, rod, diameter=103.923), tmp_path)
    assert "diagonal" in line


def test_an_object_without_an_entry_goes_without_symmetries(tmp_path):
    info = {"1": {"diameter": 118.3, "symmetries_discrete": [TURN]}, "3": {"diameter": "big"}}
    models = {f"obj_{number:06d}.ply": box(50.0, 50.0, 50.0) for number in (2, 3)}
    folder = write(bop(tmp_path), models | {"models_info.json": json.dumps(info)})
    catalog, lines = load_models(folder, tmp_path)
    assert [len(entry.symmetries_discrete) for entry in catalog.entries] == [1, 0, 0]
    assert [line.rpartition("; ")[2] for line in lines] == ["until then it has no symmetries"] * 2
    write_models(catalog, tmp_path / "out")
    written = json.loads((tmp_path / "out" / "models_info.json").read_text())
    assert written["3"]["diameter"] == pytest.approx(86.6, rel=1e-3)
    with pytest.raises(CatalogError, match="no entry for object 2"):
        load_models(folder, tmp_path, strict=True)


def test_a_mesh_in_metres_among_millimetres_is_told(tmp_path):
    with pytest.raises(SynpickError, match=r"diameter is 0\.1183 mm, but models_info\.json says 118\.3; scale it to millimetres"):
        load_models(bop(tmp_path, box(0.1, 0.06, 0.02), diameter=118.3), tmp_path)
