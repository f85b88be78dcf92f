"""Pictures for a page, encoded, and held within a budget of bytes, of episodes, views and frames in a deterministic, stratified sample.

Sampled frames have colour, visible and amodal masks as ids, boxes, depth and layers; film strips, one episode a mode, evenly spread frames
in up to three cameras, with the episode's attempts on the time axis.
"""

import base64
import enum
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import cv2
import numpy as np

from synpick_warp.apps.statistics.columns import MAX_NAME, EpisodeFacts
from synpick_warp.apps.statistics.compute import read_facts
from synpick_warp.apps.viz.drawing import DepthScale, color_depth, describe_depth, draw_layer, instance_color, pooled_scale
from synpick_warp.codes import Outcome
from synpick_warp.dataset.reading import DataSet, Episode
from synpick_warp.dataset.view import MILLIMETERS, View
from synpick_warp.errors import OutputError
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


def spread(items: Sequence[int], count: int) -> list[int]:
    """At most `count` of the items, evenly spread, the first and the last among them if there are two or more."""
    if len(items) <= count:
        return list(items)
    if count == 1:
        return [items[len(items) // 2]]
    return [items[index * (len(items) - 1) // (count - 1)] for index in range(count)]


def read_episodes(data_set: DataSet) -> SampledEpisodes:
    """Read the rows of at most MAX_EPISODES episodes; raises DatasetError if a manifest entry is damaged."""
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


BUDGET = 25_000_000
"""Most bytes of all pictures of a page, as they stand in it, in Base64."""
PHOTO_QUALITY = 82
"""WebP quality of colour images and false colours."""


class Section(enum.Enum):
    """Part of a page; its value is its share of the budget."""

    FRAMES = 0.45
    EPISODES = 0.40
    ATTEMPTS = 0.15


class EncodedPicture(NamedTuple):
    """Encoded image of a report."""

    kind: str
    """webp or png."""
    text: str
    """The file in Base64."""


@dataclass
class Album:
    """Encoded pictures of a page in the order in which they were added, within a budget of bytes."""

    budget: int = BUDGET
    pictures: list[EncodedPicture] = field(default_factory=list)
    spent: Counter[Section] = field(default_factory=Counter)
    """Bytes of each section."""

    def left(self, section: Section) -> int:
        """Bytes that a section may still add to the album's budget."""
        return int(section.value * self.budget) - self.spent[section]

    def add(self, section: Section, pictures: Sequence[EncodedPicture]) -> list[int] | None:
        """Add pictures that belong together; returns their indices, or None, and adds none, if the section's share is too small."""
        size = sum(len(picture.text) for picture in pictures)
        if size > self.left(section):
            return None
        self.spent[section] += size
        first = len(self.pictures)
        self.pictures += pictures
        return list(range(first, len(self.pictures)))


def shrink(image: np.ndarray, width: int, *, smooth: bool = True) -> np.ndarray:
    """Scale an image down to at most that width [px]; nearest neighbour unless `smooth`, as ids and masks need it."""
    if image.shape[1] <= width:
        return image
    size = width, max(1, round(image.shape[0] * width / image.shape[1]))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA if smooth else cv2.INTER_NEAREST)


def encode_photo(image: np.ndarray, quality: int = PHOTO_QUALITY) -> EncodedPicture:
    """Encode an image (H, W, 3) uint8, blue first, as WebP."""
    return _encode("webp", image, [cv2.IMWRITE_WEBP_QUALITY, quality])


def encode_ids(image: np.ndarray) -> EncodedPicture:
    """Encode an id image (H, W) uint8 as a lossless PNG."""
    return _encode("png", image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def _encode(kind: str, image: np.ndarray, options: list[int]) -> EncodedPicture:
    """Encode an image by OpenCV; raises OutputError if it cannot."""
    try:
        encoded, data = cv2.imencode(f".{kind}", image, options)
    except cv2.error:
        encoded, data = False, np.empty(0, np.uint8)
    if not encoded:
        raise OutputError(f"OpenCV cannot encode {image.shape[1]} x {image.shape[0]} pixels as .{kind}; use another build of OpenCV")
    return EncodedPicture(kind, base64.b64encode(data.tobytes()).decode("ascii"))


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
SUCCESSES = {outcome.name.lower() for outcome in Outcome if outcome.succeeded}
"""Names of the outcomes of attempts that picked."""
_PROBES = 3
"""Frames that are encoded first, to learn how many fit the budget."""
_MARGIN = 1.15
"""Factor by which other frames may be larger than the probes."""


def make_frame(view: View, names: Mapping[int, str], mode: str, album: Album, scale: DepthScale | None) -> dict[str, Any] | None:
    """JSON of a frame, whose pictures are added to the album; None: they exceed the budget.

    `names` by obj_id may lack some, `mode` is that of the episode, and `scale` that of the depth images of its scene, None: that of the
    image itself. Raises DatasetError if a file is missing or damaged.
    """
    color = show(view, scale)
    panels: list[tuple[str, str, EncodedPicture]] = [("rgb", "colour", encode_photo(shrink(color, WIDTH)))]
    if view.has("mask_visib"):
        ids = np.zeros(color.shape[:2], np.uint8)
        for index, mask in enumerate(view.masks[:MAX_IDS]):
            ids[mask] = index + 1
        panels.append(("ids", "visible masks", encode_ids(shrink(ids, WIDTH, smooth=False))))
        if view.has("mask"):
            planes = [shrink(plane, WIDTH, smooth=False) for plane in _amodal_planes(view, color.shape[:2])]
            panels.append(("amodal", "amodal masks", encode_ids(np.concatenate(planes))))
    if view.has("depth") and "depth_scale" in view.records.camera:
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
    light = view.records.camera.get("light")
    pictures = {name: {"picture": place, "caption": caption} for (name, caption, _), place in zip(panels, places, strict=True)}
    return {
        "episode": view.episode,
        "frame": view.frame,
        "camera": view.camera,
        "mode": mode,
        "size": [color.shape[1], color.shape[0]],
        "light": light["map"][:MAX_NAME] if isinstance(light, dict) and isinstance(light.get("map"), str) else "",
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
    return {
        "name": names.get(object_id, "") or f"object {object_id}",
        "object": object_id,
        "visible": None if np.isnan(info["visib_fract"]) else round(float(info["visib_fract"]), 4),
        "color": css_color(int(truth.get("instance_id", index))),
        "amodal": _box(info["bbox_obj"]) if seen and info["bbox_obj"][2] >= 0 else None,
        "modal": _box(info["bbox_visib"]) if seen else None,
    }


def css_color(instance: int) -> str:
    """CSS colour of an instance, as in preview pictures."""
    blue, green, red = instance_color(instance % 256)
    return f"rgb({red} {green} {blue})"


def _box(box: list[int]) -> list[int]:
    """Convert a BOP box (x, y, width, height) [px], whose width is x_max - x_min, to one whose width and height count the last pixel."""
    x, y, width, height = box
    return [x, y, width + 1, height + 1]


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
    """JSON of an episode's film strip, whose pictures are added to the album; None: not even two frames fit its budget.

    `strips` are still to share the budget, this one included; `report` receives the number of pictures that were encoded, and how many
    there are at most. Raises DatasetError if a file is missing or damaged.
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
    probes = [sum(len(encode(frame, camera).text) for camera in cameras) for frame in spread(every, _PROBES)]
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
    return [
        {
            "attempt": attempt["attempt"],
            "first": attempt["frame"],
            "last": attempt["end_frame"],
            "sentence": attempt["sentence"],
            "success": attempt["outcome"] in SUCCESSES,
        }
        for attempt in episode.attempts
    ]
