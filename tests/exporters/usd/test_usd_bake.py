"""Bakes in USD: bodies projected by USD's cameras match BOP's masks pixel by pixel; an episode's own materials stand in place of those of
the assets, as its record has them, also after a conversion."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade
from scipy.spatial import ConvexHull

from synpick_warp.apps.conversion.run import convert
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.testing.exporters import digests
from tests.builders import STIRRING, bake_boxes
from tests.exporters.usd.test_usd import validation_errors
from tests.worlds import small_worlds

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
    "randomize.bin_color": {"uniform": [[0, 0, 0], [1, 1, 1]]},
    "randomize.texture_width": 0.25,
    "randomize.table_roughness": {"uniform": [0.5, 1.0]},
    "render.table_size": [1.0, 0.8],
}


def textures(place: Path) -> dict[str, object]:
    """Settings of the textures of table and background."""
    return {f"randomize.{part}_textures": str(place / "textures") for part in ("table", "background")}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("looks")
    (place / "textures").mkdir()
    for name, color in (("a", (10, 20, 200)), ("b", (200, 100, 0))):
        cv2.imwrite(str(place / "textures" / f"{name}.png"), np.full((4, 8, 3), color, np.uint8))
    bake_boxes(place / "set", GIVEN | textures(place), objects=small_worlds.cluttered_catalog)
    return place / "set"


@pytest.fixture(scope="module")
def stage(folder):
    return Usd.Stage.Open(str(folder / "usd/000000.usdc"))


@pytest.fixture(scope="module")
def record(folder):
    return json.loads((folder / "episodes.jsonl").read_text().splitlines()[0])["looks"]


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


def test_a_conversion_writes_the_same_looks(folder, tmp_path, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.catalog.load_catalog", lambda _: small_worlds.cluttered_catalog())
    given = GIVEN | {"bake.formats": ["zarr"]} | textures(folder.parent)
    bake_boxes(tmp_path / "zarr", given, objects=small_worlds.cluttered_catalog)
    convert(tmp_path / "zarr", tmp_path / "usd", ("usd",), 1, lambda *_: None)
    baked, converted = (
        {name: value for name, value in digests(place).items() if name.startswith("usd/")} for place in (folder, tmp_path / "usd")
    )
    assert converted == baked
