"""Evaluation target lists of BOP (test_targets_bop19.json, test_targets_bop24.json), from the committed scenes of a split."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from synpick_warp.exporters.writing.files import write_atomically

BOP19, BOP24 = "test_targets_bop19.json", "test_targets_bop24.json"


def write_scene_targets(scene: Path, folder: Path, visibility: float) -> None:
    """Task: write a scene's targets, one per line, to `folder/<file name>/<scene name>`; the folders must exist.

    BOP19: for each image and object, the number of instances whose visible fraction is at least `visibility`. BOP24: every image.
    """
    truth = json.loads((scene / "scene_gt.json").read_bytes())
    infos = json.loads((scene / "scene_gt_info.json").read_bytes())
    scene_id = int(scene.name)
    localize, detect = [], []
    for frame in sorted(truth, key=int):
        visible = Counter(
            entry["obj_id"] for entry, info in zip(truth[frame], infos[frame], strict=True) if info["visib_fract"] >= visibility
        )
        image = {"im_id": int(frame)}
        localize += [{**image, "inst_count": count, "obj_id": obj_id, "scene_id": scene_id} for obj_id, count in sorted(visible.items())]
        detect.append({**image, "scene_id": scene_id})
    for name, targets in ((BOP19, localize), (BOP24, detect)):
        (folder / name / scene.name).write_text("".join(json.dumps(target) + "\n" for target in targets), encoding="ascii")


def concatenate_targets(folder: Path, out: Path) -> None:
    """Concatenate the parts that `write_scene_targets` wrote into the data set's two files, in order of scenes."""
    for name in (BOP19, BOP24):
        parts = sorted((folder / name).iterdir(), key=lambda path: int(path.name))
        lines = [line for part in parts for line in part.read_bytes().splitlines()]
        write_atomically(out / name, b"[\n" + b",\n".join(lines) + b"\n]\n")
