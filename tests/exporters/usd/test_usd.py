"""USD data sets as files: exporter contract, assets, references, and USD's own validators. Bakes: bodies projected by USD's cameras match
BOP's masks pixel by pixel; an episode's own materials stand in place of those of the assets, also after a conversion."""

import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdSemantics, UsdShade, UsdUtils, UsdValidation
from scipy.spatial import ConvexHull

from synpick_warp.apps.conversion.run import convert
from synpick_warp.configs.cell.bins import BinRow, Bins
from synpick_warp.configs.schema import Config
from synpick_warp.errors import OutputError
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.usd.assets import new_asset, save_layer, write_light_maps
from synpick_warp.exporters.usd.exporter import UsdExporter
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.scenes.types import MAP_CENTER
from synpick_warp.testing.exporters import ExporterContract, digests
from tests.builders import STIRRING, bake_boxes
from tests.harness import scripted_bake
from tests.worlds import small_worlds, usd_sets

CATALOG = usd_sets.textured(small_worlds.catalog())


class TestContract(ExporterContract):
    exporter_class, row = UsdExporter, FORMAT_TABLE["usd"]


@pytest.fixture(scope="module")
def config():
    return usd_sets.settings()


@pytest.fixture(scope="module")
def folder(tmp_path_factory, config) -> Path:
    """The USD files of a data set of two episodes."""
    return usd_sets.write_set(tmp_path_factory.mktemp("usd") / "set", config, CATALOG, (0, 4))


def layers(folder: Path) -> list[Path]:
    """All layer files."""
    return sorted(folder.rglob("*.usdc"))


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    stage = new_asset("thing", "thing")
    with pytest.raises(FileNotFoundError, match="No such file"):
        save_layer(stage.GetRootLayer(), tmp_path / "gone" / "thing.usdc")
    assert not (tmp_path / "gone").exists()
    (tmp_path / "lights").mkdir()
    (tmp_path / "lights" / "light_000.exr").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*light_000\.exr: .*; free space or rights there"):
        write_light_maps(tmp_path, skies()[:1])
    (tmp_path / "taken.usdc").mkdir()
    with pytest.raises(OutputError, match=r"cannot write .*taken\.usdc: "):
        save_layer(stage.GetRootLayer(), tmp_path / "taken.usdc")


LIMITED = """
import resource, signal, sys
from pathlib import Path
from synpick_warp.errors import OutputError
from synpick_warp.exporters.usd.assets import new_asset, save_layer
stage = new_asset("thing", "thing")
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))
try:
    save_layer(stage.GetRootLayer(), Path(sys.argv[1]))
except OutputError as error:
    sys.exit(str(error))
"""


def test_a_truncated_file_is_an_error(tmp_path):
    """In a separate process, since the file size limit applies to the whole process."""
    limited = subprocess.run((sys.executable, "-c", LIMITED, str(tmp_path / "thing.usdc")), capture_output=True, text=True)
    assert limited.stderr == f"cannot write {tmp_path / 'thing.usdc'}: File too large; free space or rights there\n"


def test_a_writer_has_no_thread_beside_its_own(tmp_path, monkeypatch):
    """After its second episode, a thread of USD's TBB polled on, which took a core of each writer."""
    threads = []

    class Pool(WriterPool):
        def __init__(self, _: int, *arguments: int) -> None:
            super().__init__(1, *arguments)

        def __exit__(self, *error: object) -> None:
            threads.append(sum(1 for _ in Path(f"/proc/{self.pids()[0]}/task").iterdir()))
            super().__exit__(*error)

    monkeypatch.setattr(scripted_bake, "WriterPool", Pool)
    scripted_bake.bake(tmp_path / "set", scripted_bake.settings(2, ("usd",)))
    assert threads == [1]


def test_one_file_per_episode_and_shared_assets(folder):
    names = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assets = {f"assets/{name}.usdc" for name in ("obj_000001", "obj_000002", "obj_000003", "tote", "finger", "cup", "table")}
    assets |= {f"assets/textures/obj_000002{ending}" for ending in (".png", "_normal.png", "_values.png", "_emission.png")}
    assets |= {*(f"assets/lights/light_00{index}.exr" for index in range(2))}
    assert names == assets | {"000000.usdc", "000004.usdc"}
    assert (folder / "000000.usdc").stat().st_size < 60_000


def test_references_are_relative_and_resolve(folder):
    referenced = set()
    for path in layers(folder):
        layer = Sdf.Layer.FindOrOpen(str(path))
        assert all(Path(asset).is_relative_to(folder) for asset in layer.GetExternalAssetDependencies())
        assert str(folder) not in layer.ExportToString()
        layers_used, assets, missing = UsdUtils.ComputeAllDependencies(Sdf.AssetPath(str(path)))
        assert missing == []
        referenced |= {Path(layer.realPath) for layer in layers_used} | {Path(asset) for asset in assets}
    # The environment map that no episode uses is not referenced.
    assert {path.resolve() for path in folder.rglob("*") if path.is_file()} - referenced == {folder / "assets/lights/light_000.exr"}


def validation_errors(path: Path) -> Iterator[str]:
    """Messages of all registered validators, as `usdchecker` prints them (USD 26; earlier: `UsdUtils.ComplianceChecker`)."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    for error in UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path))):
        yield f"{error.GetName()}: {error.GetMessage()}"


def test_validators_find_nothing_but_a_broken_reference(folder, tmp_path):
    assert [error for path in layers(folder) for error in validation_errors(path)] == []
    stage = Usd.Stage.CreateNew(str(tmp_path / "bad.usda"))
    UsdGeom.Xform.Define(stage, "/Root").GetPrim().GetReferences().AddReference("./nowhere.usdc")
    stage.Save()
    assert list(validation_errors(tmp_path / "bad.usda"))


def test_stages_state_units_and_time_codes(folder, config):
    for path in layers(folder):
        stage = Usd.Stage.Open(str(path))
        assert UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
        assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
        assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
        assert stage.GetDefaultPrim()
    stage = Usd.Stage.Open(str(folder / "000004.usdc"))
    rate = 1.0 / (config.physics.step * config.physics.steps_per_tick)
    assert stage.GetTimeCodesPerSecond() == stage.GetFramesPerSecond() == pytest.approx(rate)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, usd_sets.FRAMES - 1)
    properties = {item.GetName(): item.Get() for item in stage.GetDefaultPrim().GetPropertiesInNamespace("userProperties")}
    expected = {"episode": 4, "arrangement": 0, "frames": usd_sets.FRAMES, "ending": "emptied"}
    assert properties == {f"userProperties:{name}": value for name, value in expected.items()}


@pytest.mark.parametrize("entry", CATALOG.entries, ids=lambda entry: entry.name)
def test_objects_have_their_meshes_and_materials(folder, entry):
    stage = Usd.Stage.Open(str(folder / f"assets/obj_{entry.obj_id:06d}.usdc"))
    root = stage.GetDefaultPrim()
    assert root.GetAttribute("userProperties:obj_id").Get() == entry.obj_id
    assert list(UsdSemantics.LabelsAPI(root, "class").GetLabelsAttr().Get()) == [entry.name]
    mesh = UsdGeom.Mesh(root.GetChild("Visual"))
    np.testing.assert_array_equal(mesh.GetPointsAttr().Get(), entry.mesh.vertices)
    np.testing.assert_array_equal(mesh.GetNormalsAttr().Get(), entry.mesh.normals)
    np.testing.assert_array_equal(np.reshape(mesh.GetFaceVertexIndicesAttr().Get(), (-1, 3)), entry.mesh.faces)
    np.testing.assert_array_equal(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get(), entry.mesh.uv)
    assert UsdGeom.Mesh.ValidateTopology(
        mesh.GetFaceVertexIndicesAttr().Get(), mesh.GetFaceVertexCountsAttr().Get(), len(entry.mesh.vertices)
    )[0]
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    shader, _, _ = material.ComputeSurfaceSource()
    assert shader.GetShaderId() == "UsdPreviewSurface"
    metallic, roughness, normal = (shader.GetInput(name) for name in ("metallic", "roughness", "normal"))
    assert (metallic.Get(), roughness.Get()) == pytest.approx((entry.material.metallic, entry.material.roughness))
    linear, color = srgb_to_linear(entry.material.color), shader.GetInput("diffuseColor")
    if entry.material.texture is None:
        np.testing.assert_allclose(color.Get(), linear, rtol=1e-6)
        emission = shader.GetInput("emissiveColor")
        assert tuple(emission.Get() if emission else (0.0, 0.0, 0.0)) == entry.material.emission
        coat = [shader.GetInput(name) for name in ("clearcoat", "clearcoatRoughness")]
        assert [each.Get() if each else 0.0 for each in coat] == [
            entry.material.finish.clearcoat,
            entry.material.finish.clearcoat_roughness,
        ]
        return
    image = UsdShade.Shader(color.GetConnectedSources()[0][0].source.GetPrim())
    np.testing.assert_allclose(image.GetInput("scale").Get(), [*linear, 1.0], rtol=1e-6)
    assert image.GetInput("sourceColorSpace").Get() == "sRGB"
    picture = cv2.imread(image.GetInput("file").Get().resolvedPath)
    np.testing.assert_array_equal(picture[..., ::-1], entry.material.texture)
    reader = UsdShade.Shader(image.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
    assert reader.GetInput("varname").Get() == "st"
    expected = (entry.material.maps[..., :2].astype(float) - MAP_CENTER) / (MAP_CENTER - 1)
    np.testing.assert_allclose(sampled(normal)[..., :2], expected, atol=0.005)
    np.testing.assert_allclose(np.linalg.norm(sampled(normal), axis=2), 1.0, atol=0.01)
    assert [each.GetConnectedSources()[0][0].sourceName for each in (roughness, metallic)] == ["g", "b"]
    glow = UsdShade.Shader(shader.GetInput("emissiveColor").GetConnectedSources()[0][0].source.GetPrim())
    assert tuple(glow.GetInput("scale").Get())[:3] == entry.material.emission
    np.testing.assert_array_equal(cv2.imread(glow.GetInput("file").Get().resolvedPath)[..., ::-1], entry.material.glow)
    np.testing.assert_allclose(sampled(roughness)[..., 1], entry.material.maps[..., 2] / 255.0)
    np.testing.assert_allclose(sampled(metallic)[..., 2], entry.material.maps[..., 3] / 255.0)


def sampled(value: UsdShade.Input) -> np.ndarray:
    """Texels (H, W, 3) of the texture that an input is connected to, scaled and biased as the node says; it is not a colour."""
    image = UsdShade.Shader(value.GetConnectedSources()[0][0].source.GetPrim())
    assert image.GetInput("sourceColorSpace").Get() == "raw"
    texels = cv2.imread(image.GetInput("file").Get().resolvedPath)[..., ::-1] / 255.0
    bias = image.GetInput("bias")
    return texels * list(image.GetInput("scale").Get())[:3] + (list(bias.Get())[:3] if bias else [0.0, 0.0, 0.0])


def test_every_visible_mesh_has_a_material_every_collider_friction_and_the_dome_its_map(folder, config):
    stage = Usd.Stage.Open(str(folder / "000000.usdc"))
    visible = solid = 0
    for prim in stage.Traverse():
        binding = UsdShade.MaterialBindingAPI(prim)
        if prim.HasAPI(UsdPhysics.CollisionAPI):
            solid += 1
            assert UsdGeom.Imageable(prim).ComputePurpose() == UsdGeom.Tokens.guide
            contact = UsdPhysics.MaterialAPI(binding.ComputeBoundMaterial("physics")[0].GetPrim())
            assert contact.GetDynamicFrictionAttr().Get() == contact.GetStaticFrictionAttr().Get() == config.physics.friction
            if prim.IsA(UsdGeom.Mesh):
                assert UsdPhysics.MeshCollisionAPI(prim).GetApproximationAttr().Get() == "convexHull"
        elif prim.IsA(UsdGeom.Gprim):
            visible += 1
            assert binding.ComputeBoundMaterial()[0].ComputeSurfaceSource()[0]
    dome = UsdLux.DomeLight.Get(stage, "/Episode/Lights/Dome")
    assert (dome.GetPrim().GetDisplayName(), dome.GetTextureFileAttr().Get().path) == ("mixed_lamps", "./assets/lights/light_001.exr")
    # Table, tote, finger, cup and three objects; a box, nine pieces, two, and four of the objects of which one has two.
    assert (visible, solid) == (7, 1 + 9 + 2 + 4)


def test_a_table_that_is_not_rendered_only_collides(tmp_path):
    folder = usd_sets.write_set(tmp_path / "set", usd_sets.settings(render__table=False), CATALOG, frames=2)
    stage = Usd.Stage.Open(str(folder / "000000.usdc"))
    table = stage.GetPrimAtPath("/Episode/Table")
    assert not table.GetChild("Visual")
    box = UsdGeom.Boundable(table.GetPrimAtPath("Collision/box"))
    bounds = UsdGeom.BBoxCache(0, [UsdGeom.Tokens.guide]).ComputeWorldBound(box.GetPrim()).ComputeAlignedRange()
    np.testing.assert_allclose(bounds.GetMax(), (10.0, 10.0, -0.0045), atol=1e-6)


@pytest.mark.parametrize(
    ("kind", "rows", "assets", "prim"),
    [
        ("tote", (), {"tote"}, "Tote"),
        ("own", (BinRow(name="kanban", compartments=(2, 1)), BinRow(name="2nd")), {"bin_kanban", "bin_2nd"}, "Bin"),
        ("pallet", (), {"pallet"}, "Bin"),
        ("none", (), set(), ""),
    ],
)
def test_an_episode_references_its_bin(tmp_path, kind, rows, assets, prim):
    config = replace(Config(), bins=Bins(kind=kind), bin=rows)
    folder = usd_sets.write_set(tmp_path / "set", config, CATALOG, frames=4)
    names = {path.stem for path in (folder / "assets").glob("*.usdc")}
    assert names - {"finger", "cup", "table"} - {name for name in names if name.startswith("obj_")} == assets
    stage = Usd.Stage.Open(str(folder / "000000.usdc"))
    for name in ("Tote", "Bin"):
        found = stage.GetPrimAtPath(f"/Episode/{name}")
        assert found.IsValid() == (name == prim)
        if name == prim:
            assert stage.GetPrimAtPath(f"/Episode/{name}/Visual").IsValid()
            pieces = stage.GetPrimAtPath(f"/Episode/{name}/Collision").GetChildren()
            assert len(pieces) == {"tote": 9, "own": 10, "pallet": 1}[kind]


# ---- bakes ----

CAMERAS = 3
NEAR = 0.01
"""Tolerance at outlines [px]: pixels whose centres are nearer may be in or out, as USD's camera parameters have 32 bits."""


def test_validators_find_nothing(picked_set):
    assert [error for path in (picked_set / "usd").rglob("*.usdc") for error in validation_errors(path)] == []


@pytest.mark.parametrize("camera", range(CAMERAS))
def test_projected_bodies_match_the_masks(picked_set, camera):
    stage = Usd.Stage.Open(str(picked_set / "usd/000000.usdc"))
    scene = picked_set / "train" / f"{camera:06d}"
    truth = json.loads((scene / "scene_gt.json").read_text())
    assert stage.GetEndTimeCode() == len(truth) - 1
    mask_pixels = 0
    for frame in range(len(truth)):
        lens = UsdGeom.Camera.Get(stage, f"/Episode/Cameras/camera_{camera}").GetCamera(frame).frustum
        view = np.array(lens.ComputeViewMatrix() * lens.ComputeProjectionMatrix())
        records = {record["instance_id"]: place for place, record in enumerate(truth[str(frame)])}
        bodies = visible_objects(stage, frame)
        assert set(bodies) == set(records)
        for instance, prim in bodies.items():
            mask = cv2.imread(str(scene / f"mask/{frame:06d}_{records[instance]:06d}.png"), cv2.IMREAD_UNCHANGED) > 0
            depth = inside(prim, frame, view, mask.shape)
            assert not (mask & (depth < -NEAR)).any()
            assert not (~mask & (depth > NEAR)).any()
            mask_pixels += mask.sum()
    assert mask_pixels > 1000
    assert json.loads((picked_set / "episodes.jsonl").read_text().splitlines()[0])["picked"] > 0  # Objects that disappear are covered.


def visible_objects(stage: Usd.Stage, frame: int) -> dict[int, Usd.Prim]:
    """Prims of the visible objects, by instance_id."""
    prims = stage.GetPrimAtPath("/Episode/Objects").GetChildren()
    visible = [prim for prim in prims if UsdGeom.Imageable(prim).ComputeVisibility(frame) != UsdGeom.Tokens.invisible]
    return {prim.GetAttribute("userProperties:instance_id").Get(): prim for prim in visible}


def inside(prim: Usd.Prim, frame: int, view: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Signed distance of pixel centres to an object's outline (H, W) [px], positive inside; the object is a union of convex pieces."""
    height, width = shape
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    best = np.full(shape, -np.inf)
    to_screen = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim)) @ view
    for piece in prim.GetChild("Collision").GetChildren():
        points = np.array(UsdGeom.Mesh(piece).GetPointsAttr().Get(), np.float64)
        shown = np.column_stack([points, np.ones(len(points))]) @ to_screen
        at = (shown[:, :2] / shown[:, 3:] * [0.5, -0.5] + 0.5) * [width, height]
        normals = ConvexHull(at).equations
        best = np.maximum(best, -(normals[:, :1, None] * x + normals[:, 1:2, None] * y + normals[:, 2:, None]).max(axis=0))
    return best


GIVEN = STIRRING | {
    "bake.formats": ["usd", "zarr"],
    "randomize.distractors": 1,
    "randomize.object_hue": {"uniform": [-90, 90]},
    "randomize.object_brightness": {"uniform": [0.5, 1.0]},
    "randomize.object_roughness": {"uniform": [0.0, 1.0]},
    "randomize.object_metallic": 0.25,
    "randomize.object_transmission": 0.8,
    "randomize.bin_color": {"uniform": [[0, 0, 0], [1, 1, 1]]},
    "randomize.texture_width": 0.25,
    "randomize.table_roughness": {"uniform": [0.5, 1.0]},
    "render.table_size": [1.0, 0.8],
}


def textures(place: Path) -> dict[str, object]:
    """Settings of the textures of table and background."""
    return {f"randomize.{part}_textures": str(place / "textures") for part in ("table", "background")}


@pytest.fixture(scope="module")
def looks(tmp_path_factory):
    place = tmp_path_factory.mktemp("looks")
    (place / "textures").mkdir()
    for name, color in (("a", (10, 20, 200)), ("b", (200, 100, 0))):
        cv2.imwrite(str(place / "textures" / f"{name}.png"), np.full((4, 8, 3), color, np.uint8))
    bake_boxes(place / "set", GIVEN | textures(place), objects=small_worlds.cluttered_catalog)
    return place / "set"


@pytest.fixture(scope="module")
def stage(looks):
    return Usd.Stage.Open(str(looks / "usd/000000.usdc"))


@pytest.fixture(scope="module")
def record(looks):
    return json.loads((looks / "episodes.jsonl").read_text().splitlines()[0])["looks"]


def bound(stage, path: str) -> tuple[UsdShade.Shader, UsdShade.Shader | None]:
    """Shader of the material that is bound to the visible mesh below a prim, and the texture that gives its colour."""
    material, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(f"{path}/Visual")).ComputeBoundMaterial()
    shader, *_ = material.ComputeSurfaceSource()
    sources, _ = shader.GetInput("diffuseColor").GetConnectedSources()
    return shader, UsdShade.Shader(sources[0].source.GetPrim()) if sources else None


def test_objects_have_the_drawn_material(stage, record):
    """Without texture: brightness, and a rotation about the grey axis, which keeps the sum of the channels."""
    assert len(record["objects"]) > 1
    assert len(record["distractors"]) == 1
    (base,) = {entry.material.color for entry in small_worlds.catalog().entries}
    rows = {f"instance_{index:02d}": row for index, row in enumerate(record["objects"])}
    rows |= {f"distractor_{row['instance']:02d}": row for row in record["distractors"]}
    for name, row in rows.items():
        shader, texture = bound(stage, f"/Episode/Objects/{name}")
        assert texture is None
        color = np.array(shader.GetInput("diffuseColor").Get())
        assert color.sum() == pytest.approx(row["brightness"] * srgb_to_linear(base).sum(), abs=1e-5)
        assert shader.GetInput("roughness").Get() == pytest.approx(row["roughness"], abs=1e-6)
        assert shader.GetInput("opacity").Get() == pytest.approx(1.0 - 0.75 * row["transmission"], abs=1e-6)
        assert shader.GetInput("metallic").Get() == pytest.approx(0.25)


def test_the_bin_has_the_drawn_colour_and_what_else_it_is_made_of(stage, record):
    shader, texture = bound(stage, "/Episode/Tote")
    assert texture is None
    np.testing.assert_allclose(shader.GetInput("diffuseColor").Get(), srgb_to_linear(record["bin"]["color"]), atol=1e-5)
    asset = Usd.Stage.Open(stage.ResolveIdentifierToEditTarget("./assets/tote.usdc"))
    given, _ = bound(asset, "/tote")
    assert shader.GetInput("roughness").Get() == given.GetInput("roughness").Get()


@pytest.mark.parametrize(("prim", "part", "side", "height"), [("Table", "table", 0.5, 0.0), ("Floor", "background", 10.0, -0.74)])
def test_table_and_floor_have_the_drawn_texture_at_its_width(stage, record, prim, part, side, height):
    shader, texture = bound(stage, f"/Episode/{prim}")
    assert shader.GetInput("roughness").Get() == pytest.approx(record[part].get("roughness", 1.0), abs=1e-6)
    place = texture.GetInput("file").Get().resolvedPath
    color = cv2.imread(place)[0, 0].tolist()
    assert color == ([10, 20, 200], [200, 100, 0])[record[part]["texture"]]
    scale = UsdShade.Shader(texture.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
    assert scale.GetIdAttr().Get() == "UsdTransform2d"
    np.testing.assert_allclose(scale.GetInput("scale").Get(), (4.0, 4.0))
    mesh = stage.GetPrimAtPath(f"/Episode/{prim}/Visual")
    points = np.array(mesh.GetAttribute("points").Get())
    np.testing.assert_allclose(np.array(mesh.GetAttribute("primvars:st").Get()), points[:, :2])
    assert (points[:, 0].max(), points[:, 2].max()) == pytest.approx((side, height - small_worlds.settings().tote.wall))


def test_a_conversion_writes_the_same_looks(looks, tmp_path, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.catalog.load_catalog", lambda _: small_worlds.cluttered_catalog())
    given = GIVEN | {"bake.formats": ["zarr"]} | textures(looks.parent)
    bake_boxes(tmp_path / "zarr", given, objects=small_worlds.cluttered_catalog)
    convert(tmp_path / "zarr", tmp_path / "usd", ("usd",), 1, lambda *_: None)
    baked, converted = (
        {name: value for name, value in digests(place).items() if name.startswith("usd/")} for place in (looks, tmp_path / "usd")
    )
    assert converted == baked
