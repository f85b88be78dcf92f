"""Task that commits an episode, its videos and its part: what the episode alone determines of its table (states, actions, task sentences,
outcomes), as a JSON file. It runs in writer processes.

LeRobot numbers frames and episodes over the whole data set, so the tables are written when the bake ends, from the parts of all episodes.
"""

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from synpick_warp.codes import Ending, Mode, Outcome
from synpick_warp.configs.dataset import ExportSettings
from synpick_warp.exporters.lerobot.layout import ROW, part_path, video_path, video_rate
from synpick_warp.exporters.lerobot.video import GROUP, LEVELS, join_groups
from synpick_warp.exporters.writing.files import sync_file, sync_folder, write_synced
from synpick_warp.views.frames import EpisodeEnd

_Count = Annotated[int, msgspec.Meta(ge=0, lt=2**62)]
_Levels = Annotated[list[_Count], msgspec.Meta(min_length=LEVELS, max_length=LEVELS)]
_CATALOG_NUMBER = re.compile(r"^[0-9]+[_ -]+")
"""Number before an object's name, as in YCB's 003_cracker_box."""

TICK = np.dtype([("pose", "<f4", 7), ("setpoint", "<f4", 3), ("suction", "?"), ("attached", "?")])
"""A frame as it comes from the simulation: cup to world, setpoint of the steps that led to it (NaN: none), suction, load."""


class LerobotPart(msgspec.Struct):
    """Schema of an episode's part: its frames, mode, ending, attempts and sentences, until the tables over all episodes are written."""

    frames: Annotated[int, msgspec.Meta(ge=1, lt=2**31)]
    mode: str
    ending: str
    attempts: _Count
    picked: _Count
    sentences: Annotated[list[str], msgspec.Meta(min_length=1)]
    """Tasks of the episode's frames."""
    rows: bytes
    """Rows of `ROW`."""
    levels: list[Annotated[list[_Levels], msgspec.Meta(min_length=3, max_length=3)]]
    """Histogram of each camera's colour channels."""

    def __post_init__(self) -> None:
        if len(self.rows) != self.frames * ROW.itemsize:
            raise ValueError(f"its rows have {len(self.rows)} bytes, but {self.frames} frames have {self.frames * ROW.itemsize}")
        rows = np.frombuffer(self.rows, ROW)
        if not all(np.isfinite(rows[name]).all() for name in ("state", "action", "reward")):
            raise ValueError("a state, action or reward is not a finite number")
        tasks = rows["task"]
        if tasks.min() < 0 or tasks.max() >= len(self.sentences):
            raise ValueError("a frame has a task without sentence")


def make_rows(ticks: np.ndarray, attempts: Sequence[Mapping[str, Any]], tasks: np.ndarray) -> np.ndarray:
    """Build the rows (frame) of `ROW` of an episode from its frames of `TICK`, attempts, and index of each frame's sentence.

    The action of a frame is the command of the tick that leads to the next one; the last frame repeats its own.
    """
    count = len(ticks)
    rows = np.zeros(count, ROW)
    rows["state"] = np.column_stack((ticks["pose"], ticks["suction"], ticks["attached"]))
    following = np.minimum(np.arange(count) + 1, count - 1)
    setpoint = np.where(np.isnan(ticks["setpoint"]), ticks["pose"][:, :3], ticks["setpoint"])[following]
    rows["action"] = np.column_stack((setpoint, ticks["suction"][following]))
    rows["attempt"], rows["task"] = -1, tasks
    for index, attempt in enumerate(attempts):
        outcome = Outcome[attempt["outcome"].upper()]
        first, last = attempt["frame"], attempt["end_frame"]
        rows["attempt"][first:last], rows["outcome"][first:last] = index, outcome
        if outcome.succeeded and 0 < last <= count:
            rows["reward"][last - 1], rows["success"][last - 1] = 1.0, True
    return rows


def describe_tasks(
    mode: str, frames: int, attempts: Iterable[Mapping[str, Any]], objects: Mapping[int, str], noun: str = "tote"
) -> tuple[list[str], np.ndarray]:
    """The task of each frame in words: that of the running attempt, or else of the next one, of the last one, or of the episode.

    `objects` are names by obj_id, `noun` is what they are in, or on: tote, bin, table or pallet. Returns sentences in order of appearance,
    and the index of each frame's (frame) int32.
    """
    there = ("on", "off") if noun in ("table", "pallet") else ("in", "out of")
    general = f"stir the objects {there[0]} the {noun}" if mode == Mode.MOVE.name.lower() else f"pick all objects {there[1]} the {noun}"
    verb = "dig" if mode == Mode.TARGET.name.lower() else "pick"
    of_frame = np.full(frames, general, object)
    begin = 0
    for attempt in attempts:
        if attempt["object_id"] is not None:
            name = objects.get(attempt["object_id"], f"object {attempt['object_id']}")
            of_frame[begin : attempt["end_frame"]] = f"{verb} the {speak(name)} {there[1]} the {noun}"
        begin = attempt["end_frame"]
    # The frame in which the last attempt was judged belongs to no attempt.
    if 0 < begin < frames:
        of_frame[begin:] = of_frame[begin - 1]
    sentences = list(dict.fromkeys(of_frame.tolist()))
    return sentences, np.array([sentences.index(sentence) for sentence in of_frame], np.int32)


def speak(name: str) -> str:
    """An object's name in words: 003_cracker_box is a cracker box."""
    return " ".join(_CATALOG_NUMBER.sub("", name).replace("_", " ").split()) or name


def group_path(folder: Path, camera: int, group: int) -> Path:
    """Encoded group of a camera's frames, in the episode's staging folder."""
    return folder / f"{camera}-{group:06d}"


def frame_path(folder: Path, camera: int, frame: int) -> Path:
    """Spooled frame, in the episode's staging folder."""
    return folder / f"{camera}-{frame:06d}.frame"


def commit_episode(folder: Path, end: EpisodeEnd, rows: bytes, objects: Mapping[int, str], out: Path, settings: ExportSettings) -> None:
    """Task: join the videos of an episode and rename part and videos to their places, the part first: by it a resumed bake finds them.

    `rows` are of `TICK`, `objects` names by obj_id.
    """
    ticks, rate = np.frombuffer(rows, TICK), video_rate(settings.physics)
    groups = range(-(-len(ticks) // GROUP))
    videos, levels = [], []
    for camera, (name, size) in enumerate(zip(settings.rig.names, settings.rig.sizes, strict=True)):
        video = folder / f"{camera}.mp4"
        levels.append(join_groups([group_path(folder, camera, group) for group in groups], size, rate, video).tolist())
        sync_file(video)
        videos.append((video, out / video_path(name, end.episode)))
    attempts, mode = [json.loads(line) for line in end.attempts], str(end.row.get("mode", ""))
    sentences, tasks = describe_tasks(mode, len(ticks), attempts, objects, settings.bins[0].noun)
    ending, picked = Ending(end.ending).name.lower(), int(end.row.get("picked", 0))
    data = make_rows(ticks, attempts, tasks).tobytes()
    part = LerobotPart(len(ticks), mode, ending, len(attempts), picked, sentences, data, levels)
    write_synced(folder / "part", msgspec.json.encode(part))
    for source, place in ((folder / "part", out / part_path(end.episode)), *videos):
        make_folders(out, place.parent)
        source.rename(place)
        sync_folder(place.parent)


def make_folders(out: Path, folder: Path) -> None:
    """Create a folder below the data set, which must exist, and those between."""
    for parent in reversed([folder, *folder.parents][: len(folder.relative_to(out).parts)]):
        parent.mkdir(exist_ok=True)
