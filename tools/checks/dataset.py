"""Accuracy check of a baked BOP data set: images and scene_gt_info against models and poses, cameras against each other.

Independent of the kernels that made it: triangles of models/ are intersected with the rays of pixel centres here, in float64, through
the lens of a distorted camera. Prints a table; exits with 1 if a bound is violated, with 2 if the folder cannot be checked. What files
say of each other, without models (counts of masks, COCO annotations, missing files), is checked by `synpick-warp validate`.

    python -m tools.checks.dataset DIR --views 24
"""

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import trimesh

from synpick_warp.configs.calibration.lens import LensMap, read_lens
from synpick_warp.configs.files.load import load_config
from synpick_warp.errors import DatasetError, SynpickError
from tools.options import fail, positive_count


@dataclass
class MeasuredValue:
    """Bounded quantity: the largest magnitude of all values (`update_max`), or the percentage of bad pixels (`add_pixels`)."""

    name: str
    unit: str
    allowed: float
    worst: float = 0.0
    where: str = ""
    """Image, scene or episode of the worst value; of percentages, of the first bad pixel."""
    bad: int = 0
    total: int = 0
    """Values or pixels so far."""

    def update_max(self, values: npt.ArrayLike, where: str) -> None:
        """Take the maximum with the magnitudes of `values`, which are of `where`."""
        magnitudes = np.abs(np.asarray(values, dtype=np.float64))
        if not magnitudes.size:
            return
        self.total += magnitudes.size
        worst = float(magnitudes.max())
        if not worst <= self.worst:  # NaN is the worst value.
            self.worst, self.where = worst, where

    def add_pixels(self, bad: npt.ArrayLike, total: npt.ArrayLike, where: str) -> None:
        """Count the bad pixels and all pixels of the image `where`, given as masks."""
        count = int(np.count_nonzero(bad))
        if count and not self.bad:
            self.where = where
        self.bad += count
        self.total += int(np.count_nonzero(total))
        self.worst = 100.0 * self.bad / max(self.total, 1)

    @property
    def holds(self) -> bool:
        """Whether the worst value is within the bound."""
        return self.worst <= self.allowed


def print_measures(measures: Iterable[MeasuredValue]) -> bool:
    """Print the table of all quantities; returns whether all bounds hold."""
    held = True
    print(f"{'quantity':<60} {'measured':>12} {'allowed':>9} {'unit':<8} {'count':>10}  worst case")
    for measure in measures:
        worst = f"{measure.worst:.6g}" if measure.total else "-"
        verdict = "" if measure.holds else "  VIOLATED"
        print(f"{measure.name:<60} {worst:>12} {measure.allowed:>9g} {measure.unit:<8} {measure.total:>10}  {measure.where}{verdict}")
        held = held and measure.holds
    return held


def run_check(
    doc: str | None, samples: str, default: int, check: Callable[[Path, int], Mapping[str, MeasuredValue]], needed: Iterable[str]
) -> int:
    """Run the command line of a check that takes `default` or other numbers of `samples`, such as "views"; returns the exit code.

    Without values of the quantities `needed` nothing was checked.
    """
    parser = argparse.ArgumentParser(description=(doc or "").partition("\n")[0])
    parser.add_argument("dataset", type=Path, metavar="DIR", help="folder of the data set")
    text = f"{samples} to check, spread over the data set (default %(default)s)"
    parser.add_argument(f"--{samples}", dest="count", type=positive_count, default=default, help=text)
    given = parser.parse_args()
    try:
        measures = check(given.dataset, given.count)
    except SynpickError as error:
        return fail(parser.prog, error)
    held = print_measures(measures.values())
    missing = next((measures[name].name for name in needed if not measures[name].total), None)
    if missing is not None:
        print(f"nothing was checked: no sample has values of '{missing}'")
    return 0 if held and missing is None else 1


DEPTH_TOLERANCE = 0.2
"""Largest allowed difference between a depth image and the models [mm]."""
BORDER_STEP = 5.0
"""Depth step between neighbours that makes a pixel a border pixel [mm]; the silhouette is one as well."""
CHUNK = 2_000_000
"""Triangle-pixel pairs intersected at once."""


@dataclass
class Report:
    """Measures of the check, one for each bounded quantity."""

    rotation: MeasuredValue = field(default_factory=lambda: MeasuredValue("rotations: deviation from orthonormal", "", 1e-9))
    world: MeasuredValue = field(default_factory=lambda: MeasuredValue("position of an instance, camera against camera", "mm", 1e-3))
    depth: MeasuredValue = field(default_factory=lambda: MeasuredValue("depth against models, inside", "mm", DEPTH_TOLERANCE))
    border: MeasuredValue = field(default_factory=lambda: MeasuredValue("depth against models, borders beyond tolerance", "% of px", 0.05))
    unknown: MeasuredValue = field(default_factory=lambda: MeasuredValue("visible instance without depth", "% of px", 0))
    mask: MeasuredValue = field(default_factory=lambda: MeasuredValue("mask against models", "% of px", 0.05))
    visible: MeasuredValue = field(default_factory=lambda: MeasuredValue("mask_visib against models and depth", "% of px", 0.05))
    count_all: MeasuredValue = field(default_factory=lambda: MeasuredValue("px_count_all against models, beyond 2 px and 0.1 %", "px", 0))
    box_amodal: MeasuredValue = field(default_factory=lambda: MeasuredValue("bbox_obj against models", "px", 1))


@dataclass(frozen=True, eq=False)
class Silhouette:
    """Depth of one object by ray casting, in the image and up to one image size beyond its borders."""

    depth: np.ndarray
    """Planar depth in a window of the image plane (h, w) float64 [mm]; infinite: missed."""
    left: int
    """Image column of the window's first column; may be negative."""
    top: int
    """Image row of the window's first row, likewise."""

    def crop(self, height: int, width: int) -> np.ndarray:
        """Depth within the image (height, width), without the parts beyond its borders."""
        image = np.full((height, width), np.inf)
        rows = slice(max(self.top, 0), max(min(self.top + self.depth.shape[0], height), 0))
        columns = slice(max(self.left, 0), max(min(self.left + self.depth.shape[1], width), 0))
        overlap = image[rows, columns]
        overlap[...] = self.depth[rows.start - self.top :, columns.start - self.left :][: overlap.shape[0], : overlap.shape[1]]
        return image

    def box(self) -> list[int]:
        """Amodal bounding box in BOP's convention: x, y, x_max - x_min, y_max - y_min."""
        return tight_box(np.isfinite(self.depth), self.left, self.top)


def cast_rays(corners: np.ndarray, matrix: np.ndarray, height: int, width: int, lens: LensMap | None = None) -> Silhouette:
    """Ray casting: intersect the rays of pixel centres, through a lens unless None, with triangles (F, 3, 3) in the camera's frame [mm].

    A ray d through the camera's centre hits the triangle a, b, c if d·(b x c), d·(c x a) and d·(a x b) have the same sign;
    its depth then is a·(b x c) over their sum.
    """
    if not (corners[..., 2] > 0).all():
        raise DatasetError("an object reaches behind a camera; this check does not support that")
    slope, beside = corners / corners[..., 2:], np.zeros((len(corners), 1))
    pixel = (slope @ matrix.T)[..., :2] - 0.5
    if lens is not None:
        # Bent edges lie this close to their chords.
        edge = np.linalg.norm(slope - np.roll(slope, 1, axis=1), axis=-1).max(axis=1, keepdims=True)
        pixel, beside = lens.project(slope[..., :2]) - 0.5, lens.bend * edge**2 / 8
    low = np.maximum(np.ceil(pixel.min(axis=1) - beside), (-width, -height)).astype(int)
    high = np.minimum(np.floor(pixel.max(axis=1) + beside), (2 * width - 1, 2 * height - 1)).astype(int)
    extent = np.maximum(high - low + 1, 0)
    covers = extent.prod(axis=1) > 0
    corners, low, high, extent = corners[covers], low[covers], high[covers], extent[covers]
    if not len(corners):
        return Silhouette(np.full((0, 0), np.inf), 0, 0)
    (left, top), (right, bottom) = low.min(axis=0), high.max(axis=0)
    depth = np.full((bottom - top + 1, right - left + 1), np.inf)
    edges = np.stack([np.cross(corners[:, (i + 1) % 3], corners[:, (i + 2) % 3]) for i in range(3)], axis=1)
    volume = np.einsum("fi,fi->f", corners[:, 0], edges[:, 0])
    centers = np.stack(np.meshgrid(np.arange(left, right + 1) + 0.5, np.arange(top, bottom + 1) + 0.5), -1)
    rays = (centers - matrix[:2, 2]) / np.diag(matrix)[:2] if lens is None else lens.unproject(centers)
    rays = np.concatenate([rays, np.ones((*depth.shape, 1))], axis=-1)
    for triangle, column, row in box_pixels(low, extent):
        sides = np.einsum("nij,nj->ni", edges[triangle], rays[row - top, column - left])
        hit = ((sides >= 0).all(axis=1) | (sides <= 0).all(axis=1)) & (sides.sum(axis=1) != 0)
        np.minimum.at(depth, (row[hit] - top, column[hit] - left), volume[triangle[hit]] / sides[hit].sum(axis=1))
    return Silhouette(depth, int(left), int(top))


def box_pixels(low: np.ndarray, extent: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Triangle, column and row of every pixel in every triangle's bounding box, in chunks."""
    counts = extent.prod(axis=1)
    chunk = np.cumsum(counts) // CHUNK
    for index in np.unique(chunk):
        members = np.flatnonzero(chunk == index)
        triangle = np.repeat(members, counts[members])
        first = np.repeat(np.cumsum(counts[members]) - counts[members], counts[members])
        pixel = np.arange(len(triangle)) - first
        yield triangle, low[triangle, 0] + pixel % extent[triangle, 0], low[triangle, 1] + pixel // extent[triangle, 0]


def tight_box(mask: np.ndarray, left: int = 0, top: int = 0) -> list[int]:
    """Bounding box of a mask in BOP's convention; four times -1 if it is empty."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return [-1, -1, -1, -1]
    return [int(columns[0]) + left, int(rows[0]) + top, int(np.ptp(columns)), int(np.ptp(rows))]


@cache
def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file, once."""
    try:
        return json.loads(path.read_bytes())
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error


def read_image(path: Path) -> np.ndarray:
    """Read an image with its own depth and channels."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"cannot read {path}")
    return image


@cache
def read_model(path: Path) -> np.ndarray:
    """Read the corners of all triangles of a model (F, 3, 3) [mm], once."""
    try:
        mesh = trimesh.load_mesh(path, process=False)
    except (OSError, ValueError) as error:
        raise DatasetError(f"cannot read {path}: {error}") from error
    return np.asarray(mesh.vertices, np.float64)[np.asarray(mesh.faces)]


def transform_matrix(record: dict[str, Any], rotation: str, translation: str) -> np.ndarray:
    """Homogeneous transform (4, 4) [mm] from the fields `rotation` and `translation` of a JSON record."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(record[rotation], (3, 3)), record[translation]
    return matrix


def check_world(scenes: list[Path], frame: str, report: Report) -> None:
    """Check that each instance has the same world position in all cameras of an episode."""
    extents = defaultdict(list)
    for scene in scenes:
        cameras, truth = (read_json(scene / f"scene_{name}.json") for name in ("camera", "gt"))
        camera = cameras.get(frame, {})
        for index, record in enumerate(truth.get(frame, ()) if camera else ()):
            where = f"{scene.name} image {frame}"
            pose = transform_matrix(record, "cam_R_m2c", "cam_t_m2c")
            for rotation in (pose[:3, :3], np.reshape(camera["cam_R_w2c"], (3, 3))):
                error = np.abs(rotation.T @ rotation - np.eye(3)).max() + abs(np.linalg.det(rotation) - 1)
                report.rotation.update_max(float(error), where)
            model = read_model(scene.parent.parent / "models" / f"obj_{record['obj_id']:06d}.ply").reshape(-1, 3)
            corners = np.array([model.min(axis=0), model.max(axis=0)])
            world = np.linalg.inv(transform_matrix(camera, "cam_R_w2c", "cam_t_w2c")) @ pose
            extents[record.get("instance_id", index), record["obj_id"]].append(corners @ world[:3, :3].T + world[:3, 3])
    for (instance, _), views in extents.items():
        error = max(float(np.linalg.norm(extent - views[0], axis=-1).max()) for extent in views)
        report.world.update_max(error if len(views) == len(scenes) else np.inf, f"{scenes[0].name} image {frame} instance {instance}")


@dataclass(frozen=True, eq=False)
class CheckedView:
    """Files of one view, and the silhouettes of its instances by ray casting."""

    where: str
    infos: list[dict[str, Any]]
    depth: np.ndarray
    """Depth image (H, W) float64 [mm]; infinite: no depth."""
    masks: np.ndarray
    """Amodal masks (N, H, W) bool; N = 0 without mask files."""
    visible: np.ndarray
    """Visible masks (N, H, W) bool, likewise."""
    silhouettes: list[Silhouette]


def read_view(scene: Path, frame: str) -> CheckedView:
    """Read one view, and cast rays at its instances."""
    camera = read_json(scene / "scene_camera.json")[frame]
    stem = f"{int(frame):06d}"
    counts = read_image(scene / "depth" / f"{stem}.png")
    height, width = counts.shape
    silhouettes = []
    records, lens = read_json(scene / "scene_gt.json")[frame], read_lens(camera, (width, height))
    for record in records:
        corners = read_model(scene.parent.parent / "models" / f"obj_{record['obj_id']:06d}.ply")
        pose = transform_matrix(record, "cam_R_m2c", "cam_t_m2c")
        matrix = np.reshape(camera["cam_K"], (3, 3))
        silhouettes.append(cast_rays(corners @ pose[:3, :3].T + pose[:3, 3], matrix, height, width, lens))
    images = {}
    for name in ("mask", "mask_visib"):
        paths = [scene / name / f"{stem}_{index:06d}.png" for index in range(len(records))] if (scene / name).is_dir() else []
        images[name] = np.array([read_image(path) > 0 for path in paths]).reshape(len(paths), height, width)
    depth = np.where(counts > 0, counts * float(camera["depth_scale"]), np.inf)
    return CheckedView(
        f"{scene.name} image {frame}",
        read_json(scene / "scene_gt_info.json")[frame],
        depth,
        images["mask"],
        images["mask_visib"],
        silhouettes,
    )


def check_images(view: CheckedView, report: Report) -> None:
    """Check depth and masks against the models."""
    inside = np.array([silhouette.crop(*view.depth.shape) for silhouette in view.silhouettes])
    if not len(inside):
        return
    nearest = inside.min(axis=0)
    # Where the depth image is nearer than every instance, tote, table or gripper occlude it.
    occluded = view.depth < nearest - DEPTH_TOLERANCE
    expected = np.array([(depth <= nearest) & np.isfinite(depth) & ~occluded for depth in inside])
    finite = np.where(np.isfinite(nearest), nearest, 1e9)
    square = np.ones((3, 3), np.uint8)
    border = cv2.dilate(finite, square) - cv2.erode(finite, square) > BORDER_STEP
    labelled = view.visible if len(view.visible) else expected
    compared = (labelled & (inside <= nearest) & np.isfinite(inside)).any(axis=0)
    error = np.abs(np.where(compared, view.depth, 0.0) - np.where(compared, nearest, 0.0))
    known = compared & np.isfinite(view.depth)
    report.depth.update_max(float(error[known & ~border].max(initial=0.0)), view.where)
    report.border.add_pixels(known & border & (error > DEPTH_TOLERANCE), compared, view.where)
    report.unknown.add_pixels(compared & ~known, compared, view.where)
    for index, mask in enumerate(view.masks):
        report.mask.add_pixels(mask ^ np.isfinite(inside[index]), mask, view.where)
    for index, visible in enumerate(view.visible):
        report.visible.add_pixels(visible ^ expected[index], visible, view.where)


def check_info(view: CheckedView, report: Report) -> None:
    """Check scene_gt_info against models."""
    for index, (info, silhouette) in enumerate(zip(view.infos, view.silhouettes, strict=True)):
        where = f"{view.where} instance {index}"
        amodal = int(np.isfinite(silhouette.depth).sum())
        report.count_all.update_max(max(0.0, abs(info["px_count_all"] - amodal) - max(2.0, 1e-3 * amodal)), where)
        box = silhouette.box() if info["px_count_visib"] else [-1, -1, -1, -1]
        report.box_amodal.update_max(box_error(info["bbox_obj"], box), where)


def box_error(one: list[int], other: list[int]) -> float:
    """Largest distance between the sides of two boxes [px]."""
    sides = [(x, y, x + width, y + height) for x, y, width, height in (one, other)]
    return float(max(abs(a - b) for a, b in zip(*sides, strict=True)))


def count_cameras(dataset: Path, scenes: list[Path]) -> int:
    """Number of cameras: that of the settings; without these the number of poses that cameras have in the scenes' first images."""
    if (dataset / "config.toml").exists():
        return len(load_config(str(dataset / "config.toml")).rig)
    firsts = [next(iter(read_json(scene / "scene_camera.json").values()), {}) for scene in scenes]
    return len({(*first.get("cam_R_w2c", ()), *first.get("cam_t_w2c", ())) for first in firsts})


def check(dataset: Path, views: int) -> Report:
    """Check `views` views spread evenly over a data set."""
    scenes = sorted(path.parent for path in dataset.glob("[!.]*/*/scene_camera.json"))
    if not scenes:
        raise DatasetError(f"{dataset} has no scene")
    report = Report()
    cameras = count_cameras(dataset, scenes)
    order = [(scene, frame) for scene in scenes for frame in sorted(read_json(scene / "scene_gt.json"), key=int)]
    for index in np.unique(np.linspace(0, len(order) - 1, views).round().astype(int)):
        scene, frame = order[index]
        episode = int(scene.name) // cameras
        check_world([other for other in scenes if other.parent == scene.parent and int(other.name) // cameras == episode], frame, report)
        view = read_view(scene, frame)
        check_images(view, report)
        check_info(view, report)
    return report


def main() -> int:
    """Run the command line; returns the exit code."""
    return run_check(__doc__, "views", 24, lambda folder, count: vars(check(folder, count)), ("depth", "world"))


if __name__ == "__main__":
    sys.exit(main())
