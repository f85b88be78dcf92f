"""Multisensor layout: one scene per episode whose files equal those of the classic layout, with the sensor in their names."""

from __future__ import annotations

import json
from pathlib import Path
from typing import ClassVar

import pytest

import synpick_warp
from synpick_warp.apps.validation.run import Summary, ValidationOptions, validate
from synpick_warp.configs.schema import Config
from synpick_warp.exporters.bop.exporter import BopExporter
from tests.harness.exporter_contract import FRAMES, ExporterContract
from tests.worlds import box_views
from tests.worlds.box_sets import EPISODES, write_set


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


def test_it_opens_by_episode(folders):
    data = synpick_warp.open(folders[0])
    assert list(data) == list(EPISODES)
    assert list(synpick_warp.open(folders[1])) == list(EPISODES)


def test_validation_finds_the_same_in_both_layouts(folders):
    multi, classic = (
        {found.rule for found in validate(folder, ValidationOptions(sample=0, images=False), Summary())} for folder in folders
    )
    assert multi <= classic
