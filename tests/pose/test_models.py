"""Object models on the device: samples of surfaces and their colours, symmetries that keep a shape."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.types import Material
from synpick_warp.stages.pose.models import (
    MAX_SYMMETRIES,
    SAMPLES,
    SYMMETRY_STEP,
    SYMMETRY_TOLERANCE,
    build_models,
    near_symmetries,
    sample_surface,
)
from tests.worlds.pose_views import as_material, embedded, model_of
from tests.worlds.toy_scene import GREY, ball, box, flat_shaded, sheet


def cylinder(radius: float, height: float):
    mesh = trimesh.creation.cylinder(radius, height, sections=64)
    return flat_shaded(mesh.vertices, mesh.faces)


def has_symmetry(symmetries: np.ndarray, rotation: Rotation, tolerance: float = 1.0) -> bool:
    return bool(np.degrees((Rotation.from_quat(symmetries) * rotation.inv()).magnitude()).min() < tolerance)


@pytest.mark.parametrize("count", [64, 500, SAMPLES])
def test_samples_lie_evenly_on_the_surface(count):
    size = np.array([0.12, 0.08, 0.05])
    found = sample_surface(box(*size), GREY, count)
    area = 2.0 * (size[0] * size[1] + size[1] * size[2] + size[2] * size[0])
    assert found.area == pytest.approx(area, rel=1e-6)
    # On a face, with its outward normal.
    side = np.abs(found.normal).argmax(axis=1)
    rows = np.arange(count)
    assert found.position[rows, side] * np.sign(found.normal[rows, side]) == pytest.approx(size[side] / 2.0, abs=1e-6)
    assert (np.abs(found.position) <= size / 2.0 + 1e-6).all()
    for axis in range(3):
        for sign in (-1.0, 1.0):
            share = np.prod(np.delete(size, axis)) / area
            assert (found.normal[:, axis] == sign).sum() == pytest.approx(share * count, abs=4.0)
    # No point of the surface is farther from a sample than twice the step of a square grid.
    dense = sample_surface(box(*size), GREY, 20_000).position
    assert KDTree(found.position).query(dense)[0].max() < 2.0 * np.sqrt(area / count)


def test_colours_of_samples_are_those_of_the_texture():
    """v points up: the texture's top row is at the sheet's +y."""
    texture = np.zeros((2, 2, 3), np.uint8)
    texture[0], texture[1] = [(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (128, 128, 128)]
    found = sample_surface(sheet(0.1, 0.1), Material((1.0, 1.0, 0.5), texture, 0.0, 0.5), 200)
    column, row = (found.position[:, 0] > 0.0).astype(int), (found.position[:, 1] < 0.0).astype(int)
    factor = srgb_to_linear(np.array([1.0, 1.0, 0.5]))
    assert found.color == pytest.approx(srgb_to_linear(texture[row, column] / 255.0) * factor, abs=1e-6)


def test_colours_are_means_over_a_crop_pixel():
    """A fine chequerboard becomes grey: a sample stands for more than a texel."""
    board = np.tile(np.array([[0.0, 1.0], [1.0, 0.0]]), (256, 256))[..., None] * np.ones(3)
    found = sample_surface(sheet(0.1, 0.1), as_material(board), 200)
    assert found.color == pytest.approx(np.full((200, 3), 0.5), abs=0.01)


def test_without_a_texture_the_factor_is_the_colour():
    found = sample_surface(ball(0.05, 1), GREY, 50)
    assert found.color == pytest.approx(np.full((50, 3), srgb_to_linear(0.7)), abs=1e-6)


def test_turns_of_a_cylinder():
    """All steps about its axis, and the can upside down in all of them; beside these only slight tilts, and no quarter turn."""
    symmetries = near_symmetries(sample_surface(cylinder(0.034, 0.1), GREY, SAMPLES).position)
    assert symmetries[0].tolist() == [0.0, 0.0, 0.0, 1.0]
    upright = Rotation.from_quat(symmetries).as_matrix()[:, 2, 2]
    assert (np.abs(upright) > np.cos(np.deg2rad(SYMMETRY_STEP + 5.0))).all()
    for angle in np.arange(0.0, 360.0, SYMMETRY_STEP):
        # The samples' principal axes are not exactly the can's.
        about = Rotation.from_euler("z", angle, degrees=True)
        assert has_symmetry(symmetries, about, 5.0)
        assert has_symmetry(symmetries, about * Rotation.from_euler("x", 180.0, degrees=True), 0.5 * SYMMETRY_STEP + 1.0)


@pytest.mark.parametrize(("size", "quarter"), [((0.16, 0.09, 0.05), None), ((0.2, 0.05, 0.05), "x"), ((0.16, 0.16, 0.05), "z")])
def test_turns_of_a_box(size, quarter):
    """The three half-turns; of a square one also the quarter turns about its axis. Quarter turns about other axes are none."""
    symmetries = near_symmetries(sample_surface(box(*size), GREY, SAMPLES).position)
    assert has_symmetry(symmetries, Rotation.identity())
    for axis in "xyz":
        assert has_symmetry(symmetries, Rotation.from_euler(axis, 180.0, degrees=True), 0.5 * SYMMETRY_STEP)
        assert has_symmetry(symmetries, Rotation.from_euler(axis, 90.0, degrees=True), 0.5 * SYMMETRY_STEP) == (axis == quarter)


def test_turns_of_a_shape_without_symmetry():
    """A long L: slight tilts about its axes may keep it near, half-turns do not."""
    arms = trimesh.util.concatenate(
        [trimesh.creation.box((0.2, 0.04, 0.03)), _moved(trimesh.creation.box((0.04, 0.1, 0.05)), (0.08, 0.07, 0.0))]
    )
    mesh = flat_shaded(arms.vertices, arms.faces)
    symmetries = near_symmetries(sample_surface(mesh, GREY, SAMPLES).position)
    magnitude = np.degrees(Rotation.from_quat(symmetries).magnitude())
    half_about_z = np.abs(Rotation.from_quat(symmetries).apply((0.0, 0.0, 1.0))[:, 2]) > 0.9
    assert magnitude[half_about_z].max() < 3.0 * SYMMETRY_STEP


def _moved(mesh: trimesh.Trimesh, offset: tuple[float, float, float]) -> trimesh.Trimesh:
    mesh.apply_translation(offset)
    return mesh


def test_turns_keep_the_surface_near():
    """To the tolerance, and the spacing of the samples, for the symmetries about one axis; twice that for those that flip, too."""
    (can,) = embedded(4)
    points = sample_surface(can.mesh, can.material, SAMPLES).position.astype(np.float64)
    points -= points.mean(axis=0)
    tree, symmetries = KDTree(points), near_symmetries(points)
    size = 2.0 * np.linalg.norm(points, axis=1).max()
    spacing = tree.query(points, k=2)[0][:, 1].mean()
    moved = [tree.query(Rotation.from_quat(turn).apply(points))[0].mean() for turn in symmetries]
    assert max(moved) < 2.0 * (spacing + SYMMETRY_TOLERANCE * size)
    assert 1 < len(symmetries) <= MAX_SYMMETRIES
    # Different symmetries are apart.
    apart = [
        (Rotation.from_quat(turn) * Rotation.from_quat(symmetries[:k]).inv()).magnitude().min() for k, turn in enumerate(symmetries) if k
    ]
    assert np.degrees(min(apart)) > 0.5 * SYMMETRY_STEP - 1e-3


def test_device_arrays_hold_the_models(device):
    objects = [model_of(box(0.12, 0.08, 0.05)), *embedded(4)]
    models = build_models(objects, device, samples=256)
    radius = [np.linalg.norm(item.mesh.vertices, axis=1).max() for item in objects]
    assert models.models.radius.numpy() == pytest.approx(radius)
    assert models.diameters == pytest.approx(2.0 * np.array(radius))
    for row, item in enumerate(objects):
        samples = sample_surface(item.mesh, item.material, 256)
        assert np.array_equal(models.models.position.numpy()[row], samples.position)
        assert np.array_equal(models.models.normal.numpy()[row], samples.normal)
        assert np.array_equal(models.models.color.numpy()[row], samples.color)
        assert models.models.sample_area.numpy()[row] == pytest.approx(samples.area / 256)
        assert models.symmetries.center.numpy()[row] == pytest.approx(samples.position.mean(axis=0), abs=1e-6)
    assert models.models.mesh.numpy().tolist() == [mesh.id for mesh in models.meshes]
