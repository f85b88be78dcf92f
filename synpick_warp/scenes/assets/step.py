"""STEP import (ISO 10303-21): surfaces are tessellated by OpenCASCADE through cascadio, which is optional, and read as the GLB it makes."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.asset_files import MAX_TEXT_MESH, reading_as
from synpick_warp.scenes.assets.gltf.parts import read_gltf
from synpick_warp.scenes.assets.mesh_parts import MeshPart, Notes
from synpick_warp.system.inputs.files import read_file

STEP_SUFFIXES = (".step", ".stp")
"""Endings of STEP files; lengths are in the unit that each names itself, and come out in metres."""
# Largest distance of a chord from its curve [mm] and angle between two chords [rad]: below what a depth camera resolves, while a drilled
# plate stays at some thousand triangles.
_CHORD, _ANGLE = 0.05, 0.3


def read_step(path: Path, notes: Notes) -> list[MeshPart]:
    """Read a STEP file, all of its bodies, in metres.

    Raises:
        CatalogError: cascadio is not installed, or the file cannot be read.
    """
    data = read_file(path, MAX_TEXT_MESH, CatalogError)
    with reading_as("STEP", path):
        glb = _load_cascadio(path).load(data, file_type="step", tol_linear=_CHORD, tol_angular=_ANGLE, use_parallel=False)
    if not glb:
        raise CatalogError(
            f"{path}: not readable as STEP (OpenCASCADE refuses it); export it again as AP203, AP214 or AP242, or save it as STL"
        )
    return read_gltf(path, notes, glb)


def _load_cascadio(path: Path) -> Any:
    """Import cascadio; raises CatalogError if it is not installed."""
    try:
        return importlib.import_module("cascadio")
    except ImportError:
        advice = "pip install 'synpick-warp[step]', or save it as STL or GLB"
        raise CatalogError(f"{path}: STEP files need cascadio, which is not installed: {advice}") from None
