"""Consistency check of data sets: it passes a correct one, and finds each type of damage by the right measure."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from synpick_warp.exporters.bop.exporter import BopExporter
from tests.harness.exporter_contract import export
from tests.worlds.box_views import cameras, config
from tools.checks import dataset as tool

CAMERAS = cameras(240, 180)


@pytest.fixture(scope="module")
def baked(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("check") / "set"
    return export(BopExporter, out, config(), (0,), 0, 2, CAMERAS)


@pytest.fixture
def dataset(baked, tmp_path) -> Path:
    tool.read_json.cache_clear()
    tool.read_model.cache_clear()
    return Path(shutil.copytree(baked, tmp_path / "set"))


def violated(dataset: Path) -> set[str]:
    """Names of the measures that exceed their bound."""
    return {name for name, measure in vars(tool.check(dataset, 6)).items() if not measure.holds}


def edit_json(name: str, edit: Callable[[dict], None]) -> Callable[[Path], None]:
    def damage(scene: Path) -> None:
        content = json.loads((scene / name).read_text())
        edit(content)
        (scene / name).write_text(json.dumps(content))

    return damage


def edit_images(pattern: str, edit: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], None]:
    def damage(scene: Path) -> None:
        for path in sorted(scene.glob(pattern)):
            cv2.imwrite(str(path), edit(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))

    return damage


def add_to(key: str, index: int | None, value: float) -> Callable[[dict], None]:
    def edit(content: dict) -> None:
        record = content["0"][1]
        if index is None:
            record[key] += value
        else:
            record[key][index] += value

    return edit


def negate_rotation(content: dict) -> None:
    content["0"][0]["cam_R_m2c"] = [-value for value in content["0"][0]["cam_R_m2c"]]


def blot(image: np.ndarray) -> np.ndarray:
    image[60:90, 100:130] = 255
    return image


def scale_models(scene: Path) -> None:
    for path in (scene.parent.parent / "models").glob("*.ply"):
        mesh = trimesh.load(path, process=False)
        mesh.apply_scale(0.97)
        mesh.export(path)


def test_a_correct_data_set_passes(dataset):
    assert violated(dataset) == set()


DEPTH = edit_images("depth/*.png", lambda image: image + np.uint16(4))
NEARER = edit_images("depth/*.png", lambda image: image - np.uint16(4))
SHIFTED_MASKS = edit_images("mask*/*_000001.png", lambda image: np.roll(image, 1, axis=1))


@pytest.mark.parametrize(
    ("damage", "measures"),
    [
        (DEPTH, {"depth"}),
        (NEARER, {"depth", "visible"}),
        (edit_images("depth/*.png", lambda image: 0 * image), {"unknown"}),
        (SHIFTED_MASKS, {"mask", "visible"}),
        (edit_images("mask_visib/*.png", blot), {"visible"}),
        (edit_json("scene_gt_info.json", add_to("px_count_all", None, 20)), {"count_all"}),
        (edit_json("scene_gt_info.json", add_to("bbox_obj", 0, 2)), {"box_amodal"}),
        (edit_json("scene_gt.json", negate_rotation), {"rotation"}),
        (scale_models, {"depth", "mask", "visible", "count_all", "box_amodal"}),
    ],
)
def test_each_type_of_damage_is_found(dataset, damage, measures):
    for scene in sorted((dataset / "train_pbr").iterdir()):
        damage(scene)
    assert measures <= violated(dataset)


def test_a_pose_error_of_one_and_a_half_micrometres_in_one_camera_is_found(dataset):
    edit_json("scene_gt.json", add_to("cam_t_m2c", 2, 1.5e-3))(dataset / "train_pbr" / "000001")
    assert violated(dataset) == {"world"}


def test_exit_codes(dataset, tmp_path, monkeypatch, capsys):
    def run(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["dataset", *map(str, arguments)])
        return tool.main(), *capsys.readouterr()

    code, out, err = run(dataset, "--views", 2)
    assert (code, err) == (0, "")
    assert "VIOLATED" not in out
    DEPTH(dataset / "train_pbr" / "000000")
    code, out, _ = run(dataset, "--views", 6)
    assert code == 1
    assert "depth against models, inside" in {line.split("  ")[0] for line in out.splitlines() if "VIOLATED" in line}
    assert run(tmp_path / "none") == (2, "", f"dataset: {tmp_path / 'none'} has no scene\n")


def test_ray_casting_hits_a_known_triangle():
    """A triangle across the optical axis, tilted: depth 1000 + x at the point (x, y)."""
    corners = np.array([[[-100.0, -100, 900], [100, -100, 1100], [0, 100, 1000]]])
    hit = tool.cast_rays(corners, np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]]), 30, 40).crop(30, 40)
    rows, columns = np.nonzero(np.isfinite(hit))
    slope = (columns + 0.5 - 20) / 100
    np.testing.assert_allclose(hit[rows, columns], 1000 / (1 - slope), rtol=1e-12)
    assert len(rows) == pytest.approx(200, abs=12)  # Half of 200 x 200 mm at a metre, 100 px/m/m.


def test_silhouettes_extend_beyond_the_image():
    corners = np.array([[[-400.0, -100, 1000], [0, -100, 1000], [-400, 300, 1000]], [[0, -100, 1000], [0, 300, 1000], [-400, 300, 1000]]])
    hit = tool.cast_rays(corners, np.array([[100.0, 0, 20], [0, 100, 15], [0, 0, 1]]), 30, 40)
    assert hit.box() == [-20, 5, 39, 39]
    assert np.isfinite(hit.depth).all()
    assert np.isfinite(hit.crop(30, 40)).sum() == 20 * 25
