"""Pictures for a page: sampled frames with colour, visible and amodal masks as ids, boxes, depth and layers; and film strips, one episode a
mode, evenly spread frames in up to three cameras, with its attempts on the time axis.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from synpick_warp.apps.report.album import Album, EncodedPicture, Section, encode_ids, encode_photo, shrink
from synpick_warp.apps.report.sampling import Content, SampledEpisodes, spread
from synpick_warp.apps.statistics.columns import MAX_NAME
from synpick_warp.apps.viz.drawing import instance_color
from synpick_warp.apps.viz.false_colors import DepthScale, color_depth, describe_depth, draw_layer, pooled_scale
from synpick_warp.codes import Outcome
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.dataset.view import MILLIMETERS, View

WIDTH = 960
"""Largest width of a frame on the page [px]."""
MAX_IDS = 255
"""Most instances whose masks are shown: ids are bytes, and 0 is none."""
LAYER_WIDTH = 640
"""Largest width of depth and of layers [px]."""
MAX_STRIPS = 4
"""Most episodes."""
MAX_FRAMES = 72
"""Maximum number of frames of an episode, one a step of the slider."""
MAX_CAMERAS = 3
STRIP_WIDTH = 420
"""Largest width of a picture of a film strip [px]: three stand side by side."""
STRIP_QUALITY = 74
"""WebP quality: pictures in motion."""
_PROBES = 3
"""Frames that are encoded first, to learn how many fit the budget."""
_MARGIN = 1.15
"""Factor by which other frames may be larger than the probes."""


def make_frame(
    view: View, content: Content, names: Mapping[int, str], mode: str, album: Album, scale: DepthScale | None
) -> dict[str, Any] | None:
    """JSON of a frame, whose pictures are added to the album; None: they exceed the budget.

    Args:
        view: The view.
        content: What the data set has of it.
        names: Object id -> name; it may lack some.
        mode: Mode of the episode.
        album: Receives the pictures.
        scale: Of the depth images of its scene; None: that of the image itself.

    Raises:
        DatasetError: A file is missing or damaged.
    """
    color = show(view, scale)
    panels: list[tuple[str, str, EncodedPicture]] = [("rgb", "colour", encode_photo(shrink(color, WIDTH)))]
    ids = _instance_ids(view, content, color.shape[:2])
    if ids is not None:
        panels.append(("ids", "visible masks", encode_ids(shrink(ids, WIDTH, smooth=False))))
        if content.amodal:
            planes = [shrink(plane, WIDTH, smooth=False) for plane in _amodal_planes(view, color.shape[:2])]
            panels.append(("amodal", "amodal masks", encode_ids(np.concatenate(planes))))
    if content.depth:
        depth = view.depth * MILLIMETERS
        scale = scale or pooled_scale([depth])
        panels.append(("depth", describe_depth(scale), encode_photo(shrink(color_depth(depth, scale), LAYER_WIDTH))))
    counts = scale and DepthScale(*(each / float(view.records.camera["depth_scale"]) for each in scale))
    for name in view.layers:
        caption, picture = draw_layer(name, view.layer(name), counts)
        panels.append((name, caption, encode_photo(shrink(picture, LAYER_WIDTH))))
    places = album.add(Section.FRAMES, [picture for _, _, picture in panels])
    if places is None:
        return None
    pictures = {name: {"picture": place, "caption": caption} for (name, caption, _), place in zip(panels, places, strict=True)}
    return {
        "episode": view.episode,
        "frame": view.frame,
        "camera": view.camera,
        "mode": mode,
        "size": [color.shape[1], color.shape[0]],
        "light": _light(view),
        "pictures": pictures,
        "instances": [_instance(view, index, names) for index in range(len(view))],
    }


def show(view: View, scale: DepthScale | None = None) -> np.ndarray:
    """Picture of a view (H, W, 3) uint8, blue first: its colour image, or else depth as false colour."""
    if view.has("rgb") or not view.has("depth"):
        return view.rgb[..., ::-1]
    depth = view.depth * MILLIMETERS
    return color_depth(depth, scale or pooled_scale([depth]))


def _instance(view: View, index: int, names: Mapping[int, str]) -> dict[str, Any]:
    """An instance: the masks have the id index + 1. Boxes: x, y, width, height [px]; None: nothing is visible."""
    truth, info = view.records.gt[index], view.records.gt_info[index]
    seen = info["px_count_visib"] > 0
    object_id = int(truth["obj_id"])
    blue, green, red = instance_color(int(truth.get("instance_id", index)) % 256)
    return {
        "name": names.get(object_id, "") or f"object {object_id}",
        "object": object_id,
        "visible": None if np.isnan(info["visib_fract"]) else round(float(info["visib_fract"]), 4),
        "color": f"rgb({red} {green} {blue})",
        "amodal": _box(info["bbox_obj"]) if seen and info["bbox_obj"][2] >= 0 else None,
        "modal": _box(info["bbox_visib"]) if seen else None,
    }


def _box(box: list[int]) -> list[int]:
    """Convert a BOP box (x, y, width, height) [px], whose width is x_max - x_min, to one whose width and height count the last pixel."""
    x, y, width, height = box
    return [x, y, width + 1, height + 1]


def _instance_ids(view: View, content: Content, size: tuple[int, ...]) -> np.ndarray | None:
    """Index + 1 of the instance that each pixel shows (H, W) uint8; 0: none. None: the data set has no masks."""
    if not content.masks:
        return None
    ids = np.zeros(size, np.uint8)
    for index, mask in enumerate(view.masks[:MAX_IDS]):
        ids[mask] = index + 1
    return ids


def _amodal_planes(view: View, size: tuple[int, ...]) -> list[np.ndarray]:
    """Index + 1 of the instance whose silhouette covers each pixel (H, W) uint8; 0: none.

    Silhouettes overlap, so there are planes: each instance is in the first one where it overlaps no other (greedy colouring).
    """
    planes = [np.zeros(size, np.uint8)]
    for index, mask in enumerate(view.amodal_masks[:MAX_IDS]):
        plane = next((plane for plane in planes if not plane[mask].any()), None)
        if plane is None:
            planes.append(plane := np.zeros(size, np.uint8))
        plane[mask] = index + 1
    return planes


def _light(view: View) -> str:
    """Name of the view's environment map, cut to MAX_NAME; empty: not recorded."""
    light = view.records.camera.get("light")
    name = light.get("map") if isinstance(light, dict) else None
    return name[:MAX_NAME] if isinstance(name, str) else ""


# ---- film strips ----


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
                shrink(show(episode.view(frame - frame % episode.frames(camera).step, camera)), STRIP_WIDTH), STRIP_QUALITY
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
