"""BOP writer: data sets written by the real pool from views of boxes, read back with OpenCV and json."""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import re
import shutil
import signal
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.configs.cell.sensors import Effects
from synpick_warp.configs.schema import Config
from synpick_warp.errors import CatalogError, OutputError
from synpick_warp.exporters.bop.exporter import BopExporter
from synpick_warp.exporters.bop.scene import SceneSettings, commit_scenes, create_scene_folders
from synpick_warp.exporters.bop.shared.models import encode_model, write_models
from synpick_warp.exporters.bop.view import ANNOTATIONS, annotation_block
from synpick_warp.exporters.writing.files import open_folder
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.codecs.jpeg import encode_jpeg
from tests.exporters.writing.test_rle import decode
from tests.harness.exporter_contract import ExporterContract, digests, export, export_context, exporting, feed, finish, with_files
from tests.twins.masks import masks_of_batch
from tests.worlds.box_views import OBJECT_IDS, SIZES, batches, cameras, catalog, config, poses

EPISODES = (0, 2)
FRAMES = 3
LENSES = cameras()
VIEW = next(batches(1, (0,), 1, LENSES))


def make(out: Path, processes: int = 0, episodes: tuple[int, ...] = EPISODES, **bop: object) -> Path:
    return export(BopExporter, out, config(**bop), episodes, processes)


def load(path: Path) -> object:
    return json.loads(path.read_text())


def light_of(episode: int) -> dict[str, object]:
    direction = [0.0, 0.6, 0.8] if episode else None
    return {"map": f"map {episode}", "yaw": 0.5 * episode, "exposure": -0.25, "direction": direction}


def rows():
    """Every view of the data set: its batch, scene and frame."""
    for batch in batches(1, EPISODES, FRAMES, LENSES):
        yield batch, f"{3 * int(batch.episode[0]) + int(batch.camera[0]):06d}", int(batch.frame[0])


@pytest.fixture(scope="module")
def dataset(tmp_path_factory) -> Path:
    return make(tmp_path_factory.mktemp("bop") / "not" / "there" / "yet")


@pytest.fixture(scope="module")
def split(dataset) -> Path:
    return dataset / "train_pbr"


def test_folder_tree_is_exactly_bops(dataset, split):
    assert {path.name for path in dataset.iterdir()} == {
        "bop_dataset_params.py",
        "camera.json",
        "dataset_info.md",
        "models",
        "models_eval",
        "test_targets_bop19.json",
        "test_targets_bop24.json",
        "train_pbr",
    }
    assert {path.name for path in split.iterdir()} == {f"{scene:06d}" for scene in (0, 1, 2, 6, 7, 8)}
    for scene in split.iterdir():
        assert {path.name for path in scene.iterdir()} == {
            "rgb",
            "depth",
            "mask",
            "mask_visib",
            "scene_camera.json",
            "scene_gt.json",
            "scene_gt_info.json",
            "scene_gt_coco.json",
        }
        names = [f"{frame:06d}" for frame in range(FRAMES)]
        masks = {f"{name}_{index:06d}.png" for name in names for index in range(3)}
        assert {path.name for path in (scene / "rgb").iterdir()} == {f"{name}.jpg" for name in names}
        assert {path.name for path in (scene / "depth").iterdir()} == {f"{name}.png" for name in names}
        assert {path.name for path in (scene / "mask").iterdir()} == masks
        assert {path.name for path in (scene / "mask_visib").iterdir()} == masks


def test_images_and_masks_read_back(split):
    for batch, scene, frame in rows():
        depth = cv2.imread(str(split / scene / "depth" / f"{frame:06d}.png"), cv2.IMREAD_UNCHANGED)
        assert depth.dtype == np.uint16
        np.testing.assert_array_equal(depth, batch.depth[0])
        color = cv2.imread(str(split / scene / "rgb" / f"{frame:06d}.jpg"))[..., ::-1]
        assert np.median(np.abs(color.astype(int) - batch.color[0])) <= 3
        for index, instance in enumerate(np.flatnonzero(OBJECT_IDS >= 0)):
            name = f"{frame:06d}_{index:06d}.png"
            amodal = cv2.imread(str(split / scene / "mask" / name), cv2.IMREAD_UNCHANGED)
            visible = cv2.imread(str(split / scene / "mask_visib" / name), cv2.IMREAD_UNCHANGED)
            assert amodal.dtype == visible.dtype == np.uint8
            np.testing.assert_array_equal(amodal, np.where(masks_of_batch(batch)[instance], 255, 0))
            np.testing.assert_array_equal(visible, np.where(batch.instance[0] == 1 + instance, 255, 0))


def test_cameras_and_model_to_camera_poses_in_millimetres(split):
    corners = np.array([[0.08, -0.05, 0.03], [0.0, 0.01, -0.02]])
    for _, scene, frame in rows():
        camera = load(split / scene / "scene_camera.json")[str(frame)]
        lens = LENSES[int(scene) % 3]
        assert camera == {
            "cam_K": lens.matrix.ravel().tolist(),
            "cam_R_w2c": lens.rotation.ravel().tolist(),
            "cam_t_w2c": (1000 * lens.translation).tolist(),
            "depth_scale": 0.1,
            "light": light_of(int(scene) // 3),
        }
        truth = load(split / scene / "scene_gt.json")[str(frame)]
        assert [record["instance_id"] for record in truth] == [0, 2, 3]
        assert [record["obj_id"] for record in truth] == [3, 7, 3]
        for record in truth:
            pose = poses(int(scene) // 3, frame)[record["instance_id"]].astype(np.float64)
            world = trimesh.transformations.quaternion_matrix(pose[[6, 3, 4, 5]])[:3, :3] @ corners.T + pose[:3, None]
            expected = 1000 * (lens.rotation @ world + lens.translation[:, None])
            transformed = np.reshape(record["cam_R_m2c"], (3, 3)) @ (1000 * corners.T) + np.reshape(record["cam_t_m2c"], (3, 1))
            np.testing.assert_allclose(transformed, expected, rtol=0, atol=1e-9)


def test_counts_and_boxes(split):
    for batch, scene, frame in rows():
        infos = load(split / scene / "scene_gt_info.json")[str(frame)]
        assert len(infos) == 3
        for info, instance in zip(infos, np.flatnonzero(OBJECT_IDS >= 0), strict=True):
            total, valid, visible = batch.pixels[0, instance].tolist()
            assert (info["px_count_all"], info["px_count_valid"], info["px_count_visib"]) == (total, valid, visible)
            assert info["visib_fract"] == visible / total
            ys, xs = np.nonzero(batch.instance[0] == 1 + instance)
            if visible:
                assert info["bbox_visib"] == [xs.min(), ys.min(), np.ptp(xs), np.ptp(ys)]
                x_min, y_min, x_max, y_max = batch.boxes[0, instance, 0].tolist()
                assert info["bbox_obj"] == [x_min, y_min, x_max - x_min, y_max - y_min]
            else:
                assert info["bbox_visib"] == info["bbox_obj"] == [-1, -1, -1, -1]


def test_views_cover_clipped_and_occluded_objects(split):
    """One object is clipped by the left border, another is partly hidden."""
    infos = [info for scene in split.iterdir() for view in load(scene / "scene_gt_info.json").values() for info in view]
    assert any(info["bbox_obj"][0] < 0 and info["px_count_visib"] for info in infos)
    assert any(0 < info["visib_fract"] < 0.9 and info["bbox_obj"][0] >= 0 for info in infos)


def test_coco_masks_and_boxes(split):
    for scene in split.iterdir():
        coco = load(scene / "scene_gt_coco.json")
        assert coco["categories"] == [{"id": obj_id, "name": f"box {obj_id}", "supercategory": "synpick"} for obj_id in SIZES]
        assert [image["file_name"] for image in coco["images"]] == [f"rgb/{frame:06d}.jpg" for frame in range(FRAMES)]
        assert [annotation["id"] for annotation in coco["annotations"]] == list(range(1, len(coco["annotations"]) + 1))
        expected = []
        for frame, infos in load(scene / "scene_gt_info.json").items():
            for index, (info, record) in enumerate(zip(infos, load(scene / "scene_gt.json")[frame], strict=True)):
                name = f"{int(frame):06d}_{index:06d}.png"
                amodal, visible = (cv2.imread(str(scene / one / name), cv2.IMREAD_UNCHANGED) > 0 for one in ("mask", "mask_visib"))
                if visible.any():
                    expected.append((int(frame), record["obj_id"], amodal, visible, info))
        assert len(expected) == len(coco["annotations"])
        for annotation, (frame, obj_id, amodal, visible, info) in zip(coco["annotations"], expected, strict=True):
            assert (annotation["image_id"], annotation["category_id"], annotation["area"]) == (frame, obj_id, visible.sum())
            ys, xs = np.nonzero(amodal)
            assert annotation["bbox"] == [xs.min(), ys.min(), np.ptp(xs) + 1, np.ptp(ys) + 1]
            assert annotation["ignore"] == (info["visib_fract"] < 0.1)
            np.testing.assert_array_equal(decode(annotation["segmentation"]["counts"], *annotation["segmentation"]["size"]), visible)


def test_targets_count_visible_instances(dataset, split):
    detect, localize = (load(dataset / f"test_targets_bop{year}.json") for year in (24, 19))
    views = [(int(scene.name), frame) for scene in sorted(split.iterdir()) for frame in range(FRAMES)]
    assert [(target["scene_id"], target["im_id"]) for target in detect] == views
    expected = []
    for scene, frame in views:
        infos = load(split / f"{scene:06d}" / "scene_gt_info.json")[str(frame)]
        truth = load(split / f"{scene:06d}" / "scene_gt.json")[str(frame)]
        visible = [record["obj_id"] for record, info in zip(truth, infos, strict=True) if info["visib_fract"] >= 0.1]
        expected += [
            {"im_id": frame, "inst_count": visible.count(obj_id), "obj_id": obj_id, "scene_id": scene} for obj_id in sorted(set(visible))
        ]
    assert localize == expected
    assert {target["inst_count"] for target in localize} == {1, 2}


def test_camera_file(dataset):
    record = {"width": 96, "height": 72, "fx": 288.0, "fy": 288.0, "cx": 48.0, "cy": 36.0, "depth_scale": 0.1}
    assert load(dataset / "camera.json") == record


@pytest.mark.parametrize("folder", ["models", "models_eval"])
def test_models_are_toolkit_compatible_ply_in_millimetres(dataset, folder):
    infos = load(dataset / folder / "models_info.json")
    for obj_id, size in SIZES.items():
        path = dataset / folder / f"obj_{obj_id:06d}.ply"
        np.testing.assert_allclose(trimesh.load(path, process=False).extents, 1000 * np.array(size), rtol=1e-6)
        header = path.read_bytes().split(b"end_header")[0].decode()
        assert set(re.findall(r"property (?:list )?(\w+)", header)) <= {"float", "uchar", "int", "uint"}
        assert [infos[str(obj_id)][f"size_{axis}"] for axis in "xyz"] == pytest.approx(1000 * np.array(size))
        assert infos[str(obj_id)]["diameter"] == pytest.approx(1000 * np.linalg.norm(size))
    assert infos["7"]["symmetries_discrete"] == [[-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 2, 0, 0, 0, 1]]
    assert infos["7"]["symmetries_continuous"] == [{"axis": [0, 0, 1], "offset": [1, 0, 0]}]
    texture = cv2.imread(str(dataset / folder / "obj_000003.png"))[..., ::-1]
    np.testing.assert_array_equal(texture, catalog().entries[0].material.texture)
    assert "comment TextureFile obj_000003.png" in (dataset / folder / "obj_000003.ply").read_bytes().split(b"end_header")[0].decode()


def test_files_of_the_device_stand_for_images(dataset, tmp_path):
    assert digests(export(BopExporter, tmp_path, config(), EPISODES, 2, prepare=with_files)) == digests(dataset)


def test_active_effects_are_recorded_and_jpeg_quality_is_per_view(tmp_path):
    effects = Effects(exposure_jitter=1.0, blur=(0.0, 2.0), jpeg_quality=(5, 40))
    export(BopExporter, tmp_path / "set", replace(config(), effects=effects), (0,), 0)
    for scene in range(3):
        folder = tmp_path / "set/train_pbr" / f"{scene:06d}"
        for frame in range(FRAMES):
            record = load(folder / "scene_camera.json")[str(frame)]
            first = float(10 * scene + frame)
            assert record["effects"] == {"exposure": first, "blur": first + 5, "jpeg_quality": first + 8}
            assert record["light"] == light_of(0)
            picture = next(batch.color[0] for batch, name, index in rows() if name == f"{scene:06d}" and index == frame)
            assert (folder / "rgb" / f"{frame:06d}.jpg").read_bytes() == encode_jpeg(picture, int(first) + 8).tobytes()


def test_png_colour_without_masks_and_coco(tmp_path):
    out = make(tmp_path / "set", episodes=(0,), split="test", color_format="png", masks=False, coco=False)
    batch = VIEW
    np.testing.assert_array_equal(cv2.imread(str(out / "test/000000/rgb/000000.png"))[..., ::-1], batch.color[0])
    names = {path.name for path in (out / "test/000000").iterdir()}
    assert names == {"rgb", "depth", "scene_camera.json", "scene_gt.json", "scene_gt_info.json"}


def test_an_episode_without_end_is_not_committed(tmp_path):
    with exporting(BopExporter, tmp_path / "set", config()) as exporter:
        exporter.write_constants()
        for batch in batches(5, (1,), 2, LENSES):
            exporter.write_views(batch)
        finish(exporter)
    assert list((tmp_path / "set/train_pbr").iterdir()) == []
    assert load(tmp_path / "set/test_targets_bop19.json") == load(tmp_path / "set/test_targets_bop24.json") == []


def kill_a_writer(out: Path) -> None:
    with exporting(BopExporter, out, config(), 2) as exporter:
        exporter.write_constants()
        pool = export_context(exporter).pool
        feed(exporter, (0,))
        pool.wait()
        os.kill(pool.pids()[0], signal.SIGKILL)
        for _ in range(100):
            feed(exporter, (1,))


def test_a_killed_writer_is_reported_and_committed_scenes_stay(tmp_path):
    with pytest.raises(OutputError, match="a writer process was ended by SIGKILL"):
        kill_a_writer(tmp_path)
    assert sorted(path.name for path in (tmp_path / "train_pbr").iterdir()) == ["000000", "000001", "000002"]
    gc.collect()  # CPython 3.12.1 crashed here while errors of failed sends kept views of a BytesIO.


def test_annotation_blocks_are_sorted_and_checked_for_completeness(tmp_path):
    settings = SceneSettings("train_pbr", range(3), 4, 3, ".jpg", True, categories=())
    for frames in ((2, 0, 1), (2, 0, 1, 0), (2, 0)):
        scene, place = tmp_path / "hidden", tmp_path / "-".join(map(str, frames))
        create_scene_folders(scene, ("rgb", "depth", "mask", "mask_visib"))
        with open_folder(scene) as folder:
            for frame in frames:
                annotations = [b'{"of": %d}' % frame] * frame
                folder.append(ANNOTATIONS, annotation_block(frame, (b'{"view": %d}' % frame, b"[]", b"[1]", *annotations)))
        if frames != (2, 0, 1):
            with pytest.raises(OutputError, match=f"has {len(frames)} of 3 frames"):
                commit_scenes(((scene, place),), (settings,))
            assert not place.exists()
            shutil.rmtree(scene)
            continue
        commit_scenes(((scene, place),), (settings,))
        assert load(place / "scene_camera.json") == {str(frame): {"view": frame} for frame in range(3)}
        assert list(load(place / "scene_gt_info.json").items()) == [(str(frame), [1]) for frame in range(3)]
        assert load(place / "scene_gt_coco.json")["annotations"] == [
            {"id": number, "of": frame} for number, frame in ((1, 1), (2, 2), (3, 2))
        ]
        assert not (place / ANNOTATIONS).exists()


def catalog_from_file(path: Path) -> Catalog:
    entry = catalog().entries[0]
    return Catalog((type(entry)(**{**entry.__dict__, "source": path}),))


def test_bop_models_are_copied_byte_for_byte(tmp_path):
    source = tmp_path / "source"
    source.mkdir()
    model = encode_model(catalog().entries[0]).replace(b"TextureFile obj_000003.png", b"TextureFile label.png")
    (source / "obj_000003.ply").write_bytes(model)
    info = {"diameter": 197.98, "min_x": -80.0, "note": "kept"}
    (source / "models_info.json").write_text(json.dumps({"3": info}))
    with pytest.raises(CatalogError, match=r"refers to 'label\.png', but there is no file"):
        write_models(tmp_path / "without", catalog_from_file(source / "obj_000003.ply"))
    # Read without its texture, which was missing: a copy would name it.
    plain = catalog_from_file(source / "obj_000003.ply").entries[0]
    plain = dataclasses.replace(plain, material=dataclasses.replace(plain.material, texture=None))
    write_models(tmp_path / "plain", Catalog((plain,)))
    assert b"TextureFile" not in (tmp_path / "plain" / "obj_000003.ply").read_bytes()
    label = encode_png(catalog().entries[0].material.texture)
    (source / "label.png").write_bytes(label)
    write_models(tmp_path / "models", catalog_from_file(source / "obj_000003.ply"))
    assert (tmp_path / "models/obj_000003.ply").read_bytes() == model
    assert (tmp_path / "models/label.png").read_bytes() == label
    assert load(tmp_path / "models/models_info.json") == {"3": info}


class TestContract(ExporterContract):
    exporter_class = BopExporter

    @classmethod
    def config(cls) -> Config:
        return config(("flow", "classes"))
