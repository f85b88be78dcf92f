"""Asset files of users: size limits, file names, and the files that a model or a set of lights refers to.

A model folder or light folder may come from anywhere. Its files are read whole, up to the limits here, and libraries get bytes; OpenCV
alone opens environment maps by their path, once their headers are checked.
"""

from __future__ import annotations

import logging
import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from synpick_warp.errors import CatalogError, SynpickError
from synpick_warp.inputs.files import read_file
from synpick_warp.inputs.paths import path_inside

MAX_MESH_FILE = 2**28
"""Largest binary mesh file [bytes]: 256 MiB, some 2 million triangles with their textures."""
MAX_TEXT_MESH = 2**27
"""Largest OBJ or ASCII PLY file [bytes]: 128 MiB, since text takes several times its size while it is read."""
MAX_ROWS = 2**21
"""Maximum number of vertices, and of triangles, of one model: 2 million; finer scans show no more at any resolution here."""
MAX_PARTS = 2**12
"""Maximum number of parts, materials, nodes or buffers of one model: 4096."""
MAX_SHOWN = 200
"""Length to which a library's message is cut."""

# Readers log what they leave out; without a handler, Python prints such lines to standard error.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


@contextmanager
def quiet_decoding() -> Iterator[None]:
    """Silence warnings of NumPy and Pillow: whatever was decoded is validated afterwards. Text that is no number stays an error."""
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        warnings.filterwarnings("error", message=".*could not be read to its end.*")
        yield


def check_file_name(path: Path, error: type[SynpickError]) -> None:
    """Check that a file's name is printable UTF-8, since it becomes a name in the data set; raises `error`."""
    if not path.name.isprintable():
        shown = ascii(path.name)[1:-1]
        raise error(f'{ascii(str(path.parent))[1:-1]}: the file name "{shown}" is not printable UTF-8; rename the file')


def describe_error(error: BaseException) -> str:
    """Message of a library's exception as one short line."""
    if isinstance(error, ImportError):
        return "it uses a feature of the format that is not supported"
    text = " ".join(str(error).split()) or type(error).__name__
    text = text if text.isprintable() else ascii(text)[1:-1]
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}…"


def read_referred(folder: Path, name: str, owner: object, limit: int) -> tuple[Path, bytes]:
    """Read a file that a model file names, inside the model folder only.

    Args:
        folder: Folder of the model file.
        name: The name in it.
        owner: The model file, for errors.
        limit: Largest size [bytes].

    Raises:
        CatalogError: The name leads out of the folder, or the file is missing, too large or not a regular file.
    """
    path = path_inside(folder, name, owner, CatalogError)
    if not os.path.lexists(path):
        raise CatalogError(f"{owner} refers to {name!a}, but there is no file {path}; add it or remove the reference")
    return path, read_file(path, limit, CatalogError)
