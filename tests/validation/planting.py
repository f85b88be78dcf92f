"""Faults to plant in a copy of a correct data set: functions of its folder, each with the rule that must find it and words of its text."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

SCENE = "train/000001"
FAULTS: list[Fault] = []


@dataclass(frozen=True)
class Fault:
    """A fault."""

    rule: str
    """Rule that must find it."""
    words: str
    """Part of the message."""
    plant: Callable[[Path], None]

    @property
    def name(self) -> str:
        """Name of the test."""
        return self.plant.__name__


def fault(rule: str, words: str = "") -> Callable[[Callable[[Path], None]], Callable[[Path], None]]:
    """Declare the decorated function as one that plants a fault."""

    def declare(plant: Callable[[Path], None]) -> Callable[[Path], None]:
        FAULTS.append(Fault(rule, words, plant))
        return plant

    return declare


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    """Change a JSON file in place."""
    content = json.loads(path.read_text())
    changed = change(content)
    path.write_text(json.dumps(content if changed is None else changed))


def edit_entry(folder: Path, name: str, index: int | None = None, image: str = "1", **values: Any) -> None:
    """Set keys of an entry in a scene's JSON file."""

    def change(content: Any) -> None:
        entry = content[image] if index is None else content[image][index]
        entry.update(values)

    edit(folder / SCENE / f"scene_{name}.json", change)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


def write(path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)


def mask_path(folder: Path, index: int, kind: str = "mask", image: int = 1) -> Path:
    return folder / SCENE / kind / f"{image:06d}_{index:06d}.png"
