"""Newton: an episode's USD file as bodies of a model, by `ModelBuilder.add_usd`."""

from __future__ import annotations

import contextlib
import io
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tools.clients.base import Reading, Sources, first_episode, pose_matrix

PACKAGES = ("newton", "newton-usd-schemas", "usd-core")
BOUNDS = {"object_to_world": 1e-6}
"""Bound of the largest absolute difference [m]: Newton keeps poses in float32, BOP files have translations in millimetres."""


def find(data: Path, sources: Sources) -> Path | None:
    """USD file of the first episode; None: there is none."""
    file = data / "usd" / f"{first_episode(data)['episode']:06d}.usdc"
    return file if file.is_file() else None


def read(place: Path, data: Path, sources: Sources) -> Reading:
    """Poses of the objects that are in the first frame, by instance_id."""
    with warnings.catch_warnings(), contextlib.redirect_stdout(io.StringIO()):
        warnings.simplefilter("ignore")
        import newton

        builder = newton.ModelBuilder()
        builder.add_usd(str(place))
    bodies = zip(builder.body_label, builder.body_q, strict=True)
    poses = {int(label.rpartition("_")[2]): pose for label, pose in bodies if "/Objects/" in label}
    values = {"instance_id": np.array(sorted(poses))}
    values["object_to_world"] = np.array([pose_matrix(np.array(poses[index])) for index in sorted(poses)])
    return Reading(f"{place.parent.name}/{place.name}: {builder.body_count} bodies, {builder.shape_count} shapes", values)


def expect(data_set: Any) -> dict[str, np.ndarray]:
    """Values that `read` must return, from the views in memory: the objects of the first frame, in which all are in the scene."""
    view = data_set[min(data_set)].view(0)
    return {"instance_id": view.instance_ids, "object_to_world": view.object_to_world}
