"""PLY import: header validation before the body is decoded, BOP's texture comments, vertices in the order of the file."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.ply import load_ply

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, FileMaterial, decode_texture
from synpick_warp.scenes.assets.asset_files import MAX_MESH_FILE, MAX_ROWS, MAX_TEXT_MESH, quiet_decoding, read_referred, reading_as
from synpick_warp.scenes.assets.mesh_parts import NO_MATERIAL, WHITE, MeshPart, Notes
from synpick_warp.scenes.assets.ply_binary import read_binary
from synpick_warp.scenes.assets.polygons import clip_ears, find_concave
from synpick_warp.scenes.assets.text import check_decimals, decode_text
from synpick_warp.system.inputs.files import read_file

MAX_HEADER = 2**16
"""Longest header [bytes]; models have less than 1 kB."""
MAX_PROPERTIES = 256
"""Maximum number of properties of all elements together."""
MAX_VALUES = 2**24
"""Maximum number of values of an ASCII file: rows times properties."""

# Property names of texture coordinates: BOP's first, then those of Blender and MeshLab.
_UV_COLUMNS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
# Property names of colours, sRGB: those of most programs, then older ones.
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_INDICES = ("vertex_indices", "vertex_index")
# All that numbers consist of: digits, signs, exponents, "nan", "infinity".
_NUMBERS = b"0123456789+-.eEnNaAiIfFtTyY \t\r\n"


def read_ply_file(path: Path) -> bytes:
    """Read a PLY file and check its header.

    Raises:
        CatalogError: It is not a PLY file, or exceeds a limit.
    """
    data = read_file(path, MAX_MESH_FILE, CatalogError)
    if data.startswith(b"ply\rformat ascii") and b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    if not data.startswith(b"ply"):
        # Text with a byte order mark, or in UTF-16.
        text = decode_text(data)
        data = text.encode() if text.startswith("ply") else data
    lines, start = _header(data, path)
    _check_elements(lines, data, start, path)
    return data


def texture_name(data: bytes, path: Path) -> str | None:
    """The image that a PLY header names in a line `comment TextureFile NAME` (in any case); None if there is none.

    Args:
        data: The file.
        path: Its path, for errors.

    Raises:
        CatalogError: The header names several images, or is no PLY header.
    """
    names = []
    for line in _header(data, path)[0]:
        words = line.split(maxsplit=2)
        if len(words) == 3 and words[0] == "comment" and words[1].lower() == "texturefile":
            names.append(words[2].strip())
    if len(set(names)) > 1:
        raise CatalogError(f"{path}: {len(names)} texture comments, {names[0]!a} and {names[1]!a}; keep one")
    return names[0] if names else None


def read_ply_texture(data: bytes, path: Path) -> tuple[str, bytes] | None:
    """Name and content of the texture that a PLY file names, inside the file's folder; None if it names none.

    Raises:
        MissingFileError: There is no such file.
        CatalogError: The file cannot be used.
    """
    name = texture_name(data, path)
    return None if name is None else (name, read_referred(path.parent, name, path, MAX_TEXTURE_FILE)[1])


def read_ply(path: Path, notes: Notes) -> list[MeshPart]:
    """Read a PLY file in BOP's format; vertices keep their order, since texture coordinates refer to it.

    Raises:
        CatalogError: The file cannot be read or has no triangles, or its texture is missing.
    """
    data = read_ply_file(path)
    with reading_as("PLY", path):
        part = _ply_part(_elements(data, path), path, notes)
    found = notes.image(lambda: read_ply_texture(data, path))
    if found is None:
        return [replace(part, uv=None)]
    texture = decode_texture(found[1], str(path.parent / found[0]))
    if part.uv is None:
        raise CatalogError(f"{path}: refers to a texture, but its vertices have no texture_u, texture_v; unwrap it or remove the texture")
    if part.colors is not None:
        notes.ignored.append("colours beside a texture")
    return [replace(part, colors=None, material=FileMaterial(WHITE, texture, None, None))]


def read_ply_vertices(path: Path) -> np.ndarray:
    """Read the vertices of a PLY file as they are stored (V, 3) float64, in the file's unit; faces and texture are not read.

    Raises:
        CatalogError: The file cannot be read, has no vertices, or one that is not finite.
    """
    data = read_ply_file(path)
    with reading_as("PLY", path), quiet_decoding():
        vertices = _columns(_elements(data, path).get("vertex", {}), ("x", "y", "z"))
    if vertices is None or not len(vertices):
        raise CatalogError(f"{path}: no vertices with x, y and z")
    if not np.isfinite(vertices).all():
        raise CatalogError(f"{path}: a vertex is not a finite number; repair the mesh")
    return vertices


def _elements(data: bytes, path: Path) -> dict[str, Any]:
    """Elements of a PLY file, each with length, properties (type by name) and data (values by name)."""
    lines, start = _header(data, path)
    # The reader takes all lists of a property in a binary file for equally long; it would make lines of the element edge.
    if len(lines) > 1 and lines[1].startswith("format binary_") and any(" list " in line for line in lines):
        return read_binary(lines, data, start)
    renamed = re.sub(rb"(?m)^([ \t]*element[ \t]+)edge(?=[ \t])", rb"\1edg_", data[:start])
    # fix_texture would reorder vertices; textures are read elsewhere, where a missing one is an error.
    return load_ply(io.BytesIO(renamed + data[start:]), fix_texture=False, skip_materials=True)["metadata"]["_ply_raw"]


def _header(data: bytes, path: Path) -> tuple[list[str], int]:
    """Lines of the header, and where the body begins; ends, as for the reader, at the first line with the word end_header."""
    lines, start = [], 0
    while start < min(len(data), MAX_HEADER):
        end = data.find(b"\n", start, MAX_HEADER) + 1 or len(data)
        try:
            lines.append(data[start:end].decode("utf-8").strip())
        except UnicodeDecodeError:
            raise CatalogError(
                f"{path}: not readable as PLY (line {len(lines) + 1} of its header is not UTF-8); save it as UTF-8"
            ) from None
        start = end
        if lines[0] != "ply":
            raise CatalogError(f"{path}: not readable as PLY (its first line is not ply)")
        if "end_header" in lines[-1].split():
            return lines, start
    raise CatalogError(f"{path}: not readable as PLY (no header that ends within {MAX_HEADER} bytes)")


def _check_elements(lines: list[str], data: bytes, start: int, path: Path) -> None:
    """Check the counts of a header before anything is allocated for them."""
    elements: dict[str, int] = {}
    counts: dict[str, set[str]] = {}
    for number, line in enumerate(lines[2:-1], start=3):
        words = line.split()
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isascii() or not words[2].isdecimal() or words[1] in elements:
                raise CatalogError(f"{path}: not readable as PLY (line {number}: {line[:80]!a})")
            if len(words[2]) > 20 or int(words[2]) > MAX_ROWS:
                raise CatalogError(f"{path}: {line[:80]!a}; allowed: at most {MAX_ROWS} vertices and as many faces; decimate the mesh")
            elements[words[1]], counts[words[1]] = int(words[2]), set()
        elif words[:1] == ["property"]:
            owner = list(counts)[-1] if counts else ""
            if not owner or words[-1] in counts[owner]:
                raise CatalogError(f"{path}: not readable as PLY (line {number}: {line[:80]!a})")
            counts[owner].add(words[-1])
        elif not words or "element" in words[0] or "property" in words[0]:
            raise CatalogError(f"{path}: not readable as PLY (line {number}: {line[:80]!a})")
    if sum(map(len, counts.values())) > MAX_PROPERTIES:
        raise CatalogError(f"{path}: more than {MAX_PROPERTIES} properties; remove those that are not needed")
    if len(lines) > 1 and "ascii" in lines[1].lower():
        _check_ascii(data, start, sum(elements.values()), sum(count * len(counts[name]) for name, count in elements.items()), path)


def _check_ascii(data: bytes, start: int, rows: int, values: int, path: Path) -> None:
    """Check the body of an ASCII file: numbers only, and at least as many rows and values as its header announces."""
    if len(data) > MAX_TEXT_MESH or values > MAX_VALUES:
        raise CatalogError(f"{path}: too large for an ASCII file; save it as binary PLY")
    body = data[start:]
    if body.translate(None, _NUMBERS):
        check_decimals(decode_text(body), path)
        raise CatalogError(f"{path}: not readable as PLY (its body has characters that are not part of numbers)")
    if body.count(b"\n") + body.count(b"\r") > 4 * MAX_ROWS:
        raise CatalogError(f"{path}: more than {4 * MAX_ROWS} lines; save it as binary PLY")
    if body.count(b"\n") + 1 < rows or 2 * values > len(body) + 1:
        raise CatalogError(f"{path}: not readable as PLY (its header announces {rows} rows, its body is shorter); the file is cut short")


def _ply_part(elements: dict[str, Any], path: Path, notes: Notes) -> MeshPart:
    """Convert the reader's elements; texture coordinates are None or (V, 2), with vertices split where faces carry them or colours."""
    vertex, face = elements.get("vertex", {}), elements.get("face", {})
    columns = [_columns(vertex, names) for names in (("x", "y", "z"), ("nx", "ny", "nz"))]
    columns += [next((rows for names in _UV_COLUMNS if (rows := _columns(vertex, names)) is not None), None), _colors(vertex)]
    corners, source = _triangles(face, elements.get("tristrips", {}), columns[0], path, notes)
    if columns[0] is None:
        raise CatalogError(f"{path}: vertices without x, y and z")
    face_colors = _colors(face) if columns[3] is None and source is not None else None
    flat, faces = corners
    corner_uv = _corner_uv(face, len(flat))
    if corner_uv is not None or face_colors is not None:
        order = flat[faces].reshape(-1)
        if not 0 <= order.min() <= order.max() < len(columns[0]):
            wrong = order.min() if order.min() < 0 else order.max()
            raise CatalogError(f"{path}: a triangle refers to vertex {wrong}, but there are {len(columns[0])}; repair the mesh")
        columns = [None if rows is None else rows[order] for rows in columns]
        if corner_uv is not None:
            columns[2] = corner_uv[faces].reshape(-1, 2)
        if face_colors is not None and source is not None:
            columns[3] = np.repeat(face_colors[source], 3, axis=0)
        triangles = np.arange(len(order)).reshape(-1, 3)
    else:
        triangles = flat[faces]
    known = {"texnumber", "alpha", *_INDICES, *(("texcoord",) if corner_uv is not None else ()), *sum((*_UV_COLUMNS, *_COLORS), ())}
    known |= {"x", "y", "z", "nx", "ny", "nz", "diffuse_alpha"}
    notes.ignored += [ascii(name)[1:-1][:40] for part in (vertex, face) for name in part.get("properties", {}) if name not in known]
    vertices, normals, uv, colors = columns
    assert vertices is not None
    return MeshPart(vertices, triangles, normals, uv, colors, NO_MATERIAL if colors is None else replace(NO_MATERIAL, color=WHITE))


def _triangles(
    face: dict[str, Any], strips: dict[str, Any], vertices: np.ndarray | None, path: Path, notes: Notes
) -> tuple[tuple[np.ndarray, np.ndarray], np.ndarray | None]:
    """Triangulate polygons, and strips.

    Args:
        face: The element of polygons.
        strips: The element of strips.
        vertices: Positions (V, 3); None: there are none.
        path: The file, for errors.
        notes: What is left out.

    Returns:
        The vertices of all corners (C,) and triangles of corners (F, 3); and the face of each triangle (F,), None for strips.
    """
    name = next((name for name in (*_INDICES, *face.get("properties", {})) if name in face.get("properties", {})), None)
    if name is not None and face.get("length"):
        flat, lengths = _lists(face, name)
        count = np.maximum(lengths - 2, 0)
        source = np.repeat(np.arange(len(lengths)), count)
        step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
        first = (np.cumsum(lengths) - lengths)[source]
        corners, source_faces = np.stack([first, first + step + 1, first + step + 2], axis=1), source
        if vertices is not None and np.any(lengths > 3) and 0 <= flat.min() <= flat.max() < len(vertices):
            _clip_concave(corners, source, flat.astype(np.int64), lengths, vertices, notes)
    elif strips.get("length"):
        flat, source_faces = np.concatenate([_lists(strips, next(iter(strips["properties"])))[0], [-1]]), None
        start = np.flatnonzero((flat[:-2] >= 0) & (flat[1:-1] >= 0) & (flat[2:] >= 0))
        begin = np.maximum.accumulate(np.where(flat < 0, np.arange(len(flat)) + 1, 0))[start]
        odd = (start - begin) % 2
        corners = np.stack([start, start + 1 + odd, start + 2 - odd], axis=1)
    else:
        flat, corners, source_faces = np.zeros(0, np.int64), np.zeros((0, 3), np.int64), None
    if not len(corners):
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return (flat.astype(np.int64), corners.astype(np.int64)), source_faces


def _clip_concave(
    corners: np.ndarray, source: np.ndarray, flat: np.ndarray, lengths: np.ndarray, vertices: np.ndarray, notes: Notes
) -> None:
    """Replace the fans of concave polygons among `corners` (F, 3), which are as many triangles."""
    starts, first = np.cumsum(lengths) - lengths, np.searchsorted(source, np.arange(len(lengths)))
    for index in find_concave(vertices, flat, lengths, notes.ignored):
        start, count = starts[index], lengths[index]
        corners[first[index] : first[index] + count - 2] = start + np.array(clip_ears(vertices[flat[start : start + count]]))


def _lists(element: dict[str, Any], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Values of a list property, one after another, and the length of each row's list."""
    rows = element["data"][name]
    rows = rows["f1"] if getattr(rows, "dtype", None) is not None and rows.dtype.names else np.asarray(rows)
    if rows.dtype == object:
        return np.concatenate([np.atleast_1d(row) for row in rows]), np.array([np.size(row) for row in rows])
    rows = rows.reshape(element["length"], -1)
    return rows.reshape(-1), np.full(len(rows), rows.shape[1])


def _columns(element: dict[str, Any], names: tuple[str, ...]) -> np.ndarray | None:
    """Stack columns (V, len(names)) float64; None unless all exist."""
    if not element.get("length") or not all(name in element.get("properties", {}) for name in names):
        return None
    return np.stack([np.asarray(element["data"][name], dtype=np.float64).reshape(-1) for name in names], axis=1)


def _colors(element: dict[str, Any]) -> np.ndarray | None:
    """Colours (V, 3) in 0..1; None if there are none. Bytes, 16-bit integers or numbers up to 1 or 255, as the values show."""
    for names in _COLORS:
        colors = _columns(element, names)
        if colors is not None:
            kind = np.dtype(element["properties"][names[0]])
            colors = np.nan_to_num(colors)
            largest = 255.0 if kind.itemsize == 1 or (kind.kind != "f" and colors.max() <= 255.0) else 65535.0
            if kind.kind == "f":
                largest = 1.0 if colors.max() <= 1.0 else 255.0
            return np.clip(colors / largest, 0.0, 1.0)
    return None


def _corner_uv(face: dict[str, Any], count: int) -> np.ndarray | None:
    """Texture coordinates of the faces' corners (C, 2), if the file stores them per face; otherwise None."""
    if "texcoord" not in face.get("properties", {}):
        return None
    values = _lists(face, "texcoord")[0]
    return np.asarray(values, dtype=np.float64).reshape(count, 2)
