"""Annotations of toy scenes: rendered layers, and NumPy twins of projection, rigid motion, pixel counts and bounding boxes; semi-global
matching of a rectified pair, written from its formulas."""

from dataclasses import dataclass, field, replace

import numpy as np
import warp as wp

from synpick_warp.configs.schema import LAYERS
from synpick_warp.factory.assembly import make_renderer
from synpick_warp.scenes.types import Camera
from synpick_warp.stages.arrays import allocate
from synpick_warp.stages.buffers import LayerBuffers, ViewBuffers, view_buffer_sizes
from tests.twins.raycast import rotation_of
from tests.worlds.toy_scene import RenderedViews, ToyScene, build_scene, render, snapshot, views_of


@dataclass
class PreviousFrame:
    """Previous frame of every world: the toy scene's bodies then, and whether there was such a frame."""

    placed: list[list[tuple[int, tuple[float, ...]]]]
    follows: list[int]
    fixture_poses: tuple[tuple[float, ...], ...] | None = None
    """None: the toy scene's own."""
    fixtures_visible: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class RenderedLayers:
    """Layers by name, beside the G-buffer that they are computed from: segmentation ids and planar depth [m]."""

    layers: dict[str, np.ndarray]
    segment: np.ndarray
    depth: np.ndarray
    names: tuple[str, ...] = field(default=LAYERS)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.layers[name]


def render_layers(
    toy: ToyScene, device: wp.Device, previous: PreviousFrame | None = None, names: tuple[str, ...] = LAYERS
) -> RenderedLayers:
    """Render layers of every world by every camera: view = world x cameras + camera."""
    config = replace(toy.settings(), render=replace(toy.settings().render, layers=names))
    scene, views = build_scene(toy, device), views_of(toy, device)
    now = snapshot(toy, device)
    if previous is not None:
        poses, visible = previous.fixture_poses or toy.fixture_poses, previous.fixtures_visible or toy.fixtures_visible
        last = snapshot(replace(toy, placed=previous.placed, fixture_poses=poses, fixtures_visible=visible), device)
        for name in ("catalog_index", "pose", "fixture_pose", "fixture_visible"):
            wp.copy(getattr(now, f"last_{name}"), getattr(last, name))
        now.follows.assign(np.array(previous.follows))
    renderer = make_renderer(config, scene, toy.instances, views.count, colors=False)
    sizes = view_buffer_sizes(views.count, scene.width, scene.height, toy.instances)
    out = allocate(LayerBuffers, sizes, device, names)
    renderer.render(now, views, allocate(ViewBuffers, sizes, device), out)
    layers = {name: getattr(out, name).numpy() for name in names}
    return RenderedLayers(layers, renderer.gbuffer.segment.numpy(), renderer.gbuffer.depth.numpy(), names)


def surface_points(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Back-projection: surface points in the camera's axes (H, W, 3) float64 [m], from planar depth (H, W) [m]."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    matrix = camera.matrix
    rays = np.stack([(columns - matrix[0, 2]) / matrix[0, 0], (rows - matrix[1, 2]) / matrix[1, 1], np.ones_like(rows)], axis=-1)
    return rays * np.asarray(depth, np.float64)[..., None]


def project(point: np.ndarray, camera: Camera) -> np.ndarray:
    """Projection of points in the camera's axes: column, row [px]."""
    image = point @ camera.matrix.T
    return image[..., :2] / image[..., 2:]


def pose_in(camera: Camera, pose: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Rotation and translation from a body to the camera, of its pose in the world rounded to float32."""
    exact = np.asarray(pose, np.float32).astype(np.float64)
    return camera.rotation @ rotation_of(exact[3:]), camera.rotation @ exact[:3] + camera.translation


def previous_points(point: np.ndarray, now: tuple[np.ndarray, np.ndarray], then: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Previous positions of points of a body (..., 3), from their current ones and the body's rotation and translation now and then."""
    own = (point - now[1]) @ now[0]
    return own @ then[0].T + then[1]


def box_of(mask: np.ndarray, origin: tuple[int, int] = (0, 0)) -> tuple[int, int, int, int]:
    """x_min, y_min, x_max, y_max, inclusive, of a mask whose first pixel has column and row `origin`; (0, 0, -1, -1) if empty."""
    rows, columns = np.nonzero(mask)
    if len(rows) == 0:
        return 0, 0, -1, -1
    left, top = origin
    return int(columns.min()) + left, int(rows.min()) + top, int(columns.max()) + left, int(rows.max()) + top


def count_pixels(instance: np.ndarray, depth: np.ndarray, masks: np.ndarray, canvas: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Expected pixel counts and boxes of one view. `instance`: segmentation ids (H, W). `depth`: counts (H, W). `masks`: amodal masks (I,
    H, W) bool. `canvas`: amodal masks (I, 3H, 3W) bool, with the image in the middle. Returns px_count_all, px_count_valid, px_count_visib
    (I, 3); bbox_obj and bbox_visib (I, 2, 4)."""
    height, width = instance.shape
    pixels, boxes = np.zeros((len(masks), 3), int), np.zeros((len(masks), 2, 4), int)
    for i, (full, inside) in enumerate(zip(canvas, masks, strict=True)):
        visible = instance == 1 + i
        pixels[i] = full.sum(), (inside & (depth != 0)).sum(), visible.sum()
        boxes[i] = box_of(full, (-width, -height)), box_of(visible)
    return pixels, boxes


def canvas_of(view: Camera) -> Camera:
    """The same camera with an image three times as wide and high, centred on the original."""
    matrix, size = view.matrix.copy(), (3 * view.width, 3 * view.height)
    matrix[:2, 2] += view.width, view.height
    lens = view.lens.cropped(-view.width, -view.height, size) if view.lens else None
    return replace(view, width=size[0], height=size[1], matrix=matrix, lens=lens)


def annotated(toy: ToyScene, device: wp.Device) -> tuple[RenderedViews, np.ndarray, np.ndarray]:
    """A scene rendered by its camera, and what its pixel counts and boxes must be."""
    picture, canvas = (render(replace(toy, cameras=(view,)), device, colors=False) for view in (toy.cameras[0], canvas_of(toy.cameras[0])))
    return picture, *count_pixels(picture.instance[0], picture.depth[0], picture.masks[0], canvas.masks[0])


RADIUS, BITS, SMALL, LARGE = 3, 24, 8, 32


def census(image: np.ndarray) -> np.ndarray:
    """Centre-symmetric census (H, W, BITS) bool: whether a pixel of the window is brighter than the opposite one."""
    height, width = image.shape
    padded = np.pad(image, RADIUS, mode="edge")
    offsets = [(down, right) for down in range(-RADIUS, 1) for right in range(-RADIUS, RADIUS + 1) if down < 0 or right < 0]

    def moved(down: int, right: int) -> np.ndarray:
        return padded[RADIUS + down : RADIUS + down + height, RADIUS + right : RADIUS + right + width]

    return np.stack([moved(down, right) > moved(-down, -right) for down, right in offsets], axis=-1)


def matching_costs(left: np.ndarray, right: np.ndarray, lowest: int, count: int) -> np.ndarray:
    """Hamming distance of each pixel of the left image to its partner (H, W, disparity); BITS without a partner."""
    ours, theirs = census(left), census(right)
    costs = np.full((*left.shape, count), BITS)
    for index in range(count):
        shift = lowest + index
        if shift < left.shape[1]:
            costs[:, shift:, index] = (ours[:, shift:] != theirs[:, : left.shape[1] - shift]).sum(axis=-1)
    return costs


def path_costs(costs: np.ndarray) -> np.ndarray:
    """Sum over paths to the right, to the left, down and up of L(p, d), as of Hirschmüller (2008)."""
    total = np.zeros_like(costs)
    for axis in (0, 1):
        for backwards in (False, True):
            lines = np.moveaxis(costs, axis, 0)
            lines = lines[::-1] if backwards else lines
            result = np.empty_like(lines)
            last = np.zeros_like(lines[0])
            for step, cost in enumerate(lines):
                least = last.min(axis=-1, keepdims=True)
                beside = np.pad(last, ((0, 0), (1, 1)), constant_values=10**6)
                beside = np.minimum(beside[:, :-2], beside[:, 2:]) + SMALL
                last = cost + np.minimum(np.minimum(last, beside), least + LARGE) - least
                result[step] = last
            total += np.moveaxis(result[::-1] if backwards else result, 0, axis)
    return total
