"""Lamp shadows: packed bytes against NumPy, boxes of moving bodies, reused rays, and the known profile of a straight edge."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting import moving_bodies, shadow_filter, shadow_upsampling, shadows
from synpick_warp.kernels.render.lighting.shadow_filter import FULL_SHARE, MAX_STEEPNESS, MIN_STEEPNESS, STEEPNESS_LEVELS
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET
from synpick_warp.kernels.render.visibility.gbuffer import Meshes
from synpick_warp.scenes.environment import map_directions
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render.denoised import scratch_sizes
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.sampling_rates import shadow_size
from synpick_warp.stages.render.scene import rays_per_lamp
from tests.harness.probe import probe
from tests.render.lighting.test_history import show
from tests.twins.lattice import measure_lattice
from tests.worlds.shapes import FLAT, UPRIGHT, ball, box, camera, entry, flat_shaded, lamp, sheet, sun
from tests.worlds.toy_scene import ToyScene, build_scene, one, render, several, with_render

SAMPLES = 2000
VIEW = camera(96, 64, 250.0, (0.0, 0.0, 1.5))
LAMPS = EnvironmentMap("lamps", sum(sun(at, 0.1, 900.0).radiance for at in ((1.0, 0.0, 1.0), (-0.6, 0.8, 0.9), (0.1, -1.0, 0.7))))


@wp.func
def spread_byte(bits: int, lamp: int):
    """Byte of a lamp after its bit was spread."""
    return shadows.byte_of(shadows.spread_bits(bits), lamp)


spread_bytes, blend, lamp_fractions = probe(spread_byte), probe(shadow_upsampling.blend_bytes), probe(shadow_filter.lamp_fractions)
steepness, meets_box, world_box = probe(shadow_filter.steepness_levels), probe(shadows.meets_box), probe(moving_bodies.world_box)


def as_bytes(packed: np.ndarray) -> np.ndarray:
    """Bytes (..., 8) of packed values (...), byte k that of lamp k."""
    return (packed[..., None] >> np.arange(0, 64, 8, dtype=np.uint64)) & np.uint64(0xFF)


def test_bits_of_lamps_spread_to_bytes(device):
    bits, lamps = np.indices((256, 8))
    np.testing.assert_array_equal(spread_bytes(bits, lamps, device=device), (bits >> lamps) & 1)


def test_blended_bytes_are_weighted_means(device):
    random = np.random.default_rng(1)
    taps = random.integers(0, 2**64, (SAMPLES, 4), dtype=np.uint64)
    # Some weights are as small as those of coarse pixels on other surfaces.
    weights = random.random((SAMPLES, 4)) * np.where(random.random((SAMPLES, 4)) < 0.3, 1e-4, 1.0) + 1e-8
    taps[: SAMPLES // 4] = taps[: SAMPLES // 4, :1]
    blended = as_bytes(blend(taps, weights, device=device)).astype(float)
    expected = (weights[..., None] * as_bytes(taps).astype(float)).sum(axis=1) / weights.sum(axis=1)[:, None]
    # Fixed-point weights are off by up to 1/256 between two taps, and the mean is rounded.
    assert np.abs(blended - expected).max() < 2.0
    np.testing.assert_allclose((blended - expected).mean(), 0.0, atol=0.02)
    np.testing.assert_array_equal(blended[: SAMPLES // 4], as_bytes(taps[: SAMPLES // 4, 0]))


@pytest.mark.parametrize(("lamps", "rays"), [(1, 4), (2, 4), (3, 2), (4, 2), (5, 1), (8, 1)])
@pytest.mark.parametrize("weight", [4, 19, 64])
def test_fractions_count_the_free_rays_of_each_lamp(device, lamps, rays, weight):
    random = np.random.default_rng(5)
    free = random.integers(0, weight + 1, (SAMPLES, 8))
    shifts = np.arange(0, 64, 16, dtype=np.uint64)
    sums = [(free[:, first::2].astype(np.uint64) << shifts).sum(axis=1, dtype=np.uint64) for first in (0, 1)]
    found = as_bytes(lamp_fractions(*sums, weight, lamps, rays, device=device))
    expected = free[:, : lamps * rays].reshape(SAMPLES, lamps, rays).sum(axis=2) / (weight * rays)
    assert np.abs(found[:, :lamps] / 255.0 - expected).max() <= 0.5 / 255.0 + 1e-12
    assert not found[:, lamps:].any()


@pytest.mark.parametrize(("share", "supported"), [(1.0, True), (0.16, True), (0.03, True), (1.0, False)])
def test_shadows_are_steep_where_fractions_differ_and_where_few_rays_tell(device, share, supported):
    levels, top = steepness(*np.indices((256, 256)), share, supported, device=device), int(STEEPNESS_LEVELS)
    assert levels[0, 0] == levels[255, 255] == 0
    if supported:
        difference = np.arange(256) / 255.0 * min(share / float(FULL_SHARE), 1.0)
        slope = (difference - float(MIN_STEEPNESS)) / float(MAX_STEEPNESS - MIN_STEEPNESS)
        assert np.abs(levels[0] - slope.clip(0.0, 1.0) * top).max() <= 0.5 + 1e-4
        assert levels[0, 255] == (top if share == 1.0 else levels[0, 255])
        assert (share > float(FULL_SHARE * MIN_STEEPNESS)) == (levels[0, 255] > 0)
    else:
        assert (levels[0, 1:] == top).all()


@pytest.mark.parametrize(("lamps", "rays"), [(0, 4), (1, 4), (2, 4), (3, 2), (4, 2), (5, 1), (8, 1)])
def test_few_lamps_have_several_rays_from_a_pixel(lamps, rays):
    assert rays_per_lamp(lamps) == rays


def test_rays_that_pass_through_a_box_meet_it(device):
    """By construction: rays towards points in the box meet it, unless they start beyond it; rays towards points around it may miss."""
    random = np.random.default_rng(3)
    lower, upper = np.array([-0.1, 0.2, 0.0]), np.array([0.3, 0.5, 0.2])
    target = lower + (upper - lower) * random.uniform(-1.0, 2.0, (SAMPLES, 3))
    origin = random.normal(size=(SAMPLES, 3))
    direction = (target - origin) * random.choice([-1.0, 1.0], (SAMPLES, 1))
    steps = origin[:, None] + np.linspace(0.0, 8.0, 4000)[None, :, None] * direction[:, None]
    expected = ((steps > lower) & (steps < upper)).all(axis=2).any(axis=1)
    meets = meets_box(origin, 1.0 / direction.astype(np.float32), lower, upper, device=device)
    assert meets[expected].all()
    assert 100 < expected.sum() < SAMPLES - 100
    # Rays that cut a corner between two steps.
    assert (meets & ~expected).mean() < 0.01


def test_boxes_around_bodies_are_their_corners_box_and_a_margin(device):
    random = np.random.default_rng(4)
    lower, upper = np.array([-0.02, -0.05, 0.0]), np.array([0.07, 0.01, 0.3])
    poses = np.concatenate([random.normal(size=(50, 3)), random.normal(size=(50, 4))], axis=1).astype(np.float32)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    meshes = Meshes()
    meshes.lower, meshes.upper = (wp.array(corner[None], dtype=wp.vec3, device=device) for corner in (lower, upper))
    boxes = world_box(meshes, 0, poses, device=device)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
    for i, pose in enumerate(poses):
        q, w = pose[3:6], pose[6]
        turned = corners + 2.0 * np.cross(q, np.cross(q, corners) + w * corners) + pose[:3]
        np.testing.assert_allclose(boxes[0][i], turned.min(axis=0) - RAY_OFFSET, atol=1e-6)
        np.testing.assert_allclose(boxes[1][i], turned.max(axis=0) + RAY_OFFSET, atol=1e-6)


def stirred(frame: int, balls: int = 2) -> ToyScene:
    """A sheet and a box at rest; one ball flies across them, another appears in frame 5 and is gone from frame 9 on."""
    placed = [(0, (0.0, 0.0, 0.0, *UPRIGHT)), (1, (0.06, 0.03, 0.03, *UPRIGHT))]
    placed.append((2, (-0.12 + 0.02 * frame, 0.01, 0.09, *UPRIGHT)))
    if balls > 1 and 5 <= frame < 9:
        placed.append((2, (0.0, -0.06, 0.2, *UPRIGHT)))
    entries = [entry(sheet(0.4, 0.4)), entry(box(0.04, 0.04, 0.06)), entry(ball(0.02, 3))]
    config = with_render(coarse_pixel=1, coarse_paths=1)
    return ToyScene(entries, [placed], (VIEW,), lights=(LAMPS,), config=config)


def renderers(device: wp.Device) -> tuple[Renderer, Renderer]:
    """Two renderers of the same scene: with histories, and without."""
    each = stirred(0)
    scene = build_scene(each, device)
    return make_renderer(each.settings(), scene, each.instances, 1, histories=1), make_renderer(each.settings(), scene, each.instances, 1)


def rays(renderer: Renderer) -> np.ndarray:
    """Packed shadow rays (row, column) of the last view."""
    return renderer.shading.shadow_rays.packed.numpy()[0].copy()  # type: ignore[union-attr]


def test_reused_shadows_are_those_that_would_be_traced(device):
    """Bit by bit, in every frame, while bodies fly, appear and disappear over surfaces at rest."""
    reusing, tracing = renderers(device)
    frames = [(frame, stirred(frame)) for frame in range(14)]
    pairs = [(rays(reusing), rays(tracing)) for _ in zip(show(reusing, frames, device), show(tracing, frames, device), strict=True)]
    shadows = [traced & np.uint64(0xFF) for _, traced in pairs]
    assert all((now != before).mean() > 0.002 for before, now in itertools.pairwise(shadows))
    for reused, traced in pairs:
        np.testing.assert_array_equal(reused, traced)


def test_shadows_are_reused(device):
    """Static scene: inverted bits in the history persist, since no ray is traced again."""
    reusing, _ = renderers(device)
    wrong = []
    for _ in show(reusing, [(frame, stirred(3, 1)) for frame in range(18)], device):
        if not wrong:
            truth = rays(reusing)
            surface = (truth >> np.uint64(8)) & np.uint64(0xFF) != 0
            history = reusing.shading.history.shadows  # type: ignore[union-attr]
            history.assign(history.numpy() ^ np.uint16(0xFF))
        wrong.append((rays(reusing) != truth)[surface].mean())
    assert wrong == [0.0, *[1.0] * 17]


def test_lamps_share_the_light_of_a_map_with_the_paths(device):
    """A plane that sees everything has the same light with all lamps, with one, and with none."""
    values = []
    for lamps in (8, 1, 0):
        config = with_render(coarse_paths=64, lamps=lamps)
        each = one(sheet(1.0, 1.0), FLAT, VIEW, lights=(LAMPS,), config=config)
        scene = build_scene(each, device)
        assert scene.lights.lamps.numpy().tolist() == [min(lamps, 3)]
        renderer = make_renderer(each.settings(), scene, each.instances, 1)
        values.append(next(show(renderer, [(0, each)], device))[20:44, 20:76].mean(axis=(0, 1)))
    np.testing.assert_allclose(values[1], values[0], rtol=0.02)
    np.testing.assert_allclose(values[2], values[0], rtol=0.02)


# ---- shadow of a straight edge ----


FOCAL, DISTANCE = 300.0, 1.5
WIDTH, HEIGHT = 160, 120
COSINE = 0.8
"""Of the lamp's direction and the vertical."""


def shadow(device: wp.Device, size: int, degrees: float, height: float, turn: float) -> tuple[np.ndarray, np.ndarray]:
    """Visible fraction of a lamp on a plane beside a sheet at `height` [m]: rendered and exact (row, column), NaN where the sheet is seen.
    `size`: width of coarse pixels [px]. `degrees`: angular radius of the lamp. `turn`: angle of the sheet's straight edge to the columns of
    pixels [rad]."""
    along = np.array([np.cos(turn), np.sin(turn)])
    pose = (-along[0], -along[1], height, 0.0, 0.0, np.sin(turn / 2), np.cos(turn / 2))
    config = with_render(coarse_pixel=size, coarse_paths=1, bounces=1, antialias=False)
    radiance = 3.0 / np.sin(np.radians(degrees)) ** 2
    # The lamp's azimuth is π, so that the shadow lies beside the sheet.
    light = lamp(COSINE, np.radians(degrees), radiance, rows=512)
    light = replace(light, radiance=np.roll(light.radiance, 512, axis=1))
    view = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, DISTANCE))
    picture = render(several((sheet(4.0, 4.0), sheet(2.0, 4.0)), (FLAT, pose), view, lights=(light,), config=config), device)
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
    poses = (FLAT, (-1.45, 0.0, 0.5, 0.0, 0.0, np.sin(0.1), np.cos(0.1)))
    view, light = camera(320, 240, FOCAL, (0.0, 0.0, DISTANCE)), EnvironmentMap("lamps", radiance)
    picture = render(several((sheet(4.0, 4.0), sheet(2.0, 4.0)), poses, view, lights=(light,), config=config), device)
    floor = np.where(picture.instance[0] == 1, Segment.TOTE, 1).astype(np.uint8)
    ratio, share, windows = measure_lattice(picture.color[0], floor, periods)
    assert windows >= 20
    assert ratio < 1.2
    assert share == 0.0


@pytest.mark.parametrize("size", [1, 2, 4])
def test_a_bevel_in_the_shadow_of_a_wall_is_dark(device, size):
    """The wall faces away from the lamp; the bevel between wall and floor faces it, but is in the shadow of the wall."""
    profile = np.array([(-0.4, 0.0), (0.195, 0.0), (0.205, 0.01), (0.215, 0.15)])
    vertices = np.array([(x, y, z) for y in (-0.4, 0.4) for x, z in profile])
    faces = np.array([face for i in range(3) for face in ((i, i + 1, i + 5), (i, i + 5, i + 4))])
    config = with_render(coarse_pixel=size, coarse_paths=16, bounces=1, antialias=False)
    light = lamp(np.sqrt(0.75), np.radians(3.0), 1000.0)
    view = camera(WIDTH, HEIGHT, FOCAL, (0.0, 0.0, DISTANCE))
    value = render(one(flat_shaded(vertices, faces), FLAT, view, lights=(light,), config=config), device).radiance[0][30:90].mean(axis=2)
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
