"""Validation rules of scene_graph.json: edges and unstacking order against each other, support edges against the models' geometry."""

from functools import cache, partial
from itertools import chain

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.rules.models import ModelsFolder, ModelSubject
from synpick_warp.apps.validation.scene_files import TruthSchema
from synpick_warp.apps.validation.subjects import SceneSubject
from synpick_warp.dataset.annotations import GraphEntry

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
