"""Binary PLY bodies: elements with lists of any length, such as triangles and quads mixed."""

from __future__ import annotations

import struct
from typing import Any

import numpy as np

_KINDS = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4", "double": "f8"}
_KINDS |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"}


def read_binary(lines: list[str], data: bytes, start: int) -> dict[str, Any]:
    """Read the body of a binary PLY file, as the reader of other files (trimesh) returns it.

    Args:
        lines: Its header, which has been checked.
        data: The file.
        start: Where its body begins.

    Returns:
        By element: length; properties, NumPy types by name; data by name, of lists an object array of arrays unless all are equally long.

    Raises:
        ValueError: The file is cut short, or has an unknown type.
    """
    order = ">" if "big" in lines[1] else "<"
    elements: dict[str, Any] = {}
    properties: dict[str, str] = {}
    for words in (line.split() for line in lines[2:-1]):
        if words[0] == "element":
            properties = {}
            elements[words[1]] = {"length": int(words[2]), "properties": properties}
        elif words[0] == "property":
            kinds = [order + _KINDS[kind] for kind in words[2:4]] if words[1] == "list" else [order + _KINDS[words[1]]]
            properties[words[-1]] = " ".join(kinds)
    for element in elements.values():
        element["data"], start = _read_rows(element["length"], element["properties"], data, start)
    if start != len(data):
        raise ValueError(f"its header announces {start} bytes, it has {len(data)}")
    return elements


def _read_rows(count: int, properties: dict[str, str], data: bytes, start: int) -> tuple[Any, int]:
    """Values by property of an element's rows, and where the next element begins."""
    if not count:
        return {name: np.zeros(0) for name in properties}, start
    kinds = []
    at = start
    # Rows as long as the first one are read at once; if one differs, its list's length is not the first one's.
    for name, kind in properties.items():
        words = kind.split()
        if len(words) == 1:
            kinds.append((name, words[0]))
            at += np.dtype(words[0]).itemsize
        else:
            length = int(np.frombuffer(data, words[0], 1, at)[0])
            kinds += [(f"{name} length", words[0]), (name, words[1], (length,))]
            at += np.dtype(words[0]).itemsize + length * np.dtype(words[1]).itemsize
    row = np.dtype(kinds)
    if start + count * row.itemsize <= len(data):
        rows = np.frombuffer(data, row, count, start)
        lengths = [rows[name] for name in row.names or () if name.endswith(" length")]
        if all((length == length[0]).all() for length in lengths):
            return {name: rows[name] for name in properties}, start + count * row.itemsize
    return _read_ragged(count, properties, data, start)


def _read_ragged(count: int, properties: dict[str, str], data: bytes, start: int) -> tuple[dict[str, np.ndarray], int]:
    """Read the rows of an element with lists of several lengths, one by one; returns as `_read_rows`."""
    values: dict[str, list[Any]] = {name: [] for name in properties}
    codes = {"i1": "b", "u1": "B", "i2": "h", "u2": "H", "i4": "i", "u4": "I", "f4": "f", "f8": "d"}
    plan = []
    for name, kind in properties.items():
        words = kind.split()
        plan.append((values[name], struct.Struct(words[0][0] + codes[words[0][1:]]), np.dtype(words[1]) if len(words) == 2 else None))
    for _ in range(count):
        for column, single, item in plan:
            (value,) = single.unpack_from(data, start)
            start += single.size
            if item is None:
                column.append(value)
            else:
                if value < 0 or start + int(value) * item.itemsize > len(data):
                    raise ValueError("a list is longer than the file")
                column.append((start, int(value)))
                start += int(value) * item.itemsize
    result = {}
    for (name, kind), (column, _, item) in zip(properties.items(), plan, strict=True):
        if item is None:
            result[name] = np.array(column, dtype=kind)
        else:
            result[name] = np.empty(count, dtype=object)
            result[name][:] = [np.frombuffer(data, item, length, place) for place, length in column]
    return result, start
