"""Model and light folders of strangers: one bad file leaves the others, names and layouts are as exporters write them."""

from __future__ import annotations

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.errors import CatalogError, LightError, SynpickError
from synpick_warp.exporters.bop.shared.models import write_models
from synpick_warp.scenes import catalog as catalog_reader
from synpick_warp.scenes import lights as lights_reader
from synpick_warp.scenes import looks as looks_reader
from synpick_warp.scenes.lights import load_lights
from synpick_warp.system.processes.isolation import Failure
from tests.builders import mistake
from tests.scenes.test_fuzz_assets import OBJ, picture
from tests.worlds.model_files import box, exported, load_models, put

CASES = Path(__file__).resolve().parents[1] / "cases"
SMALL = OBJ.replace("v 1 ", "v 0.1 ").replace("v 0 1 ", "v 0 0.1 ").replace("v 0 0 1\n", "v 0 0 0.1\n", 1)
"""A textured tetrahedron of 0.1 m."""


def write(folder: Path, **files: str | bytes) -> Path:
    """Files by name, with __ for / and _dot_ for the dot."""
    for name, content in files.items():
        put(folder / name.replace("__", "/").replace("_dot_", "."), content)
    return folder


# ---- the inputs of tests/cases ----


@pytest.mark.parametrize(("case", "names"), [("one", ["u"]), ("two", ["a", "b"])])
def test_where_coacd_crashes_the_hull_stands(tmp_path, monkeypatch, case, names):
    monkeypatch.syspath_prepend(str(CASES / "coacd_crash" / "stub"))
    restart_server()
    try:
        catalog, lines = load_models(CASES / "coacd_crash" / case, tmp_path)
    finally:
        restart_server()
    assert [(entry.name, len(entry.pieces)) for entry in catalog.entries] == [(name, 1) for name in names]
    said = [f"{name}: its convex decomposition crashed (SIGSEGV); its convex hull is used instead" for name in names]
    assert [line.partition(":")[0] + ":" + line.split(":")[1] for line in lines[1:]] == said


LIGHT = cv2.imencode(".hdr", np.full((8, 16, 3), 0.5, np.float32))[1].tobytes()


@pytest.mark.parametrize("reason", ["took longer than 600 s of processor time and was stopped", "was killed, probably for lack of memory"])
@pytest.mark.parametrize(
    ("reader", "option", "suffix", "content", "remedy"),
    [
        (catalog_reader, "bake.models", "ply", box(0.1, 0.1, 0.1), "decimate its mesh and scale down its textures, or remove the file"),
        (lights_reader, "bake.lights", "hdr", LIGHT, "scale the map down, or remove it"),
        (looks_reader, "randomize.table_textures", "png", picture(), "scale the image down, or remove it"),
    ],
)
def test_a_file_for_which_the_machine_does_not_suffice_is_not_left_out(
    tmp_path, monkeypatch, reader, option, suffix, content, remedy, reason
):
    """Elsewhere the same command would make another data set. What is damaged stays left out."""
    for name, data in (("damaged", b"none"), ("good", content), ("slow", content)):
        put(tmp_path / "given" / f"{name}.{suffix}", data)
    real = reader.run_isolated

    def too_slow(function, calls, limits):
        for call, result in zip(calls, real(function, calls, limits), strict=True):
            yield Failure(reason, by_machine=True) if f"slow.{suffix}" in str(call) else result

    monkeypatch.setattr(reader, "run_isolated", too_slow)
    folder = tmp_path / "given"
    said = mistake("bake", "--config", "smoke", "--device", "cpu", "--out", tmp_path / "set", "--set", f"{option}={folder}")
    assert said == f"{folder / f'slow.{suffix}'}: the process that reads it {reason}; {remedy}"
    assert not (tmp_path / "set").exists()


def restart_server() -> None:
    from synpick_warp.system.processes import isolation

    isolation._server.stop()


def test_the_diagonal_in_models_info_is_named(tmp_path):
    catalog, (line,) = load_models(CASES / "models_info_diagonal", tmp_path)
    assert catalog.entries[0].diameter == pytest.approx(0.01)
    assert "diameter 12.81 mm, which is the diagonal of its bounding box; its own, 10 mm, is used" in line


def test_a_folder_per_object(tmp_path):
    catalog, lines = load_models(CASES / "gso_layout", tmp_path)
    assert [entry.name for entry in catalog.entries] == ["Shoe"]
    assert catalog.entries[0].material.texture is not None
    assert not lines


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
    folder = write(tmp_path / "models", a_dot_ply=box(0.1, 0.1, 0.1), b_dot_ply=b"no mesh", c_dot_ply=box(3.0, 3.0, 3.0), d_dot_glb=b"glTF")
    write(folder, e_dot_ply=box(0.1, 0.1, 0.0), f_dot_ply=box(0.1, 0.1, 0.1))
    write(folder, g_dot_ply=box(0.1, 0.1, 0.1), g_dot_obj=box(0.1, 0.1, 0.1, kind="obj"))
    catalog, lines = load_models(folder, tmp_path)
    assert [(entry.obj_id, entry.name) for entry in catalog.entries] == [(1, "a"), (6, "f"), (7, "g")]
    assert all(line.startswith("left out: ") for line in lines)
    with pytest.raises(CatalogError):
        load_models(folder, tmp_path, strict=True)


def test_a_folder_of_bad_meshes_ends_in_one_line(tmp_path):
    folder = write(tmp_path / "models", a_dot_ply=b"no mesh", b_dot_ply=b"no mesh either")
    with pytest.raises(CatalogError) as caught:
        load_models(folder, tmp_path)
    assert str(caught.value).startswith(f"models folder {folder}: none of its 2 objects can be used; the first: {folder / 'a.ply'}: ")


def test_a_bad_light_map_is_left_out(tmp_path):
    assert cv2.imwrite(str(tmp_path / "good.hdr"), np.full((8, 16, 3), 0.5, np.float32))
    (tmp_path / "bad.hdr").write_bytes(b"#?RADIANCE\n")
    lines: list[str] = []
    assert [light.name for light in load_lights(str(tmp_path), lines.append)] == ["good"]
    assert lines[0].startswith(f"left out: {tmp_path / 'bad.hdr'} cannot be read as an image")
    with pytest.raises(LightError, match=r"bad\.hdr"):
        load_lights(str(tmp_path), strict=True)


# ---- names ----


@pytest.mark.parametrize(
    "name",
    ["SKIN.PNG", "Tex\\Skin.png", ".\\tex\\SKIN.png", "C:\\Users\\x\\skin.png", "/data/x/skin.png", "maps/skin.png"],
)
def test_a_texture_is_found_by_names_of_other_systems(tmp_path, name):
    folder = write(tmp_path / "models", a_dot_obj=SMALL.replace("a.mtl", "A.MTL"), a_dot_mtl=f"newmtl skin\nmap_Kd {name}\n")
    write(folder, **{("skin_dot_png" if "Tex" not in name and "\\tex" not in name else "tex__skin_dot_png"): picture()})
    catalog, lines = load_models(folder, tmp_path)
    assert catalog.entries[0].material.texture is not None
    assert len(lines) == 1
    assert "is read" in lines[0]


@pytest.mark.parametrize("name", ["../skin.png", "..\\skin.png", "textures/../../skin.png", "link/skin.png"])
def test_such_names_do_not_lead_out_of_the_folder(tmp_path, name):
    folder = write(tmp_path / "models", a_dot_obj=SMALL, a_dot_mtl=f"newmtl skin\nmap_Kd {name}\n")
    (folder / "link").symlink_to("..")
    (folder / "textures").symlink_to("..")
    (tmp_path / "skin.png").write_bytes(picture())
    with pytest.raises(CatalogError, match=r"skin\.png"):
        load_models(folder, tmp_path)


@pytest.mark.parametrize("mtl", ["texture.png", "../materials/textures/texture.png", "..\\materials\\textures\\Texture.PNG"])
@pytest.mark.parametrize("depth", ["", "meshes__"])
def test_a_folder_per_object_with_textures_beside(tmp_path, mtl, depth):
    if depth == "":
        mtl = mtl.replace("../", "").replace("..\\", "")
    folder = tmp_path / "models"
    for name in ("Shoe", "Mug"):
        files = {f"{depth}model_dot_obj": SMALL, f"{depth}a_dot_mtl": f"newmtl skin\nmap_Kd {mtl}\n"}
        write(folder / name, **files, materials__textures__texture_dot_png=picture(), meshes__nontextured_dot_ply=box(0.1, 0.1, 0.1))
    write(folder / "no_model", readme_dot_txt="none")
    catalog, lines = load_models(folder, tmp_path)
    assert [(entry.obj_id, entry.name) for entry in catalog.entries] == [(1, "Mug"), (2, "Shoe")]
    assert all(entry.material.texture is not None for entry in catalog.entries)
    assert sum("2 meshes, of which" in line for line in lines) == 2


YCB = "002_master_chef_can"
"""Name of an object folder in the YCB data set; its download has meshes of several resolutions and reconstructions, and point clouds."""


@pytest.mark.parametrize(
    ("files", "read"),
    [
        (
            (
                "google_16k/textured.obj",
                "google_16k/nontextured.ply",
                "google_16k/nontextured.stl",
                "tsdf/textured.obj",
                "clouds/merged_cloud.ply",
            ),
            "google_16k/textured.obj",
        ),
        (("google_64k/textured.obj", "google_512k/textured.obj", "google_16k/textured.obj"), "google_16k/textured.obj"),
        (("poisson/nontextured.stl", "tsdf/textured.obj"), "tsdf/textured.obj"),
        (("meshes/model.obj", "meshes/collision.stl", "thumbnails/0.jpg"), "meshes/model.obj"),
        (("visual.glb", "collision.obj"), "visual.glb"),
        ((f"{YCB}.stl", "a.stl"), f"{YCB}.stl"),
    ],
)
def test_the_mesh_of_an_object_that_has_a_folder(tmp_path, files, read):
    """A box of 60 mm is the one to be read; its texture lies beside it, or where Google Scanned Objects have theirs."""
    folder = tmp_path / "models" / YCB
    for name in files:
        side = 0.06 if name == read else 0.1
        kind = Path(name).suffix[1:]
        content = SMALL.replace("0.1", str(side)) if kind == "obj" else b"" if kind == "jpg" else box(side, side, side, kind=kind)
        put(folder / name, content)
        put((folder / name).with_name("a.mtl"), "newmtl skin\nmap_Kd texture_map.png\n")
        put((folder / name).with_name("texture_map.png"), picture())
    catalog, lines = load_models(tmp_path / "models", tmp_path)
    assert [entry.name for entry in catalog.entries] == [YCB]
    assert np.ptp(catalog.entries[0].mesh.vertices, axis=0) == pytest.approx([0.06] * 3, rel=1e-5)
    assert (catalog.entries[0].material.texture is not None) == read.endswith(".obj")
    assert any(f"of which {read} is read" in line for line in lines)


def test_a_whole_bop_data_set_is_pointed_to_its_models(tmp_path):
    write(tmp_path / "set", models__obj_000001_dot_ply=box(100.0, 60.0, 20.0), camera_dot_json="{}")
    with pytest.raises(CatalogError, match=r"its folder models has BOP models; give .*/set/models$"):
        load_models(tmp_path / "set", tmp_path)


def test_a_set_of_lights_from_windows(tmp_path):
    folder = write(tmp_path / "set", a_dot_ibl="[Reflection]\nREFfile = Maps\\REF.hdr\n")
    (folder / "maps").mkdir()
    assert cv2.imwrite(str(folder / "maps" / "ref.hdr"), np.full((8, 16, 3), 0.5, np.float32))
    assert [light.name for light in load_lights(str(tmp_path))] == ["a"]


# ---- models_info.json ----


def bop(tmp_path: Path, **info) -> Path:
    """A box of 100 x 60 x 20 mm, diameter 118.3."""
    return write(tmp_path / "models", obj_000001_dot_ply=box(100.0, 60.0, 20.0), models_info_dot_json=json.dumps({"1": info}))


TURN = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
QUARTER = [0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
SIZES = {"min_x": -50, "min_y": -30, "min_z": -10, "size_x": 100, "size_y": 60, "size_z": 20}


@pytest.mark.parametrize(
    ("info", "said"),
    [
        ({"diameter": 118.3, "symmetries_discrete": [TURN], **SIZES}, ""),
        ({"diameter": 119.0}, ""),
        ({"diameter": 250.0}, "diameter 250 mm, which belongs to another mesh; its own, 118.3 mm, is used"),
        ({"diameter": 0.1183}, "diameter 0.1183, where its mesh has 118.3 mm: lengths in metres; they are converted"),
        (
            {"diameter": 118.3, **SIZES, "size_x": 200},
            "a bounding box of 200 x 60 x 20 mm, or elsewhere than it is; its own, 100 x 60 x 20 mm",
        ),
        ({"symmetries_discrete": [QUARTER]}, "symmetries_discrete[0], which moves its surface by "),
        ({"symmetries_continuous": [{"axis": [0, 0, 1]}]}, "symmetries_continuous[0], which moves its surface by "),
    ],
)
def test_a_stale_models_info_is_named_and_not_copied(tmp_path, info, said):
    catalog, lines = load_models(bop(tmp_path, **info), tmp_path)
    assert catalog.entries[0].diameter == pytest.approx(0.1183, rel=1e-3)
    assert len(lines) == bool(said)
    assert said in "".join(lines)
    write_models(tmp_path / "out", catalog)
    written = json.loads((tmp_path / "out" / "models_info.json").read_text())["1"]
    sizes = "symmetries" not in said and said
    assert written == info if not sizes else written["diameter"] == pytest.approx(118.3, rel=1e-3)
    assert written.get("size_x", 100) == pytest.approx(100) or not sizes


def test_a_diagonal_that_is_hardly_longer_than_the_diameter_is_named(tmp_path):
    """By 2 % only, for a rod."""
    rod = exported(trimesh.creation.cylinder(10.0, 100.0))
    folder = write(tmp_path / "models", obj_000001_dot_ply=rod, models_info_dot_json=json.dumps({"1": {"diameter": 103.923}}))
    _, (line,) = load_models(folder, tmp_path)
    assert "diagonal" in line


def test_an_object_without_an_entry_goes_without_symmetries(tmp_path):
    folder = bop(tmp_path, diameter=118.3, symmetries_discrete=[TURN])
    write(folder, obj_000002_dot_ply=box(50.0, 50.0, 50.0), obj_000003_dot_ply=box(50.0, 50.0, 50.0))
    info = json.loads((folder / "models_info.json").read_text())
    (folder / "models_info.json").write_text(json.dumps({**info, "3": {"diameter": "big"}}))
    catalog, lines = load_models(folder, tmp_path)
    assert [len(entry.symmetries_discrete) for entry in catalog.entries] == [1, 0, 0]
    assert [line.rpartition("; ")[2] for line in lines] == ["until then it has no symmetries"] * 2
    write_models(tmp_path / "out", catalog)
    written = json.loads((tmp_path / "out" / "models_info.json").read_text())
    assert written["3"]["diameter"] == pytest.approx(86.6, rel=1e-3)
    with pytest.raises(CatalogError, match="no entry for object 2"):
        load_models(folder, tmp_path, strict=True)


def test_a_mesh_in_metres_among_millimetres_is_told(tmp_path):
    folder = write(tmp_path / "models", obj_000001_dot_ply=box(0.1, 0.06, 0.02))
    (folder / "models_info.json").write_text(json.dumps({"1": {"diameter": 118.3}}))
    with pytest.raises(SynpickError, match=r"diameter is 0\.1183 mm, but models_info\.json says 118\.3; scale it to millimetres"):
        load_models(folder, tmp_path)
