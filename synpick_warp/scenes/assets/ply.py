"""PLY import (Turk, 1994), text and binary, with BOP's texture comments; vertices keep the order of the file.

Rows of text are read by trimesh. Binary ones are read here: trimesh takes all lists of a property for as long as the first, which mixed
triangles and quads are not.
"""

import io
import re
import struct
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from trimesh.exchange.ply import load_ply

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets import asset_files
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, NO_MATERIAL, WHITE, FileMaterial, decode_texture
from synpick_warp.scenes.assets.mesh_parts import MeshPart, check_indices, clip_ears, find_concave
from synpick_warp.system.inputs.files import read_file

MAX_HEADER = 2**16
"""Longest header [bytes]; models have less than 1 kB."""

# Property names of texture coordinates: BOP's first, then those of Blender and MeshLab.
_UV_COLUMNS = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
# Property names of colours, sRGB: those of most programs, then older ones.
_COLORS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_INDICES = ("vertex_indices", "vertex_index")
_KINDS = {"char": "b", "uchar": "B", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}
_KINDS |= {"int8": "b", "uint8": "B", "int16": "h", "uint16": "H", "int32": "i", "uint32": "I", "float32": "f", "float64": "d"}
_KINDS |= {"int64": "q", "uint64": "Q", "float16": "e"}
"""Codes of struct and NumPy by the names of types, also such as are found in files only."""
_END = re.compile(rb"(?m)^(?:.*[ \t])?end_header(?:[ \t\r].*)?$\n?")
"""Last line of a header: for trimesh too, the first with that word."""
_ELEMENT = re.compile(r"element\s+(\S+)\s+([0-9]{1,20})")
_PROPERTY = re.compile(rf"property\s+(?:list\s+({'|'.join(_KINDS)})\s+)?({'|'.join(_KINDS)})\s+(\S+)")


@dataclass(eq=False)
class _Element:
    """PLY element: number of rows, and types and values of its properties by name."""

    count: int = 0
    kinds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Type of a property's values, before it that of the lengths if they are lists."""
    values: dict[str, Any] = field(default_factory=dict)
    """Columns (count) or (count, 1); of lists (count, length), or an object array of arrays unless all are equally long."""


@dataclass(frozen=True, eq=False)
class _Header:
    """Header of a PLY file: elements without values, texture comments, byte order (empty: text), and where the body begins."""

    elements: dict[str, _Element]
    textures: list[str]
    order: str
    start: int


def read_ply_file(path: Path) -> bytes:
    """Read a PLY file, text of any encoding as UTF-8. Raises CatalogError: it cannot be read, or is too large."""
    data = read_file(path, asset_files.MAX_MESH_FILE, CatalogError)
    if data.startswith(b"ply\rformat ascii") and b"\n" not in data:
        return data.replace(b"\r", b"\n")
    text = "" if data.startswith(b"ply") else asset_files.decode_text(data)
    return text.encode() if text.startswith("ply") else data


def read_ply_texture(data: bytes, path: Path) -> tuple[str, bytes] | None:
    """Name and content of the texture that a PLY header names in a line `comment TextureFile NAME` (in any case), inside the file's folder;
    None if there is none. Raises MissingFileError: there is no such file; CatalogError: the file cannot be used, or the header is none of
    PLY or names several."""
    names = _read_header(data, path).textures
    if len(set(names)) > 1:
        raise CatalogError(f"{path}: {len(names)} texture comments, {names[0]!a} and {names[1]!a}; keep one")
    return (names[0], asset_files.read_referred(path.parent, names[0], path, MAX_TEXTURE_FILE)[1]) if names else None


def read_ply(path: Path, notes: asset_files.Notes) -> list[MeshPart]:
    """Read a PLY file in BOP's format; vertices keep their order, since texture coordinates refer to it. Raises CatalogError: the file
    cannot be read or has no triangles, or its texture is missing."""
    data = read_ply_file(path)
    with asset_files.reading_as("PLY", path):
        part = _ply_part(_read_elements(data, path), path, notes)
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
    """Read the vertices of a PLY file as they are stored (V, 3) float64, in the file's unit; faces and texture are not read. Raises
    CatalogError: the file cannot be read, has no vertices, or one that is not finite."""
    data = read_ply_file(path)
    with asset_files.reading_as("PLY", path), asset_files.quiet_decoding():
        vertices = _columns(_read_elements(data, path).get("vertex", _Element()), ("x", "y", "z"))
    if vertices is None or not len(vertices):
        raise CatalogError(f"{path}: no vertices with x, y and z")
    if not np.isfinite(vertices).all():
        raise CatalogError(f"{path}: a vertex is not a finite number; repair the mesh")
    return vertices


def _read_header(data: bytes, path: Path) -> _Header:
    """Parse the header. Numbers of rows are limited, since the body of an element without properties has no size."""
    end = _END.search(data, 0, MAX_HEADER)
    if end is None:
        raise CatalogError(f"{path}: not readable as PLY (no header that ends within {MAX_HEADER} bytes)")
    try:
        lines = [line.strip() for line in data[: end.start()].decode().split("\n")[:-1]]
    except UnicodeDecodeError as error:
        number = data.count(b"\n", 0, error.start) + 1
        raise CatalogError(f"{path}: not readable as PLY (line {number} of its header is not UTF-8); save it as UTF-8") from None
    if len(lines) < 2 or lines[0] != "ply":
        raise CatalogError(f"{path}: not readable as PLY (its first line is not ply)")
    order = "" if "ascii" in lines[1].lower() else ">" if "big" in lines[1].lower() else "<"
    comments = [words for line in lines if len(words := line.split(maxsplit=2)) == 3 and words[0] == "comment"]
    header = _Header({}, [words[2] for words in comments if words[1].lower() == "texturefile"], order, end.end())
    element = _Element()
    for number, line in enumerate(lines[2:], start=3):
        if (match := _ELEMENT.fullmatch(line)) and match[1] not in header.elements:
            element = header.elements[match[1]] = _Element(int(match[2]))
            if element.count > asset_files.MAX_ROWS:
                raise CatalogError(
                    f"{path}: {line[:80]!a}; allowed: at most {asset_files.MAX_ROWS} vertices and as many faces; decimate the mesh"
                )
        elif header.elements and (match := _PROPERTY.fullmatch(line)) and match[3] not in element.kinds:
            element.kinds[match[3]] = tuple((order or "<") + _KINDS[kind] for kind in match.groups()[:2] if kind)
        elif re.match(r"\S*(element|property)|$", line):
            raise CatalogError(f"{path}: not readable as PLY (line {number}: {line[:80]!a})")
    return header


def _read_elements(data: bytes, path: Path) -> dict[str, _Element]:
    """Elements of a PLY file by name."""
    header = _read_header(data, path)
    if not header.order:
        _read_text(header, data, path)
        return header.elements
    start = header.start
    for element in header.elements.values():
        start = _read_rows(element, data, start)
    if start != len(data):
        raise ValueError(f"its header announces {start} bytes, it has {len(data)}")
    return header.elements


def _read_text(header: _Header, data: bytes, path: Path) -> None:
    """Read the rows of a text file by trimesh, which does not mind rows or values that are missing."""
    if len(data) > asset_files.MAX_TEXT_MESH or data.count(b"\n") > 4 * asset_files.MAX_ROWS:
        raise CatalogError(f"{path}: too large for an ASCII file; save it as binary PLY")
    # trimesh builds meshes and paths of elements that it knows by name.
    renamed = re.sub(rb"(?m)^([ \t]*element[ \t]+)", rb"\1_", data[: header.start])
    try:
        read = load_ply(io.BytesIO(renamed + data[header.start :]), skip_materials=True)["metadata"]["_ply_raw"]
    except Exception:
        asset_files.check_decimals(asset_files.decode_text(data[header.start :]), path)
        raise
    for name, element in header.elements.items():
        element.values = read[f"_{name}"]["data"] if element.count else {}
        if any(key not in element.values or len(element.values[key]) != element.count for key in element.kinds if element.count):
            raise ValueError(f"its header announces {element.count} rows of {name[:40]}, its body is shorter; the file is cut short")


def _read_rows(element: _Element, data: bytes, start: int) -> int:
    """Read the rows of an element of a binary file; returns where the next element begins."""
    if not element.count:
        return start
    fields, at = [], start
    # Rows as long as the first one are read at once; if one differs, its list's length is not the first one's.
    for name, (*length, kind) in element.kinds.items():
        shape = tuple(int(np.frombuffer(data, each, 1, at)[0]) for each in length)
        fields += [(f"{name} length", each) for each in length] + [(name, kind, shape)]
        at += np.dtype(fields[-len(length) - 1 :]).itemsize
    row = np.dtype(fields)
    end = start + element.count * row.itemsize
    if end <= len(data):
        rows = np.frombuffer(data, row, element.count, start)
        lengths = [rows[name] for name in row.names or () if name.endswith(" length")]
        if all((length == length[0]).all() for length in lengths):
            element.values = {name: rows[name] for name in element.kinds}
            return end
    return _read_ragged(element, data, start)


def _read_ragged(element: _Element, data: bytes, start: int) -> int:
    """Read rows with lists of several lengths one by one; returns as `_read_rows`."""
    values: dict[str, list[Any]] = {name: [] for name in element.kinds}
    plan = [(values[name], struct.Struct(kinds[0]), np.dtype(kinds[-1]), len(kinds) == 2) for name, kinds in element.kinds.items()]
    for _ in range(element.count):
        for column, single, kind, is_list in plan:
            (value,) = single.unpack_from(data, start)
            start += single.size
            if is_list:
                end = start + int(value) * kind.itemsize
                if not start <= end <= len(data):
                    raise ValueError("a list is longer than the file")
                value, start = (start, int(value)), end
            column.append(value)
    for column, (name, (_, _, kind, is_list)) in zip(values.values(), zip(values, plan, strict=True), strict=True):
        element.values[name] = np.empty(element.count, object) if is_list else np.array(column, kind)
        if is_list:
            element.values[name][:] = [np.frombuffer(data, kind, length, place) for place, length in column]
    return start


def _ply_part(elements: dict[str, _Element], path: Path, notes: asset_files.Notes) -> MeshPart:
    """Mesh part of a file's elements; vertices are split where faces carry texture coordinates or colours."""
    vertex, face = elements.get("vertex", _Element()), elements.get("face", _Element())
    columns = [_columns(vertex, names) for names in (("x", "y", "z"), ("nx", "ny", "nz"))]
    columns += [next((rows for names in _UV_COLUMNS if (rows := _columns(vertex, names)) is not None), None), _colors(vertex)]
    flat, corners, source = _triangles(face, elements.get("tristrips", _Element()), columns[0], path, notes)
    if columns[0] is None:
        raise CatalogError(f"{path}: vertices without x, y and z")
    face_colors = _colors(face) if columns[3] is None and source is not None else None
    faces, known = flat[corners], {"x", "y", "z", "nx", "ny", "nz", "texnumber", "alpha", "diffuse_alpha", *_INDICES}
    has_uv = "texcoord" in face.kinds
    if has_uv or face_colors is not None:
        check_indices(faces, len(columns[0]), path)
        columns = [None if rows is None else rows[faces.reshape(-1)] for rows in columns]
        if has_uv:
            uv = np.asarray(_lists(face, "texcoord")[0], np.float64).reshape(len(flat), 2)
            columns[2], known = uv[corners].reshape(-1, 2), known | {"texcoord"}
        if face_colors is not None and source is not None:
            columns[3] = np.repeat(face_colors[source], 3, axis=0)
        faces = np.arange(faces.size).reshape(-1, 3)
    known |= set(sum((*_UV_COLUMNS, *_COLORS), ()))
    notes.ignored += [ascii(name)[1:-1][:40] for name in (*vertex.kinds, *face.kinds) if name not in known]
    vertices, normals, uv, colors = columns
    assert vertices is not None
    return MeshPart(vertices, faces, normals, uv, colors, NO_MATERIAL if colors is None else replace(NO_MATERIAL, color=WHITE))


def _triangles(
    face: _Element, strips: _Element, vertices: np.ndarray | None, path: Path, notes: asset_files.Notes
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Triangulate polygons, and strips. `vertices`: positions (V, 3); None: there are none. Returns the vertices of all corners (C,) and
    triangles of corners (F, 3); and the face of each triangle (F,), None for strips."""
    name = next((name for name in (*_INDICES, *face.kinds) if name in face.kinds), None)
    if name is not None and face.count:
        flat, lengths = _lists(face, name)
        count = np.maximum(lengths - 2, 0)
        source = np.repeat(np.arange(len(lengths)), count)
        step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
        first = (np.cumsum(lengths) - lengths)[source]
        corners, source_faces = np.stack([first, first + step + 1, first + step + 2], axis=1), source
        if vertices is not None and np.any(lengths > 3) and 0 <= flat.min() <= flat.max() < len(vertices):
            _clip_concave(corners, source, flat.astype(np.int64), lengths, vertices, notes)
    elif strips.count:
        flat, source_faces = np.concatenate([_lists(strips, next(iter(strips.kinds)))[0], [-1]]), None
        start = np.flatnonzero((flat[:-2] >= 0) & (flat[1:-1] >= 0) & (flat[2:] >= 0))
        begin = np.maximum.accumulate(np.where(flat < 0, np.arange(len(flat)) + 1, 0))[start]
        odd = (start - begin) % 2
        corners = np.stack([start, start + 1 + odd, start + 2 - odd], axis=1)
    else:
        flat, corners, source_faces = np.zeros(0, np.int64), np.zeros((0, 3), np.int64), None
    if not len(corners):
        raise CatalogError(f"{path}: no triangles; a model needs a surface, a point cloud has none")
    return flat.astype(np.int64), corners.astype(np.int64), source_faces


def _clip_concave(
    corners: np.ndarray, source: np.ndarray, flat: np.ndarray, lengths: np.ndarray, vertices: np.ndarray, notes: asset_files.Notes
) -> None:
    """Replace the fans of concave polygons among `corners` (F, 3), which are as many triangles."""
    starts, first = np.cumsum(lengths) - lengths, np.searchsorted(source, np.arange(len(lengths)))
    for index in find_concave(vertices, flat, lengths, notes.ignored):
        start, count = starts[index], lengths[index]
        corners[first[index] : first[index] + count - 2] = start + np.array(clip_ears(vertices[flat[start : start + count]]))


def _lists(element: _Element, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Values of a list property, one after another, and the length of each row's list."""
    rows = np.asarray(element.values[name])
    if rows.dtype == object:
        return np.concatenate([np.atleast_1d(row) for row in rows]), np.array([np.size(row) for row in rows])
    rows = rows.reshape(element.count, -1)
    return rows.reshape(-1), np.full(len(rows), rows.shape[1])


def _columns(element: _Element, names: tuple[str, ...]) -> np.ndarray | None:
    """Stack columns (V, len(names)) float64; None unless all exist."""
    if not element.count or not all(name in element.kinds for name in names):
        return None
    return np.stack([np.asarray(element.values[name], dtype=np.float64).reshape(-1) for name in names], axis=1)


def _colors(element: _Element) -> np.ndarray | None:
    """Colours (V, 3) in 0..1; None if there are none. Bytes, 16-bit integers or numbers up to 1 or 255, as the values show."""
    for names in _COLORS:
        colors = _columns(element, names)
        if colors is not None:
            kind = np.dtype(element.kinds[names[0]][-1])
            colors = np.nan_to_num(colors)
            largest = 255.0 if kind.itemsize == 1 or (kind.kind != "f" and colors.max() <= 255.0) else 65535.0
            if kind.kind == "f":
                largest = 1.0 if colors.max() <= 1.0 else 255.0
            return np.clip(colors / largest, 0.0, 1.0)
    return None
