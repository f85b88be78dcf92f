"""Temporal accumulation: what is remembered, what is forgotten, and that pictures get nearer to the reference."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting import history as kernels
from synpick_warp.kernels.render.lighting.history import LIGHT_CHANGE, MAX_PERIOD_BITS, MAX_TRAVEL, LightHistory
from synpick_warp.kernels.render.lighting.moving_bodies import MAX_DRIFT
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.denoise_probe import guide_segments
from tests.harness.probe import probe
from tests.worlds.toy_scene import UPRIGHT, ToyScene, ball, box, build_scene, camera, entry, even_light, sheet, snapshot, with_render

PATHS = 16
LONGEST_PERIOD = 1 << int(MAX_PERIOD_BITS)
FILLED = 2 + 2 * 2 + 4 * 4 + 8 * 8
"""Frames until the history of a still scene is full: 2 paths in each frame, 2 in every second, 4 in every fourth, 8 in every eighth."""
FIRST_FRAMES = 600
"""Frames in which a history may begin: more than the schedule repeats after."""
VIEW = camera(64, 48, 300.0, (0.0, 0.0, 1.5))
LIGHT = EnvironmentMap("gradient", even_light(1.0, 32).radiance * np.linspace(3.0, 0.1, 64, dtype=np.float32)[None, :, None])


@wp.func
def list_paths(numbers: wp.array2d[int], row: int, column: int, first: int):
    """Numbers of the paths that a coarse pixel of a still scene traces until the array is full; its history begins in frame `first`."""
    paths = wp.int32(0)
    frame = first
    while paths < numbers.shape[1]:
        bits = kernels.period_bits(wp.min(paths, 16), 1000)
        if bits == 0 or kernels.update_frame(row, column, bits) == frame % (1 << bits):
            numbers[first, paths] = kernels.path_number(frame, bits)
            paths += 1
        frame += 1


schedule, usable_paths = probe(list_paths), probe(kernels.usable_paths)
lag_frames, covered_fraction = probe(kernels.lag_frames), probe(kernels.covered_fraction)


def settings() -> Config:
    return with_render(coarse_pixel=2, coarse_paths=1, history=PATHS)


def toy(ball_height: float | None = 0.08, config: Config | None = None) -> ToyScene:
    """A sheet with a box, and a ball above it; None: the ball is not there."""
    placed = [(0, (0.0, 0.0, 0.0, *UPRIGHT)), (1, (0.06, 0.0, 0.03, *UPRIGHT))]
    if ball_height is not None:
        placed.append((2, (-0.05, 0.0, ball_height, *UPRIGHT)))
    entries = [entry(sheet(0.4, 0.4)), entry(box(0.04, 0.04, 0.06)), entry(ball(0.03, 3))]
    return ToyScene(entries, [placed], (VIEW,), lights=(LIGHT,), config=config or settings())


def show(renderer: Renderer, frames: list[tuple[int, ToyScene]], device: wp.Device, episode: int = 0) -> Iterator[np.ndarray]:
    """Render (frame index, scene) one after the other, each with the one before as its last frame; yields radiance."""
    scene, before = renderer.scene, None
    out = allocate_view_buffers(1, scene.width, scene.height, 4, device)
    zero = wp.zeros(1, dtype=wp.int32, device=device)
    for frame, each in frames:
        state = snapshot(each, device)
        state.frame.fill_(frame)
        state.episode.fill_(episode)
        link(state, before or state)
        renderer.render(state, make_views(zero, zero, 1, 4), out)
        before = state
        yield renderer.image.radiance.numpy()[0].copy()


def link(state: Snapshot, before: Snapshot) -> None:
    for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible"):
        wp.copy(getattr(state, f"last_{name}"), getattr(before, name))


@pytest.fixture
def renderer(device) -> Renderer:
    each = toy()
    return make_renderer(each.settings(), build_scene(each, device), each.instances, 1, 1)


def usable(paths: int, limit: int, device: wp.Device) -> tuple[int, int]:
    """Paths that may be kept, and the rest period [frames]."""
    history = LightHistory()
    history.paths = wp.full((1, 1, 1), paths, dtype=wp.uint8, device=device)
    kept, bits = usable_paths(history, 0, 0, 0, limit, device=device)
    return int(kept), 1 << int(bits)


def remembered(renderer: Renderer) -> np.ndarray:
    """Paths that the history counts (row, column)."""
    return renderer.shading.history.paths.numpy()[0]  # type: ignore[union-attr]


def test_a_still_scene_is_remembered_up_to_the_limit(renderer, device):
    counts = [np.unique(remembered(renderer)).tolist() for _ in show(renderer, [(frame, toy()) for frame in range(FILLED + 4)], device)]
    assert counts[:2] == [[1], [2]]
    assert [counts[frame - 1][0] for frame in (2 + 2, 2 + 2 * 2, 2 + 2 * 2 + 4 * 4)] == [3, 4, 8]
    assert counts[FILLED:] == [[PATHS]] * 4


def test_history_ends_where_nothing_is_visible(renderer, device):
    """The sheet disappears: what returns to its pixels later, even slowly, begins a new history."""
    gone = toy()
    gone.placed[0].pop(0)
    frames = show(renderer, [(0, toy()), (1, gone)], device)
    segments = [renderer.shading.history.segment.numpy()[0].copy() for _ in frames]  # type: ignore[union-attr]
    assert (segments[0] == 1).mean() > 0.5
    background = renderer.shading.guide.surface.numpy()[0, ..., 3] == Segment.NOTHING  # type: ignore[union-attr]
    assert background.mean() > 0.5
    assert (segments[1][background] == Segment.NOTHING).all()


@pytest.mark.parametrize(
    ("paths", "limit", "kept", "period"),
    [
        (1, 99, 1, 1),
        (2, 99, 2, 2),
        (3, 99, 3, 2),
        (4, 99, 4, 4),
        (7, 99, 7, 4),
        (8, 99, 8, 8),
        (16, 99, 12, 8),
        (16, 128, 16, 8),
        (16, 31, 3, 8),
        (16, 8, 2, 4),
        (16, 7, 3, 2),
        (16, 3, 3, 1),
    ],
)
def test_averages_span_no_more_frames_than_the_lag_allows(device, paths, limit, kept, period):
    """Paths and the frames between them, by known cases: 2 paths trace in every second frame, if 4 frames are allowed, and so on."""
    assert usable(paths, limit, device) == (kept, period)
    assert kept * period <= limit


@pytest.mark.parametrize("row", range(4))
@pytest.mark.parametrize("column", range(4))
def test_the_paths_of_a_history_have_distinct_samples(device, row, column):
    """In whichever frame of an episode the history begins, and as it forgets: any PATHS paths in a row."""
    numbers = wp.empty((FIRST_FRAMES, 3 * PATHS), dtype=wp.int32, device=device)
    schedule(numbers, row, column, np.arange(FIRST_FRAMES), device=device)
    ordered = np.sort(np.lib.stride_tricks.sliding_window_view(numbers.numpy(), PATHS, axis=1), axis=-1)
    assert (np.diff(ordered) > 0).all()


def test_full_histories_take_turns(renderer, device):
    """In a still scene a coarse pixel traces a path in one of 8 frames, an even part of all in each, also in each 4 x 4."""
    frames = [(frame, toy()) for frame in range(FILLED + 1 + 2 * LONGEST_PERIOD)]
    stored = [renderer.shading.history.diffuse.numpy()[0].copy() for _ in show(renderer, frames, device)]
    changed = np.array([now != before for before, now in itertools.pairwise(stored[FILLED:])])
    assert (changed[:LONGEST_PERIOD].sum(axis=0) <= 1).all()
    assert (changed[LONGEST_PERIOD:].sum(axis=0) <= 1).all()
    squares = changed[:, :24, :32].reshape(2 * LONGEST_PERIOD, 6, 4, 8, 4).sum(axis=(2, 4))
    assert squares.max() == 16 // LONGEST_PERIOD
    assert squares.mean() > 0.9 * 16 // LONGEST_PERIOD


@pytest.mark.parametrize("scale", [1e-7, 1e6])
def test_accumulated_light_does_not_depend_on_the_unit_of_maps(device, scale):
    colors = []
    for light in (LIGHT, EnvironmentMap("scaled", scale * LIGHT.radiance)):
        each = replace(toy(), lights=(light,))
        made = make_renderer(each.settings(), build_scene(each, device), each.instances, 1, 1)
        factor = made.scene.lights.exposure.numpy()[0]
        colors.append([factor * radiance for radiance in show(made, [(frame, each) for frame in range(4)], device)])
    np.testing.assert_allclose(colors[1], colors[0], rtol=5e-3, atol=1e-3)


def test_the_first_frame_is_that_of_a_renderer_without_history(renderer, device):
    each = toy()
    alone = make_renderer(each.settings(), renderer.scene, each.instances, 1)
    (first,) = show(renderer, [(0, each)], device)
    (single,) = show(alone, [(0, each)], device)
    assert first.tobytes() == single.tobytes()


@pytest.mark.parametrize(("frame", "episode"), [(5, 0), (2, 0), (4, 1), (3, 0)])
def test_without_the_frame_before_nothing_is_remembered(renderer, device, frame, episode):
    list(show(renderer, [(index, toy()) for index in range(4)], device))
    list(show(renderer, [(frame, toy())], device, episode))
    assert (remembered(renderer) == 1).all()


def test_a_body_that_moves_is_forgotten_and_dims_the_memory_around_it(renderer, device):
    frames = [(index, toy()) for index in range(PATHS)] + [(PATHS, toy(0.1))]
    list(show(renderer, frames, device))
    count, segment = remembered(renderer), guide_segments(renderer.shading.guide)[0]  # type: ignore[union-attr]
    assert set(np.unique(count[segment == 3])) == {1}
    distance = np.hypot(*(np.argwhere(segment == 1) - np.argwhere(segment == 3).mean(axis=0)).T)
    near, far = (count[segment == 1][part].mean() for part in (distance < 8, distance > 16))
    assert near < far <= PATHS
    moving = renderer.shading.moving  # type: ignore[union-attr]
    assert moving.count.numpy()[0] == 1
    # 2 cm of a ball whose box has a mean projected area of 1.5 x 6 cm x 6 cm.
    np.testing.assert_allclose(moving.change.numpy()[0, 0], 0.02 / np.sqrt(1.5 * 0.06**2), rtol=1e-3)


def test_frames_that_the_lag_allows(renderer, device):
    """Against bisection, for two moving bodies: never more frames than allowed, and nearly as many; far away any number."""
    moved = ToyScene(
        toy().entries, [[(0, (0.0, 0.0, 0.0, *UPRIGHT)), (1, (0.063, 0.0, 0.03, *UPRIGHT)), (2, (-0.03, 0.0, 0.08, *UPRIGHT))]], (VIEW,)
    )
    list(show(renderer, [(0, toy()), (1, replace(moved, lights=(LIGHT,), config=settings()))], device))
    moving = renderer.shading.moving  # type: ignore[union-attr]
    assert moving.count.numpy()[0] == 2
    points = np.array([[x, 0.0, 0.0] for x in (-0.1, 0.0, 0.1, 0.2, 0.4, 2.0)], dtype=np.float32)
    frames = lag_frames(renderer.scene.meshes, moving, 0, points, 1e9, device=device)
    covered = covered_fraction(renderer.scene.meshes, moving, 0, np.arange(2), points[:, None], device=device)
    travel = np.geomspace(1e-2, 1e4, 100_000)[:, None] * moving.change.numpy()[0, :2]
    change = np.minimum(travel, float(MAX_TRAVEL)) @ covered.T
    allowed = np.array([np.searchsorted(column, float(LIGHT_CHANGE)) for column in change.T])
    expected = np.append(np.geomspace(1e-2, 1e4, 100_000), np.inf)[allowed]
    assert (frames <= 1.001 * expected).all()
    assert (frames >= 0.9 * np.minimum(expected, 1e3)).all()
    assert expected[0] < 10.0
    assert np.isinf(expected[-1])


def test_a_creeping_body_keeps_the_history_of_its_drift(renderer, device):
    """0.4 mm a frame: 10 frames, of which up to 4 paths are kept. 5 mm a frame: none."""
    assert float(MAX_DRIFT) / 4e-4 == pytest.approx(10.0)
    frames = [*((index, toy(0.08 + 4e-4 * index)) for index in range(24)), (24, toy(0.0945))]
    guide = renderer.shading.guide  # type: ignore[union-attr]
    paths = [remembered(renderer)[guide_segments(guide)[0] == 3] for _ in show(renderer, frames, device)]
    assert paths[-2].max() in (3, 4)
    assert set(np.unique(paths[-1])) == {1}


@pytest.mark.parametrize(("before", "after"), [(None, 0.08), (0.08, None)])
def test_bodies_that_come_or_go_change_the_light(renderer, device, before, after):
    list(show(renderer, [*((index, toy(before)) for index in range(4)), (4, toy(after))], device))
    assert renderer.shading.moving.count.numpy()[0] == 1  # type: ignore[union-attr]
    assert renderer.shading.moving.change.numpy()[0, 0] == 1.0  # type: ignore[union-attr]
    assert remembered(renderer).min() == 1


def test_a_displacement_below_the_threshold_is_rest(renderer, device):
    list(show(renderer, [(0, toy(0.08)), (1, toy(0.0802))], device))
    assert renderer.shading.moving.count.numpy()[0] == 0  # type: ignore[union-attr]
    assert (remembered(renderer) == 2).all()


def test_pictures_approach_the_reference_over_the_frames(renderer, device):
    each = toy()
    config = Config(render=replace(each.settings().render, mode=REFERENCE, samples=256))
    (reference,) = show(make_renderer(config, renderer.scene, each.instances, 1), [(0, each)], device)
    errors = [
        np.sqrt(np.mean((picture - reference) ** 2)) for picture in show(renderer, [(index, each) for index in range(FILLED)], device)
    ]
    assert errors[-1] < 0.65 * errors[0]
    assert np.mean(errors[-4:]) < np.mean(errors[4:8]) < errors[0]


def test_a_moved_body_leaves_no_ghost(renderer, device):
    """A ball that has left its place: what was beneath it has the light of a renderer without history."""
    frames = [*((index, toy(0.04)) for index in range(PATHS)), *((PATHS + index, toy(None)) for index in range(6))]
    *_, last = show(renderer, frames, device)
    each = toy(None)
    many = Config(render=replace(each.settings().render, coarse_paths=64))
    (expected,) = show(make_renderer(many, renderer.scene, each.instances, 1), [(0, each)], device)
    blur = np.abs(last - expected).mean(axis=-1) / expected.mean()
    assert blur[12:36, 8:32].mean() < 0.02
