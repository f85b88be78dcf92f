"""Task that commits an episode: its videos and its part. It runs in writer processes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path

import msgspec
import numpy as np

from synpick_warp.configs.cell.rig import Size
from synpick_warp.exporters.lerobot.layout import part_path, video_path
from synpick_warp.exporters.lerobot.part import TICK, LerobotPart, describe_tasks, make_rows
from synpick_warp.exporters.lerobot.video import GROUP, join_groups
from synpick_warp.exporters.writing.files import sync_file, sync_folder, write_synced


@dataclass(frozen=True)
class LerobotSettings:
    """Settings common to all episodes: data set, cameras, image sizes [px], frame rate [1/s], object names by obj_id."""

    out: Path
    """The data set."""
    cameras: tuple[str, ...]
    """Their names."""
    sizes: tuple[Size, ...]
    """Width and height of each camera's images [px]."""
    rate: Fraction
    """Frames per second."""
    objects: Mapping[int, str]
    """obj_id -> name."""
    noun: str = "tote"
    """What the objects are in, or on."""


@dataclass(frozen=True)
class LerobotContent:
    """Content of an episode besides its videos: mode, ending, objects picked, rows of `TICK`, lines of attempts.jsonl."""

    episode: int
    mode: str
    ending: str
    picked: int
    ticks: bytes
    """Rows of `TICK`."""
    attempts: tuple[str, ...]
    """Lines of attempts.jsonl."""


def group_path(folder: Path, camera: int, group: int) -> Path:
    """Encoded group of a camera's frames, in the episode's staging folder."""
    return folder / f"{camera}-{group:06d}"


def frame_path(folder: Path, camera: int, frame: int) -> Path:
    """Spooled frame, in the episode's staging folder."""
    return folder / f"{camera}-{frame:06d}.frame"


def commit_episode(folder: Path, content: LerobotContent, settings: LerobotSettings) -> None:
    """Task: join the videos of an episode and rename part and videos to their places, the part first: by it a resumed bake finds them."""
    ticks = np.frombuffer(content.ticks, TICK)
    groups = range(-(-len(ticks) // GROUP))
    videos, levels = [], []
    for camera, (name, size) in enumerate(zip(settings.cameras, settings.sizes, strict=True)):
        video = folder / f"{camera}.mp4"
        levels.append(join_groups([group_path(folder, camera, group) for group in groups], size, settings.rate, video).tolist())
        sync_file(video)
        videos.append((video, settings.out / video_path(name, content.episode)))
    attempts = [json.loads(line) for line in content.attempts]
    sentences, tasks = describe_tasks(content.mode, len(ticks), attempts, settings.objects, settings.noun)
    rows = make_rows(ticks, attempts, sentences, tasks)
    part = LerobotPart(len(ticks), content.mode, content.ending, len(attempts), content.picked, sentences, rows.tobytes(), levels)
    write_synced(folder / "part", msgspec.json.encode(part))
    for source, place in ((folder / "part", settings.out / part_path(content.episode)), *videos):
        make_folders(settings.out, place.parent)
        source.rename(place)
        sync_folder(place.parent)


def make_folders(out: Path, folder: Path) -> None:
    """Create a folder below the data set, which must exist, and those between."""
    for parent in reversed([folder, *folder.parents][: len(folder.relative_to(out).parts)]):
        parent.mkdir(exist_ok=True)
