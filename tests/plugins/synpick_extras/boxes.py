"""A format of a few lines: a folder of images and boxes for each scene. Writer processes import this module, so it imports little."""

import json
from pathlib import Path

from synpick_warp.configs.dataset import DataLayout
from synpick_warp.exporters.base import EncodedView, SharedFiles
from synpick_warp.exporters.bop.scene_exporter import SceneExporter
from synpick_warp.exporters.bop.view import ViewSettings
from synpick_warp.exporters.formats import Format
from synpick_warp.exporters.writing.files import open_folder

FOLDER = Path("boxes")


def episode_files(layout: DataLayout, episode: int) -> str:
    scenes = "|".join(f"{layout.cameras * episode + camera:06d}" for camera in range(layout.cameras))
    return rf"boxes/(?:{scenes})/.*"


FORMAT = Format("synpick_extras.boxes", "BoxesExporter", "", episode_files, sources=lambda _: ("views", "masks"))


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
    def shared_files(layout: DataLayout) -> SharedFiles:
        return SharedFiles((), (), (FOLDER,))

    def write_constants(self) -> list[Path]:
        (self._out / FOLDER).mkdir(exist_ok=True)
        return []

    def places(self, episode: int) -> list[Path]:
        return [FOLDER / f"{scene:06d}" for scene in self.scene_ids(episode)]

    def _stage_scene(self, scene: Path, settings) -> None:
        scene.mkdir()

    def _commit_task(self, scenes, frames):
        return move, (scenes, self._out)
