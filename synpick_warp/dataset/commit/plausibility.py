"""Plausibility of a data set's own records: names in checksum lists, and numbers of frames.

A list in a folder that somebody else made could name `.git/hooks/post-checkout` or `Makefile`; files are copied by lists, so a list is
compared with the names in FORMAT_TABLE first: only those that its formats write. They follow from the settings alone.

A record states how many frames an episode has, and may be edited or damaged; arrays, loops and tasks follow from the number. So it is
compared with the sizes of the files that are there before anything is made of it.
"""

import functools
import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.dataset.annotations import ADVICE
from synpick_warp.dataset.commit.manifest import CONSTANTS, MAX_SHOWN, entry_advice
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.formats import find_format, format_names, part_files
from synpick_warp.exporters.trajectory.arrays import EPISODES, STORE
from synpick_warp.system.inputs.files import describe_bytes

_HARMLESS = 1000
"""Number of frames up to which nothing is compared: reading finds what is missing, and says so better."""
_CAMERA, _MEMBERS = 40, 5 * 1024
"""Least bytes that a frame takes in scene_camera.json ("0": {"cam_K": nine numbers}), and in a shard (five members with headers)."""
_TIME = 0.125
"""The same of the times in a trajectory: zstd's highest level makes one byte of five of these float64."""


@functools.lru_cache(maxsize=4)
def _pattern(layout: DataLayout, entry: Path) -> re.Pattern[str]:
    """Regular expression of the file names that the formats write in an entry: of an episode, or the constants."""
    formats = [find_format(name) for name in dict.fromkeys(layout.formats)]
    names = (row.constants if entry == CONSTANTS else row.episode(layout, int(entry.name)) for row in formats)
    return re.compile("|".join(dict.fromkeys(names)))


def check_file_names(folder: Path, entry: Path, names: Iterable[str], layout: DataLayout) -> None:
    """Raise DatasetError unless a checksum list, of the constants or an episode, names only files that the formats of a data set write."""
    matches = _pattern(layout, entry).fullmatch
    foreign = next((name for name in names if not matches(name)), None)
    if foreign is not None:
        raise DatasetError(
            f'{folder / entry}.sha256 names "{foreign[:MAX_SHOWN]}", which none of its formats writes; {entry_advice(entry)}'
        )


def describe_strays(folder: Path, layout: DataLayout, episodes: Iterable[int]) -> str:
    """Name, in a sentence, what lies beside the parts that indices are joined from and belongs to no committed episode; empty: nothing."""
    strays = []
    known = set(episodes)
    for name in (name for name in format_names() if name in layout.formats):
        part = find_format(name).part
        if part is not None and part.joined and (folder / part.folder).is_dir():
            count = layout.cameras if part.per_scene else 1
            parts = {f"{number:06d}{part.suffix}" for episode in known for number in range(count * episode, count * (episode + 1))}
            strays += sorted(f"{part.folder}/{entry.name}" for entry in os.scandir(folder / part.folder) if entry.name not in parts)
    if not strays:
        return ""
    more = f" and {len(strays) - 1} more" if len(strays) > 1 else ""
    return f"left out: {folder}/{ascii(strays[0])[1:-1][:MAX_SHOWN]}{more}, of no committed episode"


def check_frames(folder: Path, layout: DataLayout | None, episode: int, frames: int) -> None:
    """Compare the number of frames that an episode's record states, if it is above _HARMLESS, with the sizes of its files in every format;
    raises DatasetError if one is too small. `layout` None: the data set has no settings, as a lone trajectory store."""
    for path, size, least in _sizes(folder, layout, episode) if frames > _HARMLESS else ():
        if size / least < frames:
            raise DatasetError(
                f"the record of episode {episode} in {folder} counts {frames:,} frames, but {path.relative_to(folder)} has"
                f" {describe_bytes(size)}, too little for them; {ADVICE}"
            )


def check_listed_frames(folder: Path, layout: DataLayout, row: Mapping[str, Any], names: Mapping[str, str]) -> None:
    """Compare an episode's row with the images that its checksum list names. Raises DatasetError if it counts more or fewer."""
    episode, frames = row["episode"], row["frames"]
    scene, suffix = layout.scene(episode, 0)
    for place in (f"{layout.folder(episode)}/{scene:06d}/rgb{suffix}/", f"coco/images/{scene:06d}/"):
        count = sum(name.startswith(place) for name in names)
        if count and count != len(layout.frames(0, frames)):
            raise DatasetError(f"the record of episode {episode} in {folder} counts {frames:,} frames, but {place} has {count:,}; {ADVICE}")


def _sizes(folder: Path, layout: DataLayout | None, episode: int) -> Iterator[tuple[Path, int, float]]:
    """File or folder that holds something of every frame, its size, and the least size of a frame [bytes]; only what is there."""
    name = f"{episode:06d}"
    times = folder / STORE / EPISODES / name / "ticks" / "time"
    if times.is_dir():
        yield times, sum(_size(path) for path in times.iterdir() if path.name.startswith("c")), _TIME
    parts = part_files(None if layout is None else layout.cameras)
    places: list[tuple[Path, float]] = [(folder / part.file(episode), part.frame_bytes) for part in parts if part.frame_bytes]
    if layout is not None:
        cameras, (scene, sensor) = layout.cameras, layout.scene(episode, 0)
        split = folder / layout.folder(episode)
        places.append((split / f"{scene:06d}" / f"scene_camera{sensor}.json", _CAMERA / layout.every[0]))
        first = split.with_name(f"{split.name}_web") / f"shard-{cameras * episode:06d}.tar"
        if first.is_file():
            shards = first.parent.glob(f"shard-*{cameras * episode:06d}.tar")
            yield first, sum(map(_size, shards)), _MEMBERS / layout.every[0]
    yield from ((path, _size(path), least) for path, least in places if path.is_file())


def _size(path: Path) -> int:
    """Size of a file [bytes]; 0: it cannot be looked at."""
    try:
        return path.stat().st_size
    except OSError:
        return 0
