"""Memory of what takes most of the time to build small worlds, and follows from its arguments alone."""

from __future__ import annotations

import functools
import hashlib
import pickle
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from newton._src.geometry import narrow_phase

from synpick_warp.stages.render import scene

MOST_MAPS = 50
"""Environment maps whose tables are kept."""
KERNELS = ("create_narrow_phase_kernel_gjk_mpr", "create_narrow_phase_primitive_kernel")
"""Functions by which Newton generates kernels anew for each collision pipeline."""


@contextmanager
def made_once() -> Iterator[None]:
    """Tables of environment maps, and Newton's kernels of the narrow phase, are made once a process and its forks."""
    tables, make = {}, scene.precompute_environment

    def remember(*arguments: object) -> object:
        key = hashlib.sha256(pickle.dumps(arguments)).digest()
        if key not in tables:
            if len(tables) > MOST_MAPS:
                tables.clear()
            tables[key] = make(*arguments)
        return tables[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scene, "precompute_environment", remember)
        for name in KERNELS:
            patch.setattr(narrow_phase, name, functools.cache(getattr(narrow_phase, name)))
        yield
