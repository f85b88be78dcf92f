"""Views: pixel tiles, camera rays, projected boxes, bodies of tiles in their order, and kernels by the structs of their arguments."""

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from synpick_warp.kernels.render.lighting.materials import material_of
from synpick_warp.kernels.render.lighting.surfaces import AnySurfaces, RandomizedSurfaces, Surfaces
from synpick_warp.kernels.render.visibility.camera import (
    AnyViews,
    CameraTable,
    ImageGrid,
    LensViews,
    Views,
    in_image,
    lens_of,
    pinhole_ray,
    projected_box,
    tile_pixel,
)
from synpick_warp.kernels.render.visibility.variants import kernel_for, kernel_of_views
from synpick_warp.stages.render.scene import build_grid
from synpick_warp.stages.render.view_setup import pair_views
from tests.harness.environment import default_device
from tests.harness.probe import probe
from tests.twins.raycast import rotation_of
from tests.worlds.shapes import ball, box, camera, entry, random_pile, random_rotation, sheet
from tests.worlds.toy_scene import ToyScene, render_gbuffer, views_of

WIDTH, HEIGHT, FOCAL = 160, 90, 200.0


@wp.func
def visit_pixel(grid: ImageGrid, visits: wp.array3d[int], index: int):
    view, row, column = tile_pixel(grid, index)
    if in_image(grid, row, column):
        wp.atomic_add(visits, view, row, column, 1)


visit, ray_of, box_of = probe(visit_pixel), probe(pinhole_ray), probe(projected_box, cameras=CameraTable)


def project(lower, upper, rotation, position):
    cameras = CameraTable()
    cameras.intrinsics = wp.array([(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)], dtype=wp.vec4, device=default_device())
    return box_of(lower, upper, rotation, position, cameras, 0, build_grid(WIDTH, HEIGHT))


@pytest.mark.parametrize(("width", "height"), [(8, 4), (1, 1), (33, 17), (7, 9)])
def test_tiles_visit_every_pixel_once(width, height):
    grid = build_grid(width, height)
    visits = wp.zeros((2, height, width), dtype=int, device=default_device())
    visit(grid, visits, np.arange(2 * grid.tiles * 32))
    assert (visits.numpy() == 1).all()


def test_rays_pass_pixel_centres():
    rays = ray_of((10.0, 20.0, 1.5, 1.0), *np.indices((2, 3)), (0.0, 0.0))
    np.testing.assert_allclose(rays[0, 0], [-1.0 / 10.0, -0.5 / 20.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rays[1, 2], [1.0 / 10.0, 0.5 / 20.0, 1.0], rtol=1e-6)
    np.testing.assert_allclose(rays[0, 1][0], 0.0, atol=1e-7)
    rays = ray_of((10.0, 20.0, 1.5, 1.0), *np.indices((2, 3)), (0.5, -0.5))
    np.testing.assert_allclose(rays[0, 0], [-0.5 / 10.0, -1.0 / 20.0, 1.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("upper", "position", "expected"),
    [
        # Half a width of 0.1 m at 1 m is 20 px; the nearest face decides; one pixel of margin.
        pytest.param((0.1, 0.1, 1.0), (0, 0, 1.1), [59, 24, 101, 66], id="straight ahead"),
        pytest.param((0.1,) * 3, (0, 0, -1.0), [0, 0, -1, -1], id="behind the camera"),
        pytest.param((0.1,) * 3, (0, 0, 0.05), [-160, -90, 319, 179], id="across the camera covers the canvas"),
        pytest.param((0.1,) * 3, (5.0, 0, 1.0), [0, 0, -1, -1], id="beyond the canvas at the right"),
        pytest.param((0.1,) * 3, (0, -3.0, 1.0), [0, 0, -1, -1], id="beyond the canvas at the top"),
    ],
)
def test_known_projections_of_boxes(upper, position, expected):
    assert project((-0.1,) * 3, upper, np.eye(3), position).tolist() == expected


@given(
    size=st.tuples(*[st.floats(0.001, 0.3)] * 3),
    quaternion=st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
    position=st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-0.3, 3.0)),
    seed=st.integers(0, 1000),
)
def test_projected_boxes_are_conservative(size, quaternion, position, seed):
    rotation = rotation_of(np.array(quaternion))
    half = np.array(size, np.float32) / 2
    left, top, right, bottom = project(-half, half, rotation, position)
    points = np.random.default_rng(seed).uniform(-1, 1, (200, 3)) * half.astype(np.float64) @ rotation.T + position
    points = points[points[:, 2] > 1e-3]
    columns = points[:, 0] / points[:, 2] * FOCAL + WIDTH / 2
    rows = points[:, 1] / points[:, 2] * FOCAL + HEIGHT / 2
    on_canvas = (columns >= -WIDTH) & (columns < 2 * WIDTH) & (rows >= -HEIGHT) & (rows < 2 * HEIGHT)
    columns, rows = columns[on_canvas], rows[on_canvas]
    assert (np.floor(columns) >= left).all()
    assert (np.floor(columns) <= right).all()
    assert (np.floor(rows) >= top).all()
    assert (np.floor(rows) <= bottom).all()


# ---- bodies of a view ----


def pile(rng, count: int) -> ToyScene:
    """An object at the origin and others of many shapes at random poses around it, seen from a random camera; some surround the camera."""
    meshes = [box(0.16, 0.07, 0.2), ball(0.06, 2), box(0.3, 0.004, 0.02), sheet(0.2, 0.1), box(0.02, 0.02, 0.02)]
    rotation = random_rotation(rng)
    view = camera(83, 46, rng.uniform(40.0, 250.0), tuple(rotation.T @ (0.0, 0.0, -rng.uniform(0.1, 1.5))), rotation)
    placed = random_pile(rng, len(meshes), count, (-0.4,) * 3, (0.4,) * 3)
    placed[0] = (placed[0][0], (0.0, 0.0, 0.0, *placed[0][1][3:]))
    return ToyScene([entry(mesh) for mesh in meshes], [placed], (view,), instances=count + 2)


def test_views_are_listed_world_by_world_and_camera_by_camera():
    world, camera = pair_views(np.array([1, 4]), np.array([0, 2, 5]))
    assert (world.tolist(), camera.tolist()) == ([1, 1, 1, 4, 4, 4], [0, 2, 5, 0, 2, 5])
    assert world.dtype == camera.dtype == np.int32
    none = pair_views(np.array([], np.int64), np.array([0, 2]))
    assert [len(values) for values in none] == [0, 0]


@pytest.mark.parametrize("seed", range(12))
def test_tile_body_masks_are_conservative(device, seed):
    toy = pile(np.random.default_rng(seed), 14)
    out, renderer = render_gbuffer(toy, device)
    masks = renderer.bodies.body_mask.numpy()[0, :, 0].copy()
    present = renderer.bodies.present.numpy()[0]
    assert present == 14
    expected = {name: getattr(out, name).numpy().copy() for name in ("instance", "depth", "mask_words")}
    renderer.bodies.body_mask.fill_(wp.uint64((1 << 14) - 1))
    renderer.rasterizer.rasterize(renderer.bodies, views_of(toy, device, renderer.cameras), renderer.gbuffer, out)
    for name, image in expected.items():
        np.testing.assert_array_equal(image, getattr(out, name).numpy())
    counts = np.array([int(value).bit_count() for value in masks])
    assert counts.max() <= present
    assert counts.mean() < 0.9 * present
    assert (expected["instance"] > 0).any()


@pytest.mark.parametrize("seed", range(4))
def test_bodies_are_sorted_front_to_back_with_the_tote_last(device, seed):
    toy = pile(np.random.default_rng(seed), 9)
    toy.fixtures_visible = (1, 0, 1)
    _, renderer = render_gbuffer(toy, device)
    mesh, near, order = (getattr(renderer.bodies, name).numpy()[0] for name in ("mesh", "near", "order"))
    present = int(renderer.bodies.present.numpy()[0])
    visible = np.flatnonzero(mesh >= 0)
    assert present == len(visible) == 11
    assert set(order[:present]) == set(visible)
    tote = toy.instances
    others = visible[visible != tote]
    np.testing.assert_array_equal(order[:present], [*others[np.argsort(near[others], kind="stable")], tote])


# ---- permutations of kernels ----


MESH, ROW, LENS = 7, 5, 3


@kernel_of_views
def read_rows_kernel(surfaces: AnySurfaces, views: AnyViews, rows_out: wp.array[int]):
    """Rows of the lens of a view and of the material of its first body."""
    rows_out[0] = lens_of(views.cameras, 0)
    rows_out[1] = material_of(surfaces, 0, 0, MESH)


@pytest.mark.parametrize(
    ("surfaces", "views", "rows"),
    [
        (Surfaces, Views, [-1, MESH]),
        (Surfaces, LensViews, [LENS, MESH]),
        (RandomizedSurfaces, Views, [-1, ROW]),
        (RandomizedSurfaces, LensViews, [LENS, ROW]),
    ],
)
def test_structs_of_the_arguments_choose_the_kernel(surfaces, views, rows, device):
    arguments = [surfaces(), views(), wp.zeros(2, dtype=wp.int32, device=device)]
    arguments[1].cameras.lens = wp.full(1, LENS, dtype=wp.int32, device=device)
    if surfaces is RandomizedSurfaces:
        arguments[0].row = wp.full((1, 1), ROW, dtype=wp.int32, device=device)
    wp.launch(kernel_for(read_rows_kernel, *arguments), dim=1, inputs=arguments, device=device)
    assert arguments[2].numpy().tolist() == rows


def test_plain_structs_have_nothing_of_looks():
    """Known: a cell without looks has neither the rows nor the code that reads them."""
    assert set(RandomizedSurfaces.vars) - set(Surfaces.vars) == {
        "row",
        "recolor",
        "repeats",
        "wear",
        "pattern",
        "noise",
        "glass",
        "label",
        "emission",
        "glow",
        "finish",
    }
