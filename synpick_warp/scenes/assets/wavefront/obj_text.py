"""OBJ text in the form that the reader (trimesh) understands: line ends, indentation, comments, relative indices, concave polygons."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.assets.polygons import clip_ears, find_concave

_INDENT = re.compile(r"(?m)^ +")
_COMMENT = re.compile(r"(?m)^((?:f|fo|v|vt|vn|l|p|s) [^#\n]*)#.*$")
_OUTDATED = re.compile(r"(?m)^fo ")
_MATERIAL = re.compile(r"(?m)^usemtl .*$")
_ZERO = re.compile(r"(?m)^f (?:[^\n]* )?[-+]?0+(?=[/ \n]|\Z)")
_RELATIVE = re.compile(r"(?m)^f [^\n]*-")
_POLYGON = re.compile(r"(?m)^f +\S+ +\S+ +\S+ +\S+.*$")
_KINDS = ("v", "vt", "vn")


def normalize_text(text: str, path: Path, ignored: list[str]) -> str:
    """Rewrite the text of an OBJ file: lines end in a line feed and begin with a keyword and one blank, without comments behind numbers;
    indices are absolute, and concave polygons are triangles.

    Args:
        text: The text.
        path: The file, for errors.
        ignored: What is left out is added to it.

    Raises:
        CatalogError: A face refers to vertex 0.
    """
    text = join_lines(text).replace("\t", " ")
    text = _OUTDATED.sub("f ", _INDENT.sub("", text))
    text = _MATERIAL.sub(lambda match: " ".join(match[0].split()), text)
    if "#" in text:
        text = _COMMENT.sub(r"\1", text)
    if _ZERO.search(text):
        raise CatalogError(f"{path}: a face refers to vertex 0, but indices begin at 1; export it again")
    if _RELATIVE.search(text):
        text = _resolve_indices(text)
    return _split_concave(text, ignored) if _POLYGON.search(text) else text


def join_lines(text: str) -> str:
    """Text with line feeds as line ends, and lines that end in a backslash joined with the next."""
    return text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")


def _resolve_indices(text: str) -> str:
    """Replace negative indices, which count back from the last vertex so far, by those from the first one."""
    counts, lines = dict.fromkeys(_KINDS, 0), text.split("\n")
    for number, line in enumerate(lines):
        kind, _, rest = line.partition(" ")
        if kind in counts:
            counts[kind] += 1
        elif kind == "f" and "-" in rest:
            known = tuple(counts.values())
            corners = (zip(corner.split("/"), known, strict=False) for corner in rest.split())
            lines[number] = "f " + " ".join(
                "/".join(str(count + 1 + int(index)) if index.startswith("-") else index for index, count in corner) for corner in corners
            )
    return "\n".join(lines)


def _split_concave(text: str, ignored: list[str]) -> str:
    """Replace concave polygons by triangles, since the reader makes fans; other text stays."""
    matches = list(_POLYGON.finditer(text))
    try:
        rows = [line.split()[1:4] for line in re.findall(r"(?m)^v [^\n]*", text)]
        vertices = np.array(rows, np.float64).reshape(-1, 3)
        polygons = [[int(corner.split("/")[0]) - 1 for corner in match[0].split()[1:]] for match in matches]
        flat = np.concatenate([np.array(polygon, np.int64) for polygon in polygons])
        if flat.min() < 0 or flat.max() >= len(vertices):
            return text
    except ValueError:  # The reader says what is wrong.
        return text
    parts, end = [], 0
    for index in find_concave(vertices, flat, np.array([len(polygon) for polygon in polygons]), ignored):
        match, corners = matches[index], matches[index][0].split()[1:]
        triangles = clip_ears(vertices[polygons[index]])
        parts += [text[end : match.start()], "\n".join("f " + " ".join(corners[at] for at in triangle) for triangle in triangles)]
        end = match.end()
    return "".join([*parts, text[end:]])
