"""Anti-aliasing of the fast picture: coverage known by geometry, and nothing changed but the colour of edges."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import FAST, REFERENCE, Config
from synpick_warp.kernels.render.images import antialias
from synpick_warp.scenes.appearance import srgb_to_linear
from synpick_warp.scenes.types import Material, TriangleMesh
from tests.worlds.toy_scene import UPRIGHT, Picture, ToyScene, box, camera, entry, even_light, render, sheet, sun

VIEW = camera(48, 40, 200.0, (0.0, 0.0, 2.0))
SAMPLES = int(antialias.SAMPLES)
OFFSETS = np.array(antialias.ROOKS, np.float64).reshape(SAMPLES, 2)
"""x, y [px from the pixel's centre]."""
EMPTY = entry(sheet(0.1, 0.1))


def with_render(**settings) -> Config:
    return replace(Config(), render=replace(Config().render, **settings))


def turned(x: float, y: float, z: float, angle: float, axis: int = 2) -> tuple[float, ...]:
    """A pose [m, rad]."""
    quaternion = [0.0, 0.0, 0.0, np.cos(angle / 2)]
    quaternion[axis] = np.sin(angle / 2)
    return (x, y, z, *quaternion)


def shown(device, *placed, view=VIEW, config=None, **more) -> Picture:
    """Picture of (mesh, pose, colour)."""
    entries = [entry(mesh, Material(color=color, texture=None, metallic=0.0, roughness=1.0)) for mesh, _, color in placed] or [EMPTY]
    world = [(number, pose) for number, (_, pose, _) in enumerate(placed)]
    return render(ToyScene(entries, [world], (view,), config=config or with_render(), **more), device)


def sources(picture: Picture) -> np.ndarray:
    """(row, column) of the pixel whose radiance each sample of each pixel shows (H, W, SAMPLES, 2)."""
    mix = picture.mix[0]
    choice = (mix[..., None] >> (2 * np.arange(SAMPLES, dtype=np.uint32))) & 3
    towards = np.where(OFFSETS[:, ::-1] > 0.0, 1, -1)
    step = np.stack([choice >> 1, choice & 1], axis=-1).astype(int) * towards
    return np.stack(np.mgrid[: mix.shape[0], : mix.shape[1]], axis=-1)[:, :, None] + step


def plate_places(view, pose, distance: float) -> np.ndarray:
    """Where each sample of each pixel passes the plane z = 0 in the axes of a plate that lies there [m] (H, W, SAMPLES, 2)."""
    rows, columns = np.mgrid[: view.height, : view.width]
    x = (columns[..., None] + 0.5 + OFFSETS[:, 0] - view.matrix[0, 2]) / view.matrix[0, 0] * distance
    y = -(rows[..., None] + 0.5 + OFFSETS[:, 1] - view.matrix[1, 2]) / view.matrix[1, 1] * distance
    angle = 2.0 * np.arctan2(pose[5], pose[6])
    x, y = x - pose[0], y - pose[1]
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x], axis=-1)


def test_samples_are_rooks_about_the_centre():
    for axis in range(2):
        assert sorted(OFFSETS[:, axis] * 8) == [-3, -1, 1, 3]


@pytest.mark.parametrize("angle", [0.0, 0.1, 0.4, np.pi / 4, 1.3])
def test_pixels_on_a_plates_edge_mix_by_coverage(device, angle):
    pose = turned(0.0123, -0.0071, 0.0, angle)
    width, height = 0.21, 0.13
    picture = shown(device, (sheet(width, height), pose, (0.9, 0.2, 0.2)))
    inside = np.all(np.abs(plate_places(VIEW, pose, 2.0)) <= (width / 2, height / 2), axis=-1)
    source = sources(picture)
    taken = picture.instance[0][source[..., 0], source[..., 1]] == 1
    edge = picture.mix[0] != 0
    np.testing.assert_array_equal(taken[edge], inside[edge])
    # What is no edge is covered wholly or not at all, but for the tips of corners.
    partly = (inside.any(axis=-1) != inside.all(axis=-1)) & ~edge
    assert partly.sum() <= 4
    assert edge.sum() > 40


def test_colour_of_an_edge_is_the_mean_of_what_it_shows(device):
    picture = shown(
        device, (sheet(0.21, 0.13), turned(0.0, 0.0, 0.0, 0.3), (0.5, 0.5, 0.5)), config=with_render(tone="linear", exposure=0.4)
    )
    source = sources(picture)
    mixed = picture.radiance[0][source[..., 0], source[..., 1]].mean(axis=2)
    edge = picture.mix[0] != 0
    gain = srgb_to_linear(picture.color[0, 0, 0] / 255.0) / picture.radiance[0, 0, 0]
    np.testing.assert_allclose(srgb_to_linear(picture.color[0][edge] / 255.0), gain * mixed[edge], atol=0.006)


def plate_over_slope() -> TriangleMesh:
    """A level plate 0.3 m over one that leans, as one mesh."""
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


def test_a_bodys_edge_over_itself_is_told_by_depth(device):
    pose = turned(0.0, 0.0, 0.0, 0.3)
    picture = shown(device, (plate_over_slope(), pose, (0.9, 0.9, 0.9)), lights=(sun((0.0, 0.7, 0.7)),))
    inside = np.all(np.abs(plate_places(VIEW, pose, 1.7)) <= 0.05, axis=-1)
    source = sources(picture)
    upper = picture.exact_depth[0][source[..., 0], source[..., 1]] < 1.85
    edge = picture.mix[0] != 0
    np.testing.assert_array_equal(upper[edge], inside[edge])
    assert (inside.any(axis=-1) & edge).sum() > 30


def test_a_boxs_edge_mixes_its_two_sides(device):
    """A box that turns an edge to the camera: left of it one side, right of it the other."""
    ridged = (box(0.1, 0.3, 0.1), turned(0.003, 0.0, 0.0, np.pi / 4, axis=1), (0.9, 0.9, 0.9))
    picture = shown(device, ridged, lights=(sun((0.7, 0.0, 0.7)),))
    ridge = VIEW.matrix[0, 2] + 0.003 / (2.0 - 0.1 / np.sqrt(2.0)) * VIEW.matrix[0, 0]
    column = int(ridge)
    source = sources(picture)[10:30, column]
    assert (picture.mix[0, 10:30, column] != 0).all()
    right = column + 0.5 + OFFSETS[:, 0] > ridge
    centre_is_right = column + 0.5 > ridge
    expected = np.where(right == centre_is_right, column, np.where(right, column + 1, column - 1))
    np.testing.assert_array_equal(source[..., 1], np.broadcast_to(expected, source[..., 1].shape))


def test_surfaces_of_one_colour_are_not_mixed(device):
    """Both sides of a box's edge that points to the camera send the same light."""
    picture = shown(device, (box(0.1, 3.0, 0.1), turned(0.003, 0.0, 0.0, np.pi / 4, axis=1), (0.9, 0.9, 0.9)))
    assert not picture.mix[0, :, 20:28].any()


@pytest.mark.parametrize(("one", "other"), [((0.9, 0.1, 0.1), (0.9, 0.29, 0.1)), ((0.1, 0.1, 0.9), (0.3, 0.1, 0.9))])
def test_colours_that_differ_in_a_dark_channel_are_mixed(device, one, other):
    """Two sheets side by side; what they show differs by 40 grey levels in one channel."""
    sheets = [(sheet(0.2, 0.5), turned(side * 0.1 + 0.003, 0.0, 0.0, 0.0), color) for side, color in ((-1, one), (1, other))]
    assert (shown(device, *sheets).mix[0, 5:35, 24] != 0).all()


def test_edges_reach_the_pictures_rim(device):
    """A plate whose edges cross all four of the picture's rims, where pixels mix too, each by its own samples."""
    pose = turned(0.0, 0.0, 0.0, 0.25)
    picture = shown(device, (sheet(1.0, 0.34), pose, (0.9, 0.2, 0.2)))
    inside = np.all(np.abs(plate_places(VIEW, pose, 2.0)) <= (0.5, 0.17), axis=-1)
    source = sources(picture)
    taken = picture.instance[0][source[..., 0], source[..., 1]] == 1
    rim = np.ones_like(picture.mix[0], bool)
    rim[1:-1, 1:-1] = False
    partly = rim & (inside.any(axis=-1) != inside.all(axis=-1))
    assert all(side.any() for side in (partly[0], partly[-1], partly[:, 0], partly[:, -1]))
    np.testing.assert_array_equal(taken[partly], inside[partly])


def test_even_surfaces_and_the_background_have_no_edges(device):
    tilted = turned(0.0, 0.0, 0.0, 1.2, axis=0)
    assert not shown(device, (sheet(4.0, 9.0), tilted, (0.9, 0.9, 0.9))).mix.any()
    empty = shown(device)
    assert not empty.mix.any()
    assert (empty.instance == Segment.NOTHING).all()
    assert not shown(device, table=True).mix.any()


def test_nothing_changes_but_the_colour_of_edges(device):
    things = [
        (box(0.1, 0.06, 0.08), turned(0.02, 0.0, 0.0, 0.5), (0.2, 0.4, 0.9)),
        (sheet(0.3, 0.1), turned(-0.05, 0.0, -0.1, 1.0), (0.8, 0.8, 0.3)),
    ]
    smooth, rough = (shown(device, *things, config=with_render(antialias=on), table=True) for on in (True, False))
    for name in ("depth", "instance", "amodal", "pixels", "boxes", "exact_depth", "radiance"):
        np.testing.assert_array_equal(getattr(smooth, name), getattr(rough, name))
    edge = smooth.mix[0] != 0
    assert not rough.mix.any()
    np.testing.assert_array_equal(smooth.color[0][~edge], rough.color[0][~edge])
    assert (smooth.color[0][edge] != rough.color[0][edge]).any(axis=-1).mean() > 0.5


def test_edges_come_nearer_to_the_reference(device):
    things = [
        (sheet(0.6, 0.5), (0.0, 0.0, 0.0, *UPRIGHT), (0.7, 0.7, 0.6)),
        (box(0.12, 0.06, 0.08), turned(0.02, 0.01, 0.041, 0.5), (0.1, 0.2, 0.6)),
        (box(0.05, 0.05, 0.05), turned(-0.07, 0.02, 0.026, 1.0), (0.8, 0.1, 0.1)),
    ]
    configs = (with_render(mode=FAST), with_render(mode=FAST, antialias=False), with_render(mode=REFERENCE, samples=256))
    smooth, rough, reference = (shown(device, *things, config=config, lights=(even_light(),)) for config in configs)
    edge = smooth.mix[0] != 0
    errors = [np.square(picture.color[0].astype(float) - reference.color[0])[edge].mean() for picture in (smooth, rough)]
    assert errors[0] < 0.3 * errors[1]
