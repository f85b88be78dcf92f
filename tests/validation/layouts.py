"""Foreign BOP layouts, made from a correct data set of ours: T-LESS, YCB-V, ITODD, BOP-Industrial (several sensors), imagewise."""

from __future__ import annotations

import json
import shutil
import tarfile
from pathlib import Path

import cv2
import numpy as np

from tests.validation.planting import read, write

_KEPT = ("camera.json", "models", "models_eval", "train", "test_targets_bop19.json")
SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Options that extract a tar file without leaving the folder; Python has them since 3.11.4."""
NOISE = 3.0
"""Standard deviation of a sensor's depth [mm]."""


def _strip(good: Path, out: Path) -> Path:
    """Copy what a foreign set has: no manifest, no shards, no instance ids."""
    out.mkdir()
    for name in _KEPT:
        (shutil.copytree if (good / name).is_dir() else shutil.copy)(good / name, out / name)
    for path in out.glob("train/*/scene_gt.json"):
        content = json.loads(path.read_text())
        for item in (item for items in content.values() for item in items):
            del item["instance_id"]
        path.write_text(json.dumps(content))
    return out


def _rename_images(scene: Path, ids: dict[int, int]) -> None:
    """Give a scene's images other indices."""
    for path in scene.glob("scene_*.json"):
        content = json.loads(path.read_text())
        if "coco" in path.name:
            for image in content["images"]:
                image["id"] = ids[image["id"]]
                image["file_name"] = f"rgb/{image['id']:06d}.png"
            for item in content["annotations"]:
                item["image_id"] = ids[item["image_id"]]
        else:
            content = {str(ids[int(key)]): value for key, value in content.items()}
        path.write_text(json.dumps(content))
    for folder in (path for path in scene.iterdir() if path.is_dir()):
        for path in sorted(folder.iterdir(), reverse=True):
            path.rename(folder / f"{ids[int(path.name[:6])]:06d}{path.name[6:]}")


def _retarget(out: Path, scenes: dict[int, int], images: dict[int, int]) -> None:
    path = out / "test_targets_bop19.json"
    records = json.loads(path.read_text())
    path.write_text(json.dumps([record | {"scene_id": scenes[record["scene_id"]], "im_id": images[record["im_id"]]} for record in records]))


def _add_noise(split: Path) -> None:
    """Depth as a sensor measures it."""
    random = np.random.default_rng(0)
    for path in split.glob("*/depth/*.png"):
        depth = read(path)
        write(path, np.clip(depth + 10.0 * NOISE * random.standard_normal(depth.shape), 1, 65535).astype(np.uint16))


def tless(good: Path, out: Path) -> Path:
    """T-LESS: models_cad instead of models, split test_primesense, scenes from 1, measured depth, no extrinsics, no COCO file."""
    _strip(good, out)
    (out / "models").rename(out / "models_cad")
    (out / "train").rename(out / "test_primesense")
    for index in (2, 1, 0):
        (out / f"test_primesense/{index:06d}").rename(out / f"test_primesense/{index + 1:06d}")
    for path in out.glob("test_primesense/*/scene_camera.json"):
        content = json.loads(path.read_text())
        for item in content.values():
            del item["cam_R_w2c"], item["cam_t_w2c"]
        path.write_text(json.dumps(content))
    for path in out.glob("test_primesense/*/scene_gt_coco.json"):
        path.unlink()
    _add_noise(out / "test_primesense")
    _retarget(out, {0: 1, 1: 2, 2: 3}, {0: 0, 1: 1})
    return out


def ycbv(good: Path, out: Path) -> Path:
    """YCB-V: splits test (scenes from 48, images from 1 with gaps, measured depth) and train_pbr (JPEG)."""
    _strip(good, out)
    shutil.copytree(out / "train", out / "train_pbr")
    for path in out.glob("train_pbr/*/rgb/*.png"):
        cv2.imwrite(str(path.with_suffix(".jpg")), read(path))
        path.unlink()
    for path in out.glob("train_pbr/*/scene_gt_coco.json"):
        path.write_text(path.read_text().replace(".png", ".jpg"))
    (out / "train").rename(out / "test")
    for index in range(3):
        (out / f"test/{index:06d}").rename(out / f"test/{index + 48:06d}")
        _rename_images(out / f"test/{index + 48:06d}", {0: 1, 1: 36})
    _add_noise(out / "test")
    _retarget(out, {0: 48, 1: 49, 2: 50}, {0: 1, 1: 36})
    return out


def itodd(good: Path, out: Path) -> Path:
    """ITODD: split val of grey and depth images in TIFF, split test without ground truth, no amodal masks."""
    _strip(good, out)
    (out / "train").rename(out / "val")
    for scene in (out / "val").iterdir():
        (scene / "gray").mkdir()
        for path in (scene / "rgb").iterdir():
            write(scene / "gray" / f"{path.stem}.tif", cv2.cvtColor(read(path), cv2.COLOR_BGR2GRAY))
        shutil.rmtree(scene / "rgb")
        shutil.rmtree(scene / "mask")
        for path in list((scene / "depth").iterdir()):
            write(path.with_suffix(".tif"), read(path))
            path.unlink()
        (scene / "scene_gt_coco.json").unlink()
    shutil.copytree(out / "val/000000", out / "test/000000")
    for name in ("scene_gt.json", "scene_gt_info.json"):
        (out / "test/000000" / name).unlink()
    shutil.rmtree(out / "test/000000/mask_visib")
    path = out / "test_targets_bop19.json"
    path.write_text(json.dumps([record for record in json.loads(path.read_text()) if record["scene_id"] == 0]))
    return out


def multisensor(good: Path, out: Path) -> Path:
    """BOP-Industrial 2025: one scene, whose files have the sensor's name; instances keep their ids."""
    out.mkdir()
    for name in ("models", "models_eval"):
        shutil.copytree(good / name, out / name)
    scene = out / "test/000000"
    scene.mkdir(parents=True)
    for camera in range(3):
        source = good / f"train/{camera:06d}"
        for folder in (path for path in source.iterdir() if path.is_dir()):
            shutil.copytree(folder, scene / f"{folder.name}_cam{camera}")
        for path in source.glob("*.json"):
            text = path.read_text().replace("rgb/", f"rgb_cam{camera}/")
            (scene / f"{path.stem}_cam{camera}.json").write_text(text)
        shutil.copy(good / "camera.json", out / f"camera_cam{camera}.json")
    (out / "test_targets_bop19.json").write_text("[]")
    return out


def imagewise(good: Path, out: Path) -> Path:
    """Imagewise: the members of all shards as files of one folder."""
    out.mkdir()
    for name in ("models", "models_eval", "camera.json"):
        (shutil.copytree if (good / name).is_dir() else shutil.copy)(good / name, out / name)
    for shard in sorted((good / "train_web").glob("*.tar")):
        with tarfile.open(shard) as tar:
            tar.extractall(out / "train_pbr", **SAFELY)
    return out


LAYOUTS = {make.__name__: make for make in (tless, ycbv, itodd, multisensor, imagewise)}
