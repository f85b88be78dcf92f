"""Cache of detected symmetries in the user's cache folder. The key is a hash of the mesh, the tolerance and the source code of
the detection: symmetries of a part are detected once, and again after the code has changed."""

import contextlib
import hashlib
import os
from pathlib import Path

import numpy as np
import scipy

from synpick_warp.errors import CatalogError
from synpick_warp.scenes.collision.shapes import write_arrays
from synpick_warp.scenes.symmetries import detection, surface
from synpick_warp.scenes.symmetries.detection import Symmetries, Turn, find_symmetries
from synpick_warp.system import linear_algebra
from synpick_warp.system.hardware.kernels import user_cache
from synpick_warp.system.inputs.files import check_regular_file

MAX_FILE = 1 << 22
"""Largest file that is read [bytes]: 20,000 symmetries, more than an object can have."""


def cached_symmetries(vertices: np.ndarray, faces: np.ndarray, diameter: float, tolerance: float, folder: Path | None = None) -> Symmetries:
    """Symmetries of a mesh by `find_symmetries`, or those that it found before. `folder`: cache folder, which need not exist nor be
    writable; None: that of the user."""
    given = (diameter, tolerance, vertices.shape, vertices.dtype, faces.shape, faces.dtype, np.__version__, scipy.__version__)
    digest = hashlib.sha256(repr(given).encode())
    for part in (*(Path(str(module.__file__)).read_bytes() for module in (detection, surface, linear_algebra)), vertices, faces):
        digest.update(part if isinstance(part, bytes) else np.ascontiguousarray(part).tobytes())
    file = (folder or (user_cache() or Path(os.devnull)) / "synpick-warp" / "symmetries") / f"{digest.hexdigest()}.npz"
    with contextlib.suppress(Exception):  # A damaged file raises nearly anything; whatever it is, the symmetries are found again.
        check_regular_file(file, MAX_FILE, CatalogError)
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            turns = [Turn(row[:3], row[3:6], int(row[6]), float(row[7])) for row in data["turns"].reshape(-1, 8)]
            continuous, missed = turns[: int(data["continuous"])], turns[int(data["continuous"]) :]
            return Symmetries(data["discrete"].reshape(-1, 4, 4), data["deviations"], tuple(continuous), missed[0] if missed else None)
    found = find_symmetries(vertices, faces, diameter, tolerance)
    with contextlib.suppress(OSError):  # Without a cache they are found each time.
        turns = [*found.continuous, *([] if found.missed is None else [found.missed])]
        rows = np.array([(*turn.axis, *turn.point, turn.fold, turn.deviation) for turn in turns], np.float64)
        count = np.array(len(found.continuous))
        write_arrays(file, turns=rows, continuous=count, discrete=found.discrete, deviations=found.deviations)
    return found
