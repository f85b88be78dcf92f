"""Webdataset shards of BOP scenes: one tar file per scene that holds its complete views, for sequential reading; their exporter.

The card README.md has the header that the Hugging Face hub, its viewer and the package `datasets` read. It declares each split's files, as
key_to_shard.json lies beside them, and the columns' types: inferred ones come from the first views, and miss masks of scenes with more
objects, or find nothing but null where a later scene has a light's direction.

Runs in writer processes, too, so it imports neither Warp nor Newton.
"""

import contextlib
import json
import os
import shutil
import tarfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from synpick_warp.configs.cell.cameras import lens_map
from synpick_warp.configs.dataset import MAX_SHARD_SCENES, DataLayout, ExportSettings, split_kind
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import EncodedView, SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages, constant_files
from synpick_warp.exporters.bop.view import ViewSettings, make_rle, to_json
from synpick_warp.exporters.writing.files import (
    LINES,
    PARTIAL,
    Buffer,
    join_lines,
    open_folder,
    output_errors,
    spooled_checksums,
    sync_folder,
    write_atomically,
    write_synced,
)
from synpick_warp.exporters.writing.notes import describe_lenses
from synpick_warp.exporters.writing.pool import WriterPool
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


CARD_FILE = "README.md"
"""Name that the hub gives the card."""
_POWERS = ("K", "M", "B", "T")
"""Units of the hub's size categories: powers of 1000."""
_NUMBERS, _INTEGERS = {"list": "float64"}, {"list": "int64"}
_LIGHT = {"map": "string", "yaw": "float64", "exposure": "float64", "direction": _NUMBERS}
_POSE = {"cam_R_m2c": _NUMBERS, "cam_t_m2c": _NUMBERS, "obj_id": "int64", "instance_id": "int64"}
_COUNTS = dict.fromkeys(("px_count_all", "px_count_valid", "px_count_visib"), "int64")
_INFO = {"bbox_obj": _INTEGERS, "bbox_visib": _INTEGERS, **_COUNTS, "visib_fract": "float64"}
_MASK = {"counts": _INTEGERS, "size": _INTEGERS}

_FOREIGN = "\nObjects or light maps are not synpick-warp's own: set `license` to theirs in the copy that you upload.\n"


class SplitContent(NamedTuple):
    """What the dataset card says of a split: name on the hub, folder of its shards, numbers of views and shards, their size [B]."""

    name: str
    folder: str
    views: int
    shards: int
    bytes: int


def hub_splits(layout: DataLayout) -> tuple[str, ...]:
    """Names of the splits on the hub, for each of `DataLayout.folders`: val is called validation there, unless another split is."""
    names = [split.name for split in layout.splits] or [split_kind(layout.split)]
    return tuple("validation" if name == "val" and "validation" not in names else name for name in names)


def make_card(settings: ExportSettings, contents: Sequence[SplitContent]) -> str:
    """Text of README.md. It leaves out splits without shards, unless none has any: a pattern that matches no file is an error."""
    # Objects and light maps that are not synpick-warp's have licences of their own.
    embedded = not (settings.bake.models or settings.bake.lights)
    splits = [split for split in contents if split.shards] or contents
    views, shards, size = (sum(getattr(split, name) for split in splits) for name in ("views", "shards", "bytes"))
    split, folder = splits[0].name, splits[0].folder
    files = (f"\n  - split: {each.name}\n    path: {each.folder}/shard-*.tar" for each in splits)
    header = "\n".join(
        (
            f"license: {'mit' if embedded else 'unknown'}",
            "pretty_name: Synthetic bin picking by synpick-warp",
            "task_categories: [object-detection, image-segmentation, depth-estimation, robotics]",
            "tags: [6d-pose-estimation, bin-picking, synthetic, webdataset, bop]",
            f"size_categories: [{size_category(views)}]",
            f"configs:\n- config_name: default\n  data_files:{''.join(files)}",
            "dataset_info:\n  config_name: default\n  features:",
            *_list_features(_features(settings), "  "),
        )
    )
    rows = "\n".join(f"| {each.name} | {each.folder} | {each.views:,} | {each.shards:,} | {each.bytes:,} |" for each in splits)
    licence = "" if embedded else _FOREIGN
    return f"""---
{header}
---
# Synthetic bin picking
{describe_lenses(settings)}
{views:,} views in {shards:,} webdataset shards of {size:,} bytes in all, made by synpick-warp:
colour, 16-bit depth, 6D poses, boxes and masks as in the BOP challenge. One shard is one camera's scene; `dataset_info.md` has
the conventions and the objects.

| split | folder | views | shards | bytes |
|---|---|---|---|---|
{rows}
{licence}
    datasets.load_dataset("DIR", split="{split}")
    datasets.load_dataset("webdataset", data_dir="DIR/{folder}", data_files="*.tar", split="train")
    webdataset.WebDataset("DIR/{folder}/shard-000000.tar").decode(synpick_warp.webdataset.decode_view)

The first line has the columns' types from this file; the second infers them from the first views, which fails or loses masks if
later scenes have more objects. `datasets` reads 16-bit depth whole (Pillow's mode I;16), but colour layers of 16 bits as 8: cast
these columns to `Image(decode=False)`, and decode their bytes by `decode_view`.
"""


def size_category(views: int) -> str:
    """The hub's size category of a number of examples: n<1K, 1K<n<10K, ..., n>1T."""
    power = len(str(views)) - 1
    if power < 3:
        return "n<1K"
    low, high = (f"{10 ** (each % 3)}{_POWERS[min(each, 12) // 3 - 1]}" for each in (power, power + 1))
    return f"{low}<n<{high}" if power < 12 else "n>1T"


def _features(settings: ExportSettings) -> dict[str, object]:
    """Columns of the card's table with their types: a type's name, a structure or a list."""
    camera = {"cam_K": _NUMBERS, "cam_R_w2c": _NUMBERS, "cam_t_w2c": _NUMBERS, "depth_scale": "float64", "light": _LIGHT}
    if any(lens_map(row) is not None for row in settings.rig.rows):
        camera |= {"cam_dist_model": "string", "cam_dist": _NUMBERS}
    if any(any(settings.rig.shutter(index)) for index in range(len(settings.rig))):
        camera |= {"exposure_time": "float64", "readout_time": "float64"}
    if settings.effects:
        camera["effects"] = dict.fromkeys(settings.effects, "float64")
    masks = {str(index): _MASK for index in range(settings.objects)}
    return {
        f"rgb.{settings.bop.color_format}": "image",
        "depth.png": "image",
        "camera.json": camera,
        "gt.json": {"list": _POSE},
        "gt_info.json": {"list": _INFO},
        **({"mask.json": masks, "mask_visib.json": masks} if settings.bop.masks else {}),
        **{f"{name}.png": "image" for name in settings.render.layers},
        "__key__": "string",
        "__url__": "string",
    }


def _list_features(features: dict[str, object], indent: str) -> Iterator[str]:
    """Yield lines of YAML of the features, as `datasets.Features` reads them."""
    for name, kind in features.items():
        yield f'{indent}- name: "{name}"'
        yield from _describe_type(kind, f"{indent}  ")


def _describe_type(kind: object, indent: str) -> Iterable[str]:
    """YAML lines of a feature's type in the dataset card: plain, struct or list."""
    if not isinstance(kind, dict):
        return (f"{indent}dtype: {kind}",)
    if set(kind) != {"list"}:
        return (f"{indent}struct:", *_list_features(kind, indent))
    if isinstance(kind["list"], str):
        return (f"{indent}list: {kind['list']}",)
    return (f"{indent}list:", *_list_features(kind["list"], indent))


KEYS_FILE = "key_to_shard.json"
"""Index file: key of a view -> index of its shard."""
_SIZES = "sizes"
"""Name in LINES: size [B] and number of views of each shard, a line each."""


class ShardsExporter(SceneExporter):
    """`Exporter` of one tar file per scene, named by scene_id; a scene of more than 1,000 views has further ones.

    Shard indices depend on the scene only, so an episode's shards can be committed when it ends, independently of other episodes.
    """

    staging = "shards"
    write_view = staticmethod(write_view)
    write_layer = staticmethod(write_layer)

    @staticmethod
    def folder_name(split: str) -> str:
        return f"{split}_web"

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        splits = ShardsExporter.folders(layout)
        return SharedFiles(constant_files(layout), (*(split / KEYS_FILE for split in splits), Path(CARD_FILE)), splits)

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        layout = settings.layout
        cameras = layout.cameras
        scenes = [scene for episode in episodes for scene in range(cameras * episode, cameras * (episode + 1))]
        contents = [
            _join_known(out, name, split) if (out / LINES).is_dir() else _write_keys(out, name, split, pool, scenes)
            for name, split in zip(hub_splits(layout), ShardsExporter.folders(layout), strict=True)
        ]
        with output_errors(out / CARD_FILE):
            write_atomically(out / CARD_FILE, make_card(settings, contents).encode())
        return [*(Path(split.folder) / KEYS_FILE for split in contents), Path(CARD_FILE)]

    @staticmethod
    def index_lines(out: Path, settings: ExportSettings, names: Sequence[str]) -> Iterator[tuple[str, bytes]]:
        """For each shard keys of its views, in parts of MAX_SHARD_SCENES shards; its size [B] and number of views."""
        splits = ShardsExporter.folders(settings.layout)
        shards = filter(lambda path: path.parent in splits and path.suffix == ".tar", map(Path, names))
        for shard in sorted(shards, key=shard_index):
            lines, size = key_lines(out / shard), (out / shard).stat().st_size
            views = lines.count(b"\n")
            yield f"{shard.parent / KEYS_FILE}/{shard_index(shard) // MAX_SHARD_SCENES}", lines
            yield f"{shard.parent}/{_SIZES}/0", f"{size} {views}\n".encode()

    def places(self, episode: int) -> Iterator[Path]:
        return (path.relative_to(self._out) for scene in self.scene_ids(episode) for path in find_shards(scene, self._folder(scene)))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        split = self._folder(scenes[0][1]).relative_to(self._out)
        return commit_shards, (scenes, self._out, split, images, tuple(view.layers for view in self._views))


def _write_keys(out: Path, name: str, split: Path, pool: WriterPool, scenes: Sequence[int]) -> SplitContent:
    """Write the index of a split by reading its shards of these scenes. Returns the numbers of views and shards, and their size."""
    parts = out / PARTIAL / ShardsExporter.staging / "keys"
    with output_errors(out / split):
        parts.parent.mkdir(exist_ok=True)
        shutil.rmtree(parts, ignore_errors=True)
        parts.mkdir()
        shards, size = 0, 0
        for shard in (shard for scene in scenes for shard in find_shards(scene, out / split)):
            shards, size = shards + 1, size + shard.stat().st_size
            pool.submit(list_keys, (), (shard, parts), path=shard)
        pool.wait()
        views = sum(path.read_bytes().count(b"\n") for path in _join_keys(parts, out / split))
        return SplitContent(name, split.name, views, shards, size)


def _join_keys(parts: Path, split: Path) -> list[Path]:
    """Write the index of a split by concatenating the files of a folder in numerical order. Returns these files."""
    paths = sorted(parts.iterdir(), key=lambda path: (len(path.name), path.name)) if parts.is_dir() else []
    write_atomically(split / KEYS_FILE, join_lines(paths, b"{", b"}\n"))
    return paths


def _join_known(out: Path, name: str, split: Path) -> SplitContent:
    """Write the index of a split from the `index_lines` of its episodes, without reading shards. Returns as `_write_keys`."""
    known, shards, size, views = out / LINES / split, 0, 0, 0
    with output_errors(out / split):
        _join_keys(known / KEYS_FILE, out / split)
        with (known / _SIZES / "0").open() if (known / _SIZES).is_dir() else contextlib.nullcontext(()) as rows:
            for row in rows:
                own_size, own_views = map(int, row.split())
                shards, size, views = shards + 1, size + own_size, views + own_views
    return SplitContent(name, split.name, views, shards, size)
