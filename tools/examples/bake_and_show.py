"""Bake a small data set and draw one view with its instance masks and poses.

python -m tools.examples.bake_and_show DATA
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import synpick_warp
from synpick_warp.dataset.view import MILLIMETERS, View

SETTINGS = {"bake.episodes": 1, "bake.worlds": 1}
AXES = 0.04 * np.concatenate((np.zeros((1, 3)), np.eye(3)))
"""Origin and tips of the drawn axes in an object's frame (4, 3) [m]."""
AXIS_COLORS = ((255, 0, 0), (0, 255, 0), (0, 0, 255))
TINT = 0.45
"""Weight of an instance's colour over the image."""


def draw_view(view: View) -> np.ndarray:
    """The image with tinted visible masks and the visible objects' axes, x red, y green, z blue (H, W, 3) uint8, red first."""
    image = view.rgb.copy()
    colors = np.random.default_rng(0).uniform(60, 255, (len(view), 3))
    for mask, color in zip(view.masks, colors, strict=True):
        image[mask] = (1 - TINT) * image[mask] + TINT * color
    for pose, visibility in zip(view.object_to_camera, view.visibility, strict=True):
        if visibility > 0:
            origin, *tips = view.project(AXES, pose).astype(int).tolist()
            for tip, color in zip(tips, AXIS_COLORS, strict=True):
                cv2.line(image, origin, tip, color, 2, cv2.LINE_AA)
    return image


def check(view: View, models_info: dict[int, dict]) -> None:
    """Depth, masks and poses belong together: an object's visible points lie within its bounding sphere."""
    rows, columns = np.indices(view.depth.shape) + 0.5
    rays = np.stack((columns, rows, np.ones_like(rows)), axis=-1) @ np.linalg.inv(view.intrinsics).T
    points = rays * view.depth[..., None]
    for mask, pose, object_id in zip(view.masks, view.object_to_camera, view.object_ids.tolist(), strict=True):
        info = models_info[object_id]
        middle = np.array([info[f"min_{axis}"] + info[f"size_{axis}"] / 2 for axis in "xyz"]) / MILLIMETERS
        center = pose[:3, :3] @ middle + pose[:3, 3]
        radius = np.linalg.norm([info[f"size_{axis}"] for axis in "xyz"]) / MILLIMETERS / 2
        distance = np.linalg.norm(points[mask] - center, axis=-1)
        if not (distance <= radius + 1e-3).all():
            raise SystemExit(f"object {object_id} is {distance.max():.3f} m from its pose, but its radius is {radius:.3f} m")


def main(arguments: list[str] | None = None) -> None:
    """Bake if needed, draw, check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="data set; baked if there is none")
    parser.add_argument("--out", type=Path, default=Path("view.png"), help="picture to write (default view.png)")
    given = parser.parse_args(arguments)
    if not given.folder.exists():
        synpick_warp.bake("smoke", given.folder, SETTINGS)

    data = synpick_warp.open(given.folder)
    view = data[next(iter(data))].view(frame=0)
    cv2.imwrite(str(given.out), cv2.cvtColor(draw_view(view), cv2.COLOR_RGB2BGR))
    print(f"{given.out}: {view} with {len(view)} objects, {(view.visibility > 0).sum()} visible")
    check(view, data.models_info)


if __name__ == "__main__":
    main()
