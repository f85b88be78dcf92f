"""Table of clients, third-party libraries that read our data sets in a test, and the script that runs one of them: it saves what it read
(.npz) and a report (.json)."""

import json
import sys
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients import images, trajectories
from tools.clients.base import Client, find_in, find_usd, first_scene, first_shard

CLIENTS = {
    "bop_toolkit": Client(
        packages=("bop_toolkit_lib", "numpy"),
        find=first_scene,
        read=images.read_bop_toolkit,
        expect=images.expect_bop_toolkit,
        bounds={"depth": 1e-5, "world_to_camera": 1e-12, "object_to_camera": 1e-12, "model": 1e-4},  # [m]; models [mm], stored in float32.
    ),
    "shards": Client(("webdataset", "torch", "synpick-warp"), first_shard, images.read_shards, bounds={"depth": 1e-6}),
    "pytorch": Client(("torch", "synpick-warp"), images.find_views, images.read_pytorch, bounds={"visible_pose": 1e-6}),
    "hugging_face": Client(("datasets", "pillow"), images.find_shards, images.read_hugging_face),
    "coco": Client(("pycocotools",), images.find_coco, images.read_coco, images.expect_coco),
    "yolo": Client(
        packages=("ultralytics", "supervision"),
        find=find_in("yolo/data.yaml"),
        read=images.read_yolo,
        expect=images.expect_yolo,
        bounds={"box": 1e-3, "box_of_segment": 0.61, "oriented_area": 0.02},  # Boxes [px], also of segments; areas, relative.
    ),
    "xarray_store": Client(("xarray", "zarr"), find_in("trajectory.zarr"), trajectories.read_xarray, trajectories.expect_ticks),
    "newton_usd": Client(
        packages=("newton", "newton-usd-schemas", "usd-core"),
        find=find_usd,
        read=trajectories.read_newton,
        expect=trajectories.expect_first_frame,
        bounds={"object_to_world": 1e-6},  # Newton keeps poses in float32, BOP files have translations in millimetres.
    ),
    "blender": Client(
        packages=("bpy",),
        find=find_usd,
        read=trajectories.read_blender,
        expect=trajectories.expect_blender,
        bounds={"object_to_world": 2e-6, "camera_to_world": 2e-6, "focal": 1e-3},  # Matrices [m], in float32; relative to the width.
        tone_map=trajectories.tone_map,
    ),
    "lerobot": Client(
        packages=("av", "pyarrow", "lerobot", "torch"),
        find=trajectories.find_lerobot,
        read=trajectories.read_lerobot,
        expect=trajectories.expect_lerobot,
        bounds={"position": 1e-6, "dataset": 1e-6},
    ),
}
"""Clients by name, in the order of the table's rows."""


def version_of(package: str) -> str:
    """Version of a distribution, or "" if it is not installed but can be imported from a folder."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return ""


def main() -> None:
    """Run one client in this process; arguments: its name, the file or folder it opens, the data set's folder, the folder for results, and
    that of a copy of the BOP toolkit (empty: none)."""
    name, place, data, out, toolkit = sys.argv[1:]
    client = CLIENTS[name]
    reading = client.read(Path(place), Path(data), toolkit)
    folder = Path(out)
    values: dict[str, Any] = dict(reading.values)
    np.savez(folder / "values.npz", **values)
    versions = {package: version_of(package) for package in client.packages} | reading.versions
    (folder / "report.json").write_text(json.dumps({"what": reading.what, "remarks": reading.remarks, "versions": versions}))


if __name__ == "__main__":
    main()
