"""Parsers of calibration files: YAML, XML, JSON, NumPy's archives, COLMAP's lists, ROS's .ini, and bare numbers, told apart by content.

They run in the isolated process of `files.read_calibration`: what a parser raises, or takes of time and memory, ends there.
"""

import io
import re
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from synpick_warp.errors import ConfigError
from synpick_warp.system.inputs.files import decode_json, read_file

MAX_FILE = 2**20
"""Largest calibration file [bytes]; one with the corners of a hundred pictures of a board has some 300 kB."""
_MAX_ARRAY = 2**12
"""Largest array of an archive that is read [bytes]; a camera matrix has 200, poses of a board have more and are not needed."""
_BARE, _WORD = re.compile(r"[\s\d.,;eE+\-\[\]()]+"), re.compile(r"[^\s,;\[\]()]+")
"""Text of numbers without a name, and a number of it."""

Tree = dict[str, Any]
"""Mapping of names to numbers, strings, lists and mappings; numbers may be strings, as in YAML and XML."""


def read_document(path: Path) -> Tree:
    """Read a file as a mapping: of its names, or of those that formats without names mean. Raises ConfigError: it cannot be read, is too
    large, or has no names; and whatever parsers raise."""
    data = read_file(path, MAX_FILE, ConfigError)
    if data.startswith((b"PK", b"\x93NUMPY")):
        return _decode_arrays(data)
    text = data.decode("utf-8-sig")
    if text.lstrip().startswith("{"):
        return decode_json(text.encode(), dict[str, Any], path, ConfigError)
    if _BARE.fullmatch(text) and "-" not in (numbers := _WORD.findall(text)):
        return {"K": numbers}
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if ["[image]"] in rows:
        return _decode_ini(rows)
    if rows and len(rows[0]) > 4 and rows[0][0].isdecimal() and re.fullmatch("[A-Z_]+", rows[0][1]):
        return {row[0]: {"MODEL": row[1], "width": row[2], "height": row[3], "PARAMS": row[4:]} for row in rows if len(row) > 4}
    tree = _decode_xml(text) if text.lstrip().startswith("<") else _decode_yaml(text)
    if not isinstance(tree, dict):
        raise ConfigError(f"{path} is no calibration file: its top level has no names")
    return tree


def _decode_arrays(data: bytes) -> Tree:
    """Small arrays of an .npz file, or the one of an .npy file, as nested lists. Pickles, which arrays of objects are, are left out."""
    import numpy as np

    if not data.startswith(b"PK"):
        return {"K": np.load(io.BytesIO(data), allow_pickle=False).tolist()}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        small = [item for item in archive.infolist() if item.filename.endswith(".npy") and item.file_size <= _MAX_ARRAY]
        arrays = {item.filename.removesuffix(".npy"): archive.read(item) for item in small}
    return {name: np.load(io.BytesIO(array), allow_pickle=False).tolist() for name, array in arrays.items() if b"'|O'" not in array[:128]}


def _decode_ini(rows: list[list[str]]) -> Tree:
    """Tree of ROS's .ini, in which values stand in the lines below their name; its model follows from the number of coefficients."""
    tree: dict[str, Any] = {}
    name = ""
    for row in rows:
        if row[0][0].isalpha() or row[0][0] == "[":
            name = "_".join(row)
        else:
            tree[name] = [*tree.get(name, []), *row]
    sizes = {key: tree[key][0] for key in ("width", "height") if key in tree}
    return tree | sizes | {"distortion_model": "rational_polynomial" if len(tree.get("distortion", ())) == 8 else "plumb_bob"}


def _decode_xml(text: str) -> Tree:
    """Tree of a file as OpenCV's FileStorage writes it: elements by name, their text, or their own elements by name."""
    root = ElementTree.fromstring(text)
    return {item.tag: {part.tag: part.text or "" for part in item} if len(item) else item.text or "" for item in root}


def _decode_yaml(text: str) -> Any:
    """Tree of the first document of a YAML file, with scalars as strings; tags, such as !!opencv-matrix, are not interpreted."""
    import yaml

    # OpenCV begins with "%YAML:1.0", which is no directive of YAML.
    text = text.partition("\n")[2] if text.startswith("%YAML") else text
    return next(yaml.load_all(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader)), None)
