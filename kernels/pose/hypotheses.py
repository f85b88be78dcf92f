"""Pose hypotheses of detector and tracker: motion models, near-symmetries, their colour correlation, and the choice of the best."""

import warp as wp

from synpick_warp.kernels.pose.observation import Images, Observation, Targets
from synpick_warp.kernels.pose.residuals import LossParameters, Models
from synpick_warp.kernels.pose.samples import VISIBLE, has_color, interpolate_color, view_sample

wp.set_module_options({"enable_backward": False})

MOTIONS = wp.constant(3)
"""Motion hypotheses per instance: at rest, constant velocity, shift with the observed centroid."""
CORRELATION_LANES = wp.constant(8)
"""Threads that share the correlation of one near-symmetry."""
MIN_SAMPLES = wp.constant(24)
"""Smallest number of coloured samples for a correlation."""
NO_CORRELATION = wp.constant(-2.0)
"""Below any correlation: there are too few samples."""
FAST_MEAN = wp.constant(0.1)
SLOW_MEAN = wp.constant(0.02)
"""Weights of a new correlation in its running mean: usually, and while it is so low that symmetries are considered."""
COST_MEAN = wp.constant(0.2)
"""Weight of a new cost in its running mean."""


@wp.struct
class Track:
    """Tracker state of each instance: its last two poses (object to camera), centroid [m], number of frames with an estimate and since the
    last accepted one, and running means of cost and colour correlation (NO_CORRELATION: none yet).
    """

    pose: wp.array[wp.transform]
    """(instance): last estimate, object to camera [m]."""
    before: wp.array[wp.transform]
    """(instance): estimate of the frame before [m]."""
    centroid: wp.array[wp.vec3]
    """(instance): centroid of the points in the last frame whose estimate was taken [m]."""
    frames: wp.array[int]
    """(instance): number of frames with an estimate; 0: none yet."""
    cost: wp.array[float]
    """(instance): running mean of the costs of the estimates."""
    held: wp.array[int]
    """(instance): number of frames since the last one whose estimate was taken."""
    correlation: wp.array[float]
    """(instance): running mean of the correlation between image and base colours, before symmetries; `NO_CORRELATION`: none yet."""


@wp.struct
class TrackPolicy:
    """Limits of acceptance of an estimate into a track."""

    min_points: int
    """Minimum observed points; with fewer an instance keeps its pose."""
    surprise: float
    """Increase of the cost over its running mean above which an estimate is rejected."""
    patience: int
    """Number of frames without an estimate after which any is taken, and its cost becomes the mean."""
    first_cost: float
    """Running mean at the start."""


@wp.struct
class Symmetries:
    """Near-symmetries by model: rotations (the first is the identity) about a centre [m] that change the object's shape little.
    Constant.
    """

    rotation: wp.array2d[wp.quat]
    """(model, symmetry): in the model's axes; the first is the identity."""
    count: wp.array[int]
    """(model): number of symmetries."""
    center: wp.array[wp.vec3]
    """(model): fixed point of the rotations, in the model's frame [m]."""


@wp.struct
class Correlation:
    """Partial sums, by candidate pose and lane, of the zero-mean normalized cross-correlation between intensity and base colour."""

    intensity: wp.array2d[wp.vec3]
    """(candidate, lane): sum of the intensities."""
    base: wp.array2d[wp.vec3]
    """(candidate, lane): sum of the base colours."""
    squares: wp.array2d[wp.vec4]
    """(candidate, lane): sums of intensity², base², intensity x base over the channels, and the number of samples."""


@wp.kernel
def propose_motions_kernel(
    # State:
    track_inout: Track,
    # In:
    observation: Observation,
    start: wp.array[wp.transform],  # (instance) [m]
    starting: wp.array[int],  # (instance)
    # Out:
    pose_out: wp.array[wp.transform],  # (pose) [m]
):
    """Motion hypotheses: `pose_out` receives three poses per instance: at rest, at constant velocity, displaced as the observed centroid.

    A track that starts is reset to its start pose, so that nothing is left of another track. Launched over instance.
    """
    instance = wp.tid()
    if starting[instance] != 0:
        track_inout.pose[instance] = start[instance]
        track_inout.correlation[instance] = NO_CORRELATION
        track_inout.frames[instance] = 0
    pose = track_inout.pose[instance]
    rotation = wp.transform_get_rotation(pose)
    position = wp.transform_get_translation(pose)
    first = instance * MOTIONS
    pose_out[first] = pose
    pose_out[first + 1] = pose
    pose_out[first + 2] = pose
    if track_inout.frames[instance] > 1:
        before = track_inout.before[instance]
        rotated = rotation * wp.quat_inverse(wp.transform_get_rotation(before))
        shift = position - wp.transform_get_translation(before)
        pose_out[first + 1] = wp.transform(position + shift, wp.normalize(rotated * rotation))
    if track_inout.frames[instance] > 0 and observation.points[instance] > 0 and track_inout.centroid[instance][2] > 0.0:
        shift = observation.centroid[instance] - track_inout.centroid[instance]
        pose_out[first + 2] = wp.transform(position + shift, rotation)


@wp.kernel
def symmetric_poses_kernel(
    # Scene:
    symmetries: Symmetries,
    # In:
    targets: Targets,
    pose: wp.array[wp.transform],  # (instance) [m]
    capacity: int,
    # Out:
    pose_out: wp.array[wp.transform],  # (candidate) [m]
):
    """Candidate poses: each pose rotated by each near-symmetry of its object.

    Launched over candidate = instance x capacity + symmetry.
    """
    index = wp.tid()
    instance = index // capacity
    symmetry = index % capacity
    model = targets.model[instance]
    result = pose[instance]
    if symmetry < symmetries.count[model]:
        rotation = symmetries.rotation[model, symmetry]
        center = symmetries.center[model]
        result = result * wp.transform(center - wp.quat_rotate(rotation, center), rotation)
    pose_out[index] = result


@wp.kernel
def correlate_symmetries_kernel(
    # Scene:
    models: Models,
    symmetries: Symmetries,
    loss: LossParameters,
    # In:
    images: Images,
    targets: Targets,
    observation: Observation,
    pose: wp.array[wp.transform],  # (candidate) [m]
    capacity: int,
    # Out:
    correlation_out: Correlation,
):
    """Sums of intensity and base colour over the visible samples of each candidate pose. Launched over candidate, lane."""
    index, lane = wp.tid()
    instance = index // capacity
    model = targets.model[instance]
    intensities = wp.vec3()
    bases = wp.vec3()
    squares = wp.vec4()
    if observation.points[instance] > 0 and index % capacity < symmetries.count[model]:
        for k in range(lane, models.position.shape[1], CORRELATION_LANES):
            sample = view_sample(models, images, targets, observation, loss, instance, pose[index], k)
            if sample.state == VISIBLE and has_color(observation, instance, sample.crop):
                intensity, across, down = interpolate_color(observation, instance, sample.crop)
                base = models.color[model, k]
                intensities += intensity
                bases += base
                squares += wp.vec4(wp.dot(intensity, intensity), wp.dot(base, base), wp.dot(intensity, base), 1.0)
    correlation_out.intensity[index, lane] = intensities
    correlation_out.base[index, lane] = bases
    correlation_out.squares[index, lane] = squares


@wp.func
def correlation_of(correlation: Correlation, index: int) -> float:
    """Zero-mean normalized cross-correlation of a candidate, the means removed per channel; `NO_CORRELATION`: too few samples."""
    intensity = wp.vec3()
    base = wp.vec3()
    squares = wp.vec4()
    for lane in range(CORRELATION_LANES):
        intensity += correlation.intensity[index, lane]
        base += correlation.base[index, lane]
        squares += correlation.squares[index, lane]
    count = squares[3]
    if count < float(MIN_SAMPLES):
        return NO_CORRELATION
    spread = (squares[0] - wp.dot(intensity, intensity) / count) * (squares[1] - wp.dot(base, base) / count)
    if spread <= 0.0:
        return 0.0
    return (squares[2] - wp.dot(intensity, base) / count) / wp.sqrt(spread)


@wp.kernel
def choose_symmetry_kernel(
    # Scene:
    symmetries: Symmetries,
    # State:
    mean_inout: wp.array[float],  # (instance)
    # In:
    targets: Targets,
    correlation: Correlation,
    pose: wp.array[wp.transform],  # (candidate) [m]
    capacity: int,
    gain: float,
    # Out:
    pose_out: wp.array[wp.transform],  # (pose) [m]
):
    """Two hypotheses per instance: `pose_out` receives the pose as it is, and its near-symmetry that correlates best.

    A near-symmetry is considered only where colours correlate worse than their running mean (`mean_inout`, updated) by `gain`, and only if
    it correlates better than the pose by `gain`; else the pose is repeated. Light and gloss alone make some symmetries of a still object
    fit better than the truth. Launched over instance.
    """
    instance = wp.tid()
    first = instance * capacity
    best = first
    start = correlation_of(correlation, first)
    mean = mean_inout[instance]
    if start > NO_CORRELATION:
        if mean == NO_CORRELATION:
            mean = start
        weight = float(FAST_MEAN)
        if start < mean - gain:
            weight = float(SLOW_MEAN)
            most = start + gain
            for symmetry in range(1, symmetries.count[targets.model[instance]]):
                value = correlation_of(correlation, first + symmetry)
                if value > most:
                    most = value
                    best = first + symmetry
        mean_inout[instance] = mean + weight * (start - mean)
    pose_out[2 * instance] = pose[first]
    pose_out[2 * instance + 1] = pose[best]


@wp.kernel
def choose_poses_kernel(
    # In:
    pose: wp.array[wp.transform],  # (pose) [m]
    cost: wp.array[float],  # (pose)
    hypotheses: int,
    loyalty: float,
    # Out:
    pose_out: wp.array[wp.transform],  # (instance) [m]
    cost_out: wp.array[float],  # (instance)
):
    """Pose and cost of the hypothesis of least cost; another than the first must be better by the factor 1 - `loyalty`.

    Launched over instance.
    """
    instance = wp.tid()
    first = instance * hypotheses
    best = first
    least = cost[first] * (1.0 - loyalty)
    for k in range(1, hypotheses):
        if cost[first + k] < least:
            least = cost[first + k]
            best = first + k
    pose_out[instance] = pose[best]
    cost_out[instance] = cost[best]


@wp.kernel
def update_tracks_kernel(
    # Scene:
    policy: TrackPolicy,
    # In:
    observation: Observation,
    pose: wp.array[wp.transform],  # (instance) [m]
    cost: wp.array[float],  # (instance)
    start: wp.array[wp.transform],  # (instance) [m]
    starting: wp.array[int],  # (instance)
    # Out:
    track_out: Track,
):
    """Accept new estimates into tracks; tracks that start are reset to their start pose.

    An instance keeps its pose, at rest, if it shows too few points, or if its estimate costs much more than the running mean: then its mask
    probably shows another instance. After `TrackPolicy.patience` such frames the estimate is accepted nevertheless. Launched over instance.
    """
    instance = wp.tid()
    if starting[instance] != 0:
        track_out.pose[instance] = start[instance]
        track_out.before[instance] = start[instance]
        track_out.centroid[instance] = observation.centroid[instance]
        track_out.correlation[instance] = NO_CORRELATION
        track_out.frames[instance] = 1
        track_out.cost[instance] = policy.first_cost
        track_out.held[instance] = 0
        return
    if track_out.frames[instance] == 0:
        return
    track_out.before[instance] = track_out.pose[instance]
    mean = track_out.cost[instance]
    held = track_out.held[instance]
    surprising = cost[instance] > mean + policy.surprise
    if observation.points[instance] < policy.min_points or (surprising and held < policy.patience):
        track_out.held[instance] = held + 1
        return
    # Motion over several frames is not the velocity of one.
    if held > 0:
        track_out.before[instance] = pose[instance]
    if surprising:
        mean = cost[instance]
    track_out.held[instance] = 0
    track_out.pose[instance] = pose[instance]
    track_out.centroid[instance] = observation.centroid[instance]
    track_out.frames[instance] = track_out.frames[instance] + 1
    track_out.cost[instance] = mean + COST_MEAN * (cost[instance] - mean)
