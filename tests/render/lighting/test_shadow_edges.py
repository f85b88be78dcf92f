"""Shadow of a straight edge under one lamp: its profile has a known answer, and no pattern of the pixels that trace rays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render.denoised import scratch_sizes
from synpick_warp.stages.render.sampling_rates import shadow_size
from tests.twins.lattice import measure_lattice
from tests.worlds.toy_scene import FLAT, ToyScene, camera, entry, flat_shaded, lamp, render, sheet, with_render

FOCAL, DISTANCE = 300.0, 1.5
WIDTH, HEIGHT = 160, 120
COSINE = 0.8
"""Of the lamp's direction and the vertical."""


def shadow(device: wp.Device, size: int, degrees: float, height: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Visible fraction of a lamp on a plane beside a sheet at `height` [m]: rendered and exact (row, column), NaN where the sheet is seen.

    Args:
        size: Width of coarse pixels [px].
        degrees: Angular radius of the lamp.
        turn: Angle of the sheet's straight edge to the columns of pixels [rad].
    """
    along = np.array([np.cos(turn), np.sin(turn)])
    pose = (-along[0], -along[1], height, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
    config = with_render(coarse_pixel=size, coarse_paths=1, bounces=1, antialias=False)
    radiance = 3.0 / np.sin(np.radians(degrees)) ** 2
    # The lamp's azimuth is π, so that the shadow lies beside the sheet.
    light = lamp(COSINE, np.radians(degrees), radiance, rows=512)
    light = replace(light, radiance=np.roll(light.radiance, 512, axis=1))
    placed = [(0, FLAT), (1, pose)]
    toy = ToyScene(
        [entry(sheet(4.0, 4.0)), entry(sheet(2.0, 4.0))],
        [placed],
        (camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, DISTANCE)),),
        lights=(light,),
        config=config,
    )
    picture = render(toy, device)
    value = np.where(picture.instance[0] == 1, picture.radiance[0].mean(axis=2), np.nan)
    x = (np.arange(WIDTH) + 0.5 - WIDTH / 2) * DISTANCE / FOCAL
    y = (HEIGHT / 2 - np.arange(HEIGHT) - 0.5) * DISTANCE / FOCAL
    distance = (along[0] * x[None] + along[1] * y[:, None]) / height
    # Directions to the lamp's disc, sampled; a ray is free if it passes the edge: distance > tangent along the edge's normal.
    center = np.array([-np.sqrt(1.0 - COSINE**2), 0.0, COSINE])
    across, upward = np.array([0.0, 1.0, 0.0]), np.array([COSINE, 0.0, np.sqrt(1.0 - COSINE**2)])
    radius, angle = np.meshgrid(np.sqrt((np.arange(40) + 0.5) / 40), (np.arange(80) + 0.5) / 80 * 2 * np.pi)
    spread = np.tan(np.radians(degrees)) * radius.reshape(-1, 1)
    points = center + spread * (np.cos(angle).reshape(-1, 1) * across + np.sin(angle).reshape(-1, 1) * upward)
    tangents = np.sort(-(points[:, :2] @ along) / points[:, 2])
    exact = np.searchsorted(tangents, distance) / len(tangents)
    inner = ~np.isnan(value)
    dark, lit = (float(np.median(value[inner & where])) for where in (exact == 0.0, exact == 1.0))
    return (value - dark) / (lit - dark), np.where(inner, exact, np.nan)


@pytest.mark.parametrize("turn", [0.0, 0.3])
@pytest.mark.parametrize(
    ("size", "degrees", "height"), [(1, 0.5, 0.1), (1, 3.0, 0.1), (1, 5.0, 0.15), (4, 0.5, 0.1), (4, 3.0, 0.1), (4, 5.0, 0.15)]
)
def test_the_shadow_of_a_straight_edge_is_straight(device, size, degrees, height, turn):
    rendered, exact = shadow(device, size, degrees, height, turn)
    # Away from the sheet, whose own edge is another matter.
    near = np.isnan(exact)
    for _ in range(6):
        near[:, 1:] |= near[:, :-1]
    rows = [row for row in range(8, HEIGHT - 8) if (~near[row]).sum() > 20]
    error = np.where(near, 0.0, rendered - exact)
    # A filter over five pixels blurs a sharp edge by 0.045; more where it is not steep enough for rays.
    assert np.sqrt((error**2).mean()) < (0.06 if size > 2 else 0.04)
    # Position of the edge: the sum of a row's error is its displacement in pixels.
    displacement = error[rows].sum(axis=1)
    assert np.abs(displacement).max() < (1.0 if size > 2 else 0.5)
    assert displacement.std() < (0.35 if size > 2 else 0.25)


@pytest.mark.parametrize(("size", "periods"), [(1, (4,)), (2, (4, 8)), (4, (12, 16))])
def test_the_shadows_of_many_lamps_show_no_lattice(device, size, periods):
    """Of more than four lamps a pixel of the shadow grid has one ray each, and neighbouring pixels see different parts of them."""
    azimuths = np.array([0.3, 1.6, 2.8, 4.1, 5.2])
    directions, _ = map_directions(512)
    radiance = np.full(directions.shape, 0.05, np.float32)
    for azimuth in azimuths:
        center = np.array([0.5 * np.cos(azimuth), 0.5 * np.sin(azimuth), np.sqrt(0.75)])
        radiance[directions @ center > np.cos(np.radians(4.0))] = 60.0
    config = with_render(coarse_pixel=size, coarse_paths=16, bounces=1, antialias=False)
    toy = ToyScene(
        [entry(sheet(4.0, 4.0)), entry(sheet(2.0, 4.0))],
        [[(0, FLAT), (1, (-1.45, 0.0, 0.5, 0.0, 0.0, np.sin(0.1), np.cos(0.1)))]],
        (camera(320, 240, FOCAL, (0.0, 0.0, DISTANCE)),),
        lights=(EnvironmentMap("lamps", radiance),),
        config=config,
    )
    picture = render(toy, device)
    floor = np.where(picture.instance[0] == 1, Segment.TOTE, 1).astype(np.uint8)
    lattice = measure_lattice(picture.color[0], floor, periods)
    assert lattice.windows >= 20
    assert lattice.ratio < 1.2
    assert lattice.share == 0.0


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_bevel_in_the_shadow_of_a_wall_is_dark(device, size):
    """A lamp stands behind a wall, which does not face it; the bevel between wall and floor does, but lies in the wall's shadow."""
    profile = np.array([(-0.4, 0.0), (0.195, 0.0), (0.205, 0.01), (0.215, 0.15)])
    vertices = np.array([(x, y, z) for y in (-0.4, 0.4) for x, z in profile])
    faces = np.array([face for i in range(3) for face in ((i, i + 1, i + 5), (i, i + 5, i + 4))])
    config = with_render(coarse_pixel=size, coarse_paths=16, bounces=1, antialias=False)
    light = lamp(np.sqrt(0.75), np.radians(3.0), 1000.0)
    view = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, DISTANCE))
    toy = ToyScene([entry(flat_shaded(vertices, faces))], [[(0, FLAT)]], (view,), lights=(light,), config=config)
    value = render(toy, device).radiance[0][30:90].mean(axis=2)
    column = {x: int(WIDTH / 2 + x * FOCAL / DISTANCE) for x in (-0.1, 0.1, 0.175, 0.21)}
    lit = value[:, column[-0.1] : column[0.1]]
    assert lit.min() > 0.85 * lit.max()
    assert value[:, column[0.175] : column[0.21]].max() < 0.05 * lit.mean()


@pytest.mark.parametrize("size", [1, 2, 3, 4, 8, 9, 32, 33, 64])
def test_lists_of_edges_index_all_pixels_of_their_chunk(size):
    width, height = 1920, 1080
    sizes = scratch_sizes(with_render(coarse_pixel=size).render, width, height)
    assert sizes["chunk_pixel"] <= np.iinfo(np.uint16).max + 1
    assert sizes["chunk_cell"] * shadow_size(size) ** 2 == sizes["chunk_pixel"]
    assert sizes["edge_chunk"] * sizes["chunk_pixel"] >= width * height
