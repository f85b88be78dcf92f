"""Mesh parts: geometry and material as read from a mesh file, before they are validated and merged; and notes on what was left out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import FileMaterial
from synpick_warp.scenes.assets.asset_files import MissingFileError

_Image = TypeVar("_Image")

# Default base colour (sRGB): a light grey, since highlights do not show on pure white.
GREY = (0.7, 0.7, 0.7)
WHITE = (1.0, 1.0, 1.0)
NO_MATERIAL = FileMaterial(GREY, None, None, None)
"""Material of a part whose file has none: light grey, the rest by the settings."""


def plain_color(color: tuple[float, float, float] | None) -> tuple[float, float, float]:
    """Colour of a material whose image is not there: its own, unless it has none, or white or black, which exporters write beside an
    image; then light grey."""
    return GREY if color is None or all(value < _ROUNDING for value in color) or all(value > 1.0 - _ROUNDING for value in color) else color


_ROUNDING = 1e-6
# Longest list in a note; of more only the number is told.
_MAX_LISTED = 8


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Part of a mesh file, not yet validated, in the file's unit: vertices, faces, material; normals, texture coordinates and vertex
    colours (None: not stated).
    """

    vertices: np.ndarray
    """(V, 3) float64."""
    faces: np.ndarray
    """Vertex indices (F, 3) int64."""
    normals: np.ndarray | None
    """(V, 3)."""
    uv: np.ndarray | None
    """(V, 2)."""
    colors: np.ndarray | None
    """Vertex colours, sRGB in 0..1 (V, 3); multiply the material's base colour in linear light."""
    material: FileMaterial


def check_indices(faces: np.ndarray, count: int, path: Path) -> None:
    """Raise CatalogError if a triangle (F, 3) refers to another vertex than the `count` that there are."""
    wrong = faces[(faces < 0) | (faces >= count)]
    if len(wrong):
        raise CatalogError(f"{path}: a triangle refers to vertex {wrong[0]}, but there are {count}; repair the mesh")


@dataclass(eq=False)
class Notes:
    """Notes of a reader on a mesh file: warnings on what was replaced, and features that are not used; told in one line per file."""

    substitute: bool = False
    """Whether an image that is not there is replaced by a colour, which is noted; otherwise it is an error."""
    said: list[str] = field(default_factory=list)
    """Warnings: what is missing and what is used instead."""
    ignored: list[str] = field(default_factory=list)
    """Names of features that the file has and that are not used."""

    def image(self, read: Callable[[], _Image]) -> _Image | None:
        """Result of `read`; None if the image is not there and is replaced by a colour."""
        try:
            return read()
        except MissingFileError as error:
            if not self.substitute:
                raise
            self.said.append(f"the image {ascii(error.name)[:80]} is missing, a plain colour is used")
            return None

    def line(self, source: object) -> str | None:
        """All notes as one line; None: there are none."""
        ignored = list(dict.fromkeys(self.ignored))
        more = [f"{len(ignored) - _MAX_LISTED} more"] if len(ignored) > _MAX_LISTED else []
        said = list(dict.fromkeys(self.said))[:_MAX_LISTED]
        said += [f"ignored: {', '.join(ignored[:_MAX_LISTED] + more)}"] if ignored else []
        return f"{source}: {'; '.join(said)}" if said else None
