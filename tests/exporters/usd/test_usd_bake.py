"""A bake in BOP and USD formats: bodies projected by USD's cameras match BOP's masks pixel by pixel."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest
from pxr import Usd, UsdGeom
from scipy.spatial import ConvexHull

from tests.exporters.usd.test_usd import validation_errors

CAMERAS = 3
NEAR = 0.01
"""Tolerance at outlines [px]: pixels whose centres are nearer may be in or out, as USD's camera parameters have 32 bits."""


def test_validators_find_nothing(picked_set):
    for path in sorted((picked_set / "usd").rglob("*.usdc")):
        assert list(validation_errors(path)) == []


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
