"""Table of all clients, and the process of one of them: it reads, and leaves values in an .npz file and a report in JSON."""

from __future__ import annotations

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
        ("bop_toolkit_lib", "numpy"),
        first_scene,
        images.read_bop_toolkit,
        images.expect_bop_toolkit,
        {"depth": 1e-5, "world_to_camera": 1e-12, "object_to_camera": 1e-12, "model": 1e-4},  # [m]; models in float32 [mm].
    ),
    "shards": Client(("webdataset", "torch", "synpick-warp"), first_shard, images.read_shards, bounds={"depth": 1e-6}),
    "pytorch": Client(("torch", "synpick-warp"), images.find_views, images.read_pytorch, bounds={"visible_pose": 1e-6}),
    "hugging_face": Client(("datasets", "pillow"), images.find_shards, images.read_hugging_face),
    "coco": Client(("pycocotools",), images.find_coco, images.read_coco, images.expect_coco),
    "yolo": Client(
        ("ultralytics", "supervision"),
        find_in("yolo/data.yaml"),
        images.read_yolo,
        images.expect_yolo,
        {
            "box": 1e-3,
            "box_of_segment": 0.61,
            "oriented_area": 0.02,
        },  # Boxes, those that Ultralytics takes from segments [px]; areas, relative.
    ),
    "xarray_store": Client(("xarray", "zarr"), find_in("trajectory.zarr"), trajectories.read_xarray, trajectories.expect_ticks),
    "newton_usd": Client(
        ("newton", "newton-usd-schemas", "usd-core"),
        find_usd,
        trajectories.read_newton,
        trajectories.expect_first_frame,
        {"object_to_world": 1e-6},  # Newton keeps poses in float32, BOP files have translations in millimetres.
    ),
    "blender": Client(
        ("bpy",),
        find_usd,
        trajectories.read_blender,
        trajectories.expect_blender,
        {"object_to_world": 2e-6, "camera_to_world": 2e-6, "focal": 1e-3},  # 32-bit matrices [m]; focal length, relative to the width.
        trajectories.develop,
    ),
    "lerobot": Client(
        ("av", "pyarrow", "lerobot", "torch"),
        trajectories.find_lerobot,
        trajectories.read_lerobot,
        trajectories.expect_lerobot,
        {"position": 1e-6, "dataset": 1e-6},
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
    """Run one client in this process; arguments: NAME PLACE DATA OUT TOOLKIT."""
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
