"""A bake of cameras of three sizes, with matrix, field of view and lens, in every format, read back by other libraries;
and of a lens as it is and rectified."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import trimesh
import zarr

import synpick_warp
from synpick_warp.configs.schema import FORMATS
from tests.builders import once, run
from tests.worlds.cells import SIDE, bake_cell, camera_matrix, cell_config, make_camera
from tools.checks.dataset import check

CAMERAS = (
    make_camera("left", **SIDE, matrix=camera_matrix(82.5, 82.38, 49.14, 35.25)),
    make_camera("top", resolution=[64, 48], fov=40.0),
    make_camera(
        "right",
        (0.5, 0.2, 0.9),
        (0.0, 0.0, 0.1),
        (0.0, 0.0, 1.0),
        resolution=[80, 60],
        matrix=camera_matrix(75.0, 74.5, 41.5, 28.75),
        distortion=[-0.12, 0.08, 0.0005, -0.0003, 0.01],
    ),
)
NAMES = ("left", "top", "right")
SIZES = [(96, 72), (64, 48), (80, 60)]
TOP = 32.0 / np.tan(np.radians(20.0))
INTRINSICS = (82.5, 82.38, 49.14, 35.25), (TOP, TOP, 32.0, 24.0), (75.0, 74.5, 41.5, 28.75)
MATRICES = [np.array(camera_matrix(*numbers)) for numbers in INTRINSICS]
DISTORTION = [None, None, [-0.12, 0.08, 0.0005, -0.0003, 0.01]]


def bake(out, layout: str, formats: tuple[str, ...]) -> None:
    bake_cell(out, cell_config(CAMERAS, **{"bake.formats": list(formats), "bop.layout": layout}))


@pytest.fixture(scope="module", params=["classic", "multisensor"])
def cell(tmp_path_factory, request):
    formats = tuple(name for name in FORMATS if name != "picks") if request.param == "classic" else ("bop", "usd")
    return once(tmp_path_factory, f"cell-{request.param}", lambda out: bake(out, request.param, formats))[0]


def test_every_view_has_its_cameras_size_and_matrix(cell):
    data = synpick_warp.open(cell)
    assert [tuple(camera.resolution) for camera in data.cameras] == SIZES
    seen = set()
    for view in data.views():
        width, height = SIZES[view.camera]
        assert (view.rgb.shape, view.depth.shape) == ((height, width, 3), (height, width))
        np.testing.assert_array_equal(view.intrinsics, data.cameras[view.camera].matrix)
        seen.add(view.camera)
    assert seen == {0, 1, 2}


def test_it_is_whole_and_valid(cell):
    for command in ("verify", "validate"):
        ran = run(command, cell)
        assert ran.code == 0, ran
    assert "0 errors" in ran[1] + ran[2]


def sensors(cell: Path) -> Iterator[tuple[int, Path, str]]:
    """Camera, scene folder, and what follows the names of its files and folders."""
    split = next(path for path in cell.iterdir() if (path / "000000").is_dir())
    for index, name in enumerate(NAMES):
        is_multi = (split / "000000" / f"rgb_{name}").is_dir()
        yield index, split / ("000000" if is_multi else f"{index:06d}"), f"_{name}" if is_multi else ""


def records(scene: Path, name: str, suffix: str) -> dict[str, Any]:
    return json.loads((scene / f"{name}{suffix}.json").read_text())


def test_json_and_opencv_find_exact_views_of_each_sensor(cell):
    """Masks have the counts and boxes that are stated; models projected by OpenCV lie in the boxes; objects stand in one place for all."""
    places: dict[tuple[str, int], list[np.ndarray]] = {}
    checked = 0
    for index, scene, suffix in sensors(cell):
        (width, height), cameras = SIZES[index], records(scene, "scene_camera", suffix)
        truth, infos = records(scene, "scene_gt", suffix), records(scene, "scene_gt_info", suffix)
        for image, camera in cameras.items():
            rgb, depth = (cv2.imread(str(scene / f"{kind}{suffix}" / f"{int(image):06d}.png"), -1) for kind in ("rgb", "depth"))
            assert (rgb.shape, depth.shape, depth.dtype) == ((height, width, 3), (height, width), np.uint16)
            np.testing.assert_allclose(np.reshape(camera["cam_K"], (3, 3)), MATRICES[index], rtol=1e-9)
            assert camera.get("cam_dist") == DISTORTION[index]
            to_camera = np.reshape(camera["cam_R_w2c"], (3, 3))
            for number, (one, info) in enumerate(zip(truth[image], infos[image], strict=True)):
                files = [scene / f"{kind}{suffix}" / f"{int(image):06d}_{number:06d}.png" for kind in ("mask", "mask_visib")]
                whole, seen = (cv2.imread(str(file), -1) > 0 for file in files)
                assert (whole.sum(), seen.sum()) == (info["px_count_all"], info["px_count_visib"])
                assert (depth[whole] > 0).sum() == info["px_count_valid"]
                if seen.any():
                    x, y, w, h = cv2.boundingRect(seen.astype(np.uint8))
                    assert [x, y, w - 1, h - 1] == info["bbox_visib"]  # BOP's boxes end at their last pixel.
                rotation, place = np.reshape(one["cam_R_m2c"], (3, 3)), np.array(one["cam_t_m2c"])
                world = to_camera.T @ (place - np.array(camera["cam_t_w2c"]))
                places.setdefault((image, one["instance_id"]), []).append(world)
                corners = trimesh.load(cell / "models" / f"obj_{one['obj_id']:06d}.ply").vertices
                shown, _ = cv2.projectPoints(
                    corners, cv2.Rodrigues(rotation)[0], place, MATRICES[index], np.array(DISTORTION[index] or [0.0] * 4)
                )
                low, high = shown[:, 0].min(axis=0), shown[:, 0].max(axis=0)
                if (low > 1).all() and (high < (width - 1, height - 1)).all() and info["px_count_all"]:
                    # Pixels belong to the mask whose centres are covered; the tips of corners cover none.
                    first, last = np.array(info["bbox_obj"][:2]) + 0.5, np.array(info["bbox_obj"][:2]) + info["bbox_obj"][2:] + 0.5
                    assert np.abs((first - low, last - high)).max() <= 1.5
                    checked += 1
    assert checked > 20
    assert {len(found) for found in places.values()} == {len(NAMES)}
    assert max(np.ptp(found, axis=0).max() for found in places.values()) < 1e-3  # [mm]


@pytest.mark.parametrize("cell", ["classic"], indirect=True)
def test_zarr_and_lerobot_have_cameras_of_their_sizes(cell):
    cameras = zarr.open_group(str(cell / "trajectory.zarr"), mode="r")["cameras"]
    np.testing.assert_array_equal(cameras["resolution"][:], SIZES)
    np.testing.assert_allclose(cameras["matrix"][:], MATRICES, rtol=1e-12)
    assert cameras.attrs["distortion"] == [values and {"cam_dist_model": "pinhole", "cam_dist": values} for values in DISTORTION]
    features = json.loads(next(cell.rglob("meta/info.json")).read_text())["features"]
    for name, (width, height) in zip(NAMES, SIZES, strict=True):
        assert features[f"observation.images.{name}"]["shape"] == [height, width, 3]
        (video,) = cell.rglob(f"observation.images.{name}/**/*.mp4")
        with av.open(str(video)) as container:
            assert {(frame.width, frame.height) for frame in container.decode(video=0)} == {(width, height)}


BENT = make_camera("bent", **SIDE, matrix=MATRICES[0].tolist(), distortion=[-0.3, 0.08, 0.0005, -0.0003]), make_camera("flat", fov=40.0)


@pytest.mark.parametrize("rectified", [False, True])
def test_a_rectified_set_is_that_of_a_pinhole_with_the_same_matrix(tmp_path, rectified):
    bake_cell(tmp_path / "set", cell_config(BENT, **{"bop.rectified": rectified, "bake.formats": ["bop", "shards"]}))
    bent, flat = (json.loads((tmp_path / f"set/train/{scene:06d}/scene_camera.json").read_text())["0"] for scene in (0, 1))
    assert bent["cam_K"] == np.ravel(MATRICES[0]).tolist()
    assert (bent.get("cam_dist"), flat.get("cam_dist")) == (None if rectified else [-0.3, 0.08, 0.0005, -0.0003], None)
    assert ("cam_dist" in (tmp_path / "set/camera_bent.json").read_text()) is not rectified
    assert all(line.holds for line in vars(check(tmp_path / "set", 4)).values())
    for card in ("dataset_info.md", "README.md"):
        lines = (tmp_path / "set" / card).read_text().splitlines()
        (first,) = (lines[index + 2] for index, line in enumerate(lines) if line.startswith("# "))
        assert first.startswith("**Pictures are rectified**" if rectified else "**Pictures are distorted** by the lens of bent:")
