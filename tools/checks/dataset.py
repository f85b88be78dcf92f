"""Check a baked BOP data set against itself: images against models and poses, numbers against images, cameras against each other.

Uses nothing of the project: triangles of models/ are intersected with the rays of pixel centres here, in float64. Prints a
table; exits with 1 if a bound is violated, with 2 if the folder cannot be checked.

    python -m tools.checks.dataset DIR --views 24
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import trimesh

DEPTH_TOLERANCE = 0.2
"""Between a depth image and the models [mm]."""
EDGE = 5.0
"""A pixel counts as a border if the models' depth changes by more within one pixel of it, or ends there [mm]."""
CHUNK = 2_000_000
"""Pairs of triangle and pixel that are intersected at once."""


class UnusableError(Exception):
    """The folder is no data set, or a file of it cannot be read."""


@dataclass
class Measure:
    """Something that is to be at most `allowed`: the largest of all values seen, or the share of bad ones in all pixels added."""

    name: str
    unit: str
    allowed: float
    worst: float = 0.0
    where: str = ""
    bad: int = 0
    total: int = 0

    def see(self, value: float, where: str) -> None:
        self.total += 1
        if not value <= self.worst:  # NaN is worst of all.
            self.worst, self.where = value, where

    def add(self, bad: npt.ArrayLike, total: npt.ArrayLike, where: str) -> None:
        count = int(np.count_nonzero(bad))
        if count and not self.bad:
            self.where = where
        self.bad += count
        self.total += int(np.count_nonzero(total))
        self.worst = 100.0 * self.bad / max(self.total, 1)

    @property
    def holds(self) -> bool:
        return self.worst <= self.allowed


@dataclass
class Report:
    """All measures."""

    missing: Measure = field(default_factory=lambda: Measure("files missing, lists of different length", "", 0))
    rotation: Measure = field(default_factory=lambda: Measure("rotations: deviation from orthonormal", "", 1e-9))
    world: Measure = field(default_factory=lambda: Measure("instance in the world, camera against camera", "mm", 1e-3))
    depth: Measure = field(default_factory=lambda: Measure("depth against models, inside", "mm", DEPTH_TOLERANCE))
    border: Measure = field(default_factory=lambda: Measure("depth against models, borders beyond tolerance", "% of px", 0.05))
    unknown: Measure = field(default_factory=lambda: Measure("visible instance without depth", "% of px", 0))
    mask: Measure = field(default_factory=lambda: Measure("mask against models", "% of px", 0.05))
    visible: Measure = field(default_factory=lambda: Measure("mask_visib against models and depth", "% of px", 0.05))
    overlap: Measure = field(default_factory=lambda: Measure("mask_visib of several instances", "% of px", 0))
    outside: Measure = field(default_factory=lambda: Measure("mask_visib outside of mask", "% of px", 0))
    count_all: Measure = field(default_factory=lambda: Measure("px_count_all against models, beyond 2 px and 0.1 %", "px", 0))
    count_valid: Measure = field(default_factory=lambda: Measure("px_count_valid against mask and depth", "px", 0))
    count_visible: Measure = field(default_factory=lambda: Measure("px_count_visib against mask_visib", "px", 0))
    fraction: Measure = field(default_factory=lambda: Measure("visib_fract against counts", "", 1e-12))
    box_whole: Measure = field(default_factory=lambda: Measure("bbox_obj against models", "px", 1))
    box_visible: Measure = field(default_factory=lambda: Measure("bbox_visib against mask_visib", "px", 0))
    coco: Measure = field(default_factory=lambda: Measure("COCO annotations that are wrong or missing", "", 0))


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What the rays of a picture, and of one more picture's size around it, hit of one object."""

    depth: np.ndarray
    """Planar depth in a part of the picture's plane (h, w) float64 [mm], infinite: missed."""
    left: int
    """Column of the part's first column; may be negative."""
    top: int

    def inside(self, height: int, width: int) -> np.ndarray:
        """Depth over the picture (height, width)."""
        full = np.full((height, width), np.inf)
        rows = slice(max(self.top, 0), max(min(self.top + self.depth.shape[0], height), 0))
        columns = slice(max(self.left, 0), max(min(self.left + self.depth.shape[1], width), 0))
        part = full[rows, columns]
        part[...] = self.depth[rows.start - self.top :, columns.start - self.left :][: part.shape[0], : part.shape[1]]
        return full

    def box(self) -> list[int]:
        """BOP's box: x, y, x_max - x_min, y_max - y_min."""
        return tight_box(np.isfinite(self.depth), self.left, self.top)


def cast(corners: np.ndarray, matrix: np.ndarray, height: int, width: int) -> Silhouette:
    """Intersect the rays of pixel centres with triangles (F, 3, 3) in the camera's frame [mm].

    A ray d through the camera's centre hits the triangle a, b, c if d·(b x c), d·(c x a) and d·(a x b) have one sign;
    its depth then is a·(b x c) over their sum.
    """
    if not (corners[..., 2] > 0).all():
        raise UnusableError("an object reaches behind a camera; this check cannot deal with that")
    plane = corners @ matrix.T
    pixel = plane[..., :2] / plane[..., 2:] - 0.5
    low = np.maximum(np.ceil(pixel.min(axis=1)), (-width, -height)).astype(int)
    high = np.minimum(np.floor(pixel.max(axis=1)), (2 * width - 1, 2 * height - 1)).astype(int)
    extent = np.maximum(high - low + 1, 0)
    wanted = extent.prod(axis=1) > 0
    corners, low, high, extent = corners[wanted], low[wanted], high[wanted], extent[wanted]
    if not len(corners):
        return Silhouette(np.full((0, 0), np.inf), 0, 0)
    (left, top), (right, bottom) = low.min(axis=0), high.max(axis=0)
    depth = np.full((bottom - top + 1, right - left + 1), np.inf)
    edges = np.stack([np.cross(corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]) for i in range(3)], axis=1)
    volume = np.einsum("fi,fi->f", corners[:, 0], edges[:, 0])
    inverse = np.linalg.inv(matrix)
    for triangle, column, row in candidates(low, extent):
        ray = np.stack([column + 0.5, row + 0.5, np.ones(len(row))], axis=1) @ inverse.T
        sides = np.einsum("nij,nj->ni", edges[triangle], ray)
        hit = ((sides >= 0).all(axis=1) | (sides <= 0).all(axis=1)) & (sides.sum(axis=1) != 0)
        np.minimum.at(depth, (row[hit] - top, column[hit] - left), volume[triangle[hit]] / sides[hit].sum(axis=1))
    return Silhouette(depth, int(left), int(top))


def candidates(low: np.ndarray, extent: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Triangle, column and row of every pixel in every triangle's rectangle, in chunks."""
    counts = extent.prod(axis=1)
    chunk = np.cumsum(counts) // CHUNK
    for number in np.unique(chunk):
        members = np.flatnonzero(chunk == number)
        triangle = np.repeat(members, counts[members])
        first = np.repeat(np.cumsum(counts[members]) - counts[members], counts[members])
        place = np.arange(len(triangle)) - first
        yield triangle, low[triangle, 0] + place % extent[triangle, 0], low[triangle, 1] + place // extent[triangle, 0]


def tight_box(mask: np.ndarray, left: int = 0, top: int = 0) -> list[int]:
    """BOP's box of a mask; -1 four times if it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return [-1, -1, -1, -1]
    return [int(columns[0]) + left, int(rows[0]) + top, int(np.ptp(columns)), int(np.ptp(rows))]


@cache
def read_json(path: Path) -> dict[str, Any]:
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise UnusableError(f"cannot read {path}: {error}") from error


def read_image(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise UnusableError(f"cannot read {path}")
    return image


@cache
def read_model(path: Path) -> np.ndarray:
    """Corners of all triangles (F, 3, 3) [mm]."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (OSError, ValueError) as error:
        raise UnusableError(f"cannot read {path}: {error}") from error
    return np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]


def matrix_of(record: dict[str, Any], rotation: str, translation: str) -> np.ndarray:
    """4 x 4, lengths in mm."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(record[rotation], (3, 3)), record[translation]
    return matrix


def check_files(scene: Path, report: Report) -> None:
    """That every list is as long as the others, and every image is there."""
    cameras, truth, infos = (read_json(scene / f"scene_{name}.json") for name in ("camera", "gt", "gt_info"))
    problems = len(cameras.keys() ^ truth.keys()) + len(cameras.keys() ^ infos.keys())
    masks = [folder for name in ("mask", "mask_visib") if (folder := scene / name).is_dir()]
    names = {
        folder.name: {path.name for path in folder.iterdir()} for folder in (scene / "rgb", scene / "depth", *masks) if folder.is_dir()
    }
    for frame, records in truth.items():
        stem = f"{int(frame):06d}"
        problems += len(records) != len(infos.get(frame, ()))
        problems += not names.get("rgb", set()) & {f"{stem}.jpg", f"{stem}.png"}
        problems += f"{stem}.png" not in names.get("depth", ())
        problems += sum(f"{stem}_{index:06d}.png" not in names[folder.name] for folder in masks for index in range(len(records)))
    report.missing.see(problems, scene.name)


def check_world(scenes: list[Path], frame: str, report: Report) -> None:
    """That all cameras of an episode see each instance at one place."""
    places = defaultdict(list)
    for scene in scenes:
        cameras, truth = (read_json(scene / f"scene_{name}.json") for name in ("camera", "gt"))
        camera = cameras.get(frame, {})
        for index, record in enumerate(truth.get(frame, ()) if camera else ()):
            where = f"{scene.name} image {frame}"
            pose = matrix_of(record, "cam_R_m2c", "cam_t_m2c")
            for rotation in (pose[:3, :3], np.reshape(camera["cam_R_w2c"], (3, 3))):
                error = np.abs(rotation.T @ rotation - np.eye(3)).max() + abs(np.linalg.det(rotation) - 1)
                report.rotation.see(float(error), where)
            model = read_model(scene.parent.parent / "models" / f"obj_{record['obj_id']:06d}.ply").reshape(-1, 3)
            ends = np.array([model.min(axis=0), model.max(axis=0)])
            world = np.linalg.inv(matrix_of(camera, "cam_R_w2c", "cam_t_w2c")) @ pose
            places[record.get("instance_id", index), record["obj_id"]].append(ends @ world[:3, :3].T + world[:3, 3])
    for (instance, _), seen in places.items():
        error = max(float(np.linalg.norm(place - seen[0], axis=-1).max()) for place in seen)
        report.world.see(error if len(seen) == len(scenes) else np.inf, f"{scenes[0].name} image {frame} instance {instance}")


@dataclass(frozen=True, eq=False)
class View:
    """A view's files, and what the models say about it."""

    where: str
    infos: list[dict[str, Any]]
    depth: np.ndarray
    """Of the depth image [mm]; infinite: none."""
    masks: np.ndarray
    """(N, H, W) bool; all N = 0 if there are none."""
    seen: np.ndarray
    """mask_visib (N, H, W) bool."""
    hits: list[Silhouette]


def read_view(scene: Path, frame: str) -> View:
    camera = read_json(scene / "scene_camera.json")[frame]
    stem = f"{int(frame):06d}"
    counts = read_image(scene / "depth" / f"{stem}.png")
    height, width = counts.shape
    hits = []
    records = read_json(scene / "scene_gt.json")[frame]
    for record in records:
        corners = read_model(scene.parent.parent / "models" / f"obj_{record['obj_id']:06d}.ply")
        pose = matrix_of(record, "cam_R_m2c", "cam_t_m2c")
        hits.append(cast(corners @ pose[:3, :3].T + pose[:3, 3], np.reshape(camera["cam_K"], (3, 3)), height, width))
    images = {}
    for name in ("mask", "mask_visib"):
        paths = [scene / name / f"{stem}_{index:06d}.png" for index in range(len(records))] if (scene / name).is_dir() else []
        images[name] = np.array([read_image(path) > 0 for path in paths]).reshape(len(paths), height, width)
    depth = np.where(counts > 0, counts * float(camera["depth_scale"]), np.inf)
    return View(
        f"{scene.name} image {frame}", read_json(scene / "scene_gt_info.json")[frame], depth, images["mask"], images["mask_visib"], hits
    )


def check_images(view: View, report: Report) -> None:
    """Depth and masks against the models."""
    inside = np.array([hit.inside(*view.depth.shape) for hit in view.hits])
    if not len(inside):
        return
    nearest = inside.min(axis=0)
    # Where the depth image is nearer than every instance, something that is no instance hides it.
    hidden = view.depth < nearest - DEPTH_TOLERANCE
    expected = np.array([(depth <= nearest) & np.isfinite(depth) & ~hidden for depth in inside])
    finite = np.where(np.isfinite(nearest), nearest, 1e9)
    square = np.ones((3, 3), np.uint8)
    border = cv2.dilate(finite, square) - cv2.erode(finite, square) > EDGE
    claimed = view.seen if len(view.seen) else expected
    compared = (claimed & (inside <= nearest) & np.isfinite(inside)).any(axis=0)
    error = np.abs(np.where(compared, view.depth, 0.0) - np.where(compared, nearest, 0.0))
    known = compared & np.isfinite(view.depth)
    report.depth.see(float(error[known & ~border].max(initial=0.0)), view.where)
    report.border.add(known & border & (error > DEPTH_TOLERANCE), compared, view.where)
    report.unknown.add(compared & ~known, compared, view.where)
    for index, mask in enumerate(view.masks):
        report.mask.add(mask ^ np.isfinite(inside[index]), mask, view.where)
    for index, seen in enumerate(view.seen):
        report.visible.add(seen ^ expected[index], seen, view.where)
    report.overlap.add(view.seen.sum(axis=0) > 1, view.seen.any(axis=0), view.where)
    if len(view.masks) == len(view.seen):
        report.outside.add(view.seen & ~view.masks, view.seen, view.where)


def check_numbers(view: View, report: Report) -> None:
    """scene_gt_info against images and models."""
    for index, (info, hit) in enumerate(zip(view.infos, view.hits, strict=True)):
        where = f"{view.where} instance {index}"
        whole = int(np.isfinite(hit.depth).sum())
        report.count_all.see(max(0.0, abs(info["px_count_all"] - whole) - max(2.0, 1e-3 * whole)), where)
        share = info["px_count_visib"] / info["px_count_all"] if info["px_count_all"] else 0.0
        report.fraction.see(abs(info["visib_fract"] - share), where)
        box = hit.box() if info["px_count_visib"] else [-1, -1, -1, -1]
        report.box_whole.see(box_error(info["bbox_obj"], box), where)
        if len(view.masks):
            valid = np.count_nonzero(view.masks[index] & np.isfinite(view.depth))
            report.count_valid.see(abs(info["px_count_valid"] - valid), where)
        if len(view.seen):
            report.count_visible.see(abs(info["px_count_visib"] - np.count_nonzero(view.seen[index])), where)
            report.box_visible.see(box_error(info["bbox_visib"], tight_box(view.seen[index])), where)


def box_error(one: list[int], other: list[int]) -> float:
    """The largest distance between two boxes' edges [px]."""
    ends = [(x, y, x + width, y + height) for x, y, width, height in (one, other)]
    return float(max(abs(a - b) for a, b in zip(*ends, strict=True)))


def check_coco(scene: Path, frame: str, view: View, report: Report) -> None:
    """Annotations against masks, boxes and scene_gt."""
    if not (scene / "scene_gt_coco.json").is_file() or len(view.seen) != len(view.masks):
        return
    coco = read_json(scene / "scene_gt_coco.json")
    found = [annotation for annotation in coco["annotations"] if annotation["image_id"] == int(frame)]
    expected = [index for index, seen in enumerate(view.seen) if seen.any()]
    wrong = abs(len(found) - len(expected)) + (int(frame) not in {image["id"] for image in coco["images"]})
    for annotation, index in zip(found, expected, strict=False):
        counts, (height, width) = annotation["segmentation"]["counts"], annotation["segmentation"]["size"]
        runs = np.repeat(np.arange(len(counts)) % 2 == 1, counts)
        same = runs.size == height * width and np.array_equal(runs.reshape(width, height).T, view.seen[index])
        x, y, box_width, box_height = tight_box(view.masks[index])
        wrong += not (
            same
            and annotation["bbox"] == [x, y, box_width + 1, box_height + 1]
            and annotation["area"] == np.count_nonzero(view.seen[index])
            and annotation["category_id"] == read_json(scene / "scene_gt.json")[frame][index]["obj_id"]
            and annotation["ignore"] == (view.infos[index]["visib_fract"] < 0.1)
        )
    report.coco.see(wrong, view.where)


def check(dataset: Path, views: int) -> Report:
    """Check all files of a data set, and everything else on views spread evenly over it."""
    scenes = sorted(path.parent for path in dataset.glob("*/*/scene_camera.json"))
    if not scenes:
        raise UnusableError(f"{dataset} has no scene")
    report = Report()
    lenses = set()
    for scene in scenes:
        check_files(scene, report)
        first = next(iter(read_json(scene / "scene_camera.json").values()), {})
        lenses.add((*first.get("cam_R_w2c", ()), *first.get("cam_t_w2c", ())))
    order = [(scene, frame) for scene in scenes for frame in sorted(read_json(scene / "scene_gt.json"), key=int)]
    for place in np.unique(np.linspace(0, len(order) - 1, views).round().astype(int)):
        scene, frame = order[place]
        episode = int(scene.name) // len(lenses)
        check_world(
            [other for other in scenes if other.parent == scene.parent and int(other.name) // len(lenses) == episode], frame, report
        )
        view = read_view(scene, frame)
        check_images(view, report)
        check_numbers(view, report)
        check_coco(scene, frame, view, report)
    return report


def print_report(report: Report) -> bool:
    """Print the table; returns whether every bound holds and the main things were measured at all."""
    measures: list[Measure] = list(vars(report).values())
    print(f"{'what':<52} {'found':>12} {'allowed':>9} {'unit':<8} {'of':>10}  where")
    for measure in measures:
        found = f"{measure.worst:.6g}" if measure.total else "-"
        verdict = "" if measure.holds else "  VIOLATED"
        print(f"{measure.name:<52} {found:>12} {measure.allowed:>9g} {measure.unit:<8} {measure.total:>10}  {measure.where}{verdict}")
    if not (report.depth.total and report.world.total):
        print("nothing was checked: no sampled view has an instance")
        return False
    return all(measure.holds for measure in measures)


def main() -> int:
    parser = argparse.ArgumentParser(description="Check a baked BOP data set for consistency.")
    parser.add_argument("dataset", type=Path, metavar="DIR", help="folder of the data set")
    parser.add_argument("--views", type=int, default=24, help="views to check, spread over the data set (default %(default)s)")
    arguments = parser.parse_args()
    if arguments.views < 1:
        parser.error(f"--views is {arguments.views}; allowed: at least 1")
    try:
        return 0 if print_report(check(arguments.dataset, arguments.views)) else 1
    except UnusableError as error:
        print(f"check_dataset: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
