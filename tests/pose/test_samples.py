"""Model samples in views: which are visible, hidden or protruding, on scenes made by hand."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose.samples import HIDDEN, PROTRUDING, VISIBLE
from synpick_warp.scenes.types import TriangleMesh
from synpick_warp.stages.pose.batch import RgbdBatch
from synpick_warp.stages.pose.models import PoseModels, build_models
from synpick_warp.stages.pose.refine import LossScales, make_loss
from tests.harness.pose_probe import view_samples
from tests.twins import pose as twin
from tests.worlds.pose_views import FACING, drawn, model_of, observe, plate_view, pose_of, smooth_texture, table_of
from tests.worlds.toy_scene import box, sheet

FOCAL, SHAPE, DISTANCE = 400.0, (120, 160), 0.6
WIDTH, HEIGHT = 0.1, 0.08
POSE = np.array([0.0, 0.0, DISTANCE, *FACING], np.float32)
SCALES = LossScales()
PIXEL = DISTANCE / FOCAL
ONE = table_of((0, 0, 0))


def states(batch: RgbdBatch, mesh: TriangleMesh, pose: np.ndarray, device) -> tuple[dict[str, np.ndarray], PoseModels]:
    """What is found of each sample of the one instance, and the model."""
    models = build_models([model_of(mesh)], device, samples=512)
    found = view_samples(models, make_loss(SCALES, 0.01, 1, 1.0), observe(batch, ONE, device), pose)
    return {name: values[0] for name, values in found.items()}, models


def plate(texture: np.ndarray | None = None) -> RgbdBatch:
    """A sheet before a wall."""
    return plate_view((WIDTH, HEIGHT), DISTANCE, FOCAL, SHAPE, smooth_texture(1, 40, 50) if texture is None else texture)


def clear_of_edges(found: dict[str, np.ndarray]) -> np.ndarray:
    """Samples whose pixels surely show the plate or surely do not: more than a pixel from its edges."""
    away = np.abs(np.abs(found["position"][:, :2]) - (WIDTH / 2, HEIGHT / 2))
    return (away > PIXEL).all(axis=1)


def changed(batch: RgbdBatch, **arrays: np.ndarray) -> RgbdBatch:
    return RgbdBatch(**(vars(batch) | arrays))


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return POSE + np.array([x, y, z, 0, 0, 0, 0], np.float32)


def test_a_plate_before_a_wall_is_visible(device):
    found, models = states(plate(), sheet(WIDTH, HEIGHT), POSE, device)
    assert (found["state"][clear_of_edges(found)] == VISIBLE).all()
    position = models.models.position.numpy()[0] * (1.0, -1.0, -1.0) + (0.0, 0.0, DISTANCE)
    assert found["position"] == pytest.approx(position, abs=1e-6)
    assert found["normal"] == pytest.approx(np.tile([0.0, 0.0, -1.0], (512, 1)), abs=1e-6)
    # Its area across the viewing direction.
    facing = position[:, 2] / np.linalg.norm(position, axis=1)
    assert found["area"] == pytest.approx(WIDTH * HEIGHT / 512 * facing, rel=1e-4)


def test_crop_coordinates_are_those_of_the_projection(device):
    batch = plate()
    found, _ = states(batch, sheet(WIDTH, HEIGHT), POSE, device)
    seen = observe(batch, ONE, device).observation
    pixel = found["position"][:, :2] / found["position"][:, 2:] * FOCAL + (SHAPE[1] / 2, SHAPE[0] / 2)
    assert found["crop"] == pytest.approx((pixel - seen.corner.numpy()[0]) / seen.pitch.numpy()[0] - 0.5, abs=1e-3)


def test_an_occluder_hides(device):
    batch = plate()
    label, depth = batch.label.copy(), batch.depth.copy()
    label[0, :, : SHAPE[1] // 2] = 2
    depth[0, :, : SHAPE[1] // 2] = round(0.5 / batch.depth_scale[0])
    found, _ = states(changed(batch, label=label, depth=depth), sheet(WIDTH, HEIGHT), POSE, device)
    left, sure = found["position"][:, 0] < 0.0, clear_of_edges(found)
    assert (found["state"][left] == HIDDEN).all()
    assert (found["state"][~left & sure] == VISIBLE).all()


def test_what_lies_before_the_background_protrudes(device):
    """A plate that is estimated 10 mm beside its mask; the wall is 0.2 m behind."""
    found, _ = states(plate(), sheet(WIDTH, HEIGHT), moved(x=0.01), device)
    beyond = found["position"][:, 0] > WIDTH / 2
    assert beyond.sum() == pytest.approx(51, abs=3)
    sure = clear_of_edges(found)
    assert (found["state"][beyond & sure] == PROTRUDING).all()
    assert (found["state"][~beyond & sure] == VISIBLE).all()
    # By as much as it is beyond the last pixel's centre, less the deadband; straight back.
    way = found["way"][beyond]
    pitch = max(1.0, 1.12 * WIDTH / PIXEL / twin.CROP)
    expected = found["position"][beyond, 0] - WIDTH / 2 + (0.5 - 0.75 * pitch) * PIXEL
    inner = np.abs(found["position"][beyond, 1]) < HEIGHT / 2 - 3 * PIXEL
    assert way[inner, 3] == pytest.approx(np.maximum(expected[inner], 0.0), abs=0.8 * pitch * PIXEL)
    far = inner & (way[:, 3] > 3 * PIXEL)
    assert far.any()
    assert (way[far, 0] < -0.9).all()
    assert np.einsum("nc,nc->n", way[far, :3], found["position"][beyond][far]) == pytest.approx(np.zeros(far.sum()), abs=1e-6)
    assert np.linalg.norm(way[far, :3], axis=1) == pytest.approx(np.ones(far.sum()), abs=1e-5)


@pytest.mark.parametrize(("behind", "state"), [(0.004, HIDDEN), (0.008, PROTRUDING)])
def test_a_sample_protrudes_by_more_than_the_margin(device, behind, state):
    """Neighbours at nearly its depth may hide it: the margin is 6 mm."""
    batch = plate()
    depth = np.where(batch.label > 0, batch.depth, round((DISTANCE + behind) / batch.depth_scale[0])).astype(np.uint16)
    found, _ = states(changed(batch, depth=depth), sheet(WIDTH, HEIGHT), moved(x=0.01), device)
    assert (found["state"][(found["position"][:, 0] > WIDTH / 2) & clear_of_edges(found)] == state).all()


@pytest.mark.parametrize(("behind", "state"), [(-0.004, VISIBLE), (0.004, VISIBLE), (0.02, HIDDEN), (-0.02, VISIBLE)])
def test_in_the_mask_a_sample_behind_the_depth_is_hidden(device, behind, state):
    found, _ = states(plate(), sheet(WIDTH * 0.8, HEIGHT * 0.8), moved(z=behind), device)
    assert (found["state"] == state).all()


def test_without_depth_the_mask_decides(device):
    batch = plate()
    nothing = changed(batch, depth=np.zeros_like(batch.depth))
    found, _ = states(nothing, sheet(WIDTH, HEIGHT), moved(x=0.01), device)
    beyond = found["position"][:, 0] > WIDTH / 2
    sure = clear_of_edges(found)
    assert (found["state"][beyond & sure] == HIDDEN).all()
    assert (found["state"][~beyond & sure] == VISIBLE).all()


@pytest.mark.parametrize(
    "pose",
    [
        moved(x=1.0),
        moved(y=-1.0),
        moved(z=-1.0),
        np.array([0.0, 0.0, DISTANCE, 0.0, 0.0, 0.0, 1.0], np.float32),
        pose_of((0.0, 0.0, DISTANCE), Rotation.from_euler("x", 94.0, degrees=True)),
    ],
    ids=["beside the image", "above the image", "behind the camera", "averted", "oblique"],
)
def test_what_a_camera_cannot_see_is_hidden(device, pose):
    found, _ = states(plate(), sheet(WIDTH, HEIGHT), pose, device)
    assert (found["state"] == HIDDEN).all()


def test_a_concave_object_hides_a_part_of_itself(device):
    """Two plates 60 mm apart: of the one behind, only what the nearer, smaller one leaves free is seen."""
    front, back = box(0.04, 0.04, 0.004), box(0.1, 0.08, 0.004)
    both = TriangleMesh(
        vertices=np.concatenate([front.vertices + np.float32([0, 0, -0.06]), back.vertices]),
        faces=np.concatenate([front.faces, back.faces + len(front.vertices)]),
        normals=np.concatenate([front.normals, back.normals]),
        uv=np.concatenate([front.uv, back.uv]),
    )
    near, far = DISTANCE - 0.062, DISTANCE - 0.002
    depth = np.full(SHAPE, 0.64)
    rows, columns = np.indices(SHAPE)
    x, y = np.abs(columns + 0.5 - SHAPE[1] / 2) / FOCAL, np.abs(rows + 0.5 - SHAPE[0] / 2) / FOCAL
    depth[(x * far < 0.05) & (y * far < 0.04)] = far
    depth[(x * near < 0.02) & (y * near < 0.02)] = near
    found, models = states(drawn(depth < 0.63, depth, FOCAL), both, pose_of((0, 0, DISTANCE), Rotation.identity()), device)
    facing = models.models.normal.numpy()[0][:, 2] < -0.9
    side = np.abs(found["position"][:, :2] / found["position"][:, 2:])
    upper = found["position"][:, 2] < DISTANCE - 0.03
    sure = ((np.abs(side - 0.02 / near) > 1.0 / FOCAL) & (np.abs(side - np.array([0.05, 0.04]) / far) > 1.0 / FOCAL)).all(axis=1)
    covered = facing & ~upper & (side * near < 0.02).all(axis=1)
    assert (covered & sure).sum() > 20
    assert (found["state"][covered & sure] == HIDDEN).all()
    assert (found["state"][facing & ~covered & sure] == VISIBLE).all()
    assert (found["state"][models.models.normal.numpy()[0][:, 2] > 0.9] == HIDDEN).all()


def test_colours_are_interpolated_within_the_mask(device):
    batch = plate()
    found, _ = states(batch, sheet(WIDTH, HEIGHT), POSE, device)
    seen = observe(batch, ONE, device).observation
    inside, color = seen.inside.numpy()[0] > 0, seen.color.numpy()[0].astype(np.float64)
    column, row = np.floor(found["crop"]).astype(int).T
    whole = inside[row, column] & inside[row, column + 1] & inside[row + 1, column] & inside[row + 1, column + 1]
    assert np.array_equal(found["colored"] > 0, whole)
    assert 0.8 < whole.mean() < 1.0
    assert found["color"][whole] == pytest.approx(twin.bilinear(color, found["crop"][whole].astype(np.float64)), abs=1e-4)
