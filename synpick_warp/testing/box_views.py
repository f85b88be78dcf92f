"""View and tick batches of scenes made of boxes, rendered by analytic ray-box intersection (slab test) in float64; and tables of simulated
picks on them: points, normals and pixels are exact, outcomes are drawn."""

import functools
import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from synpick_warp.codes import MASK_ROWS, Effect, Ending, Outcome, Segment, Share
from synpick_warp.configs.schema import Bop, Cameras, Config, Render
from synpick_warp.scenes.types import Camera, Catalog, CatalogEntry, Material, TriangleMesh
from synpick_warp.views.frames import EpisodeEnd, FrameBatch, TickBatch
from synpick_warp.views.picks import COLUMNS, PickBatch

ROOM = 5
"""Instance capacity of a world; instances 1 and 4 do not exist."""
OBJECT_IDS = np.array([3, -1, 7, 3, -1], np.int32)
SIZES = {3: (0.16, 0.10, 0.06), 7: (0.05, 0.05, 0.20)}
FINGER_SIZE = (0.05, 0.05, 0.10)
FOCAL = 3.0
"""Focal length in image widths."""


def config(layers: tuple[str, ...] = (), **bop: Any) -> Config:
    """Settings of the BOP writers. `layers` may name those that `_layers` makes."""
    lens = cameras()[0]
    return Config(bop=Bop(**bop), cameras=Cameras(resolution=(lens.width, lens.height)), render=Render(layers=layers))


def catalog() -> Catalog:
    texture = np.random.default_rng(0).integers(0, 256, (16, 24, 3), dtype=np.uint8)
    return Catalog(tuple(_entry(obj_id, texture if obj_id == 3 else None) for obj_id in SIZES))


def _entry(obj_id: int, texture: np.ndarray | None) -> CatalogEntry:
    box = trimesh.creation.box(extents=SIZES[obj_id])
    vertices = np.asarray(box.vertices, np.float32)
    mesh = TriangleMesh(vertices, np.asarray(box.faces, np.int32), np.asarray(box.vertex_normals, np.float32), np.zeros((8, 2), np.float32))
    half_turn = (-1.0, 0, 0, 0, 0, -1.0, 0, 0, 0, 0, 1.0, 0.002, 0, 0, 0, 1.0)
    return CatalogEntry(
        obj_id=obj_id,
        name=f"box {obj_id}",
        mesh=mesh,
        material=Material(color=(1.0, 1.0, 1.0) if texture is not None else (0.5, 0.25, 0.0), texture=texture, metallic=0.0, roughness=0.5),
        pieces=(),
        volume=float(np.prod(SIZES[obj_id])),
        radius=float(np.linalg.norm(SIZES[obj_id]) / 2),
        mass=0.3,
        center_of_mass=np.zeros(3),
        inertia=np.eye(3),
        diameter=float(np.linalg.norm(SIZES[obj_id])),
        symmetries_discrete=(half_turn,) if obj_id == 7 else (),
        symmetries_continuous=(((0.0, 0.0, 1.0), (0.001, 0.0, 0.0)),) if obj_id == 7 else (),
        source=None,
    )


def cameras(width: int = 96, height: int = 72, count: int = 3) -> tuple[Camera, ...]:
    """Cameras above the origin that look at it."""
    return tuple(_camera(np.array([0.0, y, 1.5]), width, height) for y in (0.0, 0.4, -0.4)[:count])


def _camera(place: np.ndarray, width: int, height: int) -> Camera:
    forward = -place / np.linalg.norm(place)
    right = np.array([1.0, 0.0, 0.0])
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.array([[FOCAL * width, 0, width / 2], [0, FOCAL * width, height / 2], [0, 0, 1.0]])
    return Camera(width, height, matrix, rotation, -rotation @ place)


def poses(episode: int, frame: int) -> np.ndarray:
    """Poses (ROOM, 7) float32: instance 0 leaves the image, instance 2 rests, instance 3 drifts under the gripper shaft."""
    result = np.zeros((ROOM, 7), np.float32)
    result[:, 6] = 1.0
    rotation = np.array([0.3 + 0.1 * frame, 0.2, 0.1 * episode, 1.7])  # Not of unit length: users normalise quaternions.
    result[0] = [-0.10 - 0.04 * frame, 0.07, 0.03, *rotation]
    result[2] = [0.02, -0.02, 0.05, 0.2, -0.3 - 0.1 * episode, 0.1, 1.0]
    result[3] = [0.10 - 0.03 * frame, 0.01, 0.0, 0.0, 0.0, 0.4, 0.9]
    return result


def batches(
    views: int, episodes: tuple[int, ...], frames: int, lenses: tuple[Camera, ...], depth_scale: float = 0.1
) -> Iterator[FrameBatch]:
    """All views of the episodes, interleaved as from worlds that run in parallel, in batches of at most `views`."""
    order = [(episode, frame, camera) for frame in range(frames) for episode in episodes for camera in range(len(lenses))]
    for start in range(0, len(order), views):
        chosen = order[start : start + views]
        rows = [_known_view(pickle.dumps((episode, frame, camera, lenses[camera], depth_scale))) for episode, frame, camera in chosen]
        layers = [_layers(row) for row in rows]
        yield FrameBatch(
            **{name: np.stack([row[name] for row in rows]) for name in rows[0]},
            layers={name: np.stack([layer[name] for layer in layers]) for name in layers[0]},
        )


def _layers(view: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Layers with made-up values that differ between views."""
    index = int(100 * view["episode"] + 10 * view["camera"] + view["frame"])
    flow = np.stack([view["instance"] - np.float32(index), np.where(view["instance"] == Segment.TABLE, np.nan, 0.25)], axis=-1)
    return {"classes": (view["instance"] + np.uint16(index)).astype(np.uint16), "flow": flow.astype(np.float32)}


def ticks(worlds: int, episodes: tuple[int, ...], frames: int) -> Iterator[TickBatch]:
    """Every frame of the episodes, in batches of at most `worlds`."""
    order = [(episode, frame) for frame in range(frames) for episode in episodes]
    for start in range(0, len(order), worlds):
        rows = [_tick(episode, frame) for episode, frame in order[start : start + worlds]]
        batch: dict[str, Any] = {name: np.stack([row[name] for row in rows]) for name in rows[0]}
        yield TickBatch(**batch)


def _tick(episode: int, frame: int) -> dict[str, Any]:
    fixtures = np.zeros((3, 7), np.float32)
    fixtures[:, 6] = 1.0
    fixtures[1:, :3] = [[0.1 - 0.02 * frame, 0.05, 0.2], [0.1 - 0.02 * frame, 0.05, 0.05]]
    return {
        "episode": np.int32(episode),
        "frame": np.int32(frame),
        "time": np.float64(frame / 15),
        "object_id": OBJECT_IDS if frame < 2 else np.where(np.arange(ROOM) == 3, -1, OBJECT_IDS).astype(np.int32),
        "pose": poses(episode, frame),
        "bin": np.int32(0),
        "fixture_pose": fixtures,
        "fixture_visible": np.array([1, frame > 0, frame > 0], np.int32),
        "light": np.int32(0),
        "light_yaw": np.float32(0.5 * episode),
        "light_exposure": np.float32(0.25),
    }


def ends(episodes: tuple[int, ...], frames: int, ending: Ending = Ending.FINISHED, arrangement: int = 0) -> list[EpisodeEnd]:
    return [EpisodeEnd(episode, arrangement, frames, int(ending)) for episode in episodes]


@functools.lru_cache(maxsize=300)
def _known_view(arguments: bytes) -> dict[str, Any]:
    """A view by its pickled arguments: many tests export the same ones. Not to be changed."""
    return _view(*pickle.loads(arguments))


def _view(episode: int, frame: int, index: int, camera: Camera, depth_scale: float) -> dict[str, Any]:
    pose = poses(episode, frame)
    depths = np.full((ROOM, 3 * camera.height, 3 * camera.width), np.inf)
    for i in np.flatnonzero(OBJECT_IDS >= 0):
        depths[i] = _depth(SIZES[OBJECT_IDS[i]], pose[i], camera)
    inner = depths[:, camera.height : 2 * camera.height, camera.width : 2 * camera.width]
    finger_pose = np.array([0.1 - 0.02 * frame, 0.05, 0.2, 0.0, 0.0, 0.0, 1.0])
    finger = _depth(FINGER_SIZE, finger_pose, camera)[camera.height : 2 * camera.height, camera.width : 2 * camera.width]
    table = _table(camera)
    nearest = np.argmin(np.concatenate((inner, finger[None], table[None])), axis=0)
    depth = np.min(np.concatenate((inner, finger[None], table[None])), axis=0)
    codes = np.array([*range(1, ROOM + 1), Segment.FINGER, Segment.TABLE], np.uint8)
    instance = codes[nearest]
    pixels, boxes = np.zeros((ROOM, 3), np.int32), np.tile(np.array([0, 0, -1, -1], np.int32), (ROOM, 2, 1))
    for i in range(ROOM):
        visible = instance == 1 + i
        pixels[i] = np.isfinite(depths[i]).sum(), np.isfinite(inner[i]).sum(), visible.sum()
        boxes[i, 0] = _box(np.isfinite(depths[i]), camera.width, camera.height)
        boxes[i, 1] = _box(visible, 0, 0)
    shade = (40 * (nearest + 1) % 256).astype(np.uint8)
    return {
        "episode": np.int32(episode),
        "camera": np.int32(index),
        "frame": np.int32(frame),
        "time": np.float64(frame / 15),
        "color": np.stack([shade, shade[::-1], np.full_like(shade, 90)], axis=-1),
        "depth": np.rint(depth * 1000 / depth_scale).astype(np.uint16),
        "instance": instance,
        **pack_masks(np.isfinite(inner)),
        "object_id": OBJECT_IDS,
        "pose": pose,
        "pixels": pixels,
        "boxes": boxes,
        "effects": np.arange(len(Effect), dtype=np.float32) + np.float32(10 * index + frame),
        "light_name": np.str_(f"map {episode}"),
        "light_yaw": np.float32(0.5 * episode),
        "light_exposure": np.float32(-0.25),
        "light_direction": np.array([0.0, 0.6, 0.8] if episode else [0.0, 0.0, 0.0], np.float32),
    }


def _rays(camera: Camera) -> np.ndarray:
    """Ray directions with z = 1 in the camera's frame, over a canvas of 3 x 3 image sizes with the image in the middle."""
    x = np.arange(-camera.width, 2 * camera.width) + 0.5
    y = np.arange(-camera.height, 2 * camera.height) + 0.5
    columns, rows = np.meshgrid((x - camera.matrix[0, 2]) / camera.matrix[0, 0], (y - camera.matrix[1, 2]) / camera.matrix[1, 1])
    return np.stack([columns, rows, np.ones_like(rows)], axis=-1)


def _depth(size: tuple[float, ...], pose: np.ndarray, camera: Camera) -> np.ndarray:
    """Planar depth of a box [m] by the slab test; infinite where rays miss."""
    x, y, z, w = pose[3:].astype(np.float64) / np.linalg.norm(pose[3:].astype(np.float64))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + 2 * w * cross + 2 * cross @ cross
    origin = rotation.T @ (-camera.rotation.T @ camera.translation - pose[:3].astype(np.float64))
    direction = _rays(camera) @ camera.rotation @ rotation
    half = np.asarray(size, np.float32).astype(np.float64) / 2
    with np.errstate(divide="ignore", invalid="ignore"):
        first, second = (-half - origin) / direction, (half - origin) / direction
    near, far = np.minimum(first, second).max(axis=-1), np.maximum(first, second).min(axis=-1)
    return np.where((near <= far) & (near > 0), near, np.inf)


def _table(camera: Camera) -> np.ndarray:
    rays = _rays(camera)[camera.height : 2 * camera.height, camera.width : 2 * camera.width] @ camera.rotation
    height = (-camera.rotation.T @ camera.translation)[2]
    return (-0.1 - height) / rays[..., 2]


def _box(mask: np.ndarray, left: int, top: int) -> list[int]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not rows.size:
        return [0, 0, -1, -1]
    return [int(columns[0]) - left, int(rows[0]) - top, int(columns[-1]) - left, int(rows[-1]) - top]


def pack_masks(masks: np.ndarray, margin: int = 1) -> dict[str, np.ndarray]:
    """Pack masks (I, H, W) bool of one view into the mask fields of `FrameBatch`; boxes are bounding boxes enlarged by `margin` [px]."""
    count, height, width = masks.shape
    words = np.zeros(count * width * -(-height // MASK_ROWS), np.uint32)
    first, box = np.zeros(count, np.int32), np.tile(np.array([0, 0, -1, -1], np.int32), (count, 1))
    used = 0
    for index, mask in enumerate(masks):
        first[index] = used
        rows, columns = np.nonzero(mask)
        if not rows.size:
            continue
        left, top = max(0, columns.min() - margin), max(0, rows.min() - margin)
        right, bottom = min(width - 1, columns.max() + margin), min(height - 1, rows.max() + margin)
        box[index] = left, top, right, bottom
        down, right_by = rows - top, columns - left
        np.bitwise_or.at(
            words, used + down // MASK_ROWS * (right - left + 1) + right_by, np.uint32(1) << (down % MASK_ROWS).astype(np.uint32)
        )
        used += (right - left + 1) * -(-(bottom - top + 1) // MASK_ROWS)
    return {"mask_words": words, "mask_first": first, "mask_box": box, "mask_length": np.array(used, np.int32)}


REPEATS = 2
EACH = 4
"""Candidates of a visible instance."""


def pick_batch(episode: int, frames: tuple[int, ...] = (0, 2), own: bool = True) -> PickBatch:
    """Trials from states at these frames, in descending order of the states: EACH candidates of each visible box, REPEATS times each.

    The first one is the episode's own, if `own` says so; the others are uniform over visible pixels. A pick succeeds by chance, with a
    probability of seal times wrench.
    """
    generator = np.random.default_rng((episode, 0))
    views = {int(batch.frame[0]): batch for batch in batches(1, (episode,), max(frames) + 1, cameras()[:1])}
    tables = [_trials(views[frame], state, generator, own) for state, frame in reversed(list(enumerate(frames)))]
    trials = {name: np.concatenate([table[name] for table in tables]) for name in tables[0]}
    size = views[frames[0]].instance[0].shape
    states = {
        "state": np.arange(len(frames)),
        "frame": np.array(frames),
        "camera": np.zeros(len(frames)),
        "width": np.full(len(frames), size[1]),
        "height": np.full(len(frames), size[0]),
        "candidates": np.array([len(np.unique(trials["candidate"][trials["state"] == state])) for state in range(len(frames))]),
        "visible": np.array([[(views[frame].instance[0] == 1 + index).any() for index in range(len(OBJECT_IDS))] for frame in frames]),
    }
    return PickBatch(episode, trials, states)


def _trials(view: FrameBatch, state: int, generator: np.random.Generator, has_own: bool) -> dict[str, np.ndarray]:
    """Columns of the trials of a state."""
    seen = [index for index in range(len(OBJECT_IDS)) if (view.instance[0] == 1 + index).any()]
    pixels = {index: np.argwhere(view.instance[0] == 1 + index) for index in seen}
    chosen = np.concatenate([generator.choice(pixels[index], EACH, replace=False) for index in seen])
    instance = np.repeat(seen, EACH)
    point, normal = _surface(view, chosen, instance)
    count, trials = len(chosen), len(chosen) * REPEATS
    seal, wrench = generator.random((2, count)).astype(np.float32)
    own = has_own & (np.arange(count) == 0)
    each = {
        "candidate": np.arange(count),
        "share": np.where(own, Share.OWN, Share.UNIFORM),
        "weight": np.where(own, 0.0, np.repeat([len(pixels[index]) / EACH for index in seen], EACH)),
        "row": chosen[:, 0],
        "column": chosen[:, 1],
        "instance": instance,
        "obj_id": OBJECT_IDS[instance],
        "point": point,
        "normal": normal,
        "approach": -normal,
        "yaw": np.zeros(count),
        "tilt": np.zeros(count),
        "seal": seal,
        "wrench": wrench,
    }
    trial = {name: np.repeat(values, REPEATS, axis=0) for name, values in each.items()}
    success = generator.random(trials) < trial["seal"] * trial["wrench"]
    hits = generator.integers(1, 30, trials)
    perturbed = np.arange(trials) % REPEATS
    peak = np.where(success, 2.0, 6.0)
    trial |= {
        "state": np.full(trials, state),
        "frame": np.full(trials, int(view.frame[0])),
        "repeat": perturbed,
        "offset": 1e-3 * generator.uniform(-1, 1, (trials, 3)) * perturbed[:, None],
        "rotation": np.zeros((trials, 3)),
        "friction": np.where(perturbed, 0.9, 1.0),
        "outcome": np.where(success, Outcome.TARGET_PICKED, Outcome.DROPPED),
        "ending": np.full(trials, Ending.RUNNING),
        "success": success,
        "intended": success,
        "hits": hits,
        "sealed": np.ones(trials),
        "picked": np.where(success, trial["instance"], -1),
        "peak_force": peak,
        "margin": 1.0 - peak / 5.0,
        "time_to_break": np.where(success, np.nan, 0.2),
        "held": np.where(success, 0.6, 0.2),
        "moved": np.zeros(trials),
        "farthest": np.zeros(trials),
        "lost": np.zeros(trials),
        "duration": np.full(trials, 1.0),
    }
    return {column.name: trial[column.name] for column in COLUMNS}


def _surface(view: FrameBatch, pixels: np.ndarray, instance: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points on the boxes at the centres of pixels, by their depth, and the normals of the nearest faces."""
    camera = cameras()[0]
    depth = view.depth[0][pixels[:, 0], pixels[:, 1]] * 1e-4
    rays = np.column_stack((pixels[:, ::-1] + 0.5, np.ones(len(pixels)))) @ np.linalg.inv(camera.matrix).T
    point = (depth[:, None] * rays - camera.translation) @ camera.rotation
    rotation = Rotation.from_quat(view.pose[0][instance, 3:])
    inside = rotation.inv().apply(point - view.pose[0][instance, :3])
    half = np.array([SIZES[int(OBJECT_IDS[index])] for index in instance]) / 2
    axis = np.argmax(np.abs(inside) - half, axis=1)
    normal = np.zeros_like(inside)
    normal[np.arange(len(axis)), axis] = np.sign(inside[np.arange(len(axis)), axis])
    return point, rotation.apply(normal)
