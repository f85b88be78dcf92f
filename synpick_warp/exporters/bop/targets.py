"""The lists of evaluation targets, from the whole scenes of a split: what an evaluation asks of every image."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path

from synpick_warp.exporters.writing.files import write_atomically

BOP19, BOP24 = "test_targets_bop19.json", "test_targets_bop24.json"


def write_scene_targets(scene: Path, folder: Path, visibility: float) -> None:
    """Write a scene's targets, one a line, to `folder/<file name>/<scene name>`; the folders are there.

    BOP19: for each image and object, how many instances are visible by at least the share `visibility`. BOP24: each image.
    """
    truth = json.loads((scene / "scene_gt.json").read_bytes())
    infos = json.loads((scene / "scene_gt_info.json").read_bytes())
    scene_id = int(scene.name)
    localize, detect = [], []
    for frame in sorted(truth, key=int):
        seen = Counter(
            record["obj_id"] for record, info in zip(truth[frame], infos[frame], strict=True) if info["visib_fract"] >= visibility
        )
        place = {"im_id": int(frame)}
        localize += [{**place, "inst_count": count, "obj_id": obj_id, "scene_id": scene_id} for obj_id, count in sorted(seen.items())]
        detect.append({**place, "scene_id": scene_id})
    for name, targets in ((BOP19, localize), (BOP24, detect)):
        (folder / name / scene.name).write_text("".join(json.dumps(target) + "\n" for target in targets), encoding="ascii")


def join_targets(folder: Path, out: Path) -> None:
    """Join what `write_scene_targets` left into the data set's two files."""
    for name in (BOP19, BOP24):
        parts = sorted((folder / name).iterdir(), key=lambda path: int(path.name))
        lines = [line for part in parts for line in part.read_bytes().splitlines()]
        write_atomically(out / name, b"[\n" + b",\n".join(lines) + b"\n]\n")
