"""Pictures of failures: the worst estimate of each object as observed, rendered and residual, side by side."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import warp as wp
from PIL import Image as PillowImage
from PIL import ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from synpick_warp.apps.estimation.run import ObjectModel
from synpick_warp.apps.evaluation.errors import LIMIT, Scores
from synpick_warp.apps.evaluation.truth import PoseTable, Truth
from synpick_warp.dataset.reading import DataSet
from synpick_warp.dataset.view import View
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.render.raster import object_scene, render_object
from synpick_warp.stages.render.scene import build_meshes
from synpick_warp.system.codecs.charts import INK, SOFT, printable

Color = tuple[int, int, int]
"""Red, green, blue."""
Image = np.ndarray
"""(H, W, 3) uint8, red first."""
METRIC = "ADD-S"
"""Metric by which estimates are the worst: it forgives turns that the shape does not show."""
PANEL = 260
"""Width and height of a panel [px]."""
_CAPTION, _GAP, _HEADING = 56, 8, 34
"""Height of a row's caption, gap between panels, and height of the headings [px]."""
_FONT = 17
_MARGIN = 0.25
"""Margin around mask and object in a panel, relative to their size."""
_RANGE = 0.02
"""Depth difference of the fullest colour [m]."""
_DIM = 0.45
"""Brightness of the photograph around a rendered object."""
_TRUTH: Color = (60, 200, 60)
_ESTIMATE: Color = (230, 60, 40)
_HEADINGS = ("observed, with its mask", "estimate (red), truth (green)", "estimate rendered", "depth: observed - rendered")


@dataclass(frozen=True, eq=False)
class PoseFailure:
    """An instance that a method has missed or estimated badly."""

    truth: int
    """Row of the ground truth."""
    estimate: int
    """Row of the estimates of its object in its image that is nearest; -1: there is none."""
    error: float
    """[m]; infinity: missed."""
    distance: float = np.inf
    """Of the estimate's position from the true one [m]. BOP's matching takes as many estimates as there are targets, the best scored, so
    that an instance may be missed though an estimate is near."""


@dataclass(frozen=True, eq=False)
class _Window:
    """Square part of an image (left, top, size [px]), which is resampled to a panel."""

    left: float
    top: float
    size: float

    def camera(self, intrinsics: np.ndarray) -> Camera:
        """Camera at the origin that sees the window with the resolution of a panel."""
        scale = PANEL / self.size
        matrix = np.diag([scale, scale, 1.0]) @ (intrinsics - np.array([[0, 0, self.left], [0, 0, self.top], [0, 0, 0]]))
        return Camera(PANEL, PANEL, matrix, np.eye(3), np.zeros(3))

    def sample(self, image: np.ndarray) -> np.ndarray:
        """The image's values at the panel's pixel centres (nearest pixel); 0 outside the image."""
        steps = (np.arange(PANEL) + 0.5) * self.size / PANEL
        rows, columns = np.floor(self.top + steps).astype(int), np.floor(self.left + steps).astype(int)
        inside = ((rows >= 0) & (rows < image.shape[0]))[:, None] & ((columns >= 0) & (columns < image.shape[1]))[None]
        result = image[np.clip(rows, 0, image.shape[0] - 1)][:, np.clip(columns, 0, image.shape[1] - 1)].copy()
        result[~inside] = 0
        return result


def find_failures(truth: Truth, scores: Scores, estimates: PoseTable, count: int) -> list[PoseFailure]:
    """The worst instance of at most `count` objects by ADD-S, worst first; an object's misses with an estimate before those without."""
    result, errors = list[PoseFailure](), scores.errors[METRIC]
    objects = truth.poses.object_id[scores.target]
    for object_id in np.unique(objects):
        rows = np.flatnonzero(objects == object_id)
        nearest = {row: nearest_estimate(truth.poses, int(scores.target[row]), estimates) for row in rows if not np.isfinite(errors[row])}
        if nearest:
            row = next((row for row, estimate in nearest.items() if estimate >= 0), next(iter(nearest)))
        else:
            row = rows[np.argmax(errors[rows])]
        target = int(scores.target[row])
        estimate = nearest[row] if row in nearest else nearest_estimate(truth.poses, target, estimates)
        offset = np.inf if estimate < 0 else np.linalg.norm(estimates.translation[estimate] - truth.poses.translation[target])
        result.append(PoseFailure(target, estimate, float(errors[row]), float(offset)))
    return sorted(result, key=lambda failure: -failure.error)[:count]


def nearest_estimate(truth: PoseTable, row: int, estimates: PoseTable) -> int:
    """Row of the estimate of an instance's object in its image whose position is nearest; -1: there is none."""
    first, last = np.searchsorted(estimates.scene, [truth.scene[row], truth.scene[row] + 1])
    block = slice(first, last)
    rows = first + np.flatnonzero((estimates.image[block] == truth.image[row]) & (estimates.object_id[block] == truth.object_id[row]))
    if not len(rows):
        return -1
    return int(rows[np.argmin(np.linalg.norm(estimates.translation[rows] - truth.translation[row], axis=1))])


def draw_failures(
    data_set: DataSet,
    truth: Truth,
    estimates: PoseTable,
    failures: Sequence[PoseFailure],
    models: Sequence[ObjectModel],
    names: Mapping[int, str],
    device: wp.Device,
) -> Image:
    """Draw a sheet with a row for each failure, at least one, with estimates rendered; `models`: of their objects, `names`: by obj_id."""
    meshes, keep = build_meshes([model.mesh for model in models], len(models), device)
    index = {model.object_id: row for row, model in enumerate(models)}
    width = len(_HEADINGS) * PANEL + (len(_HEADINGS) + 1) * _GAP
    canvas = np.full((_HEADING + len(failures) * (PANEL + _CAPTION), width, 3), 255, np.uint8)
    captions = []
    for number, failure in enumerate(failures):
        episode = data_set[int(truth.episode[failure.truth])]
        view = episode.view(episode.image_ids.index(int(truth.poses.image[failure.truth])), int(truth.camera[failure.truth]))
        slot = int(np.flatnonzero(view.instance_ids == truth.poses.instance[failure.truth])[0])
        model = index[int(truth.poses.object_id[failure.truth])]
        renderer = _PoseRenderer(meshes, keep, models[model], model, device)
        panels = _draw_panels(view, slot, _pose_of(truth.poses, failure.truth), _pose_of(estimates, failure.estimate), renderer)
        top = _HEADING + number * (PANEL + _CAPTION)
        for column, panel in enumerate(panels):
            left = _GAP + column * (PANEL + _GAP)
            canvas[top : top + PANEL, left : left + PANEL] = panel
        captions.append((top + PANEL + 4, describe_failure(truth, failure, view, names)))
    return _write_texts(canvas, captions)


def describe_failure(truth: Truth, failure: PoseFailure, view: View, names: Mapping[int, str]) -> tuple[str, str]:
    """Caption of two lines: object and error; location in the data set, visibility and speed."""
    object_id = int(truth.poses.object_id[failure.truth])
    name = printable(names.get(object_id, f"object {object_id}"))
    place = f"{truth.mode[failure.truth]}, episode {view.episode}, camera {view.camera}, frame {view.frame}"
    if np.isfinite(failure.error):
        error = f"{METRIC} {1e3 * failure.error:.1f} mm"
    elif failure.estimate < 0:
        error = "no estimate"
    elif failure.distance < LIMIT:
        error = "missed: other estimates of the object have higher scores (shown: the nearest)"
    else:
        error = f"missed (above {1e3 * LIMIT:.0f} mm)"
    speed = truth.speed[failure.truth]
    moving = f", {speed:.2f} m/s" if np.isfinite(speed) else ""
    visibility = truth.visibility[failure.truth]
    seen = f"; {100 * visibility:.0f} % visible" if np.isfinite(visibility) else ""
    return f"{name}: {error}", f"{place}{seen}{moving}"


def _pose_of(poses: PoseTable, row: int) -> np.ndarray | None:
    """Pose as x, y, z [m] and quaternion x, y, z, w; None: there is none."""
    if row < 0:
        return None
    return np.concatenate([poses.translation[row], Rotation.from_matrix(poses.rotation[row]).as_quat()])


class _PoseRenderer:
    """Renders one object in a window."""

    def __init__(self, meshes: object, keep: tuple[wp.Mesh, ...], model: ObjectModel, row: int, device: wp.Device) -> None:
        self.meshes, self.keep, self.model, self.row, self.device = meshes, keep, model, row, device

    def render(self, camera: Camera, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Depth (H, W) float32 [m], 0: none, and colour (H, W, 3) uint8 of textures under a light at the camera."""
        gbuffer = render_object(object_scene(self.meshes, self.keep, [camera], self.device), self.row, pose)
        hit = gbuffer.segment.numpy()[0] > 0
        depth = np.where(hit, gbuffer.depth.numpy()[0], 0.0).astype(np.float32)
        mesh = self.model.mesh
        faces = mesh.faces[gbuffer.triangle.numpy()[0][hit]]
        weights = gbuffer.barycentric.numpy()[0][hit].astype(np.float64)
        weights = np.concatenate([weights, 1.0 - weights.sum(axis=1, keepdims=True)], axis=1)
        normals = Rotation.from_quat(pose[3:]).apply(np.einsum("nk,nkc->nc", weights, mesh.normals[faces]))
        facing = np.clip(-normals[:, 2] / np.maximum(np.linalg.norm(normals, axis=1), 1e-9), 0.0, 1.0)
        base = self._base_color(np.einsum("nk,nkc->nc", weights, mesh.uv[faces]))
        color = np.zeros((*hit.shape, 3), np.uint8)
        color[hit] = np.rint(base * (0.35 + 0.65 * facing[:, None])).astype(np.uint8)
        return depth, color

    def _base_color(self, uv: np.ndarray) -> np.ndarray:
        """sRGB 0 to 255 (N, 3) of the base colour at texture coordinates, nearest texel."""
        material = self.model.material
        factor = np.array(material.color)
        if material.texture is None:
            return np.broadcast_to(255.0 * factor, (len(uv), 3))
        height, width = material.texture.shape[:2]
        row = np.floor((1.0 - np.mod(uv[:, 1], 1.0)) * height).astype(int).clip(0, height - 1)
        column = np.floor(np.mod(uv[:, 0], 1.0) * width).astype(int).clip(0, width - 1)
        return material.texture[row, column] * factor


def _draw_panels(view: View, slot: int, truth: np.ndarray | None, estimate: np.ndarray | None, renderer: _PoseRenderer) -> list[Image]:
    """Panels of one failure, in the order of the headings."""
    assert truth is not None
    mask = view.masks[slot]
    window = _choose_window(view, mask, [pose for pose in (truth, estimate) if pose is not None], renderer.model)
    camera = window.camera(view.intrinsics)
    photograph, shown = _resample(view.rgb, window), window.sample(mask)
    observed = photograph.copy()
    _outline(observed, shown, (255, 255, 255))
    depth = renderer.render(camera, truth)[0]
    both = photograph.copy()
    _outline(both, depth > 0.0, _TRUTH)
    rendered, residual = (_DIM * photograph).astype(np.uint8), np.full_like(photograph, 255)
    if estimate is not None:
        depth, color = renderer.render(camera, estimate)
        _outline(both, depth > 0.0, _ESTIMATE)
        rendered = np.where((depth > 0.0)[..., None], color, rendered)
        residual = _color_residual(window.sample(view.depth), depth, shown)
    return [observed, both, rendered, residual]


def _choose_window(view: View, mask: np.ndarray, poses: Sequence[np.ndarray], model: ObjectModel) -> _Window:
    """Square around the mask and the projections of an object."""
    rows, columns = np.nonzero(mask)
    points = [np.stack([columns, rows], axis=1)] if len(rows) else []
    for pose in poses:
        vertices = Rotation.from_quat(pose[3:]).apply(model.mesh.vertices.astype(np.float64)) + pose[:3]
        front = vertices[vertices[:, 2] > 1e-3]
        if len(front):
            points.append(view.project(front))
    corners = np.concatenate(points)
    height, width = mask.shape
    low = np.clip(corners.min(axis=0), (-width, -height), (2 * width, 2 * height))
    high = np.clip(corners.max(axis=0), (-width, -height), (2 * width, 2 * height))
    size = max(float((high - low).max()), 8.0) * (1.0 + 2.0 * _MARGIN)
    left, top = (low + high - size) / 2.0
    return _Window(float(left), float(top), size)


def _resample(image: Image, window: _Window) -> Image:
    """Photograph in a window: area-filtered if it shrinks, smooth if it grows; black outside the image."""
    scale = PANEL / window.size
    matrix = np.array([[scale, 0.0, -scale * window.left + 0.5 * (scale - 1.0)], [0.0, scale, -scale * window.top + 0.5 * (scale - 1.0)]])
    if scale < 1.0:
        image = cv2.blur(image, (max(1, round(1.0 / scale)),) * 2)
    return cv2.warpAffine(image, matrix, (PANEL, PANEL), flags=cv2.INTER_LINEAR)


def _outline(image: Image, mask: np.ndarray, color: Color) -> None:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(image, contours, -1, color, 2, cv2.LINE_AA)


def _color_residual(observed: np.ndarray, rendered: np.ndarray, mask: np.ndarray) -> Image:
    """Depth difference in colour: white 0, red the scene lies behind the estimate, blue before it; grey: only one of mask and estimate.

    Pixels outside both, or without observed depth, are pale.
    """
    both = mask.astype(bool) & (rendered > 0.0) & (observed > 0.0)
    difference = np.clip((observed - rendered) / _RANGE, -1.0, 1.0)
    strength = (255.0 * (1.0 - np.abs(difference))).astype(np.uint8)
    full = np.full_like(strength, 255)
    colors = np.where((difference > 0.0)[..., None], np.stack([full, strength, strength], -1), np.stack([strength, strength, full], -1))
    picture = np.full((*mask.shape, 3), 238, np.uint8)
    picture[mask.astype(bool) ^ (rendered > 0.0)] = 170
    picture[both] = colors[both]
    return picture


def _write_texts(canvas: Image, captions: Sequence[tuple[int, tuple[str, str]]]) -> Image:
    picture = PillowImage.fromarray(canvas)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(_FONT)
    for column, text in enumerate(_HEADINGS):
        draw.text((_GAP + column * (PANEL + _GAP), 8), text, fill=INK, font=font)
    for top, (first, second) in captions:
        draw.text((_GAP, top), first, fill=INK, font=font)
        draw.text((_GAP, top + _FONT + 4), second, fill=SOFT, font=font)
    return np.asarray(picture)
