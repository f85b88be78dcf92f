"""BOP folders from other sources: every command that reads takes them with what they have, and says in one line what they lack. Data sets
of released versions, one each in tests/cases/data_sets: this version reads them, or says in a line that it does not."""

import io
import json
import re
import shutil
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

import synpick_warp
from synpick_warp.dataset.bop.foreign import measure_info
from synpick_warp.dataset.commit.merge import merge
from synpick_warp.dataset.commit.verify import verify
from synpick_warp.dataset.view_files import decode_run_lengths
from synpick_warp.errors import DatasetError
from tests.builders import mistake, run
from tests.harness.scripted_bake import snapshot
from tests.validation.conftest import LAYOUTS, _rename_images, _strip, good, tless  # noqa: F401

EPISODES = {
    "tless": [1, 2, 3],
    "ycbv": [0, 1, 2, 48, 49, 50],
    "itodd": [0, 1_000_000, 1_000_001, 1_000_002],
    "multisensor": [0],
    "imagewise": [0, 1, 2],
}


@pytest.fixture(scope="module")
def folders(good, tmp_path_factory) -> dict[str, Path]:  # noqa: F811
    """Each layout of others. Read only."""
    out = tmp_path_factory.mktemp("found")
    return {name: make(good, out / name) for name, make in LAYOUTS.items()}


@pytest.fixture
def plain(good, tmp_path) -> Path:  # noqa: F811
    """A classic set without manifest, with one split of three scenes, to be changed."""
    out = _strip(good, tmp_path / "plain")
    (out / "train").rename(out / "test")
    return out


@pytest.mark.parametrize("name", LAYOUTS)
def test_scenes_are_episodes_and_sensors_are_cameras(folders, name):
    data = synpick_warp.open(folders[name])
    assert list(data) == EPISODES[name]
    assert data.camera_count == (3 if name == "multisensor" else 1)
    views = list(data.views())
    assert len(views) == sum(len(episode) * len(episode.cameras) for episode in data.values())
    for view in views:
        assert view.rgb.shape == (150, 200, 3)
        assert view.depth.shape == (150, 200)


@pytest.mark.parametrize(("name", "first"), [("tless", 1), ("ycbv", 48), ("multisensor", 0), ("imagewise", 0)])
def test_what_is_read_is_what_was_baked(good, folders, name, first):  # noqa: F811
    """Pixels, masks and poses of the first image, which all layouts share."""
    mine, theirs = synpick_warp.open(good)[0].view(0), synpick_warp.open(folders[name])[first].view(0)
    for name in ("rgb", "masks", "amodal_masks", "object_to_camera", "visibility", "intrinsics"):
        np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))


def test_images_keep_their_ids_and_may_be_grey_tiff_files_without_truth(folders):
    episode = synpick_warp.open(folders["ycbv"])[49]
    assert list(episode.image_ids) == [1, 36]
    assert [view.image_id for view in episode.views()] == [1, 36]
    assert episode.view(-1).image_id == 36
    data = synpick_warp.open(folders["itodd"])
    hidden = next(iter(data.split("test").views()))
    assert len(hidden) == 0
    assert (hidden.rgb[..., 0] == hidden.rgb[..., 2]).all()
    shown = next(iter(data.split("val").views()))
    assert len(shown) > 0
    assert shown.masks.any()


def test_what_scene_gt_info_would_tell_is_measured_or_unknown(plain):
    told = [(view.visible_boxes, view.visibility) for view in synpick_warp.open(plain).views()]
    remove(plain, "scene_gt_info.json")
    for (boxes, visibility), view in zip(told, synpick_warp.open(plain).views(), strict=True):
        np.testing.assert_array_equal(view.visible_boxes, boxes)
        np.testing.assert_allclose(view.visibility, visibility, atol=0.02)
    remove(plain, "mask")
    view = synpick_warp.open(plain)[0].view(0)
    assert np.isnan(view.visibility).all()
    np.testing.assert_array_equal(view.visible_boxes, told[0][0])


def test_measured_boxes_end_with_the_last_pixel():
    mask = np.zeros((6, 8), bool)
    mask[2:4, 3:7] = True
    visible = mask & (np.arange(8) < 5)
    (entry,) = measure_info([visible], [mask])
    boxes = {"bbox_obj": [3, 2, 3, 1], "bbox_visib": [3, 2, 1, 1]}
    assert entry == boxes | {"px_count_all": 8, "px_count_valid": 8, "px_count_visib": 4, "visib_fract": 0.5}


def test_scenes_of_the_same_index_are_told_apart(good, tmp_path):  # noqa: F811
    folder = tless(good, tmp_path / "set")
    shutil.copytree(folder / "test_primesense", folder / "train_primesense")
    data = synpick_warp.open(folder)
    assert list(data) == [1, 2, 3, 1_000_001, 1_000_002, 1_000_003]
    assert list(data.splits) == ["test_primesense", "train_primesense"]
    assert list(data.split("train_primesense")) == [1_000_001, 1_000_002, 1_000_003]
    assert data.scene_id(1_000_002, 0) == 2


@pytest.mark.parametrize("name", LAYOUTS)
def test_statistics_report_and_contact_sheet_of_any_layout(folders, name, tmp_path):
    views = sum(len(episode) * len(episode.cameras) for episode in synpick_warp.open(folders[name]).values())
    code, out, _ = run("stats", folders[name], "--threads", 1)
    assert code == 0
    assert f"{views} views in " in out
    assert "missing: this data set is from another source" in out
    assert run("report", folders[name], "--out", tmp_path / "page.html", "--views", 2, "--threads", 1).code == 0
    assert run("preview", folders[name], "--out", tmp_path / "sheet.png", "--views", 3).code == 0
    assert cv2.imread(str(tmp_path / "sheet.png")).std() > 10


def remove(plain: Path, *names: str) -> None:
    """Remove files or folders of each scene."""
    for path in [path for name in names for path in plain.glob(f"test/*/{name}")]:
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def test_estimates_are_made_and_scored(plain, tmp_path):
    """Without models a line says so."""
    results = tmp_path / "refine_plain-test.csv"
    words = ("estimate", "--data", plain, "--method", "refine", "--every", 1, "--out", results, "--threads", 1)
    assert run(*words)[0] == 0
    assert {line.split(",")[0] for line in results.read_text().splitlines()[1:]} == {"0", "1", "2"}
    code, out, _ = run("eval", "--data", plain, "--results", results)
    assert code == 0
    assert "unknown" not in out
    listed = ("eval", "--data", plain, "--results", results, "--targets", plain / "test_targets_bop19.json")
    assert run(*listed)[0] == 0
    (plain / "models").rename(plain / "models_cad")
    assert run("eval", "--data", plain, "--results", results)[0] == 0
    shutil.rmtree(plain / "models_cad")
    shutil.rmtree(plain / "models_eval")
    said = mistake("eval", "--data", plain, "--results", results)
    assert "has no models/models_info.json, which poses are evaluated with" in said


@pytest.mark.parametrize(
    ("method", "missing", "said"),
    [
        ("refine", ["scene_gt.json", "scene_gt_info.json"], "has no ground truth (scene_gt.json), which poses are estimated with"),
        ("refine", ["depth"], "has no depth images, which poses are estimated with"),
        ("refine", ["mask_visib"], "has no masks (mask_visib), which poses are estimated with"),
        ("track", [], "has no instance_id in its ground truth, by which instances are tracked; use another method"),
    ],
)
def test_what_estimation_lacks_is_named(plain, tmp_path, method, missing, said):
    remove(plain, *missing)
    assert said in mistake("estimate", "--data", plain, "--method", method, "--out", tmp_path / "out.csv", "--threads", 1)
    assert not (tmp_path / "out.csv").exists()


def _four_digits(scene: Path) -> None:
    for path in list(scene.glob("*/*.*")):
        path.rename(path.with_name("_".join(part[2:] for part in path.stem.split("_")) + path.suffix))


def _capitals(scene: Path) -> None:
    for path in list(scene.glob("rgb/*")):
        path.rename(path.with_suffix(path.suffix.upper()))


@pytest.mark.parametrize("change", [_four_digits, _capitals])
def test_names_of_images_may_be_written_otherwise(plain, change):
    before = [(view.rgb, view.masks) for view in synpick_warp.open(plain).views()]
    for scene in plain.glob("test/*"):
        change(scene)
    for (color, masks), view in zip(before, synpick_warp.open(plain).views(), strict=True):
        np.testing.assert_array_equal(view.rgb, color)
        np.testing.assert_array_equal(view.masks, masks)


@pytest.mark.parametrize(
    "missing",
    [("scene_camera.json", "depth", "mask", "mask_visib"), ("rgb", "mask", "mask_visib", "scene_gt.json", "scene_gt_info.json")],
    ids=["rgb_and_gt", "depth"],
)
def test_a_set_with_a_single_kind_of_images(plain, tmp_path, missing):
    remove(plain, *missing)
    shutil.rmtree(plain / "models")
    assert len(list(synpick_warp.open(plain).views())) == 6
    for words in (("stats", "--threads", 1), ("preview", "--out", tmp_path / "sheet.png"), ("report", "--out", tmp_path / "page.html")):
        assert run(words[0], plain, *words[1:])[0] == 0
    assert cv2.imread(str(tmp_path / "sheet.png"))[20:300, :480].std() > 10


def check_same(theirs, ours) -> None:
    """Two views have the same content."""
    for name in ("rgb", "depth", "masks", "object_to_camera", "visibility"):
        np.testing.assert_array_equal(getattr(theirs, name), getattr(ours, name), err_msg=name)


def convert(folder: Path, to: str, out: Path, *options: object, threads: int = 1) -> str:
    """Convert a set; returns what the command prints."""
    code, said, error = run("convert", folder, "--to", to, "--out", out, "--threads", threads, *options)
    assert code == 0, error
    return said


@pytest.mark.parametrize(("name", "to"), [("tless", "shards"), ("imagewise", "bop")])
def test_converted_views_are_those_of_the_source(folders, tmp_path, name, to):
    out = tmp_path / "new" / "out"
    assert f"3 scenes converted to {to}, coco" in convert(folders[name], f"{to},coco", out)
    assert [path.name for path in out.parent.iterdir()] == ["out"]
    source, made = synpick_warp.open(folders[name]), synpick_warp.open(out)
    assert list(made) == list(source)
    for theirs, ours in zip(source.views(), made.views(), strict=True):
        assert (theirs.episode, theirs.image_id) == (ours.episode, ours.image_id)
        check_same(theirs, ours)
    (file,) = (out / "coco" / "annotations").iterdir()
    content = json.loads(file.read_text())
    assert len(content["images"]) == 6
    assert all((out / "coco" / "images" / image["file_name"]).is_file() for image in content["images"])
    assert len(content["annotations"]) == sum(int(mask.any()) for view in source.views() for mask in view.masks)
    assert run("validate", out)[0] == 0


def test_each_sensor_becomes_a_scene(folders, tmp_path):
    convert(folders["multisensor"], "shards,coco,yolo,points", tmp_path / "out")
    source, made = synpick_warp.open(folders["multisensor"]), synpick_warp.open(tmp_path / "out")
    assert list(made) == [0, 1, 2]
    for theirs in source.views():
        check_same(theirs, made[theirs.camera].view(theirs.frame))
        cloud = trimesh.load(str(tmp_path / f"out/points/test/{theirs.camera:06d}/{theirs.frame:06d}.ply"))
        frame = "world" if "cam_R_w2c" in theirs.records.camera else "camera"
        np.testing.assert_allclose(cloud.vertices, theirs.points(frame)[theirs.depth > 0], atol=1e-6)
    assert "those of scene s and its sensors " in (tmp_path / "out/dataset_info.md").read_text()
    assert run("validate", tmp_path / "out")[0] == 0


def test_masks_are_rendered_where_a_set_has_none(plain, tmp_path):
    """Those of the bake, but for pixels on edges; the classes are those of the models, and what was made is noted."""
    expected = [(view.episode, view.image_id, mask) for view in synpick_warp.open(plain).views() for mask in view.masks if mask.any()]
    remove(plain, "mask*", "scene_gt_info.json")
    for folder in ("models", "models_eval"):
        shutil.copyfile(plain / folder / "obj_000003.ply", plain / folder / "obj_000009.ply")
    assert "Masks are rendered from models and poses" in convert(plain, "coco,yolo", tmp_path / "out", threads=2)
    content = json.loads((tmp_path / "out/coco/annotations/instances_test.json").read_text())
    assert len(content["annotations"]) == len(expected)
    for one, (_, _, mask) in zip(content["annotations"], expected, strict=True):
        made = decode_run_lengths(one["segmentation"]["counts"], mask.shape)
        assert np.count_nonzero(made != mask) <= 0.01 * mask.sum()
    assert "Masks are rendered from models and poses" in (tmp_path / "out/dataset_info.md").read_text()
    assert "nc: 3\n" in (tmp_path / "out/yolo/data.yaml").read_text(), "9 is in no image"
    for folder in ("models", "models_eval"):
        shutil.rmtree(plain / folder)
    said = mistake("convert", plain, "--to", "yolo", "--out", tmp_path / "none", "--threads", 1)
    assert "has no masks of visible parts (mask_visib), nor models and cameras to render them, which it needs" in said


def test_a_split_is_converted(folders, tmp_path):
    convert(folders["ycbv"], "shards", tmp_path / "out", "--split", "test")
    assert [(view.episode, view.image_id) for view in synpick_warp.open(tmp_path / "out").views()] == [
        (scene, image) for scene in (48, 49, 50) for image in (1, 36)
    ]


def test_images_of_other_kinds_are_encoded_and_keep_their_ids(folders, tmp_path):
    shutil.copytree(folders["itodd"] / "val", tmp_path / "set" / "val")
    for scene in (tmp_path / "set/val").iterdir():
        _rename_images(scene, {0: 1, 1: 36})
    convert(tmp_path / "set", "shards,coco", tmp_path / "out")
    for theirs, ours in zip(synpick_warp.open(tmp_path / "set").views(), synpick_warp.open(tmp_path / "out").views(), strict=True):
        assert ours.image_id in (1, 36)
        np.testing.assert_array_equal(theirs.rgb, ours.rgb)
        np.testing.assert_array_equal(theirs.depth, ours.depth)
    content = json.loads((tmp_path / "out/coco/annotations/instances_val.json").read_text())
    assert {image["file_name"][7:] for image in content["images"]} == {"000001.png", "000036.png"}


@pytest.mark.parametrize(
    ("name", "to", "said"),
    [
        ("tless", "usd", "--to names usd, which is made of trajectories"),
        ("tless", "lerobot", "--to names lerobot, which is made of trajectories"),
        ("tless", "bop", "--to names bop, which .* has already"),
        ("tless", "nothing", "--to names nothing; allowed: bop, shards, coco, yolo"),
        ("ycbv", "coco", "has the splits test, train_pbr; choose one by --split"),
    ],
)
def test_what_can_not_be_made_of_a_found_set_is_one_line(folders, tmp_path, name, to, said):
    assert re.search(said, mistake("convert", folders[name], "--to", to, "--out", tmp_path / "out", "--threads", 1))
    assert not list(tmp_path.iterdir())


def test_a_conversion_that_fails_leaves_nothing(plain, tmp_path):
    sorted(plain.glob("test/000002/depth/*"))[-1].write_bytes(b"")
    before = sorted(path.name for path in tmp_path.iterdir())
    assert "is not an image" in mistake("convert", plain, "--to", "shards", "--out", tmp_path / "out", "--threads", 1)
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_shards_of_others_may_have_extended_headers(folders, tmp_path):
    """Times of fractions of a second, as webdataset's writer makes them; files of another name or size are not taken."""
    out = tmp_path / "set" / "train_web"
    out.mkdir(parents=True)
    files = sorted((folders["imagewise"]).glob("*/0*.*"))

    def pack(**headers: str) -> None:
        with tarfile.open(out / "shard-000000.tar", "w", format=tarfile.PAX_FORMAT) as shard:
            for path in files:
                info = tarfile.TarInfo(path.name)
                info.size, info.mtime, info.pax_headers = path.stat().st_size, 1.5, headers
                shard.addfile(info, io.BytesIO(path.read_bytes()))

    pack()
    for ours, theirs in zip(synpick_warp.open(out.parent).views(), synpick_warp.open(folders["imagewise"]).views(), strict=True):
        np.testing.assert_array_equal(ours.rgb, theirs.rgb)
        np.testing.assert_array_equal(ours.masks, theirs.masks)
    pack(path="000000_000000.gt.json")
    with pytest.raises(DatasetError, match="has a member at byte 0 that is not a regular file"):
        list(synpick_warp.open(out.parent))


def test_other_cameras_than_pinholes_are_named(plain):
    path = plain / "test/000000/scene_camera.json"
    content = json.loads(path.read_text())
    for entry in content.values():
        entry["cam_model"] = {"projection_model_type": "CameraModelType.FISHEYE624"}
        del entry["cam_K"], entry["depth_scale"]
    path.write_text(json.dumps(content))
    view = synpick_warp.open(plain)[0].view(0)
    assert view.rgb.any()
    with pytest.raises(DatasetError, match="the camera of image 0 has no cam_K"):
        _ = view.intrinsics
    with pytest.raises(DatasetError, match="the camera of image 0 has no depth_scale"):
        _ = view.depth


def test_folders_that_are_no_data_set_say_so(tmp_path, plain):
    for folder, said in (
        (tmp_path / "gone", "is not a data set: it does not exist"),
        (plain / "test", "is a split; name the data set, the folder above"),
        (plain / "test/000000", "is a scene; name the data set, two folders above"),
    ):
        with pytest.raises(DatasetError, match=said):
            synpick_warp.open(folder)
    with pytest.raises(DatasetError, match="has no settings: it is from another source"):
        _ = synpick_warp.open(plain).config


# ---- released versions ----

SETS = Path(__file__).parents[1] / "cases" / "data_sets"
FRAMES, CAMERAS, FILES = 4, 2, 174
"""Of an episode in which one of two boxes is picked, 64x48, as scenes and trajectories."""


@pytest.fixture(params=["0.2.0"])
def released(request, tmp_path) -> Path:
    """The set that a version baked, beside the folder of its models."""
    with tarfile.open(SETS / f"{request.param}.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path / request.param


def test_a_released_data_set_is_read(released, tmp_path):
    before = snapshot(released)
    data = synpick_warp.open(released)
    assert (len(data), len(data[0]), data.camera_count) == (1, FRAMES, CAMERAS)
    view = data[0].view(0, camera=1)
    assert view.rgb.shape == (48, 64, 3)
    assert [attempt["outcome"] for attempt in data[0].attempts] == ["target_picked"]
    assert verify(released) == ("", 1, FILES, True)
    assert "8 views, 6 of them rendered again: 0 errors, 0 warnings" in run("validate", released).out
    assert "target_picked         1    100.0%" in run("stats", released).out
    merge([released], tmp_path / "merged")
    assert snapshot(tmp_path / "merged").keys() == before.keys()
    assert snapshot(released) == before


def test_a_released_data_set_is_converted_and_back_to_its_bytes(released, tmp_path):
    synpick_warp.convert(released, tmp_path / "shards", ("shards", "lerobot"))
    synpick_warp.convert(tmp_path / "shards", tmp_path / "scenes", ("bop",))
    back, before = snapshot(tmp_path / "scenes" / "train"), snapshot(released / "train")
    assert back == before
    assert [verify(tmp_path / name).problem for name in ("shards", "scenes")] == ["", ""]


def test_a_released_data_set_is_not_taken_for_one_of_this_version(released, tmp_path):
    other = f'versions.synpick-warp is "{synpick_warp.__version__}", there "{released.name}"'
    assert other in mistake("prove", released)
    assert other in mistake("bake", "--config", released / "config.toml", "--out", released)
    said = mistake("convert", released, "--to", "usd", "--out", tmp_path / "usd")
    assert f"were digested by synpick-warp {released.name}, this is {synpick_warp.__version__}; convert with that version" in said
    assert not (tmp_path / "usd").exists()
