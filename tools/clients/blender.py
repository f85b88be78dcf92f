"""Blender: an episode's USD file imported by `bpy`; poses, cameras and properties, and a picture by Cycles against ours."""

# Runs in Blender's Python, which the type checker does not see.
# pyright: reportMissingImports=false

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import PICTURE, Reading, Sources, first_episode, sample_frames, sampled_views

PACKAGES = ("bpy",)
BOUNDS = {"object_to_world": 2e-6, "camera_to_world": 2e-6, "focal": 1e-3}
"""32-bit matrices [m]; focal length in pixels."""
WIDTH = 320
"""Width of the picture [px]."""
PATHS = 192
"""Cycles' samples a pixel."""
SHOULDER_START = 0.6
"""Knee of the tone curve (kernels/render/images/postprocess.py)."""


def find(data: Path, sources: Sources) -> Path | None:
    """USD file of the first episode; None: there is none."""
    file = data / "usd" / f"{first_episode(data)['episode']:06d}.usdc"
    return file if file.is_file() else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Objects at the sampled frames, cameras, properties; the picture of the middle frame by the first camera."""
    import bpy

    frames = sample_frames(first_episode(data)["frames"])
    with _silent():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.world = bpy.data.worlds.new("World")
        bpy.ops.wm.usd_import(filepath=str(place))
    scene = bpy.context.scene
    instances = {item["instance_id"]: item for item in bpy.data.objects if "instance_id" in item}
    values: dict[str, np.ndarray] = {}
    for frame in frames:
        scene.frame_set(frame)
        # Blender ignores animated visibility: what has left the scene is far away.
        clip = bpy.data.objects["camera_0"].data.clip_end
        near = {index: item for index, item in instances.items() if item.matrix_world.translation.length < clip}
        values[f"instance_id {frame}"] = np.array(sorted(near))
        values[f"object_to_world {frame}"] = np.array([near[index].matrix_world for index in sorted(near)]).reshape(-1, 4, 4)
        values[f"obj_id {frame}"] = np.array([near[index]["obj_id"] for index in sorted(near)])
    lens = bpy.data.objects["camera_0"]
    values["camera_to_world"] = np.array(lens.matrix_world)
    values["focal"] = np.array(lens.data.lens / lens.data.sensor_width)
    values["episode"] = np.array([bpy.data.objects["Episode"][name] for name in ("episode", "frames")])
    remarks = []
    rate = scene.render.fps / scene.render.fps_base
    if rate == 24.0:
        remarks.append("frame rate and resolution are not taken from the file: set them")
    values[f"{PICTURE} {frames[1]}"] = _render(frames[1])
    return Reading(f"{place.parent.name}/{place.name}: {len(instances)} objects, frame {frames[1]} rendered", values, remarks)


def _render(frame: int) -> np.ndarray:
    """Linear radiance of a frame (H, W, 3) by Cycles on the CPU."""
    import bpy

    scene = bpy.context.scene
    scene.frame_set(frame)
    scene.camera = bpy.data.objects["camera_0"]
    sensor = scene.camera.data
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising, scene.cycles.seed = "CPU", PATHS, False, 0
    scene.render.resolution_x, scene.render.resolution_percentage = WIDTH, 100
    scene.render.resolution_y = round(WIDTH * sensor.sensor_height / sensor.sensor_width)
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    with tempfile.TemporaryDirectory() as folder:
        scene.render.filepath = f"{folder}/picture.exr"
        with _silent():
            bpy.ops.render.render(write_still=True)
        image = bpy.data.images.load(scene.render.filepath)
        pixels = np.empty(image.size[0] * image.size[1] * image.channels, np.float32)
        image.pixels.foreach_get(pixels)
        return pixels.reshape(image.size[1], image.size[0], image.channels)[::-1, :, :3].copy()


@contextmanager
def _silent() -> Iterator[None]:
    """Redirect standard output to the null device, that of Blender's C code included."""
    sys.stdout.flush()
    saved, nowhere = os.dup(1), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 1)
        yield
    finally:
        sys.stdout.flush()
        os.dup2(saved, 1)
        os.close(saved)
        os.close(nowhere)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views of the data set in memory; camera axes of OpenCV turned to those of USD (y up, looking
    along -z).
    """
    import cv2

    values: dict[str, np.ndarray] = {}
    episode = data_set[min(data_set)]
    views = sampled_views(data_set)
    for frame, view in views.items():
        order = np.argsort(view.instance_ids)
        values[f"instance_id {frame}"] = view.instance_ids[order]
        values |= {f"object_to_world {frame}": view.object_to_world[order], f"obj_id {frame}": view.object_ids[order]}
    frame = list(views)[1]
    view = views[frame]
    values["camera_to_world"] = np.linalg.inv(view.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    height, width = view.depth.shape
    values["focal"] = np.array(view.intrinsics[0, 0] / width)
    values["episode"] = np.array([episode.index, len(episode)])
    size = (WIDTH, round(WIDTH * height / width))
    values[f"{PICTURE} {frame}"] = cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA) / 255.0
    return values


def develop(name: str, value: np.ndarray) -> np.ndarray:
    """Cycles' linear radiance as an sRGB picture like ours: our tone curve ("shoulder"), then sRGB's transfer curve. Called for pictures
    only, so `name` is not used.
    """
    linear = np.maximum(value.astype(np.float64), 0.0)
    rest = 1.0 - SHOULDER_START
    bent = SHOULDER_START + rest * (1.0 - np.exp(np.minimum(SHOULDER_START - linear, 0.0) / rest))
    linear = np.where(linear > SHOULDER_START, bent, linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
