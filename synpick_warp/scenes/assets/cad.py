"""Import of STL, binary and text, and of STEP (ISO 10303-21), whose surfaces are tessellated by OpenCASCADE through cascadio, which is
optional, and read as the GLB that it makes."""

import importlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import NO_MATERIAL
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE, MAX_ROWS, MAX_TEXT_MESH, Notes, check_decimals, decode_text, reading_as
from synpick_warp.scenes.assets.gltf.parts import read_gltf
from synpick_warp.scenes.assets.mesh_parts import MeshPart
from synpick_warp.system.inputs.files import read_file

_HEADER = 84
_SAMPLE = 4096
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_VERTEX = re.compile(r"\bvertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path, notes: Notes) -> list[MeshPart]:
    """Read an STL file. Equal corners become one vertex; the triangles' own normals are not used, since they are often wrong. Raises
    CatalogError: the file cannot be read, or is too large."""
    data = read_file(path, MAX_MESH_FILE, CatalogError)
    count = int.from_bytes(data[80:_HEADER], "little")
    # Binary files may begin with "solid" as well, and text with any word: the announced size decides first.
    exact = len(data) >= _HEADER and len(data) == _HEADER + count * _TRIANGLE.itemsize
    if exact or (len(data) >= _HEADER and b"\0" in data[:_SAMPLE] and not _VERTEX.search(decode_text(data[:_SAMPLE]))):
        corners = _binary(data, count, path, notes)
    else:
        corners = _text(data, path)
    if not len(corners):
        raise CatalogError(f"{path}: no triangles; a model needs a surface")
    vertices, index = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    return [MeshPart(vertices, index.reshape(-1, 3).astype(np.int64), None, None, None, NO_MATERIAL)]


def _binary(data: bytes, count: int, path: Path, notes: Notes) -> np.ndarray:
    """Triangle corners (F, 3, 3) float64 of a binary STL file: as many as its body holds, unless other bytes follow those announced.

    Programs that write triangles as they come leave the number in the header at 0.
    """
    held, rest = divmod(len(data) - _HEADER, _TRIANGLE.itemsize)
    if max(count, held) > MAX_ROWS:
        raise CatalogError(f"{path}: announces {count} triangles, holds {held}; allowed: at most {MAX_ROWS}; decimate the mesh")
    if held < count:
        raise CatalogError(f"{path}: not readable as STL (its header announces {count} triangles, its body holds {held}); it is cut short")
    if held > count or rest:
        announced, count = count, count if count and rest else held
        notes.said.append(f"its header announces {announced} triangles, its body holds {held}: {count} are read")
    triangles = np.frombuffer(data, _TRIANGLE, count, _HEADER)
    if np.any(triangles["attribute"]):
        notes.ignored.append("colours or other attributes of triangles")
    return triangles["corners"].astype(np.float64)


def _text(data: bytes, path: Path) -> np.ndarray:
    """Triangle corners (F, 3, 3) float64 of a text STL file, of all its solids together."""
    if len(data) > MAX_TEXT_MESH:
        raise CatalogError(f"{path}: too large for a text file; save it as binary STL")
    text = decode_text(data)
    if text.count("vertex") + text.count("VERTEX") > 3 * MAX_ROWS:
        raise CatalogError(f"{path}: more than {MAX_ROWS} triangles; decimate the mesh")
    numbers = _VERTEX.findall(text)
    try:
        return np.array(numbers, dtype=np.float64).reshape(-1, 3, 3)
    except ValueError:
        check_decimals(text, path)
        raise CatalogError(f"{path}: not readable as STL (its {len(numbers)} vertices are not three numbers each, three a facet)") from None


STEP_SUFFIXES = (".step", ".stp")
"""Endings of STEP files; lengths are in the unit that each names itself, and come out in metres."""
# Largest distance of a chord from its curve [mm] and angle between two chords [rad]: below what a depth camera resolves, while a drilled
# plate stays at some thousand triangles.
_CHORD, _ANGLE = 0.05, 0.3


def read_step(path: Path, notes: Notes) -> list[MeshPart]:
    """Read a STEP file, all of its bodies, in metres. Raises CatalogError: cascadio is not installed, or the file cannot be read."""
    data = read_file(path, MAX_TEXT_MESH, CatalogError)
    try:
        cascadio: Any = importlib.import_module("cascadio")
    except ImportError:
        advice = "pip install 'synpick-warp[step]', or save it as STL or GLB"
        raise CatalogError(f"{path}: STEP files need cascadio, which is not installed: {advice}") from None
    with reading_as("STEP", path):
        glb = cascadio.load(data, file_type="step", tol_linear=_CHORD, tol_angular=_ANGLE, use_parallel=False)
    if not glb:
        raise CatalogError(
            f"{path}: not readable as STEP (OpenCASCADE refuses it); export it again as AP203, AP214 or AP242, or save it as STL"
        )
    return read_gltf(path, notes, glb)
