"""Parsers of calibration files: YAML, XML or JSON, told apart by content, to nested mappings. Aliases, tags and entities are refused.

OpenCV's own reader is not used: it fails by exceptions of C++, and takes files of any size.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from synpick_warp.errors import ConfigError
from synpick_warp.system.inputs.files import read_file
from synpick_warp.system.inputs.json import decode_json

MAX_FILE = 2**20
"""Largest calibration file [bytes]; one with the corners of a hundred pictures of a board has some 300 kB."""
_MAX_DEPTH = 16
"""Most levels of nesting."""
_MATRIX_TAG = "tag:yaml.org,2002:opencv-matrix"

Tree = dict[str, Any]
"""Mapping of names to numbers, strings, lists and mappings; numbers may be strings, as in YAML and XML."""


def read_document(path: Path) -> Tree:
    """Read a YAML, XML or JSON file whose top level is a mapping.

    Raises:
        ConfigError: In one line: it cannot be read, is too large, is none of them, or has what a calibration never needs.
    """
    data = read_file(path, MAX_FILE, ConfigError)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as fault:
        raise ConfigError(f"{path} is no calibration file: byte {fault.start} is not UTF-8") from None
    start = text.lstrip()[:1]
    if start == "{":
        return decode_json(text.encode(), dict[str, Any], path, ConfigError)
    tree = _decode_xml(text, path) if start == "<" else _decode_yaml(text, path)
    if not isinstance(tree, dict):
        raise ConfigError(f"{path} is no calibration file: its top level has no names")
    return tree


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
    """Tree of the first document of a YAML file, with scalars as strings, built from the parser's events without recursion."""
    import yaml

    # OpenCV begins with "%YAML:1.0", which is no directive of YAML.
    lines = text.split("\n", 1)
    text = lines[-1] if lines[0].startswith("%YAML") else text
    root: list[Any] = []
    stack: list[_Level] = [_Level(root)]
    try:
        for event in yaml.parse(text, Loader=getattr(yaml, "CBaseLoader", yaml.BaseLoader)):
            if isinstance(event, yaml.DocumentEndEvent):
                break
            if isinstance(event, yaml.AliasEvent) or getattr(event, "anchor", None):
                raise ConfigError(f"{path} has anchors or aliases in line {event.start_mark.line + 1}; write the values out")
            tag = getattr(event, "tag", None)
            if tag and tag != _MATRIX_TAG:
                raise ConfigError(f"{path} has the tag {tag!r} in line {event.start_mark.line + 1}; allowed: !!opencv-matrix")
            if isinstance(event, yaml.ScalarEvent):
                stack[-1].add(event.value)
            elif isinstance(event, yaml.CollectionStartEvent):
                value: Any = {} if isinstance(event, yaml.MappingStartEvent) else []
                stack[-1].add(value)
                stack.append(_Level(value))
                if len(stack) > _MAX_DEPTH:
                    raise ConfigError(f"{path} is nested too deeply in line {event.start_mark.line + 1}")
            elif isinstance(event, yaml.CollectionEndEvent):
                stack.pop()
    except yaml.YAMLError as fault:
        mark = getattr(fault, "problem_mark", None)
        where = f" in line {mark.line + 1}" if mark else ""
        raise ConfigError(f"{path} is no YAML{where}: {getattr(fault, 'problem', None) or 'it has characters that YAML forbids'}") from None
    return root[0] if root else None


class _Level:
    """A list or mapping that is being filled."""

    def __init__(self, value: Any) -> None:
        self.value, self.key = value, None

    def add(self, item: Any) -> None:
        """Append an item; in a mapping, keys and values take turns. A key that is a list or mapping is no name, and is left out."""
        if isinstance(self.value, list):
            self.value.append(item)
        elif self.key is None:
            self.key = (item if isinstance(item, str) else "",)
        else:
            self.value[self.key[0]] = item
            self.key = None
