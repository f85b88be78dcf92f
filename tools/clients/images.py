"""Clients of images: BOP toolkit, webdataset, PyTorch, Hugging Face `datasets`, pycocotools, Ultralytics and supervision."""

# Runs where the packages are, which the type checker may not see; webdataset does not declare its names.
# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import contextlib
import importlib.util
import io
import json
import os
import re
import shutil
import sys
import tempfile
import warnings
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients import base

BATCH, WORKERS = 2, 2
"""Views of a batch, and workers of PyTorch's loader."""


# ---- BOP toolkit ----


def read_bop_toolkit(place: Path, data: Path, toolkit: str) -> base.ClientReading:
    """Views of a scene by the toolkit's own loaders, and one of each from its shard; the first model by its PLY reader."""
    if toolkit:
        sys.path.insert(0, toolkit)
    from bop_toolkit_lib import inout, misc
    from bop_toolkit_lib.dataset import bop_scenewise, bop_webdataset

    scene = bop_scenewise.load_scene_data(place)
    cameras, truth, infos = scene["scene_camera"], scene["scene_gt"], scene["scene_gt_info"]
    values: base.Values = {}
    for frame in base.sample_frames(len(cameras)):
        camera, rows = cameras[frame], truth[frame]
        (color,) = (place / "rgb").glob(f"{frame:06d}.*")
        values[f"rgb {frame}"] = inout.load_im(color)
        values[f"depth {frame}"] = inout.load_depth(place / f"depth/{frame:06d}.png") * camera["depth_scale"] / base.MILLIMETERS
        values[f"cam_K {frame}"] = camera["cam_K"]
        values[f"world_to_camera {frame}"] = base.make_matrix(camera["cam_R_w2c"], camera["cam_t_w2c"])
        values[f"object_to_camera {frame}"] = np.array([base.make_matrix(row["cam_R_m2c"], row["cam_t_m2c"]) for row in rows]).reshape(
            -1, 4, 4
        )
        values[f"obj_id {frame}"] = np.array([row["obj_id"] for row in rows])
        values[f"visib_fract {frame}"] = np.array([row["visib_fract"] for row in infos[frame]])
        if rows and (place / "mask").is_dir():
            for name in ("mask", "mask_visib"):
                values[f"{name} {frame}"] = bop_scenewise.load_masks(place, frame, name, len(rows)) > 0
    shard = place.parent.with_name(f"{place.parent.name}_web") / f"shard-{place.name}.tar"
    if shard.is_file():
        options = {"load_mask": True, "load_gt": True, "load_gt_info": True, "rgb_suffix": next((place / "rgb").iterdir()).suffix}
        view = bop_webdataset.load_image_data(shard, f"{place.name}_000000", **options)
        values |= {"shard rgb": view["im_rgb"], "shard mask": np.asarray(view["mask"]) > 0}
    infos = json.loads((data / "models" / "models_info.json").read_text())
    values["model"] = inout.load_ply(data / "models" / f"obj_{min(map(int, infos)):06d}.ply")["pts"]
    values["symmetries"] = np.array([len(misc.get_symmetry_transformations(info, 0.01)) > 0 for info in infos.values()])
    what = f"{place.parent.name}/{place.name}{', its shard' if shard.is_file() else ''}, a model"
    project = Path(inout.__file__).parents[1] / "pyproject.toml"
    version = re.search(r'^version = "(.*)"', project.read_text() if project.is_file() else "", re.MULTILINE)
    return base.ClientReading(what, values, versions={"bop_toolkit_lib": version[1]} if version else {})


def expect_bop_toolkit(data_set: Any) -> base.Values:
    """Views, the first one again as in its shard, and the first model; every object has a symmetry transformation, the identity."""
    import trimesh

    values = base.expect_views(data_set)
    mesh = trimesh.load_mesh(data_set.folder / "models" / f"obj_{min(map(int, data_set.models_info)):06d}.ply", process=False)
    values |= {"shard rgb": values["rgb 0"], "shard mask": values["mask 0"]}
    return values | {"model": np.asarray(mesh.vertices), "symmetries": np.ones(len(data_set.models_info), bool)}


# ---- shards, PyTorch, Hugging Face ----


def find_shards(data: Path) -> Path | None:
    """Folder of the first shard; None: there is none."""
    shard = base.first_shard(data)
    return None if shard is None else shard.parent


def find_views(data: Path) -> Path | None:
    """The data set, if it has views; else None."""
    return data if base.first_scene(data) or base.first_shard(data) else None


def read_shards(place: Path, data: Path, _: str) -> base.ClientReading:
    """Sampled views of the first shard through webdataset's own pipeline with our decoder; two batches with torch, if that is installed."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Its import looks for torch.
        import webdataset
    from synpick_warp.dataset.webdataset import decode_view

    frames = set(base.sample_frames(base.first_episode(data)["frames"]))
    values: base.Values = {}
    for frame, view in enumerate(webdataset.WebDataset(str(place), shardshuffle=False).decode(decode_view)):
        if frame not in frames:
            continue
        color = view["rgb.png"] if "rgb.png" in view else view["rgb.jpg"]
        scale = np.float32(view["camera.json"]["depth_scale"] / base.MILLIMETERS)
        values |= {f"rgb {frame}": color, f"depth {frame}": view["depth.png"] * scale, f"mask_visib {frame}": view["mask_visib.json"]}
        values[f"obj_id {frame}"] = np.array([row["obj_id"] for row in view["gt.json"]])
        if not view["gt.json"]:  # An entry without masks does not tell the image's size.
            values[f"mask_visib {frame}"] = np.zeros((0, *color.shape[:2]), bool)
    stock = next(iter(webdataset.WebDataset(str(place), shardshuffle=False).decode("l8")))["depth.png"]
    remarks = ["its own decoders clip depth to 0 and 255: use decode_view"] if set(np.unique(stock)) <= {0, 255} else []
    if importlib.util.find_spec("torch") is None:
        return base.ClientReading(place.name, values, [*remarks, "torch is not installed: no DataLoader"])
    import torch

    views = webdataset.WebDataset(str(place), shardshuffle=False).decode(decode_view).to_tuple("depth.png")
    batches = list(islice(torch.utils.data.DataLoader(views, batch_size=BATCH), 2))
    return base.ClientReading(f"{place.name}, {len(batches)} batches of {len(batches[0][0])}", values, remarks)


def read_pytorch(place: Path, data: Path, _: str) -> base.ClientReading:
    """Sampled views of the first camera of the first episode, out of batches of PyTorch's DataLoader with two workers."""
    import torch

    from synpick_warp.dataset.pytorch import Views, collate

    entry, fields = base.first_episode(data), ("rgb", "depth", "masks", "object_ids", "poses")
    views = Views(data, cameras=[0], fields=fields, min_visibility=0.0)
    subset = torch.utils.data.Subset(views, range(entry["frames"]))
    values: base.Values = {}
    batches = 0
    for batch in torch.utils.data.DataLoader(subset, batch_size=BATCH, num_workers=WORKERS, collate_fn=collate):
        batches += 1
        for row, frame in enumerate(batch["frame"].tolist()):
            if frame in base.sample_frames(entry["frames"]):
                color, depth, masks, ids, poses = (batch[name][row].numpy() for name in fields)
                values |= {f"rgb {frame}": color.transpose(1, 2, 0), f"depth {frame}": depth[0], f"visible_mask {frame}": masks}
                values |= {f"visible_obj_id {frame}": ids, f"visible_pose {frame}": poses}
    return base.ClientReading(f"{len(views)} views; {batches} batches of {BATCH} by {WORKERS} workers", values)


def read_hugging_face(place: Path, data: Path, _: str) -> base.ClientReading:
    """Sampled views of shards by `load_dataset("webdataset")`, streamed, offline, with a cache in a temporary folder."""
    os.environ |= {"HF_HUB_OFFLINE": "1", "HF_DATASETS_OFFLINE": "1"}
    with tempfile.TemporaryDirectory() as cache:
        os.environ["HF_HOME"] = cache
        import datasets

        # BOP's key_to_shard.json lies beside the shards, hence the pattern.
        stream = datasets.load_dataset("webdataset", data_dir=str(place), data_files="*.tar", streaming=True, cache_dir=cache)
        split = next(iter(stream))
        frames = set(base.sample_frames(base.first_episode(data)["frames"]))
        values: base.Values = {}
        for index, row in enumerate(islice(stream[split], max(frames) + 1)):
            if index in frames:
                color = row["rgb.png"] if "rgb.png" in row else row["rgb.jpg"]
                values |= {f"rgb {index}": np.asarray(color), f"depth_count {index}": np.asarray(row["depth.png"]).astype(np.int64)}
                values[f"obj_id {index}"] = np.array([entry["obj_id"] for entry in row["gt.json"]])
    return base.ClientReading(f"{place.name}, split {split}", values)


# ---- COCO ----


def _coco_of_scene(data: Path) -> Path | None:
    """COCO file of the first scene; None: there is none."""
    scene = base.first_scene(data)
    return scene / "scene_gt_coco.json" if scene is not None and (scene / "scene_gt_coco.json").is_file() else None


def _coco_of_split(data: Path) -> Path | None:
    """COCO file of the first split; None: there is none."""
    return min(data.glob("coco/annotations/instances_*.json"), default=None)


def find_coco(data: Path) -> Path | None:
    """COCO file of the first scene; without one, that of the first split."""
    return _coco_of_scene(data) or _coco_of_split(data)


def read_coco(place: Path, data: Path, _: str) -> base.ClientReading:
    """Masks and categories of the sampled images, of scene and split, through pycocotools' own index."""
    from pycocotools.coco import COCO

    row = base.first_episode(data)
    frames = base.sample_frames(row["frames"])
    values: base.Values = {}
    texts, remarks = [], []
    for prefix, file in (("", _coco_of_scene(data)), ("split ", _coco_of_split(data))):
        if file is None:
            continue
        with contextlib.redirect_stdout(io.StringIO()):
            coco = COCO(str(file))
        for image in coco.dataset["images"]:
            frame = image.get("frame", image["id"])
            if frame not in frames or image.get("episode", row["episode"]) != row["episode"] or image.get("camera", 0):
                continue
            rows = coco.loadAnns(sorted(coco.getAnnIds(imgIds=[image["id"]])))
            masks = np.array([coco.annToMask(item) > 0 for item in rows], bool).reshape(-1, image["height"], image["width"])
            values[f"{prefix}visible_obj_id {frame}"] = np.array([item["category_id"] for item in rows])
            values[f"{prefix}visible_mask {frame}"] = masks
        if all(category["name"].isdigit() for category in coco.dataset["categories"]):
            remarks.append(f"{file.name}: categories are named by their number")
        texts.append(f"{file.name}, {len(coco.anns)} annotations")
    return base.ClientReading("; ".join(texts), values, remarks)


def expect_coco(data_set: Any) -> base.Values:
    """Visible instances of views, as of a scene and as of a split."""
    values = base.expect_views(data_set)
    return values | {f"split {name}": value for name, value in values.items()}


# ---- YOLO ----


def read_yolo(place: Path, data: Path, _: str) -> base.ClientReading:
    """Labels of the sampled images of the first camera of the first episode. Ultralytics writes a cache beside labels: it gets a copy."""
    frames = base.sample_frames(base.first_episode(data)["frames"])
    with tempfile.TemporaryDirectory() as folder:
        os.environ["YOLO_CONFIG_DIR"] = folder
        copy = Path(shutil.copytree(place.parent, Path(folder) / "yolo"))
        lists = sorted(copy.glob("[0-9]*.txt"))
        scene, split = lists[0].stem, lists[0].read_text().split("/")[2]
        values, names = _read_ultralytics(copy, split, scene, frames)
        values |= _read_supervision(copy, split, scene, frames)
    return base.ClientReading(f"{len(lists)} scenes, {len(names)} classes", values)


def _read_ultralytics(copy: Path, split: str, scene: str, frames: list[int]) -> tuple[base.Values, dict[int, str]]:
    """Segments, filled by its own function, and oriented boxes."""
    from ultralytics.data.dataset import YOLODataset
    from ultralytics.data.utils import check_det_dataset, polygon2mask

    data = check_det_dataset(str(copy / "data.yaml"), autodownload=False)
    values: base.Values = {}
    for task in ("segment", "obb"):
        items = YOLODataset(img_path=str(copy / "images" / split), data=data, task=task, augment=False, imgsz=64)
        assert len(items.labels) == len(list((copy / "images" / split).rglob("*.*g"))), "images were left out"
        for index, label in enumerate(items.labels):
            name, (height, width) = Path(label["im_file"]).stem, label["shape"]
            if name not in {f"{scene}_{frame:06d}" for frame in frames}:
                continue
            frame, size = int(name[-6:]), np.array([width, height])
            if task == "segment":
                masks = [polygon2mask((height, width), [(part * size).reshape(-1)]) > 0 for part in label["segments"]]
                values[f"bridged_mask {frame}"] = np.array(masks, bool).reshape(-1, height, width)
                values[f"class {frame}"] = label["cls"].ravel().astype(int)
                values[f"box_of_segment {frame}"] = label["bboxes"] * np.tile(size, 2)
            else:
                values[f"oriented boxes {frame}"] = np.array(len(items[index]["bboxes"].numpy()))
    return values, data["names"]


def _read_supervision(copy: Path, split: str, scene: str, frames: list[int]) -> base.Values:
    """Masks of segments, boxes, and areas of oriented boxes."""
    import supervision

    values: base.Values = {}
    for kind, options in (("labels", {"force_masks": True}), ("boxes", {}), ("oriented_boxes", {"is_obb": True})):
        folders = (str(copy / "images" / split / scene), str(copy / kind / split / scene), str(copy / "data.yaml"))
        for path, _, detections in supervision.DetectionDataset.from_yolo(*folders, **options):
            frame = int(Path(path).stem[-6:])
            if frame not in frames:
                continue
            if kind == "labels":
                values[f"bridged_mask supervision {frame}"] = detections.mask
            elif kind == "boxes":
                low, high = detections.xyxy[:, :2], detections.xyxy[:, 2:]
                values[f"box {frame}"] = np.concatenate(((low + high) / 2, high - low), axis=1)
            else:
                x, y = np.moveaxis(detections.data["xyxyxyxy"].astype(float), 2, 0)
                crosses = x * np.roll(y, -1, axis=1) - np.roll(x, -1, axis=1) * y
                values[f"oriented_area {frame}"] = np.abs(crosses.sum(axis=1)) / 2
    return values


def expect_yolo(data_set: Any) -> base.Values:
    """Visible instances of views; bridges join the parts of a mask into one polygon."""
    import cv2

    from synpick_warp.exporters.bop.outlines import join_parts, trace_outlines
    from synpick_warp.exporters.writing.rle import find_run_boundaries

    values: base.Values = {}
    obj_ids = sorted(info.object_id for info in data_set.objects)
    for frame, view in base.sampled_views(data_set).items():
        seen = view.masks.any(axis=(1, 2))
        masks, boxes, areas = [], [], []
        for mask in view.masks[seen]:
            parts = trace_outlines(find_run_boundaries(mask.astype(np.uint8)).runs_of(1))
            joined = join_parts(parts)
            bridged = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(bridged, [joined.at_pixels().astype(np.int32)], 1)
            masks.append(mask if len(parts) == 1 else bridged > 0)
            rows, columns = np.nonzero(mask)
            low, high = np.array([columns.min(), rows.min()]), np.array([columns.max(), rows.max()]) + 1
            boxes.append(np.concatenate(((low + high) / 2, high - low)))
            corners = np.clip(cv2.boxPoints(cv2.minAreaRect(joined.points.astype(np.float32))), 0, mask.shape[::-1])
            areas.append(cv2.contourArea(corners.astype(np.float32)))
        found: dict[str, Any] = {"class": [obj_ids.index(obj_id) for obj_id in view.object_ids[seen]], "oriented boxes": len(masks)}
        found |= {"bridged_mask": masks, "bridged_mask supervision": masks, "box": boxes, "box_of_segment": boxes, "oriented_area": areas}
        values |= {f"{name} {frame}": np.array(value) for name, value in found.items()}
    return values
