"""OBJ import: text and material libraries are decoded and checked here, so that the reader opens no file by itself."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError
from synpick_warp.inputs.files import read_file
from synpick_warp.scenes.assets.appearance import MAX_TEXTURE_FILE, MAX_TEXTURE_PIXELS, decode_texture
from synpick_warp.scenes.assets.asset_files import MAX_PARTS, MAX_ROWS, MAX_TEXT_MESH, FileTable, read_referred

MAX_LIBRARY = 2**22
"""Largest material library [bytes]: 4 MiB."""
_LIBRARY = "library"


def prepare_obj(path: Path) -> tuple[bytes, FileTable]:
    """Read an OBJ file with its material libraries and their images.

    Returns:
        The file for the reader, UTF-8, with one material library; and the files that it refers to.

    Raises:
        CatalogError: A file is missing, too large or outside of the model's folder, an image is damaged, or a colour is not finite.
    """
    text = _decode(read_file(path, MAX_TEXT_MESH, CatalogError))
    if text.count("\n") > 4 * MAX_ROWS:
        raise CatalogError(f"{path}: more than {4 * MAX_ROWS} lines; decimate the mesh")
    lines = text.split("\n")
    materials = {line[line.index("usemtl ") :].strip() for line in lines if "usemtl " in line}
    if len(materials) > MAX_PARTS or text.count("usemtl ") > MAX_ROWS:
        raise CatalogError(f"{path}: more than {MAX_PARTS} materials; merge them")
    table = FileTable(path.name)
    library: list[str] = []
    seen: set[str] = set()
    pixels = 0
    for line in lines:
        name = line.strip().removeprefix("mtllib").strip()
        if line.split(maxsplit=1)[:1] == ["mtllib"] and name not in seen:
            seen.add(name)
            found, pixels = _read_library(path, name, table, pixels)
            library += found
            if len(table.files) > MAX_PARTS:
                raise CatalogError(f"{path}: its material libraries name more than {MAX_PARTS} images; merge them")
    if library:
        table.files[_LIBRARY] = "\n".join(library).encode()
        text = f"mtllib {_LIBRARY}\n{text}"
    return text.encode(), table


def _decode(data: bytes) -> str:
    """Decode text: UTF-8, with or without a byte order mark, otherwise Latin-1, which only names and comments can be in."""
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def _read_library(path: Path, name: str, table: FileTable, pixels: int) -> tuple[list[str], int]:
    """Read a material library: names, diffuse colours and images, which are put into the table.

    Returns:
        Its lines, and the number of pixels of all images so far.
    """
    library, data = read_referred(path.parent, name, path, MAX_LIBRARY)
    lines: list[str] = []
    sizes: dict[Path, int] = {}
    for line in _decode(data).splitlines():
        words = line.split()
        key = words[0].lower() if len(words) > 1 else ""
        if key == "newmtl":
            lines.append(f"newmtl {' '.join(words[1:])}")
        elif key == "kd" and lines:
            lines += _color_line(words[1:], library)
        elif key == "map_kd" and lines:
            image, content = _read_image(library, line, words)
            if image not in sizes:
                sizes[image] = decode_texture(content, str(image)).size // 3
            pixels += sizes[image]
            if pixels > MAX_TEXTURE_PIXELS:
                raise CatalogError(f"{path}: its textures have more than {MAX_TEXTURE_PIXELS} pixels together; scale them down")
            lines.append(f"map_Kd image{len(table.files)}")
            table.files[f"image{len(table.files)}"] = content
    return lines, pixels


def _color_line(words: list[str], library: Path) -> list[str]:
    """A diffuse colour of one or three numbers; none if it is given as a spectrum, or in another colour space."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        return []
    if not np.isfinite(values).all():
        raise CatalogError(f"{library}: Kd {ascii(' '.join(words))[1:-1][:80]} is not finite; give red, green and blue from 0 to 1")
    return [f"Kd {' '.join(map(repr, values))}"]


def _read_image(library: Path, line: str, words: list[str]) -> tuple[Path, bytes]:
    """Read the image that a line names: the rest of the line, or its last word, after options."""
    name = line[line.lower().index("map_kd") + 6 :].strip()
    if not name.isprintable() or not os.path.isfile(library.parent / name):
        name = words[-1]
    return read_referred(library.parent, name, library, MAX_TEXTURE_FILE)
