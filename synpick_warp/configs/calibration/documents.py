"""Parsers of calibration files: YAML, XML, JSON, NumPy's archives, COLMAP's lists, ROS's .ini, and bare numbers, told apart by content.

OpenCV's own reader is not used: it fails by exceptions of C++, and takes files of any size.
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
_MAX_DEPTH = 16
"""Most levels of nesting."""
_MAX_ARRAY = 2**12
"""Largest array of an archive that is read [bytes]; a camera matrix has 200, poses of a board have more and are not needed."""
_SECONDS, _MEMORY = 10.0, 2**28
"""Limits of reading an archive: time [s] and memory [bytes]."""
_MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"
_BARE, _WORD = re.compile(r"[\s\d.,;eE+\-\[\]()]+"), re.compile(r"[^\s,;\[\]()]+")
"""Text of numbers without a name, and a number of it."""

Tree = dict[str, Any]
"""Mapping of names to numbers, strings, lists and mappings; numbers may be strings, as in YAML and XML."""


def read_document(path: Path) -> Tree:
    """Read a file as a mapping: of its names, or of those that formats without names mean. Raises ConfigError: in one line: it cannot be
    read, is too large, is of no such format, or has what a calibration never needs."""
    data = read_file(path, MAX_FILE, ConfigError)
    if data.startswith((b"PK", b"\x93NUMPY")):
        return _read_arrays(data, path)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path} is no calibration file: byte {fault.start} is not UTF-8") from None
    if text.lstrip().startswith("{"):
        return decode_json(text.encode(), dict[str, Any], path, ConfigError)
    if _BARE.fullmatch(text) and "-" not in (numbers := _WORD.findall(text)):
        return {"K": numbers}
    rows = [line.split() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]
    if ["[image]"] in rows:
        return _decode_ini(rows)
    if rows and len(rows[0]) > 4 and rows[0][0].isdecimal() and re.fullmatch("[A-Z_]+", rows[0][1]):
        return {row[0]: {"MODEL": row[1], "width": row[2], "height": row[3], "PARAMS": row[4:]} for row in rows if len(row) > 4}
    tree = _decode_xml(text, path) if text.lstrip().startswith("<") else _decode_yaml(text, path)
    if not isinstance(tree, dict):
        raise ConfigError(f"{path} is no calibration file: its top level has no names")
    return tree


def _read_arrays(data: bytes, path: Path) -> Tree:
    """Arrays of NumPy's .npz or .npy by name, decoded in an isolated process."""
    from synpick_warp.system.processes.isolation import Failure, Limits, run_isolated

    (tree,) = run_isolated(_decode_arrays, [(data,)], Limits(_SECONDS, _MEMORY))
    if isinstance(tree, Failure):
        raise ConfigError(f"{path} is no archive of NumPy's arrays: its reader {tree.reason}")
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


def _decode_xml(text: str, path: Path) -> Tree:
    """Tree of a file as OpenCV's FileStorage writes it: elements by name, their text, or their own elements by name."""
    if "<!" in text.replace("<!--", ""):
        raise ConfigError(f"{path} has a document type or entities; remove them: a calibration needs none")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as fault:
        raise ConfigError(f"{path} is no XML: {fault}") from None
    return {item.tag: {part.tag: part.text or "" for part in item} if len(item) else item.text or "" for item in root}


def _decode_yaml(text: str, path: Path) -> Any:
    """Tree of the first document of a YAML file, with scalars as strings."""
    import yaml

    # OpenCV begins with "%YAML:1.0", which is no directive of YAML.
    lines = text.split("\n", 1)
    text, loader = lines[-1] if lines[0].startswith("%YAML") else text, getattr(yaml, "CBaseLoader", yaml.BaseLoader)
    depth = 0
    try:
        for event in yaml.parse(text, Loader=loader):
            line = event.start_mark.line + 1
            tag, depth = getattr(event, "tag", None), depth + isinstance(event, yaml.CollectionStartEvent)
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise ConfigError(f"{path} has anchors or aliases in line {line}; write the values out")
            if tag and tag != _MATRIX_TAG:
                raise ConfigError(f"{path} has the tag {tag!r} in line {line}; allowed: !!opencv-matrix")
            if depth > _MAX_DEPTH:
                raise ConfigError(f"{path} is nested too deeply in line {line}")
            depth -= isinstance(event, yaml.CollectionEndEvent)
        return next(yaml.load_all(text, Loader=loader), None)
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path} is no YAML{where}: {getattr(fault, 'problem', None) or 'it has characters that YAML forbids'}") from None
