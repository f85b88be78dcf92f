"""Film strips for a page: one episode a mode, evenly spread frames in up to three cameras, and its attempts on the time axis."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from synpick_warp.apps.report.album import Album, EncodedPicture, Section, encode_photo, shrink
from synpick_warp.apps.report.frames import show
from synpick_warp.apps.report.sampling import SampledEpisodes, spread
from synpick_warp.codes import Outcome
from synpick_warp.dataset.reading import DataSet, Episode

MAX_STRIPS = 4
"""Most episodes."""
MAX_FRAMES = 72
"""Maximum number of frames of an episode, one a step of the slider."""
MAX_CAMERAS = 3
WIDTH = 420
"""Largest width of a picture [px]: three stand side by side."""
QUALITY = 74
"""WebP quality: pictures in motion."""
_PROBES = 3
"""Frames that are encoded first, to learn how many fit the budget."""
_MARGIN = 1.15
"""Factor by which other frames may be larger than the probes."""


def choose_episodes(episodes: SampledEpisodes) -> list[int]:
    """Choose an episode of median length of each mode, at most MAX_STRIPS; modes in the order of their first episodes."""
    by_mode: dict[str, list[int]] = {}
    for index, row in episodes.rows.items():
        if row.frames:
            by_mode.setdefault(row.mode, []).append(index)
    chosen = [sorted(group, key=lambda index: (episodes.rows[index].frames, index))[len(group) // 2] for group in by_mode.values()]
    return chosen[:MAX_STRIPS]


def make_strip(data_set: DataSet, index: int, strips: int, album: Album, report: Callable[[int, int], None]) -> dict[str, Any] | None:
    """JSON of an episode's film strip, whose pictures are added to the album; None: not even two frames fit the album's budget in bytes.

    Args:
        data_set: The data set.
        index: Index of the episode.
        strips: Number of strips that are still to share the budget, this one included.
        album: Receives the pictures.
        report: Receives the number of pictures that were encoded, and how many there are at most.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    episode = data_set[index]
    cameras = range(min(MAX_CAMERAS, data_set.camera_count))
    cache: dict[tuple[int, int], EncodedPicture] = {}
    most = min(MAX_FRAMES, len(episode)) * len(cameras)

    def encode(frame: int, camera: int) -> EncodedPicture:
        if (frame, camera) not in cache:
            cache[frame, camera] = encode_photo(
                shrink(show(episode.view(frame - frame % episode.frames(camera).step, camera)), WIDTH), QUALITY
            )
            report(len(cache), most)
        return cache[frame, camera]

    every = range(len(episode))
    probes = [sum(encode(frame, camera).size for camera in cameras) for frame in spread(every, _PROBES)]
    fitting = int(album.left(Section.EPISODES) / max(1, strips) / (_MARGIN * max(probes)))
    count = min(MAX_FRAMES, len(episode), fitting)
    if count < min(2, len(episode)):
        return None
    frames = spread(every, count)
    places = album.add(Section.EPISODES, [encode(frame, camera) for camera in cameras for frame in frames])
    if places is None:
        return None
    return {
        "episode": index,
        "mode": episode.row["mode"],
        "sentence": episode.row.get("sentence") or episode.row["ending"],
        "total": len(episode),
        "period": data_set.period or 0.0,
        "frames": frames,
        "cameras": [places[camera * count : (camera + 1) * count] for camera in cameras],
        "attempts": _spans(episode),
    }


def _spans(episode: Episode) -> list[dict[str, Any]]:
    """First and last frame of each attempt, and how it ended."""
    succeeded = {outcome.name.lower() for outcome in Outcome if outcome.succeeded}
    return [
        {
            "attempt": attempt["attempt"],
            "first": attempt["frame"],
            "last": attempt["end_frame"],
            "sentence": attempt["sentence"],
            "success": attempt["outcome"] in succeeded,
        }
        for attempt in episode.attempts
    ]
