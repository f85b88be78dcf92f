"""Temporal accumulation: what is remembered and what is forgotten; queued paths have the light of paths that one thread traces."""

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import warp as wp

from synpick_warp.codes import Segment
from synpick_warp.configs.schema import REFERENCE, Config
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.kernels.render.lighting import history as kernels
from synpick_warp.kernels.render.lighting.history import LIGHT_CHANGE, MAX_TRAVEL, LightHistory
from synpick_warp.kernels.render.lighting.moving_bodies import MAX_DRIFT
from synpick_warp.kernels.render.lighting.paths.lists import REGION_PIXELS
from synpick_warp.kernels.render.lighting.paths.queues import QUEUE_CAPACITY, PathPixel, PathQueues, first_record, read_path, write_path
from synpick_warp.kernels.render.lighting.paths.tracing import Path
from synpick_warp.scenes.types import EnvironmentMap
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.buffers import Snapshot, allocate_view_buffers
from synpick_warp.stages.render.denoised import PATH_QUEUES, queue_sizes, queue_views
from synpick_warp.stages.render.renderer import Renderer
from synpick_warp.stages.render.sampling_rates import interleaved_threads
from synpick_warp.stages.render.view_setup import make_views
from tests.harness.denoise_probe import guide_segments
from tests.harness.probe import probe
from tests.worlds.shapes import UPRIGHT, ball, box, camera, entry, even_light, sheet
from tests.worlds.toy_scene import ToyScene, build_scene, snapshot, with_render

PATHS = 16
LONGEST_PERIOD = 16
"""Update period [frames] of a history of PATHS paths."""
FILLED = 2 + 2 * 2 + 4 * 4 + 8 * 8
"""Frames until the history of a still scene is full: 2 paths in each frame, 2 in every second, 4 in every fourth, 8 in every eighth."""
FIRST_FRAMES = 600
"""Frames in which a history may begin: more than the schedule repeats after."""
VIEW = camera(64, 48, 300.0, (0.0, 0.0, 1.5))
LIGHT = EnvironmentMap("gradient", even_light(1.0, 32).radiance * np.linspace(3.0, 0.1, 64, dtype=np.float32)[None, :, None])


@wp.func
def list_paths(numbers: wp.array2d[int], phase: int, first: int):
    """Numbers of the paths that a coarse pixel of a still scene traces until the array is full; its history begins in frame `first`."""
    paths = wp.int32(0)
    frame = first
    while paths < numbers.shape[1]:
        bits = kernels.period_bits(wp.min(paths, 16), 1000)
        if bits == 0 or kernels.is_due(frame + phase, bits):
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
    return make_renderer(each.settings(), build_scene(each, device), each.instances, 1, histories=1)


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
        (16, 99, 6, 16),
        (16, 256, 16, 16),
        (32, 99, 3, 32),
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


@pytest.mark.parametrize("phase", range(0, 88, 11))
def test_the_paths_of_a_history_have_distinct_samples(device, phase):
    """In whichever frame of an episode the history begins, and as it forgets: any PATHS paths in a row."""
    numbers = wp.empty((FIRST_FRAMES, 3 * PATHS), dtype=wp.int32, device=device)
    schedule(numbers, phase, np.arange(FIRST_FRAMES), device=device)
    ordered = np.sort(np.lib.stride_tricks.sliding_window_view(numbers.numpy(), PATHS, axis=1), axis=-1)
    assert (np.diff(ordered) > 0).all()


def test_full_histories_are_due_together(renderer, device):
    """In a still scene all coarse pixels trace a path in one of 16 frames, and none in the others: then nothing is shaded."""
    frames = [(frame, toy()) for frame in range(FILLED + 1 + 2 * LONGEST_PERIOD)]
    stored, passes = zip(
        *(
            (renderer.shading.history.diffuse.numpy()[0].copy(), renderer.image.passes.numpy()[0].copy())
            for _ in show(renderer, frames, device)
        ),
        strict=True,
    )
    shares = np.array([(now != before).mean() for before, now in itertools.pairwise(stored[FILLED:])])
    due = shares > 0.0
    assert due.sum() == 2
    assert np.diff(np.flatnonzero(due)).tolist() == [LONGEST_PERIOD]
    assert shares[due].min() > 0.9
    assert [bool(each.any()) for each in passes[FILLED + 1 :]] == due.tolist()


@pytest.mark.parametrize("scale", [1e-7, 1e6])
def test_accumulated_light_does_not_depend_on_the_unit_of_maps(device, scale):
    colors = []
    for light in (LIGHT, EnvironmentMap("scaled", scale * LIGHT.radiance)):
        each = replace(toy(), lights=(light,))
        made = make_renderer(each.settings(), build_scene(each, device), each.instances, 1, histories=1)
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


def test_a_small_displacement_shortens_no_history(renderer, device):
    list(show(renderer, [(0, toy(0.08)), (1, toy(0.08002))], device))
    assert renderer.shading.moving.moved.numpy()[0].tolist() == [0, 0, 1, 0, 0, 0, 0]  # type: ignore[union-attr]
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


# ---- path queues ----


LARGER = camera(96, 64, 250.0, (0.0, 0.0, 1.5))
FRAMES = 5
MAX_INTEGERS = {
    "path": {"bounce": 63, "hit.segment": 255, "hit.triangle": (1 << 26) - 1},
    "pixel": {"offset": 511, "segment": 255, "known": 255, "number": (1 << 30) - 1},
}
"""Largest integers of a queued path and of its coarse pixel."""
NOT_QUEUED = {"hit.depth", "unoccluded.indirect"}
"""Members that have no use after a bounce."""


@wp.func
def repack_path(queues: PathQueues, slot: int, path: Path, pixel: PathPixel):
    """Round trip: store a path in a slot of the queue (view 0, region 0), and load it again."""
    write_path(queues, first_record(queues, 0, 0, slot), path, pixel)
    again, place = read_path(queues, first_record(queues, 0, 0, slot))
    return again, place


repack = probe(repack_path)


def pile(frame: int, bounces: int, walls: bool, paths: int) -> ToyScene:
    """A sheet, a ball that moves over it, and a box; or walls instead of the box, between which most paths go on."""
    placed = [(0, (0.0, 0.0, 0.0, *UPRIGHT)), (2, (-0.1 + 0.02 * frame, 0.0, 0.06, *UPRIGHT))]
    if walls:
        placed += [(3, (x, 0.0, 0.3, *UPRIGHT)) for x in (-0.11, 0.11)]
    else:
        placed.append((1, (0.05, 0.02, 0.03, *UPRIGHT)))
    entries = [entry(mesh) for mesh in (sheet(0.4, 0.4), box(0.04, 0.04, 0.06), ball(0.03, 3), box(0.02, 0.5, 0.6))]
    # As many paths as by default: several where no history is usable, one elsewhere.
    config = with_render(coarse_pixel=1, coarse_paths=paths, bounces=bounces, history=8)
    return ToyScene(entries, [placed], (LARGER,), lights=(LIGHT,), config=config)


def make_queues(renderer: Renderer, regions: int, views: int = 1) -> Any:
    """Queues of a renderer for some views at a time; 0 regions: none."""
    render = with_render(bounces=renderer.shading.rules.bounces).render  # type: ignore[union-attr]
    sizes = queue_sizes(render, LARGER.width, LARGER.height, views, 1, renderer.scene.device)
    return allocate_struct(PATH_QUEUES, sizes | {"queue_region": regions, "queue_view": views}, renderer.scene.device)


def light_of(bounces: int, walls: bool, paths: int, regions: int, device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Radiance of all frames, and the number of paths in the first stage's queues after each (frame, region)."""
    each = pile(0, bounces, walls, paths)
    renderer = make_renderer(each.settings(), build_scene(each, device), each.instances, 1, histories=1)
    renderer.shading.queues = make_queues(renderer, regions)  # type: ignore[union-attr]
    images, counts = [], []
    for image in show(renderer, [(frame, pile(frame, bounces, walls, paths)) for frame in range(FRAMES)], device):
        images.append(image)
        counts.append(renderer.shading.queues.count.numpy()[0, :, 0].copy())  # type: ignore[union-attr]
    return np.stack(images), np.stack(counts)


def assert_same_light(queued: np.ndarray, alone: np.ndarray, device: wp.Device) -> None:
    """Compare bit by bit on a CPU. On a GPU the compiler contracts multiplications and additions (FMA) differently in the two kernels, so
    that rounding may change the outcome of a few comparisons."""
    if device.is_cuda:
        assert np.isclose(queued, alone, rtol=1e-3, atol=1e-4).mean() > 0.999
    else:
        np.testing.assert_array_equal(queued, alone)


@pytest.mark.parametrize(
    ("bounces", "walls", "paths"), [(1, False, 1), (2, False, 1), (4, False, 1), (4, True, 1), (6, True, 1), (4, True, 0)]
)
def test_queued_paths_have_the_light_of_paths_traced_by_one_thread(device, bounces, walls, paths):
    regions = interleaved_threads(LARGER.width, LARGER.height) // int(REGION_PIXELS)
    alone, _ = light_of(bounces, walls, paths, 0, device)
    queued, counts = light_of(bounces, walls, paths, regions, device)
    assert_same_light(queued, alone, device)
    # The first frame, in which all coarse pixels trace several paths, queues none.
    assert (counts > 0).any(axis=1).tolist() == [bounces > 1 and (frame > 0 or paths == 1) for frame in range(FRAMES)]
    # Between walls more than half of the paths go on.
    assert (2 * counts > int(QUEUE_CAPACITY)).any() == (walls and bounces > 1)


def leaves(rows: np.ndarray, prefix: str = "") -> dict[str, np.ndarray]:
    """Members of nested structs by their paths, as views."""
    parts = [
        leaves(rows[name], f"{prefix}{name}.") if rows[name].dtype.names else {f"{prefix}{name}": rows[name]} for name in rows.dtype.names
    ]
    return {name: values for part in parts for name, values in part.items()}


def test_paths_survive_packing(device):
    """Random paths, the first with the largest integers; all but what a queued path has none of."""
    random, count = np.random.default_rng(1), 40
    given = {name: np.zeros(count, np.dtype(kind.numpy_dtype())) for name, kind in (("path", Path), ("pixel", PathPixel))}
    for name, rows in given.items():
        for member, values in leaves(rows).items():
            if largest := MAX_INTEGERS[name].get(member):
                values[:] = random.integers(0, largest + 1, count)
                values[0] = largest
            else:
                values[:] = random.normal(size=values.shape)
    queues = allocate_struct(
        PATH_QUEUES, queue_sizes(Config().render, LARGER.width, LARGER.height, 1, 1, device) | {"queue_region": 1}, device
    )
    found = dict(zip(given, repack(queues, np.arange(count), *given.values(), device=device), strict=True))
    for name, rows in given.items():
        again = leaves(found[name])
        for member, values in leaves(rows).items():
            if member not in NOT_QUEUED:
                np.testing.assert_array_equal(again[member], values, err_msg=member)


def test_batches_of_more_views_than_queues_take_turns(device):
    """Three views with queues for two: each has the light that it has without queues."""
    each = pile(0, 4, True, 1)
    renderer = make_renderer(each.settings(), build_scene(each, device), each.instances, 3)
    regions = interleaved_threads(LARGER.width, LARGER.height) // int(REGION_PIXELS)
    zeros = wp.zeros(3, dtype=wp.int32, device=device)
    views, out = make_views(zeros, zeros, 3, 4), allocate_view_buffers(3, LARGER.width, LARGER.height, 4, device)
    images = []
    for count in (0, regions):
        renderer.shading.queues = make_queues(renderer, count, views=2)  # type: ignore[union-attr]
        renderer.render(snapshot(each, device), views, out)
        images.append(renderer.image.radiance.numpy())
    assert_same_light(images[1], images[0], device)


@pytest.mark.parametrize(
    ("views", "regions", "gigabytes", "expected"),
    [(25, 255, 80, 25), (25, 255, 24, 9), (13, 255, 12, 5), (414, 255, 80, 32), (1, 255, 1, 1), (6144, 8, 80, 1024)],
)
def test_views_take_turns_of_equal_length(views, regions, gigabytes, expected):
    """A view's queues take 20.9 MB in full HD, with 255 regions, and 0.7 MB at 64x64."""
    assert queue_views(views, regions, gigabytes << 30) == expected
