"""BOP writer: data sets written by the real pool from views of boxes, read back with OpenCV and json. Multisensor layout: one scene per
episode whose files equal those of the classic layout. Of both, bop_dataset_params.py, run on a stand-in for the toolkit's module."""

import gc
import json
import os
import runpy
import shutil
import signal
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import ClassVar

import cv2
import numpy as np
import pytest
import trimesh

import synpick_warp
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.configs.cell.cameras import Effects
from synpick_warp.configs.schema import Config
from synpick_warp.errors import CatalogError, OutputError
from synpick_warp.exporters.bop.scene import CHECKSUMS, SceneSettings, commit_scenes, create_scene_folders
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shared import encode_model, write_models
from synpick_warp.exporters.bop.view import ANNOTATIONS, ViewSettings, annotation_block
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.writing.files import PARTIAL, open_folder, spooled_checksums, write_checksums
from synpick_warp.exporters.writing.png import encode_png
from synpick_warp.scenes.types import Catalog
from synpick_warp.system.codecs.jpeg import encode_jpeg
from synpick_warp.testing import box_views
from synpick_warp.testing.box_views import SIZES, batches, cameras, catalog, config, poses
from synpick_warp.testing.exporters import FRAMES, ExporterContract, digests, export, export_context, exporting, feed, finish, with_files
from tests.worlds.box_sets import EPISODES, write_set

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


FOLDERS = {"rgb", "depth", "mask", "mask_visib"}
RECORDS = {"scene_camera.json", "scene_gt.json", "scene_gt_info.json"}


def test_folder_tree_is_exactly_bops(dataset, split):
    targets = {"test_targets_bop19.json", "test_targets_bop24.json"}
    names = {"bop_dataset_params.py", "camera.json", "dataset_info.md", "models", "models_eval", "train_pbr"}
    assert {path.name for path in dataset.iterdir()} == names | targets
    assert {path.name for path in split.iterdir()} == {f"{scene:06d}" for scene in (0, 1, 2, 6, 7, 8)}
    frames = [f"{frame:06d}" for frame in range(FRAMES)]
    masks = {f"{name}_{index:06d}.png" for name in frames for index in range(3)}
    files = {"rgb": {f"{name}.jpg" for name in frames}, "depth": {f"{name}.png" for name in frames}, "mask": masks, "mask_visib": masks}
    for scene in split.iterdir():
        assert {path.name for path in scene.iterdir()} == FOLDERS | RECORDS | {"scene_gt_coco.json"}
        assert {name: {path.name for path in (scene / name).iterdir()} for name in FOLDERS} == files
    record = {"width": 96, "height": 72, "fx": 288.0, "fy": 288.0, "cx": 48.0, "cy": 36.0, "depth_scale": 0.1}
    assert load(dataset / "camera.json") == record


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


@pytest.mark.parametrize("folder", ["models", "models_eval"])
def test_models_are_toolkit_compatible_ply_in_millimetres(dataset, folder):
    infos = load(dataset / folder / "models_info.json")
    for obj_id, size in SIZES.items():
        mesh = trimesh.load(dataset / folder / f"obj_{obj_id:06d}.ply", process=False)
        np.testing.assert_allclose(mesh.extents, 1000 * np.array(size), rtol=1e-6)
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
    np.testing.assert_array_equal(cv2.imread(str(out / "test/000000/rgb/000000.png"))[..., ::-1], VIEW.color[0])
    assert {path.name for path in (out / "test/000000").iterdir()} == {"rgb", "depth"} | RECORDS


def test_a_set_without_episodes_has_empty_targets(tmp_path):
    with exporting(BopExporter, tmp_path, config()) as exporter:
        exporter.write_constants()
        finish(exporter)
    assert [load(tmp_path / f"test_targets_bop{year}.json") for year in (19, 24)] == [[], []]


def test_a_killed_writer_is_reported_and_committed_scenes_stay(tmp_path):
    with exporting(BopExporter, tmp_path, config(), 2) as exporter:
        exporter.write_constants()
        pool = export_context(exporter).pool
        feed(exporter, (0,))
        pool.wait()
        os.kill(pool.pids()[0], signal.SIGKILL)
        with pytest.raises(OutputError, match="a writer process was ended by SIGKILL"):
            _ = [feed(exporter, (1,)) for _ in range(100)]
        pool.abort()
    assert sorted(path.name for path in (tmp_path / "train_pbr").iterdir()) == ["000000", "000001", "000002"]
    gc.collect()  # CPython 3.12.1 crashed here while errors of failed sends kept views of a BytesIO.


def test_annotation_blocks_are_sorted_and_checked_for_completeness(tmp_path):
    settings = SceneSettings(ViewSettings(".jpg", 95, (), True, True, {}, (4, 3)), "train_pbr", range(3), ())
    for frames in ((2, 0, 1), (2, 0, 1, 0), (2, 0)):
        scene, place = tmp_path / "hidden", Path("-".join(map(str, frames)))
        create_scene_folders(scene, ("rgb", "depth", "mask", "mask_visib"))
        (tmp_path / PARTIAL).mkdir(exist_ok=True)
        with open_folder(scene, CHECKSUMS) as folder:
            for frame in frames:
                annotations = [b'{"of": %d}' % frame] * frame
                folder.append(ANNOTATIONS, annotation_block(frame, (b'{"view": %d}' % frame, b"[]", b"[1]", *annotations)))
                folder.write(f"rgb/{frame}.jpg", b"%d" % frame)
        if frames != (2, 0, 1):
            with pytest.raises(OutputError, match=f"has {len(frames)} of 3 frames"):
                commit_scenes(((scene, place),), tmp_path, (settings,))
            assert not (tmp_path / place).exists()
            shutil.rmtree(scene)
            continue
        commit_scenes(((scene, place),), tmp_path, (settings,))
        known, place = spooled_checksums(tmp_path, place).read_text(), tmp_path / place
        write_checksums(tmp_path, place.relative_to(tmp_path), tmp_path / "spooled")
        assert not spooled_checksums(tmp_path, place.relative_to(tmp_path)).exists()
        write_checksums(tmp_path, place.relative_to(tmp_path), tmp_path / "hashed")
        for name in ("spooled", "hashed"):
            assert sorted((tmp_path / name).read_text().splitlines()) == sorted(known.splitlines())
        assert load(place / "scene_camera.json") == {str(frame): {"view": frame} for frame in range(3)}
        assert list(load(place / "scene_gt_info.json").items()) == [(str(frame), [1]) for frame in range(3)]
        assert load(place / "scene_gt_coco.json")["annotations"] == [
            {"id": number, "of": frame} for number, frame in ((1, 1), (2, 2), (3, 2))
        ]
        assert not (place / ANNOTATIONS).exists()
        assert not (place / CHECKSUMS).exists()


def test_bop_models_are_copied_byte_for_byte(tmp_path):
    source, entry = tmp_path / "source", catalog().entries[0]
    source.mkdir()
    model, label = encode_model(entry).replace(b"TextureFile obj_000003.png", b"TextureFile label.png"), encode_png(entry.material.texture)
    (source / "obj_000003.ply").write_bytes(model)
    info = {"3": {"diameter": 197.98, "min_x": -80.0, "note": "kept"}}
    (source / "models_info.json").write_text(json.dumps(info))
    entry = replace(entry, source=source / "obj_000003.ply")
    with pytest.raises(CatalogError, match=r"refers to 'label\.png', but there is no file"):
        write_models(Catalog((entry,)), tmp_path / "without")
    # Read without its texture, which was missing: a copy would name it.
    write_models(Catalog((replace(entry, material=replace(entry.material, texture=None)),)), tmp_path / "plain")
    assert b"TextureFile" not in (tmp_path / "plain" / "obj_000003.ply").read_bytes()
    (source / "label.png").write_bytes(label)
    write_models(Catalog((entry,)), tmp_path / "models")
    assert (tmp_path / "models/obj_000003.ply").read_bytes() == model
    assert (tmp_path / "models/label.png").read_bytes() == label
    assert load(tmp_path / "models/models_info.json") == info


class TestContract(ExporterContract):
    exporter_class, row = BopExporter, FORMAT_TABLE["bop"]

    @classmethod
    def config(cls) -> Config:
        return config(("flow", "classes"))


class TestMultisensorContract(ExporterContract):
    exporter_class: ClassVar = BopExporter

    @classmethod
    def config(cls) -> Config:
        return box_views.config(layout="multisensor")


@pytest.fixture(scope="module")
def folders(tmp_path_factory) -> tuple[Path, Path]:
    place = tmp_path_factory.mktemp("sensors")
    return write_set(place / "multi", BopExporter, layout="multisensor"), write_set(place / "classic", BopExporter)


def test_files_are_those_of_the_classic_layout(folders):
    multi, classic = folders
    assert sorted(path.name for path in (multi / "train").iterdir()) == [f"{episode:06d}" for episode in EPISODES]
    for episode in EPISODES:
        scene = multi / "train" / f"{episode:06d}"
        names = {path.name for path in scene.iterdir()}
        for camera in range(3):
            other = classic / "train" / f"{3 * episode + camera:06d}"
            for path in filter(Path.is_file, other.rglob("*")):
                first, *rest = path.relative_to(other).parts
                twin = scene.joinpath(f"{Path(first).stem}_cam{camera}{Path(first).suffix}", *rest)
                names.discard(twin.relative_to(scene).parts[0])
                content = path.read_bytes()
                if path.name == "scene_gt_coco.json":
                    content = content.replace(b'"rgb/', b'"rgb_cam%d/' % camera)
                assert twin.read_bytes() == content, twin
        assert names == set()


def test_targets_name_images_of_the_first_sensor_and_of_all(folders):
    multi, classic = folders
    lists = {year: json.loads((multi / f"test_targets_{year}.json").read_text()) for year in ("bop19", "bop24", "multiview_bop25")}
    images = [(episode, frame) for episode in EPISODES for frame in range(FRAMES)]
    assert [(target["scene_id"], target["im_id"]) for target in lists["bop24"]] == images
    expected = [{"im_id": [[f"cam{camera}", frame] for camera in range(3)], "scene_id": episode} for episode, frame in images]
    assert lists["multiview_bop25"] == expected
    known = json.loads((classic / "test_targets_bop19.json").read_text())
    first = [target | {"scene_id": target["scene_id"] // 3} for target in known if target["scene_id"] % 3 == 0]
    assert lists["bop19"] == first


def test_it_opens_by_episode_and_validation_finds_the_same_in_both_layouts(folders):
    assert [list(synpick_warp.open(folder)) for folder in folders] == [list(EPISODES)] * 2
    multi, classic = (
        {found.rule for found in validate(folder, ValidationOptions(sample=0, images=False), Summary())} for folder in folders
    )
    assert multi <= classic


@pytest.fixture
def toolkit(monkeypatch) -> ModuleType:
    """A stand-in for bop_toolkit_lib.dataset_params."""

    def unknown(datasets_path: str, name: str, *rest: object, **more: object) -> dict[str, object]:
        raise ValueError(f"Unknown BOP dataset ({name}).")

    package, module = ModuleType("bop_toolkit_lib"), ModuleType("bop_toolkit_lib.dataset_params")
    for name in ("get_split_params", "get_model_params", "get_camera_params"):
        setattr(module, name, unknown)
    module.inout = SimpleNamespace(load_cam_params=lambda path: {"im_size": json.loads(Path(path).read_text())["width"]})
    package.dataset_params = module
    monkeypatch.setitem(sys.modules, "bop_toolkit_lib", package)
    monkeypatch.setitem(sys.modules, "bop_toolkit_lib.dataset_params", module)
    return module


@pytest.mark.parametrize("layout", ["classic", "multisensor"])
def test_paths_of_the_entry_exist(toolkit, tmp_path, layout):
    folder = write_set(tmp_path / "synpick", BopExporter, layout=layout)
    runpy.run_path(str(folder / "bop_dataset_params.py"))
    split = toolkit.get_split_params(str(tmp_path), "synpick", "train", split_type=None)
    classic = layout == "classic"
    assert split["scene_ids"] == ([3 * episode + camera for episode in EPISODES for camera in range(3)] if classic else list(EPISODES))
    assert split["eval_sensor"] == (None if classic else "cam0")
    assert split["im_size"] == ((96, 72) if classic else {"": (96, 72), "cam0": (96, 72), "cam1": (96, 72), "cam2": (96, 72)})
    templates = {name: path for name, path in split.items() if name.endswith("_tpath")}
    assert len(templates) == (9 if classic else 3 * 2 * 7)
    for scene in split["scene_ids"]:
        for name, path in templates.items():
            if name != "gray_tpath":
                assert os.path.isfile(path.format(scene_id=scene, im_id=FRAMES - 1, gt_id=2)), path
    keys = {"scene_gt_tpath", "rgb_tpath"} if classic else {"scene_gt_rgb_cam1_tpath", "mask_visib_depth_cam2_tpath", "depth_cam0_tpath"}
    assert keys <= set(templates)


def test_models_cameras_and_other_data_sets(toolkit, tmp_path):
    folder = make(tmp_path / "synpick", episodes=(0,))
    runpy.run_path(str(folder / "bop_dataset_params.py"))
    models = toolkit.get_model_params(str(tmp_path), "synpick", "eval")
    assert (models["obj_ids"], models["symmetric_obj_ids"]) == ([3, 7], [7])
    assert all(os.path.isfile(models["model_tpath"].format(obj_id=obj_id)) for obj_id in models["obj_ids"])
    assert toolkit.get_split_params(str(tmp_path), "synpick", "train", "pbr")["rgb_tpath"].endswith(".jpg")
    assert toolkit.get_camera_params(str(tmp_path), "synpick")["im_size"] == 96
    with pytest.raises(ValueError, match=r"Unknown BOP dataset \(lm\)"):
        toolkit.get_split_params(str(tmp_path), "lm", "test")
    with pytest.raises(ValueError, match="synpick has no split test; splits: train_pbr"):
        toolkit.get_split_params(str(tmp_path), "synpick", "test")
    notes = (folder / "dataset_info.md").read_text()
    for text in ("run_path('$BOP_PATH/synpick/bop_dataset_params.py')", "METHOD_synpick-train-pbr.csv", "on a copy", "EGL_PLATFORM"):
        assert text in notes
    shutil.move(folder, tmp_path / "my-set")
    with pytest.raises(ValueError, match="rename"):
        runpy.run_path(str(tmp_path / "my-set" / "bop_dataset_params.py"))
