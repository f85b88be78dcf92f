"""Content digests of a bake's inputs: SHA-256 over dataclasses and arrays, by which a resumed bake recognizes other objects or lights.

Names and order of the dataclasses' fields are hashed, too: renaming a field of `Catalog` or `EnvironmentMap` changes every manifest.
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from synpick_warp.scenes.looks import Looks
from synpick_warp.scenes.types import Catalog, EnvironmentMap


def digest_inputs(catalog: Catalog, lights: tuple[EnvironmentMap, ...], looks: Looks | None = None) -> dict[str, str]:
    """Digests of the content of objects, lights, distractors and textures, without the names of their files: the manifest's INPUTS."""
    textures = {"textures": _digest_data(tuple(looks.textures.values()))} if looks and looks.all_textures else {}
    distractors = {"distractors": _digest_data(catalog.distractors)} if catalog.distractors else {}
    return {"objects": _digest_data(catalog), "lights": _digest_data(lights)} | distractors | textures


def _digest_data(value: object) -> str:
    """SHA-256 of nested data, by type and content."""
    state = hashlib.sha256()
    for part in _parts(value):
        state.update(part)
    return state.hexdigest()


def _parts(value: object) -> Iterator[bytes]:
    """Serialize dataclasses, tuples, arrays and plain values; paths, and fields that are not hashed, are left out."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield np.ascontiguousarray(value).tobytes()
    elif isinstance(value, tuple):
        yield f"({len(value)}".encode()
        for part in value:
            yield from _parts(part)
    elif dataclasses.is_dataclass(value):
        for item in (item for item in dataclasses.fields(value) if item.hash is not False):
            yield item.name.encode()
            yield from _parts(getattr(value, item.name))
    elif not isinstance(value, Path):
        yield repr(value).encode()
