"""Scenes as tar files: a view's records and pictures as tar entries, and views put together into whole shards.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

from __future__ import annotations

import json
import os
import shutil
import tarfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from synpick_warp.errors import OutputError
from synpick_warp.exporters.bop.view import (
    ViewSettings,
    ViewTruth,
    camera_record,
    encode_color,
    extract_masks,
    gt_records,
    info_records,
    run_length_record,
    to_json,
)
from synpick_warp.exporters.writing.files import sync_folder
from synpick_warp.exporters.writing.folder import Buffer, open_folder
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.exporters.writing.rle import Runs
from synpick_warp.layer_codec import encode_layer

MAX_SHARD_VIEWS = 1000
"""Of a shard, as the toolkit has them (convert_imagewise_to_webdataset.py)."""
SHARD_STRIDE = 1_000_000
"""The shards of a scene are numbered scene, scene + this, scene + twice this, ...; scenes have six digits."""
_END = bytes(2 * tarfile.BLOCKSIZE)
"""How a tar file ends (POSIX.1-1988, section 10.1.1)."""
_COPY_BYTES = 1 << 20
"""Copied at once [B]."""


def shard_name(scene: int, part: int) -> str:
    """File of the views `MAX_SHARD_VIEWS · part` and following of a scene."""
    return f"shard-{scene + SHARD_STRIDE * part:06d}.tar"


def write_shard_view(
    color: np.ndarray, depth: np.ndarray, first: np.ndarray, second: np.ndarray, scene: Path, settings: ViewSettings, truth: ViewTruth
) -> None:
    """Write all of a view as tar entries, without a tar file's end, to a file in a scene's folder that is named as the frame."""
    height, width = depth.shape
    entries: list[tuple[str, Buffer]] = [
        (f"rgb{settings.color_suffix}", encode_color(color, settings, truth.jpeg_quality)),
        ("depth.png", encode_png(depth)),
        ("camera.json", to_json(camera_record(truth, settings))),
        ("gt.json", to_json(gt_records(truth, settings.camera))),
        ("gt_info.json", to_json(info_records(truth))),
    ]
    if settings.masks:
        masks = extract_masks(first, second, truth, height)
        entries.append(("mask.json", _mask_json((mask.whole for mask in masks), height, width)))
        entries.append(("mask_visib.json", _mask_json((mask.seen for mask in masks), height, width)))
    key = _key(truth.scene, truth.frame)
    with open_folder(scene) as folder:
        folder.write(str(truth.frame), b"".join(part for name, data in entries for part in _tar_entry(f"{key}.{name}", data)))


def write_shard_layer(values: np.ndarray, scene: Path, number: int, name: str, frame: int) -> None:
    """Write a view's layer as a tar entry, without a tar file's end, to a file in a scene's folder; `number` is the scene's."""
    entry = _tar_entry(f"{_key(number, frame)}.{name}.png", encode_png(encode_layer(name, values)))
    with open_folder(scene) as folder:
        folder.write(_layer_file(frame, name), b"".join(entry))


def _key(scene: int, frame: int) -> str:
    return f"{scene:06d}_{frame:06d}"


def _layer_file(frame: int, name: str) -> str:
    return f"{frame}.{name}"


def _mask_json(masks: Iterable[Runs], height: int, width: int) -> bytes:
    return to_json({str(index): run_length_record(runs, height, width) for index, runs in enumerate(masks)})


def _tar_entry(name: str, data: Buffer) -> tuple[Buffer, ...]:
    """Nothing of the machine or the time: no owner, and the first second of 1970."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    return info.tobuf(tarfile.USTAR_FORMAT), data, bytes(-len(data) % tarfile.BLOCKSIZE)


def finish_shards(scenes: tuple[tuple[Path, int], ...], split: Path, frames: int, layers: tuple[str, ...]) -> None:
    """Make an episode's shards of its views with their layers, and move them to their places: hidden folders and scene numbers.

    Shards are on the disk before the move.
    """
    whole: list[tuple[Path, Path]] = []
    for scene, number in scenes:
        views = [[str(frame), *(_layer_file(frame, name) for name in layers)] for frame in range(frames)]
        names = {path.name for path in scene.iterdir()}
        if names != {name for view in views for name in view}:
            raise OutputError(f"{scene} does not have {frames} whole frames; this is an error of synpick-warp, please report it")
        for part, begin in enumerate(range(0, frames, MAX_SHARD_VIEWS)):
            shard = scene / shard_name(number, part)
            _join(shard, [scene / name for view in views[begin : begin + MAX_SHARD_VIEWS] for name in view])
            whole.append((shard, split / shard.name))
    for shard, place in whole:
        shard.rename(place)
    sync_folder(split)
    for scene, _ in scenes:
        shutil.rmtree(scene)


def _join(shard: Path, pieces: list[Path]) -> None:
    """Join files of entries to a tar file; each goes at once, so that little room is taken twice."""
    with shard.open("wb", buffering=0) as target:
        for piece in pieces:
            with piece.open("rb", buffering=0) as source:
                shutil.copyfileobj(source, target, _COPY_BYTES)
            piece.unlink()
        target.write(_END)
        os.fsync(target.fileno())


def shards_of(scene: int, split: Path) -> Iterator[Path]:
    """The shards of a scene that are there, in order."""
    part = 0
    while os.path.lexists(path := split / shard_name(scene, part)):
        yield path
        part += 1


def list_keys(shard: Path, folder: Path) -> None:
    """Write the keys of a shard's views and its number, as lines of a JSON object, into a folder, to a file of the same name."""
    with tarfile.open(shard, "r:") as file:
        keys = dict.fromkeys(name.partition(".")[0] for name in file.getnames())
    lines = (f"{json.dumps(key)}: {shard_number(shard)}\n" for key in keys)
    (folder / shard.name).write_text("".join(lines), encoding="ascii")


def shard_number(shard: Path) -> int:
    """The number in a shard's name."""
    return int(shard.stem.removeprefix("shard-"))
