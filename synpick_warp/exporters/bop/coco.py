"""COCO instance segmentation: images, one annotation file for each split, with visible boxes, for detectors' training code; its exporter.

Beside BOP's scene_gt_coco.json, which is a file a scene with amodal boxes: here boxes enclose the visible mask, as COCO's readers expect.
Runs in writer processes, too, so it imports neither Warp nor Newton.
"""

import json
import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from synpick_warp.configs.cell.cameras import Size
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Bop
from synpick_warp.errors import DatasetError
from synpick_warp.exporters.base import EncodedView, SharedFiles
from synpick_warp.exporters.bop import view as bop_view
from synpick_warp.exporters.bop.outlines import trace_outlines
from synpick_warp.exporters.bop.scene import AnnotationBlocks
from synpick_warp.exporters.bop.scene_exporter import SceneExporter, SceneImages
from synpick_warp.exporters.writing.files import PARTIAL, open_folder, output_errors, sync_folder, write_synced
from synpick_warp.exporters.writing.notes import note_files, write_notes
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.system.inputs.files import MAX_JSON, decode_json, path_inside, read_file, read_json

FOLDER = Path("coco")
"""Folder in the data set."""
IMAGES, PARTS, CATEGORIES = FOLDER / "images", FOLDER / "parts", FOLDER / "categories.json"
"""Images in a folder a scene, annotations of each scene, names of the objects. Splits share them, as scene ids are unique over all."""
_Line: Any = list[dict[str, Any]] | None
"""A line of a part."""
_ADVICE = "remove it and its episode's two files in manifest/, and resume the bake"


class _Category(msgspec.Struct):
    """Schema of a category in the categories file: obj_id, name, and keypoints with their positions, if there are any."""

    id: int
    name: str
    keypoints: list[str] | msgspec.UnsetType = msgspec.UNSET
    skeleton: list[tuple[int, int]] | msgspec.UnsetType = msgspec.UNSET
    keypoint_positions: list[tuple[float, float, float]] | msgspec.UnsetType = msgspec.UNSET


def annotation_file(split: str) -> Path:
    """The annotations of a split's images, relative to the data set; `split`: its name in BOP, such as test_pbr."""
    return FOLDER / "annotations" / f"instances_{split}.json"


def write_categories(out: Path, names: Mapping[int, str], keypoints: Mapping[int, bop_view.Keypoints]) -> None:
    """Write names and keypoints (or none) of the objects by obj_id, and the folders of the format."""
    with output_errors(out / CATEGORIES):
        for folder in (FOLDER, IMAGES, PARTS):
            (out / folder).mkdir(exist_ok=True)
        extras = {obj_id: bop_view.make_category_keys(points) for obj_id, points in keypoints.items()}
        named = [{"id": obj_id, "name": name, "supercategory": "object"} for obj_id, name in sorted(names.items())]
        categories = [category | extras.get(obj_id, {}) for category, obj_id in zip(named, sorted(names), strict=True)]
        (out / CATEGORIES).write_text(json.dumps(categories, indent=2) + "\n", encoding="ascii")


def write_view(view: EncodedView, scene: Path, settings: bop_view.ViewSettings) -> None:
    """Write a view's image to the staging folder of its scene, and append its annotations there."""
    suffix, color = view.color
    with open_folder(scene) as folder:
        folder.write(f"{view.frame:06d}{suffix}", color)
        folder.append(
            bop_view.ANNOTATIONS, bop_view.annotation_block(view.frame, (bop_view.to_json(list(_make_annotations(view, settings))),))
        )


def _make_annotations(view: EncodedView, settings: bop_view.ViewSettings) -> Iterator[dict[str, Any]]:
    """Annotations of a view's visible instances, without ids: box of the visible mask, segmentation, extra keys, keypoints."""
    width, height = settings.resolution
    for pose, info, mask, points in zip(
        view.gt, view.gt_info, view.masks(), bop_view.make_keypoints(view, settings.keypoints), strict=True
    ):
        box = mask.visible.box()
        if box is not None:
            left, top, right, bottom = box
            # Polygons as in COCO, x and y by turns [px]: one for each part.
            polygons = [polygon.points.ravel().tolist() for polygon in trace_outlines(mask.visible)] if settings.polygons else None
            yield {
                "category_id": pose["obj_id"],
                "bbox": [left, top, right - left + 1, bottom - top + 1],
                "area": mask.visible.count,
                "iscrowd": 0,
                "segmentation": bop_view.make_rle(mask.visible, height, width) if polygons is None else polygons,
                **_make_extras(pose, info),
            } | points


def _make_extras(pose: Mapping[str, Any], info: Mapping[str, Any]) -> dict[str, Any]:
    """Extra keys of an annotation beside COCO's; data sets of other programs may lack them."""
    extras = {} if math.isnan(info["visib_fract"]) else {"visib_fract": info["visib_fract"]}
    if extras:
        extras = {"bbox_amodal": [*info["bbox_obj"][:2], *(size + 1 for size in info["bbox_obj"][2:])], **extras}
    return extras | ({"instance_id": pose["instance_id"]} if "instance_id" in pose else {})


def commit_scenes(scenes: tuple[tuple[Path, int], ...], out: Path, frames: Sequence[Sequence[int]]) -> None:
    """Task: complete an episode's scenes, (staging folder, scene_id): a line of annotations for each frame, null for im_ids that sets of
    others leave out, and rename all to their places; raises OutputError if not all `frames` (im_id) of a scene have arrived."""
    for (scene, scene_id), own in zip(scenes, frames, strict=True):
        with (scene / bop_view.ANNOTATIONS).open("rb") as file:
            blocks = AnnotationBlocks(file)
            blocks.check_frames(scene, own)
            known = set(blocks.frames)
            lines = [next(blocks.read(frame, 0, 1)) if frame in known else b"null" for frame in range(max(known, default=-1) + 1)]
        part = scene.with_name(f"{scene.name}.part")
        write_synced(part, b"".join(b"%s\n" % line for line in lines))
        (scene / bop_view.ANNOTATIONS).unlink()
        sync_folder(scene)
        part.rename(out / PARTS / f"{scene_id:06d}.jsonl")
        scene.rename(out / IMAGES / f"{scene_id:06d}")
    for folder in (PARTS, IMAGES):
        sync_folder(out / folder)


def write_annotation_files(out: Path, settings: ExportSettings, episodes: Iterable[int]) -> list[Path]:
    """Join the episodes' parts to an annotation file a split; images and annotations are numbered from 1 in each. Returns their names;
    raises DatasetError if a part is damaged."""
    layout = settings.layout
    parts: dict[str, list[Path]] = {split: [] for split in layout.folders}
    cameras = layout.cameras
    for episode in episodes:
        names = (out / PARTS / f"{scene:06d}.jsonl" for scene in range(cameras * episode, cameras * (episode + 1)))
        parts[layout.folder(episode)] += filter(os.path.lexists, names)
    categories = read_json(path_inside(out, str(CATEGORIES), out, DatasetError), list[_Category], DatasetError, _ADVICE)
    describe = partial(_describe_image, settings.rig.sizes, settings.bop.color_format)
    return [_write_annotations(out, describe, split, found, categories) for split, found in parts.items()]


def _write_annotations(
    out: Path, describe: Callable[[int, int], dict[str, Any]], split: str, parts: list[Path], categories: list[_Category]
) -> Path:
    """Join parts to the annotation file of a split; returns its name. `describe`: entry of the image of a scene and frame."""
    place = annotation_file(split)
    folder = out / PARTIAL / "coco-index"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    images, annotations = 0, 0
    with (folder / "images").open("w", encoding="ascii") as image_file, (folder / "annotations").open("w", encoding="ascii") as file:
        for part in parts:
            for frame, found in enumerate(_read_part(part, out)):
                if found is None:
                    continue
                images += 1
                row = {"id": images, **describe(int(part.stem), frame)}
                image_file.write((",\n" if images > 1 else "") + json.dumps(row))
                for annotation in found:
                    annotations += 1
                    text = bop_view.to_json({"id": annotations, "image_id": images, **annotation}).decode()
                    file.write((",\n" if annotations > 1 else "") + text)
    head = {"info": {"description": f"synpick-warp, {split}"}, "licenses": [], "categories": msgspec.to_builtins(categories)}
    (out / place).parent.mkdir(exist_ok=True)
    with (folder / "joined").open("wb") as joined:
        joined.write((json.dumps(head)[:-1] + ', "images": [\n').encode())
        for name, end in (("images", b'\n], "annotations": [\n'), ("annotations", b"\n]}\n")):
            with (folder / name).open("rb") as source:
                shutil.copyfileobj(source, joined)
            joined.write(end)
        joined.flush()
        os.fsync(joined.fileno())
    (folder / "joined").replace(out / place)
    sync_folder((out / place).parent)
    shutil.rmtree(folder)
    return place


def _read_part(part: Path, out: Path) -> Iterator[list[dict[str, Any]] | None]:
    """Annotations of each frame of a scene; None: there is no such image (im_id)."""
    data = read_file(path_inside(out, str(part.relative_to(out)), out / PARTS, DatasetError), MAX_JSON, DatasetError)
    for number, line in enumerate(data.splitlines(), start=1):
        yield decode_json(line, _Line, f"{part}, line {number},", DatasetError, _ADVICE)


def _describe_image(sizes: tuple[Size, ...], color_format: str, scene: int, frame: int) -> dict[str, Any]:
    """Entry of an image in COCO's list, but for its id: file name, size, episode, camera, frame."""
    episode, camera = divmod(scene, len(sizes))
    width, height = sizes[camera]
    name = f"{scene:06d}/{frame:06d}.{color_format}"
    return {"file_name": name, "width": width, "height": height, "episode": episode, "camera": camera, "frame": frame}


class CocoExporter(SceneExporter):
    """`Exporter` of COCO. A scene has a folder of images and an annotation part; parts are merged into a file per split at the end."""

    writes_depth = False
    staging = "coco"

    write_view = staticmethod(write_view)

    @staticmethod
    def annotates(bop: Bop) -> bool:
        return True

    @staticmethod
    def folder_name(split: str) -> str:
        return FOLDER.name

    @staticmethod
    def shared_files(layout: DataLayout) -> SharedFiles:
        places = tuple(map(annotation_file, layout.folders))
        return SharedFiles((CATEGORIES, *note_files(layout)), places, (IMAGES, PARTS, places[0].parent, FOLDER))

    @staticmethod
    def finalize(out: Path, settings: ExportSettings, pool: WriterPool, episodes: Sequence[int]) -> list[Path]:
        with output_errors(out / FOLDER):
            return write_annotation_files(out, settings, episodes)

    def write_constants(self) -> list[Path]:
        names = self._context.names
        write_categories(self._out, names, self._keypoints)
        with output_errors(self._out):
            return [CATEGORIES, *write_notes(self._out, self._context.settings, names, self._cameras)]

    def places(self, episode: int) -> Iterator[Path]:
        return (place for scene in self.scene_ids(episode) for place in (IMAGES / f"{scene:06d}", PARTS / f"{scene:06d}.jsonl"))

    def _commit_task(self, scenes: tuple[tuple[Path, int], ...], images: SceneImages) -> tuple[Callable[..., None], tuple[Any, ...]]:
        return commit_scenes, (scenes, self._out, images)
