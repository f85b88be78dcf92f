"""COCO annotations of a whole split: the exporter contract, and pycocotools against the views. Keypoints: farthest points of known shapes,
projections, and visibility against ray casts. YOLO labels against the views; and outlines of masks, which are exact for readers that fill
polygons by OpenCV and by pycocotools. A tick and views of 200 instances in all formats, from lists and from words, checked in float64."""

import contextlib
import dataclasses
import io
import json
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import yaml
import zarr
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pycocotools import mask as coco
from pycocotools.coco import COCO

import synpick_warp
from synpick_warp.codes import MAX_INSTANCES
from synpick_warp.configs.dataset import DataLayout, ExportSettings
from synpick_warp.configs.schema import Arrangement, Split
from synpick_warp.errors import DatasetError, OutputError
from synpick_warp.exporters.bop import yolo
from synpick_warp.exporters.bop.coco import CATEGORIES, IMAGES, PARTS, CocoExporter, commit_scenes, write_view
from synpick_warp.exporters.bop.outlines import Polygon, join_parts, trace_outlines
from synpick_warp.exporters.bop.scene_exporter import BopExporter
from synpick_warp.exporters.bop.shards import ShardsExporter
from synpick_warp.exporters.bop.view import Keypoints, ViewSettings, project_keypoints, sample_keypoints
from synpick_warp.exporters.bop.yolo import CONTENTS, YoloExporter
from synpick_warp.exporters.formats import FORMAT_TABLE
from synpick_warp.exporters.trajectory.exporter import TrajectoryExporter
from synpick_warp.exporters.usd.exporter import UsdExporter
from synpick_warp.exporters.writing.rle import Masks, find_run_boundaries
from synpick_warp.system.hardware.device import pick_device
from synpick_warp.testing.box_views import SIZES, batches, cameras, config, ends, ticks
from synpick_warp.testing.exporters import ExporterContract, digests, export, exporting, finish, with_files, without_objects
from tests.harness.environment import default_device
from tests.harness.hostile import fuzz_examples
from tests.twins.masks import masks_of_batch
from tests.worlds import trajectories
from tests.worlds.box_sets import write_set
from tests.worlds.toy_scene import dense_batch, dense_toy
from tools.checks import dataset as check
from tools.clients.base import pose_matrix
from tools.clients.trajectories import read_newton

LENSES = cameras()


class TestCocoContract(ExporterContract):
    exporter_class, row = CocoExporter, FORMAT_TABLE["coco"]


def read(out: Path, split: str = "train_pbr") -> COCO:
    """The annotation file of a split, by pycocotools, which prints."""
    with contextlib.redirect_stdout(io.StringIO()):
        return COCO(out / "coco" / "annotations" / f"instances_{split}.json")


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
def test_pycocotools_reads_back_masks_boxes_and_images(tmp_path):
    read_back = read(out := export(CocoExporter, tmp_path / "set", config(), (0, 2)))
    assert {category["id"]: category["name"] for category in read_back.loadCats(read_back.getCatIds())} == {3: "box 3", 7: "box 7"}
    views = {(row["episode"], row["camera"], row["frame"]): row for row in read_back.loadImgs(read_back.getImgIds())}
    assert len(views) == 18
    for batch in batches(1, (0, 2), 3, LENSES):
        image = views[int(batch.episode[0]), int(batch.camera[0]), int(batch.frame[0])]
        color = cv2.imread(str(out / "coco" / "images" / image["file_name"]))[..., ::-1]
        assert np.median(np.abs(color.astype(int) - batch.color[0])) <= 3
        found = read_back.loadAnns(read_back.getAnnIds(imgIds=image["id"]))
        assert [row["instance_id"] for row in found] == [index for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        for row in found:
            visible = batch.instance[0] == 1 + row["instance_id"]
            np.testing.assert_array_equal(read_back.annToMask(row), visible)
            rows, columns = np.flatnonzero(visible.any(axis=1)), np.flatnonzero(visible.any(axis=0))
            assert row["bbox"] == [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]
            x_min, y_min, x_max, y_max = batch.boxes[0, row["instance_id"], 0].tolist()
            assert row["bbox_amodal"] == [x_min, y_min, x_max - x_min + 1, y_max - y_min + 1]
            assert (row["area"], row["category_id"]) == (visible.sum(), batch.object_id[0, row["instance_id"]])


@pytest.mark.parametrize("keypoints", [0, 8])
def test_keypoints_are_those_of_bop_annotations(tmp_path, keypoints):
    scenes = [export(kind, tmp_path / kind.__name__, config(keypoints=keypoints), (0,)) for kind in (BopExporter, CocoExporter)]
    split = read(scenes[1])
    for camera in range(len(LENSES)):
        scene = json.loads((scenes[0] / "train_pbr" / f"{camera:06d}" / "scene_gt_coco.json").read_text())
        images = [index for index, image in split.imgs.items() if image["camera"] == camera]
        ours = [row for index in images for row in split.loadAnns(split.getAnnIds(imgIds=index))]
        keys = ("keypoints", "num_keypoints")
        assert [[row.get(key) for key in keys] for row in ours] == [[row.get(key) for key in keys] for row in scene["annotations"]]
        assert all(("keypoints" in row) == (keypoints > 0) for row in (*ours, *scene["categories"]))
        for mine, other in zip(split.dataset["categories"], scene["categories"], strict=True):
            assert mine == {key: value for key, value in other.items() if key != "supercategory"}
            assert len(mine.get("keypoint_positions", ())) == keypoints


def test_every_split_has_an_annotation_file(tmp_path):
    """Two splits of one episode each, and one that has not been baked."""
    splits = Split("train", 2, 0, "pick", "train_pbr"), Split("test", 2, 2, "pick", "test_pbr"), Split("val", 5, 9, "pick", "val_pbr")
    settings = dataclasses.replace(config(), splits=splits)
    out = export(CocoExporter, tmp_path / "set", settings, (0, 2))
    assert sorted(path.name for path in (out / IMAGES).iterdir()) == [f"{scene:06d}" for scene in (0, 1, 2, 6, 7, 8)]
    assert {out / name for name in CocoExporter.shared_files(DataLayout.of(settings)).indices} == set(
        (out / "coco" / "annotations").iterdir()
    )
    for split, episode in (("train_pbr", 0), ("test_pbr", 2)):
        found = read(out, split)
        assert sorted(found.imgs) == list(range(1, 10))
        assert sorted(found.anns) == list(range(1, len(found.anns) + 1))
        assert {image["episode"] for image in found.imgs.values()} == {episode}
        assert all((out / IMAGES / image["file_name"]).is_file() for image in found.imgs.values())
        assert found.dataset["info"]["description"] == f"synpick-warp, {split}"
    assert (len(read(out, "val_pbr").imgs), len(read(out, "val_pbr").cats)) == (0, 2)
    assert str(PARTS) == FORMAT_TABLE["coco"].part.folder


def test_scenes_are_checked_for_completeness(tmp_path):
    scene, settings = tmp_path / "hidden", ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(4, 3))
    empty = {frame: SimpleNamespace(frame=frame, color=(".jpg", b"image"), gt=[], gt_info=[], masks=list) for frame in range(3)}
    scene.mkdir()
    for frame in (2, 0):
        write_view(empty[frame], scene, settings)
    for name in (IMAGES, PARTS):
        (tmp_path / name).mkdir(parents=True)
    with pytest.raises(OutputError, match="has 2 of 3 frames"):
        commit_scenes(((scene, 7),), tmp_path, (range(3),))
    write_view(empty[1], scene, settings)
    commit_scenes(((scene, 7),), tmp_path, (range(3),))
    assert sorted(path.name for path in (tmp_path / IMAGES / "000007").iterdir()) == ["000000.jpg", "000001.jpg", "000002.jpg"]


@pytest.mark.parametrize("name", [str(PARTS / "000001.jsonl"), str(CATEGORIES)])
def test_views_without_objects_have_no_annotations_and_damaged_parts_are_one_error(tmp_path, name):
    out = export(CocoExporter, tmp_path / "set", config(), (0,), frames=1, prepare=without_objects)
    assert (len(read(out).imgs), len(read(out).anns)) == (3, 0)
    (out / name).write_text("[}\n")
    (out / ".partial").mkdir()
    with pytest.raises(DatasetError, match=Path(name).name):
        CocoExporter.finalize(out, ExportSettings.of(config()), None, (0,))  # type: ignore[arg-type]


# ---- keypoints ----

CAMERA = {"cam_K": [100.0, 0.0, 50.0, 0.0, 100.0, 40.0, 0.0, 0.0, 1.0], "depth_scale": 0.1}
POSE = {"obj_id": 1, "cam_R_m2c": np.eye(3).ravel().tolist(), "cam_t_m2c": [0.0, 0.0, 1000.0]}


def test_farthest_points_of_a_cube_are_its_corners_and_their_skeleton_is_a_tree():
    corners = np.array([[x, y, z] for x in (0, 0.2) for y in (0, 0.2) for z in (0, 0.2)], np.float32)
    inner = np.random.default_rng(0).uniform(0.09, 0.11, (200, 3)).astype(np.float32)
    found = sample_keypoints(np.concatenate((inner, corners)), 8)
    assert sorted(found.positions.tolist()) == sorted(np.round(1000.0 * corners.astype(float), 4).tolist())
    assert [last for _, last in found.edges] == list(range(1, 8))
    assert all(first < last for first, last in found.edges)
    assert len(sample_keypoints(np.repeat(corners, 3, axis=0), 20).positions) == 8


def test_flags_tell_outside_hidden_and_visible():
    points = {1: Keypoints(np.array([[0.0, 0, 0], [100, 0, 0], [0, 100, 0], [600, 0, 0], [0, 0, -1100]]), ())}
    depth = np.full((80, 100), 10000, np.uint16)
    depth[40, 60] = 9800  # 20 mm in front: more than a pixel's width, 10 mm, and the tolerance.
    depth[50, 50] = 9890  # 11 mm in front.
    (keys,) = project_keypoints([POSE], CAMERA, depth, points)
    assert keys == {"keypoints": [50.0, 40.0, 2, 60.0, 40.0, 1, 50.0, 50.0, 2, 0, 0, 0, 0, 0, 0], "num_keypoints": 3}
    (keys,) = project_keypoints([POSE], CAMERA, np.zeros((80, 100), np.uint16), points)
    assert keys["keypoints"][2::3] == [2, 2, 2, 0, 0]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return write_set(tmp_path_factory.mktemp("keypoints") / "set", BopExporter, keypoints=8)


def test_pycocotools_reads_keypoints_whose_flags_agree_with_rays(folder, capsys):
    flags: list[int] = []
    data = synpick_warp.open(folder)
    for scene in sorted((folder / "train").iterdir()):
        coco = COCO(str(scene / "scene_gt_coco.json"))
        categories = {category["id"]: category for category in coco.loadCats(coco.getCatIds())}
        assert {index: category["name"] for index, category in categories.items()} == {obj_id: f"box {obj_id}" for obj_id in SIZES}
        episode, camera = divmod(int(scene.name), 3)
        for annotation in coco.loadAnns(coco.getAnnIds()):
            view = data[episode].view(annotation["image_id"], camera)
            category = categories[annotation["category_id"]]
            positions = np.array(category["keypoint_positions"])
            assert len(category["keypoints"]) == len(positions) == 8
            assert sorted(np.abs(positions).max(axis=0)) == pytest.approx(sorted(np.array(SIZES[category["id"]]) * 500))
            x, y, flag = np.reshape(annotation["keypoints"], (8, 3)).T
            assert annotation["num_keypoints"] == (flag > 0).sum()
            rows = [row for row, mask in enumerate(view.masks) if mask.sum() == annotation["area"]]
            pixels = [view.project(positions / 1000, view.object_to_camera[row]) for row in rows]
            labeled = flag > 0
            assert any(np.abs(each[labeled] - np.stack((x, y), axis=1)[labeled]).max(initial=0) < 0.006 for each in pixels)
            flags += flag.astype(int).tolist()
    capsys.readouterr()
    assert set(flags) == {0, 1, 2}


def test_depth_files_of_the_device_give_the_same_flags(tmp_path):
    images = export(BopExporter, tmp_path / "images", config(keypoints=8))
    assert digests(export(BopExporter, tmp_path / "files", config(keypoints=8), prepare=with_files)) == digests(images)


# ---- YOLO ----

SIZE = np.array([LENSES[0].width, LENSES[0].height])


class TestYoloContract(ExporterContract):
    exporter_class, row = YoloExporter, FORMAT_TABLE["yolo"]


def rows(file: Path) -> list[tuple[int, np.ndarray]]:
    """Class and points [px] of each row."""
    parts = [line.split() for line in file.read_text().splitlines()]
    return [(int(index), np.array(list(map(float, values))).reshape(-1, 2) * SIZE) for index, *values in parts]


def test_labels_are_those_of_the_views(tmp_path):
    """Segments as readers fill them, boxes of the visible masks, and oriented boxes that hold them."""
    out = export(YoloExporter, tmp_path / "set", config(), (0, 2)) / "yolo"
    assert yaml.safe_load((out / "data.yaml").read_text())["names"] == {0: "box 3", 1: "box 7"}
    whole = unclipped = 0
    for batch in batches(1, (0, 2), 3, LENSES):
        scene = int(len(LENSES) * batch.episode[0] + batch.camera[0])
        place = f"train_pbr/{scene:06d}/{scene:06d}_{int(batch.frame[0]):06d}"
        color = cv2.imread(str(out / "images" / f"{place}.jpg"))[..., ::-1]
        assert np.median(np.abs(color.astype(int) - batch.color[0])) <= 3
        assert f"./images/{place}.jpg" in (out / f"{scene:06d}.txt").read_text().splitlines()
        masks = [batch.instance[0] == 1 + index for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        classes = [(3, 7).index(batch.object_id[0, index]) for index in (0, 2, 3) if (batch.instance[0] == 1 + index).any()]
        labels = [rows(out / kind / f"{place}.txt") for kind in CONTENTS[1:]]
        assert [[index for index, _ in kind] for kind in labels] == [classes] * 3
        for mask, (_, segment), (_, box), (_, oriented) in zip(masks, *labels, strict=True):
            filled = np.zeros(mask.shape, np.uint8)
            cv2.fillPoly(filled, [segment.astype(np.int32)], 1)
            # Between parts lies a bridge, which readers fill as well.
            parts = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[0] - 1
            assert filled[mask].all()
            assert (filled > mask).sum() <= 24 * (parts - 1)
            whole += parts == 1
            (y, x), (middle, size) = np.nonzero(mask), box
            np.testing.assert_allclose(middle - size / 2, (x.min(), y.min()), atol=1e-3)
            np.testing.assert_allclose(middle + size / 2, (x.max() + 1, y.max() + 1), atol=1e-3)
            assert oriented.shape == (4, 2)
            centers = np.stack((x, y), axis=1) + 0.5
            if ((oriented > 0) & (oriented < SIZE)).all():
                assert all(cv2.pointPolygonTest(oriented.astype(np.float32), point.tolist(), True) > 0 for point in centers)
                unclipped += 1
    assert min(whole, unclipped) > 20


def test_segments_of_several_parts_are_one_row_and_scenes_are_complete(tmp_path):
    """Two pixels apart: the bridge between them is filled as well."""
    mask = np.zeros((3, 4), np.uint8)
    mask[1, 0] = mask[1, 3] = 1
    for kind in CONTENTS:
        (tmp_path / kind).mkdir()
    settings = ViewSettings(".jpg", 95, (), masks=True, coco=True, camera={}, resolution=(4, 3), classes=(5,))
    runs = find_run_boundaries(mask).runs_of(1)
    view = SimpleNamespace(scene=0, frame=0, color=(".jpg", b"image"), gt=[{"obj_id": 5}], masks=lambda: [Masks(runs, runs)])
    yolo.write_view(view, tmp_path, settings)
    assert (tmp_path / "boxes" / "000000_000000.txt").read_text() == "0 0.500000 0.500000 1.000000 0.333333\n"
    assert len((tmp_path / "labels" / "000000_000000.txt").read_text().split()) == 1 + 2 * (4 + 4 + 2)
    with pytest.raises(DatasetError, match="obj_id 5, which is none of the objects"):
        yolo.write_view(view, tmp_path, dataclasses.replace(settings, classes=(6,)))
    with pytest.raises(OutputError, match="has 1 of 3 frames"):
        yolo.commit_scenes(((tmp_path, 7),), tmp_path, "train_pbr", (range(3),))


@pytest.mark.parametrize(
    ("folders", "keys"),
    [
        (("train_pbr", "test_pbr"), ("train_pbr", "test_pbr", "test_pbr")),
        (("train_pbr", "val_pbr"), ("train_pbr", "val_pbr", None)),
        (("test_pbr",), ("test_pbr", "test_pbr", "test_pbr")),
        (("mine",), ("mine", "mine", None)),
    ],
)
def test_readers_find_images_to_train_and_to_validate(tmp_path, folders, keys):
    splits = tuple(Split(f"s{index}", 1, index, "pick", folder) for index, folder in enumerate(folders))
    out = export(YoloExporter, tmp_path / "set", dataclasses.replace(config(), splits=splits), (0,))
    data = yaml.safe_load((out / "yolo" / "data.yaml").read_text())
    assert [data.get(key) for key in ("train", "val", "test")] == [key and f"images/{key}" for key in keys]
    note = {"train_pbr": "train", "test_pbr": "test", "mine": "all", "val_pbr": None}[keys[1]]
    assert (f"# No split for validation: these are the {note} images." in (out / "yolo" / "data.yaml").read_text()) == (note is not None)
    assert all((out / "yolo" / "images" / folder).is_dir() for folder in folders)
    assert FORMAT_TABLE["yolo"].part.file(0) == "yolo/000000.txt"


MASKS = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(lambda shape: arrays(bool, shape))
FROM = (3, 5)
"""Row and column of the masks in an image."""


def outlines(mask: np.ndarray) -> list[Polygon]:
    return trace_outlines(find_run_boundaries(mask.astype(np.uint8), *FROM).runs_of(1))


def area(polygon: Polygon) -> float:
    """By the shoelace formula [px²]."""
    (x, y), (ahead_x, ahead_y) = polygon.points.T, np.roll(polygon.points, -1, axis=0).T
    return 0.5 * float(np.sum(x * ahead_y - ahead_x * y))


@pytest.mark.filterwarnings("ignore:__array__:DeprecationWarning")
@settings(max_examples=fuzz_examples(200), deadline=None)
@given(mask=MASKS)
def test_polygons_fill_to_the_mask(mask):
    image = np.zeros((20, 20), bool)
    image[FROM[0] : FROM[0] + mask.shape[0], FROM[1] : FROM[1] + mask.shape[1]] = mask
    parts = outlines(mask)
    filled = np.zeros(image.shape, np.uint8)
    for part in parts:
        alone = np.zeros_like(filled)
        np.testing.assert_array_equal(part.at_pixels().astype(np.int32), np.round(part.at_pixels()))
        cv2.fillPoly(alone, [part.at_pixels().astype(np.int32)], 1)
        filled |= alone
    np.testing.assert_array_equal(filled, image)
    assert len(parts) == cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[0] - 1
    assert sum(map(area, parts)) == mask.sum()
    if parts:
        rings = coco.frPyObjects([part.points.ravel().tolist() for part in parts], *image.shape)
        np.testing.assert_array_equal(coco.decode(coco.merge(rings)), image)
        assert area(join_parts(parts)) == pytest.approx(mask.sum())


def test_an_outline_goes_around_clockwise_and_into_a_hole():
    ring = np.ones((3, 3), bool)
    ring[1, 1] = False
    (part,) = outlines(ring)
    x, y = part.points.T - np.array([FROM[1], FROM[0]])[:, None]
    assert (x.min(), x.max(), y.min(), y.max()) == (0, 3, 0, 3)
    assert area(part) == 8
    assert {(1.0, 1.5), (0.0, 1.5)} <= set(zip(x.tolist(), y.tolist(), strict=True))


# ---- many instances ----

COUNT = 200
LARGE = cameras(240, 180)


@pytest.fixture(scope="module")
def batch():
    return dense_batch(dense_toy(COUNT, LARGE, MAX_INSTANCES), pick_device(default_device()))


@pytest.fixture(scope="module")
def masks(batch) -> list[np.ndarray]:
    """Amodal masks of each view (N, H, W)."""
    return [masks_of_batch(batch, view)[:COUNT] for view in range(len(batch))]


def write(kind: type, out: Path, batch) -> Path:
    """A data set of one frame."""
    settings = dataclasses.replace(trajectories.config(), arrangement=Arrangement(max_objects=MAX_INSTANCES))
    tick = dataclasses.replace(next(ticks(1, (0,), 1)), object_id=batch.object_id[:1], pose=batch.pose[:1])
    with exporting(kind, out, settings, 0, LARGE) as exporter:
        exporter.write_constants()
        exporter.write_ticks(trajectories.with_physics(tick))
        exporter.write_views(batch)
        exporter.end_episode(ends((0,), 1)[0], lambda: None)
        finish(exporter)
    return out


@pytest.fixture(scope="module")
def bop(batch, tmp_path_factory) -> Path:
    return write(BopExporter, tmp_path_factory.mktemp("dense") / "set", batch)


def test_masks_and_counts_of_files_are_those_of_the_renderer(bop, batch, masks):
    """In scenes and in shards; without a manifest, each camera's scene is an episode."""
    for folder in (bop, write(ShardsExporter, bop.parent / "shards", batch)):
        for camera, expected in enumerate(masks):
            view = synpick_warp.open(folder)[camera].view(0)
            np.testing.assert_array_equal(view.amodal_masks, expected)
            np.testing.assert_array_equal(view.masks, batch.instance[camera] == 1 + np.arange(COUNT)[:, None, None])
            infos = view.records.gt_info
            assert [info["px_count_visib"] for info in infos] == view.masks.sum(axis=(1, 2)).tolist()
            beyond = np.array([info["px_count_all"] for info in infos]) - expected.sum(axis=(1, 2))
            assert (beyond >= 0).all()
            assert (beyond == 0).sum() > COUNT // 10
    assert len(np.unique(batch.instance)) > 60


def test_an_independent_check_in_float64_finds_nothing(bop):
    check.read_json.cache_clear()
    check.read_model.cache_clear()
    report = check.check(bop, 3)
    assert [name for name, measure in vars(report).items() if not measure.holds] == []


@pytest.mark.parametrize("kind", [BopExporter, CocoExporter, ShardsExporter, YoloExporter])
def test_files_are_the_same_from_lists_and_from_words(kind, batch, tmp_path):
    words = dataclasses.replace(batch, boundaries=None, boundary_count=None, runs=None, run_count=None)
    assert digests(write(kind, tmp_path / "lists", batch)) == digests(write(kind, tmp_path / "words", words))


def read_zarr(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Instances and poses (N, 4, 4) in the first tick of the zarr store."""
    tick = zarr.open_group(out / "trajectory.zarr", mode="r")["episodes/000000/ticks"]
    present = np.flatnonzero(tick["object_id"][0] >= 0)
    return present, np.array([pose_matrix(pose) for pose in tick["pose"][0][present]])


def read_usd(out: Path) -> tuple[np.ndarray, np.ndarray]:
    """Instances and poses (N, 4, 4) of the bodies that Newton imports."""
    values = read_newton(out / "usd" / "000000.usdc", out, "").values
    return values["instance_id"], values["object_to_world"]


@pytest.mark.parametrize(("kind", "read"), [(TrajectoryExporter, read_zarr), (UsdExporter, read_usd)])
def test_stores_of_trajectories_have_every_body(batch, tmp_path, kind, read):
    present, poses = read(write(kind, tmp_path / "set", batch))
    assert present.tolist() == list(range(COUNT))
    np.testing.assert_allclose(poses, [pose_matrix(pose) for pose in batch.pose[0, :COUNT]], atol=1e-6)
