"""Records of an episode's bin in data sets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

_DIGITS = 6
_FLAT = ("table", "pallet")
"""Names of bins without walls."""


def bin_record(name: str, pose: np.ndarray) -> dict[str, Any]:
    """Record of a bin: name, position [m] and yaw [rad] in the world, from its pose (7): x, y, z [m], quaternion x, y, z, w."""
    x, y, z, _, _, sine, cosine = pose.astype(np.float64).tolist()
    yaw = round(2.0 * math.atan2(sine, cosine), _DIGITS)
    return {"name": name, "position": [round(part, _DIGITS) for part in (x, y, z)], "yaw": yaw}


def name_bin(sentence: str, record: Mapping[str, Any] | None) -> str:
    """Sentence on an episode's tote, said of the bin that it has; None: a tote that is always in its place."""
    if record is None:
        return sentence
    name = record["name"]
    if name in _FLAT:
        sentence = sentence.replace("in the tote", "on the tote")
    return sentence.replace("tote", name if name in ("tote", *_FLAT) else "bin")
