"""Hypotheses of the tracker: motions, symmetries, correlation of colours, choices, state of the tracks."""

import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from synpick_warp.kernels.pose.hypotheses import (
    CORRELATION_LANES,
    FAST_MEAN,
    MOTIONS,
    NO_CORRELATION,
    SLOW_MEAN,
    TrackPolicy,
    choose_poses_kernel,
    choose_symmetry_kernel,
    correlate_symmetries_kernel,
    propose_motions_kernel,
    symmetric_poses_kernel,
    update_tracks_kernel,
)
from synpick_warp.stages.arrays import allocate_struct
from synpick_warp.stages.pose.models import SYMMETRIES, build_models
from synpick_warp.stages.pose.refine import LossScales, make_loss
from synpick_warp.stages.pose.symmetries import CORRELATION
from synpick_warp.stages.pose.track import TRACK
from tests.harness.pose_probe import view_samples
from tests.twins import pose as twin
from tests.worlds.pose_views import (
    FACING,
    as_material,
    drawn,
    model_of,
    observe,
    plate_view,
    pose_errors,
    pose_of,
    smooth_texture,
    table_of,
)
from tests.worlds.toy_scene import box, sheet


def two_discs(device):
    """Observer of two instances, of which the second is not visible."""
    label = np.zeros((40, 60), np.uint8)
    label[5:35, 10:40] = 1
    return observe(drawn(label, np.full(label.shape, 0.5), 80.0), table_of((0, 0, 0), (0, 1, 0)), device)


def as_poses(pose: np.ndarray, device) -> wp.array:
    return wp.array(np.atleast_2d(pose).astype(np.float32), dtype=wp.transform, device=device)


BEFORE = pose_of((0.0, 0.0, 0.5), Rotation.from_rotvec([0.2, 0.0, 0.1]))
NOW = pose_of((0.01, -0.02, 0.53), Rotation.from_rotvec([0.0, 0.3, 0.0]) * Rotation.from_rotvec([0.2, 0.0, 0.1]))


@pytest.mark.parametrize("frames", [0, 1, 2])
def test_motion_hypotheses(device, frames):
    observer = two_discs(device)
    track = allocate_struct(TRACK, {"instance": 2}, device)
    track.pose.assign(np.stack([NOW, NOW]))
    track.before.assign(np.stack([BEFORE, BEFORE]))
    track.frames.assign(np.full(2, frames, np.int32))
    track.centroid.assign(np.array([[0.001, 0.002, 0.49]] * 2, np.float32))
    out = wp.zeros(2 * int(MOTIONS), dtype=wp.transform, device=device)
    inputs = [track, observer.observation, as_poses(np.stack([BEFORE, BEFORE]), device), wp.zeros(2, dtype=int, device=device)]
    wp.launch(propose_motions_kernel, dim=2, inputs=inputs, outputs=[out], device=device)
    found = out.numpy().reshape(2, 3, 7)
    shown = observer.observation.centroid.numpy()[0] - (0.001, 0.002, 0.49)
    onward = pose_of((0.02, -0.04, 0.56), Rotation.from_rotvec([0.0, 0.3, 0.0]) * Rotation.from_quat(NOW[3:]))
    shifted = NOW.copy()
    shifted[:3] += shown
    expected = [NOW, onward if frames > 1 else NOW, shifted if frames > 0 else NOW]
    # What is not visible has no centroid to follow.
    for row, poses in enumerate([expected, [*expected[:2], NOW]]):
        distance, angle = pose_errors(found[row], np.stack(poses))
        assert distance.max() < 1e-6
        assert angle.max() < 1e-2


def test_a_track_that_starts_forgets_what_was(device):
    observer = two_discs(device)
    track = allocate_struct(TRACK, {"instance": 2}, device)
    track.pose.assign(np.stack([NOW, NOW]))
    track.before.assign(np.stack([BEFORE, BEFORE]))
    track.frames.assign(np.full(2, 5, np.int32))
    track.correlation.fill_(0.5)
    out, start = wp.zeros(2 * int(MOTIONS), dtype=wp.transform, device=device), turned_poses(2)
    inputs = [track, observer.observation, as_poses(start, device), wp.array([1, 0], dtype=int, device=device)]
    wp.launch(propose_motions_kernel, dim=2, inputs=inputs, outputs=[out], device=device)
    assert np.array_equal(out.numpy()[:3], np.tile(start[0], (3, 1)))
    assert np.array_equal(track.pose.numpy(), np.stack([start[0], NOW]))
    assert track.correlation.numpy().tolist() == [float(NO_CORRELATION), 0.5]


def test_turns_keep_the_centre(device):
    observer = two_discs(device)
    symmetries = allocate_struct(SYMMETRIES, {"model": 1, "symmetry": 3}, device)
    quarter = Rotation.from_euler("z", 90, degrees=True)
    symmetries.rotation.assign(np.array([[(0, 0, 0, 1), quarter.as_quat(), (1, 0, 0, 0)]], np.float32))
    symmetries.count.assign(np.array([2], np.int32))
    center = np.array([0.01, 0.02, 0.03])
    symmetries.center.assign(center[None].astype(np.float32))
    out = wp.zeros(6, dtype=wp.transform, device=device)
    poses = as_poses(np.stack([NOW, BEFORE]), device)
    wp.launch(symmetric_poses_kernel, dim=6, inputs=[symmetries, observer.targets, poses, 3], outputs=[out], device=device)
    found = out.numpy().reshape(2, 3, 7)
    for row, pose in enumerate((NOW, BEFORE)):
        # Beyond the model's symmetries the pose is repeated.
        assert found[row, [0, 2]] == pytest.approx(np.stack([pose, pose]), abs=1e-6)
        rotation, place = Rotation.from_quat(pose[3:]), pose[:3]
        turned = Rotation.from_quat(found[row, 1, 3:])
        assert turned.apply(center) + found[row, 1, :3] == pytest.approx(rotation.apply(center) + place, abs=1e-6)
        assert ((rotation * quarter).inv() * turned).magnitude() < 1e-5


def correlate(device, observer, models, pose: np.ndarray):
    """Sums of one candidate per instance."""
    sums = allocate_struct(CORRELATION, {"candidate": len(pose), "lane": int(CORRELATION_LANES)}, device)
    loss = make_loss(LossScales(), 0.01, 1, 1.0)
    inputs = [models.models, models.symmetries, loss, observer.images, observer.targets, observer.observation, as_poses(pose, device), 1]
    wp.launch(correlate_symmetries_kernel, dim=(len(pose), int(CORRELATION_LANES)), inputs=inputs, outputs=[sums], device=device)
    return sums


def choose_turn(device, sums, poses: np.ndarray, mean: float, gain: float, capacity: int, count: int | None = None):
    """The two hypotheses of one instance, and the new running mean."""
    symmetries = allocate_struct(SYMMETRIES, {"model": 1, "symmetry": capacity}, device)
    symmetries.count.assign(np.array([capacity if count is None else count], np.int32))
    observer = two_discs(device)
    means, out = wp.array([mean, mean], dtype=float, device=device), wp.zeros(2, dtype=wp.transform, device=device)
    inputs = [symmetries, means, observer.targets, sums, as_poses(poses, device), capacity, gain]
    wp.launch(choose_symmetry_kernel, dim=1, inputs=inputs, outputs=[out], device=device)
    return out.numpy(), float(means.numpy()[0])


@pytest.mark.parametrize("offset", [0.0, 0.004, 0.012])
def test_correlation_is_that_of_numpy(device, offset):
    """The running mean starts at the first correlation."""
    texture, size, focal, shape = smooth_texture(6, 64, 64), (0.1, 0.08), 500.0, (120, 160)
    observer = observe(plate_view(size, 0.5, focal, shape, texture), table_of((0, 0, 0)), device)
    models = build_models([model_of(sheet(*size), as_material(texture))], device)
    pose = np.array([[offset, 0.0, 0.5, *FACING]], np.float32)
    found = view_samples(models, make_loss(LossScales(), 0.01, 1, 1.0), observer, pose)
    used = found["colored"][0] > 0
    expected = twin.correlation(found["color"][0][used], models.models.color.numpy()[0][used])
    _, mean = choose_turn(device, correlate(device, observer, models, pose), pose, float(NO_CORRELATION), 0.1, 1)
    assert mean == pytest.approx(expected, abs=1e-4)
    assert (mean > 0.97) == (offset == 0.0)


def sums_of(device, *correlations: float | None):
    """Correlation sums of candidates with these correlations; None: of too few samples."""
    lanes = int(CORRELATION_LANES)
    sums = allocate_struct(CORRELATION, {"candidate": len(correlations), "lane": lanes}, device)
    rows = [(1.0, 1.0, 0.0 if value is None else value, 8.0 if value is None else 80.0) for value in correlations]
    sums.squares.assign(np.repeat(np.array(rows, np.float32)[:, None] / lanes, lanes, axis=1))
    return sums


def turned_poses(count: int) -> np.ndarray:
    return np.stack([pose_of((0.1 * k, 0.0, 0.5), Rotation.identity()) for k in range(count)])


@pytest.mark.parametrize(
    ("correlations", "mean", "gain", "chosen", "after"),
    [
        # As well as ever: symmetries are not considered, however well they fit.
        ((0.5, 0.9), 0.5, 0.1, 0, 0.5),
        ((0.45, 0.9), 0.5, 0.1, 0, 0.5 - 0.05 * float(FAST_MEAN)),
        # Worse than ever: the best that is better by the gain.
        ((0.3, 0.9, 0.8), 0.5, 0.1, 1, 0.5 - 0.2 * float(SLOW_MEAN)),
        ((0.3, 0.8, 0.9), 0.5, 0.1, 2, 0.5 - 0.2 * float(SLOW_MEAN)),
        ((0.3, 0.39), 0.5, 0.1, 0, 0.5 - 0.2 * float(SLOW_MEAN)),
        ((0.3, None), 0.5, 0.1, 0, 0.5 - 0.2 * float(SLOW_MEAN)),
        # Nothing to compare: the mean stays.
        ((None, 0.9), 0.5, 0.1, 0, 0.5),
        ((0.4, 0.9), float(NO_CORRELATION), 0.1, 0, 0.4),
        # Without colour.
        ((0.3, 0.9), 0.5, float("inf"), 0, 0.5 - 0.2 * float(FAST_MEAN)),
    ],
)
def test_a_turn_is_proposed_where_colours_fit_worse_than_they_used_to(device, correlations, mean, gain, chosen, after):
    poses = turned_poses(len(correlations))
    found, updated = choose_turn(device, sums_of(device, *correlations), poses, mean, gain, len(correlations))
    assert np.array_equal(found, poses[[0, chosen]])
    assert updated == pytest.approx(after, abs=1e-6)


def test_turns_of_other_models_are_not_proposed(device):
    found, _ = choose_turn(device, sums_of(device, 0.1, 0.2, 0.9), turned_poses(3), 0.8, 0.05, 3, count=2)
    assert found[1, 0] == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("costs", "loyalty", "chosen"),
    [((0.5, 0.4, 0.3), 0.0, 2), ((0.5, 0.48, 0.46), 0.1, 0), ((0.5, 0.44, 0.43), 0.1, 2), ((0.5, 0.5, 0.5), 0.0, 0)],
)
def test_the_least_cost_wins_unless_the_first_is_nearly_as_good(device, costs, loyalty, chosen):
    poses = np.concatenate([turned_poses(3), turned_poses(3)[::-1]])
    cost = wp.array([*costs, *costs], dtype=float, device=device)
    out, least = wp.zeros(2, dtype=wp.transform, device=device), wp.zeros(2, dtype=float, device=device)
    wp.launch(choose_poses_kernel, dim=2, inputs=[as_poses(poses, device), cost, 3, loyalty], outputs=[out, least], device=device)
    assert np.array_equal(out.numpy(), poses[[chosen, 3 + chosen]])
    assert least.numpy() == pytest.approx([costs[chosen]] * 2)


def policy(min_points: int = 12) -> TrackPolicy:
    """Policy of the tests: a cost rise above 0.4 rejects an estimate, for at most two frames."""
    result = TrackPolicy()
    result.min_points, result.surprise, result.patience, result.first_cost = min_points, 0.4, 2, 0.5
    return result


class Tracks:
    """Two tracks with the pose NOW, the first of which is visible; both are offered new poses at a cost."""

    def __init__(self, device, frames: int) -> None:
        self.device, self.observer = device, two_discs(device)
        self.state = allocate_struct(TRACK, {"instance": 2}, device)
        self.state.pose.assign(np.stack([NOW, NOW]))
        self.state.before.assign(np.stack([BEFORE, BEFORE]))
        self.state.frames.assign(np.full(2, frames, np.int32))
        self.state.correlation.fill_(0.5)
        self.state.cost.fill_(0.3)
        self.new, self.start = turned_poses(2), turned_poses(4)[2:]

    def update(self, cost: float = 0.3, starting: int = 0, min_points: int = 12) -> None:
        costs = wp.array([cost, cost], dtype=float, device=self.device)
        inputs = [policy(min_points), self.observer.observation, as_poses(self.new, self.device), costs, as_poses(self.start, self.device)]
        inputs += [wp.array([starting] * 2, dtype=int, device=self.device)]
        wp.launch(update_tracks_kernel, dim=2, inputs=inputs, outputs=[self.state], device=self.device)

    def pose(self) -> np.ndarray:
        return self.state.pose.numpy()


@pytest.mark.parametrize("min_points", [12, 10_000])
def test_tracks_take_new_estimates_over(device, min_points):
    """With too few points the pose stays, at rest."""
    tracks = Tracks(device, frames=3)
    tracks.update(min_points=min_points)
    seen = min_points < 1000
    assert np.array_equal(tracks.pose(), np.stack([tracks.new[0] if seen else NOW, NOW]))
    assert np.array_equal(tracks.state.before.numpy(), np.stack([NOW, NOW]))
    assert tracks.state.frames.numpy().tolist() == [3 + seen, 3]
    centroid = tracks.observer.observation.centroid.numpy()[0] if seen else np.zeros(3)
    assert np.array_equal(tracks.state.centroid.numpy()[0], centroid)


@pytest.mark.parametrize("frames", [0, 5])
def test_tracks_start_at_their_start_pose(device, frames):
    tracks = Tracks(device, frames)
    tracks.update(starting=1, min_points=10_000)
    assert np.array_equal(tracks.pose(), tracks.start)
    assert np.array_equal(tracks.state.before.numpy(), tracks.start)
    assert tracks.state.frames.numpy().tolist() == [1, 1]
    assert tracks.state.correlation.numpy().tolist() == [float(NO_CORRELATION)] * 2
    assert tracks.state.cost.numpy().tolist() == [0.5, 0.5]


def test_a_track_that_has_not_started_waits(device):
    tracks = Tracks(device, frames=0)
    tracks.update()
    assert np.array_equal(tracks.pose(), np.stack([NOW, NOW]))
    assert tracks.state.frames.numpy().tolist() == [0, 0]


def test_an_estimate_that_costs_too_much_waits_for_two_frames(device):
    """Wrong masks are short; after `patience` frames it counts nevertheless, and is the new mean. Hidden instances wait, too."""
    tracks = Tracks(device, frames=3)
    for held in (1, 2):
        tracks.update(cost=0.75)
        assert np.array_equal(tracks.pose()[0], NOW)
        assert tracks.state.held.numpy().tolist() == [held, held]
        assert tracks.state.frames.numpy().tolist() == [3, 3]
    tracks.update(cost=0.75)
    assert np.array_equal(tracks.pose()[0], tracks.new[0])
    assert tracks.state.held.numpy()[0] == 0
    assert tracks.state.cost.numpy() == pytest.approx([0.75, 0.3])
    # What has moved during several frames tells no velocity.
    assert np.array_equal(tracks.state.before.numpy()[0], tracks.new[0])


def test_an_ordinary_cost_ends_the_wait(device):
    tracks = Tracks(device, frames=3)
    tracks.update(cost=0.75)
    tracks.update(cost=0.65)
    assert np.array_equal(tracks.pose()[0], tracks.new[0])
    assert tracks.state.held.numpy()[0] == 0
    assert tracks.state.cost.numpy()[0] == pytest.approx(0.3 + 0.2 * 0.35)


def test_a_box_has_its_turns_in_the_table(device):
    models = build_models([model_of(box(0.12, 0.08, 0.05)), model_of(box(0.08, 0.08, 0.08))], device, samples=1024)
    counts, rotation = models.symmetries.count.numpy(), models.symmetries.rotation.numpy()
    assert rotation.shape[1] == counts.max()
    assert (counts >= 4).all()
    assert rotation[:, 0].tolist() == [[0.0, 0.0, 0.0, 1.0]] * 2
    for row, count in enumerate(counts):
        assert (rotation[row, count:] == (0.0, 0.0, 0.0, 1.0)).all()
        assert np.linalg.norm(rotation[row], axis=1) == pytest.approx(np.ones(rotation.shape[1]), abs=1e-6)
