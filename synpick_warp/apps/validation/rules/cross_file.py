"""Rules that compare files with each other: target lists with scenes, scenes of cameras that recorded together, shards with their keys;
edges and unstacking order of scene_graph.json against each other, and support edges against the models' geometry."""

from collections import Counter
from dataclasses import dataclass
from functools import cache, partial
from itertools import chain
from typing import Any

import numpy as np
from msgspec import UNSET
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.rules.models import ModelsFolder, ModelSubject
from synpick_warp.apps.validation.scene_files import KeyedScene, TruthSchema
from synpick_warp.apps.validation.subjects import SceneSubject, TargetLists, ViewSubject
from synpick_warp.dataset.annotations import GraphEntry
from synpick_warp.dataset.bop.images import KEY, KeyedFolder
from synpick_warp.dataset.bop.layout import KEYED, KEYS

MIN_VISIBILITY = 0.1
"""Visible fraction from which an instance is a target, in the toolkit's enumerate_test_targets.py."""
FRACTION_SLACK = 1e-3
"""Distance from that fraction within which an instance may be a target or not: files are often rounded."""


@rule(TargetLists, "target-schema", "make it again with enumerate_test_targets.py")
def check_schema(lists: TargetLists) -> Findings:
    """A target list is a JSON list of records with scene_id and im_id; those of 2019 also with obj_id and inst_count."""
    for name, found in lists.lists.items():
        if found.fault:
            yield name, found.fault


@rule(TargetLists, "target-scenes", "remove its records, or restore the scene")
def check_scenes(lists: TargetLists) -> Findings:
    """Every scene of a target list exists."""
    for name, found in lists.lists.items():
        known = lists.scene_ids(name)
        for scene in sorted(set(found.scenes) - known):
            yield name, f"there is no scene {scene}"


@rule(SceneSubject, "target-images", "remove the record, or restore the image")
def check_images(scene: SceneSubject) -> Findings:
    """Every image and object of a target list is in the scene's ground truth, and no record occurs twice."""
    for name, by_image in scene.targets.items():
        for image, records in by_image.items():
            place = f"scene {scene.files.ref.scene}, image {image}"
            if image not in scene.record("camera").raw:
                yield name, f"{place}: there is no such image"
                continue
            counts = Counter(None if record.obj_id is UNSET else record.obj_id for record in records)
            for obj_id in (obj_id for obj_id, count in counts.items() if count > 1):
                yield name, f"{place}: {counts[obj_id]} records" + ("" if obj_id is None else f" of obj_id {obj_id}")
            present = {item.obj_id for item in scene.truths.get(image, ())}
            for obj_id in counts if scene.record("gt").present else ():
                if obj_id is not None and obj_id not in present and image in scene.truths:
                    yield name, f"{place}: obj_id {obj_id} is not in the image"


@rule(SceneSubject, "target-counts", "make the list again with enumerate_test_targets.py")
def check_counts(scene: SceneSubject) -> Findings:
    """inst_count is the number of instances of the object whose visib_fract is at least 0.1."""
    for name, by_image in scene.targets.items():
        for image, records in by_image.items():
            truths, infos = scene.truths.get(image), scene.infos.get(image)
            if truths is None or infos is None or len(truths) != len(infos):
                continue
            fractions = [(item.obj_id, info.visib_fract) for item, info in zip(truths, infos, strict=True)]
            for record in records:
                if record.obj_id is UNSET or record.inst_count is UNSET:
                    continue
                own = [fraction for obj_id, fraction in fractions if obj_id == record.obj_id]
                low, high = (sum(value >= MIN_VISIBILITY + slack for value in own) for slack in (FRACTION_SLACK, -FRACTION_SLACK))
                if own and not low <= record.inst_count <= high:
                    place = f"scene {scene.files.ref.scene}, image {image}, obj_id {record.obj_id}"
                    yield name, f"{place}: inst_count is {record.inst_count}, but {high} are visible"


DISTANCE_TOLERANCE, ANGLE_TOLERANCE = 0.1, 1e-3
"""Largest difference of an instance's world poses from two cameras [mm], [rad]; ours differ by 1e-12 mm."""


@dataclass(frozen=True, eq=False)
class RigSubject:
    """Scenes recorded together: of the cameras of one episode, or of the sensors of one scene in the layout `multisensor`."""

    place: str
    """Where violations are reported: the first scene."""
    scenes: tuple[SceneSubject, ...]
    cameras: int
    """Number of cameras that the rig has."""


@rule(RigSubject, "rig-complete", "restore the scene, or bake again: the same command resumes")
def check_complete(rig: RigSubject) -> Findings:
    """Every camera of an episode has its scene."""
    if len(rig.scenes) < rig.cameras:
        yield rig.place, f"{len(rig.scenes)} scenes of {rig.cameras} cameras"


@rule(RigSubject, "world-poses", "check the extrinsics' unit and direction (world to camera) and the pose of the instance")
def check_world_poses(rig: RigSubject) -> Findings:
    """cam_R_w2c and cam_t_w2c map an instance (instance_id) to the same world pose from every camera."""
    known: dict[tuple[int, int], tuple[str, np.ndarray]] = {}
    for scene in rig.scenes:
        record = scene.record("gt")
        for image, entries in scene.truths.items():
            camera = scene.cameras.get(image)
            if camera is None or not (isinstance(camera.cam_R_w2c, list) and isinstance(camera.cam_t_w2c, list)):
                continue
            to_world = _transform(camera.cam_R_w2c, camera.cam_t_w2c)
            to_world[:3, 3] = -to_world[:3, :3].T @ to_world[:3, 3]
            to_world[:3, :3] = to_world[:3, :3].T
            for index, item in enumerate(entries):
                if item.instance_id is UNSET:
                    continue
                pose = to_world @ _transform(item.cam_R_m2c, item.cam_t_m2c)
                first, other = known.setdefault((image, int(item.instance_id)), (record.where(image), pose))
                distance = float(np.linalg.norm(pose[:3, 3] - other[:3, 3]))
                # The Frobenius norm of the difference of two rotations is 2 √2 sin(angle / 2).
                sine = float(np.linalg.norm(pose[:3, :3] - other[:3, :3])) / np.sqrt(8.0)
                angle = 2.0 * float(np.arcsin(min(sine, 1.0)))
                if distance > DISTANCE_TOLERANCE or angle > ANGLE_TOLERANCE:
                    off = f"{distance:.3g} mm and {np.degrees(angle):.2g}° off"
                    yield record.where(image), f"image {image}, instance {index}: its world pose is {off} that in {first}"


def _transform(rotation: Any, translation: Any) -> np.ndarray:
    """Rigid transform (4, 4) from a rotation (9 values, row by row) and a translation."""
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), translation
    return matrix


MAX_VIEWS = 1000
"""Most views of a shard, as in BOP's webdataset layout."""


@rule(KeyedFolder, "shard-index", "list the keys of each shard again, or restore the shard")
def check_index(folder: KeyedFolder) -> Findings:
    """key_to_shard.json maps every key SSSSSS_IIIIII to the index of the shard that contains it, and no others."""
    keys, fault = folder.keys
    if fault:
        yield folder.listing.name(KEYS), fault
    if keys is None:
        return
    places = {key: shard for shard, found in folder.members.items() if isinstance(found, set) for key in found}
    damaged = {shard for shard, found in folder.members.items() if isinstance(found, str)}
    for key, index in keys.items():
        shard = f"shard-{index:06d}.tar"
        if not KEY.fullmatch(key):
            yield folder.listing.name(KEYS), f'key "{key[:40]}" is not SCENE_IMAGE of six digits each'
        elif shard not in folder.members:
            yield folder.listing.name(KEYS), f"key {key}: there is no {shard}"
        elif shard not in damaged and places.get(key) != shard:
            yield folder.listing.name(KEYS), f"key {key} is in {places.get(key, 'no shard')}, not in {shard}"
    for key in sorted(places.keys() - keys.keys()):
        yield folder.listing.name(KEYS), f"key {key} of {places[key]} is missing"


@rule(KeyedFolder, "shard-files", "write the shard again, without links or other files")
def check_shards(folder: KeyedFolder) -> Findings:
    """Shards are tar files of regular members named KEY.CONTENT, with at most 1000 views each."""
    for shard, found in folder.members.items():
        if isinstance(found, str):
            yield folder.listing.name(shard), found
        elif len(found) > MAX_VIEWS:
            yield folder.listing.name(shard), f"{len(found)} views"
    for name in sorted(folder.listing.files) if not folder.shards else ():
        if not KEYED.fullmatch(name) and name != KEYS:
            yield folder.listing.name(name), "a file name that is not KEY.CONTENT"


@rule(ViewSubject, "mask-entries", "write one entry for each ground-truth index")
def check_entries(view: ViewSubject) -> Findings:
    """KEY.mask.json and KEY.mask_visib.json have run lengths of every instance."""
    if isinstance(view.scene.files, KeyedScene):
        for kind, masks in view.masks.items():
            faults = {file for file, _ in view.faults}
            for index, mask in enumerate(masks):
                file = view.scene.files.file(kind, view.image, index)
                if mask is None and file not in faults:
                    yield file, f"missing; there are {len(masks)} instances"


SUPPORT_GAP = 5.0
"""Largest distance between the convex hulls of an object and its supporter [mm]: contacts are between convex pieces, which may overlap by
a millimetre, and poses are rounded."""
STILL = 0.5
"""Largest relative motion of a pair since the image before at which it is checked [mm]: forces are means over that time."""
IMAGES = 20
"""Most images of a scene in which support is checked."""
_Hull = tuple[np.ndarray, np.ndarray]
"""Corners [mm] and unit normals of the facets (n, 3)."""


@rule(SceneSubject, "scene-graph", "make scene_graph.json again by a bake with bop.graph = true")
def check_graph(scene: SceneSubject) -> Findings:
    """scene_graph.json has edges between instances of scene_gt.json, and an order in which each is once and none carries a later one."""
    record = scene.record("graph")
    yield from record.faults
    for image, graph in record.entries.items():
        count = len(scene.truths.get(image, ()))
        ends = [index for one, other, _ in (*_supports(graph), *graph.occlusion) for index in (one, other)]
        order = graph.order or []
        if any(index >= count for index in (*ends, *chain.from_iterable(order))):
            yield record.where(image), f"image {image}: an index above {count - 1}, that of the last instance"
        elif graph.order and sorted(chain.from_iterable(order)) != list(range(count)):
            yield record.where(image), f"image {image}: the order does not have each of {count} instances once"
        elif graph.order:
            rank = {index: place for place, component in enumerate(order) for index in component}
            wrong = next(((one, other) for one, other, _ in _supports(graph) if other >= 0 and rank[one] > rank[other]), None)
            if wrong is not None:
                yield record.where(image), f"image {image}: instance {wrong[1]} comes before {wrong[0]}, which it carries"


@rule(SceneSubject, "support-touches", "check poses and the list's order: the ground-truth index is the position in scene_gt.json")
def check_support(scene: SceneSubject) -> Findings:
    """An object touches what carries it, if both are still: their convex hulls are at most 5 mm apart."""
    record, folders = scene.record("graph"), [ModelsFolder(listing) for listing in scene.layout.models.values()]
    find_hull = cache(partial(_find_hull, folders))
    images = sorted(image for image in record.entries if image in scene.truths and image - 1 in scene.truths)
    for image in images[:: -(-len(images) // IMAGES) or 1]:
        truths, before = scene.truths[image], {truth.instance_id: truth for truth in scene.truths[image - 1]}
        for one, other, _ in _supports(record.entries[image]):
            if not 0 <= other < len(truths) or one >= len(truths):
                continue
            upper, lower = truths[one], truths[other]
            last = before.get(upper.instance_id), before.get(lower.instance_id)
            shapes = find_hull(upper.obj_id), find_hull(lower.obj_id)
            if last[0] is None or last[1] is None or shapes[0] is None or shapes[1] is None:
                continue
            pose = relative_pose(upper, lower)
            still = np.abs(pose - relative_pose(last[0], last[1])).max() <= STILL
            if still and (gap := find_gap(shapes[0], shapes[1], pose)) > SUPPORT_GAP:
                yield record.where(image), f"image {image}: instance {other} carries {one}, but is {gap:.3g} mm from it"


def _supports(graph: GraphEntry) -> list[tuple[int, int, float]]:
    """Support edges of an image; an empty list if they are unknown."""
    return graph.support or []


def _find_hull(folders: list[ModelsFolder], obj_id: int) -> _Hull | None:
    """Convex hull of a model; None: there is no such model, or it has no volume."""
    for folder in folders:
        vertices = ModelSubject(folder, obj_id).vertices if obj_id in folder.files else None
        if vertices is not None:
            try:
                hull = ConvexHull(vertices)
            except (QhullError, ValueError):
                continue
            return vertices[hull.vertices], np.unique(hull.equations[:, :3].round(3), axis=0)
    return None


def relative_pose(one: TruthSchema, other: TruthSchema) -> np.ndarray:
    """Pose of `other` in the frame of `one` (3, 4): rotation matrix times 100 mm, so that turns count as motions, and translation [mm]."""
    turn, move = np.reshape(one.cam_R_m2c, (3, 3)), np.subtract(other.cam_t_m2c, one.cam_t_m2c)
    return np.column_stack((100.0 * turn.T @ np.reshape(other.cam_R_m2c, (3, 3)), turn.T @ move))


def find_gap(one: _Hull, other: _Hull, pose: np.ndarray) -> float:
    """Lower bound of the distance of two convex hulls [mm], the second at a `relative_pose`: separating axis test along all facet normals
    and the line between the centres; exact where a facet is nearest, negative where hulls overlap."""
    turn = pose[:, :3] / 100.0
    corners = other[0] @ turn.T + pose[:, 3]
    line = corners.mean(axis=0) - one[0].mean(axis=0)
    axes = np.concatenate((one[1], -other[1] @ turn.T, [line / max(float(np.linalg.norm(line)), 1e-9)]))
    return float(((corners @ axes.T).min(axis=0) - (one[0] @ axes.T).max(axis=0)).max())
