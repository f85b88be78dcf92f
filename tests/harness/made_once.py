"""Memoization of pure functions that dominate the set-up of small worlds, and test doubles for disk flushes and subprocesses."""

import functools
import hashlib
import os
import pickle
import tomllib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import warp as wp
from newton._src.geometry import narrow_phase

from synpick_warp.apps.conversion import run
from synpick_warp.apps.evaluation import figures
from synpick_warp.apps.viz import explain
from synpick_warp.cloud import run as cloud_run
from synpick_warp.dataset.commit import merge, writing
from synpick_warp.exporters.writing.pool import WriterPool
from synpick_warp.factory import pipeline
from synpick_warp.kernels.render.visibility.variants import VARIANTS
from synpick_warp.scenes.collision import simplification
from synpick_warp.stages.render import light_tables, scene
from synpick_warp.system.processes import isolation
from tests.harness.charts import render_here

MOST_MAPS, MOST_HULLS = 50, 1000
"""Maximum number of cached environment tables or parsed TOML files, and of cached convex hulls."""
KERNELS = ("create_narrow_phase_kernel_gjk_mpr", "create_narrow_phase_primitive_kernel")
"""Newton's kernel factories, which generate new kernels for each collision pipeline."""


def remembered(make: Callable[..., object], most: int = MOST_MAPS) -> Callable[..., object]:
    """Memoize a function of arrays; the cache is keyed by the digest of the arguments, and cleared above `most` entries."""
    tables: dict[bytes, object] = {}

    def remember(*arguments: object) -> object:
        key = hashlib.sha256(pickle.dumps(arguments)).digest()
        if key not in tables:
            if len(tables) > most:
                tables.clear()
            tables[key] = make(*arguments)
        return tables[key]

    return remember


def permuted(template: wp.Kernel, types: dict[str, Any], overload: Callable[..., wp.Kernel] = wp.overload) -> wp.Kernel:
    """`wp.overload`, with a module for each set of structs that are not the default: in the module of its template, a permutation is
    compiled again with those of all tests that ran before in this process, in every order of tests."""
    special = {kind.key for name, kind in types.items() if name in VARIANTS and kind is not VARIANTS[name][0]}
    if special:
        module = wp.get_module(".".join([template.module.name, *sorted(special)]))
        module.options = dict(template.module.options)
        template = wp.Kernel(template.func, template.key, module, template.options)
    return overload(template, types)


@contextmanager
def made_once() -> Iterator[None]:
    """Cache environment tables, convex hulls, parsed TOML and Newton's narrow-phase kernels for the life of a process; forks inherit them.
    Permutations of kernels are compiled apart (`permuted`).

    Files are not flushed to the disk, as no test simulates a power failure here: what a killed process wrote remains.
    """
    with pytest.MonkeyPatch.context() as patch:
        for module, name in ((scene, "precompute_environment"), (light_tables, "environment_cdf")):
            patch.setattr(module, name, remembered(getattr(module, name)))
        patch.setattr(simplification, "hull_piece", remembered(simplification.hull_piece, MOST_HULLS))
        for name in KERNELS:
            patch.setattr(narrow_phase, name, functools.cache(getattr(narrow_phase, name)))
        patch.setattr(wp, "overload", permuted)
        read = functools.lru_cache(maxsize=MOST_MAPS)(lambda text, loads=tomllib.loads: pickle.dumps(loads(text)))
        patch.setattr(tomllib, "loads", lambda text: pickle.loads(read(text)))
        patch.setattr(os, "fsync", lambda handle: None)
        patch.setattr(writing, "sync_file_system", lambda folder: None)
        patch.setattr(isolation, "IDLE_TIME", 600.0)  # Between two tests that read files half a minute may pass.
        yield


@contextmanager
def written_here() -> Iterator[None]:
    """Bakes, also the ends of those into stores, conversions and merges with one writer write in their own process, in which charts are
    rendered, too: another takes longer to start than to write a small set or to render a few charts.
    """

    def pool(processes: int, *arguments: int) -> WriterPool:
        return WriterPool(processes if processes > 1 else 0, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        for module in (pipeline, run, merge, cloud_run):
            patch.setattr(module, "WriterPool", pool)
        for module in (explain, figures):
            patch.setattr(module, "render_charts", render_here)
        yield
