"""USD data sets as files: exporter contract, assets, references, and USD's own validators."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from pxr import Sdf, Usd, UsdGeom, UsdLux, UsdPhysics, UsdSemantics, UsdShade, UsdUtils, UsdValidation

from synpick_warp.configs.cell.bins import BinRow, Bins
from synpick_warp.configs.schema import Config
from synpick_warp.errors import OutputError
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.usd.exporter import UsdExporter
from synpick_warp.exporters.usd.lights import write_light_maps
from synpick_warp.exporters.usd.parts import new_asset, save_layer
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.embedded.skies import skies
from synpick_warp.testing.exporters import ExporterContract
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
from synpick_warp.exporters.usd.parts import new_asset, save_layer
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
    assets |= {"assets/textures/obj_000002.png", *(f"assets/lights/light_00{index}.exr" for index in range(2))}
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
    assert shader.GetInput("metallic").Get() == pytest.approx(entry.material.metallic)
    assert shader.GetInput("roughness").Get() == pytest.approx(entry.material.roughness)
    linear, color = srgb_to_linear(entry.material.color), shader.GetInput("diffuseColor")
    if entry.material.texture is None:
        np.testing.assert_allclose(color.Get(), linear, rtol=1e-6)
        return
    image = UsdShade.Shader(color.GetConnectedSources()[0][0].source.GetPrim())
    np.testing.assert_allclose(image.GetInput("scale").Get(), [*linear, 1.0], rtol=1e-6)
    assert image.GetInput("sourceColorSpace").Get() == "sRGB"
    picture = cv2.imread(image.GetInput("file").Get().resolvedPath)
    np.testing.assert_array_equal(picture[..., ::-1], entry.material.texture)
    reader = UsdShade.Shader(image.GetInput("st").GetConnectedSources()[0][0].source.GetPrim())
    assert reader.GetInput("varname").Get() == "st"


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
