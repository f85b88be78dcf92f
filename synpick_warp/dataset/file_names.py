"""Names of a data set's files, as regular expressions for each format: what the checksum lists of constants and episodes may name.

A list in a folder that somebody else made could name `.git/hooks/post-checkout` or `Makefile`; files are copied by lists, so a list is
compared with these names first. They follow from the settings alone.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Iterable
from pathlib import Path

from synpick_warp.configs.schema import Config
from synpick_warp.configs.splits import bop_folder, bop_scene
from synpick_warp.dataset.manifest import CONSTANTS, MAX_SHOWN, entry_advice
from synpick_warp.errors import DatasetError
from synpick_warp.inputs.image_files import TEXTURE_KINDS

_INDEX = r"[0-9]{6,12}"
_PLAIN = r"[^./][^/]*"
"""A part of a path that is not hidden."""
_MODELS = rf"models(?:_eval)?/(?:models_info\.json|obj_{_INDEX}\.ply|(?:{_PLAIN}/)*{_PLAIN}\.(?i:{'|'.join(TEXTURE_KINDS)}))"
"""Models, and textures, whose names come from the models of the user."""
_NOTES = r"camera\.json|dataset_info\.md"
_SCENE_CONSTANTS = rf"{_MODELS}|{_NOTES}|bop_dataset_params\.py"
_ZARR_ARRAY = r"[a-z_]+/(?:zarr\.json|c(?:\.[0-9]+)*)"
_STORE = r"trajectory\.zarr"


def _bop(config: Config, episode: int) -> str:
    scenes = "|".join(dict.fromkeys(f"{bop_scene(config, episode, camera)[0]:06d}" for camera in range(len(config.cameras.positions))))
    image = rf"[a-z_]+(?:_cam[0-9]+)?/{_INDEX}(?:_[0-9]{{6}})?\.(?:png|jpg)"
    return rf"{re.escape(bop_folder(config, episode))}/(?:{scenes})/(?:scene_[a-z_]+(?:_cam[0-9]+)?\.json|{image})"


def _shards(config: Config, episode: int) -> str:
    # Further shards of a scene have its id plus a multiple of a million.
    return rf"{re.escape(bop_folder(config, episode))}_web/shard-[0-9]{{0,12}}(?:{_scenes(config, episode)})\.tar"


def _usd(_: Config, episode: int) -> str:
    return rf"usd/{episode:06d}\.usdc"


def _zarr(_: Config, episode: int) -> str:
    return rf"{_STORE}/episodes/{episode:06d}/(?:zarr\.json|[a-z_]+/(?:zarr\.json|{_ZARR_ARRAY}))"


def _lerobot(_: Config, episode: int) -> str:
    video = rf"chunk-{episode // 1000:03d}/file-{episode % 1000:03d}\.mp4"
    return rf"lerobot/(?:parts/{episode:06d}\.json|videos/observation\.images\.camera_[0-9]+/{video})"


def _coco(config: Config, episode: int) -> str:
    scenes = _scenes(config, episode)
    return rf"coco/(?:parts/(?:{scenes})\.jsonl|images/(?:{scenes})/{_INDEX}\.(?:png|jpg))"


def _scenes(config: Config, episode: int) -> str:
    cameras = len(config.cameras.positions)
    return "|".join(f"{scene:06d}" for scene in range(cameras * episode, cameras * (episode + 1)))


_FORMATS: dict[str, tuple[str, Callable[[Config, int], str]]] = {
    "bop": (_SCENE_CONSTANTS, _bop),
    "shards": (_SCENE_CONSTANTS, _shards),
    "usd": (r"usd/assets/(?:[a-z_0-9]+\.usdc|lights/light_[0-9]{3,6}\.exr|textures/[a-z_0-9]+\.png)", _usd),
    "zarr": (rf"{_STORE}/(?:(?:episodes/)?zarr\.json|(?:objects|cameras)/(?:zarr\.json|{_ZARR_ARRAY}))", _zarr),
    "lerobot": (_NOTES, _lerobot),
    "coco": (rf"coco/categories\.json|{_NOTES}", _coco),
}
"""Format -> names of its constants, and of an episode's files."""


@functools.lru_cache(maxsize=4)
def _pattern(config: Config, entry: Path) -> re.Pattern[str]:
    formats = [_FORMATS[name] for name in dict.fromkeys(config.bake.formats)]
    names = (constants if entry == CONSTANTS else episode(config, int(entry.name)) for constants, episode in formats)
    return re.compile("|".join(dict.fromkeys(names)))


def check_file_names(folder: Path, entry: Path, names: Iterable[str], config: Config) -> None:
    """Check that a checksum list names only files that the formats of a data set write.

    Args:
        folder: The data set.
        entry: Manifest entry of the list: of the constants, or of an episode.
        names: Names in the list, relative to the data set.
        config: Settings of the data set.

    Raises:
        DatasetError: It names another file.
    """
    matches = _pattern(config, entry).fullmatch
    foreign = next((name for name in names if not matches(name)), None)
    if foreign is not None:
        raise DatasetError(
            f'{folder / entry}.sha256 names "{foreign[:MAX_SHOWN]}", which none of its formats writes; {entry_advice(entry)}'
        )


_PARTS = (("coco", "coco/parts"), ("lerobot", "lerobot/parts"))
"""Formats whose indices are joined from a file an episode or scene, and the folder of these."""


def describe_strays(folder: Path, config: Config, episodes: Iterable[int]) -> str:
    """Name what lies beside the parts that indices are joined from and belongs to no committed episode.

    Args:
        folder: The data set.
        config: Its settings.
        episodes: Its committed episodes.

    Returns:
        A sentence; empty: there is nothing.
    """
    strays = []
    cameras, known = len(config.cameras.positions), set(episodes)
    for name, place in _PARTS:
        if name in config.bake.formats and (folder / place).is_dir():
            suffix, count = (".jsonl", cameras) if name == "coco" else (".json", 1)
            parts = {f"{number:06d}{suffix}" for episode in known for number in range(count * episode, count * (episode + 1))}
            strays += sorted(f"{place}/{entry.name}" for entry in os.scandir(folder / place) if entry.name not in parts)
    if not strays:
        return ""
    more = f" and {len(strays) - 1} more" if len(strays) > 1 else ""
    return f"left out: {folder}/{ascii(strays[0])[1:-1][:MAX_SHOWN]}{more}, of no committed episode"
