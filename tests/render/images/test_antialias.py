"""Anti-aliasing and supersampled shading: coverage against known geometry, no change beside discontinuities, means of pixels."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import FAST, REFERENCE, UNOCCLUDED
from synpick_warp.kernels.render.images.antialias import sample_offset
from synpick_warp.kernels.render.images.kept_sources import KeptSources, forget_sources_kernel
from synpick_warp.kernels.render.lighting.shading import MAX_WEIGHT_CHANGE, move_weights, shade_kernel, shade_samples_kernel, sum_of
from synpick_warp.kernels.render.lighting.tile_flags import DAMAGED, RELIT, TileFlags
from synpick_warp.kernels.render.visibility.triangles import Triangle, edge_areas
from synpick_warp.scenes.assets.appearance import srgb_to_linear
from synpick_warp.scenes.types import EnvironmentMap, TriangleMesh
from synpick_warp.stages.render import denoised, sampling_rates
from synpick_warp.stages.render.sampling_rates import COVERAGE_RAYS, NARROW_COVERAGE_RAYS
from synpick_warp.stages.render.scene import build_grid
from tests.harness.probe import probe
from tests.worlds.shapes import UPRIGHT, WHITE, ball, box, camera, entry, even_light, sheet, sun, surface
from tests.worlds.toy_scene import ANNOTATIONS, RenderedViews, ToyScene, assert_same, render, render_objects, with_render

VIEW = camera(48, 40, 200.0, (0.0, 0.0, 2.0))


def rotated_pose(x: float, y: float, z: float, angle: float, axis: int = 2) -> tuple[float, ...]:
    """Pose at x, y, z [m], rotated by `angle` [rad] about an axis."""
    quaternion = [0.0, 0.0, 0.0, np.cos(angle / 2)]
    quaternion[axis] = np.sin(angle / 2)
    return (x, y, z, *quaternion)


def render_image(device, *bodies, view=VIEW, config=None, **more) -> RenderedViews:
    """Image of bodies, given as (mesh, pose, colour)."""
    placed = [(mesh, surface(color), pose) for mesh, pose, color in bodies]
    return render_objects(device, *placed, view=view, config=config, **more)


def sample_offsets(samples: int = NARROW_COVERAGE_RAYS) -> np.ndarray:
    """Positions x, y of the coverage samples [px from the pixel's centre] (samples, 2), sorted by quadrant."""
    columns = np.arange(samples)
    digits = (columns[:, None] >> np.arange(samples.bit_length() - 1)) & 1
    rows = (digits[:, ::-1] * (1 << np.arange(digits.shape[1]))).sum(axis=1) ^ (samples // 2)
    x, y = ((place + 0.5) / samples - 0.5 for place in (columns, rows))
    order = np.argsort(2 * (y > 0.0) + (x > 0.0), kind="stable")
    return np.stack([x, y], axis=-1)[order]


def source_pixels(picture: RenderedViews, samples: int = NARROW_COVERAGE_RAYS) -> np.ndarray:
    """Source pixel (row, column) of each sample of each pixel (H, W, samples, 2): the pixel whose radiance the sample takes."""
    resolve = picture.resolve[0]
    choice = (resolve[..., None] >> (2 * np.arange(samples, dtype=np.uint32))) & 3
    towards = np.where(sample_offsets(samples)[:, ::-1] > 0.0, 1, -1)
    step = np.stack([choice >> 1, choice & 1], axis=-1).astype(int) * towards
    return np.stack(np.mgrid[: resolve.shape[0], : resolve.shape[1]], axis=-1)[:, :, None] + step


def sample_positions(view, pose, distance: float, samples: int = NARROW_COVERAGE_RAYS) -> np.ndarray:
    """Intersections of the samples' rays with the plane z = 0, in the coordinate system of a plate in that plane [m] (H, W, samples, 2)."""
    rows, columns = np.mgrid[: view.height, : view.width]
    offsets = sample_offsets(samples)
    x = (columns[..., None] + 0.5 + offsets[:, 0] - view.matrix[0, 2]) / view.matrix[0, 0] * distance
    y = -(rows[..., None] + 0.5 + offsets[:, 1] - view.matrix[1, 2]) / view.matrix[1, 1] * distance
    angle = 2.0 * np.arctan2(pose[5], pose[6])
    x, y = x - pose[0], y - pose[1]
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x], axis=-1)


offset_of = probe(sample_offset)


@pytest.mark.parametrize("samples", [4, 8, 16])
def test_samples_are_stratified_and_sorted_by_quadrant(device, samples):
    """Each of n rows and n columns contains one of n samples, and each quadrant n / 4; 4 samples form the rotated grid (four rooks)."""
    found = offset_of(np.arange(samples), samples, device=device)
    for axis in range(2):
        np.testing.assert_allclose(np.sort(found[:, axis]), (np.arange(samples) + 0.5) / samples - 0.5, atol=1e-7)
    np.testing.assert_array_equal(2 * (found[:, 1] > 0) + (found[:, 0] > 0), np.repeat(np.arange(4), samples // 4))
    np.testing.assert_array_equal(found, sample_offsets(samples))
    if samples == 4:
        np.testing.assert_array_equal(found * 8.0, [(-1, -3), (3, -1), (-3, 1), (1, 3)])


def render_plate(device, width: float, height: float, pose, samples: int) -> tuple[RenderedViews, np.ndarray, np.ndarray]:
    """Image of a plate; which samples it covers, and which take the radiance of a pixel that shows it (H, W, samples)."""
    config = with_render(coarse_pixel=2 if samples == COVERAGE_RAYS else 0)
    picture = render_image(device, (sheet(width, height), pose, (0.9, 0.2, 0.2)), config=config)
    inside = np.all(np.abs(sample_positions(VIEW, pose, 2.0, samples)) <= (width / 2, height / 2), axis=-1)
    return picture, inside, picture.instance[0][tuple(np.moveaxis(source_pixels(picture, samples), -1, 0))] == 1


@pytest.mark.parametrize("samples", [COVERAGE_RAYS, NARROW_COVERAGE_RAYS])
@pytest.mark.parametrize("angle", [0.0, 0.1, 0.4, np.pi / 4, 1.3])
def test_silhouette_pixels_resolve_by_coverage(device, angle, samples):
    picture, inside, on_plate = render_plate(device, 0.21, 0.13, rotated_pose(0.0123, -0.0071, 0.0, angle), samples)
    resolved = picture.resolve[0] != 0
    np.testing.assert_array_equal(on_plate[resolved], inside[resolved])
    # All other pixels are covered wholly or not at all, except at the tips of corners.
    partly = (inside.any(axis=-1) != inside.all(axis=-1)) & ~resolved
    assert partly.sum() <= 4
    assert resolved.sum() > 40


def test_resolved_colour_is_the_mean_over_the_source_pixels(device):
    picture = render_image(
        device, (sheet(0.21, 0.13), rotated_pose(0.0, 0.0, 0.0, 0.3), (0.5, 0.5, 0.5)), config=with_render(tone="linear", exposure=0.4)
    )
    source = source_pixels(picture)
    mean = picture.radiance[0][source[..., 0], source[..., 1]].mean(axis=2)
    resolved = picture.resolve[0] != 0
    gain = srgb_to_linear(picture.color[0, 0, 0] / 255.0) / picture.radiance[0, 0, 0]
    np.testing.assert_allclose(srgb_to_linear(picture.color[0][resolved] / 255.0), gain * mean[resolved], atol=0.006)


def plate_over_slope() -> TriangleMesh:
    """A level plate 0.3 m above a sloping one, as one mesh."""
    low, high = sheet(0.25, 0.2), sheet(0.1, 0.1)
    lean = np.array([[1, 0, 0], [0, 1, 0], [0, 0.5, 1]], np.float32)
    normals = low.normals @ np.linalg.inv(lean)
    return replace(
        low,
        vertices=np.concatenate([low.vertices @ lean.T, high.vertices + np.array([0, 0, 0.3], np.float32)]),
        faces=np.concatenate([low.faces, high.faces + 4]),
        normals=np.concatenate([normals / np.linalg.norm(normals, axis=1, keepdims=True), high.normals]),
        uv=np.concatenate([low.uv, high.uv]),
    )


def test_self_occlusion_is_resolved_by_depth(device):
    pose = rotated_pose(0.0, 0.0, 0.0, 0.3)
    picture = render_image(device, (plate_over_slope(), pose, (0.9, 0.9, 0.9)), lights=(sun((0.0, 0.7, 0.7)),))
    inside = np.all(np.abs(sample_positions(VIEW, pose, 1.7)) <= 0.05, axis=-1)
    source = source_pixels(picture)
    upper = picture.exact_depth[0][source[..., 0], source[..., 1]] < 1.85
    resolved = picture.resolve[0] != 0
    np.testing.assert_array_equal(upper[resolved], inside[resolved])
    assert (inside.any(axis=-1) & resolved).sum() > 30


@pytest.mark.parametrize("x", [0.003, 0.00483])
def test_a_crease_resolves_both_faces_by_coverage(device, x):
    """A box with one edge towards the camera: one face to the left of it, another to the right; also an edge at the centres of pixels."""
    rotated_box = (box(0.1, 0.3, 0.1), rotated_pose(x, 0.0, 0.0, np.pi / 4, axis=1), (0.9, 0.9, 0.9))
    picture = render_image(device, rotated_box, lights=(sun((0.7, 0.0, 0.7)),))
    ridge = VIEW.matrix[0, 2] + x / (2.0 - 0.1 / np.sqrt(2.0)) * VIEW.matrix[0, 0]
    column = int(ridge)
    source = source_pixels(picture)[10:30, column]
    assert (picture.resolve[0, 10:30, column] != 0).all()
    right = column + 0.5 + sample_offsets()[:, 0] > ridge
    centre_is_right = column + 0.5 > ridge
    expected = np.where(right == centre_is_right, column, np.where(right, column + 1, column - 1))
    np.testing.assert_array_equal(source[..., 1], np.broadcast_to(expected, source[..., 1].shape))


def test_creases_without_contrast_are_not_resolved(device):
    """Both faces at a box's edge towards the camera have the same radiance, with little noise."""
    rotated_box = (box(0.1, 3.0, 0.1), rotated_pose(0.003, 0.0, 0.0, np.pi / 4, axis=1), (0.9, 0.9, 0.9))
    picture = render_image(device, rotated_box, config=with_render(coarse_paths=32))
    assert not picture.resolve[0, :, 20:28].any()


@pytest.mark.parametrize(("one", "other"), [((0.9, 0.1, 0.1), (0.9, 0.29, 0.1)), ((0.1, 0.1, 0.9), (0.3, 0.1, 0.9))])
def test_contrast_in_a_dark_channel_is_resolved(device, one, other):
    """Two sheets side by side, whose colours differ by 40 grey levels in one channel."""
    sheets = [(sheet(0.2, 0.5), rotated_pose(side * 0.1 + 0.003, 0.0, 0.0, 0.0), color) for side, color in ((-1, one), (1, other))]
    assert (render_image(device, *sheets).resolve[0, 5:35, 24] != 0).all()


@pytest.mark.parametrize("samples", [COVERAGE_RAYS, NARROW_COVERAGE_RAYS])
def test_pixels_at_the_image_border_are_resolved(device, samples):
    """A plate whose silhouette crosses all four image borders, where footprints have only two corner pixels.

    A sample keeps the radiance of its own pixel if neither corner shows the surface it hits. Four samples per pixel never do here.
    """
    picture, inside, on_plate = render_plate(device, 1.0, 0.34, rotated_pose(0.0, 0.0, 0.0, 0.25), samples)
    plate = picture.instance[0] == 1
    border = np.ones_like(plate)
    border[1:-1, 1:-1] = False
    partly = border & (inside.any(axis=-1) != inside.all(axis=-1))
    assert all(side.any() for side in (partly[0], partly[-1], partly[:, 0], partly[:, -1]))
    padded = np.pad(plate, 1, mode="edge")
    down, right = (np.where(sample_offsets(samples)[:, axis] > 0.0, 1, -1) for axis in (1, 0))
    rows, columns = (index[..., None] + 1 for index in np.mgrid[: plate.shape[0], : plate.shape[1]])
    corners = [padded[rows + i * down, columns + j * right] for i in (0, 1) for j in (0, 1)]
    shown = np.any(corners, axis=0) != np.all(corners, axis=0)
    expected = np.where(shown, inside, plate[..., None])
    np.testing.assert_array_equal(on_plate[partly], expected[partly])
    assert (expected != inside)[partly].mean() <= (0.0 if samples == COVERAGE_RAYS else 0.04)


def test_smooth_surfaces_and_the_background_are_not_resolved(device):
    tilted = rotated_pose(0.0, 0.0, 0.0, 1.2, axis=0)
    assert not render_image(device, (sheet(4.0, 9.0), tilted, (0.9, 0.9, 0.9))).resolve.any()
    empty = render_image(device)
    assert not empty.resolve.any()
    assert (empty.instance == Segment.NOTHING).all()
    assert not render_image(device, table=True).resolve.any()


def test_antialiasing_changes_only_the_colour_of_resolved_pixels(device):
    bodies = [
        (box(0.1, 0.06, 0.08), rotated_pose(0.02, 0.0, 0.0, 0.5), (0.2, 0.4, 0.9)),
        (sheet(0.3, 0.1), rotated_pose(-0.05, 0.0, -0.1, 1.0), (0.8, 0.8, 0.3)),
    ]
    antialiased, aliased = (render_image(device, *bodies, config=with_render(antialias=on), table=True) for on in (True, False))
    assert_same(antialiased, aliased, "exact_depth", "radiance", *ANNOTATIONS)
    resolved = antialiased.resolve[0] != 0
    assert not aliased.resolve.any()
    np.testing.assert_array_equal(antialiased.color[0][~resolved], aliased.color[0][~resolved])
    assert (antialiased.color[0][resolved] != aliased.color[0][resolved]).any(axis=-1).mean() > 0.5


def test_resolved_pixels_are_closer_to_the_reference(device):
    bodies = [
        (sheet(0.6, 0.5), (0.0, 0.0, 0.0, *UPRIGHT), (0.7, 0.7, 0.6)),
        (box(0.12, 0.06, 0.08), rotated_pose(0.02, 0.01, 0.041, 0.5), (0.1, 0.2, 0.6)),
        (box(0.05, 0.05, 0.05), rotated_pose(-0.07, 0.02, 0.026, 1.0), (0.8, 0.1, 0.1)),
    ]
    configs = (with_render(mode=FAST), with_render(mode=FAST, antialias=False), with_render(mode=REFERENCE, samples=256))
    antialiased, aliased, reference = (render_image(device, *bodies, config=config, lights=(even_light(),)) for config in configs)
    resolved = antialiased.resolve[0] != 0
    errors = [np.square(picture.color[0].astype(float) - reference.color[0])[resolved].mean() for picture in (antialiased, aliased)]
    assert errors[0] < 0.3 * errors[1]


# ---- supersampled shading of narrow images ----


WIDTH, HEIGHT, FINE = 64, 48, 8
"""Image size, and the number of pixels of a finer image along one of its pixels."""
TILTED = (0.0, 0.0, 0.0, np.sin(0.5), 0.0, 0.0, np.cos(0.5))
"""Pose of a body that is turned by 1 rad about the image's x axis."""
STRIPES = EnvironmentMap(
    "stripes", np.broadcast_to(np.where(np.arange(64) // 2 % 2, 1.5, 0.5)[:, None, None], (64, 128, 3)).astype(np.float32)
)
"""Sky with horizontal stripes, six degrees wide."""


@wp.func
def move_to_ray(triangle: Triangle, ray: wp.vec3, center_ray: wp.vec3, center: wp.vec3):
    """Weights of the point where a ray of depth 1 meets its triangle's plane, and the fraction of the way from `center`."""
    weights, fraction = move_weights(center, wp.sign(sum_of(edge_areas(triangle, center_ray))), edge_areas(triangle, ray))
    return weights, fraction


moved_weights = probe(move_to_ray)


def triangles(corners: np.ndarray) -> np.ndarray:
    """Triangles of corners (N, 3, 3), in camera axes [m]."""
    rows = np.zeros(len(corners), np.dtype(Triangle.numpy_dtype()))
    rows["a"], rows["b"], rows["c"] = corners.transpose(1, 0, 2)
    return rows


def view(scale: int = 1):
    return camera(scale * WIDTH, scale * HEIGHT, scale * 200.0, (0.0, 0.0, 2.0))


def radiance_of(mesh, material, pose, device, scale=1) -> np.ndarray:
    scene = ToyScene([entry(mesh, material)], [[(0, pose)]], (view(scale),), lights=(STRIPES,))
    return render(scene, device).radiance[0]


@pytest.mark.parametrize(
    ("settings", "width", "histories", "expected"),
    [
        ({}, 320, 3, True),
        ({}, 959, 3, True),
        ({}, 960, 3, False),
        ({}, 1920, 3, False),
        ({"coarse_pixel": 1}, 1920, 3, True),
        ({"coarse_pixel": 2}, 320, 3, False),
        ({"mode": UNOCCLUDED}, 320, 0, False),
        ({"mode": FAST}, 320, 0, True),
    ],
)
def test_images_whose_coarse_pixels_are_pixels_are_supersampled(settings, width, histories, expected):
    assert sampling_rates.supersamples(with_render(**settings).render, width, histories) == expected


def test_points_lie_on_the_plane_of_the_triangle(device):
    """Against float64: random triangles before the camera, rays near their middles; some triangles are narrower than the offset."""
    random = np.random.default_rng(6)
    count = 400
    size = 10.0 ** random.uniform(-4.0, -1.0, (count, 1, 1))
    corners = np.array([0.1, -0.05, 1.0]) + random.normal(size=(count, 3, 3)) * size
    middle = random.dirichlet((1.0, 1.0, 1.0), count)
    point = np.einsum("nk,nkd->nd", middle, corners)
    ray = point / point[:, 2:] + np.c_[random.uniform(-1e-3, 1e-3, (count, 2)), np.zeros(count)]
    weights, fraction = moved_weights(triangles(corners), ray, point / point[:, 2:], middle, device=device)
    on_plane = np.linalg.solve(corners.transpose(0, 2, 1), ray[..., None])[..., 0]
    change = on_plane / on_plane.sum(1, keepdims=True) - middle
    largest = np.abs(change).max(1)
    expected = np.minimum(1.0, float(MAX_WEIGHT_CHANGE) / largest)
    facing = np.abs(np.linalg.det(corners)) > 1e-2 * size[:, 0, 0] ** 2
    assert facing.sum() > count // 2
    assert (expected[facing] < 1.0).any()
    assert (expected[facing] == 1.0).any()
    np.testing.assert_allclose(fraction[facing], expected[facing], rtol=0.02)
    np.testing.assert_allclose(weights[facing], (middle + expected[:, None] * change)[facing], atol=0.02)


@pytest.mark.parametrize(
    ("corners", "ray"),
    [
        pytest.param([(0, 0, 1), (0, 0, 2), (0, 0, 3)], (0.0, 0.0, 1.0), id="edge on"),
        pytest.param([(0, 0, 1), (1, 0, 10), (0, 1, 1)], (0.12, 0.1, 1.0), id="beyond the horizon of the plane"),
    ],
)
def test_a_ray_that_misses_the_plane_keeps_the_center(device, corners, ray):
    weights, fraction = moved_weights(triangles(np.array([corners])), ray, (0.0, 0.0, 1.0), (0.2, 0.3, 0.5), device=device)
    np.testing.assert_allclose(weights[0], (0.2, 0.3, 0.5), rtol=1e-6)
    assert fraction[0] == 0.0


def test_a_plain_flat_surface_is_the_same_with_either_kernel(device, monkeypatch):
    """All points of a matt, evenly lit plane have the same radiance, so that supersampling changes nothing."""
    matt = surface((0.5, 0.4, 0.3))
    found = radiance_of(sheet(0.4, 0.3), matt, TILTED, device)
    monkeypatch.setattr(sampling_rates, "supersamples", lambda *_: False)
    np.testing.assert_allclose(found, radiance_of(sheet(0.4, 0.3), matt, TILTED, device), rtol=2e-3)


@pytest.mark.parametrize("shape", ["texture", "normals"])
def test_the_mean_of_a_pixel_is_approached(device, monkeypatch, shape):
    """Against the mean of FINE² pixels of a finer image: a texture of squares 1.3 px wide, and a polished ball under a sky with stripes."""
    random = np.random.default_rng(7)
    if shape == "texture":
        texture = np.repeat(np.repeat(random.integers(0, 255, (32, 32, 3)), 8, 0), 8, 1).astype(np.uint8)
        body = sheet(0.4, 0.4), surface(texture=texture), TILTED
    else:
        body = ball(0.1, 3), surface(WHITE, 1.0, 0.1), TILTED
    inner = np.s_[HEIGHT // 2 - 4 : HEIGHT // 2 + 4, WIDTH // 2 - 8 : WIDTH // 2 + 8]
    mean = radiance_of(*body, device, FINE).reshape(HEIGHT, FINE, WIDTH, FINE, 3).mean((1, 3))[inner]
    errors = []
    for kernel in (shade_samples_kernel, shade_kernel):
        monkeypatch.setattr(denoised, "shade_samples_kernel", kernel)
        errors.append(np.sqrt(np.square(radiance_of(*body, device)[inner] - mean).mean()))
    assert errors[0] < 0.7 * errors[1]


@pytest.mark.parametrize("samples", [4, 16])
def test_sources_with_a_corner_in_a_damaged_tile_are_unknown(device, samples):
    grid, numbers = build_grid(21, 10), np.random.default_rng(samples)
    dirty = numbers.choice(np.array([0, 0, 0, DAMAGED, RELIT], np.uint8), (40, grid.tiles))
    flags, kept, footprints = TileFlags(), KeptSources(), 22 * 11
    flags.dirty, flags.kept_row = (wp.array(array, device=device) for array in (dirty, np.arange(40, dtype=np.int32)[::-1].copy()))
    kept.word = wp.zeros((40, -(-footprints * samples // 16)), dtype=wp.uint32, device=device)
    wp.launch(forget_sources_kernel, (40, grid.tiles, 5), [grid, flags, samples], [kept], device=device)
    bits = np.unpackbits(kept.word.numpy()[::-1].copy().view(np.uint8), axis=1, bitorder="little")[:, : footprints * 2 * samples]
    row, column = np.indices((10, 21))
    pixels = np.pad(dirty[:, row // 4 * grid.tile_columns + column // 8] == DAMAGED, ((0, 0), (1, 1), (1, 1)))
    expected = pixels[:, 1:, 1:] | pixels[:, :-1, 1:] | pixels[:, 1:, :-1] | pixels[:, :-1, :-1]
    np.testing.assert_array_equal(bits.reshape(40, 11, 22, -1), np.repeat(expected[..., None], 2 * samples, axis=-1))
