"""Lamp shadows: packed bytes against NumPy, boxes of moving bodies, and that reused shadow rays are those that would be traced again."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting import moving_bodies, shadow_filter, shadow_upsampling, shadows
from synpick_warp.kernels.render.lighting.shadow_filter import FULL_SHARE, MAX_STEEPNESS, MIN_STEEPNESS, STEEPNESS_LEVELS
from synpick_warp.kernels.render.lighting.shadows import REFRESH_FRAMES
from synpick_warp.kernels.render.visibility.bvh_rays import RAY_OFFSET
from synpick_warp.kernels.render.visibility.gbuffer import Meshes
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.scene import rays_per_lamp
from tests.harness.probe import probe
from tests.render.lighting.test_history import show
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, build_scene, camera, entry, sheet, sun, with_render

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
    return make_renderer(each.settings(), scene, each.instances, 1, 1), make_renderer(each.settings(), scene, each.instances, 1, 0)


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
    """Static scene: inverted bits in the history persist until their rays are retraced, one of REFRESH_FRAMES parts in each frame."""
    reusing, _ = renderers(device)
    wrong = []
    for _ in show(reusing, [(frame, stirred(3, 1)) for frame in range(int(REFRESH_FRAMES) + 1)], device):
        if not wrong:
            truth = rays(reusing)
            surface = (truth >> np.uint64(8)) & np.uint64(0xFF) != 0
            history = reusing.shading.history.shadows  # type: ignore[union-attr]
            history.assign(history.numpy() ^ np.uint16(0xFF))
        wrong.append((rays(reusing) != truth)[surface].mean())
    assert wrong[0] == 0.0
    steps = -np.diff(wrong[1:])
    assert wrong[1] == pytest.approx(1.0 - 1.0 / int(REFRESH_FRAMES), abs=0.05)
    np.testing.assert_allclose(steps, 1.0 / int(REFRESH_FRAMES), atol=0.05)
    assert wrong[-1] == 0.0


def test_lamps_share_the_light_of_a_map_with_the_paths(device):
    """A plane that sees everything has the same light with all lamps, with one, and with none."""
    values = []
    for lamps in (8, 1, 0):
        config = with_render(coarse_paths=64, lamps=lamps)
        each = ToyScene([entry(sheet(1.0, 1.0))], [[(0, (0.0, 0.0, 0.0, *UPRIGHT))]], (VIEW,), lights=(LAMPS,), config=config)
        scene = build_scene(each, device)
        assert scene.lights.lamps.numpy().tolist() == [min(lamps, 3)]
        renderer = make_renderer(each.settings(), scene, each.instances, 1)
        values.append(next(show(renderer, [(0, each)], device))[20:44, 20:76].mean(axis=(0, 1)))
    np.testing.assert_allclose(values[1], values[0], rtol=0.02)
    np.testing.assert_allclose(values[2], values[0], rtol=0.02)
