"""Tables of simulated picks on the boxes of `box_views`: points, normals and pixels are exact, outcomes are drawn."""

import numpy as np
from scipy.spatial.transform import Rotation

from synpick_warp.codes import Ending, Outcome, Share
from synpick_warp.testing.box_views import OBJECT_IDS, SIZES, batches, cameras
from synpick_warp.views.frames import FrameBatch
from synpick_warp.views.picks import COLUMNS, PickBatch

REPEATS = 2
EACH = 4
"""Candidates of a visible instance."""


def pick_batch(episode: int, frames: tuple[int, ...] = (0, 2), own: bool = True) -> PickBatch:
    """Trials from states at these frames, in descending order of the states: EACH candidates of each visible box, REPEATS times each.

    The first one is the episode's own, if `own` says so; the others are uniform over visible pixels. A pick succeeds by chance, with a
    probability of seal times wrench.
    """
    generator = np.random.default_rng((episode, 0))
    views = {int(batch.frame[0]): batch for batch in batches(1, (episode,), max(frames) + 1, cameras()[:1])}
    tables = [_trials(views[frame], state, generator, own) for state, frame in reversed(list(enumerate(frames)))]
    trials = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    size = views[frames[0]].instance[0].shape
    states = {
        "state": np.arange(len(frames)),
        "frame": np.array(frames),
        "camera": np.zeros(len(frames)),
        "width": np.full(len(frames), size[1]),
        "height": np.full(len(frames), size[0]),
        "candidates": np.array([len(np.unique(trials["candidate"][trials["state"] == state])) for state in range(len(frames))]),
        "visible": np.array([[(views[frame].instance[0] == 1 + index).any() for index in range(len(OBJECT_IDS))] for frame in frames]),
    }
    return PickBatch(episode, trials, states)


def _trials(view: FrameBatch, state: int, generator: np.random.Generator, has_own: bool) -> dict[str, np.ndarray]:
    """Columns of the trials of a state."""
    seen = [index for index in range(len(OBJECT_IDS)) if (view.instance[0] == 1 + index).any()]
    pixels = {index: np.argwhere(view.instance[0] == 1 + index) for index in seen}
    chosen = np.concatenate([generator.choice(pixels[index], EACH, replace=False) for index in seen])
    instance = np.repeat(seen, EACH)
    point, normal = _surface(view, chosen, instance)
    count, trials = len(chosen), len(chosen) * REPEATS
    seal, wrench = generator.random((2, count)).astype(np.float32)
    own = has_own & (np.arange(count) == 0)
    each = {
        "candidate": np.arange(count),
        "share": np.where(own, Share.OWN, Share.UNIFORM),
        "weight": np.where(own, 0.0, np.repeat([len(pixels[index]) / EACH for index in seen], EACH)),
        "row": chosen[:, 0],
        "column": chosen[:, 1],
        "instance": instance,
        "obj_id": OBJECT_IDS[instance],
        "point": point,
        "normal": normal,
        "approach": -normal,
        "yaw": np.zeros(count),
        "tilt": np.zeros(count),
        "seal": seal,
        "wrench": wrench,
    }
    trial = {name: np.repeat(values, REPEATS, axis=0) for name, values in each.items()}
    success = generator.random(trials) < trial["seal"] * trial["wrench"]
    hits = generator.integers(1, 30, trials)
    perturbed = np.arange(trials) % REPEATS
    peak = np.where(success, 2.0, 6.0)
    trial |= {
        "state": np.full(trials, state),
        "frame": np.full(trials, int(view.frame[0])),
        "repeat": perturbed,
        "offset": 1e-3 * generator.uniform(-1, 1, (trials, 3)) * perturbed[:, None],
        "rotation": np.zeros((trials, 3)),
        "friction": np.where(perturbed, 0.9, 1.0),
        "outcome": np.where(success, Outcome.TARGET_PICKED, Outcome.DROPPED),
        "ending": np.full(trials, Ending.RUNNING),
        "success": success,
        "intended": success,
        "hits": hits,
        "sealed": np.ones(trials),
        "picked": np.where(success, trial["instance"], -1),
        "peak_force": peak,
        "margin": 1.0 - peak / 5.0,
        "time_to_break": np.where(success, np.nan, 0.2),
        "held": np.where(success, 0.6, 0.2),
        "moved": np.zeros(trials),
        "farthest": np.zeros(trials),
        "lost": np.zeros(trials),
        "duration": np.full(trials, 1.0),
    }
    return {column.name: trial[column.name] for column in COLUMNS}


def _surface(view: FrameBatch, pixels: np.ndarray, instance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the boxes at the centres of pixels, by their depth, and the normals of the nearest faces."""
    camera = cameras()[0]
    depth = view.depth[0][pixels[:, 0], pixels[:, 1]] * 1e-4
    rays = np.column_stack((pixels[:, ::-1] + 0.5, np.ones(len(pixels)))) @ np.linalg.inv(camera.matrix).T
    point = (depth[:, None] * rays - camera.translation) @ camera.rotation
    rotation = Rotation.from_quat(view.pose[0][instance, 3:])
    inside = rotation.inv().apply(point - view.pose[0][instance, :3])
    half = np.array([SIZES[int(OBJECT_IDS[index])] for index in instance]) / 2
    axis = np.argmax(np.abs(inside) - half, axis=1)
    normal = np.zeros_like(inside)
    normal[np.arange(len(axis)), axis] = np.sign(inside[np.arange(len(axis)), axis])
    return point, rotation.apply(normal)
