"""PLY import (Turk, 1994), text and binary, with BOP's texture comments; vertices keep the order of the file.

The numbers of text are read into the layout of a binary file, so that one reader serves both. trimesh reads neither the lists of mixed
triangles and quads in binary files, nor notices that rows of text are missing.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

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
_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}
_KINDS |= {"int64": "i8", "uint64": "u8", "float16": "f2"}
"""NumPy's names of types, also of such as are found in files only."""
_TEXT = "=f8"
"""Type of the numbers of a text file."""
_HEADER = re.compile(rb"ply[ \t\r]*\n(.*?\n)[ \t]*end_header[^\n]*\n?", re.DOTALL)


@dataclass(eq=False)
class _Element:
    """PLY element: number of rows, and types and values of its properties by name."""

    count: int
    kinds: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Type of a property's values, before it that of the lengths if they are lists."""
    values: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    """Values of all rows, one after another, and the number of each row's values (count,)."""


@dataclass(frozen=True, eq=False)
class _Header:
    """Header of a PLY file: elements without values, texture comments, whether it is text, and where the body begins."""

    elements: dict[str, _Element]
    textures: list[str]
    is_text: bool
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
    with asset_files.reading_as("PLY", path):
        names = _read_header(data, path).textures
    if len(set(names)) > 1:
        raise CatalogError(f"{path}: {len(names)} texture comments, {names[0]!a} and {names[1]!a}; keep one")
    return (names[0], asset_files.read_referred(path.parent, names[0], path, MAX_TEXTURE_FILE)[1]) if names else None


def read_ply(path: Path, notes: asset_files.Notes) -> list[MeshPart]:
    """Read a PLY file in BOP's format; vertices keep their order, since texture coordinates refer to it. Raises CatalogError: the file
    cannot be read or has no triangles, or its texture is missing."""
    data = read_ply_file(path)
    with asset_files.reading_as("PLY", path, data if b"\0" not in data else b""):
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
        vertices = _columns(_read_elements(data, path).get("vertex", _Element(0)), ("x", "y", "z"))
    if vertices is None or not len(vertices):
        raise CatalogError(f"{path}: no vertices with x, y and z")
    if not np.isfinite(vertices).all():
        raise CatalogError(f"{path}: a vertex is not a finite number; repair the mesh")
    return vertices


def _read_header(data: bytes, path: Path) -> _Header:
    """Parse the header. Numbers of rows are limited, since the body of an element without properties has no size."""
    match = _HEADER.match(data, 0, MAX_HEADER)
    if match is None:
        raise ValueError(f"no header that ends within {MAX_HEADER} bytes")
    kind, *lines = [line.strip() for line in match[1].decode().split("\n")]
    order = ">" if "big" in kind.lower() else "<"
    header = _Header(known := {}, [], "ascii" in kind.lower(), match.end())
    element = _Element(0)
    for line in lines:
        match line.split():
            case ["element", name, count] if name not in known:
                element = known[name] = _Element(int(count))
                if not 0 <= element.count <= asset_files.MAX_ROWS:
                    raise CatalogError(f"{path}: {line[:80]!a}; allowed: at most {asset_files.MAX_ROWS} rows; decimate the mesh")
            case ["property", "list", length, kind, name] if known and name not in element.kinds and {length, kind} <= _KINDS.keys():
                element.kinds[name] = order + _KINDS[length], order + _KINDS[kind]
            case ["property", kind, name] if known and name not in element.kinds and kind in _KINDS:
                element.kinds[name] = (order + _KINDS[kind],)
            case ["comment", word, *_] if word.lower() == "texturefile":
                header.textures.extend(line.split(maxsplit=2)[2:])
            case [word, *_] if "element" in word or "property" in word:
                raise ValueError(f"its header has {line[:80]!a}")
    return header


def _read_elements(data: bytes, path: Path) -> dict[str, _Element]:
    """Elements of a PLY file by name."""
    header = _read_header(data, path)
    start, body = (0, data[header.start :]) if header.is_text else (header.start, data)
    if header.is_text:
        if len(data) > asset_files.MAX_TEXT_MESH:
            raise CatalogError(f"{path}: too large for an ASCII file; save it as binary PLY")
        body = np.fromstring(body.decode("latin-1"), np.dtype(_TEXT), sep=" ").tobytes() if body.strip() else b""
    for element in header.elements.values():
        kinds = {name: (_TEXT,) * len(each) if header.is_text else each for name, each in element.kinds.items()}
        start = _read_rows(element, kinds, body, start)
    if start != len(body):
        raise ValueError("it has more values than its header announces")
    return header.elements


def _read_rows(element: _Element, kinds: dict[str, tuple[str, ...]], body: bytes, start: int) -> int:
    """Read the rows of an element, whose values have these types in the body; returns where the next element begins."""
    fields, at = [], start
    # Rows as long as the first one are read at once; if one differs, its list's length is not the first one's.
    for name, (*length, kind) in kinds.items() if element.count else ():
        shape = tuple(int(np.frombuffer(body, each, 1, at)[0]) for each in length)
        fields += [(f"{name} length", each) for each in length] + [(name, kind, shape)]
        at += np.dtype(fields[-len(length) - 1 :]).itemsize
    row = np.dtype(fields)
    end = start + element.count * row.itemsize
    rows = np.frombuffer(body, row, element.count, start) if fields and end <= len(body) else None
    if rows is not None and all((rows[name] == rows[name][0]).all() for name in row.names or () if name.endswith(" length")):
        values = {name: rows[name].reshape(element.count, -1) for name in kinds}
        element.values = {name: (each.reshape(-1), np.full(element.count, each.shape[1])) for name, each in values.items()}
    else:
        end = _read_ragged(element, kinds, body, start)
    # Numbers of text have the precision and the range of their types.
    for name, (flat, count) in element.values.items():
        values = flat.astype(element.kinds[name][-1])
        if values.dtype.kind in "iu" and not np.array_equal(values, flat):
            raise ValueError(f"{name} has a value that is no {values.dtype}")
        element.values[name] = values, count
    return end


def _read_ragged(element: _Element, kinds: dict[str, tuple[str, ...]], body: bytes, start: int) -> int:
    """Read rows with lists of several lengths one by one; returns as `_read_rows`."""
    columns: dict[str, list[np.ndarray]] = {name: [] for name in kinds}
    plan = [(columns[name], [np.dtype(kind) for kind in each]) for name, each in kinds.items()]
    for _ in range(element.count):
        for column, (*length, kind) in plan:
            count = 1
            for each in length:
                count, start = int(np.frombuffer(body, each, 1, start)[0]), start + each.itemsize
            if count < 0:
                raise ValueError("a list has a negative length")
            column.append(np.frombuffer(body, kind, count, start))
            start += count * kind.itemsize
    element.values = {name: (np.concatenate(rows), np.array([len(row) for row in rows])) for name, rows in columns.items() if rows}
    return start


def _ply_part(elements: dict[str, _Element], path: Path, notes: asset_files.Notes) -> MeshPart:
    """Mesh part of a file's elements; vertices are split where faces carry texture coordinates or colours."""
    vertex, face, strips = (elements.get(name, _Element(0)) for name in ("vertex", "face", "tristrips"))
    columns = [_columns(vertex, names) for names in (("x", "y", "z"), ("nx", "ny", "nz"))]
    columns += [next((rows for names in _UV_COLUMNS if (rows := _columns(vertex, names)) is not None), None), _colors(vertex)]
    flat, corners, source = _triangles(face, strips, columns[0], path, notes)
    if columns[0] is None:
        raise CatalogError(f"{path}: vertices without x, y and z")
    face_colors = _colors(face) if columns[3] is None and source is not None else None
    faces, known = flat[corners], {"x", "y", "z", "nx", "ny", "nz", "texnumber", "alpha", "diffuse_alpha", *_INDICES}
    has_uv = "texcoord" in face.kinds
    if has_uv or face_colors is not None:
        check_indices(faces, len(columns[0]), path)
        columns = [None if rows is None else rows[faces.reshape(-1)] for rows in columns]
        if has_uv:
            uv = face.values["texcoord"][0].astype(np.float64).reshape(len(flat), 2)
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
        flat, lengths = face.values[name]
        count = np.maximum(lengths - 2, 0)
        source = np.repeat(np.arange(len(lengths)), count)
        step = np.arange(len(source)) - np.repeat(np.cumsum(count) - count, count)
        first = (np.cumsum(lengths) - lengths)[source]
        corners, source_faces = np.stack([first, first + step + 1, first + step + 2], axis=1), source
        if vertices is not None and np.any(lengths > 3) and 0 <= flat.min() <= flat.max() < len(vertices):
            _clip_concave(corners, source, flat.astype(np.int64), lengths, vertices, notes)
    elif strips.count:
        flat, source_faces = np.concatenate([next(iter(strips.values.values()))[0], [-1]]), None
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


def _columns(element: _Element, names: tuple[str, ...]) -> np.ndarray | None:
    """Stack columns (V, len(names)) float64; None unless all exist."""
    if not element.count or not all(name in element.kinds for name in names):
        return None
    return np.stack([element.values[name][0].astype(np.float64) for name in names], axis=1).reshape(element.count, len(names))


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
