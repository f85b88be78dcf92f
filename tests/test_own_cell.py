"""What users bring, end to end: a bin and a part as STL in all formats, catalogs at the ends of what fits, materials, light maps. What
cannot be used is one line and exit code 2 before anything is simulated, and nothing is written."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
import zarr
from PIL import Image
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.apps.viz.explain import write_explanation
from synpick_warp.apps.viz.preview import write_contact_sheet
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import FORMATS
from synpick_warp.dataset.reading import DataSet
from synpick_warp.factory.episodes import BakeSummary
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.kernels.render.lighting.surfaces import METALLIC_SHIFT, ROUGHNESS_MASK, ROUGHNESS_SHIFT
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.scenes.lights import MAX_RADIANCE
from synpick_warp.scenes.types import Material
from synpick_warp.stages.render.scene import build_render_scene, pack_texels
from synpick_warp.stages.sim.simulate import Simulation
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING, mistake, once
from tests.harness.bake_server import TINY, TINY_PICKS
from tests.harness.pieces import depth_within
from tests.worlds.bin_meshes import bracket, sloped_bin
from tests.worlds.model_files import box, exported, glb, put
from tests.worlds.shapes import UPRIGHT, camera, entry, even_light, sheet, sun
from tests.worlds.small_worlds import QUICK
from tests.worlds.toy_scene import ToyScene, render

CELL = """preset = "smoke"
[bins]
kind = "own"
shift = [0.02, 0.02]
yaw = 20.0
[[bin]]
name = "kanban"
file = "bins/kanban.stl"
unit = "mm"
"""
MAX_DEPTH = 2e-3
"""Largest depth of a part in the bin in any step [m]; 0.16 mm were measured in 76,488 poses of twelve picks."""


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Settings and data set of an episode."""
    return once(tmp_path_factory, "own-cell", bake_own)[0]


def bake_own(folder: Path) -> None:
    for name in ("bins", "parts"):
        (folder / name).mkdir(parents=True)
    sloped_bin().apply_scale(1000.0).export(folder / "bins" / "kanban.stl")
    bracket(60.0).export(folder / "parts" / "bracket.stl")
    (folder / "cell.toml").write_text(CELL)
    more = {
        "bake.models": str(folder / "parts"),
        "bake.formats": list(FORMATS),
        "bake.episodes": 1,
        "bake.worlds": 1,
        "cameras.resolution": [96, 54],
        "objects.unit": "mm",
        "objects.center": True,
        "arrangement.max_objects": 3,
    }
    # With the physics of the preset.
    quick = {key: value for key, value in (PICKING | TINY).items() if not key.startswith("physics.")}
    quick |= {key: value for key, value in TINY_PICKS.items() if key.startswith("picks.")}
    config = load_config(str(folder / "cell.toml"), quick | more)
    summary = run_bake(config, folder / "set", SilentProgress())
    (row,) = summary.episodes
    assert (row.objects, row.picked > 0, summary.resampled) == (3, True, 0)


@pytest.mark.slow
def test_parts_stay_within_the_mesh_in_every_step(baked):
    """Nothing passes through a wall, the divider or the sloped floor while the gripper picks."""
    data_set = DataSet(baked / "set")
    (one,), (part,) = make_bins(data_set.config.cell.bins), load_catalog(data_set.config).entries
    episode = zarr.open_group(baked / "set" / "trajectory.zarr", mode="r")["episodes/000000"]
    place = episode["ticks/fixture_pose"][0, 0].astype(float)
    points = np.concatenate([piece.vertices for piece in part.pieces])
    poses = episode["steps/pose"][:].reshape(-1, 7).astype(float)
    poses = poses[np.isfinite(poses).all(axis=1) & (np.abs(poses[:, :3]).max(axis=1) < 1.0)]
    world = Rotation.from_quat(poses[:, 3:]).as_matrix() @ points.T + poses[:, :3, None]
    local = Rotation.from_quat(place[3:]).inv().apply(world.transpose(0, 2, 1).reshape(-1, 3) - place[:3])
    assert len(poses) > 100
    assert one.pieces
    assert depth_within(one.pieces, local) < MAX_DEPTH
    inside = np.abs(local[:, :2]) < np.array(one.sizes.opening) / 2 + MAX_DEPTH
    assert (inside.all(axis=1) | (local[:, 2] > one.sizes.height - MAX_DEPTH)).all()


@pytest.mark.slow
def test_all_formats_are_valid_explained_and_have_the_mesh(baked):
    summary = Summary()
    assert list(validate(baked / "set", ValidationOptions(sample=50, threads=1), summary)) == []
    assert summary.views > 0
    stage = Usd.Stage.Open(str(baked / "set" / "usd" / "000000.usdc"))
    visual = next(UsdGeom.Mesh(prim) for prim in Usd.PrimRange(stage.GetPrimAtPath("/Episode/Bin")) if prim.IsA(UsdGeom.Mesh))
    (one,) = make_bins(DataSet(baked / "set").config.cell.bins)
    np.testing.assert_allclose(np.ptp(visual.GetPointsAttr().Get(), axis=0), np.ptp(one.fixture.mesh.vertices, axis=0), atol=1e-6)
    place = zarr.open_group(baked / "set" / "trajectory.zarr", mode="r")["episodes/000000/ticks/fixture_pose"][0, 0]
    moved = UsdGeom.XformCache(0).GetLocalToWorldTransform(stage.GetPrimAtPath("/Episode/Bin")).ExtractTranslation()
    np.testing.assert_allclose(moved, place[:3], atol=1e-6)
    for write in (write_contact_sheet(baked / "set", baked / "sheet.png", 3), write_explanation(baked / "set", baked / "why.png", 0)):
        assert write.stat().st_size > 10_000
    for name in ("train", "train_web", "usd", "trajectory.zarr", "lerobot", "coco", "yolo"):
        assert any((baked / "set" / name).rglob("*")), name


# ---- catalogs of one or two objects ----


class Notes(SilentProgress):
    """Keeps notes."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def note(self, text: str) -> None:
        self.lines.append(text)


IN_WAY, ASIDE = [0.1, 0.1, 0.6], [0.0, 0.6, 1.0]
"""Positions of cameras [m]."""
AROUND = {"cameras.positions": [IN_WAY, ASIDE, IN_WAY]}


def bake_models(folder: Path, mode: str, *sizes: tuple[float, float, float], **more: object) -> tuple[BakeSummary, list[str]]:
    """Bake an episode of boxes with these sides [m] under the budget and the capacity of `smoke`, 3 litres and 24 objects; with notes."""
    quick = {key: value for key, value in (QUICK | PICKING | TINY).items() if not key.startswith("arrangement.")}
    quick |= {"bake.worlds": 1, "bake.episodes": 1, "bake.formats": ["bop"], "render.layers": [], "bake.mode": mode}
    for index, size in enumerate(sizes):
        put(folder / "models" / f"box_{index}.ply", box(*size))
    notes = Notes()
    config = load_config("smoke", quick | {"bake.models": str(folder / "models")} | more)
    summary = run_bake(config, folder / "out", notes)
    assert [row.ending.delivers for row in summary.episodes] == [True]
    assert summary.views > 0
    return summary, notes.lines


@pytest.mark.parametrize(
    ("mode", "sizes"),
    [
        ("move", [(0.1, 0.1, 0.1)]),
        ("target", [(0.1, 0.1, 0.1), (0.1, 0.1, 0.1)]),
        ("move", [(0.003, 0.003, 0.003)]),
        ("pick", [(0.144, 0.144, 0.144)]),
    ],
    ids=["a litre", "twins", "3 mm", "the whole budget"],
)
@pytest.mark.slow
def test_a_catalog_of_one_or_two_objects_gives_episodes(mode, sizes, tmp_path):
    """Fault 4: with cubes of 100 mm, all 20 arrangements needed more body slots than a world had."""
    assert bake_models(tmp_path, mode, *sizes)[0].resampled == 0


def test_plates_of_a_millimetre_come_to_rest(tmp_path):
    """All 20 arrangements had more contacts than the solver has capacity for by default: 24 plates have 700."""
    summary, notes = bake_models(tmp_path, "move", (0.1, 0.08, 0.001), **AROUND)
    assert [row.objects for row in summary.episodes] == [24]
    assert not any("more contacts arose" in line or "in the gripper's way" in line for line in notes)
    assert sum("thin objects: capacity for" in line for line in notes) == 1


def test_one_model_fills_the_tote_in_mode_pick(tmp_path):
    """There was one object in the tote, and no word."""
    summary, notes = bake_models(tmp_path, "pick", (0.1, 0.1, 0.1), **AROUND)
    assert [row.objects for row in summary.episodes] == [3]
    assert [line.split(" stands")[0] for line in notes if "in the gripper's way" in line] == ["camera camera_0", "camera camera_2"]
    assert "1 objects take 0.001 of 0.003 m³ together, so that they repeat in an episode" in notes


# ---- materials and light maps ----


def test_a_gltf_material_reaches_the_renderer(tmp_path, device):
    """Factors times the picture that glTF keeps roughness (green) and metalness (blue) in: texel by texel, and the mean."""
    rough = np.zeros((4, 6, 3), np.uint8)
    rough[:, :3], rough[:, 3:] = (9, 100, 200), (9, 200, 240)
    material = PBRMaterial(
        baseColorFactor=(255, 128, 0, 255),
        baseColorTexture=Image.new("RGB", (5, 3), (200, 100, 50)),
        metallicFactor=0.5,
        roughnessFactor=0.8,
        metallicRoughnessTexture=Image.fromarray(rough),
    )
    mesh = trimesh.creation.box((0.1, 0.08, 0.06))
    mesh.visual = TextureVisuals(uv=np.random.default_rng(0).random((8, 2)), material=material)
    put(tmp_path / "models" / "box.glb", glb(mesh))
    config = load_config(None, {"bake.models": str(tmp_path / "models")})
    catalog = load_catalog(config, tmp_path / "cache")
    toy = ToyScene([], [], (camera(8, 8, 8.0, (0.0, 0.0, 1.0)),))
    surfaces = build_render_scene(config.render, -config.tote.wall, catalog, toy.fixtures, toy.cameras, (even_light(),), device).surfaces
    assert surfaces.metallic.numpy()[0] == pytest.approx(0.5 * 220 / 255, abs=1e-3)
    assert surfaces.roughness.numpy()[0] == pytest.approx(0.8 * 150 / 255, abs=1e-3)
    # glTF's factor is linear, as are the renderer's colours.
    assert surfaces.color.numpy()[0] == pytest.approx((1.0, 128 / 255, 0.0), abs=2e-3)
    # The larger picture decides the size of both.
    assert surfaces.texture_size.numpy()[0].tolist() == [6, 4]
    assert surfaces.texel.numpy()[0] == pack_texels(np.array([[[200, 100, 50]]], np.uint8))[0]
    left, right = (surfaces.detail.numpy()[:6].astype(np.int64)[column] for column in (0, 5))
    for texel, green, blue in ((left, 100, 200), (right, 200, 240)):
        assert texel >> int(ROUGHNESS_SHIFT) & int(ROUGHNESS_MASK) == pytest.approx(0.8 * green / 255 * 127, abs=1)
        assert texel >> int(METALLIC_SHIFT) == pytest.approx(0.5 * blue / 255 * 31, abs=1)


def test_a_picture_does_not_depend_on_the_unit_of_its_light_map(device):
    """Up to the largest radiance that is allowed: exposure is automatic, and nothing overflows."""
    dim, pictures = sun((0.3, 0.2, 1.0)), []
    body = entry(sheet(0.2, 0.2), Material((0.6, 0.5, 0.4), None, 0.0, 0.5))
    for gain in (1.0, 0.99 * MAX_RADIANCE / dim.radiance.max()):
        light = replace(dim, radiance=(dim.radiance * np.float32(gain)))
        toy = ToyScene([body], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (camera(24, 24, 60.0, (0.0, 0.0, 1.0)),), lights=(light,))
        pictures.append(render(toy, device).color.astype(int))
    assert pictures[0].mean() > 50
    assert np.abs(pictures[0] - pictures[1]).max() <= 2


# ---- what cannot be used ----

LOOK = "pose = { position = [0.0, -0.4, 1.1], look_at = [0.0, 0.0, 0.1], up = [0.0, 1.0, 0.0] }"
CAMERA = f'[[camera]]\nname = "left"\nresolution = [320, 240]\nfov = 60.0\n{LOOK}\n'
FILE = f'[[camera]]\nname = "left"\nfile = "FILE"\n{LOOK}\n'
BIN = '[bins]\nkind = "own"\n[[bin]]\nname = "a"\n'
PARTS = '[bake]\nmodels = "parts"\n'
IN_MM = PARTS + '[objects]\nunit = "mm"\n'
LIGHTS = '[bake]\nlights = "lights"\n'
TRANSPOSED = "image_width: 320\nimage_height: 240\ncamera_matrix: [275, 0, 0, 0, 274.6, 0, 163, 117, 1]\n"
ROW = '[[object_rows]]\nid = 1\nname = "long"\ndiameter = 0.14\nmass = 0\n'


def looks(setting: str) -> str:
    return f"[randomize]\n{setting}\n"


CASES = {
    "transposed file": (FILE.replace("FILE", "transposed.yaml"), "transposed.yaml (OpenCV): the camera matrix is written column by column"),
    "no file": (FILE.replace("FILE", "gone.yaml"), "gone.yaml; a path in a file of settings is relative to that file"),
    "bin lower than its floor": (BIN + "outer_size = [0.615, 0.373, 0.004]\n", "bin[0].wall is "),
    "corners without room": (BIN + "floor_size = [0.035, 0.319]\n", "bin a: floor_size: a length of 0.035 m is too small"),
    "camera below a mesh's floor": (
        CAMERA + BIN + 'file = "bin.stl"\nplace = "file"\n',
        "in cell.toml; allowed: positions above the bin's floor, z > 1.5",
    ),
    "part larger than a compartment": (IN_MM + BIN + "compartments = [6, 6]\n", "long: too large for the bin"),
    "part larger than the budget": (IN_MM + "[arrangement]\nvolume = 1e-5\n", "arrangement.volume is 1e-05 m³, but the smallest object, "),
    "part without mass": (IN_MM + ROW, "object_rows[0].mass is 0 in cell.toml; "),
    "no parts": ('[bake]\nmodels = "empty"\n', "empty: it contains no models; "),
    "light that is not finite": (LIGHTS, "lights/a.hdr has radiance that is infinite or not a number"),
    "no textures": (looks('bin_textures = "missing"'), "missing cannot be read"),
    "empty textures": (looks('table_textures = "empty"'), "empty has 0 images"),
    "damaged textures": (
        looks('background_textures = "cut"') + "[render]\ntable_size = [1, 1]\n",
        "randomize.background_textures: none of the 2 images of",
    ),
    "a damaged texture": (looks('table_textures = "half"') + "[objects]\nstrict = true\n", "half/b.jpg"),
    "background without floor": (looks('background_textures = "half"'), "render.table_size"),
    "value beyond": (looks("bin_metallic = 2.0"), "randomize.bin_metallic is 2.0"),
    "choice beyond": (looks("lamps = { choice = [0, 9] }"), "randomize.lamps is "),
    "mean beyond": (looks("object_hue = { normal = [400.0, 1.0] }"), "randomize.object_hue is "),
    "colour of two": (looks("bin_color = [0.1, 0.2]"), "randomize.bin_color is "),
    "colour beyond": (looks("bin_color = { uniform = [[0, 0, 0], [1, 1, 255]] }"), "randomize.bin_color is "),
}


@pytest.mark.parametrize("case", CASES)
def test_what_cannot_be_baked_is_one_line(tmp_path, monkeypatch, case):
    for name in ("tick", "tick_parts"):
        monkeypatch.setattr(Simulation, name, lambda *_, **__: pytest.fail("a tick is simulated"))
    monkeypatch.chdir(tmp_path)
    text, said = CASES[case]
    picture = cv2.imencode(".png", np.random.default_rng(0).integers(0, 256, (64, 64, 3)).astype(np.uint8))[1].tobytes()
    radiance = np.full((8, 16, 3), [[[0.5, np.inf, 0.5]]], np.float32)
    files = {
        "cell.toml": f'preset = "smoke"\n{text}',
        "transposed.yaml": TRANSPOSED,
        "bin.stl": exported(sloped_bin().apply_translation((0.0, 0.0, 1.5)), "stl"),
        "parts/long.stl": exported(trimesh.creation.box((90.0, 80.0, 70.0)), "stl"),
        "cut/a.png": picture[:3000],
        "cut/b.webp": b"",
        "half/a.png": picture,
        "half/b.jpg": picture[:40],
        "lights/a.hdr": cv2.imencode(".tiff", radiance)[1].tobytes(),  # Unlike a radiance map, it can hold any number.
    }
    for name, content in files.items():
        put(Path(name), content)
    Path("empty").mkdir()
    before = sorted(Path().rglob("*"))
    assert said in mistake("bake", "--config", "cell.toml", "--device", "cpu", "--mode", "move", "--out", "deep/data")
    assert sorted(Path().rglob("*")) == before
