"""Clients of trajectories, USD and video: xarray, Newton, Blender, LeRobot."""

# Runs where the packages are, which the type checker may not see.
# pyright: reportMissingImports=false

import contextlib
import importlib.util
import io
import json
import os
import sys
import tempfile
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import PICTURE, ClientReading, Values, first_episode, pose_matrix, sample_frames, sampled_views

ARRAYS = ("time", "object_id", "pose", "fixture_pose", "fixture_visible", "attached", "peak_force")
"""Arrays of ticks that xarray reads."""
CAMERA = "observation.images.camera_0"
WIDTH, PATHS = 320, 192
"""Width of Blender's picture [px], and Cycles' samples a pixel."""
SHOULDER_START = 0.6
"""Knee of the tone curve (kernels/render/images/postprocess.py)."""


def read_xarray(place: Path, data: Path, _: str) -> ClientReading:
    """Arrays of the ticks at sampled frames, by dimension names, and the objects' masses; coordinates along each labelled dimension."""
    import xarray

    row = first_episode(data)
    ticks = xarray.open_zarr(place, group=f"episodes/{row['episode']:06d}/ticks", consolidated=False)
    labels = ticks["pose"].attrs["labels"]
    ticks = ticks.assign_coords({name: values for name, values in labels.items() if name in ticks.dims})
    frames = sample_frames(row["frames"])
    values = {name: ticks[name].isel(tick=frames).to_numpy() for name in ARRAYS}
    height = ticks["pose"].isel(tick=frames).sel({ticks["pose"].dims[-1]: "z"})
    objects = xarray.open_zarr(place, group="objects", consolidated=False)
    values |= {"z by label": height.to_numpy(), "mass": objects["mass"].to_numpy()}
    return ClientReading(f"{place.name}: ticks of episode {row['episode']}, objects", values)


def expect_ticks(data_set: Any) -> Values:
    """Arrays of the ticks at the sampled frames by plain zarr, and masses."""
    episode = data_set[min(data_set)]
    frames = sample_frames(len(episode))
    values = {name: np.asarray(episode.ticks[name][:])[frames] for name in ARRAYS}
    return values | {"z by label": values["pose"][..., 2], "mass": np.array([entry.mass for entry in data_set.objects])}


def read_newton(place: Path, data: Path, _: str) -> ClientReading:
    """Poses of the objects that are in the first frame, by instance_id: bodies of a model by `ModelBuilder.add_usd`."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import newton

        builder = newton.ModelBuilder()
        builder.add_usd(str(place))
    bodies = zip(builder.body_label, builder.body_q, strict=True)
    poses = {int(label.rpartition("_")[2]): pose for label, pose in bodies if "/Objects/" in label}
    values = {"instance_id": np.array(sorted(poses))}
    values["object_to_world"] = np.array([pose_matrix(np.array(poses[index])) for index in sorted(poses)])
    return ClientReading(f"{place.parent.name}/{place.name}: {builder.body_count} bodies, {builder.shape_count} shapes", values)


def expect_first_frame(data_set: Any) -> Values:
    """The objects of the first frame, in which all are in the scene."""
    view = data_set[min(data_set)].view(0)
    return {"instance_id": view.instance_ids, "object_to_world": view.object_to_world}


# ---- Blender ----


def read_blender(place: Path, data: Path, _: str) -> ClientReading:
    """USD imported by `bpy`: objects at the sampled frames, cameras, properties; the picture of the middle frame by the first camera."""
    import bpy

    frames = sample_frames(first_episode(data)["frames"])
    with _silent():
        bpy.ops.wm.read_factory_settings(use_empty=True)
        bpy.context.scene.world = bpy.data.worlds.new("World")
        bpy.ops.wm.usd_import(filepath=str(place))
    scene, lens = bpy.context.scene, bpy.data.objects["camera_0"]
    instances = {item["instance_id"]: item for item in bpy.data.objects if "instance_id" in item}
    values: Values = {}
    for frame in frames:
        scene.frame_set(frame)
        # Blender ignores animated visibility: what has left the scene is far away.
        near = {index: item for index, item in instances.items() if item.matrix_world.translation.length < lens.data.clip_end}
        values[f"instance_id {frame}"] = np.array(sorted(near))
        values[f"object_to_world {frame}"] = np.array([near[index].matrix_world for index in sorted(near)]).reshape(-1, 4, 4)
        values[f"obj_id {frame}"] = np.array([near[index]["obj_id"] for index in sorted(near)])
    values["camera_to_world"] = np.array(lens.matrix_world)
    values["focal"] = np.array(lens.data.lens / lens.data.sensor_width)
    values["episode"] = np.array([bpy.data.objects["Episode"][name] for name in ("episode", "frames")])
    unset = scene.render.fps / scene.render.fps_base == 24.0
    values[f"{PICTURE} {frames[1]}"] = _render(frames[1])
    remarks = ["frame rate and resolution are not taken from the file: set them"] if unset else []
    return ClientReading(f"{place.parent.name}/{place.name}: {len(instances)} objects, frame {frames[1]} rendered", values, remarks)


def _render(frame: int) -> np.ndarray:
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


@contextlib.contextmanager
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


def expect_blender(data_set: Any) -> Values:
    """Objects and camera of the views; camera axes of OpenCV turned to those of USD (y up, looking along -z)."""
    import cv2

    values: Values = {}
    episode, views = data_set[min(data_set)], sampled_views(data_set)
    for frame, view in views.items():
        order = np.argsort(view.instance_ids)
        values[f"instance_id {frame}"] = view.instance_ids[order]
        values |= {f"object_to_world {frame}": view.object_to_world[order], f"obj_id {frame}": view.object_ids[order]}
    frame = list(views)[1]
    view = views[frame]
    height, width = view.depth.shape
    values["camera_to_world"] = np.linalg.inv(view.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    values |= {"focal": np.array(view.intrinsics[0, 0] / width), "episode": np.array([episode.index, len(episode)])}
    size = (WIDTH, round(WIDTH * height / width))
    return values | {f"{PICTURE} {frame}": cv2.resize(view.rgb, size, interpolation=cv2.INTER_AREA) / 255.0}


def tone_map(radiance: np.ndarray) -> np.ndarray:
    """Tone-map Cycles' linear radiance to an sRGB picture like ours: our tone curve ("shoulder"), then sRGB's transfer curve."""
    linear = np.maximum(radiance.astype(np.float64), 0.0)
    rest = 1.0 - SHOULDER_START
    bent = SHOULDER_START + rest * (1.0 - np.exp(np.minimum(SHOULDER_START - linear, 0.0) / rest))
    linear = np.where(linear > SHOULDER_START, bent, linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)


# ---- LeRobot ----


def find_lerobot(data: Path) -> Path | None:
    """Folder of the LeRobot data set; None: there is none."""
    return data / "lerobot" if (data / "lerobot" / "meta" / "info.json").is_file() else None


def read_lerobot(place: Path, data: Path, _: str) -> ClientReading:
    """State of the sampled frames of the first episode by pyarrow, and their pictures in the first camera's video by PyAV; each split by
    LeRobotDataset where it is installed."""
    import av
    import pyarrow.parquet as parquet

    info = json.loads((place / "meta" / "info.json").read_text())
    episode = parquet.read_table(place / "meta" / "episodes", columns=None).to_pylist()[0]
    table = parquet.read_table(place / info["data_path"].format(chunk_index=0, file_index=0)).to_pylist()
    rows = [row for row in table if row["episode_index"] == episode["episode_index"]]
    frames = sample_frames(first_episode(data)["frames"])
    values = {"frames": np.array([len(rows), episode["length"]])}
    values["position"] = np.array([rows[frame]["observation.state"][:3] for frame in frames])
    chunk, file = (episode[f"videos/{CAMERA}/{name}_index"] for name in ("chunk", "file"))
    with av.open(str(place / info["video_path"].format(video_key=CAMERA, chunk_index=chunk, file_index=file))) as video:
        pictures = [picture.to_ndarray(format="rgb24") for picture in video.decode(video=0)]
    values |= {f"{PICTURE} {frame}": pictures[frame] / 255.0 for frame in frames}
    what = f"{place.name}: {info['total_episodes']} episodes, {info['total_frames']} frames; {len(pictures)} pictures"
    if importlib.util.find_spec("lerobot") is None:
        return ClientReading(what, values, ["the package lerobot is not installed: its reader was not tried"])
    ranges = {name: range(*map(int, span.split(":"))) for name, span in info["splits"].items()}
    for name, episodes in ranges.items():
        values |= _read_split(place, name, list(episodes), frames)
    return ClientReading(f"{what}; {len(ranges)} splits by LeRobotDataset", values, ["decoded by pyav: torchcodec needs a system's FFmpeg"])


def _read_split(place: Path, name: str, episodes: list[int], frames: list[int]) -> Values:
    """Read a split by LeRobot's own reader: its numbers of episodes and frames; of the first episode of all, the sampled frames, too."""
    os.environ["HF_HUB_OFFLINE"] = "1"
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    if not episodes:
        return {}
    data_set = LeRobotDataset("local/set", root=place, episodes=episodes, video_backend="pyav")
    first, last = data_set[0], data_set[len(data_set) - 1]
    values = {f"split {name}": np.array([data_set.num_episodes, len(data_set), bool(last["next.done"])])}
    if int(first["episode_index"]) == 0:
        rows = [data_set[frame] for frame in frames]
        values["dataset position"] = np.array([row["observation.state"][:3].numpy() for row in rows])
        for frame, row in zip(frames, rows, strict=True):
            values[f"{PICTURE} of dataset {frame}"] = row[CAMERA].permute(1, 2, 0).numpy()
    return values


def expect_lerobot(data_set: Any) -> Values:
    """Cup poses, which need the trajectories (zarr), pictures, and splits."""
    episode, views = data_set[min(data_set)], sampled_views(data_set)
    values = {"frames": np.array([len(episode), len(episode)])}
    if data_set.has_store:
        values["position"] = np.asarray(episode.ticks["fixture_pose"][:])[list(views), 2, :3]
        values["dataset position"] = values["position"]
    for frame, view in views.items():
        values[f"{PICTURE} {frame}"] = values[f"{PICTURE} of dataset {frame}"] = view.rgb / 255.0
    for name, part in (data_set.splits or {"train": data_set}).items():
        values[f"split {name}"] = np.array([len(part), sum(len(part[index]) for index in part), True])
    return values
