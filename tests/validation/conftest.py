"""A small data set to validate: of boxes, rendered analytically, as scenes and shards; and foreign BOP layouts that are made of it:
T-LESS, YCB-V, ITODD, BOP-Industrial (several sensors), imagewise."""

import json
import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from synpick_warp.apps.validation.registry import Violation
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.testing import box_views
from tests.harness import scripted_bake
from tests.validation.faults import TARGETS, edit, read, write

WIDTH, HEIGHT = 200, 150


@pytest.fixture(scope="session")
def good(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A correct data set: an episode of two frames in three cameras, with masks, COCO annotations, shards and picks. Read only."""
    out = tmp_path_factory.mktemp("validation") / "set"
    given = {"cameras.resolution": (WIDTH, HEIGHT), "bop.split": "train", "bop.color_format": "png", "bop.masks": True, "bop.coco": True}
    config = scripted_bake.settings(1, ("bop", "shards", "picks")).with_values(given)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scripted_bake, "_LENSES", box_views.cameras(WIDTH, HEIGHT))
        scripted_bake.bake(out, config, picks=True)
    return out


@pytest.fixture
def copy(good: Path, tmp_path: Path) -> Path:
    """A copy of the correct data set, to be damaged."""
    return Path(shutil.copytree(good, tmp_path / "set"))


@pytest.fixture(scope="session")
def check() -> Callable[..., list[Violation]]:
    """Validate a folder in this process, rendering every view again."""

    def run(folder: Path, **options: object) -> list[Violation]:
        return list(validate(folder, ValidationOptions(**({"sample": None, "threads": 1} | options)), Summary()))

    return run


SAFELY = {"filter": "data"} if hasattr(tarfile, "data_filter") else {}
"""Options that extract a tar file without leaving the folder; Python has them since 3.11.4."""
NOISE = 3.0
"""Standard deviation of a sensor's depth [mm]."""


def copy_parts(good: Path, out: Path, *names: str) -> None:
    """Copy files and folders into a new folder."""
    out.mkdir()
    for name in names:
        (shutil.copytree if (good / name).is_dir() else shutil.copy)(good / name, out / name)


def _strip(good: Path, out: Path) -> Path:
    """Copy what a foreign set has: no manifest, no shards, no instance ids."""
    copy_parts(good, out, "camera.json", "models", "models_eval", "train", TARGETS)
    for path in out.glob("train/*/scene_gt.json"):
        edit(path, lambda content: [item.pop("instance_id") for items in content.values() for item in items] and None)
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
    def renamed(records: list[dict[str, int]]) -> list[dict[str, int]]:
        return [record | {"scene_id": scenes[record["scene_id"]], "im_id": images[record["im_id"]]} for record in records]

    edit(out / TARGETS, renamed)


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
        edit(path, lambda content: [item.pop(key) for item in content.values() for key in ("cam_R_w2c", "cam_t_w2c")] and None)
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
    edit(out / TARGETS, lambda records: [record for record in records if record["scene_id"] == 0])
    return out


def multisensor(good: Path, out: Path) -> Path:
    """BOP-Industrial 2025: one scene, whose files have the sensor's name; instances keep their ids."""
    copy_parts(good, out, "models", "models_eval")
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
    (out / TARGETS).write_text("[]")
    return out


def imagewise(good: Path, out: Path) -> Path:
    """Imagewise: the members of all shards as files of one folder."""
    copy_parts(good, out, "models", "models_eval", "camera.json")
    for shard in sorted((good / "train_web").glob("*.tar")):
        with tarfile.open(shard) as tar:
            tar.extractall(out / "train_pbr", **SAFELY)
    return out


LAYOUTS = {make.__name__: make for make in (tless, ycbv, itodd, multisensor, imagewise)}
