"""Webdataset shards of BOP scenes: views as tar entries, and their concatenation into tar files.

Runs in writer processes, so it imports neither Warp nor Newton.
"""

import json
import os
import tarfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from synpick_warp.configs.dataset import MAX_SHARD_SCENES
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import EncodedView
from synpick_warp.exporters.bop.view import ViewSettings, make_rle, to_json
from synpick_warp.exporters.writing.files import Buffer, open_folder, spooled_checksums, sync_folder, write_synced
from synpick_warp.exporters.writing.rle import Runs
from synpick_warp.system.inputs.tar_files import list_members

MAX_SHARD_VIEWS = 1000
"""Maximum number of views in a shard, as in the toolkit (convert_imagewise_to_webdataset.py)."""
END_OF_ARCHIVE = bytes(2 * tarfile.BLOCKSIZE)
"""End-of-archive marker of a tar file (POSIX.1-1988, section 10.1.1)."""
_ADVICE = "remove it and its episode's two files in manifest/, and resume the bake"


def shard_name(scene: int, part: int) -> str:
    """Name of the shard that holds a scene's views from `MAX_SHARD_VIEWS · part` on."""
    if scene >= MAX_SHARD_SCENES:
        raise OutputError(f"scene {scene} is too many for the format shards, whose names hold {MAX_SHARD_SCENES}; bake fewer episodes")
    return f"shard-{scene + MAX_SHARD_SCENES * part:06d}.tar"


def write_view(view: EncodedView, scene: Path, settings: ViewSettings) -> None:
    """Write a view as tar entries, without end-of-archive marker, to a file in the scene's staging folder named by its frame."""
    entries: list[tuple[str, Buffer]] = [(f"rgb{view.color[0]}", view.color[1])] if settings.color else []
    entries += [("depth.png", view.depth)] if settings.depth else []
    entries += [(f"{name}.json", to_json(record)) for name, record in (("camera", view.camera), ("gt", view.gt), ("gt_info", view.gt_info))]
    if settings.masks:
        masks = view.masks()
        entries.append(("mask.json", _mask_json((mask.amodal for mask in masks), settings)))
        entries.append(("mask_visib.json", _mask_json((mask.visible for mask in masks), settings)))
    key = _view_key(view.scene, view.frame)
    with open_folder(scene) as folder:
        folder.write(str(view.frame), b"".join(part for name, data in entries for part in _tar_entry(f"{key}.{name}", data)))


def write_layer(data: Buffer, scene: Path, scene_id: int, name: str, frame: int) -> None:
    """Write a view's layer as a tar entry, without end-of-archive marker, to a file in the scene's staging folder."""
    with open_folder(scene) as folder:
        folder.write(f"{frame}.{name}", b"".join(_tar_entry(f"{_view_key(scene_id, frame)}.{name}.png", data)))


def _view_key(scene: int, frame: int) -> str:
    """Key of a view in shards: scene_id and im_id, of six digits each."""
    return f"{scene:06d}_{frame:06d}"


def _mask_json(masks: Iterable[Runs], settings: ViewSettings) -> bytes:
    """Masks by ground-truth index, as run lengths."""
    width, height = settings.resolution
    return to_json({str(index): make_rle(runs, height, width) for index, runs in enumerate(masks)})


def _tar_entry(name: str, data: Buffer) -> tuple[Buffer, ...]:
    """Reproducible tar entry: no owner, modification time 0."""
    info = tarfile.TarInfo(name)
    info.size = len(data)
    return info.tobuf(tarfile.USTAR_FORMAT), data, bytes(-len(data) % tarfile.BLOCKSIZE)


def commit_shards(
    scenes: tuple[tuple[Path, int], ...], out: Path, split: Path, images: Sequence[Sequence[int]], layers: Sequence[Sequence[str]]
) -> None:
    """Task: concatenate the views and layers of an episode's scenes, (staging folder, scene_id), into shards, synced to disk, rename these
    to their places in the split's folder, and spool their checksums; raises OutputError unless each scene has all its images (im_id,
    ascending) and layers."""
    complete: list[tuple[Path, Path]] = []
    for (scene, scene_id), own, shown in zip(scenes, images, layers, strict=True):
        views = [[str(frame), *(f"{frame}.{name}" for name in shown)] for frame in own]
        names = {path.name for path in scene.iterdir()}
        if names != {name for view in views for name in view}:
            raise OutputError(f"{scene} does not have {len(own)} whole frames; this is an error of synpick-warp, please report it")
        for part, begin in enumerate(range(0, len(own), MAX_SHARD_VIEWS)):
            shard = scene / shard_name(scene_id, part)
            place = split / shard.name
            pieces = (scene / name for view in views[begin : begin + MAX_SHARD_VIEWS] for name in view)
            spooled_checksums(out, place).write_text(write_synced(shard, _join_pieces(pieces), split), encoding="utf-8")
            complete.append((shard, out / place))
    for shard, place in complete:
        shard.rename(place)
    sync_folder(out / split)


def _join_pieces(pieces: Iterable[Path]) -> Iterator[bytes]:
    """Content of a tar file from files of its entries; each is removed once it is written, so that little disk space is used twice."""
    for piece in pieces:
        yield piece.read_bytes()
        piece.unlink()
    yield END_OF_ARCHIVE


def find_shards(scene: int, split: Path) -> Iterator[Path]:
    """Find the committed shards of a scene, in order."""
    part = 0
    while os.path.lexists(path := split / shard_name(scene, part)):
        yield path
        part += 1


def key_lines(shard: Path) -> bytes:
    """Key table of a shard: a line `"key": shard index` of a JSON object for each view."""
    keys = dict.fromkeys(name.partition(".")[0] for name, _, _ in list_members(shard, _ADVICE))
    return "".join(f"{json.dumps(key)}: {shard_index(shard)}\n" for key in keys).encode()


def list_keys(shard: Path, folder: Path) -> None:
    """Task: write the `key_lines` of a shard to a file of the shard's name in `folder`."""
    (folder / shard.name).write_bytes(key_lines(shard))


def shard_index(shard: Path) -> int:
    """Index in a shard's file name."""
    return int(shard.stem.removeprefix("shard-"))
