"""An own cell end to end: a bin as STL with a sloped floor and a divider, a part as STL in millimetres, all formats."""

from __future__ import annotations

import numpy as np
import pytest
import zarr
from pxr import Usd, UsdGeom
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.apps.viz.explain import write_explanation
from synpick_warp.apps.viz.preview import write_contact_sheet
from synpick_warp.configs.files.load import load_config
from synpick_warp.configs.schema import FORMATS
from synpick_warp.dataset.reading import DataSet
from synpick_warp.factory.pipeline import run_bake
from synpick_warp.scenes.bins import make_bins
from synpick_warp.scenes.catalog import load_catalog
from synpick_warp.system.progress import SilentProgress
from tests.builders import PICKING
from tests.harness.bake_server import TINY
from tests.worlds.bin_meshes import bracket, sloped_bin

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


def deepest(pieces, points: np.ndarray) -> float:
    """Largest depth of points (N, 3) in convex pieces [m]."""
    planes = (ConvexHull(piece.vertices.astype(float)).equations for piece in pieces)
    return max(float(-(points @ each[:, :3].T + each[:, 3]).max(axis=1).min()) for each in planes)


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """Settings and data set of an episode."""
    folder = tmp_path_factory.mktemp("cell")
    for name in ("bins", "parts"):
        (folder / name).mkdir()
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
    config = load_config(str(folder / "cell.toml"), quick | more)
    summary = run_bake(config, folder / "set", SilentProgress())
    (row,) = summary.episodes
    assert (row.objects, row.picked > 0, summary.resampled) == (3, True, 0)
    return folder


@pytest.mark.slow(minutes=1)
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
    assert deepest(one.pieces, local) < MAX_DEPTH
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
