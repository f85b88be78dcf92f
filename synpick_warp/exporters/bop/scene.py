"""Scene folders of BOP: write views, assemble the JSON files of a scene from the annotation blocks of its views, commit the scene.

The scene graph of a frame has support edges from contact forces, occlusion edges from masks, and an unstacking order; its nodes are
ground-truth indices: positions in a frame's list of scene_gt.json. Runs in writer processes, so it imports neither Warp nor Newton.
"""

import itertools
import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import orjson

from synpick_warp.configs.calibration.lens import read_lens
from synpick_warp.errors import OutputError
from synpick_warp.exporters.base import EncodedView
from synpick_warp.exporters.bop.view import ANNOTATIONS, ViewSettings, annotation_block, make_keypoints, make_rle, to_json
from synpick_warp.exporters.writing.files import Buffer, open_folder, spooled_checksums, sync_folder, write_synced
from synpick_warp.exporters.writing.png import hashed_mask_png
from synpick_warp.exporters.writing.rle import Masks, Runs
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.frames import TickBatch
from synpick_warp.views.layer_codec import layer_path
from synpick_warp.views.picks import COLUMNS, PickBatch, make_rows, row_type, sort_rows

GRAPH_FILE = "scene_graph.json"
SUPPORT_FRACTION = 0.05
"""Least upward force of a supporter, as a fraction of the supported object's weight. At rest the solver leaves 2 % of a load
unbalanced, and friction at a neighbour that an object only touches carries little more."""
WITHOUT_LABEL = -1
"""Index that stands for a supporter without node: bin, table, or an object without label."""
_GRAPH_DIGITS = 4
"""Decimal places of forces [N]."""
_BOUNDS = ("column", "first", "past")
"""Fields of `Runs` that are arrays."""


@dataclass(frozen=True, eq=False)
class FrameSupport:
    """Edge list of a frame's support graph: rows of object, supporter (or WITHOUT_LABEL) and upward force [N]; `nodes` instances."""

    nodes: int
    edges: np.ndarray
    """(edge, 3) float32."""


def find_supports(batch: TickBatch, weights: Mapping[int, float]) -> list[FrameSupport]:
    """Find the support edges of each frame of a batch, which has support forces: contact forces of at least SUPPORT_FRACTION of the
    object's weight, in `weights` [N] by obj_id."""
    frames = zip(batch.object_id, batch.tick["support"], batch.tick["static_support"], strict=True)
    return [_find_edges(*frame, weights) for frame in frames]


def _find_edges(object_id: np.ndarray, support: np.ndarray, static: np.ndarray, weights: Mapping[int, float]) -> FrameSupport:
    """Support edges of a frame: obj_id of instances (I), upward forces between them (I, I) and of static bodies on them (I) [N]."""
    labelled, others = np.flatnonzero(object_id >= 0), np.flatnonzero(object_id < WITHOUT_LABEL)
    # The last column has index -1: WITHOUT_LABEL.
    force = np.column_stack((support[np.ix_(labelled, labelled)], static[labelled] + support[np.ix_(labelled, others)].sum(axis=1)))
    least = SUPPORT_FRACTION * np.array([weights[obj_id] for obj_id in object_id[labelled].tolist()])
    objects, supporters = np.nonzero(force > least[:, None])
    ends = np.where(supporters < len(labelled), supporters, WITHOUT_LABEL)
    return FrameSupport(len(labelled), np.column_stack((objects, ends, force[objects, supporters])).astype(np.float32))


def find_occlusions(masks: Sequence[Masks]) -> list[tuple[int, int, int]]:
    """Occlusion edges of a view, (a, b, pixels): number of pixels common to a's visible mask and b's amodal mask.

    Interval join: visible masks are disjoint, so the visible runs that overlap an amodal run are consecutive in column-major order.
    """
    shown, begin, end = _list_runs([mask.visible for mask in masks], masks)
    hidden, start, past = _list_runs([mask.amodal for mask in masks], masks)
    order = np.argsort(begin, kind="stable")
    shown, begin, end = shown[order], begin[order], end[order]
    first, last = np.searchsorted(end, start, "right"), np.searchsorted(begin, past, "left")
    counts = last - first
    run = np.repeat(np.arange(len(start)), counts)
    other = np.arange(len(run)) - np.repeat(np.cumsum(counts) - counts - first, counts)
    pixels = np.minimum(end[other], past[run]) - np.maximum(begin[other], start[run])
    common = np.zeros((len(masks), len(masks)), np.int64)
    np.add.at(common, (shown[other], hidden[run]), pixels)
    np.fill_diagonal(common, 0)
    return [(a, b, int(common[a, b])) for a, b in np.argwhere(common).tolist()]


def _list_runs(parts: Sequence[Runs], masks: Sequence[Masks]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Runs of a mask of each instance: instance, and column-major positions of the first pixel and after the last (N)."""
    span = max((max(mask.amodal.bottom, mask.visible.bottom) for mask in masks), default=0) + 1
    column, first, past = (np.concatenate([np.zeros(0, np.int64), *(getattr(one, name) for one in parts)]) for name in _BOUNDS)
    instance = np.repeat(np.arange(len(parts)), [len(one.column) for one in parts])
    return instance, column * span + first, column * span + past


def find_unstacking_order(nodes: int, supports: Iterable[tuple[int, int]]) -> list[list[int]]:
    """Unstacking order: a topological order of the support graph's condensation, the least index first wherever several may follow.

    From the transitive closure, by repeated squaring of the adjacency matrix: bins have few enough objects. Edges are (object, supporter);
    those to WITHOUT_LABEL are left out. Returns strongly connected components, none of which carries a later one; one of several objects
    is a cycle: they carry each other.
    """
    reach = np.eye(nodes, dtype=np.float32)
    for one, other in supports:
        if other != WITHOUT_LABEL:
            reach[one, other] = 1.0
    for _ in range(nodes.bit_length()):
        reach = np.minimum(matmul(reach, reach), 1.0)
    mutual = (reach * reach.T).astype(bool)
    heads = np.unique(mutual.argmax(axis=1)) if nodes else np.zeros(0, np.int64)
    # Number of components that have to be taken before each, itself included; 0: it is taken.
    above = reach[np.ix_(heads, heads)].astype(np.int64)
    waiting, order = above.sum(axis=0), []
    for _ in heads:
        following = int((waiting == 1).argmax())
        order.append(np.flatnonzero(mutual[heads[following]]).tolist())
        waiting -= above[following]
    return order


def graph_entry(entry: Mapping[str, Any], support: FrameSupport | None) -> dict[str, Any]:
    """A frame's entry in scene_graph.json: the view's `entry`, with support edges and unstacking order (`support` None: without)."""
    if support is None:
        return dict(entry)
    edges = [(int(one), int(other), round(force, _GRAPH_DIGITS)) for one, other, force in support.edges.tolist()]
    return {**entry, "support": edges, "order": find_unstacking_order(support.nodes, ((one, other) for one, other, _ in edges))}


PICKS = "picks"
"""Spool file of a staged scene; absent if no candidates were drawn from its camera's images."""
_MM = 1000.0
"""Millimetres in a metre."""
_DIGITS = 6
"""Decimal places of numbers; lengths in millimetres and pixels have three less."""


def spool_picks(batch: PickBatch, scenes: tuple[Path, ...]) -> None:
    """Append the trials of a batch to spool files: each to that of the camera from which its candidate was drawn; `scenes`: by camera."""
    rows = make_rows(COLUMNS, batch.trials)
    state, camera = np.asarray(batch.states["state"]), np.asarray(batch.states["camera"])
    for index in np.unique(camera).astype(int).tolist():
        own = np.isin(rows["state"], state[camera == index])
        with (scenes[index] / PICKS).open("ab") as file:
            file.write(rows[own].tobytes())


def format_picks(spool: Path, camera: Callable[[int], dict[str, Any] | None], size: tuple[int, int]) -> Iterator[str]:
    """Format scene_picks.json, as lines of text: a list of candidates by frame. `camera` gives an image's entry in scene_camera.json, None:
    there is no such image; `size`: width and height of the images [px]."""
    rows = sort_rows(np.fromfile(spool, row_type(COLUMNS)))
    yield "{"
    begin = "\n"
    for frame in np.unique(rows["frame"]).tolist():
        entry = camera(frame)
        if entry is not None:
            yield f'{begin}  "{frame}": {json.dumps(_list_picks(rows[rows["frame"] == frame], entry, size))}'
            begin = ",\n"
    yield "\n}\n"


def _list_picks(rows: np.ndarray, camera: dict[str, Any], size: tuple[int, int]) -> list[dict[str, Any]]:
    """Entries of a frame: one for each candidate, in their order."""
    _, first, which = np.unique(rows[["state", "candidate"]], return_index=True, return_inverse=True)
    trials = np.bincount(which)
    success = np.bincount(which, rows["success"]) / trials
    rotation = np.reshape(np.array(camera["cam_R_w2c"], np.float64), (3, 3))
    point = matmul(_MM * rows["point"][first].astype(np.float64), rotation.T) + camera["cam_t_w2c"]
    normal = matmul(rows["normal"][first].astype(np.float64), rotation.T)
    lens, flat = read_lens(camera, size), point[:, :2] / point[:, 2:]
    matrix = np.reshape(np.array(camera["cam_K"], np.float64), (3, 3))
    pixel = matmul(flat, matrix[:2, :2].T) + matrix[:2, 2] if lens is None else lens.project(flat)
    seal, wrench = rows["seal"][first].astype(np.float64), rows["wrench"][first].astype(np.float64)
    columns = {
        "pixel": np.round(pixel, _DIGITS - 3),
        "point": np.round(point, _DIGITS - 3),
        "normal": np.round(normal, _DIGITS),
        "obj_id": rows["obj_id"][first],
        "instance_id": rows["instance"][first],
        "seal": np.round(seal, _DIGITS),
        "wrench": np.round(wrench, _DIGITS),
        "score": np.round(seal * wrench, _DIGITS),
        "success": np.round(success, _DIGITS),
        "trials": trials,
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*(values.tolist() for values in columns.values()), strict=True)]


IGNORE_VISIBILITY = 0.1
"""COCO annotations with a lower visible fraction are marked `ignore` (the toolkit's calc_gt_coco.py)."""
CHECKSUMS = "checksums"
"""Spool file of a staged scene: the checksum lines of its images, so that they are hashed while they are in the cache of the processor."""
DATE = "1970-01-01 00:00:00"
"""Value of COCO's date fields: constant, so that the same seed gives the same bytes."""


@dataclass(frozen=True)
class SceneSettings:
    """What completes a scene."""

    view: ViewSettings
    split: str
    images: Sequence[int]
    """Images (im_id) that it must have, ascending."""
    categories: tuple[dict[str, Any], ...]
    """COCO's category of every object of the catalog."""
    sensor: str = ""
    """Suffix of the image folders, such as "_cam1"; empty: classic."""
    supports: Sequence[FrameSupport] = ()
    """Support edges by frame of the episode; empty: those of stored entries."""


def create_scene_folders(scene: Path, kinds: Iterable[str]) -> None:
    """Create the staging folder of a scene, with a subfolder for each image type."""
    scene.mkdir()
    for name in kinds:
        (scene / name).mkdir()


def write_view(view: EncodedView, scene: Path, settings: ViewSettings) -> None:
    """Write a view's images into the folders of a staged scene, and append its annotation block to `ANNOTATIONS`.

    The block holds the entries of scene_camera, scene_gt, scene_gt_info and, if that is written, scene_graph, then the COCO annotations,
    without their ids.
    """
    name = f"{view.frame:06d}"
    with open_folder(scene, CHECKSUMS) as folder:
        if settings.color:
            suffix, color = view.color
            folder.write(f"rgb/{name}{suffix}", color)
        if settings.depth:
            folder.write(f"depth/{name}.png", view.depth)
        masks = view.masks() if settings.masks or settings.coco or settings.graph else []
        for index, mask in enumerate(masks if settings.masks else ()):
            width, height = settings.resolution
            for kind, runs in (("mask", mask.amodal), ("mask_visib", mask.visible)):
                folder.write(f"{kind}/{name}_{index:06d}.png", *hashed_mask_png(runs, height, width))
        annotations = _make_annotations(view, masks, settings) if settings.coco else ()
        graph = (view.graph or {"occlusion": find_occlusions(masks)},) if settings.graph else ()
        folder.append(ANNOTATIONS, annotation_block(view.frame, map(to_json, (view.camera, view.gt, view.gt_info, *graph, *annotations))))


def write_layer(data: Buffer, scene: Path, _: int, name: str, frame: int) -> None:
    """Write a view's layer into the folder of that name."""
    with open_folder(scene, CHECKSUMS) as folder:
        folder.write(str(layer_path(Path(), name, frame)), data)


def _make_annotations(view: EncodedView, masks: list[Masks], settings: ViewSettings) -> Iterator[dict[str, Any]]:
    """COCO annotations of the visible instances, without ids: amodal box clipped to the image, visible mask, keys of keypoints."""
    width, height = settings.resolution
    for pose, info, mask, points in zip(view.gt, view.gt_info, masks, make_keypoints(view, settings.keypoints), strict=True):
        box = mask.amodal.box()
        area = mask.visible.count
        if box is not None and area:
            x_min, y_min, x_max, y_max = box
            yield {
                "image_id": view.frame,
                "category_id": pose["obj_id"],
                "iscrowd": 0,
                "area": area,
                "bbox": [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1],
                "segmentation": make_rle(mask.visible, height, width),
                "width": width,
                "height": height,
                "ignore": info["visib_fract"] < IGNORE_VISIBILITY,
            } | points


def commit_scenes(scenes: tuple[tuple[Path, Path], ...], out: Path, settings: tuple[SceneSettings, ...]) -> None:
    """Task: complete an episode's scenes, rename each from its staging folder to its place, (from, to), and spool the checksums.

    JSON files and folder entries are synced to disk before the rename. Images are at least in the page cache: they survive the end
    of this process, and a power cut once the data set is finished.
    """
    for (scene, place), own in zip(scenes, settings, strict=True):
        spooled_checksums(out, place).write_text(complete_scene(scene, place, own), encoding="utf-8")
    for scene, place in scenes:
        scene.rename(out / place)
    for folder in {place.parent for _, place in scenes}:
        sync_folder(out / folder)


def complete_scene(scene: Path, place: Path, settings: SceneSettings) -> str:
    """Write the JSON files of a staged scene from its annotation blocks, and sync its folders to disk. Returns the checksum lines of all of
    its files, at their place in the data set."""
    sums: list[str] = []
    with (scene / ANNOTATIONS).open("rb") as file:
        blocks = AnnotationBlocks(file)
        blocks.check_frames(scene, settings.images)
        names = ("scene_camera.json", "scene_gt.json", "scene_gt_info.json")
        for index, name in enumerate(names):
            sums.append(write_synced(scene / name, _format_keyed(blocks, index)))
        if settings.view.graph:
            sums.append(write_synced(scene / GRAPH_FILE, _format_keyed(blocks, len(names), partial(_complete_graph, settings.supports))))
        if settings.view.coco:
            sums.append(write_synced(scene / "scene_gt_coco.json", _format_coco(blocks, len(names) + settings.view.graph, settings)))
        if (scene / PICKS).exists():
            lines = format_picks(scene / PICKS, blocks.camera, settings.view.resolution)
            sums.append(write_synced(scene / "scene_picks.json", map(str.encode, lines)))
            (scene / PICKS).unlink()
    with (scene / CHECKSUMS).open(encoding="ascii") as file:
        sums += file
    for name in (ANNOTATIONS, CHECKSUMS):
        (scene / name).unlink()
    for folder in (*(entry for entry in sorted(scene.iterdir()) if entry.is_dir()), scene):
        sync_folder(folder)
    parts = (line.split(" ", 2) for line in sums)
    return "".join(f"{digest} {size} {place}/{_add_sensor(name, settings.sensor)}" for digest, size, name in parts)


def _add_sensor(name: str, sensor: str) -> str:
    """Name of a file or image folder of a scene, or a path that begins with it, with the suffix of its sensor."""
    first, slash, rest = name.partition("/")
    stem, dot, kind = first.partition(".")
    return f"{stem}{sensor}{dot}{kind}{slash}{rest}"


class AnnotationBlocks:
    """Random access by frame to a file of `annotation_block`s, which may be too large for the memory."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.frames: list[int] = []
        """Frame of each block, sorted."""
        self._places: dict[int, list[tuple[int, int]]] = {}
        """Frame -> (offset, size) of each entry [B]."""
        while head := file.readline():
            frame, *sizes = map(int, head.split())
            *begins, end = itertools.accumulate((size + 1 for size in sizes), initial=file.tell())
            self._places[frame] = list(zip(begins, sizes, strict=True))
            self.frames.append(frame)
            file.seek(end)
        self.frames.sort()

    def check_frames(self, scene: Path, images: Sequence[int]) -> None:
        """Raise OutputError unless there is one block of each image."""
        if self.frames != list(images):
            raise OutputError(f"{scene} has {len(self.frames)} of {len(images)} frames; this is an error of synpick-warp, please report it")

    def camera(self, frame: int) -> dict[str, Any] | None:
        """Entry of a frame in scene_camera.json; None: the scene has no such image."""
        return json.loads(next(self.read(frame, 0, 1))) if frame in self._places else None

    def read(self, frame: int, begin: int, end: int | None) -> Iterator[bytes]:
        """Read entries `begin` to `end`, exclusive, of a frame."""
        for offset, size in self._places[frame][begin:end]:
            self._file.seek(offset)
            yield self._file.read(size)


def _complete_graph(supports: Sequence[FrameSupport], frame: int, text: bytes) -> bytes:
    """Complete the JSON of a view's entry in scene_graph.json by what its frame's contacts tell."""
    return to_json(graph_entry(orjson.loads(text), supports[frame] if supports else None))


def _format_keyed(
    blocks: AnnotationBlocks, index: int, change: Callable[[int, bytes], bytes] = lambda frame, text: text
) -> Iterator[bytes]:
    """Format entry `index` of all views, as `change` of frame and text returns it, as a JSON object with a key for each frame."""
    yield b"{\n"
    for position, frame in enumerate(blocks.frames):
        (text,) = blocks.read(frame, index, index + 1)
        yield b'%s  "%d": %s' % (b",\n" if position else b"", frame, change(frame, text))
    yield b"\n}\n"


def _format_coco(blocks: AnnotationBlocks, first: int, settings: SceneSettings) -> Iterator[bytes]:
    """Format scene_gt_coco.json; the views' annotations are their entries from `first` on, and get their ids here, from 1."""
    head = {
        "info": {
            "description": f"synpick_{settings.split}",
            "url": "",
            "version": "1.0",
            "year": int(DATE[:4]),
            "contributor": "synpick-warp",
            "date_created": DATE,
        },
        "licenses": [{"id": 1, "name": "as of the models", "url": ""}],
        "categories": settings.categories,
        "images": [_coco_image(frame, settings) for frame in blocks.frames],
    }
    yield json.dumps(head)[:-1].encode() + b', "annotations": [\n'
    annotation_id = 0
    for frame in blocks.frames:
        for text in blocks.read(frame, first, None):
            annotation_id += 1
            yield b'%s{"id": %d, %s' % (b",\n" if annotation_id > 1 else b"", annotation_id, text[1:])
    yield b"\n]}\n"


def _coco_image(frame: int, settings: SceneSettings) -> dict[str, object]:
    return {
        "id": frame,
        "file_name": f"rgb{settings.sensor}/{frame:06d}{settings.view.color_suffix}",
        "width": settings.view.resolution[0],
        "height": settings.view.resolution[1],
        "date_captured": DATE,
        "license": 1,
        "coco_url": "",
        "flickr_url": "",
    }


def commit_sensor_scene(scenes: tuple[Path, ...], place: Path, out: Path, settings: tuple[SceneSettings, ...]) -> None:
    """Task of the multisensor layout of BOP-Industrial 2025: complete the scenes of an episode's cameras, which are staged in the classic
    layout, bring them together in one folder, with folders and annotation files for each camera, and rename it to its place.

    The rename of the folder is the commit: a killed bake leaves nothing at `place`.
    """
    whole = scenes[0].with_name(f"{scenes[0].name}-sensors")
    whole.mkdir()
    sums: list[str] = []
    for scene, own in zip(scenes, settings, strict=True):
        sums.append(complete_scene(scene, place, own))
        for path in sorted(scene.iterdir()):
            path.rename(whole / _add_sensor(path.name, own.sensor))
    spooled_checksums(out, place).write_text("".join(sums), encoding="utf-8")
    sync_folder(whole)
    whole.rename(out / place)
    sync_folder((out / place).parent)
