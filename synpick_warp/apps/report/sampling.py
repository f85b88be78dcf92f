"""Deterministic, stratified sampling of a data set's episodes, views and frames."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from synpick_warp.apps.statistics.collect import read_facts
from synpick_warp.apps.statistics.columns import EpisodeFacts
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view import View
from synpick_warp.scenes.environment import LUMINANCE
from synpick_warp.system.random_numbers import r2_points

MAX_EPISODES = 2000
"""Maximum number of episodes whose manifest entry is read; larger data sets are sampled at equal steps."""
SURVEY_VIEWS = 48
"""Number of views whose brightness is measured."""
_WEIGHTS = LUMINANCE.astype(np.float32)
"""Luma weights of red, green and blue (Rec. 709)."""


@dataclass(frozen=True)
class SampledEpisodes:
    """Episodes of which the report tells more than counts."""

    rows: dict[int, EpisodeFacts]
    """Manifest row by index of the episode."""
    attempts: dict[int, int]
    """Number of attempts by index of the episode."""
    total: int
    """Episodes of the data set."""


@dataclass(frozen=True)
class Brightness:
    """Mean luma of one view."""

    episode: int
    camera: int
    frame: int
    mean: float
    """From 0 to 1, of the sRGB values."""


@dataclass(frozen=True)
class Content:
    """Whether a data set has visible masks, amodal masks and depth beside colour."""

    masks: bool
    amodal: bool
    depth: bool


def find_content(view: View) -> Content:
    """Look whether a view's scene has masks of both kinds and depth with its scale."""
    return Content(view.has("mask_visib"), view.has("mask"), view.has("depth") and "depth_scale" in view.records.camera)


def spread(items: Sequence[int], count: int) -> list[int]:
    """At most `count` of the items, evenly spread, the first and the last among them if there are two or more."""
    if len(items) <= count:
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[index * (len(items) - 1) // (count - 1)] for index in range(count)]


def read_episodes(data_set: DataSet) -> SampledEpisodes:
    """Read the rows of at most MAX_EPISODES episodes.

    Raises:
        DatasetError: A manifest entry is damaged.
    """
    indices = list(data_set)
    rows, attempts = {}, {}
    for index in spread(indices, MAX_EPISODES):
        rows[index] = read_facts(data_set, index)
        attempts[index] = len(data_set[index].attempts)
    return SampledEpisodes(rows, attempts, len(indices))


def sample_views(data_set: DataSet, episodes: SampledEpisodes, count: int) -> list[View]:
    """Sample distinct views, sorted: episodes at equal steps, times at equal steps, and cameras in equal numbers.

    The times of an episode are the middles of as many equal parts as it has views; where it has one, the times of all of them are, in an
    order of low discrepancy (R2). Fewer than `count` views are returned if the chosen episodes have fewer.
    """
    indices = [index for index, row in episodes.rows.items() if row.frames]
    cameras, keys = data_set.camera_count, set()
    number = np.arange(count if indices else 0)
    points = _middles(r2_points(number, start=0.5))
    chosen = number * len(indices) // max(1, count)
    for each in np.flatnonzero(np.bincount(chosen) > 1):
        points[chosen == each] = _middles(points[chosen == each])
    for each, (time, place) in zip(chosen.tolist(), points.tolist(), strict=True):
        index = indices[each]
        frames = episodes.rows[index].frames
        first = int(time * frames) * cameras + int(place * cameras)
        views = (divmod((first + step) % (frames * cameras), cameras) for step in range(min(count, frames * cameras)))
        # Of a camera without a picture of the frame, the one before.
        views = ((frame - frame % data_set[index].frames(camera).step, camera) for frame, camera in views)
        keys.update(next(([(index, *view)] for view in views if (index, *view) not in keys), []))
    return [data_set[index].view(frame, camera) for index, frame, camera in sorted(keys)]


def _middles(points: np.ndarray) -> np.ndarray:
    """Points (N, 2) moved to the middles of N equal parts of each axis, in their order along it."""
    return (np.argsort(np.argsort(points, axis=0), axis=0) + 0.5) / max(1, len(points))


def measure_brightness(view: View) -> Brightness:
    """Mean luma of a view; every fourth row and column is read."""
    mean = float((view.rgb[::4, ::4] @ _WEIGHTS).mean()) / 255.0
    return Brightness(view.episode, view.camera, view.frame, mean)
