"""Rules about lists of targets: test_targets_bop19.json, test_targets_bop24.json, and such lists of other splits."""

from __future__ import annotations

from collections import Counter

from msgspec import UNSET

from synpick_warp.apps.validation.registry import Findings, rule
from synpick_warp.apps.validation.subjects import SceneSubject
from synpick_warp.apps.validation.target_lists import TargetLists

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
