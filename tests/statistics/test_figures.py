"""Figures: known answers on a hand-made data set, twins in NumPy, merges that equal the whole, and the comparison with the paper. AUC,
calibration and bootstrap: known answers by hand, brute force over pairs, and intervals that cover what they should."""

import dataclasses
import io
import itertools
import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

import synpick_warp
from synpick_warp.apps.statistics import columns, compute
from synpick_warp.apps.statistics.columns import Block, Counts, Group
from synpick_warp.apps.statistics.compute import DEPTH_QUANTILES, SceneTask, assemble, collect, compute_statistics, read_episode, read_scene
from synpick_warp.apps.statistics.figures import Annotations, BinUse, Coverage, EpisodeFigures, GroupStatistics, Rest
from synpick_warp.apps.statistics.picks import BINS, Scored, calibrate, estimate, success_rate, weighted_auc
from synpick_warp.apps.statistics.tables import make_tables, print_statistics
from synpick_warp.configs.cell.gripper import Suction
from synpick_warp.dataset.bop.arrays import SceneArrays
from synpick_warp.dataset.reading import DataSet
from synpick_warp.errors import DatasetError
from tests.worlds.evaluation_set import BOX, BRICK, CAMERAS, FRAMES, MODES, PERIOD, PRISM, VISIBILITY, write_evaluation_set

GROUP = Group("train", "pick")
ATTEMPTS = [
    {"outcome": "target_picked", "good_seal": True, "engaged": [1], "peak_force": [0.0, 3.0, 5.5]},
    {"outcome": "target_picked", "good_seal": False, "engaged": [0, 1], "peak_force": [0.0, 500.0]},
    {"outcome": "missed", "good_seal": False, "engaged": [], "peak_force": []},
]
LOOKS = {
    "exposure": -0.25,
    "bin": {"color": [0.123, 0.5, 1.0], "texture": 3},
    "table": {},
    "objects": [{"hue": float(hue)} for hue in range(-90, 91, 10)],
    "distractors": [{"instance": 19, "name": "cup", "hue": 12.345}],
}
HEIGHT, WIDTH = 4, 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Two episodes, move and pick, with attempts, lights and depth images of the second one only."""
    out = write_evaluation_set(tmp_path_factory.mktemp("statistics") / "set")
    text = (out / "config.toml").read_text().replace("resolution = [320, 180]", f"resolution = [{WIDTH}, {HEIGHT}]", 1)
    (out / "config.toml").write_text(text)
    entry = out / "manifest" / "000001.json"
    own = {"name": "kanban", "position": [0.014, -0.012, 0.0], "yaw": -0.1}
    row = json.loads(entry.read_text())["row"] | {"objects": 4, "picked": 2, "lost": 1, "looks": LOOKS, "bin": own}
    entry.write_text(json.dumps({"row": row, "attempts": ATTEMPTS}))
    random = np.random.default_rng(3)
    for scene in range(CAMERAS, 2 * CAMERAS):
        place = out / "train_pbr" / f"{scene:06d}"
        cameras = json.loads((place / "scene_camera.json").read_text())
        for camera in cameras.values():
            camera["light"] = {"map": "sky", "yaw": 3.2, "exposure": -0.05, "direction": None}
        (place / "scene_camera.json").write_text(json.dumps(cameras))
        (place / "depth").mkdir()
        for frame in range(FRAMES):
            image = random.integers(0, 3, (HEIGHT, WIDTH)) * random.integers(15_000, 22_000, (HEIGHT, WIDTH))
            cv2.imwrite(str(place / "depth" / f"{frame:06d}.png"), image.astype(np.uint16))
    return out


@pytest.fixture(scope="module")
def data_set(folder) -> DataSet:
    return synpick_warp.open(folder)


@pytest.fixture(scope="module")
def statistics(data_set):
    return compute_statistics(data_set, depth_views=1000)


def test_the_table_has_the_known_answers(statistics):
    assert [(row.split, row.mode) for row in statistics.groups] == [("train_pbr", mode) for mode in MODES]
    for row in statistics.groups:
        views = FRAMES * CAMERAS
        assert (row.episodes.episodes, row.episodes.frames, row.annotations.views) == (1, FRAMES, views)
        assert row.annotations.instances == views * len(VISIBILITY)
        assert row.annotations.visibility == pytest.approx(np.mean(VISIBILITY), abs=1e-9)
        assert row.annotations.objects == {BRICK: 2 * views, BOX: views, PRISM: views}
        assert row.annotations.invisible == 0
        expected = dict.fromkeys(range(columns.VISIBILITY_BINS), 0) | {1: views, 6: views, 12: views, columns.VISIBILITY_BINS - 1: views}
        assert dict(enumerate(row.annotations.histogram)) == expected
        assert [point.objects for point in row.objects_over_time] == [len(VISIBILITY)]
    total = statistics.total.annotations
    assert (total.views, total.instances_per_view) == (2 * FRAMES * CAMERAS, len(VISIBILITY))
    assert [(each.object_id, each.instances) for each in statistics.objects] == sorted(total.objects.items())


def test_attempts_and_seal_forces_have_the_known_answers(statistics):
    move, pick = (row.episodes for row in statistics.groups)
    assert (move.attempts, move.outcomes, move.force) == (0, {}, None)
    assert (pick.objects, pick.picked, pick.lost, pick.attempts) == (4, 2, 1, 3)
    assert pick.outcomes == {"target_picked": 2, "missed": 1}
    assert pick.endings == {"finished": 1}
    assert (pick.seals, pick.good_seals, pick.force) == (2, 1, pytest.approx((5.5 + 500.0) / 2))
    assert {index: count for index, count in enumerate(pick.force_histogram) if count} == {int(5.5 / columns.FORCE_BIN): 1, 29: 1}
    assert statistics.total.episodes.attempts == 3


@pytest.mark.parametrize(("forces", "load"), [(((5.5, True, None), (0.3, False, None)), 15), (((8.0, False, 40.0), (2.1, True, 5.0)), 42)])
@pytest.mark.parametrize("broken", [0, 1])
def test_a_line_tells_that_no_seal_came_near_its_break_force(statistics, forces, load, broken):
    """Of the settings, 40 and 2 N, or of the attempt; one that broke is near it."""
    rows = [
        columns.AttemptFacts("target_picked", good, [1], [0.0, force], limit)
        for force, good, limit in (*forces, *[(2.5, False, None)] * broken)
    ]
    found = counted(columns.episode_blocks(GROUP, columns.EpisodeFacts("pick", 9, "finished"), rows, Suction()))
    episodes = compute.episode_figures(found, [GROUP])
    assert episodes.largest_load == (100 if broken else load)
    console = Console(file=io.StringIO(), width=200)
    print_statistics(console, replace(statistics, total=replace(statistics.total, episodes=episodes)))
    assert (f"no seal was loaded beyond {load} % of its break force" in console.file.getvalue()) == (not broken)


def test_bins_have_the_known_answers_and_merge(statistics):
    step = math.radians(5.0)
    assert statistics.bins == {"kanban": BinUse(1, (0.01, 0.02), (-0.02, -0.01), (-2 * step, -step))}
    found = Counts()
    for name, x in (("a", 0.0), ("b", 0.0), ("b", 0.035)):
        facts = columns.EpisodeFacts("pick", 9, "finished", bin=columns.BinFacts(name, (x, 0.0, 0.0), 0.0))
        found.merge(counted(columns.episode_blocks(GROUP, facts, [], None)))
    used = {name: (use.episodes, use.x) for name, use in compute.bin_figures(found).items()}
    assert used == {"b": (2, (0.0, 0.04)), "a": (1, (0.0, 0.01))}


def test_lights_have_the_known_answers_and_what_is_missing_is_told(statistics, data_set):
    assert statistics.lights.maps == {"sky": 1}
    assert statistics.lights.exposure == {-0.1: 1}
    assert [index for index, count in enumerate(statistics.lights.yaw) if count] == [6]
    assert statistics.missing == ("the objects are not those of the paper, so their distributions are not compared",)
    move = assemble(data_set, collect(data_set, 0, 1))
    assert move.depth is None
    assert "no depth images: no depth range" in move.missing


def test_looks_have_the_known_answers(statistics):
    rows = {(row.part, row.parameter): (row.draws, *row.quantiles) for row in statistics.looks}
    assert rows == {
        ("bin", "color.blue"): (1, 1.0, 1.0, 1.0),
        ("bin", "color.green"): (1, 0.5, 0.5, 0.5),
        ("bin", "color.red"): (1, 0.12, 0.12, 0.12),
        ("bin", "texture"): (1, 3.0, 3.0, 3.0),
        ("distractor", "hue"): (1, 12.0, 12.0, 12.0),
        ("episode", "distractors"): (1, 1.0, 1.0, 1.0),
        ("episode", "exposure"): (1, -0.25, -0.25, -0.25),
        ("object", "hue"): (19, -90.0, 0.0, 90.0),
    }
    (table,) = (table for table in make_tables(statistics) if table.name == "looks")
    assert len(table.rows) == len(rows)


def test_depth_is_that_of_all_pixels(statistics, folder):
    images = [cv2.imread(str(path), -1) for path in sorted(folder.glob("train_pbr/*/depth/*.png"))]
    pixels = np.sort(np.concatenate([image[image > 0] for image in images])) * 0.1
    assert statistics.depth.views == len(images) == FRAMES * CAMERAS
    assert statistics.depth.missing == pytest.approx(np.mean(np.stack(images) == 0))
    for quantile in DEPTH_QUANTILES:
        expected = np.quantile(pixels, quantile, method="inverted_cdf")
        assert statistics.depth.quantiles[quantile] == pytest.approx(expected, abs=columns.DEPTH_BIN / 2 + 1e-6)
    assert compute.depth_figures(Counts()) is None
    empty = compute.depth_figures(counted(columns.depth_blocks(np.zeros((2, 3), np.uint16), 0.1)))
    assert (empty.quantiles, empty.missing) == ({}, 1.0)


def test_all_figures_are_those_of_a_twin_that_reads_view_by_view(statistics, data_set):
    """The twin uses the public reader, one view at a time, and other formulas for directions."""
    for row, (_, episode) in zip(statistics.groups, data_set.items(), strict=True):
        views = list(episode.views())
        visibility = np.concatenate([view.visibility for view in views])
        assert row.annotations.visibility == pytest.approx(visibility.mean(), abs=1e-9)
        bins = [min(int(Fraction(str(value)) * columns.VISIBILITY_BINS), columns.VISIBILITY_BINS - 1) for value in visibility.tolist()]
        np.testing.assert_array_equal(np.bincount(bins, minlength=columns.VISIBILITY_BINS), row.annotations.histogram)
        by_frame = [len(view.instance_ids) for view in views if view.camera == 0]
        assert row.objects_over_time[0].objects == pytest.approx(np.mean(by_frame))
    counts = {each.object_id: np.zeros((columns.BANDS, columns.SECTORS), int) for each in statistics.objects}
    for view in data_set.views():
        for entry, info, pose in zip(view.records.gt, view.records.gt_info, view.object_to_camera, strict=True):
            if info["visib_fract"] >= columns.MIN_VISIBILITY:
                x, y, z = np.linalg.inv(pose)[:3, 3]  # The camera in the object's frame.
                height, longitude = z / np.sqrt(x * x + y * y + z * z), np.degrees(np.arctan2(y, x))
                band = int(np.digitize(height, np.linspace(-1, 1, columns.BANDS + 1))) - 1
                counts[entry["obj_id"]][band, int(np.digitize(longitude, np.linspace(-180, 180, columns.SECTORS + 1))) - 1] += 1
    for each in statistics.objects:
        np.testing.assert_array_equal(np.reshape(each.coverage.bins, (columns.BANDS, columns.SECTORS)), counts[each.object_id])
        assert each.coverage.occupied == pytest.approx((counts[each.object_id] > 0).mean())


# ---- merges ----


def counted(*tables: Iterable[Block]) -> Counts:
    """Sums over tables."""
    result = Counts()
    for blocks in tables:
        result.add(blocks)
    return result


@given(
    order=st.permutations(list(itertools.product(range(len(MODES)), range(CAMERAS)))),
    parts=st.lists(st.integers(0, 3), min_size=6, max_size=6),
)
def test_parts_merge_to_the_whole_in_any_order(blocks, whole, order, parts):
    pieces = [Counts() for _ in range(4)]
    for place, part in zip(order, parts, strict=True):
        pieces[part].add(blocks[place])
    left, right = pieces[:2], pieces[2:]
    for side in (left, right):
        side[0].merge(side[1])
    right[0].merge(left[0])
    assert right[0] == whole


@pytest.fixture(scope="module")
def blocks(data_set) -> dict[tuple[int, int], list[Block]]:
    """Tables of each (episode, camera); those of the episode are with camera 0."""
    return {
        (episode, camera): [
            *read_scene(data_set, SceneTask(episode, camera, FRAMES, range(FRAMES))),
            *(read_episode(data_set, episode) if camera == 0 else ()),
        ]
        for episode, camera in itertools.product(range(len(MODES)), range(CAMERAS))
    }


@pytest.fixture(scope="module")
def whole(blocks) -> Counts:
    return counted(*blocks.values())


@given(visibility=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=60), cut=st.integers(0, 60), seed=st.integers(0, 2**32 - 1))
def test_a_scene_counts_as_its_halves(visibility, cut, seed):
    random = np.random.default_rng(seed)
    ids = random.integers(1, 5, len(visibility))
    whole = counted(columns.scene_blocks(GROUP, scene(visibility, ids), ""))
    halves = counted(*(columns.scene_blocks(GROUP, scene(visibility[part], ids[part]), "") for part in (slice(0, cut), slice(cut, None))))
    halves.sums["views"][GROUP, "views"] -= 1
    assert halves == whole
    result = compute.annotation_figures(whole, [GROUP])
    assert result.visibility == pytest.approx(np.mean(visibility), abs=1e-9)
    assert sum(result.histogram) == result.instances == len(visibility)


def scene(visibility: Sequence[float], ids: np.ndarray, frames: Sequence[int] | None = None) -> SceneArrays:
    """Scene of instances before the camera, `frames` of them in each frame; without, all in one."""
    frames, number = [len(ids)] if frames is None else frames, len(ids)
    row, pose = np.repeat(np.arange(len(frames)), frames), (np.tile(np.eye(3), (number, 1, 1)), np.tile((0.0, 0.0, -1.0), (number, 1)))
    return SceneArrays(np.arange(len(frames)), [], row, ids, ids, True, *pose, np.array(visibility), np.zeros((number, 4)))


def test_processes_count_what_one_counts(data_set, statistics, monkeypatch):
    monkeypatch.setattr(compute, "VIEWS_PER_PROCESS", 1)
    seen = []
    found = compute_statistics(data_set, depth_views=1000, threads=3, report=lambda *progress: seen.append(progress))
    assert found == statistics
    assert seen[-1] == ("views", 24, 24)
    assert [done for _, done, _ in seen] == sorted(done for _, done, _ in seen)


@given(frames=st.lists(st.integers(1, 40), min_size=1, max_size=8), count=st.integers(0, 50))
def test_depth_is_sampled_evenly(frames, count):
    tasks = list(compute._sample_depth([SceneTask(index, 0, length) for index, length in enumerate(frames)], count))
    places = [sum(frames[: task.episode]) + frame for task in tasks for frame in task.depth_frames]
    assert len(places) == len(set(places)) == min(count, sum(frames))
    assert all(frame < task.frames for task in tasks for frame in task.depth_frames)
    if len(places) > 1 and count <= sum(frames):
        assert np.ptp(np.diff(places)) <= 1


# ---- single figures ----


def test_bins_of_directions_have_equal_areas():
    """Even directions fill them evenly; the axes have known bins."""
    random = np.random.default_rng(0).normal(size=(columns.DIRECTION_BINS * 500, 3))
    counts = np.bincount(columns.direction_bins(random / np.linalg.norm(random, axis=1, keepdims=True)), minlength=columns.DIRECTION_BINS)
    assert abs(((counts - 500.0) ** 2 / 500.0).sum() - (columns.DIRECTION_BINS - 1)) < 4.5 * np.sqrt(2.0 * columns.DIRECTION_BINS)
    bands = columns.direction_bins(np.array([[0.0, 0, 1], [0, 0, -1], [1, 0, 0], [-1, 0, 0], [0, 1, 0]])) // columns.SECTORS
    assert bands.tolist() == [columns.BANDS - 1, 0, columns.BANDS // 2, columns.BANDS // 2, columns.BANDS // 2]
    sectors = columns.direction_bins(np.array([[1.0, 0, 0], [0, 1, 0]])) % columns.SECTORS
    assert sectors.tolist() == [columns.SECTORS // 2, 3 * columns.SECTORS // 4]


def coverage(counts: Counts, object_id: int) -> Coverage:
    return compute.coverage_figures(counts.of("directions"), object_id)


def test_evenness_is_0_for_one_direction_and_1_for_all():
    one, even = counted(columns.scene_blocks(GROUP, scene(np.ones(5), np.full(5, 7)), "")), Counts()
    first = coverage(one, 7)
    assert (first.views, first.evenness, first.occupied) == (5, 0.0, 1 / columns.DIRECTION_BINS)
    even.sums["directions"].update({(7, index): 2 for index in range(columns.DIRECTION_BINS)})
    assert coverage(even, 7).evenness == pytest.approx(1.0)
    assert coverage(even, 8) == dataclasses.replace(first, views=0, occupied=0.0, bins=(0,) * columns.DIRECTION_BINS)
    hidden = counted(columns.scene_blocks(GROUP, scene(np.full(5, columns.MIN_VISIBILITY - 1e-6), np.full(5, 7)), ""))
    assert coverage(hidden, 7).views == 0


def test_objects_over_time_are_a_mean_over_those_that_last():
    half = round(columns.TIME_BIN / PERIOD)
    frames = ([5] * half + [3] * half, [1] * half)
    found = counted(*(columns.frame_blocks(GROUP, scene(np.ones(sum(each)), np.ones(sum(each), int), each), PERIOD) for each in frames))
    assert compute.timeline_figures(found, [GROUP]) == ((0.0, 2 * half, 3.0), (columns.TIME_BIN, half, 3.0))


@given(yaw=st.floats(-100.0, 100.0), exposure=st.floats(-5.0, 5.0))
def test_any_light_has_a_bin(yaw, exposure):
    lights = compute.light_figures(counted(columns.light_blocks(columns.Light("sky", yaw, exposure))))
    assert sum(lights.yaw) == 1
    ((low, _),) = lights.exposure.items()
    assert low - 1e-6 <= exposure < low + 0.1 + 1e-6


def test_endlessly_many_objects_are_refused(monkeypatch):
    monkeypatch.setattr(columns, "MAX_OBJECTS", 3)
    with pytest.raises(DatasetError, match="more than 3 different obj_id"):
        Counts().merge(counted(columns.scene_blocks(GROUP, scene(np.ones(4), np.arange(4)), "")))


# ---- piles at rest ----

STEP, WINDOWS = 2e-3, 5
TIME = STEP * np.arange(round(WINDOWS * 0.2 / STEP))
HUM = np.sin(2 * np.pi * 50.0 * TIME)
"""50 Hz."""


def rest(speed: np.ndarray, **others: Any) -> Rest | None:
    """Windows of an episode in which one of two objects has these speeds [m/s] along x; a third is not in the scene."""
    velocity = np.zeros((len(TIME), 3, 3), np.float32)
    velocity[:, 1, 0], velocity[:, 2] = speed, np.nan
    steps = {"velocity": velocity, "attached": np.zeros((len(TIME), 3), bool), "gripper_contact_load": np.zeros((len(TIME), 2))}
    return compute.rest_figures(counted(columns.rest_blocks(SimpleNamespace(steps={**steps, **others}), STEP)))


SPEEDS = [
    (0.0 * TIME, 5, 0),
    (0.006 * HUM, 5, 5),
    (0.006 * HUM + 0.001, 5, 5),
    (0.004 * HUM, 5, 0),
    (0.006 * HUM * (TIME < 0.4), 5, 2),
    (0.1 * HUM * np.exp(-TIME / 0.02), 5, 0),
    (0.006 * HUM + 0.02 * (TIME < 0.2), 4, 4),
]
"""Speeds, number of windows at rest, and of those that vibrate."""


def test_windows_that_vibrate_are_counted():
    """To and fro without decay; objects that drift or are shaken once are no pile at rest that vibrates, nor is what the gripper does."""
    assert [rest(speed) for speed, *_ in SPEEDS] == [Rest(windows, vibrating) for _, windows, vibrating in SPEEDS]
    pressed = np.zeros((len(TIME), 2))
    pressed[150, 1] = 3.0
    assert rest(0.006 * HUM, gripper_contact_load=pressed) == Rest(4, 4)
    assert rest(0.006 * HUM, attached=np.ones((len(TIME), 3), bool)) is None


# ---- the paper ----

COUNTS = st.dictionaries(st.sampled_from("abcdef"), st.integers(0, 1000)).filter(lambda counts: sum(counts.values()) > 0)


def test_the_papers_numbers_add_up_and_its_own_set_has_no_difference():
    paper = compute.read_paper()
    assert sum(group.views for group in paper.groups) == paper.total_views == 503_232
    assert sum(group.instances for group in paper.groups) == 3_927_549
    assert {(group.split, group.mode) for group in paper.groups} == {
        (split, mode) for split in ("train", "test") for mode in ("pick", "target", "move")
    }
    assert all(len(group.objects) == 21 for group in paper.groups)
    # The total is the mean over views, to the digits of the table.
    mean = sum(group.views * group.visibility for group in paper.groups) / paper.total_views
    assert mean == pytest.approx(paper.total_visibility, abs=0.011)
    frames = [round(group.views / (group.sequences * paper.cameras)) for group in paper.groups[:3]]
    assert frames == [573, 416, 687]
    ids = {name: index for index, name in enumerate(paper.groups[0].objects)}
    ours = []
    for each in paper.groups:
        objects = {ids[name]: count for name, count in each.objects.items()}
        episodes = EpisodeFigures(each.sequences, 0, {}, 0, 0, 0, 0, {}, 0, 0, None, ())
        ours.append(
            GroupStatistics(each.split, each.mode, episodes, Annotations(each.views, each.instances, each.visibility, 0, (), objects), ())
        )
    names = {index: f"000_{name}" for name, index in ids.items()}
    rows = compute.compare(ours, {"train": "train", "test": "test"}, names, paper.cameras)
    assert len(rows) == 6
    assert all(row.ours == row.paper and row.distance == 0.0 and 0.05 < row.paper_distance < 0.2 for row in rows)


def test_distances_have_known_answers():
    assert compute.total_variation({"a": 1, "b": 1}, {"a": 5, "b": 5}) == 0.0
    assert compute.total_variation({"a": 1}, {"b": 7}) == 1.0
    assert compute.total_variation({"a": 3, "b": 1}, {"a": 1, "b": 1}) == pytest.approx(0.25)
    names = {1: "002_master_chef_can", 2: "003_cracker_box", 3: "banana"}  # The last is of another set, with the same word.
    theirs = {"master_chef_can": 1, "cracker_box": 1, "banana": 0}
    assert [compute.object_distance(ours, names, theirs) for ours in ({1: 5, 2: 5}, {3: 5}, {4: 5}, {})] == [0.0, None, None, None]


@given(first=COUNTS, second=COUNTS, third=COUNTS)
def test_total_variation_is_a_metric(first, second, third):
    distance = compute.total_variation(first, second)
    assert 0.0 <= distance <= 1.0 + 1e-12
    assert distance == pytest.approx(compute.total_variation(second, first))
    assert distance <= compute.total_variation(first, third) + compute.total_variation(third, second) + 1e-12


# ---- ranking ----


def scored(score, outcome, weight=None, cluster=None) -> Scored:
    count = len(score)
    return Scored(
        np.array(score, float),
        np.array(outcome, bool),
        np.ones(count) if weight is None else np.array(weight, float),
        np.arange(count) if cluster is None else np.array(cluster),
    )


def test_auc_is_the_share_of_pairs_in_order():
    generator = np.random.default_rng(3)
    score, outcome, weight = generator.integers(0, 12, 200) / 11, generator.random(200) < 0.3, generator.random(200)
    order = np.sign(score[outcome][:, None] - score[~outcome]) / 2 + 0.5
    pairs = weight[outcome][:, None] * weight[~outcome]
    assert weighted_auc(scored(score, outcome, weight)) == pytest.approx((order * pairs).sum() / pairs.sum(), abs=1e-12)
    assert np.isnan([weighted_auc(scored(score, np.ones(200))), weighted_auc(scored([], []))]).all()


def test_calibration_of_a_hand_made_table():
    """Two bins: 0.25 succeeds in 1 of 4, so it is calibrated; 0.95 in 1 of 2, an error of 0.45 for a third of the samples."""
    found = calibrate(scored([0.25] * 4 + [0.95] * 2, [1, 0, 0, 0, 1, 0]), draws=50)
    count, predicted, observed = found.bins.T[:3]
    assert count.tolist() == [0, 0, 4, 0, 0, 0, 0, 0, 0, 2]
    np.testing.assert_allclose(predicted[[2, 9]], (0.25, 0.95))
    np.testing.assert_allclose(observed[[2, 9]], (0.25, 0.5))
    assert np.isnan(observed[[0, 5]]).all()
    assert found.error.value == pytest.approx(0.45 / 3)


def test_weights_of_calibration_are_repetitions():
    generator = np.random.default_rng(5)
    score, outcome, weight = generator.random(60), generator.random(60) < 0.5, generator.integers(1, 4, 60)
    once = calibrate(scored(score, outcome, weight, np.zeros(60)))
    many = calibrate(scored(*(np.repeat(each, weight) for each in (score, outcome)), cluster=np.zeros(weight.sum())))
    np.testing.assert_allclose(once.bins[:, 1:3], many.bins[:, 1:3])
    assert once.error.value == pytest.approx(many.error.value)
    assert len(once.bins) == BINS
    assert np.isnan(once.error.low), "one cluster has no interval"


def test_intervals_widen_with_clusters_and_cover_the_truth():
    """100 data sets of 40 clusters whose success depends on the cluster: some 95 of 100 intervals over clusters hold the true rate, which
    those over samples miss often."""
    generator, held = np.random.default_rng(7), {True: 0, False: 0}
    for _ in range(100):
        rate = np.repeat(generator.choice((0.1, 0.9), 40), 25)
        outcome = generator.random(1000) < rate
        for clustered in held:
            groups = np.repeat(np.arange(40), 25) if clustered else np.arange(1000)
            found = estimate(scored(outcome, outcome, cluster=groups), success_rate, draws=100)
            held[clustered] += found.low <= 0.5 <= found.high
    assert held[True] >= 88
    assert held[False] <= 60
