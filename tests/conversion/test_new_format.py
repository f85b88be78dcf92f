"""A format of a few lines, which nothing but the table of formats knows: bakes and `convert` write it, byte for byte the same."""

from __future__ import annotations

import ast
import json
import os
import sys
from pathlib import Path

import pytest

import synpick_warp
from synpick_warp.configs.schema import FORMATS, Config
from synpick_warp.conversion.run import convert
from synpick_warp.exporters.base import EncodedView, SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.formats import FORMAT_TABLE, Format
from synpick_warp.exporters.writing.folder import open_folder
from tests.conversion.test_convert import settings
from tests.harness import scripted_bake
from tests.harness.scripted_bake import snapshot
from tests.worlds import box_views

FOLDER = Path("boxes")


def write_view(view: EncodedView, scene: Path, _: ViewSettings) -> None:
    """An image, and a line of what is on it, of every part that a view has."""
    suffix, color = view.color
    line = [*view.gt, *view.gt_info, view.camera["cam_K"], [mask.visible.count for mask in view.masks()], int(view.depth_image().max())]
    with open_folder(scene) as folder:
        folder.write(f"{view.frame:06d}{suffix}", color)
        folder.write(f"{view.frame:06d}.json", json.dumps(line).encode())


def write_layer(data, scene: Path, _: int, name: str, frame: int) -> None:
    (scene / f"{frame:06d}_{name}.png").write_bytes(data)


def move(scenes, out: Path) -> None:
    for scene, scene_id in scenes:
        scene.rename(out / FOLDER / f"{scene_id:06d}")


class BoxesExporter(SceneExporter):
    staging = "boxes"
    write_view = staticmethod(write_view)
    write_layer = staticmethod(write_layer)

    @staticmethod
    def folder_name(split: str) -> str:
        return FOLDER.name

    @staticmethod
    def shared_files(config: Config) -> SharedFiles:
        return SharedFiles((), (), (FOLDER,))

    def write_constants(self) -> list[Path]:
        (self._out / FOLDER).mkdir(exist_ok=True)
        return []

    def files(self, episode: int) -> list[Path]:
        places = [FOLDER / f"{self.scene_id(episode, camera):06d}" for camera in range(len(self._cameras))]
        return [place for place in places if os.path.lexists(self._out / place)]

    def _stage_scene(self, scene: Path) -> None:
        scene.mkdir()

    def _commit_task(self, scenes, frames):
        return move, (scenes, self._out)


@pytest.fixture
def boxes(monkeypatch) -> None:
    """All that makes it known to bakes, `convert`, manifest and reader: its row in the table of formats."""
    row = Format("boxes", "BoxesExporter", "", lambda _, episode: f"boxes/{episode:06d}/.*", sources=lambda _: ("views", "masks"))
    monkeypatch.setitem(FORMAT_TABLE, "boxes", row)
    monkeypatch.setitem(sys.modules, "synpick_warp.exporters.boxes", sys.modules[__name__])


def test_a_new_format_is_converted_for_free(tmp_path, boxes, monkeypatch):
    monkeypatch.setattr("synpick_warp.scenes.cameras.make_cameras", lambda _: box_views.cameras(16, 12))
    for name in ("bop", "shards", "boxes"):
        scripted_bake.bake(tmp_path / name, settings(name))
    baked = snapshot(tmp_path / "boxes")
    assert sum(name.endswith("_flow.png") for name in baked) == 2 * 3 * scripted_bake.FRAMES
    for source in ("bop", "shards"):
        convert(tmp_path / source, tmp_path / f"{source}-boxes", ("boxes",), 1, lambda *_: None)
        assert snapshot(tmp_path / f"{source}-boxes") == baked


def test_nothing_else_lists_formats():
    """Collections that name three formats or more, besides the values of the setting `bake.formats`, which must not import exporters."""
    listing = set()
    for path in Path(synpick_warp.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            values = node.keys if isinstance(node, ast.Dict) else node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else ()
            if sum(isinstance(value, ast.Constant) and value.value in FORMATS for value in values) >= 3:
                listing.add(path.name)
    assert listing == {"formats.py"}
