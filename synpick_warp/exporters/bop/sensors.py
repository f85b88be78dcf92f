"""Multisensor layout of BOP-Industrial 2025: one scene per episode, with folders and annotation files for each camera.

The cameras' scenes are staged in the classic layout, and brought together by renaming when the episode is complete. Runs in writer
processes, so it imports neither Warp nor Newton.
"""

from __future__ import annotations

from pathlib import Path

from synpick_warp.exporters.bop.scene import SceneSettings, complete_scene
from synpick_warp.exporters.writing.files import sync_folder


def commit_sensor_scene(scenes: tuple[Path, ...], place: Path, settings: tuple[SceneSettings, ...]) -> None:
    """Task: complete the scenes of an episode's cameras, bring them together in one folder, and rename it to its place.

    The rename of the folder is the commit: a killed bake leaves nothing at `place`.

    Args:
        scenes: Staging folder of each camera.
        place: Folder of the scene.
        settings: Settings of each scene, with its sensor.
    """
    whole = scenes[0].with_name(f"{scenes[0].name}-sensors")
    whole.mkdir()
    for scene, own in zip(scenes, settings, strict=True):
        complete_scene(scene, own)
        for path in sorted(scene.iterdir()):
            path.rename(whole / f"{path.stem}{own.sensor}{path.suffix}")
    sync_folder(whole)
    whole.rename(place)
    sync_folder(place.parent)
