"""Read trajectories: print pick attempts, and draw the path of every object, seen from the side.

python -m tools.examples.read_trajectory DATA
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

import synpick_warp
from synpick_warp.dataset.reading import Episode

SETTINGS = {"bake.episodes": 1, "bake.worlds": 1, "bake.mode": "pick", "bake.formats": ["bop", "zarr"], "pick.failures": 1}
SIZE, SCALE = 480, 480.0
"""Width and height of the picture [px], and pixels per metre: it shows 1 m x 1 m above the tote's floor."""
TOLERANCE = 1e-6
"""How far poses of two formats differ: float32 against float64 [m]."""


def object_paths(episode: Episode) -> dict[int, np.ndarray]:
    """instance_id -> position in every frame (frame, 3) [m]; NaN where the object is not in the scene."""
    poses, object_ids = episode.ticks["pose"][:], episode.ticks["object_id"][:]
    positions = np.where(object_ids[..., None] >= 0, poses[..., :3], np.nan)
    return {instance: positions[:, instance] for instance in np.flatnonzero((object_ids >= 0).any(axis=0)).tolist()}


def draw_paths(paths: dict[int, np.ndarray]) -> np.ndarray:
    """Paths from the side, x to the right and z up; a disc at each start (SIZE, SIZE, 3) uint8."""
    picture = np.full((SIZE, SIZE, 3), 255, np.uint8)
    colors = np.random.default_rng(0).integers(30, 200, (len(paths), 3)).tolist()
    for path, color in zip(paths.values(), colors, strict=True):
        known = path[np.isfinite(path).all(axis=1)]
        pixels = np.rint((SIZE / 2, SIZE - 1) + SCALE * known[:, ::2] * (1, -1)).astype(np.int32)
        cv2.polylines(picture, [pixels], False, color, 2, cv2.LINE_AA)
        cv2.circle(picture, pixels[0].tolist(), 5, color, -1, cv2.LINE_AA)
    return picture


def check(episode: Episode, paths: dict[int, np.ndarray]) -> None:
    """Compare trajectories with the ground truth of every 20th view of the first camera. Raises SystemExit where they differ."""
    for view in list(episode.views(camera=0))[::20]:
        for instance, pose in zip(view.instance_ids.tolist(), view.object_to_world, strict=True):
            error = np.abs(pose[:3, 3] - paths[instance][view.frame]).max()
            if not error < TOLERANCE:
                raise SystemExit(f"{view}: instance {instance} is {error:g} m off its path")


def main(arguments: list[str] | None = None) -> None:
    """Bake if needed, print, draw, check."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="data set with the formats bop and zarr; baked if there is none")
    parser.add_argument("--out", type=Path, default=Path("paths.png"), help="picture to write (default paths.png)")
    given = parser.parse_args(arguments)
    if not given.folder.exists():
        synpick_warp.bake("smoke", given.folder, SETTINGS)

    data = synpick_warp.open(given.folder)
    episode = data[next(iter(data))]
    names = {one.object_id: one.name for one in data.objects}
    for attempt in episode.attempts:
        target = names.get(attempt["object_id"], "nothing")
        print(f"attempt {attempt['attempt']}, frames {attempt['frame']} to {attempt['end_frame']}: {target}: {attempt['sentence']}")
    paths = object_paths(episode)
    cv2.imwrite(str(given.out), draw_paths(paths))
    print(f"{given.out}: {len(paths)} objects, {len(episode)} frames")
    check(episode, paths)


if __name__ == "__main__":
    main()
