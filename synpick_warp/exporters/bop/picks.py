"""File scene_picks.json beside a BOP scene: the grasp candidates of each frame in camera coordinates, with their simulated success.

Trials are spooled to the staged scene as table rows when they arrive; the JSON file is written when the scene is complete.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.configs.calibration.lens import read_lens
from synpick_warp.system.linear_algebra import matmul
from synpick_warp.views.picks import COLUMNS, PickBatch, make_rows, row_type, sort_rows

PICKS = "picks"
"""Spool file of a staged scene; absent if no candidates were drawn from its camera's images."""
_MM = 1000.0
"""Millimetres in a metre."""
_DIGITS = 6
"""Decimal places of numbers; lengths in millimetres and pixels have three less."""


def spool_picks(batch: PickBatch, scenes: tuple[Path, ...]) -> None:
    """Append the trials of a batch to spool files: each to that of the camera from which its candidate was drawn; `scenes`: by camera."""
    rows = make_rows(COLUMNS, batch.trials)
    state, camera = np.asarray(batch.states["state"]), np.asarray(batch.states["camera"])
    for index in np.unique(camera).astype(int).tolist():
        own = np.isin(rows["state"], state[camera == index])
        with (scenes[index] / PICKS).open("ab") as file:
            file.write(rows[own].tobytes())


def format_picks(spool: Path, camera: Callable[[int], dict[str, Any] | None], size: tuple[int, int]) -> Iterator[str]:
    """Format scene_picks.json, as lines of text: a list of candidates by frame. `camera` gives an image's entry in scene_camera.json, None:
    there is no such image; `size`: width and height of the images [px]."""
    rows = sort_rows(np.fromfile(spool, row_type(COLUMNS)))
    yield "{"
    begin = "\n"
    for frame in np.unique(rows["frame"]).tolist():
        entry = camera(frame)
        if entry is not None:
            yield f'{begin}  "{frame}": {json.dumps(_list_picks(rows[rows["frame"] == frame], entry, size))}'
            begin = ",\n"
    yield "\n}\n"


def _list_picks(rows: np.ndarray, camera: dict[str, Any], size: tuple[int, int]) -> list[dict[str, Any]]:
    """Entries of a frame: one for each candidate, in their order."""
    _, first, which = np.unique(rows[["state", "candidate"]], return_index=True, return_inverse=True)
    trials = np.bincount(which)
    success = np.bincount(which, rows["success"]) / trials
    rotation = np.reshape(np.array(camera["cam_R_w2c"], np.float64), (3, 3))
    point = matmul(_MM * rows["point"][first].astype(np.float64), rotation.T) + camera["cam_t_w2c"]
    normal = matmul(rows["normal"][first].astype(np.float64), rotation.T)
    lens, flat = read_lens(camera, size), point[:, :2] / point[:, 2:]
    matrix = np.reshape(np.array(camera["cam_K"], np.float64), (3, 3))
    pixel = matmul(flat, matrix[:2, :2].T) + matrix[:2, 2] if lens is None else lens.project(flat)
    seal, wrench = rows["seal"][first].astype(np.float64), rows["wrench"][first].astype(np.float64)
    columns = {
        "pixel": np.round(pixel, _DIGITS - 3),
        "point": np.round(point, _DIGITS - 3),
        "normal": np.round(normal, _DIGITS),
        "obj_id": rows["obj_id"][first],
        "instance_id": rows["instance"][first],
        "seal": np.round(seal, _DIGITS),
        "wrench": np.round(wrench, _DIGITS),
        "score": np.round(seal * wrench, _DIGITS),
        "success": np.round(success, _DIGITS),
        "trials": trials,
    }
    return [dict(zip(columns, row, strict=True)) for row in zip(*(values.tolist() for values in columns.values()), strict=True)]
